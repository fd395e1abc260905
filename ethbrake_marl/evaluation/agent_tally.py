"""Sums of one agent's measures over some worlds, and the estimates made of them.

Sums are exact, so they can be added in any order to the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from ethbrake_marl.evaluation.measures import BASELINE, Measure, MeasureSet, every_set
from ethbrake_marl.evaluation.outcome import COLUMN, Outcome, Values
from ethbrake_marl.evaluation.own_measures import registered_measure
from ethbrake_marl.evaluation.statistics import Moments, exact_sum, rate
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.game.measures import REPORTED


@dataclass(frozen=True, slots=True)
class AgentTally:
    """What one agent did in some worlds, by measure."""

    counts: Mapping[str, tuple[int, int]] = field(default_factory=dict)  # worlds in which it is so, of how many
    moments: Mapping[str, Moments] = field(default_factory=dict)
    products: Mapping[str, Fraction] = field(default_factory=dict)  # with the baseline's

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
        """Worlds in which it is so."""
        return self.counts.get(name, (0, 0))[0]

    def share(self, name: str, worlds: int) -> float | None:
        """Their share; None unless all of the worlds have it."""
        so, of = self.counts.get(name, (0, 0))
        return so / worlds if of == worlds else None

    def sums(self, name: str, worlds: int) -> Moments | None:
        """The moments of a number; None unless all of the worlds have it."""
        moments = self.moments.get(name)
        return moments if moments is not None and moments.count == worlds else None


def tally_agents(
    outcomes: Mapping[str, Outcome],
    contexts: Mapping[str, Any],
    *,
    baseline: str = BASELINE,
    objectives: Sequence[str] | None = None,
) -> dict[str, AgentTally]:
    """The tally of every agent in the same worlds.

    Args:
        outcomes: by agent.
        contexts: what each set of measures knows of these worlds; see ``contexts_of``.
        baseline: the agent to compare with, for sets that have none of their own.
        objectives: also sum up what each vehicle bears, and what these make of it; None: neither.

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
            {name: Moments.of(column) for name, column in own.items() if name not in truths},
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
    """Estimate of every measure of one agent in so many worlds; None for what not all of them have."""
    own = tallies[agent]
    columns = [name.removeprefix(COLUMN) for name in (*own.counts, *own.moments) if name.startswith(COLUMN)]
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
    """Estimate of one measure; of one that compares, only where ``whole`` holds in every world."""
    name = measure.name if callable(measure.of) else measure.of
    if own.share(name, worlds) is not None:
        return rate(own.count(name), worlds)
    sums = own.sums(name, worlds)
    if sums is None or not measure.against:
        return None if sums is None else sums.estimate
    other = None if baseline is None else baseline.sums(name, worlds)
    if other is None or (whole is not None and own.count(whole) != worlds):
        return None
    product = own.products[name]
    return sums.decrease(other, product) if measure.against == "decrease" else sums.minus(other, product).estimate


def lower_bounds(tally: AgentTally, worlds: int) -> frozenset[str]:
    """Means that are only lower bounds, because what their set needs holds in some of the worlds alone."""

    def is_partial(each: MeasureSet) -> bool:
        share = None if each.whole is None else tally.share(each.whole, worlds)
        return share is not None and share < 1.0

    partial = [each for _, each in every_set() if is_partial(each)]
    return frozenset(measure.name for each in partial for measure in each.measures if not measure.against)
