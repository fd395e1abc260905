"""Compiled motion of one world through a segment (an interval of constant commands), from event to event.

Arguments that several functions share:

- ``table``: the world in the layout of ``physics.rows``; it is advanced
- ``restitution``: coefficient of restitution of every impact
- ``duration``: length of the segment, s
- ``now``: present time, counted from the start of the segment, s
- ``building``: result of ``builds_up``: whether brakes build up or a vehicle follows a fixed sequence of commands
"""

from __future__ import annotations

import math

from ethbrake_marl.first_edition.physics.build_up import (
    accelerate_moving,
    built_up,
    move_apart_on_cubics,
    move_on_cubics,
    next_moving_event,
)
from ethbrake_marl.first_edition.physics.constant_motion import accelerate, move, next_event
from ethbrake_marl.first_edition.physics.impact import record_impacts, resolve_impacts
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND, command_acts, contact, solo_motion
from ethbrake_marl.first_edition.physics.pieces import begin_piece
from ethbrake_marl.first_edition.physics.rows import FLAG, ROW, builds_up
from ethbrake_marl.first_edition.physics.state import Floats


@compiled(bare=True)
def advance_table(
    table: Floats, restitution: float, duration: float, start_s: float, world: int, rows: Floats, recorded: int
) -> tuple[int, int]:
    """Advance one world through a segment; return the number of impacts so far and a code of ``FLAG``.

    The code is DONE if the segment was completed. The function writes the harm of the segment to the rows FIRST_HARM
    and TOTAL_HARM, and the number of impacts to row COUNT. It writes single impacts into ``rows``, like
    ``impact.record_impacts``. ``start_s`` is the absolute time (s) at the start of the segment, and ``world`` the index
    of the world. ``recorded`` is the number of earlier impacts, which the returned number includes.
    """
    if builds_up(table):
        return advance_on_cubics(table, restitution, duration, start_s, world, rows, recorded)
    return _advance(table, restitution, duration, start_s, world, rows, recorded, False)


@compiled(apart=True, bare=True)
def advance_on_cubics(
    table: Floats, restitution: float, duration: float, start_s: float, world: int, rows: Floats, recorded: int
) -> tuple[int, int]:
    """Do the work of ``advance_table`` if brakes build up or a vehicle follows a fixed sequence of commands."""
    for i in range(table.shape[1]):
        if not command_acts(table[ROW.ONSET, i], duration):
            table[ROW.ONSET, i] = max(table[ROW.ONSET, i], duration)
    return _advance(table, restitution, duration, start_s, world, rows, recorded, True)


@compiled(bare=True)
def _advance(
    table: Floats, restitution: float, duration: float, start_s: float, world: int, rows: Floats, recorded: int,
    building: bool,
) -> tuple[int, int]:  # fmt: skip
    """Do the work of ``advance_table``; callers pass a constant ``building``, so numba compiles only that case."""
    for p in range(table.shape[1] - 1):
        table[ROW.FIRST_HARM, p] = 0.0
        table[ROW.TOTAL_HARM, p] = 0.0
        table[ROW.COUNT, p] = 0.0
    if move_apart(table, duration, building):
        return recorded, FLAG.DONE
    start_events(table, building)
    now = 0.0
    for _ in range(BOUND.MOST_EVENTS):
        status, now = to_next_impact(table, restitution, now, duration, building)
        if status != FLAG.IMPACT:
            return recorded, status
        recorded = record_impacts(table, start_s + now, world, rows, recorded)
    return recorded, FLAG.STUCK


@compiled(bare=True)
def move_apart(table: Floats, duration: float, building: bool) -> bool:
    """Move a world to the end of the segment and return True, or return False if two vehicles may touch.

    If the result is False, the world has not moved. If both vehicles of a pair have constant accelerations, the time of
    their contact is computed exactly. If the acceleration of one of the vehicles changes, the function uses an upper
    bound of the decrease of the gap. Without contact, the speed of a vehicle only rises or only falls within the
    segment of length T = ``duration``. A gap therefore shrinks by at most ``(max rear speed - min front speed) T``.
    """
    if building:
        return move_apart_on_cubics(table, duration)
    vehicles = table.shape[1]
    slowest_in_front, front_steady = math.inf, 0.0
    for i in range(vehicles):
        speed = table[ROW.SPEED, i]
        if speed < 0.0:
            return False
        after, way, steady = solo_motion(
            speed, table[ROW.COMMAND, i], table[ROW.ONSET, i], table[ROW.LIMIT, i], duration
        )
        table[ROW.SPEED_VALUE, i] = after
        table[ROW.WAY, i] = way
        if i > 0:
            closing = max(speed, after) - slowest_in_front
            if closing > 0.0 and closing * duration >= table[ROW.GAP, i - 1]:
                closing, pressing = speed - table[ROW.SPEED, i - 1], steady - front_steady
                if math.isnan(pressing) or (table[ROW.GAP, i - 1] <= 0.0 and closing >= 0.0):
                    return False
                if contact(table[ROW.GAP, i - 1], closing, pressing)[0] <= duration:
                    return False
        slowest_in_front, front_steady = min(speed, after), steady
    for i in range(vehicles):
        table[ROW.SPEED, i] = table[ROW.SPEED_VALUE, i]
    for p in range(vehicles - 1):
        table[ROW.GAP, p] = max(table[ROW.GAP, p] + (table[ROW.WAY, p] - table[ROW.WAY, p + 1]), 0.0)
    return True


@compiled(bare=True)
def start_events(table: Floats, building: bool) -> None:
    """Prepare a world for ``to_next_impact`` at the start of a segment: mark the commands that are in effect."""
    for i in range(table.shape[1]):
        table[ROW.ACTIVE, i] = 1.0 if table[ROW.ONSET, i] <= 0.0 else 0.0
        table[ROW.CONTACT_SPEED, i] = 0.0
        if building and table.shape[0] > ROW.OF_BUILD_UP:
            begin_piece(table, i, 0.0)


@compiled(bare=True)
def to_next_impact(table: Floats, restitution: float, now: float, duration: float, building: bool) -> tuple[int, float]:
    """Move a world to its next impacts and resolve them, or move it to the end of the segment.

    Returns a status code of ``FLAG`` and the time reached (s, from the start of the segment). The status is IMPACT if
    impacts were resolved (then call the function again), DONE at the end of the segment, or the code of a failure.
    """
    for _ in range(BOUND.MOST_EVENTS):
        if resolve_impacts(table, restitution):
            return FLAG.IMPACT, now
        if now >= duration:
            return FLAG.DONE, now
        sound, now = to_next_event(table, now, duration, building)
        if not sound:
            return FLAG.PENETRATED, now
    return FLAG.STUCK, now


@compiled(bare=True)
def to_next_event(table: Floats, now: float, duration: float, building: bool) -> tuple[bool, float]:
    """Move a world to its next event or the end of the segment; return whether this succeeded, and the new time (s).

    The first result is False if a gap became negative, which means that a contact was missed. The time is counted from
    the start of the segment.
    """
    if building and not built_up(table):
        passed = next_moving_event(table, now, duration, accelerate_moving(table))
        sound = move_on_cubics(table, passed)
    else:
        accelerate(table)
        passed = next_event(table, now, duration)
        sound = move(table, passed)
    if not sound:
        return False, now
    begin_commands(table, now, passed, building)
    return True, duration if passed >= duration - now else now + passed


@compiled(bare=True)
def begin_commands(table: Floats, now: float, passed: float, building: bool) -> None:
    """Put into effect the commands that begin between ``now`` and ``now + passed`` (s).

    This includes the next command of a vehicle that follows a fixed sequence of commands.
    """
    for i in range(table.shape[1]):
        if table[ROW.ONSET, i] - now <= passed:
            table[ROW.ACTIVE, i] = 1.0
        if building and table.shape[0] > ROW.OF_BUILD_UP and table[ROW.NEXT_PIECE, i] - now <= passed:
            begin_piece(table, i, table[ROW.NEXT_PIECE, i])
