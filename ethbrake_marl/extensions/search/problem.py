"""Search for the best command profiles of a problem, one world per task."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ethbrake_marl.engine.profiles import MOST_PHASES, ProfileProblem, Profiles, make_search_world
from ethbrake_marl.errors import PhysicsError, check_whole_number
from ethbrake_marl.extensions.search.profiles import search_world
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.state import Floats, UInt64s

_MIX = 0xD1342543DE82EF95  # odd multiplier that spreads seeds over 64 bits


def seeded(identity: UInt64s, seed: int) -> UInt64s:
    """Return the initial random state of each world, [n], from its hash ``identity`` [n] and the seed alone."""
    with np.errstate(over="ignore"):
        z = identity ^ np.uint64((int(seed) * _MIX) % 2**64)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return np.asarray(z ^ (z >> np.uint64(31)), np.uint64)


Found = tuple[Profiles, dict[HarmCount, Floats]]


def search_profiles(problem: ProfileProblem, given: Profiles, *, budget: int, seed: int = 0, threads: int = 1) -> Found:
    """Return the best command profile of each world that the search finds, and its harm [n] (m2/s2) under each count.

    A profile has at most ``MOST_PHASES`` phases of constant command. The result is never worse than any profile of
    ``given``. Raises ``InvalidInput`` for a budget below 1, and ``PhysicsError`` with the worlds in which no profile
    could be followed.

    Args:
        problem: n worlds, with the commands of the other vehicles and the harm to minimise.
        given: [n * Q] starting profiles: the Q profiles of world 0 first, then those of world 1, and so on.
        budget: approximate number of candidates per world.
        seed: seed of the random search.
        threads: number of threads.

    """
    for name, value, least in (("budget", budget, 1), ("threads", threads, 1), ("seed", seed, 0)):
        check_whole_number(name, value, least)
    n, C = problem.n, len(problem.vehicles)
    ends = np.ascontiguousarray(given.ends.reshape(n, -1, MOST_PHASES))
    commands = np.ascontiguousarray(given.commands_mps2.reshape(n, -1, MOST_PHASES, C))
    best = Profiles(np.zeros((n, MOST_PHASES), np.int64), np.zeros((n, MOST_PHASES, C)))
    random = seeded(problem.identity, seed)

    def work(k: int) -> int:
        world = make_search_world(problem, k, random)
        return search_world(world, problem.start[k], ends[k], commands[k], budget, best.ends[k], best.commands_mps2[k])

    if threads == 1:
        used = [work(k) for k in range(n)]
    else:
        with ThreadPoolExecutor(threads) as pool:
            used = list(pool.map(work, range(n)))
    if 0 in used:
        raise PhysicsError({k: "no profile could be followed" for k in range(n) if used[k] == 0})
    first, total = problem.follow(best)
    return best, {"first": first, "total": total}
