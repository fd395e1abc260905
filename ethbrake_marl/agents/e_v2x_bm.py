"""E-V2X-BM: the constant deceleration of least harm, in closed form and in the engine's physics, and as an agent.

First the closed form of one pair: its first contact, and the thresholds that avoid it. Symbols, for a pair alone
(docs/proofs/constant-deceleration.md derives every formula):

=============  ===============================================================
l, f           leader (front vehicle), follower (rear vehicle)
gap            bumper to bumper at the start [m], >= 0
v_l, v_f       speeds at the start [m/s], >= 0
a_l, a_f       decelerations [m/s2], >= 0, held to standstill
onset_l/_f     start of braking after the start [s]; before it a vehicle coasts
tau            latency of the follower after the leader's onset [s], >= 0
lead           latency of the leader after the follower's onset [s], > 0
w              closing speed ``v_f - v_l`` [m/s]
=============  ===============================================================

Only + - * / and sqrt: a world gives the same bits in any batch.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.agents.believed import Believing
from ethbrake_marl.agents.registry import Agent, AgentSettings, Source, fixed_commands
from ethbrake_marl.engine import Memory, Script, is_state_free
from ethbrake_marl.errors import InvalidInput, renumbered
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.physics import (
    BOUND,
    FLAG,
    LISTED,
    ROW,
    Bools,
    Floats,
    Ints,
    Worlds,
    accelerate,
    advance,
    builds_up,
    by_parts,
    compiled,
    move_apart,
    onset_s,
    pieces_to_come,
    place_forces,
    place_obstacle,
    record_impacts,
    resolve_impacts,
    rows_for,
    start_events,
    to_next_event,
    to_next_impact,
)
from ethbrake_marl.registry import Part
from ethbrake_marl.scenario import ScriptSpec

TOUCH_SQUARED = (
    BOUND.TOUCH_SPEED_MPS * BOUND.TOUCH_SPEED_MPS
)  # contact at or below this squared closing speed: no impact
_NONE = -1.0


@compiled
def stopping_time(speed: float, deceleration: float) -> float:
    """Time from the onset of braking to standstill: ``v / a``; 0 at rest, inf without braking. [s]"""
    if speed == 0.0:
        return 0.0
    return speed / deceleration


@compiled
def stopping_distance(speed: float, deceleration: float) -> float:
    """Distance from the onset of braking to standstill: ``v^2 / 2a``; 0 at rest, inf without braking. [m]"""
    if speed == 0.0:
        return 0.0
    return speed * speed / (2.0 * deceleration)


@compiled
def contact_while_coasting(gap: float, v_l: float, a_l: float, v_f: float, tau: float) -> float:
    """Squared closing speed if the pair meets while the follower still coasts (regimes A and A'), else -1."""
    w = v_f - v_l
    stop_l = stopping_time(v_l, a_l)
    squared = w * w + 2.0 * a_l * gap
    time = math.inf
    if w > 0.0:
        time = 2.0 * gap / (w + math.sqrt(squared))
    elif a_l > 0.0:
        time = (math.sqrt(squared) - w) / a_l
    if time <= min(tau, stop_l):
        return squared
    if stop_l < tau and gap + stopping_distance(v_l, a_l) <= v_f * tau:
        return v_f * v_f
    return _NONE


@compiled
def contact_while_both_brake(gap: float, v_l: float, a_l: float, v_f: float, a_f: float, tau: float) -> float:
    """Squared closing speed if the pair meets while both brake and move (regime B), else -1."""
    stop_l = stopping_time(v_l, a_l)
    if not stop_l > tau:
        return _NONE
    w_t = v_f - v_l + a_l * tau
    g_t = gap - (v_f - v_l) * tau - 0.5 * a_l * tau * tau
    q = a_f - a_l
    squared = w_t * w_t - 2.0 * q * g_t
    after = math.inf
    if w_t > 0.0:
        if squared >= 0.0:
            after = 2.0 * g_t / (w_t + math.sqrt(squared))
    elif q < 0.0:
        after = (math.sqrt(max(squared, 0.0)) - w_t) / -q
    if after < math.inf and tau + after <= min(stop_l, tau + stopping_time(v_f, a_f)):
        return squared
    return _NONE


@compiled
def contact_leader_first(gap: float, v_l: float, a_l: float, v_f: float, a_f: float, tau: float) -> float:
    """Squared closing speed at the first contact, the leader braking from 0, the follower from ``tau``; 0 if none."""
    squared = contact_while_coasting(gap, v_l, a_l, v_f, tau)
    if squared < 0.0:
        squared = contact_while_both_brake(gap, v_l, a_l, v_f, a_f, tau)
    if squared >= 0.0:
        return squared
    room = gap + stopping_distance(v_l, a_l) - v_f * tau
    outlasts = tau + stopping_time(v_f, a_f) > stopping_time(v_l, a_l)
    if outlasts and stopping_distance(v_f, a_f) > room:  # regime C: the leader stands
        return v_f * v_f - 2.0 * a_f * room
    return 0.0


@compiled
def contact_before_leader_brakes(gap: float, w: float, a_f: float, lead: float) -> float:
    """Squared closing speed if a braking follower meets a leader that coasts for ``lead``, else -1.

    ``w^2 - 2 a_f gap`` at ``s = 2 gap / (w + sqrt(.)) <= lead``. A touch is passed over: the pair separates again.
    """
    squared = w * w - 2.0 * a_f * gap
    if w > 0.0 and squared > TOUCH_SQUARED and 2.0 * gap / (w + math.sqrt(squared)) <= lead:
        return squared
    return _NONE


@compiled
def closing_speed_squared(
    gap: float, v_l: float, a_l: float, onset_l: float, v_f: float, a_f: float, onset_f: float
) -> float:
    """Squared closing speed at the pair's first impact, 0 when there is none or only a touch. [m2/s2]"""
    w = v_f - v_l
    both_coast = min(onset_l, onset_f)
    if w > 0.0 and gap <= w * both_coast:
        squared = w * w
    elif onset_l <= onset_f:
        squared = contact_leader_first(gap - w * both_coast, v_l, a_l, v_f, a_f, onset_f - onset_l)
    else:
        lead = onset_l - onset_f
        gap = gap - w * both_coast
        squared = contact_before_leader_brakes(gap, w, a_f, lead)
        if squared < 0.0:
            squared = 0.0
            if v_f > a_f * lead:
                gap = max(gap - (w - 0.5 * a_f * lead) * lead, 0.0)
                squared = contact_leader_first(gap, v_l, a_l, v_f - a_f * lead, a_f, 0.0)
    return squared if squared > TOUCH_SQUARED else 0.0


@compiled
def least_behind_braking(gap: float, v_l: float, a_l: float, v_f: float, tau: float) -> float:
    """``least_to_spare_front`` for a leader that brakes from 0 and a follower that brakes from ``tau >= 0``."""
    coasting = contact_while_coasting(gap, v_l, a_l, v_f, tau)
    if coasting > TOUCH_SQUARED:
        return math.inf
    if v_f == 0.0 or coasting >= 0.0:
        return 0.0
    room = gap + stopping_distance(v_l, a_l) - v_f * tau
    if not room > 0.0:
        return math.inf
    to_stop = v_f * v_f / (2.0 * room)
    if tau + v_f / to_stop >= stopping_time(v_l, a_l):
        return to_stop
    w_t = v_f - v_l + a_l * tau
    g_t = gap - (v_f - v_l) * tau - 0.5 * a_l * tau * tau
    return a_l + w_t * w_t / (2.0 * g_t)


@compiled
def least_behind_coasting(gap: float, v_l: float, a_l: float, v_f: float, lead: float) -> float:
    """``least_to_spare_front`` for a follower that brakes from 0 and a leader that brakes from ``lead > 0``."""
    if v_f == 0.0:
        return 0.0
    w = v_f - v_l
    graze = 0.0
    if w > 0.0 and 2.0 * gap <= w * lead:
        graze = w * w / (2.0 * gap)
    to_stop = v_f * v_f / (2.0 * (gap + v_l * lead + stopping_distance(v_l, a_l)))
    if v_f / to_stop >= lead + stopping_time(v_l, a_l):
        return max(graze, to_stop)
    if graze > 0.0:
        return graze
    return (w * w + 2.0 * a_l * (gap - w * lead)) / (2.0 * gap - a_l * lead * lead)


@compiled
def least_to_spare_front(gap: float, v_l: float, a_l: float, onset_l: float, v_f: float, onset_f: float) -> float:
    """Smallest constant deceleration of the follower that avoids the leader; inf if none does. [m/s2]

    The follower's position at any time falls with its deceleration, so every larger one avoids the leader too.
    The leader brakes (``a_l > 0``). Binding is either the stopping distance or, when the follower would stop
    first, the grazing contact of two moving vehicles.
    """
    w = v_f - v_l
    both_coast = min(onset_l, onset_f)
    if w > 0.0 and gap <= w * both_coast:
        return math.inf
    gap = gap - w * both_coast
    if onset_l <= onset_f:
        return least_behind_braking(gap, v_l, a_l, v_f, onset_f - onset_l)
    return least_behind_coasting(gap, v_l, a_l, v_f, onset_l - onset_f)


@compiled
def most_ahead_of_coasting(gap: float, v_l: float, v_f: float, a_f: float, tau: float) -> float:
    """``most_to_spare_rear`` for a leader that brakes from 0 and a follower that brakes from ``tau >= 0``."""
    reach = v_f * tau + stopping_distance(v_f, a_f)
    touching = gap == 0.0 and v_f == v_l  # pressed together from the start: no impact
    if reach <= gap or touching:
        return math.inf
    if v_l == 0.0:
        return -math.inf
    to_stop = v_l * v_l / (2.0 * (reach - gap))
    if tau + stopping_time(v_f, a_f) >= v_l / to_stop:
        return to_stop
    w = v_f - v_l
    graze = (2.0 * a_f * (gap - w * tau) - w * w) / (a_f * tau * tau + 2.0 * gap)
    return graze if graze >= 0.0 else -math.inf


@compiled
def most_to_spare_rear(gap: float, v_l: float, onset_l: float, v_f: float, a_f: float, onset_f: float) -> float:
    """Largest constant deceleration of the leader that avoids the follower; inf if all do, -inf if none does. [m/s2]

    The leader's position at any time falls with its deceleration, so every smaller one avoids the follower too.
    The follower brakes (``a_f > 0``). A follower that brakes first is advanced to the leader's onset: until then
    nothing depends on the leader's deceleration.
    """
    w = v_f - v_l
    both_coast = min(onset_l, onset_f)
    if w > 0.0 and gap <= w * both_coast:
        return -math.inf
    gap = gap - w * both_coast
    if onset_l <= onset_f:
        return most_ahead_of_coasting(gap, v_l, v_f, a_f, onset_f - onset_l)
    lead = onset_l - onset_f
    if contact_before_leader_brakes(gap, w, a_f, lead) >= 0.0:
        return -math.inf
    if v_f <= a_f * lead:
        return math.inf
    gap = max(gap - (w - 0.5 * a_f * lead) * lead, 0.0)
    return most_ahead_of_coasting(gap, v_l, v_f - a_f * lead, a_f, 0.0)


# E-V2X-BM in closed form: the constant deceleration of one vehicle that minimises its pairs' predicted harm.
#
# The controlled vehicle's neighbours brake at full capacity from their own latencies; its front and its rear pair are
# treated as independent, so each counts its first contact only and no velocity is exchanged. Predicted harm is
# ``H(a) = c_front(a)^2 + c_rear(a)^2`` (m2/s2). Between a handful of closed-form breakpoints it is concave in ``a``, so
# its minimum is at one of them: no grid. docs/proofs/constant-deceleration.md derives all of it.

CANDIDATES = 6  # 0, capacity, the two thresholds, and two more where the vehicle may brake before its front neighbour
_TIE = 1e-12  # harms closer than this, relative to 1 + harm, are one harm


class PairwiseOptimum(NamedTuple):
    """The closed-form optimum of each world [n]."""

    deceleration_mps2: Floats  # a*, in [0, braking capacity]
    harm: Floats  # predicted H* (m2/s2)
    spares_front_mps2: Floats  # smallest deceleration that avoids the front vehicle; inf if none
    spares_rear_mps2: Floats  # largest deceleration that avoids the rear vehicle; inf if all do, -inf if none
    breakpoints_mps2: Floats  # [n, 6] every deceleration at which the harm may have its minimum, unordered


@compiled
def early_breakpoints(gap: float, w: float, onset_l: float, onset_f: float) -> tuple[float, float]:
    """Kink and jump of the front pair's harm when the follower may brake before the leader; (0, 0) otherwise.

    Kink: contact exactly at the leader's onset, ``2 (w lead - gap) / lead^2``. Jump: below ``w^2 / (2 gap)`` the
    follower strikes the coasting leader lightly, above it grazes past and may strike harder once the leader brakes;
    the lightest contact that still is an impact stands for the open end. [m/s2]
    """
    lead = onset_l - onset_f
    if lead <= 0.0:
        return 0.0, 0.0
    gap = gap - w * onset_f
    return 2.0 * (w * lead - gap) / (lead * lead), (w * w - 4.0 * TOUCH_SQUARED) / (2.0 * gap)


@compiled
def front_harm(a: float, i: int, gap: Floats, speed: Floats, capacity: Floats, onset: Floats) -> float:
    """Predicted harm of vehicle ``i``'s front pair when it brakes with ``a``; 0 for the first vehicle."""
    if i == 0:
        return 0.0
    return closing_speed_squared(gap[i - 1], speed[i - 1], capacity[i - 1], onset[i - 1], speed[i], a, onset[i])


@compiled
def rear_harm(a: float, i: int, gap: Floats, speed: Floats, capacity: Floats, onset: Floats) -> float:
    """Predicted harm of vehicle ``i``'s rear pair when it brakes with ``a``; 0 for the last vehicle."""
    if i == gap.shape[0]:
        return 0.0
    return closing_speed_squared(gap[i], speed[i], a, onset[i], speed[i + 1], capacity[i + 1], onset[i + 1])


@compiled
def find_breakpoints(
    at: Floats, i: int, gap: Floats, speed: Floats, capacity: Floats, onset: Floats
) -> tuple[float, float]:
    """Fill ``at`` [6] with the candidates of one world, all inside [0, capacity]; returns both thresholds."""
    low, high = 0.0, math.inf
    at[:] = 0.0
    at[1] = capacity[i]
    if i > 0:
        f = i - 1
        low = least_to_spare_front(gap[f], speed[f], capacity[f], onset[f], speed[i], onset[i])
        at[4], at[5] = early_breakpoints(gap[f], speed[i] - speed[f], onset[f], onset[i])
    if i < gap.shape[0]:
        r = i + 1
        high = most_to_spare_rear(gap[i], speed[i], onset[i], speed[r], capacity[r], onset[r])
    at[2] = low
    at[3] = high
    for k in range(at.shape[0]):
        if not (0.0 <= at[k] <= capacity[i]):
            at[k] = 0.0
    return low, high


@compiled
def minimise_over(
    at: Floats, i: int, gap: Floats, speed: Floats, capacity: Floats, onset: Floats
) -> tuple[float, float]:
    """Least predicted harm over the candidates, and where: in the middle if the harm is flat between minimisers."""
    best, first, last = math.inf, 0.0, 0.0
    for k in range(at.shape[0]):
        if k > 0 and at[k] == 0.0:
            continue
        harm = front_harm(at[k], i, gap, speed, capacity, onset) + rear_harm(at[k], i, gap, speed, capacity, onset)
        if harm < best - _TIE * (1.0 + harm):
            first, last = at[k], at[k]
        elif harm <= best + _TIE * (1.0 + best):
            first, last = min(first, at[k]), max(last, at[k])
        best = min(best, harm)
    middle = 0.5 * (first + last)
    harm = front_harm(middle, i, gap, speed, capacity, onset) + rear_harm(middle, i, gap, speed, capacity, onset)
    if harm <= best + _TIE * (1.0 + best):
        return middle, harm
    harm = front_harm(first, i, gap, speed, capacity, onset) + rear_harm(first, i, gap, speed, capacity, onset)
    return first, harm


@compiled
def optimise_worlds(
    gaps: Floats, speeds: Floats, capacity: Floats, onset: Floats, i: int, at: Floats, out: Floats
) -> None:
    """Candidates of every world into ``at`` [n, 6], its optimum into ``out`` [4, n]: a*, H*, and the two thresholds."""
    for k in range(gaps.shape[0]):
        low, high = find_breakpoints(at[k], i, gaps[k], speeds[k], capacity[k], onset[k])
        top = min(high, capacity[k, i])
        if low <= top:
            out[0, k], out[1, k] = 0.5 * (low + top), 0.0
        else:
            out[0, k], out[1, k] = minimise_over(at[k], i, gaps[k], speeds[k], capacity[k], onset[k])
        out[2, k], out[3, k] = low, high


@compiled
def contacts_of_worlds(gaps: Floats, speeds: Floats, deceleration: Floats, onset: Floats, out: Floats) -> None:
    """Squared closing speed of every pair alone into ``out`` [n, P]."""
    for k in range(gaps.shape[0]):
        for p in range(gaps.shape[1]):
            out[k, p] = closing_speed_squared(
                gaps[k, p], speeds[k, p], deceleration[k, p], onset[k, p],
                speeds[k, p + 1], deceleration[k, p + 1], onset[k, p + 1],
            )  # fmt: skip


def optimise_pairwise(worlds: Worlds, vehicle: int) -> PairwiseOptimum:
    """E-V2X-BM of controlled ``vehicle`` (index from 0) in every world, in closed form.

    Minimises ``H(a) = c_front^2 + c_rear^2`` over ``a`` in [0, capacity]. If the decelerations that avoid both
    neighbours form a non-empty interval, ``a*`` is its middle, else the best breakpoint. The first and the last
    vehicle of a line have one pair; pairs further away (N > 3) are not looked at. Needs the gaps, speeds,
    capacities and latencies of the vehicle and its two neighbours, nothing else.

    Raises ``InvalidInput`` if ``vehicle`` is not in the line, a vehicle moves backward or brakes build up.
    """
    worlds.refuse_build_up("the closed form of E-V2X-BM and planner")
    return _closed_form(worlds, vehicle)


def _closed_form(worlds: Worlds, vehicle: int) -> PairwiseOptimum:
    """The optimum were every acceleration there at once."""
    onset, capacity = _onset_s(worlds, vehicle), worlds.vehicles.braking_capacity_mps2
    at, out = np.empty((worlds.n, CANDIDATES)), np.empty((4, worlds.n))
    optimise_worlds(worlds.gaps_m, worlds.speeds_mps, capacity, onset, vehicle, at, out)
    deceleration, harm, front, rear = out
    return PairwiseOptimum(deceleration, harm, front, rear, at)


def pairwise_harm(worlds: Worlds, deceleration_mps2: ArrayLike) -> Floats:
    """Predicted harm of each pair on its own, [n, P] (m2/s2), under constant decelerations [n, N].

    Every vehicle coasts to its latency and then brakes to rest. The prediction of E-V2X-BM is the sum over the
    controlled vehicle's pairs. Raises ``InvalidInput`` for a deceleration that is negative or not finite, and where
    brakes build up.
    """
    worlds.refuse_build_up("the closed form of E-V2X-BM and planner")
    onset = _onset_s(worlds, 0)
    deceleration = np.array(np.broadcast_to(np.asarray(deceleration_mps2, np.float64), worlds.speeds_mps.shape))
    good = (deceleration >= 0.0) & np.isfinite(deceleration)
    if not good.all():
        k, i = (int(x) for x in np.argwhere(~good)[0])
        raise InvalidInput(f"deceleration_mps2[{k}, {i}] = {deceleration[k, i]:g}: must be finite and >= 0")
    out = np.empty_like(worlds.gaps_m)
    contacts_of_worlds(worlds.gaps_m, worlds.speeds_mps, deceleration, onset, out)
    return out


def _onset_s(worlds: Worlds, vehicle: int) -> Floats:
    """Time from now until each vehicle may brake, [n, N]; checks that the closed form applies."""
    if not 0 <= vehicle < worlds.N:
        raise InvalidInput(f"vehicle {vehicle}: must be an index in 0..{worlds.N - 1}")
    if not np.all(worlds.speeds_mps >= 0.0):
        k, i = (int(x) for x in np.argwhere(~(worlds.speeds_mps >= 0.0))[0])
        raise InvalidInput(f"speeds_mps[{k}, {i}] = {worlds.speeds_mps[k, i]:g}: the closed form needs speeds >= 0")
    onset: Floats = np.maximum(worlds.vehicles.latency_s - worlds.time_s[:, None], 0.0)
    return onset


# Samples of one world's harm over decelerations, compiled: joined, bounded between, followed downhill, chosen from.
#
# A world has about 560 of them; they are kept in rising order of the deceleration.

STEEPER = 2.0  # the harm between two samples may fall this much faster than beside them
NARROWEST_MPS2 = 1e-9  # decelerations closer than this are not told apart
TIE = 1e-9  # harms (m2/s2) closer than this are one harm


class Samples(NamedTuple):
    """Simulated decelerations of one world, each [k]."""

    at: Floats  # decelerations (m/s2)
    harm: Floats  # under the count that is minimised (m2/s2)
    other: Floats  # under the other count
    course: Floats  # differs where the numbers of impacts differ: there the harm may jump


@compiled
def make_samples(most: int) -> Samples:
    """Room for ``most`` samples."""
    return Samples(np.empty(most), np.empty(most), np.empty(most), np.empty(most))


@compiled(bare=True)
def copy_sample(one: Samples, k: int, other: Samples, to: int) -> None:
    """Copy sample ``k`` to another place."""
    other.at[to] = one.at[k]
    other.harm[to] = one.harm[k]
    other.other[to] = one.other[k]
    other.course[to] = one.course[k]


@compiled(bare=True)
def merge(one: Samples, n: int, other: Samples, m: int, into: Samples) -> None:
    """The first ``n`` and ``m`` of two lists in rising order as one in rising order."""
    i, j = 0, 0
    for to in range(n + m):
        if j == m or (i < n and one.at[i] <= other.at[j]):
            copy_sample(one, i, into, to)
            i += 1
        else:
            copy_sample(other, j, into, to)
            j += 1


@compiled(bare=True)
def put_in_order(samples: Samples, n: int) -> None:
    """Put the first ``n``, few or nearly in order, in rising order."""
    for k in range(1, n):
        at, harm, other, course = samples.at[k], samples.harm[k], samples.other[k], samples.course[k]
        to = k
        while to > 0 and samples.at[to - 1] > at:
            copy_sample(samples, to - 1, samples, to)
            to -= 1
        samples.at[to], samples.harm[to], samples.other[to], samples.course[to] = at, harm, other, course


@compiled(bare=True)
def bound_cells(samples: Samples, n: int, bounds: Floats) -> None:
    """Least harm expected between neighbours of ``n`` samples into ``bounds`` [n - 1].

    The sides that fall into a cell run on, ``STEEPER`` times as fast.
    """
    before, slope = 0.0, _slope(samples, 0)
    for k in range(n - 1):
        after = _slope(samples, k + 1) if k < n - 2 else 0.0
        reach = STEEPER * (samples.at[k + 1] - samples.at[k])
        from_left = samples.harm[k] + reach * min(before, 0.0)
        from_right = samples.harm[k + 1] - reach * max(after, 0.0)
        bounds[k] = min(from_left, from_right)
        before, slope = slope, after


@compiled(bare=True)
def _slope(samples: Samples, k: int) -> float:
    """Of the harm from sample ``k`` to the next one."""
    width = samples.at[k + 1] - samples.at[k]
    return float((samples.harm[k + 1] - samples.harm[k]) / max(width, NARROWEST_MPS2))


@compiled(bare=True)
def least_harm(samples: Samples, n: int) -> float:
    """Of the first ``n``."""
    least = math.inf
    for k in range(n):
        least = min(least, samples.harm[k])
    return least


@compiled(bare=True)
def find_smallest(values: Floats, n: int, places: Ints) -> None:
    """Fill ``places`` with those of the smallest of ``n`` values, in rising order; the first one of equals first."""
    found = 0
    for k in range(n):
        if found == places.shape[0] and not values[k] < values[places[found - 1]]:
            continue
        to = found if found < places.shape[0] else found - 1
        while to > 0 and values[places[to - 1]] > values[k]:
            places[to] = places[to - 1]
            to -= 1
        places[to] = k
        found = min(found + 1, places.shape[0])


@compiled(bare=True)
def find_minima(samples: Samples, n: int, depth: Floats, places: Ints) -> None:
    """Fill ``places`` with the lowest local minima of ``n`` samples, in rising order of the harm.

    ``depth`` [n] receives the harm where there is one, infinity elsewhere. Where there are too few, the rest of the
    places are those of the first samples that are none.
    """
    for k in range(n):
        falls = k == 0 or samples.harm[k] < samples.harm[k - 1]
        rises = k == n - 1 or samples.harm[k] <= samples.harm[k + 1]
        depth[k] = samples.harm[k] if falls and rises else math.inf
    find_smallest(depth, n, places)


@compiled(bare=True)
def choose(samples: Samples, n: int, room: Floats) -> float:
    """Deceleration of least harm; ties by the other count, then the middle one of those that are left.

    ``room`` [n or more] is used up. The first samples may be in rising order, which is faster.
    """
    least, rest = least_harm(samples, n) + TIE, math.inf
    for k in range(n):
        if samples.harm[k] <= least:
            rest = min(rest, samples.other[k])
    rest += TIE
    good = 0
    for k in range(n):
        if samples.harm[k] <= least and samples.other[k] <= rest:
            to = good
            while to > 0 and room[to - 1] > samples.at[k]:
                room[to] = room[to - 1]
                to -= 1
            room[to] = samples.at[k]
            good += 1
    return float(room[(good - 1) // 2])


# Many constant decelerations of one vehicle in one world, compiled: what the coupled search asks for.
#
# The harm is that of ``physics.advance`` under constant commands, to the same bits; the motion is not kept. Three
# things make it cheap. Until the vehicle's command takes effect all candidates are one, and that part is moved once. A
# simulation ends as soon as nobody can meet anybody any more (``will_stay_apart``). And it is given up once its harm,
# which never falls again, has reached a bound that the caller names.

DURATION, RESTITUTION, SHARED_S = range(3)  # columns of a line's clock
CLEAR_M, CLEAR_MPS = 1e-6, 1e-6  # margins, a million times what rounding can do to a gap or a speed
_DIGIT = 1_000.0  # impacts of a pair that are told apart


class Line(NamedTuple):
    """One world as candidates run in it, in tables of ``physics.kernel``; an obstacle ahead stands in column 0."""

    start: Floats  # [rows_for(2 K), N or N + 1] with everybody's command but that of the controlled vehicle
    shared: Floats  # the same where that vehicle's command takes effect
    table: Floats  # room
    clock: Floats  # [3] length of a simulation, restitution, time from the start to ``shared``
    controlled: int  # column of the vehicle
    vehicles: int  # column of Vehicle 1
    harm: int  # the row whose sum is minimised
    other: int  # the row of the other count
    no_rows: Floats  # an empty list of impacts


@compiled(apart=True)
def make_line(
    gap: Floats, speed: Floats, hit: Bools, obstacle: float, obstacle_hit: bool, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, in_force: Floats, brake_rate: Floats, release_rate: Floats, pieces: Floats,
    time: float, restitution: float, horizon: float, vehicle: int, total: bool,
) -> Line:  # fmt: skip
    """One world at its ``time``, ready for ``share_start``; an ``obstacle`` that is finitely far is in it."""
    at = 1 if obstacle < math.inf else 0
    vehicles = speed.shape[0]
    table = np.zeros((rows_for(pieces.shape[1]), vehicles + at))
    place_forces(table, in_force, brake_rate, release_rate, pieces)
    if at == 1:
        place_obstacle(table, obstacle, 1.0 if obstacle_hit else 0.0)
        table[ROW.ONSET, 0] = onset_s(0.0, time)
    for i in range(vehicles):
        table[ROW.COMMAND, at + i], table[ROW.SPEED, at + i] = command[i], speed[i]
        table[ROW.MASS, at + i], table[ROW.LIMIT, at + i] = mass[i], limit[i]
        table[ROW.ONSET, at + i] = onset_s(latency[i], time)
    for p in range(vehicles - 1):
        table[ROW.GAP, at + p] = gap[p]
        table[ROW.HIT, at + p] = 1.0 if hit[p] else 0.0
    clock = np.array([horizon - time, restitution, 0.0])
    rows = (ROW.TOTAL_HARM, ROW.FIRST_HARM) if total else (ROW.FIRST_HARM, ROW.TOTAL_HARM)
    return Line(
        table, table.copy(), table.copy(), clock, at + vehicle, at, rows[0], rows[1], np.empty((0, LISTED.WIDTH))
    )


@compiled(apart=True, bare=True)
def share_start(line: Line) -> int:
    """Move the line to where its controlled vehicle's command takes effect; DONE, or what went wrong."""
    table, clock = line.shared, line.clock
    copy_table(line.start, table)
    start_events(table, builds_up(table))
    now = 0.0
    for _ in range(BOUND.MOST_EVENTS):
        if table[ROW.ACTIVE, line.controlled] == 1.0 or now >= clock[DURATION]:
            clock[SHARED_S] = now
            return FLAG.DONE
        if resolve_impacts(table, clock[RESTITUTION]):
            record_impacts(table, now, 0, line.no_rows, 0)
            continue
        sound, now = to_next_event(table, now, clock[DURATION], builds_up(table))
        if not sound:
            return FLAG.PENETRATED
    return FLAG.STUCK


@compiled(apart=True, bare=True)
def simulate(line: Line, samples: Samples, first: int, end: int, bound: float) -> int:
    """Fill what the decelerations ``samples.at[first:end]`` do; DONE, or what went wrong with one of them.

    Where the harm reaches ``bound`` it stands for any harm that is not below it, and the other columns mean nothing.
    """
    for s in range(first, end):
        if s > first and samples.at[s] == samples.at[s - 1]:
            copy_sample(samples, s - 1, samples, s)
            continue
        status = _simulate_one(line, -samples.at[s], bound)
        if status != FLAG.DONE:
            return status
        samples.harm[s] = _sum_row(line, line.harm)
        samples.other[s] = _sum_row(line, line.other)
        samples.course[s] = _course(line)
    return FLAG.DONE


@compiled(within=True)
def _simulate_one(line: Line, command: float, bound: float) -> int:
    """Leave the harm of one candidate in the line's table."""
    table, duration = line.table, line.clock[DURATION]
    table[ROW.COMMAND, line.controlled] = command
    _copy_state(line.start, table)
    building = builds_up(table)
    if move_apart(table, duration, building):
        return FLAG.DONE
    _copy_state(line.shared, table)
    now = line.clock[SHARED_S]
    for _ in range(BOUND.MOST_EVENTS):
        status, now = to_next_impact(table, line.clock[RESTITUTION], now, duration, building)
        if status != FLAG.IMPACT:
            return status
        record_impacts(table, now, 0, line.no_rows, 0)
        if _sum_row(line, line.harm) >= bound or will_stay_apart(table):
            return FLAG.DONE
    return FLAG.STUCK


@compiled(within=True)
def _copy_state(of: Floats, table: Floats) -> None:
    """Put the table into the state of another one; both have the same vehicles."""
    vehicles = table.shape[1]
    for i in range(vehicles):
        table[ROW.SPEED, i] = of[ROW.SPEED, i]
        table[ROW.ACTIVE, i] = of[ROW.ACTIVE, i]
        table[ROW.FORCE, i] = of[ROW.FORCE, i]
        if table.shape[0] > ROW.OF_BUILD_UP:
            table[ROW.NEXT_PIECE, i] = of[ROW.NEXT_PIECE, i]
            if table[ROW.PIECES, i] < math.inf:
                table[ROW.COMMAND, i] = of[ROW.COMMAND, i]
    for p in range(vehicles - 1):
        table[ROW.GAP, p] = of[ROW.GAP, p]
        table[ROW.CONTACT_SPEED, p] = of[ROW.CONTACT_SPEED, p]
        table[ROW.HIT, p] = of[ROW.HIT, p]
        table[ROW.FIRST_HARM, p] = of[ROW.FIRST_HARM, p]
        table[ROW.TOTAL_HARM, p] = of[ROW.TOTAL_HARM, p]
        table[ROW.COUNT, p] = of[ROW.COUNT, p]


@compiled(within=True)
def copy_table(one: Floats, other: Floats) -> None:
    """Copy a whole table."""
    for row in range(one.shape[0]):
        for i in range(one.shape[1]):
            other[row, i] = one[row, i]


@compiled(within=True)
def will_stay_apart(table: Floats) -> bool:
    """Whether surely no pair has another impact, however long everybody's command goes on; False when not sure.

    All commands are in full effect, brake or coast, and nobody moves backward. Every vehicle then keeps the
    acceleration it has (that of its body, where some rest against each other) until it stands. A pair of front ``f``
    and rear ``r`` with gap g, closing speed w and decelerations d has no impact where

    * r stands, or both are one body;
    * ``w <= 0`` and ``d_r >= d_f``: w stays so until r stands, in the kernel's rounding, too;
    * r would stop behind f, ``g + v_f^2 / 2 d_f > v_r^2 / 2 d_r``, the pair is apart (or separates), and if r brakes
      harder while it closes the least gap is positive, too: ``w^2 < 2 (d_r - d_f) g``. (If r brakes less hard, the gap
      is concave until f stands, and falls from then on.) All with margins.
    """
    vehicles, hardest = table.shape[1], 0.0
    if pieces_to_come(table):
        return False
    for i in range(vehicles):
        if table[ROW.ACTIVE, i] == 0.0 or table[ROW.COMMAND, i] > 0.0 or table[ROW.SPEED, i] < 0.0:
            return False
        if builds_up(table) and table[ROW.FORCE, i] != table[ROW.COMMAND, i]:
            return False
        hardest = max(hardest, -table[ROW.COMMAND, i])
    for p in range(vehicles - 1):  # what surely meets is soon told
        closing = table[ROW.SPEED, p + 1] - table[ROW.SPEED, p]
        if closing > 0.0 and closing * closing >= 2.0 * hardest * table[ROW.GAP, p]:
            return False
    accelerate(table)
    for p in range(vehicles - 1):
        front, rear = table[ROW.SPEED, p], table[ROW.SPEED, p + 1]
        gap, closing, harder = (
            table[ROW.GAP, p],
            rear - front,
            table[ROW.ACCELERATION, p] - table[ROW.ACCELERATION, p + 1],
        )
        if rear == 0.0 or table[ROW.JOINED, p] == 1.0 or (closing <= 0.0 and harder >= 0.0):
            continue
        if not (gap > CLEAR_M or closing < -CLEAR_MPS):
            return False
        gap -= CLEAR_M
        if closing > 0.0 and harder > 0.0 and front > 0.0 and not closing * closing < 2.0 * harder * gap:
            return False
        if not gap + _way_to_stop(front, table[ROW.ACCELERATION, p]) > _way_to_stop(
            rear, table[ROW.ACCELERATION, p + 1]
        ):
            return False
    return True


@compiled(within=True)
def _way_to_stop(speed: float, acceleration: float) -> float:
    """How far a vehicle goes that slows down or coasts; infinitely far if it coasts (m)."""
    return speed * speed / (2.0 * abs(acceleration)) if speed > 0.0 else 0.0


@compiled(within=True)
def _course(line: Line) -> float:
    """A number that says how many impacts each pair, and the obstacle, had."""
    course, digit, table = 0.0, 1.0, line.table
    for p in range(line.vehicles, table.shape[1] - 1):
        course += table[ROW.COUNT, p] * digit
        digit *= _DIGIT
    return course + table[ROW.COUNT, 0] * digit if line.vehicles == 1 else course


@compiled(within=True)
def _sum_row(line: Line, row: int) -> float:
    """Sum of a row over the pairs, and the obstacle's entry, in the order in which NumPy adds up a row."""
    table, first, total = line.table, line.vehicles, 0.0
    eights = (table.shape[1] - 1 - first) // 8
    if eights > 0:
        total = _sum_eights(table, row, first, first + 8 * eights)
    for p in range(first + 8 * eights, table.shape[1] - 1):
        total += table[row, p]
    return total + table[row, 0] if line.vehicles == 1 else total


@compiled(apart=True, bare=True)
def _sum_eights(table: Floats, row: int, first: int, end: int) -> float:
    """Sum of whole eights of entries: each place of them by itself, then the places two by two."""
    return (
        (_sum_place(table, row, first, end) + _sum_place(table, row, first + 1, end))
        + (_sum_place(table, row, first + 2, end) + _sum_place(table, row, first + 3, end))
    ) + (
        (_sum_place(table, row, first + 4, end) + _sum_place(table, row, first + 5, end))
        + (_sum_place(table, row, first + 6, end) + _sum_place(table, row, first + 7, end))
    )


@compiled(apart=True, bare=True)
def _sum_place(table: Floats, row: int, first: int, end: int) -> float:
    """Sum of every eighth entry."""
    total = table[row, first]
    for p in range(first + 8, end, 8):
        total += table[row, p]
    return float(total)


# The coupled search of one world, compiled: an even look, a closer one, borders, minima, one step back.
#
# ``coupled`` says what is searched for, docs/baselines.md why in these steps.

GRID = 161  # first look: evenly spaced decelerations from 0 to the capacity
CELLS = 24  # cells of the grid that are looked into, at most
INSIDE = 16  # samples inside such a cell
BORDERS = 6  # borders between two courses of impacts that are located, at most
MINIMA = 6  # local minima of all samples that are followed
_JUMP = 1e-6  # a change of harm (m2/s2) between decelerations 1e-9 m/s2 apart that only a jump explains
_LOOKED = GRID + CANDIDATES + CELLS * INSIDE
_NARROWED = _LOOKED + 2 * BORDERS
_MOST = _NARROWED + MINIMA
_FEW = 6
# Bounds that are no literals, for each of which all physics would be compiled once more:
_ZERO, _ONE, _FIVE, _GRID_END, _CANDIDATES_END = (cast(int, np.int64(k)) for k in (0, 1, 5, GRID, CANDIDATES))
_SHARES = np.linspace(0.0, 1.0, GRID)
_SHARES_INSIDE = np.arange(1, INSIDE + 1) / (INSIDE + 1)
_FIFTHS = np.arange(1, 5) / 5  # new points between the ends of a border


class Room(NamedTuple):
    """What a search works in, the same for every world of a batch."""

    one: Samples  # the grid, later what was looked at
    two: Samples  # what was looked at, at the end with borders and minima
    new: Samples
    few: Samples
    values: Floats
    cells: Ints  # [CELLS] places in a list of samples
    borders: Ints  # [BORDERS]
    minima: Ints  # [MINIMA]


@compiled
def make_room() -> Room:
    """Room for the search of any world."""
    return Room(
        make_samples(_MOST), make_samples(_MOST), make_samples(_MOST), make_samples(_FEW), np.empty(_MOST),
        np.empty(CELLS, np.int64), np.empty(BORDERS, np.int64), np.empty(MINIMA, np.int64),
    )  # fmt: skip


@compiled(apart=True, bare=True)
def search_line(line: Line, room: Room, breakpoints: Floats, capacity: float, out: Floats) -> int:
    """The best deceleration of a line, its harm and that of the other count into ``out`` [3]; DONE, or what went wrong.

    ``breakpoints`` [CANDIDATES] are looked at beside the grid.
    """
    status = share_start(line)
    if status == FLAG.DONE:
        status = look_evenly(line, room, breakpoints, capacity)
    if status == FLAG.DONE:
        status = look_inside(line, room)
    if status == FLAG.DONE:
        status = locate_borders(line, room)
    if status == FLAG.DONE:
        status = narrow_minima(line, room)
    if status == FLAG.DONE:
        status = step_back(line, room.few, choose(room.two, _MOST, room.values), capacity, out)
    return status


@compiled(apart=True, bare=True)
def look_evenly(line: Line, room: Room, breakpoints: Floats, capacity: float) -> int:
    """Samples on the grid in ``room.one``, and with those at the breakpoints in ``room.two``."""
    grid, new = room.one, room.few
    for k in range(GRID):
        grid.at[k] = capacity * _SHARES[k]
    for k in range(CANDIDATES):
        new.at[k] = breakpoints[k]
    put_in_order(new, CANDIDATES)
    status = simulate(line, grid, _ZERO, _GRID_END, math.inf)
    if status == FLAG.DONE:
        status = simulate(line, new, _ZERO, _CANDIDATES_END, math.inf)
    merge(grid, GRID, new, CANDIDATES, room.two)
    return status


@compiled(apart=True, bare=True)
def look_inside(line: Line, room: Room) -> int:
    """Samples inside the cells of the grid that hold a border, or may hide less harm than any sample so far.

    Leaves ``_LOOKED`` samples in ``room.one``: where there are fewer cells, the last one stands for those left.
    """
    grid, looked, new, cells, bounds = room.one, room.two, room.new, room.cells, room.values
    best = least_harm(looked, GRID + CANDIDATES)
    bound_cells(grid, GRID, bounds)
    for k in range(GRID - 1):
        if not (bounds[k] < best or grid.course[k] != grid.course[k + 1]):
            bounds[k] = math.inf
    find_smallest(bounds, GRID - 1, cells)
    found = 0
    while found < CELLS and bounds[cells[found]] < math.inf:
        found += 1
    _put_in_order(cells, found)
    for c in range(found):
        low = grid.at[cells[c]]
        width = grid.at[cells[c] + 1] - low
        for k in range(INSIDE):
            new.at[INSIDE * c + k] = low + width * _SHARES_INSIDE[k]
    status = simulate(line, new, _ZERO, INSIDE * found, math.inf)
    number = GRID + CANDIDATES + INSIDE * found
    merge(looked, GRID + CANDIDATES, new, INSIDE * found, grid)
    for k in range(number, _LOOKED):
        copy_sample(grid, number - 1, grid, k)
    return status


@compiled(bare=True)
def _put_in_order(places: Ints, n: int) -> None:
    """Put the first ``n`` in rising order."""
    for k in range(1, n):
        place, to = places[k], k
        while to > 0 and places[to - 1] > place:
            places[to] = places[to - 1]
            to -= 1
        places[to] = place


@compiled(apart=True, bare=True)
def locate_borders(line: Line, room: Room) -> int:
    """Both sides of the borders between courses of impacts that may hide less harm, 1e-9 m/s2 apart.

    In between, harm is smooth, and what falls toward a border is least there. Leaves all samples in ``room.two``.
    """
    looked, new, few, places, bounds = room.one, room.new, room.few, room.borders, room.values
    best = least_harm(looked, _LOOKED)
    bound_cells(looked, _LOOKED, bounds)
    for k in range(_LOOKED - 1):
        if not (bounds[k] < best and looked.course[k] != looked.course[k + 1]):
            bounds[k] = math.inf
    find_smallest(bounds, _LOOKED - 1, places)
    for b in range(BORDERS):
        copy_sample(looked, places[b], few, 0)
        copy_sample(looked, places[b] + 1, few, 5)
        if bounds[places[b]] < math.inf:
            status = _cut(line, few)
            if status != FLAG.DONE:
                return status
        copy_sample(few, 0, new, 2 * b)
        copy_sample(few, 5, new, 2 * b + 1)
    put_in_order(new, 2 * BORDERS)
    merge(looked, _LOOKED, new, 2 * BORDERS, room.two)
    return FLAG.DONE


@compiled(bare=True)
def _cut(line: Line, few: Samples) -> int:
    """Bring samples 0 and 5 on both sides of a border together, each time to a fifth."""
    while few.at[5] - few.at[0] > NARROWEST_MPS2:
        low, width = few.at[0], few.at[5] - few.at[0]
        for k in range(4):
            few.at[1 + k] = low + width * _FIFTHS[k]
        status = simulate(line, few, _ONE, _FIVE, math.inf)
        if status != FLAG.DONE:
            return status
        border, least = 0, math.inf
        for k in range(5):
            lower = min(few.harm[k], few.harm[k + 1])
            if few.course[k] != few.course[k + 1] and lower < least:
                border, least = k, lower
        copy_sample(few, border + 1, few, 5)  # first: it may be sample 1 that moves to 0
        copy_sample(few, border, few, 0)
    return FLAG.DONE


@compiled(apart=True, bare=True)
def narrow_minima(line: Line, room: Room) -> int:
    """Follow the lowest local minima of the samples down to brackets of 1e-9 m/s2; adds where they end."""
    found, minima, last = room.two, room.minima, _NARROWED - 1
    find_minima(found, _NARROWED, room.values, minima)
    for m in range(MINIMA):
        middle, to = minima[m], _NARROWED + m
        copy_sample(found, middle, found, to)
        if room.values[middle] < math.inf:
            low, high = found.at[max(middle - 1, 0)], found.at[min(middle + 1, last)]
            status = _narrow(line, room.few, low, high, found, to)
            if status != FLAG.DONE:
                return status
    return FLAG.DONE


@compiled(bare=True)
def _narrow(line: Line, few: Samples, low: float, high: float, found: Samples, to: int) -> int:
    """Bring ``low`` and ``high`` together around the least harm, which is that of ``found[to]``.

    Both sides are cut in three each time. Where nothing is lower than the middle, that stays.
    """
    while high - low > NARROWEST_MPS2:
        middle = found.at[to]
        left, right = (middle - low) / 3, (high - middle) / 3
        few.at[0], few.at[1], few.at[2], few.at[3] = low + left, middle - left, middle + right, high - right
        first, end = 0 if left > 0.0 else 2, 4 if right > 0.0 else 2  # the middle itself is known
        status = simulate(line, few, first, end, found.harm[to])
        if status != FLAG.DONE:
            return status
        pick, least = -1, found.harm[to]
        for k in range(first, end):
            if few.harm[k] < least:
                pick, least = k, few.harm[k]
        if pick < 0:
            low, high = few.at[1], few.at[2]
            continue
        low, high = (
            low if pick == 0 else few.at[0] if pick == 1 else middle if pick == 2 else few.at[2],
            few.at[1] if pick == 0 else middle if pick == 1 else few.at[3] if pick == 2 else high,
        )
        copy_sample(few, pick, found, to)
    return FLAG.DONE


@compiled(apart=True, bare=True)
def step_back(line: Line, around: Samples, best: float, capacity: float, out: Floats) -> int:
    """Move a minimum that lies on the very edge of a jump 1e-9 m/s2 to its safe side.

    Otherwise the last bits, which differ when the same motion is advanced step by step, would decide the harm.
    """
    for k in range(5):
        around.at[k] = min(max(best + NARROWEST_MPS2 * (k - 2.0), 0.0), capacity)
    status = simulate(line, around, _ZERO, _FIVE, math.inf)
    pick, least, middle = 1, math.inf, 0.0
    for k in range(3):
        worst = max(max(around.harm[k], around.harm[k + 1]), around.harm[k + 2])
        if worst < least:
            pick, least = k, worst
        if k == 1:
            middle = worst
    if middle - least < _JUMP:
        pick = 1
    out[0], out[1], out[2] = around.at[pick + 1], around.harm[pick + 1], around.other[pick + 1]
    return status


# E-V2X-BM coupled: the best constant deceleration of one vehicle in the engine's own physics.
#
# The closed form of ``pairwise`` treats the pairs as independent. Here every candidate is simulated to the horizon with
# velocity exchange, second impacts and resting contact, so the harm found is the harm realised: the only one of the
# three baselines that may bound a shield. docs/baselines.md says how close to the true minimum the search comes.

_MANY = 200  # worlds to search: fewer are neither remembered nor shared between threads
_REMEMBERED = 32  # searches: the baseline's, which a shield around another agent asks for in the same worlds
_FOUND: dict[bytes, Floats] = {}  # by the SHA-256 of all that was asked


class CoupledOptimum(NamedTuple):
    """The best constant deceleration found in each world [n]."""

    deceleration_mps2: Floats  # a*, in [0, braking capacity]
    harm: Floats  # realised, under the count that was minimised (m2/s2)
    first_impact_harm: Floats  # realised with a*
    total_harm: Floats  # realised with a*


def optimise_coupled(
    worlds: Worlds,
    vehicle: int,
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    others_mps2: Floats | None = None,
) -> CoupledOptimum:
    """Constant deceleration of ``vehicle`` (index from 0) with the least realised harm until ``horizon_s``.

    The other vehicles follow ``others_mps2`` [n, N], signed accelerations (default: full braking of all; the
    controlled vehicle's column is ignored). If braking in the middle of the pairwise collision-free interval
    proves harmless, it is taken. Otherwise an even grid and the pairwise breakpoints are simulated; where the number of
    impacts changes, one smooth piece of the harm ends, and that border is located to 1e-9 m/s2; so are the best local
    minima, on the safe side where the harm jumps. Equal harms are decided by the other count, then by the middle one of
    the equal decelerations. A world's result does not depend on the batch it is in.

    Raises ``InvalidInput`` for an unknown ``vehicle`` or ``harm_count`` or others beyond their capacities,
    ``PhysicsError`` naming the worlds in which some candidate could not be simulated as far as it was needed.
    """
    check_harm_count(harm_count)
    capacity = worlds.vehicles.braking_capacity_mps2
    command = -capacity if others_mps2 is None else np.array(others_mps2, dtype=np.float64)
    # The closed form lets the others brake with all their capacity: it is what they are told. Who is told to coast or
    # to drive keeps the capacity: the closed form cannot say what that one does.
    braking = np.where(command < 0.0, -command, capacity)
    braking[:, vehicle] = capacity[:, vehicle]
    told = replace(worlds, vehicles=replace(worlds.vehicles, braking_capacity_mps2=braking))
    best = _closed_form(told, vehicle).deceleration_mps2  # where brakes build up, no more than a first guess
    command[:, vehicle] = -best
    _, impacts = advance(worlds, command, until_s=horizon_s)
    first = impacts.first_impact_harm.sum(axis=1) + impacts.obstacle_first_harm
    total = impacts.total_harm.sum(axis=1) + impacts.obstacle_total_harm
    hit = np.flatnonzero(total > 0.0)
    if hit.size:
        found = _minimise(worlds, told, command, vehicle, hit, harm_count, horizon_s)
        harms = (first, total) if harm_count == "first" else (total, first)
        for column, values in zip((best, *harms), found, strict=True):
            column[hit] = values
    return CoupledOptimum(best, first if harm_count == "first" else total, first, total)


def _minimise(
    worlds: Worlds, told: Worlds, command: Floats, vehicle: int, rows: Ints, harm_count: HarmCount, horizon_s: float
) -> Floats:
    """Best deceleration of worlds ``rows`` [m], its harm and that of the other count: [3, m]."""
    v = worlds.vehicles
    lines = (
        worlds.gaps_m, worlds.speeds_mps, worlds.time_s, worlds.pair_hit, worlds.obstacle_gap_m, worlds.obstacle_hit,
        command, told.vehicles.braking_capacity_mps2, _onset_s(worlds, vehicle), v.latency_s, v.mass_t,
        v.speed_limit_mps, worlds.command_mps2, v.brake_rate_mps3, v.release_rate_mps3, v.pieces, v.restitution,
    )  # fmt: skip
    question = hashlib.sha256(repr((vehicle, harm_count, horizon_s, worlds.speeds_mps.shape)).encode())
    for column in (rows, *lines):
        question.update(np.ascontiguousarray(column).tobytes())
    key = question.digest()
    if key in _FOUND:
        return _FOUND[key].copy()

    def search(part: slice) -> tuple[Floats, Ints]:
        some = rows[part]
        found, status = np.empty((3, some.size)), np.empty(some.size, np.int64)
        _search_worlds(*lines, vehicle, some, harm_count == "total", horizon_s, found, status)
        return found, status

    parts = by_parts(search, rows.size, (os.cpu_count() or 1) if rows.size >= _MANY else 1)
    found, status = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    if (status != FLAG.DONE).any():
        with renumbered(rows):
            raise FLAG.failure(status, worlds.time_s[rows], np.full(rows.size, horizon_s))
    if rows.size >= _MANY:
        _FOUND[key] = found.copy()
        for old in list(_FOUND)[:-_REMEMBERED]:
            _FOUND.pop(old, None)
    return found


@compiled
def _search_worlds(
    gaps: Floats, speeds: Floats, time: Floats, hit: Bools, obstacle: Floats, obstacle_hit: Bools, command: Floats,
    capacity: Floats, onset: Floats, latency: Floats, mass: Floats, limit: Floats, in_force: Floats, brake_rate: Floats,
    release_rate: Floats, pieces: Floats, restitution: Floats, vehicle: int, rows: Ints, total: bool, horizon: float,
    found: Floats, status: Ints,
) -> None:  # fmt: skip
    """Fill ``found`` [3, m] and ``status`` [m] for worlds ``rows`` [m]."""
    room, at, best = make_room(), np.empty(CANDIDATES), np.empty(3)
    for m in range(rows.shape[0]):
        k = rows[m]
        line = make_line(
            gaps[k], speeds[k], hit[k], obstacle[k], obstacle_hit[k], command[k], latency[k], mass[k], limit[k],
            in_force[k], brake_rate[k], release_rate[k], pieces[k], time[k], restitution[k], horizon, vehicle, total,
        )  # fmt: skip
        find_breakpoints(at, vehicle, gaps[k], speeds[k], capacity[k], onset[k])
        status[m] = search_line(line, room, at, capacity[k, vehicle], best)
        for c in range(3):
            found[c, m] = best[c]


Mode = Literal["coupled", "pairwise"]


class EV2XBM:
    """The constant deceleration of least harm.

    ``coupled`` minimises the harm realised in the engine's physics until ``horizon_s`` under ``harm_count``, the
    others following their scripts, and all vehicles without one (learners) braking fully. ``pairwise`` is the paper's
    closed form: everybody else brakes fully, and no velocities are exchanged. It remembers ``deceleration_mps2`` [n],
    which is a*, and ``predicted_harm`` [n], what each of them expects (m2/s2). Raises ``InvalidInput`` for an unknown
    mode or count, and, when an episode begins, in ``coupled`` mode for another vehicle's script whose command is not
    fixed at the alert.
    """

    def __init__(self, mode: Mode = "coupled", *, harm_count: HarmCount = "first", horizon_s: float = 8.0) -> None:
        if mode not in ("coupled", "pairwise"):
            raise InvalidInput(f"e_v2x_bm mode {mode!r}: must be 'coupled' or 'pairwise'")
        check_harm_count(harm_count)
        self.name = "e_v2x_bm" if mode == "coupled" else "e_v2x_bm:pairwise"
        self.knows = Source.MODEL if mode == "coupled" else Source.STATE
        self._mode, self._harm_count, self._horizon_s = mode, harm_count, horizon_s

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Choose a* from the worlds at the alert."""
        if self._mode == "pairwise":
            closed = optimise_pairwise(alert, vehicle)
            return {"deceleration_mps2": closed.deceleration_mps2, "predicted_harm": closed.harm}

        def is_fixed(script: Script) -> bool:
            """Whether its command does not wait for that of ``vehicle``, which is scripted itself or free to decide."""
            chooses_first = isinstance(script, EV2XBM) and (script._mode == "pairwise" or vehicle not in scripts)
            return is_state_free(script) or chooses_first

        others = fixed_commands(
            scripts, alert, f"agent {self.name!r}", vehicle=vehicle, is_fixed=is_fixed,
            advice=f" before vehicle_{vehicle + 1} chooses; take e_v2x_bm:pairwise, which needs nobody's command, for"
            " one of the two",
        )  # fmt: skip
        coupled = optimise_coupled(
            alert, vehicle, harm_count=self._harm_count, horizon_s=self._horizon_s, others_mps2=others
        )
        return {"deceleration_mps2": coupled.deceleration_mps2, "predicted_harm": coupled.harm}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """``-a*``, [n] m/s2."""
        return -memory["deceleration_mps2"], memory


def make_e_v2x_bm(argument: str | None, settings: AgentSettings) -> Agent:
    """``e_v2x_bm``, the same as ``e_v2x_bm:coupled``, or ``e_v2x_bm:pairwise``; ``:believed`` behind: believing."""
    if argument not in (None, "coupled", "pairwise"):
        raise InvalidInput(f"agent {settings.spec!r}: the argument must be 'coupled' or 'pairwise', then 'believed'")
    mode: Mode = "pairwise" if argument == "pairwise" else "coupled"
    agent = EV2XBM(mode, harm_count=settings.harm_count, horizon_s=settings.horizon_s)
    return Believing(agent, settings.needed_scenario()) if settings.believes else agent


# Scripts: full braking, coasting, a constant, and two baselines that know only the vehicle in front.


class StateFree:
    """``full_brake``, ``coast`` or ``constant:a`` (deceleration in m/s2): the same command whatever happens.

    Of a ``profile`` it is the first piece's; the engine goes on to the others (``Worlds.play_pieces``).

    ``full_brake`` of every vehicle is the paper's non-ethical strategy. Raises ``InvalidInput`` for any other script
    and for a constant beyond the vehicle's capacity.
    """

    state_free = True
    knows = Source.SENSORS

    def __init__(self, spec: str) -> None:
        if not ScriptSpec.parse(spec).is_state_free():
            raise InvalidInput(f"agent {spec!r}: must be full_brake, coast or constant:a")
        self.name, self.braking_pieces = spec, ScriptSpec.parse(spec).pieces

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The constant command, [n] m/s2."""
        vehicles = worlds.vehicles
        command = ScriptSpec.parse(self.name).command(
            vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
        )
        assert command is not None
        return command


def make_script(argument: str | None, settings: AgentSettings) -> Agent:
    """The script of that name."""
    return StateFree(settings.spec)


# What this package's entry points name (pyproject.toml).


COAST = Part(make_script, form="coast", about="nothing at all", knows=Source.SENSORS)
FULL_BRAKE = Part(
    make_script, form="full_brake", about="full braking, the paper's non-ethical strategy", knows=Source.SENSORS
)
CONSTANT = Part(
    make_script, form="constant:A", about="this deceleration in m/s2; negative drives", knows=Source.SENSORS
)
PROFILE = Part(make_script, form="profile:0=A,S=B", about="in pieces; of roles alone", knows=Source.SENSORS)
E_V2X_BM = Part(
    make_e_v2x_bm,
    form="e_v2x_bm[:pairwise][:believed]",
    about="the best constant deceleration in this simulation; pairwise: the paper's closed form, from the true state;"
    " believed: on what was received, and the scenario's ranges for the rest",
    knows=Source.MODEL,
)
