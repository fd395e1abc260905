"""Profiles of commands for many worlds: the problem that a search solves, what it finds, and what a profile does.

Worlds are independent: a world's result does not depend on its batch, its place in it, or the number of threads.
Threads run at the same time because the kernels release Python's lock.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.profile_motion import (
    CLOCK_WIDTH,
    HARM_IS_TOTAL,
    HORIZON,
    LAST_STEP,
    RESTITUTION,
    START,
    STEPWISE,
    TIME_STEP,
    Setting,
    Words,
    follow_whole,
)
from ethbrake_marl.agents.profile_search import MOST_PHASES, search_world
from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.harm import HarmCount, check_count
from ethbrake_marl.physics import Floats, Ints, Worlds, advance
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.impact import MASS
from ethbrake_marl.physics.packed import TIME, command_at, gap_at, harm_at, pack, speed_at
from ethbrake_marl.physics.segment import COMMAND, LIMIT, TABLE_ROWS

TIME_STEP_S = 0.1  # between two decisions, where nobody says otherwise
_MIX = 0xD1342543DE82EF95  # an odd number: spreads seeds over 64 bits


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


class Found(NamedTuple):
    """What a search found in each world."""

    profiles: Profiles
    first_impact_harm: Floats  # [n] of the profile, as the engine counts it (m2/s2)
    total_harm: Floats  # [n] likewise

    def harm(self, count: HarmCount) -> Floats:
        """Harm under one count, [n] m2/s2."""
        return self.first_impact_harm if count == "first" else self.total_harm


@dataclass(frozen=True, slots=True)
class ProfileProblem:
    """Whose commands are chosen, in which worlds, on which grid of decisions. Build it with ``profile_problem``."""

    vehicles: Ints  # [C] controlled, index from 0
    start: Floats  # [n, S] at the first decision
    clock: Floats  # [n, CLOCK_WIDTH]
    bounds: Floats  # [n, C, 2] m/s2
    command: Floats  # [n, N] of the others
    latency: Floats  # [n, N]
    mass: Floats  # [n, N]
    limit: Floats  # [n, N]
    identity: Words  # [n]

    @property
    def n(self) -> int:
        """Number of worlds."""
        return len(self.start)

    @property
    def last_step(self) -> Ints:
        """Number of decisions up to the horizon, [n]."""
        return self.clock[:, LAST_STEP].astype(np.int64)


def profile_problem(
    worlds: Worlds,
    vehicles: Sequence[int],
    *,
    count: HarmCount = "first",
    horizon_s: float = 8.0,
    time_step_s: float = TIME_STEP_S,
    others_mps2: Floats | None = None,
    deciders: Sequence[int] | None = None,
) -> ProfileProblem:
    """The problem of choosing the whole profiles of ``vehicles`` (indices from 0) so as to do the least harm.

    The first decision falls on the smallest latency of the ``deciders`` (default: ``vehicles``) or on the worlds' time,
    whichever is later; one follows every ``time_step_s``. The other vehicles follow ``others_mps2`` [n, N] (default:
    full braking; the columns of ``vehicles`` are ignored). Raises ``InvalidInput`` for no vehicle, one given twice or
    not there, an unknown count, a command beyond capacity, or a horizon before the first decision.
    """
    chosen = _checked_vehicles(vehicles, worlds.N)
    check_count(count)
    if not (0.0 < time_step_s < math.inf and 0.0 < horizon_s < math.inf):
        raise InvalidInput(f"time_step_s {time_step_s!r}, horizon_s {horizon_s!r}: must be positive numbers of seconds")
    v = worlds.vehicles
    command = -v.braking_capacity_mps2 if others_mps2 is None else np.array(others_mps2, np.float64)
    if command.shape != worlds.speeds_mps.shape:
        raise InvalidInput(f"others_mps2: shape {command.shape}; {worlds.speeds_mps.shape} is needed")
    command[:, chosen] = 0.0
    decide = _checked_vehicles(vehicles if deciders is None else deciders, worlds.N)
    first = np.maximum(v.latency_s[:, decide].min(axis=1), worlds.time_s)
    if not (first < horizon_s).all():
        raise InvalidInput(f"horizon_s {horizon_s:g}: must be after the first decision at {first.max():g} s")
    clock = np.empty((worlds.n, CLOCK_WIDTH))
    clock[:, START], clock[:, TIME_STEP], clock[:, HORIZON] = first, time_step_s, horizon_s
    clock[:, LAST_STEP] = np.ceil((horizon_s - first) / time_step_s - 1e-9)
    clock[:, RESTITUTION], clock[:, HARM_IS_TOTAL], clock[:, STEPWISE] = v.restitution, count == "total", 0.0
    bounds = np.stack([-v.braking_capacity_mps2[:, chosen], v.driving_capacity_mps2[:, chosen]], axis=2)
    after, impacts = advance(worlds, command, until_s=first)
    start = [after.speeds_mps, after.gaps_m, after.pair_hit, impacts.first_impact_harm, impacts.total_harm]
    return ProfileProblem(
        chosen, np.concatenate(start, axis=1), clock, np.ascontiguousarray(bounds), command, v.latency_s, v.mass_t,
        v.speed_limit_mps, identities(worlds, command, clock, chosen),
    )  # fmt: skip


def identities(worlds: Worlds, command: Floats, clock: Floats, vehicles: Ints) -> Words:
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
        params,
        command,
        clock[:, [START, TIME_STEP, LAST_STEP, HORIZON]],
        who,
    ]
    rows = np.ascontiguousarray(np.concatenate(parts, axis=1) + 0.0, "<f8")  # + 0.0: one zero, not two
    digests = [hashlib.blake2b(row.tobytes(), digest_size=8).digest() for row in rows]
    return np.frombuffer(b"".join(digests), "<u8").astype(np.uint64)


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


def search_profiles(problem: ProfileProblem, given: Profiles, *, budget: int, seed: int = 0, threads: int = 1) -> Found:
    """The best profiles of at most ``MOST_PHASES`` phases that about ``budget`` candidates per world find.

    ``given`` [n * Q]: Q profiles of each world, world by world, from which to start; the result is never worse than
    any of them. Raises ``InvalidInput`` for a budget below 1 and ``PhysicsError`` if no profile of a world could be
    advanced.
    """
    for name, value, least in (("budget", budget, 1), ("threads", threads, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or not value >= least:
            raise InvalidInput(f"{name} = {value!r}: must be a whole number, at least {least}")
    n, C = problem.n, len(problem.vehicles)
    ends = np.ascontiguousarray(given.ends.reshape(n, -1, MOST_PHASES))
    commands = np.ascontiguousarray(given.commands_mps2.reshape(n, -1, MOST_PHASES, C))
    best = Profiles(np.zeros((n, MOST_PHASES), np.int64), np.zeros((n, MOST_PHASES, C)))
    random = seeded(problem.identity, seed)
    failed = np.full(n, False)

    def work(rows: Ints) -> None:
        search_worlds(
            rows, problem.start, problem.clock, problem.bounds, problem.command, problem.latency, problem.mass,
            problem.limit, problem.vehicles, random, ends, commands, budget, best.ends, best.commands_mps2, failed,
        )  # fmt: skip

    if threads == 1 or n == 1:
        work(np.arange(n))
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, [np.arange(k, min(k + 1, n)) for k in range(n)]))
    if failed.any():
        raise PhysicsError(f"search: world {int(np.argmax(failed))} could not be advanced")
    return Found(best, *follow_profiles(problem, best))


def follow_profiles(problem: ProfileProblem, profiles: Profiles) -> tuple[Floats, Floats]:
    """First-impact and total harm [n] of one profile per world, as the engine counts it, to the same bits.

    Raises ``InvalidInput`` for profiles that do not fit the problem or exceed a capacity.
    """
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
    first, total = np.zeros(n), np.zeros(n)
    failed = follow_worlds(
        problem.start, problem.clock, problem.bounds, problem.command, problem.latency, problem.mass, problem.limit,
        problem.vehicles, np.ascontiguousarray(profiles.ends, np.int64),
        np.ascontiguousarray(profiles.commands_mps2, np.float64), first, total,
    )  # fmt: skip
    if failed >= 0:
        raise PhysicsError(f"profiles: world {failed} could not be advanced")
    return first, total


def seeded(identity: Words, seed: int) -> Words:
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


@compiled
def make_setting(
    clock: Floats, bounds: Floats, command: Floats, latency: Floats, mass: Floats, limit: Floats, vehicles: Ints,
    random: Words,
) -> Setting:  # fmt: skip
    """One world's setting, with room to work in."""
    N = mass.shape[0]
    table = np.zeros((TABLE_ROWS, N))
    table[COMMAND] = command
    table[MASS] = mass
    table[LIMIT] = limit
    return Setting(table, np.zeros((2, N - 1)), latency, clock.copy(), vehicles, bounds, random)


@compiled
def search_worlds(
    rows: Ints, start: Floats, clock: Floats, bounds: Floats, command: Floats, latency: Floats, mass: Floats,
    limit: Floats, vehicles: Ints, random: Words, seed_ends: Ints, seed_commands: Floats, budget: int,
    ends: Ints, commands: Floats, failed: Floats,
) -> None:  # fmt: skip
    """Search these rows; fills ``ends`` [n, K], ``commands`` [n, K, C] and ``failed`` [n]."""
    for k in rows:
        world = make_setting(
            clock[k], bounds[k], command[k], latency[k], mass[k], limit[k], vehicles, random[k : k + 1]
        )
        used = search_world(world, start[k], seed_ends[k], seed_commands[k], budget, ends[k], commands[k])
        failed[k] = used == 0
        for j in range(used, ends.shape[1]):
            ends[k, j] = clock[k, LAST_STEP]
            commands[k, j] = commands[k, used - 1]


@compiled
def follow_worlds(
    start: Floats, clock: Floats, bounds: Floats, command: Floats, latency: Floats, mass: Floats, limit: Floats,
    vehicles: Ints, ends: Ints, commands: Floats, first: Floats, total: Floats,
) -> int:  # fmt: skip
    """Fill ``first`` and ``total`` [n] with the harm of one profile per world; a world that failed, or -1."""
    no_random = np.zeros(1, np.uint64)
    for k in range(start.shape[0]):
        world = make_setting(clock[k], bounds[k], command[k], latency[k], mass[k], limit[k], vehicles, no_random)
        states = np.zeros((ends.shape[1] + 1, start.shape[1]))
        states[0] = start[k]
        world.clock[STEPWISE] = 1.0
        if follow_whole(world, ends[k], commands[k], states, math.inf)[1] < 0:
            return k
        for p in range(mass.shape[1] - 1):
            first[k] += world.harm[0, p]
            total[k] += world.harm[1, p]
    return -1
