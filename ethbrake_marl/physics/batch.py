"""Exact, event-driven advance of many worlds under commands held constant.

Between events (command onset, standstill, speed limit, contact, end of segment) accelerations are constant and the
motion is closed form; impacts and resting contact follow ``impact``. Half-open rule: an event exactly at the end
of a segment belongs to that segment.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.errors import InvalidInput, PhysicsError, renumbered
from ethbrake_marl.physics.compiling import by_parts, compiled
from ethbrake_marl.physics.kernel import (
    BOUND,
    FLAG,
    LISTED,
    ROW,
    advance_table,
    command_acts,
    force_at,
    has_acted,
    onset_s,
    place_forces,
    place_obstacle,
    rows_for,
    solo_motion,
)
from ethbrake_marl.physics.worlds import Bools, Floats, Ints, Vehicles, Worlds, checked_numbers

# Worlds that cannot be advanced: left out, named, and never at the expense of the others.

Result = TypeVar("Result")


LeftOutRows = tuple[tuple[int, str], ...]  # row of the batch that was given, why its world counts nowhere


def measured_without_failed(measure: Callable[[Ints], Result], n: int) -> tuple[Result, Ints, LeftOutRows]:
    """What ``measure`` finds in those of ``n`` worlds in which it does not fail, their rows, and which were left out.

    As ``leaving_out_failed``, but raises ``PhysicsError`` where no world is left.
    """
    found, rows, failed = leaving_out_failed(measure, np.arange(n))
    if found is None:
        raise PhysicsError(failed)
    return found, rows, tuple(sorted(failed.items()))


def leaving_out_failed(work: Callable[[Ints], Result], rows: Ints) -> tuple[Result | None, Ints, dict[int, str]]:
    """Result of ``work`` on those of ``rows`` in which it does not fail, these rows, and what went wrong in the others.

    ``work`` takes rows of a batch and raises ``PhysicsError`` by the place in what it was given. As the result of a
    world does not depend on its batch, it is simply done again without those that failed; each time there are fewer.
    The result is None where no row is left.
    """
    failed: dict[int, str] = {}
    while len(rows):
        try:
            with renumbered(rows):
                return work(rows), rows, failed
        except PhysicsError as error:
            failed |= error.worlds
            rows = rows[~np.isin(rows, list(error.worlds))]
    return None, rows, failed


@dataclass(frozen=True, slots=True)
class ImpactRows:
    """Every impact of a segment, by world and then by time; arrays [k]."""

    world: Ints
    pair: Ints  # -1: Vehicle 1 and the obstacle ahead
    time_s: Floats  # since Vehicle 1 began to brake
    closing_speed_mps: Floats  # immediately before, > 0
    first: Bools  # the pair had no impact before
    front_speed_change_mps: Floats  # of the pair's front vehicle in this cluster of impacts, >= 0
    rear_speed_change_mps: Floats  # of its rear vehicle, usually negative


@dataclass(frozen=True, slots=True)
class Impacts:
    """What happened in a segment. Harm of a pair's impact is its squared closing speed (m2/s2)."""

    first_impact_harm: Floats  # [n, P] only impacts of pairs that had none before
    total_harm: Floats  # [n, P] every impact
    count: Ints  # [n, P]
    obstacle_first_harm: Floats  # [n] the same of Vehicle 1's impacts with the obstacle ahead
    obstacle_total_harm: Floats  # [n]
    obstacle_count: Ints  # [n]
    rows: ImpactRows | None = None  # only when recorded

    @staticmethod
    def no_obstacle(n: int) -> tuple[Floats, Floats, Ints]:
        """Harm, by both counts, and impacts of ``n`` worlds without an obstacle."""
        return np.zeros(n), np.zeros(n), np.zeros(n, np.int64)


# One row per world: the layout in which worlds are kept while they run.
#
# The engine steps thousands of worlds, or one world thousands of times. Two arrays (state and parameters) are then far
# cheaper to hand to a kernel, to copy and to replace row by row than a dozen. ``Worlds`` stays what everybody else
# sees.


class Columns(NamedTuple):
    """First column of each group of the rows of N vehicles and P = N - 1 pairs; it ends where the next one begins.

    News by link is there where some news comes so, else latencies are all own, and everything is known from them on.
    The columns of periodic messages (``physics.messages``) follow it, and change as messages come in.
    """

    vehicles: int  # N, no column
    # of the state
    time: int
    speed: int  # N (m/s)
    command: int  # N, in force (m/s2)
    previous: int  # N, in force before the last segment (m/s2)
    gap: int  # P (m)
    hit: int  # P
    harm: int  # since the episode began: first-impact harm P, total harm P, impacts P
    obstacle: int  # the width without an obstacle; else its gap (infinite: none), hit flag, both harms, impacts
    # of the parameters
    restitution: int
    braking: int  # N
    driving: int  # N
    latency: int  # N
    mass: int  # N
    limit: int  # N
    brake_rate: int  # N
    release_rate: int  # N
    own_latency: int  # the width without news by link; else N
    news: int  # N * N: from when on vehicle i acts on news of vehicle j
    messages: int  # the width without periodic messages


OBSTACLE_WIDTH = 5


def _columns_of(vehicles: int) -> Columns:
    N, P = vehicles, vehicles - 1
    gap, news = 1 + 3 * N, 1 + 8 * N
    return Columns(
        N, 0, 1, 1 + N, 1 + 2 * N, gap, gap + P, gap + 2 * P, gap + 5 * P,
        0, 1, 1 + N, 1 + 2 * N, 1 + 3 * N, 1 + 4 * N, 1 + 5 * N, 1 + 6 * N, 1 + 7 * N, news, news + N * N,
    )  # fmt: skip


_known_columns = lru_cache(maxsize=64)(_columns_of)
_compiled_columns = compiled(_columns_of)


@compiled
def columns(state: Floats) -> Columns:
    """The columns of these rows of state, [n, S], and of their parameters."""
    return _compiled_columns((state.shape[1] + 4) // 8)


class Packed(NamedTuple):
    """Worlds by rows."""

    state: Floats  # [n, S]
    params: Floats  # [n, 1 + 7 N], [n, 1 + 8 N + N * N] or, with M columns of messages, [n, 1 + 8 N + N * N + M]

    @classmethod
    def of(cls, worlds: Worlds) -> Packed:
        """Worlds with no harm so far; with columns of the obstacle, and of news by link, if any world has such."""
        v, (n, N) = worlds.vehicles, worlds.speeds_mps.shape
        none = np.zeros((n, 3 * (N - 1)))
        state = [
            worlds.time_s[:, np.newaxis], worlds.speeds_mps, worlds.command_mps2, np.zeros((n, N)), worlds.gaps_m,
            worlds.pair_hit, none,
        ]  # fmt: skip
        params = [
            v.restitution[:, np.newaxis], v.braking_capacity_mps2, v.driving_capacity_mps2, v.latency_s, v.mass_t,
            v.speed_limit_mps, v.brake_rate_mps3, v.release_rate_mps3,
        ]  # fmt: skip
        if not v.is_known_at_once or worlds.messages.shape[1] > 0:
            params += [v.own_latency_s, v.known_from_s.reshape(n, N * N), worlds.messages]
        if worlds.obstacle_ahead.any():
            state += [worlds.obstacle_gap_m[:, np.newaxis], worlds.obstacle_hit[:, np.newaxis], none[:, :3]]
        return cls(np.concatenate(state, axis=1), np.concatenate(params, axis=1))

    @property
    def column(self) -> Columns:
        """Where each group begins."""
        return _known_columns((self.state.shape[1] + 4) // 8)

    @property
    def has_obstacle(self) -> bool:
        """Whether the rows have columns of an obstacle."""
        return bool(self.state.shape[1] > self.column.obstacle)

    @property
    def has_news(self) -> bool:
        """Whether the rows have columns of news by link."""
        return bool(self.params.shape[1] > self.column.own_latency)

    @property
    def has_messages(self) -> bool:
        """Whether the rows have columns of periodic messages."""
        return bool(self.params.shape[1] > self.column.messages)

    @property
    def builds_up(self) -> bool:
        """Whether brakes of some world build up."""
        column = self.column
        return bool(np.isfinite(self.params[:, column.brake_rate : column.own_latency]).any())

    def widened(self, obstacle: bool, news: bool) -> Packed:
        """The rows with columns of an obstacle, and of news by link, where that is wanted.

        Where there were none, they say that there is no obstacle, and that all news comes at the own latency.
        """
        (state, params), column = self, self.column
        if obstacle and not self.has_obstacle:
            none = (np.full((len(state), 1), np.inf), np.zeros((len(state), OBSTACLE_WIDTH - 1)))
            state = np.concatenate([state, *none], axis=1)
        if news and not self.has_news:
            latency = params[:, column.latency : column.mass]
            params = np.concatenate([params, latency, latency.repeat(column.vehicles, axis=1)], axis=1)
        return Packed(state, params)

    def worlds(self, vehicles: Vehicles | None = None) -> Worlds:
        """The worlds, in their own memory but for ``vehicles``, if they are given as they were unpacked."""
        (state, params), column, far = self, self.column, not self.has_obstacle
        return Worlds(
            self._vehicles() if vehicles is None else vehicles,
            state[:, column.gap : column.hit].copy(),
            state[:, column.speed : column.command].copy(),
            state[:, column.time].copy(),
            state[:, column.hit : column.harm] == 1.0,
            state[:, column.command : column.previous].copy(),
            np.full(len(state), np.inf) if far else state[:, column.obstacle].copy(),
            np.zeros(len(state), np.bool_) if far else state[:, column.obstacle + 1] == 1.0,
            params[:, column.messages :].copy(),
            np.zeros((len(state), 0)),
        )

    def _vehicles(self) -> Vehicles:
        params, column = self.params, self.column
        ends = (
            column.braking, column.driving, column.latency, column.mass, column.limit, column.brake_rate,
            column.release_rate, column.own_latency,
        )  # fmt: skip
        braking, driving, latency, mass, limit, *rates = (params[:, begin:end].copy() for begin, end in pairwise(ends))
        restitution = params[:, column.restitution].copy()
        if not self.has_news:
            return Vehicles.at_once(braking, driving, latency, mass, limit, restitution, *rates)
        own = params[:, column.own_latency : column.news].copy()
        brake_rate, release_rate = rates
        known = self.known_from_s
        none = np.zeros((*latency.shape, 0))
        return Vehicles(braking, driving, latency, mass, limit, restitution, brake_rate, release_rate, none, own, known)

    @property
    def known_from_s(self) -> Floats:
        """``Vehicles.known_from_s`` [n, N, N] of these rows, in its own memory."""
        column = self.column
        if not self.has_news:
            return Vehicles.known_at_once(self.params[:, column.latency : column.mass].copy())
        return self.params[:, column.news : column.messages].copy().reshape(-1, column.vehicles, column.vehicles)

    def ledger(self) -> tuple[Floats, Floats, Ints, Floats, Floats, Ints]:
        """Since the episode began: both harms and impacts of each pair, [n, P] each; of the obstacle, [n] each."""
        state, column, pairs = self.state, self.column, self.column.vehicles - 1
        first, total, count = (state[:, at : at + pairs].copy() for at in range(column.harm, column.obstacle, pairs))
        of_obstacle = Impacts.no_obstacle(len(state))
        if self.has_obstacle:
            harm, whole, hits = (state[:, column.obstacle + g].copy() for g in (2, 3, 4))
            of_obstacle = harm, whole, hits.astype(np.int64)
        return first, total, count.astype(np.int64), *of_obstacle


# Advancing worlds.


@compiled
def finite_among(values: Floats) -> int:
    """How many of n numbers are below infinity; a loop by index that counts is compiled to one of vectors."""
    count = 0
    for k in range(values.size):
        count += 1 if values[k] < math.inf else 0
    return count


@compiled
def advance_worlds(
    gaps: Floats, speeds: Floats, time: Floats, hit: Bools, in_force: Floats, ahead: Floats, ahead_hit: Bools,
    first_harm: Floats, total_harm: Floats, count: Ints, ahead_first: Floats, ahead_total: Floats, ahead_count: Ints,
    command: Floats, until: Floats, braking: Floats, driving: Floats, latency: Floats, mass: Floats, limit: Floats,
    restitution: Floats, brake_rate: Floats, release_rate: Floats, pieces: Floats, failed: Ints, at: int, rows: Floats,
) -> tuple[int, bool]:  # fmt: skip
    """Advance every world to its ``until``, in place (the first seven arrays), and fill its harm (the next six).

    ``at`` is 1 where some world has an obstacle ``ahead``, else 0: vehicle i stands in column at + i of the table.
    ``rows`` [capacity, LISTED.WIDTH] receives the impacts that fit. Gives their whole number, and False where a world's
    end or command is refused. A world in which a check fails is marked with its status in ``failed`` [n] (else DONE)
    and stays where it was; the others go on.
    """
    n, vehicles = speeds.shape
    building = pieces.shape[2] > 0 or finite_among(brake_rate.ravel()) + finite_among(release_rate.ravel()) > 0
    table = np.zeros((rows_for(pieces.shape[2]) if building else ROW.OF_SEGMENT, at + vehicles))
    recorded = 0
    for k in range(n):
        duration = until[k] - time[k]
        if not 0.0 <= duration < math.inf:
            return recorded, False
        if at == 1:
            place_obstacle(table, min(ahead[k], BOUND.FAR_AWAY_M), 1.0 if ahead_hit[k] else 0.0)
            table[ROW.SPEED, 0] = 0.0
        for i in range(vehicles):
            if not -braking[k, i] <= command[k, i] <= driving[k, i]:
                return recorded, False
            table[ROW.COMMAND, at + i] = command[k, i]
            table[ROW.SPEED, at + i] = speeds[k, i]
            table[ROW.MASS, at + i] = mass[k, i]
            table[ROW.LIMIT, at + i] = limit[k, i]
            table[ROW.ONSET, at + i] = onset_s(latency[k, i], time[k])
            if not building:
                in_force[k, i] = command[k, i] if command_acts(latency[k, i], until[k]) else 0.0
        for p in range(vehicles - 1):
            table[ROW.GAP, at + p] = gaps[k, p]
            table[ROW.HIT, at + p] = 1.0 if hit[k, p] else 0.0
        if building:
            place_forces(table, in_force[k], brake_rate[k], release_rate[k], pieces[k])
        recorded, status = advance_table(table, restitution[k], duration, time[k], k, rows, recorded)
        failed[k] = status
        if status != FLAG.DONE:
            continue
        time[k] = until[k]
        for i in range(vehicles):
            speeds[k, i] = table[ROW.SPEED, at + i]
        if building:
            for i in range(vehicles):
                in_force[k, i] = force_at(table, at + i, command[k, i], latency[k, i], until[k])
        for p in range(vehicles - 1):
            gaps[k, p] = table[ROW.GAP, at + p]
            hit[k, p] = table[ROW.HIT, at + p] == 1.0
            first_harm[k, p] = table[ROW.FIRST_HARM, at + p]
            total_harm[k, p] = table[ROW.TOTAL_HARM, at + p]
            count[k, p] = int(table[ROW.COUNT, at + p])
        if at == 1 and ahead[k] < math.inf:
            ahead[k] = table[ROW.GAP, 0]
            ahead_hit[k] = table[ROW.HIT, 0] == 1.0
            ahead_first[k] = table[ROW.FIRST_HARM, 0]
            ahead_total[k] = table[ROW.TOTAL_HARM, 0]
            ahead_count[k] = int(table[ROW.COUNT, 0])
    return recorded, True


def advance(
    worlds: Worlds,
    command_mps2: ArrayLike,
    duration_s: ArrayLike | None = None,
    *,
    until_s: ArrayLike | None = None,
    record: bool = False,
    threads: int = 1,
) -> tuple[Worlds, Impacts]:
    """Advance ``worlds`` exactly, each under its constant command, and report the impacts on the way.

    Raises ``InvalidInput`` for an unusable command, end or ``threads``, ``PhysicsError`` naming the worlds that failed.

    Args:
        worlds: n worlds of N vehicles.
        command_mps2: signed acceleration wanted, [n, N] m/s2, within capacities; nothing before the latency elapsed.
        duration_s: length of the segment, one number or [n], s; or give ``until_s``.
        until_s: its absolute end, not before the worlds' time.
        record: also report every impact, as ``Impacts.rows``.
        threads: pay from about 10,000 worlds on; neither they nor the batch change a result.

    """
    command = _shaped("command_mps2", command_mps2, worlds.speeds_mps.shape)
    if until_s is None and duration_s is not None:
        until_s = worlds.time_s + _shaped("duration_s", duration_s, (worlds.n,))
    elif until_s is None or duration_s is not None:
        raise InvalidInput("advance: give either duration_s or until_s")
    until = _shaped("until_s", until_s, (worlds.n,))
    v, shape = worlds.vehicles, worlds.gaps_m.shape
    at, capacity = int(worlds.obstacle_ahead.any()), 4 * worlds.n + 64 if record else 0
    while True:
        after = worlds.copy()
        harm = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.int64), *Impacts.no_obstacle(worlds.n)
        failed = np.empty(worlds.n, np.int64)
        arrays = (
            after.gaps_m, after.speeds_mps, after.time_s, after.pair_hit, after.command_mps2, after.obstacle_gap_m,
            after.obstacle_hit, *harm, command, until, v.braking_capacity_mps2, v.driving_capacity_mps2, v.latency_s,
            v.mass_t, v.speed_limit_mps, v.restitution, v.brake_rate_mps3, v.release_rate_mps3, v.pieces,
            failed,
        )  # fmt: skip
        parts = by_parts(partial(_advance_part, arrays, at, capacity), worlds.n, threads)
        for part in parts:
            if not part.good:
                _refuse_bad(worlds, command, until, (until >= worlds.time_s) & (until < math.inf))
        if not record:
            break
        most = max(part.recorded for part in parts)
        if most <= capacity:
            break
        capacity = most
    if (failed != FLAG.DONE).any():
        raise FLAG.failure(failed, worlds.time_s, until)
    return after, Impacts(*harm, _impact_rows(parts, at) if record else None)


class _Part(NamedTuple):
    """How the kernel fared on a part of the worlds."""

    first: int  # world of the whole batch with which the part begins
    rows: Floats  # the impacts that fit; worlds are counted from ``first``
    recorded: int  # all impacts
    good: bool  # no end and no command was refused


def _advance_part(arrays: tuple[NDArray[Any], ...], at: int, capacity: int, part: slice) -> _Part:
    """Advance the worlds of ``part`` in place."""
    rows, kernel = np.empty((capacity, LISTED.WIDTH)), cast("Any", advance_worlds)
    whole = part.stop - part.start == len(arrays[0])
    mine = arrays if whole else [array[part] for array in arrays]
    return _Part(part.start, rows, *kernel(*mine, at, rows))


def _shaped(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
    given = checked_numbers(name, value)
    if given.shape == shape:
        return np.ascontiguousarray(given)
    try:
        return np.array(np.broadcast_to(given, shape), order="C")
    except ValueError:
        raise InvalidInput(f"{name}: shape {given.shape} does not fit {shape}") from None


def _refuse_bad(worlds: Worlds, command: Floats, until: Floats, in_time: Bools) -> None:
    """Refuse the first world whose end is not ``in_time`` [n], or with a command beyond a vehicle's capacity."""
    low, high = -worlds.vehicles.braking_capacity_mps2, worlds.vehicles.driving_capacity_mps2
    in_range = (command >= low) & (command <= high)
    if in_time.all() and in_range.all():
        return
    k = int(np.argmin(in_time & in_range.all(axis=1)))
    if not in_time[k]:
        raise InvalidInput(f"advance: world {k} is at {worlds.time_s[k]:g} s and cannot be advanced to {until[k]:g} s")
    i = int(np.argmin(in_range[k]))
    raise InvalidInput(f"command_mps2[{k}, {i}] = {command[k, i]:g}: must be in [{low[k, i]:g}, {high[k, i]:g}] m/s2")


def _impact_rows(parts: list[_Part], ahead: int) -> ImpactRows:
    """The impacts of all parts; ``ahead`` columns of their tables stand before that of Vehicle 1."""
    rows = np.concatenate([part.rows[: part.recorded] for part in parts])
    first = np.repeat([part.first for part in parts], [part.recorded for part in parts])
    return ImpactRows(
        first + rows[:, LISTED.WORLD].astype(np.int64),
        rows[:, LISTED.PAIR].astype(np.int64) - ahead,
        rows[:, LISTED.TIME].copy(),
        rows[:, LISTED.CLOSING].copy(),
        rows[:, LISTED.FIRST] > 0.0,
        rows[:, LISTED.FRONT_CHANGE].copy(),
        rows[:, LISTED.REAR_CHANGE].copy(),
    )


# The paper's fixed-step map (eq. dynamics2): impacts are looked for, and take effect, at sample times only.
#
# With the sampling period h, one step of a vehicle with command u, from sample n to sample n + 1, is
#
#     x(n + 1) = x(n) + h f(n) + h^2 / 2 u(n)
#     v(n + 1) = f(n) + h u(n)
#
# where f(n) is the vehicle's speed after the impacts of sample n. A pair whose gap is <= 0 at a sample and which is
# closing exchanges velocity by the paper's eq. (13): for Vehicle 2 that is f = f1 after f3, the rear impact first, then
# the front impact with the already changed speed; the vehicle on the other side of the pair is updated with it.
#
# How the paper's open points are read here:
#
# * f1 is handed the state that f3 has changed, so the closing speed of the front impact is the changed one. Its harm is
#   the square of that same speed; the printed J_harm takes the speeds before both, which differs only where both pairs
#   meet at one sample.
# * The printed f1 and f3 also act on overlapping vehicles that separate, which would pull them together again. The text
#   below eq. (13) asks for a positive relative velocity, and so does this map, for the exchange and for its harm.
# * Samples are at ``tau_2 + n h``, tau_2 being the latency of Vehicle 2. Before its first sample a world moves exactly
#   and no impact is looked for: the paper assumes that there is none.
# * The command of a step is the one in force at the sample that begins it (zero-order hold); a latency that ends
#   between two samples takes effect at the later one.
# * ``0 <= v <= v_max`` is a constraint on u in the paper and no part of its map. Here each command is cut to the
#   largest one that keeps the constraint at the next sample, for every vehicle. An impact can leave a negative speed;
#   clamping it would destroy momentum, so it stays, and brakes bring it to rest from below.
#
# Only N = 3 is defined by the paper. For any N, the pairs are treated once per sample, from the rear pair to the front
# pair. Gaps become negative between a contact and its sample and while vehicles overlap; nothing pushes them apart.
# Source: the paper, section "Optimization Problem".

SHORTEST_STEP_S = 1e-6
MOST_STEPS = 10**9  # of one call
_ON_SAMPLE = 1e-6  # part of a step within which two times are one sample: time is rounded, the grid is not


@compiled
def exchange(
    front_mps: float, rear_mps: float, front_t: float, rear_t: float, restitution: float
) -> tuple[float, float]:
    """Speeds of a pair after its impact, the paper's eq. (13).

    With w = v_{i+1} - v_i: ``v_i+ = v_i + m_{i+1} (1 + e) w / (m_i + m_{i+1})`` and
    ``v_{i+1}+ = v_{i+1} - m_i (1 + e) w / (m_i + m_{i+1})``. [m/s, t]
    """
    impulse = (1.0 + restitution) * (rear_mps - front_mps) / (front_t + rear_t)
    return front_mps + rear_t * impulse, rear_mps - front_t * impulse


@compiled
def exchange_at_sample(
    k: int, gaps: Floats, speeds: Floats, mass: Floats, restitution: float, hit: Bools, first_harm: Floats,
    total_harm: Floats, count: Ints,
) -> None:  # fmt: skip
    """The impacts of world ``k`` at a sample, from the rear pair to the front pair, each counted in the ledger.

    As in ``advance``, harm is the squared closing speed of the impact itself, and a closing speed of at most
    ``TOUCH_SPEED_MPS`` is a touch, which does none.
    """
    for p in range(gaps.shape[1] - 1, -1, -1):
        closing = speeds[k, p + 1] - speeds[k, p]
        if gaps[k, p] > 0.0 or closing <= 0.0:
            continue
        front, rear = exchange(speeds[k, p], speeds[k, p + 1], mass[k, p], mass[k, p + 1], restitution)
        speeds[k, p] = front
        speeds[k, p + 1] = rear
        if closing <= BOUND.TOUCH_SPEED_MPS:
            continue
        harm = closing * closing
        total_harm[k, p] += harm
        count[k, p] += 1
        if not hit[k, p]:
            hit[k, p] = True
            first_harm[k, p] += harm


@compiled
def held_motion(speed: float, command: float, limit: float, step: float) -> tuple[float, float]:
    """Speed after a step of held command, and the way: ``v + h u`` and ``h v + h^2 / 2 u``. [m/s, m]

    u is the command, cut so that the speed ends on standstill or on its limit instead of beyond it. The way is written
    as the mean of both speeds times h, which is the same for a constant u. Brakes act against the motion.
    """
    after = speed
    if command < 0.0:
        after = max(speed + command * step, 0.0) if speed >= 0.0 else min(speed - command * step, 0.0)
    elif command > 0.0 and speed < limit:
        after = min(speed + command * step, limit)
    return after, 0.5 * (speed + after) * step


@compiled
def held_speeds(speeds: Floats, command: Floats, limit: Floats, step: float) -> Floats:
    """The speeds of ``held_motion`` after a step, [n, N] m/s."""
    after = np.empty(speeds.shape)
    for k in range(speeds.shape[0]):
        for i in range(speeds.shape[1]):
            after[k, i] = held_motion(speeds[k, i], command[k, i], limit[k, i], step)[0]
    return after


@compiled
def move_to_grid(
    k: int, duration: float, time: float, gaps: Floats, speeds: Floats, command: Floats, latency: Floats, limit: Floats
) -> None:
    """Exact motion of world ``k`` before its first sample, without impacts."""
    way_in_front = 0.0
    for i in range(speeds.shape[1]):
        after, way, _ = solo_motion(speeds[k, i], command[k, i], latency[k, i] - time, limit[k, i], duration)
        speeds[k, i] = after
        if i > 0:
            gaps[k, i - 1] += way_in_front - way
        way_in_front = way


@compiled
def sample_worlds(
    gaps: Floats, speeds: Floats, time: Floats, hit: Bools, command: Floats, until: Floats, step: float, first: Ints,
    last: Ints, latency: Floats, mass: Floats, limit: Floats, restitution: Floats, first_harm: Floats,
    total_harm: Floats, count: Ints,
) -> None:  # fmt: skip
    """Take every world from its sample ``first`` to its sample ``last``, in place; -1 is the time before sample 0."""
    for k in range(speeds.shape[0]):
        start = latency[k, 1]
        begin = first[k]
        if begin < 0:
            end = until[k] if last[k] < 0 else start
            move_to_grid(k, end - time[k], time[k], gaps, speeds, command, latency, limit)
            time[k] = end
            begin = 0
        for n in range(begin, last[k]):
            exchange_at_sample(k, gaps, speeds, mass, restitution[k], hit, first_harm, total_harm, count)
            now = start + n * step + _ON_SAMPLE * step
            way_in_front = 0.0
            for i in range(speeds.shape[1]):
                wanted = command[k, i] if latency[k, i] <= now else 0.0
                speeds[k, i], way = held_motion(speeds[k, i], wanted, limit[k, i], step)
                if i > 0:
                    gaps[k, i - 1] += way_in_front - way
                way_in_front = way
        if last[k] > begin:
            time[k] = start + last[k] * step


def advance_sampled(
    worlds: Worlds, command_mps2: ArrayLike, *, until_s: ArrayLike, step_s: float = 0.1
) -> tuple[Worlds, Impacts]:
    """Advance ``worlds`` by the paper's fixed-step map, each under its constant command, and report the impacts.

    ``command_mps2`` [n, N] is the signed acceleration each vehicle wants, ignored before its latency; ``until_s`` an
    absolute time (scalar or [n]). Steps are whole: a world ends at its first sample at or after ``until_s``, or at
    ``until_s`` itself where that is before its first sample. Impacts of the last sample belong to the next call, so
    calls can be chained; the state returned is the paper's s(n), before them. ``Impacts.rows`` is None. The result of
    a world does not depend on the batch it is in. Inputs are left alone.

    Gaps of the result may be negative: it can be continued here, but not by ``advance``.

    Raises ``InvalidInput`` for a command beyond a vehicle's capacity, an end before a world's time, a step below
    1e-6 s, a world whose time is between two samples, negative speeds before the first sample, or an obstacle ahead.
    """
    if worlds.obstacle_ahead.any():
        k = int(np.argmax(worlds.obstacle_ahead))
        raise InvalidInput(
            f"advance_sampled: world {k} has an obstacle ahead (obstacle_gap_m = {worlds.obstacle_gap_m[k]:g}); the"
            " paper's fixed-step map knows none, use advance"
        )
    worlds.refuse_build_up("advance_sampled")
    command = _shaped("command_mps2", command_mps2, worlds.speeds_mps.shape)
    until = _shaped("until_s", until_s, (worlds.n,))
    _refuse_bad(worlds, command, until, np.ones(worlds.n, np.bool_))
    _refuse_unsampled(worlds, until, step_s)
    after = worlds.copy()
    impacts = sample_on(after, command, until, step_s)
    after.command_mps2[...] = np.where(has_acted(worlds.vehicles.latency_s, after.time_s[:, np.newaxis]), command, 0.0)
    return after, impacts


def sample_on(worlds: Worlds, command: Floats, until: Floats, step_s: float) -> Impacts:
    """``advance_sampled`` of what it would accept, in place; it checks nothing, and leaves ``command_mps2`` alone."""
    vehicles = worlds.vehicles
    start = vehicles.latency_s[:, 1]
    position, end = (worlds.time_s - start) / step_s, (until - start) / step_s  # times on the grid may be rounded
    first = np.where(position < -_ON_SAMPLE, -1.0, np.rint(position)).astype(np.int64)
    last = np.where(end < -_ON_SAMPLE, -1.0, np.ceil(end - _ON_SAMPLE)).astype(np.int64)
    gaps, time = worlds.gaps_m, worlds.time_s
    first_harm, total_harm, count = np.zeros(gaps.shape), np.zeros(gaps.shape), np.zeros(gaps.shape, np.int64)
    sample_worlds(
        gaps, worlds.speeds_mps, time, worlds.pair_hit, command, until, float(step_s), first, last, vehicles.latency_s,
        vehicles.mass_t, vehicles.speed_limit_mps, vehicles.restitution, first_harm, total_harm, count,
    )  # fmt: skip
    return Impacts(first_harm, total_harm, count, *Impacts.no_obstacle(worlds.n))


def _refuse_unsampled(worlds: Worlds, until: Floats, step_s: float) -> None:
    """Refuse a step, an end or a state that the map does not know."""
    if not (SHORTEST_STEP_S <= step_s < math.inf):
        raise InvalidInput(f"step_s = {step_s:g}: must be finite and at least {SHORTEST_STEP_S:g} s")
    good = (until >= worlds.time_s) & (until <= worlds.time_s + MOST_STEPS * step_s)
    if not good.all():
        k = int(np.argmin(good))
        raise InvalidInput(
            f"advance_sampled: world {k} is at {worlds.time_s[k]:g} s and cannot be advanced to {until[k]:g} s in 0 to"
            f" {MOST_STEPS:,} steps of {step_s:g} s"
        )
    start = worlds.vehicles.latency_s[:, 1]
    position = (worlds.time_s - start) / step_s
    before = position < -_ON_SAMPLE
    good = before | (np.abs(position - np.rint(position)) <= _ON_SAMPLE)
    if not good.all():
        k = int(np.argmin(good))
        raise InvalidInput(
            f"advance_sampled: world {k} is at {worlds.time_s[k]:g} s, between two of its samples"
            f" {start[k]:g} s + n * {step_s:g} s; begin at a sample or before the first"
        )
    good = ~before[:, np.newaxis] | (worlds.speeds_mps >= 0.0)
    if not good.all():
        k = int(np.argmin(good.all(axis=1)))
        raise InvalidInput(
            f"advance_sampled: world {k} has a negative speed at {worlds.time_s[k]:g} s, before its first sample at"
            f" {start[k]:g} s; the map knows no impacts before that"
        )
