"""The paper's Scenarios 1 and 2: trajectories (``Fig:pic5sim``) and acceleration profiles (``Fig:pic5act``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ethbrake_marl.evaluation import EpisodeRecord, record_episode
from ethbrake_marl.evaluation.inputs import make_agents
from ethbrake_marl.evaluation.statistics import Estimate
from ethbrake_marl.figures.episode import trajectories
from ethbrake_marl.figures.reproduction import profiles_figure, road_figure
from ethbrake_marl.pages.chosen import drive_played
from ethbrake_marl.pages.player import Played, player_content
from ethbrake_marl.physics import Floats
from ethbrake_marl.studies.reproduction.item import (
    LIST_SEED,
    Drawn,
    Made,
    Parameter,
    Settings,
    Table,
    csv_text,
    scenario_parameters,
)
from ethbrake_marl.studies.reproduction.measure import (
    ABOUT_POLICIES,
    AS_STATED,
    COUPLED,
    FULL_BRAKE,
    NAMES,
    PPO,
    READINGS,
    SAC,
    Reading,
    lineup,
    read_scenario,
)
from ethbrake_marl.studies.reproduction.verdicts import Less, Show, Verdict, judge_statement

_AGENTS = (PPO, SAC, COUPLED, FULL_BRAKE)
_POLICIES = (NAMES[PPO], NAMES[SAC])
_SCENARIOS = (1, 2)
_METRES, _COMMAND = Show(2, unit=" m"), Show(2, unit=" m/s²")
_GRID_S = 0.02

Records = dict[tuple[Reading, int, str], EpisodeRecord]  # reading, scenario, strategy


def reproduce_trajectories(settings: Settings) -> Made:
    """Positions of the three vehicles in both scenarios, against the vehicle and against time."""
    records = _record_all(settings)
    figures = []
    for reading, stem in zip(READINGS, ("stated", "early"), strict=True):
        own = {_panel(number, name): records[reading, number, name] for name in _POLICIES for number in _SCENARIOS}
        text = f"Positions of the vehicles, {reading.name}; an arrow every second, dashed lines join equal times."
        road = road_figure(own, caption=text)
        figures.append(Drawn(f"trajectories-road-{stem}", f"Trajectories, {reading.name}", text, road))
        text = f"The same over time, {reading.name}: positions with impacts, gaps, commands of Vehicle 2."
        over_time = trajectories(own, caption=text)
        figures.append(Drawn(f"trajectories-time-{stem}", f"Over time, {reading.name}", text, over_time))
    verdicts = [verdict for reading in READINGS for verdict in _judge_positions(reading, records)]
    return Made(
        tuple(verdicts), _parameters(), (_outcomes(records),), tuple(figures), {"trajectories": _csv(records)},
        episodes=_played(),
    )  # fmt: skip


def reproduce_accelerations(settings: Settings) -> Made:
    """Commands of Vehicle 2 in both scenarios."""
    records = _record_all(settings)
    panels = {
        _panel(number, name): {reading.name: records[reading, number, name] for reading in READINGS}
        for name in _POLICIES
        for number in _SCENARIOS
    }
    text = "Command of Vehicle 2 over time, as the paper states the latencies and with Vehicle 2 acting at 0.2 s."
    drawn = Drawn("accelerations", "Acceleration profiles", text, profiles_figure(panels, caption=text))
    verdicts = [verdict for reading in READINGS for verdict in _judge_commands(reading, records)]
    return Made(tuple(verdicts), _parameters(), (_profiles(records),), (drawn,), {"accelerations": _csv(records)})


def _record_all(settings: Settings) -> Records:
    found: Records = {}
    for reading in READINGS:
        for number in _SCENARIOS:
            scenario = read_scenario(f"paper-scenario-{number}", reading)
            world = scenario.sample(1, LIST_SEED).worlds
            for name, agent in lineup(_AGENTS, scenario).items():
                found[reading, number, name] = record_episode(world, agent, scenario=scenario)
                settings.say("recorded episodes", len(found), len(READINGS) * len(_SCENARIOS) * len(_AGENTS))
    return found


def _played() -> dict[str, Any]:
    """Both scenarios in both readings, PPO and SAC side by side, for the player of the page."""
    found = []
    for reading in READINGS:
        for number in _SCENARIOS:
            scenario = read_scenario(f"paper-scenario-{number}", reading)
            world = scenario.sample(1, LIST_SEED).worlds
            latencies = ",".join(f"{each:g}" for each in scenario.model_dump()["latency_s"])
            again = "" if reading.acts_s is None else f"replay with --set latency_s=[{latencies}]"
            one = Played(0, reading.name, again, {}, {}, f"Scenario {number}, {reading.name}")
            for spec, agent in make_agents(_AGENTS, scenario).items():
                drive_played([one], world, NAMES[spec], agent, scenario, spec, seed=LIST_SEED)
            found.append(one)
    return player_content(found, scenario.learners) | {"shown": [_AGENTS.index(PPO), _AGENTS.index(SAC)]}


def _panel(number: int, name: str) -> str:
    return f"{name}, Scenario {number}"


def _parameters() -> tuple[Parameter, ...]:
    one, two = (scenario_parameters(read_scenario(f"paper-scenario-{k}", AS_STATED)) for k in _SCENARIOS)
    told = [
        Parameter(first.name, f"{first.value}; Scenario 2: {second.value}", "text to Fig:pic5sim")
        if first.value != second.value
        else first
        for first, second in zip(one, two, strict=True)
    ]
    return (*told, Parameter("policies", f"{ABOUT_POLICIES}; not the paper's", ""))


def _on_grid(record: EpisodeRecord, values: Floats, until_s: float) -> Floats:
    """A column of a record at equal times; beyond its end it stays."""
    times = np.arange(0.0, until_s, _GRID_S)
    found: Floats = np.interp(times, record.time_s, values)
    return found


def _together(records: Records, reading: Reading, number: int) -> tuple[EpisodeRecord, EpisodeRecord, float]:
    """PPO's and SAC's episode of a scenario, and when the later one ends."""
    first, second = (records[reading, number, name] for name in _POLICIES)
    return first, second, float(max(first.time_s[-1], second.time_s[-1]))


def _apart(records: Records, reading: Reading, number: int) -> float:
    """Root mean square distance (m) between the places of Vehicle 2 under PPO and under SAC."""
    first, second, until_s = _together(records, reading, number)
    one, other = (_on_grid(each, each.positions_m[:, 1], until_s) for each in (first, second))
    return float(np.sqrt(np.mean((one - other) ** 2)))


def _mean_gap(record: EpisodeRecord, pair: int, until_s: float) -> float:
    return float(_on_grid(record, record.gaps_m[:, pair], until_s).mean())


def _below(where: str, smaller: float, larger: float) -> list[Less]:
    """A comparison of two numbers of one world: without an interval."""
    return [Less(where, Estimate(smaller - larger, None))]


def _judge_positions(reading: Reading, records: Records) -> list[Verdict]:
    """The paper's statements about the trajectories."""
    ppo, sac, until_s = _together(records, reading, 2)
    apart = {number: _apart(records, reading, number) for number in _SCENARIOS}
    gaps = {(name, p): _mean_gap(each, p, until_s) for name, each in (("PPO", ppo), ("SAC", sac)) for p in (0, 1)}
    parts = {
        "Vehicle 2 of PPO and SAC is nearer together in Scenario 1 than in 2": _below(
            f"root mean square {apart[1]:.2f} m against {apart[2]:.2f} m", apart[1], apart[2]
        ),
        "Scenario 2: PPO keeps the larger distance to Vehicle 3": _below(
            f"mean gap {gaps['SAC', 1]:.2f} m under SAC, {gaps['PPO', 1]:.2f} m under PPO",
            gaps["SAC", 1],
            gaps["PPO", 1],
        ),
        "Scenario 2: SAC keeps the larger distance to Vehicle 1": _below(
            f"mean gap {gaps['PPO', 0]:.2f} m under PPO, {gaps['SAC', 0]:.2f} m under SAC",
            gaps["PPO", 0],
            gaps["SAC", 0],
        ),
    }
    return [judge_statement(f"{what} ({reading.name})", part, show=_METRES) for what, part in parts.items()]


def _changes(record: EpisodeRecord) -> float:
    """How far the command of Vehicle 2 goes up and down from its first decision on, m/s2."""
    acting = record.time_s >= float(record.initial.vehicles.latency_s[0, 1])
    return float(np.abs(np.diff(record.command_mps2[acting, 1])).sum())


def _first_command(record: EpisodeRecord) -> float:
    """The command of Vehicle 2 at its first decision, m/s2."""
    acting = record.time_s >= float(record.initial.vehicles.latency_s[0, 1])
    return float(record.command_mps2[acting, 1][0])


def _braking_share(record: EpisodeRecord) -> float:
    """Share of the time from its first decision to its standstill in which Vehicle 2 brakes."""
    acting = record.time_s >= float(record.initial.vehicles.latency_s[0, 1])
    moving = acting & (record.speeds_mps[:, 1] > 0.0)
    return float((record.command_mps2[moving, 1] < 0.0).mean()) if moving.any() else 0.0


def _judge_commands(reading: Reading, records: Records) -> list[Verdict]:
    """The paper's statements about the profiles."""
    apart = {}
    for number in _SCENARIOS:
        first, second, until_s = _together(records, reading, number)
        one, other = (_on_grid(each, each.command_mps2[:, 1], until_s) for each in (first, second))
        apart[number] = float(np.sqrt(np.mean((one - other) ** 2)))
    ppo, sac, _ = _together(records, reading, 2)
    command, share = _first_command(ppo), _braking_share(sac)
    parts = {
        "the profiles are more alike in Scenario 1 than in 2": _below(
            f"root mean square difference {apart[1]:.2f} m/s² against {apart[2]:.2f} m/s²", apart[1], apart[2]
        ),
        "Scenario 2: PPO accelerates before it brakes": _below(f"first command {command:+.2f} m/s²", 0.0, command),
        "Scenario 2: SAC decelerates throughout most of it": _below(
            f"braking in {100.0 * share:.0f} % of the time it moves", 0.5, share
        ),
        "Scenario 2: PPO's profile is the smoother one": _below(
            f"ups and downs {_changes(ppo):.1f} m/s² under PPO, {_changes(sac):.1f} m/s² under SAC",
            _changes(ppo),
            _changes(sac),
        ),
    }
    return [judge_statement(f"{what} ({reading.name})", part, show=_COMMAND) for what, part in parts.items()]


def _outcomes(records: Records) -> Table:
    """What happened in every recorded episode."""
    rows = []
    for (reading, number, name), record in records.items():
        gaps = [f"{float(gap):.2f}" for gap in record.gaps_m[-1]]
        harm = float(record.ledger.world_harm("first")[0])
        rows.append((reading.name, str(number), name, str(len(record.impacts.time_s)), f"{harm:.2f}", *gaps))
    head = ("Reading", "Scenario", "Strategy", "Impacts", "First-impact harm", "Last gap 1 (m)", "Last gap 2 (m)")
    return Table("How the episodes end", head, tuple(rows), "One world each: no intervals. Harm in m²/s².")


def _profiles(records: Records) -> Table:
    """Figures of the commands."""
    rows: list[Sequence[str]] = []
    for (reading, number, name), record in records.items():
        numbers = (f"{_first_command(record):+.2f}", f"{record.command_mps2[:, 1].min():+.2f}")
        more = (f"{100.0 * _braking_share(record):.0f} %", f"{_changes(record):.1f}")
        rows.append((reading.name, str(number), name, *numbers, *more))
    head = ("Reading", "Scenario", "Strategy", "First command", "Hardest", "Braking while it moves", "Ups and downs")
    note = "Commands of Vehicle 2 in m/s². One world each: no intervals."
    return Table("Commands of Vehicle 2", head, tuple(tuple(row) for row in rows), note)


def _csv(records: Mapping[tuple[Reading, int, str], EpisodeRecord]) -> str:
    rows = []
    for (reading, number, name), record in records.items():
        columns = (record.positions_m, record.speeds_mps, record.gaps_m, record.command_mps2)
        for k, time_s in enumerate(record.time_s):
            rows.append([reading.name, number, name, round(float(time_s), 9), *(v for c in columns for v in c[k])])
    every = range(1, 4)
    head = ["reading", "scenario", "strategy", "time_s", *(f"position_{i}_m" for i in every)]
    head += [*(f"speed_{i}_mps" for i in every), "gap_1_m", "gap_2_m", *(f"command_{i}_mps2" for i in every)]
    return csv_text(head, rows)
