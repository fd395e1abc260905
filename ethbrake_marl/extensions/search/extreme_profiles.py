"""Starting profiles of full drive and full braking for a search.

They drive, brake until they meet the leader, and drive again; or the mirror image with the rear vehicle. The proof of
the lower bound shows that the least harm has this form: the vehicle drives fully for a while, then brakes fully until
it meets the leader; or it brakes, then drives until the rear vehicle meets it. After the meeting it does the opposite
(docs/extensions/search.md). A random search seldom finds such a narrow optimum.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.engine.profiles import (
    MOST_PHASES,
    ProfileProblem,
    Profiles,
    SearchWorld,
    copy_rows,
    make_search_world,
)
from ethbrake_marl.extensions.proofs.line import FRONT_FIRST, REAR_FIRST
from ethbrake_marl.extensions.proofs.meetings import meet_front, meet_rear
from ethbrake_marl.extensions.proofs.plans import empty_plan
from ethbrake_marl.extensions.search.profiles import allowed, copy_profile, largest
from ethbrake_marl.physics.episode import CLOCK, follow_whole
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Bools, Floats, Ints

KEPT = 12  # number of profiles of each world

_LATEST_S = 2.0  # latest first change of command in the first round

_TIMES = 24  # times of the first change that are tried in each round

_ROUNDS = 3  # rounds, each closer around the best time

_PHASES = 5  # before the first change, its step, until the second change, its step, after it


def extreme_profiles(problem: ProfileProblem, states: Floats, has_front: Bools, has_rear: Bools) -> Profiles:
    """Return the ``KEPT`` best extreme profiles of the one controlled vehicle, [n * KEPT], all of world 0 first, and so
    on.

    An *extreme* profile changes between full drive and full braking. ``states`` is used only to find when two vehicles
    would meet, as if neighbours braked fully. If they do not, the profiles are worse but still valid.

    Args:
        problem: the worlds, with the commands of the other vehicles and the harm to minimise.
        states: [n, WIDTH] one row for each world at the first decision, with the columns of ``proofs.line.LINE``.
        has_front: [n] True if a vehicle is ahead.
        has_rear: [n] True if a vehicle is behind.

    """
    n, last = problem.n, problem.last_step
    ends = np.repeat(last, KEPT * MOST_PHASES).reshape(n, KEPT, MOST_PHASES)
    commands = np.zeros((n, KEPT, MOST_PHASES, 1))
    _fill_extremes(problem, states, has_front, has_rear, ends, commands)
    return Profiles(ends.reshape(-1, MOST_PHASES), commands.reshape(-1, MOST_PHASES, 1))


@compiled
def _fill_extremes(
    problem: ProfileProblem, states: Floats, has_front: Bools, has_rear: Bools, ends: Ints, commands: Floats
) -> None:
    """Compute the best extreme profiles (full drive and full braking) of each world.

    Args:
        problem: the worlds, with the commands of the other vehicles and the harm to minimise.
        states: [n, WIDTH] one row for each world at the first decision, with the columns of ``proofs.line.LINE``.
        has_front: [n] True if a vehicle is ahead.
        has_rear: [n] True if a vehicle is behind.
        ends: output array [n, KEPT, K]: the steps at which the phases end.
        commands: output array [n, KEPT, K, 1]: the commands of the phases, m/s2.

    """
    no_random = np.zeros(states.shape[0], np.uint64)
    for k in range(states.shape[0]):
        world = make_search_world(problem, k, no_random)
        values = np.full(KEPT, math.inf)
        for kind, there in ((FRONT_FIRST, has_front[k]), (REAR_FIRST, has_rear[k])):
            low, high = 0.0, _LATEST_S
            for _ in range(_ROUNDS if there else 0):
                best = try_changes(world, kind, states[k], problem.start[k], low, high, ends[k], commands[k], values)
                around = 1.5 * (high - low) / (_TIMES - 1)
                low, high = max(best - around, 0.0), best + around


@compiled(apart=True)
def try_changes(
    world: SearchWorld, kind: int, at: Floats, start: Floats, low: float, high: float, ends: Ints, commands: Floats,
    values: Floats,
) -> float:  # fmt: skip
    """Simulate profiles whose first change of command lies between ``low`` and ``high`` (s), and keep the best ones.

    Returns the time of the first change with the least harm (s).

    Args:
        world: the world, with its commands, bounds and random stream.
        kind: ``FRONT_FIRST`` or ``REAR_FIRST``: the neighbour to meet.
        at: the world at the first decision, an array with the columns of ``proofs.line.LINE``.
        start: [S] state of the simulation at the first decision.
        low: earliest first change, s.
        high: latest first change, s.
        ends: [KEPT, K] ends of the best profiles so far, in steps; changed in place.
        commands: [KEPT, K, 1] their commands, m/s2; changed in place.
        values: [KEPT] their harm, m2/s2; changed in place.

    """
    plan, other = empty_plan(), empty_plan()
    states = np.zeros((_PHASES + 1, start.shape[0]))
    copy_rows(start.reshape(1, -1), states, 1)
    tried_ends, tried = np.zeros(_PHASES, np.int64), np.zeros((_PHASES, 1))
    least, best = math.inf, low
    for k in range(_TIMES):
        change = low + (high - low) * k / (_TIMES - 1)
        meeting = meet_front(at, change, plan, other) if kind == FRONT_FIRST else meet_rear(at, change, plan, other)
        for early, share in ((0, 0.0), (0, 0.5), (0, 1.0), (1, 0.5)):
            fill_extreme(world, kind, change, meeting, early, share, tried_ends, tried)
            value, reached = follow_whole(world.episode, tried_ends, tried, states, math.inf)
            if reached < 0:
                continue
            if value < least:
                least, best = value, change
            worst = largest(values)
            if value < values[worst]:
                values[worst] = value
                copy_profile(tried_ends, tried, ends[worst], commands[worst])
                for phase in range(_PHASES, commands.shape[1]):
                    commands[worst, phase, 0] = tried[_PHASES - 1, 0]
    return best


@compiled
def fill_extreme(
    world: SearchWorld, kind: int, change: float, meeting: float, early: int, share: float, ends: Ints, commands: Floats
) -> None:
    """Write one profile: a first command, the opposite one from ``change`` to ``meeting``, then the first one again.

    Commands can change only between steps. If ``change`` lies within a step, that step gets the mean command, so that
    the speed after it is the same.

    Args:
        world: the world, with its commands, bounds and random stream.
        kind: ``FRONT_FIRST``: drive first; ``REAR_FIRST``: brake first.
        change: time of the first change, s.
        meeting: time of the second change, s.
        early: number of steps by which the second change comes earlier.
        share: weight of the first command in the step of the second change, 0 to 1.
        ends: output array [5]: the steps at which the phases end.
        commands: output array [5, 1]: the commands of the phases, m/s2.

    """
    low, high, step = world.bounds[0, 0], world.bounds[0, 1], world.episode.clock[CLOCK.TIME_STEP]
    last = int(world.episode.clock[CLOCK.LAST_STEP])
    first, second = (high, low) if kind == FRONT_FIRST else (low, high)
    turn = min(int(change / step), last)
    back = max(int(min(meeting / step, last)) - early, turn + 1)
    commands[0, 0], commands[2, 0], commands[4, 0] = first, second, first
    commands[1, 0] = second + (change / step - turn) * (first - second)
    commands[3, 0] = second + share * (first - second)
    ends[0], ends[1], ends[2], ends[3], ends[4] = turn, turn + 1, back, back + 1, last
    for k in range(_PHASES):
        ends[k] = min(ends[k], last)
        commands[k, 0] = allowed(commands[k, 0], low, high)
