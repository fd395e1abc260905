"""The paper's Scenarios 1 and 2: positions (``Fig:pic5sim``) and accelerations (``Fig:pic5act``) under PPO and SAC."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
from matplotlib.figure import Figure

from ethbrake_marl.evaluation.door import SEED
from ethbrake_marl.evaluation.record import EpisodeRecord, record_episode
from ethbrake_marl.extensions.report.style import GREY, finish, in_our_style, new_panels, series_style
from ethbrake_marl.extensions.reproduction.made import POLICIES, Drawn, Made, Settings
from ethbrake_marl.extensions.reproduction.readings import COUPLED, FOUR, NON_ETHICAL, PPO, READINGS, SAC, Reading
from ethbrake_marl.extensions.reproduction.verdicts import Less, Verdict, judge_statement
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.names import open_game, teams_of

AGENTS = {name: FOUR[name] for name in (PPO, SAC, COUPLED, NON_ETHICAL)}
DRL = (PPO, SAC)
SCENARIOS = (1, 2)
ARROW_S = 1.0  # between arrows: ten steps, as in the paper
VEHICLE_2 = 1  # column of arrays

Records = dict[tuple[Reading, int, str], EpisodeRecord]  # (reading, number of the scenario, strategy) -> episode


@cache
def record_all() -> Records:
    """Return the recorded episodes."""
    records: Records = {}
    for reading in READINGS:
        for number in SCENARIOS:
            scenario, game = open_game(reading.scenario(f"paper-scenario-{number}"))
            world = scenario.sample(1, SEED)
            for name, team in teams_of(AGENTS, scenario).items():
                records[reading, number, name] = record_episode(world, team, game)
    return records


@in_our_style
def road_figure(records: Mapping[str, EpisodeRecord], caption: str) -> Figure:
    """Draw vehicles along the road in four episodes, as the paper does: a row each, an arrow every second.

    Dashes join equal times.
    """
    figure, panels = new_panels((10.0, 4.8), 2, 2, sharex=True, sharey=True)
    for axes, (title, record) in zip(panels, records.items(), strict=True):
        vehicles = np.arange(1, record.positions_m.shape[1] + 1)
        times = np.arange(0.0, record.time_s[-1] + 1e-9, ARROW_S)
        at = np.array([np.interp(times, record.time_s, column) for column in record.positions_m.T])
        axes.plot(at, vehicles, color=GREY, linewidth=0.7, linestyle="--")
        for number, places in zip(vehicles, at, strict=True):
            axes.plot(places, np.full(len(times), number), marker=">", color=series_style(number)["color"])
        axes.set(title=title, xlabel="Position along the road (m)", ylabel="Vehicle", yticks=vehicles, ylim=(0.5, 3.5))
        axes.label_outer()
    return finish(figure, caption)


@in_our_style
def profiles_figure(panels: Mapping[str, Mapping[str, EpisodeRecord]], caption: str) -> Figure:
    """Draw the command of Vehicle 2 over time: title of one of four panels -> label of a curve -> episode."""
    figure, every = new_panels((10.0, 5.6), 2, 2, sharex=True, sharey=True)
    for axes, (title, records) in zip(every, panels.items(), strict=True):
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        for number, (label, record) in enumerate(records.items()):
            style = {**series_style(number), "marker": ""}
            command = record.command_mps2[:, VEHICLE_2]
            axes.plot(record.time_s, command, drawstyle="steps-post", label=label, **style)
        axes.set(title=title, xlabel="Time since Vehicle 1 began to brake (s)", ylabel="Command (m/s²)")
        axes.label_outer()
    return finish(figure, caption, every[0], columns=4)


def reproduce_trajectories(settings: Settings) -> Made:
    """Reproduce the trajectories."""
    records, figures, verdicts = record_all(), [], []
    for reading, stem in zip(READINGS, ("stated", "early"), strict=True):
        own = {f"{name}, Scenario {k}": records[reading, k, name] for name in DRL for k in SCENARIOS}
        text = f"Positions of the vehicles, {reading.name}; an arrow every second, dashed lines join equal times."
        road = road_figure(own, text)
        figures.append(Drawn(f"trajectories-road-{stem}", f"Trajectories, {reading.name}", text, road))
        one, two = (apart(records, reading, k, "positions_m") for k in SCENARIOS)
        ahead, behind = ([float(gap.mean()) for gap in both(records, reading, 2, "gaps_m", k)] for k in (0, 1))
        claims = {
            "Vehicle 2 of PPO and SAC is nearer together in Scenario 1 than in 2": (
                f"root mean square {one:.2f} m against {two:.2f} m", one, two,
            ),
            "Scenario 2: PPO keeps the larger distance to Vehicle 3": (
                f"mean gap {behind[1]:.2f} m under SAC, {behind[0]:.2f} m under PPO", behind[1], behind[0],
            ),
            "Scenario 2: SAC keeps the larger distance to Vehicle 1": (
                f"mean gap {ahead[0]:.2f} m under PPO, {ahead[1]:.2f} m under SAC", ahead[0], ahead[1],
            ),
        }  # fmt: skip
        verdicts += judge_one_world(claims, reading, " m")
    rows = [
        (
            *(reading.name, str(number), name, int(record.impacts.number.sum())),
            *(float(record.last.harm("first")[0]), *map(float, record.gaps_m[-1])),
        )
        for (reading, number, name), record in records.items()
    ]
    numbers = map(Column, ("Impacts", "First-impact harm", "Last gap 1 (m)", "Last gap 2 (m)"))
    note = f"One world each: no intervals. Harm in m²/s². {POLICIES}"
    sheet = Sheet("How the episodes end", ("Reading", "Scenario", "Strategy", *numbers), rows, note)
    return Made(verdicts, [sheet], figures)


def reproduce_accelerations(settings: Settings) -> Made:
    """Reproduce the commands of Vehicle 2."""
    records, verdicts = record_all(), []
    asked = {key: asked_of_vehicle_2(record) for key, record in records.items()}
    panels = {
        f"{name}, Scenario {k}": {reading.name: records[reading, k, name] for reading in READINGS}
        for name in DRL
        for k in SCENARIOS
    }
    text = "Command of Vehicle 2 over time, as the paper states the latencies and with Vehicle 2 acting at 0.2 s."
    figure = Drawn("accelerations", "Acceleration profiles", text, profiles_figure(panels, text))
    for reading in READINGS:
        one, two = (apart(records, reading, k, "command_mps2") for k in SCENARIOS)
        (first, ppo_changes, _), (_, sac_changes, braking) = (asked[reading, 2, name] for name in DRL)
        claims = {
            "the profiles are more alike in Scenario 1 than in 2": (
                f"root mean square difference {one:.2f} m/s² against {two:.2f} m/s²", one, two,
            ),
            "Scenario 2: PPO accelerates before it brakes": (f"first command {first:+.2f} m/s²", 0.0, first),
            "Scenario 2: SAC decelerates throughout most of it": (
                f"braking in {100.0 * braking:.0f} % of the time it moves", 0.5, braking,
            ),
            "Scenario 2: PPO's profile is the smoother one": (
                f"ups and downs {ppo_changes:.1f} m/s² under PPO, {sac_changes:.1f} m/s² under SAC", ppo_changes,
                sac_changes,
            ),
        }  # fmt: skip
        verdicts += judge_one_world(claims, reading, " m/s²")
    rows = [
        (
            *(reading.name, str(number), name, first),
            *(float(records[reading, number, name].command_mps2[:, VEHICLE_2].min()), braking, changes),
        )
        for (reading, number, name), (first, changes, braking) in asked.items()
    ]
    numbers = (
        Column("First command", sign="+"),
        Column("Hardest", sign="+"),
        Column("Braking while it moves", digits=0, scale=100.0, unit=" %"),
        Column("Ups and downs", digits=1),
    )
    note = "Commands of Vehicle 2 in m/s². One world each: no intervals."
    sheet = Sheet("Commands of Vehicle 2", ("Reading", "Scenario", "Strategy", *numbers), rows, note)
    return Made(verdicts, [sheet], [figure])


def both(records: Records, reading: Reading, number: int, what: str, column: int) -> list[Floats]:
    """Return a recorded quantity under PPO, and under SAC at the same times; an episode that has ended stays as it is.

    ``number`` is that of the scenario, ``what`` an attribute of ``EpisodeRecord``, ``column`` a vehicle or pair from 0.
    """
    pair = [records[reading, number, name] for name in DRL]
    times = np.arange(0.0, float(max(record.time_s[-1] for record in pair)), 0.02)
    return [np.interp(times, each.time_s, getattr(each, what)[:, column]) for each in pair]


def apart(records: Records, reading: Reading, number: int, what: str) -> float:
    """Return the root mean square over time of the difference between PPO and SAC, of Vehicle 2."""
    one, other = both(records, reading, number, what, VEHICLE_2)
    return float(np.sqrt(np.mean((one - other) * (one - other))))


def judge_one_world(claims: Mapping[str, tuple[str, float, float]], reading: Reading, unit: str) -> list[Verdict]:
    """Return verdicts on claims about one world: claim -> words, the number that should be smaller, the larger one."""
    show = Column("", unit=unit)
    return [
        judge_statement(f"{claim} ({reading.name})", [Less(words, Estimate(smaller - larger, None))], show=show)
        for claim, (words, smaller, larger) in claims.items()
    ]


def asked_of_vehicle_2(record: EpisodeRecord) -> tuple[float, float, float]:
    """Return the first command of Vehicle 2 and the sum of its changes (m/s2), and how long it brakes while it moves.

    The last is a share of the time in which it moves after its latency.
    """
    acting = record.time_s >= float(record.initial.latency_s[0, VEHICLE_2])
    command, moving = record.command_mps2[acting, VEHICLE_2], record.speeds_mps[acting, VEHICLE_2] > 0.0
    return float(command[0]), float(np.abs(np.diff(command)).sum()), float((command[moving] < 0.0).mean())
