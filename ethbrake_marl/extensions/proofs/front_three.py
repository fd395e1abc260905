"""Lower bound on the harm of three vehicles: Vehicle 1 is scripted, Vehicle 2 controlled, Vehicle 3 may do anything.

For first contacts with the leader, the module uses ``lower_bound.front_first``, the bound for one controlled vehicle.
This bound assumes that the rear vehicle brakes fully. The bound for full braking also holds for a rear vehicle that may
do anything, because a rear vehicle that arrives earlier never lowers the harm. For first contacts with the rear vehicle
there is a separate search (``free_rear.meetings_behind``). docs/internals/proofs/team-bound.md has the proofs.

``proofs/__init__.py`` and ``free_rear`` explain the arguments that functions share. ``first`` is the earliest time (s)
of a first contact with the front vehicle. ``pair`` [PAIR_WIDTH] is working memory for the values of one pair;
overwritten.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.extensions.proofs.branch_and_bound import CELLS, HEAP_WIDTH, NEAR, gentlest_between
from ethbrake_marl.extensions.proofs.closing import (
    FOLLOWER_A,
    FOLLOWER_ONSET,
    FOLLOWER_V,
    LEADER_A,
    LEADER_FREE,
    LEADER_ONSET,
    LEADER_V,
    PAIR_GAP,
    PAIR_WIDTH,
    least_closing_of_pair,
)
from ethbrake_marl.extensions.proofs.free_rear import BEST, FLOOR, POWER, SEARCH, SEARCHED, SINCE, meetings_behind
from ethbrake_marl.extensions.proofs.line import FRONT_FIRST, LARGE, LINE, TOUCH_HARM
from ethbrake_marl.extensions.proofs.lower_bound import front_first, last_meeting, last_rest
from ethbrake_marl.extensions.proofs.meetings import meet_front, stays_ahead
from ethbrake_marl.extensions.proofs.plans import empty_plan
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats


@compiled(apart=True)
def all_at_once(at: Floats, first: float, last: float, pair: Floats, plan: Floats, other: Floats) -> float:
    """Return the smallest harm (m2/s2) of a contact of all three vehicles at the same time; infinite if such a contact
    is impossible.

    Let W be the smallest closing speed that the rear vehicle can have relative to the front vehicle at a contact of all
    three vehicles. The closing speeds of the two pairs add up to at least W. The closing speed of the front pair is at
    least the smallest closing speed of any first contact with the front vehicle. ``last`` is the latest time (s) of a
    first contact with the front vehicle.
    """
    pair[PAIR_GAP], pair[LEADER_ONSET], pair[LEADER_FREE] = at[LINE.GAP_L] + at[LINE.GAP_R], 0.0, 0.0
    pair[LEADER_V], pair[LEADER_A] = at[LINE.V_L], at[LINE.A_L]
    pair[FOLLOWER_V], pair[FOLLOWER_ONSET], pair[FOLLOWER_A] = at[LINE.V_R], at[LINE.ONSET_R], at[LINE.A_R]
    both, met = least_closing_of_pair(pair, math.inf, plan, other)
    if met == math.inf:
        return math.inf
    until = min(met, last)
    least = gentlest_between(FRONT_FIRST, at, first, until) if until > first else 0.0
    front = max(least, 0.5 * both)
    rear = max(both - front, 0.0)
    return float(front * front + rear * rear)


@compiled(apart=True)
def late_meetings(at: Floats, first: float, stand: float, plan: Floats, other: Floats) -> int:
    """Return a code that says whether the first contact of the rear pair can come after ``stand``, the time (s) at
    which the rear vehicle comes to rest under full braking.

    Code 0: this contact cannot come after ``stand``. Code 1: it can; if it does, its harm is at least as large as the
    harm of some first contact with the front vehicle. Code 2: it can, and nothing is proven about its harm. ``first``
    is infinite if there is no first contact with the front vehicle.
    """
    if first == math.inf or not stays_ahead(at, first, first, plan, other):
        return 0
    _, end, leans = last_meeting(
        at, first, plan, other
    )  # latest first contact with the leader if the rear vehicle brakes fully
    if end <= stand and not leans:
        return 0
    leader_moves = at[LINE.A_F] < at[LINE.A_L] and at[LINE.V_L] > at[LINE.A_L] * stand
    thrown_back = (
        1.0 - at[LINE.FRONT_SHARE] < at[LINE.RESTITUTION] * at[LINE.FRONT_SHARE] or at[LINE.OBSTACLE] < math.inf
    )
    return 2 if leader_moves or thrown_back else 1


@compiled(apart=True)
def combined_bound_of_team(
    at: Floats, until: float, front: float, rear: float, since: float, power: float, pair: Floats, moved: Floats,
    plan: Floats, other: Floats, heap: Floats, heap_behind: Floats,
) -> float:  # fmt: skip
    """Return a lower bound (m2/s2) on the harm of the first three vehicles in a world with unavoidable contact.

    The bound covers first contacts with the front vehicle and first contacts with the rear vehicle. The result is 0 if
    some of the harm that the bound counts may come after the horizon ``until`` (s). ``front`` and ``rear`` are lower
    bounds on the harm of each pair alone (m2/s2). ``heap_behind`` is the heap of ``free_rear``.
    """
    rest, stand = last_rest(at)
    if not rest < until:
        return 0.0
    first = meet_front(at, math.inf, plan, other)
    late = late_meetings(at, first, stand, plan, other)
    if late == 2:
        return 0.0
    step, least, any_time = at[LINE.TIME_STEP], 0.0, 0.0
    once = all_at_once(at, first, meet_front(at, 0.0, plan, other), pair, plan, other)
    search = np.empty(SEARCH)
    search[SINCE], search[POWER], search[FLOOR] = since, power, front
    for time_step in (0.0, step):  # a bound for all commands also holds for commands that change at decisions only
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
    """Compute a lower bound (m2/s2) on the harm of the first three vehicles together in each of ``n`` worlds with
    unavoidable contact, and write it to ``out`` [n].

    ``states`` is [n, LINE.WIDTH]. ``until`` [n] is the horizon (s), after which harm does not count. ``pairs`` [n, 2]
    has lower bounds on the harm of each of the first two pairs alone (m2/s2). ``since`` and ``power`` are [n].
    """
    plan, other, pair, moved = empty_plan(), empty_plan(), np.empty(PAIR_WIDTH), np.empty(LINE.WIDTH)
    heap, heap_behind = np.empty((CELLS, NEAR)), np.empty((SEARCHED + 4, HEAP_WIDTH))
    for k in range(states.shape[0]):
        out[k] = combined_bound_of_team(
            states[k], until[k], pairs[k, 0], pairs[k, 1], since[k], power[k], pair, moved, plan, other, heap,
            heap_behind,
        )  # fmt: skip
