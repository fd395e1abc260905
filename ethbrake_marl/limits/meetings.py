"""Compiled: when the controlled vehicle meets a neighbour, and what harm must then follow at the other one.

Times count from the moment at which the controlled vehicle may act; the front vehicle (leader, l) brakes by then, f is
the controlled one, the rear vehicle (r) coasts to its onset and then brakes. All speeds and gaps are >= 0.
docs/avoidability.md has the proofs.
"""

from __future__ import annotations

import math

from ethbrake_marl.limits.walk import (
    fill_brake_then_drive,
    fill_braking,
    fill_drive_then_brake,
    fill_plan,
    walk,
)
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.events import solo_motion
from ethbrake_marl.physics.worlds import Floats

# one world when the controlled vehicle may act
GAP_L, V_L, A_L = 0, 1, 2
V_F, A_F, U_F, LIMIT_F = 3, 4, 5, 6
GAP_R, V_R, A_R, ONSET_R = 7, 8, 9, 10
FRONT_SHARE = 11  # m_l / (m_l + m_f)
REAR_SHARE = 12  # m_r / (m_f + m_r)
RESTITUTION = 13
WIDTH = 14
FRONT_FIRST, REAR_FIRST = 0, 1


@compiled
def meet_front(at: Floats, drive: float, plan: Floats, other: Floats) -> tuple[float, float]:
    """When, and with which closing speed, one that drives for ``drive``, then brakes, meets the leader."""
    fill_drive_then_brake(plan, at[V_F], at[U_F], at[LIMIT_F], drive, at[A_F])
    fill_braking(other, 0.0, at[A_L])
    _, time, squared = walk(at[GAP_L], at[V_L], other, at[V_F], plan, math.inf)
    return time, math.sqrt(squared)


@compiled
def meet_rear(at: Floats, brake: float, plan: Floats, other: Floats) -> tuple[float, float]:
    """When, and with which closing speed, the rear vehicle meets one that brakes for ``brake``, then drives."""
    fill_brake_then_drive(plan, at[V_F], at[U_F], at[LIMIT_F], brake, at[A_F])
    fill_braking(other, at[ONSET_R], at[A_R])
    _, time, squared = walk(at[GAP_R], at[V_F], plan, at[V_R], other, at[ONSET_R] + at[V_R] / at[A_R])
    return time, math.sqrt(squared)


@compiled
def after_front(at: Floats, time: float, closing: float, plan: Floats, other: Floats) -> float:
    """Least squared closing speed at the rear after the leader was met at ``time`` with ``closing``; 0: not proven.

    Their energy after the impact, the work of the drive and that of the leader's brakes keep their centre of mass, and
    so the controlled vehicle, behind a block that starts with V_E and has the acceleration A. The controlled vehicle's
    speed is bounded by what must have held it back on the way.
    """
    share, rest = at[FRONT_SHARE], 1.0 - at[FRONT_SHARE]
    if rest < at[RESTITUTION] * share:
        return 0.0
    v_l, way_l, _ = solo_motion(at[V_L], -at[A_L], 0.0, math.inf, time)
    v_r, way_r, _ = solo_motion(at[V_R], -at[A_R], at[ONSET_R], math.inf, time)
    together = v_l + rest * closing
    bounce = at[RESTITUTION] * closing
    onset = max(at[ONSET_R] - time, 0.0)
    accelerate = rest * at[U_F] - share * at[A_L]
    fill_plan(plan, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, accelerate)
    fill_braking(other, onset, at[A_R])
    start = math.sqrt(together * together + share * rest * bounce * bounce)
    behind = max(at[GAP_L] + at[GAP_R] + way_l - way_r, 0.0)
    _, until, _ = walk(behind, start, plan, v_r, other, onset + v_r / at[A_R])
    if until == math.inf:
        return 0.0
    held = 0.5 * share * (at[A_L] + at[U_F]) * until
    stands = together / at[A_L]
    if until > stands:
        held -= share * at[A_L] * (until - stands) * (until - stands) / (2.0 * until)
    fastest = max(together, together + at[U_F] * until - held)
    slowest: float = max(solo_motion(v_r, -at[A_R], onset, math.inf, until)[0] - fastest, 0.0)
    return slowest * slowest


@compiled
def after_rear(at: Floats, time: float, closing: float, plan: Floats, other: Floats) -> float:
    """Least squared closing speed at the front after the rear vehicle was met at ``time`` with ``closing``.

    Both together have the speed ``V = v_r - (1 - REAR_SHARE) closing`` and brake with at most
    ``p = (1 - REAR_SHARE) a_f + REAR_SHARE a_r``. They reach the leader no later than a block that brakes with p, and
    the controlled vehicle's speed is then at least V minus (a_f + p) / 2 times the time since. It also brakes no
    harder than a_f.
    """
    v_l, way_l, _ = solo_motion(at[V_L], -at[A_L], 0.0, math.inf, time)
    v_r, way_r, _ = solo_motion(at[V_R], -at[A_R], at[ONSET_R], math.inf, time)
    gap = max(at[GAP_L] + at[GAP_R] + way_l - way_r, 0.0)
    speed = max(v_r - (1.0 - at[REAR_SHARE]) * closing, 0.0)
    pooled = (1.0 - at[REAR_SHARE]) * at[A_F] + at[REAR_SHARE] * at[A_R]
    fill_braking(plan, 0.0, at[A_L])
    fill_braking(other, 0.0, pooled)
    _, until, squared = walk(gap, v_l, plan, speed, other, speed / pooled)
    if until == math.inf:
        return 0.0
    lean = max(math.sqrt(squared) - 0.5 * (at[A_F] - pooled) * until, 0.0)
    fill_braking(other, 0.0, at[A_F])
    _, _, alone = walk(gap, v_l, plan, speed, other, speed / at[A_F])
    harm: float = max(lean * lean, alone)
    return harm


@compiled
def meet(kind: int, at: Floats, parameter: float, plan: Floats, other: Floats) -> tuple[float, float]:
    """``meet_front`` or ``meet_rear``."""
    if kind == FRONT_FIRST:
        return meet_front(at, parameter, plan, other)
    return meet_rear(at, parameter, plan, other)


@compiled
def after(kind: int, at: Floats, time: float, closing: float, plan: Floats, other: Floats) -> float:
    """``after_front`` or ``after_rear``."""
    if kind == FRONT_FIRST:
        return after_front(at, time, closing, plan, other)
    return after_rear(at, time, closing, plan, other)
