"""Compute the smallest possible closing speed of a pair's first contact, whatever the vehicles do.

The bound compares every motion of the pair with one extreme motion of each vehicle. The leader (front vehicle) goes as
far ahead as it can: it drives fully if it is controlled, and brakes fully otherwise. The follower brakes fully, so it
stays as far behind as it can. If the extreme motions lead to contact, every other motion of the pair leads to contact
at the same time or earlier. docs/internals/proofs/team-bound.md has the proof.

In this file ``at`` describes one pair, [PAIR_WIDTH], in the columns ``PAIR_GAP`` to ``FOLLOWER_A``. ``plan`` and
``other`` are working memory, arrays from ``empty_plan``.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.line import TOUCH_HARM
from ethbrake_marl.extensions.proofs.plans import empty_plan, fill_braking, fill_plan, time_to_limit, walk
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats

# columns of a pair: gap; speed, onset and braking capacity of both vehicles; whether the leader is controlled; driving
# capacity and speed limit of a controlled leader
PAIR_GAP, LEADER_V, LEADER_ONSET, LEADER_A, LEADER_FREE, LEADER_U, LEADER_LIMIT = range(7)

FOLLOWER_V, FOLLOWER_ONSET, FOLLOWER_A, PAIR_WIDTH = range(7, 11)


@compiled(apart=True)
def least_on_piece(constant: float, pressing: float, since: float, until: float) -> float:
    """Return the smallest value of ``(constant / t) + (pressing * t / 2)`` for ``t`` from ``since`` to ``until``."""
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


@compiled(apart=True)
def least_before(at: Floats, met: float, squared: float) -> float:
    """Return the smallest closing speed (m/s) of a pair's first contact until ``met``, for a leader that follows a
    script.

    If the first contact happens at the time t (s), its closing speed is at least ``c(t) + (g(t) / t)``. Here c(t) and
    g(t) are the closing speed (m/s) and the gap (m) at the time t if both vehicles brake fully. ``g(t) / t`` is the
    additional speed that the follower needs to close the gap g(t) by the time t. ``met`` is the time (s) of the contact
    in the extreme motions, and ``squared`` its squared closing speed (m2/s2).
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


@compiled(apart=True)
def least_closing_of_pair(at: Floats, until: float, plan: Floats, other: Floats) -> tuple[float, float]:
    """Return the smallest closing speed (m/s) of a pair's first contact, and the latest time of that contact (s).

    The results are 0 and infinity if contact before the horizon ``until`` (s) is not certain.
    """
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
    """Compute a lower bound (m2/s2) on the harm of each of ``n`` pairs, whatever the vehicles do, and write it to
    ``out`` [n].

    ``pairs`` is [n, PAIR_WIDTH]; ``until`` [n] is the horizon (s), after which harm does not count. A contact without
    impact counts as 0.
    """
    plan, other = empty_plan(), empty_plan()
    for k in range(pairs.shape[0]):
        closing = least_closing_of_pair(pairs[k], until[k], plan, other)[0]
        out[k] = closing * closing if closing * closing > TOUCH_HARM else 0.0
