"""Profiles of commands for many worlds: what a search is given and what it finds, and what a profile does.

Worlds are independent: a world's result does not depend on its batch, its place in it, or the number of threads.
Threads run at the same time because the kernels release Python's lock.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import Bools, Floats, Ints, UInt64s
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.episode import EPISODE_ROWS, LATENCY, STEPWISE, Episode, follow_whole, harm_so_far
from ethbrake_marl.physics.impact import MASS
from ethbrake_marl.physics.segment import COMMAND, LIMIT
from ethbrake_marl.search.kernel import MOST_PHASES, SearchWorld, copy_rows, search_world
from ethbrake_marl.search.problem import ProfileProblem, seeded


class Profiles(NamedTuple):
    """One profile per world: ``commands_mps2[k, j]`` from step ``ends[k, j - 1]`` to ``ends[k, j]`` of the decisions.

    Phases beyond a world's last one are empty: they too end at the last step.
    """

    ends: Ints  # [n, K]
    commands_mps2: Floats  # [n, K, C]

    def at(self, step: Ints) -> Floats:
        """The commands in force in these steps [n]: [n, C] m/s2; beyond the last step its command goes on."""
        phase = np.minimum((self.ends <= step[:, np.newaxis]).sum(axis=1), self.ends.shape[1] - 1)
        at: Floats = self.commands_mps2[np.arange(len(phase)), phase]
        return at

    def take(self, rows: Ints | slice) -> Profiles:
        """Those of some worlds."""
        return Profiles(self.ends[rows], self.commands_mps2[rows])

    def grown(self, n: int) -> Profiles:
        """These and as many meaningless ones as make ``n`` in all; in their own memory."""
        more = n - len(self.ends)
        return Profiles(np.pad(self.ends, ((0, more), (0, 0))), np.pad(self.commands_mps2, ((0, more), (0, 0), (0, 0))))


class SearchResult(NamedTuple):
    """What a search found in each world."""

    profiles: Profiles
    first_impact_harm: Floats  # [n] of the profile, as the engine counts it (m2/s2)
    total_harm: Floats  # [n] likewise

    def harm(self, harm_count: HarmCount) -> Floats:
        """Harm under one count, [n] m2/s2."""
        return self.first_impact_harm if harm_count == "first" else self.total_harm


def constant_profiles(problem: ProfileProblem, commands_mps2: Floats) -> Profiles:
    """Profiles [n * Q] that hold the given commands [n, Q, C], divided into phases for a search to change."""
    n, Q, C = commands_mps2.shape
    borders = np.array([2, 5, 9, 14, 20] + (MOST_PHASES - 5) * [np.iinfo(np.int64).max])
    ends = np.minimum(borders, problem.last_step[:, np.newaxis])
    shape = (n, Q, MOST_PHASES)
    repeated = np.broadcast_to(commands_mps2[:, :, np.newaxis], (*shape, C))
    return Profiles(
        np.broadcast_to(ends[:, np.newaxis], shape).reshape(n * Q, MOST_PHASES).copy(),
        repeated.reshape(n * Q, MOST_PHASES, C).copy(),
    )


def even_grid(problem: ProfileProblem, number: int) -> Floats:
    """``number`` commands from each vehicle's least to its greatest, evenly spaced, both included; [n, number, C] m/s2.

    ``low + (high - low)`` may lie an ulp beyond ``high``, so the greatest is taken as it is.
    """
    low, high = problem.bounds[:, np.newaxis, :, 0], problem.bounds[:, np.newaxis, :, 1]
    share = np.linspace(0.0, 1.0, number)[:, np.newaxis]
    grid: Floats = np.minimum(low + share * (high - low), high)
    return grid


def pad_profiles(parts: Sequence[Profiles], least: int) -> list[Profiles]:
    """The same profiles, all with as many phases (at least ``least``): empty ones are added. In their own memory."""
    width = max([least, *(part.ends.shape[1] for part in parts)])
    return [
        Profiles(
            np.pad(part.ends, ((0, 0), (0, width - part.ends.shape[1])), mode="edge"),
            np.pad(part.commands_mps2, ((0, 0), (0, width - part.ends.shape[1]), (0, 0)), mode="edge"),
        )
        for part in parts
    ]


def search_profiles(
    problem: ProfileProblem, given: Profiles, *, budget: int, seed: int = 0, threads: int = 1
) -> SearchResult:
    """The best profiles of at most ``MOST_PHASES`` phases that about ``budget`` candidates per world find.

    ``given`` [n * Q]: Q profiles of each world, world by world, from which to start; the result is never worse than
    any of them. Raises ``InvalidInput`` for a budget below 1 and ``PhysicsError`` naming the worlds of which no profile
    could be followed.
    """
    for name, value, least in (("budget", budget, 1), ("threads", threads, 1), ("seed", seed, 0)):
        check_whole_number(name, value, least)
    n, C = problem.n, len(problem.vehicles)
    ends = np.ascontiguousarray(given.ends.reshape(n, -1, MOST_PHASES))
    commands = np.ascontiguousarray(given.commands_mps2.reshape(n, -1, MOST_PHASES, C))
    best = Profiles(np.zeros((n, MOST_PHASES), np.int64), np.zeros((n, MOST_PHASES, C)))
    random = seeded(problem.identity, seed)

    def work(k: int) -> int:
        world = make_search_world(
            problem.clock[k], problem.bounds[k], problem.command[k], problem.latency[k], problem.mass[k],
            problem.limit[k], problem.vehicles, random[k : k + 1],
        )  # fmt: skip
        return search_world(world, problem.start[k], ends[k], commands[k], budget, best.ends[k], best.commands_mps2[k])

    if threads == 1:
        used = [work(k) for k in range(n)]
    else:
        with ThreadPoolExecutor(threads) as pool:
            used = list(pool.map(work, range(n)))
    if 0 in used:
        raise PhysicsError({k: "no profile could be followed" for k in range(n) if used[k] == 0})
    return SearchResult(best, *follow_profiles(problem, best))


def follow_profiles(problem: ProfileProblem, profiles: Profiles) -> tuple[Floats, Floats]:
    """First-impact and total harm [n] of one profile per world, as the engine counts it, to the same bits.

    Raises ``InvalidInput`` for profiles that do not fit the problem or exceed a capacity, ``PhysicsError`` naming the
    worlds in which a check of the kernel failed.
    """
    check_profiles(problem, profiles)
    n = problem.n
    first, total, failed = np.zeros(n), np.zeros(n), np.zeros(n, np.bool_)
    follow_worlds(
        problem.start, problem.clock, problem.bounds, problem.command, problem.latency, problem.mass, problem.limit,
        problem.vehicles, np.ascontiguousarray(profiles.ends, np.int64),
        np.ascontiguousarray(profiles.commands_mps2, np.float64), first, total, failed,
    )  # fmt: skip
    if failed.any():
        raise PhysicsError({k: "its profile could not be followed" for k in np.flatnonzero(failed).tolist()})
    return first, total


def check_profiles(problem: ProfileProblem, profiles: Profiles) -> None:
    """Raise ``InvalidInput`` unless there is one profile per world, within the capacities, its phases in order."""
    n, C = problem.n, len(problem.vehicles)
    K = profiles.ends.shape[-1]
    if profiles.ends.shape != (n, K) or profiles.commands_mps2.shape != (n, K, C):
        raise InvalidInput(
            f"profiles: shapes {profiles.ends.shape} and {profiles.commands_mps2.shape}; ({n}, K) and ({n}, K, {C})"
            " are needed"
        )
    low, high = problem.bounds[:, np.newaxis, :, 0], problem.bounds[:, np.newaxis, :, 1]
    good = (profiles.commands_mps2 >= low) & (profiles.commands_mps2 <= high)
    if not good.all():
        raise InvalidInput(
            f"profiles: command {profiles.commands_mps2[~good][0]:g} m/s2 is beyond a vehicle's capacity"
        )
    ordered = (np.diff(profiles.ends, axis=1, prepend=0) >= 0).all() and (
        profiles.ends[:, -1] == problem.last_step
    ).all()
    if not ordered:
        raise InvalidInput("profiles: phases must end in order, the last one at the last step")


@compiled
def make_search_world(
    clock: Floats, bounds: Floats, command: Floats, latency: Floats, mass: Floats, limit: Floats, vehicles: Ints,
    random: UInt64s,
) -> SearchWorld:  # fmt: skip
    """One world's surroundings, with room to work in."""
    N = mass.shape[0]
    table = np.zeros((EPISODE_ROWS, N))
    for i in range(N):
        table[COMMAND, i], table[LATENCY, i] = command[i], latency[i]
        table[MASS, i], table[LIMIT, i] = mass[i], limit[i]
    return SearchWorld(Episode(table, clock.copy(), vehicles), bounds, random)


@compiled
def follow_worlds(
    start: Floats, clock: Floats, bounds: Floats, command: Floats, latency: Floats, mass: Floats, limit: Floats,
    vehicles: Ints, ends: Ints, commands: Floats, first: Floats, total: Floats, failed: Bools,
) -> None:  # fmt: skip
    """Fill ``first`` and ``total`` [n] with the harm of one profile per world, and ``failed`` [n] where it ended."""
    no_random = np.zeros(1, np.uint64)
    for k in range(start.shape[0]):
        episode = make_search_world(
            clock[k], bounds[k], command[k], latency[k], mass[k], limit[k], vehicles, no_random
        ).episode
        states = np.zeros((ends.shape[1] + 1, start.shape[1]))
        copy_rows(start[k : k + 1], states, 1)
        episode.clock[STEPWISE] = 1.0
        if follow_whole(episode, ends[k], commands[k], states, math.inf)[1] < 0:
            failed[k] = True
            continue
        first[k], total[k] = harm_so_far(episode.table, 0.0), harm_so_far(episode.table, 1.0)
