"""Decide whether the controlled vehicle can avoid contact with both neighbours.

One trajectory decides. The *largest trajectory* of the controlled vehicle is farther ahead at every time than any other
trajectory that stays behind the front vehicle. Contact with the rear vehicle can be avoided if and only if the rear
vehicle stays behind the largest trajectory.

Symbols: the index l marks the front vehicle (leader), f the controlled vehicle (follower), r the rear vehicle. A gap is
in m, a speed v in m/s, a braking capacity a > 0 and a driving capacity u >= 0 in m/s2. Time 0 is the moment at which
the controlled vehicle may act; the leader already brakes at time 0. docs/internals/proofs/avoidable-contact.md derives
every formula. The formulas use only + - * / and sqrt, so they give the same bits on every machine.

Arrays that several functions share: ``gap`` [P], ``speed`` [N], ``braking`` and ``driving`` [N] (capacities, m/s2) and
``limit`` [N] (speed limit, m/s) describe one world; ``onset`` [N] has the time from which on each vehicle may act. The
times ``onset``, ``start`` and ``until`` are in s after the moment of the given gaps and speeds. ``i`` is the index of
the controlled vehicle. ``out`` [RESULT_WIDTH] is the verdict, into which the functions write; ``decide_world`` explains
its columns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.extensions.proofs.plans import empty_plan, fill_braking, fill_plan, time_to_limit, walk
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND, solo_motion, stopping_distances
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds

ROUNDING_M = 1e-12  # a smaller overlap is a rounding error at gap 0, not an impact

SQUEEZE_M = 1e-9  # if less room than this remains between both neighbours, contact counts as unavoidable

# The same limit if even full braking brings the vehicle to the front vehicle; that touch may move it by this much.
TOUCHING_M = 1e-5

AVOIDABLE, EARLY, FRONT, REAR = 0, 1, 2, 3

REASON, MARGIN, SPARE, DRIVE, TOUCH, FOLLOW, RESULT_WIDTH = range(7)  # columns of a verdict


@compiled
def spare_gap(gap: float, v_l: float, a_l: float, v_f: float, a_f: float) -> float:
    """Return the smallest gap (m) if the follower and the leader both brake fully from now on.

    A negative result means that the two vehicles make contact. If the follower comes to rest last, the smallest gap is
    the gap at rest. Otherwise the gap is smallest when both speeds are equal, or now if the leader is at least as fast
    as the follower.
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
    """Return how long a vehicle can drive before it must brake fully to stay behind the leader.

    The vehicle drives with the constant acceleration ``u``. The leader brakes from now on. The function requires
    ``spare_gap >= 0``: full braking from now on avoids an overlap with the leader.

    The results are the duration of the drive (s), the time at which the gap becomes 0 (s), and whether both vehicles
    still move at that time. If both vehicles still move, then ``a_f > a_l`` and both have the same speed. Otherwise the
    follower comes to rest behind the leader, which is already at rest. The first two results are infinite if the
    follower never moves.
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
    """Return the results of ``drive_before_braking`` for a follower with the speed limit ``limit`` (m/s)."""
    cap = time_to_limit(v_f, u, limit)
    if cap > 0.0:
        meeting = drive_before_braking(gap, v_l, a_l, v_f, a_f, u)
        if meeting[0] <= cap:
            return meeting
        after_l, way_l, _ = solo_motion(v_l, -a_l, 0.0, math.inf, cap)
        gap = gap + (way_l - 0.5 * (v_f + limit) * cap)
        v_l, v_f = after_l, limit
    drive, touch, moving = drive_before_braking(gap, v_l, a_l, v_f, a_f, 0.0)
    return cap + drive, cap + touch, moving


@compiled
def lowest_while_coasting(gap: float, v_f: float, v_r: float, a_r: float, onset_r: float, until: float) -> float:
    """Return the smallest gap (m), until the time ``until`` (s), between a coasting vehicle and the vehicle behind it,
    which brakes from ``onset_r`` (s) on.

    The gap is a convex function of time. Therefore the gap is smallest when both vehicles have the same speed, or at
    the start or end of the coasting.
    """
    w = v_r - v_f
    if w <= 0.0:
        return gap
    if onset_r + w / a_r < until:
        return gap - w * onset_r - w * w / (2.0 * a_r)
    return gap + v_f * until - solo_motion(v_r, -a_r, onset_r, math.inf, until)[1]


@compiled
def met(gap: float, closing: float) -> bool:
    """Return whether a pair with the given ``gap`` (m) and closing speed ``closing`` (m/s) has or had an impact."""
    return gap < -ROUNDING_M or (gap <= 0.0 and closing > BOUND.TOUCH_SPEED_MPS)


@compiled
def leader_at_onset(
    gap: float, v_l: float, a_l: float, onset_l: float, v_f: float, start: float
) -> tuple[float, float]:
    """Return the gap to the leader (m) and the speed of the leader (m/s) at ``start`` (s), if the follower coasts until
    then.

    The leader brakes from the time ``onset_l`` on; ``onset_l`` must not be after ``start``. Until ``start`` the gap is
    a concave function of time: if the gap is not negative at ``start``, the gap was not negative at any earlier time.
    """
    after, way, _ = solo_motion(v_l, -a_l, onset_l, math.inf, start)
    return gap + (way - v_f * start), after


@compiled
def decide_front(gap: Floats, speed: Floats, onset: Floats, braking: Floats, i: int, out: Floats) -> bool:
    """Return whether full braking may keep vehicle ``i`` (at least 1) behind the front vehicle; False if contact is
    certain.

    The function writes the columns REASON, MARGIN, SPARE and DRIVE of ``out``.
    """
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
    """Write to ``plan`` [2, PIECES] the trajectory of vehicle ``i`` that is farthest ahead, but stays ``keep`` metres
    behind vehicle ``i - 1``.

    Vehicle ``i`` drives as hard as it can, then brakes fully, then follows the vehicle in front at the distance
    ``keep``. The function also writes the columns DRIVE, TOUCH and FOLLOW of ``out``.
    """
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
    """Return whether the vehicle behind vehicle ``i`` has contact with vehicle ``i`` before vehicle ``i`` may act.

    If it has, the function writes the columns REASON and MARGIN of ``out``.
    """
    v_f, v_r, a_r, start = speed[i], speed[i + 1], braking[i + 1], onset[i]
    lowest = lowest_while_coasting(gap[i], v_f, v_r, a_r, onset[i + 1], start)
    after, way, _ = solo_motion(v_r, -a_r, onset[i + 1], math.inf, start)
    if met(lowest, 0.0) or met(gap[i] + (v_f * start - way), after - v_f):
        out[REASON], out[MARGIN] = EARLY, lowest
        return True
    return False


@compiled
def decide_world(
    gap: Floats, speed: Floats, onset: Floats, braking: Floats, driving: Floats, limit: Floats, i: int, plan: Floats,
    rear: Floats, out: Floats,
) -> None:  # fmt: skip
    """Decide whether vehicle ``i`` can avoid contact in one world, and write the verdict to ``out``.

    Columns of the verdict: REASON (AVOIDABLE, EARLY, FRONT or REAR), MARGIN (m; as in ``Avoidability``), SPARE (m; part
    of the gap that remains under full braking), DRIVE (s; end of the drive), TOUCH (s; end of the full braking after
    the drive), FOLLOW (m/s2; the command after the full braking). DRIVE and TOUCH are times after the moment at which
    vehicle ``i`` may act. ``plan`` and ``rear`` are working memory, arrays from ``empty_plan``.
    """
    out[REASON], out[MARGIN], out[SPARE] = AVOIDABLE, math.inf, math.inf
    out[DRIVE], out[TOUCH], out[FOLLOW] = math.inf, math.inf, -braking[i]
    has_rear = i < gap.shape[0]
    if i > 0 and not decide_front(gap, speed, onset, braking, i, out) and out[REASON] == EARLY:
        return
    if has_rear and meets_rear_early(gap, speed, onset, braking, i, out):
        return
    if has_rear and out[REASON] == AVOIDABLE:
        # check that the rear vehicle stays behind the largest trajectory of vehicle i
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
def decide_worlds(
    gaps: Floats, speeds: Floats, onset: Floats, braking: Floats, driving: Floats, limit: Floats, i: int, out: Floats
) -> None:
    """Decide for each of ``n`` worlds whether vehicle ``i`` can avoid contact, and write the verdicts to ``out``.

    All arrays have one row for each world: ``gaps`` is [n, P], ``out`` [n, RESULT_WIDTH], the others [n, N].
    """
    plan, rear = empty_plan(), empty_plan()
    for k in range(gaps.shape[0]):
        decide_world(gaps[k], speeds[k], onset[k], braking[k], driving[k], limit[k], i, plan, rear, out[k])


REASONS = ("", "early", "front", "rear")  # name of each reason code; "" if contact is avoidable


@dataclass(frozen=True, slots=True)
class Avoidability:
    """Verdict on each of ``n`` worlds: can the controlled vehicle avoid all contact?

    The *largest trajectory* of the controlled vehicle is farther ahead at every time than any other trajectory that
    stays behind the front vehicle. ``margin_m`` is the smallest gap between the largest trajectory and the rear
    vehicle. Without a rear vehicle, ``margin_m`` is the part of the gap to the front vehicle that remains under full
    braking. ``margin_m`` is negative if contact is unavoidable. If the reason is *front*, ``margin_m`` is minus the
    distance by which the gap to the front vehicle is too short for full braking. If the reason is *early*, ``margin_m``
    is minus the overlap before the vehicle may act.

    ``command_mps2`` and ``switch_s`` are commands that show how to avoid contact, and their times: in a simulation
    these commands cause no impact. Each command applies from its time (s after the alert) until the time of the next
    command; it never applies if its time is infinite. Both arrays are NaN in worlds where contact is unavoidable.
    """

    # [n] 0: contact is avoidable. 1, early: a pair has contact before the controlled vehicle may act. 2, front: even
    # full braking leads to contact with the front vehicle. 3, rear: the rear vehicle reaches the largest trajectory
    reason: Ints
    margin_m: Floats  # [n] smallest gap to the rear vehicle, m; negative if contact is unavoidable
    switch_s: Floats  # [n, 3] times from which on the commands apply, s
    command_mps2: Floats  # [n, 3] commands that avoid contact, m/s2

    @property
    def avoidable(self) -> Bools:
        """Boolean mask [n]: True for worlds in which some commands avoid all contact, and therefore every impact."""
        return np.asarray(self.reason == 0, np.bool_)

    @property
    def reason_name(self) -> NDArray[np.str_]:
        """Reason why contact is unavoidable, [n]: "early", "front" or "rear"; "" if contact is avoidable."""
        return np.array(REASONS)[self.reason]


def avoidability(worlds: Worlds, vehicle: int = 1, *, scripts: Mapping[int, str] | None = None) -> Avoidability:
    """Decide for every world whether one vehicle can avoid all contact from now on.

    If the vehicle cannot avoid contact, all its commands lead to contact, but not always to an impact
    (``LowerBound.impact_proven`` shows where an impact is certain). The line must have three vehicles with the middle
    one controlled, or two vehicles with either one controlled. The other vehicles brake fully from their latencies on.
    An overlap of at most 1e-12 m in the computed motion counts as a rounding error, not as contact.

    Args:
        worlds: the ``n`` worlds in their present state.
        vehicle: index of the controlled vehicle, from 0.
        scripts: script of each vehicle that is not controlled, by index, as in ``Scenario.roles``; only full_brake is
            allowed. None: all of them brake fully.

    Raises ``InvalidInput`` for any other line, for a script other than full_brake, if brakes build up, if the front
    vehicle may brake only after the controlled vehicle may act, if a vehicle moves backward, or if vehicle_1 could
    reach an obstacle (``obstacle_gap_m``) before any contact.

    """
    worlds.refuse_build_up("avoidability")
    _check_covered(worlds, vehicle, scripts)
    v = worlds.vehicles
    onset = np.maximum(v.latency_s - worlds.time_s[:, None], 0.0)
    out = np.empty((worlds.n, RESULT_WIDTH))
    decide_worlds(
        worlds.gaps_m, worlds.speeds_mps, onset, v.braking_capacity_mps2, v.driving_capacity_mps2, v.speed_limit_mps,
        vehicle, out,
    )  # fmt: skip
    reason = out[:, REASON].astype(np.int64)
    start = worlds.time_s + onset[:, vehicle]
    switch = np.column_stack([worlds.time_s, start + out[:, DRIVE], start + out[:, TOUCH]])
    braking = -v.braking_capacity_mps2[:, vehicle]
    command = np.column_stack([v.driving_capacity_mps2[:, vehicle], braking, out[:, FOLLOW]])
    switch[reason > 0] = np.nan
    command[reason > 0] = np.nan
    return Avoidability(reason, out[:, MARGIN].copy(), switch, command)


def _check_covered(worlds: Worlds, vehicle: int, scripts: Mapping[int, str] | None) -> None:
    """Raise ``InvalidInput`` for worlds that ``avoidability`` does not cover. Brake build-up is not checked."""
    # An obstacle that Vehicle 1 does not reach under full braking has no effect: only a push could bring Vehicle 1
    # there, and a push begins with an impact.
    check_whole_number("avoidability: vehicle", vehicle, 0, worlds.N - 1)
    own = np.maximum(worlds.vehicles.latency_s[:, 0] - worlds.time_s, 0.0)
    v = worlds.vehicles
    way = stopping_distances(worlds.speeds_mps[:, 0], own, v.braking_capacity_mps2[:, 0], v.brake_rate_mps3[:, 0])
    _refuse(
        ~(way < worlds.obstacle_gap_m),
        worlds.obstacle_gap_m,
        "obstacle_gap_m",
        None,
        "greater than the stopping distance of vehicle_1",
    )
    if vehicle == 0 and np.isfinite(worlds.obstacle_gap_m).any():
        raise InvalidInput(
            "avoidability: vehicle_1 is controlled and has an obstacle ahead (obstacle_gap_m); give worlds without"
            " an obstacle"
        )
    if (worlds.N, vehicle) not in ((3, 1), (2, 0), (2, 1)):
        raise InvalidInput(
            f"avoidability: vehicle_{vehicle + 1} of {worlds.N} vehicles is controlled, but the proofs cover only"
            " vehicle_2 in a line of 3 vehicles, and both vehicles in a line of 2"
        )
    for index, script in (scripts or {}).items():
        if index != vehicle and script != "full_brake":
            raise InvalidInput(f"avoidability: vehicle_{index + 1} follows the script {script!r}; must be 'full_brake'")
    if vehicle == 1:
        latency = np.maximum(worlds.vehicles.latency_s, worlds.time_s[:, None])
        _refuse(
            latency[:, 0] > latency[:, 1],
            worlds.vehicles.latency_s[:, 0],
            "latency_s",
            0,
            "at most the latency of vehicle_2",
        )
    for i in range(worlds.N):
        _refuse(~(worlds.speeds_mps[:, i] >= 0.0), worlds.speeds_mps[:, i], "speeds_mps", i, ">= 0")


def _refuse(bad: Bools, values: Floats, name: str, i: int | None, right: str) -> None:
    if bad.any():
        k = int(np.argmax(bad))
        place = f"{k}" if i is None else f"{k}, {i}"
        raise InvalidInput(f"avoidability: {name}[{place}] = {values[k]:g}: must be {right}")
