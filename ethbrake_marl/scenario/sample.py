"""A part of a list of worlds: the worlds, where they stand in the list, and what they were drawn as."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.physics.state import Ints, Worlds

_Texts = NDArray[np.str_]


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
    types: _Texts | None = None  # [n, N] type of every vehicle, where a scenario has types; empty: it has none
    scenarios: _Texts | None = None  # [n] the scenario of a mixture that each world was drawn from

    def __repr__(self) -> str:
        numbers = f"numbers {self.index.min()} to {self.index.max()}" if len(self.index) else "no numbers"
        return f"Sample({self.worlds!r}, {numbers}, {self.rejected:,} rejected)"

    def take(self, rows: ArrayLike) -> Sample:
        """Some of the worlds, by row or mask (always a copy); none of them was rejected."""
        some = np.asarray(rows)
        types, scenarios = (None if each is None else each[some] for each in (self.types, self.scenarios))
        return Sample(self.worlds.take(some), self.index[some], 0, types, scenarios)

    @staticmethod
    def join(parts: Sequence[Sample], rejected: int) -> Sample:
        """The worlds of all parts in the order of their numbers; all have types, or scenarios, or none has."""
        index = np.concatenate([part.index for part in parts])
        order = np.argsort(index)
        joined: dict[str, _Texts] = {}
        for name in ("types", "scenarios"):
            given = [getattr(part, name) for part in parts if getattr(part, name) is not None]
            joined |= {name: np.concatenate(given)[order]} if given else {}
        worlds = Worlds.concatenate([part.worlds for part in parts]).take(order)
        return Sample(worlds, index[order], rejected, **joined)

    @property
    def kinds(self) -> dict[str, _Texts]:
        """``scenario`` of a mixture and ``vehicle_K_type``, each [n], where the worlds were drawn with such."""
        columns = {} if self.scenarios is None else {"scenario": self.scenarios}
        types = () if self.types is None else self.types.T
        return columns | {f"vehicle_{i + 1}_type": column for i, column in enumerate(types)}

    def count_kinds(self) -> str:
        """How often each scenario of a mixture, and each type of a vehicle, is there; empty without such."""
        told = ""
        for kind, column in self.kinds.items():
            names, counts = np.unique(column, return_counts=True)
            told += f"; {kind}: " + ", ".join(f"{n or 'none'} {c}" for n, c in zip(names, counts, strict=True))
        return told
