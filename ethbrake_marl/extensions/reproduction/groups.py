"""Reproduce figures of the paper that show harm against distance or delay.

In the paper's source, the figures of harm against distance have the labels ``Fig:Harm-ivds`` and ``Fig:hybrid illu``;
the figure of harm against delay has the label ``Fig:harm-delay``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from ethbrake_marl.extensions.reproduction.figures import estimates_figure
from ethbrake_marl.extensions.reproduction.folder import (
    FIRST_IMPACTS,
    NOT_THEIRS,
    POLICIES,
    Drawn,
    Made,
    Parameter,
    Reproduction,
    csv_text,
    list_parameter,
    scenario_parameters,
    stated,
)
from ethbrake_marl.extensions.reproduction.strategies import (
    ABOUT_BASELINE,
    BASELINES,
    FOUR,
    FULL_BRAKE,
    NAMES,
    PPO,
    READINGS,
    SAC,
    drive_list,
    harms,
    lineup,
)
from ethbrake_marl.extensions.reproduction.verdicts import LIST_SEED, PREDICTED, PROVEN, Less, Verdict, judge_statement
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.statistics import mean
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario

Groups = Mapping[str, Mapping[str, Floats]]  # group of worlds -> strategy -> harm of each world

_HARM_TITLE = "First-impact harm (m²/s²)"

DISTANCE, _DISTANCE_WORLDS = "paper-distance", 5_000

_ENDS_M = (10.0, 12.0, 14.0, 16.0, 18.0, 20.0)  # limits of the groups, for the sum of both gaps


def by_distance(evaluation: Evaluation) -> tuple[list[float], Groups]:
    """Divide the worlds of an evaluation into groups by the sum of the two gaps.

    Return the mean sum of the gaps (m) in each group, and a dictionary ``{"10-12 m": {"PPO": harm, ...}, ...}``, where
    ``harm`` is the harm in each world of the group. Groups without worlds are omitted.
    """
    total, each_harm = evaluation.worlds.gaps_m.sum(axis=1), harms(evaluation)
    inner, at, groups = np.digitize(total, _ENDS_M[1:-1]), [], {}
    for k, (low, high) in enumerate(pairwise(_ENDS_M)):
        if (rows := inner == k).any():
            at.append(float(total[rows].mean()))
            groups[f"{low:g}-{high:g} m"] = {name: harm[rows] for name, harm in each_harm.items()}
    return at, groups


def less_in_each(groups: Groups, smaller: str, *larger: str) -> list[Less]:
    """Compare the harm of the strategy ``smaller`` with each strategy in ``larger``, in every group of worlds.

    The comparisons are paired, because the strategies drive the same worlds.
    """
    return [
        Less.of_harms(group if len(larger) == 1 else f"{group}, {other}", harm, smaller, other)
        for group, harm in groups.items()
        for other in larger
    ]


def _harm_table(title: str, groups: Groups, note: str) -> Sheet:
    """Return a table of mean harms with 95 % intervals: a row for each strategy, a column for each group of worlds.

    ``note`` is added to the text below the table.
    """
    strategies = next(iter(groups.values()))
    rows = [(name, *(mean(harm[name]) for harm in groups.values())) for name in strategies]
    return Sheet(title, ("Strategy", *groups), rows, f"First-impact harm, m²/s²{note}. {ABOUT_BASELINE}")


def over_distance(
    stem: str,
    curves: Mapping[str, tuple[Sequence[float], Groups]],
    verdicts: Sequence[Verdict],
    lines: Sequence[str],
    parameters: Sequence[Parameter],
    episodes: int,
) -> Made:
    """Return the result for a figure of the paper that shows harm against the sum of the two gaps.

    ``stem`` is the file name of figure and data, without ending. ``curves`` has results of ``by_distance`` by name of
    the assumption on when Vehicle 2 may act (``strategies.Reading``). ``lines`` are the strategies in the figure.
    ``parameters`` are listed on the page in addition to the parameters of the scenario.
    """
    panels = {
        reading: {
            name: {at: mean(harm[name]) for at, harm in zip(at_m, groups.values(), strict=True)} for name in lines
        }
        for reading, (at_m, groups) in curves.items()
    }
    figure = estimates_figure(
        panels,
        x_label="Total distance d1 + d2 at the alert (m)",
        y_label=_HARM_TITLE,
        caption=f"Means over {episodes:,} worlds in groups of 2 m; bands: 95 % intervals.",
    )
    text = "Mean harm of each strategy against the sum of both gaps; left as the paper states it, right with Vehicle 2"
    rows = [
        (reading, name, group, at, len(harm[name]), mean(harm[name]))
        for reading, (at_m, groups) in curves.items()
        for name in next(iter(groups.values()))
        for at, (group, harm) in zip(at_m, groups.items(), strict=True)
    ]
    head = ("reading", "strategy", "total_distance", "mean_distance_m", "worlds", "first_impact_harm", "low", "high")
    title, note = "Harm by total distance", ", with 95 % intervals"
    return Made(
        verdicts,
        [
            *scenario_parameters(load_scenario(DISTANCE), gaps_m="5 to 10 m, text to Table:hybrid"),
            *parameters,
            list_parameter(episodes),
        ],
        [_harm_table(f"{title}, {reading}", groups, note) for reading, (_, groups) in curves.items()],
        {Drawn(stem, "Harm over total distance", f"{text} acting at 0.2 s."): figure},
        {stem: csv_text(head, rows)},
    )


def reproduce_distance(settings: Reproduction) -> Made:
    """Reproduce the paper's figure of harm against the sum of the two gaps."""
    episodes, braking = min(_DISTANCE_WORLDS, settings.episodes), NAMES[FULL_BRAKE]
    curves, verdicts = {}, []
    for reading in READINGS:
        scenario = reading.scenario(DISTANCE)
        curves[reading.name] = by_distance(drive_list(scenario, lineup(scenario, *FOUR), episodes, settings))
        _, groups = curves[reading.name]
        claims = {
            "non-ethical: the larger the distance, the larger the harm": [
                Less.of_lists(f"{one} to {other}", groups[one][braking], groups[other][braking])
                for one, other in pairwise(groups)
            ],
            **{f"{name} harms less than non-ethical": less_in_each(groups, name, braking) for name in BASELINES},
            **{
                f"{NAMES[policy]} harms less than {name} over the whole range": less_in_each(
                    groups, NAMES[policy], name
                )
                for policy in (SAC, PPO)
                for name in BASELINES
            },
        }
        verdicts += [judge_statement(f"{claim} ({reading.name})", parts) for claim, parts in claims.items()]
    parameters = [
        Parameter("distances", "each gap drawn on its own, then grouped by the sum"),
        FIRST_IMPACTS,
        NOT_THEIRS,
    ]
    lines = [*(NAMES[spec] for spec in FOUR), PREDICTED, PROVEN]
    return over_distance("harm-distance", curves, verdicts, lines, parameters, episodes)


_DELAYS, _DELAY_WORLDS = ("low", "middle", "high"), 2_000

_STATE = {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}  # world of the paper's figure

_ONE, _LIST = "d = 7, 7 m; v = 20, 18, 20 m/s", "d = 5-10 m; v = 18-22 m/s"


def reproduce_delays(settings: Reproduction) -> Made:
    """Reproduce the paper's figure of harm at three delays.

    Our first figure shows the harm in the single world of the paper's figure, our second the mean harm in random
    worlds.
    """
    episodes = min(_DELAY_WORLDS, settings.episodes)
    curves: dict[tuple[str, str], Groups] = {}  # (description of the worlds, assumption) -> delay -> harm
    for reading in READINGS:
        for worlds, state, count in ((_ONE, _STATE, 1), (_LIST, {}, episodes)):
            scenarios = [reading.scenario(f"paper-delay-{delay}", **state) for delay in _DELAYS]
            curves[worlds, reading.name] = {
                _delay_name(each): harms(drive_list(each, lineup(each, *FOUR), count, settings)) for each in scenarios
            }
    figures = {}
    for worlds, stem in ((_ONE, "world"), (_LIST, "list")):
        panels = {
            reading: {
                name: {at: mean(harm[name]) for at, harm in zip(_DELAYS, delays.values(), strict=True)}
                for name in next(iter(delays.values()))
            }
            for (own, reading), delays in curves.items()
            if own == worlds
        }
        caption = f"{worlds}. Low, middle, high: τ3 = 0.3, 0.6, 1.2 s; left τ2 = 0.1, 0.3, 0.8 s. Bars: 95 % intervals."
        about = f"Harm of each strategy at three delays, {worlds}."
        figures[Drawn(f"harm-delays-{stem}", "Harm at three delays", about)] = estimates_figure(
            panels, y_label=_HARM_TITLE, caption=caption
        )
    low, *_ = scenarios = [load_scenario(f"paper-delay-{delay}") for delay in _DELAYS]
    parameters = [
        *(each for each in scenario_parameters(low.replace(**_STATE)) if not each.name.startswith("latencies")),
        Parameter("delays (Vehicle 2, 3)", "; ".join(map(_delay_name, scenarios))),
        Parameter("policies", f"{POLICIES}; not the paper's, and not trained at these delays"),
        stated("worlds of the figure", "one at each delay", "text to Fig:harm-delay"),
        Parameter("list beside it", f"{_LIST}; {list_parameter(episodes).value} (seed {LIST_SEED})"),
    ]
    rows = [
        (*where, delay, name, len(values), mean(values))
        for where, delays in curves.items()
        for delay, harm in delays.items()
        for name, values in harm.items()
    ]
    head = ("worlds", "reading", "delay", "strategy", "count", "first_impact_harm", "low", "high")
    verdicts = [  # "both SAC and PPO consistently achieve the lowest harm values across all tested delay setting"
        judge_statement(
            f"{NAMES[policy]} harms less than non-ethical and E-V2X-BM at every delay ({'; '.join(where)})",
            less_in_each(delays, NAMES[policy], NAMES[FULL_BRAKE], *BASELINES),
        )
        for where, delays in curves.items()
        for policy in (SAC, PPO)
    ]
    tables = [_harm_table(", ".join(where), delays, "; one world has no interval") for where, delays in curves.items()]
    return Made(verdicts, parameters, tables, figures, {"harm-delays": csv_text(head, rows)})


def _delay_name(scenario: Scenario) -> str:
    """Return the name of a scenario's delay, with the latencies of Vehicles 2 and 3: "low (0.1, 0.3 s)"."""
    _, middle, rear = scenario.model_dump()["latency_s"]
    return f"{scenario.name.removeprefix('paper-delay-')} ({middle:g}, {rear:g} s)"
