"""Synchronised braking: all vehicles of a platoon begin to brake at the same instant, and equally hard."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.episode.layer import MESSAGES, check_seen
from ethbrake_marl.episode.state import State
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.registry import Part


class Synchronised:
    """Coasts until the slowest vehicle that it knows can brake, then brakes as hard as the weakest one can."""

    name, knows = "synchronised", MESSAGES

    def begin(self, alert: State, body: int) -> None:
        return None

    def act(self, state: State, memory: None, body: int) -> tuple[Floats, None]:
        check_seen(self, state, body)
        known = state.know[:, body, 1:] <= state.time_s[:, np.newaxis]
        known[:, body - 1] = True
        instant = np.where(known & np.isfinite(state.latency_s), state.latency_s, 0.0).max(axis=1)
        weakest = np.where(known, state.braking_capacity_mps2, np.inf).min(axis=1)
        return np.where(state.time_s < instant, 0.0, -weakest), memory


def make_synchronised(argument: None, settings: object) -> Synchronised:
    return Synchronised()


AGENT = Part(
    make_synchronised,
    form="synchronised",
    about="coasts until all vehicles can brake, then brakes as hard as the weakest",
    knows=MESSAGES,
)
