"""Estimates of a vehicle over a channel of periodic messages: where the others are, and how old its news is."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics.columns import columns
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.messages import CHANNEL, LINK, link_at, place_at
from ethbrake_marl.physics.motion import solo_motion
from ethbrake_marl.physics.state import Floats


@compiled
def estimate_rows(state: Floats, params: Floats, observer: int, out: Floats) -> None:
    """Fill ``out`` [n, S] with the worlds as one vehicle takes them to be now, from what it was told.

    Of whom it knows: the newest place and speed, moved on with the command of then, as if alone. A pair whose two
    vehicles it sees now has its true gap; the own pairs' hit flags are its own. Who is not known stands in the place of
    the next one towards the observer, at rest: nothing of it is left.
    """
    column = columns(state)
    N, gap, speed, command, obstacle = column.vehicles, column.gap, column.speed, column.command, column.obstacle
    head = column.messages
    place, fresh = np.empty(N), np.empty(N, np.bool_)
    out[:] = state
    for k in range(state.shape[0]):
        if params[k, head + CHANNEL.PERIOD] == 0.0:
            continue
        told, time = params[k, head:], state[k, column.time]
        place[observer], fresh[observer] = told[place_at(N) + observer], True
        for way in (-1, 1):
            last = place[observer]
            j = observer + way
            while 0 <= j < N:
                link = link_at(observer, j, N)
                known = time >= params[k, column.news + observer * N + j] and told[link + LINK.TOLD_S] >= 0.0
                fresh[j] = known and told[link + LINK.TOLD_S] >= time
                out[k, speed + j], out[k, command + j], place[j] = 0.0, 0.0, last
                if known:
                    limit, age = params[k, column.limit + j], time - told[link + LINK.TOLD_S]
                    after, passed = moved_on(told[link + LINK.TOLD_SPEED], told[link + LINK.TOLD_COMMAND], limit, age)
                    out[k, speed + j], out[k, command + j] = after, told[link + LINK.TOLD_COMMAND]
                    place[j] = told[link + LINK.TOLD_PLACE] + passed
                    last = place[j]
                j += way
        for p in range(N - 1):
            if not (fresh[p] and fresh[p + 1]):
                out[k, gap + p] = max(place[p] - place[p + 1], 0.0)
            if p != observer and p + 1 != observer:
                out[k, gap + N - 1 + p] = 0.0
        if observer > 0 and state.shape[1] > obstacle:
            out[k, obstacle] = max(told[CHANNEL.OBSTACLE_PLACE] - place[0], 0.0)
            out[k, obstacle + 1] = told[link_at(observer, 0, N) + LINK.TOLD_HIT]


@compiled
def moved_on(speed: float, command: float, limit: float, duration: float) -> tuple[float, float]:
    """Speed and way of a vehicle alone after ``duration`` under a command in force; one moving backward brakes too."""
    if speed >= 0.0:
        after, way, _ = solo_motion(speed, command, 0.0, limit, duration)
        return after, way
    force = abs(command)
    braking = min(duration, -speed / force) if force > 0.0 else duration
    return min(speed + force * braking, 0.0), (speed + 0.5 * force * braking) * braking


@compiled
def move_on(speed: Floats, command: Floats, onset: Floats, limit: Floats, duration: Floats) -> tuple[Floats, Floats]:
    """Speeds and ways, each [n, N], of vehicles alone after ``duration``, the command acting from ``onset`` (s) on.

    All are [n, N], speeds not below 0.
    """
    after, way = np.empty(speed.shape), np.empty(speed.shape)
    for k in range(speed.shape[0]):
        for i in range(speed.shape[1]):
            after[k, i], way[k, i], _ = solo_motion(
                speed[k, i], command[k, i], onset[k, i], limit[k, i], duration[k, i]
            )
    return after, way
