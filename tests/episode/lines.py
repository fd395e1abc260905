"""States of lines in given places, and the same some time later."""

from __future__ import annotations

from typing import Any

import numpy as np

from ethbrake_marl.episode.state import TIME, State
from ethbrake_marl.episode.step import OUT_ROWS, SAFE_END, Step, at_alert
from ethbrake_marl.motion import layout as at
from ethbrake_marl.motion.interval import FAILED
from tests.motion.lines import driven, lines


def state_of(gaps_m: Any, speeds_mps: Any, **settings: Any) -> State:
    """Worlds at the alert; a vehicle knows all others after its own latency; settings as for ``lines``."""
    line, car = lines(gaps_m, speeds_mps, **settings)
    car[:, at.OWN_LATENCY] = car[:, at.LATENCY]
    know = np.repeat(car[:, at.LATENCY, :, np.newaxis], line.shape[2], axis=2)
    return at_alert(line, car, know, np.zeros((len(line), line.shape[2])), np.arange(len(line)))


def later(state: State, commands_mps2: Any, until_s: float) -> State:
    line, met, _ = driven(state.line, state.car, commands_mps2, state.time_s, until_s)
    assert (met != FAILED).all()
    clock, wanted = state.clock.copy(), state.wanted.copy()
    clock[:, TIME], wanted[:, 1:] = until_s, commands_mps2
    return state._replace(line=line, clock=clock, wanted=wanted)


def step_between(before: State, after: State, *, safe: bool = False) -> Step:
    out = np.zeros((OUT_ROWS, after.n))
    out[0], out[1] = after.harm("first") - before.harm("first"), after.harm("total") - before.harm("total")
    out[SAFE_END] = safe
    return Step(np.zeros((after.n, after.vehicles)), out, float((after.time_s - before.time_s)[0]))
