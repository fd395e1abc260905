"""E-V2X-BM in closed form: the constant deceleration of one vehicle that minimises the predicted harm of its pairs.

The prediction assumes that the neighbours of the controlled vehicle brake with full capacity after their own latencies.
It also assumes that only the first contact of each pair does harm and that impacts change no speed, so that the pair in
front and the pair behind do not influence each other. The predicted harm is ``H(a) = c_front(a)^2 + c_rear(a)^2``
(m2/s2). Here ``a`` is the controlled vehicle's deceleration (m/s2), and ``c_front`` and ``c_rear`` are the closing
speeds (m/s) at its first contact with the vehicle in front and with the vehicle behind. A formula yields a few
decelerations, called *breakpoints*. Between two neighbouring breakpoints H(a) is concave, so H(a) is least at a
breakpoint. docs/internals/proofs/constant-deceleration.md has the derivation.

Arguments that several functions share, for one world: index ``i`` of the controlled vehicle (0 = front), gaps ``gap``
[P] m, speeds ``speed`` [N] m/s, braking capacities ``capacity`` [N] m/s2, and ``onset`` [N] s, the time from now until
each vehicle may brake. Arguments for n worlds have a first axis of length n.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.e_v2x_bm.contacts import (
    TOUCH_SQUARED,
    closing_speed_squared,
    least_to_spare_front,
    most_to_spare_rear,
)
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Floats, Worlds

CANDIDATES = 6  # 0, capacity, two thresholds, and two more if the vehicle may brake before its front neighbour

_TIE = 1e-12  # harms closer than this, relative to 1 + harm, count as equal


class PairwiseOptimum(NamedTuple):
    """Result of the closed form: the best constant deceleration of one vehicle in each of n worlds."""

    deceleration_mps2: Floats  # [n] best deceleration a*, in [0, braking capacity]
    harm: Floats  # [n] predicted harm with a*, called H* (m2/s2)
    spares_front_mps2: Floats  # [n] smallest deceleration without an impact in front (m/s2); inf if there is none
    spares_rear_mps2: Floats  # [n] largest deceleration without an impact behind (m/s2); inf: all, -inf: none
    breakpoints_mps2: Floats  # [n, 6] decelerations at which the harm may have its minimum, unordered (m/s2)


@compiled
def early_breakpoints(gap: float, w: float, onset_l: float, onset_f: float) -> tuple[float, float]:
    """Return two decelerations (m/s2) of the follower: at the first, the pair's harm has a kink; at the second, a jump.

    Both decelerations are 0 unless the follower may brake before the leader (front vehicle). ``onset_l`` and
    ``onset_f`` are the times (s) from now until the leader begins to brake and until the follower may brake; ``gap``
    (m) and the closing speed ``w`` (m/s) are the values now. In the formulas, however, ``gap`` is the gap at the moment
    when the follower begins to brake, and ``lead`` is the time from this moment until the leader begins to brake.

    - Kink, at ``2 (w lead - gap) / lead^2``: with this deceleration, the contact happens exactly when the leader begins
      to brake.
    - Jump, at ``w^2 / (2 gap)``: with a slightly smaller deceleration, the follower strikes the coasting leader
      lightly. With a larger deceleration, the follower does not reach the coasting leader, but may strike the leader
      harder once the leader brakes. The returned deceleration lies just below the jump, where the impact is lightest.
    """
    lead = onset_l - onset_f
    if lead <= 0.0:
        return 0.0, 0.0
    gap = gap - w * onset_f
    return 2.0 * (w * lead - gap) / (lead * lead), (w * w - 4.0 * TOUCH_SQUARED) / (2.0 * gap)


@compiled
def front_harm(a: float, i: int, gap: Floats, speed: Floats, capacity: Floats, onset: Floats) -> float:
    """Return the predicted harm (m2/s2) of an impact of vehicle ``i`` with the vehicle in front; 0 for Vehicle 1.

    Vehicle ``i`` brakes with ``a`` m/s2, and the vehicle in front brakes with its full capacity.
    """
    if i == 0:
        return 0.0
    return closing_speed_squared(gap[i - 1], speed[i - 1], capacity[i - 1], onset[i - 1], speed[i], a, onset[i])


@compiled
def rear_harm(a: float, i: int, gap: Floats, speed: Floats, capacity: Floats, onset: Floats) -> float:
    """Return the predicted harm (m2/s2) of an impact of vehicle ``i`` with the vehicle behind; 0 for the last vehicle.

    Vehicle ``i`` brakes with ``a`` m/s2, and the vehicle behind brakes with its full capacity.
    """
    if i == gap.shape[0]:
        return 0.0
    return closing_speed_squared(gap[i], speed[i], a, onset[i], speed[i + 1], capacity[i + 1], onset[i + 1])


@compiled
def find_breakpoints(
    at: Floats, i: int, gap: Floats, speed: Floats, capacity: Floats, onset: Floats
) -> tuple[float, float]:
    """Write to ``at`` [6] the decelerations (m/s2) of vehicle ``i`` at which its predicted harm may be least.

    All decelerations in ``at`` are in [0, braking capacity]. Returns two more decelerations (m/s2), which may be
    infinite: the smallest deceleration that avoids an impact with the vehicle in front, and the largest deceleration
    that avoids an impact with the vehicle behind.
    """
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
    """Return the deceleration (m/s2) of vehicle ``i`` for which the predicted harm is least, and this harm (m2/s2).

    Only the six decelerations in ``at`` (m/s2) are compared. If several of them have the least harm, the result is the
    middle between the smallest and the largest of these if the middle does as little harm, otherwise the smallest.
    """
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
    """Find the best constant deceleration of vehicle ``i`` in n worlds, in closed form.

    ``at`` [n, 6] receives the decelerations that ``find_breakpoints`` writes (m/s2). ``out`` [4, n] receives the best
    deceleration, its predicted harm, and the two decelerations that ``find_breakpoints`` returns.
    """
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
    """Write to ``out`` [n, P] the squared closing speed (m2/s2) at each pair's first impact, or 0 without an impact.

    It is assumed that impacts change no speed, so that pairs do not influence each other. In world k, vehicle j coasts
    for ``onset[k, j]`` seconds and then brakes with the constant ``deceleration[k, j]`` m/s2.
    """
    for k in range(gaps.shape[0]):
        for p in range(gaps.shape[1]):
            out[k, p] = closing_speed_squared(
                gaps[k, p], speeds[k, p], deceleration[k, p], onset[k, p],
                speeds[k, p + 1], deceleration[k, p + 1], onset[k, p + 1],
            )  # fmt: skip


def optimise_pairwise(worlds: Worlds, vehicle: int) -> PairwiseOptimum:
    """Return the best constant deceleration a* of ``vehicle`` (index from 0) in every world, in closed form.

    ``a*`` minimises the predicted harm ``H(a)`` (module docstring) over ``a`` in [0, capacity]. If an interval of
    decelerations avoids both impacts, ``a*`` is the middle of this interval; otherwise ``a*`` is the breakpoint with
    the least H. The first and the last vehicle of a line have one neighbour, so H has only one of the two terms. Only
    gaps, speeds, capacities and latencies of the vehicle and its neighbours are used.

    Raises ``InvalidInput`` if ``vehicle`` is not in the line, if a vehicle moves backward, or if brakes build up
    gradually.
    """
    worlds.refuse_build_up("the closed form of E-V2X-BM")
    return closed_form(worlds, vehicle)


def closed_form(worlds: Worlds, vehicle: int) -> PairwiseOptimum:
    """Do the same as ``optimise_pairwise``, but treat brakes that build up gradually as if they acted at once."""
    onset, capacity = onset_s(worlds, vehicle), worlds.vehicles.braking_capacity_mps2
    at, out = np.empty((worlds.n, CANDIDATES)), np.empty((4, worlds.n))
    optimise_worlds(worlds.gaps_m, worlds.speeds_mps, capacity, onset, vehicle, at, out)
    deceleration, harm, front, rear = out
    return PairwiseOptimum(deceleration, harm, front, rear, at)


def pairwise_harm(worlds: Worlds, deceleration_mps2: ArrayLike) -> Floats:
    """Return the predicted harm of each pair, [n, P] m2/s2, as if no pair influenced another pair.

    Every vehicle coasts until its latency has elapsed, and then brakes to rest with the constant ``deceleration_mps2``,
    [n, N] or a shape that broadcasts to [n, N]. The harm that E-V2X-BM predicts for a vehicle is the sum of the
    predicted harms of the pairs that contain this vehicle.

    Raises ``InvalidInput`` for a deceleration that is negative or not finite, and for brakes that build up gradually.
    """
    worlds.refuse_build_up("the closed form of E-V2X-BM")
    onset = onset_s(worlds, 0)
    deceleration = np.array(np.broadcast_to(np.asarray(deceleration_mps2, np.float64), worlds.speeds_mps.shape))
    good = (deceleration >= 0.0) & np.isfinite(deceleration)
    if not good.all():
        k, i = (int(x) for x in np.argwhere(~good)[0])
        raise InvalidInput(f"deceleration_mps2[{k}, {i}] = {deceleration[k, i]:g}: must be finite and >= 0")
    out = np.empty_like(worlds.gaps_m)
    contacts_of_worlds(worlds.gaps_m, worlds.speeds_mps, deceleration, onset, out)
    return out


def onset_s(worlds: Worlds, vehicle: int) -> Floats:
    """Return the time from now until each vehicle may brake, [n, N] s; 0 for a vehicle that may brake now.

    Raises ``InvalidInput`` if no vehicle has the index ``vehicle``, or if a speed is negative, because the closed form
    then does not apply.
    """
    if not 0 <= vehicle < worlds.N:
        raise InvalidInput(f"vehicle = {vehicle}: must be an index from 0 to {worlds.N - 1}")
    if not np.all(worlds.speeds_mps >= 0.0):
        k, i = (int(x) for x in np.argwhere(~(worlds.speeds_mps >= 0.0))[0])
        raise InvalidInput(
            f"speeds_mps[{k}, {i}] = {worlds.speeds_mps[k, i]:g}: must be at least 0, because the formula"
            " for a pair holds only then"
        )
    onset: Floats = np.maximum(worlds.vehicles.latency_s - worlds.time_s[:, None], 0.0)
    return onset
