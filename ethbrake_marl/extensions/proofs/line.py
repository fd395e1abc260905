"""Columns of the arrays that describe worlds in the proofs, and the motion of a front or rear vehicle that nothing
pushes.

``at`` is the state of one world: a row of such an array, [LINE.WIDTH]. Times are in s after the moment of this state.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND, solo_motion
from ethbrake_marl.first_edition.physics.state import Floats


class _Line(NamedTuple):
    """Index of each column in the arrays that describe worlds at the moment at which the controlled vehicle may act.

    L marks the front vehicle (leader), F the controlled vehicle (follower), R the rear vehicle. V is a speed (m/s), A a
    braking capacity and U a driving capacity (m/s2).
    """

    GAP_L: int = 0  # gap to the front vehicle, m
    V_L: int = 1  # speed of the front vehicle, m/s
    A_L: int = 2  # braking capacity of the front vehicle, m/s2
    V_F: int = 3  # speed of the controlled vehicle, m/s
    A_F: int = 4  # braking capacity of the controlled vehicle, m/s2
    U_F: int = 5  # driving capacity of the controlled vehicle, m/s2
    LIMIT_F: int = 6  # speed limit of the controlled vehicle, m/s
    GAP_R: int = 7  # gap to the rear vehicle, m
    V_R: int = 8  # speed of the rear vehicle, m/s
    A_R: int = 9  # braking capacity of the rear vehicle, m/s2
    ONSET_R: int = 10  # time from which on the rear vehicle brakes, s
    FRONT_SHARE: int = 11  # m_l / (m_l + m_f), with the masses m
    REAR_SHARE: int = 12  # m_r / (m_f + m_r), with the masses m
    RESTITUTION: int = 13  # coefficient of restitution
    TIME_STEP: int = 14  # time between decisions, s; the first decision is now. 0 if commands may change at any time
    WIDTH: int = 15  # number of columns


LINE = _Line()

FRONT_FIRST, REAR_FIRST = 0, 1  # neighbour with which the controlled vehicle has its first contact

HALVINGS = 60

AHEAD_M = 1e-9  # an overlap below this does not count as contact with the other neighbour


@compiled
def leader(at: Floats, time: float) -> tuple[float, float]:
    """Return speed (m/s) and travelled distance (m) of the front vehicle at ``time`` if no other vehicle pushes it."""
    speed, way, _ = solo_motion(at[LINE.V_L], -at[LINE.A_L], 0.0, math.inf, time)
    return speed, way


@compiled
def follower(at: Floats, time: float) -> tuple[float, float]:
    """Return speed (m/s) and travelled distance (m) of the rear vehicle at ``time`` if no other vehicle pushes it."""
    speed, way, _ = solo_motion(at[LINE.V_R], -at[LINE.A_R], at[LINE.ONSET_R], math.inf, time)
    return speed, way


LARGE = 1e6  # m2/s2; more than the harm of any impact

FRONT_BOUND, REAR_BOUND, COMBINED_BOUND, BOUNDS = range(4)

# largest harm of two contacts that do not count as impacts, m2/s2
TOUCH_HARM = 2.0 * BOUND.TOUCH_SPEED_MPS * BOUND.TOUCH_SPEED_MPS

TOUCHING_M = 1e-9  # a smaller gap counts as contact, because of rounding
