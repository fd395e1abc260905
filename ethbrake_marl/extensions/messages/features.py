"""Features of a neighbour from its messages: ``age``, ``intent``, and ``PIECE_known`` for each quantity."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np

from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.messages.belief import ages_s, known_pieces
from ethbrake_marl.extensions.messages.links import MESSAGES_KEY, PIECES
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.registry import Part


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
            return np.full(state.n, float(piece != "intent"))
        return known_pieces(state, body)[:, neighbour, PIECES.index(piece)].astype(np.float64)

    is_known.__doc__ = f"1 if the neighbour's {piece.replace('_', ' ')} is known, from a message or from sensors."
    return _of_neighbour(is_known, "1", 1.0, 0.0, 1.0)


def _of_neighbour(function: Callable[..., Floats], unit: str, scale: float, low: float, high: float) -> Part:
    return Part(function, unit=unit, scale=scale, low=low, high=high, of="neighbour")


AGE = _of_neighbour(age, "s", 1.0, 0.0, 8.0)
INTENT_FEATURE = _of_neighbour(intent, "m/s2", 10.0, -2.0, 2.0)
KNOWN = SimpleNamespace(**{piece: _known_feature(piece) for piece in PIECES})
