"""Compiled motion of one world from event to event, with constant accelerations between two events.

The argument ``table`` is one world in the layout of ``physics.rows``.
"""

from __future__ import annotations

import math

from ethbrake_marl.first_edition.physics.impact import pool
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND, contact, drift, force_range, settle, speed_event
from ethbrake_marl.first_edition.physics.rows import ROW
from ethbrake_marl.first_edition.physics.state import Floats


@compiled(bare=True)
def accelerate(table: Floats) -> None:
    """Set the acceleration of every vehicle, and mark the pairs of touching vehicles that move as one body.

    The function writes the rows ACCELERATION and JOINED.
    """
    vehicles = table.shape[1]
    for i in range(vehicles):
        wanted = table[ROW.COMMAND, i] * table[ROW.ACTIVE, i]
        low, high = force_range(table[ROW.SPEED, i], wanted, table[ROW.LIMIT, i])
        table[ROW.FORCE_LOW, i] = low
        table[ROW.FORCE_HIGH, i] = high
    first = 0
    while first < vehicles:
        last = first
        while (
            last < vehicles - 1 and table[ROW.GAP, last] <= 0.0 and table[ROW.SPEED, last] == table[ROW.SPEED, last + 1]
        ):
            last += 1
        if last == first:
            table[ROW.ACCELERATION, first] = settle(table[ROW.FORCE_LOW, first], table[ROW.FORCE_HIGH, first])
        else:
            pool(table, ROW.FORCE_LOW, ROW.FORCE_HIGH, first, last, ROW.ACCELERATION)
            for p in range(first, last):
                table[ROW.JOINED, p] = 1.0 if table[ROW.ACCELERATION, p] == table[ROW.ACCELERATION, p + 1] else 0.0
        table[ROW.JOINED, last] = 0.0
        first = last + 1


@compiled(bare=True)
def next_event(table: Floats, now: float, end: float) -> float:
    """Return the time from ``now`` to the next event, at most ``end - now`` (s).

    There is an event when a pair comes into contact, a vehicle comes to rest or reaches its speed limit, or a command
    takes effect. The function also writes into the table when each vehicle next comes to rest or reaches its speed
    limit, and when each pair next comes into contact. ``accelerate`` must have been applied to ``table``. ``now`` and
    the segment's ``end`` are in seconds from the start of the segment.
    """
    vehicles = table.shape[1]
    soonest = end - now
    for i in range(vehicles):
        wanted = table[ROW.COMMAND, i] * table[ROW.ACTIVE, i]
        time, value = speed_event(table[ROW.SPEED, i], table[ROW.ACCELERATION, i], wanted, table[ROW.LIMIT, i])
        table[ROW.SPEED_TIME, i] = time
        table[ROW.SPEED_VALUE, i] = value
        soonest = min(soonest, time)
        if table[ROW.ACTIVE, i] == 0.0:
            soonest = min(soonest, table[ROW.ONSET, i] - now)
    for p in range(vehicles - 1):
        time, speed = math.inf, 0.0
        if table[ROW.JOINED, p] == 0.0:
            closing = table[ROW.SPEED, p + 1] - table[ROW.SPEED, p]
            pressing = table[ROW.ACCELERATION, p + 1] - table[ROW.ACCELERATION, p]
            time, speed = contact(table[ROW.GAP, p], closing, pressing)
        table[ROW.CONTACT_TIME, p] = time
        table[ROW.CONTACT_SPEED, p] = speed
        soonest = min(soonest, time)
    return soonest


@compiled(bare=True)
def move(table: Floats, duration: float) -> bool:
    """Move the world of ``table`` to its next event, ``duration`` (s) later; return False if a contact was missed.

    At the event, the function sets quantities to their exact values: the gap of a pair in contact to 0, and the speed
    of a vehicle to 0 or to the speed limit. A negative gap means that a contact was missed.
    """
    sound = True
    for p in range(table.shape[1] - 1):
        if table[ROW.CONTACT_TIME, p] <= duration:
            table[ROW.GAP, p] = 0.0
            continue
        table[ROW.CONTACT_SPEED, p] = 0.0
        if table[ROW.JOINED, p] == 0.0:
            closing = table[ROW.SPEED, p + 1] - table[ROW.SPEED, p]
            pressing = table[ROW.ACCELERATION, p + 1] - table[ROW.ACCELERATION, p]
            after = drift(table[ROW.GAP, p], closing, pressing, duration)
            sound = sound and after >= -BOUND.PENETRATION_M
            table[ROW.GAP, p] = max(after, 0.0)
    move_speeds(table, duration)
    return sound


@compiled(bare=True)
def move_speeds(table: Floats, duration: float) -> None:
    """Advance the speeds in ``table`` by ``duration`` (s), which must not go beyond the next event.

    Vehicles that move as one body get one common speed. If a pair comes into contact, the function sets the speed of
    the rear vehicle to the speed of the front vehicle plus the closing speed in row CONTACT_SPEED.
    """
    vehicles = table.shape[1]
    first = 0
    while first < vehicles:
        value = table[ROW.SPEED, first] + table[ROW.ACCELERATION, first] * duration
        last = first
        if table[ROW.SPEED_TIME, first] <= duration:
            value = table[ROW.SPEED_VALUE, first]
        while table[ROW.JOINED, last] == 1.0:
            last += 1
            if table[ROW.SPEED_TIME, last] <= duration:
                value = table[ROW.SPEED_VALUE, last]
        if first > 0 and table[ROW.CONTACT_SPEED, first - 1] > 0.0:
            value = table[ROW.SPEED, first - 1] + table[ROW.CONTACT_SPEED, first - 1]
        for i in range(first, last + 1):
            table[ROW.SPEED, i] = value
        first = last + 1
