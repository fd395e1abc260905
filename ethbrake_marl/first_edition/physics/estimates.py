"""One vehicle's estimate of the other vehicles' states, from the newest periodic messages, which may be old."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.first_edition.physics.columns import columns
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.messages import (
    ACCELERATION,
    CHANNEL,
    LINK,
    PLACE,
    PLACES_AT,
    SPEED,
    has_contents,
    knows_piece,
    link_at,
)
from ethbrake_marl.first_edition.physics.motion import solo_motion
from ethbrake_marl.first_edition.physics.state import Floats


@compiled
def estimate_rows(state: Floats, params: Floats, observer: int, out: Floats) -> None:
    """Fill ``out`` with the worlds as vehicle ``observer`` estimates them from the messages it has received.

    If the observer has received the state of a vehicle, the function extrapolates the newest received place and speed
    to the present, under the received command and without contact. If the received states of both vehicles of a pair
    are from the present time, the estimated gap is the true gap. The observer knows about past impacts of its own
    pairs, but not of other pairs. If the observer has received nothing about a vehicle, the function puts this vehicle
    at rest at the place of the next vehicle towards the observer. If messages do not contain a quantity, the function
    replaces the quantity in the same way: a place by the place of the next vehicle towards the observer, a speed or a
    command by 0.

    Args:
        state: true states of the worlds, [n, S], one row per world in the layout of ``physics.columns``.
        params: parameters of the worlds, one row per world, with message columns.
        observer: index of the observing vehicle, from 0.
        out: result, the estimated states, [n, S]; in a world without periodic messages, the true state.

    """
    column = columns(state)
    N, gap, speed, command, obstacle = column.vehicles, column.gap, column.speed, column.command, column.obstacle
    head = column.messages
    place, fresh = np.empty(N), np.empty(N, np.bool_)
    out[:] = state
    for k in range(state.shape[0]):
        if params[k, head + CHANNEL.PERIOD] == 0.0:
            continue
        messages, time = params[k, head:], state[k, column.time]
        says = has_contents(messages, N)
        place[observer], fresh[observer] = messages[PLACES_AT + observer], True
        for way in (-1, 1):
            last = place[observer]
            j = observer + way
            while 0 <= j < N:
                link = link_at(observer, j, N)
                known = time >= params[k, column.news + observer * N + j] and messages[link + LINK.TOLD_S] >= 0.0
                fresh[j] = known and messages[link + LINK.TOLD_S] >= time
                out[k, speed + j], out[k, command + j], place[j] = 0.0, 0.0, last
                if known:
                    limit, age = params[k, column.limit + j], time - messages[link + LINK.TOLD_S]
                    then, force = messages[link + LINK.TOLD_SPEED], messages[link + LINK.TOLD_COMMAND]
                    if says and not knows_piece(messages, N, observer, j, ACCELERATION, time):
                        force = 0.0
                    after, passed = moved_on(then, force, limit, age)
                    out[k, command + j] = force
                    if says and not knows_piece(messages, N, observer, j, SPEED, time):
                        after = passed = 0.0
                    out[k, speed + j] = after
                    if says and not knows_piece(messages, N, observer, j, PLACE, time):
                        fresh[j] = False
                    else:
                        place[j] = messages[link + LINK.TOLD_PLACE] + passed
                        last = place[j]
                j += way
        for p in range(N - 1):
            if not (fresh[p] and fresh[p + 1]):
                out[k, gap + p] = max(place[p] - place[p + 1], 0.0)
            if p != observer and p + 1 != observer:
                out[k, gap + N - 1 + p] = 0.0
        if observer > 0 and state.shape[1] > obstacle:
            out[k, obstacle] = max(messages[CHANNEL.OBSTACLE_PLACE] - place[0], 0.0)
            out[k, obstacle + 1] = messages[link_at(observer, 0, N) + LINK.TOLD_HIT]


@compiled
def moved_on(speed: float, command: float, limit: float, duration: float) -> tuple[float, float]:
    """Return a vehicle's speed (m/s) after ``duration`` (s) without contact, and the distance (m) that it travels.

    A vehicle that moves backward brakes until it is at rest, whatever the sign of its command. ``speed`` (m/s) may be
    negative; ``command`` is the acceleration in force, m/s2; ``limit`` is the speed up to which the vehicle drives,
    m/s.
    """
    if speed >= 0.0:
        after, way, _ = solo_motion(speed, command, 0.0, limit, duration)
        return after, way
    force = abs(command)
    braking = min(duration, -speed / force) if force > 0.0 else duration
    return min(speed + force * braking, 0.0), (speed + 0.5 * force * braking) * braking


@compiled
def move_on(speed: Floats, command: Floats, onset: Floats, limit: Floats, duration: Floats) -> tuple[Floats, Floats]:
    """Return final speeds (m/s) and distances (m) of all vehicles by ``motion.solo_motion``; all arrays are [n, N]."""
    after, way = np.empty(speed.shape), np.empty(speed.shape)
    for k in range(speed.shape[0]):
        for i in range(speed.shape[1]):
            after[k, i], way[k, i], _ = solo_motion(
                speed[k, i], command[k, i], onset[k, i], limit[k, i], duration[k, i]
            )
    return after, way
