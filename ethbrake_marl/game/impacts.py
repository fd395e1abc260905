"""Every impact of a batch of episodes, as arrays, from which measures by impacts are computed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.left_out import ImpactRows
from ethbrake_marl.physics.state import Bools, Floats, Ints, Vehicles, Worlds

_OF_WORLDS = [field.name for field in fields(Worlds) if field.name != "vehicles"]
_OF_VEHICLES = [field.name for field in fields(Vehicles)]
_OF_ROWS = [field.name for field in fields(ImpactRows)]
_NO_INTS, _NO_FLOATS = np.empty(0, np.int64), np.empty(0)
_NO_ROWS = ImpactRows(_NO_INTS, _NO_INTS, _NO_FLOATS, _NO_FLOATS, np.empty(0, np.bool_), _NO_FLOATS, _NO_FLOATS)


@dataclass(frozen=True, slots=True)
class EpisodeImpacts:
    """The impacts of n episodes of N vehicles so far; its arrays are read-only."""

    worlds: Worlds  # the n worlds at the alert, when the episodes began
    rows: ImpactRows  # every impact so far, ordered by world and then by time; arrays [k]

    @classmethod
    def of(cls, worlds: Worlds, parts: Sequence[ImpactRows] = ()) -> EpisodeImpacts:
        """Return the impacts of the episodes that began as ``worlds``.

        ``parts``: their impacts, in parts that follow each other in time.
        """
        whole = [np.concatenate([getattr(rows, name) for rows in (_NO_ROWS, *parts)]) for name in _OF_ROWS]
        order = np.argsort(whole[0], kind="stable")
        whole = [column[order] for column in whole]
        for column in whole:
            column.flags.writeable = False
        return cls(worlds.read_only(), ImpactRows(*whole))

    @property
    def largest_speed_change_mps(self) -> Floats:
        """Largest change of speed of each vehicle in one impact (delta-v), [n, N] m/s; 0 without an impact.

        A vehicle that is pushed by one that already touches it has no impact of its own, and so no change from the
        push.
        """
        rows, change = self.rows, np.zeros(self.worlds.speeds_mps.shape)
        np.maximum.at(change, (rows.world, rows.pair + 1), np.abs(rows.rear_speed_change_mps))
        pairs = rows.pair >= 0  # an obstacle ahead is no vehicle
        np.maximum.at(change, (rows.world[pairs], rows.pair[pairs]), np.abs(rows.front_speed_change_mps[pairs]))
        return change

    def and_then(self, way: Iterable[tuple[Worlds, Floats, Floats]], some: Bools) -> EpisodeImpacts:
        """Return the impacts after the episodes have gone on: these impacts, and the new ones of some worlds.

        Args:
            way: consecutive parts of the new motion: worlds at its start, constant commands [n, N] m/s2, and end [n] s,
                as ``Engine.segments`` yields them.
            some: worlds whose new impacts are added, a mask [n].

        """
        parts, blocks = list(way), [self.rows]
        for k, (before, command_mps2, until_s) in enumerate(parts, 1):
            moving = until_s > before.time_s
            if k == len(parts):
                moving |= until_s == 0.0  # an impact at the very alert
            blocks.append(impacts_within(before, command_mps2, until_s, np.flatnonzero(some & moving)))
        return EpisodeImpacts.of(self.worlds, blocks)

    def renewed(self, rows: Ints, alert: Worlds) -> EpisodeImpacts:
        """Return the impacts after new episodes have begun in some rows; these have no impacts yet.

        ``rows``: indices of the new episodes, [k]; ``alert``: their k worlds at the alert.
        """
        others = ~np.isin(self.rows.world, rows)
        return EpisodeImpacts.of(self.worlds.assign(rows, alert), [_some(self.rows, others)])

    def take(self, rows: Ints) -> EpisodeImpacts:
        """Return the impacts of the episodes at the indices ``rows`` [k]; an index may occur several times."""
        first = np.searchsorted(self.rows.world, rows)
        count = np.searchsorted(self.rows.world, rows, side="right") - first
        at = np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())
        taken = replace(_some(self.rows, at), world=np.repeat(np.arange(len(rows)), count))
        return EpisodeImpacts.of(self.worlds.take(rows), [taken])

    @staticmethod
    def join(parts: Sequence[EpisodeImpacts]) -> EpisodeImpacts:
        """Join the episodes of all parts into one batch, in the order of the parts."""
        before = np.cumsum([0, *(part.worlds.n for part in parts)])
        shifted = [replace(p.rows, world=p.rows.world + n) for p, n in zip(parts, before, strict=False)]
        return EpisodeImpacts.of(Worlds.concatenate([part.worlds for part in parts]), shifted)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all data as arrays by name, for a snapshot; ``read`` restores it."""
        arrays = {name: getattr(self.worlds, name) for name in _OF_WORLDS}
        arrays |= {name: getattr(self.worlds.vehicles, name) for name in _OF_VEHICLES}
        arrays["rows"] = np.stack([getattr(self.rows, name) for name in _OF_ROWS], axis=1, dtype=np.float64)
        return {f"impacts.{name}": np.array(array, order="C") for name, array in arrays.items()}

    def read(self, arrays: Mapping[str, NDArray[Any]]) -> EpisodeImpacts:
        """Return the impacts that ``arrays``, made by ``EpisodeImpacts.arrays``, hold.

        They must be of the same number of episodes as this object. Raises ``InvalidInput`` for an array that is missing
        or has another shape.
        """
        for name, own in self.arrays().items():
            have = arrays.get(name)
            if have is None or have.ndim != own.ndim or (len(have) != len(own) and name != "impacts.rows"):
                shape = "nothing" if have is None else have.shape
                raise InvalidInput(f"engine snapshot: {name} is {shape}; {own.shape} is needed")
        columns = zip(_OF_ROWS, np.array(arrays["impacts.rows"]).T, strict=True)
        rows = ImpactRows(**{name: column.astype(getattr(_NO_ROWS, name).dtype) for name, column in columns})
        vehicles = Vehicles(**{name: arrays[f"impacts.{name}"] for name in _OF_VEHICLES})
        worlds = Worlds(vehicles, **{name: arrays[f"impacts.{name}"] for name in _OF_WORLDS})
        return EpisodeImpacts.of(worlds.take(np.arange(worlds.n)), [rows])


def _some(rows: ImpactRows, index: NDArray[Any]) -> ImpactRows:
    return ImpactRows(*(getattr(rows, name)[index] for name in _OF_ROWS))


def impacts_within(before: Worlds, command_mps2: Floats, until_s: Floats, rows: Ints) -> ImpactRows:
    """Return every impact of some worlds during a segment; ``world`` in the result is the row in the whole batch.

    Args:
        before: n worlds at the start of the segment.
        command_mps2: constant commands, [n, N] m/s2.
        until_s: end of the segment, [n] s.
        rows: indices of the worlds to simulate, [k].

    """
    impacts = advance(before.take(rows), command_mps2[rows], until_s=until_s[rows], record=True)[1].rows
    assert impacts is not None  # they were asked for
    return replace(impacts, world=rows[impacts.world])
