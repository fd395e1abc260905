"""From an action in [-1, 1] to a wanted acceleration, and back.

-1 is full braking capacity, 0 coasts, +1 is full driving capacity; linear on each side.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats, Vehicles, real_numbers

LARGEST = float(np.nextafter(np.float32(1.0), np.float32(2.0)))  # one float32 step beyond 1 is rounding, and means 1


def checked_action(action: ArrayLike, shape: tuple[int, ...], names: str) -> Floats:
    """The action as float64 of ``shape``, refused with ``InvalidInput`` unless it fits there and lies in [-1, 1].

    Axes of length 1 may be missing or added: a single action may come as a number, as [1] or as [1, 1]. One float32
    step beyond -1 or 1, which a network's last rounding can give, is -1 or 1.
    """
    given = _numbers(action, names)
    if given.shape != shape and _longer_axes(given.shape) != _longer_axes(shape):
        raise InvalidInput(f"action of {names}: shape {given.shape}; {shape} is needed")
    good = (given >= -LARGEST) & (given <= LARGEST)
    if not good.all():
        raise InvalidInput(
            f"action of {names}: {float(given[~good].flat[0])!r}; must be in [-1, 1], from full braking to full driving"
        )
    return given.reshape(shape).clip(-1.0, 1.0)


def own_actions(actions: ArrayLike, names: str) -> NDArray[Any]:
    """A copy of the actions, unchecked where they are an array already; ``InvalidInput`` for what is no number."""
    return actions.copy() if isinstance(actions, np.ndarray) else _numbers(actions, names).copy()


def _numbers(action: ArrayLike, names: str) -> Floats:
    try:
        return real_numbers(action)
    except ValueError as error:
        raise InvalidInput(f"action of {names}: {action!r} {error}; a number in [-1, 1] is needed") from None


def _longer_axes(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(length for length in shape if length != 1)


def action_to_command(action: Floats, vehicles: Vehicles, vehicle: int) -> Floats:
    """Wanted signed acceleration of one vehicle, [n] m/s2, for its action [n] in [-1, 1]."""
    braking, driving = vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
    return commands_of(np.ascontiguousarray(action, np.float64), braking, driving)


def command_to_action(command_mps2: Floats, vehicles: Vehicles, vehicle: int) -> Floats:
    """The action [n] that asks for ``command_mps2`` [n]; clipped to [-1, 1], 0 where the capacity is 0."""
    braking, driving = vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
    return _actions(np.ascontiguousarray(command_mps2, np.float64), braking, driving)


@compiled
def command_of(action: float, braking: float, driving: float) -> float:
    """Wanted signed acceleration (m/s2) for an action, given the two capacities (m/s2)."""
    return action * braking if action < 0.0 else action * driving


@compiled
def action_of(command: float, braking: float, driving: float) -> float:
    """The action that asks for a command (m/s2); clipped to [-1, 1], 0 where the capacity is 0."""
    capacity = braking if command < 0.0 else driving
    return min(max(command / capacity, -1.0), 1.0) if capacity > 0.0 else 0.0


@compiled
def commands_of(action: Floats, braking: Floats, driving: Floats) -> Floats:
    """``command_of`` in every world, [n] m/s2."""
    command = np.empty(action.shape[0])
    for k in range(action.shape[0]):
        command[k] = command_of(action[k], braking[k], driving[k])
    return command


@compiled
def _actions(command: Floats, braking: Floats, driving: Floats) -> Floats:
    action = np.empty(command.shape[0])
    for k in range(command.shape[0]):
        action[k] = action_of(command[k], braking[k], driving[k])
    return action
