"""Actions and commands: an action in [-1, 1] becomes a command, and a command an action.

A *command* is an acceleration (m/s2), negative brakes. Action -1 is full braking, 0 is coasting, 1 is full driving; in
between, a command is the action times the capacity in its direction (``motion.forces.capacity``). Below each
kernel stands a function for arrays with the same bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.compiling import kernel
from ethbrake_marl.motion.forces import capacities, capacity
from ethbrake_marl.motion.layout import BRAKING, DRIVING, Floats, Ints

LARGEST_ACTION = float(np.nextafter(np.float32(1.0), np.float32(2.0)))  # counts as 1: the next float32 number


@kernel
def command_of(car, i, action):
    """Command of body i (m/s2) for an ``action``. An action outside [-1, 1] counts as the nearest end of this range."""
    action = min(max(action, -1.0), 1.0)
    return action * capacity(car, BRAKING if action < 0.0 else DRIVING, i)


def commands_of(state: State, bodies: Any, actions: Floats) -> Floats:
    """Commands (m/s2) for the ``actions`` of one body, [n], or of B ``bodies``, [n, B], as in ``command_of``."""
    actions = np.clip(actions, -1.0, 1.0)
    return np.asarray(actions * _capacity_for(state, bodies, actions))


@kernel
def write_commands(car, wanted, learners, actions):
    """Write the commands (m/s2) of one world's ``learners`` [L] to ``wanted`` [N + 1], from their ``actions`` [L]."""
    for j in range(learners.shape[0]):
        wanted[learners[j]] = command_of(car, learners[j], actions[j])


@kernel
def action_of(car, i, command):
    """Action of body i for a ``command`` (m/s2), in [-1, 1]; 0 if the body has no capacity in this direction."""
    most = capacity(car, BRAKING if command < 0.0 else DRIVING, i)
    return min(max(command / most, -1.0), 1.0) if most > 0.0 else 0.0


def actions_of(state: State, bodies: Any, commands: Floats) -> Floats:
    """Actions for the ``commands`` (m/s2) of one body, [n], or of B ``bodies``, [n, B], as in ``action_of``."""
    most = _capacity_for(state, bodies, commands)
    return np.clip(np.divide(commands, most, out=np.zeros_like(most), where=most > 0.0), -1.0, 1.0)


def _capacity_for(state: State, bodies: Any, signs: Floats) -> Floats:
    """Capacity (m/s2) of ``bodies`` to brake where ``signs`` are negative, otherwise to drive.

    ``signs`` are actions or commands; the result has their shape.
    """
    braking, driving = (capacities(state.car, row)[:, bodies] for row in (BRAKING, DRIVING))
    return np.where(signs < 0.0, braking, driving)


def action_array(learners: Ints, actions: Floats | None, n: int) -> Floats:
    """Actions of the L ``learners`` as float64 [n, L]. Raises ``InvalidInput`` for any other type or shape."""
    shape = n, len(learners)
    if not isinstance(actions, np.ndarray) or actions.shape != shape or actions.dtype.kind not in "fiu":
        raise InvalidInput(f"actions = {actions!r:.60}: must be an array of numbers with the shape {shape}")
    return np.ascontiguousarray(actions, np.float64)


def proposal_array(learners: Ints, actions: Floats | None, n: int) -> Floats:
    """Copy of proposed actions, [n, L] in [-1, 1] or NaN. Raises ``InvalidInput`` for a bad type, shape or action."""
    actions = action_array(learners, actions, n)
    for row in actions[(np.abs(actions) > LARGEST_ACTION).any(axis=1)]:
        check_actions(learners, np.where(np.isnan(row), 0.0, row))
    return np.minimum(np.maximum(actions, -1.0), 1.0)


def check_actions(learners: Ints, actions: Floats) -> None:
    """Raise ``InvalidInput`` unless the ``actions`` [L] of the ``learners`` in one world are in [-1, 1]."""
    for body, action in zip(learners, actions, strict=True):
        if not -LARGEST_ACTION <= action <= LARGEST_ACTION:
            raise InvalidInput(
                f"action of vehicle_{body} = {float(action)!r}: must be from -1 (full braking) to 1 (full driving)"
            )
