"""Profiles of full driving and full braking, with which a search begins: a random one seldom draws them.

The proof of the lower bound (``extensions.proofs``) shows that the best commands have one of two forms: drive fully,
brake fully until the vehicle meets the one ahead, and drive fully again; or brake fully, drive fully until the vehicle
behind meets it, and brake fully again.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.extensions.proofs.line import rows_of
from ethbrake_marl.extensions.proofs.meetings import meet_front, meet_rear
from ethbrake_marl.extensions.search.kernels import RESOLUTION, try_all
from ethbrake_marl.extensions.search.pricing import MOST_PHASES, Problem, Profiles
from ethbrake_marl.extensions.search.search import prepared, seeded
from ethbrake_marl.motion.layout import Floats

KEPT = 12  # profiles of each world
LATEST_S = 2.0  # latest first change of command, in the first round
TIMES = 24  # first changes that are tried in each round
ROUNDS = 3  # each closer to the best time so far
WAYS = ((0, 0.0), (0, 0.5), (0, 1.0), (1, 0.5))  # steps by which the second change comes early, and the share in it


def extreme_profiles(problem: Problem) -> Profiles:
    """Return the best extreme profiles of one controlled vehicle, [n * KEPT]: first those of world 0, and so on.

    Where it meets its neighbours is computed as if they braked fully. A world in which a vehicle moves backward, or
    where there is no neighbour, has profiles of coasting in place of some.
    """
    (body,), n, last = problem.bodies.tolist(), problem.n, problem.last_step
    at, random = rows_of(problem.state, body), seeded(problem.identity, 0)
    kinds = [kind for kind, there in ((0, body > 1), (1, body < problem.state.vehicles)) if there]
    ends = np.repeat(last, KEPT * MOST_PHASES).reshape(n, KEPT, MOST_PHASES)
    commands = np.zeros((n, KEPT, MOST_PHASES, 1))
    for k in np.flatnonzero((problem.state.speeds_mps >= 0.0).all(axis=1)):
        world, room = prepared(problem, int(k), random, MOST_PHASES, False)
        tried, values = [], []
        for kind in kinds:
            meet, low, high = (meet_front, meet_rear)[kind], 0.0, LATEST_S
            for _ in range(ROUNDS):
                changes = low + (high - low) * np.arange(TIMES) / (TIMES - 1)
                meetings, value = np.array([meet(at[k], change) for change in changes]), np.empty(TIMES * len(WAYS))
                tried.append(extremes(problem, int(k), kind, changes, meetings))
                try_all(world, room, *tried[-1], value)
                values.append(value)
                best = changes[value.argmin() // len(WAYS)]
                around = 1.5 * (high - low) / (TIMES - 1)
                low, high = max(best - around, 0.0), best + around
        if tried:
            order = np.concatenate(values).argsort(kind="stable")[:KEPT]
            kept = Profiles.padded([Profiles.join(tried).take(order)], MOST_PHASES)[0]
            ends[k], commands[k] = kept
    return Profiles(ends.reshape(-1, MOST_PHASES), commands.reshape(-1, MOST_PHASES, 1))


def extremes(problem: Problem, k: int, kind: int, changes: Floats, meetings: Floats) -> Profiles:
    """Return the extreme profiles of world k that change at these times (s) and at these meetings, [TIMES * WAYS].

    ``kind`` 0 drives, brakes and drives; 1 brakes, drives and brakes. Commands change between steps only: within the
    step of a change the command is the mean of both, so that the speed after it is exact.
    """
    low, high = problem.bounds[k, 0]
    first, second = (low, high) if kind else (high, low)
    step, last = problem.time_step_s, int(problem.last_step[k])
    early, share = np.array(WAYS).T
    turn = np.repeat(np.minimum(changes / step, last).astype(np.int64), len(WAYS))
    within = np.repeat(changes / step, len(WAYS)) - turn
    back = np.minimum(np.repeat(meetings / step, len(WAYS)), last).astype(np.int64)
    back = np.maximum(back - np.tile(early, TIMES).astype(np.int64), turn + 1)
    ends = np.minimum(np.stack([turn, turn + 1, back, back + 1, np.full(len(turn), last)], axis=1), last)
    commands = np.empty((len(turn), 5, 1))
    commands[:, [0, 4]], commands[:, 2] = first, second
    commands[:, 1, 0] = second + within * (first - second)
    commands[:, 3, 0] = second + np.tile(share, TIMES) * (first - second)
    return Profiles(ends, np.trunc(np.clip(commands, low, high) * RESOLUTION) / RESOLUTION)
