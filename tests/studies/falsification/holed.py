"""An agent with a planted hole."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics import Bools, Floats, Ints, Worlds


class Holed:
    """Brakes fully, but coasts in a corner of the ranges: 0.1 % of the worlds of ``paper-random``."""

    name = "holed"

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        self.hole = in_hole(worlds)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        command: Floats = np.where(self.hole, 0.0, -worlds.vehicles.braking_capacity_mps2[:, vehicle])
        return command


def in_hole(worlds: Worlds) -> Bools:
    """Three conditions, each of which a tenth of the worlds meets."""
    found: Bools = (worlds.gaps_m < 5.5).all(axis=1) & (worlds.speeds_mps[:, 1] > 21.6)
    return found
