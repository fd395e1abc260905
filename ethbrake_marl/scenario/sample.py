"""A part of a list of worlds: the worlds, where they stand in the list, and what they were drawn as."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.physics.worlds import Floats, Ints, Worlds, concatenate
from ethbrake_marl.scenario.quantities import OPTIONAL, QUANTITIES, QuantityRule

Texts = NDArray[np.str_]


@dataclass(frozen=True, slots=True)
class Sample:
    """Worlds at the alert, and where in the list they stand.

    >>> import ethbrake_marl as eb
    >>> sample = eb.load_scenario("paper-random").sample(2, seed=7)
    >>> sample.index, sample.worlds.gaps_m.round(2)
    (array([0, 1]), array([[6.62, 8.49], [5.33, 7.79]]))

    """

    worlds: Worlds  # at t = 0
    index: Ints  # [n] number of each world in the list of its seed
    rejected: int  # draws refused because of an early impact
    types: Texts | None = None  # [n, N] type of every vehicle, where a scenario has types; empty: it has none
    scenarios: Texts | None = None  # [n] the scenario of a mixture that each world was drawn from

    def __repr__(self) -> str:
        numbers = f"numbers {self.index.min()} to {self.index.max()}" if len(self.index) else "no numbers"
        return f"Sample({self.worlds!r}, {numbers}, {self.rejected:,} rejected)"

    def take(self, rows: ArrayLike) -> Sample:
        """Some of the worlds, by row or mask (always a copy); none of them was rejected."""
        some = np.asarray(rows)
        types, scenarios = (None if each is None else each[some] for each in (self.types, self.scenarios))
        return Sample(self.worlds.take(some), self.index[some], 0, types, scenarios)


def quantity(worlds: Worlds, field: str) -> Floats:
    """A quantity of every world, [n, entries]: one entry per vehicle, pair or world (see ``QUANTITIES``)."""
    holder = worlds if field in ("gaps_m", "speeds_mps", *OPTIONAL) else worlds.vehicles
    values: Floats = getattr(holder, field)
    return values.reshape(worlds.n, -1)


def quantity_rules(worlds: Worlds) -> dict[str, QuantityRule]:
    """The quantities that these worlds have: the distance to an obstacle only where there is one."""
    return {**QUANTITIES, **OPTIONAL} if np.isfinite(worlds.obstacle_gap_m).all() else QUANTITIES


def quantity_columns(worlds: Worlds) -> dict[str, Floats]:
    """Every quantity of the worlds, each [n], named as in a table of initial states: ``gap_1_m``, ``mass_2_t``."""
    return {
        rule.column_of(i): values
        for field, rule in quantity_rules(worlds).items()
        for i, values in enumerate(quantity(worlds, field).T)
    }


def kind_columns(types: Texts | None, scenarios: Texts | None) -> dict[str, Texts]:
    """``scenario`` of a mixture and ``vehicle_K_type``, each [n], where the worlds were drawn with such."""
    columns = {} if scenarios is None else {"scenario": scenarios}
    if types is not None:
        columns |= {f"vehicle_{i + 1}_type": column for i, column in enumerate(types.T)}
    return columns


def count_kinds(sample: Sample) -> str:
    """How often each scenario of a mixture, and each type of a vehicle, is in the sample; empty without such."""
    told = ""
    for kind, column in kind_columns(sample.types, sample.scenarios).items():
        names, counts = np.unique(column, return_counts=True)
        told += f"; {kind}: " + ", ".join(f"{n or 'none'} {c}" for n, c in zip(names, counts, strict=True))
    return told


def join_samples(parts: Sequence[Sample], rejected: int) -> Sample:
    """The worlds of all parts in the order of their numbers; all have types, or scenarios, or none has."""
    index = np.concatenate([part.index for part in parts])
    order = np.argsort(index)
    types, scenarios = (_joined([getattr(part, name) for part in parts], order) for name in ("types", "scenarios"))
    worlds = concatenate([part.worlds for part in parts]).take(order)
    return Sample(worlds, index[order], rejected, types, scenarios)


def _joined(columns: Sequence[Texts | None], order: Ints) -> Texts | None:
    given = [column for column in columns if column is not None]
    return np.concatenate(given)[order] if given else None
