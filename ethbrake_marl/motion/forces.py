"""Force of a body, and its acceleration when it moves freely or is pushed.

The *force* is the acceleration (m/s2) that brakes or engine alone would cause; negative brakes. It changes towards the
command at the vehicle's rates (m/s3), and jumps where a rate is infinite. It also changes while the vehicle is at rest.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.motion.compiling import kernel, large, part
from ethbrake_marl.motion.layout import (
    ACTIVE,
    BRAKE_RATE,
    BRAKING,
    COMMAND,
    FORCE,
    FORCE_GOAL,
    FORCE_RATE,
    FORCE_TIME,
    RELEASE_RATE,
    Floats,
)

FULL_MPS2 = 1e-5  # a force this near to the braking capacity is full: searches round commands
ROUNDING_S = 1e-9  # an onset this shortly before the end of an interval is at its end


@kernel
def acts(latency, time):
    """Whether a command takes effect before ``time``. At ``time`` the next decision already replaces the command.

    ``latency`` is when the command takes effect; both times (s) count from the same moment.
    """
    return latency <= 0.0 or latency < time - ROUNDING_S


@kernel
def force_now(force, command, brake_rate, release_rate):
    """Force (m/s2) just after the ``command`` (m/s2) has taken effect.

    If the rate (m/s3) towards the command is infinite, the new force is the command, otherwise still ``force`` (m/s2).
    """
    return command if math.isinf(brake_rate if command < force else release_rate) else force


@part
def driving(force, command, brake_rate, release_rate, duration):
    """Speed (m/s) that the engine alone gives in ``duration`` (s), and the force (m/s2) at the end.

    The speed is the integral of the force where it is positive. The force goes from ``force`` to ``command`` (m/s2) at
    the rate (m/s3) in that direction, then stays constant.
    """
    if duration <= 0.0:
        return 0.0, force
    rate = -brake_rate if command < force else release_rate
    ramp, after = (command - force) / rate, command
    if ramp > duration:
        ramp, after = duration, force + rate * duration
    high, low, speed = max(force, after), min(force, after), max(command, 0.0) * (duration - ramp)
    if high > 0.0 and ramp > 0.0:
        speed += 0.5 * (high + low) * ramp if low >= 0.0 else 0.5 * high * high / abs(rate)
    return speed, after


@kernel
def capacity(car, row, i):
    """Largest deceleration (``row`` BRAKING) or forward acceleration (DRIVING) of body i, m/s2."""
    return car[row, i]


def capacities(car: Floats, row: int) -> Floats:
    """Largest deceleration (``row`` BRAKING) or forward acceleration (DRIVING) of all bodies, [n, N + 1] m/s2."""
    return car[:, row]


@kernel
def is_full(force, car, i):
    """Whether a ``force`` or command (m/s2) of body i is full braking."""
    return force <= FULL_MPS2 - capacity(car, BRAKING, i)


@kernel
def brakes_fully(line, car, scratch, i):
    """Whether body i brakes with full force, and keeps it until its command changes."""
    command = scratch[COMMAND, i] * scratch[ACTIVE, i]
    force = force_now(line[FORCE, i], command, car[BRAKE_RATE, i], car[RELEASE_RATE, i])
    return is_full(command, car, i) and is_full(force, car, i)


@kernel
def plan_force(line, car, scratch, i, builds):
    """Set how the force of body i changes: its rate, its next goal, and the time until the goal (rows of ``scratch``).

    The goal is the command, or 0 if the force changes its sign on the way: at force 0 the body may start to move.
    """
    command = scratch[COMMAND, i] * scratch[ACTIVE, i]
    force = force_now(line[FORCE, i], command, car[BRAKE_RATE, i], car[RELEASE_RATE, i]) if builds else command
    line[FORCE, i], scratch[FORCE_RATE, i], scratch[FORCE_TIME, i] = force, 0.0, math.inf
    if builds and command != force:
        rate = -car[BRAKE_RATE, i] if command < force else car[RELEASE_RATE, i]
        goal = 0.0 if force < 0.0 < command or command < 0.0 < force else command
        scratch[FORCE_RATE, i], scratch[FORCE_TIME, i], scratch[FORCE_GOAL, i] = rate, (goal - force) / rate, goal


@kernel
def force_range(force, rate, speed, limit):
    """``(forward, backward, rate of forward, rate of backward)`` of the acceleration by a body's own force.

    ``forward`` is the acceleration (m/s2) if the body is about to move forward, ``backward`` if it is about to move
    backward; their rates are in m/s3. The two differ in two cases: brakes at rest act against motion in either
    direction; a vehicle that drives at its speed limit uses only as much force as keeps it there.
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


@kernel
def settle(low, high, low_jerk, high_jerk):
    """Acceleration (m/s2) and jerk (m/s3) of a body: the value nearest to 0 in the range ``[low, high]`` (m/s2).

    The body's own forces allow the accelerations in this range. ``low_jerk`` and ``high_jerk`` (m/s3) are the rates at
    which the two ends of the range change.
    """
    if low > 0.0 or (low == 0.0 and low_jerk > 0.0):
        return low, low_jerk
    if high < 0.0 or (high == 0.0 and high_jerk < 0.0):
        return high, high_jerk
    return 0.0, 0.0


@kernel
def stopping_m(speed, latency_left, capacity, rate):
    """Distance (m) in which a vehicle stops that coasts until its latency has elapsed and then brakes fully.

    With speed v (m/s, at least 0), remaining latency tau (s), capacity a (m/s2) and rate r (m/s3), the distance is ``v
    tau + v^2 / (2 a) + v a / (2 r) - a^3 / (24 r^2)``. A vehicle with ``v < a^2 / (2 r)`` stops before its brakes have
    full force, after ``v tau + (2 / 3) v sqrt(2 v / r)``. For an infinite rate the distance is ``v tau + v^2 / (2 a)``.
    """
    speed = max(speed, 0.0)
    if math.isinf(rate):
        return speed * latency_left + speed * speed / (2.0 * capacity)
    rise = capacity / rate
    if speed < 0.5 * capacity * rise:
        return speed * latency_left + 2.0 / 3.0 * speed * math.sqrt(2.0 * speed / rate)
    return speed * latency_left + 0.5 * speed * rise - capacity * rise * rise / 24.0 + speed * speed / (2.0 * capacity)


@large
def _stopping_each(speed, latency_left, capacity, rate, out):
    for k in range(len(out)):
        out[k] = stopping_m(speed[k], latency_left[k], capacity[k], rate[k])


def stopping_distances(speed: Floats, latency_left: Floats, capacity: Floats, rate: Floats) -> Floats:
    """Stopping distances (``stopping_m``) of n vehicles, [n] m; all arguments are [n]."""
    out, tidy = np.empty(len(speed)), np.ascontiguousarray
    _stopping_each(tidy(speed), tidy(latency_left), tidy(capacity), tidy(rate), out)
    return out
