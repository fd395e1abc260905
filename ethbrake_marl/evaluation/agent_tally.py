"""Sums of one agent's measures over some worlds, and the estimates made of them.

Sums are exact, so they can be added in any order to the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction

from ethbrake_marl.evaluation.measures import BASELINE, KNOWN, Measure, measures
from ethbrake_marl.evaluation.outcome import COLUMN
from ethbrake_marl.evaluation.own_measures import REGISTERED, registered_measure
from ethbrake_marl.evaluation.statistics import Moments, rate
from ethbrake_marl.files.sheet import Estimate


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

    def found(self, name: str, worlds: int) -> Moments | None:
        """The moments of a number; None unless all of the worlds have it."""
        moments = self.moments.get(name)
        return moments if moments is not None and moments.count == worlds else None


def estimate_all(
    tallies: Mapping[str, AgentTally], agent: str, worlds: int, *, baseline: str
) -> dict[str, Estimate | None]:
    """What one agent did in so many worlds, by measure; None for what not all of them have."""
    own = tallies[agent]
    columns = [name.removeprefix(COLUMN) for name in (*own.counts, *own.moments) if name.startswith(COLUMN)]
    registered = list(REGISTERED.values())
    columns.sort(key=lambda column: registered.index(each) if (each := registered_measure(column)) else len(registered))

    def estimate(measure: Measure) -> Estimate | None:
        name = measure.name if callable(measure.of) else measure.of
        if own.share(name, worlds) is not None:
            return rate(own.count(name), worlds)
        found = own.found(name, worlds)
        if found is None or not measure.against:
            return None if found is None else found.estimate
        compared = tallies.get(BASELINE if measure.limits else baseline)
        other = None if compared is None else compared.found(name, worlds)
        if other is None or (measure.limits and own.count(KNOWN) != worlds):
            return None
        product = own.products[name]
        return found.decrease(other, product) if measure.against == "decrease" else found.minus(other, product).estimate

    return {measure.name: estimate(measure) for measure in measures(columns)}
