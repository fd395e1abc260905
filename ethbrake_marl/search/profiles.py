"""Profiles of commands for many worlds: what a search is given and what it finds, and what a profile does.

Worlds are independent: a world's result does not depend on its batch, its place in it, or the number of threads.
Threads run at the same time because the kernels release Python's lock.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number
from ethbrake_marl.harm import check_harm_count
from ethbrake_marl.physics import Bools, Floats, Ints, UInt64s, Worlds, advance
from ethbrake_marl.physics.advance import TIME, command_at, gap_at, harm_at, pack, params_at, speed_at
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.episode import (
    CLOCK_WIDTH,
    EPISODE_ROWS,
    HARM_IS_TOTAL,
    HORIZON,
    LAST_STEP,
    LATENCY,
    RESTITUTION,
    START,
    STEPWISE,
    TIME_STEP,
    Episode,
    first_decision_s,
    follow_whole,
    harm_so_far,
    number_of_decisions,
)
from ethbrake_marl.physics.kernel import COMMAND, LIMIT, MASS, ahead, obstacle_ahead, with_obstacle
from ethbrake_marl.search.kernel import MOST_PHASES, SearchWorld, copy_rows, search_world

# The problem of choosing whole profiles: whose, in which worlds, on which grid of decisions.

TIME_STEP_S = 0.1  # between two decisions, where nobody says otherwise
PER_WORLD = ("start", "clock", "bounds", "command", "latency", "mass", "limit", "identity")  # arrays of a problem
_MIX = 0xD1342543DE82EF95  # an odd number: spreads seeds over 64 bits


@dataclass(frozen=True, slots=True)
class ProfileProblem:
    """Whose commands are chosen, in which worlds, on which grid of decisions. Build it with ``profile_problem``."""

    vehicles: Ints  # [C] controlled, index from 0; in lines with an obstacle from 1, it being vehicle 0 of every column
    start: Floats  # [n, S] at the first decision
    clock: Floats  # [n, CLOCK_WIDTH]
    bounds: Floats  # [n, C, 2] m/s2
    command: Floats  # [n, N] of the others
    latency: Floats  # [n, N]
    mass: Floats  # [n, N]
    limit: Floats  # [n, N]
    identity: UInt64s  # [n]

    @property
    def n(self) -> int:
        """Number of worlds."""
        return len(self.start)

    def take(self, rows: Ints) -> ProfileProblem:
        """That of some of the worlds."""
        return replace(self, **{name: getattr(self, name)[rows] for name in PER_WORLD})

    @property
    def last_step(self) -> Ints:
        """Number of decisions up to the horizon, [n]."""
        return self.clock[:, LAST_STEP].astype(np.int64)


def profile_problem(
    worlds: Worlds,
    vehicles: Sequence[int],
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    time_step_s: float = TIME_STEP_S,
    others_mps2: Floats | None = None,
    deciders: Sequence[int] | None = None,
) -> ProfileProblem:
    """The problem of choosing the whole profiles of ``vehicles`` (indices from 0) so as to do the least harm.

    The first decision falls on the smallest latency of the ``deciders`` (default: ``vehicles``) or on the worlds' time,
    whichever is later; one follows every ``time_step_s``. An obstacle ahead is written out as a vehicle in front
    (``physics.obstacle``): all columns of the problem are those of that line. The other vehicles follow ``others_mps2``
    [n, N] (default: full braking; the columns of ``vehicles`` are ignored). Raises ``InvalidInput`` for no vehicle, one
    given twice or not there, an unknown count, a command beyond capacity, a horizon before the first decision, or
    worlds of which only some have an obstacle.
    """
    chosen = _checked_vehicles(vehicles, worlds.N)
    check_harm_count(harm_count)
    if not (0.0 < time_step_s < math.inf and 0.0 < horizon_s < math.inf):
        raise InvalidInput(f"time_step_s {time_step_s!r}, horizon_s {horizon_s!r}: must be positive numbers of seconds")
    v = worlds.vehicles
    command = -v.braking_capacity_mps2 if others_mps2 is None else np.array(others_mps2, np.float64)
    if command.shape != worlds.speeds_mps.shape:
        raise InvalidInput(f"others_mps2: shape {command.shape}; {worlds.speeds_mps.shape} is needed")
    command[:, chosen] = 0.0
    obstacle = obstacle_ahead(worlds)
    if obstacle.any():
        if not obstacle.all():
            raise InvalidInput("profiles: only some of the worlds have an obstacle ahead (obstacle_gap_m), not all")
        return profile_problem(
            with_obstacle(worlds),
            [i + 1 for i in chosen.tolist()],
            harm_count=harm_count,
            horizon_s=horizon_s,
            time_step_s=time_step_s,
            others_mps2=ahead(0.0, command),
            deciders=None if deciders is None else [i + 1 for i in deciders],
        )
    decide = _checked_vehicles(vehicles if deciders is None else deciders, worlds.N)
    first = first_decision_s(worlds, decide.tolist())
    if not (first < horizon_s).all():
        raise InvalidInput(f"horizon_s {horizon_s:g}: must be after the first decision at {first.max():g} s")
    clock = np.empty((worlds.n, CLOCK_WIDTH))
    clock[:, START], clock[:, TIME_STEP], clock[:, HORIZON] = first, time_step_s, horizon_s
    clock[:, LAST_STEP] = number_of_decisions(first, time_step_s, horizon_s)
    clock[:, RESTITUTION], clock[:, HARM_IS_TOTAL], clock[:, STEPWISE] = v.restitution, harm_count == "total", 0.0
    bounds = np.stack([-v.braking_capacity_mps2[:, chosen], v.driving_capacity_mps2[:, chosen]], axis=2)
    after, impacts = advance(worlds, command, until_s=first)
    start = [after.speeds_mps, after.gaps_m, after.pair_hit, impacts.first_impact_harm, impacts.total_harm]
    return ProfileProblem(
        chosen, np.concatenate(start, axis=1), clock, np.ascontiguousarray(bounds), command, v.latency_s, v.mass_t,
        v.speed_limit_mps, identities(worlds, command, clock, chosen),
    )  # fmt: skip


def state_columns(worlds: Worlds) -> Floats:
    """The worlds as they are now, in the columns of ``ProfileProblem.start`` before the harm: speeds, gaps, hit flags.

    Raises ``InvalidInput`` for worlds of which only some have an obstacle ahead.
    """
    obstacle = obstacle_ahead(worlds)
    if obstacle.any():
        if not obstacle.all():
            raise InvalidInput("profiles: only some of the worlds have an obstacle ahead (obstacle_gap_m), not all")
        worlds = with_obstacle(worlds)
    return np.concatenate([worlds.speeds_mps, worlds.gaps_m, worlds.pair_hit], axis=1)


def worlds_at(worlds: Worlds, states: Floats) -> Worlds:
    """These worlds in the states [n, S] of a problem with them: speeds, gaps, hit flags, and those of the obstacle."""
    added = int(obstacle_ahead(worlds).any())  # columns in front of each group
    N = worlds.N + added
    gaps, hit = states[:, N : 2 * N - 1], states[:, 2 * N - 1 : 3 * N - 2] == 1.0
    return replace(
        worlds,
        speeds_mps=states[:, added:N].copy(),
        gaps_m=gaps[:, added:].copy(),
        pair_hit=hit[:, added:].copy(),
        obstacle_gap_m=gaps[:, 0].copy() if added else worlds.obstacle_gap_m,
        obstacle_hit=hit[:, 0].copy() if added else worlds.obstacle_hit,
    )


def identities(worlds: Worlds, command: Floats, clock: Floats, vehicles: Ints) -> UInt64s:
    """What tells one world's problem from another's, [n]: 8 bytes of BLAKE2b over all that the harm depends on.

    State and parameters of the world, the other vehicles' commands, the decisions (first, step, number), the horizon
    and the controlled vehicles; not the count.
    """
    state, params = pack(worlds)
    N = worlds.N
    who = np.zeros((worlds.n, N))
    who[:, vehicles] = 1.0
    parts = [
        state[:, [TIME]],
        state[:, speed_at(N) : command_at(N)],
        state[:, gap_at(N) : harm_at(N)],
        params[:, : params_at(5, N)],  # the news of others changes no harm
        command,
        clock[:, [START, TIME_STEP, LAST_STEP, HORIZON]],
        who,
    ]
    rows = np.ascontiguousarray(np.concatenate(parts, axis=1) + 0.0, "<f8")  # + 0.0: one zero, not two
    digests = [hashlib.blake2b(row.tobytes(), digest_size=8).digest() for row in rows]
    return np.frombuffer(b"".join(digests), "<u8").astype(np.uint64)


def seeded(identity: UInt64s, seed: int) -> UInt64s:
    """The first state of each world's random numbers, [n]: a function of its identity and the seed alone."""
    with np.errstate(over="ignore"):
        z = identity ^ np.uint64((int(seed) * _MIX) % 2**64)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return np.asarray(z ^ (z >> np.uint64(31)), np.uint64)


def _checked_vehicles(vehicles: Sequence[int], N: int) -> Ints:
    chosen = list(vehicles)
    if not chosen or len(set(chosen)) != len(chosen) or not all(0 <= i < N for i in chosen):
        raise InvalidInput(f"vehicles {tuple(chosen)}: at least one is needed, each once, from 0 to {N - 1}")
    return np.array(chosen, np.int64)


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
