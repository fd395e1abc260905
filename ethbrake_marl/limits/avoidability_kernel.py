"""Compiled decision of one world: the largest trajectory behind the front vehicle, and whether the rear one meets it.

Symbols: l the front vehicle (leader), f the controlled one (follower), r the rear one; gap [m], speed v [m/s], braking
capacity a > 0, driving capacity u >= 0 [m/s2]. Times count from the moment at which the controlled vehicle may act; by
then the leader brakes. docs/avoidability.md derives every formula. Only + - * / and sqrt.
"""

from __future__ import annotations

import math

from ethbrake_marl.limits.walk import empty_plan, fill_braking, fill_plan, time_to_limit, walk
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.events import TOUCH_SPEED_MPS, solo_motion
from ethbrake_marl.physics.worlds import Floats

ROUNDING_M = 1e-12  # an overlap up to this is the rounding of a touch, not an impact
SQUEEZE_M = 1e-9  # with less room than this between both neighbours, contact counts as unavoidable
TOUCHING_M = 1e-5  # the same where the front vehicle cannot but be touched: a touch may cost that much of the way
AVOIDABLE, EARLY, FRONT, REAR = 0, 1, 2, 3
REASON, MARGIN, SPARE, DRIVE, TOUCH, FOLLOW, RESULT_WIDTH = range(7)  # columns of a decision


@compiled
def spare_gap(gap: float, v_l: float, a_l: float, v_f: float, a_f: float) -> float:
    """Gap beyond what full braking from now needs to stay behind a leader that brakes from now; negative: they meet.

    If the follower stops last, its stopping distance counts, else the moment of equal speeds. [m]
    """
    if v_f * a_l >= v_l * a_f:
        return gap - max(0.0, v_f * v_f / (2.0 * a_f) - v_l * v_l / (2.0 * a_l))
    if v_f > v_l:
        return gap - (v_f - v_l) * (v_f - v_l) / (2.0 * (a_f - a_l))
    return gap


@compiled
def drive_before_braking(
    gap: float, v_l: float, a_l: float, v_f: float, a_f: float, u: float
) -> tuple[float, float, bool]:
    """Longest drive with constant ``u >= 0`` after which full braking still stays behind the braking leader.

    Returns its duration, the time of the touch, and whether both move there (then ``a_f > a_l``, equal speeds; else the
    follower comes to rest at the standing leader). Infinite where the follower never moves. Assumes ``spare_gap >= 0``.
    """
    w, closing, relief = v_f - v_l, u + a_l, a_f - a_l
    if relief > 0.0 and v_l > 0.0:
        both = u + a_f
        root = math.sqrt(both * relief * (w * w + 2.0 * closing * gap))
        if w > 0.0:
            drive = max(2.0 * relief * gap - w * w, 0.0) / (w * both + root)
        else:
            drive = (root - w * both) / (closing * both)
        touch = drive + (w + closing * drive) / relief
        if touch * a_l <= v_l:
            return drive, touch, True
    ratio = 1.0 + u / a_f
    room = max(v_l * v_l / (2.0 * a_l) + gap - v_f * v_f / (2.0 * a_f), 0.0)
    pace = ratio * v_f + math.sqrt(ratio * ratio * v_f * v_f + 2.0 * u * ratio * room)
    if v_f == 0.0 and u == 0.0:
        return math.inf, math.inf, False
    drive = 2.0 * room / pace if room > 0.0 else 0.0
    return drive, drive + (v_f + u * drive) / a_f, False


@compiled
def largest_behind(
    gap: float, v_l: float, a_l: float, v_f: float, a_f: float, u: float, limit: float
) -> tuple[float, float, bool]:
    """As ``drive_before_braking``, for a drive that ends at the speed limit."""
    cap = time_to_limit(v_f, u, limit)
    if cap > 0.0:
        found = drive_before_braking(gap, v_l, a_l, v_f, a_f, u)
        if found[0] <= cap:
            return found
        after_l, way_l, _ = solo_motion(v_l, -a_l, 0.0, math.inf, cap)
        gap = gap + (way_l - 0.5 * (v_f + limit) * cap)
        v_l, v_f = after_l, limit
    drive, touch, moving = drive_before_braking(gap, v_l, a_l, v_f, a_f, 0.0)
    return cap + drive, cap + touch, moving


@compiled
def lowest_while_coasting(gap: float, v_f: float, v_r: float, a_r: float, onset_r: float, until: float) -> float:
    """Smallest gap behind a vehicle that coasts until then. The gap is convex: at equal speeds or at an end. [m]"""
    w = v_r - v_f
    if w <= 0.0:
        return gap
    if onset_r + w / a_r < until:
        return gap - w * onset_r - w * w / (2.0 * a_r)
    return gap + v_f * until - solo_motion(v_r, -a_r, onset_r, math.inf, until)[1]


@compiled
def met(gap: float, closing: float) -> bool:
    """Whether a pair with this gap and closing speed has met, or meets at this very moment, with an impact."""
    return gap < -ROUNDING_M or (gap <= 0.0 and closing > TOUCH_SPEED_MPS)


@compiled
def leader_at_onset(
    gap: float, v_l: float, a_l: float, onset_l: float, v_f: float, start: float
) -> tuple[float, float]:
    """Gap to the leader and its speed when the follower, coasting until then, may act; the leader brakes by then.

    The gap is concave until then: if it is not negative at the end, it never was.
    """
    after, way, _ = solo_motion(v_l, -a_l, onset_l, math.inf, start)
    return gap + (way - v_f * start), after


@compiled
def decide_front(gap: Floats, speed: Floats, onset: Floats, braking: Floats, i: int, out: Floats) -> bool:
    """The front pair of vehicle ``i``: False if it surely meets. REASON, MARGIN and SPARE in ``out``; no drive yet."""
    a_l, v_f, a_f = braking[i - 1], speed[i], braking[i]
    ahead, v_l = leader_at_onset(gap[i - 1], speed[i - 1], a_l, onset[i - 1], v_f, onset[i])
    out[REASON], out[MARGIN] = EARLY, ahead
    if met(ahead, v_f - v_l):
        return False
    spare = spare_gap(max(ahead, 0.0), v_l, a_l, v_f, a_f)
    out[REASON], out[MARGIN], out[SPARE], out[DRIVE] = FRONT, spare, max(spare, 0.0), 0.0
    if spare < -ROUNDING_M:
        return False
    out[REASON] = AVOIDABLE
    return True


@compiled
def plan_behind(
    gap: Floats, speed: Floats, onset: Floats, braking: Floats, driving: Floats, limit: Floats, i: int, keep: float,
    plan: Floats, out: Floats,
) -> None:  # fmt: skip
    """The largest trajectory that keeps ``keep`` metres to the leader, if there is one, into ``plan`` and ``out``."""
    a_f, u = braking[i], driving[i]
    if i > 0:
        a_l = braking[i - 1]
        ahead, v_l = leader_at_onset(gap[i - 1], speed[i - 1], a_l, onset[i - 1], speed[i], onset[i])
        ahead = max(ahead - keep, 0.0)
        out[DRIVE], out[TOUCH], moving = largest_behind(ahead, v_l, a_l, speed[i], a_f, u, limit[i])
        out[FOLLOW] = -a_l if moving else -a_f
    cap = min(time_to_limit(speed[i], u, limit[i]), out[DRIVE])
    fill_plan(plan, cap, u, out[DRIVE], 0.0, out[TOUCH], -a_f, out[FOLLOW])


@compiled
def meets_rear_early(gap: Floats, speed: Floats, onset: Floats, braking: Floats, i: int, out: Floats) -> bool:
    """Whether the rear pair of vehicle ``i`` meets before the vehicle may act; then the reason is in ``out``."""
    v_f, v_r, a_r, start = speed[i], speed[i + 1], braking[i + 1], onset[i]
    lowest = lowest_while_coasting(gap[i], v_f, v_r, a_r, onset[i + 1], start)
    after, way, _ = solo_motion(v_r, -a_r, onset[i + 1], math.inf, start)
    if met(lowest, 0.0) or met(gap[i] + (v_f * start - way), after - v_f):
        out[REASON], out[MARGIN] = EARLY, lowest
        return True
    return False


@compiled
def decide_rear(
    gap: Floats, speed: Floats, onset: Floats, braking: Floats, driving: Floats, limit: Floats, i: int, plan: Floats,
    rear: Floats, out: Floats,
) -> None:  # fmt: skip
    """Whether the rear vehicle stays behind the largest trajectory of vehicle ``i``; plan and rear are scratch."""
    v_f, a_r, start = speed[i], braking[i + 1], onset[i]
    v_r, way, _ = solo_motion(speed[i + 1], -a_r, onset[i + 1], math.inf, start)
    behind = max(gap[i] + (v_f * start - way), 0.0)
    onset_r = max(onset[i + 1] - start, 0.0)
    fill_braking(rear, onset_r, a_r)
    plan_behind(gap, speed, onset, braking, driving, limit, i, 0.0, plan, out)
    margin = walk(behind, v_f, plan, v_r, rear, onset_r + v_r / a_r)[0]
    out[MARGIN] = margin
    if margin < -ROUNDING_M:
        out[REASON] = REAR
    elif i > 0:
        if behind > SQUEEZE_M and margin < (SQUEEZE_M if out[SPARE] >= SQUEEZE_M else TOUCHING_M):
            out[REASON] = REAR
        keep = 0.5 * min(SQUEEZE_M, out[SPARE], max(margin, 0.0))
        plan_behind(gap, speed, onset, braking, driving, limit, i, keep, plan, out)


@compiled
def decide_world(
    gap: Floats, speed: Floats, onset: Floats, braking: Floats, driving: Floats, limit: Floats, i: int, plan: Floats,
    rear: Floats, out: Floats,
) -> None:  # fmt: skip
    """Decide one world into ``out`` [RESULT_WIDTH]; plan and rear are scratch. Times count from the onset of ``i``."""
    out[REASON], out[MARGIN], out[SPARE] = AVOIDABLE, math.inf, math.inf
    out[DRIVE], out[TOUCH], out[FOLLOW] = math.inf, math.inf, -braking[i]
    has_rear = i < gap.shape[0]
    if i > 0 and not decide_front(gap, speed, onset, braking, i, out) and out[REASON] == EARLY:
        return
    if has_rear and meets_rear_early(gap, speed, onset, braking, i, out):
        return
    if has_rear and out[REASON] == AVOIDABLE:
        decide_rear(gap, speed, onset, braking, driving, limit, i, plan, rear, out)


@compiled
def decide_worlds(
    gaps: Floats, speeds: Floats, onset: Floats, braking: Floats, driving: Floats, limit: Floats, i: int, out: Floats
) -> None:
    """Decide every world into ``out`` [n, RESULT_WIDTH]."""
    plan, rear = empty_plan(), empty_plan()
    for k in range(gaps.shape[0]):
        decide_world(gaps[k], speeds[k], onset[k], braking[k], driving[k], limit[k], i, plan, rear, out[k])
