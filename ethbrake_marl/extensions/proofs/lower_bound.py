"""``lower_bound``: a proven lower bound on the harm of every world, whatever the controlled vehicle does.

Proof: docs/proofs/harm.md. Arguments: ``proofs/__init__.py``.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import ALL_IMPACTS, BUILT_IN_COUNTS, HONEST, AnyCount, HarmCount
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import hold_commands
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.proofs.avoidability import FRONT, avoidability
from ethbrake_marl.extensions.proofs.branch_and_bound import CELL_COLUMNS, CELLS, least_contact_harm
from ethbrake_marl.extensions.proofs.first_contacts import GRAZE_S, last_meeting, outer_contact, rear_times
from ethbrake_marl.extensions.proofs.followers import after
from ethbrake_marl.extensions.proofs.line import (
    A_F,
    A_L,
    A_R,
    FRONT_FIRST,
    GAP_L,
    GAP_R,
    LARGE,
    ONSET_F,
    ONSET_R,
    REAR_FIRST,
    TIME_STEP,
    TOUCH_HARM,
    TOUCHING_M,
    V_F,
    V_L,
    V_R,
    rows_of,
)
from ethbrake_marl.extensions.proofs.meetings import (
    before_rear,
    behind_leader,
    driving_first,
    gentlest_front,
    meet_front,
    rest_of_rear,
    stays_ahead,
)
from ethbrake_marl.extensions.proofs.plans import braking
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.interval import solo
from ethbrake_marl.motion.layout import LIMIT, Bools, Floats
from ethbrake_marl.parallel import chosen_threads

LEAST_TIME_STEP_S = 1e-3  # shorter steps between decisions would take too long

# Bounds are lowered by so many spacings of doubles at the largest squared speed of a world. A segment of motion or a
# round of impacts changes a squared closing speed by at most 8 of them, and an episode has at most 500 of these.
BOUND_EPS = 2.0**12
EPS = 2.0**-52

_AT_ONCE = 100  # worlds that a thread bounds together
_PARTS = 8  # number of parts into which the times of soft contacts are divided

FRONT_BOUND, REAR_BOUND, COMBINED_BOUND, BOUNDS = range(4)


class LowerBound(NamedTuple):
    """Lower bounds on the harm of each world, [n] m2/s2: ``harm``, and the terms from which it is computed.

    ``harm = early + max(front_pair + rear_pair, combined)`` (see ``lower_bound``).
    """

    harm: Floats  # no command does less
    early: Floats  # harm before the controlled vehicle may act
    front_pair: Floats  # bound of the front pair alone, after the early harm
    rear_pair: Floats  # bound of the rear pair alone, after the early harm
    combined: Floats  # bound of both pairs together; 0 if nothing is proven

    @property
    def impact_proven(self) -> Bools:
        """Whether it is proven that every command leads to an impact, [n].

        False: an impact is not proven, but may be unavoidable.
        """
        return np.asarray(self.harm > 0.0)


@kernel
def front_bound(at):
    """Smallest squared closing speed (m2/s2) and latest time (s) of the front pair's first contact.

    The time is infinite if full braking avoids the contact. ``at``: one world (columns: ``proofs/line.py``).
    """
    _, time, squared = behind_leader(at, braking(0.0, at[A_F]), at[V_F] / at[A_F])
    if at[A_F] < at[A_L] and at[V_F] < at[V_L]:
        squared = min(squared, 2.0 * (at[A_L] - at[A_F]) * at[GAP_L])
    return squared, time


@kernel
def rear_bound(at):
    """Smallest squared closing speed (m2/s2) and latest time (s) of the rear pair's first contact.

    Full drive attains both; the time is infinite if full drive avoids the contact. ``at``: one world (columns: file
    ``line``).
    """
    _, time, squared = before_rear(at, driving_first(at, math.inf), rest_of_rear(at))
    return squared, time


@large
def soft_harm(kind, at, early, late, floor, best):
    """Lower bound (m2/s2), at most ``best``, on the harm of first contacts from ``early`` to ``late`` (s).

    Unlike in ``least_contact_harm``, these contacts may have any closing speed from 0 on. Arguments: package
    ``proofs``.
    """
    soft = 0.0
    while soft * soft < best:
        hard = soft + 0.02 * (1.0 + soft)
        best = min(best, soft * soft + max(after(kind, at, early, late, hard, late, 0.0), floor))
        soft = hard
    return best


@large
def front_first(at, floor, best, enough, cells):
    """Lower bound (m2/s2), at most ``best``, on the harm if the controlled vehicle first meets the front vehicle, or
    meets both neighbours at once.

    If it meets both at once, the two closing speeds add up to that of the rear vehicle towards the front vehicle, and
    the front one cannot be below the smallest possible at that time. This case counts only at times at which a first
    contact with the front vehicle is possible. Arguments: package ``proofs``.
    """
    first = meet_front(at, math.inf)
    if first == math.inf and at[GAP_L] <= TOUCHING_M:
        return min(best, rear_bound(at)[0])  # it stands in contact with the leader, so the rear vehicle hits both
    if first == math.inf or not stays_ahead(at, first, first):
        return best
    last, end, leans = last_meeting(at, first)
    best = least_contact_harm(FRONT_FIRST, at, first, end, floor, best, enough, cells)
    if leans:
        best = soft_harm(FRONT_FIRST, at, last, last, floor, best)
        stand = at[V_L] / at[A_L]
        if last < stand:
            best = soft_harm(FRONT_FIRST, at, stand, stand, floor, best)
    time, squared = outer_contact(at)
    if time == math.inf or (time > end + GRAZE_S and not leans):
        return best
    least = gentlest_front(at, min(time, last))[0] if time > first else 0.0
    front = max(least, 0.5 * math.sqrt(squared))
    rear = max(math.sqrt(squared) - front, 0.0)
    return min(best, front * front + rear * rear)


@large
def rear_first(at, floor, best, enough, cells):
    """Lower bound (m2/s2), at most ``best``, on the harm if the first contact is with the rear vehicle.

    ``floor`` (m2/s2) is a known bound on the front pair's harm; the search may stop early once its result is at most
    ``enough`` (m2/s2). Other arguments: package ``proofs``.
    """
    first, last, end, late = rear_times(at)
    if first == math.inf:
        return best
    best = least_contact_harm(REAR_FIRST, at, first, end, floor, best, enough, cells)
    if late == last:
        return best
    part = (late - last) / _PARTS
    for k in range(_PARTS):
        best = soft_harm(REAR_FIRST, at, last + k * part, last + (k + 1) * part, floor, best)
    return best


@kernel
def last_rest(at):
    """Time (s) after which no harm that ``combined_bound`` counts can happen.

    ``at``: one world (columns: ``proofs/line.py``).
    """
    stand = rest_of_rear(at)
    way = solo(at[V_R], -at[A_R], at[ONSET_R], math.inf, stand)[1]
    room = at[GAP_L] + at[V_L] * at[V_L] / (2.0 * at[A_L]) + at[GAP_R] - way
    rest = at[ONSET_R] + at[V_R] / min(at[A_R], at[A_F])
    return max(rest, stand + math.sqrt(2.0 * max(room, 0.0) / at[A_F]))


@large
def combined_bound(at, until, front, rear, cells):
    """Lower bound (m2/s2) on the harm of both pairs together in a world with unavoidable contact.

    0 if harm that this bound counts may come after the horizon ``until`` (s). ``front`` and ``rear`` are lower bounds
    on the harm of each pair alone (m2/s2). ``at``, ``cells``: package ``proofs``.
    """
    if not last_rest(at) < until:
        return 0.0
    step, least = at[TIME_STEP], 0.0
    for time_step in (0.0, step):  # a bound for all commands also holds for commands that change at decisions only
        at[TIME_STEP] = time_step
        best = front_first(at, rear, LARGE, front + rear, cells)
        best = rear_first(at, front, best, front + rear, cells)
        least = max(least, best - TOUCH_HARM if best < LARGE else 0.0)
        if step <= 0.0:
            break
    return least


@large
def bound_worlds(rows, until, has_front, has_rear, unavoidable, cells, out):
    """Write the bounds of n worlds to ``out`` [n, BOUNDS] (m2/s2): front pair, rear pair, both together.

    ``rows`` [n, LINE_COLUMNS]: the worlds (columns: ``proofs/line.py``). Harm after ``until`` [n] (s) does not count.
    ``has_front`` [n]: whether the front vehicle exists and the next impact with it counts; ``has_rear`` [n]: the same
    for the rear vehicle. ``unavoidable`` [n]: whether contact cannot be avoided. ``cells``: overwritten.
    """
    for k in range(len(out)):
        for column in range(BOUNDS):
            out[k, column] = 0.0
        if has_front[k]:
            squared, time = front_bound(rows[k])
            out[k, FRONT_BOUND] = squared if time < until[k] and squared > TOUCH_HARM else 0.0
        if has_rear[k]:
            squared, time = rear_bound(rows[k])
            out[k, REAR_BOUND] = squared if time < until[k] and squared > TOUCH_HARM else 0.0
        if unavoidable[k]:
            out[k, COMBINED_BOUND] = combined_bound(rows[k], until[k], out[k, FRONT_BOUND], out[k, REAR_BOUND], cells)


def lower_bound(
    state: State,
    body: int = 2,
    *,
    harm_count: AnyCount = HONEST,
    horizon_s: float = 8.0,
    time_step_s: float | None = None,
) -> LowerBound:
    """Proven lower bound on the harm of every episode, over all commands of the vehicle ``body`` from now on.

    ``harm = early + max(front_pair + rear_pair, combined)``; each term is lowered by the largest possible rounding
    error (``rounding``). ``early`` includes harm that has already happened. ``combined`` is 0 where contact can be
    avoided. Harm that may come only after ``horizon_s`` counts as 0. The proof covers the lines that ``avoidability``
    accepts, without an obstacle.

    Args:
        state: the n episodes now.
        body: the controlled vehicle (1: Vehicle 1); all others brake fully.
        harm_count: ``first`` (of each pair only the first impact), ``total``, or ``honest``: total harm, which the
            honest cost is never below.
        horizon_s: time until which harm counts, s after the alert.
        time_step_s: time between two decisions (s); the first decision is when the vehicle may act. None: commands
            may change at any time. With a time step the bound is larger, but holds only for commands that change at
            decisions, and takes ten times as long.

    Raises ``InvalidInput`` where ``avoidability`` does, for an obstacle, another count, a time step below
    ``LEAST_TIME_STEP_S``, and a horizon that is not finite or lies before the vehicle may act.

    """
    reason = avoidability(state, body).reason
    start = state.time_s + rows_of(state, body)[:, ONSET_F]
    count = HarmCount.of(harm_count, "lower_bound: harm_count")
    _check_asked(state, start, count, horizon_s, time_step_s)
    count = ALL_IMPACTS if count == HONEST else count
    full = np.pad(-state.braking_capacity_mps2, ((0, 0), (1, 0)))
    now = hold_commands(state._replace(wanted=full), start)  # until then all brake fully
    counts = (now.speeds_mps[:, 1:] >= 0.0) & (now.speeds_mps[:, :-1] >= 0.0) & ((count == ALL_IMPACTS) | ~now.pair_hit)
    none = np.zeros(state.n, np.bool_)
    has_front = counts[:, body - 2] if body > 1 else none
    has_rear = counts[:, body - 1] if body < state.vehicles else none
    unavoidable = has_front & has_rear & (reason >= FRONT)
    rows, until, out = rows_of(now, body, time_step_s or 0.0), horizon_s - start, np.empty((state.n, BOUNDS))

    def bound(first: int) -> None:
        part = slice(first, first + _AT_ONCE)
        cells = np.empty((CELLS, CELL_COLUMNS))
        bound_worlds(rows[part], until[part], has_front[part], has_rear[part], unavoidable[part], cells, out[part])

    with ThreadPoolExecutor(chosen_threads(None)) as pool:
        list(pool.map(bound, range(0, state.n, _AT_ONCE)))
    parts = (now.harm(count), out[:, FRONT_BOUND], out[:, REAR_BOUND], out[:, COMBINED_BOUND])
    early, front, rear, combined = (np.maximum(part - rounding(state, body), 0.0) for part in parts)
    return LowerBound(early + np.maximum(front + rear, combined), early, front, rear, combined)


def _check_asked(state: State, start: Floats, count: HarmCount, horizon_s: float, time_step_s: float | None) -> None:
    if count not in BUILT_IN_COUNTS:
        known = ", ".join(known.name for known in BUILT_IN_COUNTS)
        raise InvalidInput(f"lower_bound: harm_count = {count.name!r}: a bound is proven only for {known}")
    if not (isinstance(horizon_s, int | float) and (start <= horizon_s).all() and horizon_s < math.inf):
        raise InvalidInput(
            f"lower_bound: horizon_s = {horizon_s!r}: must be a finite number of at least {start.max():g} (s): by then"
            " the controlled vehicle may act in every world"
        )
    if time_step_s is not None and not (
        isinstance(time_step_s, int | float) and LEAST_TIME_STEP_S <= time_step_s < math.inf
    ):
        raise InvalidInput(
            f"lower_bound: time_step_s = {time_step_s!r}: must be a finite number of at least {LEAST_TIME_STEP_S:g}"
            " (s), or None"
        )
    if (ahead := np.isfinite(state.obstacle_gap_m)).any():
        raise InvalidInput(
            f"lower_bound: world {int(np.argmax(ahead))} has an obstacle ahead; the bound is proven without an obstacle"
        )


def rounding(state: State, body: int) -> Floats:
    """Largest difference, caused by rounding, between a bound and the simulated harm, [n] m2/s2.

    A squared closing speed is ``D = w^2 + 2 b g``, with closing speed w, closing acceleration b and gap g. Let ``V`` be
    the largest speed in the line, ``G`` the sum of its gaps, ``A`` the largest closing acceleration and ``a`` the
    weakest braking capacity. The term ``w^2`` of D is at most ``V^2``. No gap grows beyond ``G + V^2 / (2 a)``.
    Therefore all terms of D stay below ``S = V^2 (1 + A / a) + 2 A G``.

    In a segment of motion, the computation rounds each speed twice and each gap five times. In a round of impacts,
    rounding changes each speed by up to 8 eps of the largest speed (eps = 2^-52). Rounding in one segment or round
    changes D by at most 8 eps S. These errors add up and do not multiply, because the proofs compare a motion only with
    the formulas for this same motion. ``BOUND_EPS`` allows for 500 segments and rounds of impacts. This is enough: an
    episode of 8 s has 80 steps, and the computation of the bound itself rounds a few hundred times.

    If the controlled vehicle may drive, V is at least its speed limit, and A includes its driving capacity.
    """
    driving = state.driving_capacity_mps2[:, body - 1]
    limits = np.where(driving > 0.0, state.car[:, LIMIT, body], 0.0)
    fastest = np.maximum(state.speeds_mps.max(axis=1), limits)
    closing = state.braking_capacity_mps2.max(axis=1) + driving
    weakest = state.braking_capacity_mps2.min(axis=1)
    scale = fastest * fastest * (1.0 + closing / weakest) + 2.0 * closing * state.gaps_m.sum(axis=1)
    return np.asarray(BOUND_EPS * EPS * scale)
