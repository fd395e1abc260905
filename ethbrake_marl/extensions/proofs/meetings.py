"""Compute the gentlest first contact (smallest closing speed) of the controlled vehicle with a neighbour at a given
time.

Times are measured from the moment at which the controlled vehicle may act. The front vehicle already brakes at time 0.
The rear vehicle coasts until its latency has elapsed, and then brakes. All speeds and gaps are at least 0.
docs/internals/proofs/lower-bound.md has the proofs.

``proofs/__init__.py`` explains the arguments that functions share. ``drive`` is how long (s) a vehicle drives before it
brakes, and ``brake`` how long (s) a vehicle brakes before it drives.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.line import AHEAD_M, FRONT_FIRST, HALVINGS, LINE, follower, leader
from ethbrake_marl.extensions.proofs.plans import (
    fill_brake_then_drive,
    fill_braking,
    fill_drive_then_brake,
    time_to_limit,
    walk,
)
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Floats

_GUARD = 2.0**-46  # largest relative rounding error of positions; closing speeds are lowered accordingly


@compiled(apart=True)
def gentlest_front(at: Floats, time: float) -> tuple[float, float]:
    """Return the smallest closing speed (m/s) of a contact with the front vehicle at ``time``, and how long (s) the
    controlled vehicle drives before it brakes.

    The controlled vehicle reaches the place of the contact at ``time`` with the smallest possible speed if it drives
    first and then brakes.
    """
    v_l, way = leader(at, time)
    place, v, u, a = at[LINE.GAP_L] + way, at[LINE.V_F], at[LINE.U_F], at[LINE.A_F]
    cap = time_to_limit(v, u, at[LINE.LIMIT_F])
    drive = u if cap > 0.0 else 0.0
    travelled = (v + 0.5 * drive * time) * time
    beyond = 0.5 * drive * max(time - cap, 0.0) * max(time - cap, 0.0)
    guard = _GUARD * (travelled + place)
    brake = math.sqrt(2.0 * max(travelled - beyond - place + guard, 0.0) / a)
    top = v + drive * cap
    if time - brake < cap:
        brake = math.sqrt(2.0 * max(travelled - place + guard, 0.0) / (drive + a))
        top = v + drive * (time - brake)
    if brake > time:
        brake, top = time, v
    return max(top - a * brake - v_l, 0.0), time - brake


@compiled
def braked_then_driven(at: Floats, brake: float, time: float) -> tuple[float, float]:
    """Return travelled distance (m) and speed (m/s) of the controlled vehicle at ``time`` if it brakes first and then
    drives.

    A vehicle that brakes to rest waits there until it drives.
    """
    v, u, a = at[LINE.V_F], at[LINE.U_F], at[LINE.A_F]
    braking = min(brake, v / a)
    slow = max(v - a * brake, 0.0)
    cap = time_to_limit(slow, u, at[LINE.LIMIT_F])
    drive = u if cap > 0.0 else 0.0
    left = time - brake
    beyond = max(left - cap, 0.0)
    way = (v - 0.5 * a * braking) * braking + (slow + 0.5 * drive * left) * left - 0.5 * drive * beyond * beyond
    return way, slow + drive * (left - beyond)


@compiled(apart=True)
def braking_to_rear(at: Floats, time: float) -> float:
    """Return how long (s) the controlled vehicle must brake before it drives, so that it has contact with the rear
    vehicle at ``time``.
    """
    place = follower(at, time)[1] - at[LINE.GAP_R]
    low, high = 0.0, time
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if braked_then_driven(at, middle, time)[0] >= place:
            low = middle
        else:
            high = middle
    return low


@compiled(apart=True)
def gentlest_rear(at: Floats, time: float) -> tuple[float, float]:
    """Return the smallest closing speed (m/s) of a contact with the rear vehicle at ``time``, and how long (s) the
    controlled vehicle brakes before it drives.

    The controlled vehicle reaches the place of the contact at ``time`` with the largest possible speed if it brakes
    first and then drives. The duration of the braking is returned as infinite if the vehicle reaches its speed limit by
    ``time``.
    """
    brake = braking_to_rear(at, time)
    speed = braked_then_driven(at, brake, time)[1]
    return max(follower(at, time)[0] - speed, 0.0), brake if speed < at[LINE.LIMIT_F] else math.inf


@compiled(apart=True)
def gentlest(kind: int, at: Floats, time: float) -> tuple[float, float]:
    """Return the smallest closing speed (m/s) of a first contact at ``time``, and how long (s) the controlled vehicle
    drives or brakes first.
    """
    return gentlest_front(at, time) if kind == FRONT_FIRST else gentlest_rear(at, time)


@compiled(apart=True)
def meet_front(at: Floats, drive: float, plan: Floats, other: Floats) -> float:
    """Return the time (s) at which a controlled vehicle that drives first and then brakes has contact with the front
    vehicle.

    The result is infinite if there is no contact. If ``drive`` is infinite, the vehicle never brakes.
    """
    fill_drive_then_brake(plan, at[LINE.V_F], at[LINE.U_F], at[LINE.LIMIT_F], drive, at[LINE.A_F])
    fill_braking(other, 0.0, at[LINE.A_L])
    return walk(at[LINE.GAP_L], at[LINE.V_L], other, at[LINE.V_F], plan, math.inf)[1]


@compiled(apart=True)
def meet_rear(at: Floats, brake: float, plan: Floats, other: Floats) -> float:
    """Return the time (s) at which a controlled vehicle that brakes first and then drives has contact with the rear
    vehicle.

    The result is infinite if there is no contact.
    """
    fill_brake_then_drive(plan, at[LINE.V_F], at[LINE.U_F], at[LINE.LIMIT_F], brake, at[LINE.A_F])
    fill_braking(other, at[LINE.ONSET_R], at[LINE.A_R])
    return walk(
        at[LINE.GAP_R], at[LINE.V_F], plan, at[LINE.V_R], other, at[LINE.ONSET_R] + at[LINE.V_R] / at[LINE.A_R]
    )[1]


@compiled(apart=True)
def stays_ahead(at: Floats, drive: float, until: float, plan: Floats, other: Floats) -> bool:
    """Return whether a controlled vehicle that drives first and then brakes avoids contact with the rear vehicle until
    ``until`` (s).
    """
    fill_drive_then_brake(plan, at[LINE.V_F], at[LINE.U_F], at[LINE.LIMIT_F], drive, at[LINE.A_F])
    fill_braking(other, at[LINE.ONSET_R], at[LINE.A_R])
    return walk(at[LINE.GAP_R], at[LINE.V_F], plan, at[LINE.V_R], other, until)[0] >= -AHEAD_M


@compiled(apart=True)
def stays_behind(at: Floats, brake: float, until: float, plan: Floats, other: Floats) -> bool:
    """Return whether a controlled vehicle that brakes first and then drives avoids contact with the front vehicle until
    ``until`` (s).
    """
    fill_brake_then_drive(plan, at[LINE.V_F], at[LINE.U_F], at[LINE.LIMIT_F], brake, at[LINE.A_F])
    fill_braking(other, 0.0, at[LINE.A_L])
    return walk(at[LINE.GAP_L], at[LINE.V_L], other, at[LINE.V_F], plan, until)[0] >= -AHEAD_M
