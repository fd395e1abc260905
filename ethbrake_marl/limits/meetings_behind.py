"""Compiled: the least harm over all first meetings with a rear vehicle that may do as it likes.

It is never behind, nor slower than, its full braking, but it may come earlier. So a meeting is a time, how much
*further* it has come than by full braking, and a closing speed. Cells of these are halved until their bounds come close
to the least meeting tried. docs/avoidability.md, "Teams", has the proof.
"""

from __future__ import annotations

import math

from ethbrake_marl.limits.aftermath import braking_after, pushed_by_rear
from ethbrake_marl.limits.first_meeting import HARM, drop_first
from ethbrake_marl.limits.meetings import (
    A_F,
    A_L,
    A_R,
    GAP_L,
    GAP_R,
    ONSET_R,
    REAR_SHARE,
    RESTITUTION,
    U_F,
    V_F,
    V_L,
    V_R,
    WIDTH,
    braked_then_driven,
    follower,
    leader,
)
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.events import solo_motion
from ethbrake_marl.physics.worlds import Floats

SINCE, POWER, FLOOR, BEST, SEARCH = range(5)  # of a search: see gained; the front pair's own bound; the least meeting
SEARCHED = 400  # divisions after which the least meeting stays as loosely bounded as it is
_CELL = 1e-3  # the search stops this close to the least meeting tried, relative to 1 m2/s2 and to itself
# columns of the heap after HARM: times; how much further, at least and at most; closing speeds
_EARLY, _LATE, _NEAR, _FAR, _SOFT, _HARD, HEAP_WIDTH = range(1, 8)
_SHORT_S = 1e-3
_HALVINGS = 60


@compiled_apart
def closing_behind(at: Floats, time: float, further: float) -> float:
    """Least closing speed, seen from the rear vehicle by full braking, of one that is ``further`` ahead of it.

    At ``time``, by the fastest way to be there: brake, then drive. Negative where that is faster.
    """
    v_r, way = follower(at, time)
    place = way - at[GAP_R] + further
    low, high = 0.0, time
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if braked_then_driven(at, middle, time)[0] >= place:
            low = middle
        else:
            high = middle
    return v_r - braked_then_driven(at, low, time)[1]


@compiled
def gained(near: float, time: float, since: float, power: float) -> float:
    """How much faster than by full braking the rear vehicle is, at least, if it has come ``near`` further by ``time``.

    It holds back from ``since`` on, at most ``power`` a second (infinite where others push it).
    """
    if near <= 0.0 or time <= since:
        return 0.0
    span = time - since
    if power == math.inf:
        return near / span
    gain: float = power * (span - math.sqrt(max(span * span - 2.0 * near / power, 0.0)))
    return gain


@compiled
def behind_full_braking(at: Floats, early: float, late: float) -> float:
    """Gap behind, at least, where both brake fully: the controlled one until ``early``, the rear one until ``late``."""
    gap: float = at[GAP_R] + solo_motion(at[V_F], -at[A_F], 0.0, math.inf, early)[1] - follower(at, late)[1]
    return gap


@compiled
def soft_behind(at: Floats, early: float, late: float, near: float, far: float, since: float, power: float) -> float:
    """Least closing speed of the meetings behind in a cell."""
    faster = gained(near, late, since, power)
    return max(closing_behind(at, late, far + faster * (late - early)) + faster, 0.0)


@compiled_apart
def after_behind(
    at: Floats, early: float, late: float, near: float, far: float, hard: float, faster: float, moved: Floats,
    plan: Floats, other: Floats,
) -> float:  # fmt: skip
    """Least squared closing speed at the front after the meetings behind of a cell, of at most ``hard``.

    The state is one at ``early`` that is, at every later time of the cell, no further and no faster than that of any
    meeting there: ``near`` to ``far`` further than by full braking, and ``faster``.
    """
    further = near - faster * (late - early)
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    gap = max(at[GAP_L] + at[GAP_R] + way_l - way_r - further, 0.0)
    passed = max(follower(at, late)[1] - way_r - (leader(at, late)[1] - way_l), 0.0)
    for column in range(WIDTH):
        moved[column] = at[column]
    moved[V_L], moved[GAP_L], moved[GAP_R] = v_l, gap, 0.0
    moved[V_R], moved[ONSET_R] = v_r + faster, max(at[ONSET_R] - early, 0.0)
    share, rest = at[REAR_SHARE], 1.0 - at[REAR_SHARE]
    speed = moved[V_R] - rest * hard
    if share * (1.0 + at[RESTITUTION]) <= 1.0:
        speed += share * at[RESTITUTION] * hard
    speed = max(speed - max(at[A_R] - at[A_F], 0.0) * (late - early), 0.0)
    least = gap - passed - (far - further)
    squared = braking_after(gap, least, v_l, at[A_L], speed, at[A_F], plan, other)
    if at[A_F] < at[A_R]:
        return squared
    pushed = pushed_by_rear(moved, 0.0, late - early, hard, late - early, 0.0, gap, plan, other)
    return max(squared, pushed * pushed)


@compiled_apart
def put_behind(
    at: Floats, early: float, late: float, near: float, far: float, soft: float, hard: float, search: Floats,
    count: int, moved: Floats, plan: Floats, other: Floats, heap: Floats,
) -> int:  # fmt: skip
    """Put a cell of meetings behind on the heap if it may hold less harm than the best; the new number of cells."""
    since, power, floor = search[SINCE], search[POWER], search[FLOOR]
    room = at[GAP_L] + at[GAP_R] + leader(at, late)[1] - follower(at, early)[1]
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
    k = count
    while k > 0 and heap[(k - 1) // 2, HARM] > harm:
        heap[k] = heap[(k - 1) // 2]
        k = (k - 1) // 2
    heap[k, HARM], heap[k, _EARLY], heap[k, _LATE] = harm, early, late
    heap[k, _NEAR], heap[k, _FAR], heap[k, _SOFT], heap[k, _HARD] = near, far, soft, hard
    return count + 1


@compiled_apart
def try_behind(
    at: Floats, time: float, near: float, far: float, search: Floats, moved: Floats, plan: Floats, other: Floats
) -> None:
    """Lower the best to the bound of the gentlest meeting behind at ``time`` that is about ``near`` further."""
    near = max(near, behind_full_braking(at, time, time))
    if near > far or near > at[GAP_L] + at[GAP_R] + leader(at, time)[1] - follower(at, time)[1]:
        return
    since, power = search[SINCE], search[POWER]
    soft = soft_behind(at, time, time, near, near, since, power)
    follows = after_behind(at, time, time, near, near, soft, gained(near, time, since, power), moved, plan, other)
    search[BEST] = min(search[BEST], soft * soft + max(follows, search[FLOOR]))


@compiled_apart
def divide_behind(
    at: Floats, search: Floats, count: int, moved: Floats, plan: Floats, other: Floats, heap: Floats
) -> int:
    """Replace the first cell of the heap by its halves; the new number of cells."""
    early, late, near, far = heap[0, _EARLY], heap[0, _LATE], heap[0, _NEAR], heap[0, _FAR]
    soft, hard = heap[0, _SOFT], min(heap[0, _HARD], math.sqrt(search[BEST]))
    count = drop_first(heap, count)
    try_behind(at, early, near, far, search, moved, plan, other)
    by_time = (late - early) * (at[U_F] + at[A_F] + at[A_R])
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


@compiled_apart
def meetings_behind(
    at: Floats, last: float, search: Floats, moved: Floats, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Lower bound of the harm, if below the best, of all meetings behind that come first, until ``last``."""
    since, hard, count = min(search[SINCE], last), math.sqrt(search[BEST]), 0
    if since > 0.0:
        count = put_behind(at, 0.0, since, 0.0, 0.0, 0.0, hard, search, count, moved, plan, other, heap)
    if last > since:
        far = at[GAP_L] + at[GAP_R] + leader(at, last)[1] if search[POWER] > 0.0 else 0.0
        count = put_behind(at, since, last, 0.0, far, 0.0, hard, search, count, moved, plan, other, heap)
    for _ in range(SEARCHED):
        if count == 0 or heap[0, HARM] >= search[BEST] - _CELL * (1.0 + search[BEST]):
            break
        count = divide_behind(at, search, count, moved, plan, other, heap)
    least: float = min(search[BEST], heap[0, HARM]) if count > 0 else search[BEST]
    return least
