"""A proven lower bound on the harm of every world, whatever several controlled vehicles do together.

docs/avoidability.md, "Teams", has the proofs, under both counting rules:

* each pair alone: its front vehicle as far ahead as it can be (full drive where it is controlled, else full braking),
  its rear vehicle as far behind (full braking); pushes from outside the pair only make it worse;
* the front three together, where Vehicle 1 brakes fully, Vehicle 2 is controlled, and contact is unavoidable; where
  Vehicle 1 is controlled, the obstacle ahead is the first of the three.

Bounds of different pairs add up, as each holds for every joint command. All parts are rounded outward.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.harm import empty_ledger
from ethbrake_marl.limits.lower_bound import (
    BOUND_EPS,
    CELL_OF,
    CELLS,
    EPS,
    FRONT_FIRST,
    LARGE,
    LINE,
    avoidability,
    braked_then_driven,
    braking_after,
    check_asked,
    drop_first,
    empty_plan,
    fill_braking,
    fill_plan,
    follower,
    front_first,
    gentlest_between,
    largest_behind,
    last_ahead,
    leader,
    meet_front,
    onset_states,
    pushed_by_rear,
    spare_gap,
    stays_ahead,
    time_to_limit,
    walk,
)
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, advance
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.kernel import TOUCH_SPEED_MPS, solo_motion, stopping_distances, with_obstacle
from ethbrake_marl.physics.worlds import vehicles_at_once

# Compiled: the least closing speed of a pair's first contact, whatever its vehicles and those around it do.
#
# The leader goes as far ahead as it can (full drive where it is controlled, else full braking), the follower stays as
# far
# behind as it can (full braking). Where these extremes meet, every run of the pair meets no later.
# docs/avoidability.md,
# "Teams", has the proof.

# one pair: its gap; speed, onset and brakes of both; the leader's drive and speed limit where it is controlled
PAIR_GAP, LEADER_V, LEADER_ONSET, LEADER_A, LEADER_FREE, LEADER_U, LEADER_LIMIT = range(7)
FOLLOWER_V, FOLLOWER_ONSET, FOLLOWER_A, PAIR_WIDTH = range(7, 11)

TOUCH_HARM = 2.0 * TOUCH_SPEED_MPS * TOUCH_SPEED_MPS  # what two touches may hide


@compiled_apart
def least_on_piece(constant: float, pressing: float, since: float, until: float) -> float:
    """Least value of ``constant / t + pressing t / 2`` from ``since`` to ``until``."""
    least = constant / until + 0.5 * pressing * until
    if since > 0.0:
        least = min(least, constant / since + 0.5 * pressing * since)
    elif constant <= 0.0:
        least = min(least, 0.0) if constant == 0.0 else -math.inf
    if constant > 0.0 and pressing > 0.0:
        turn = math.sqrt(2.0 * constant / pressing)
        if since < turn < until:
            least = min(least, math.sqrt(2.0 * constant * pressing))
    return least


@compiled_apart
def least_before(at: Floats, met: float, squared: float) -> float:
    """Least closing speed of a pair's first contact up to ``met``, where both extremes meet; a scripted leader.

    ``c(t) + g(t) / t``: the extremes' closing speed, and what must be added to it to be through their gap by then.
    """
    if met <= 0.0:
        return math.sqrt(squared)
    least, now = math.sqrt(squared), 0.0
    gap, v_l, v_f = at[PAIR_GAP], at[LEADER_V], at[FOLLOWER_V]
    rest = at[LEADER_ONSET] + at[LEADER_V] / at[LEADER_A]
    for _ in range(4):
        end = met
        for turn in (at[LEADER_ONSET], at[FOLLOWER_ONSET], rest):
            if now < turn < end:
                end = turn
        u_l = -at[LEADER_A] if at[LEADER_ONSET] <= now < rest else 0.0
        u_f = -at[FOLLOWER_A] if now >= at[FOLLOWER_ONSET] else 0.0
        w, b, step = v_f - v_l, u_f - u_l, end - now
        least = min(least, least_on_piece(gap + (w - 0.5 * b * now) * now, b, now, end))
        gap -= (w + 0.5 * b * step) * step
        v_l = 0.0 if end >= rest else v_l + u_l * step
        v_f += u_f * step
        now = end
        if now >= met:
            break
    return max(least, 0.0)


@compiled_apart
def least_closing_of_pair(at: Floats, until: float, plan: Floats, other: Floats) -> tuple[float, float]:
    """Least closing speed at a pair's first contact, and its latest time; 0, inf where none is forced by ``until``."""
    onset = at[LEADER_ONSET]
    if at[LEADER_FREE] > 0.0:
        full = onset + time_to_limit(at[LEADER_V], at[LEADER_U], at[LEADER_LIMIT])
        fill_plan(plan, onset, 0.0, full, at[LEADER_U], full, 0.0, 0.0)
    else:
        fill_braking(plan, onset, at[LEADER_A])
    fill_braking(other, at[FOLLOWER_ONSET], at[FOLLOWER_A])
    _, met, squared = walk(at[PAIR_GAP], at[LEADER_V], plan, at[FOLLOWER_V], other, until)
    if not met < until:
        return 0.0, math.inf
    return math.sqrt(squared) if at[LEADER_FREE] > 0.0 else least_before(at, met, squared), met


@compiled
def bound_pairs(pairs: Floats, until: Floats, out: Floats) -> None:
    """Bounds of pairs ``pairs`` [n, PAIR_WIDTH] into ``out`` [n]; a touch counts as 0."""
    plan, other = empty_plan(), empty_plan()
    for k in range(pairs.shape[0]):
        closing = least_closing_of_pair(pairs[k], until[k], plan, other)[0]
        out[k] = closing * closing if closing * closing > TOUCH_HARM else 0.0


# Compiled: the least harm over all first meetings with a rear vehicle that may do as it likes.
#
# It is never behind, nor slower than, its full braking, but it may come earlier. So a meeting is a time, how much
# *further* it has come than by full braking, and a closing speed. Cells of these are halved until their bounds come
# close
# to the least meeting tried. docs/avoidability.md, "Teams", has the proof.

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
    place = way - at[LINE.GAP_R] + further
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
    gap: float = (
        at[LINE.GAP_R] + solo_motion(at[LINE.V_F], -at[LINE.A_F], 0.0, math.inf, early)[1] - follower(at, late)[1]
    )
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


@compiled_apart
def put_behind(
    at: Floats, early: float, late: float, near: float, far: float, soft: float, hard: float, search: Floats,
    count: int, moved: Floats, plan: Floats, other: Floats, heap: Floats,
) -> int:  # fmt: skip
    """Put a cell of meetings behind on the heap if it may hold less harm than the best; the new number of cells."""
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
    k = count
    while k > 0 and heap[(k - 1) // 2, CELL_OF.HARM] > harm:
        heap[k] = heap[(k - 1) // 2]
        k = (k - 1) // 2
    heap[k, CELL_OF.HARM], heap[k, _EARLY], heap[k, _LATE] = harm, early, late
    heap[k, _NEAR], heap[k, _FAR], heap[k, _SOFT], heap[k, _HARD] = near, far, soft, hard
    return count + 1


@compiled_apart
def try_behind(
    at: Floats, time: float, near: float, far: float, search: Floats, moved: Floats, plan: Floats, other: Floats
) -> None:
    """Lower the best to the bound of the gentlest meeting behind at ``time`` that is about ``near`` further."""
    near = max(near, behind_full_braking(at, time, time))
    if near > far or near > at[LINE.GAP_L] + at[LINE.GAP_R] + leader(at, time)[1] - follower(at, time)[1]:
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


@compiled_apart
def meetings_behind(
    at: Floats, last: float, search: Floats, moved: Floats, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Lower bound of the harm, if below the best, of all meetings behind that come first, until ``last``."""
    since, hard, count = min(search[SINCE], last), math.sqrt(search[BEST]), 0
    if since > 0.0:
        count = put_behind(at, 0.0, since, 0.0, 0.0, 0.0, hard, search, count, moved, plan, other, heap)
    if last > since:
        far = at[LINE.GAP_L] + at[LINE.GAP_R] + leader(at, last)[1] if search[POWER] > 0.0 else 0.0
        count = put_behind(at, since, last, 0.0, far, 0.0, hard, search, count, moved, plan, other, heap)
    for _ in range(SEARCHED):
        if count == 0 or heap[0, CELL_OF.HARM] >= search[BEST] - _CELL * (1.0 + search[BEST]):
            break
        count = divide_behind(at, search, count, moved, plan, other, heap)
    least: float = min(search[BEST], heap[0, CELL_OF.HARM]) if count > 0 else search[BEST]
    return least


# Compiled: the least harm of the front three, Vehicle 1 scripted, Vehicle 2 controlled, the one behind it anything.
#
# The meetings with the leader are those of one controlled vehicle (``lower_bound_kernel``): a rear vehicle that comes
# earlier only makes what follows worse. Those behind have a search of their own (``meetings_behind``).
# docs/avoidability.md, "Teams", has the proofs.


@compiled_apart
def all_at_once(at: Floats, first: float, last: float, pair: Floats, plan: Floats, other: Floats) -> float:
    """Least harm where leader and rear vehicle meet, with the controlled one between them; inf where they do not.

    The front pair has at least the least closing speed of its meetings, the other one what is left.
    """
    pair[PAIR_GAP], pair[LEADER_V], pair[LEADER_ONSET], pair[LEADER_A] = (
        at[LINE.GAP_L] + at[LINE.GAP_R],
        at[LINE.V_L],
        0.0,
        at[LINE.A_L],
    )
    pair[LEADER_FREE], pair[FOLLOWER_V], pair[FOLLOWER_ONSET], pair[FOLLOWER_A] = (
        0.0,
        at[LINE.V_R],
        at[LINE.ONSET_R],
        at[LINE.A_R],
    )
    both, met = least_closing_of_pair(pair, math.inf, plan, other)
    if met == math.inf:
        return math.inf
    until = min(met, last)
    least = gentlest_between(FRONT_FIRST, at, first, until) if until > first else 0.0
    front = max(least, 0.5 * both)
    rear = max(both - front, 0.0)
    harm: float = front * front + rear * rear
    return harm


@compiled_apart
def last_first_meeting(at: Floats, first: float, plan: Floats, other: Floats) -> float:
    """When the leader can be met first at the latest, the rear one braking fully; inf: whenever; -inf: never.

    ``first`` is when it can be met at the earliest.
    """
    if first == math.inf or not stays_ahead(at, first, first, plan, other):
        return -math.inf
    touches = spare_gap(at[LINE.GAP_L], at[LINE.V_L], at[LINE.A_L], at[LINE.V_F], at[LINE.A_F]) >= 0.0
    last = meet_front(at, 0.0, plan, other)
    if touches:
        last = largest_behind(
            at[LINE.GAP_L], at[LINE.V_L], at[LINE.A_L], at[LINE.V_F], at[LINE.A_F], at[LINE.U_F], at[LINE.LIMIT_F]
        )[1]
    end = last_ahead(at, first, last, plan, other)
    return math.inf if touches and end == last else end


@compiled_apart
def late_meetings(at: Floats, first: float, stand: float, plan: Floats, other: Floats) -> int:
    """Whether the rear vehicle may first meet the controlled one only after it would stand by full braking.

    0: no. 1: yes, and then no harm is less than where the leader is met first. 2: yes, and nothing is proven.
    """
    if last_first_meeting(at, first, plan, other) <= stand:
        return 0
    leader_moves = at[LINE.A_F] < at[LINE.A_L] and at[LINE.V_L] > at[LINE.A_L] * stand
    thrown_back = (
        1.0 - at[LINE.FRONT_SHARE] < at[LINE.RESTITUTION] * at[LINE.FRONT_SHARE] or at[LINE.OBSTACLE] < math.inf
    )
    return 2 if leader_moves or thrown_back else 1


@compiled_apart
def combined_bound_of_team(
    at: Floats, until: float, front: float, rear: float, since: float, power: float, pair: Floats, moved: Floats,
    plan: Floats, other: Floats, heap: Floats, heap_behind: Floats,
) -> float:  # fmt: skip
    """Least harm of the front three where contact is unavoidable, whoever is met first; 0 if that may be after until.

    ``front`` and ``rear`` are the pairs' own bounds. The rear vehicle may hold back from ``since`` on, by ``power``.
    """
    stand = at[LINE.ONSET_R] + at[LINE.V_R] / at[LINE.A_R]
    way = solo_motion(at[LINE.V_R], -at[LINE.A_R], at[LINE.ONSET_R], math.inf, stand)[1]
    room = at[LINE.GAP_L] + at[LINE.V_L] * at[LINE.V_L] / (2.0 * at[LINE.A_L]) + at[LINE.GAP_R] - way
    rest = at[LINE.ONSET_R] + at[LINE.V_R] / min(at[LINE.A_R], at[LINE.A_F])
    if not max(rest, stand + math.sqrt(2.0 * max(room, 0.0) / at[LINE.A_F])) < until:
        return 0.0
    first = meet_front(at, math.inf, plan, other)
    late = late_meetings(at, first, stand, plan, other)
    if late == 2:
        return 0.0
    step, least, any_time = at[LINE.TIME_STEP], 0.0, 0.0
    once = all_at_once(at, first, meet_front(at, 0.0, plan, other), pair, plan, other)
    search = np.empty(SEARCH)
    search[SINCE], search[POWER], search[FLOOR] = since, power, front
    for time_step in (0.0, step):  # what holds for any command holds for one that changes at decisions only
        at[LINE.TIME_STEP] = time_step
        best = min(front_first(at, rear, LARGE, front + rear, plan, other, heap), once)
        if time_step <= 0.0:
            any_time = best
        elif late == 1:
            best = min(best, any_time)
        search[BEST] = best
        if best > front + rear:
            best = meetings_behind(at, stand, search, moved, plan, other, heap_behind)
        least = max(least, best - TOUCH_HARM if best < LARGE else 0.0)
        if step <= 0.0:
            break
    return least


@compiled
def bound_threes(states: Floats, until: Floats, pairs: Floats, since: Floats, power: Floats, out: Floats) -> None:
    """Combined bounds of the front three of worlds ``states`` [n, WIDTH] into ``out`` [n]; contact is unavoidable.

    ``pairs`` [n, 2] are the bounds of their two pairs.
    """
    plan, other, pair, moved = empty_plan(), empty_plan(), np.empty(PAIR_WIDTH), np.empty(LINE.WIDTH)
    heap, heap_behind = np.empty((CELLS, CELL_OF.WIDTH)), np.empty((SEARCHED + 4, HEAP_WIDTH))
    for k in range(states.shape[0]):
        out[k] = combined_bound_of_team(
            states[k], until[k], pairs[k, 0], pairs[k, 1], since[k], power[k], pair, moved, plan, other, heap,
            heap_behind,
        )  # fmt: skip


# The front three vehicles of a line whose second one is controlled, bounded together: rows of the compiled bound.
#
# An obstacle ahead of a controlled Vehicle 1 is a first vehicle that nothing moves. docs/avoidability.md, "Teams".

_MIDDLE, _REAR = 1, 2
_UNMOVED_T = 1e30  # an obstacle: its share of any two masses is 1


@dataclass(frozen=True, slots=True)
class Line:
    """A line when the first controlled vehicle may act."""

    now: Worlds
    onset_s: Floats  # [n, N] from now
    counts: Bools  # [n, P] pairs whose next impact counts, and which move forward


def behind_wall(line: Line, free: Bools) -> Line:
    """The line with its obstacle as a first vehicle that stands and that nothing moves.

    ``free`` [n]: the next impact with it counts, and Vehicle 1 moves forward.
    """
    onset, counts = _with_column(0.0, line.onset_s), _with_column(free, line.counts)
    return Line(_with_wall(line.now), onset, counts)


def _with_column(first: Floats | Bools | float, rest: Floats | Bools) -> Any:
    """One column more in front."""
    return np.column_stack([np.broadcast_to(first, len(rest)), rest])


def _with_wall(now: Worlds) -> Worlds:
    """The line with its obstacle as a first vehicle that stands and that nothing moves."""
    line = with_obstacle(now)
    braking, mass = line.vehicles.braking_capacity_mps2.copy(), line.vehicles.mass_t.copy()
    braking[:, 0], mass[:, 0] = 1.0, _UNMOVED_T
    vehicles = replace(line.vehicles, braking_capacity_mps2=braking, mass_t=mass)
    return replace(line, vehicles=vehicles, obstacle_gap_m=np.ones(line.n))  # what is thrown back has no centre of mass


def combined_bound(line: Line, chosen: Ints, until: Floats, pairs: Floats, time_step_s: float | None) -> Floats:
    """The bound of the front two pairs together, [n] m2/s2, ``until`` [n] s from now; 0 where nothing is proven.

    It asks that the first vehicle brakes by now; the second one, which is among the ``chosen``, is taken to act from
    now on. ``pairs`` [n, 2] are the bounds of both pairs alone.
    """
    now, onset, counts = line.now, line.onset_s, line.counts
    v = now.vehicles
    stops = stopping_distances(now.speeds_mps[:, 0], onset[:, 0], v.braking_capacity_mps2[:, 0]) < now.obstacle_gap_m
    rows = np.flatnonzero((onset[:, 0] <= 0.0) & counts[:, 0] & counts[:, 1] & stops & ~now.obstacle_hit)
    three = _front_three(now, rows)
    if not len(rows):
        return np.zeros(now.n)
    unavoidable = avoidability(three, _MIDDLE).reason >= 2
    rows, three = rows[unavoidable], three.take(np.flatnonzero(unavoidable))
    steps = np.where(onset[rows, _MIDDLE] <= 0.0, 0.0 if time_step_s is None else time_step_s, 0.0)
    since, power = np.zeros(len(rows)), np.full(len(rows), np.inf)
    if now.N == 3:  # nobody pushes the last one
        full = v.braking_capacity_mps2[rows, _REAR] + v.driving_capacity_mps2[rows, _REAR]
        since, power = onset[rows, _REAR], full if _REAR in chosen else np.zeros(len(rows))
    found, out = np.zeros(now.n), np.empty(len(rows))
    bound_threes(onset_states(three, _MIDDLE, steps), until[rows], pairs[rows], since, power, out)
    found[rows] = out
    return found


def _front_three(now: Worlds, rows: Ints) -> Worlds:
    """The first three vehicles of these worlds, Vehicle 2 free to act at once."""
    some = now.take(rows)
    v = some.vehicles
    braking, driving, latency, mass, limit = (
        np.ascontiguousarray(each[:, :3])
        for each in (
            v.braking_capacity_mps2,
            v.driving_capacity_mps2,
            v.latency_s,
            v.mass_t,
            v.speed_limit_mps,
        )
    )
    latency[:, _MIDDLE] = np.minimum(latency[:, _MIDDLE], some.time_s)
    return replace(
        some,
        vehicles=vehicles_at_once(braking, driving, latency, mass, limit, v.restitution),
        gaps_m=some.gaps_m[:, :2].copy(),
        speeds_mps=some.speeds_mps[:, :3].copy(),
        pair_hit=some.pair_hit[:, :2].copy(),
        command_mps2=some.command_mps2[:, :3].copy(),
        messages=np.zeros((some.n, 0)),
    )


@dataclass(frozen=True, slots=True)
class TeamBound:
    """What is proven about each world [n], in m2/s2."""

    harm: Floats  # no joint command does less harm than this
    early: Floats  # done before any controlled vehicle may act
    obstacle: Floats  # Vehicle 1 and the obstacle ahead
    pairs: Floats  # [n, P] of each pair alone, from then on
    combined: Floats  # of the front two pairs together (see ``team_bound``); 0 where nothing is proven

    @property
    def impact_proven(self) -> Bools:
        """Whether every joint command has an impact, [n]; elsewhere none is proven."""
        yes: Bools = self.harm > 0.0
        return yes


def team_bound(
    worlds: Worlds,
    vehicles: Iterable[int],
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    scripts: Mapping[int, str] | None = None,
    time_step_s: float | None = None,
) -> TeamBound:
    """Proven lower bound on the harm from now to ``horizon_s`` (absolute), over all joint commands of ``vehicles``.

    ``harm = early + obstacle + max(pairs[:, 0] + pairs[:, 1], combined) + pairs[:, 2:]``, each part rounded outward;
    where Vehicle 1 is controlled, ``combined`` is that of the obstacle and Vehicles 1 and 2: ``early + max(obstacle +
    pairs[:, 0], combined) + pairs[:, 1:]``.
    All other vehicles brake with their whole capacity from their latencies on; ``scripts`` (index -> name) is only
    checked to say the same. What may come only after the horizon counts as 0, and so does the next impact of a pair
    that was hit before where ``harm_count`` is "first". One controlled vehicle is allowed; ``lower_bound`` is sharper
    where it covers the line.

    With ``time_step_s`` it is proven only for commands that change at decisions, the first one when the first of the
    vehicles may act, one every ``time_step_s`` after it. That is sharper where Vehicle 2 is the first.

    Raises ``InvalidInput`` for vehicles that are none, not there or given twice, another script, an unknown count, a
    time step below ``LEAST_TIME_STEP_S``, and a horizon that is not finite or lies before any of them may act.
    """
    check_asked("team_bound", harm_count, horizon_s, time_step_s)
    chosen = _checked(worlds, vehicles, scripts or {})
    latency = worlds.vehicles.latency_s
    start = np.maximum(latency[:, chosen].min(axis=1), worlds.time_s)
    if not (np.all(start <= horizon_s) and horizon_s < np.inf):
        raise InvalidInput(f"team_bound: horizon_s {horizon_s!r}: must be finite and at least {start.max():g} s")
    now, impacts = advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=start)
    early = empty_ledger(worlds).add(impacts).world_harm(harm_count)
    onset = np.maximum(latency - start[:, np.newaxis], 0.0)
    until = horizon_s - start
    forward = now.speeds_mps >= 0.0
    counts = (~now.pair_hit if harm_count == "first" else True) & forward[:, 1:] & forward[:, :-1]
    pairs = np.stack([_pair(now, p, onset, chosen, until, counts[:, p]) for p in range(worlds.N - 1)], axis=1)
    ahead = forward[:, 0] & np.isfinite(now.obstacle_gap_m) & ~(now.obstacle_hit & (harm_count == "first"))
    obstacle = _obstacle(now, onset, until, ahead)
    combined, walled = np.zeros(worlds.n), bool(chosen[0] == 0)
    if walled and ahead.any():
        wall = behind_wall(Line(now, onset, counts), ahead)
        both = np.stack([obstacle, pairs[:, 0]], axis=1)
        combined = combined_bound(wall, chosen + 1, until, both, time_step_s)
    elif worlds.N >= 3 and chosen[0] == 1:
        combined = combined_bound(Line(now, onset, counts), chosen, until, pairs[:, :2], time_step_s)
    outward = _rounding(worlds, chosen)
    early, obstacle, combined = (np.maximum(part - outward, 0.0) for part in (early, obstacle, combined))
    pairs = np.maximum(pairs - outward[:, np.newaxis], 0.0)
    alone = np.column_stack([obstacle, pairs])
    together = alone[:, :2] if walled else alone[:, 1:3]
    harm = early + alone.sum(axis=1) + np.maximum(combined - together.sum(axis=1), 0.0)
    return TeamBound(harm, early, obstacle, pairs, combined)


def _pair(now: Worlds, p: int, onset: Floats, chosen: Ints, until: Floats, counts: Bools) -> Floats:
    """The bound of pair ``p`` alone, [n]."""
    v, at = now.vehicles, np.zeros((now.n, PAIR_WIDTH))
    columns: dict[int, Floats | float] = {
        PAIR_GAP: now.gaps_m[:, p],
        LEADER_V: now.speeds_mps[:, p],
        LEADER_ONSET: onset[:, p],
        LEADER_A: v.braking_capacity_mps2[:, p],
        LEADER_FREE: float(p in chosen),
        LEADER_U: v.driving_capacity_mps2[:, p],
        LEADER_LIMIT: v.speed_limit_mps[:, p],
        FOLLOWER_V: now.speeds_mps[:, p + 1],
        FOLLOWER_ONSET: onset[:, p + 1],
        FOLLOWER_A: v.braking_capacity_mps2[:, p + 1],
    }
    return _bound(at, columns, until, counts)


def _obstacle(now: Worlds, onset: Floats, until: Floats, counts: Bools) -> Floats:
    """The bound of Vehicle 1 and the obstacle ahead, [n]: a pair whose front vehicle stands."""
    at = np.zeros((now.n, PAIR_WIDTH))
    columns: dict[int, Floats | float] = {
        PAIR_GAP: np.where(counts, now.obstacle_gap_m, 0.0),
        LEADER_A: 1.0,
        FOLLOWER_V: now.speeds_mps[:, 0],
        FOLLOWER_ONSET: onset[:, 0],
        FOLLOWER_A: now.vehicles.braking_capacity_mps2[:, 0],
    }
    return _bound(at, columns, until, counts)


def _bound(at: Floats, columns: Mapping[int, Floats | float], until: Floats, counts: Bools) -> Floats:
    for column, values in columns.items():
        at[:, column] = values
    found, out = np.zeros(len(at)), np.empty(int(counts.sum()))
    bound_pairs(at[counts], until[counts], out)
    found[counts] = out
    return found


def _checked(worlds: Worlds, vehicles: Iterable[int], scripts: Mapping[int, str]) -> Ints:
    """The controlled vehicles in order; refuse what the bound does not cover."""
    if not isinstance(vehicles, Iterable):
        raise InvalidInput(f"team_bound: vehicles {vehicles!r}: must be a list of vehicles, for instance (1, 2)")
    given = tuple(vehicles)
    for vehicle in given:
        check_whole_number("team_bound: a vehicle", vehicle, 0, worlds.N - 1)
    if not given or len(set(given)) != len(given):
        raise InvalidInput(f"team_bound: vehicles {given}: at least one is needed, each once")
    for index, script in scripts.items():
        check_whole_number("team_bound: a vehicle of scripts", index, 0, worlds.N - 1)
        if index not in given and script != "full_brake":
            raise InvalidInput(f"team_bound: vehicle_{index + 1} follows {script!r}; must be 'full_brake'")
    return np.array(sorted(given), np.int64)


def _rounding(worlds: Worlds, chosen: Ints) -> Floats:
    """How far arithmetic can move a bound and a realised harm apart, at most; [n] m2/s2: see ``lower_bound.rounding``.

    The largest speed is a speed limit where any controlled vehicle may drive, the largest closing acceleration that of
    the strongest drive.
    """
    v = worlds.vehicles
    driving = v.driving_capacity_mps2[:, chosen]
    limits = np.where(driving > 0.0, v.speed_limit_mps[:, chosen], 0.0)
    fastest = np.maximum(worlds.speeds_mps.max(axis=1), limits.max(axis=1))
    closing = v.braking_capacity_mps2.max(axis=1) + driving.max(axis=1)
    weakest = v.braking_capacity_mps2.min(axis=1)
    way = worlds.gaps_m.sum(axis=1) + np.where(np.isfinite(worlds.obstacle_gap_m), worlds.obstacle_gap_m, 0.0)
    scale = fastest * fastest * (1.0 + closing / weakest) + 2.0 * closing * way
    outward: Floats = BOUND_EPS * EPS * scale
    return outward
