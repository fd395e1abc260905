"""The paper's Scenarios 1 and 2: trajectories (``Fig:pic5sim``) and acceleration profiles (``Fig:pic5act``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ethbrake_marl.evaluation import EpisodeRecord, record_episode
from ethbrake_marl.evaluation.inputs import make_agents
from ethbrake_marl.evaluation.statistics import Estimate, mean, unpaired_difference
from ethbrake_marl.figures.evaluation import trajectories
from ethbrake_marl.figures.studies import bars_figure, lines_figure, profiles_figure, road_figure
from ethbrake_marl.pages.player import Played, player_content
from ethbrake_marl.pages.report import drive_played
from ethbrake_marl.physics import Floats
from ethbrake_marl.studies.reproduction.item import (
    ABOUT_BASELINE,
    ABOUT_POLICIES,
    AS_STATED,
    COUPLED,
    FOUR,
    FULL_BRAKE,
    HARM,
    LIST_SEED,
    NAMES,
    PAIRWISE,
    PPO,
    PREDICTED,
    PROVEN,
    READINGS,
    SAC,
    Drawn,
    Grouped,
    Less,
    Made,
    Parameter,
    Reading,
    Settings,
    Show,
    Table,
    Verdict,
    csv_text,
    drive_list,
    group_by_distance,
    harms,
    judge_statement,
    less_in,
    lineup,
    list_parameter,
    read_scenario,
    scenario_parameters,
)

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


# The paper's figure of harm at three communication delays (``Fig:harm-delay``).

_DELAYS = ("low", "middle", "high")
_STATE = {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}  # of the figure: one world at each delay
_WORLDS = 2_000
_ONE, _LIST = "d = 7, 7 m; v = 20, 18, 20 m/s", "d = 5-10 m; v = 18-22 m/s"
_NOTE = f"First-impact harm, m²/s²; one world has no interval. {ABOUT_BASELINE}"

Found = dict[tuple[str, Reading], dict[str, dict[str, Floats]]]  # worlds and reading -> delay -> strategy -> harm


def reproduce_delays(settings: Settings) -> Made:
    """Harm of the four strategies at low, middle and high delay, in the figure's world and in a list of worlds."""
    episodes = settings.worlds(_WORLDS)
    found: Found = {}
    for reading in READINGS:
        for worlds, state, count in ((_ONE, _STATE, 1), (_LIST, {}, episodes)):
            found[worlds, reading] = {}
            for delay in _DELAYS:
                scenario = read_scenario(f"paper-delay-{delay}", reading).replace(**state)
                evaluation = drive_list(scenario, lineup(FOUR, scenario), count, settings)
                found[worlds, reading][_name(delay, reading)] = harms(evaluation)
    return Made(
        tuple(verdict for (worlds, reading), harm in found.items() for verdict in _judge(worlds, reading, harm)),
        _delay_parameters(episodes),
        tuple(_table(f"{worlds}, {reading.name}", harm) for (worlds, reading), harm in found.items()),
        tuple(_figure(k, worlds, found) for k, worlds in enumerate((_ONE, _LIST))),
        {"harm-delays": _delay_csv(found)},
    )


def _name(delay: str, reading: Reading) -> str:
    """A delay with its latencies."""
    _, middle, rear = read_scenario(f"paper-delay-{delay}", reading).model_dump()["latency_s"]
    return f"{delay} ({middle:g}, {rear:g} s)"


def _delay_parameters(episodes: int) -> tuple[Parameter, ...]:
    scenario = read_scenario("paper-delay-low", AS_STATED).replace(**_STATE)
    delays = "; ".join(_name(delay, AS_STATED) for delay in _DELAYS)
    return (
        *(each for each in scenario_parameters(scenario) if not each.name.startswith("latencies")),
        Parameter("delays (Vehicle 2, 3)", delays, ""),
        Parameter("policies", f"{ABOUT_POLICIES}; not the paper's, and not trained at these delays", ""),
        Parameter("worlds of the figure", "one at each delay", "text to Fig:harm-delay"),
        Parameter("list beside it", f"{_LIST}; {list_parameter(episodes).value} (seed {LIST_SEED})", ""),
    )


def _judge(worlds: str, reading: Reading, found: Mapping[str, Mapping[str, Floats]]) -> list[Verdict]:
    """Whether "both SAC and PPO consistently achieve the lowest harm values across all tested delay setting"."""
    others = (NAMES[FULL_BRAKE], NAMES[PAIRWISE], NAMES[COUPLED], PREDICTED)
    return [
        judge_statement(
            f"{NAMES[policy]} harms less than non-ethical and E-V2X-BM at every delay ({worlds}; {reading.name})",
            [
                less_in(f"{delay}, {other}", harm, NAMES[policy], other)
                for delay, harm in found.items()
                for other in others
            ],
        )
        for policy in (SAC, PPO)
    ]


def _table(title: str, found: Mapping[str, Mapping[str, Floats]]) -> Table:
    strategies = next(iter(found.values()))
    rows = tuple((name, *(HARM.estimate(mean(harm[name])) for harm in found.values())) for name in strategies)
    return Table(title, ("Strategy", *found), rows, _NOTE)


def _figure(number: int, worlds: str, found: Found) -> Drawn:
    panels = {
        reading.name: {
            name: [mean(found[worlds, reading][delay][name]) for delay in found[worlds, reading]]
            for name in next(iter(found[worlds, reading].values()))
        }
        for reading in READINGS
    }
    caption = f"{worlds}. Low, middle, high: τ3 = 0.3, 0.6, 1.2 s; left τ2 = 0.1, 0.3, 0.8 s. Bars: 95 % intervals."
    figure = bars_figure(panels, groups=_DELAYS, y_label="First-impact harm (m²/s²)", caption=caption)
    text = f"Harm of each strategy at three delays, {worlds}."
    return Drawn(f"harm-delays-{('world', 'list')[number]}", "Harm at three delays", text, figure)


def _delay_csv(found: Found) -> str:
    rows = []
    for (worlds, reading), delays in found.items():
        for delay, harm in delays.items():
            for name, values in harm.items():
                estimate = mean(values)
                low, high = estimate.interval or ("", "")
                rows.append([worlds, reading.name, delay, name, len(values), estimate.value, low, high])
    return csv_text(("worlds", "reading", "delay", "strategy", "count", "first_impact_harm", "low", "high"), rows)


# The paper's figure of harm over total distance (``Fig:Harm-ivds``).

_SCENARIO, _DISTANCE_WORLDS = "paper-distance", 5_000
X_LABEL, Y_LABEL = "Total distance d1 + d2 at the alert (m)", "First-impact harm (m²/s²)"


def reproduce_distance(settings: Settings) -> Made:
    """Harm of the four strategies over the total distance."""
    episodes = settings.worlds(_DISTANCE_WORLDS)
    found = {}
    for reading in READINGS:
        scenario = read_scenario(_SCENARIO, reading)
        found[reading] = group_by_distance(drive_list(scenario, lineup(FOUR, scenario), episodes, settings))
    verdicts = [each for reading, grouped in found.items() for each in _judge_distance(reading, grouped)]
    parameters = (
        *scenario_parameters(read_scenario(_SCENARIO, READINGS[0]), gaps_m="5 to 10 m, text to Table:hybrid"),
        Parameter("distances", "each gap drawn on its own, then grouped by the sum", ""),
        Parameter("harm", "each pair's first impact", "sec:result, Experimental Set-Up"),
        Parameter("policies", f"{ABOUT_POLICIES}; not the paper's", ""),
        list_parameter(episodes),
    )
    return Made(
        tuple(verdicts),
        parameters,
        tuple(distance_table(reading.name, grouped) for reading, grouped in found.items()),
        (distance_figure("harm-distance", found, [*(NAMES[spec] for spec in FOUR), PREDICTED, PROVEN], episodes),),
        {"harm-distance": distance_csv(found)},
    )


def distance_figure(stem: str, found: dict[Reading, Grouped], strategies: list[str], episodes: int) -> Drawn:
    """One panel per reading, one line per strategy."""
    panels = {reading.name: {name: grouped.line(name) for name in strategies} for reading, grouped in found.items()}
    caption = f"Means over {episodes:,} worlds in groups of 2 m; bands: 95 % intervals."
    figure = lines_figure(panels, x_label=X_LABEL, y_label=Y_LABEL, caption=caption)
    text = "Mean harm of each strategy against the sum of both gaps; left as the paper states it, right with Vehicle 2"
    return Drawn(stem, "Harm over total distance", f"{text} acting at 0.2 s.", figure)


def distance_table(title: str, grouped: Grouped) -> Table:
    """Harm with its interval: one row per strategy, one column per group."""
    rows = tuple(
        (name, *(HARM.estimate(grouped.estimate(name, k)) for k in range(len(grouped.groups)))) for name in grouped.harm
    )
    note = f"First-impact harm, m²/s², with 95 % intervals. {ABOUT_BASELINE}"
    return Table(f"Harm by total distance, {title}", ("Strategy", *grouped.groups), rows, note)


def distance_csv(found: dict[Reading, Grouped]) -> str:
    """One row per reading, strategy and group."""
    rows = []
    for reading, grouped in found.items():
        for name in grouped.harm:
            for k, group in enumerate(grouped.groups):
                estimate = grouped.estimate(name, k)
                low, high = estimate.interval or ("", "")
                count = int(grouped.rows[k].sum())
                rows.append([reading.name, name, group, grouped.at_m[k], count, estimate.value, low, high])
    head = ("reading", "strategy", "total_distance", "mean_distance_m", "worlds", "first_impact_harm", "low", "high")
    return csv_text(head, rows)


def _judge_distance(reading: Reading, grouped: Grouped) -> list[Verdict]:
    """The paper's statements about the figure."""

    def judge(statement: str, parts: list[Less]) -> Verdict:
        return judge_statement(f"{statement} ({reading.name})", parts)

    braking = NAMES[FULL_BRAKE]
    baselines = (NAMES[PAIRWISE], NAMES[COUPLED], PREDICTED)
    rising = [
        Less(
            f"{grouped.groups[k]} to {grouped.groups[k + 1]}",
            unpaired_difference(
                grouped.estimate(braking, k),
                int(grouped.rows[k].sum()),
                grouped.estimate(braking, k + 1),
                int(grouped.rows[k + 1].sum()),
            ),
        )
        for k in range(len(grouped.groups) - 1)
    ]
    return [
        judge("non-ethical: the larger the distance, the larger the harm", rising),
        *(judge(f"{name} harms less than non-ethical", grouped.less(name, braking)) for name in baselines),
        *(
            judge(f"{NAMES[policy]} harms less than {name} over the whole range", grouped.less(NAMES[policy], name))
            for policy in (SAC, PPO)
            for name in baselines
        ),
    ]
