"""Exact, event-driven advance of many worlds under commands held constant.

Between events (command onset, standstill, speed limit, contact, end of segment) accelerations are constant and the
motion is closed form; impacts and resting contact follow ``impact``. Half-open rule: an event exactly at the end
of a segment belongs to that segment.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.errors import InvalidInput, PhysicsError, renumbered
from ethbrake_marl.physics.compiled import by_parts, compiled
from ethbrake_marl.physics.kernel import (
    FLAG,
    LISTED,
    MOST_EVENTS,
    ROW,
    advance_table,
    ahead,
    command_in_force,
    obstacle_ahead,
    onset_s,
    with_obstacle,
    without_obstacle,
)
from ethbrake_marl.physics.worlds import (
    Bools,
    Floats,
    Ints,
    Vehicles,
    Worlds,
    concatenate,
    is_known_at_once,
    known_at_once,
    vehicles_at_once,
)

# Worlds that cannot be advanced: left out, named, and never at the expense of the others.

Result = TypeVar("Result")


LeftOutRows = tuple[tuple[int, str], ...]  # row of the batch that was given, why its world counts nowhere
_REASONS = {FLAG.PENETRATED: "a contact was missed", FLAG.STUCK: f"more than {MOST_EVENTS} events"}


def failure(status: Ints, from_s: Floats, until_s: Floats) -> PhysicsError:
    """The error for all worlds that the kernel marked with a ``status`` [n] other than DONE."""
    return PhysicsError(
        {
            k: f"{_REASONS[int(status[k])]} between {from_s[k]:g} s and {until_s[k]:g} s"
            for k in np.flatnonzero(status != FLAG.DONE).tolist()
        }
    )


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


_BAD_COMMAND, _BAD_END = 10, 11


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


@compiled
def advance_worlds(
    gaps: Floats, speeds: Floats, time: Floats, hit: Bools, in_force: Floats, command: Floats, until: Floats,
    braking: Floats, driving: Floats, latency: Floats, mass: Floats, limit: Floats, restitution: Floats,
    first_harm: Floats, total_harm: Floats, count: Ints, failed: Ints, rows: Floats,
) -> tuple[int, int, int]:  # fmt: skip
    """Advance every world to its ``until``, in place (the first five arrays and the harm).

    ``rows`` [capacity, LISTED.WIDTH] receives the impacts that fit. Returns their whole number, the world whose end or
    command is refused (or -1) and why. A world in which a check fails is marked with its status in ``failed`` [n] (else
    DONE) and stays where it was; the others go on.
    """
    n, vehicles = speeds.shape
    table = np.zeros((ROW.OF_SEGMENT, vehicles))
    recorded = 0
    for k in range(n):
        duration = until[k] - time[k]
        if not 0.0 <= duration < math.inf:
            return recorded, k, _BAD_END
        for i in range(vehicles):
            wanted = command[k, i]
            if not -braking[k, i] <= wanted <= driving[k, i]:
                return recorded, k, _BAD_COMMAND
            table[ROW.COMMAND, i] = wanted
            table[ROW.SPEED, i] = speeds[k, i]
            table[ROW.MASS, i] = mass[k, i]
            table[ROW.LIMIT, i] = limit[k, i]
            table[ROW.ONSET, i] = onset_s(latency[k, i], time[k])
            in_force[k, i] = command_in_force(wanted, latency[k, i], until[k])
        for p in range(vehicles - 1):
            table[ROW.GAP, p] = gaps[k, p]
            table[ROW.HIT, p] = 1.0 if hit[k, p] else 0.0
        recorded, status = advance_table(table, restitution[k], duration, time[k], k, rows, recorded)
        failed[k] = status
        if status != FLAG.DONE:
            continue
        time[k] = until[k]
        for i in range(vehicles):
            speeds[k, i] = table[ROW.SPEED, i]
        for p in range(vehicles - 1):
            gaps[k, p] = table[ROW.GAP, p]
            hit[k, p] = table[ROW.HIT, p] == 1.0
            first_harm[k, p] = table[ROW.FIRST_HARM, p]
            total_harm[k, p] = table[ROW.TOTAL_HARM, p]
            count[k, p] = int(table[ROW.COUNT, p])
    return recorded, -1, FLAG.DONE


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
    if (duration_s is None) == (until_s is None):
        raise InvalidInput("advance: give either duration_s or until_s")
    end = until_s if duration_s is None else worlds.time_s + _shaped("duration_s", duration_s, (worlds.n,))
    until = _shaped("until_s", end, (worlds.n,))
    obstacle = obstacle_ahead(worlds)
    if not obstacle.any():
        return _advance(worlds, command, until, record, threads)
    _refuse_bad(worlds, command, until)
    if obstacle.all():
        return _advance_with_obstacle(worlds, command, until, record, threads)
    return _advance_mixed(worlds, command, until, record, threads, obstacle)


def _advance(worlds: Worlds, command: Floats, until: Floats, record: bool, threads: int) -> tuple[Worlds, Impacts]:
    """``advance`` of worlds without an obstacle, or with one that is written out as a vehicle."""
    vehicles = worlds.vehicles
    capacity = 4 * worlds.n + 64 if record else 0
    while True:
        after = Worlds(
            vehicles, worlds.gaps_m.copy(), worlds.speeds_mps.copy(), worlds.time_s.copy(), worlds.pair_hit.copy(),
            np.empty(worlds.speeds_mps.shape), worlds.obstacle_gap_m.copy(), worlds.obstacle_hit.copy(),
            worlds.messages.copy(),
        )  # fmt: skip
        shape = worlds.gaps_m.shape
        first_harm, total_harm, count = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.int64)
        failed = np.empty(worlds.n, np.int64)
        arrays = (
            after.gaps_m, after.speeds_mps, after.time_s, after.pair_hit, after.command_mps2, command, until,
            vehicles.braking_capacity_mps2, vehicles.driving_capacity_mps2, vehicles.latency_s, vehicles.mass_t,
            vehicles.speed_limit_mps, vehicles.restitution, first_harm, total_harm, count,
            failed,
        )  # fmt: skip
        parts = by_parts(partial(_advance_part, arrays, capacity), worlds.n, threads)
        for part in parts:
            if part.status != FLAG.DONE:
                raise _refusal(worlds, command, until, part.world, part.status)
        if (failed != FLAG.DONE).any():
            raise failure(failed, worlds.time_s, until)
        impacts = Impacts(first_harm, total_harm, count, *no_obstacle_harm(worlds.n))
        if not record:
            return after, impacts
        most = max(part.recorded for part in parts)
        if most <= capacity:
            return after, replace(impacts, rows=_impact_rows(parts))
        capacity = most


def _advance_with_obstacle(
    worlds: Worlds, command: Floats, until: Floats, record: bool, threads: int
) -> tuple[Worlds, Impacts]:
    """``advance`` of worlds that all have an obstacle: pair 0 of the lines in which it is written out."""
    after, found = _advance(with_obstacle(worlds), ahead(0.0, command), until, record, threads)
    first, total, count = found.first_impact_harm, found.total_harm, found.count
    impacts = Impacts(
        first[:, 1:].copy(), total[:, 1:].copy(), count[:, 1:].copy(), first[:, 0].copy(), total[:, 0].copy(),
        count[:, 0].copy(), None if found.rows is None else replace(found.rows, pair=found.rows.pair - 1),
    )  # fmt: skip
    return without_obstacle(after, worlds.vehicles), impacts


def _advance_mixed(
    worlds: Worlds, command: Floats, until: Floats, record: bool, threads: int, obstacle: Bools
) -> tuple[Worlds, Impacts]:
    """``advance`` of worlds of which only those marked have an obstacle."""
    places = [np.flatnonzero(~obstacle), np.flatnonzero(obstacle)]
    parts = []
    for run, at in zip((_advance, _advance_with_obstacle), places, strict=True):
        with renumbered(at):
            parts.append(run(worlds.take(at), command[at], until[at], record, threads))
    order = np.argsort(np.concatenate(places))
    after = concatenate([part for part, _ in parts]).take(order)
    found = [impacts for _, impacts in parts]

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(impacts, name) for impacts in found])[order]

    impacts = Impacts(
        joined("first_impact_harm"), joined("total_harm"), joined("count"), joined("obstacle_first_harm"),
        joined("obstacle_total_harm"), joined("obstacle_count"),
    )  # fmt: skip
    lists = [each.rows for each in found if each.rows is not None]
    if not lists:
        return after, impacts
    world = np.concatenate([at[rows.world] for at, rows in zip(places, lists, strict=True)])
    columns = (np.concatenate([getattr(rows, f.name) for rows in lists]) for f in fields(ImpactRows)[1:])
    by_world = np.argsort(world, kind="stable")
    return after, replace(impacts, rows=ImpactRows(world[by_world], *(column[by_world] for column in columns)))


def no_obstacle_harm(n: int) -> tuple[Floats, Floats, Ints]:
    """Harm, by both counts, and impacts of ``n`` worlds without an obstacle."""
    return np.zeros(n), np.zeros(n), np.zeros(n, np.int64)


class _Part(NamedTuple):
    """How the kernel fared on a part of the worlds."""

    first: int  # world of the whole batch with which the part begins
    rows: Floats  # the impacts that fit; worlds are counted from ``first``
    recorded: int  # all impacts
    world: int  # whose end or command is refused, counted from the batch's first world
    status: int


def _advance_part(arrays: tuple[NDArray[Any], ...], capacity: int, part: slice) -> _Part:
    """Advance the worlds of ``part`` in place."""
    whole = part.stop - part.start == len(arrays[0])
    rows = np.empty((capacity, LISTED.WIDTH))
    mine = (*arrays, rows) if whole else (*(array[part] for array in arrays), rows)
    recorded, world, status = advance_worlds(*mine)
    return _Part(part.start, rows, recorded, part.start + world, status)


def _shaped(name: str, value: ArrayLike | None, shape: tuple[int, ...]) -> Floats:
    given = np.asarray(value, np.float64)
    if given.shape == shape:
        return np.ascontiguousarray(given)
    if given.ndim == 0:
        return np.full(shape, given)
    try:
        return np.ascontiguousarray(np.broadcast_to(given, shape))
    except ValueError:
        raise InvalidInput(f"{name}: shape {given.shape} does not fit {shape}") from None


def _refusal(worlds: Worlds, command: Floats, until: Floats, k: int, status: int) -> InvalidInput:
    """The error for the world where the kernel stopped."""
    if status == _BAD_END:
        return InvalidInput(f"advance: world {k} is at {worlds.time_s[k]:g} s and cannot be advanced to {until[k]:g} s")
    low, high = -worlds.vehicles.braking_capacity_mps2[k], worlds.vehicles.driving_capacity_mps2[k]
    i = int(np.argmin((command[k] >= low) & (command[k] <= high)))
    return InvalidInput(f"command_mps2[{k}, {i}] = {command[k, i]:g}: must be in [{low[i]:g}, {high[i]:g}] m/s2")


def _refuse_bad(worlds: Worlds, command: Floats, until: Floats) -> None:
    """Refuse what the kernel would refuse, by the numbers of the vehicles as everybody knows them."""
    vehicles = worlds.vehicles
    in_time = (until >= worlds.time_s) & (until < math.inf)
    in_range = (command >= -vehicles.braking_capacity_mps2) & (command <= vehicles.driving_capacity_mps2)
    good = in_time & in_range.all(axis=1)
    if not good.all():
        k = int(np.argmin(good))
        raise _refusal(worlds, command, until, k, _BAD_COMMAND if in_time[k] else _BAD_END)


def _impact_rows(parts: list[_Part]) -> ImpactRows:
    rows = np.concatenate([part.rows[: part.recorded] for part in parts])
    first = np.repeat([part.first for part in parts], [part.recorded for part in parts])
    return ImpactRows(
        first + rows[:, LISTED.WORLD].astype(np.int64),
        rows[:, LISTED.PAIR].astype(np.int64),
        rows[:, LISTED.TIME].copy(),
        rows[:, LISTED.CLOSING].copy(),
        rows[:, LISTED.FIRST] > 0.0,
        rows[:, LISTED.FRONT_CHANGE].copy(),
        rows[:, LISTED.REAR_CHANGE].copy(),
    )


# One row per world: the layout in which worlds are kept while they run.
#
# The engine steps thousands of worlds, or one world thousands of times. Two arrays (state and parameters) are then far
# cheaper to hand to a kernel, to copy and to replace row by row than a dozen. ``Worlds`` stays what everybody else
# sees.
#
# Columns, for N vehicles and P = N - 1 pairs; the ``_at`` functions give the first column of each group:
#
# state   time, speeds N, commands in force N, commands in force before N, gaps P, hit flags P; and since the
#         episode began: first-impact harm P, total harm P, impacts P; and, where worlds have an obstacle ahead: gap to
# it
#         (infinite: none), hit flag, and since the episode began: first-impact harm, total harm, impacts
# params  restitution, braking N, driving N, latency N, mass N, speed limit N; and, where news comes link by link: own
#         latency N, and from when on vehicle i acts on news of vehicle j, N * N columns (without them latencies are all
#         own, and everything is known from them on); and, where messages are periodic, the columns of
#         ``physics.messages``, which change as messages come in

TIME = 0
RESTITUTION = 0
OBSTACLE_WIDTH = 5


@compiled
def speed_at(vehicles: int) -> int:
    """First column of the speeds (m/s)."""
    return 1


@compiled
def command_at(vehicles: int) -> int:
    """First column of the commands in force (m/s2)."""
    return 1 + vehicles


@compiled
def previous_at(vehicles: int) -> int:
    """First column of the commands in force before the last segment (m/s2)."""
    return 1 + 2 * vehicles


@compiled
def gap_at(vehicles: int) -> int:
    """First column of the gaps (m); those of the hit flags and of the harm follow, P columns each."""
    return 1 + 3 * vehicles


@compiled
def harm_at(vehicles: int) -> int:
    """First column of first-impact harm; total harm and impacts follow, P columns each."""
    return 1 + 3 * vehicles + 2 * (vehicles - 1)


@compiled
def state_width(vehicles: int) -> int:
    """Columns of the state without an obstacle; with one, OBSTACLE_WIDTH more follow."""
    return 1 + 3 * vehicles + 5 * (vehicles - 1)


@compiled
def params_at(group: int, vehicles: int) -> int:
    """First column of a group of parameters: 0 braking, 1 driving, 2 latency, 3 mass, 4 speed limit.

    Where news comes link by link: 5 own latency, 6 news.
    """
    return 1 + group * vehicles


@compiled
def vehicles_in(state: Floats) -> int:
    """Number of vehicles N of these rows of state."""
    return int((state.shape[1] + 4) // 8)


class Packed(NamedTuple):
    """Worlds by rows."""

    state: Floats  # [n, S]
    params: Floats  # [n, 1 + 5 N], [n, 1 + 6 N + N * N] or, with M columns of messages, [n, 1 + 6 N + N * N + M]


def pack(worlds: Worlds) -> Packed:
    """Worlds by rows, with no harm so far; with columns of the obstacle, and of news by link, if any world has such."""
    n, N = worlds.speeds_mps.shape
    state = np.zeros((n, state_width(N)))
    state[:, TIME] = worlds.time_s
    state[:, speed_at(N) : command_at(N)] = worlds.speeds_mps
    state[:, command_at(N) : previous_at(N)] = worlds.command_mps2
    state[:, gap_at(N) : gap_at(N) + N - 1] = worlds.gaps_m
    state[:, gap_at(N) + N - 1 : harm_at(N)] = worlds.pair_hit
    v = worlds.vehicles
    plain = is_known_at_once(v) and worlds.messages.shape[1] == 0
    params = np.concatenate(
        [
            v.restitution[:, np.newaxis],
            v.braking_capacity_mps2,
            v.driving_capacity_mps2,
            v.latency_s,
            v.mass_t,
            v.speed_limit_mps,
            *(() if plain else (v.own_latency_s, v.known_from_s.reshape(n, N * N), worlds.messages)),
        ],
        axis=1,
    )
    if obstacle_ahead(worlds).any():
        none = np.zeros((n, OBSTACLE_WIDTH - 2))
        state = np.concatenate([state, np.column_stack([worlds.obstacle_gap_m, worlds.obstacle_hit]), none], axis=1)
    return Packed(state, params)


def has_obstacle(state: Floats, vehicles: int) -> bool:
    """Whether these rows have columns of an obstacle."""
    return bool(state.shape[1] > state_width(vehicles))


def with_obstacle_columns(state: Floats, vehicles: int) -> Floats:
    """The rows with columns of an obstacle; where there were none, they say that there is none."""
    if has_obstacle(state, vehicles):
        return state
    return np.concatenate([state, np.full((len(state), 1), np.inf), np.zeros((len(state), OBSTACLE_WIDTH - 1))], axis=1)


@compiled
def has_news(params: Floats, vehicles: int) -> bool:
    """Whether these rows have columns of news by link."""
    return bool(params.shape[1] > params_at(5, vehicles))


def with_news_columns(params: Floats, vehicles: int) -> Floats:
    """The rows with columns of news by link; where there were none, all news comes at the own latency."""
    if has_news(params, vehicles):
        return params
    latency = params[:, params_at(2, vehicles) : params_at(3, vehicles)]
    return np.concatenate([params, latency, latency.repeat(vehicles, axis=1)], axis=1)


@compiled
def messages_at(vehicles: int) -> int:
    """First of the parameters' columns of periodic messages."""
    return params_at(6, vehicles) + vehicles * vehicles


def has_messages(state: Floats, params: Floats) -> bool:
    """Whether these rows have columns of periodic messages. Not compiled: a call of a kernel costs more."""
    vehicles = (state.shape[1] + 4) // 8
    return bool(params.shape[1] > 1 + 6 * vehicles + vehicles * vehicles)


def own_latency_and_news(params: Floats, vehicles: int) -> tuple[Floats, Floats]:
    """``own_latency_s`` [n, N] and ``known_from_s`` [n, N, N] of these rows' ``Vehicles``, in their own memory."""
    if not has_news(params, vehicles):
        latency = params[:, params_at(2, vehicles) : params_at(3, vehicles)].copy()
        return latency, known_at_once(latency)
    own, news, end = params_at(5, vehicles), params_at(6, vehicles), messages_at(vehicles)
    return params[:, own:news].copy(), params[:, news:end].copy().reshape(-1, vehicles, vehicles)


def unpack(packed: Packed, vehicles: Vehicles | None = None) -> Worlds:
    """The worlds of these rows, in their own memory but for ``vehicles``, if they are given as they were unpacked."""
    state, params = packed
    N = vehicles_in(state)
    gaps, n = gap_at(N), len(state)
    far = not has_obstacle(state, N)
    return Worlds(
        _vehicles(params, N) if vehicles is None else vehicles,
        state[:, gaps : gaps + N - 1].copy(),
        state[:, speed_at(N) : command_at(N)].copy(),
        state[:, TIME].copy(),
        state[:, gaps + N - 1 : harm_at(N)] == 1.0,
        state[:, command_at(N) : previous_at(N)].copy(),
        np.full(n, np.inf) if far else state[:, state_width(N)].copy(),
        np.zeros(n, np.bool_) if far else state[:, state_width(N) + 1] == 1.0,
        params[:, messages_at(N) :].copy(),
    )


def _vehicles(params: Floats, vehicles: int) -> Vehicles:
    columns = (params[:, params_at(g, vehicles) : params_at(g + 1, vehicles)].copy() for g in range(5))
    braking, driving, latency, mass, limit = columns
    restitution = params[:, RESTITUTION].copy()
    if not has_news(params, vehicles):
        return vehicles_at_once(braking, driving, latency, mass, limit, restitution)
    own, news = own_latency_and_news(params, vehicles)
    return Vehicles(braking, driving, latency, mass, limit, restitution, own, news)


def ledger_columns(state: Floats, vehicles: int) -> tuple[Floats, Floats, Ints]:
    """First-impact harm, total harm and impacts of each pair since the episode began, [n, P] each."""
    pairs, first = vehicles - 1, harm_at(vehicles)
    groups = [state[:, first + g * pairs : first + (g + 1) * pairs].copy() for g in range(3)]
    return groups[0], groups[1], groups[2].astype(np.int64)


def obstacle_ledger_columns(state: Floats, vehicles: int) -> tuple[Floats, Floats, Ints]:
    """The same of the impacts with the obstacle, [n] each."""
    if not has_obstacle(state, vehicles):
        return no_obstacle_harm(len(state))
    first, total, count = (state[:, state_width(vehicles) + g].copy() for g in (2, 3, 4))
    return first, total, count.astype(np.int64)


NO_ROWS = np.empty((0, LISTED.WIDTH))  # for kernels that keep no list of impacts
