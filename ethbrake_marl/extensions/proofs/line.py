"""One world as the proofs represent it, and the motion of its two neighbours without contact."""

from __future__ import annotations

import math
from typing import NamedTuple

from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import BOUND, solo_motion
from ethbrake_marl.physics.state import Floats


class _Line(NamedTuple):
    """Columns of one world at the moment when the controlled vehicle (follower, F) may act.

    L is the front vehicle (leader), R the rear vehicle. V are speeds, A braking and U driving capacities.
    """

    GAP_L: int = 0
    V_L: int = 1
    A_L: int = 2
    V_F: int = 3
    A_F: int = 4
    U_F: int = 5
    LIMIT_F: int = 6
    GAP_R: int = 7
    V_R: int = 8
    A_R: int = 9
    ONSET_R: int = 10
    FRONT_SHARE: int = 11  # m_l / (m_l + m_f)
    REAR_SHARE: int = 12  # m_r / (m_f + m_r)
    RESTITUTION: int = 13
    TIME_STEP: int = 14  # time between decisions (s), the first one now; 0 if commands may change at any time
    OBSTACLE: int = (
        15  # gap from the leader to an obstacle ahead (m), which it does not reach by itself; infinite without
    )
    # only with brake build-up: accelerations in force (m/s2); rates at which they fall and rise (m/s3)
    FORCE_L: int = 16
    FALL_L: int = 17
    FORCE_F: int = 18
    FALL_F: int = 19
    RISE_F: int = 20
    FORCE_R: int = 21
    FALL_R: int = 22
    UNTIL: int = 23  # horizon (s); 0 if unknown
    WALL: int = 24  # OBSTACLE if an impact with it counts and the rear vehicle brakes fully; else 0
    WIDTH: int = 25


LINE = _Line()

FRONT_FIRST, REAR_FIRST = 0, 1  # kind of a meeting: which neighbour the controlled vehicle meets first

RAMPED_FRONT, RAMPED_REAR = 2, 3  # the same with brake build-up

HALVINGS = 60

AHEAD_M = 1e-9  # tolerance: a smaller overlap is no meeting with the other vehicle


@compiled
def leader(at: Floats, time: float) -> tuple[float, float]:
    """Return speed and distance of the front vehicle at ``time`` if nobody touches it."""
    speed, way, _ = solo_motion(at[LINE.V_L], -at[LINE.A_L], 0.0, math.inf, time)
    return speed, way


@compiled
def follower(at: Floats, time: float) -> tuple[float, float]:
    """Return speed and distance of the rear vehicle at ``time`` if nobody touches it."""
    speed, way, _ = solo_motion(at[LINE.V_R], -at[LINE.A_R], at[LINE.ONSET_R], math.inf, time)
    return speed, way


LARGE = 1e6  # m2/s2; more than the harm of any impact

FRONT_BOUND, REAR_BOUND, COMBINED_BOUND, BOUNDS = range(4)

TOUCH_HARM = 2.0 * BOUND.TOUCH_SPEED_MPS * BOUND.TOUCH_SPEED_MPS  # harm that two contacts without impact may hide

TOUCHING_M = 1e-9  # a smaller gap is a contact, up to rounding

FORCE_HALVINGS, ROUGHLY = 12, 20  # halvings of a force, and of a time, that need not be exact
