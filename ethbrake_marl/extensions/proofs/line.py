"""One world as the proofs see it: the controlled vehicle and its two neighbours, in one row of numbers.

In the columns of ``at``, L is the front vehicle (leader), F the controlled vehicle (follower), R the rear vehicle; V is
a speed (m/s), A a braking capacity and U a driving capacity (m/s2). Times count from the moment of the state. A missing
neighbour is infinitely far away.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.episode.state import State
from ethbrake_marl.motion.compiling import kernel
from ethbrake_marl.motion.forces import capacities
from ethbrake_marl.motion.impact import TOUCH_MPS
from ethbrake_marl.motion.interval import solo
from ethbrake_marl.motion.layout import BRAKING, DRIVING, FAR_M, GAP, LATENCY, LIMIT, MASS, SPEED, Floats

GAP_L, V_L, A_L, ONSET_L = range(4)  # gap to the front vehicle (m); ONSET: time from which a vehicle may act (s)
V_F, A_F, U_F, LIMIT_F, ONSET_F = range(4, 9)  # LIMIT: speed up to which it drives (m/s)
GAP_R, V_R, A_R, ONSET_R = range(9, 13)  # gap to the rear vehicle (m)
FRONT_SHARE = 13  # m_l / (m_l + m_f), with the masses m
REAR_SHARE = 14  # m_r / (m_f + m_r)
BOUNCE = 15  # coefficient of restitution
TIME_STEP = 16  # time between decisions, the first of which is now (s); 0: commands may change at any time
LINE_COLUMNS = 17

FRONT_FIRST, REAR_FIRST = 0.0, 1.0  # neighbour of the first contact; floats: numba compiles again for each integer

AHEAD_M = 1e-9  # an overlap below this is no contact with the other neighbour
TOUCHING_M = 1e-9  # a smaller gap counts as contact, because of rounding
TOUCH_HARM = 2.0 * TOUCH_MPS * TOUCH_MPS  # largest harm of two contacts that are no impacts (m2/s2)
LARGE = 1e6  # more than the harm of any impact (m2/s2)
HALVINGS = 60


@kernel
def leader(at, time):
    """Speed (m/s) and way (m) of the front vehicle at ``time`` if it brakes fully from now on and nothing pushes it.

    ``time``: s from now. ``at``: one world (columns: top of this file).
    """
    speed, way, _ = solo(at[V_L], -at[A_L], 0.0, math.inf, time)
    return speed, way


@kernel
def follower(at, time):
    """Speed (m/s) and way (m) of the rear vehicle at ``time`` (s from now) if nothing pushes it.

    It coasts until its latency has elapsed, then brakes fully. ``at``: one world (columns: top of this file).
    """
    speed, way, _ = solo(at[V_R], -at[A_R], at[ONSET_R], math.inf, time)
    return speed, way


def rows_of(state: State, body: int, time_step_s: float = 0.0) -> Floats:
    """Worlds as the proofs use them: one row of numbers for each world, [n, LINE_COLUMNS].

    ``body``: the controlled vehicle (1: Vehicle 1). ``time_step_s``: time between decisions; 0: commands may change at
    any time.
    """
    line, car, at = state.line, state.car, np.zeros((state.n, LINE_COLUMNS))
    onset = np.maximum(car[:, LATENCY] - state.time_s[:, np.newaxis], 0.0)
    at[:, [GAP_L, GAP_R]] = FAR_M
    braking, driving = (capacities(car, row) for row in (BRAKING, DRIVING))
    at[:, [V_F, A_F, U_F]] = np.stack([line[:, SPEED, body], braking[:, body], driving[:, body]], axis=1)
    at[:, LIMIT_F], at[:, ONSET_F] = car[:, LIMIT, body], onset[:, body]
    at[:, BOUNCE], at[:, TIME_STEP] = state.restitution, time_step_s
    sides = [(body - 1, body - 1, GAP_L, FRONT_SHARE), (body + 1, body, GAP_R, REAR_SHARE)]
    for neighbour, pair, first, share in sides:
        if 1 <= neighbour <= state.vehicles:
            columns = line[:, GAP, pair], line[:, SPEED, neighbour], braking[:, neighbour], onset[:, neighbour]
            at[:, first : first + 4] = np.stack(columns, axis=1)
            at[:, share] = car[:, MASS, neighbour] / (car[:, MASS, neighbour] + car[:, MASS, body])
    return at
