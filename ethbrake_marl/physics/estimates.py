"""Estimates of a vehicle over a channel of periodic messages: where the others are, and how old its news is."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.events import solo_motion
from ethbrake_marl.physics.messages import (
    LINK,
    OBSTACLE_PLACE,
    PERIOD,
    TOLD_COMMAND,
    TOLD_HIT,
    TOLD_PLACE,
    TOLD_S,
    TOLD_SPEED,
    link_at,
    place_at,
    ring_at,
)
from ethbrake_marl.physics.rows import (
    TIME,
    command_at,
    gap_at,
    messages_at,
    params_at,
    speed_at,
    state_width,
    vehicles_in,
)
from ethbrake_marl.physics.worlds import Bools, Floats, Worlds


@compiled
def estimate_rows(state: Floats, params: Floats, observer: int, out: Floats) -> None:
    """Fill ``out`` [n, S] with the worlds as one vehicle takes them to be now, from what it was told.

    Of whom it knows: the newest place and speed, moved on with the command of then, as if alone. A pair whose two
    vehicles it sees now has its true gap; the own pairs' hit flags are its own. Who is not known stands in the place of
    the next one towards the observer, at rest: nothing of it is left.
    """
    N = vehicles_in(state)
    head, gap, speed, command = messages_at(N), gap_at(N), speed_at(N), command_at(N)
    place, fresh = np.empty(N), np.empty(N, np.bool_)
    out[:] = state
    for k in range(state.shape[0]):
        if params[k, head + PERIOD] == 0.0:
            continue
        told, time = params[k, head:], state[k, TIME]
        place[observer], fresh[observer] = told[place_at(N) + observer], True
        for way in (-1, 1):
            last = place[observer]
            j = observer + way
            while 0 <= j < N:
                link = link_at(observer, j, N)
                known = time >= params[k, params_at(6, N) + observer * N + j] and told[link + TOLD_S] >= 0.0
                fresh[j] = known and told[link + TOLD_S] >= time
                out[k, speed + j], out[k, command + j], place[j] = 0.0, 0.0, last
                if known:
                    limit, age = params[k, params_at(4, N) + j], time - told[link + TOLD_S]
                    after, passed = moved_on(told[link + TOLD_SPEED], told[link + TOLD_COMMAND], limit, age)
                    out[k, speed + j], out[k, command + j] = after, told[link + TOLD_COMMAND]
                    place[j] = told[link + TOLD_PLACE] + passed
                    last = place[j]
                j += way
        for p in range(N - 1):
            if not (fresh[p] and fresh[p + 1]):
                out[k, gap + p] = max(place[p] - place[p + 1], 0.0)
            if p != observer and p + 1 != observer:
                out[k, gap + N - 1 + p] = 0.0
        if observer > 0 and state.shape[1] > state_width(N):
            out[k, state_width(N)] = max(told[OBSTACLE_PLACE] - place[0], 0.0)
            out[k, state_width(N) + 1] = told[link_at(observer, 0, N) + TOLD_HIT]


@compiled
def moved_on(speed: float, command: float, limit: float, duration: float) -> tuple[float, float]:
    """Speed and way of a vehicle alone after ``duration`` under a command in force; one moving backward brakes too."""
    if speed >= 0.0:
        after, way, _ = solo_motion(speed, command, 0.0, limit, duration)
        return after, way
    force = abs(command)
    braking = min(duration, -speed / force) if force > 0.0 else duration
    return min(speed + force * braking, 0.0), (speed + 0.5 * force * braking) * braking


def is_periodic(worlds: Worlds) -> Bools:
    """In which worlds messages go on after the first one, so that what is known grows old, [n]."""
    if worlds.messages.shape[1] == 0:
        return np.zeros(worlds.n, np.bool_)
    periodic: Bools = worlds.messages[:, PERIOD] > 0.0
    return periodic


def links_of(worlds: Worlds) -> Floats:
    """The columns of every link, [n, N, N, LINK], of worlds with columns of messages."""
    n, N = worlds.speeds_mps.shape
    return worlds.messages[:, link_at(0, 0, N) : ring_at(N)].reshape(n, N, N, LINK)


def age_s(worlds: Worlds) -> Floats:
    """How old what vehicle i was last told of vehicle j is, [n, N, N] s: since the state was sampled.

    0 without periodic messages, where the present is known; infinite where nothing has been told yet. Whether i may act
    on it is another question (``Vehicles.known_from_s``).
    """
    return age_by_rows(worlds.time_s, worlds.messages, worlds.N)


def age_by_rows(time_s: Floats, messages: Floats, vehicles: int) -> Floats:
    """``age_s`` of worlds at ``time_s`` [n] by their columns of ``messages`` [n, M]."""
    age = np.zeros((len(time_s), vehicles, vehicles))
    if messages.shape[1] == 0:
        return age
    links = messages[:, link_at(0, 0, vehicles) : ring_at(vehicles)].reshape(-1, vehicles, vehicles, LINK)
    periodic, told_s = messages[:, PERIOD] > 0.0, links[..., TOLD_S]
    age[periodic] = np.where(told_s >= 0.0, time_s[:, np.newaxis, np.newaxis] - told_s, np.inf)[periodic]
    age[:, np.arange(vehicles), np.arange(vehicles)] = 0.0
    return age


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
