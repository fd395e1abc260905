"""Closed formulas for motion at constant acceleration: time until the next event, gap, stopping distance.

Between events every gap is a quadratic function of time, so the formulas give the time of the next event exactly, and
no event is missed. The formulas use only + - * / and sqrt, so a world's results have the same bits in any batch.

Arguments that several functions share:

- ``speed`` v: present speed, m/s; ``limit``: speed up to which the vehicle drives, m/s
- ``command``: command in force (in ``solo_motion``: from ``onset`` on), m/s2; negative brakes
- ``duration``: length of the motion, s
- ``gap`` g: present gap of a pair, m, at least 0
- ``closing`` w, ``pressing`` b: present closing speed (m/s) and constant closing acceleration (m/s2), rear minus front
- ``latency_left`` tau: time until the brakes act, s; ``capacity`` a: largest deceleration, m/s2
- ``rate`` r: rate at which the brakes build up, m/s3; infinite if they act at once
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Floats


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
    """Return whether a command has taken effect before the end of a time interval; accepts numbers and arrays.

    The result is True for a command that takes effect at the start of the interval, and False for a command that would
    take effect exactly at the end, because the next decision replaces this command before it acts.

    Args:
        latency_s: time from the start of the interval until the command takes effect, s; may be negative.
        time_s: length of the interval, s.

    """
    return (latency_s <= 0.0) | (latency_s < time_s - ONSET_ROUNDING_S)


command_acts = compiled(has_acted)


@compiled
def contact(gap: float, closing: float, pressing: float) -> tuple[float, float]:
    """Return the time (s) and the closing speed (m/s) of a pair's first contact; ``(inf, 0)`` if there is no contact.

    With the gap g, the closing speed w and the closing acceleration b, let ``D = w^2 + 2 b g``. If ``w > 0``, there is
    no contact for ``D < 0``; otherwise the contact is at ``t = 2 g / (w + sqrt(D))``. If ``w <= 0``, there is a contact
    only for ``b > 0``, at ``t = (sqrt(D) - w) / b``. The closing speed at the contact is computed as ``sqrt(D)``,
    because ``w + b t``, which is mathematically equal, loses digits by cancellation.
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
    """Return the gap (m) of a pair after the time t = ``duration``: ``g - (w + b t / 2) t``."""
    return gap - (closing + 0.5 * pressing * duration) * duration


@compiled
def speed_event(speed: float, acceleration: float, command: float, limit: float) -> tuple[float, float]:
    """Return the time (s) until a vehicle next comes to rest or reaches its speed limit, and its speed (m/s) then.

    When the vehicle comes to rest, its brakes hold it there. The speed limit matters only if the command drives the
    vehicle. If the vehicle neither comes to rest nor reaches the limit, the result is ``(inf, 0)``. ``acceleration`` is
    constant, m/s2.
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
    """Return the acceleration (m/s2) by a vehicle's own brakes or engine for motion forward, and for motion backward.

    The two accelerations differ if the vehicle brakes at rest or drives at its speed limit. The brakes of a vehicle at
    rest act against motion in either direction. A driving vehicle at its speed limit uses only as much force as keeps
    it at this speed.
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
    """Return the acceleration (m/s2) of a body: the value nearest to 0 in the range ``[low, high]``.

    The body is a vehicle, or several vehicles that move as one. ``[low, high]`` is the range of accelerations (m/s2)
    that the body's own forces allow.
    """
    if low > 0.0:
        return low
    if high < 0.0:
        return high
    return 0.0


@compiled
def solo_motion(
    speed: float, command: float, onset: float, limit: float, duration: float
) -> tuple[float, float, float]:
    """Move a vehicle without contact; return its final speed (m/s), distance travelled (m) and acceleration (m/s2).

    The vehicle coasts until ``onset`` (s from now; 0 or less: the command acts at once). From ``onset`` on, the vehicle
    brakes until it is at rest, or drives up to the speed limit. If the acceleration changes during the motion, the
    returned acceleration is NaN. ``speed`` is at least 0.
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
    """Return the distance (m) until a vehicle is at rest: ``v tau`` in the remaining latency plus ``v^2 / (2 a)``.

    The vehicle coasts during the remaining latency and then brakes fully. If the vehicle does not move forward, the
    distance is 0.
    """
    speed = max(speed, 0.0)
    return speed * latency_left + speed * speed / (2.0 * capacity)


@compiled
def ramped_stopping_distance(speed: float, latency_left: float, capacity: float, rate: float) -> float:
    """Return the distance (m) until a vehicle is at rest under full braking, if its brakes build up from 0.

    After the remaining latency, the brakes build up at a constant rate. The distance is
    ``v tau + v a / (2 r) - a^3 / (24 r^2) + v^2 / (2 a)``. If ``v < a^2 / (2 r)``, the vehicle stops before its brakes
    reach full force, and the distance is ``v tau + (2 / 3) v sqrt(2 v / r)``. If the vehicle does not move forward, the
    distance is 0.
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
    """Return the ``ramped_stopping_distance`` of each of n vehicles, [n] m."""
    distance = np.empty(len(speed))
    for k in range(len(speed)):
        distance[k] = ramped_stopping_distance(speed[k], latency_left[k], capacity[k], rate[k])
    return distance
