"""The gentlest first contact (smallest closing speed) of the controlled vehicle with a neighbour at a given time.

The front vehicle already brakes; the rear vehicle coasts until its latency has elapsed, then brakes. ``drive`` is the
time (s) for which a vehicle drives before it brakes, ``brake`` the time for which it brakes before it drives. Times
count from the moment at which the controlled vehicle may act. Proofs: docs/proofs/harm.md.
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
    """Smallest closing speed (m/s) of a contact with the front vehicle at ``time`` (s), and the drive before it (s).

    To be at a place at a time with the smallest speed, a vehicle drives first and then brakes; the second result is how
    long it drives. ``at``: one world (columns: ``proofs/line.py``).
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
    """Way (m) and speed (m/s) at ``time`` (s) of a vehicle that brakes first, at most to rest, and then drives.

    ``brake``: duration of the braking (s). ``at``: one world (columns: ``proofs/line.py``).
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
    """Time (s) for which the controlled vehicle must brake, before it drives, to meet the rear vehicle at ``time`` (s).

    ``at``: one world (columns: ``proofs/line.py``).
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
    """Smallest closing speed (m/s) of a first contact at ``time`` (s), and the duration of the first phase (s).

    Before a contact in front, the vehicle drives and then brakes: it arrives with the smallest possible speed. Before a
    contact behind, the vehicle brakes and then drives: it arrives with the largest possible speed. If this is its speed
    limit, the duration is infinite. ``kind``, ``at``: package ``proofs``.
    """
    if kind == FRONT_FIRST:
        return gentlest_front(at, time)
    brake = braking_to_rear(at, time)
    speed = braked_then_driven(at, brake, time)[1]
    return max(follower(at, time)[0] - speed, 0.0), brake if speed < at[LIMIT_F] else math.inf


@kernel
def behind_leader(at, plan, until):
    """Smallest gap (m) to the front vehicle under a plan, time (s) and squared closing speed (m2/s2) of the contact.

    ``at``: one world (columns: ``proofs/line.py``). ``plan``: of the controlled vehicle, until ``until`` (s); see
    ``plans.walk``.
    """
    return walk(at[GAP_L], at[V_L], braking(0.0, at[A_L]), at[V_F], plan, until)


@kernel
def before_rear(at, plan, until):
    """Smallest gap (m) to the rear vehicle under a plan, time (s) and squared closing speed (m2/s2) of the contact.

    Arguments: as for ``behind_leader``.
    """
    return walk(at[GAP_R], at[V_F], plan, at[V_R], braking(at[ONSET_R], at[A_R]), until)


@kernel
def driving_first(at, drive):
    return drive_then_brake(at[V_F], at[U_F], at[LIMIT_F], drive, at[A_F])


@kernel
def braking_first(at, brake):
    return brake_then_drive(at[V_F], at[U_F], at[LIMIT_F], brake, at[A_F])


@kernel
def rest_of_rear(at):
    """Time (s) at which the rear vehicle comes to rest if nothing pushes it.

    ``at``: one world (columns: ``proofs/line.py``).
    """
    return at[ONSET_R] + at[V_R] / at[A_R]


@large
def meet_front(at, drive):
    """Time (s) at which a vehicle that drives for ``drive`` s, then brakes, meets the front vehicle; infinite: never.

    ``at``: one world (columns: ``proofs/line.py``).
    """
    return behind_leader(at, driving_first(at, drive), math.inf)[1]


@large
def meet_rear(at, brake):
    """Time (s) at which the rear vehicle meets a vehicle that brakes for ``brake`` s, then drives; infinite: never.

    ``at``: one world (columns: ``proofs/line.py``).
    """
    return before_rear(at, braking_first(at, brake), rest_of_rear(at))[1]


@large
def stays_ahead(at, drive, until):
    """Whether a vehicle that drives for ``drive`` s, then brakes, avoids the rear vehicle until ``until`` (s).

    ``at``: one world (columns: ``proofs/line.py``).
    """
    return before_rear(at, driving_first(at, drive), until)[0] >= -AHEAD_M


@large
def stays_behind(at, brake, until):
    """Whether a vehicle that brakes for ``brake`` s, then drives, avoids the front vehicle until ``until`` (s).

    ``at``: one world (columns: ``proofs/line.py``).
    """
    return behind_leader(at, braking_first(at, brake), until)[0] >= -AHEAD_M
