"""Conversion between an action in [-1, 1] and a commanded acceleration.

-1 is full braking capacity, 0 coasts, +1 is full driving capacity; linear on each side.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.game.discrete_actions import checked_indices, index_to_action
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats, Vehicles, real_numbers

LARGEST = float(np.nextafter(np.float32(1.0), np.float32(2.0)))  # 1 plus one float32 step, accepted as a rounded 1


def checked_action(action: ArrayLike, shape: tuple[int, ...], names: str, count: int | None = None) -> Floats:
    """Return the action as float64 of ``shape``; raise ``InvalidInput`` unless it fits and is in [-1, 1].

    Axes of length 1 may be missing or added: a single action may be a number, [1] or [1, 1]. Rounding in a network can
    exceed the bounds by one float32 step; such a value counts as -1 or 1. ``names`` names the vehicles in the message.
    With a ``count``, ``action`` holds indices of ``count`` discrete actions instead (``index_to_action``).
    """
    number = _numbers(action, names) if count is None else index_to_action(action, count, names)
    if number.shape != shape and _longer_axes(number.shape) != _longer_axes(shape):
        raise InvalidInput(f"action of {names}: shape {number.shape}; {shape} is needed")
    good = (number >= -LARGEST) & (number <= LARGEST)
    if not good.all():
        raise InvalidInput(
            f"action of {names}: {float(number[~good].flat[0])!r}; must be in [-1, 1], from full braking to full"
            " driving"
        )
    return number.reshape(shape).clip(-1.0, 1.0)


def own_actions(actions: ArrayLike, names: str, count: int | None = None) -> NDArray[Any]:
    """Return a copy of the actions as an array, which later changes by the caller do not affect.

    Raises ``InvalidInput`` for a list or tensor with values that are not numbers; a NumPy array is copied unchecked.
    ``names``: names of the vehicles, for the message. With a ``count``, they are indices of ``count`` discrete actions.
    """
    if isinstance(actions, np.ndarray):
        return actions.copy()
    return _numbers(actions, names).copy() if count is None else checked_indices(actions, count, names)


def _numbers(action: ArrayLike, names: str) -> Floats:
    try:
        return real_numbers(action)
    except ValueError as error:
        raise InvalidInput(f"action of {names}: {action!r} {error}; a number in [-1, 1] is needed") from None


def _longer_axes(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(length for length in shape if length != 1)


def action_to_command(action: Floats, vehicles: Vehicles, vehicle: int) -> Floats:
    """Return the acceleration that an action commands, [n] m/s2.

    Args:
        action: actions of one vehicle, [n] in [-1, 1].
        vehicles: parameters of the n worlds, with the capacities.
        vehicle: index of the vehicle, from 0.

    """
    braking, driving = vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
    return commands_of(np.ascontiguousarray(action, np.float64), braking, driving)


def command_to_action(command_mps2: Floats, vehicles: Vehicles, vehicle: int) -> Floats:
    """Return the action that commands an acceleration, [n]; clipped to [-1, 1], and 0 if the capacity is 0.

    Args:
        command_mps2: commanded accelerations of one vehicle, [n] m/s2.
        vehicles: parameters of the n worlds, with the capacities.
        vehicle: index of the vehicle, from 0.

    """
    braking, driving = vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
    return _actions(np.ascontiguousarray(command_mps2, np.float64), braking, driving)


@compiled
def command_of(action: float, braking: float, driving: float) -> float:
    """Return the commanded acceleration (m/s2) for an action in [-1, 1].

    ``braking`` and ``driving`` are the largest deceleration and acceleration of the vehicle (m/s2).
    """
    return action * braking if action < 0.0 else action * driving


@compiled
def action_of(command: float, braking: float, driving: float) -> float:
    """Return the action for a command (m/s2); clipped to [-1, 1], and 0 if the capacity is 0.

    ``braking`` and ``driving`` are the largest deceleration and acceleration of the vehicle (m/s2).
    """
    capacity = braking if command < 0.0 else driving
    return min(max(command / capacity, -1.0), 1.0) if capacity > 0.0 else 0.0


@compiled
def commands_of(action: Floats, braking: Floats, driving: Floats) -> Floats:
    """Return the commanded acceleration for the action in every world, [n] m/s2.

    ``action`` [n] is in [-1, 1]; ``braking`` and ``driving`` [n] are the capacities of the vehicle (m/s2).
    """
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
