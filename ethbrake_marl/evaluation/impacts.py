"""Every impact of a batch of episodes, as arrays: what registered measures are computed from."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

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
