"""One world through one segment of constant command: apart in closed form, else event by event.

Most segments bring no two vehicles near each other; each vehicle then moves on its own (``move_apart``). When two may
meet, touch or rest against each other, the world goes from event to event (``to_next_impact``). Both work on the
table of one world whose first rows ``impact`` names.
"""

from __future__ import annotations

import math

from ethbrake_marl.physics.compiled import compiled_bare
from ethbrake_marl.physics.events import contact, drift, force_range, settle, solo_motion, speed_event
from ethbrake_marl.physics.impact import (
    BEFORE,
    CLOSING,
    CONTACT_SPEED,
    GAP,
    IMPACT_ROWS,
    SPEED,
    STRUCK,
    pool,
    resolve_impacts,
)
from ethbrake_marl.physics.worlds import Floats

PENETRATION_TOLERANCE_M = 1e-9  # a gap below minus this means that a contact was missed
MOST_EVENTS = 1_000_000  # per world and segment; reached by a defect of the kernel. (Cascades of 160,000 were seen.)

# per vehicle, after the rows of impact
COMMAND = IMPACT_ROWS
ONSET = IMPACT_ROWS + 1  # when the command takes effect, seconds from the start of the segment
LIMIT = IMPACT_ROWS + 2
ACTIVE = IMPACT_ROWS + 3  # 1 once the command is in effect
ACCELERATION = IMPACT_ROWS + 4
FORCE_LOW = IMPACT_ROWS + 5
FORCE_HIGH = IMPACT_ROWS + 6
SPEED_TIME = IMPACT_ROWS + 7  # time to the next speed event
SPEED_VALUE = IMPACT_ROWS + 8  # the speed there
WAY = IMPACT_ROWS + 9
# per pair
JOINED = IMPACT_ROWS + 10  # 1 where the pair moves as one body
CONTACT_TIME = IMPACT_ROWS + 11
HIT = IMPACT_ROWS + 12  # 1 once the pair has had an impact
FIRST_HARM = IMPACT_ROWS + 13  # harm of this segment
TOTAL_HARM = IMPACT_ROWS + 14
COUNT = IMPACT_ROWS + 15  # impacts of this segment
TABLE_ROWS = IMPACT_ROWS + 16

IMPACT, DONE, PENETRATED, STUCK = 0, 1, 2, 3
# columns of the list of impacts
ROW_WORLD, ROW_PAIR, ROW_TIME, ROW_CLOSING, ROW_FIRST, ROW_FRONT_CHANGE, ROW_REAR_CHANGE, ROW_WIDTH = range(8)


@compiled_bare
def advance_table(
    table: Floats, restitution: float, duration: float, start_s: float, world: int, rows: Floats, recorded: int
) -> tuple[int, int]:
    """Take one world through a segment. Returns how many impacts are recorded by now, and a status (DONE if well).

    Harm of the segment is in rows FIRST_HARM, TOTAL_HARM and COUNT. ``rows`` [capacity, ROW_WIDTH] receives the impacts
    that fit, those beyond are only counted.
    """
    for p in range(table.shape[1] - 1):
        table[FIRST_HARM, p] = 0.0
        table[TOTAL_HARM, p] = 0.0
        table[COUNT, p] = 0.0
    if move_apart(table, duration):
        return recorded, DONE
    start_events(table)
    now = 0.0
    for _ in range(MOST_EVENTS):
        status, now = to_next_impact(table, restitution, now, duration)
        if status != IMPACT:
            return recorded, status
        recorded = record_impacts(table, start_s + now, world, rows, recorded)
    return recorded, STUCK


@compiled_bare
def record_impacts(table: Floats, time_s: float, world: int, rows: Floats, recorded: int) -> int:
    """Add the last round of impacts to the harm, and to the list of impacts."""
    for p in range(table.shape[1] - 1):
        if table[STRUCK, p] == 0.0:
            continue
        closing = table[CLOSING, p]
        harm = closing * closing
        if recorded < rows.shape[0]:
            rows[recorded, ROW_WORLD] = world
            rows[recorded, ROW_PAIR] = p
            rows[recorded, ROW_TIME] = time_s
            rows[recorded, ROW_CLOSING] = closing
            rows[recorded, ROW_FIRST] = 1.0 - table[HIT, p]
            rows[recorded, ROW_FRONT_CHANGE] = table[SPEED, p] - table[BEFORE, p]
            rows[recorded, ROW_REAR_CHANGE] = table[SPEED, p + 1] - table[BEFORE, p + 1]
        recorded += 1
        table[TOTAL_HARM, p] += harm
        table[COUNT, p] += 1.0
        if table[HIT, p] == 0.0:
            table[HIT, p] = 1.0
            table[FIRST_HARM, p] += harm
    return recorded


@compiled_bare
def move_apart(table: Floats, duration: float) -> bool:
    """Move a world whose vehicles surely stay apart; leave it and return False when that is not sure.

    Where both of a pair have constant accelerations, the contact time says it exactly. Else: speeds are monotone
    within a segment, so a pair closes by at most ``(max rear speed - min front speed) T``.
    """
    vehicles = table.shape[1]
    slowest_in_front, front_steady = math.inf, 0.0
    for i in range(vehicles):
        speed = table[SPEED, i]
        if speed < 0.0:
            return False
        after, way, steady = solo_motion(speed, table[COMMAND, i], table[ONSET, i], table[LIMIT, i], duration)
        table[SPEED_VALUE, i] = after
        table[WAY, i] = way
        if i > 0:
            closing = max(speed, after) - slowest_in_front
            if closing > 0.0 and closing * duration >= table[GAP, i - 1]:
                closing, pressing = speed - table[SPEED, i - 1], steady - front_steady
                if math.isnan(pressing) or (table[GAP, i - 1] <= 0.0 and closing >= 0.0):
                    return False
                if contact(table[GAP, i - 1], closing, pressing)[0] <= duration:
                    return False
        slowest_in_front, front_steady = min(speed, after), steady
    for i in range(vehicles):
        table[SPEED, i] = table[SPEED_VALUE, i]
    for p in range(vehicles - 1):
        table[GAP, p] = max(table[GAP, p] + (table[WAY, p] - table[WAY, p + 1]), 0.0)
    return True


@compiled_bare
def start_events(table: Floats) -> None:
    """Make the table ready for ``to_next_impact`` from the start of a segment."""
    for i in range(table.shape[1]):
        table[ACTIVE, i] = 1.0 if table[ONSET, i] <= 0.0 else 0.0
        table[CONTACT_SPEED, i] = 0.0


@compiled_bare
def to_next_impact(table: Floats, restitution: float, now: float, duration: float) -> tuple[int, float]:
    """Move from ``now`` event by event up to and through the next round of impacts, or to the end of the segment.

    Returns IMPACT (call again), DONE, or what went wrong; and the time reached.
    """
    for _ in range(MOST_EVENTS):
        if resolve_impacts(table, restitution):
            return IMPACT, now
        if now >= duration:
            return DONE, now
        sound, now = to_next_event(table, now, duration)
        if not sound:
            return PENETRATED, now
    return STUCK, now


@compiled_bare
def to_next_event(table: Floats, now: float, duration: float) -> tuple[bool, float]:
    """Move from ``now`` to the next event or to the end of the segment; False where a gap became impossible."""
    accelerate(table)
    passed = next_event(table, now, duration)
    if not move(table, passed):
        return False, now
    for i in range(table.shape[1]):
        if table[ONSET, i] - now <= passed:
            table[ACTIVE, i] = 1.0
    return True, duration if passed >= duration - now else now + passed


@compiled_bare
def accelerate(table: Floats) -> None:
    """Accelerations in force, touching vehicles coupled; marks the pairs that move as one body."""
    vehicles = table.shape[1]
    for i in range(vehicles):
        wanted = table[COMMAND, i] * table[ACTIVE, i]
        low, high = force_range(table[SPEED, i], wanted, table[LIMIT, i])
        table[FORCE_LOW, i] = low
        table[FORCE_HIGH, i] = high
    first = 0
    while first < vehicles:
        last = first
        while last < vehicles - 1 and table[GAP, last] <= 0.0 and table[SPEED, last] == table[SPEED, last + 1]:
            last += 1
        if last == first:
            table[ACCELERATION, first] = settle(table[FORCE_LOW, first], table[FORCE_HIGH, first])
        else:
            pool(table, FORCE_LOW, FORCE_HIGH, first, last, ACCELERATION)
            for p in range(first, last):
                table[JOINED, p] = 1.0 if table[ACCELERATION, p] == table[ACCELERATION, p + 1] else 0.0
        table[JOINED, last] = 0.0
        first = last + 1


@compiled_bare
def next_event(table: Floats, now: float, end: float) -> float:
    """Time from ``now`` to the next event, at most ``end - now``; fills the candidates of each vehicle and pair."""
    vehicles = table.shape[1]
    soonest = end - now
    for i in range(vehicles):
        wanted = table[COMMAND, i] * table[ACTIVE, i]
        time, value = speed_event(table[SPEED, i], table[ACCELERATION, i], wanted, table[LIMIT, i])
        table[SPEED_TIME, i] = time
        table[SPEED_VALUE, i] = value
        soonest = min(soonest, time)
        if table[ACTIVE, i] == 0.0:
            soonest = min(soonest, table[ONSET, i] - now)
    for p in range(vehicles - 1):
        time, speed = math.inf, 0.0
        if table[JOINED, p] == 0.0:
            closing = table[SPEED, p + 1] - table[SPEED, p]
            pressing = table[ACCELERATION, p + 1] - table[ACCELERATION, p]
            time, speed = contact(table[GAP, p], closing, pressing)
        table[CONTACT_TIME, p] = time
        table[CONTACT_SPEED, p] = speed
        soonest = min(soonest, time)
    return soonest


@compiled_bare
def move(table: Floats, duration: float) -> bool:
    """Move to the next event, putting event values exactly; False when a gap became impossible."""
    sound = True
    for p in range(table.shape[1] - 1):
        if table[CONTACT_TIME, p] <= duration:
            table[GAP, p] = 0.0
            continue
        table[CONTACT_SPEED, p] = 0.0
        if table[JOINED, p] == 0.0:
            closing = table[SPEED, p + 1] - table[SPEED, p]
            pressing = table[ACCELERATION, p + 1] - table[ACCELERATION, p]
            after = drift(table[GAP, p], closing, pressing, duration)
            sound = sound and after >= -PENETRATION_TOLERANCE_M
            table[GAP, p] = max(after, 0.0)
    move_speeds(table, duration)
    return sound


@compiled_bare
def move_speeds(table: Floats, duration: float) -> None:
    """Speeds after ``duration``: one value for each joined body, and a pair in contact differs by its closing speed."""
    vehicles = table.shape[1]
    first = 0
    while first < vehicles:
        value = table[SPEED, first] + table[ACCELERATION, first] * duration
        last = first
        if table[SPEED_TIME, first] <= duration:
            value = table[SPEED_VALUE, first]
        while table[JOINED, last] == 1.0:
            last += 1
            if table[SPEED_TIME, last] <= duration:
                value = table[SPEED_VALUE, last]
        if first > 0 and table[CONTACT_SPEED, first - 1] > 0.0:
            value = table[SPEED, first - 1] + table[CONTACT_SPEED, first - 1]
        for i in range(first, last + 1):
            table[SPEED, i] = value
        first = last + 1
