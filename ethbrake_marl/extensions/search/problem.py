"""Search for the command profile with the least harm in each world of a problem, on several threads."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number
from ethbrake_marl.extensions.search.profiles import search_world
from ethbrake_marl.first_edition.engine.profiles import MOST_PHASES, ProfileProblem, Profiles, make_search_world
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.game.objectives import Declared, aim_of, objectives_of
from ethbrake_marl.first_edition.physics.state import Floats, UInt64s, Worlds

_MIX = 0xD1342543DE82EF95  # odd multiplier that spreads seeds over 64 bits


def seeded(identity: UInt64s, seed: int) -> UInt64s:
    """Return the initial state of each world's random stream, [n], from the hash ``identity`` [n] and ``seed``."""
    with np.errstate(over="ignore"):
        z = identity ^ np.uint64((int(seed) * _MIX) % 2**64)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return np.asarray(z ^ (z >> np.uint64(31)), np.uint64)


def minimising(problem: ProfileProblem, worlds: Worlds, declared: Declared, vehicles: Sequence[int]) -> ProfileProblem:
    """Return a copy of ``problem`` in which the search minimises the objective of the controlled vehicles.

    Raises ``InvalidInput`` if the objective is neither a weighted sum of the vehicles' harm nor ``maximin``, or if the
    controlled vehicles have different objectives. ``declared`` is one objective for all vehicles or one for each
    vehicle, as under a scenario's key ``objective``.
    """
    objectives = objectives_of(declared, worlds.N)
    if all(objectives[vehicle].kind == "total" for vehicle in vehicles):
        return problem
    aims = [aim_of(objectives[vehicle], worlds.vehicles, vehicle) for vehicle in vehicles]
    weights, largest = aims[0]
    if any(also != largest or not np.array_equal(other, weights) for other, also in aims[1:]):
        raise InvalidInput(
            f"objective {declared!r}: the {len(vehicles)} controlled vehicles have different objectives, but a search"
            " can minimise only one; give all of them the same objective, for instance weighted:1,4,1"
        )
    return problem.minimising(weights, largest=largest)


Found = tuple[Profiles, dict[HarmCount, Floats]]


def search_profiles(problem: ProfileProblem, given: Profiles, *, budget: int, seed: int = 0, threads: int = 1) -> Found:
    """Search each world for the profile with the least harm; return it and its harm [n] (m2/s2) under each harm count.

    A profile has at most ``MOST_PHASES`` phases. The harm of the returned profile is at most the harm of each profile
    of ``given``. The harm is the quantity that ``problem`` minimises. Raises ``InvalidInput`` if ``budget`` or
    ``threads`` is below 1, or if ``seed`` is negative. Raises ``PhysicsError``, which names the worlds in which the
    physics could simulate no profile.

    ``given`` [n * Q] are the starting profiles: first the Q profiles of world 0, then the Q profiles of world 1, and so
    on. ``budget`` is the approximate number of profiles that are simulated in each world.
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
        raise PhysicsError({k: "no command profile could be simulated" for k in range(n) if used[k] == 0})
    return best, problem.values(best)
