"""Every impact of a batch of episodes, as arrays: what registered measures are computed from."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.left_out import ImpactRows
from ethbrake_marl.physics.state import Floats, Worlds


@dataclass(frozen=True, slots=True)
class EpisodeImpacts:
    """What a registered measure is computed from, for n episodes of N vehicles; its arrays cannot be written to."""

    worlds: Worlds  # [n] at the alert
    rows: ImpactRows  # every impact, by world and then by time, arrays [k]

    @classmethod
    def unwritable(cls, worlds: Worlds, rows: ImpactRows) -> EpisodeImpacts:
        """Those of these episodes; the arrays of ``rows`` cannot be written to from now on."""
        for column in fields(rows):
            getattr(rows, column.name).flags.writeable = False
        return cls(worlds.read_only(), rows)

    @property
    def largest_speed_change_mps(self) -> Floats:
        """The largest change of speed of each vehicle in one impact (delta-v), [n, N]; 0 without one.

        One that is pushed by a vehicle that touches it already has no impact of its own, and so no change from it.
        """
        rows, change = self.rows, np.zeros(self.worlds.speeds_mps.shape)
        np.maximum.at(change, (rows.world, rows.pair + 1), np.abs(rows.rear_speed_change_mps))
        pairs = rows.pair >= 0  # an obstacle ahead is no vehicle
        np.maximum.at(change, (rows.world[pairs], rows.pair[pairs]), np.abs(rows.front_speed_change_mps[pairs]))
        return change


class Tape:
    """The steps of a batch of episodes as they are driven (``Watch``), and every impact in them.

    With ``steps`` False only the impacts are kept.
    """

    def __init__(self, worlds: Worlds, *, steps: bool = True) -> None:
        self.worlds = worlds  # at the alert
        self.steps: list[tuple[Worlds, Floats, Floats]] = []  # before, commands [n, N], until [n]
        self._keeps_steps = steps
        self._rows: list[ImpactRows] = []

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Keep one step."""
        moving = until_s > before.time_s
        some = np.flatnonzero(moving | (before.time_s == self.worlds.time_s))  # an impact at the very alert
        rows = advance(before.take(some), command_mps2[some], until_s=until_s[some], record=True)[1].rows
        assert rows is not None  # they were asked for
        self._rows.append(replace(rows, world=some[rows.world]))
        if self._keeps_steps:
            self.steps.append((before, command_mps2, until_s))

    def impacts(self) -> ImpactRows:
        """Every impact so far, by world and then by time."""
        columns = {f.name: np.concatenate([getattr(rows, f.name) for rows in self._rows]) for f in fields(ImpactRows)}
        order = np.argsort(columns["world"], kind="stable")
        return ImpactRows(**{name: column[order] for name, column in columns.items()})

    def episodes(self) -> EpisodeImpacts:
        """What registered measures are computed from."""
        return EpisodeImpacts.unwritable(self.worlds.take(np.arange(self.worlds.n)), self.impacts())
