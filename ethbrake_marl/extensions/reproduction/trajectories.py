"""Reproduce the paper's figures of its Scenarios 1 and 2.

For both scenarios, the paper shows trajectories (figure ``Fig:pic5sim``) and accelerations (figure ``Fig:pic5act``).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np

from ethbrake_marl.extensions.report.episode_figure import trajectories
from ethbrake_marl.extensions.report.page import Part
from ethbrake_marl.extensions.report.player import Played
from ethbrake_marl.extensions.reproduction.figures import profiles_figure, road_figure
from ethbrake_marl.extensions.reproduction.folder import (
    POLICIES,
    Drawn,
    Made,
    Parameter,
    Reproduction,
    csv_text,
    scenario_parameters,
    stated,
)
from ethbrake_marl.extensions.reproduction.strategies import (
    COUPLED,
    FULL_BRAKE,
    NAMES,
    PPO,
    READINGS,
    SAC,
    Reading,
    lineup,
)
from ethbrake_marl.extensions.reproduction.verdicts import LIST_SEED, Less, Verdict, judge_statement
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.first_edition.evaluation.lineup import make_agents
from ethbrake_marl.first_edition.evaluation.record import EpisodeRecord, record_episode
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.progress import Progress

_AGENTS = (PPO, SAC, COUPLED, FULL_BRAKE)

_POLICIES = (NAMES[PPO], NAMES[SAC])

_SCENARIOS = (1, 2)

_CELLS = [(reading, number) for reading in READINGS for number in _SCENARIOS]

Records = dict[tuple[Reading, int, str], EpisodeRecord]  # (assumption, number of the scenario, strategy) -> episode


def reproduce_trajectories(settings: Reproduction) -> Made:
    """Reproduce the trajectories in the paper's Scenarios 1 and 2."""
    records, figures, verdicts = _record_all(settings), {}, []
    for reading, stem in zip(READINGS, ("stated", "early"), strict=True):
        own = {f"{name}, Scenario {k}": records[reading, k, name] for name in _POLICIES for k in _SCENARIOS}
        text = f"Positions of the vehicles, {reading.name}; an arrow every second, dashed lines join equal times."
        road = Drawn(f"trajectories-road-{stem}", f"Trajectories, {reading.name}", text)
        figures[road] = road_figure(own, caption=text)
        text = f"The same over time, {reading.name}: positions with impacts, gaps, commands of Vehicle 2."
        over_time = Drawn(f"trajectories-time-{stem}", f"Over time, {reading.name}", text)
        figures[over_time] = trajectories(own, caption=text)
        one, two = _apart(records, reading, "positions_m")
        ahead, behind = ([float(gaps.mean()) for gaps in _both(records, reading, 2, "gaps_m", k)] for k in (0, 1))
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
        verdicts += _judge_one_world(claims, reading, Column("Distance", unit=" m"))
    rows = [
        (
            *(reading.name, number, name, len(record.impacts.time_s)),
            *(float(record.ledger.world_harm("first")[0]), *map(float, record.gaps_m[-1])),
        )
        for (reading, number, name), record in records.items()
    ]
    head = ("Reading", "Scenario", "Strategy", "Impacts", "First-impact harm", "Last gap 1 (m)", "Last gap 2 (m)")
    table = Sheet("How the episodes end", head, rows, "One world each: no intervals. Harm in m²/s².")
    return Made(verdicts, _parameters(), [table], figures, {"trajectories": _csv(records)})


def reproduce_accelerations(settings: Reproduction) -> Made:
    """Reproduce the commands of Vehicle 2 in the paper's Scenarios 1 and 2."""
    records, verdicts = _record_all(settings), []
    commands = {key: _asked_of_vehicle_2(record) for key, record in records.items()}
    panels = {
        f"{name}, Scenario {number}": {reading.name: records[reading, number, name] for reading in READINGS}
        for name in _POLICIES
        for number in _SCENARIOS
    }
    text = "Command of Vehicle 2 over time, as the paper states the latencies and with Vehicle 2 acting at 0.2 s."
    figures = {Drawn("accelerations", "Acceleration profiles", text): profiles_figure(panels, caption=text)}
    for reading in READINGS:
        one, two = _apart(records, reading, "command_mps2")
        (first, ppo_changes, _), (_, sac_changes, braking) = (commands[reading, 2, name] for name in _POLICIES)
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
        verdicts += _judge_one_world(claims, reading, Column("Command", unit=" m/s²"))
    rows = [
        (
            *(reading.name, number, name, f"{first:+.2f}"),
            f"{records[reading, number, name].command_mps2[:, 1].min():+.2f}",
            *(f"{100.0 * braking:.0f} %", f"{changes:.1f}"),
        )
        for (reading, number, name), (first, changes, braking) in commands.items()
    ]
    head = ("Reading", "Scenario", "Strategy", "First command", "Hardest", "Braking while it moves", "Ups and downs")
    note = "Commands of Vehicle 2 in m/s². One world each: no intervals."
    table = Sheet("Commands of Vehicle 2", head, rows, note)
    return Made(verdicts, _parameters(), [table], figures, {"accelerations": _csv(records)})


def _record_all(settings: Reproduction) -> Records:
    records: Records = {}
    for reading, number in _CELLS:
        scenario = reading.scenario(f"paper-scenario-{number}")
        world = scenario.sample(1, LIST_SEED).worlds
        for name, agent in lineup(scenario, *_AGENTS).items():
            records[reading, number, name] = record_episode(world, agent, scenario=scenario)
            settings.tell(Progress("recorded episodes", len(records), len(_CELLS) * len(_AGENTS)))
    return records


@cache
def play() -> Part:
    """Return an interactive player of the episodes in Scenarios 1 and 2, as a part of the page.

    The player has one episode for each scenario, strategy and ``strategies.Reading``; it first shows PPO and SAC.
    """
    records = []
    for reading, number in _CELLS:
        scenario = reading.scenario(f"paper-scenario-{number}")
        world = scenario.sample(1, LIST_SEED).worlds
        latencies = ",".join(f"{each:g}" for each in scenario.model_dump()["latency_s"])
        again = "" if reading.acts_s is None else f"--set latency_s=[{latencies}]"
        one = Played(0, reading.name, again, title=f"Scenario {number}, {reading.name}")
        for spec, agent in make_agents(_AGENTS, scenario).items():
            Played.drive([one], world, NAMES[spec], agent, scenario)
        records.append(one)
    return Part.player(records, scenario.learners, shown_first=[_AGENTS.index(PPO), _AGENTS.index(SAC)])


def _parameters() -> list[Parameter]:
    one, two = (scenario_parameters(load_scenario(f"paper-scenario-{k}")) for k in _SCENARIOS)
    parameters = [
        stated(first.name, f"{first.value}; Scenario 2: {second.value}", "text to Fig:pic5sim")
        if first.value != second.value
        else first
        for first, second in zip(one, two, strict=True)
    ]
    return [*parameters, Parameter("policies", f"{POLICIES}; not the paper's")]


def _both(records: Records, reading: Reading, number: int, what: str, column: int) -> tuple[Floats, Floats]:
    """Return the values over time of one recorded quantity: under PPO, and under SAC at the same times.

    ``number`` is 1 or 2 (Scenario 1 or 2). ``what`` is an attribute of ``EpisodeRecord`` such as ``gaps_m``, and
    ``column`` the index (0 = front) of the vehicle or pair. After the end of the shorter episode, its last value is
    repeated.
    """
    pair = [records[reading, number, name] for name in _POLICIES]
    times = np.arange(0.0, float(max(record.time_s[-1] for record in pair)), 0.02)
    one, other = (np.interp(times, each.time_s, getattr(each, what)[:, column]) for each in pair)
    return one, other


def _apart(records: Records, reading: Reading, what: str) -> list[float]:
    """Return how far a quantity of Vehicle 2 differs between PPO and SAC, in Scenario 1 and in Scenario 2.

    The result is the root mean square, over the times of the episode, of the difference. ``what`` is an attribute of
    ``EpisodeRecord`` such as ``positions_m``.
    """
    pairs = (_both(records, reading, number, what, 1) for number in _SCENARIOS)
    return [float(np.sqrt(np.mean((one - other) ** 2))) for one, other in pairs]


def _judge_one_world(claims: Mapping[str, tuple[str, float, float]], reading: Reading, show: Column) -> list[Verdict]:
    """Return a verdict on each claim of the paper about a single world. Numbers for a single world have no intervals.

    ``claims`` maps each claim to a text for the verdict, the number that is smaller according to the claim, and the
    number that is larger.
    """
    return [
        judge_statement(f"{claim} ({reading.name})", [Less(value, Estimate(smaller - larger, None))], show=show)
        for claim, (value, smaller, larger) in claims.items()
    ]


def _asked_of_vehicle_2(record: EpisodeRecord) -> tuple[float, float, float]:
    """Return three numbers that describe the commands of Vehicle 2 in one episode.

    These are the first command after its latency (m/s2), the sum of the absolute changes of the command (m/s2), and the
    time in which it brakes while it moves, divided by the time in which it moves.
    """
    acting = record.time_s >= float(record.initial.vehicles.latency_s[0, 1])
    command, moving = record.command_mps2[acting, 1], record.speeds_mps[acting, 1] > 0.0
    braking = float((command[moving] < 0.0).mean()) if moving.any() else 0.0
    return float(command[0]), float(np.abs(np.diff(command)).sum()), braking


def _csv(records: Records) -> str:
    every = range(1, 4)
    head = [
        *("reading", "scenario", "strategy", "time_s"),
        *(f"position_{i}_m" for i in every),
        *(f"speed_{i}_mps" for i in every),
        *("gap_1_m", "gap_2_m"),
        *(f"command_{i}_mps2" for i in every),
    ]
    rows = [
        [reading.name, number, name, round(float(time_s), 9), *(value for column in columns for value in column[k])]
        for (reading, number, name), record in records.items()
        for columns in [(record.positions_m, record.speeds_mps, record.gaps_m, record.command_mps2)]
        for k, time_s in enumerate(record.time_s)
    ]
    return csv_text(head, rows)
