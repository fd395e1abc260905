"""One world through one segment of constant command: apart in closed form, else event by event.

Most segments bring no two vehicles near each other; each vehicle then moves on its own (``move_apart``). When two may
meet, touch or rest against each other, the world goes from event to event (``to_next_impact``). Both work on the
table of one world whose first rows ``impact`` names.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.physics.compiling import compiled
from ethbrake_marl.physics.worlds import Bools, Floats, Ints, Worlds

# Closed-form times of the events that end a segment of constant acceleration.
#
# Between events every quantity is a quadratic in time, so the first event is found exactly and none is missed.
# Only + - * / and sqrt are used: the same world gives the same bits in any batch.


class _Bounds(NamedTuple):
    """Where one rule of the physics ends and another begins."""

    TOUCH_SPEED_MPS: float = 1e-5  # a contact at or below this closing speed is a touch: no impact, no harm
    PLASTIC_SPEED_MPS: float = 0.05  # a cluster whose largest closing speed is below this does not bounce
    PENETRATION_M: float = 1e-9  # a gap below minus this means that a contact was missed
    MOST_EVENTS: int = 1_000_000  # per world and segment; reached by a defect of the kernel (160,000 were seen)
    FAR_AWAY_M: float = 1e300  # of no obstacle where others of a batch have one: nothing comes near, no bit changes


BOUND = _Bounds()

ONSET_ROUNDING_S = 1e-9  # a latency that elapses this close before the end of an interval elapses at its end


def has_acted(latency_s: Any, time_s: Any) -> Any:
    """Whether a command acts in the interval from 0 to ``time_s``; numbers (in kernels) or arrays, s.

    A latency that elapses at the beginning of the interval counts, one that elapses at its end does not: there the next
    decision replaces the command before it has acted.
    """
    return (latency_s <= 0.0) | (latency_s < time_s - ONSET_ROUNDING_S)


command_acts = compiled(has_acted)


@compiled
def contact(gap: float, closing: float, pressing: float) -> tuple[float, float]:
    """Time to the first contact of a pair and the closing speed there, or ``(inf, 0)`` when there is none.

    With gap ``g >= 0``, closing speed ``w`` and closing acceleration ``b``: ``D = w^2 + 2 b g``;
    ``w > 0``: none if ``D < 0``, else ``t = 2 g / (w + sqrt D)``; ``w <= 0``: only if ``b > 0``,
    ``t = (-w + sqrt D) / b``. The closing speed at contact is ``sqrt D``; ``w + b t`` would cancel. [m, m/s, m/s2]
    """
    if closing > 0.0:
        squared = closing * closing + 2.0 * pressing * gap
        if squared < 0.0:
            return math.inf, 0.0
        speed = math.sqrt(squared)
        return 2.0 * gap / (closing + speed), speed
    if pressing > 0.0:
        speed = math.sqrt(closing * closing + 2.0 * pressing * gap)
        return (speed - closing) / pressing, speed
    return math.inf, 0.0


@compiled
def drift(gap: float, closing: float, pressing: float, duration: float) -> float:
    """Gap after ``duration`` of constant closing acceleration: ``g - (w + b t / 2) t``. [m]"""
    return gap - (closing + 0.5 * pressing * duration) * duration


@compiled
def speed_event(speed: float, acceleration: float, command: float, limit: float) -> tuple[float, float]:
    """Time until the speed next reaches a value where the forces change, and that value; ``(inf, 0)`` if never.

    These values are standstill (brakes then hold) and, for a driving vehicle, its speed limit.
    """
    if acceleration == 0.0:
        return math.inf, 0.0
    time = math.inf
    value = 0.0
    if (speed > 0.0) == (acceleration < 0.0) and speed != 0.0:
        time = -speed / acceleration
    if command > 0.0 and speed != limit and (speed < limit) == (acceleration > 0.0):
        reach = (limit - speed) / acceleration
        if reach < time:
            time = reach
            value = limit
    return time, value


@compiled
def force_range(speed: float, command: float, limit: float) -> tuple[float, float]:
    """Acceleration this vehicle's own forces give when it moves forward, and when it moves backward.

    The two differ where the force is set-valued: brakes at standstill hold against a push from either side,
    and a driving vehicle at its speed limit gives only as much drive as keeps it there.
    """
    if command < 0.0:
        if speed > 0.0:
            return command, command
        if speed < 0.0:
            return -command, -command
        return command, -command
    if command > 0.0:
        if speed < limit:
            return command, command
        if speed == limit:
            return 0.0, command
    return 0.0, 0.0


@compiled
def settle(low: float, high: float) -> float:
    """Acceleration of a free body whose forces range over ``[low, high]``: the value nearest to rest."""
    if low > 0.0:
        return low
    if high < 0.0:
        return high
    return 0.0


@compiled
def solo_motion(
    speed: float, command: float, onset: float, limit: float, duration: float
) -> tuple[float, float, float]:
    """A vehicle on its own for ``duration``: coast until ``onset``, then brake to standstill or drive to the limit.

    Returns the speed after it, the way, and the acceleration where that was constant all along (else NaN);
    ``speed >= 0``. [m/s, m, m/s2]
    """
    way = 0.0
    steady = command
    if onset > 0.0:
        if onset >= duration or command == 0.0:
            return speed, speed * duration, 0.0
        way = speed * onset
        duration -= onset
        steady = math.nan
    after = speed + command * duration
    if command < 0.0:
        if after <= 0.0:
            return 0.0, way - speed * speed / (2.0 * command), 0.0 if speed == 0.0 else math.nan
    elif command > 0.0:
        if speed >= limit:
            return speed, way + speed * duration, 0.0
        if after >= limit:
            driving = (limit - speed) / command
            return limit, way + 0.5 * (speed + limit) * driving + limit * (duration - driving), math.nan
    return after, way + (speed + 0.5 * command * duration) * duration, steady


@compiled
def stopping_distance(speed: float, latency_left: float, capacity: float) -> float:
    """Distance to rest under full braking once the latency has elapsed: ``v tau + v^2 / (2 a)``, 0 if not moving on."""
    speed = max(speed, 0.0)
    return speed * latency_left + speed * speed / (2.0 * capacity)


@compiled
def ramped_stopping_distance(speed: float, latency_left: float, capacity: float, rate: float) -> float:
    """``stopping_distance`` of brakes that build up from 0 at ``rate`` r (m/s3): with the capacity a it is

    ``v tau + v a / (2 r) - a^3 / (24 r^2) + v^2 / (2 a)``, and ``v tau + 2/3 v sqrt(2 v / r)`` where the vehicle stands
    before its brakes are full, ``v < a^2 / (2 r)``.
    """
    speed = max(speed, 0.0)
    if math.isinf(rate):
        return stopping_distance(speed, latency_left, capacity)
    rise = capacity / rate
    if speed < 0.5 * capacity * rise:
        return speed * latency_left + 2.0 / 3.0 * speed * math.sqrt(2.0 * speed / rate)
    return speed * latency_left + 0.5 * speed * rise - capacity * rise * rise / 24.0 + speed * speed / (2.0 * capacity)


@compiled
def stopping_distances(speed: Floats, latency_left: Floats, capacity: Floats, rate: Floats) -> Floats:
    """``ramped_stopping_distance`` of n vehicles, each [n]."""
    distance = np.empty(len(speed))
    for k in range(len(speed)):
        distance[k] = ramped_stopping_distance(speed[k], latency_left[k], capacity[k], rate[k])
    return distance


# Impacts and resting contact of touching vehicles: one order-free law for both.
#
# Pairs resolved one after another give results that depend on their order. Here a whole cluster of touching
# vehicles is resolved at once by a mass-weighted isotonic regression ``P`` (pool adjacent violators):
#
# * impact: ``v+ = (1 + e) P(v-) - e v-``; for two vehicles this is the paper's eq. (13);
# * resting contact: accelerations are ``P`` of the vehicles' own ones, a block's common acceleration being
#   ``sum(m u) / sum(m)``; forces that hold (brakes at rest) enter as a range, so a block at rest moves only when
#   pushed harder than its braked members hold.
#
# Vehicles are ordered front to rear; feasible means that no vehicle is faster than the one before it.
#
# The kernels work on one table of floats for one world, ``table[row, vehicle or pair]``; the rows are named here. (One
# array is cheap to hand from function to function; twenty small ones cost more than the physics.)


class _Rows(NamedTuple):
    """Rows of the table of one world: of its vehicles, its pairs, its pooled blocks."""

    # per vehicle
    SPEED: int = 0
    MASS: int = 1
    BEFORE: int = 2  # speed before an impact
    POOLED: int = 3
    # per pair
    GAP: int = 4
    CLOSING: int = 5  # closing speed before an impact, 0 where the pair does not touch
    CONTACT_SPEED: int = 6  # exact closing speed of a pair that has just met, else 0
    STRUCK: int = 7  # 1 where the last round was an impact (not a touch)
    # per pooled block
    BLOCK_MASS: int = 8
    BLOCK_LOW: int = 9
    BLOCK_HIGH: int = 10
    BLOCK_FIRST: int = 11
    # per vehicle: of motion
    COMMAND: int = 12
    ONSET: int = 13  # when the command takes effect, seconds from the start of the segment
    LIMIT: int = 14
    ACTIVE: int = 15  # 1 once the command is in effect
    ACCELERATION: int = 16
    FORCE_LOW: int = 17
    FORCE_HIGH: int = 18
    SPEED_TIME: int = 19  # time to the next speed event
    SPEED_VALUE: int = 20  # the speed there
    WAY: int = 21
    # per pair: of motion
    JOINED: int = 22  # 1 where the pair moves as one body
    CONTACT_TIME: int = 23
    HIT: int = 24  # 1 once the pair has had an impact
    FIRST_HARM: int = 25  # harm of this segment
    TOTAL_HARM: int = 26
    COUNT: int = 27  # impacts of this segment
    # of an episode: per vehicle
    LATENCY: int = 28  # when its command takes effect (s since Vehicle 1 began to brake)
    # of an episode: per pair
    SUM_FIRST_HARM: int = 29  # harm since the episode began (m2/s2)
    SUM_TOTAL_HARM: int = 30
    # of brakes that build up: per vehicle
    FORCE: int = 31  # acceleration that its brakes or its engine call for now; it moves towards the command (m/s2)
    BRAKE_RATE: int = 32  # how fast it falls, and rises (m/s3); infinite: at once
    RELEASE_RATE: int = 33
    BUILDS_UP: int = 34  # of the world, in column 0: 1 where some rate is finite
    FORCE_RATE: int = 35  # at which FORCE moves in this piece (m/s3)
    FORCE_TIME: int = 36  # until it reaches the command, or passes 0
    FORCE_VALUE: int = 37  # there
    JERK: int = 38
    LOW_JERK: int = 39  # at which FORCE_LOW and FORCE_HIGH move
    HIGH_JERK: int = 40
    # per pooled block
    BLOCK_LOW_JERK: int = 41
    BLOCK_HIGH_JERK: int = 42
    # how many of them
    OF_IMPACT: int = 12  # rows of the table that an impact needs, a segment, an episode
    OF_SEGMENT: int = 28
    OF_EPISODE: int = 31
    OF_BUILD_UP: int = 43  # of a segment or an episode in which brakes may build up
    # of brakes in pieces: per vehicle, in tables longer than OF_BUILD_UP
    NEXT_PIECE: int = 43  # when the next piece of its command begins, seconds from the start of the segment
    PIECES: int = 44  # when each of K pieces begins, seconds after the onset (infinite: none), then their K commands


ROW = _Rows()


@compiled(bare=True)
def pool(table: Floats, low: int, high: int, first: int, last: int, out: int) -> int:
    """Mass-weighted isotonic regression of vehicles ``first..last`` (inclusive) into row ``out``; the number of blocks.

    Rows ``low`` and ``high`` bound each vehicle's own value (equal for an ordinary one). All members of a pooled
    block get the same bits. Rows BLOCK_* describe the blocks. A vehicle of infinite mass (``obstacle``) stands, and
    so does its block.
    """
    count = 0
    for i in range(first, last + 1):
        mass = table[ROW.MASS, i]
        table[ROW.BLOCK_MASS, count] = mass
        table[ROW.BLOCK_LOW, count] = mass * table[low, i] if mass < math.inf else 0.0
        table[ROW.BLOCK_HIGH, count] = mass * table[high, i] if mass < math.inf else 0.0
        table[ROW.BLOCK_FIRST, count] = i
        top = count + first
        table[out, top] = settle(table[low, i], table[high, i])
        while count > 0 and table[out, top] > table[out, top - 1]:
            count -= 1
            top -= 1
            table[ROW.BLOCK_MASS, count] += table[ROW.BLOCK_MASS, count + 1]
            table[ROW.BLOCK_LOW, count] += table[ROW.BLOCK_LOW, count + 1]
            table[ROW.BLOCK_HIGH, count] += table[ROW.BLOCK_HIGH, count + 1]
            mass = table[ROW.BLOCK_MASS, count]
            table[out, top] = settle(table[ROW.BLOCK_LOW, count] / mass, table[ROW.BLOCK_HIGH, count] / mass)
        count += 1
    member = last
    for k in range(count - 1, -1, -1):
        value = table[out, k + first]
        while member >= table[ROW.BLOCK_FIRST, k]:
            table[out, member] = value
            member -= 1
    return count


@compiled(bare=True)
def resolve_cluster(table: Floats, restitution: float, first: int, last: int) -> None:
    """Replace the speeds of touching vehicles ``first..last`` by their speeds after the impact.

    One restitution holds per world, so clusters never mix two; the cluster is plastic when its largest closing speed
    is below ``PLASTIC_SPEED_MPS``. A block's common speed is refined by the mean of what is left over, so the momentum
    error stays within 4 eps of ``sum(m |v|)`` whatever the masses; a vehicle that nobody strikes keeps its bits.

    The exact blocks are ordered, their refined speeds only up to rounding. A plastic cluster is therefore put in order
    at the end (front to rear, nobody faster than the one before): then no pair approaches any more, and the instant has
    no further round. Without it two blocks can hand the last bit to and fro for ever.
    """
    largest = 0.0
    for p in range(first, last):
        largest = max(largest, table[ROW.CLOSING, p])
    bounce = restitution if largest >= BOUND.PLASTIC_SPEED_MPS else 0.0
    end = last + 1
    for block in range(pool(table, ROW.SPEED, ROW.SPEED, first, last, ROW.POOLED) - 1, -1, -1):
        head = int(table[ROW.BLOCK_FIRST, block])
        pooled = table[ROW.POOLED, head]
        if table[ROW.BLOCK_MASS, block] < math.inf:
            rest = 0.0
            for i in range(head, end):
                rest += table[ROW.MASS, i] * (table[ROW.SPEED, i] - pooled)
            pooled += rest / table[ROW.BLOCK_MASS, block]
        for i in range(head, end):
            table[ROW.SPEED, i] = pooled + bounce * (pooled - table[ROW.SPEED, i])
        end = head
    if bounce == 0.0:
        for i in range(first + 1, last + 1):
            table[ROW.SPEED, i] = min(table[ROW.SPEED, i], table[ROW.SPEED, i - 1])


@compiled(bare=True)
def resolve_impacts(table: Floats, restitution: float) -> bool:
    """One round of impacts of one world: every cluster that holds an approaching pair, once. False if there is none.

    Rows CLOSING, BEFORE and STRUCK tell what happened. CONTACT_SPEED is used up.
    """
    pairs = table.shape[1] - 1
    approaching = False
    for p in range(pairs):
        closing = 0.0
        if table[ROW.GAP, p] <= 0.0:
            closing = table[ROW.CONTACT_SPEED, p]
            if closing == 0.0:
                closing = table[ROW.SPEED, p + 1] - table[ROW.SPEED, p]
        table[ROW.CLOSING, p] = closing
        approaching = approaching or closing > 0.0
    if not approaching:
        return False
    for i in range(pairs + 1):
        table[ROW.BEFORE, i] = table[ROW.SPEED, i]
    first = 0
    while first < pairs:
        last = first
        approaching = False
        while last < pairs and table[ROW.GAP, last] <= 0.0:
            approaching = approaching or table[ROW.CLOSING, last] > 0.0
            last += 1
        if approaching:
            resolve_cluster(table, restitution, first, last)
        first = last + 1
    for p in range(pairs):
        table[ROW.CONTACT_SPEED, p] = 0.0
        table[ROW.STRUCK, p] = 1.0 if table[ROW.CLOSING, p] > BOUND.TOUCH_SPEED_MPS else 0.0
    return True


class _Flags(NamedTuple):
    """What advancing one world told."""

    IMPACT: int = 0
    DONE: int = 1
    PENETRATED: int = 2
    STUCK: int = 3

    def failure(self, status: Ints, from_s: Floats, until_s: Floats) -> PhysicsError:
        """The error for all worlds that the kernel marked with a ``status`` [n] other than DONE."""
        reasons = {self.PENETRATED: "a contact was missed", self.STUCK: f"more than {BOUND.MOST_EVENTS} events"}
        return PhysicsError(
            {
                k: f"{reasons[int(status[k])]} between {from_s[k]:g} s and {until_s[k]:g} s"
                for k in np.flatnonzero(status != self.DONE).tolist()
            }
        )


FLAG = _Flags()


class _Listed(NamedTuple):
    """Columns of the list of impacts."""

    WORLD: int = 0
    PAIR: int = 1
    TIME: int = 2
    CLOSING: int = 3
    FIRST: int = 4
    FRONT_CHANGE: int = 5
    REAR_CHANGE: int = 6
    WIDTH: int = 7


LISTED = _Listed()


@compiled(bare=True)
def advance_table(
    table: Floats, restitution: float, duration: float, start_s: float, world: int, rows: Floats, recorded: int
) -> tuple[int, int]:
    """Take one world through a segment. Returns how many impacts are recorded by now, and a status (DONE if well).

    Harm of the segment is in rows FIRST_HARM, TOTAL_HARM and COUNT. ``rows`` [capacity, LISTED.WIDTH] receives the
    impacts that fit, those beyond are only counted.
    """
    if builds_up(table):
        return advance_on_cubics(table, restitution, duration, start_s, world, rows, recorded)
    return _advance(table, restitution, duration, start_s, world, rows, recorded, False)


@compiled(apart=True, bare=True)
def advance_on_cubics(
    table: Floats, restitution: float, duration: float, start_s: float, world: int, rows: Floats, recorded: int
) -> tuple[int, int]:
    """``advance_table`` where brakes build up."""
    for i in range(table.shape[1]):
        if not command_acts(table[ROW.ONSET, i], duration):
            table[ROW.ONSET, i] = max(table[ROW.ONSET, i], duration)
    return _advance(table, restitution, duration, start_s, world, rows, recorded, True)


@compiled(bare=True)
def _advance(
    table: Floats, restitution: float, duration: float, start_s: float, world: int, rows: Floats, recorded: int,
    building: bool,
) -> tuple[int, int]:  # fmt: skip
    """``advance_table``; as ``building`` is a constant where it is called, only one of both motions is compiled."""
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
def record_impacts(table: Floats, time_s: float, world: int, rows: Floats, recorded: int) -> int:
    """Add the last round of impacts to the harm, and to the list of impacts."""
    for p in range(table.shape[1] - 1):
        if table[ROW.STRUCK, p] == 0.0:
            continue
        closing = table[ROW.CLOSING, p]
        harm = closing * closing
        if recorded < rows.shape[0]:
            rows[recorded, LISTED.WORLD] = world
            rows[recorded, LISTED.PAIR] = p
            rows[recorded, LISTED.TIME] = time_s
            rows[recorded, LISTED.CLOSING] = closing
            rows[recorded, LISTED.FIRST] = 1.0 - table[ROW.HIT, p]
            rows[recorded, LISTED.FRONT_CHANGE] = table[ROW.SPEED, p] - table[ROW.BEFORE, p]
            rows[recorded, LISTED.REAR_CHANGE] = table[ROW.SPEED, p + 1] - table[ROW.BEFORE, p + 1]
        recorded += 1
        table[ROW.TOTAL_HARM, p] += harm
        table[ROW.COUNT, p] += 1.0
        if table[ROW.HIT, p] == 0.0:
            table[ROW.HIT, p] = 1.0
            table[ROW.FIRST_HARM, p] += harm
    return recorded


@compiled(bare=True)
def move_apart(table: Floats, duration: float, building: bool) -> bool:
    """Move a world whose vehicles surely stay apart; leave it and return False when that is not sure.

    Where both of a pair have constant accelerations, the contact time says it exactly. Else: speeds are monotone
    within a segment, so a pair closes by at most ``(max rear speed - min front speed) T``. ``building``: brakes build
    up, see ``builds_up``.
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
    """Make the table ready for ``to_next_impact`` from the start of a segment."""
    for i in range(table.shape[1]):
        table[ROW.ACTIVE, i] = 1.0 if table[ROW.ONSET, i] <= 0.0 else 0.0
        table[ROW.CONTACT_SPEED, i] = 0.0
        if building and table.shape[0] > ROW.OF_BUILD_UP:
            begin_piece(table, i, 0.0)


@compiled(bare=True)
def to_next_impact(table: Floats, restitution: float, now: float, duration: float, building: bool) -> tuple[int, float]:
    """Move from ``now`` event by event up to and through the next round of impacts, or to the end of the segment.

    Returns IMPACT (call again), DONE, or what went wrong; and the time reached.
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
    """Move from ``now`` to the next event or to the end of the segment; False where a gap became impossible."""
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
    """Let those commands and pieces act that begin within ``passed`` (s) from ``now`` on."""
    for i in range(table.shape[1]):
        if table[ROW.ONSET, i] - now <= passed:
            table[ROW.ACTIVE, i] = 1.0
        if building and table.shape[0] > ROW.OF_BUILD_UP and table[ROW.NEXT_PIECE, i] - now <= passed:
            begin_piece(table, i, table[ROW.NEXT_PIECE, i])


@compiled(bare=True)
def accelerate(table: Floats) -> None:
    """Accelerations in force, touching vehicles coupled; marks the pairs that move as one body."""
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
    """Time from ``now`` to the next event, at most ``end - now``; fills the candidates of each vehicle and pair."""
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
    """Move to the next event, putting event values exactly; False when a gap became impossible."""
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
    """Speeds after ``duration``: one value for each joined body, and a pair in contact differs by its closing speed."""
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


# Brakes that build up: the force moves towards the command at a constant rate, so the motion is a cubic in time.
#
# What a vehicle's brakes or engine call for (FORCE) falls at BRAKE_RATE and rises at RELEASE_RATE until it is the
# command; before the latency has elapsed the command is 0. It goes on while a vehicle stands, is held, or is struck.
# Between events each vehicle, and each body of joined vehicles, has a constant jerk. Two more events bound a piece: the
# force reaches the command or passes 0; and joined vehicles part, or a body that is held is so no more. A world in
# which all rates are infinite never comes here.

_SAME_MPS2 = 5e-13  # touching vehicles whose accelerations differ by less are one body: less than parting needs
_PARTS_LATE_S = 1e-9  # joined vehicles part this much late, so that rounding cannot undo it: it costs 1e-26 m
_PARTS_LATE_MPS2 = 1e-12  # and by no smaller a difference of accelerations


@compiled(bare=True)
def builds_up(table: Floats) -> bool:
    """Whether the brakes of this world build up."""
    return bool(table.shape[0] > ROW.OF_EPISODE and table[ROW.BUILDS_UP, 0] == 1.0)


@compiled(bare=True)
def built_up(table: Floats) -> bool:
    """Whether every force is the command in effect, so that until the next onset the motion is that of ``move``."""
    there = True
    for i in range(table.shape[1]):
        there = there and table[ROW.FORCE, i] == table[ROW.COMMAND, i] * table[ROW.ACTIVE, i]
    return there and not pieces_to_come(table)


@compiled
def first_return(value: float, rate: float, jerk: float) -> float:
    """First time > 0 at which ``value + rate t + jerk t^2 / 2`` is 0; infinite: never. A start at 0 does not count."""
    if value == 0.0:
        return -2.0 * rate / jerk if rate * jerk < 0.0 else math.inf
    if jerk == 0.0:
        return -value / rate if value * rate < 0.0 else math.inf
    squared = rate * rate - 2.0 * jerk * value
    if squared < 0.0:
        return math.inf
    root = math.sqrt(squared)
    both = -(rate + root) if rate >= 0.0 else root - rate
    early = both / jerk
    late = 2.0 * value / both if both != 0.0 else early
    if early <= 0.0 or 0.0 < late < early:
        early = late
    return early if early > 0.0 else math.inf


@compiled
def gap_after(gap: float, closing: float, pressing: float, jerk: float, time: float) -> float:
    """Gap after ``time`` of constant closing jerk: ``g - (w + (b + j t / 3) t / 2) t``. [m]"""
    return gap - (closing + 0.5 * (pressing + jerk * time / 3.0) * time) * time


@compiled
def contact_within(gap: float, closing: float, pressing: float, jerk: float, end: float) -> tuple[float, float]:
    """``contact`` of a pair whose closing acceleration changes at the rate ``jerk`` (m/s3), until ``end`` (s).

    The closing speed ``w + b t + j t^2 / 2`` has at most two roots, between which the gap is monotone. The first
    stretch at whose end the gap is not positive holds the contact. Newton's method finds it, kept inside by bisection.
    """
    if jerk == 0.0:
        return contact(gap, closing, pressing)
    first, second = -math.inf, -math.inf  # the turning points of the gap, in order
    squared = pressing * pressing - 2.0 * jerk * closing
    if squared > 0.0:
        root = math.sqrt(squared)
        both = -(pressing + root) if pressing >= 0.0 else root - pressing
        one, other = both / jerk, 2.0 * closing / both
        first, second = min(one, other), max(one, other)
    elif jerk < 0.0:
        return math.inf, 0.0
    for stretch in range(2):
        if jerk > 0.0:  # closing up to the first turning point, and from the second one on
            low, high = (0.0, min(first, end)) if stretch == 0 else (max(second, 0.0), end)
        else:
            low, high = (max(first, 0.0), min(second, end)) if stretch == 0 else (0.0, 0.0)
        if not low < high or gap_after(gap, closing, pressing, jerk, high) > 0.0:
            continue
        time = low
        for _ in range(200):
            beyond = gap_after(gap, closing, pressing, jerk, time)
            if beyond > 0.0:
                low = time
            else:
                high = time
            speed = closing + (pressing + 0.5 * jerk * time) * time
            after = time + beyond / speed if speed > 0.0 else math.inf
            if not low < after < high:
                after = 0.5 * (low + high)
                if after <= low or after >= high:
                    break
            if after == time:
                break
            time = after
        return time, max(closing + (pressing + 0.5 * jerk * time) * time, 0.0)
    return math.inf, 0.0


@compiled(bare=True)
def plan_force(table: Floats, i: int, wanted: float) -> None:
    """Where the force of vehicle ``i`` goes from now on, and when it is there: the command, or 0 on the way to it."""
    force = table[ROW.FORCE, i]
    force = force_now(force, wanted, table[ROW.BRAKE_RATE, i], table[ROW.RELEASE_RATE, i])
    table[ROW.FORCE, i] = force
    table[ROW.FORCE_RATE, i] = 0.0
    table[ROW.FORCE_TIME, i] = math.inf
    if wanted == force:
        return
    rate = -table[ROW.BRAKE_RATE, i] if wanted < force else table[ROW.RELEASE_RATE, i]
    goal = 0.0 if (force < 0.0 < wanted) or (wanted < 0.0 < force) else wanted
    table[ROW.FORCE_RATE, i] = rate
    table[ROW.FORCE_TIME, i] = (goal - force) / rate
    table[ROW.FORCE_VALUE, i] = goal


@compiled
def force_ranges(force: float, rate: float, speed: float, limit: float) -> tuple[float, float, float, float]:
    """``force_range``, and the rates at which both ends move."""
    if force < 0.0 or (force == 0.0 and rate < 0.0):
        if speed > 0.0:
            return force, force, rate, rate
        if speed < 0.0:
            return -force, -force, -rate, -rate
        return force, -force, rate, -rate
    if force > 0.0 or rate > 0.0:
        if speed < limit:
            return force, force, rate, rate
        if speed == limit:
            return 0.0, force, 0.0, rate
    return 0.0, 0.0, 0.0, 0.0


@compiled
def settle_moving(low: float, high: float, low_jerk: float, high_jerk: float) -> tuple[float, float]:
    """Acceleration and jerk of a free body whose forces range over a moving ``[low, high]``."""
    if low > 0.0 or (low == 0.0 and low_jerk > 0.0):
        return low, low_jerk
    if high < 0.0 or (high == 0.0 and high_jerk < 0.0):
        return high, high_jerk
    return 0.0, 0.0


@compiled(apart=True, bare=True)
def pool_moving(table: Floats, first: int, last: int) -> float:
    """Accelerations and jerks of touching vehicles ``first..last`` of equal speed; the time until one of them parts.

    The regression of ``pool``, but vehicles of equal acceleration are joined, and part by their jerks. Accelerations
    that differ by rounding alone are equal.
    """
    count = 0
    for i in range(first, last + 1):
        mass, heavy = table[ROW.MASS, i], table[ROW.MASS, i] == math.inf
        table[ROW.BLOCK_MASS, count] = mass
        table[ROW.BLOCK_LOW, count] = 0.0 if heavy else mass * table[ROW.FORCE_LOW, i]
        table[ROW.BLOCK_HIGH, count] = 0.0 if heavy else mass * table[ROW.FORCE_HIGH, i]
        table[ROW.BLOCK_LOW_JERK, count] = 0.0 if heavy else mass * table[ROW.LOW_JERK, i]
        table[ROW.BLOCK_HIGH_JERK, count] = 0.0 if heavy else mass * table[ROW.HIGH_JERK, i]
        table[ROW.BLOCK_FIRST, count] = i
        top = count + first
        settle_block(table, count, top)
        while count > 0 and table[ROW.ACCELERATION, top] >= table[ROW.ACCELERATION, top - 1] - _SAME_MPS2:
            count -= 1
            top -= 1
            for row in (ROW.BLOCK_MASS, ROW.BLOCK_LOW, ROW.BLOCK_HIGH, ROW.BLOCK_LOW_JERK, ROW.BLOCK_HIGH_JERK):
                table[row, count] += table[row, count + 1]
            settle_block(table, count, top)
        count += 1
    soonest, end = math.inf, last + 1
    for k in range(count - 1, -1, -1):
        head, value, jerk = (
            int(table[ROW.BLOCK_FIRST, k]),
            table[ROW.ACCELERATION, k + first],
            table[ROW.JERK, k + first],
        )
        soonest = min(soonest, parting_s(table, head, end - 1, value, jerk))
        for i in range(head, end):
            table[ROW.ACCELERATION, i], table[ROW.JERK, i] = value, jerk
            table[ROW.JOINED, i] = 1.0 if i < end - 1 else 0.0
        end = head
    return soonest


@compiled(bare=True)
def settle_block(table: Floats, block: int, out: int) -> None:
    """Acceleration and jerk of a block, into column ``out``."""
    mass = table[ROW.BLOCK_MASS, block]
    table[ROW.ACCELERATION, out], table[ROW.JERK, out] = settle_moving(
        table[ROW.BLOCK_LOW, block] / mass, table[ROW.BLOCK_HIGH, block] / mass,
        table[ROW.BLOCK_LOW_JERK, block] / mass, table[ROW.BLOCK_HIGH_JERK, block] / mass,
    )  # fmt: skip


@compiled(bare=True)
def parting_s(table: Floats, head: int, tail: int, value: float, jerk: float) -> float:
    """Time until the block of vehicles ``head..tail`` is one no more.

    A block that moves parts where the front ones of it alone would be faster than it; one that is held moves where its
    front ones drive away or its rear ones would be pushed back.
    """
    soonest = math.inf
    held = value == 0.0 and jerk == 0.0
    forward = value > 0.0 or (value == 0.0 and jerk > 0.0)
    mass, force, rate = 0.0, 0.0, 0.0
    for i in range(head, tail + (1 if held else 0)):  # the front ones, up to i
        if table[ROW.MASS, i] == math.inf:
            mass = math.inf
            continue
        mass += table[ROW.MASS, i]
        side = ROW.FORCE_LOW if held or forward else ROW.FORCE_HIGH
        force += table[ROW.MASS, i] * table[side, i]
        rate += table[ROW.MASS, i] * table[side + ROW.LOW_JERK - ROW.FORCE_LOW, i]
        soonest = min(soonest, crossing_s(force / mass - value, rate / mass - jerk))
    mass, force, rate = 0.0, 0.0, 0.0
    for i in range(tail if held else head - 1, head - 1, -1):  # the rear ones, from i on
        if table[ROW.MASS, i] == math.inf:
            break
        mass += table[ROW.MASS, i]
        force += table[ROW.MASS, i] * table[ROW.FORCE_HIGH, i]
        rate += table[ROW.MASS, i] * table[ROW.HIGH_JERK, i]
        soonest = min(soonest, crossing_s(-force / mass, -rate / mass))
    return soonest


@compiled
def crossing_s(below: float, rate: float) -> float:
    """When a difference of accelerations that is not positive is surely positive; infinite: never. [m/s2, m/s3]"""
    if rate <= 0.0:
        return math.inf
    return max(-below / rate, 0.0) + _PARTS_LATE_S + _PARTS_LATE_MPS2 / rate


@compiled(apart=True, bare=True)
def accelerate_moving(table: Floats) -> float:
    """``accelerate`` where brakes build up: accelerations and jerks; the time until touching vehicles part."""
    vehicles = table.shape[1]
    for i in range(vehicles):
        plan_force(table, i, table[ROW.COMMAND, i] * table[ROW.ACTIVE, i])
        low, high, low_jerk, high_jerk = force_ranges(
            table[ROW.FORCE, i], table[ROW.FORCE_RATE, i], table[ROW.SPEED, i], table[ROW.LIMIT, i]
        )
        table[ROW.FORCE_LOW, i], table[ROW.FORCE_HIGH, i] = low, high
        table[ROW.LOW_JERK, i], table[ROW.HIGH_JERK, i] = low_jerk, high_jerk
    soonest, first = math.inf, 0
    while first < vehicles:
        last = first
        while (
            last < vehicles - 1 and table[ROW.GAP, last] <= 0.0 and table[ROW.SPEED, last] == table[ROW.SPEED, last + 1]
        ):
            last += 1
        if last == first:
            table[ROW.ACCELERATION, first], table[ROW.JERK, first] = settle_moving(
                table[ROW.FORCE_LOW, first], table[ROW.FORCE_HIGH, first],
                table[ROW.LOW_JERK, first], table[ROW.HIGH_JERK, first],
            )  # fmt: skip
            table[ROW.JOINED, first] = 0.0
        else:
            soonest = min(soonest, pool_moving(table, first, last))
        first = last + 1
    return soonest


@compiled(apart=True, bare=True)
def next_moving_event(table: Floats, now: float, end: float, parting: float) -> float:
    """``next_event`` where brakes build up."""
    vehicles = table.shape[1]
    soonest = min(end - now, parting)
    for i in range(vehicles):
        soonest = min(soonest, table[ROW.FORCE_TIME, i])
        if table[ROW.ACTIVE, i] == 0.0:
            soonest = min(soonest, table[ROW.ONSET, i] - now)
        if table.shape[0] > ROW.OF_BUILD_UP:
            soonest = min(soonest, table[ROW.NEXT_PIECE, i] - now)
    for i in range(vehicles):
        speed, rate, jerk, limit = (
            table[ROW.SPEED, i],
            table[ROW.ACCELERATION, i],
            table[ROW.JERK, i],
            table[ROW.LIMIT, i],
        )
        most = (abs(rate) + abs(jerk) * soonest) * soonest  # by so much the speed can change
        time, value = math.inf, 0.0
        if most >= abs(speed):
            time = first_return(speed, rate, jerk)
        if most >= abs(speed - limit) and (table[ROW.FORCE, i] > 0.0 or table[ROW.FORCE_RATE, i] > 0.0):
            reach = first_return(speed - limit, rate, jerk)
            if reach < time:
                time, value = reach, limit
        table[ROW.SPEED_TIME, i] = time
        table[ROW.SPEED_VALUE, i] = value
        soonest = min(soonest, time)
    for p in range(vehicles - 1):
        time, speed = math.inf, 0.0
        if table[ROW.JOINED, p] == 0.0:
            gap, closing = table[ROW.GAP, p], table[ROW.SPEED, p + 1] - table[ROW.SPEED, p]
            pressing = table[ROW.ACCELERATION, p + 1] - table[ROW.ACCELERATION, p]
            jerk = table[ROW.JERK, p + 1] - table[ROW.JERK, p]
            most = max(closing, 0.0) + (max(pressing, 0.0) + max(jerk, 0.0) * soonest) * soonest
            if most * soonest >= gap:  # else it cannot close in this piece
                time, speed = contact_within(gap, closing, pressing, jerk, soonest)
        table[ROW.CONTACT_TIME, p] = time
        table[ROW.CONTACT_SPEED, p] = speed
        soonest = min(soonest, time)
    return soonest


@compiled(apart=True, bare=True)
def move_on_cubics(table: Floats, duration: float) -> bool:
    """``move`` where brakes build up: gaps, speeds and forces."""
    vehicles, sound = table.shape[1], True
    for p in range(vehicles - 1):
        if table[ROW.CONTACT_TIME, p] <= duration:
            table[ROW.GAP, p] = 0.0
        else:
            table[ROW.CONTACT_TIME, p] = math.inf
            table[ROW.CONTACT_SPEED, p] = 0.0
            if table[ROW.JOINED, p] == 0.0:
                after = gap_after(
                    table[ROW.GAP, p], table[ROW.SPEED, p + 1] - table[ROW.SPEED, p],
                    table[ROW.ACCELERATION, p + 1] - table[ROW.ACCELERATION, p],
                    table[ROW.JERK, p + 1] - table[ROW.JERK, p], duration,
                )  # fmt: skip
                sound = sound and after >= -BOUND.PENETRATION_M
                table[ROW.GAP, p] = max(after, 0.0)
    first = 0
    while first < vehicles:
        rate, jerk = table[ROW.ACCELERATION, first], table[ROW.JERK, first]
        value = table[ROW.SPEED, first] + (rate + 0.5 * jerk * duration) * duration
        last = first
        if table[ROW.SPEED_TIME, first] <= duration:
            value = table[ROW.SPEED_VALUE, first]
        while table[ROW.JOINED, last] == 1.0:
            last += 1
            if table[ROW.SPEED_TIME, last] <= duration:
                value = table[ROW.SPEED_VALUE, last]
        if first > 0 and table[ROW.CONTACT_TIME, first - 1] <= duration:
            value = table[ROW.SPEED, first - 1] + table[ROW.CONTACT_SPEED, first - 1]
        for i in range(first, last + 1):
            table[ROW.SPEED, i] = value
        first = last + 1
    for i in range(vehicles):
        if table[ROW.FORCE_TIME, i] <= duration:
            table[ROW.FORCE, i] = table[ROW.FORCE_VALUE, i]
        else:
            table[ROW.FORCE, i] += table[ROW.FORCE_RATE, i] * duration
    return sound


@compiled(apart=True, bare=True)
def move_apart_on_cubics(table: Floats, duration: float) -> bool:
    """``move_apart`` where brakes build up: each vehicle from event to event on its own, and how near two can come."""
    vehicles = table.shape[1]
    slowest_in_front = math.inf
    for i in range(vehicles):
        speed = table[ROW.SPEED, i]
        if speed < 0.0:
            return False
        onset, before = table[ROW.ONSET, i], table[ROW.FORCE, i]
        table[ROW.WAY, i], table[ROW.SPEED_VALUE, i] = 0.0, speed
        slowest, fastest = speed, speed
        if onset > 0.0:
            slowest, fastest = move_alone(table, i, 0.0, min(onset, duration))
        in_pieces, now = table.shape[0] > ROW.OF_BUILD_UP, max(onset, 0.0)
        if in_pieces:
            begin_piece(table, i, 0.0)
        while in_pieces and table[ROW.NEXT_PIECE, i] <= duration:
            begins = table[ROW.NEXT_PIECE, i]
            low, high = move_alone(table, i, table[ROW.COMMAND, i], begins - now)
            slowest, fastest, now = min(slowest, low), max(fastest, high), begins
            begin_piece(table, i, now)
        if now < duration:
            low, high = move_alone(table, i, table[ROW.COMMAND, i], duration - now)
            slowest, fastest = min(slowest, low), max(fastest, high)
        table[ROW.FORCE_VALUE, i] = table[ROW.FORCE, i]
        table[ROW.FORCE, i] = before
        if i > 0:
            closing = fastest - slowest_in_front
            if closing > 0.0 and closing * duration >= table[ROW.GAP, i - 1]:
                return False
        slowest_in_front = slowest
    for i in range(vehicles):
        table[ROW.SPEED, i] = table[ROW.SPEED_VALUE, i]
        table[ROW.FORCE, i] = table[ROW.FORCE_VALUE, i]
    for p in range(vehicles - 1):
        table[ROW.GAP, p] = max(table[ROW.GAP, p] + (table[ROW.WAY, p] - table[ROW.WAY, p + 1]), 0.0)
    return True


@compiled(bare=True)
def move_alone(table: Floats, i: int, wanted: float, duration: float) -> tuple[float, float]:
    """Move vehicle ``i`` under one command, from SPEED_VALUE on, and add its WAY; its lowest and its highest speed."""
    speed = table[ROW.SPEED_VALUE, i]
    force = force_now(table[ROW.FORCE, i], wanted, table[ROW.BRAKE_RATE, i], table[ROW.RELEASE_RATE, i])
    rate, building = 0.0, 0.0  # at which the force moves towards the command, and for how long
    if wanted != force:
        rate = -table[ROW.BRAKE_RATE, i] if wanted < force else table[ROW.RELEASE_RATE, i]
        building = duration if abs(rate * duration) < abs(wanted - force) else (wanted - force) / rate
    built = wanted if building < duration else force + rate * duration
    if speed == 0.0 and force <= 0.0 and built <= 0.0:
        table[ROW.FORCE, i] = built
        return 0.0, 0.0
    between = speed + (force + 0.5 * rate * building) * building
    after = between + built * (duration - building)
    turning = speed - 0.5 * force * force / rate if force * built < 0.0 else speed  # where the force passes 0
    slowest, fastest = min(min(speed, between), min(after, turning)), max(max(speed, between), max(after, turning))
    if slowest <= 0.0 or fastest >= table[ROW.LIMIT, i]:
        return move_alone_by_events(table, i, wanted, duration)
    table[ROW.WAY, i] += (speed + 0.5 * (force + rate * building / 3.0) * building) * building
    table[ROW.WAY, i] += (between + 0.5 * built * (duration - building)) * (duration - building)
    table[ROW.FORCE, i], table[ROW.SPEED_VALUE, i] = built, after
    return slowest, fastest


@compiled(apart=True, bare=True)
def move_alone_by_events(table: Floats, i: int, wanted: float, duration: float) -> tuple[float, float]:
    """``move_alone`` where the vehicle may come to rest, or to its speed limit."""
    speed, limit, now = table[ROW.SPEED_VALUE, i], table[ROW.LIMIT, i], 0.0
    slowest, fastest = speed, speed
    while now < duration:
        plan_force(table, i, wanted)
        force, rate = table[ROW.FORCE, i], table[ROW.FORCE_RATE, i]
        acceleration, jerk = settle_moving(*force_ranges(force, rate, speed, limit))
        passed = min(duration - now, table[ROW.FORCE_TIME, i])
        reach, value = first_return(speed, acceleration, jerk), 0.0
        if (force > 0.0 or rate > 0.0) and first_return(speed - limit, acceleration, jerk) < reach:
            reach, value = first_return(speed - limit, acceleration, jerk), limit
        passed = min(passed, reach)
        table[ROW.WAY, i] += (speed + 0.5 * (acceleration + jerk * passed / 3.0) * passed) * passed
        speed = value if reach <= passed else speed + (acceleration + 0.5 * jerk * passed) * passed
        there = table[ROW.FORCE_TIME, i] <= passed
        table[ROW.FORCE, i] = table[ROW.FORCE_VALUE, i] if there else force + rate * passed
        slowest, fastest = min(slowest, speed), max(fastest, speed)
        now = duration if passed >= duration - now else now + passed
    table[ROW.SPEED_VALUE, i] = speed
    return slowest, fastest


# Brakes in pieces: from its onset on such a vehicle has the command of the piece in force, whatever else it is told.
# Its world moves as one in which brakes build up, at rates that may be infinite.


@compiled
def rows_for(pieces: int) -> int:
    """Rows of a table for vehicles with so many ``pieces``, times and commands; 0: ROW.OF_BUILD_UP."""
    return ROW.PIECES + pieces if pieces > 0 else ROW.OF_BUILD_UP


@compiled(bare=True)
def begin_piece(table: Floats, i: int, now: float) -> None:
    """Give vehicle ``i`` the command of its piece at ``now`` (s from the segment's start), and plan the next one."""
    count = (table.shape[0] - ROW.PIECES) // 2
    table[ROW.NEXT_PIECE, i] = math.inf
    for piece in range(count):
        begins = table[ROW.ONSET, i] + table[ROW.PIECES + piece, i]
        if begins == math.inf or (piece > 0 and begins > now):
            table[ROW.NEXT_PIECE, i] = begins
            return
        table[ROW.COMMAND, i] = table[ROW.PIECES + count + piece, i]


@compiled(bare=True)
def pieces_to_come(table: Floats) -> bool:
    """Whether some vehicle's next piece is still to begin."""
    if table.shape[0] > ROW.OF_BUILD_UP:
        for i in range(table.shape[1]):
            if table[ROW.NEXT_PIECE, i] < math.inf:
                return True
    return False


@compiled(bare=True)
def place_rates(table: Floats, brake_rate: Floats, release_rate: Floats, pieces: Floats) -> None:
    """Write rates (m/s3), each [N], and pieces [N, 2 K] of the vehicles into a table [rows_for(2 K), N or N + 1].

    Where all rates are infinite and nobody brakes in pieces, the forces are not looked at.
    """
    at, least = table.shape[1] - brake_rate.shape[0], math.inf
    for row in range(pieces.shape[1]):
        for i in range(table.shape[1]):
            table[ROW.PIECES + row, i] = math.inf if i < at else pieces[i - at, row]
            least = min(least, table[ROW.PIECES + row, i])
    for i in range(brake_rate.shape[0]):
        least = min(least, brake_rate[i], release_rate[i])
    table[ROW.BUILDS_UP, 0] = 1.0 if least < math.inf else 0.0
    if least < math.inf:
        for i in range(brake_rate.shape[0]):
            table[ROW.BRAKE_RATE, at + i] = brake_rate[i]
            table[ROW.RELEASE_RATE, at + i] = release_rate[i]


@compiled(bare=True)
def place_forces(
    table: Floats, force: Floats, brake_rate: Floats, release_rate: Floats, pieces: Floats
) -> None:  # fmt: skip
    """``place_rates``, and the forces of the vehicles [N] (m/s2)."""
    place_rates(table, brake_rate, release_rate, pieces)
    if table[ROW.BUILDS_UP, 0] == 1.0:
        for i in range(force.shape[0]):
            table[ROW.FORCE, table.shape[1] - force.shape[0] + i] = force[i]


@compiled(bare=True)
def force_at(table: Floats, i: int, command: float, latency_s: float, time_s: float) -> float:
    """The force of vehicle ``i`` at ``time_s``, the end of a segment; no command acts before its latency. [m/s2]"""
    acts = command_acts(latency_s, time_s)
    if not builds_up(table):
        return command if acts else 0.0
    wanted = table[ROW.COMMAND, i] if acts else 0.0  # of its piece, where it brakes in pieces
    return force_now(table[ROW.FORCE, i], wanted, table[ROW.BRAKE_RATE, i], table[ROW.RELEASE_RATE, i])


@compiled
def force_now(force: float, wanted: float, brake_rate: float, release_rate: float) -> float:
    """The force at the moment at which another command begins to act: it jumps only at an infinite rate. [m/s2]"""
    return wanted if math.isinf(brake_rate if wanted < force else release_rate) else force


# The obstacle ahead of Vehicle 1, for the kernels: one more vehicle in front, which stands and which nothing moves.
#
# Its mass is infinite. In the regression P of a cluster that touches it, and of touching vehicles that press against
# it, it therefore stays at 0, and P is the regression of the vehicles alone bounded above by 0: ``min(P, 0)``. Contact,
# touch, plastic impacts and first impacts follow the rules of any pair, to the same bits. The added vehicle exists
# inside the physics only; everybody else keeps the numbers of the vehicles, and the obstacle has columns of its own.


@compiled
def place_obstacle(table: Floats, gap: float, hit: float) -> None:
    """Write the obstacle into column 0 of a world's table; its speed and command are the zeros of a new table."""
    table[ROW.MASS, 0] = math.inf
    table[ROW.GAP, 0] = gap
    table[ROW.HIT, 0] = hit


# The step of an episode, compiled: onset of the commands, motion, harm, rest, and the times of the decisions.
#
# Search and shield advance an episode by ``step_episode``. The engine, whose loop keeps its worlds in rows, is made of
# the same rules (``step_end_s``, ``onset_s``, ``force_at``, ``stands``) around the same ``advance_table``, so
# all three agree to the bit (decision 0025). Search and shield copy one world at a time into the table of
# ``physics.kernel``, which is longer here by the rows below.
#
# A *profile* holds the commands of the controlled vehicles in each of its phases. Phases begin and end on the grid of
# decisions, so an agent can drive it. Letters beside those of ``physics.worlds``:
#
# ===  ===========================================================
# C    controlled vehicles
# K    phases, in order of time; ``ends[k]`` is the step in which phase k ends, the last one reaches the horizon
# S    columns of a saved state: speeds N, gaps P, hit flags P, first-impact harm P, total harm P, forces N (which mean
#      nothing where no brakes build up)
# ===  ===========================================================

# rows of the table after those of a segment


# what a step brought; what is below 0 is a failure: minus the status of the kernel
GOES_ON, AT_REST, AT_HORIZON = 0, 1, 2


class _Clock(NamedTuple):
    """Entries of an episode's clock."""

    START: int = 0  # first decision (s)
    TIME_STEP: int = 1  # s
    LAST_STEP: int = 2  # number of steps
    HORIZON: int = 3  # s
    RESTITUTION: int = 4
    HARM_IS_TOTAL: int = 5  # 1 to minimise total harm
    STEPWISE: int = 6  # 1 to advance decision by decision
    WIDTH: int = 7


CLOCK = _Clock()

OTHER_WEIGHT = 1e-8  # of the other count in the value that is minimised: it decides between equal harms
_ROUNDING = 1e-9  # of a step: by less than this the horizon may lie beyond the last whole step
_ON_GRID = 1e-6  # of a step: a time this close before a decision is that decision


class Grid(NamedTuple):
    """The decisions of one episode: one every ``time_step_s`` from ``first_s`` on, ``last_step`` of them."""

    first_s: float
    time_step_s: float
    last_step: float
    horizon_s: float  # where the last step ends


class Episode(NamedTuple):
    """One world as its profiles run."""

    table: Floats  # [rows_for(2 K), N] with latencies, masses, speed limits and the other vehicles' commands
    clock: Floats  # [CLOCK.WIDTH]
    controlled: Ints  # [C] vehicles


class Decisions(NamedTuple):
    """Moments at which somebody decides, of one world or of many: at ``first_s``, and each time step from then on."""

    first_s: Floats  # s
    time_step_s: Floats | float  # s

    def before(self, time_s: Floats | float) -> Floats:
        """How many fall before the horizon, or another time."""
        return np.ceil((time_s - self.first_s) / self.time_step_s - _ROUNDING)

    def latest(self, time_s: Floats) -> Ints:
        """Number of the latest one at these times; below 0 before the first one."""
        number: Floats = np.floor((time_s - self.first_s) / self.time_step_s + _ON_GRID)
        return number.astype(np.int64)

    def at(self, step: Floats | Ints | float) -> Floats:
        """Time of a decision by its number: when that step, unless it is the last one, begins (s)."""
        return self.first_s + step * self.time_step_s


@compiled
def grid_of(clock: Floats) -> Grid:
    """The decisions that a clock [CLOCK.WIDTH] tells of."""
    return Grid(clock[CLOCK.START], clock[CLOCK.TIME_STEP], clock[CLOCK.LAST_STEP], clock[CLOCK.HORIZON])


@compiled
def step_end_s(step: float, last_step: float, first_s: float, time_step_s: float, horizon_s: float) -> float:
    """Time (s) at which the step with this number, from 1, ends; the last one ends at the horizon."""
    return horizon_s if step >= last_step else first_s + step * time_step_s


@compiled
def time_of(grid: Grid, step: int) -> float:
    """Time at which a step, counted from 0, begins (s)."""
    return step_end_s(step, grid.last_step, grid.first_s, grid.time_step_s, grid.horizon_s)


@compiled
def onset_s(latency_s: float, time_s: float) -> float:
    """How long after ``time_s`` a command takes effect (s); not above 0: at once."""
    return latency_s - time_s


@compiled
def stands(speed_mps: float, command_mps2: float) -> bool:
    """Whether a vehicle stands and its command would not move it."""
    return speed_mps == 0.0 and command_mps2 <= 0.0


@compiled(within=True)
def at_rest(table: Floats) -> bool:
    """Whether the episode has ended: everything stands and no command would move it."""
    for i in range(table.shape[1]):  # all() is not compiled
        command = table[ROW.COMMAND, i]
        if not stands(table[ROW.SPEED, i], max(command, table[ROW.FORCE, i]) if builds_up(table) else command):
            return False
    return True


@compiled(within=True)
def step_episode(
    table: Floats, restitution: float, time: float, until: float, horizon_s: float, no_rows: Floats
) -> int:
    """THE step: from ``time`` to ``until`` (s) under the commands in the table, and the harm of it.

    Returns GOES_ON, AT_REST, AT_HORIZON (still moving, or told to move), or minus the kernel's status of a failure; the
    table is then of no use. ``no_rows`` is an empty list of impacts, as ``table[:0]``. The bits depend on where steps
    end: what the engine does is a step from each decision to the next one.
    """
    status = advance_table(table, restitution, until - time, time, 0, no_rows, 0)[1]
    if status != FLAG.DONE:
        return -status
    for p in range(table.shape[1] - 1):
        table[ROW.SUM_FIRST_HARM, p] += table[ROW.FIRST_HARM, p]
        table[ROW.SUM_TOTAL_HARM, p] += table[ROW.TOTAL_HARM, p]
    if at_rest(table):
        return AT_REST
    return AT_HORIZON if until >= horizon_s else GOES_ON


@compiled(within=True)
def step_again(table: Floats, restitution: float, grid: Grid, step: int, end: int, no_rows: Floats) -> int:
    """``step_episode`` from decision ``step`` to decision ``end`` of a table that stays loaded from step to step."""
    time = time_of(grid, step)
    for i in range(table.shape[1]):
        table[ROW.ONSET, i] = onset_s(table[ROW.LATENCY, i], time)
    return step_episode(table, restitution, time, time_of(grid, end), grid.horizon_s, no_rows)


@compiled
def harm_so_far(table: Floats, total: float) -> float:
    """Harm of the line since the episode began, under one count (1: total harm), summed front to rear (m2/s2)."""
    value, row = 0.0, ROW.SUM_TOTAL_HARM if total == 1.0 else ROW.SUM_FIRST_HARM
    for p in range(table.shape[1] - 1):
        value += table[row, p]
    return value


@compiled
def value_of(table: Floats, total: float) -> float:
    """What a search minimises: the harm under one count, and a very little of the other one (m2/s2)."""
    return harm_so_far(table, total) + OTHER_WEIGHT * harm_so_far(table, 1.0 - total)


@compiled
def save(table: Floats, state: Floats) -> None:
    """Keep a world's state and its harm so far in one row [S]."""
    vehicles = table.shape[1]
    pairs = vehicles - 1
    for i in range(vehicles):
        state[i] = table[ROW.SPEED, i]
    for p in range(pairs):
        state[vehicles + p] = table[ROW.GAP, p]
        state[vehicles + pairs + p] = table[ROW.HIT, p]
        state[vehicles + 2 * pairs + p] = table[ROW.SUM_FIRST_HARM, p]
        state[vehicles + 3 * pairs + p] = table[ROW.SUM_TOTAL_HARM, p]
    for i in range(vehicles):
        state[vehicles + 4 * pairs + i] = table[ROW.FORCE, i]


@compiled
def restore(table: Floats, state: Floats) -> None:
    """Bring back what ``save`` kept."""
    vehicles = table.shape[1]
    pairs = vehicles - 1
    for i in range(vehicles):
        table[ROW.SPEED, i] = state[i]
    for p in range(pairs):
        table[ROW.GAP, p] = state[vehicles + p]
        table[ROW.HIT, p] = state[vehicles + pairs + p]
        table[ROW.SUM_FIRST_HARM, p] = state[vehicles + 2 * pairs + p]
        table[ROW.SUM_TOTAL_HARM, p] = state[vehicles + 3 * pairs + p]
    for i in range(vehicles):
        table[ROW.FORCE, i] = state[vehicles + 4 * pairs + i]


@compiled(apart=True)
def follow_whole(world: Episode, ends: Ints, commands: Floats, states: Floats, bound: float) -> tuple[float, int]:
    """``follow`` a profile from its first phase on."""
    phase = min(0, ends.shape[0])  # 0, but no literal, for which everything would be compiled a second time
    return follow(world, ends, commands, states, phase, bound)


@compiled
def follow(world: Episode, ends: Ints, commands: Floats, states: Floats, phase: int, bound: float) -> tuple[float, int]:
    """Follow a profile from the start of ``phase`` on; ``states[k]`` [K + 1, S] is the state at the start of phase k.

    ``ends`` [K], ``commands`` [K, C]. Gives up as soon as the value is not below ``bound``: harm never falls again.
    With ``clock[STEPWISE]`` it advances decision by decision, as the engine does, to the same bits; otherwise phase by
    phase, which is several times faster and differs by rounding. Returns the value and the number of phases up to the
    end of the episode; -1 for that number if the kernel failed.
    """
    table, clock, controlled = world.table, world.clock, world.controlled
    grid, restitution, total = grid_of(clock), clock[CLOCK.RESTITUTION], clock[CLOCK.HARM_IS_TOTAL]
    no_rows = table[:0]
    restore(table, states[phase])
    value = value_of(table, total)
    for k in range(phase, ends.shape[0]):
        begin = ends[k - 1] if k > 0 else 0
        outcome = GOES_ON
        if ends[k] > begin:
            for c in range(controlled.shape[0]):
                table[ROW.COMMAND, controlled[c]] = commands[k, c]
            length = 1 if clock[CLOCK.STEPWISE] == 1.0 else ends[k] - begin
            for step in range(begin, ends[k], length):
                outcome = step_again(table, restitution, grid, step, step + length, no_rows)
                if outcome != GOES_ON:
                    break
            if outcome < GOES_ON:
                return value, -1
            value = value_of(table, total)
        save(table, states[k + 1])
        if value >= bound or outcome == AT_REST:
            return value, k + 1
    return value, ends.shape[0]


# A segment of constant command as pieces of constant acceleration: what a picture needs to be exact between events.

_CAPACITY = 64


@compiled
def _pieces(table: Floats, restitution: float, duration: float, rows: Floats) -> int:
    """Write down time from the start, gaps, speeds, accelerations and jerks where each piece begins; their number.

    Those that do not fit into ``rows`` [capacity, 1 + P + 3 N] are only counted; minus their number where a contact
    was missed.
    """
    vehicles, building = table.shape[1], builds_up(table)
    start_events(table, building)
    now, count = 0.0, 0
    for _ in range(BOUND.MOST_EVENTS):
        if resolve_impacts(table, restitution):
            continue
        if now >= duration:
            break
        parting = accelerate_moving(table) if building else math.inf
        if not building:
            accelerate(table)
        if count < rows.shape[0]:
            rows[count, 0] = now
            for p in range(vehicles - 1):
                rows[count, 1 + p] = table[ROW.GAP, p]
            for i in range(vehicles):
                rows[count, vehicles + i] = table[ROW.SPEED, i]
                rows[count, 2 * vehicles + i] = table[ROW.ACCELERATION, i]
                rows[count, 3 * vehicles + i] = table[ROW.JERK, i] if building else 0.0
        count += 1
        passed = next_moving_event(table, now, duration, parting) if building else next_event(table, now, duration)
        if not (move_on_cubics(table, passed) if building else move(table, passed)):
            return -count
        begin_commands(table, now, passed, building)
        now = duration if passed >= duration - now else now + passed
    return count


def segment_pieces(worlds: Worlds, command_mps2: Floats, until_s: Floats) -> list[Floats]:
    """The motion of each world until a time, under one command: a row per piece of constant jerk.

    Args:
        worlds: n, of N vehicles; they stay as they are.
        command_mps2: signed accelerations wanted, [n, N] m/s2.
        until_s: where the segments end, [n] s.

    Returns for each world [k, 1 + N + 3 N]: the absolute time at which the piece begins (s), how far Vehicle 1 has come
    since the segment began, the gaps (m), the speeds (m/s), the accelerations (m/s2) and the jerks (m/s3).

    """
    v, N, durations = worlds.vehicles, worlds.N, until_s - worlds.time_s
    front_gaps = worlds.with_post_ahead(durations).obstacle_gap_m  # says where Vehicle 1 is
    latencies, restitutions = v.latency_s, v.restitution
    # all but the post's own
    wanted = [*range(N + 1), *(part * (N + 1) + i for part in (1, 2, 3) for i in range(1, N + 1))]
    found = []
    for k in range(worlds.n):
        start = float(worlds.time_s[k])
        table = np.zeros((rows_for(v.pieces.shape[2]), N + 1))
        place_obstacle(table, float(front_gaps[k]), 0.0)
        table[ROW.COMMAND, 1:], table[ROW.SPEED, 1:] = command_mps2[k], worlds.speeds_mps[k]
        table[ROW.MASS, 1:], table[ROW.LIMIT, 1:] = v.mass_t[k], v.speed_limit_mps[k]
        table[ROW.ONSET, 0], table[ROW.ONSET, 1:] = onset_s(0.0, start), latencies[k] - start
        place_forces(table, worlds.command_mps2[k], v.brake_rate_mps3[k], v.release_rate_mps3[k], v.pieces[k])
        table[ROW.GAP, 1:N] = worlds.gaps_m[k]
        capacity = _CAPACITY
        while True:
            rows = np.empty((capacity, 4 * (N + 1)))
            count = abs(_pieces(table.copy(), float(restitutions[k]), float(durations[k]), rows))
            if count <= capacity:
                break
            capacity = count
        pieces = rows[:count, wanted]
        pieces[:, 0] += start
        pieces[:, 1] = front_gaps[k] - pieces[:, 1]
        found.append(pieces)
    return found


# The forecast of constant commands: the physics of ``advance``, for many candidate commands of one vehicle.
#
# Nothing of the motion is kept, only the harm, so a candidate costs little more than its events.


def forecast(
    worlds: Worlds, command_mps2: Floats, vehicle: int, candidates_mps2: Floats, until_s: float
) -> tuple[Floats, Floats]:
    """First-impact and total harm from now to ``until_s`` if ``vehicle`` held each candidate command, [n, K] each.

    Harm is that of all pairs and of the obstacle ahead, if there is one.
    ``command_mps2`` [n, N] are the other vehicles' commands (the vehicle's own column is ignored);
    ``candidates_mps2`` [n, K]. Worlds at or beyond ``until_s`` have no harm left. Pairs hit before do not count
    again in first-impact harm. Raises ``InvalidInput`` for shapes that do not fit or a candidate beyond capacity,
    ``PhysicsError`` naming the worlds in which a check of the kernel failed.
    """
    n, N = worlds.speeds_mps.shape
    if command_mps2.shape != (n, N) or candidates_mps2.ndim != 2 or candidates_mps2.shape[0] != n:
        raise InvalidInput(
            f"forecast: commands {command_mps2.shape} and candidates {candidates_mps2.shape}; ({n}, {N}) and ({n}, K)"
            " are needed"
        )
    if not 0 <= vehicle < N:
        raise InvalidInput(f"forecast: vehicle index {vehicle}; must be in 0..{N - 1}")
    v = worlds.vehicles
    low, high = -v.braking_capacity_mps2[:, [vehicle]], v.driving_capacity_mps2[:, [vehicle]]
    good = (candidates_mps2 >= low) & (candidates_mps2 <= high)
    if not good.all():
        raise InvalidInput(
            f"forecast: candidate {candidates_mps2[~good][0]:g} m/s2 is beyond vehicle_{vehicle + 1}'s capacity"
        )
    first, total = np.zeros(candidates_mps2.shape), np.zeros(candidates_mps2.shape)
    ahead = np.minimum(worlds.obstacle_gap_m, BOUND.FAR_AWAY_M) if worlds.obstacle_ahead.any() else np.empty(0)
    failed = np.zeros(n, np.bool_)
    forecast_worlds(
        worlds.gaps_m, worlds.speeds_mps, worlds.time_s, worlds.pair_hit, ahead, worlds.obstacle_hit,
        np.ascontiguousarray(command_mps2), vehicle, np.ascontiguousarray(candidates_mps2), until_s, v.latency_s,
        v.mass_t, v.speed_limit_mps, v.restitution, worlds.command_mps2, v.brake_rate_mps3, v.release_rate_mps3,
        v.pieces, first, total, failed,
    )  # fmt: skip
    if failed.any():
        raise PhysicsError({k: f"a forecast could not reach {until_s:g} s" for k in np.flatnonzero(failed).tolist()})
    return first, total


@compiled
def forecast_worlds(
    gaps: Floats, speeds: Floats, time: Floats, hit: Bools, ahead: Floats, ahead_hit: Bools, command: Floats,
    vehicle: int, candidates: Floats, until_s: float, latency: Floats, mass: Floats, limit: Floats, restitution: Floats,
    in_force: Floats, brake_rate: Floats, release_rate: Floats, pieces: Floats, first: Floats, total: Floats,
    failed: Bools,
) -> None:  # fmt: skip
    """Fill ``first`` and ``total`` [n, K], and ``failed`` [n] where a check failed.

    ``ahead`` [n] is where an obstacle is, ``FAR_AWAY_M`` for none; empty where no world has one.
    """
    n, vehicles = speeds.shape
    at = min(ahead.shape[0], 1)  # vehicle i stands in column at + i, behind an obstacle
    table = np.zeros((rows_for(pieces.shape[2]), at + vehicles))
    no_rows = np.empty((0, LISTED.WIDTH))
    for k in range(n):
        duration = until_s - time[k]
        if not duration > 0.0:
            continue
        for c in range(candidates.shape[1]):
            if at == 1:
                place_obstacle(table, ahead[k], 1.0 if ahead_hit[k] else 0.0)
                table[ROW.SPEED, 0] = 0.0
            for i in range(vehicles):
                table[ROW.SPEED, at + i] = speeds[k, i]
                table[ROW.COMMAND, at + i] = candidates[k, c] if i == vehicle else command[k, i]
                table[ROW.MASS, at + i] = mass[k, i]
                table[ROW.LIMIT, at + i] = limit[k, i]
                table[ROW.ONSET, at + i] = onset_s(latency[k, i], time[k])
            for p in range(vehicles - 1):
                table[ROW.GAP, at + p] = gaps[k, p]
                table[ROW.HIT, at + p] = 1.0 if hit[k, p] else 0.0
            place_forces(table, in_force[k], brake_rate[k], release_rate[k], pieces[k])
            if advance_table(table, restitution[k], duration, 0.0, k, no_rows, 0)[1] != FLAG.DONE:
                failed[k] = True
                break
            for p in range(at + vehicles - 1):
                first[k, c] += table[ROW.FIRST_HARM, p]
                total[k, c] += table[ROW.TOTAL_HARM, p]


# The forecast of contacts: when the pairs of a line first meet under commands held constant, and how hard.
#
# The physics of ``advance``, on a table that somebody has filled; nothing of the motion is kept.


class _Contact(NamedTuple):
    """Rows of a forecast of the next impact of each pair."""

    TIME: int = 0  # from now to the first impact from now on (s); infinite: none
    CLOSING: int = 1  # its closing speed (m/s); 0: none
    WIDTH: int = 2


CONTACT = _Contact()


@compiled(apart=True)
def forecast_contacts(table: Floats, restitution: float, duration: float, found: Floats) -> int:
    """Take one world ``duration`` (s) on; its status. Fills ``found`` [CONTACT_ROWS, N], and the harm of the table.

    A pair that has had an impact before may have another first one from now on; in first-impact harm it counts no more.
    """
    for p in range(table.shape[1] - 1):
        found[CONTACT.TIME, p], found[CONTACT.CLOSING, p] = math.inf, 0.0
        table[ROW.FIRST_HARM, p] = 0.0
        table[ROW.TOTAL_HARM, p] = 0.0
        table[ROW.COUNT, p] = 0.0
    building = builds_up(table)
    if move_apart(table, duration, building):
        return FLAG.DONE
    start_events(table, building)
    no_rows, now = table[:0], 0.0
    for _ in range(BOUND.MOST_EVENTS):
        status, now = to_next_impact(table, restitution, now, duration, building)
        if status != FLAG.IMPACT:
            return status
        for p in range(table.shape[1] - 1):
            if table[ROW.STRUCK, p] == 1.0 and found[CONTACT.TIME, p] == math.inf:
                found[CONTACT.TIME, p], found[CONTACT.CLOSING, p] = now, table[ROW.CLOSING, p]
        record_impacts(table, now, 0, no_rows, 0)
    return FLAG.STUCK
