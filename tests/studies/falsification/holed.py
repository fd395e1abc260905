"""An agent with a planted hole."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics import Bools, Floats, Worlds


class Holed:
    """Brakes fully, but coasts in a corner of the ranges: 0.1 % of the worlds of ``paper-random``."""

    name = "holed"

    def begin(self, alert: Worlds, vehicle: int, scripts: object) -> Bools:
        return in_hole(alert)

    def act(self, worlds: Worlds, memory: Bools, vehicle: int) -> tuple[Floats, Bools]:
        return np.where(memory, 0.0, -worlds.vehicles.braking_capacity_mps2[:, vehicle]), memory


def in_hole(worlds: Worlds) -> Bools:
    """Three conditions, each of which a tenth of the worlds meets."""
    found: Bools = (worlds.gaps_m < 5.5).all(axis=1) & (worlds.speeds_mps[:, 1] > 21.6)
    return found
