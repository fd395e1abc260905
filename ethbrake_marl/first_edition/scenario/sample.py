"""``Sample``: drawn worlds, and for each world its number in the list, its vehicle types, scenario and recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.first_edition.physics.state import Ints, Worlds
from ethbrake_marl.first_edition.scenario.fields import RECORDING

_Texts = NDArray[np.str_]


def recording_of(texts: _Texts) -> _Texts:
    """Return the name of the recording in each text of the column ``recording``, [n]: the part before the last ": "."""
    before, _, after = np.char.rpartition(texts, ": ").T
    names: _Texts = np.where(before == "", after, before)
    return names


def clusters_of(kinds: Mapping[str, _Texts], index: Ints) -> _Texts | None:
    """Return the name of each world's cluster, [n], or None if all worlds are independent.

    Worlds of the same cluster are not statistically independent. A cluster contains all worlds from one recording, even
    if these worlds contain different vehicles. In a mixture, a world without a recording is a cluster of its own.
    ``kinds`` has the form of ``Sample.kinds``, and ``index`` is the number of each world in its list, [n].
    """
    column = kinds.get(RECORDING)
    if column is None:
        return None
    recording = recording_of(column)
    return np.where(recording == "", np.char.add(" ", index.astype(str)), recording)


@dataclass(frozen=True, slots=True)
class Sample:
    """Worlds at the alert (time 0), each with its number in the list of worlds.

    >>> import ethbrake_marl.first_edition as eb
    >>> sample = eb.load_scenario("paper-random").sample(2, seed=7)
    >>> sample.index, sample.worlds.gaps_m.round(2)
    (array([0, 1]), array([[6.62, 8.49], [5.33, 7.79]]))
    """

    worlds: Worlds  # at t = 0
    index: Ints  # [n] number of each world in the list of its seed
    rejected: int  # number of draws that were rejected for an early impact
    types: _Texts | None = None  # [n, N] type of every vehicle, "" if it has none; None: the scenario has no types
    scenarios: _Texts | None = None  # [n] scenario of a mixture that each world was drawn from; None: no mixture
    recordings: _Texts | None = None  # [n] recording that each world comes from, "" if none; None: no such column

    def __repr__(self) -> str:
        numbers = f"numbers {self.index.min()} to {self.index.max()}" if len(self.index) else "no numbers"
        return f"Sample({self.worlds!r}, {numbers}, {self.rejected:,} rejected)"

    def take(self, rows: ArrayLike) -> Sample:
        """Return a sample of the worlds ``rows`` (indices or a mask [n]), with ``rejected`` = 0."""
        some = np.asarray(rows)
        texts = (None if each is None else each[some] for each in (self.types, self.scenarios, self.recordings))
        return Sample(self.worlds.take(some), self.index[some], 0, *texts)

    @staticmethod
    def join(parts: Sequence[Sample], rejected: int) -> Sample:
        """Join samples into one, in the order of their world numbers.

        Either all samples in ``parts`` have vehicle types, or no sample has; the same applies to scenarios and to
        recordings. ``rejected`` becomes ``Sample.rejected``.
        """
        index = np.concatenate([part.index for part in parts])
        order = np.argsort(index)
        joined: dict[str, _Texts] = {}
        for name in ("types", "scenarios", "recordings"):
            values = [getattr(part, name) for part in parts if getattr(part, name) is not None]
            joined |= {name: np.concatenate(values)[order]} if values else {}
        worlds = Worlds.concatenate([part.worlds for part in parts]).take(order)
        return Sample(worlds, index[order], rejected, **joined)

    @property
    def kinds(self) -> dict[str, _Texts]:
        """Columns of text about the worlds: name -> texts, [n].

        The column ``scenario`` exists for a mixture, ``recording`` for a table that names recordings, and
        ``vehicle_1_type`` and so on for a scenario with vehicle types.
        """
        columns = {} if self.scenarios is None else {"scenario": self.scenarios}
        columns |= {} if self.recordings is None else {RECORDING: self.recordings}
        types = () if self.types is None else self.types.T
        return columns | {f"vehicle_{i + 1}_type": column for i, column in enumerate(types)}

    @property
    def clusters(self) -> _Texts | None:
        """Name of each world's cluster, [n], or None if all worlds are independent; see ``clusters_of``."""
        return clusters_of(self.kinds, self.index)

    def count_kinds(self) -> str:
        """Return a text with the number of worlds for each scenario of a mixture and each vehicle type.

        An example is ``"; vehicle_1_type: car 7, truck 3"``. For the column ``recording``, the text contains only the
        number of different recordings. The text is empty if the sample has no ``kinds``.
        """
        text = ""
        for kind, column in self.kinds.items():
            names, counts = np.unique(column, return_counts=True)
            each = ", ".join(f"{n or 'none'} {c}" for n, c in zip(names, counts, strict=True))
            text += f"; {kind}: {each if kind != RECORDING else f'{len(names)} different'}"
        return text
