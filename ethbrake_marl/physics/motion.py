"""Closed-form times of the events that bound motion under constant acceleration, and distances to stop.

Between events every quantity is a quadratic in time, so the first event is found exactly and none is missed. Only
+ - * / and sqrt are used, so a world gives the same bits in any batch.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats


class _Bounds(NamedTuple):
    """Thresholds at which the physics changes from one rule to another."""

    TOUCH_SPEED_MPS: float = 1e-5  # contact at this closing speed or less is a touch: no impact, no harm
    PLASTIC_SPEED_MPS: float = 0.05  # a cluster whose largest closing speed is below this does not bounce
    PENETRATION_M: float = 1e-9  # a gap below minus this value means that a contact was missed
    MOST_EVENTS: int = 1_000_000  # per world and segment; more means a defect of the kernel (largest seen: 160,000)
    FAR_AWAY_M: float = 1e300  # gap of a world without an obstacle in a batch with obstacles: unreachable


BOUND = _Bounds()

ONSET_ROUNDING_S = 1e-9  # a latency that elapses this shortly before the end of an interval elapses at its end


def has_acted(latency_s: Any, time_s: Any) -> Any:
    """Return whether a command acts in the interval from 0 to ``time_s``; numbers (in kernels) or arrays, s.

    A latency that elapses at the start of the interval counts. A latency that elapses at its end does not: the next
    decision replaces the command before it acts.
    """
    return (latency_s <= 0.0) | (latency_s < time_s - ONSET_ROUNDING_S)


command_acts = compiled(has_acted)


@compiled
def contact(gap: float, closing: float, pressing: float) -> tuple[float, float]:
    """Return the time to a pair's first contact and the closing speed there; ``(inf, 0)`` if there is none.

    With gap ``g >= 0``, closing speed ``w`` and closing acceleration ``b`` (arguments ``gap``, ``closing``,
    ``pressing``): ``D = w^2 + 2 b g``. For ``w > 0``: no contact if ``D < 0``, otherwise ``t = 2 g / (w + sqrt D)``.
    For ``w <= 0``: contact only if ``b > 0``, ``t = (-w + sqrt D) / b``. The closing speed at contact is ``sqrt D``,
    because ``w + b t`` would suffer cancellation. [m, m/s, m/s2]
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
    """Return the gap after ``duration`` t at constant closing acceleration: ``g - (w + b t / 2) t``. [m]

    g is ``gap`` (m), w ``closing`` (closing speed, m/s), b ``pressing`` (closing acceleration, m/s2).
    """
    return gap - (closing + 0.5 * pressing * duration) * duration


@compiled
def speed_event(speed: float, acceleration: float, command: float, limit: float) -> tuple[float, float]:
    """Return the time until the speed next reaches a value where forces change, and that value; ``(inf, 0)``: never.

    These values are standstill, where brakes hold, and the speed limit of a vehicle that drives.
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
    """Return the acceleration from a vehicle's own forces if it is about to move forward, and if backward.

    The two differ where the force is set-valued: brakes at standstill hold against a push from either side, and a
    driving vehicle at its speed limit drives only as much as keeps it there.
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
    """Return the acceleration of a free body whose forces range over ``[low, high]``: the value nearest to 0."""
    if low > 0.0:
        return low
    if high < 0.0:
        return high
    return 0.0


@compiled
def solo_motion(
    speed: float, command: float, onset: float, limit: float, duration: float
) -> tuple[float, float, float]:
    """Move a vehicle alone for ``duration``: coast until ``onset``, then brake to standstill or drive to the limit.

    Returns the final speed, the distance, and the acceleration if it was constant throughout (otherwise NaN).
    Requires ``speed >= 0``. [m/s, m, m/s2]
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
    """Return the distance to rest under full braking after the remaining latency: ``v tau + v^2 / (2 a)``.

    v is ``speed`` (m/s), tau ``latency_left`` (s), a ``capacity`` (m/s2). The distance is 0 if the vehicle does not
    move forward. [m]
    """
    speed = max(speed, 0.0)
    return speed * latency_left + speed * speed / (2.0 * capacity)


@compiled
def ramped_stopping_distance(speed: float, latency_left: float, capacity: float, rate: float) -> float:
    """Return ``stopping_distance`` with brakes that build up from 0 at ``rate`` r (m/s3). [m]

    With capacity a: ``v tau + v a / (2 r) - a^3 / (24 r^2) + v^2 / (2 a)``. If the vehicle stops before its brakes
    reach full force, ``v < a^2 / (2 r)``: ``v tau + 2/3 v sqrt(2 v / r)``.
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
    """Return ``ramped_stopping_distance`` of n vehicles, [n]."""
    distance = np.empty(len(speed))
    for k in range(len(speed)):
        distance[k] = ramped_stopping_distance(speed[k], latency_left[k], capacity[k], rate[k])
    return distance
