"""``lower_bound``: a proven lower bound on the harm of every world, whatever the controlled vehicle does.

``proofs/__init__.py`` explains the arguments that functions share.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.proofs.avoidability import avoidability, largest_behind, spare_gap
from ethbrake_marl.extensions.proofs.branch_and_bound import CELLS, HEAP_WIDTH, least_harm
from ethbrake_marl.extensions.proofs.followers import after
from ethbrake_marl.extensions.proofs.line import (
    BOUNDS,
    COMBINED_BOUND,
    FRONT_BOUND,
    FRONT_FIRST,
    HALVINGS,
    LARGE,
    LINE,
    REAR_BOUND,
    REAR_FIRST,
    TOUCH_HARM,
    TOUCHING_M,
)
from ethbrake_marl.extensions.proofs.meetings import (
    braking_to_rear,
    gentlest_front,
    meet_front,
    meet_rear,
    stays_ahead,
    stays_behind,
)
from ethbrake_marl.extensions.proofs.onset import (
    LEAST_PART,
    LowerBound,
    at_onset_of,
    check_asked,
    onset_states,
    rounding,
)
from ethbrake_marl.extensions.proofs.plans import empty_plan, fill_braking, fill_drive_then_brake, walk
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.jit import by_parts, compiled
from ethbrake_marl.first_edition.physics.motion import solo_motion
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds

_GRAZE_S = 1e-3  # largest rounding error in the time of a contact at closing speed 0

_PARTS = 8  # number of parts into which the times of soft contacts are divided


@compiled
def rear_bound(at: Floats, plan: Floats, other: Floats) -> tuple[float, float]:
    """Return the smallest squared closing speed (m2/s2) at the first contact of the rear pair, and the latest time (s)
    of this contact.

    If the controlled vehicle drives fully, the first contact of the rear pair happens exactly at the returned time with
    the returned squared closing speed. The returned time is infinite if full drive avoids this contact.
    """
    fill_drive_then_brake(plan, at[LINE.V_F], at[LINE.U_F], at[LINE.LIMIT_F], math.inf, at[LINE.A_F])
    fill_braking(other, at[LINE.ONSET_R], at[LINE.A_R])
    _, time, squared = walk(
        at[LINE.GAP_R], at[LINE.V_F], plan, at[LINE.V_R], other, at[LINE.ONSET_R] + at[LINE.V_R] / at[LINE.A_R]
    )
    return squared, time


@compiled(apart=True)
def is_first(kind: int, at: Floats, time: float, plan: Floats, other: Floats) -> bool:
    """Return whether the gentlest first contact (smallest closing speed) with the neighbour ``kind`` at ``time`` comes
    before any contact with the other neighbour.
    """
    if kind == FRONT_FIRST:
        return stays_ahead(at, gentlest_front(at, time)[1], time, plan, other)
    return stays_behind(at, braking_to_rear(at, time), time, plan, other)


@compiled(apart=True)
def last_first(kind: int, at: Floats, first: float, last: float, plan: Floats, other: Floats) -> float:
    """Return the latest time (s), at most ``last``, at which a contact with the neighbour ``kind`` can come before any
    contact with the other neighbour.

    The function finds this time by bisection, beginning with ``first`` (s), a time at which such a contact is possible.
    The later the first contact, the nearer is the other neighbour. The later the contact with the front vehicle, the
    shorter the controlled vehicle drives, so the rear vehicle comes nearer. The later the contact with the rear
    vehicle, the shorter the controlled vehicle brakes, so the controlled vehicle comes nearer to the front vehicle.
    """
    if is_first(kind, at, last, plan, other):
        return last
    for _ in range(HALVINGS):
        middle = 0.5 * (first + last)
        if is_first(kind, at, middle, plan, other):
            first = middle
        else:
            last = middle
    return last


@compiled(apart=True)
def last_meeting(at: Floats, first: float, plan: Floats, other: Floats) -> tuple[float, float, bool]:
    """Return the latest time (s) of a contact with the front vehicle, and the latest time (s) at which a contact with
    the front vehicle can come before the rear vehicle arrives.

    The third result is True if the first contact with the front vehicle may come arbitrarily late and at any closing
    speed. ``first`` is the earliest time (s) of a contact with the front vehicle.
    """
    touches = spare_gap(at[LINE.GAP_L], at[LINE.V_L], at[LINE.A_L], at[LINE.V_F], at[LINE.A_F]) >= 0.0
    last = meet_front(at, 0.0, plan, other)
    if touches:
        last = largest_behind(
            at[LINE.GAP_L], at[LINE.V_L], at[LINE.A_L], at[LINE.V_F], at[LINE.A_F], at[LINE.U_F], at[LINE.LIMIT_F]
        )[1]
    end = last_first(FRONT_FIRST, at, first, last, plan, other)
    return last, end, touches and end == last


@compiled(apart=True)
def front_first(
    at: Floats, floor: float, best: float, enough: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Return a lower bound (m2/s2), at most ``best``, on the harm if the first contact is with the front vehicle or
    with both neighbours at once.

    In a contact of all three vehicles at once, the closing speeds of the two pairs add up to W, the closing speed of
    the rear vehicle relative to the front vehicle. The closing speed of the front pair is at least the smallest closing
    speed that is possible at the time of this contact. The result covers a contact of all three vehicles at a time t
    only if a first contact with the front vehicle is possible at the time t.
    """
    first = meet_front(at, math.inf, plan, other)
    if (
        first == math.inf and at[LINE.GAP_L] <= TOUCHING_M
    ):  # the vehicle stands in contact with the leader, so the rear vehicle hits both at once
        return min(best, rear_bound(at, plan, other)[0])
    if first == math.inf or not stays_ahead(at, first, first, plan, other):
        return best
    last, end, leans = last_meeting(at, first, plan, other)
    best = least_harm(FRONT_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    if leans:
        best = soft_harm(FRONT_FIRST, at, last, last, floor, best, plan, other)
        stand = at[LINE.V_L] / at[LINE.A_L]
        if last < stand:
            best = soft_harm(FRONT_FIRST, at, stand, stand, floor, best, plan, other)
    fill_braking(plan, 0.0, at[LINE.A_L])
    fill_braking(other, at[LINE.ONSET_R], at[LINE.A_R])
    _, time, squared = walk(at[LINE.GAP_L] + at[LINE.GAP_R], at[LINE.V_L], plan, at[LINE.V_R], other, math.inf)
    if time == math.inf or (time > end + _GRAZE_S and not leans):
        return best
    least = gentlest_front(at, min(time, last))[0] if time > first else 0.0
    front = max(least, 0.5 * math.sqrt(squared))
    rear = max(math.sqrt(squared) - front, 0.0)
    return min(best, front * front + rear * rear)


@compiled(apart=True)
def soft_harm(
    kind: int, at: Floats, early: float, late: float, floor: float, best: float, plan: Floats, other: Floats
) -> float:
    """Return a lower bound (m2/s2), at most ``best``, on the harm of first contacts from ``early`` to ``late`` with any
    closing speed.
    """
    soft = 0.0
    while soft * soft < best:
        hard = soft + 0.02 * (1.0 + soft)
        follows = max(after(kind, at, early, late, hard, late, 0.0, plan, other), floor)
        best = min(best, soft * soft + follows)
        soft = hard
    return best


@compiled(apart=True)
def rear_first(
    at: Floats, floor: float, best: float, enough: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Return a lower bound (m2/s2), at most ``best``, on the harm if the first contact is with the rear vehicle."""
    high = max(at[LINE.V_F] / at[LINE.A_F], at[LINE.ONSET_R] + at[LINE.V_R] / at[LINE.A_R])
    first = meet_rear(at, high, plan, other)
    if first == math.inf or not stays_behind(at, first, first, plan, other):
        return best
    last = meet_rear(at, 0.0, plan, other)
    if last < math.inf:
        end = last_first(REAR_FIRST, at, first, last, plan, other)
        return least_harm(REAR_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    low, top = 0.0, high
    for _ in range(HALVINGS):
        middle = 0.5 * (low + top)
        if meet_rear(at, middle, plan, other) < math.inf:
            top = middle
        else:
            low = middle
    last = meet_rear(at, top, plan, other)
    end = last_first(REAR_FIRST, at, first, last, plan, other)
    best = least_harm(REAR_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    if end < last:
        return best
    late = max(last_soft(at, high, plan, other), last) + _GRAZE_S
    part = (late - last) / _PARTS
    for k in range(_PARTS):
        best = soft_harm(REAR_FIRST, at, last + k * part, last + (k + 1) * part, floor, best, plan, other)
    return best


@compiled(apart=True)
def last_soft(at: Floats, rest: float, plan: Floats, other: Floats) -> float:
    """Return a time (s) after which no first contact with the rear vehicle is possible.

    Until its first contact, the rear vehicle passes neither the front vehicle nor the controlled vehicle. Suppose that
    the rear vehicle brakes harder than the controlled vehicle, by b (m/s2). If the rear vehicle already braked at the
    time t seconds before the contact, the rear vehicle was faster at that time than the controlled vehicle by at least
    ``b t`` (m/s). ``rest`` is the time (s) at which controlled and rear vehicle have both come to rest under full
    braking.
    """
    fill_braking(plan, 0.0, at[LINE.A_L])
    fill_braking(other, at[LINE.ONSET_R], at[LINE.A_R])
    last = min(
        max(rest, at[LINE.V_L] / at[LINE.A_L]),
        walk(at[LINE.GAP_L] + at[LINE.GAP_R], at[LINE.V_L], plan, at[LINE.V_R], other, math.inf)[1],
    )
    if at[LINE.A_F] >= at[LINE.A_R]:
        return float(last)
    harder, onset, closing = at[LINE.A_R] - at[LINE.A_F], at[LINE.ONSET_R], at[LINE.V_R] - at[LINE.V_F]
    gap = max(at[LINE.GAP_R] + (0.5 * at[LINE.U_F] * onset - closing) * onset, 0.0)
    ahead = max(closing + at[LINE.A_F] * onset, 0.0)
    return float(min(last, onset + min(ahead / harder, math.sqrt(2.0 * gap / harder))))


@compiled(apart=True)
def last_rest(at: Floats) -> tuple[float, float]:
    """Return the time (s) by which all harm that the combined bound counts has happened, and the time (s) at which the
    rear vehicle comes to rest if it brakes fully and no other vehicle pushes it.
    """
    stand = at[LINE.ONSET_R] + at[LINE.V_R] / at[LINE.A_R]
    way = solo_motion(at[LINE.V_R], -at[LINE.A_R], at[LINE.ONSET_R], math.inf, stand)[1]
    room = at[LINE.GAP_L] + at[LINE.V_L] * at[LINE.V_L] / (2.0 * at[LINE.A_L]) + at[LINE.GAP_R] - way
    rest = at[LINE.ONSET_R] + at[LINE.V_R] / min(at[LINE.A_R], at[LINE.A_F])
    return max(rest, stand + math.sqrt(2.0 * max(room, 0.0) / at[LINE.A_F])), stand


@compiled(apart=True)
def combined_bound(
    at: Floats, until: float, front: float, rear: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Return a lower bound (m2/s2) on the harm of a world with unavoidable contact.

    The first contact may be with the front or the rear vehicle. The result is 0 if some of the harm that the bound
    counts may come after the horizon ``until`` (s). ``front`` and ``rear`` are lower bounds on the harm of each pair
    alone (m2/s2).
    """
    if not last_rest(at)[0] < until:
        return 0.0
    step, least = at[LINE.TIME_STEP], 0.0
    for time_step in (0.0, step):  # a bound for all commands also holds for commands that change at decisions only
        at[LINE.TIME_STEP] = time_step
        best = front_first(at, rear, LARGE, front + rear, plan, other, heap)
        best = rear_first(at, front, best, front + rear, plan, other, heap)
        least = max(least, best - TOUCH_HARM if best < LARGE else 0.0)
        if step <= 0.0:
            break
    return least


@compiled
def bound_worlds(
    states: Floats, until: Floats, has_front: Bools, has_rear: Bools, unavoidable: Bools, out: Floats
) -> None:
    """Compute lower bounds on the harm of ``n`` worlds: for each pair alone, and for both pairs together.

    Args:
        states: [n, LINE.WIDTH] worlds; ``line.LINE`` names the columns.
        until: [n] horizon, s; later harm does not count.
        has_front: [n] True if the controlled vehicle has a front vehicle and the next impact of this pair counts.
        has_rear: [n] the same for the rear vehicle.
        unavoidable: [n] True if contact is unavoidable; the combined bound is 0 in all other worlds.
        out: [n, BOUNDS] output: the columns FRONT_BOUND, REAR_BOUND and COMBINED_BOUND, m2/s2.

    """
    plan, other, heap = empty_plan(), empty_plan(), np.empty((CELLS, HEAP_WIDTH))
    for k in range(states.shape[0]):
        front, rear = 0.0, 0.0
        if has_front[k]:
            # least squared closing speed at the front pair's first contact, and the latest time of that contact
            at = states[k]
            fill_braking(plan, 0.0, at[LINE.A_L])
            fill_braking(other, 0.0, at[LINE.A_F])
            _, time, squared = walk(
                at[LINE.GAP_L], at[LINE.V_L], plan, at[LINE.V_F], other, at[LINE.V_F] / at[LINE.A_F]
            )
            if at[LINE.A_F] < at[LINE.A_L] and at[LINE.V_F] < at[LINE.V_L]:
                squared = min(squared, 2.0 * (at[LINE.A_L] - at[LINE.A_F]) * at[LINE.GAP_L])
            front = squared if time < until[k] and squared > TOUCH_HARM else 0.0
        if has_rear[k]:
            squared, time = rear_bound(states[k], plan, other)
            rear = squared if time < until[k] and squared > TOUCH_HARM else 0.0
        out[k, FRONT_BOUND], out[k, REAR_BOUND], out[k, COMBINED_BOUND] = front, rear, 0.0
        if unavoidable[k]:
            out[k, COMBINED_BOUND] = combined_bound(states[k], until[k], front, rear, plan, other, heap)


def lower_bound(
    worlds: Worlds,
    vehicle: int = 1,
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    scripts: Mapping[int, str] | None = None,
    time_step_s: float | None = None,
) -> LowerBound:
    """Return a proven lower bound on the harm of every world, over all commands of one vehicle.

    The fields of the result satisfy ``harm = early + max((front_pair + rear_pair), combined)``. Each term of this
    formula is lowered by the largest possible rounding error (``rounding``). ``combined`` is 0 in worlds in which
    contact can be avoided. Harm that may come only after ``horizon_s`` counts as 0. The function covers the same lines
    as ``avoidability``, without an obstacle ahead.

    Args:
        worlds: the ``n`` worlds in their present state.
        vehicle: index of the controlled vehicle, from 0.
        harm_count: ``first`` or ``total``. With ``first``, only the first impact of each pair counts: if a pair has had
            an impact before now, no later impact of this pair counts.
        horizon_s: time until which harm counts, s after the alert.
        scripts: script of each vehicle that is not controlled, by index; only full_brake is allowed. None: all of them
            brake fully.
        time_step_s: time between two decisions, s. With a number, the bound is larger than with None, but it holds only
            for commands that change at decisions: when the vehicle may act, and every ``time_step_s`` after that, as
            for every agent. The computation then takes ten times as long. None: commands may change at any time.

    Raises ``InvalidInput`` for lines that ``avoidability`` does not cover, for an unknown ``harm_count``, for a time
    step below ``LEAST_TIME_STEP_S``, and for a horizon that is not finite or lies before the vehicle may act.

    """
    check_asked(harm_count, horizon_s, time_step_s)
    if (ahead := np.isfinite(worlds.obstacle_gap_m)).any():
        raise InvalidInput(
            f"lower_bound: world {int(np.argmax(ahead))} has an obstacle ahead; the bound is proven without an obstacle"
        )
    verdict = avoidability(worlds, vehicle, scripts=scripts)
    at_onset, start, early, counts = at_onset_of(worlds, vehicle, harm_count, horizon_s)
    none = np.zeros(worlds.n, dtype=np.bool_)
    has_front = counts[:, vehicle - 1] if vehicle > 0 else none
    has_rear = counts[:, vehicle] if vehicle < worlds.N - 1 else none
    unavoidable = has_front & has_rear & (verdict.reason >= 2)
    out = np.empty((worlds.n, BOUNDS))
    states = onset_states(at_onset, vehicle, time_step_s)
    arguments: tuple[Any, ...] = (states, horizon_s - start, has_front, has_rear, unavoidable, out)
    threads = min(os.cpu_count() or 1, worlds.n // LEAST_PART + 1)
    by_parts(lambda part: bound_worlds(*(array[part] for array in arguments)), worlds.n, threads)
    parts = (early, *(out[:, column] for column in (FRONT_BOUND, REAR_BOUND, COMBINED_BOUND)))
    early, front, rear, combined = (np.maximum(part - rounding(worlds, vehicle), 0.0) for part in parts)
    return LowerBound(early + np.maximum(front + rear, combined), early, front, rear, combined, verdict)
