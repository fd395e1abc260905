"""Many constant decelerations of one vehicle in one world, compiled: what the coupled search asks for.

The harm is that of ``physics.advance`` under constant commands, to the same bits; the motion is not kept. Three things
make it cheap. Until the vehicle's command takes effect all candidates are one, and that part is moved once. A
simulation ends as soon as nobody can meet anybody any more (``will_stay_apart``). And it is given up once its harm,
which never falls again, has reached a bound that the caller names.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.e_v2x_bm.samples import Samples, copy_sample
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.physics.compiled import compiled_apart, compiled_bare_apart, compiled_within
from ethbrake_marl.physics.episode import onset_s
from ethbrake_marl.physics.impact import CONTACT_SPEED, GAP, MASS, SPEED, resolve_impacts
from ethbrake_marl.physics.obstacle import place_obstacle
from ethbrake_marl.physics.segment import (
    ACCELERATION,
    ACTIVE,
    COMMAND,
    COUNT,
    DONE,
    FIRST_HARM,
    HIT,
    IMPACT,
    JOINED,
    LIMIT,
    MOST_EVENTS,
    ONSET,
    PENETRATED,
    ROW_WIDTH,
    STUCK,
    TABLE_ROWS,
    TOTAL_HARM,
    accelerate,
    move_apart,
    record_impacts,
    start_events,
    to_next_event,
    to_next_impact,
)

DURATION, RESTITUTION, SHARED_S = range(3)  # columns of a line's clock
CLEAR_M, CLEAR_MPS = 1e-6, 1e-6  # margins, a million times what rounding can do to a gap or a speed
_DIGIT = 1_000.0  # impacts of a pair that are told apart


class Line(NamedTuple):
    """One world as candidates run in it, in tables of ``physics.segment``; an obstacle ahead stands in column 0."""

    start: Floats  # [TABLE_ROWS, N or N + 1] with everybody's command but that of the controlled vehicle
    shared: Floats  # the same where that vehicle's command takes effect
    table: Floats  # room
    clock: Floats  # [3] length of a simulation, restitution, time from the start to ``shared``
    controlled: int  # column of the vehicle
    vehicles: int  # column of Vehicle 1
    harm: int  # the row whose sum is minimised
    other: int  # the row of the other count
    no_rows: Floats  # an empty list of impacts


@compiled_apart
def make_line(
    gap: Floats, speed: Floats, hit: Bools, obstacle: float, obstacle_hit: bool, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, time: float, restitution: float, horizon: float, vehicle: int, total: bool,
) -> Line:  # fmt: skip
    """One world at its ``time``, ready for ``share_start``; an ``obstacle`` that is finitely far is in it."""
    at = 1 if obstacle < math.inf else 0
    vehicles = speed.shape[0]
    table = np.zeros((TABLE_ROWS, vehicles + at))
    if at == 1:
        place_obstacle(table, obstacle, 1.0 if obstacle_hit else 0.0)
        table[ONSET, 0] = onset_s(0.0, time)
    for i in range(vehicles):
        table[COMMAND, at + i], table[SPEED, at + i] = command[i], speed[i]
        table[MASS, at + i], table[LIMIT, at + i] = mass[i], limit[i]
        table[ONSET, at + i] = onset_s(latency[i], time)
    for p in range(vehicles - 1):
        table[GAP, at + p] = gap[p]
        table[HIT, at + p] = 1.0 if hit[p] else 0.0
    clock = np.array([horizon - time, restitution, 0.0])
    rows = (TOTAL_HARM, FIRST_HARM) if total else (FIRST_HARM, TOTAL_HARM)
    return Line(table, table.copy(), table.copy(), clock, at + vehicle, at, rows[0], rows[1], np.empty((0, ROW_WIDTH)))


@compiled_bare_apart
def share_start(line: Line) -> int:
    """Move the line to where its controlled vehicle's command takes effect; DONE, or what went wrong."""
    table, clock = line.shared, line.clock
    copy_table(line.start, table)
    start_events(table)
    now = 0.0
    for _ in range(MOST_EVENTS):
        if table[ACTIVE, line.controlled] == 1.0 or now >= clock[DURATION]:
            clock[SHARED_S] = now
            return DONE
        if resolve_impacts(table, clock[RESTITUTION]):
            record_impacts(table, now, 0, line.no_rows, 0)
            continue
        sound, now = to_next_event(table, now, clock[DURATION])
        if not sound:
            return PENETRATED
    return STUCK


@compiled_bare_apart
def simulate(line: Line, samples: Samples, first: int, end: int, bound: float) -> int:
    """Fill what the decelerations ``samples.at[first:end]`` do; DONE, or what went wrong with one of them.

    Where the harm reaches ``bound`` it stands for any harm that is not below it, and the other columns mean nothing.
    """
    for s in range(first, end):
        if s > first and samples.at[s] == samples.at[s - 1]:
            copy_sample(samples, s - 1, samples, s)
            continue
        status = _simulate_one(line, -samples.at[s], bound)
        if status != DONE:
            return status
        samples.harm[s] = _sum_row(line, line.harm)
        samples.other[s] = _sum_row(line, line.other)
        samples.course[s] = _course(line)
    return DONE


@compiled_within
def _simulate_one(line: Line, command: float, bound: float) -> int:
    """Leave the harm of one candidate in the line's table."""
    table, duration = line.table, line.clock[DURATION]
    table[COMMAND, line.controlled] = command
    _copy_state(line.start, table)
    if move_apart(table, duration):
        return DONE
    _copy_state(line.shared, table)
    now = line.clock[SHARED_S]
    for _ in range(MOST_EVENTS):
        status, now = to_next_impact(table, line.clock[RESTITUTION], now, duration)
        if status != IMPACT:
            return status
        record_impacts(table, now, 0, line.no_rows, 0)
        if _sum_row(line, line.harm) >= bound or will_stay_apart(table):
            return DONE
    return STUCK


@compiled_within
def _copy_state(of: Floats, table: Floats) -> None:
    """Put the table into the state of another one; both have the same vehicles."""
    vehicles = table.shape[1]
    for i in range(vehicles):
        table[SPEED, i] = of[SPEED, i]
        table[ACTIVE, i] = of[ACTIVE, i]
    for p in range(vehicles - 1):
        table[GAP, p] = of[GAP, p]
        table[CONTACT_SPEED, p] = of[CONTACT_SPEED, p]
        table[HIT, p] = of[HIT, p]
        table[FIRST_HARM, p] = of[FIRST_HARM, p]
        table[TOTAL_HARM, p] = of[TOTAL_HARM, p]
        table[COUNT, p] = of[COUNT, p]


@compiled_within
def copy_table(one: Floats, other: Floats) -> None:
    """Copy a whole table."""
    for row in range(one.shape[0]):
        for i in range(one.shape[1]):
            other[row, i] = one[row, i]


@compiled_within
def will_stay_apart(table: Floats) -> bool:
    """Whether surely no pair has another impact, however long everybody's command goes on; False when not sure.

    All commands are in effect, brake or coast, and nobody moves backward. Every vehicle then keeps the acceleration it
    has (that of its body, where some rest against each other) until it stands. A pair of front ``f`` and rear ``r``
    with gap g, closing speed w and decelerations d has no impact where

    * r stands, or both are one body;
    * ``w <= 0`` and ``d_r >= d_f``: w stays so until r stands, in the kernel's rounding, too;
    * r would stop behind f, ``g + v_f^2 / 2 d_f > v_r^2 / 2 d_r``, the pair is apart (or separates), and if r brakes
      harder while it closes the least gap is positive, too: ``w^2 < 2 (d_r - d_f) g``. (If r brakes less hard, the gap
      is concave until f stands, and falls from then on.) All with margins.
    """
    vehicles, hardest = table.shape[1], 0.0
    for i in range(vehicles):
        if table[ACTIVE, i] == 0.0 or table[COMMAND, i] > 0.0 or table[SPEED, i] < 0.0:
            return False
        hardest = max(hardest, -table[COMMAND, i])
    for p in range(vehicles - 1):  # what surely meets is soon told
        closing = table[SPEED, p + 1] - table[SPEED, p]
        if closing > 0.0 and closing * closing >= 2.0 * hardest * table[GAP, p]:
            return False
    accelerate(table)
    for p in range(vehicles - 1):
        front, rear = table[SPEED, p], table[SPEED, p + 1]
        gap, closing, harder = table[GAP, p], rear - front, table[ACCELERATION, p] - table[ACCELERATION, p + 1]
        if rear == 0.0 or table[JOINED, p] == 1.0 or (closing <= 0.0 and harder >= 0.0):
            continue
        if not (gap > CLEAR_M or closing < -CLEAR_MPS):
            return False
        gap -= CLEAR_M
        if closing > 0.0 and harder > 0.0 and front > 0.0 and not closing * closing < 2.0 * harder * gap:
            return False
        if not gap + _way_to_stop(front, table[ACCELERATION, p]) > _way_to_stop(rear, table[ACCELERATION, p + 1]):
            return False
    return True


@compiled_within
def _way_to_stop(speed: float, acceleration: float) -> float:
    """How far a vehicle goes that slows down or coasts; infinitely far if it coasts (m)."""
    return speed * speed / (2.0 * abs(acceleration)) if speed > 0.0 else 0.0


@compiled_within
def _course(line: Line) -> float:
    """A number that says how many impacts each pair, and the obstacle, had."""
    course, digit, table = 0.0, 1.0, line.table
    for p in range(line.vehicles, table.shape[1] - 1):
        course += table[COUNT, p] * digit
        digit *= _DIGIT
    return course + table[COUNT, 0] * digit if line.vehicles == 1 else course


@compiled_within
def _sum_row(line: Line, row: int) -> float:
    """Sum of a row over the pairs, and the obstacle's entry, in the order in which NumPy adds up a row."""
    table, first, total = line.table, line.vehicles, 0.0
    eights = (table.shape[1] - 1 - first) // 8
    if eights > 0:
        total = _sum_eights(table, row, first, first + 8 * eights)
    for p in range(first + 8 * eights, table.shape[1] - 1):
        total += table[row, p]
    return total + table[row, 0] if line.vehicles == 1 else total


@compiled_bare_apart
def _sum_eights(table: Floats, row: int, first: int, end: int) -> float:
    """Sum of whole eights of entries: each place of them by itself, then the places two by two."""
    return (
        (_sum_place(table, row, first, end) + _sum_place(table, row, first + 1, end))
        + (_sum_place(table, row, first + 2, end) + _sum_place(table, row, first + 3, end))
    ) + (
        (_sum_place(table, row, first + 4, end) + _sum_place(table, row, first + 5, end))
        + (_sum_place(table, row, first + 6, end) + _sum_place(table, row, first + 7, end))
    )


@compiled_bare_apart
def _sum_place(table: Floats, row: int, first: int, end: int) -> float:
    """Sum of every eighth entry."""
    total = table[row, first]
    for p in range(first + 8, end, 8):
        total += table[row, p]
    return float(total)
