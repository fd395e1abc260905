"""Motion with brakes that build up: the force approaches the command at a constant rate, so gaps are cubic in time.

The argument ``table`` is one world in the layout of ``physics.rows``: a row per quantity, a column per vehicle or
pair.

The *force* of a vehicle (row FORCE) is the acceleration that its brakes or engine alone would cause at the moment. The
force falls at the rate BRAKE_RATE or rises at the rate RELEASE_RATE until it equals the command. Until the vehicle's
latency has elapsed, the force approaches 0 instead of the command. The force also changes while the vehicle is at rest.

A *body* is a vehicle, or several touching vehicles that move together. Between events each body has a constant jerk.
Two kinds of events occur in this module but not in ``physics.constant_motion``. In an event of the first kind, a force
reaches the command or passes 0. In an event of the second kind, touching vehicles separate, or a body that its brakes
held at rest starts to move.

*Closing* speed, acceleration and jerk of a pair are the value of the rear vehicle minus the value of the front vehicle.
"""

from __future__ import annotations

import math

from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND, contact
from ethbrake_marl.first_edition.physics.pieces import begin_piece, force_now, pieces_to_come
from ethbrake_marl.first_edition.physics.rows import ROW
from ethbrake_marl.first_edition.physics.state import Floats

_SAME_MPS2 = 5e-13  # touching vehicles with accelerations closer than this move as one body

_PARTS_LATE_S = 1e-9  # delay of a separation, so that rounding cannot undo it; error 1e-26 m

_PARTS_LATE_MPS2 = 1e-12  # smallest difference of accelerations at a separation


@compiled(bare=True)
def built_up(table: Floats) -> bool:
    """Return whether every vehicle's force equals its command, so that no force changes until a latency elapses.

    If a vehicle follows a fixed sequence of commands, the result is True only after the last of these commands has
    begun. If the result is True, ``constant_motion.move`` is exact.
    """
    built = True
    for i in range(table.shape[1]):
        built = built and table[ROW.FORCE, i] == table[ROW.COMMAND, i] * table[ROW.ACTIVE, i]
    return built and not pieces_to_come(table)


@compiled
def first_return(value: float, rate: float, jerk: float) -> float:
    """Return the first time t > 0 at which ``value + rate t + jerk t^2 / 2`` is 0, in s; infinite if there is none.

    For a speed, ``value`` is in m/s, ``rate`` in m/s2 and ``jerk`` in m/s3. The result is above 0 even if ``value`` is
    0.
    """
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
    """Return the gap (m) of a pair after the time t at constant closing jerk: ``g - (w + (b + j t / 3) t / 2) t``.

    Args:
        gap: present gap g, m.
        closing: present closing speed w, m/s.
        pressing: present closing acceleration b, m/s2.
        jerk: closing jerk j, m/s3.
        time: time t, s.

    """
    return gap - (closing + 0.5 * (pressing + jerk * time / 3.0) * time) * time


@compiled
def contact_within(gap: float, closing: float, pressing: float, jerk: float, end: float) -> tuple[float, float]:
    """Return time (s) and closing speed (m/s) of a pair's first contact before ``end`` (s); ``(inf, 0)`` if none.

    The arguments are as in ``gap_after``; ``motion.contact`` is the function for a constant closing acceleration. The
    closing speed ``w + b t + j t^2 / 2`` has at most two roots, and the gap is monotone between one root and the next.
    The contact lies in the first of these monotone intervals that ends with a gap of at most 0. Newton's method finds
    the time of the contact in this interval; a bisection step replaces a step that leaves the interval.
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
    """Write into the table how the force of vehicle ``i`` changes next: its rate, its goal and the time until the goal.

    The goal is the command ``wanted`` (m/s2), or 0 if the force changes its sign on the way to this command. The
    function writes the rows FORCE, FORCE_RATE, FORCE_TIME and FORCE_VALUE. If the force already equals the command,
    FORCE_TIME is infinite.
    """
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
    """Return the acceleration by a vehicle's own brakes or engine, forward and backward, and the rates of change.

    The result is ``(forward, backward, rate of forward, rate of backward)``: two accelerations in m/s2 and their rates
    in m/s3. ``forward`` and ``backward`` differ if the force depends on the direction of motion. For example, the
    brakes of a vehicle at rest act against motion in either direction (see ``motion.force_range``).

    Args:
        force: present acceleration by brakes or engine, m/s2.
        rate: rate at which the force changes, m/s3.
        speed: present speed, m/s.
        limit: speed up to which the vehicle drives, m/s.

    """
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
    """Return the acceleration (m/s2) and jerk (m/s3) of a body.

    The body's own forces allow every acceleration in the range ``[low, high]`` (m/s2), whose ends change at the rates
    ``low_jerk`` and ``high_jerk`` (m/s3). The body's acceleration is the value in ``[low, high]`` that is nearest to 0,
    as in ``motion.settle``.
    """
    if low > 0.0 or (low == 0.0 and low_jerk > 0.0):
        return low, low_jerk
    if high < 0.0 or (high == 0.0 and high_jerk < 0.0):
        return high, high_jerk
    return 0.0, 0.0


@compiled(apart=True, bare=True)
def pool_moving(table: Floats, first: int, last: int) -> float:
    """Set the accelerations and jerks of touching vehicles; return the time (s) until two of these vehicles separate.

    The vehicles are the columns ``first..last`` of ``table`` and have the same speed. If the acceleration of a vehicle
    is at least the acceleration of the vehicle in front, up to rounding, both vehicles move as one body. If the
    vehicles' own jerks differ, the body may separate later. If no vehicles of ``first..last`` separate, the result is
    infinite. The function writes the rows ACCELERATION, JERK and JOINED.
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
    """Write the common acceleration and jerk of the body in column ``block`` of the BLOCK rows into column ``out``.

    The BLOCK rows contain the mass of the body and the sums of mass times force and of mass times jerk.
    """
    mass = table[ROW.BLOCK_MASS, block]
    table[ROW.ACCELERATION, out], table[ROW.JERK, out] = settle_moving(
        table[ROW.BLOCK_LOW, block] / mass, table[ROW.BLOCK_HIGH, block] / mass,
        table[ROW.BLOCK_LOW_JERK, block] / mass, table[ROW.BLOCK_HIGH_JERK, block] / mass,
    )  # fmt: skip


@compiled(bare=True)
def parting_s(table: Floats, head: int, tail: int, value: float, jerk: float) -> float:
    """Return the time (s) until the vehicles ``head..tail`` stop moving as one body; infinite if they never do.

    A moving body splits when its front vehicles alone would accelerate more than the whole body. A body that its brakes
    hold at rest starts to move when its front vehicles drive away or when its rear vehicles would move backward.
    ``value`` is the acceleration of the body, m/s2, and ``jerk`` its jerk, m/s3.
    """
    soonest = math.inf
    held = value == 0.0 and jerk == 0.0
    forward = value > 0.0 or (value == 0.0 and jerk > 0.0)
    mass, force, rate = 0.0, 0.0, 0.0
    for i in range(head, tail + (1 if held else 0)):  # the front vehicles, up to i
        if table[ROW.MASS, i] == math.inf:
            mass = math.inf
            continue
        mass += table[ROW.MASS, i]
        side = ROW.FORCE_LOW if held or forward else ROW.FORCE_HIGH
        force += table[ROW.MASS, i] * table[side, i]
        rate += table[ROW.MASS, i] * table[side + ROW.LOW_JERK - ROW.FORCE_LOW, i]
        soonest = min(soonest, crossing_s(force / mass - value, rate / mass - jerk))
    mass, force, rate = 0.0, 0.0, 0.0
    for i in range(tail if held else head - 1, head - 1, -1):  # the rear vehicles, from i on
        if table[ROW.MASS, i] == math.inf:
            break
        mass += table[ROW.MASS, i]
        force += table[ROW.MASS, i] * table[ROW.FORCE_HIGH, i]
        rate += table[ROW.MASS, i] * table[ROW.HIGH_JERK, i]
        soonest = min(soonest, crossing_s(-force / mass, -rate / mass))
    return soonest


@compiled
def crossing_s(below: float, rate: float) -> float:
    """Return the time (s) after which the difference of two accelerations is positive; infinite if it never is.

    The present difference is ``below`` (m/s2), at most 0, and it grows at the rate ``rate`` (m/s3). The result is later
    than the exact time by a small delay. Without this delay, rounding could leave the difference at 0.
    """
    if rate <= 0.0:
        return math.inf
    return max(-below / rate, 0.0) + _PARTS_LATE_S + _PARTS_LATE_MPS2 / rate


@compiled(apart=True, bare=True)
def accelerate_moving(table: Floats) -> float:
    """Set the acceleration and jerk of every vehicle; return the time (s) until touching vehicles separate.

    If no touching vehicles separate, the result is infinite. The function also sets how each vehicle's force changes
    next and marks the pairs that move as one body (row JOINED). For brakes that act at once,
    ``constant_motion.accelerate`` replaces this function.
    """
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
    """Return the time from ``now`` to the next event, at most ``end - now`` (s).

    There is an event when a pair comes into contact or separates, a vehicle comes to rest or reaches its speed limit, a
    command takes effect, or a force reaches its command or passes 0. The function also writes into the table when each
    vehicle next comes to rest or reaches its speed limit, and when each pair next comes into contact. For brakes that
    act at once, ``constant_motion.next_event`` replaces this function.

    Args:
        table: one world to which ``accelerate_moving`` has been applied.
        now: present time, counted from the start of the segment, s.
        end: end of the segment, s.
        parting: time until touching vehicles separate (the result of ``accelerate_moving``), s.

    """
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
        most = (abs(rate) + abs(jerk) * soonest) * soonest  # largest possible change of speed
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
            if most * soonest >= gap:  # otherwise the gap cannot close before the next event
                time, speed = contact_within(gap, closing, pressing, jerk, soonest)
        table[ROW.CONTACT_TIME, p] = time
        table[ROW.CONTACT_SPEED, p] = speed
        soonest = min(soonest, time)
    return soonest


@compiled(apart=True, bare=True)
def move_on_cubics(table: Floats, duration: float) -> bool:
    """Move gaps, speeds and forces to the next event, ``duration`` (s) later; return False if a contact was missed.

    For brakes that act at once, ``constant_motion.move`` replaces this function.
    """
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
    """Move all vehicles for ``duration`` (s) and return True, or return False if two vehicles may touch.

    If the result is False, speeds and gaps are unchanged. Two neighbours cannot touch if their gap exceeds ``duration``
    times their largest possible closing speed. For brakes that act at once, ``segment.move_apart`` replaces this
    function.
    """
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
    """Move vehicle ``i`` as if it were alone for ``duration`` (s); return its lowest and highest speed (m/s).

    The command ``wanted`` (m/s2, negative brakes) is constant. When the function is called, row SPEED_VALUE must
    contain the vehicle's present speed. The function updates the rows SPEED_VALUE and FORCE, and adds the distance that
    the vehicle travels to row WAY.
    """
    speed = table[ROW.SPEED_VALUE, i]
    force = force_now(table[ROW.FORCE, i], wanted, table[ROW.BRAKE_RATE, i], table[ROW.RELEASE_RATE, i])
    rate, building = 0.0, 0.0  # rate (m/s3) and duration (s) of the force's move to the command
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
    """Do the work of ``move_alone`` for a vehicle that may come to rest or reach its speed limit, event by event."""
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
        built = table[ROW.FORCE_TIME, i] <= passed
        table[ROW.FORCE, i] = table[ROW.FORCE_VALUE, i] if built else force + rate * passed
        slowest, fastest = min(slowest, speed), max(fastest, speed)
        now = duration if passed >= duration - now else now + passed
    table[ROW.SPEED_VALUE, i] = speed
    return slowest, fastest
