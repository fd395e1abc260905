"""The paper's figure of harm at three communication delays (``Fig:harm-delay``)."""

from __future__ import annotations

from collections.abc import Mapping

from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.figures.reproduction import bars_figure
from ethbrake_marl.physics import Floats
from ethbrake_marl.studies.reproduction.item import (
    LIST_SEED,
    Drawn,
    Made,
    Parameter,
    Settings,
    Table,
    csv_text,
    list_parameter,
    scenario_parameters,
)
from ethbrake_marl.studies.reproduction.measure import (
    ABOUT_BASELINE,
    ABOUT_POLICIES,
    AS_STATED,
    COUPLED,
    FOUR,
    FULL_BRAKE,
    NAMES,
    PAIRWISE,
    PPO,
    PREDICTED,
    READINGS,
    SAC,
    Reading,
    drive_list,
    harms,
    less_in,
    lineup,
    read_scenario,
)
from ethbrake_marl.studies.reproduction.verdicts import HARM, Verdict, judge_statement

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
        _parameters(episodes),
        tuple(_table(f"{worlds}, {reading.name}", harm) for (worlds, reading), harm in found.items()),
        tuple(_figure(k, worlds, found) for k, worlds in enumerate((_ONE, _LIST))),
        {"harm-delays": _csv(found)},
    )


def _name(delay: str, reading: Reading) -> str:
    """A delay with its latencies."""
    _, middle, rear = read_scenario(f"paper-delay-{delay}", reading).model_dump()["latency_s"]
    return f"{delay} ({middle:g}, {rear:g} s)"


def _parameters(episodes: int) -> tuple[Parameter, ...]:
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


def _csv(found: Found) -> str:
    rows = []
    for (worlds, reading), delays in found.items():
        for delay, harm in delays.items():
            for name, values in harm.items():
                estimate = mean(values)
                low, high = estimate.interval or ("", "")
                rows.append([worlds, reading.name, delay, name, len(values), estimate.value, low, high])
    return csv_text(("worlds", "reading", "delay", "strategy", "count", "first_impact_harm", "low", "high"), rows)
