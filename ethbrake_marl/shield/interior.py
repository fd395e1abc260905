"""Robust mode for every world of the box of intervals: which boxes, and an upper bound on the harm of plans over them.

What is certified is a whole plan, from the alert on: nothing that is seen later narrows a box. So the proof is short.
The plan that is held has a bound over all worlds of the box; it is replaced by another one, with the same past, only if
that one's bound is at most the budget. What was applied at the end is the plan that is held then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine.stream import Script
from ethbrake_marl.errors import InvalidInput, renumbered, unknown_name
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.compiled import compiled_apart
from ethbrake_marl.physics.kernel import obstacle_ahead
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.certify import Backup, Decision, Running, as_predicted, certify, put
from ethbrake_marl.shield.certify_kernel import NO_CERTIFICATE
from ethbrake_marl.shield.enclosure import Stack, most_harm, new_stack
from ethbrake_marl.shield.enclosure_motion import (
    Cell,
    Motion,
    add,
    difference,
    high,
    low,
    negative,
    new_motion,
    positive_part,
    product,
    reciprocal,
    rough_at_alert,
    square,
)

# Branch and bound: an upper bound on the harm of a plan over a box, refined where it is largest.

# groups of the numbers of a box, N of each but P gaps
BRAKING, DRIVING, LATENCY, MASS, SPEED, GAP = range(6)
LONGEST_PIECE_S = 0.25  # before the first decision


class Known(NamedTuple):
    """What is certain about the worlds of a box."""

    vehicle: int
    constant: Floats  # [N] command of each other vehicle; NaN: full braking
    limit: Floats  # [N]
    restitution: float
    begin_s: float  # of the worlds
    time_step_s: float
    horizon_s: float


@compiled_apart
def form_of(low_: Floats, high_: Floats, which: int, free: Ints) -> Floats:
    """The form of number ``which`` of a box whose uncertain ones are ``free`` [K]."""
    out = np.zeros(free.shape[0] + 2)
    out[0] = 0.5 * (low_[which] + high_[which])
    half = 0.5 * (high_[which] - low_[which])
    for k in range(free.shape[0]):
        if free[k] == which:
            out[1 + k] = half
            half = 0.0
    out[-1] = half + 1e-15 * abs(out[0])
    return out


@compiled_apart
def cell_of(low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats) -> tuple[Cell, Floats]:
    """The cell of a box [Q], its worlds at the alert, and how long after it the first piece of time begins (s).

    The first decision falls at another time in each world where the shielded vehicle's latency is uncertain: time is
    counted from it, and the first piece begins as long before it as the earliest one comes after the alert.
    """
    N, W = known.limit.shape[0], free.shape[0] + 2
    P, v = N - 1, known.vehicle
    speed, gap, brake, onset = np.empty((N, W)), np.empty((P, W)), np.empty((N, W)), np.empty((N, W))
    share = np.empty((P, 2, W))
    first = form_of(low_, high_, LATENCY * N + v, free)
    first[0] -= known.begin_s
    first = positive_part(first)
    earliest = known.begin_s + max(low(first), 0.0)
    first[0] += known.begin_s
    for i in range(N):
        speed[i] = form_of(low_, high_, SPEED * N + i, free)
        brake[i] = form_of(low_, high_, BRAKING * N + i, free)
        onset[i] = difference(form_of(low_, high_, LATENCY * N + i, free), first)
    for p in range(P):
        gap[p] = form_of(low_, high_, GAP * N + p, free)
        front, rear = form_of(low_, high_, MASS * N + p, free), form_of(low_, high_, MASS * N + p + 1, free)
        whole = front.copy()
        add(whole, 1.0, rear)
        share[p, 0] = product(rear, reciprocal(whole))
        share[p, 1] = -share[p, 0]
        share[p, 1, 0] += 1.0
        share[p, 1, -1] = share[p, 0, -1]
    drive = form_of(low_, high_, DRIVING * N + v, free)
    times, action = pieces(known, onset, earliest, plan)
    cell = Cell(
        speed, gap, brake, drive, share, onset, known.constant, known.limit, v, known.restitution, times, action
    )  # fmt: skip
    first[0] -= earliest
    return cell, first


@compiled_apart
def wait(cell: Cell, late: Floats) -> bool:
    """Move a cell's worlds on by ``late`` (s), each by its own; False where that may not be all that happens."""
    if high(late) <= 1e-12:
        return True
    if low(late) < -1e-12:
        return False
    N = cell.speed.shape[0]
    slowest, way = np.empty(N), np.empty_like(cell.speed)
    for i in range(N):
        pull, certain = early_pull(cell, i, late)
        begin = cell.speed[i].copy()
        way[i] = product(begin, late)
        add(way[i], 0.5, product(pull, square(late)))
        add(cell.speed[i], 1.0, product(pull, late))
        slowest[i], fastest = min(low(begin), low(cell.speed[i])), max(high(begin), high(cell.speed[i]))
        limited = high(pull) > 0.0 and fastest >= cell.limit[i]
        if not certain or limited or slowest[i] < 0.0:
            return False
        if i > 0 and low(cell.gap[i - 1]) <= max(fastest - slowest[i - 1], 0.0) * high(late) + 1e-9:
            return False
    for p in range(N - 1):
        add(cell.gap[p], 1.0, way[p])
        add(cell.gap[p], -1.0, way[p + 1])
    return True


@compiled_apart
def early_pull(cell: Cell, i: int, late: Floats) -> tuple[Floats, bool]:
    """Acceleration of a vehicle until ``late`` after the alert; False where it may begin within that time."""
    pull = np.zeros_like(late)
    if i == cell.vehicle:
        return pull, True
    acts = cell.onset[i].copy()  # after the alert
    add(acts, 1.0, late)
    acts[0] -= cell.times[0]
    if high(acts) > 1e-12:
        return pull, low(acts) >= high(late)
    if math.isnan(cell.constant[i]):
        return negative(cell.brake[i]), True
    pull[0] = cell.constant[i]
    return pull, True


@compiled_apart
def pieces(known: Known, onset: Floats, earliest: float, plan: Floats) -> tuple[Floats, Floats]:
    """Where commands may change, s after the first decision, and the shielded vehicle's action between."""
    N = onset.shape[0]
    before = earliest - known.begin_s
    first = math.ceil(before / LONGEST_PIECE_S) if before > 0.0 else 0
    last = math.ceil((known.horizon_s - earliest) / known.time_step_s - 1e-9)
    points = np.empty(first + last + 1 + 2 * N)
    count = 0
    for k in range(first):
        points[count] = -before + before * k / first
        count += 1
    for k in range(last + 1):
        points[count] = k * known.time_step_s
        count += 1
    for i in range(N):
        if i != known.vehicle:
            for at in (low(onset[i]), high(onset[i])):
                if -before < at < last * known.time_step_s:
                    points[count] = at
                    count += 1
    times = np.unique(points[:count])
    action = np.zeros(times.shape[0] - 1)
    for j in range(action.shape[0]):
        middle = 0.5 * (times[j] + times[j + 1])
        if middle > 0.0:
            action[j] = plan[min(int(middle / known.time_step_s), plan.shape[0] - 1)]
    return times, action


@compiled_apart
def bound_of(
    low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats, stack: Stack, motion: Motion, out: Floats,
    most: float,
) -> float:  # fmt: skip
    """Upper bound on the harm of a plan over one box, unless it is above ``most``."""
    cell, late = cell_of(low_, high_, free, known, plan)
    rough = rough_at_alert(cell, late)
    if wait(cell, late):
        harm = most_harm(cell, stack, motion, out, most)
        if harm <= rough:
            return harm
    out[:] = 0.0
    out[0] = rough
    return rough


@compiled_apart
def bound_box(
    low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats, enough: float, cells: int, only_enough: bool
) -> tuple[float, int]:
    """Upper bound on the harm of a plan [L] over a box [Q], and the cells looked at.

    The box is halved where the bound is largest, until that is at most ``enough`` or ``cells`` were looked at. With
    ``only_enough`` a part is given up once its harm is above ``enough``: a larger result is then no bound.
    """
    N, K, Q = known.limit.shape[0], free.shape[0], low_.shape[0]
    stack, motion = new_stack(N, K + 2), new_motion(N, K + 2)
    lows, highs = np.empty((cells + 1, Q)), np.empty((cells + 1, Q))
    bounds, slopes = np.full(cells + 1, -math.inf), np.zeros((cells + 1, K + 2))
    lows[0], highs[0] = low_, high_
    most, size, looked = enough if only_enough else math.inf, 1, 1
    bounds[0] = bound_of(low_, high_, free, known, plan, stack, motion, slopes[0], most)
    while looked + 2 <= cells and K > 0:
        at = int(np.argmax(bounds[:size]))
        if bounds[at] <= enough:
            break
        share = (highs[at] - lows[at])[free] / (high_ - low_)[free]
        weight = np.abs(slopes[at, 1:-1])
        which = free[int(np.argmax(weight if weight.max() > 0.0 else share))]
        middle = 0.5 * (lows[at, which] + highs[at, which])
        lows[size], highs[size] = lows[at], highs[at]
        highs[at, which], lows[size, which] = middle, middle
        bounds[at] = bound_of(lows[at], highs[at], free, known, plan, stack, motion, slopes[at], most)
        bounds[size] = bound_of(lows[size], highs[size], free, known, plan, stack, motion, slopes[size], most)
        size += 1
        looked += 2
    return bounds[:size].max(), looked


MOST_VEHICLES = 3
CELLS_AT_ALERT, CELLS = 200, 40  # looked at for the bound at the alert, and for one later certificate
NEAR = 1.02  # times the largest harm in a corner: a bound this good is not refined any further
NEARLY_NOTHING = 0.1  # m2/s2, likewise
CORNERS, INTERIOR = "corners", "interior"  # which worlds of a box robust mode certifies
CERTAINTIES = (CORNERS, INTERIOR)
PER_BOX = ("low", "high", "limit", "restitution", "begin_s", "constant")  # arrays of Boxes
SCRIPTS = ("full_brake", "coast", "constant")


class Boxes(NamedTuple):
    """The boxes of n worlds: each uncertain number from ``low`` to ``high``."""

    low: Floats  # [n, Q] braking, driving, latency, mass, speed of each vehicle, then the gaps
    high: Floats  # [n, Q]
    limit: Floats  # [n, N] m/s
    restitution: Floats  # [n]
    begin_s: Floats  # [n]
    constant: Floats  # [n, N] m/s2; NaN: full braking
    vehicle: int
    time_step_s: float
    horizon_s: float

    def put(self, rows: Ints, new: Boxes) -> Boxes:
        """A copy with the boxes of ``new`` in these rows."""
        columns: dict[str, Any] = {name: put(getattr(self, name), rows, getattr(new, name)) for name in PER_BOX}
        return self._replace(**columns)

    def take(self, rows: Ints) -> Boxes:
        """Those of some worlds."""
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in PER_BOX}
        return self._replace(**columns)


def placed(old: Boxes | None, new: Boxes, rows: Ints) -> Boxes:
    """The boxes of a batch in which episodes begin in these rows: all of them, or some of the ``old`` ones."""
    return new.take(np.argsort(rows)) if old is None or len(rows) >= len(old.low) else old.put(rows, new)


def check_possible(robust: str, scenario: Scenario, harm_count: HarmCount, others: Mapping[int, Script]) -> None:
    """Raise ``InvalidInput`` for a setting that interior mode cannot certify, whatever its worlds.

    That is: total harm, more than three vehicles, an obstacle ahead, or others that do anything else than brake fully,
    coast, or hold one deceleration.
    """
    if robust != INTERIOR:
        return
    if harm_count == "total":
        raise _refusal("total harm")
    if scenario.vehicles > MOST_VEHICLES:
        raise _refusal(f"{scenario.vehicles} vehicles")
    if scenario.has_obstacle:
        raise _refusal("an obstacle ahead")
    for i, script in sorted(others.items()):
        name = getattr(script, "name", type(script).__name__)
        if name.split(":")[0] not in SCRIPTS:
            raise InvalidInput(
                f"shield: robust interior: vehicle_{i + 1} is driven by {name!r}, which it cannot enclose; full_brake,"
                " coast and constant:A are possible; robust corners takes every script"
            )


def _refusal(what: str) -> InvalidInput:
    return InvalidInput(
        f"shield: robust interior: {what}: it certifies first-impact harm of at most {MOST_VEHICLES} vehicles without"
        " an obstacle; robust corners takes every scenario"
    )


def boxes_of(possible: Worlds, running: Running, scenario: Scenario, others: Mapping[int, Script]) -> Boxes:
    """The boxes of the n worlds of ``running`` at the alert, their members being ``possible`` [n * M].

    Raises ``InvalidInput`` for worlds that interior mode cannot certify: with an obstacle ahead, or in which another
    vehicle's command is not the same in the whole box. ``check_possible`` says what no world of a scenario changes.
    """
    n, vehicle = running.n, int(running.problem.vehicles[0])
    v, N = possible.vehicles, possible.N
    command = running.problem.command[:, running.problem.command.shape[1] - N :]
    if obstacle_ahead(possible).any():
        raise _refusal("an obstacle ahead")
    numbers = np.concatenate(
        [v.braking_capacity_mps2, v.driving_capacity_mps2, v.latency_s, v.mass_t, possible.speeds_mps, possible.gaps_m],
        axis=1,
    ).reshape(n, -1, 6 * N - 1)
    members = len(v.mass_t) // n
    return Boxes(
        numbers.min(axis=1), numbers.max(axis=1), v.speed_limit_mps[::members], v.restitution[::members],
        possible.time_s[::members], _constants(others, vehicle, command.reshape(n, members, N)), vehicle,
        scenario.time_step_s, scenario.horizon_s,
    )  # fmt: skip


def _constants(others: Mapping[int, Script], vehicle: int, command: Floats) -> Floats:
    """Command of each other vehicle [n, N], NaN where it brakes fully; [n, M, N] in the members."""
    constant = np.full((command.shape[0], command.shape[2]), np.nan)
    for i, script in others.items():
        name = getattr(script, "name", type(script).__name__)
        kind = name.split(":")[0]
        if i == vehicle or kind == "full_brake":
            continue
        if not (command[:, :, i] == command[:, :1, i]).all():
            raise InvalidInput(
                f"shield: robust interior: vehicle_{i + 1} is driven by {name!r}, whose command is another one in each"
                " world of the box; full_brake, coast and constant:A are possible, A being at most every capacity of"
                " the box"
            )
        constant[:, i] = command[:, 0, i]
    return constant


def expects(boxes: Boxes | None, running: Running, seen: Floats) -> Bools:
    """Where what is seen now [n, columns] may be, as far as is known, [n].

    Where the own latency of a box is uncertain a decision falls at another time in each of its worlds. No range of the
    corners holds them then: any finite numbers may be.
    """
    expected = as_predicted(running, seen)
    if boxes is not None:
        own = 2 * boxes.limit.shape[1] + boxes.vehicle
        expected |= (boxes.high[:, own] > boxes.low[:, own]) & np.isfinite(seen).all(axis=1)
    return expected


def bounds_at_alert(boxes: Boxes, plans: Floats, harm: Floats) -> Floats:
    """Upper bound on the harm of each plan [n, L] over its box, ``harm`` being its largest in a corner, [n] m2/s2."""
    return bound_plans(boxes, plans, NEAR * harm + NEARLY_NOTHING, CELLS_AT_ALERT)


def bound_plans(boxes: Boxes, plans: Floats, enough: Floats, cells: int, *, only_enough: bool = False) -> Floats:
    """Upper bound on the harm of each plan [n, L], from the alert on, over all worlds of its box, [n] m2/s2.

    A bound at most ``enough`` [n] is not refined any further, and no more than ``cells`` parts of a box are looked at.
    With ``only_enough`` what is above ``enough`` is no bound: it says that none at most that was found.
    """
    bounds = np.empty(len(plans))
    for k in range(len(plans)):
        low, high = boxes.low[k], boxes.high[k]
        known = Known(
            boxes.vehicle, boxes.constant[k], boxes.limit[k], float(boxes.restitution[k]), float(boxes.begin_s[k]),
            boxes.time_step_s, boxes.horizon_s,
        )  # fmt: skip
        plan = np.ascontiguousarray(plans[k], np.float64)
        bounds[k] = bound_box(low, high, np.flatnonzero(high > low), known, plan, float(enough[k]), cells, only_enough)[
            0
        ]
    return bounds


def checked_robust(robust: object, where: str) -> str:
    """``corners`` or ``interior``; raises ``UnknownName`` for anything else."""
    if robust not in CERTAINTIES:
        raise unknown_name(f"{where}: robust", robust, CERTAINTIES)
    return str(robust)


def certify_inside(
    boxes: Boxes | None, running: Running, held: Backup, budget: Floats, decision: Decision, asked: Bools
) -> Decision:
    """A decision that the corners allow, refused where its plan is not certified for every world of the box, if any.

    ``held`` is the backup before it. A plan without a certificate never replaces the held one. Episodes end at the
    horizon: that all corners rest does not mean that every world does.
    """
    if boxes is None:
        return decision
    plan, other = decision.backup.plan.copy(), (decision.backup.plan != held.plan).any(axis=1)
    bound = np.where(asked & ~other, held.harm, decision.bound)  # of the corners alone, where the plan is the same
    changed = np.flatnonzero(asked & other)
    found = bound_plans(boxes.take(changed), plan[changed], budget[changed], CELLS, only_enough=True)
    least = np.where(decision.intervened, held.harm, budget)[changed]
    good = found <= least
    bound[changed[good]] = found[good]
    known = np.isfinite(found)
    decision.margin[changed[known]] = (budget[changed] - found)[known]
    bad = changed[~good]
    plan[bad], bound[bad] = held.plan[bad], held.harm[bad]
    decision = decision._replace(bound=bound, backup=decision.backup._replace(plan=plan, harm=bound))
    refused = bad[~decision.intervened[bad]]
    if refused.size:
        decision = _refuse(running, held, decision, refused)
    after = decision.after
    over = np.repeat(after.steps, after.members) >= after.problem.last_step
    each = np.repeat(asked, after.members)
    return decision._replace(after=after._replace(ended=np.where(each, over, after.ended)))


def _refuse(running: Running, held: Backup, decision: Decision, rows: Ints) -> Decision:
    """The decision with the held plan's action in these rows."""
    part = running.take(rows)
    action = held.plan[rows, part.steps]
    kept = Backup(held.plan[rows], held.harm[rows], held.constants)
    with renumbered(rows):
        instead = certify(part, action, kept, held.harm[rows])
    at, after = running.rows_of(rows), decision.after
    states, ended = after.states.copy(), after.ended.copy()
    states[at], ended[at] = instead.after.states, instead.after.ended
    decision.applied[rows], decision.intervened[rows] = instead.applied, True
    decision.reason[rows] = NO_CERTIFICATE
    return decision._replace(after=after._replace(states=states, ended=ended))
