"""First contacts with brake build-up, the harm that must follow them, and functions that all lower bounds share.

``sign`` is 1 for first contacts with the leader and -1 for first contacts with the rear vehicle. The functions treat
contacts with the rear vehicle as the mirror image of contacts with the leader. Here *force* means force per mass, which
is an acceleration (m/s2). ``sign`` times the controlled vehicle's force first rises and later falls; the *switch* is
the time (s) at which it begins to fall. For a contact with the leader the controlled vehicle drives and then brakes;
for a contact with the rear vehicle it brakes and then drives. docs/internals/proofs/lower-bound-cases.md has the
proofs.

``place`` is a position times ``sign`` (m). ``final`` is the required value of ``sign`` times the force at the time of
the contact (m/s2), or -inf if no value is required. ``proofs/__init__.py`` explains the other arguments that functions
share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.proofs.avoidability import Avoidability
from ethbrake_marl.extensions.proofs.line import AHEAD_M, FORCE_HALVINGS, HALVINGS, LINE, RAMPED_FRONT, ROUGHLY
from ethbrake_marl.extensions.proofs.ramps import (
    FORCES,
    empty_legs,
    fill_build_up,
    fill_switch,
    force_of,
    meeting,
    travel,
)
from ethbrake_marl.game.harm import HarmCount, check_harm_count, empty_ledger
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds


@compiled
def fill_leader(at: Floats, plan: Floats) -> None:
    """Write the motion of the front vehicle, if no other vehicle pushes it, to ``plan`` [3, LEGS]."""
    fill_build_up(plan, 0.0, at[LINE.FORCE_L], -at[LINE.A_L], at[LINE.FALL_L])


@compiled
def fill_follower(at: Floats, plan: Floats) -> None:
    """Write the motion of the rear vehicle, if no other vehicle pushes it, to ``plan`` [3, LEGS]."""
    fill_build_up(plan, at[LINE.ONSET_R], at[LINE.FORCE_R], -at[LINE.A_R], at[LINE.FALL_R])


@compiled
def range_of(sign: float, at: Floats) -> tuple[float, float, float, float]:
    """Return the limits of ``sign`` times the controlled vehicle's force: largest value (m/s2), fastest rise (m/s3),
    smallest value (m/s2) and fastest fall (m/s3).

    The smallest value is negative and is returned without its minus sign. If ``sign`` is 1, the largest value belongs
    to full drive; if ``sign`` is -1, the largest value belongs to full braking.
    """
    if sign > 0.0:
        return at[LINE.U_F], at[LINE.RISE_F], at[LINE.A_F], at[LINE.FALL_F]
    return at[LINE.A_F], at[LINE.FALL_F], at[LINE.U_F], at[LINE.RISE_F]


@compiled
def fill_controlled(at: Floats, sign: float, switch: float, time: float, final: float, plan: Floats) -> None:
    """Write a plan of the controlled vehicle: ``sign`` times its force rises as fast as possible until ``switch``, then
    falls as fast as possible.
    """
    high, rise, low, fall = range_of(sign, at)
    fill_switch(plan, sign, sign * at[LINE.FORCE_F], high, rise, low, fall, switch, time, final)


@compiled(apart=True)
def switch_for(
    at: Floats, sign: float, time: float, place: float, final: float, halvings: int, plan: Floats
) -> tuple[float, float, float]:
    """Return a time (s) just before the switch and a time (s) just after the switch with which the controlled vehicle
    reaches ``place`` at ``time``.

    The third result is the speed (m/s) that the vehicle has at ``time`` if the switch happens at the first result.
    ``halvings`` is the number of bisection steps.
    """
    low, high = (-1.0 if range_of(sign, at)[1] == math.inf else 0.0), time
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        fill_controlled(at, sign, middle, time, final, plan)
        if sign * travel(plan, at[LINE.V_F], at[LINE.LIMIT_F], time)[1] < place:
            low = middle
        else:
            high = middle
    fill_controlled(at, sign, low, time, final, plan)
    return low, high, travel(plan, at[LINE.V_F], at[LINE.LIMIT_F], time)[0]


@compiled
def met_at(kind: int, at: Floats, time: float, plan: Floats) -> tuple[float, float, float]:
    """Return the sign of the first contact, and the speed (m/s) and the place (m) of the neighbour at ``time`` if no
    other vehicle pushes this neighbour.
    """
    if kind == RAMPED_FRONT:
        fill_leader(at, plan)
        v, way = travel(plan, at[LINE.V_L], math.inf, time)
        return 1.0, v, at[LINE.GAP_L] + way
    fill_follower(at, plan)
    v, way = travel(plan, at[LINE.V_R], math.inf, time)
    return -1.0, v, at[LINE.GAP_R] - way


@compiled(apart=True)
def gentlest_ramped(kind: int, at: Floats, time: float) -> float:
    """Return the smallest closing speed (m/s) of a first contact at ``time``, with brake build-up."""
    plan = empty_legs()
    sign, v, place = met_at(kind, at, time, plan)
    return max(sign * (switch_for(at, sign, time, place, -math.inf, HALVINGS, plan)[2] - v), 0.0)


@compiled
def slack_of(
    kind: int, at: Floats, early: float, late: float, v: float, hard: float, plan: Floats
) -> tuple[float, float]:
    """Return, for the time ``early``, the largest possible distance (m) to the neighbour and the largest possible
    *excess* (m/s).

    The excess is the closing speed of controlled vehicle and neighbour at ``early`` minus ``hard``. ``v`` is the speed
    of the neighbour at ``early``, m/s.
    """
    span = late - early
    if kind == RAMPED_FRONT:
        return (hard + at[LINE.A_F] * span) * span, at[LINE.A_F] * span
    slower = v - met_at(kind, at, late, plan)[1]
    return (hard + at[LINE.U_F] * span + slower) * span, at[LINE.U_F] * span + slower


@compiled(apart=True)
def gentlest_ramped_between(kind: int, at: Floats, early: float, late: float) -> float:
    """Return the smallest closing speed (m/s) of first contacts between ``early`` and ``late``, with brake build-up."""
    plan = empty_legs()
    hard = gentlest_ramped(kind, at, early)
    sign, v, place = met_at(kind, at, early, plan)
    far, faster = slack_of(kind, at, early, late, v, hard, plan)
    closing = sign * (switch_for(at, sign, early, place - far, -math.inf, HALVINGS, plan)[2] - v)
    if kind == RAMPED_FRONT:
        fill_leader(at, plan)
        if travel(plan, at[LINE.V_L], math.inf, late)[0] > 0.0:
            faster = max(at[LINE.A_F] + force_of(plan, early), 0.0) * (late - early)
    return max(min(closing - faster, hard), 0.0)


@compiled(apart=True)
def force_of_meeting(kind: int, at: Floats, early: float, late: float, hard: float) -> float:
    """Return an upper bound (m/s2) on the controlled vehicle's acceleration at a first contact whose closing speed is
    at most ``hard``.

    If the contact is with the rear vehicle, the result is an upper bound on the controlled vehicle's deceleration.
    """
    plan = empty_legs()
    sign, v, place = met_at(kind, at, early, plan)
    far, faster = slack_of(kind, at, early, late, v, hard, plan)
    high, rise, low, _ = range_of(sign, at)
    if rise == math.inf:
        return high
    least, most = -low, high
    for k in range(FORCE_HALVINGS):
        tried = most if k == 0 else 0.5 * (least + most)
        final = tried - rise * (late - early)
        if sign * (switch_for(at, sign, early, place - far, final, ROUGHLY, plan)[2] - v) <= hard + faster:
            least = tried
        else:
            most = tried
    return most


@compiled(apart=True)
def after_ramped(
    kind: int, at: Floats, early: float, late: float, hard: float, plan: Floats, other: Floats
) -> float:  # fmt: skip
    """Return the smallest squared closing speed (m2/s2) of the contact with the second neighbour after a first contact
    with the other neighbour, with brake build-up.

    The bound is computed from the motion of the controlled vehicle, not of a centre of mass.
    """
    sign = 1.0 if kind == RAMPED_FRONT else -1.0
    share = at[LINE.FRONT_SHARE] if kind == RAMPED_FRONT else at[LINE.REAR_SHARE]
    rest = 1.0 - share * (1.0 + at[LINE.RESTITUTION])
    if kind == RAMPED_FRONT and (rest < 0.0 or at[LINE.OBSTACLE] < math.inf):
        return 0.0  # no bound: the controlled vehicle may be thrown back
    rest, span = max(rest, 0.0), late - early
    high, rise, _, _ = range_of(sign, at)
    force = high
    if rise < math.inf:
        force = min(force_of_meeting(kind, at, early, late, hard) + rise * span, high)
    fill_leader(at, plan)
    v_l, way_l = travel(plan, at[LINE.V_L], math.inf, early)
    fill_follower(at, other)
    v_r, way_r = travel(other, at[LINE.V_R], math.inf, early)
    gap = max(at[LINE.GAP_L] + at[LINE.GAP_R] + way_l - way_r, 0.0)
    if kind == RAMPED_FRONT:
        # until ``late`` the controlled vehicle does not fall behind the leader
        least = force_of(plan, early) if travel(plan, at[LINE.V_L], math.inf, late)[0] > 0.0 else 0.0
        fill_build_up(plan, late, force, high, rise)
        plan[FORCES, 0] = max(force, least)
        impact = meeting(
            gap, rest * hard * span, v_l + rest * hard, plan, math.inf, v_r, other, math.inf, early, at[LINE.UNTIL]
        )
    else:
        v = v_r - rest * hard
        if v <= 0.0:
            return 0.0
        most = force_of(other, late)
        since, begins = late, -force
        fastest = (1.0 + at[LINE.RESTITUTION]) * v_r + at[LINE.U_F] * at[LINE.U_F] / rise
        if begins > 0.0 and fastest >= at[LINE.LIMIT_F]:  # beyond its speed limit a driving vehicle coasts
            since, begins = late + begins / rise, 0.0
        fill_build_up(other, since, begins, -high, rise)
        other[FORCES, 0] = min(begins, most)
        impact = meeting(gap, rest * hard * span, v_l, plan, math.inf, v, other, math.inf, early, at[LINE.UNTIL])
    return impact[2] * impact[2]


@compiled(apart=True)
def is_first_ramped(kind: int, at: Floats, time: float, plan: Floats, other: Floats) -> bool:
    """Return whether a first contact with the neighbour ``kind`` at ``time`` or later is possible before the other
    neighbour arrives.
    """
    sign, _, place = met_at(kind, at, time, plan)
    switch = switch_for(at, sign, time, place, -math.inf, HALVINGS, plan)[1]
    fill_controlled(at, sign, switch, time, -math.inf, plan)
    if kind == RAMPED_FRONT:
        fill_follower(at, other)
        gap = at[LINE.GAP_R] + AHEAD_M
        return meeting(
            gap, 0.0, at[LINE.V_F], plan, at[LINE.LIMIT_F], at[LINE.V_R], other, math.inf, 0.0, time
        )[0] == math.inf  # fmt: skip
    fill_leader(at, other)
    gap = at[LINE.GAP_L] + AHEAD_M
    return (
        meeting(gap, 0.0, at[LINE.V_L], other, math.inf, at[LINE.V_F], plan, at[LINE.LIMIT_F], 0.0, time)[0] == math.inf
    )


@compiled(apart=True)
def meet_ramped(kind: int, at: Floats, sign: float, plan: Floats, other: Floats) -> tuple[float, float, float]:
    """Return time (s) and closing speed (m/s) of the contact with the neighbour ``kind`` under full drive (``sign`` 1)
    or full braking (``sign`` -1).

    Brakes build up at finite rates. If there is no contact, the time is infinite and the closing speed is 0. The third
    result is the smallest closing speed (m/s) of the contact over all motions of the pair in which the gap is never
    larger than in the motion under full drive or full braking.
    """
    fill_controlled(at, sign, math.inf, math.inf, -math.inf, plan)
    if kind == RAMPED_FRONT:
        fill_leader(at, other)
        return meeting(
            at[LINE.GAP_L], 0.0, at[LINE.V_L], other, math.inf, at[LINE.V_F], plan, at[LINE.LIMIT_F], 0.0, math.inf
        )
    fill_follower(at, other)
    return meeting(
        at[LINE.GAP_R], 0.0, at[LINE.V_F], plan, at[LINE.LIMIT_F], at[LINE.V_R], other, math.inf, 0.0, math.inf
    )


EPS = 2.0**-52  # the spacing of doubles at 1

# Bounds are lowered by this many EPS times the largest squared speed of a world. A segment of motion or a round of
# impacts changes a squared closing speed by at most 8 EPS of this, and an episode has at most 500 of them.
BOUND_EPS = 2.0**12

LEAST_TIME_STEP_S = 1e-3  # shortest time between decisions; shorter steps would take too long

LEAST_PART = 100  # smallest number of worlds for which another thread is started


@dataclass(frozen=True, slots=True)
class LowerBound:
    """Proven lower bounds on the harm of each world; every array is [n], in m2/s2."""

    harm: Floats  # lower bound on the harm: no command does less
    early: Floats  # harm before the controlled vehicle may act
    front_pair: Floats  # bound on the harm of the front pair alone, after the early harm
    rear_pair: Floats  # bound on the harm of the rear pair alone, after the early harm
    combined: Floats  # bound on the harm of both pairs together; 0 if nothing is proven
    # verdict on avoidable contact, which the combined bound uses; None if brakes build up in any world
    contact: Avoidability | None

    @property
    def impact_proven(self) -> Bools:
        """Boolean mask [n]: True for worlds in which every command of the controlled vehicle certainly leads to an
        impact.

        False means that no impact is proven; an impact may be unavoidable nevertheless.
        """
        return np.asarray(self.harm > 0.0, np.bool_)


def at_onset_of(
    where: str, worlds: Worlds, vehicles: Ints, harm_count: HarmCount, horizon_s: float
) -> tuple[Worlds, Floats, Floats, Bools]:
    """Simulate worlds until the *start*, the moment when the first of the controlled ``vehicles`` may act.

    Returns the worlds at the start, the time of the start ([n], s after the alert), the harm before the start ([n],
    m2/s2), and a boolean mask [n, P]. The mask is True for each pair whose next impact counts and whose vehicles move
    forward. Error messages begin with ``where``, the name of the calling function.

    Raises ``InvalidInput`` if the horizon is not finite, or lies before a vehicle may act.
    """
    start = np.maximum(worlds.vehicles.latency_s[:, vehicles].min(axis=1), worlds.time_s)
    if not (np.all(start <= horizon_s) and horizon_s < np.inf):
        raise InvalidInput(
            f"{where}: horizon_s = {horizon_s!r}: the horizon must be finite and at least {start.max():g} s; by then"
            " a controlled vehicle may act in every world"
        )
    now, impacts = advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=start)
    early = empty_ledger(worlds).add(impacts).world_harm(harm_count)
    forward = now.speeds_mps >= 0.0
    counts = (~now.pair_hit if harm_count == "first" else True) & forward[:, 1:] & forward[:, :-1]
    return now, start, early, counts


def check_asked(where: str, harm_count: str, horizon_s: object, time_step_s: object) -> None:
    """Raise ``InvalidInput`` for an unknown harm count, a horizon that is not a number, or a time step that is neither
    None nor a finite number of at least ``LEAST_TIME_STEP_S``.

    The error message begins with ``where``, the name of the calling function.
    """
    check_harm_count(harm_count)
    if not _is_number(horizon_s):
        raise InvalidInput(f"{where}: horizon_s = {horizon_s!r}: the horizon must be a number (time in s)")
    if time_step_s is not None and not (_is_number(time_step_s) and LEAST_TIME_STEP_S <= time_step_s < np.inf):  # type: ignore[operator]  # a number
        raise InvalidInput(
            f"{where}: time_step_s = {time_step_s!r}: must be a finite number of at least"
            f" {LEAST_TIME_STEP_S:g} (time in s), or None"
        )


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def rounding(worlds: Worlds, vehicle: int | Ints, way_m: Floats | float = 0.0) -> Floats:
    """Return the largest difference between a bound and the simulated harm that floating-point rounding can cause, [n]
    m2/s2.

    A squared closing speed is ``D = w^2 + 2 b g``, with closing speed w, closing acceleration b and gap g. Let ``V`` be
    the largest speed in the line, ``G`` the sum of its gaps (plus ``way_m``), ``A`` the largest closing acceleration
    and ``a`` the weakest brakes. The term ``w^2`` of D is at most ``V^2``. No gap grows beyond ``G + V^2 / (2 a)``
    (plus ``V a / r`` if brakes build up at rate r). Therefore all terms of D stay below ``S = V^2 (1 + A / a) + 2 A
    G``.

    In a segment of motion, the computation rounds each speed twice and each gap five times. In a round of impacts,
    rounding changes each speed by up to 8 eps of the largest speed. Rounding in one segment, or in one round of
    impacts, changes D by at most 8 eps S (eps = 2^-52). These errors add up and do not multiply, because the proofs
    compare a motion only with the formulas for this same motion. ``BOUND_EPS`` allows for 500 segments and rounds of
    impacts. This number is enough: an episode of 8 s has 80 steps, and the computation of the bound itself rounds a few
    hundred times.

    If controlled vehicles may drive, the largest speed V is at least the largest of their speed limits, and the largest
    closing acceleration A includes the largest of their driving capacities.

    ``vehicle`` is the index of the controlled vehicle, or indices of several. ``way_m`` is an additional distance, such
    as the gap to an obstacle, m; one number, or [n].
    """
    v, chosen = worlds.vehicles, np.atleast_1d(vehicle)
    driving = v.driving_capacity_mps2[:, chosen]
    limits = np.where(driving > 0.0, v.speed_limit_mps[:, chosen], 0.0)
    fastest = np.maximum(worlds.speeds_mps.max(axis=1), limits.max(axis=1))
    closing = v.braking_capacity_mps2.max(axis=1) + driving.max(axis=1)
    weakest = v.braking_capacity_mps2.min(axis=1)
    longest = worlds.gaps_m.sum(axis=1) + way_m + fastest * (v.braking_capacity_mps2 / v.brake_rate_mps3).max(axis=1)
    scale = fastest * fastest * (1.0 + closing / weakest) + 2.0 * closing * longest
    return np.asarray(BOUND_EPS * EPS * scale, np.float64)


def onset_states(worlds: Worlds, i: int, time_step_s: float | Floats | None) -> Floats:
    """Return the worlds as an array with the columns of ``line.LINE``, [n, LINE.WIDTH].

    The worlds are in their state at the moment when the controlled vehicle ``i`` may act. If this vehicle has no front
    or no rear vehicle, the columns of this neighbour are 0. ``time_step_s`` is the time between two decisions, s; one
    number, or [n]. None, or 0 in an array, means that commands may change at any time.
    """
    v = worlds.vehicles
    at = np.zeros((worlds.n, LINE.WIDTH))
    columns = {
        LINE.V_F: worlds.speeds_mps[:, i],
        LINE.A_F: v.braking_capacity_mps2[:, i],
        LINE.U_F: v.driving_capacity_mps2[:, i],
        LINE.LIMIT_F: v.speed_limit_mps[:, i],
        LINE.RESTITUTION: v.restitution,
        LINE.OBSTACLE: worlds.obstacle_gap_m if i == 1 else np.inf,
        LINE.TIME_STEP: 0.0 if time_step_s is None else time_step_s,
    }
    if i > 0:
        columns |= {
            LINE.GAP_L: worlds.gaps_m[:, i - 1],
            LINE.V_L: worlds.speeds_mps[:, i - 1],
            LINE.A_L: v.braking_capacity_mps2[:, i - 1],
            LINE.FRONT_SHARE: v.mass_t[:, i - 1] / (v.mass_t[:, i - 1] + v.mass_t[:, i]),
        }
    if i < worlds.N - 1:
        columns |= {
            LINE.GAP_R: worlds.gaps_m[:, i],
            LINE.V_R: worlds.speeds_mps[:, i + 1],
            LINE.A_R: v.braking_capacity_mps2[:, i + 1],
            LINE.ONSET_R: np.maximum(v.latency_s[:, i + 1] - worlds.time_s, 0.0),
            LINE.REAR_SHARE: v.mass_t[:, i + 1] / (v.mass_t[:, i + 1] + v.mass_t[:, i]),
        }
    for column, values in columns.items():
        at[:, column] = values
    return at
