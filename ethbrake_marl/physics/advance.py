"""Exact, event-driven advance of many worlds under commands held constant.

Between events (command onset, standstill, speed limit, contact, end of segment) accelerations are constant and the
motion is closed form; impacts and resting contact follow ``impact``. Half-open rule: an event exactly at the end
of a segment belongs to that segment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.errors import InvalidInput, renumbered
from ethbrake_marl.physics.compiled import by_parts, compiled
from ethbrake_marl.physics.episode import command_in_force, onset_s
from ethbrake_marl.physics.failed import failure
from ethbrake_marl.physics.impact import GAP, MASS, SPEED
from ethbrake_marl.physics.obstacle import ahead, obstacle_ahead, with_obstacle, without_obstacle
from ethbrake_marl.physics.segment import (
    COMMAND,
    COUNT,
    DONE,
    FIRST_HARM,
    HIT,
    LIMIT,
    ONSET,
    ROW_CLOSING,
    ROW_FIRST,
    ROW_FRONT_CHANGE,
    ROW_PAIR,
    ROW_REAR_CHANGE,
    ROW_TIME,
    ROW_WIDTH,
    ROW_WORLD,
    TABLE_ROWS,
    TOTAL_HARM,
    advance_table,
)
from ethbrake_marl.physics.worlds import Bools, Floats, Ints, Worlds, concatenate

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

    ``rows`` [capacity, ROW_WIDTH] receives the impacts that fit. Returns their whole number, the world whose end or
    command is refused (or -1) and why. A world in which a check fails is marked with its status in ``failed`` [n] (else
    DONE) and stays where it was; the others go on.
    """
    n, vehicles = speeds.shape
    table = np.zeros((TABLE_ROWS, vehicles))
    recorded = 0
    for k in range(n):
        duration = until[k] - time[k]
        if not 0.0 <= duration < math.inf:
            return recorded, k, _BAD_END
        for i in range(vehicles):
            wanted = command[k, i]
            if not -braking[k, i] <= wanted <= driving[k, i]:
                return recorded, k, _BAD_COMMAND
            table[COMMAND, i] = wanted
            table[SPEED, i] = speeds[k, i]
            table[MASS, i] = mass[k, i]
            table[LIMIT, i] = limit[k, i]
            table[ONSET, i] = onset_s(latency[k, i], time[k])
            in_force[k, i] = command_in_force(wanted, latency[k, i], until[k])
        for p in range(vehicles - 1):
            table[GAP, p] = gaps[k, p]
            table[HIT, p] = 1.0 if hit[k, p] else 0.0
        recorded, status = advance_table(table, restitution[k], duration, time[k], k, rows, recorded)
        failed[k] = status
        if status != DONE:
            continue
        time[k] = until[k]
        for i in range(vehicles):
            speeds[k, i] = table[SPEED, i]
        for p in range(vehicles - 1):
            gaps[k, p] = table[GAP, p]
            hit[k, p] = table[HIT, p] == 1.0
            first_harm[k, p] = table[FIRST_HARM, p]
            total_harm[k, p] = table[TOTAL_HARM, p]
            count[k, p] = int(table[COUNT, p])
    return recorded, -1, DONE


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
            if part.status != DONE:
                raise _refusal(worlds, command, until, part.world, part.status)
        if (failed != DONE).any():
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
    rows = np.empty((capacity, ROW_WIDTH))
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
        first + rows[:, ROW_WORLD].astype(np.int64),
        rows[:, ROW_PAIR].astype(np.int64),
        rows[:, ROW_TIME].copy(),
        rows[:, ROW_CLOSING].copy(),
        rows[:, ROW_FIRST] > 0.0,
        rows[:, ROW_FRONT_CHANGE].copy(),
        rows[:, ROW_REAR_CHANGE].copy(),
    )
