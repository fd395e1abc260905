"""Starting profiles for a search, which consist of full drive and full braking.

The proof of the lower bound shows that profiles with the least harm have one of two forms. In the first form, the
vehicle drives fully for a while, brakes fully until it meets the vehicle ahead, and drives fully again. In the second
form, the vehicle brakes fully, drives fully until the vehicle behind meets it, and brakes fully again. A random search
seldom finds such profiles.

Arguments that several functions share: ``ends`` [..., K] are the time steps at which the K phases of a profile end, and
``commands`` [..., K, 1] are the commands of these phases, m/s2; both are changed in place.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.extensions.proofs.line import FRONT_FIRST, REAR_FIRST
from ethbrake_marl.extensions.proofs.meetings import meet_front, meet_rear
from ethbrake_marl.extensions.proofs.plans import empty_plan
from ethbrake_marl.extensions.search.profiles import allowed, copy_profile, largest
from ethbrake_marl.first_edition.engine.profiles import (
    MOST_PHASES,
    ProfileProblem,
    Profiles,
    SearchWorld,
    copy_rows,
    make_search_world,
)
from ethbrake_marl.first_edition.physics.episode import CLOCK, follow_whole
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints

KEPT = 12  # number of profiles of each world

_LATEST_S = 2.0  # latest first change of command in the first round

_TIMES = 24  # times of the first change that are tried in each round

_ROUNDS = 3  # rounds; each one tries times closer to the best time so far

_PHASES = 5  # before the first change, step of the first change, between, step of the second change, after it


def extreme_profiles(problem: ProfileProblem, states: Floats, has_front: Bools, has_rear: Bools) -> Profiles:
    """Return the ``KEPT`` extreme profiles with the least harm in each world, [n * KEPT].

    The profiles of world 0 come first, then the profiles of world 1, and so on. An *extreme* profile changes between
    full drive and full braking. The times at which two vehicles meet are computed from ``states``, as if the neighbours
    of the controlled vehicle braked fully. If a neighbour brakes less, other extreme profiles may have less harm.

    Args:
        problem: n worlds with one controlled vehicle.
        states: state of each world at the first decision, [n, WIDTH]; the columns are named in ``proofs.line.LINE``.
        has_front: True if there is a vehicle ahead of the controlled vehicle, [n].
        has_rear: True if there is a vehicle behind the controlled vehicle, [n].

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
    """Write the extreme profiles with the least harm in each world to ``ends`` and ``commands``."""
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
    """Simulate profiles that first change the command between ``low`` and ``high`` (s); keep those with the least harm.

    Returns the time (s) at which the command first changes in the profile with the least harm. ``kind`` is
    ``FRONT_FIRST`` if the controlled vehicle meets the vehicle ahead, ``REAR_FIRST`` if it meets the vehicle behind.
    ``at`` [WIDTH] is the state of the world at the first decision, with the columns ``proofs.line.LINE``; ``start`` [S]
    is the same state in the form of the simulation. ``values`` [KEPT] is the harm of the best profiles, m2/s2; it is
    changed in place.
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
    """Write one profile: a first command, the opposite command from ``change`` to ``meeting``, the first command again.

    Commands can change only between time steps. If the time ``change`` is within a time step, the command of this step
    is the mean of the two commands, weighted with their durations. The speed at the end of the step is then exact.

    The first command is full drive if ``kind`` is ``FRONT_FIRST``, and full braking if it is ``REAR_FIRST``. ``change``
    and ``meeting`` are times in s. The second change comes ``early`` time steps before ``meeting``. In the time step
    before the return to the first command, the command is a weighted mean of both; ``share`` (0 to 1) is the weight of
    the first command.
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
