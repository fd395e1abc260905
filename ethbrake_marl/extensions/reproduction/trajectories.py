"""The paper's Scenarios 1 and 2: positions (``Fig:pic5sim``) and accelerations (``Fig:pic5act``) under PPO and SAC."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
from matplotlib.figure import Figure

from ethbrake_marl.evaluation.evaluate import SEED
from ethbrake_marl.evaluation.record import EpisodeRecord, record_agents
from ethbrake_marl.extensions.report.style import GREY, finish, in_our_style, new_panels, series_style
from ethbrake_marl.extensions.reproduction.made import DRIVERS, DrawnFigure, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.strategies import SHIPPED_SPECS
from ethbrake_marl.extensions.reproduction.verdicts import Claim, Verdict, recorded, same_claim
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats

PAPER_SCENARIOS = (1, 2)
ARROW_S = 1.0  # between arrows: ten steps, as in the paper
VEHICLE_2_COLUMN = 1  # column of arrays
HOLDS = {True: "holds", False: "does not hold"}

Records = Mapping[tuple[str, int], EpisodeRecord]  # (PPO or SAC, number of the scenario) -> episode


@cache
def record_all(policies: tuple[tuple[str, str], ...] = (*SHIPPED_SPECS.items(),)) -> Records:
    records: dict[tuple[str, int], EpisodeRecord] = {}
    for number in PAPER_SCENARIOS:
        played = record_agents(f"paper-scenario-{number}", dict(policies), seed=SEED, harm_count="first")
        records |= {(name, number): record for name, record in played.items()}
    return records


@in_our_style
def road_figure(records: Records, caption: str) -> Figure:
    """Dashed lines join the vehicles at the same time. ``records``: (policy, scenario number) -> episode."""
    figure, panels = new_panels((10.0, 4.8), 2, 2, sharex=True, sharey=True)
    for axes, ((name, number), record) in zip(panels, records.items(), strict=True):
        vehicles = np.arange(1, record.positions_m.shape[1] + 1)
        times = np.arange(0.0, record.time_s[-1] + 1e-9, ARROW_S)
        at = np.array([np.interp(times, record.time_s, column) for column in record.positions_m.T])
        axes.plot(at, vehicles, color=GREY, linewidth=0.7, linestyle="--")
        for vehicle, places in zip(vehicles, at, strict=True):
            axes.plot(places, np.full(len(times), vehicle), marker=">", color=series_style(vehicle)["color"])
        axes.set(title=f"{name}, Scenario {number}", xlabel="Position along the road (m)", ylabel="Vehicle")
        axes.set(yticks=vehicles, ylim=(0.5, 3.5))
        axes.label_outer()
    return finish(figure, caption)


@in_our_style
def profiles_figure(records: Records, caption: str) -> Figure:
    """Commands of Vehicle 2 over time: one panel for each policy and scenario."""
    figure, panels = new_panels((10.0, 5.6), 2, 2, sharex=True, sharey=True)
    for axes, ((name, number), record) in zip(panels, records.items(), strict=True):
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        command = record.command_mps2[:, VEHICLE_2_COLUMN]
        axes.plot(record.time_s, command, drawstyle="steps-post", **{**series_style(0), "marker": ""})
        axes.set(title=f"{name}, Scenario {number}", ylabel="Command (m/s²)")
        axes.set(xlabel="Time since Vehicle 1 began to brake (s)")
        axes.label_outer()
    return finish(figure, caption)


def positions(records: Records) -> dict[str, tuple[str, bool]]:
    """What the paper says of Fig. 6: claim -> numbers in words, and whether it holds."""
    smaller, larger = (policy_difference(records, k, "positions_m") for k in PAPER_SCENARIOS)
    (ppo_1, sac_1), (ppo_2, sac_2) = (
        [float(gap.mean()) for gap in resample_pair(records, 2, "gaps_m", pair)] for pair in (0, 1)
    )
    return {
        "trajectories/alike in Scenario 1": (
            f"root mean square {smaller:.2f} m against {larger:.2f} m", smaller < larger,
        ),
        "trajectories/PPO from Vehicle 3": (
            f"mean gap {sac_2:.2f} m under SAC, {ppo_2:.2f} m under PPO", sac_2 < ppo_2,
        ),
        "trajectories/SAC from Vehicle 1": (
            f"mean gap {ppo_1:.2f} m under PPO, {sac_1:.2f} m under SAC", ppo_1 < sac_1,
        ),
    }  # fmt: skip


def commands(records: Records) -> dict[str, tuple[str, bool]]:
    """What the paper says of Fig. 7: claim -> numbers in words, and whether it holds."""
    in_1, in_2 = (policy_difference(records, k, "command_mps2") for k in PAPER_SCENARIOS)
    (first, ppo_changes, _), (_, sac_changes, braking) = (profile_of(records[name, 2]) for name in ("PPO", "SAC"))
    return {
        "accelerations/alike in Scenario 1": (
            f"root mean square difference {in_1:.2f} m/s² against {in_2:.2f} m/s²", in_1 < in_2,
        ),
        "accelerations/PPO accelerates": (f"first command {first:+.2f} m/s²", first > 0.0),
        "accelerations/SAC decelerates": (
            f"braking in {100.0 * braking:.0f} % of the time it moves", braking > 0.5,
        ),
        "accelerations/PPO is smoother": (
            f"ups and downs {ppo_changes:.1f} m/s² under PPO, {sac_changes:.1f} m/s² under SAC",
            ppo_changes < sac_changes,
        ),
    }  # fmt: skip


def reproduce_trajectories(settings: ReproductionSettings) -> Made:
    """Fig. 6."""
    records = record_all()
    text = "Positions of the vehicles; an arrow every second, dashed lines join equal times."
    figure = DrawnFigure("trajectories", "Trajectories", text, road_figure(records, text))
    claims = [shape_claim(name, *found) for name, found in positions(records).items()]
    return Made(claims, figures=[figure], notes=[DRIVERS])


def reproduce_accelerations(settings: ReproductionSettings) -> Made:
    """Fig. 7."""
    records = record_all()
    text = "Command of Vehicle 2 over time."
    figure = DrawnFigure("accelerations", "Acceleration profiles", text, profiles_figure(records, text))
    rows = [
        (str(number), policy, first, float(record.command_mps2[:, VEHICLE_2_COLUMN].min()), braking, changes)
        for (policy, number), record in records.items()
        for first, changes, braking in (profile_of(record),)
    ]
    numbers = (
        Column("First command", sign="+"),
        Column("Hardest", sign="+"),
        Column("Braking while it moves", digits=0, scale=100.0, unit=" %"),
        Column("Ups and downs", digits=1),
    )
    note = "Commands of Vehicle 2 in m/s². One world each: no intervals."
    sheet = Sheet("Commands of Vehicle 2", ("Scenario", "Policy", *numbers), rows, note)
    claims = [shape_claim(name, *found) for name, found in commands(records).items()]
    return Made(claims, [sheet], [figure])


def resample_pair(records: Records, number: int, what: str, column: int) -> list[Floats]:
    """A recorded quantity under PPO and under SAC, [k] each, at the same k times.

    ``what``: attribute of ``EpisodeRecord``. ``column``: vehicle or pair, from 0. After an episode has ended, its last
    value is repeated.
    """
    pair = [records[name, number] for name in ("PPO", "SAC")]
    times = np.arange(0.0, float(max(record.time_s[-1] for record in pair)), 0.02)
    return [np.interp(times, record.time_s, getattr(record, what)[:, column]) for record in pair]


def policy_difference(records: Records, number: int, what: str) -> float:
    """Root mean square over time of the difference between PPO and SAC in a recorded quantity of Vehicle 2."""
    ppo, sac = resample_pair(records, number, what, VEHICLE_2_COLUMN)
    return float(np.sqrt(np.mean((ppo - sac) * (ppo - sac))))


def shape_claim(result: str, numbers: str, holds: bool) -> Claim:
    """A claim about one world agrees, or differs, if the shipped policies and those of the paper's process, of which
    there are several seeds (``recorded.yaml``), all say so, and else is undecided. The same in every reading.
    """
    of_seeds = [HOLDS[each] for each in recorded()["seeds"][result]]
    text = f"{HOLDS[holds]}: {numbers}; by the paper's process, by seed: {', '.join(of_seeds)}"
    same: Verdict = "agrees" if holds else "differs"
    return same_claim(result.split("/")[1], text, same if {*of_seeds} == {HOLDS[holds]} else "undecided")


def profile_of(record: EpisodeRecord) -> tuple[float, float, float]:
    """First command of Vehicle 2 (m/s2), sum of the absolute changes of its command (m/s2), and share of braking.

    Only the time after the vehicle's latency counts. The share is the fraction of its time in motion in which it
    brakes.
    """
    acting = record.time_s >= float(record.initial.latency_s[0, VEHICLE_2_COLUMN])
    command, moving = record.command_mps2[acting, VEHICLE_2_COLUMN], record.speeds_mps[acting, VEHICLE_2_COLUMN] > 0.0
    return float(command[0]), float(np.abs(np.diff(command)).sum()), float((command[moving] < 0.0).mean())
