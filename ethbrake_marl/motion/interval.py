"""Motion of one line of bodies through an interval of constant commands, from event to event.

``builds`` says whether the force of some body follows its command at a finite rate. Between two events the jerk of
every body is constant. If ``builds`` is False, the jerk is 0; where ``builds`` is the constant False, the compiler
drops the jerk. ``ahead`` is the first body that takes part: the obstacle (0), or Vehicle 1 (1) if there is no obstacle.
Times within an interval count from its start.
"""

from __future__ import annotations

import math

from ethbrake_marl.motion.compiling import kernel, large, part
from ethbrake_marl.motion.contact import contact, contact_on_cubic, first_return, gap_after
from ethbrake_marl.motion.forces import (
    ROUNDING_S,
    acts,
    brakes_fully,
    driving,
    force_now,
    force_range,
    is_full,
    plan_force,
    settle,
)
from ethbrake_marl.motion.impact import note_foreign, pool, resolve_impacts
from ethbrake_marl.motion.layout import (
    ACCELERATION,
    ACTIVE,
    BRAKE_RATE,
    COMMAND,
    CONTACT_SPEED,
    CONTACT_TIME,
    DROVE,
    EASED,
    FAR_M,
    FIRST,
    FORCE,
    FORCE_GOAL,
    FORCE_RATE,
    FORCE_TIME,
    FOREIGN,
    FRONT_CHANGE,
    GAP,
    HIGH,
    HIGH_JERK,
    IMPACTS,
    JERK,
    JOINED,
    LAST_TIME,
    LATENCY,
    LIMIT,
    LOW,
    LOW_JERK,
    MASS,
    NEW_FIRST,
    NEW_IMPACTS,
    NEW_TOTAL,
    NEXT_CLOSING,
    NEXT_TIME,
    ONSET,
    REAR_CHANGE,
    RELEASE_RATE,
    SPEED,
    SPEED_GOAL,
    SPEED_TIME,
    TOTAL,
    WAY,
)
from ethbrake_marl.motion.push import add_push

# what `move_line` returns
NO_CONTACT = 0  # no two bodies could touch
EVENT_BY_EVENT = 1  # went from event to event; if nothing touched, what contacts changed is 0
FAILED = 2  # a check of the physics failed: never the user's fault
STOPPED = 3  # stopped after an impact, because `exceeds` was true

MISSED_M = 1e-9  # a gap below minus this means that a contact was missed
MOST_EVENTS = 1_000_000  # more events of an interval mean a defect (the most ever seen: 160,000)
LATE_S, LATE_MPS2 = 1e-9, 1e-12  # delay of a parting, so that rounding cannot undo it (1e-26 m)


@kernel
def crossing_s(below, rate):
    """Time (s) until a value that is now ``below`` (m/s2, at most 0) and grows at ``rate`` (m/s3) is surely above 0."""
    return math.inf if rate <= 0.0 else max(-below / rate, 0.0) + LATE_S + LATE_MPS2 / rate


@part
def parting_s(car, scratch, head, tail):
    """Time (s) until the bodies ``head..tail``, which move as one block, part or start to move; infinite: never.

    A moving block splits when its front bodies alone would accelerate more than the whole block. A block that its
    brakes hold at rest starts to move when its front bodies drive away, or when its rear bodies would move backward.
    """
    value, jerk, soonest = scratch[ACCELERATION, head], scratch[JERK, head], math.inf
    held = value == 0.0 and jerk == 0.0
    forward = value > 0.0 or (value == 0.0 and jerk > 0.0)
    side, side_jerk = (LOW, LOW_JERK) if held or forward else (HIGH, HIGH_JERK)
    mass, force, rate = 0.0, 0.0, 0.0
    for i in range(head, tail + (1 if held else 0)):  # the front bodies, up to i
        if car[MASS, i] == math.inf:
            mass = math.inf
            continue
        mass += car[MASS, i]
        force += car[MASS, i] * scratch[side, i]
        rate += car[MASS, i] * scratch[side_jerk, i]
        soonest = min(soonest, crossing_s(force / mass - value, rate / mass - jerk))
    mass, force, rate = 0.0, 0.0, 0.0
    for i in range(tail if held else head - 1, head - 1, -1):  # the rear bodies, from i on
        if car[MASS, i] == math.inf:
            break
        mass += car[MASS, i]
        force += car[MASS, i] * scratch[HIGH, i]
        rate += car[MASS, i] * scratch[HIGH_JERK, i]
        soonest = min(soonest, crossing_s(-force / mass, -rate / mass))
    return soonest


@kernel
def accelerate(line, car, scratch, ahead, builds):
    """Set acceleration and jerk of every body, and which pairs move as one; return the time (s) until a pair parts."""
    bodies, soonest, first = line.shape[1], math.inf, ahead
    for i in range(ahead, bodies):
        plan_force(line, car, scratch, i, builds)
        scratch[LOW, i], scratch[HIGH, i], scratch[LOW_JERK, i], scratch[HIGH_JERK, i] = force_range(
            line[FORCE, i], scratch[FORCE_RATE, i] if builds else 0.0, line[SPEED, i], car[LIMIT, i]
        )
    while first < bodies:
        last = first
        while last < bodies - 1 and line[GAP, last] <= 0.0 and line[SPEED, last] == line[SPEED, last + 1]:
            last += 1
        if last == first:
            scratch[ACCELERATION, first], scratch[JERK, first] = settle(
                scratch[LOW, first],
                scratch[HIGH, first],
                scratch[LOW_JERK, first] if builds else 0.0,
                scratch[HIGH_JERK, first] if builds else 0.0,
            )
        else:
            pool(
                car[MASS], scratch[LOW], scratch[HIGH], scratch[LOW_JERK], scratch[HIGH_JERK], scratch, first, last,
                scratch[ACCELERATION], scratch[JERK],
            )  # fmt: skip
            head = first
            for p in range(first, last + 1):
                same = scratch[ACCELERATION, p] == scratch[ACCELERATION, p + 1] if p < last else False
                same = same and scratch[JERK, p] == scratch[JERK, p + 1]
                scratch[JOINED, p] = 1.0 if same else 0.0
                if not same:
                    if builds and p > head:
                        soonest = min(soonest, parting_s(car, scratch, head, p))
                    head = p + 1
        scratch[JOINED, last] = 0.0
        first = last + 1
    return soonest


@kernel
def next_event(line, car, scratch, now, end, parting, ahead, builds):
    """Write the time (s) to the next event of every body and pair; return the time to the first, at most ``end - now``.

    Events: two bodies make contact or part (``parting`` s from now); a body comes to rest or reaches its speed limit; a
    command takes effect; a force reaches its command or 0.
    """
    bodies, soonest = line.shape[1], min(end - now, parting)
    for i in range(ahead, bodies):
        if builds:
            soonest = min(soonest, scratch[FORCE_TIME, i])
        if scratch[ACTIVE, i] == 0.0:
            soonest = min(soonest, scratch[ONSET, i] - now)
    for i in range(ahead, bodies):
        rate, jerk, goal = scratch[ACCELERATION, i], scratch[JERK, i] if builds else 0.0, 0.0
        time = first_return(line[SPEED, i], rate, jerk)
        if line[FORCE, i] > 0.0 or (builds and scratch[FORCE_RATE, i] > 0.0):
            reach = first_return(line[SPEED, i] - car[LIMIT, i], rate, jerk)
            if reach < time:
                time, goal = reach, car[LIMIT, i]
        scratch[SPEED_TIME, i], scratch[SPEED_GOAL, i] = time, goal
        soonest = min(soonest, time)
    for p in range(ahead, bodies - 1):
        time, speed = math.inf, 0.0
        if scratch[JOINED, p] == 0.0:
            closing = line[SPEED, p + 1] - line[SPEED, p]
            pressing = scratch[ACCELERATION, p + 1] - scratch[ACCELERATION, p]
            jerk = scratch[JERK, p + 1] - scratch[JERK, p] if builds else 0.0
            if jerk == 0.0:
                time, speed = contact(line[GAP, p], closing, pressing)
            else:
                time, speed = contact_on_cubic(line[GAP, p], closing, pressing, jerk, soonest)
        scratch[CONTACT_TIME, p], scratch[CONTACT_SPEED, p] = time, speed
        soonest = min(soonest, time)
    return soonest


@kernel
def move(line, scratch, duration, ahead, builds):
    """Move gaps, speeds and forces to the next event, ``duration`` (s) later; return False if a contact was missed.

    Values at the event are set exactly: a gap to 0 at contact, a speed to 0 or to the limit, a force to its goal, and
    the speed of the rear body of a contact to the front body's speed plus the closing speed.
    """
    bodies, sound, first = line.shape[1], True, ahead
    for p in range(ahead, bodies - 1):
        if scratch[CONTACT_TIME, p] <= duration:
            line[GAP, p] = 0.0
            continue
        scratch[CONTACT_SPEED, p] = 0.0
        if scratch[JOINED, p] == 0.0:
            closing = line[SPEED, p + 1] - line[SPEED, p]
            pressing = scratch[ACCELERATION, p + 1] - scratch[ACCELERATION, p]
            jerk = scratch[JERK, p + 1] - scratch[JERK, p] if builds else 0.0
            after = gap_after(line[GAP, p], closing, pressing, jerk, duration)
            sound = sound and after >= -MISSED_M
            line[GAP, p] = max(after, 0.0)
    while first < bodies:
        jerk = scratch[JERK, first] if builds else 0.0
        value = line[SPEED, first] + (scratch[ACCELERATION, first] + 0.5 * jerk * duration) * duration
        last = first
        if scratch[SPEED_TIME, first] <= duration:
            value = scratch[SPEED_GOAL, first]
        while scratch[JOINED, last] == 1.0:
            last += 1
            if scratch[SPEED_TIME, last] <= duration:
                value = scratch[SPEED_GOAL, last]
        if first > ahead and scratch[CONTACT_SPEED, first - 1] > 0.0:
            value = line[SPEED, first - 1] + scratch[CONTACT_SPEED, first - 1]
        for i in range(first, last + 1):
            line[SPEED, i] = value
        first = last + 1
    for i in range(ahead if builds else bodies, bodies):
        if scratch[FORCE_TIME, i] <= duration:
            line[FORCE, i] = scratch[FORCE_GOAL, i]
        else:
            line[FORCE, i] += scratch[FORCE_RATE, i] * duration
    return sound


@kernel
def solo(speed, command, onset, limit, duration):
    """Speed (m/s) at the end, distance (m) and acceleration (m/s2) of a vehicle that touches nothing.

    The vehicle coasts until ``onset`` (s), then brakes to rest or drives up to ``limit`` (m/s), for ``duration`` (s) in
    all. ``speed`` is at least 0. The acceleration is NaN if it changes within this time.
    """
    way, steady = 0.0, command
    if onset > 0.0:
        if onset >= duration or command == 0.0:
            return speed, speed * duration, 0.0
        way, duration, steady = speed * onset, duration - onset, math.nan
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


@kernel
def move_apart(line, car, scratch, duration, ahead, builds):
    """Move the line through the whole interval at once if surely no two bodies touch; return whether it was moved.

    Without contact a speed only rises or only falls within the interval. So a gap shrinks by at most ``duration`` (s)
    times (largest rear speed minus smallest front speed). Where this bound reaches the gap, ``contact`` decides, if
    both accelerations are constant; if not, the line is not moved. It is not moved either if a force changes within the
    interval or a body moves backward.
    """
    bodies, slowest, front = line.shape[1], math.inf, 0.0
    for i in range(ahead, bodies):
        speed, command, onset = line[SPEED, i], scratch[COMMAND, i], scratch[ONSET, i]
        if speed < 0.0:
            return False
        if builds and min(car[BRAKE_RATE, i], car[RELEASE_RATE, i]) < math.inf:
            acting = acts(onset, duration)
            if line[FORCE, i] != (command if acting else 0.0) or (acting and onset > 0.0):
                return False
        if line[EASED, i] == 0.0 and acts(onset, duration) and not is_full(command, car, i):
            line[EASED, i] = 1.0
        after, way, steady = solo(speed, command, onset, car[LIMIT, i], duration)
        scratch[SPEED_GOAL, i], scratch[WAY, i] = after, way
        if i > ahead:
            closing = max(speed, after) - slowest
            if closing > 0.0 and closing * duration >= line[GAP, i - 1]:
                closing, pressing = speed - line[SPEED, i - 1], steady - front
                if math.isnan(pressing) or (line[GAP, i - 1] <= 0.0 and closing >= 0.0):
                    return False
                if contact(line[GAP, i - 1], closing, pressing)[0] <= duration:
                    return False
        slowest, front = min(speed, after), steady
    for i in range(ahead, bodies):
        if line[FOREIGN, i] > 0.0:
            note_foreign(line, i, 0.0, scratch[SPEED_GOAL, i])
        line[SPEED, i] = scratch[SPEED_GOAL, i]
    for p in range(ahead, bodies - 1):
        line[GAP, p] = max(line[GAP, p] + (scratch[WAY, p] - scratch[WAY, p + 1]), 0.0)
    return True


@part
def note_history(line, car, scratch, duration, ahead):
    """Update the rows EASED and FOREIGN for the ``duration`` (s) until the next event."""
    for i in range(ahead, line.shape[1]):
        if duration > ROUNDING_S and scratch[ACTIVE, i] == 1.0 and not brakes_fully(line, car, scratch, i):
            line[EASED, i] = 1.0
        change = (scratch[ACCELERATION, i] + 0.5 * scratch[JERK, i] * duration) * duration
        own = (scratch[LOW, i] + 0.5 * scratch[LOW_JERK, i] * duration) * duration
        note_foreign(line, i, change - own, line[SPEED, i] + change)


@kernel
def through_interval(line, car, scratch, start, until, ahead, builds, exceeds, limit):
    """Move one line as ``move_line`` does: at once if no two bodies touch, otherwise from event to event.

    ``builds`` must be the constant True or False (module docstring).
    """
    bodies, duration, outcome, now = line.shape[1], until - start, NO_CONTACT, 0.0
    for i in range(ahead, bodies):
        scratch[ONSET, i] = car[LATENCY, i] - start
        scratch[ACTIVE, i] = 1.0 if scratch[ONSET, i] <= 0.0 else 0.0
        if (
            builds
            and min(car[BRAKE_RATE, i], car[RELEASE_RATE, i]) < math.inf
            and not acts(scratch[ONSET, i], duration)
        ):
            scratch[ONSET, i] = max(scratch[ONSET, i], duration)
    if not move_apart(line, car, scratch, duration, ahead, builds):
        for i in range(ahead, bodies):
            scratch[CONTACT_SPEED, i] = scratch[NEW_FIRST, i] = scratch[NEW_TOTAL, i] = scratch[NEW_IMPACTS, i] = 0.0
            scratch[NEXT_TIME, i], scratch[NEXT_CLOSING, i], scratch[LAST_TIME, i] = math.inf, 0.0, math.inf
            scratch[FRONT_CHANGE, i] = scratch[REAR_CHANGE, i] = 0.0
        outcome = FAILED
        for _ in range(MOST_EVENTS):
            if resolve_impacts(line, car, scratch, now, ahead):
                if exceeds is not None and exceeds(line, scratch, limit):
                    outcome = STOPPED
                    break
                continue
            if now >= duration:
                outcome = EVENT_BY_EVENT
                break
            parting = accelerate(line, car, scratch, ahead, builds)
            time_to_event = next_event(line, car, scratch, now, duration, parting, ahead, builds)
            add_push(line, car, scratch, time_to_event, ahead, builds)
            note_history(line, car, scratch, time_to_event, ahead)
            if not move(line, scratch, time_to_event, ahead, builds):
                break
            for i in range(ahead, bodies):
                if scratch[ONSET, i] - now <= time_to_event:
                    scratch[ACTIVE, i] = 1.0
            now = duration if time_to_event >= duration - now else now + time_to_event
        for p in range(ahead, bodies - 1):
            line[FIRST, p] += scratch[NEW_FIRST, p]
            line[TOTAL, p] += scratch[NEW_TOTAL, p]
            line[IMPACTS, p] += scratch[NEW_IMPACTS, p]
    for i in range(ahead, bodies):
        command = scratch[COMMAND, i] if acts(car[LATENCY, i], until) else 0.0
        line[FORCE, i] = (
            force_now(line[FORCE, i], command, car[BRAKE_RATE, i], car[RELEASE_RATE, i]) if builds else command
        )
    return outcome


@part
def through_interval_building(line, car, scratch, start, until, ahead, exceeds, limit):
    """``through_interval`` for a line in which some force follows its command at a finite rate."""
    return through_interval(line, car, scratch, start, until, ahead, True, exceeds, limit)


@kernel
def note_driving(line, car, wanted, start, until):
    """Add the speed that each vehicle's engine alone gives from ``start`` to ``until`` (s) to the row DROVE.

    ``line`` is the line at ``start``; ``wanted`` [N + 1] are the commands (m/s2). The speed that the engine gives
    depends only on the vehicle's own force and command: no contact makes driving free.
    """
    for i in range(1, line.shape[1]):
        if wanted[i] > 0.0 or line[FORCE, i] > 0.0:
            onset = max(car[LATENCY, i] - start, 0.0) if acts(car[LATENCY, i] - start, until - start) else until - start
            before, force = driving(line[FORCE, i], 0.0, car[BRAKE_RATE, i], car[RELEASE_RATE, i], onset)
            after, _ = driving(force, wanted[i], car[BRAKE_RATE, i], car[RELEASE_RATE, i], until - start - onset)
            line[DROVE, i - 1] += before + after


@kernel
def move_line(line, car, wanted, scratch, start, until, exceeds=None, limit=None):
    """Move one line from ``start`` to ``until`` (s after the alert) under the commands ``wanted`` [N + 1] (m/s2).

    A command has no effect before the body's latency has elapsed. Changes ``line``; returns ``NO_CONTACT``,
    ``EVENT_BY_EVENT`` or ``FAILED``. Unless the result is ``NO_CONTACT``, ``scratch`` then holds the harm of this
    interval (rows NEW), the first impact of each pair (rows NEXT) and the largest changes of speed by an impact (rows
    CHANGE). If the kernel ``exceeds(line, scratch, limit)`` is true after an impact, the line stops there, and the
    result is ``STOPPED``; None never stops it, and the compiler drops the question.
    """
    ahead, builds = 0 if line[GAP, 0] < FAR_M else 1, False
    for i in range(line.shape[1]):
        scratch[COMMAND, i] = wanted[i]
        builds = builds or min(car[BRAKE_RATE, i], car[RELEASE_RATE, i]) < math.inf
    scratch[NEW_FIRST, 0] = scratch[NEW_TOTAL, 0] = scratch[NEW_IMPACTS, 0] = 0.0
    note_driving(line, car, wanted, start, until)
    if builds:
        return through_interval_building(line, car, scratch, start, until, ahead, exceeds, limit)
    return through_interval(line, car, scratch, start, until, ahead, False, exceeds, limit)


@kernel
def is_line_of_three(line, car, wanted, scratch):
    """Whether arrays of n worlds (``scratch``: of one call) belong to lines of three vehicles.

    Where this is True, the number of bodies is a constant for the compiler: it unrolls loops, and addresses are sums of
    constants. So kernels that are called often contain their text twice, with this condition before the first.
    """
    return line.shape[2] == 4 and car.shape[2] == 4 and wanted.shape[1] == 4 and scratch.shape[1] == 4


@large
def move_lines(line, car, time, until, wanted, scratch):
    """Move n worlds from ``time`` to ``until`` (s, [n] each), in place; return the index of a failed world, or -1.

    ``line``, ``car`` and ``wanted`` are those of ``move_line`` for n worlds, [n, ...]. A world fails if a check of the
    physics fails.
    """
    failed = -1
    for k in range(len(until)):
        if move_line(line[k], car[k], wanted[k], scratch, time[k], until[k]) == FAILED:
            failed = k
    return failed
