"""A proven lower bound on the harm of every world, whatever the controlled vehicle does.

Three bounds, each proven in docs/avoidability.md, under both counting rules and with velocity exchange, bounces and
pushing as the physics has them:

* front pair alone: the closing speed of full braking, since a push from behind only makes it worse;
* rear pair alone: the closing speed of full drive;
* both together, where contact is unavoidable: whichever neighbour is met first, whenever and however softly, what
  follows at the other one is bounded by the motion of the centre of mass.

To these comes what has happened, for certain, before the vehicle may act.

The proofs are about exact arithmetic; the bound and the harm that it is compared with are made of doubles. So every
part is rounded outward: lowered by ``rounding``, more than both can be off together.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import check_harm_count, empty_ledger
from ethbrake_marl.limits.avoidability import (
    Avoidability,
    avoidability,
    empty_plan,
    fill_braking,
    fill_drive_then_brake,
    largest_behind,
    spare_gap,
    walk,
)
from ethbrake_marl.limits.meetings import (
    A_F,
    A_L,
    A_R,
    CELL_WIDTH,
    CELLS,
    FRONT_FIRST,
    FRONT_SHARE,
    GAP_L,
    GAP_R,
    LIMIT_F,
    OBSTACLE,
    ONSET_R,
    REAR_FIRST,
    REAR_SHARE,
    RESTITUTION,
    TIME_STEP,
    U_F,
    V_F,
    V_L,
    V_R,
    WIDTH,
    after_front,
    after_rear,
    braking_to_rear,
    gentlest_front,
    least_harm,
    meet_front,
    meet_rear,
    stays_ahead,
    stays_behind,
)
from ethbrake_marl.physics import Bools, Floats, Worlds, advance
from ethbrake_marl.physics.compiled import by_parts, compiled, compiled_apart
from ethbrake_marl.physics.kernel import TOUCH_SPEED_MPS, solo_motion

# Compiled proven lower bounds on the harm of one world; docs/avoidability.md has the proofs.

FRONT_BOUND, REAR_BOUND, COMBINED_BOUND, BOUNDS = range(4)
LARGE = 1e6  # m2/s2: more harm than any impact of vehicles does
_TOUCH_HARM = 2.0 * TOUCH_SPEED_MPS * TOUCH_SPEED_MPS  # what two touches may hide
_TOUCHING_M = 1e-9  # more than rounding leaves between two that touch
_HALVINGS = 60
_GRAZE_S = 1e-3  # more than rounding can move a graze
_PARTS = 8  # into which the times of soft meetings are divided


@compiled
def front_bound(at: Floats, plan: Floats, other: Floats) -> tuple[float, float]:
    """Least squared closing speed at the front pair's first contact, whoever pushes; and its latest time."""
    fill_braking(plan, 0.0, at[A_L])
    fill_braking(other, 0.0, at[A_F])
    _, time, squared = walk(at[GAP_L], at[V_L], plan, at[V_F], other, at[V_F] / at[A_F])
    if at[A_F] < at[A_L] and at[V_F] < at[V_L]:
        squared = min(squared, 2.0 * (at[A_L] - at[A_F]) * at[GAP_L])
    return squared, time


@compiled
def rear_bound(at: Floats, plan: Floats, other: Floats) -> tuple[float, float]:
    """Least squared closing speed at the rear pair's first contact, that under full drive; and its latest time."""
    fill_drive_then_brake(plan, at[V_F], at[U_F], at[LIMIT_F], math.inf, at[A_F])
    fill_braking(other, at[ONSET_R], at[A_R])
    _, time, squared = walk(at[GAP_R], at[V_F], plan, at[V_R], other, at[ONSET_R] + at[V_R] / at[A_R])
    return squared, time


@compiled_apart
def last_ahead(at: Floats, first: float, last: float, plan: Floats, other: Floats) -> float:
    """The latest time, at most ``last``, of a meeting with the leader before which the rear vehicle has not come.

    At ``first`` there is room. The later the meeting, the shorter the drive before it and the less room behind.
    """
    if stays_ahead(at, gentlest_front(at, last)[1], last, plan, other):
        return last
    for _ in range(_HALVINGS):
        middle = 0.5 * (first + last)
        if stays_ahead(at, gentlest_front(at, middle)[1], middle, plan, other):
            first = middle
        else:
            last = middle
    return last


@compiled_apart
def last_behind(at: Floats, first: float, last: float, plan: Floats, other: Floats) -> float:
    """The latest time, at most ``last``, of a meeting with the rear vehicle before which the leader is not met.

    At ``first`` there is room. The later the meeting, the shorter the braking before it and the less room ahead.
    """
    if stays_behind(at, braking_to_rear(at, last), last, plan, other):
        return last
    for _ in range(_HALVINGS):
        middle = 0.5 * (first + last)
        if stays_behind(at, braking_to_rear(at, middle), middle, plan, other):
            first = middle
        else:
            last = middle
    return last


@compiled_apart
def front_first(
    at: Floats, floor: float, best: float, enough: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Least harm, if below ``best``, where the leader is met first or all three meet at once.

    At once: the outer two close with W, of which the front pair has at least the least at that time. Only if the leader
    can be met as late as that.
    """
    first = meet_front(at, math.inf, plan, other)
    if first == math.inf and at[GAP_L] <= _TOUCHING_M:  # it stands at the leader, and stays: both are struck at once
        return min(best, rear_bound(at, plan, other)[0])
    if first == math.inf or not stays_ahead(at, first, first, plan, other):
        return best
    touches = spare_gap(at[GAP_L], at[V_L], at[A_L], at[V_F], at[A_F]) >= 0.0
    last = meet_front(at, 0.0, plan, other)
    if touches:
        last = largest_behind(at[GAP_L], at[V_L], at[A_L], at[V_F], at[A_F], at[U_F], at[LIMIT_F])[1]
    end = last_ahead(at, first, last, plan, other)
    best = least_harm(FRONT_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    leans = touches and end == last
    if leans:
        best = leaning_harm(at, last, floor, best, plan, other)
        stand = at[V_L] / at[A_L]
        if last < stand:
            best = leaning_harm(at, stand, floor, best, plan, other)
    fill_braking(plan, 0.0, at[A_L])
    fill_braking(other, at[ONSET_R], at[A_R])
    _, time, squared = walk(at[GAP_L] + at[GAP_R], at[V_L], plan, at[V_R], other, math.inf)
    if time == math.inf or (time > end + _GRAZE_S and not leans):
        return best
    least = gentlest_front(at, min(time, last))[0] if time > first else 0.0
    front = max(least, 0.5 * math.sqrt(squared))
    rear = max(math.sqrt(squared) - front, 0.0)
    return min(best, front * front + rear * rear)


@compiled_apart
def leaning_harm(at: Floats, time: float, floor: float, best: float, plan: Floats, other: Floats) -> float:
    """Least harm, if below ``best``, of the meetings with the leader from ``time`` on, however soft."""
    soft = 0.0
    while soft * soft < best:
        hard = soft + 0.02 * (1.0 + soft)
        follows = after_front(at, time, time, hard, time, 0.0, plan, other)
        best = min(best, soft * soft + max(follows, floor))
        soft = hard
    return best


@compiled_apart
def rear_first(
    at: Floats, floor: float, best: float, enough: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Least harm, if below ``best``, where the rear vehicle is met first."""
    high = max(at[V_F] / at[A_F], at[ONSET_R] + at[V_R] / at[A_R])
    first = meet_rear(at, high, plan, other)
    if first == math.inf or not stays_behind(at, first, first, plan, other):
        return best
    last = meet_rear(at, 0.0, plan, other)
    if last < math.inf:
        end = last_behind(at, first, last, plan, other)
        return least_harm(REAR_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    low, top = 0.0, high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + top)
        if meet_rear(at, middle, plan, other) < math.inf:
            top = middle
        else:
            low = middle
    last = meet_rear(at, top, plan, other)
    end = last_behind(at, first, last, plan, other)
    best = least_harm(REAR_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    if end < last:
        return best
    late = max(last_soft(at, high, plan, other), last) + _GRAZE_S
    part = (late - last) / _PARTS
    for k in range(_PARTS):
        best = leaned_on_harm(at, last + k * part, last + (k + 1) * part, floor, best, plan, other)
    return best


@compiled_apart
def last_soft(at: Floats, rest: float, plan: Floats, other: Floats) -> float:
    """A time after which no first meeting with the rear vehicle comes, however soft; all stand at ``rest``.

    It has then passed neither the leader nor the controlled vehicle; where it brakes harder than this one, by b, it was
    faster by ``b t`` a time t before the meeting, from its onset on.
    """
    fill_braking(plan, 0.0, at[A_L])
    fill_braking(other, at[ONSET_R], at[A_R])
    last = min(max(rest, at[V_L] / at[A_L]), walk(at[GAP_L] + at[GAP_R], at[V_L], plan, at[V_R], other, math.inf)[1])
    if at[A_F] >= at[A_R]:
        return float(last)
    harder, onset, closing = at[A_R] - at[A_F], at[ONSET_R], at[V_R] - at[V_F]
    gap = max(at[GAP_R] + (0.5 * at[U_F] * onset - closing) * onset, 0.0)
    ahead = max(closing + at[A_F] * onset, 0.0)
    return float(min(last, onset + min(ahead / harder, math.sqrt(2.0 * gap / harder))))


@compiled_apart
def leaned_on_harm(
    at: Floats, early: float, late: float, floor: float, best: float, plan: Floats, other: Floats
) -> float:
    """Least harm, if below ``best``, of the meetings with the rear vehicle from ``early`` to ``late``, however soft."""
    soft = 0.0
    while soft * soft < best:
        hard = soft + 0.02 * (1.0 + soft)
        follows = after_rear(at, early, late, hard, late, 0.0, plan, other)
        best = min(best, soft * soft + max(follows, floor))
        soft = hard
    return best


@compiled_apart
def combined_bound(
    at: Floats, until: float, front: float, rear: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Least harm of a world in which contact is unavoidable, whoever is met first; 0 if that may be after ``until``.

    ``front`` and ``rear`` are the pairs' own bounds.
    """
    stand = at[ONSET_R] + at[V_R] / at[A_R]
    way = solo_motion(at[V_R], -at[A_R], at[ONSET_R], math.inf, stand)[1]
    room = at[GAP_L] + at[V_L] * at[V_L] / (2.0 * at[A_L]) + at[GAP_R] - way
    rest = at[ONSET_R] + at[V_R] / min(at[A_R], at[A_F])
    if not max(rest, stand + math.sqrt(2.0 * max(room, 0.0) / at[A_F])) < until:
        return 0.0
    step, least = at[TIME_STEP], 0.0
    for time_step in (0.0, step):  # what holds for any command holds for one that changes at decisions only
        at[TIME_STEP] = time_step
        best = front_first(at, rear, LARGE, front + rear, plan, other, heap)
        best = rear_first(at, front, best, front + rear, plan, other, heap)
        least = max(least, best - _TOUCH_HARM if best < LARGE else 0.0)
        if step <= 0.0:
            break
    return least


@compiled
def bound_worlds(
    states: Floats, until: Floats, has_front: Bools, has_rear: Bools, unavoidable: Bools, out: Floats
) -> None:
    """Bounds of worlds ``states`` [n, WIDTH] into ``out`` [n, BOUNDS].

    Each pair's where it exists, both together where contact is unavoidable.
    """
    plan, other, heap = empty_plan(), empty_plan(), np.empty((CELLS, CELL_WIDTH))
    for k in range(states.shape[0]):
        front, rear = 0.0, 0.0
        if has_front[k]:
            squared, time = front_bound(states[k], plan, other)
            front = squared if time < until[k] and squared > _TOUCH_HARM else 0.0
        if has_rear[k]:
            squared, time = rear_bound(states[k], plan, other)
            rear = squared if time < until[k] and squared > _TOUCH_HARM else 0.0
        out[k, FRONT_BOUND], out[k, REAR_BOUND], out[k, COMBINED_BOUND] = front, rear, 0.0
        if unavoidable[k]:
            out[k, COMBINED_BOUND] = combined_bound(states[k], until[k], front, rear, plan, other, heap)


EPS = 2.0**-52  # the spacing of doubles at 1
# Bounds are lowered by so many eps of the squared speeds that a world can hold: a segment or a round of impacts moves a
# squared closing speed by at most 8 eps of these, and an episode has up to 500 of them.
BOUND_EPS = 2.0**12

LEAST_TIME_STEP_S = 1e-3  # between decisions: work grows as they come closer
_LEAST_PART = 100  # worlds of a thread: fewer are done before another one has begun


@dataclass(frozen=True, slots=True)
class LowerBound:
    """What is proven about each world [n], in m2/s2."""

    harm: Floats  # no profile does less harm than this
    early: Floats  # done before the controlled vehicle may act
    front_pair: Floats  # of the front pair alone, from then on
    rear_pair: Floats  # of the rear pair alone
    combined: Floats  # of both together; 0 where nothing is proven
    contact: Avoidability  # the verdict on contact that the bound of both together rests on

    @property
    def impact_proven(self) -> Bools:
        """Whether every profile has an impact, [n]; elsewhere none is proven, which need not mean that one can."""
        yes: Bools = self.harm > 0.0
        return yes


def lower_bound(
    worlds: Worlds,
    vehicle: int = 1,
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    scripts: Mapping[int, str] | None = None,
    time_step_s: float | None = None,
) -> LowerBound:
    """Proven lower bound on the harm from now to ``horizon_s`` (absolute), over all commands of ``vehicle``.

    ``harm = early + max(front_pair + rear_pair, combined)``, each part rounded outward (``rounding``). The combined
    bound is 0 where contact can be avoided. What may come only after the horizon counts as 0, and so does the next
    impact of a pair that was hit before where ``harm_count`` is "first".

    With ``time_step_s`` it is proven only for commands that change at decisions, the first one when the vehicle may
    act, one every ``time_step_s`` after it: what every agent drives. That is sharper, and takes ten times as long.

    Covers the same lines as ``avoidability``, and raises ``InvalidInput`` for others, for an unknown ``harm_count``, a
    time step below ``LEAST_TIME_STEP_S``, and a horizon that is not finite or lies before the vehicle may act.
    """
    check_asked("lower_bound", harm_count, horizon_s, time_step_s)
    verdict = avoidability(worlds, vehicle, scripts=scripts)
    start = np.maximum(worlds.vehicles.latency_s[:, vehicle], worlds.time_s)
    if not (np.all(start <= horizon_s) and horizon_s < np.inf):
        raise InvalidInput(f"lower_bound: horizon_s {horizon_s!r}: must be finite and at least {start.max():g} s")
    at_onset, impacts = advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=start)
    early = empty_ledger(worlds).add(impacts).world_harm(harm_count)
    counts = ~at_onset.pair_hit if harm_count == "first" else np.ones_like(at_onset.pair_hit)
    forward = at_onset.speeds_mps >= 0.0
    open_pair = counts & forward[:, 1:] & forward[:, :-1]
    none = np.zeros(worlds.n, dtype=np.bool_)
    has_front = open_pair[:, vehicle - 1] if vehicle > 0 else none
    has_rear = open_pair[:, vehicle] if vehicle < worlds.N - 1 else none
    struck = at_onset.obstacle_hit & (harm_count == "first")  # whoever is pushed there is not charged for it again
    unavoidable = has_front & has_rear & (verdict.reason >= 2) & ~struck
    out = np.empty((worlds.n, BOUNDS))
    given: tuple[Any, ...] = (
        onset_states(at_onset, vehicle, time_step_s),
        horizon_s - start,
        has_front,
        has_rear,
        unavoidable,
        out,
    )
    threads = min(os.cpu_count() or 1, worlds.n // _LEAST_PART + 1)
    by_parts(lambda part: bound_worlds(*(array[part] for array in given)), worlds.n, threads)
    parts = (early, *(out[:, column] for column in (FRONT_BOUND, REAR_BOUND, COMBINED_BOUND)))
    early, front, rear, combined = (np.maximum(part - rounding(worlds, vehicle), 0.0) for part in parts)
    return LowerBound(early + np.maximum(front + rear, combined), early, front, rear, combined, verdict)


def check_asked(where: str, harm_count: str, horizon_s: object, time_step_s: object) -> None:
    """Raise ``InvalidInput`` for an unknown count, a horizon that is no number, or a time step that cannot be."""
    check_harm_count(harm_count)
    if not _is_number(horizon_s):
        raise InvalidInput(f"{where}: horizon_s {horizon_s!r}: must be a number of seconds")
    if time_step_s is not None and not (_is_number(time_step_s) and LEAST_TIME_STEP_S <= time_step_s < np.inf):  # type: ignore[operator]  # a number
        raise InvalidInput(
            f"{where}: time_step_s {time_step_s!r}: must be a number of seconds from {LEAST_TIME_STEP_S:g} on, or None"
        )


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def rounding(worlds: Worlds, vehicle: int) -> Floats:
    """How far arithmetic can move a bound and a realised harm apart, at most; [n] m2/s2.

    A squared closing speed is ``D = w^2 + 2 b g``. With ``V`` the largest speed in the line, ``G`` its gaps, ``A`` the
    largest closing acceleration and ``a`` the weakest brakes, every ``w^2`` is at most ``V^2`` and no gap grows beyond
    ``G + V^2 / 2a``, so all terms of D stay below ``S = V^2 (1 + A / a) + 2 A G``. A segment of motion rounds each
    speed twice and each gap five times, a round of impacts each speed by ``CLUSTER_EPS``: either moves D by at most
    8 eps S. These add up and are not multiplied, for the proofs compare a run with itself, not with another one.
    ``BOUND_EPS`` grants 500 of them; the steps of an episode of 8 s are 80, and the bound's own arithmetic, a few
    hundred roundings, is among them too.
    """
    v = worlds.vehicles
    drives = v.driving_capacity_mps2[:, vehicle] > 0.0
    fastest = np.maximum(worlds.speeds_mps.max(axis=1), np.where(drives, v.speed_limit_mps[:, vehicle], 0.0))
    closing = v.braking_capacity_mps2.max(axis=1) + v.driving_capacity_mps2[:, vehicle]
    weakest = v.braking_capacity_mps2.min(axis=1)
    scale = fastest * fastest * (1.0 + closing / weakest) + 2.0 * closing * worlds.gaps_m.sum(axis=1)
    outward: Floats = BOUND_EPS * EPS * scale
    return outward


def onset_states(worlds: Worlds, i: int, time_step_s: float | Floats | None) -> Floats:
    """The worlds, in which vehicle ``i`` may act, as the compiled bounds take them [n, WIDTH] (``limits.meetings``).

    Columns of a neighbour that is not there stay 0, as does the time step where there is none.
    """
    v = worlds.vehicles
    at = np.zeros((worlds.n, WIDTH))
    columns = {
        V_F: worlds.speeds_mps[:, i],
        A_F: v.braking_capacity_mps2[:, i],
        U_F: v.driving_capacity_mps2[:, i],
        LIMIT_F: v.speed_limit_mps[:, i],
        RESTITUTION: v.restitution,
        OBSTACLE: worlds.obstacle_gap_m if i == 1 else np.inf,
        TIME_STEP: 0.0 if time_step_s is None else time_step_s,
    }
    if i > 0:
        columns[GAP_L] = worlds.gaps_m[:, i - 1]
        columns[V_L] = worlds.speeds_mps[:, i - 1]
        columns[A_L] = v.braking_capacity_mps2[:, i - 1]
        columns[FRONT_SHARE] = v.mass_t[:, i - 1] / (v.mass_t[:, i - 1] + v.mass_t[:, i])
    if i < worlds.N - 1:
        columns[GAP_R] = worlds.gaps_m[:, i]
        columns[V_R] = worlds.speeds_mps[:, i + 1]
        columns[A_R] = v.braking_capacity_mps2[:, i + 1]
        columns[ONSET_R] = np.maximum(v.latency_s[:, i + 1] - worlds.time_s, 0.0)
        columns[REAR_SHARE] = v.mass_t[:, i + 1] / (v.mass_t[:, i + 1] + v.mass_t[:, i])
    for column, values in columns.items():
        at[:, column] = values
    return at
