"""Simulate many constant decelerations of one vehicle in one world, for the agent ``e_v2x_bm``. Compiled.

The simulated harm has the same bits as the harm that ``physics.advance`` computes for the same constant commands. Three
methods save computing time:

- The motion until the vehicle's command takes effect is the same for all decelerations, so it is simulated only once.
- A simulation ends as soon as no pair can have another impact (``will_stay_apart``).
- A simulation ends as soon as its harm reaches a given number, because the harm can only grow.

Functions that simulate return a status code: ``FLAG.DONE`` or, if a simulation failed, the code of the failed check of
the physics.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.agents.e_v2x_bm.samples import Samples, copy_sample
from ethbrake_marl.first_edition.physics.constant_motion import accelerate
from ethbrake_marl.first_edition.physics.episode import onset_s
from ethbrake_marl.first_edition.physics.impact import record_impacts, resolve_impacts
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND
from ethbrake_marl.first_edition.physics.pieces import pieces_to_come
from ethbrake_marl.first_edition.physics.rows import (
    FLAG,
    LISTED,
    ROW,
    builds_up,
    place_forces,
    place_obstacle,
    rows_for,
)
from ethbrake_marl.first_edition.physics.segment import move_apart, start_events, to_next_event, to_next_impact
from ethbrake_marl.first_edition.physics.state import Bools, Floats

DURATION, RESTITUTION, SHARED_S = range(3)  # indices of ``Line.clock``

CLEAR_M, CLEAR_MPS = 1e-6, 1e-6  # margins for gaps and speeds, a million times the rounding error

_DIGIT = 1_000.0  # base in which ``_course`` encodes the number of impacts of each pair


class Line(NamedTuple):
    """Tables (``physics.rows``) of one world in which constant decelerations of one vehicle are simulated.

    A table has a row for each quantity and a column for each vehicle, front to rear. If the world has an obstacle ahead
    of Vehicle 1, column 0 is the obstacle.
    """

    start: Floats  # [rows, N or N + 1] table at the start, with the commands of all other vehicles
    shared: Floats  # same shape: table at the time when the controlled vehicle's command takes effect
    table: Floats  # same shape: workspace of each simulation
    clock: Floats  # [3] duration of a simulation (s), restitution, time from ``start`` to ``shared`` (s)
    controlled: int  # column of the controlled vehicle
    vehicles: int  # column of Vehicle 1: 1 with an obstacle ahead, otherwise 0
    harm: int  # row of the harm that is minimised: first-impact or total
    other: int  # row of the harm under the other count, which decides ties
    no_rows: Floats  # table of impacts without rows, so that impacts are not recorded


@compiled(apart=True)
def make_line(
    gap: Floats, speed: Floats, hit: Bools, obstacle: float, obstacle_hit: bool, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, in_force: Floats, brake_rate: Floats, release_rate: Floats, pieces: Floats,
    time: float, restitution: float, horizon: float, vehicle: int, total: bool,
) -> Line:  # fmt: skip
    """Return the tables of one world of N vehicles. Call ``share_start`` next.

    Args:
        gap: gap of each pair, [N - 1] m.
        speed: speed of each vehicle, [N] m/s.
        hit: whether each pair has had an impact, [N - 1].
        obstacle: distance from Vehicle 1 to an obstacle ahead, m; infinite without an obstacle.
        obstacle_hit: whether Vehicle 1 has had an impact with the obstacle.
        command: constant command of each vehicle, [N] m/s2; the controlled vehicle's entry is ignored.
        latency: latency of each vehicle, [N] s.
        mass: mass of each vehicle, [N] t.
        limit: speed limit of each vehicle, [N] m/s.
        in_force: acceleration of each vehicle at the start of the simulations, [N] m/s2.
        brake_rate: rate at which the deceleration of each vehicle rises when it brakes, [N] m/s3.
        release_rate: rate at which the deceleration of each vehicle falls when it releases its brakes, [N] m/s3.
        pieces: braking profile of each vehicle, K pieces, in the format of ``Vehicles.pieces``, [N, 2 K].
        time: time at the start of the simulations, s since the alert.
        restitution: restitution of every impact, 0 to 1.
        horizon: time at the end of the simulations, s since the alert.
        vehicle: index of the controlled vehicle (0 = front).
        total: True: total harm is minimised; False: first-impact harm is minimised.

    """
    at = 1 if obstacle < math.inf else 0
    vehicles = speed.shape[0]
    table = np.zeros((rows_for(pieces.shape[1]), vehicles + at))
    place_forces(table, in_force, brake_rate, release_rate, pieces)
    if at == 1:
        place_obstacle(table, obstacle, 1.0 if obstacle_hit else 0.0)
        table[ROW.ONSET, 0] = onset_s(0.0, time)
    for i in range(vehicles):
        table[ROW.COMMAND, at + i], table[ROW.SPEED, at + i] = command[i], speed[i]
        table[ROW.MASS, at + i], table[ROW.LIMIT, at + i] = mass[i], limit[i]
        table[ROW.ONSET, at + i] = onset_s(latency[i], time)
    for p in range(vehicles - 1):
        table[ROW.GAP, at + p] = gap[p]
        table[ROW.HIT, at + p] = 1.0 if hit[p] else 0.0
    clock = np.array([horizon - time, restitution, 0.0])
    rows = (ROW.TOTAL_HARM, ROW.FIRST_HARM) if total else (ROW.FIRST_HARM, ROW.TOTAL_HARM)
    return Line(
        table, table.copy(), table.copy(), clock, at + vehicle, at, rows[0], rows[1], np.empty((0, LISTED.WIDTH))
    )


@compiled(apart=True, bare=True)
def share_start(line: Line) -> int:
    """Simulate the motion in ``line.shared`` until the controlled vehicle's command takes effect.

    The duration (s) of this motion is written to ``line.clock``.
    """
    table, clock = line.shared, line.clock
    copy_table(line.start, table)
    start_events(table, builds_up(table))
    now = 0.0
    for _ in range(BOUND.MOST_EVENTS):
        if table[ROW.ACTIVE, line.controlled] == 1.0 or now >= clock[DURATION]:
            clock[SHARED_S] = now
            return FLAG.DONE
        if resolve_impacts(table, clock[RESTITUTION]):
            record_impacts(table, now, 0, line.no_rows, 0)
            continue
        sound, now = to_next_event(table, now, clock[DURATION], builds_up(table))
        if not sound:
            return FLAG.PENETRATED
    return FLAG.STUCK


@compiled(apart=True, bare=True)
def simulate(line: Line, samples: Samples, first: int, end: int, bound: float) -> int:
    """Simulate constant decelerations of the controlled vehicle, and write the results into ``samples``.

    ``share_start`` must have been called for ``line``; ``line.table`` is overwritten. The decelerations are
    ``samples.at[first:end]``. A simulation stops when its harm reaches ``bound`` (m2/s2). The sample of a stopped
    simulation has a harm of at least ``bound``, and its ``other`` and ``course`` have no meaning.
    """
    for s in range(first, end):
        if s > first and samples.at[s] == samples.at[s - 1]:
            copy_sample(samples, s - 1, samples, s)
            continue
        status = _simulate_one(line, -samples.at[s], bound)
        if status != FLAG.DONE:
            return status
        samples.harm[s] = _sum_row(line, line.harm)
        samples.other[s] = _sum_row(line, line.other)
        samples.course[s] = _course(line)
    return FLAG.DONE


@compiled(within=True)
def _simulate_one(line: Line, command: float, bound: float) -> int:
    """Simulate one ``command`` (m/s2) of the controlled vehicle, at most until the harm reaches ``bound`` (m2/s2)."""
    table, duration = line.table, line.clock[DURATION]
    table[ROW.COMMAND, line.controlled] = command
    _copy_state(line.start, table)
    building = builds_up(table)
    if move_apart(table, duration, building):
        return FLAG.DONE
    _copy_state(line.shared, table)
    now = line.clock[SHARED_S]
    for _ in range(BOUND.MOST_EVENTS):
        status, now = to_next_impact(table, line.clock[RESTITUTION], now, duration, building)
        if status != FLAG.IMPACT:
            return status
        record_impacts(table, now, 0, line.no_rows, 0)
        if _sum_row(line, line.harm) >= bound or will_stay_apart(table):
            return FLAG.DONE
    return FLAG.STUCK


@compiled(within=True)
def _copy_state(of: Floats, table: Floats) -> None:
    """Copy the state of all vehicles and pairs (not parameters such as masses) from table ``of`` to ``table``."""
    vehicles = table.shape[1]
    for i in range(vehicles):
        table[ROW.SPEED, i] = of[ROW.SPEED, i]
        table[ROW.ACTIVE, i] = of[ROW.ACTIVE, i]
        table[ROW.FORCE, i] = of[ROW.FORCE, i]
        if table.shape[0] > ROW.OF_BUILD_UP:
            table[ROW.NEXT_PIECE, i] = of[ROW.NEXT_PIECE, i]
            if table[ROW.PIECES, i] < math.inf:
                table[ROW.COMMAND, i] = of[ROW.COMMAND, i]
    for p in range(vehicles - 1):
        table[ROW.GAP, p] = of[ROW.GAP, p]
        table[ROW.CONTACT_SPEED, p] = of[ROW.CONTACT_SPEED, p]
        table[ROW.HIT, p] = of[ROW.HIT, p]
        table[ROW.FIRST_HARM, p] = of[ROW.FIRST_HARM, p]
        table[ROW.TOTAL_HARM, p] = of[ROW.TOTAL_HARM, p]
        table[ROW.COUNT, p] = of[ROW.COUNT, p]


@compiled(within=True)
def copy_table(one: Floats, other: Floats) -> None:
    """Copy every entry of the table ``one`` into the table ``other``."""
    for row in range(one.shape[0]):
        for i in range(one.shape[1]):
            other[row, i] = one[row, i]


@compiled(within=True)
def will_stay_apart(table: Floats) -> bool:
    """Return whether it is certain that no pair has another impact while the present commands last.

    The result is False if a command is not yet in full effect, or if a vehicle drives or moves backward. In all other
    cases every vehicle keeps its acceleration until it is at rest, and vehicles that press against each other have the
    same acceleration.

    Let f be the front vehicle and r the rear vehicle of a pair, with the gap g, the closing speed w, the speeds v_f and
    v_r, and the decelerations d_f and d_r. Each of the following conditions is enough to exclude an impact of the pair:

    * Vehicle r is at rest, or vehicles r and f move as one body.
    * The closing speed is at most 0 (``w <= 0``), and r brakes at least as hard as f (``d_r >= d_f``), so w stays at
      most 0 until r is at rest.
    * The following three statements are all true, with margins for rounding errors. First, the vehicles do not touch,
      or their gap grows. Second, without an impact, r would stop behind f: ``g + v_f^2 / (2 d_f) > v_r^2 / (2 d_r)``.
      Third, if r closes in and brakes harder than f, the smallest gap is positive: ``w^2 < 2 (d_r - d_f) g``. (If r
      brakes less hard than f, the gap is smallest now or at the end of the motion: until f is at rest, the gap is a
      concave function of time; after that, the gap decreases.)
    """
    vehicles, hardest = table.shape[1], 0.0
    if pieces_to_come(table):
        return False
    for i in range(vehicles):
        if table[ROW.ACTIVE, i] == 0.0 or table[ROW.COMMAND, i] > 0.0 or table[ROW.SPEED, i] < 0.0:
            return False
        if builds_up(table) and table[ROW.FORCE, i] != table[ROW.COMMAND, i]:
            return False
        hardest = max(hardest, -table[ROW.COMMAND, i])
    for p in range(vehicles - 1):  # quick test for pairs that may meet
        closing = table[ROW.SPEED, p + 1] - table[ROW.SPEED, p]
        if closing > 0.0 and closing * closing >= 2.0 * hardest * table[ROW.GAP, p]:
            return False
    accelerate(table)
    for p in range(vehicles - 1):
        front, rear = table[ROW.SPEED, p], table[ROW.SPEED, p + 1]
        gap, closing, harder = (
            table[ROW.GAP, p],
            rear - front,
            table[ROW.ACCELERATION, p] - table[ROW.ACCELERATION, p + 1],
        )
        if rear == 0.0 or table[ROW.JOINED, p] == 1.0 or (closing <= 0.0 and harder >= 0.0):
            continue
        if not (gap > CLEAR_M or closing < -CLEAR_MPS):
            return False
        gap -= CLEAR_M
        if closing > 0.0 and harder > 0.0 and front > 0.0 and not closing * closing < 2.0 * harder * gap:
            return False
        if not gap + _way_to_stop(front, table[ROW.ACCELERATION, p]) > _way_to_stop(
            rear, table[ROW.ACCELERATION, p + 1]
        ):
            return False
    return True


@compiled(within=True)
def _way_to_stop(speed: float, acceleration: float) -> float:
    """Return the distance (m) in which a vehicle stops; ``acceleration`` (m/s2) is at most 0.

    For a moving vehicle with acceleration 0 the distance is infinite.
    """
    return speed * speed / (2.0 * abs(acceleration)) if speed > 0.0 else 0.0


@compiled(within=True)
def _course(line: Line) -> float:
    """Return one number that encodes how many impacts each pair and the obstacle have had in ``line.table``."""
    course, digit, table = 0.0, 1.0, line.table
    for p in range(line.vehicles, table.shape[1] - 1):
        course += table[ROW.COUNT, p] * digit
        digit *= _DIGIT
    return course + table[ROW.COUNT, 0] * digit if line.vehicles == 1 else course


@compiled(within=True)
def _sum_row(line: Line, row: int) -> float:
    """Sum up a row of ``line.table`` over the pairs and the obstacle, in the order in which NumPy adds."""
    table, first, total = line.table, line.vehicles, 0.0
    eights = (table.shape[1] - 1 - first) // 8
    if eights > 0:
        total = _sum_eights(table, row, first, first + 8 * eights)
    for p in range(first + 8 * eights, table.shape[1] - 1):
        total += table[row, p]
    return total + table[row, 0] if line.vehicles == 1 else total


@compiled(apart=True, bare=True)
def _sum_eights(table: Floats, row: int, first: int, end: int) -> float:
    """Sum up ``table[row, first:end]`` in the order in which NumPy adds; the number of entries is a multiple of eight.

    NumPy forms eight partial sums, each over every eighth entry, and adds these eight sums pairwise.
    """
    return (
        (_sum_place(table, row, first, end) + _sum_place(table, row, first + 1, end))
        + (_sum_place(table, row, first + 2, end) + _sum_place(table, row, first + 3, end))
    ) + (
        (_sum_place(table, row, first + 4, end) + _sum_place(table, row, first + 5, end))
        + (_sum_place(table, row, first + 6, end) + _sum_place(table, row, first + 7, end))
    )


@compiled(apart=True, bare=True)
def _sum_place(table: Floats, row: int, first: int, end: int) -> float:
    """Return the sum of the entries ``first``, ``first + 8``, ``first + 16``, ... of ``table[row, :end]``."""
    total = table[row, first]
    for p in range(first + 8, end, 8):
        total += table[row, p]
    return float(total)
