"""Compiled: the gentlest first meeting of the controlled vehicle with a neighbour at a given time.

Times count from the moment at which the controlled vehicle may act; the front vehicle (leader, l) brakes by then, f is
the controlled one, the rear vehicle (r) coasts to its onset and then brakes. All speeds and gaps are >= 0.
docs/avoidability.md has the proofs.
"""

from __future__ import annotations

import math

from ethbrake_marl.limits.walk import (
    fill_brake_then_drive,
    fill_braking,
    fill_drive_then_brake,
    time_to_limit,
    walk,
)
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.events import solo_motion
from ethbrake_marl.physics.worlds import Floats

# one world when the controlled vehicle may act
GAP_L, V_L, A_L = 0, 1, 2
V_F, A_F, U_F, LIMIT_F = 3, 4, 5, 6
GAP_R, V_R, A_R, ONSET_R = 7, 8, 9, 10
FRONT_SHARE = 11  # m_l / (m_l + m_f)
REAR_SHARE = 12  # m_r / (m_f + m_r)
RESTITUTION = 13
TIME_STEP = 14  # between two decisions (s), the first one now; 0 where commands may change at any time
OBSTACLE = 15  # gap from the leader to an obstacle ahead of it (m), which it does not reach by itself; inf without
WIDTH = 16
FRONT_FIRST, REAR_FIRST = 0, 1
_HALVINGS = 60
_GUARD = 2.0**-46  # of the positions: a way that rounding shortens must not make a meeting look harder
AHEAD_M = 1e-9  # an overlap up to this is no meeting with the other vehicle


@compiled
def leader(at: Floats, time: float) -> tuple[float, float]:
    """Speed and way of the front vehicle, left alone until ``time``."""
    speed, way, _ = solo_motion(at[V_L], -at[A_L], 0.0, math.inf, time)
    return speed, way


@compiled
def follower(at: Floats, time: float) -> tuple[float, float]:
    """Speed and way of the rear vehicle, left alone until ``time``."""
    speed, way, _ = solo_motion(at[V_R], -at[A_R], at[ONSET_R], math.inf, time)
    return speed, way


@compiled_apart
def gentlest_front(at: Floats, time: float) -> tuple[float, float]:
    """Least closing speed of a meeting with the leader at ``time``, and how long it must be driven before braking.

    The slowest way to be there then: drive, then brake.
    """
    v_l, way = leader(at, time)
    place, v, u, a = at[GAP_L] + way, at[V_F], at[U_F], at[A_F]
    cap = time_to_limit(v, u, at[LIMIT_F])
    drive = u if cap > 0.0 else 0.0
    driven = (v + 0.5 * drive * time) * time
    beyond = 0.5 * drive * max(time - cap, 0.0) * max(time - cap, 0.0)
    guard = _GUARD * (driven + place)
    brake = math.sqrt(2.0 * max(driven - beyond - place + guard, 0.0) / a)
    top = v + drive * cap
    if time - brake < cap:
        brake = math.sqrt(2.0 * max(driven - place + guard, 0.0) / (drive + a))
        top = v + drive * (time - brake)
    if brake > time:
        brake, top = time, v
    return max(top - a * brake - v_l, 0.0), time - brake


@compiled
def braked_then_driven(at: Floats, brake: float, time: float) -> tuple[float, float]:
    """Way and speed at ``time`` of one that brakes for ``brake`` (at most to rest), then drives."""
    v, u, a = at[V_F], at[U_F], at[A_F]
    braking = min(brake, v / a)
    slow = max(v - a * brake, 0.0)
    cap = time_to_limit(slow, u, at[LIMIT_F])
    drive = u if cap > 0.0 else 0.0
    left = time - brake
    beyond = max(left - cap, 0.0)
    way = (v - 0.5 * a * braking) * braking + (slow + 0.5 * drive * left) * left - 0.5 * drive * beyond * beyond
    return way, slow + drive * (left - beyond)


@compiled_apart
def braking_to_rear(at: Floats, time: float) -> float:
    """How long it must be braked to be met by the rear vehicle at ``time``, if it is driven from then on."""
    place = follower(at, time)[1] - at[GAP_R]
    low, high = 0.0, time
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if braked_then_driven(at, middle, time)[0] >= place:
            low = middle
        else:
            high = middle
    return low


@compiled_apart
def gentlest_rear(at: Floats, time: float) -> tuple[float, float]:
    """Least closing speed of a meeting with the rear vehicle at ``time``, and how long it must be braked before.

    The fastest way to be there then: brake, then drive. The braking is infinite where that is at its speed limit.
    """
    brake = braking_to_rear(at, time)
    speed = braked_then_driven(at, brake, time)[1]
    return max(follower(at, time)[0] - speed, 0.0), brake if speed < at[LIMIT_F] else math.inf


@compiled_apart
def gentlest(kind: int, at: Floats, time: float) -> tuple[float, float]:
    """``gentlest_front`` or ``gentlest_rear``."""
    return gentlest_front(at, time) if kind == FRONT_FIRST else gentlest_rear(at, time)


@compiled_apart
def meet_front(at: Floats, drive: float, plan: Floats, other: Floats) -> float:
    """When one that drives for ``drive``, then brakes, meets the leader."""
    fill_drive_then_brake(plan, at[V_F], at[U_F], at[LIMIT_F], drive, at[A_F])
    fill_braking(other, 0.0, at[A_L])
    return walk(at[GAP_L], at[V_L], other, at[V_F], plan, math.inf)[1]


@compiled_apart
def meet_rear(at: Floats, brake: float, plan: Floats, other: Floats) -> float:
    """When the rear vehicle meets one that brakes for ``brake``, then drives."""
    fill_brake_then_drive(plan, at[V_F], at[U_F], at[LIMIT_F], brake, at[A_F])
    fill_braking(other, at[ONSET_R], at[A_R])
    return walk(at[GAP_R], at[V_F], plan, at[V_R], other, at[ONSET_R] + at[V_R] / at[A_R])[1]


@compiled_apart
def stays_ahead(at: Floats, drive: float, until: float, plan: Floats, other: Floats) -> bool:
    """Whether one that drives for ``drive``, then brakes, is not met from behind until then."""
    fill_drive_then_brake(plan, at[V_F], at[U_F], at[LIMIT_F], drive, at[A_F])
    fill_braking(other, at[ONSET_R], at[A_R])
    return walk(at[GAP_R], at[V_F], plan, at[V_R], other, until)[0] >= -AHEAD_M


@compiled_apart
def stays_behind(at: Floats, brake: float, until: float, plan: Floats, other: Floats) -> bool:
    """Whether one that brakes for ``brake``, then drives, does not meet the leader until then."""
    fill_brake_then_drive(plan, at[V_F], at[U_F], at[LIMIT_F], brake, at[A_F])
    fill_braking(other, 0.0, at[A_L])
    return walk(at[GAP_L], at[V_L], other, at[V_F], plan, until)[0] >= -AHEAD_M
