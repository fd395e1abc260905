"""``EpisodeImpacts``: every single impact in a batch of episodes, from which measures can be computed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.left_out import ImpactRows
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Vehicles, Worlds

_OF_WORLDS = [field.name for field in fields(Worlds) if field.name != "vehicles"]
_OF_VEHICLES = [field.name for field in fields(Vehicles)]
_OF_ROWS = [field.name for field in fields(ImpactRows)]
_NO_INTS, _NO_FLOATS = np.empty(0, np.int64), np.empty(0)
_NO_ROWS = ImpactRows(_NO_INTS, _NO_INTS, _NO_FLOATS, _NO_FLOATS, np.empty(0, np.bool_), _NO_FLOATS, _NO_FLOATS)


@dataclass(frozen=True, slots=True)
class EpisodeImpacts:
    """All impacts so far in n episodes of N vehicles, as read-only arrays."""

    worlds: Worlds  # the n worlds at the alert, when the episodes began
    rows: ImpactRows  # all k impacts so far, ordered by world and then by time

    @classmethod
    def of(cls, worlds: Worlds, parts: Sequence[ImpactRows] = ()) -> EpisodeImpacts:
        """Return all impacts of the episodes that began in the states ``worlds``.

        ``parts`` has the impacts of these episodes, one item for each of several consecutive time intervals.
        """
        whole = [np.concatenate([getattr(rows, name) for rows in (_NO_ROWS, *parts)]) for name in _OF_ROWS]
        order = np.argsort(whole[0], kind="stable")
        whole = [column[order] for column in whole]
        for column in whole:
            column.flags.writeable = False
        return cls(worlds.read_only(), ImpactRows(*whole))

    @property
    def largest_speed_change_mps(self) -> Floats:
        """Largest change of speed of each vehicle in a single impact (delta-v), [n, N] m/s; 0 without an impact.

        A push by a vehicle that is already in contact is not an impact and is not included.
        """
        rows, change = self.rows, np.zeros(self.worlds.speeds_mps.shape)
        np.maximum.at(change, (rows.world, rows.pair + 1), np.abs(rows.rear_speed_change_mps))
        pairs = rows.pair >= 0  # False for an impact with an obstacle
        np.maximum.at(change, (rows.world[pairs], rows.pair[pairs]), np.abs(rows.front_speed_change_mps[pairs]))
        return change

    def and_then(self, way: Iterable[tuple[Worlds, Floats, Floats]], some: Bools) -> EpisodeImpacts:
        """Return the impacts of this object together with the impacts in the next segments of the same episodes.

        ``way`` has consecutive segments (time intervals) from ``Engine.segments``. Each segment is a tuple: the worlds
        at its start, the constant commands [n, N] m/s2, and the times [n] s at which it ends. New impacts are added
        only in worlds for which the mask ``some`` [n] is True.
        """
        parts, blocks = list(way), [self.rows]
        for k, (before, command_mps2, until_s) in enumerate(parts, 1):
            moving = until_s > before.time_s
            if k == len(parts):
                moving |= until_s == 0.0  # an impact at the time of the alert
            blocks.append(impacts_within(before, command_mps2, until_s, np.flatnonzero(some & moving)))
        return EpisodeImpacts.of(self.worlds, blocks)

    def renewed(self, rows: Ints, alert: Worlds) -> EpisodeImpacts:
        """Return a copy in which new episodes, still without impacts, replace the episodes with the indices ``rows``.

        ``alert`` has the worlds of the new episodes at the alert.
        """
        others = ~np.isin(self.rows.world, rows)
        return EpisodeImpacts.of(self.worlds.assign(rows, alert), [_some(self.rows, others)])

    def take(self, rows: Ints) -> EpisodeImpacts:
        """Return the impacts of only the episodes with the indices ``rows`` [k]; an index may occur several times."""
        first = np.searchsorted(self.rows.world, rows)
        count = np.searchsorted(self.rows.world, rows, side="right") - first
        at = np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())
        taken = replace(_some(self.rows, at), world=np.repeat(np.arange(len(rows)), count))
        return EpisodeImpacts.of(self.worlds.take(rows), [taken])

    @staticmethod
    def join(parts: Sequence[EpisodeImpacts]) -> EpisodeImpacts:
        """Return one object with the episodes of all ``parts``, in the order of ``parts``."""
        before = np.cumsum([0, *(part.worlds.n for part in parts)])
        shifted = [replace(p.rows, world=p.rows.world + n) for p, n in zip(parts, before, strict=False)]
        return EpisodeImpacts.of(Worlds.concatenate([part.worlds for part in parts]), shifted)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all data as a dictionary from name to array, for a snapshot; ``read`` converts the arrays back."""
        arrays = {name: getattr(self.worlds, name) for name in _OF_WORLDS}
        arrays |= {name: getattr(self.worlds.vehicles, name) for name in _OF_VEHICLES}
        arrays["rows"] = np.stack([getattr(self.rows, name) for name in _OF_ROWS], axis=1, dtype=np.float64)
        return {f"impacts.{name}": np.array(array, order="C") for name, array in arrays.items()}

    def read(self, arrays: Mapping[str, NDArray[Any]]) -> EpisodeImpacts:
        """Return an ``EpisodeImpacts`` with the impacts in ``arrays``, a dictionary from ``EpisodeImpacts.arrays``.

        ``arrays`` must contain the same number of episodes as this object. Raises ``InvalidInput`` if an array is
        missing or has a wrong shape.
        """
        for name, own in self.arrays().items():
            have = arrays.get(name)
            if have is None or have.ndim != own.ndim or (len(have) != len(own) and name != "impacts.rows"):
                fault = "is missing" if have is None else f"has shape {have.shape}"
                raise InvalidInput(f"engine snapshot: the array {name} {fault}; must have shape {own.shape}")
        columns = zip(_OF_ROWS, np.array(arrays["impacts.rows"]).T, strict=True)
        rows = ImpactRows(**{name: column.astype(getattr(_NO_ROWS, name).dtype) for name, column in columns})
        vehicles = Vehicles(**{name: arrays[f"impacts.{name}"] for name in _OF_VEHICLES})
        worlds = Worlds(vehicles, **{name: arrays[f"impacts.{name}"] for name in _OF_WORLDS})
        return EpisodeImpacts.of(worlds.take(np.arange(worlds.n)), [rows])


def _some(rows: ImpactRows, index: NDArray[Any]) -> ImpactRows:
    return ImpactRows(*(getattr(rows, name)[index] for name in _OF_ROWS))


def impacts_within(before: Worlds, command_mps2: Floats, until_s: Floats, rows: Ints) -> ImpactRows:
    """Return every impact in the worlds ``rows`` (indices) during a segment, in which commands are constant.

    The segment begins in the n states ``before`` and ends at the times ``until_s``, [n] s. In the result,
    ``ImpactRows.world`` is the index of the impact's world in ``before``.
    """
    impacts = advance(before.take(rows), command_mps2[rows], until_s=until_s[rows], record=True)[1].rows
    assert impacts is not None  # because of record=True
    return replace(impacts, world=rows[impacts.world])
