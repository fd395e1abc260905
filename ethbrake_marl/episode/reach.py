"""Who can matter: vehicles that cannot come near an observer before the end, unless somebody drives, read as absent."""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.episode.state import END, TIME, State
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.layout import FAR_M, FORCE, GAP, LIMIT, MASS, RESTITUTION, SPEED, Floats, Ints

NEAR_M = 100.0  # vehicles within this gap always matter: features show gaps up to here


def within_reach(state: State, body: int) -> Ints:
    """First and last vehicle that can matter to ``body``, according to what ``state`` shows it, [n, 2]."""
    out = np.empty((state.n, 2), np.int64)
    rows_within_reach(state.line, state.car, clock_of_reach(state), state.know, body, out)
    return out


def clock_of_reach(state: State) -> Floats:
    """The state's ``clock``; without an end if the vehicles move in another way, so that all can matter."""
    if state.is_exact:
        return state.clock
    clock = state.clock.copy()
    clock[:, END] = np.inf
    return clock


@large
def rows_within_reach(line, car, clock, know, i, out):
    for k in range(len(out)):
        out[k, 0], out[k, 1] = row_within_reach(line[k], car[k], clock[k], know[k], i)


@kernel
def row_within_reach(line, car, clock, know, i):
    """First and last vehicle that can matter to body i in one world: the row around it without a pair that is apart."""
    first, last = 1, line.shape[1] - 1
    for p in range(i - 1, 0, -1):
        if is_apart(line, car, clock, know, i, p):
            first = p + 1
            break
    for p in range(i, line.shape[1] - 1):
        if is_apart(line, car, clock, know, i, p):
            last = p
            break
    return first, last


@kernel
def is_apart(line, car, clock, know, i, p):
    """Whether bodies p and p + 1 cannot meet before the episode ends, as far as body i knows.

    They cannot if ``gap > NEAR_M`` and ``gap > T (forward + backward)``: T is the time that is left, ``forward`` the
    largest speed behind the gap and ``backward`` the largest one, towards it, ahead of it (``largest_speeds``). So all
    ahead may stop at once, and nobody behind need brake. But nobody may begin to drive: if the observer or another
    vehicle does (perhaps after its latency), the observer sees the vehicle again at its next decision, while about
    ``NEAR_M`` or more are left. What is unknown (NaN, or not yet heard of) lets nobody be apart.
    """
    gap, time = line[GAP, p], clock[TIME]
    if not gap > NEAR_M or clock[END] <= time:
        return False
    forward, _ = largest_speeds(line, car, know[i], time, i, p + 1, line.shape[1] - 1, False)
    _, backward = largest_speeds(line, car, know[i], time, i, 1, p, line[GAP, 0] < FAR_M)
    return gap > (clock[END] - time) * (forward + backward)


@kernel
def largest_speeds(line, car, know, time, i, first, last, wall):
    """Largest speeds forward and backward (m/s) that bodies ``first`` to ``last`` can have, whatever they hit.

    Another vehicle than i that drives may reach its speed limit. An impact with restitution e leaves all speeds within
    the range that they had before, if ``e (M - m) <= m`` for the mass m of each vehicle and the sum M of all: in
    ``(1 + e) P - e v``, with the mean P of a cluster, no speed then has a weight below 0. Otherwise, and at an obstacle
    (``wall``), no speed is above ``v sqrt(M / m)``, because impacts add no energy.
    """
    forward, backward, mass, lightest = 0.0, 0.0, 0.0, math.inf
    for j in range(first, last + 1):
        speed = line[SPEED, j]
        if math.isnan(speed) or (j != i and time < know[j]):
            return math.inf, math.inf
        drives = j != i and not line[FORCE, j] <= 0.0
        forward, backward = max(forward, speed, car[LIMIT, j] if drives else 0.0), max(backward, -speed)
        mass += car[MASS, j]
        lightest = min(lightest, car[MASS, j])
    restitution = car[RESTITUTION, 0]
    if restitution == 0.0 or (first == last and not wall):
        return forward, backward
    if not wall and restitution * (mass - lightest) <= lightest:
        return forward, backward
    most = max(forward, backward) * math.sqrt(mass / lightest)
    return most, most
