"""One world through one segment of constant command: apart in closed form, else event by event.

Most segments bring no two vehicles near each other; each vehicle then moves on its own (``move_apart``). When two may
meet, touch or rest against each other, the world goes from event to event (``to_next_impact``). Both work on the
table of one world whose first rows ``impact`` names.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.physics.compiled import compiled, compiled_bare
from ethbrake_marl.physics.worlds import Bools, Floats, Vehicles, Worlds, sum_rows, vehicles_at_once

# Closed-form times of the events that end a segment of constant acceleration.
#
# Between events every quantity is a quadratic in time, so the first event is found exactly and none is missed.
# Only + - * / and sqrt are used: the same world gives the same bits in any batch.

TOUCH_SPEED_MPS = 1e-5  # a contact at or below this closing speed is a touch: no impact, no harm
PLASTIC_SPEED_MPS = 0.05  # a cluster whose largest closing speed is below this does not bounce


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
def stopping_distances(speed: Floats, latency_left: Floats, capacity: Floats) -> Floats:
    """``stopping_distance`` of n vehicles, each [n]."""
    distance = np.empty(len(speed))
    for k in range(len(speed)):
        distance[k] = stopping_distance(speed[k], latency_left[k], capacity[k])
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

# per vehicle
SPEED = 0
MASS = 1
BEFORE = 2  # speed before an impact
POOLED = 3
# per pair
GAP = 4
CLOSING = 5  # closing speed before an impact, 0 where the pair does not touch
CONTACT_SPEED = 6  # exact closing speed of a pair that has just met, else 0
STRUCK = 7  # 1 where the last round was an impact (not a touch)
# per pooled block
BLOCK_MASS = 8
BLOCK_LOW = 9
BLOCK_HIGH = 10
BLOCK_FIRST = 11
IMPACT_ROWS = 12


@compiled_bare
def pool(table: Floats, low: int, high: int, first: int, last: int, out: int) -> int:
    """Mass-weighted isotonic regression of vehicles ``first..last`` (inclusive) into row ``out``; the number of blocks.

    Rows ``low`` and ``high`` bound each vehicle's own value (equal for an ordinary one). All members of a pooled
    block get the same bits. Rows BLOCK_* describe the blocks. A vehicle of infinite mass (``obstacle``) stands, and
    so does its block.
    """
    count = 0
    for i in range(first, last + 1):
        mass = table[MASS, i]
        table[BLOCK_MASS, count] = mass
        table[BLOCK_LOW, count] = mass * table[low, i] if mass < math.inf else 0.0
        table[BLOCK_HIGH, count] = mass * table[high, i] if mass < math.inf else 0.0
        table[BLOCK_FIRST, count] = i
        top = count + first
        table[out, top] = settle(table[low, i], table[high, i])
        while count > 0 and table[out, top] > table[out, top - 1]:
            count -= 1
            top -= 1
            table[BLOCK_MASS, count] += table[BLOCK_MASS, count + 1]
            table[BLOCK_LOW, count] += table[BLOCK_LOW, count + 1]
            table[BLOCK_HIGH, count] += table[BLOCK_HIGH, count + 1]
            mass = table[BLOCK_MASS, count]
            table[out, top] = settle(table[BLOCK_LOW, count] / mass, table[BLOCK_HIGH, count] / mass)
        count += 1
    member = last
    for k in range(count - 1, -1, -1):
        value = table[out, k + first]
        while member >= table[BLOCK_FIRST, k]:
            table[out, member] = value
            member -= 1
    return count


@compiled_bare
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
        largest = max(largest, table[CLOSING, p])
    bounce = restitution if largest >= PLASTIC_SPEED_MPS else 0.0
    end = last + 1
    for block in range(pool(table, SPEED, SPEED, first, last, POOLED) - 1, -1, -1):
        head = int(table[BLOCK_FIRST, block])
        pooled = table[POOLED, head]
        if table[BLOCK_MASS, block] < math.inf:
            rest = 0.0
            for i in range(head, end):
                rest += table[MASS, i] * (table[SPEED, i] - pooled)
            pooled += rest / table[BLOCK_MASS, block]
        for i in range(head, end):
            table[SPEED, i] = pooled + bounce * (pooled - table[SPEED, i])
        end = head
    if bounce == 0.0:
        for i in range(first + 1, last + 1):
            table[SPEED, i] = min(table[SPEED, i], table[SPEED, i - 1])


@compiled_bare
def resolve_impacts(table: Floats, restitution: float) -> bool:
    """One round of impacts of one world: every cluster that holds an approaching pair, once. False if there is none.

    Rows CLOSING, BEFORE and STRUCK tell what happened. CONTACT_SPEED is used up.
    """
    pairs = table.shape[1] - 1
    approaching = False
    for p in range(pairs):
        closing = 0.0
        if table[GAP, p] <= 0.0:
            closing = table[CONTACT_SPEED, p]
            if closing == 0.0:
                closing = table[SPEED, p + 1] - table[SPEED, p]
        table[CLOSING, p] = closing
        approaching = approaching or closing > 0.0
    if not approaching:
        return False
    for i in range(pairs + 1):
        table[BEFORE, i] = table[SPEED, i]
    first = 0
    while first < pairs:
        last = first
        approaching = False
        while last < pairs and table[GAP, last] <= 0.0:
            approaching = approaching or table[CLOSING, last] > 0.0
            last += 1
        if approaching:
            resolve_cluster(table, restitution, first, last)
        first = last + 1
    for p in range(pairs):
        table[CONTACT_SPEED, p] = 0.0
        table[STRUCK, p] = 1.0 if table[CLOSING, p] > TOUCH_SPEED_MPS else 0.0
    return True


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


# The obstacle ahead of Vehicle 1, for the kernels: one more vehicle in front, which stands and which nothing moves.
#
# Its mass is infinite. In the regression P of a cluster that touches it, and of touching vehicles that press against
# it,
# it therefore stays at 0, and P is the regression of the vehicles alone bounded above by 0: ``min(P, 0)``. Contact,
# touch, plastic impacts and first impacts follow the rules of any pair, to the same bits. The added vehicle exists
# inside
# the physics only; everybody else keeps the numbers of the vehicles, and the obstacle has columns of its own.

UNMOVABLE_T = math.inf
FAR_AWAY_M = 1e300  # stands for no obstacle where others of a batch have one: nothing comes near, no bit changes


def obstacle_ahead(worlds: Worlds) -> Bools:
    """Which worlds have an obstacle ahead of Vehicle 1, [n]."""
    return np.isfinite(worlds.obstacle_gap_m)


def with_obstacle(worlds: Worlds) -> Worlds:
    """These worlds, all with an obstacle ahead, with that obstacle as vehicle 0 and every other vehicle one later."""
    vehicles = worlds.vehicles
    written_out = vehicles_at_once(  # inside the physics nobody observes
        ahead(0.0, vehicles.braking_capacity_mps2),
        ahead(0.0, vehicles.driving_capacity_mps2),
        ahead(0.0, vehicles.latency_s),
        ahead(UNMOVABLE_T, vehicles.mass_t),
        ahead(0.0, vehicles.speed_limit_mps),
        vehicles.restitution,
    )
    return Worlds(
        written_out,
        np.concatenate([worlds.obstacle_gap_m[:, np.newaxis], worlds.gaps_m], axis=1),
        ahead(0.0, worlds.speeds_mps),
        worlds.time_s,
        np.concatenate([worlds.obstacle_hit[:, np.newaxis], worlds.pair_hit], axis=1),
        ahead(0.0, worlds.command_mps2),
        np.full(worlds.n, np.inf),
        np.zeros(worlds.n, np.bool_),
        worlds.messages,
    )


def without_obstacle(written_out: Worlds, vehicles: Vehicles) -> Worlds:
    """Back from ``with_obstacle``: the obstacle's columns beside those of the pairs; ``vehicles`` are the real ones."""
    return replace(
        written_out,
        vehicles=vehicles,
        gaps_m=written_out.gaps_m[:, 1:].copy(),
        speeds_mps=written_out.speeds_mps[:, 1:].copy(),
        pair_hit=written_out.pair_hit[:, 1:].copy(),
        command_mps2=written_out.command_mps2[:, 1:].copy(),
        obstacle_gap_m=written_out.gaps_m[:, 0].copy(),
        obstacle_hit=written_out.pair_hit[:, 0].copy(),
    )


def with_post_ahead(worlds: Worlds, duration_s: Floats) -> Worlds:
    """These worlds, each with an obstacle ahead: its own, or one that Vehicle 1 cannot reach in ``duration_s`` [n].

    Worlds know gaps and speeds, no places. Such a post makes the way of Vehicle 1 the change of one more gap, and
    changes no motion.
    """
    out_of_reach = _farthest(worlds, duration_s) + 1.0
    return replace(worlds, obstacle_gap_m=np.where(obstacle_ahead(worlds), worlds.obstacle_gap_m, out_of_reach))


def _farthest(worlds: Worlds, duration_s: Floats) -> Floats:
    """More than Vehicle 1 can travel, [n] m: ``T sqrt(2 E / m_1)``, had it all the energy E the line can ever have.

    Impacts and brakes only take energy; driving adds at most ``m a v`` per second, and never above the speed limit.
    """
    vehicles = worlds.vehicles
    driving = vehicles.driving_capacity_mps2 * vehicles.speed_limit_mps * duration_s[:, np.newaxis]
    energy = sum_rows(vehicles.mass_t * (worlds.speeds_mps * worlds.speeds_mps / 2.0 + driving))
    farthest: Floats = 1.01 * duration_s * np.sqrt(2.0 * energy / vehicles.mass_t[:, 0])
    return farthest


def ahead(value: float, columns: Floats) -> Floats:
    """The columns of the vehicles [n, N] with one more in front, [n, N + 1]."""
    added: NDArray[np.float64] = np.concatenate([np.full((len(columns), 1), value), columns], axis=1)
    return added


@compiled
def place_obstacle(table: Floats, gap: float, hit: float) -> None:
    """Write the obstacle into column 0 of a world's table; its speed and command are the zeros of a new table."""
    table[MASS, 0] = UNMOVABLE_T
    table[GAP, 0] = gap
    table[HIT, 0] = hit
