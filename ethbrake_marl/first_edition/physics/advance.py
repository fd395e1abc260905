"""``advance``: move many worlds exactly through a segment, a time interval in which all commands are constant."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.physics.episode import onset_s
from ethbrake_marl.first_edition.physics.jit import by_parts, compiled
from ethbrake_marl.first_edition.physics.left_out import ImpactRows, Impacts
from ethbrake_marl.first_edition.physics.motion import BOUND, command_acts
from ethbrake_marl.first_edition.physics.pieces import force_at
from ethbrake_marl.first_edition.physics.rows import FLAG, LISTED, ROW, place_forces, place_obstacle, rows_for
from ethbrake_marl.first_edition.physics.segment import advance_table
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds, checked_numbers


@compiled
def finite_among(values: Floats) -> int:
    """Return the number of entries of ``values`` [n] that are below infinity."""
    count = 0  # this kind of loop is compiled to vector instructions
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
    """Advance every world to ``until``, in place; return the number of impacts, and whether the input is valid.

    A world in which a check of the physics fails keeps its state; the other worlds are advanced. The second result is
    True if all entries of ``until`` and ``command`` are valid. Arguments that are not listed are fields of ``Worlds``
    and ``Vehicles`` under short names, for example ``gaps`` for ``gaps_m``.

    - ``in_force``: accelerations in force at the start, [n, N] m/s2. All arrays from ``gaps`` to ``ahead_hit`` are the
      state and are updated.
    - ``ahead``: gap between Vehicle 1 and the obstacle ahead, [n] m.
    - ``first_harm``: first-impact harm, [n, P] m2/s2. All arrays from here to ``ahead_count`` are results.
    - ``command``: commands, [n, N] m/s2.
    - ``until``: time at which each world's segment ends, [n] s.
    - ``failed``: result, the status of each world, [n]: ``FLAG.DONE``, or the code of the check that failed.
    - ``at``: 1 if at least one world has an obstacle, otherwise 0; vehicle i is column ``at + i`` of the table
      (``physics.rows``).
    - ``rows``: result, one row for each impact, [capacity, LISTED.WIDTH]; if it is full, further impacts are only
      counted.
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
    """Advance ``worlds`` exactly under constant commands, and return the new worlds and their impacts.

    Raises ``InvalidInput`` for an invalid command, end time or ``threads``. Raises ``PhysicsError``, which lists the
    failed worlds, if a check of the physics fails.

    Args:
        worlds: n worlds of N vehicles; they are not changed.
        command_mps2: commanded accelerations within the vehicles' capacities, [n, N] m/s2; negative brakes. A command
            has no effect before the vehicle's latency has elapsed.
        duration_s: length of the segment, one number or [n], s. Pass either ``duration_s`` or ``until_s``.
        until_s: absolute time at which the segment ends, one number or [n], s; at least the present time of each world.
        record: whether to return each single impact in ``Impacts.rows``.
        threads: number of threads; more than one is faster from about 10,000 worlds on. The result of a world depends
            neither on the number of threads nor on the other worlds of the batch.

    """
    command = shaped("command_mps2", command_mps2, worlds.speeds_mps.shape)
    if until_s is None and duration_s is not None:
        until_s = worlds.time_s + shaped("duration_s", duration_s, (worlds.n,))
    elif until_s is None or duration_s is not None:
        raise InvalidInput("advance: pass either duration_s or until_s")
    until = shaped("until_s", until_s, (worlds.n,))
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
                refuse_bad(worlds, command, until, (until >= worlds.time_s) & (until < math.inf))
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
    """Result of the kernel ``advance_worlds`` for a contiguous slice of the worlds."""

    first: int  # row in the whole batch of the part's first world
    rows: Floats  # [capacity, LISTED.WIDTH] recorded impacts; worlds are numbered within the part
    recorded: int  # number of all impacts
    good: bool  # every end time and command was valid


def _advance_part(arrays: tuple[NDArray[Any], ...], at: int, capacity: int, part: slice) -> _Part:
    """Advance the worlds of the slice ``part`` in place; return their impacts and whether the input is valid.

    ``arrays`` are the array arguments of ``advance_worlds`` for all worlds, in the order of its signature. ``capacity``
    is the largest number of impacts to record.
    """
    rows, kernel = np.empty((capacity, LISTED.WIDTH)), cast("Any", advance_worlds)
    whole = part.stop - part.start == len(arrays[0])
    mine = arrays if whole else [array[part] for array in arrays]
    return _Part(part.start, rows, *kernel(*mine, at, rows))


def shaped(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
    numbers = checked_numbers(name, value)
    if numbers.shape == shape:
        return np.ascontiguousarray(numbers)
    try:
        return np.array(np.broadcast_to(numbers, shape), order="C")
    except ValueError:
        raise InvalidInput(f"{name}: has shape {numbers.shape}; must have shape {shape} or broadcast to it") from None


def refuse_bad(worlds: Worlds, command: Floats, until: Floats, in_time: Bools) -> None:
    """Raise ``InvalidInput`` for the first world with an invalid end time or a command beyond a vehicle's capacity.

    ``in_time`` says whether each end time is valid, [n]; ``until`` [n] is for the error message.
    """
    low, high = -worlds.vehicles.braking_capacity_mps2, worlds.vehicles.driving_capacity_mps2
    in_range = (command >= low) & (command <= high)
    if in_time.all() and in_range.all():
        return
    k = int(np.argmin(in_time & in_range.all(axis=1)))
    if not in_time[k]:
        raise InvalidInput(
            f"advance: world {k} is at t = {worlds.time_s[k]:g} s, but the requested end time is {until[k]:g} s; the"
            " end time must be finite and not before the present time"
        )
    i = int(np.argmin(in_range[k]))
    raise InvalidInput(f"command_mps2[{k}, {i}] = {command[k, i]:g}: must be in [{low[k, i]:g}, {high[k, i]:g}] m/s2")


def _impact_rows(parts: list[_Part], ahead: int) -> ImpactRows:
    """Return the recorded impacts of all slices of a batch as one object.

    ``ahead`` is 1 if pair 0 in the recorded rows is the obstacle ahead and Vehicle 1, otherwise 0.
    """
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
