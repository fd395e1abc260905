"""Conversion between actions in [-1, 1] and commanded accelerations.

Action -1 means full braking, 0 coasting and +1 full driving. The command is linear in the action from -1 to 0 and from
0 to 1.

Arguments that several functions share: ``names`` are the names of the vehicles that act, for error messages. If
actions are discrete, ``count`` is their number, and each action is an index (``discrete_actions.index_to_action``);
None: actions are continuous. ``vehicle`` is an index (0 = front). ``braking`` is the largest deceleration of a vehicle,
and ``driving`` its largest forward acceleration, m/s2.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.game.discrete_actions import checked_indices, index_to_action
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Floats, Vehicles, real_numbers

# largest absolute value of an action that is accepted: the next float32 number above 1, which counts as 1
LARGEST = float(np.nextafter(np.float32(1.0), np.float32(2.0)))


def checked_action(action: ArrayLike, shape: tuple[int, ...], names: str, count: int | None = None) -> Floats:
    """Return the action as float64 of shape ``shape``; raise ``InvalidInput`` for a wrong shape or invalid values.

    Axes of length 1 may be missing or added: a single action may be a number, [1] or [1, 1]. Values outside [-1, 1] are
    invalid; only the next float32 number above 1 or below -1 is accepted, and clipped.
    """
    number = _numbers(action, names) if count is None else index_to_action(action, count, names)
    if number.shape != shape and _longer_axes(number.shape) != _longer_axes(shape):
        raise InvalidInput(f"action of {names}: has shape {number.shape}; must have shape {shape}")
    good = (number >= -LARGEST) & (number <= LARGEST)
    if not good.all():
        raise InvalidInput(
            f"action of {names} = {float(number[~good].flat[0])!r}: must be from -1 (full braking) to 1 (full driving)"
        )
    return number.reshape(shape).clip(-1.0, 1.0)


def own_actions(actions: ArrayLike, names: str, count: int | None = None) -> NDArray[Any]:
    """Return a copy of the actions as an array, which stays the same if the caller changes ``actions`` later.

    A NumPy array is copied without checks. Raises ``InvalidInput`` if a list or tensor contains values that are not
    numbers or, if ``count`` is given, invalid indices.
    """
    if isinstance(actions, np.ndarray):
        return actions.copy()
    return _numbers(actions, names).copy() if count is None else checked_indices(actions, count, names)


def _numbers(action: ArrayLike, names: str) -> Floats:
    try:
        return real_numbers(action)
    except ValueError as error:
        raise InvalidInput(f"action of {names}: {action!r} {error}; must be a number in [-1, 1]") from None


def _longer_axes(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(length for length in shape if length != 1)


def action_to_command(action: Floats, vehicles: Vehicles, vehicle: int) -> Floats:
    """Return the commanded acceleration of a vehicle, [n] m/s2, for its action in every world, [n] in [-1, 1]."""
    braking, driving = vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
    return commands_of(np.ascontiguousarray(action, np.float64), braking, driving)


def command_to_action(command_mps2: Floats, vehicles: Vehicles, vehicle: int) -> Floats:
    """Return the action that corresponds to a vehicle's command in each world, [n], clipped to [-1, 1].

    The action is 0 if the vehicle has no capacity in the direction of the command (braking or driving).
    """
    braking, driving = vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
    return _actions(np.ascontiguousarray(command_mps2, np.float64), braking, driving)


@compiled
def command_of(action: float, braking: float, driving: float) -> float:
    """Return the commanded acceleration (m/s2) for an action in [-1, 1]."""
    return action * braking if action < 0.0 else action * driving


@compiled
def action_of(command: float, braking: float, driving: float) -> float:
    """Return the action for a command (m/s2), clipped to [-1, 1]; 0 if the needed capacity is 0.

    The needed capacity is the braking capacity for a command below 0, otherwise the driving capacity.
    """
    capacity = braking if command < 0.0 else driving
    return min(max(command / capacity, -1.0), 1.0) if capacity > 0.0 else 0.0


@compiled
def commands_of(action: Floats, braking: Floats, driving: Floats) -> Floats:
    """Return the commanded acceleration of a vehicle for its action in every world, [n] m/s2; all arguments are [n]."""
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
