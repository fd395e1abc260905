"""The paper's fixed-step map (eq. dynamics2), in which impacts are detected, and take effect, only at samples.

With the sampling period h, one step of a vehicle with command u, from sample n to sample n + 1, is

    x(n + 1) = x(n) + h f(n) + h^2 / 2 u(n)
    v(n + 1) = f(n) + h u(n)

where f(n) is its speed after the impacts of sample n. Where the gap of a pair is at most 0 and its closing speed above
0, its speeds change by eq. (13). The paper leaves open, and this map resolves:

* Impacts follow each other from the rear pair to the front pair: in the paper f is f1 applied after f3. The harm of the
  front impact is that of the speeds that f3 leaves; the paper's J_harm has those before both.
* The paper's f1 and f3 would also pull vehicles together that overlap and separate. Its text below eq. (13) requires a
  positive closing speed, and so does this map. As in the exact physics, a touch does no harm.
* Samples are at ``tau_2 + n h``, with the latency tau_2 of Vehicle 2. Before the first one worlds move exactly, and
  have no impact, as the paper assumes.
* The command of a step is that in force at its first sample (zero-order hold).
* ``0 <= v <= v_max`` is a constraint on u in the paper: commands are limited so that the speed keeps it at the next
  sample. An impact can leave a negative speed, which the brakes bring back to 0.

Gaps are negative while vehicles overlap; nothing pushes them apart. Source: the paper, section "Optimization Problem".
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.episode.state import FIRST_DECISION, STEPS, TIME, State
from ethbrake_marl.episode.step import first_decision
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.impact import TOUCH_MPS
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    COUNT,
    FAR_M,
    FIRST,
    GAP,
    HIT,
    LATENCY,
    LIMIT,
    MASS,
    RELEASE_RATE,
    RESTITUTION,
    SPEED,
    TOTAL,
    Floats,
)

SHORTEST_STEP_S = 1e-6
ON_SAMPLE = 1e-6  # part of a step: times this close count as one sample, because times are rounded


def exchange(line: Floats, car: Floats) -> None:
    """Let the pairs that overlap and close have their impacts, and count their harm, in place: ``line`` [n, 7, N + 1].

    With the closing speed w: ``v_i+ = v_i + m_{i+1} (1 + e) w / (m_i + m_{i+1})`` and
    ``v_{i+1}+ = v_{i+1} - m_i (1 + e) w / (m_i + m_{i+1})`` (eq. 13).
    """
    speed, gap = line[:, SPEED], line[:, GAP]
    for p in range(speed.shape[1] - 2, 0, -1):
        closing = speed[:, p + 1] - speed[:, p]
        meets = (gap[:, p] <= 0.0) & (closing > 0.0)
        front, rear = car[:, MASS, p], car[:, MASS, p + 1]
        impulse = np.where(meets, (1.0 + car[:, RESTITUTION, p]) * closing / (front + rear), 0.0)
        speed[:, p] += rear * impulse
        speed[:, p + 1] -= front * impulse
        impact = meets & (closing > TOUCH_MPS)
        harm = np.where(impact, closing * closing, 0.0)
        line[:, FIRST, p] += np.where(line[:, HIT, p] == 0.0, harm, 0.0)
        line[:, TOTAL, p] += harm
        line[:, COUNT, p] += impact
        line[:, HIT, p] = np.maximum(line[:, HIT, p], impact)


def sample(state: State, step_s: float) -> State:
    """Return worlds at a sample one sample later: impacts, then a step with ``state.wanted`` [n, N + 1] m/s2."""
    line, clock = state.line.copy(), state.clock.copy()
    exchange(line, state.car)
    now, speed, limit = clock[:, TIME, np.newaxis], line[:, SPEED], state.car[:, LIMIT]
    command = np.where(state.car[:, LATENCY] <= now + ON_SAMPLE * step_s, state.wanted, 0.0)
    braked = np.where(
        speed >= 0.0, np.maximum(speed + command * step_s, 0.0), np.minimum(speed - command * step_s, 0.0)
    )
    driven = np.where(speed < limit, np.minimum(speed + command * step_s, limit), speed)
    after = np.where(command < 0.0, braked, np.where(command > 0.0, driven, speed))
    way = 0.5 * (speed + after) * step_s
    line[:, GAP, 1:-1] += way[:, 1:-1] - way[:, 2:]
    line[:, SPEED] = after
    clock[:, STEPS] += 1.0
    clock[:, TIME] = clock[:, FIRST_DECISION] + clock[:, STEPS] * step_s
    return state._replace(line=line, clock=clock)


def advance_sampled(alert: State, until_s: float, step_s: float = 0.1) -> State:
    """Return worlds, given at the alert, at their first sample at or after ``until_s`` (s since the alert).

    All vehicles hold ``alert.wanted`` [n, N + 1] m/s2. The impacts of the last sample have not happened: the state is
    the paper's s(n). Raises ``InvalidInput`` for a step below 1e-6 s, an end that is no time after the first sample,
    an obstacle, brakes that build up, and worlds with an impact before the first sample.
    """
    if not SHORTEST_STEP_S <= step_s < math.inf:
        raise InvalidInput(f"advance_sampled: step_s = {step_s:g}: must be finite and at least {SHORTEST_STEP_S:g} s")
    start = alert.car[:, LATENCY, 2]
    if not start.max() <= until_s < math.inf:
        raise InvalidInput(f"advance_sampled: until_s = {until_s:g}: must be finite and at least {start.max():g} s")
    obstacle = alert.line[:, GAP, 0] < FAR_M
    builds = np.isfinite(alert.car[:, [BRAKE_RATE, RELEASE_RATE], 1:]).any(axis=(1, 2))
    state = first_decision(alert, np.array([2]), step_s, until_s)
    for wrong, what in (
        (obstacle, "an obstacle"),
        (builds, "brakes that build up"),
        (state.collided, "an impact before Vehicle 2 may act"),
    ):
        if wrong.any():
            raise InvalidInput(f"advance_sampled: row {np.argmax(wrong)} has {what}, which the paper's map has not")
    last = np.ceil((until_s - start) / step_s - ON_SAMPLE)
    while (running := state.steps < last).any():
        state = state.put(running, sample(state.take(running), step_s), donate=True)
    return state
