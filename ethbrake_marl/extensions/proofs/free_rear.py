"""Find the smallest harm over all first contacts of the controlled vehicle with a rear vehicle that may do anything.

Whatever the rear vehicle does, it is at least as far ahead and at least as fast as if it braked fully. The *lead* of
the rear vehicle is the distance (m) by which it is farther ahead than under full braking. The search describes a first
contact by its time, its lead and its closing speed. A *cell* is a set of first contacts: a range of times, a range of
leads and a range of closing speeds. The search halves cells until the smallest bound of any cell is close to the
smallest harm that the search has reached. docs/internals/proofs/team-bound.md has the proof.

Arguments that several functions share, in addition to those in ``proofs/__init__.py``:

- ``near``, ``far``: smallest and largest lead, m.
- ``since``: time from which on the rear vehicle may brake less than fully, s.
- ``power``: largest possible value of the rear vehicle's acceleration minus its acceleration under full braking, m/s2;
  infinite if other vehicles may push the rear vehicle.
- ``search``: ``since``, ``power``, ``floor`` and ``best`` in the columns SINCE, POWER, FLOOR and BEST, [SEARCH]. The
  functions lower BEST when they reach a smaller harm.
- ``moved``: working memory for a changed copy of ``at``, [LINE.WIDTH]; overwritten.
- ``heap``: heap of cells, [SEARCHED + 4, HEAP_WIDTH], of which the first ``count`` rows are used; changed in place.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.branch_and_bound import (
    EARLY,
    FAR,
    HARD,
    HARM,
    LATE,
    NEAR,
    SOFT,
    drop_first,
    room_for,
)
from ethbrake_marl.extensions.proofs.followers import braking_after, pushed_by_rear
from ethbrake_marl.extensions.proofs.line import LINE, follower, leader
from ethbrake_marl.extensions.proofs.meetings import braked_then_driven, braking_to_rear
from ethbrake_marl.extensions.proofs.obstacle import CELL
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import solo_motion
from ethbrake_marl.physics.state import Floats

# Columns of a search: SINCE and POWER are arguments of ``gained``; FLOOR is the bound of the front pair alone; BEST is
# the smallest harm of a first contact so far.
SINCE, POWER, FLOOR, BEST, SEARCH = range(5)

SEARCHED = 400  # largest number of divisions

_SHORT_S = 1e-3  # smallest time in a denominator


@compiled
def gained(near: float, time: float, since: float, power: float) -> float:
    """Return the smallest possible difference (m/s) between the rear vehicle's speed at ``time`` and the lower speed
    that this vehicle would have at ``time`` under full braking.
    """
    if near <= 0.0 or time <= since:
        return 0.0
    span = time - since
    if power == math.inf:
        return near / span
    return float(power * (span - math.sqrt(max(span * span - 2.0 * near / power, 0.0))))


@compiled
def behind_full_braking(at: Floats, early: float, late: float) -> float:
    """Return the gap (m) between the controlled vehicle's position at ``early`` (s) and the rear vehicle's position at
    ``late`` (s) if both brake fully.

    A negative gap means an overlap: the rear vehicle's position at ``late`` is ahead of the controlled vehicle's
    position at ``early`` by this distance.
    """
    return float(
        at[LINE.GAP_R] + solo_motion(at[LINE.V_F], -at[LINE.A_F], 0.0, math.inf, early)[1] - follower(at, late)[1]
    )


@compiled
def soft_behind(at: Floats, early: float, late: float, near: float, far: float, since: float, power: float) -> float:
    """Return the smallest closing speed (m/s) of all first contacts with the rear vehicle in a range of times and
    leads.
    """
    faster = gained(near, late, since, power)
    # the controlled vehicle arrives at that place with the largest speed if it brakes first and then drives
    brake = braking_to_rear(at, late, far + faster * (late - early))
    closing = follower(at, late)[0] - braked_then_driven(at, brake, late)[1]
    return max(closing + faster, 0.0)


@compiled(apart=True)
def after_behind(
    at: Floats, early: float, late: float, near: float, far: float, hard: float, faster: float, moved: Floats,
    plan: Floats, other: Floats,
) -> float:  # fmt: skip
    """Return the smallest squared closing speed (m2/s2) of the front pair after a first contact with the rear vehicle.

    The bound is computed for one motion of the controlled vehicle, which starts from a state at ``early``. After every
    first contact in the given ranges, the controlled vehicle is at every time at least as far ahead and at least as
    fast as in this motion. ``faster`` is the smallest possible value of the rear vehicle's speed minus its speed under
    full braking, m/s.
    """
    further = near - faster * (late - early)
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    gap = max(at[LINE.GAP_L] + at[LINE.GAP_R] + way_l - way_r - further, 0.0)
    passed = max(follower(at, late)[1] - way_r - (leader(at, late)[1] - way_l), 0.0)
    for column in range(LINE.WIDTH):
        moved[column] = at[column]
    moved[LINE.V_L], moved[LINE.GAP_L], moved[LINE.GAP_R] = v_l, gap, 0.0
    moved[LINE.V_R], moved[LINE.ONSET_R] = v_r + faster, max(at[LINE.ONSET_R] - early, 0.0)
    share, rest = at[LINE.REAR_SHARE], 1.0 - at[LINE.REAR_SHARE]
    speed = moved[LINE.V_R] - rest * hard
    if share * (1.0 + at[LINE.RESTITUTION]) <= 1.0:
        speed += share * at[LINE.RESTITUTION] * hard
    speed = max(speed - max(at[LINE.A_R] - at[LINE.A_F], 0.0) * (late - early), 0.0)
    least = gap - passed - (far - further)
    squared = braking_after(gap, least, v_l, at[LINE.A_L], speed, at[LINE.A_F], plan, other)
    if at[LINE.A_F] < at[LINE.A_R]:
        return squared
    pushed = pushed_by_rear(moved, 0.0, late - early, hard, late - early, 0.0, gap, plan, other)
    return max(squared, pushed * pushed)


@compiled(apart=True)
def put_behind(
    at: Floats, early: float, late: float, near: float, far: float, soft: float, hard: float, search: Floats,
    count: int, moved: Floats, plan: Floats, other: Floats, heap: Floats,
) -> int:  # fmt: skip
    """Add a cell to the heap, if the cell may contain the contact with the smallest harm, and return the new number of
    cells.
    """
    since, power, floor = search[SINCE], search[POWER], search[FLOOR]
    room = at[LINE.GAP_L] + at[LINE.GAP_R] + leader(at, late)[1] - follower(at, early)[1]
    span = max(late - since, 0.0)
    if near > room or behind_full_braking(at, early, late) > far or 2.0 * near > power * span * span:
        return count
    soft = max(soft, soft_behind(at, early, late, near, far, since, power))
    if soft >= hard:
        return count
    follows = after_behind(at, early, late, near, far, hard, gained(near, late, since, power), moved, plan, other)
    harm = soft * soft + max(follows, floor)
    if harm >= search[BEST]:
        return count
    k = room_for(heap, count, harm)
    heap[k, EARLY], heap[k, LATE], heap[k, SOFT], heap[k, HARD] = early, late, soft, hard
    heap[k, NEAR], heap[k, FAR] = near, far
    return count + 1


@compiled(apart=True)
def try_behind(
    at: Floats, time: float, near: float, far: float, search: Floats, moved: Floats, plan: Floats, other: Floats
) -> None:
    """Lower ``search[BEST]`` to the harm of the gentlest first contact (smallest closing speed) with the rear vehicle
    at ``time``, if this harm is smaller.

    The function uses a larger lead than ``near`` if no contact at ``time`` is possible with the lead ``near``.
    """
    near = max(near, behind_full_braking(at, time, time))
    if near > far or near > at[LINE.GAP_L] + at[LINE.GAP_R] + leader(at, time)[1] - follower(at, time)[1]:
        return
    since, power = search[SINCE], search[POWER]
    soft = soft_behind(at, time, time, near, near, since, power)
    follows = after_behind(at, time, time, near, near, soft, gained(near, time, since, power), moved, plan, other)
    search[BEST] = min(search[BEST], soft * soft + max(follows, search[FLOOR]))


@compiled(apart=True)
def divide_behind(
    at: Floats, search: Floats, count: int, moved: Floats, plan: Floats, other: Floats, heap: Floats
) -> int:
    """Split the cell that has the smallest bound into two halves, and return the new number of cells on the heap."""
    early, late, near, far = heap[0, EARLY], heap[0, LATE], heap[0, NEAR], heap[0, FAR]
    soft, hard = heap[0, SOFT], min(heap[0, HARD], math.sqrt(search[BEST]))
    count = drop_first(heap, count)
    try_behind(at, early, near, far, search, moved, plan, other)
    by_time = (late - early) * (at[LINE.U_F] + at[LINE.A_F] + at[LINE.A_R])
    by_place = (far - near) / max(late - search[SINCE], _SHORT_S)
    for half in range(2):
        times, places, speeds = (early, late), (near, far), (soft, hard)
        if by_time >= max(by_place, hard - soft):
            middle = 0.5 * (early + late)
            times = (early, middle) if half == 0 else (middle, late)
        elif by_place >= hard - soft:
            middle = 0.5 * (near + far)
            places = (near, middle) if half == 0 else (middle, far)
        else:
            middle = 0.5 * (soft + hard)
            speeds = (soft, middle) if half == 0 else (middle, hard)
        count = put_behind(
            at, times[0], times[1], places[0], places[1], speeds[0], speeds[1], search, count, moved, plan, other, heap
        )
    return count


@compiled(apart=True)
def meetings_behind(
    at: Floats, last: float, search: Floats, moved: Floats, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Return a lower bound (m2/s2) on the harm of all first contacts with the rear vehicle until ``last`` (s).

    The result is at most ``search[BEST]``.
    """
    since, hard, count = min(search[SINCE], last), math.sqrt(search[BEST]), 0
    if since > 0.0:
        count = put_behind(at, 0.0, since, 0.0, 0.0, 0.0, hard, search, count, moved, plan, other, heap)
    if last > since:
        far = at[LINE.GAP_L] + at[LINE.GAP_R] + leader(at, last)[1] if search[POWER] > 0.0 else 0.0
        count = put_behind(at, since, last, 0.0, far, 0.0, hard, search, count, moved, plan, other, heap)
    for _ in range(SEARCHED):
        if count == 0 or heap[0, HARM] >= search[BEST] - CELL * (1.0 + search[BEST]):
            break
        count = divide_behind(at, search, count, moved, plan, other, heap)
    return float(min(search[BEST], heap[0, HARM]) if count > 0 else search[BEST])
