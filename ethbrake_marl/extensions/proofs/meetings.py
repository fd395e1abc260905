"""The gentlest first contact (smallest closing speed) of the controlled vehicle with a neighbour at a given time.

The front vehicle already brakes; the rear vehicle coasts until its latency has elapsed, then brakes. ``drive`` is how
long (s) a vehicle drives before it brakes, ``brake`` how long it brakes before it drives. Times count from the moment
at which the controlled vehicle may act. Proofs: docs/internals/proofs/lower-bound.md.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.line import (
    A_F,
    A_L,
    A_R,
    AHEAD_M,
    FRONT_FIRST,
    GAP_L,
    GAP_R,
    HALVINGS,
    LIMIT_F,
    ONSET_R,
    U_F,
    V_F,
    V_L,
    V_R,
    follower,
    leader,
)
from ethbrake_marl.extensions.proofs.plans import brake_then_drive, braking, drive_then_brake, time_to_limit, walk
from ethbrake_marl.motion.compiling import kernel, large

_GUARD = 2.0**-46  # largest relative rounding error of positions; closing speeds are lowered accordingly


@large
def gentlest_front(at, time):
    """Smallest closing speed (m/s) of a contact with the front vehicle at ``time``, and its ``drive``.

    To be at a place at a time with the smallest speed, drive first (for ``drive`` s) and then brake. ``at``: one world
    (``line``).
    """
    v_l, way = leader(at, time)
    place, v, u, a = at[GAP_L] + way, at[V_F], at[U_F], at[A_F]
    cap = time_to_limit(v, u, at[LIMIT_F])
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


@kernel
def braked_then_driven(at, brake, time):
    """Way (m) and speed (m/s) at ``time`` if the vehicle brakes first, at most to rest, and then drives.

    ``brake``: how long it brakes (s). ``at``: one world (``line``).
    """
    v, u, a = at[V_F], at[U_F], at[A_F]
    braked = min(brake, v / a)
    slow = max(v - a * brake, 0.0)
    cap = time_to_limit(slow, u, at[LIMIT_F])
    drive = u if cap > 0.0 else 0.0
    driving_time = time - brake
    beyond = max(driving_time - cap, 0.0)
    way = (
        (v - 0.5 * a * braked) * braked
        + (slow + 0.5 * drive * driving_time) * driving_time
        - 0.5 * drive * beyond * beyond
    )
    return way, slow + drive * (driving_time - beyond)


@large
def braking_to_rear(at, time):
    """Time (s) for which the vehicle must brake first to be in contact with the rear vehicle at ``time`` (s).

    Then it drives. ``at``: one world (``line``).
    """
    place = follower(at, time)[1] - at[GAP_R]
    low, high = 0.0, time
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if braked_then_driven(at, middle, time)[0] >= place:
            low = middle
        else:
            high = middle
    return low


@large
def gentlest(kind, at, time):
    """Smallest closing speed (m/s) of a first contact at ``time``, and its ``drive`` or ``brake`` (s).

    To be at a place at a time with the largest speed, brake first and then drive. ``brake`` is infinite if the vehicle
    reaches its speed limit by then. ``kind``, ``at``: see ``proofs``.
    """
    if kind == FRONT_FIRST:
        return gentlest_front(at, time)
    brake = braking_to_rear(at, time)
    speed = braked_then_driven(at, brake, time)[1]
    return max(follower(at, time)[0] - speed, 0.0), brake if speed < at[LIMIT_F] else math.inf


@kernel
def behind_leader(at, plan, until):
    return walk(at[GAP_L], at[V_L], braking(0.0, at[A_L]), at[V_F], plan, until)


@kernel
def before_rear(at, plan, until):
    return walk(at[GAP_R], at[V_F], plan, at[V_R], braking(at[ONSET_R], at[A_R]), until)


@kernel
def driving_first(at, drive):
    return drive_then_brake(at[V_F], at[U_F], at[LIMIT_F], drive, at[A_F])


@kernel
def braking_first(at, brake):
    return brake_then_drive(at[V_F], at[U_F], at[LIMIT_F], brake, at[A_F])


@kernel
def rest_of_rear(at):
    """Time (s) at which the rear vehicle of the world ``at`` comes to rest if nothing pushes it."""
    return at[ONSET_R] + at[V_R] / at[A_R]


@large
def meet_front(at, drive):
    """Time (s) at which a vehicle that drives first, for ``drive`` s, meets the front vehicle; infinite: never.

    Then it brakes. ``at``: one world (``line``).
    """
    return behind_leader(at, driving_first(at, drive), math.inf)[1]


@large
def meet_rear(at, brake):
    """Time (s) at which a vehicle that brakes first, for ``brake`` s, meets the rear vehicle; infinite: never.

    Then it drives. ``at``: one world (``line``).
    """
    return before_rear(at, braking_first(at, brake), rest_of_rear(at))[1]


@large
def stays_ahead(at, drive, until):
    """Whether a vehicle that drives for ``drive`` s, then brakes, avoids the rear one until ``until`` (s).

    ``at``: one world (``line``).
    """
    return before_rear(at, driving_first(at, drive), until)[0] >= -AHEAD_M


@large
def stays_behind(at, brake, until):
    """Whether a vehicle that brakes for ``brake`` s, then drives, avoids the front one until ``until`` (s).

    ``at``: one world (``line``).
    """
    return behind_leader(at, braking_first(at, brake), until)[0] >= -AHEAD_M
