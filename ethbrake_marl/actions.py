"""From an action in [-1, 1] to a wanted acceleration, and back.

-1 is full braking capacity, 0 coasts, +1 is full driving capacity; linear on each side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats, Vehicles


def checked_action(action: ArrayLike, shape: tuple[int, ...], names: str) -> Floats:
    """The action as float64, refused with ``InvalidInput`` unless it has ``shape`` and lies in [-1, 1]."""
    try:
        given = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidInput(f"action of {names}: {action!r} is not a number; one in [-1, 1] is needed") from None
    if given.shape != shape:
        raise InvalidInput(f"action of {names}: shape {given.shape}; {shape} is needed")
    good = (given >= -1.0) & (given <= 1.0)
    if not good.all():
        raise InvalidInput(f"action of {names}: {given[~good].flat[0]:g}; must be in [-1, 1]")
    return given


def action_to_command(action: Floats, vehicles: Vehicles, vehicle: int) -> Floats:
    """Wanted signed acceleration of one vehicle, [n] m/s2, for its action [n] in [-1, 1]."""
    capacity = np.where(
        action < 0.0, vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
    )
    command: Floats = action * capacity
    return command


def command_to_action(command_mps2: Floats, vehicles: Vehicles, vehicle: int) -> Floats:
    """The action [n] that asks for ``command_mps2`` [n]; clipped to [-1, 1], 0 where the capacity is 0."""
    capacity = np.where(
        command_mps2 < 0.0, vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
    )
    action: Floats = np.clip(command_mps2 / np.where(capacity > 0.0, capacity, np.inf), -1.0, 1.0)
    return action
