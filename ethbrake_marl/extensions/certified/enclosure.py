"""Upper bound on the harm of a plan in all worlds of a box, by branch and bound.

The search divides the box into parts: it repeatedly halves the part with the largest upper bound on the harm.

Letters for shapes: a world consists of ``Q`` numbers, of which ``K`` are uncertain; a plan has ``L`` actions; an affine
form (module ``affine``) has ``W = K + 2`` entries. Arguments that several functions share:

- ``low_``, ``high_``: [Q] smallest and largest value in the box for each number of a world.
- ``free``: [K] indices of the uncertain numbers.
- ``plan``: [L] action of the shielded vehicle at each decision.
- ``late``: time from the alert to the start of the first piece as an affine form [W], s.
- ``rates``: [2, W] rates at which the brakes build up (index 0) and release (index 1), m/s3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.engine.profiles import ProfileProblem
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.extensions.certified.affine import (
    TOUCH_WIDTH,
    Cell,
    Forces,
    Motion,
    Path,
    add,
    between,
    cut,
    difference,
    high,
    linear,
    low,
    negative,
    new_motion,
    positive_part,
    product,
    radius,
    reciprocal,
    since,
    square,
)
from ethbrake_marl.extensions.certified.paths import Stack, most_harm, new_stack
from ethbrake_marl.extensions.certified.rough import rough_harm
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats, Ints, Worlds
from ethbrake_marl.scenario.schema import Scenario

# groups of the numbers of a box: N numbers in each group, P in the last group
BRAKING, DRIVING, LATENCY, MASS, BRAKE_RATE, RELEASE_RATE, SPEED, GAP = range(8)

LONGEST_PIECE_S = 0.25  # longest piece before the first decision


class Known(NamedTuple):
    """Quantities that are the same in all worlds of a box."""

    vehicle: int  # index of the shielded vehicle
    constant: Floats  # [N] command of each other vehicle, m/s2; NaN: full braking
    limit: Floats  # [N] speed limits, m/s
    restitution: float  # coefficient of restitution, 0 to 1
    begin_s: float  # time at which the worlds begin, s
    time_step_s: float  # time between two decisions, s
    horizon_s: float  # time at which the episode ends, s


@compiled(apart=True)
def form_of(low_: Floats, high_: Floats, which: int, free: Ints) -> Floats:
    """Return the number with index ``which`` of a world as an affine form [W] that covers all worlds of a box."""
    out = np.zeros(free.shape[0] + 2)
    out[0] = 0.5 * (low_[which] + high_[which])
    half = 0.5 * (high_[which] - low_[which])
    for k in range(free.shape[0]):
        if free[k] == which:
            out[1 + k] = half
            half = 0.0
    out[-1] = half + 1e-15 * abs(out[0])
    return out


@compiled(apart=True)
def cell_of(low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats) -> tuple[Cell, Floats]:
    """Return the cell of a box, and the time (s) from the alert to the start of the first piece as an affine form [W].

    All times in a cell are measured from the first decision. If the shielded vehicle's latency is uncertain, the time
    from the alert to the first decision differs between worlds. The first piece starts d seconds before the first
    decision, where d is the shortest time from the alert to the first decision in any world of the box.
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
    first[0] -= earliest
    build = np.zeros(N, np.bool_)
    for i in range(N):  # the other vehicles only brake or only drive, so one of their rates matters
        down, up = low_[BRAKE_RATE * N + i] < math.inf, low_[RELEASE_RATE * N + i] < math.inf
        build[i] = (up and (i == v or known.constant[i] > 0.0)) or (down and not known.constant[i] >= 0.0)
    J, moving = times.shape[0] if build.any() else 0, bool(build.any())
    forces = Forces(np.zeros((N, J, W)), np.zeros((N, J, W)), np.zeros((N, J, W)), np.zeros((N, J, 2)), build)
    cell = Cell(
        speed, gap, brake, drive, share, onset, known.constant, known.limit, v, known.restitution, times, action,
        forces, moving,
    )  # fmt: skip
    for i in range(N):
        if build[i]:
            rates = np.full((2, W), math.inf)
            for k in range(2):
                if low_[(BRAKE_RATE + k) * N + i] < math.inf:
                    rates[k] = form_of(low_, high_, (BRAKE_RATE + k) * N + i, free)
            build_up(cell, i, first, rates)
    return cell, first


@compiled(apart=True)
def build_up(cell: Cell, i: int, late: Floats, rates: Floats) -> None:
    """Write the accelerations of vehicle ``i`` into ``cell.forces``, for every piece and for the time before the first
    piece.

    At the alert the acceleration of the vehicle is 0.
    """
    forces, own, force, wanted = cell.forces, i == cell.vehicle, np.zeros_like(late), np.zeros_like(late)
    last, there = 0.0, True  # last action, and whether the acceleration has reached its target
    for j in range(cell.times.shape[0]):
        begin, end = cell.times[j - 1], cell.times[j]
        duration = between(end - begin, end - begin, late.shape[0])
        if j == 0:
            duration, begin, end = late, 0.0, high(late)
            early, acts = early_pull(cell, i, late)
            action = 1.0 if acts and radius(early) + abs(early[0]) > 0.0 else 0.0
        elif own:
            action = cell.action[j - 1]
        else:
            action = 1.0 if low(cell.onset[i]) < end else 0.0
            if action == 1.0 and high(cell.onset[i]) > begin:
                duration = cut(difference(since(cell, i, end), since(cell, i, begin)), 0.0, end - begin)
        if action != last:
            there = False
            wanted = np.zeros_like(late)
            if not own and not math.isnan(cell.constant[i]):
                wanted[0] = cell.constant[i]
            else:
                add(wanted, action if own else -1.0, cell.drive if own and action > 0.0 else cell.brake[i])
        last = action
        rise, gain = forces.rise[i, j], forces.gain[i, j]
        if there and radius(duration) == 0.0:
            add(rise, duration[0], wanted)
            add(gain, 0.5 * duration[0] * duration[0], wanted)
        else:
            add(rise, 1.0, product(wanted, duration))
            add(gain, 0.5, product(wanted, square(duration)))
        if not there:
            there = ramp(force, wanted, duration, end - begin, rates, rise, gain, forces.swing[i, j])
            there &= low(duration) >= end - begin
        if end > begin:
            add(forces.mean[i, j], 1.0 / (end - begin), rise)


@compiled(apart=True)
def ramp(
    force: Floats, wanted: Floats, duration: Floats, longest: float, rates: Floats, rise: Floats, gain: Floats,
    swing: Floats,
) -> bool:  # fmt: skip
    """Let an acceleration approach its target ``wanted`` during ``duration``; add the resulting changes of speed and
    distance to ``rise`` and ``gain``.

    Let d be the difference (acceleration minus ``wanted``) at the start, e this difference at the end, t the duration,
    and m the time during which the acceleration changes. The changes of speed and distance are those of the constant
    acceleration ``wanted``, plus ``m (d + e) / 2`` for the speed and ``m t (d + e) / 2 - m^2 (d + 2 e) / 6`` for the
    distance. Returns True if the acceleration equals ``wanted`` at the end of ``duration`` in every world of the box.

    All arguments except ``longest``, ``rates`` and ``swing`` are affine forms [W].

    Args:
        force: acceleration at the start of ``duration``, m/s2; the function replaces it by the acceleration at the end.
        wanted: acceleration that the vehicle commands, m/s2.
        duration: time during which the command acts, s.
        longest: upper limit of ``duration``, s.
        rates: rates at which the brakes build up and release.
        rise: change of speed, m/s; changed in place.
        gain: distance minus (initial speed times duration), m; changed in place.
        swing: [2] array in which the function stores the largest deviation of the acceleration from its mean, m/s2: at
            index 0 if the acceleration falls, at index 1 if the acceleration rises.

    """
    start, there = difference(force, wanted), True
    force[:] = wanted
    for k in range(2):
        sign, rate = 1.0 - 2.0 * k, rates[k]
        more = positive_part(linear(start, sign, 0.0, 0.0))
        if math.isinf(rate[0]) or high(more) <= 0.0:
            continue
        moving, rest = duration.copy(), difference(more, product(rate, duration))
        if low(rest) < 0.0:
            rest = positive_part(rest)
            moving = cut(product(difference(more, rest), reciprocal(rate)), 0.0, high(duration))
        both = more.copy()
        add(both, 1.0, rest)
        speed = product(moving, both)
        speed *= 0.5
        speed = cut(speed, 0.0, high(more) * high(duration))
        add(both, 1.0, rest)
        way = product(speed, duration)
        add(way, -1.0 / 6.0, product(square(moving), both))
        add(rise, sign, speed)
        add(gain, sign, cut(way, 0.0, 0.5 * high(more) * high(duration) * high(duration)))
        add(force, sign, rest)
        there &= high(rest) <= 0.0
        swing[k] = min(0.5 * high(rate) * longest, high(more))
    return there


@compiled(apart=True)
def wait(cell: Cell, late: Floats) -> bool:
    """Advance the speeds and gaps of a cell in place, from the alert to the start of the first piece.

    Returns False if a contact, a stop, the speed limit or a command that takes effect may disturb the motion before the
    first piece.
    """
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
        if cell.forces.build[i]:
            add(way[i], 1.0, cell.forces.gain[i, 0])
            add(cell.speed[i], 1.0, cell.forces.rise[i, 0])
        else:
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


@compiled(apart=True)
def early_pull(cell: Cell, i: int, late: Floats) -> tuple[Floats, bool]:
    """Return the acceleration (m/s2) of vehicle ``i`` from the alert until the time ``late`` as an affine form [W], and
    whether this acceleration is certain.

    The acceleration is 0 for the shielded vehicle. The acceleration is uncertain if the vehicle's command may take
    effect before ``late``.
    """
    pull = np.zeros_like(late)
    if i == cell.vehicle:
        return pull, True
    acts = cell.onset[i].copy()  # becomes the time from the alert
    add(acts, 1.0, late)
    acts[0] -= cell.times[0]
    if high(acts) > 1e-12:
        return pull, low(acts) >= high(late)
    if math.isnan(cell.constant[i]):
        return negative(cell.brake[i]), True
    pull[0] = cell.constant[i]
    return pull, True


@compiled(apart=True)
def pieces(known: Known, onset: Floats, earliest: float, plan: Floats) -> tuple[Floats, Floats]:
    """Return the times that separate the J pieces (s after the first decision), [J + 1], and the action in each piece,
    [J].

    ``onset`` [N, W] is the time after the first decision at which each vehicle's command takes effect, s. ``earliest``
    is the shortest time from the alert to the first decision in any world of the box, s.
    """
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


@compiled(apart=True)
def bound_of(
    low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats, stack: Stack, motion: Motion, out: Floats,
    most: float,
) -> float:  # fmt: skip
    """Return an upper bound (m2/s2) on the harm of a plan in all worlds of one box.

    A result above ``most`` is no bound: the search stops as soon as the harm of some world may exceed ``most``. The
    function writes the affine form of the largest harm into ``out`` [W]; the bound is its largest value. ``stack`` and
    ``motion`` are memory that the function overwrites.
    """
    cell, late = cell_of(low_, high_, free, known, plan)
    # rough bound for all worlds; their first piece begins ``late`` after the alert
    N, P, width = cell.speed.shape[0], cell.gap.shape[0], cell.speed.shape[1]
    path = Path(np.zeros((N + P + 1, width)), np.zeros((P, TOUCH_WIDTH)), np.zeros(2 * P + 1, np.int64))
    for i in range(N):
        path.forms[i] = cell.speed[i]
        if i != cell.vehicle and cell.constant[i] > 0.0:
            path.forms[i, -1] += cell.constant[i] * high(late)
    rough = rough_harm(cell, path, -1)
    if wait(cell, late):
        harm = most_harm(cell, stack, motion, out, most)
        if harm <= rough:
            return harm
    out[:] = 0.0
    out[0] = rough
    return rough


@compiled(apart=True)
def bound_box(
    low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats, enough: float, cells: int, only_enough: bool
) -> tuple[float, int]:
    """Return an upper bound (m2/s2) on the harm of a plan in all worlds of a box, and the number of parts of the box
    that were examined.

    The search stops when the bound of the whole box is at most ``enough`` (m2/s2), or after ``cells`` parts. If
    ``only_enough`` is True, the computation for a part is broken off as soon as the part's harm may exceed ``enough``;
    a result above ``enough`` is then no bound.
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

# largest number of cells to examine: for the bound at the alert, and for each later certificate
CELLS_AT_ALERT, CELLS = 200, 40

NEAR = 1.02  # a bound below this multiple of the largest harm in a corner is not refined further

NEARLY_NOTHING = 0.1  # m2/s2; added to this multiple

CORNERS, INTERIOR = "corners", "interior"  # worlds that mode robust certifies: the corners of a box, or the whole box

CERTAINTIES = (CORNERS, INTERIOR)

SCRIPTS = ("full_brake", "coast", "constant")


class Boxes(NamedTuple):
    """Boxes around ``n`` reported worlds: each of the ``Q = 8 N - 1`` numbers of a world in the box lies between
    ``low`` and ``high``.

    Arguments that several methods share: ``others`` are the scripts of the other vehicles, by vehicle index, and
    ``plans`` [m, L] the actions of the shielded vehicle at each decision, for each of m boxes.
    """

    # [n, Q] smallest values: braking and driving capacity, latency, mass, brake rate, release rate and speed of each
    # vehicle, then the gaps
    low: Floats
    high: Floats  # [n, Q] largest values, in the same order
    limit: Floats  # [n, N] speed limits, m/s
    restitution: Floats  # [n] coefficient of restitution, 0 to 1
    begin_s: Floats  # [n] time at which the worlds begin, s
    constant: Floats  # [n, N] command of each other vehicle, m/s2; NaN: full braking
    vehicle: int  # index of the shielded vehicle
    time_step_s: float  # time between two decisions, s
    horizon_s: float  # time at which the episode ends, s

    @staticmethod
    def check_possible(robust: str, scenario: Scenario, harm_count: HarmCount, others: Mapping[int, Script]) -> None:
        """Raise ``InvalidInput`` for a setting that ``robust="interior"`` cannot certify in any world.

        Interior mode cannot certify these settings: total harm; more than three vehicles; an obstacle ahead; another
        vehicle with a script other than full braking, coasting or one constant deceleration. For ``robust="corners"``
        the function never raises an error.
        """
        if robust != INTERIOR:
            return
        for what, there in (
            ("total harm", harm_count == "total"),
            (f"{scenario.vehicles} vehicles", scenario.vehicles > MOST_VEHICLES),
            ("an obstacle ahead", scenario.has_obstacle),
        ):
            if there:
                raise _refusal(what)
        for i, script in sorted(others.items()):
            name = getattr(script, "name", type(script).__name__)
            if name.split(":")[0] not in SCRIPTS:
                raise InvalidInput(
                    f"shield: robust='interior': vehicle_{i + 1} follows the script {name!r}; the script must be"
                    " full_brake, coast or constant:A; for other scripts, use robust='corners'"
                )

    @classmethod
    def of(
        cls, possible: Worlds, problem: ProfileProblem, n: int, scenario: Scenario, others: Mapping[int, Script]
    ) -> Boxes:
        """Return the boxes around ``n`` reported worlds at the alert.

        Raises ``InvalidInput`` for worlds that interior mode cannot certify: an obstacle ahead, a vehicle whose command
        changes over time (profile), brakes that began to build up before the alert, or another vehicle whose command is
        not the same in all worlds of the box. ``check_possible`` checks the settings that do not depend on the worlds.

        ``possible`` are [n * M] worlds, M consecutive worlds for each box: the reported world, then the corners of its
        box. ``problem`` has one row for each world in ``possible``, including the commands of the other vehicles.
        """
        v, N, vehicle, members = possible.vehicles, possible.N, int(problem.vehicles[0]), possible.n // n
        if possible.obstacle_ahead.any():
            raise _refusal("an obstacle ahead")
        if v.in_pieces.any():
            raise _refusal("a vehicle that follows a braking profile")
        if v.build_up.any() and possible.command_mps2.any():
            raise _refusal("a vehicle whose brakes began to build up before the alert")
        command, constant = problem.command.reshape(n, members, N), np.full((n, N), np.nan)
        for i, script in others.items():
            name = getattr(script, "name", type(script).__name__)
            if i == vehicle or name.split(":")[0] == "full_brake":
                continue
            if not (command[:, :, i] == command[:, :1, i]).all():
                raise InvalidInput(
                    f"shield: robust='interior': vehicle_{i + 1} follows the script {name!r}, whose command differs"
                    " between the possible worlds; the script must be full_brake, coast, or constant:A with A at most"
                    " the smallest capacity of this vehicle"
                )
            constant[:, i] = command[:, 0, i]
        numbers = np.concatenate(
            [
                v.braking_capacity_mps2, v.driving_capacity_mps2, v.latency_s, v.mass_t, v.brake_rate_mps3,
                v.release_rate_mps3, possible.speeds_mps, possible.gaps_m,
            ],
            axis=1,
        ).reshape(n, members, 8 * N - 1)  # fmt: skip
        return cls(
            numbers.min(axis=1), numbers.max(axis=1), v.speed_limit_mps[::members], v.restitution[::members],
            possible.time_s[::members], constant, vehicle, scenario.time_step_s, scenario.horizon_s,
        )  # fmt: skip

    def take(self, rows: Ints) -> Boxes:
        """Return the boxes of the worlds with the indices ``rows`` [m]."""
        arrays: dict[str, Any] = {name: getattr(self, name)[rows] for name in self._fields[:6]}
        return self._replace(**arrays)

    def placed(self, old: Boxes | None, rows: Ints) -> Boxes:
        """Return the boxes of all running episodes, with the new boxes (``self``) at the indices ``rows`` [m].

        ``old`` are the boxes of all episodes as they were before the new episodes began; None if no episode had begun
        before. If all episodes are new, ``old`` is not used.
        """
        if old is None or len(rows) >= len(old.low):
            return self.take(np.argsort(rows))
        arrays: dict[str, Any] = {name: getattr(old, name).copy() for name in self._fields[:6]}
        for name, array in arrays.items():
            array[rows] = getattr(self, name)
        return self._replace(**arrays)

    def at_alert(self, plans: Floats, harm: Floats) -> Floats:
        """Return, for each world at the alert, an upper bound on the harm of its plan in all worlds of its box, [n]
        m2/s2.

        ``harm`` [n] is the largest harm (m2/s2) of each world's plan over the corners of its box. The search stops when
        its upper bound is close to this harm.
        """
        return self.bound(np.arange(len(plans)), plans, NEAR * harm + NEARLY_NOTHING, CELLS_AT_ALERT)

    def bound(
        self, rows: Ints, plans: Floats, enough: Floats, cells: int = CELLS, *, only_enough: bool = False
    ) -> Floats:
        """Return, for each plan, an upper bound on the harm since the alert in all worlds of the plan's box, [m] m2/s2.

        ``rows`` [m] are the indices of the boxes. ``enough`` [m], ``cells`` and ``only_enough`` say when the search in
        a box stops, as in ``bound_box``.
        """
        bounds = np.empty(len(rows))
        for j, k in enumerate(rows.tolist()):
            low, high = self.low[k], self.high[k]
            known = Known(
                self.vehicle, self.constant[k], self.limit[k], float(self.restitution[k]), float(self.begin_s[k]),
                self.time_step_s, self.horizon_s,
            )  # fmt: skip
            free, plan = np.flatnonzero(high > low), np.ascontiguousarray(plans[j], np.float64)
            bounds[j], _ = bound_box(low, high, free, known, plan, float(enough[j]), cells, only_enough)
        return bounds


def _refusal(what: str) -> InvalidInput:
    return InvalidInput(
        f"shield: robust='interior': {what}: cannot be certified; use robust='corners', or first-impact harm of at"
        f" most {MOST_VEHICLES} vehicles without an obstacle"
    )


def checked_robust(robust: object, where: str) -> str:
    """Return ``robust`` if it is ``corners`` or ``interior``; raise ``UnknownName`` otherwise.

    ``where`` is the start of the error message.
    """
    if robust not in CERTAINTIES:
        raise unknown_name(f"{where}: robust", robust, CERTAINTIES)
    return str(robust)
