"""Can the controlled vehicle avoid contact with both neighbours? One trajectory decides.

The *largest trajectory* stays behind the front vehicle, and is farther ahead at every time than any other that does.
Contact with the rear vehicle can be avoided if and only if the rear vehicle stays behind the largest trajectory.

docs/proofs/harm.md derives every formula.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.departures import OBSTACLE
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.proofs.line import (
    A_F,
    A_L,
    A_R,
    GAP_L,
    GAP_R,
    LIMIT_F,
    ONSET_F,
    ONSET_L,
    ONSET_R,
    U_F,
    V_F,
    V_L,
    V_R,
    rows_of,
)
from ethbrake_marl.extensions.proofs.plans import braking, time_to_limit, walk
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.motion.forces import stopping_distances
from ethbrake_marl.motion.impact import TOUCH_MPS
from ethbrake_marl.motion.interval import solo
from ethbrake_marl.motion.layout import BRAKE_RATE, FAR_M, LATENCY, Bools, Floats, Ints

ROUNDING_M = 1e-12  # a smaller overlap is a rounding error at gap 0, not an impact
SQUEEZE_M = 1e-9  # if less room than this remains between both neighbours, contact counts as unavoidable
GRAZING_M = 1e-5  # the same limit if even full braking brings the vehicle to the front vehicle, which moves it so far

AVOIDABLE, EARLY, FRONT, REAR = range(4)
REASONS = ("", "early", "front", "rear")

REASON, MARGIN, SPARE, DRIVE, TOUCH, FOLLOW, VERDICT = range(7)  # columns of a verdict, and their number
COVERED_LINES = ((3, 2), (2, 1), (2, 2))  # number of vehicles, body of the controlled vehicle
PROVEN_FOR = "9c34cfada8195d65"  # digest of the physics; docs/physics.md says when to renew it


class Avoidability(NamedTuple):
    """Whether, and how, the controlled vehicle can avoid all contact in each of n worlds."""

    # [n] 0: contact is avoidable. 1, early: a pair has contact before the controlled vehicle may act. 2, front: even
    # full braking leads to contact with the front vehicle. 3, rear: the rear vehicle reaches the largest trajectory.
    reason: Ints
    # [n] smallest gap between the largest trajectory and the rear vehicle (m); without a rear vehicle, what full
    # braking leaves of the gap ahead. Negative if contact is unavoidable; front: minus what the gap ahead is too short
    # for full braking; early: minus the overlap before the vehicle may act.
    margin_m: Floats
    switch_s: Floats  # [n, 3] times (s after the alert) from which on the commands apply; NaN if contact is unavoidable
    command_mps2: Floats  # [n, 3] commands that avoid contact, m/s2; NaN if contact is unavoidable

    @property
    def avoidable(self) -> Bools:
        """Whether some command of the controlled vehicle avoids all contact, and therefore every impact, [n]."""
        return np.asarray(self.reason == AVOIDABLE)

    @property
    def reason_name(self) -> NDArray[np.str_]:
        """Why contact is unavoidable, [n] texts; empty where it is avoidable.

        ``early``: a pair touches before the vehicle may act. ``front``: full braking still reaches the front vehicle.
        ``rear``: the rear vehicle reaches the largest trajectory.
        """
        return np.array(REASONS)[self.reason]


@kernel
def spare_gap(gap, v_l, a_l, v_f, a_f):
    """Smallest gap (m) between follower and leader if both brake fully from now on; negative: they make contact.

    The gap is smallest at rest if the follower comes to rest last. Otherwise it is smallest when both speeds are equal,
    or now if the leader is at least as fast. ``gap``: present gap (m). v (m/s), a (m/s2): speed and braking capacity of
    leader (l) and follower (f).
    """
    if v_f * a_l >= v_l * a_f:
        return gap - max(0.0, v_f * v_f / (2.0 * a_f) - v_l * v_l / (2.0 * a_l))
    if v_f > v_l:
        return gap - (v_f - v_l) * (v_f - v_l) / (2.0 * (a_f - a_l))
    return gap


@kernel
def drive_before_braking(gap, v_l, a_l, v_f, a_f, u):
    """Longest time (s) for which a follower can drive and then still stay behind the leader by full braking.

    Returned with it: the time (s) at which the gap becomes 0, and whether both vehicles still move at this moment. If
    they do, ``a_f > a_l`` and both are equally fast; otherwise the follower comes to rest behind the standing leader.
    Both times are infinite if the follower never moves. ``u``: acceleration of the drive (m/s2). Other arguments: as
    for ``spare_gap``, whose result must be at least 0.
    """
    w, closing, relief = v_f - v_l, u + a_l, a_f - a_l
    if relief > 0.0 and v_l > 0.0:
        command_range = u + a_f
        root = math.sqrt(command_range * relief * (w * w + 2.0 * closing * gap))
        if w > 0.0:
            drive = max(2.0 * relief * gap - w * w, 0.0) / (w * command_range + root)
        else:
            drive = (root - w * command_range) / (closing * command_range)
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


@large
def largest_behind(gap, v_l, a_l, v_f, a_f, u, limit):
    """Results of ``drive_before_braking`` for a follower with a speed limit.

    ``limit``: speed (m/s) up to which the follower drives. Other arguments: as for ``drive_before_braking``.
    """
    cap = time_to_limit(v_f, u, limit)
    if cap > 0.0:
        drive, touch, moving = drive_before_braking(gap, v_l, a_l, v_f, a_f, u)
        if drive <= cap:
            return drive, touch, moving
        after_l, way_l, _ = solo(v_l, -a_l, 0.0, math.inf, cap)
        gap = gap + (way_l - 0.5 * (v_f + limit) * cap)
        v_l, v_f = after_l, limit
    drive, touch, moving = drive_before_braking(gap, v_l, a_l, v_f, a_f, 0.0)
    return cap + drive, cap + touch, moving


@kernel
def lowest_while_coasting(at):
    """Smallest gap (m) of the rear pair while the controlled vehicle coasts, until it may act.

    ``at``: one world at the alert (columns: ``proofs/line.py``). The gap is a convex function of time: it is smallest
    when both vehicles are equally fast, or at the start or end.
    """
    w = at[V_R] - at[V_F]
    if w <= 0.0:
        return at[GAP_R]
    if at[ONSET_R] + w / at[A_R] < at[ONSET_F]:
        return at[GAP_R] - w * at[ONSET_R] - w * w / (2.0 * at[A_R])
    return at[GAP_R] + at[V_F] * at[ONSET_F] - solo(at[V_R], -at[A_R], at[ONSET_R], math.inf, at[ONSET_F])[1]


@kernel
def had_impact(gap, closing):
    """Whether a pair with this gap (m) and closing speed (m/s) has an impact now or has had one."""
    return gap < -ROUNDING_M or (gap <= 0.0 and closing > TOUCH_MPS)


@kernel
def plan_behind(at, ahead, v_l, out):
    """Plan (file ``plans``) of the largest trajectory (top of this file): drive fully, brake fully, follow the leader.

    Also writes the columns DRIVE, TOUCH and FOLLOW of ``out`` (see ``decide``). ``at``: one world (columns: file
    ``line``). At the start of the plan the front vehicle is ``ahead`` (m) and has the speed ``v_l`` (m/s).
    """
    if at[GAP_L] < FAR_M:
        out[DRIVE], out[TOUCH], moving = largest_behind(ahead, v_l, at[A_L], at[V_F], at[A_F], at[U_F], at[LIMIT_F])
        out[FOLLOW] = -at[A_L] if moving else -at[A_F]
    cap = min(time_to_limit(at[V_F], at[U_F], at[LIMIT_F]), out[DRIVE])
    return at[U_F], cap, 0.0, out[DRIVE], -at[A_F], out[TOUCH], out[FOLLOW], math.inf


@large
def decide(at, out):
    """Decide whether contact is avoidable in one world; write the verdict to ``out`` [VERDICT].

    ``at``: the world (columns: ``proofs/line.py``). Columns of ``out``: REASON; MARGIN (m); SPARE, gap ahead that is
    left after full braking (m); DRIVE and TOUCH, end of the drive and of the full braking after it (s after the vehicle
    may act); FOLLOW, command after TOUCH (m/s2).
    """
    start, v_f, v_l, ahead = at[ONSET_F], at[V_F], 0.0, FAR_M
    out[REASON], out[MARGIN], out[SPARE] = AVOIDABLE, math.inf, math.inf
    out[DRIVE], out[TOUCH], out[FOLLOW] = math.inf, math.inf, -at[A_F]
    if at[GAP_L] < FAR_M:
        # Until the start the gap is a concave function of time: not negative then, it never was.
        v_l, way, _ = solo(at[V_L], -at[A_L], at[ONSET_L], math.inf, start)
        ahead = at[GAP_L] + (way - v_f * start)
        out[REASON], out[MARGIN] = EARLY, ahead
        if had_impact(ahead, v_f - v_l):
            return
        spare = spare_gap(max(ahead, 0.0), v_l, at[A_L], v_f, at[A_F])
        out[REASON] = FRONT if spare < -ROUNDING_M else AVOIDABLE
        out[MARGIN], out[SPARE], out[DRIVE] = spare, max(spare, 0.0), 0.0
    if at[GAP_R] == FAR_M:
        return
    lowest = lowest_while_coasting(at)
    v_r, way, _ = solo(at[V_R], -at[A_R], at[ONSET_R], math.inf, start)
    behind = at[GAP_R] + (v_f * start - way)
    if had_impact(lowest, 0.0) or had_impact(behind, v_r - v_f):
        out[REASON], out[MARGIN] = EARLY, lowest
    if out[REASON] != AVOIDABLE:
        return
    behind, onset = max(behind, 0.0), max(at[ONSET_R] - start, 0.0)
    plan = plan_behind(at, max(ahead, 0.0), v_l, out)
    margin = walk(behind, v_f, plan, v_r, braking(onset, at[A_R]), onset + v_r / at[A_R])[0]
    out[MARGIN] = margin
    if margin < -ROUNDING_M:
        out[REASON] = REAR
    elif ahead < FAR_M:
        if behind > SQUEEZE_M and margin < (SQUEEZE_M if out[SPARE] >= SQUEEZE_M else GRAZING_M):
            out[REASON] = REAR
        plan_behind(at, max(ahead - 0.5 * min(SQUEEZE_M, out[SPARE], max(margin, 0.0)), 0.0), v_l, out)


@large
def decide_worlds(rows, out):
    for k in range(len(out)):
        decide(rows[k], out[k])


def avoidability(state: State, body: int = 2) -> Avoidability:
    """Decide for every world whether the vehicle ``body`` (1: Vehicle 1) can avoid all contact from now on.

    If it cannot, all its commands lead to contact, but not always to an impact (``LowerBound.impact_proven``). The
    proof covers Vehicle 2 of three vehicles, and either of two vehicles; all others brake fully from their latencies
    on. An overlap of at most 1e-12 m in the computed motion is a rounding error, not contact.

    Raises ``InvalidInput`` for any other line, for worlds that depart from the plain game other than by an obstacle
    that Vehicle 1 does not reach before any contact, if the physics has another digest than ``PROVEN_FOR``, or if the
    front vehicle may brake only after the controlled vehicle may act.
    """
    _check_assumptions(state, body)
    out, rows = np.empty((state.n, VERDICT)), rows_of(state, body)
    decide_worlds(rows, out)
    start = state.time_s + rows[:, ONSET_F]
    switch = np.column_stack([state.time_s, start + out[:, DRIVE], start + out[:, TOUCH]])
    command = np.column_stack([rows[:, U_F], -rows[:, A_F], out[:, FOLLOW]])
    reason = out[:, REASON].astype(np.int64)
    switch[reason > 0] = command[reason > 0] = np.nan
    return Avoidability(reason, out[:, MARGIN].copy(), switch, command)


def _check_assumptions(state: State, body: int) -> None:
    """Raise ``InvalidInput`` unless the proof holds in these worlds; ``body``: the controlled vehicle.

    An obstacle is allowed if Vehicle 1 does not reach it under full braking: only a push could bring Vehicle 1 there,
    and a push begins with an impact.
    """
    require(state, "a proof", {OBSTACLE})
    if physics_digest() != PROVEN_FOR:
        raise InvalidInput(
            f"avoidability, lower_bound: proven for other physics ({PROVEN_FOR!r}) than this installation's"
            f" ({physics_digest()!r}), so nothing is claimed here"
        )
    if (state.vehicles, body) not in COVERED_LINES:
        raise InvalidInput(
            f"avoidability: vehicle_{body} of {state.vehicles} vehicles is controlled, but the proof covers only"
            " vehicle_2 in a line of 3 vehicles, and both vehicles in a line of 2"
        )
    first = state.car[:, :, 1]
    onset, speed = np.maximum(state.car[:, LATENCY] - state.time_s[:, np.newaxis], 0.0), state.speeds_mps[:, 0]
    way = stopping_distances(speed, onset[:, 1], state.braking_capacity_mps2[:, 0], first[:, BRAKE_RATE])
    obstacle = state.obstacle_gap_m
    for bad, words in (
        (np.isfinite(obstacle) & (body == 1), "has an obstacle ahead of the controlled vehicle_1"),
        (~(way < obstacle), "has an obstacle that vehicle_1 reaches although it brakes"),
        ((onset[:, 1] > onset[:, body]), "has a vehicle_1 that may brake only after the controlled vehicle may act"),
    ):
        if bad.any():
            raise InvalidInput(f"avoidability: world {int(np.argmax(bad))} {words}, which the proof does not cover")
