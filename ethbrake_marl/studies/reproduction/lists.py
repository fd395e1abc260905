"""The items that drive lists of worlds: over the total distance, at three delays, the two tables, and what is open."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain, pairwise
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import Progress
from ethbrake_marl.evaluation import Evaluation, evaluate
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY
from ethbrake_marl.evaluation.outcome import HYBRID_TEST, PAPER_ROWS, RANDOM_TEST, PaperRow
from ethbrake_marl.evaluation.statistics import Estimate, mean, paired_difference, rate, relative_decrease
from ethbrake_marl.figures.studies import Line, bars_figure, changes_figure, lines_figure
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.learning.recipe import load_recipe
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.policies.shipped import load_shipped
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.studies.reproduction.item import (
    COUPLED,
    FIRST_IMPACTS,
    FULL_BRAKE,
    HARM,
    LIST_SEED,
    NAMES,
    PAIRWISE,
    PERCENT,
    POLICIES,
    PPO,
    PREDICTED,
    PROVEN,
    READINGS,
    SAC,
    Bound,
    Drawn,
    Less,
    Made,
    Parameter,
    Reading,
    Settings,
    Verdict,
    compare_number,
    csv_text,
    drive_list,
    harms,
    judge_statement,
    lineup,
    list_parameter,
    scenario_parameters,
    stated,
)
from ethbrake_marl.studies.reproduction.trainings import OPEN, PPO_PAPER, hybrid, kept_harms, unconverged_policy

FOUR = (FULL_BRAKE, PAIRWISE, COUPLED, SAC, PPO)  # the paper's four, E-V2X-BM twice
_BASELINES = (NAMES[PAIRWISE], NAMES[COUPLED], PREDICTED)
_ABOUT_BASELINE = (
    "E-V2X-BM, predicted: what the closed form expects, pair by pair. Realised: what that deceleration does once speeds"
    " are exchanged. Coupled: the constant deceleration of least harm in the same physics."
)
_H_STAR = stated("H*", "realised (ours) and predicted pair by pair (the paper's)", "sec:baseline_drl, Hybrid DRL")
_NOT_THEIRS = Parameter("policies", f"{POLICIES}; not the paper's")

# Harm in groups of worlds: by distance (``Fig:Harm-ivds``, ``Fig:hybrid illu``), or by delay (``Fig:harm-delay``).

Groups = Mapping[str, Mapping[str, Floats]]  # group of worlds -> strategy -> harm of each world
_HARM_TITLE = "First-impact harm (m²/s²)"
_DISTANCE, _DISTANCE_WORLDS = "paper-distance", 5_000
_ENDS_M = (10.0, 12.0, 14.0, 16.0, 18.0, 20.0)  # of the groups of d_1 + d_2


class Grouped(NamedTuple):
    """Harm of each strategy over groups of the total distance; groups without a world are left out."""

    at_m: Sequence[float]  # mean distance of each group
    groups: Groups

    @classmethod
    def of(cls, evaluation: Evaluation) -> Grouped:
        """The worlds by the sum of their gaps."""
        total, found = evaluation.worlds.gaps_m.sum(axis=1), harms(evaluation)
        inner, at, groups = np.digitize(total, _ENDS_M[1:-1]), [], {}
        for k, (low, high) in enumerate(pairwise(_ENDS_M)):
            if (rows := inner == k).any():
                at.append(float(total[rows].mean()))
                groups[f"{low:g}-{high:g} m"] = {name: harm[rows] for name, harm in found.items()}
        return cls(at, groups)


def less_in_each(groups: Groups, smaller: str, larger: str) -> list[Less]:
    """The comparison of two strategies in every group, paired by world."""
    return [Less.of_harms(group, harm, smaller, larger) for group, harm in groups.items()]


def _harm_table(title: str, groups: Groups, note: str) -> Sheet:
    """Harm with its interval: one row per strategy, one column per group."""
    strategies = next(iter(groups.values()))
    rows = [(name, *(mean(harm[name]) for harm in groups.values())) for name in strategies]
    return Sheet(title, ("Strategy", *groups), rows, f"First-impact harm, m²/s²{note}. {_ABOUT_BASELINE}")


def _over_distance(
    stem: str,
    drive: Callable[[Reading], Evaluation],
    judge: Callable[[str, Grouped, Evaluation], list[Verdict]],
    lines: Sequence[str],
    told: Sequence[Parameter],
    episodes: int,
) -> Made:
    """Harm of strategies over the total distance in both readings."""
    driven = {reading.name: drive(reading) for reading in READINGS}
    found = {reading: Grouped.of(evaluation) for reading, evaluation in driven.items()}
    panels = {
        reading: {name: Line.of(grouped.at_m, [mean(harm[name]) for harm in grouped.groups.values()]) for name in lines}
        for reading, grouped in found.items()
    }
    figure = lines_figure(
        panels,
        x_label="Total distance d1 + d2 at the alert (m)",
        y_label=_HARM_TITLE,
        caption=f"Means over {episodes:,} worlds in groups of 2 m; bands: 95 % intervals.",
    )
    text = "Mean harm of each strategy against the sum of both gaps; left as the paper states it, right with Vehicle 2"
    rows = [
        (reading, name, group, at, len(harm[name]), mean(harm[name]))
        for reading, grouped in found.items()
        for name in next(iter(grouped.groups.values()))
        for at, (group, harm) in zip(grouped.at_m, grouped.groups.items(), strict=True)
    ]
    head = ("reading", "strategy", "total_distance", "mean_distance_m", "worlds", "first_impact_harm", "low", "high")
    title, note = "Harm by total distance", ", with 95 % intervals"
    return Made(
        [verdict for reading, grouped in found.items() for verdict in judge(reading, grouped, driven[reading])],
        [
            *scenario_parameters(load_scenario(_DISTANCE), gaps_m="5 to 10 m, text to Table:hybrid"),
            *told,
            list_parameter(episodes),
        ],
        [_harm_table(f"{title}, {reading}", grouped.groups, note) for reading, grouped in found.items()],
        {Drawn(stem, "Harm over total distance", f"{text} acting at 0.2 s."): figure},
        {stem: csv_text(head, rows)},
    )


def reproduce_distance(settings: Settings) -> Made:
    """Harm of the four strategies over the total distance."""
    episodes = min(_DISTANCE_WORLDS, settings.episodes)

    def drive(reading: Reading) -> Evaluation:
        scenario = reading.scenario(_DISTANCE)
        return drive_list(scenario, lineup(FOUR, scenario), episodes, settings)

    told = [Parameter("distances", "each gap drawn on its own, then grouped by the sum"), FIRST_IMPACTS, _NOT_THEIRS]
    lines = [*(NAMES[spec] for spec in FOUR), PREDICTED, PROVEN]
    return _over_distance("harm-distance", drive, _judge_distance, lines, told, episodes)


def _judge_distance(reading: str, grouped: Grouped, evaluation: Evaluation) -> list[Verdict]:
    """The paper's statements about the figure."""
    braking, groups = NAMES[FULL_BRAKE], grouped.groups
    claims = {
        "non-ethical: the larger the distance, the larger the harm": [
            Less.of_lists(f"{one} to {other}", groups[one][braking], groups[other][braking])
            for one, other in pairwise(groups)
        ],
        **{f"{name} harms less than non-ethical": less_in_each(groups, name, braking) for name in _BASELINES},
        **{
            f"{NAMES[policy]} harms less than {name} over the whole range": less_in_each(groups, NAMES[policy], name)
            for policy in (SAC, PPO)
            for name in _BASELINES
        },
    }
    return [judge_statement(f"{claim} ({reading})", parts) for claim, parts in claims.items()]


_DELAYS, _DELAY_WORLDS = ("low", "middle", "high"), 2_000
_STATE = {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}  # of the figure: one world at each delay
_ONE, _LIST = "d = 7, 7 m; v = 20, 18, 20 m/s", "d = 5-10 m; v = 18-22 m/s"


def reproduce_delays(settings: Settings) -> Made:
    """Harm of the four strategies at low, middle and high delay, in the figure's world and in a list of worlds."""
    episodes = min(_DELAY_WORLDS, settings.episodes)
    found: dict[tuple[str, str], Groups] = {}  # worlds and reading
    for reading in READINGS:
        for worlds, state, count in ((_ONE, _STATE, 1), (_LIST, {}, episodes)):
            scenarios = [reading.scenario(f"paper-delay-{delay}", **state) for delay in _DELAYS]
            found[worlds, reading.name] = {
                _delay_name(each): harms(drive_list(each, lineup(FOUR, each), count, settings)) for each in scenarios
            }
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
        for where, delays in found.items()
        for delay, harm in delays.items()
        for name, values in harm.items()
    ]
    head = ("worlds", "reading", "delay", "strategy", "count", "first_impact_harm", "low", "high")
    return Made(
        [verdict for where, delays in found.items() for verdict in _judge_delays("; ".join(where), delays)],
        parameters,
        [_harm_table(", ".join(where), delays, "; one world has no interval") for where, delays in found.items()],
        dict(_draw_delays(worlds, stem, found) for worlds, stem in ((_ONE, "world"), (_LIST, "list"))),
        {"harm-delays": csv_text(head, rows)},
    )


def _delay_name(scenario: Scenario) -> str:
    """A delay with its latencies."""
    _, middle, rear = scenario.model_dump()["latency_s"]
    return f"{scenario.name.removeprefix('paper-delay-')} ({middle:g}, {rear:g} s)"


def _judge_delays(where: str, delays: Groups) -> list[Verdict]:
    """Whether "both SAC and PPO consistently achieve the lowest harm values across all tested delay setting"."""
    return [
        judge_statement(
            f"{NAMES[policy]} harms less than non-ethical and E-V2X-BM at every delay ({where})",
            [
                Less.of_harms(f"{delay}, {other}", harm, NAMES[policy], other)
                for delay, harm in delays.items()
                for other in (NAMES[FULL_BRAKE], *_BASELINES)
            ],
        )
        for policy in (SAC, PPO)
    ]


def _draw_delays(worlds: str, stem: str, found: Mapping[tuple[str, str], Groups]) -> tuple[Drawn, Any]:
    panels = {}
    for reading in READINGS:
        delays = found[worlds, reading.name]
        strategies = next(iter(delays.values()))
        panels[reading.name] = {name: [mean(harm[name]) for harm in delays.values()] for name in strategies}
    caption = f"{worlds}. Low, middle, high: τ3 = 0.3, 0.6, 1.2 s; left τ2 = 0.1, 0.3, 0.8 s. Bars: 95 % intervals."
    figure = bars_figure(panels, groups=_DELAYS, y_label=_HARM_TITLE, caption=caption)
    drawn = Drawn(f"harm-delays-{stem}", "Harm at three delays", f"Harm of each strategy at three delays, {worlds}.")
    return drawn, figure


# Our rows beside those of the paper's tables: what agrees, what differs, and what no strategy can reach.

_RATE, _MEAN_HARM, _DECREASE, _TOTAL = "collision rate", "average harm", "harm decrease", "total harm"
_PREDICTED_HARM = "predicted harm"
_PRINTED: Mapping[str, Column] = {_RATE: PERCENT, _MEAN_HARM: HARM, _DECREASE: PERCENT}
NOBODY = "least possible (proven)"


def collision_rate(collided: Bools) -> Estimate:
    """Share of worlds with an impact."""
    return rate(int(collided.sum()), len(collided))


@dataclass(frozen=True)
class Beside:
    """Our results in one reading, to stand beside the paper's rows."""

    title: str
    evaluation: Evaluation
    ours: Mapping[str, Sequence[str]]  # the paper's row -> our strategies, the first is the one compared

    @cached_property
    def numbers(self) -> dict[str, dict[str, Estimate]]:
        """Every quantity of every strategy, and of nobody in particular what is proven to be the least."""
        found, braking = {}, self.evaluation.outcomes.get(NAMES[FULL_BRAKE])
        for name, outcome in self.evaluation.outcomes.items():
            harm, predicted = outcome.first_impact_harm, outcome.predicted_harm
            decrease = None if braking is None else relative_decrease(harm, braking.first_impact_harm)
            own = {
                _RATE: collision_rate(outcome.collided),
                _MEAN_HARM: mean(harm),
                _DECREASE: decrease,
                _TOTAL: mean(outcome.total_harm),
                _PREDICTED_HARM: None if predicted is None else mean(predicted),
            }
            found[name] = {quantity: estimate for quantity, estimate in own.items() if estimate is not None}
        if self.bounds:
            least = {quantity: bound.least for quantity, bound in self.bounds.items()}
            found[NOBODY] = {**least, _TOTAL: least[_MEAN_HARM]}
        return found

    @cached_property
    def bounds(self) -> dict[str, Bound]:
        """What no strategy undercuts in these worlds."""
        harm = harms(self.evaluation).get(PROVEN)
        if harm is None:
            return {}
        return {
            _RATE: Bound("worlds in which no command avoids an impact", collision_rate(harm > 0.0)),
            _MEAN_HARM: Bound("harm that no command undercuts", mean(harm)),
        }

    def candidates(self, row: str, quantity: str) -> Iterator[tuple[str, Estimate]]:
        """Everything of ours that may be meant by a number of a row, the compared one first."""
        for name in self.ours[row]:
            if quantity in self.numbers[name]:
                yield f"{name} ({self.title})", self.numbers[name][quantity]
            if quantity == _MEAN_HARM and name == NAMES[PAIRWISE] and _PREDICTED_HARM in self.numbers[name]:
                yield f"{PREDICTED} ({self.title})", self.numbers[name][_PREDICTED_HARM]
        if quantity == _MEAN_HARM:
            for name in self.ours[row]:
                yield f"{name}, total harm ({self.title})", self.numbers[name][_TOTAL]


def compare_rows(printed: Sequence[PaperRow], besides: Sequence[Beside]) -> list[Verdict]:
    """One verdict per reading, row and quantity."""
    verdicts = []
    for beside in besides:
        for row in printed:
            numbers = {_RATE: row.collision_rate, _MEAN_HARM: row.average_harm, _DECREASE: row.harm_decrease}
            for quantity, number in numbers.items():
                if not number:  # the decrease of the baseline, or none is printed
                    continue
                (_, ours), *own = beside.candidates(row.agent, quantity)
                others = [other.candidates(row.agent, quantity) for other in besides if other is not beside]
                verdicts.append(
                    compare_number(
                        f"{row.agent}, {quantity} ({beside.title})",
                        number,
                        ours,
                        show=_PRINTED[quantity],
                        bound=beside.bounds.get(quantity),
                        others=dict([*own, *chain(*others)]),
                    )
                )
    return verdicts


def selection_verdict(one: PaperRow, other: PaperRow, chosen: PaperRow) -> Verdict:
    """Whether a choice between two strategies, world by world, can avoid as many collisions as is printed.

    It avoids a collision only where one of the two does: at most as many as both together.
    """
    avoided = [row.episodes - row.collisions for row in (one, other, chosen)]
    together = avoided[0] + avoided[1]
    told = (
        f"{chosen.agent} is one of the two in every world, so it avoids at most {avoided[0]:,} + {avoided[1]:,} ="
        f" {together:,} collisions; printed: {avoided[2]:,}"
    )
    what = f"{chosen.agent} avoids no more than {one.agent} and {other.agent} together (arithmetic of the printed rows)"
    return Verdict(what, "agrees" if avoided[2] <= together else "cannot agree", told)


def decrease_verdict(row: PaperRow, baseline: PaperRow) -> Verdict:
    """Whether a printed harm decrease follows from the printed harms, to the printed digits."""
    follows = 1.0 - row.average_harm / baseline.average_harm
    printed = row.harm_decrease or 0.0
    told = (
        f"1 - {row.average_harm:g} / {baseline.average_harm:g} = {100.0 * follows:.2f} %; printed {100 * printed:g} %"
    )
    what = f"{row.agent}, harm decrease follows from the printed harms"
    return Verdict(what, "agrees" if abs(follows - printed) < 0.0001 else "cannot agree", told)


def rows_table(beside: Beside) -> Sheet:
    """Our rows of one reading, with what no strategy undercuts."""
    columns: dict[str, Column | str] = {
        _RATE: PERCENT, _MEAN_HARM: "First-impact harm", _TOTAL: "Total harm", _PREDICTED_HARM: "Predicted harm",
        _DECREASE: replace(PERCENT, heading="Harm decrease"),
    }  # fmt: skip
    if not any(_DECREASE in numbers for numbers in beside.numbers.values()):
        del columns[_DECREASE]
    rows = [(name, *map(numbers.get, columns)) for name, numbers in beside.numbers.items()]
    note = f"{beside.evaluation.worlds.n:,} worlds; 95 % intervals; harm in m²/s². {_ABOUT_BASELINE}"
    return Sheet(beside.title, ("Strategy", *columns.values()), rows, note)


def _beside_printed(
    stem: str,
    printed: Sequence[PaperRow],
    besides: Sequence[Beside],
    arithmetic: Sequence[Verdict],
    parameters: Sequence[Parameter],
    notes: Sequence[str] = (),
) -> Made:
    """A table of the paper, and ours in each reading."""
    head = ["Strategy", "Collisions", "Rate", "Average harm"]
    rows = [[r.agent, f"{r.collisions:,}", f"{100.0 * r.collision_rate:g} %", f"{r.average_harm:g}"] for r in printed]
    if any(row.harm_decrease for row in printed):
        head.append("Decrease")
        rows = [[*own, f"{100.0 * (r.harm_decrease or 0.0):g} %"] for own, r in zip(rows, printed, strict=True)]
    data = [
        (beside.title, name, quantity, beside.evaluation.worlds.n, numbers[quantity])
        for beside in besides
        for name, numbers in beside.numbers.items()
        for quantity in _PRINTED
        if quantity in numbers
    ]
    csv = csv_text(("reading", "strategy", "quantity", "worlds", "value", "low", "high"), data)
    tables = [Sheet("The paper's rows, as printed", head, rows), *map(rows_table, besides)]
    return Made([*arithmetic, *compare_rows(printed, besides)], parameters, tables, data={stem: csv}, notes=notes)


# The paper's hybrid around a policy that has not converged: ``Fig:hybrid illu`` and ``Table:hybrid``.

_RANDOM, _HYBRID_WORLDS, _RANDOM_WORLDS, _KINDS = "paper-random", 5_000, 10_000, ("SAC", "PPO")
_ALONE, _REALISED, _AS_PRINTED = "policy alone", "hybrid, realised H*", "hybrid, predicted H*"
_UNCONVERGED = (
    "The paper does not describe its policy that has not converged. The rows of Standalone DRL and Hybrid are of ours:"
    " whether they agree depends on when a training is stopped."
)


def _drive_hybrid(name: str, settings: Settings, reading: Reading) -> Evaluation:
    """The strategies on the worlds of a scenario; figure and table share those of the figure."""
    scenario, (policy, about) = reading.scenario(name), unconverged_policy(settings)
    agents: dict[str, Agent] = {
        **lineup((PAIRWISE, COUPLED), scenario),
        _ALONE: LearnedAgent(policy, "policy"),
        _REALISED: hybrid(policy, scenario, "coupled"),
        _AS_PRINTED: hybrid(policy, scenario, "pairwise"),
    }
    episodes = min(_HYBRID_WORLDS, settings.episodes)
    key = ("hybrid", name, reading.name, about)
    return settings.once(key, lambda: drive_list(scenario, agents, episodes, settings))


def reproduce_illustration(settings: Settings) -> Made:
    """Harm of E-V2X-BM, of a policy that has not converged, and of the hybrid, over the total distance."""
    lines = [NAMES[PAIRWISE], NAMES[COUPLED], _ALONE, _REALISED, _AS_PRINTED, PREDICTED]
    told = [Parameter("policy", unconverged_policy(settings).about), _H_STAR, FIRST_IMPACTS]
    drive, episodes = partial(_drive_hybrid, _DISTANCE, settings), min(_HYBRID_WORLDS, settings.episodes)
    return _over_distance("hybrid-illustration", drive, _judge_choice, lines, told, episodes)


def _judge_choice(reading: str, grouped: Grouped, evaluation: Evaluation) -> list[Verdict]:
    """Whether it "consistently selects the strategy that results in lower harm": in each world, in each group."""
    harm, verdicts = harms(evaluation), []
    for name, baseline in ((_REALISED, NAMES[COUPLED]), (_AS_PRINTED, NAMES[PAIRWISE])):
        lower = np.minimum(harm[_ALONE], harm[baseline])
        worse = harm[name] > lower + 1e-9
        told = (
            f"in {int(worse.sum()):,} of {len(worse):,} worlds the {name} harms more than the lower of policy and"
            f" {baseline}; mean excess {mean(harm[name] - lower).in_words()}"
        )
        what = f"the {name} takes the lower of the two ({reading})"
        verdicts.append(Verdict(what, "differs" if worse.any() else "agrees", told))
    for other in (_ALONE, NAMES[COUPLED]):
        what = f"the {_REALISED} harms no more than {other} at every distance ({reading})"
        verdicts.append(judge_statement(what, less_in_each(grouped.groups, _REALISED, other), or_equal=True))
    return verdicts


def reproduce_hybrid_table(settings: Settings) -> Made:
    """The 5,000 episodes of the paper's table, with both speeds that it may mean."""
    ours = {
        "E-V2X-BM": (NAMES[PAIRWISE], NAMES[COUPLED]),
        "Standalone DRL": (_ALONE,),
        "Hybrid": (_AS_PRINTED, _REALISED),
    }
    besides = [
        Beside(f"{speeds}, {reading.name}", _drive_hybrid(name, settings, reading), ours)
        for name, speeds in ((_RANDOM, "speeds 18 to 22 m/s"), (_DISTANCE, "speeds 20, 18, 20 m/s"))
        for reading in READINGS
    ]
    printed = {row.agent: row for row in PAPER_ROWS if row.table == HYBRID_TEST}
    episodes = min(_HYBRID_WORLDS, settings.episodes)
    both = "uniform (18, 22) m/s, the random test's, and (20, 18, 20) m/s, the figure's"
    found = scenario_parameters(load_scenario(_RANDOM), gaps_m="text to Table:hybrid", latency_s="identical settings")
    parameters = [
        *(Parameter("speeds", both) if each.name == "speeds" else each for each in found),
        Parameter("policy", unconverged_policy(settings).about),
        _H_STAR,
        FIRST_IMPACTS,
        list_parameter(episodes, "5,000, text to Table:hybrid" if episodes == _HYBRID_WORLDS else ""),
    ]
    arithmetic = [selection_verdict(*(printed[agent] for agent in ours))]
    return _beside_printed("hybrid-table", list(printed.values()), besides, arithmetic, parameters, [_UNCONVERGED])


def reproduce_random_table(settings: Settings) -> Made:
    """Collisions, harm and its decrease of the four strategies in the random test (``Table:Random``)."""
    episodes, besides = min(_RANDOM_WORLDS, settings.episodes), []
    ours: dict[str, tuple[str, ...]] = {
        "Non-E": (NAMES[FULL_BRAKE],),
        "E-V2X-BM": (NAMES[PAIRWISE], NAMES[COUPLED]),
        **{
            f"Hybrid {kind}": (f"Hybrid {kind}, realised H*", f"Hybrid {kind}, predicted H*") for kind in ("SAC", "PPO")
        },
    }
    for reading in READINGS:
        scenario = reading.scenario(_RANDOM)
        agents: dict[str, Agent] = dict(lineup((FULL_BRAKE, PAIRWISE, COUPLED), scenario))
        for kind in _KINDS:
            policy, (realised, predicted) = load_shipped(kind.lower()), ours[f"Hybrid {kind}"]
            agents |= {realised: hybrid(policy, scenario, "coupled"), predicted: hybrid(policy, scenario, "pairwise")}
        besides.append(Beside(reading.name, drive_list(scenario, agents, episodes, settings), ours))
    baseline, *others = printed = [row for row in PAPER_ROWS if row.table == RANDOM_TEST]
    text = "text to Table:Random"
    parameters = [
        *scenario_parameters(load_scenario(_RANDOM), gaps_m=text, speeds_mps=text),
        _NOT_THEIRS,
        _H_STAR,
        FIRST_IMPACTS,
        list_parameter(episodes, f"10,000, {text}" if episodes == _RANDOM_WORLDS else ""),
    ]
    arithmetic = [decrease_verdict(row, baseline) for row in others]
    return _beside_printed("random-table", printed, besides, arithmetic, parameters)


# What the paper leaves open: each quantity, what the paper says of it, our default, alternatives, and how far the
# headline of the random test moves when one of them changes.


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Another reading of a quantity, and how it is put into the random test."""

    value: str
    changes: Mapping[str, Any] = field(default_factory=dict)  # of the scenario
    seed: int | None = None  # of the list
    harm: Literal["first", "total", "sampled", "predicted"] = "first"  # what is counted
    bound: Literal["coupled", "pairwise"] | None = None  # of the hybrid that drives in the place of PPO


@dataclass(frozen=True, slots=True, eq=False)
class Gap:
    """A quantity that the paper leaves open, or that can be read in two ways."""

    name: str
    paper: str  # what it says, with the label in its source
    ours: str
    alternatives: tuple[Alternative, ...] = ()
    trained: str = ""  # the trainings of ``--full`` that measure it begin with this name
    unmeasured: str = ""  # why nothing is measured


def _of(key: str, *values: float, unit: str = "") -> tuple[Alternative, ...]:
    return tuple(Alternative(f"{value:g}{unit}", {key: value}) for value in values)


GAPS = (
    Gap("restitution e", "eq:12: e in [0, 1], typically at most 0.3; not said for its tests", "0.1",
        _of("restitution", 0.0, 0.2, 0.3, 0.5)),
    Gap("time step Δt", "sec:optimization_problem: a sampling period, no number", "0.1 s",
        _of("time_step_s", 0.05, 0.2, unit=" s")),
    Gap("impacts at samples or exact", "dynamics2: at samples", "at their exact time; each impact once",
        (Alternative("the paper's map at 0.1 s, harm at every sample of an overlap (eq:Jharmn)", harm="sampled"),)),
    Gap("horizon N", "Jfunc: N steps, no number", "8 s", _of("horizon_s", 5.0, 16.0, unit=" s")),
    Gap("largest speed v_max", "eq:52: a limit, no number", "40 m/s", _of("speed_limit_mps", 25.0, unit=" m/s")),
    Gap("when Vehicle 2 may act", "text to Fig:Harm-ivds: τ2 = 0.5 s", "0.5 s",
        (Alternative("0.2 s", {"latency_s": [0, 0.2, 0.8]}), Alternative("0.3 s", {"latency_s": [0, 0.3, 0.8]}))),
    Gap("what the latency of Vehicle 3 is counted from", "eq:olle2: from t = 0", "from t = 0",
        (Alternative("from τ2 (τ3 = 1.3 s)", {"latency_s": [0, 0.5, 1.3]}),)),
    Gap("which impacts count", "sec:result: each pairwise collision once; eq:Jharmn: at every sample",
        "each pair's first impact", (Alternative("every impact", harm="total"),)),
    Gap("H* of E-V2X-BM, predicted or realised", "Eq:BaselineHarm: the expected harm", "realised; both are shown",
        (Alternative("predicted, pair by pair", harm="predicted"),)),
    Gap("H* inside the hybrid", "alg:hybrid: H* of Eq:BaselineHarm", "realised (coupled)",
        (Alternative("hybrid with realised H*", bound="coupled"),
         Alternative("hybrid with predicted H*", bound="pairwise"))),
    Gap("initial speeds of Table:hybrid", "identical simulation settings; only gaps are named", "18 to 22 m/s",
        (Alternative("20, 18, 20 m/s", {"speeds_mps": [20, 18, 20]}),)),
    Gap("seed of the test", "text to Table:hybrid: a fixed random seed", "7",
        (Alternative("8", seed=8), Alternative("9", seed=9))),
    Gap("impacts before Vehicle 2 may act", "sec:system_model: assumed not to happen", "such worlds are drawn again",
        (Alternative("kept", {"early_impacts": "keep"}),)),
    Gap("what Vehicle 1 brakes for", "sec:problem: an unforeseen obstacle, not modelled", "nothing ahead",
        (Alternative("an obstacle 1.7 m beyond its stopping point", {"obstacle_margin_m": 1.7}),)),
    Gap("may Vehicle 2 drive", "text to Fig:Harm-ivds: yes, a_u,2 = 7 m/s²; E-V2X-BM only brakes", "yes",
        (Alternative("no, brake and coast only", {"driving_capacity_mps2": [6, 0, 6]}),)),
    Gap("Vehicles 1 and 3 after an impact", "eq:olle1, eq:olle2: brake for a time fixed by the initial speeds",
        "brake until they stand", unmeasured="the engine has no vehicle that rolls on after its braking time"),
    Gap("weights of the reward", "w_h, w_p, w_j, R_safe, k_energy, k_d, d_safe, d_target: none stated",
        "1, 0.1, 1e-5, 10 in ppo-paper", trained="ppo-paper-"),
    Gap("state of the policy", "MDP formulation: positions, speeds, actions of the others",
        "also capacities, masses, latencies, e and derived features", trained="ppo-paper-state"),
    Gap("seeds of the training", "multiple training tests with different random seeds", "0, 1, 2",
        trained="ppo-paper"),
    Gap("ends of the cosine, number of decisions", "table:params: cosine, no numbers", "3e-4 to 3e-5; in the recipes",
        unmeasured="one training each takes minutes; docs/learning.md compares recipes"),
)  # fmt: skip


_GAP_WORLDS = 2_000
_SPECS = (FULL_BRAKE, PAIRWISE, COUPLED, PPO)
_SHOWN = tuple(NAMES[spec] for spec in _SPECS)


@dataclass(frozen=True, slots=True)
class Headline:
    """Harm and collisions of each strategy in each world of a list."""

    gaps_m: Floats  # [n, P] by which lists of the same worlds are known
    harm: Mapping[str, Floats]
    collided: Mapping[str, Bools]

    def change(self, base: Headline, strategy: str) -> Estimate:
        """Harm minus that of ``base``: paired by world where the worlds are the same, else of two lists."""
        own, other = self.harm[strategy], base.harm[strategy]
        if np.array_equal(self.gaps_m, base.gaps_m):
            return paired_difference(own, other)
        return Less.of_lists(strategy, own, other).difference


def reproduce_gaps(settings: Settings) -> Made:
    """The sensitivity table: every quantity, our default, alternatives, and how far the headline moves."""
    episodes, scenario = min(_GAP_WORLDS, settings.episodes), load_scenario(_RANDOM)
    base = _measure(scenario, Alternative("default"), episodes)
    measured = [gap for gap in GAPS if gap.alternatives]
    found: dict[tuple[Gap, Alternative], Headline] = {}
    for number, gap in enumerate(measured):
        settings.tell(Progress("open quantities", number, len(measured)))
        found |= {(gap, each): _measure(scenario, each, episodes) for each in gap.alternatives}
    settings.tell(Progress("open quantities", len(measured), len(measured)))
    rows = {f"{gap.name}: {each.value}": headline for (gap, each), headline in found.items()}
    about = "Change of the mean harm of each strategy on the random test when one open quantity changes."
    changes = {row: {name: headline.change(base, name) for name in _SHOWN} for row, headline in rows.items()}
    figure = changes_figure(changes, x_label="Change of the mean harm (m²/s²)", caption=about)
    parameters = [
        *scenario_parameters(scenario, gaps_m="text to Table:Random", speeds_mps="text to Table:Random"),
        Parameter("policies", f"{POLICIES}; not trained anew for an alternative"),
        list_parameter(episodes),
    ]
    data = [
        (row, name, len(each.gaps_m), mean(each.harm[name]).value, each.change(base, name),
         collision_rate(each.collided[name]).value)
        for row, each in {"default": base, **rows}.items()
        for name in _SHOWN
    ]  # fmt: skip
    head = ("alternative", "strategy", "worlds", "harm", "change", "change_low", "change_high", "collision_rate")
    notes = []
    for name in _SHOWN:
        most = max(rows, key=lambda row: abs(changes[row][name].value))
        harm = mean(base.harm[name]).in_words()
        notes.append(f"What moves {name} ({harm}) most: {most}, by {changes[most][name].in_words()}.")
    tables, trained = [_register(), _headline(base, episodes), _sensitivity(base, found)], _trained(settings)
    verdicts = _judge_gaps(base, rows)
    if not trained:
        verdicts.append(Verdict("what is open in training", "not run", "no training; --full trains"))
    drawn = Drawn("gaps", "How far the headline moves", about)
    return Made(verdicts, parameters, [*tables, *trained], {drawn: figure}, {"gaps": csv_text(head, data)}, notes)


def _measure(scenario: Scenario, alternative: Alternative, episodes: int) -> Headline:
    """The strategies in one alternative; a strategy that predicts no harm has its first-impact harm."""
    own = scenario.replace(**alternative.changes) if alternative.changes else scenario
    agents: dict[str, Agent] = dict(lineup(_SPECS, own))
    if alternative.bound is not None:
        agents[NAMES[PPO]] = hybrid(load_shipped("ppo"), own, alternative.bound)
    seed = LIST_SEED if alternative.seed is None else alternative.seed
    evaluation = evaluate(
        own.sample(episodes, seed),
        agents,
        scenario=own,
        seed=seed,
        chunk=PROGRESS_EVERY,
        aftermath=alternative.harm == "sampled",
    )
    harm = {}
    for name, outcome in evaluation.outcomes.items():
        predicted = outcome.predicted_harm if name == NAMES[PAIRWISE] else None
        counted = {"total": outcome.total_harm, "sampled": outcome.sampled_harm, "predicted": predicted}
        chosen = counted.get(alternative.harm)
        harm[name] = outcome.first_impact_harm if chosen is None else chosen
    collided = {name: outcome.collided for name, outcome in evaluation.outcomes.items()}
    return Headline(evaluation.worlds.gaps_m, harm, collided)


def _register() -> Sheet:
    def told(gap: Gap) -> str:
        if gap.alternatives:
            return "; ".join(each.value for each in gap.alternatives)
        return f"trained by --full: {gap.trained}..." if gap.trained else f"not measured: {gap.unmeasured}"

    head = ("Quantity", "The paper", "Our default", "Alternatives, or why none is measured")
    rows = [(gap.name, gap.paper, gap.ours, told(gap)) for gap in GAPS]
    return Sheet("Register of what the paper leaves open", head, rows, "Labels are those of the paper's source.")


def _headline(base: Headline, episodes: int) -> Sheet:
    rows = [(name, collision_rate(base.collided[name]), mean(base.harm[name])) for name in _SHOWN]
    note = f"{episodes:,} worlds of the random test, seed {LIST_SEED}; first-impact harm, m²/s²; 95 % intervals."
    return Sheet("Headline at our defaults", ("Strategy", PERCENT, HARM), rows, note)


def _sensitivity(base: Headline, found: Mapping[tuple[Gap, Alternative], Headline]) -> Sheet:
    rows = []
    for (gap, each), headline in found.items():
        cells = [headline.change(base, name) for name in _SHOWN]
        rates = [collision_rate(headline.collided[NAMES[spec]]).value for spec in (PAIRWISE, PPO)]
        rows.append((gap.name, gap.ours, each.value, *cells, *rates))
    collisions = [replace(PERCENT, heading=f"Collisions, {name}") for name in ("E-V2X-BM", "PPO")]
    head: list[Column | str] = ["Quantity", "Default", "Alternative", *_SHOWN, *collisions]
    note = (
        "Change of the mean harm (m²/s²) with its 95 % interval, paired by world where the worlds are the same; then"
        " the collision rates in the alternative. In the rows of H* inside the hybrid, PPO stands behind Algorithm 1."
    )
    return Sheet("How far the headline moves", head, rows, note)


def _trained(settings: Settings) -> list[Sheet]:
    """Harm of the kept policies of the trainings of what is open; none where nothing was trained."""
    rows = [
        (name, len(kept), float(np.mean(kept)), ", ".join(f"{harm:.2f}" for harm in kept))
        for name, kept in kept_harms(settings, OPEN).items()
    ]
    note = (
        "First-impact harm (m²/s²) of the kept policy on 1,000 worlds of seed 1007; ppo-paper is the paper's table with"
        f" our weights. Each had {PPO_PAPER.decisions:,} of the recipe's"
        f" {load_recipe(PPO_PAPER.recipe).total_steps:,} decisions; two seeds say little about others."
    )
    head = ("Training", "Seeds", "Mean harm", "Each seed")
    return [Sheet("What is open in training", head, rows, note)] if rows else []


def _judge_gaps(base: Headline, rows: Mapping[str, Headline]) -> list[Verdict]:
    """Whether some alternative brings a strategy to its printed row, and whether the strategies keep their order."""
    verdicts, printed = [], {row.agent: row for row in PAPER_ROWS if row.table == RANDOM_TEST}
    for agent, spec in (("Non-E", FULL_BRAKE), ("E-V2X-BM", PAIRWISE), ("Hybrid PPO", PPO)):
        own = {row: mean(headline.harm[NAMES[spec]]) for row, headline in rows.items()}
        what = f"{agent}, average harm of Table:Random, one open quantity changed at a time"
        ours = mean(base.harm[NAMES[spec]])
        verdicts.append(compare_number(what, printed[agent].average_harm, ours, others=own))
    order = (NAMES[PPO], NAMES[COUPLED], NAMES[FULL_BRAKE])
    means = {row: [float(headline.harm[name].mean()) for name in order] for row, headline in rows.items()}
    broken = [row for row, found in means.items() if found != sorted(found)]
    told = f"in {len(rows) - len(broken)} of {len(rows)} alternatives{'; not with ' * bool(broken)}{'; '.join(broken)}"
    verdicts.append(Verdict(f"the order stays: {' < '.join(order)}", "differs" if broken else "agrees", told))
    return verdicts
