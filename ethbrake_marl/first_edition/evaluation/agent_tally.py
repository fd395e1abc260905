"""Sums of one agent's measures over many worlds, and the means and intervals computed from these sums.

The sums are exact, so they do not depend on the order in which worlds are added. The argument ``worlds`` is the
number of worlds in the evaluation. If a measure lacks a value in at least one of these worlds, its share, its sums and
its estimate are None.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.first_edition.evaluation.measure_sets import BASELINE, Measure, MeasureSet, every_set
from ethbrake_marl.first_edition.evaluation.outcome import COLUMN, Outcome, Values
from ethbrake_marl.first_edition.evaluation.own_measures import registered_measure
from ethbrake_marl.first_edition.evaluation.statistics import Moments, Texts, exact_sum, rate
from ethbrake_marl.first_edition.game.measures import REPORTED


@dataclass(frozen=True, slots=True)
class AgentTally:
    """Exact sums of one agent's measures over many worlds; ``tally + other`` has the sums over the worlds of both."""

    # Name of a true/false measure -> number of worlds in which it is true, number of worlds in which it has a value.
    counts: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    # Name of a numeric measure -> its sums. If the worlds have clusters, also true/false measures, as 1 and 0.
    moments: Mapping[str, Moments] = field(default_factory=dict)
    # Name of a measure that is compared with a baseline -> sum over worlds of own value times the baseline's value.
    products: Mapping[str, Fraction] = field(default_factory=dict)

    def __add__(self, other: AgentTally) -> AgentTally:
        counts = dict(self.counts)
        for name, (so, of) in other.counts.items():
            before = counts.get(name, (0, 0))
            counts[name] = before[0] + so, before[1] + of
        moments, products = dict(self.moments), dict(self.products)
        moments |= {name: moments.get(name, Moments()) + each for name, each in other.moments.items()}
        products |= {name: products.get(name, Fraction()) + each for name, each in other.products.items()}
        return AgentTally(counts, moments, products)

    def count(self, name: str) -> int:
        """Return the number of worlds in which the true/false measure ``name`` is true (0 for an unknown name)."""
        return self.counts.get(name, (0, 0))[0]

    def share(self, name: str, worlds: int) -> float | None:
        """Return the fraction (0 to 1) of worlds in which the true/false measure ``name`` is true."""
        so, of = self.counts.get(name, (0, 0))
        return so / worlds if of == worlds else None

    def sums(self, name: str, worlds: int) -> Moments | None:
        """Return the sums of the numeric measure ``name``."""
        moments = self.moments.get(name)
        return moments if moments is not None and moments.count == worlds else None


def tally_agents(
    outcomes: Mapping[str, Outcome],
    contexts: Mapping[str, Any],
    *,
    baseline: str = BASELINE,
    objectives: Sequence[str] | None = None,
    clusters: Texts | None = None,
) -> dict[str, AgentTally]:
    """Return the sums of every agent's measures over the same worlds, by the agent's name.

    Args:
        outcomes: outcome of each agent, by the agent's name.
        contexts: context of each set of measures (``contexts_of``), by the set's name.
        baseline: name of the agent with which the others are compared, unless a set of measures names its own baseline.
        objectives: objectives such as ``"social:45"`` (docs/cooperation.md). If this is a list, even an empty list, the
            result also contains, for each vehicle, the sum of the harm that it bears, and the sum of each objective's
            value.
        clusters: name of each world's recording, [n]; None: all worlds are independent.

    """
    values: dict[str, dict[str, Values]] = {}
    for agent, outcome in outcomes.items():
        columns = {
            measure.name: measure.values(outcome, contexts.get(name))
            for name, each in every_set(outcome.metrics)
            for measure in (*each.measures, *each.counted)
        }
        values[agent] = {name: column for name, column in columns.items() if column is not None}
        values[agent] |= {} if objectives is None else outcome.borne(objectives)
    compared_with = {
        str(measure.of): each.baseline or baseline
        for _, each in every_set()
        for measure in each.measures
        if measure.against
    }
    tallies = {}
    for agent, own in values.items():
        truths = {name: column for name, column in own.items() if column.dtype == np.bool_}
        tallies[agent] = AgentTally(
            {name: (int(column.sum()), len(column)) for name, column in truths.items()},
            {name: Moments.of(own[name], clusters) for name in own if clusters is not None or name not in truths},
            {
                name: exact_sum(own[name], values[other][name])
                for name, other in compared_with.items()
                if name in own and other in values
            },
        )
    return tallies


def estimate_all(
    tallies: Mapping[str, AgentTally], agent: str, worlds: int, *, baseline: str
) -> dict[str, Estimate | None]:
    """Return the estimate (mean and 95 % interval) of every measure of one agent, by the measure's name.

    ``baseline`` is the name of the agent with which ``agent`` is compared. If ``tallies`` does not contain it, all
    comparisons with it are None.
    """
    own = tallies[agent]
    columns = [
        name.removeprefix(COLUMN) for name in dict.fromkeys((*own.counts, *own.moments)) if name.startswith(COLUMN)
    ]
    registered = list(REPORTED.values())
    columns.sort(key=lambda column: registered.index(each) if (each := registered_measure(column)) else len(registered))
    return {
        measure.name: _estimate(measure, own, tallies.get(each.baseline or baseline), worlds, each.whole)
        for _, each in every_set(columns)
        for measure in each.measures
    }


def _estimate(
    measure: Measure, own: AgentTally, baseline: AgentTally | None, worlds: int, whole: str | None
) -> Estimate | None:
    """Return the estimate of one measure of one agent; None if values that the estimate needs are missing.

    A comparison with the baseline has an estimate only if the true/false measure ``whole`` (``MeasureSet.whole``), if
    there is one, is true in all worlds.
    """
    name = measure.name if callable(measure.of) else measure.of
    if own.share(name, worlds) is not None:
        return own.moments[name].share if name in own.moments else rate(own.count(name), worlds)
    sums = own.sums(name, worlds)
    if sums is None or not measure.against:
        return None if sums is None else sums.estimate
    other = None if baseline is None else baseline.sums(name, worlds)
    if other is None or (whole is not None and own.count(whole) != worlds):
        return None
    product = own.products[name]
    return sums.decrease(other, product) if measure.against == "decrease" else sums.minus(other, product).estimate


def lower_bounds(tally: AgentTally, worlds: int) -> frozenset[str]:
    """Return the names of the measures whose means, for one agent, are only lower bounds of the true means.

    These are the measures of a set whose values are incomplete in some world (``MeasureSet.whole``).
    """

    def is_partial(each: MeasureSet) -> bool:
        share = None if each.whole is None else tally.share(each.whole, worlds)
        return share is not None and share < 1.0

    partial = [each for _, each in every_set() if is_partial(each)]
    return frozenset(measure.name for each in partial for measure in each.measures if not measure.against)
