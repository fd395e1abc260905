"""Features of a neighbour from its messages: ``age``, ``intent``, its plan, and ``PIECE_known`` for each quantity."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np

from ethbrake_marl.episode.plans import CHANGES, COMMANDS, PHASES, PLANS_KEY, no_plans
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.messages.belief import ages_s, known_pieces
from ethbrake_marl.extensions.messages.links import MESSAGES_KEY, PIECES
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.registry import Part

LONGEST_S = 8.0  # time that a feature shows


def age(state: State, body: int, neighbour: int) -> Floats:
    """Age of the newest sample from the neighbour, [n] s; 0 if there is none, and without periodic messages."""
    if MESSAGES_KEY not in state.memories:
        return np.zeros(state.n)
    ages = ages_s(state)[:, body, neighbour]
    return np.where(np.isfinite(ages), ages, 0.0)


def intent(state: State, body: int, neighbour: int) -> Floats:
    """Command that the neighbour chose at its last decision, if its messages contain it; otherwise 0."""
    return state.wanted[:, neighbour] if MESSAGES_KEY in state.memories else np.zeros(state.n)


def _known_feature(piece: str) -> Part:
    def is_known(state: State, body: int, neighbour: int) -> Floats:
        if MESSAGES_KEY not in state.memories:
            return np.full(state.n, float(piece not in ("intent", "plan")))
        return known_pieces(state, body)[:, neighbour, PIECES.index(piece)].astype(np.float64)

    is_known.__doc__ = f"1 if the neighbour's {piece.replace('_', ' ')} is known, from a message or from sensors."
    return _of_neighbour(is_known, "1", 1.0, 0.0, 1.0)


def _plan_command(phase: int) -> Part:
    def command(state: State, body: int, neighbour: int) -> Floats:
        return np.nan_to_num(_plan_of(state, neighbour)[:, COMMANDS][:, phase])

    command.__doc__ = f"Command in phase {phase + 1} of the plan that the neighbour has told; 0 without a plan."
    return _of_neighbour(command, "m/s2", 10.0, -2.0, 2.0)


def _plan_change(phase: int) -> Part:
    def change(state: State, body: int, neighbour: int) -> Floats:
        return np.clip(np.nan_to_num(_plan_of(state, neighbour)[:, CHANGES][:, phase] - state.time_s), 0.0, LONGEST_S)

    change.__doc__ = f"Time until the end of phase {phase + 1} of the neighbour's plan, at most 8 s; 0 without a plan."
    return _of_neighbour(change, "s", 1.0, 0.0, LONGEST_S)


def _plan_of(state: State, neighbour: int) -> Floats:
    return np.asarray(state.memories.get(PLANS_KEY, no_plans(state))[:, :, neighbour])


def _of_neighbour(function: Callable[..., Floats], unit: str, scale: float, low: float, high: float) -> Part:
    return Part(function, unit=unit, scale=scale, low=low, high=high, of="neighbour")


AGE = _of_neighbour(age, "s", 1.0, 0.0, LONGEST_S)
INTENT_FEATURE = _of_neighbour(intent, "m/s2", 10.0, -2.0, 2.0)
PLAN_FEATURES = SimpleNamespace(
    **{f"command_{phase + 1}": _plan_command(phase) for phase in range(PHASES)},
    **{f"change_{phase + 1}": _plan_change(phase) for phase in range(PHASES - 1)},
)
KNOWN = SimpleNamespace(**{piece: _known_feature(piece) for piece in PIECES})
