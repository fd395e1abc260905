"""Profiles of full driving and full braking, with which a search begins, because random profiles seldom contain them.

The best commands have one of two forms (``extensions.proofs``): drive fully, brake fully until the vehicle meets the
one ahead, and drive fully again; or brake fully, drive fully until the vehicle behind meets it, and brake fully again.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.extensions.proofs.line import rows_of
from ethbrake_marl.extensions.proofs.meetings import meet_front, meet_rear
from ethbrake_marl.extensions.search.kernels import limit_command, try_all
from ethbrake_marl.extensions.search.pricing import MOST_PHASES, Problem, Profiles
from ethbrake_marl.extensions.search.search import prepare_world, random_states
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.layout import Floats

KEPT_PROFILES = 12  # profiles that are returned for each world
LATEST_S = 2.0  # latest first change of command, in the first round
TIMES = 24  # first changes that are tried in each round
EXTREME_ROUNDS = 3  # each closer to the best time so far
EXTREME_PHASES = 5
WAYS = ((0, 0.0), (0, 0.5), (0, 1.0), (1, 0.5))  # (`early`, `share`) in `write_extreme`


def extreme_profiles(problem: Problem) -> Profiles:
    """The ``KEPT_PROFILES`` best profiles that only drive or brake fully, for one vehicle, [n * KEPT_PROFILES], world
    by world.

    The first change of command is searched on a grid that is refined around the best. The second is when the vehicle
    meets its neighbour, predicted as if neighbours braked fully. Without neighbours, or moving backward, the profiles
    coast.
    """
    (body,), n, last = problem.bodies.tolist(), problem.n, problem.last_step
    at, random = rows_of(problem.state, body), random_states(problem.identity, 0)
    kinds = [kind for kind, there in ((0, body > 1), (1, body < problem.state.vehicles)) if there]
    ends = np.repeat(last, KEPT_PROFILES * MOST_PHASES).reshape(n, KEPT_PROFILES, MOST_PHASES)
    commands = np.zeros((n, KEPT_PROFILES, MOST_PHASES, 1))
    for k in np.flatnonzero((problem.state.speeds_mps >= 0.0).all(axis=1)):
        world, room = prepare_world(problem, int(k), random, MOST_PHASES, False)
        candidates, values = [], []
        for kind in kinds:
            low, high = 0.0, LATEST_S
            for _ in range(EXTREME_ROUNDS):
                changes = low + (high - low) * np.arange(TIMES) / (TIMES - 1)
                value = np.empty(TIMES * len(WAYS))
                candidates.append(extremes(problem, int(k), at[k], kind, changes))
                try_all(world, room, *candidates[-1], value)
                values.append(value)
                best = changes[value.argmin() // len(WAYS)]
                around = 1.5 * (high - low) / (TIMES - 1)
                low, high = max(best - around, 0.0), best + around
        if candidates:
            order = np.concatenate(values).argsort(kind="stable")[:KEPT_PROFILES]
            best_profiles = Profiles.pad([Profiles.join(candidates).take(order)], MOST_PHASES)[0]
            ends[k], commands[k] = best_profiles
    return Profiles(ends.reshape(-1, MOST_PHASES), commands.reshape(-1, MOST_PHASES, 1))


@large
def write_extreme(kind, change, meeting, early, share, step, last, low, high, ends, commands):
    """Write a profile of full driving (``high``, m/s2) and full braking (``low``) to ``ends`` [5] and ``commands`` [5,
    1].

    ``kind`` 0: drive, brake, drive; 1: brake, drive, brake. The first change is at ``change`` (s after the first
    decision); in its step, of ``step`` s, the command is the mean, so the speed afterwards is exact. The second change
    is ``early`` steps before the step of ``meeting`` (s; infinite: never); in its step the command is ``share`` times
    the last plus 1 - ``share`` times the second. ``last``: last step.
    """
    first, second = (high, low) if kind == 0 else (low, high)
    turn = int(min(change / step, float(last)))
    back = max(int(min(meeting / step, float(last))) - early, turn + 1)
    ends[0], ends[1], ends[2] = turn, min(turn + 1, last), min(back, last)
    ends[3], ends[4] = min(back + 1, last), last
    commands[0, 0] = commands[4, 0] = limit_command(first, low, high)
    commands[1, 0] = limit_command(second + (change / step - turn) * (first - second), low, high)
    commands[2, 0] = limit_command(second, low, high)
    commands[3, 0] = limit_command(second + share * (first - second), low, high)


@large
def write_extremes(at, kind, changes, step, last, low, high, ends, commands):
    row = 0
    for change in changes:
        meeting = meet_front(at, change) if kind == 0 else meet_rear(at, change)  # s; infinite: never
        for early, share in WAYS:
            write_extreme(kind, change, meeting, early, share, step, last, low, high, ends[row], commands[row])
            row += 1


def extremes(problem: Problem, k: int, at: Floats, kind: int, changes: Floats) -> Profiles:
    size = len(changes) * len(WAYS)
    ends, commands = np.empty((size, EXTREME_PHASES), np.int64), np.empty((size, EXTREME_PHASES, 1))
    (low, high), last = problem.bounds[k, 0].tolist(), int(problem.last_step[k])
    write_extremes(at, kind, changes, problem.time_step_s, last, low, high, ends, commands)
    return Profiles(ends, commands)
