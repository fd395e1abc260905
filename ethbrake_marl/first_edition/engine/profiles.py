"""The problem that searches and shields solve: which commands over a whole episode cause the least harm?

A *profile* contains the commands of the controlled vehicles from the first decision to the horizon. A profile consists
of at most K phases, with constant commands in each. A phase ends at a decision. C is the number of controlled vehicles.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount, check_harm_count, line_sum, split
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.columns import Packed
from ethbrake_marl.first_edition.physics.episode import (
    CLOCK,
    LARGEST,
    WEIGHTED,
    WHOLE,
    Decisions,
    Episode,
    follow_whole,
)
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.rows import ROW, place_rates, rows_for
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, UInt64s, Worlds, sum_rows

MOST_PHASES = 12


class SearchWorld(NamedTuple):
    """One world of a ``ProfileProblem``, prepared so that a search can simulate many profiles in this world."""

    episode: Episode  # working memory in which the world is simulated (``physics.episode``)
    bounds: Floats  # [C, 2] smallest and largest command of each controlled vehicle (m/s2)
    random: UInt64s  # [1] state of the world's random generator


@compiled
def copy_rows(rows: Floats, to_rows: Floats, n: int) -> None:
    """Copy the first ``n`` rows of ``rows`` to the first ``n`` rows of ``to_rows``, element by element.

    ``to_rows[:n] = rows[:n]`` would take ten times longer to compile, because numba would also compile the error
    message of this assignment.
    """
    for k in range(n):
        for c in range(rows.shape[1]):
            to_rows[k, c] = rows[k, c]


TIME_STEP_S = 0.1  # default time between two decisions


class ProfileProblem(NamedTuple):
    """The problem of choosing command profiles of the controlled vehicles in n worlds; made by ``profile_problem``.

    If there is an obstacle ahead, the obstacle has index 0 in all arrays, and Vehicle 1 has index 1.
    """

    vehicles: Ints  # [C] indices of the controlled vehicles
    start: Floats  # [n, S] state at the first decision, as ``physics.episode.save`` stores it
    clock: Floats  # [n, CLOCK.WIDTH] times and numbers of the decisions, and settings; see ``physics.episode``
    bounds: Floats  # [n, C, 2] smallest and largest command of the controlled vehicles (m/s2)
    command: Floats  # [n, N] commands of the other vehicles, 0 for the controlled ones (m/s2)
    latency: Floats  # [n, N] latencies (s)
    mass: Floats  # [n, N] masses (t)
    limit: Floats  # [n, N] speed limits (m/s)
    brake_rate: Floats  # [n, N] rates at which brakes build up (m/s3)
    release_rate: Floats  # [n, N] rates at which brakes are released (m/s3)
    pieces: Floats  # [n, N, 2 K] braking profiles of scripts with K pieces, as in ``Vehicles``
    identity: UInt64s  # [n] hash of each world's problem, see ``identities``
    weights: Floats  # [n, 2, N] of each pair: share of the front vehicle times the weight of its harm; of the rear one

    @property
    def n(self) -> int:
        """Number of worlds."""
        return len(self.start)

    def take(self, rows: Ints) -> ProfileProblem:
        """Return this problem restricted to the worlds with the indices ``rows``."""
        arrays: dict[str, Any] = {name: getattr(self, name)[rows] for name in self._fields[1:]}
        return self._replace(**arrays)

    def put(self, rows: Ints, new: ProfileProblem) -> ProfileProblem:
        """Return a copy of this problem in which the worlds of ``new`` replace the worlds with the indices ``rows``."""
        arrays: dict[str, Any] = {name: getattr(self, name).copy() for name in self._fields[1:]}
        for name, array in arrays.items():
            array[rows] = getattr(new, name)
        return self._replace(**arrays)

    @property
    def last_step(self) -> Ints:
        """Number of decisions before the horizon in each world, [n]."""
        return self.clock[:, CLOCK.LAST_STEP].astype(np.int64)

    def constant(self, commands_mps2: Floats) -> Profiles:
        """Return profiles in which each controlled vehicle keeps one command from the first decision to the horizon.

        ``commands_mps2`` [n, Q, C] contains Q commands for each world and controlled vehicle. The result has n * Q
        profiles: first the Q profiles of world 0, then the Q profiles of world 1, and so on. Each profile has
        ``MOST_PHASES`` phases with the same command; a search can later change single phases.
        """
        n, Q, C = commands_mps2.shape
        borders = np.array([2, 5, 9, 14, 20] + (MOST_PHASES - 5) * [np.iinfo(np.int64).max])
        ends = np.minimum(borders, self.last_step[:, np.newaxis])
        shape = (n, Q, MOST_PHASES)
        repeated = np.broadcast_to(commands_mps2[:, :, np.newaxis], (*shape, C))
        return Profiles(
            np.broadcast_to(ends[:, np.newaxis], shape).reshape(n * Q, MOST_PHASES).copy(),
            repeated.reshape(n * Q, MOST_PHASES, C).copy(),
        )

    def even_grid(self, number: int) -> Floats:
        """Return ``number`` evenly spaced commands for each controlled vehicle, [n, number, C] m/s2.

        The commands range from full braking to full driving. No command exceeds a capacity, not even by a rounding
        error.
        """
        low, high = self.bounds[:, np.newaxis, :, 0], self.bounds[:, np.newaxis, :, 1]
        share = np.linspace(0.0, 1.0, number)[:, np.newaxis]
        return np.asarray(np.minimum(low + share * (high - low), high), np.float64)

    def minimising(self, weights: Floats, *, largest: bool = False) -> ProfileProblem:
        """Return a copy of this problem in which searches minimise a weighted harm of the vehicles.

        ``weights`` [n, N] (at least 0) are the weights of the harm that each vehicle bears; an obstacle has no weight.
        If ``largest`` is True, searches minimise the largest weighted harm of a vehicle, otherwise the sum of all
        weighted harms. The harm count and the field ``identity`` do not change.
        """
        mass, obstacle = self.mass, self.mass.shape[1] - weights.shape[1]
        weights = np.pad(weights, ((0, 0), (obstacle, 0)))
        pairs, clock = np.zeros((self.n, 2, mass.shape[1])), self.clock.copy()
        front = mass[:, 1:] / (mass[:, :-1] + mass[:, 1:])  # 0 of an obstacle, whose mass is infinite
        pairs[:, 0, :-1], pairs[:, 1, :-1] = weights[:, :-1] * front, weights[:, 1:] * (1.0 - front)
        clock[:, CLOCK.AIM] = LARGEST if largest else WEIGHTED
        return self._replace(weights=pairs, clock=clock)

    def follow(self, profiles: Profiles) -> tuple[Floats, Floats]:
        """Return first-impact harm and total harm of each world if the vehicles follow ``profiles``, [n] m2/s2 each.

        An engine whose vehicles follow the same commands computes exactly the same harm, to the last bit. Raises
        ``InvalidInput`` for profiles that do not fit the problem or exceed a capacity, and ``PhysicsError``, which
        lists the worlds in which a check of the physics failed.
        """
        first, total = self.follow_pairs(profiles)
        return line_sum(first, np.zeros(self.n)), line_sum(total, np.zeros(self.n))

    def values(self, profiles: Profiles) -> dict[HarmCount, Floats]:
        """Return the value that a search minimises if the vehicles follow ``profiles``: {harm count: value, [n] m2/s2}.

        The value is the harm summed over the line. In a problem that ``minimising`` has returned, the value is instead
        the sum of the vehicles' weighted harms, or the largest of these harms. Raises the same errors as ``follow``.
        """
        if (self.clock[:, CLOCK.AIM] == WHOLE).all():
            return dict(zip(HARM_COUNTS, self.follow(profiles), strict=True))
        harms: dict[HarmCount, Floats] = {}
        for harm_count, pairs in zip(HARM_COUNTS, self.follow_pairs(profiles), strict=True):
            shares = np.zeros(self.mass.shape)
            shares[:, :-1] = self.weights[:, 0, :-1] * pairs
            shares[:, 1:] += self.weights[:, 1, :-1] * pairs
            largest = self.clock[:, CLOCK.AIM] == LARGEST
            harms[harm_count] = np.where(largest, shares.max(axis=1), sum_rows(shares))
        return harms

    def borne(self, profiles: Profiles) -> dict[HarmCount, Floats]:
        """Return the harm that each vehicle bears if the vehicles follow ``profiles``: {harm count: [n, N] m2/s2}.

        The returned arrays have no column for an obstacle. An engine whose vehicles follow the same commands counts the
        same harm, to the last bit. Raises the same errors as ``follow``.
        """
        obstacle, harms = int(np.isinf(self.mass[:, 0]).any()), {}
        for harm_count, pairs in zip(HARM_COUNTS, self.follow_pairs(profiles), strict=True):
            harms[harm_count] = split(np.ascontiguousarray(pairs[:, obstacle:]), self.mass[:, obstacle:].copy())
            if obstacle:
                harms[harm_count][:, 0] += pairs[:, 0]
        return harms

    def follow_pairs(self, profiles: Profiles) -> tuple[Floats, Floats]:
        """Return first-impact harm and total harm of each pair if the vehicles follow ``profiles``, [n, P] m2/s2 each.

        If there is an obstacle ahead, the first pair consists of the obstacle and Vehicle 1. Raises the same errors as
        ``follow``.
        """
        self.check(profiles)
        shape = self.n, self.mass.shape[1] - 1
        first, total, failed = np.zeros(shape), np.zeros(shape), np.zeros(self.n, np.bool_)
        ends, commands = np.ascontiguousarray(profiles.ends, np.int64), np.ascontiguousarray(profiles.commands_mps2)
        follow_worlds(self, ends, commands, first, total, failed)
        if failed.any():
            raise PhysicsError({k: "its profile could not be simulated" for k in np.flatnonzero(failed).tolist()})
        return first, total

    def check(self, profiles: Profiles) -> None:
        """Raise ``InvalidInput`` for profiles that do not fit this problem.

        There must be one profile per world, and its commands must be within the vehicles' capacities. No phase may end
        before the previous phase ends, and the last phase must end at the last step.
        """
        n, C = self.n, len(self.vehicles)
        K = profiles.ends.shape[-1]
        if profiles.ends.shape != (n, K) or profiles.commands_mps2.shape != (n, K, C):
            raise InvalidInput(
                f"profiles: ends has the shape {profiles.ends.shape} and commands_mps2 {profiles.commands_mps2.shape};"
                f" the shapes must be ({n}, K) and ({n}, K, {C})"
            )
        low, high = self.bounds[:, np.newaxis, :, 0], self.bounds[:, np.newaxis, :, 1]
        good = (profiles.commands_mps2 >= low) & (profiles.commands_mps2 <= high)
        if not good.all():
            raise InvalidInput(
                f"profiles: command {profiles.commands_mps2[~good][0]:g} m/s2 is beyond a vehicle's capacity"
            )
        ordered = (np.diff(profiles.ends, axis=1, prepend=0) >= 0).all() and (
            profiles.ends[:, -1] == self.last_step
        ).all()
        if not ordered:
            raise InvalidInput(
                "profiles: ends (the steps at which phases end) must not decrease within a profile, and the last phase"
                " of each profile must end at the last step"
            )


def profile_problem(
    worlds: Worlds,
    vehicles: Sequence[int],
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    time_step_s: float = TIME_STEP_S,
    others_mps2: Floats | None = None,
    deciders: Sequence[int] | None = None,
    written_out: bool = False,
) -> ProfileProblem:
    """Return the problem of choosing commands of some vehicles over a whole episode, such that the harm is least.

    Args:
        worlds: n worlds.
        vehicles: indices of the controlled vehicles (0 = front).
        harm_count: harm to minimise: ``first`` (first-impact harm) or ``total`` (total harm).
        horizon_s: time after the alert at which the episodes end, s.
        time_step_s: time between two decisions, s.
        others_mps2: constant commands of the other vehicles, [n, N] m/s2 (columns of ``vehicles`` are ignored); None:
            full braking.
        deciders: indices of vehicles; the first decision is at their shortest latency or, if this latency has already
            elapsed in a world, at the world's present time. None: ``vehicles``.
        written_out: whether the arrays contain an obstacle, as an additional vehicle in front
            (``Worlds.with_obstacle``), even if no world has an obstacle. If some world has an obstacle, the arrays
            always contain one. Worlds without an obstacle then get an obstacle that no vehicle can reach.

    Raises ``InvalidInput`` if ``vehicles`` is empty, repeats an index or contains an unknown index, if the harm count
    is unknown, if a command exceeds a capacity, or if the horizon is not after the first decision.

    """
    chosen = _checked_vehicles(vehicles, worlds.N)
    check_harm_count(harm_count)
    if not (0.0 < time_step_s < math.inf and 0.0 < horizon_s < math.inf):
        raise InvalidInput(
            f"time_step_s = {time_step_s!r}, horizon_s = {horizon_s!r}: must be finite numbers of seconds above 0"
        )
    v = worlds.vehicles
    command = -v.braking_capacity_mps2 if others_mps2 is None else np.array(others_mps2, np.float64)
    if command.shape != worlds.speeds_mps.shape:
        raise InvalidInput(f"others_mps2: has shape {command.shape}; must have shape {worlds.speeds_mps.shape}")
    command[:, chosen] = 0.0
    obstacle = worlds.obstacle_ahead
    if obstacle.any() or written_out:
        problem = profile_problem(
            worlds.with_post_ahead(np.full(worlds.n, horizon_s)).with_obstacle(),
            [i + 1 for i in chosen.tolist()],
            harm_count=harm_count,
            horizon_s=horizon_s,
            time_step_s=time_step_s,
            others_mps2=np.concatenate([np.zeros((len(command), 1)), command], axis=1),
            deciders=None if deciders is None else [i + 1 for i in deciders],
        )
        if not obstacle.all():  # the identity of a world must not depend on the other worlds
            free = np.flatnonzero(~obstacle)
            problem.identity[free] = profile_problem(
                worlds.take(free), vehicles, harm_count=harm_count, horizon_s=horizon_s, time_step_s=time_step_s,
                others_mps2=command[free], deciders=deciders,
            ).identity  # fmt: skip
        return problem
    decide = _checked_vehicles(vehicles if deciders is None else deciders, worlds.N)
    first = worlds.first_decision_s(decide.tolist())
    if not (first < horizon_s).all():
        raise InvalidInput(f"horizon_s = {horizon_s:g}: must be after the first decision at {first.max():g} s")
    clock = np.empty((worlds.n, CLOCK.WIDTH))
    clock[:, CLOCK.START], clock[:, CLOCK.TIME_STEP], clock[:, CLOCK.HORIZON] = first, time_step_s, horizon_s
    clock[:, CLOCK.LAST_STEP], clock[:, CLOCK.AIM] = Decisions(first, time_step_s).before(horizon_s), WHOLE
    clock[:, CLOCK.RESTITUTION], clock[:, CLOCK.HARM_IS_TOTAL], clock[:, CLOCK.STEPWISE] = (
        v.restitution,
        harm_count == "total",
        0.0,
    )
    bounds = np.stack([-v.braking_capacity_mps2[:, chosen], v.driving_capacity_mps2[:, chosen]], axis=2)
    after, impacts = advance(worlds, command, until_s=first)
    harm = [impacts.first_impact_harm, impacts.total_harm]
    start = [after.speeds_mps, after.gaps_m, after.pair_hit, *harm, after.command_mps2]
    return ProfileProblem(
        chosen, np.concatenate(start, axis=1), clock, np.ascontiguousarray(bounds), command, v.latency_s, v.mass_t,
        v.speed_limit_mps, v.brake_rate_mps3, v.release_rate_mps3, v.pieces,
        identities(worlds, command, clock, chosen), np.zeros((worlds.n, 2, worlds.N)),
    )  # fmt: skip


def identities(worlds: Worlds, command: Floats, clock: Floats, vehicles: Ints) -> UInt64s:
    """Return a hash for each world, [n]: 8 bytes of BLAKE2b over all data that affect the harm of a profile.

    These data are the world's state and parameters, the ``command`` [n, N] of the vehicles that are not controlled, the
    times of decisions and the horizon in ``clock``, and the indices ``vehicles`` of the controlled vehicles. The hash
    is the same for first-impact harm and total harm.
    """
    packed = Packed.of(worlds)
    (state, params), column = packed, packed.column
    who = np.zeros((worlds.n, worlds.N))
    who[:, vehicles] = 1.0
    parts = [
        state[:, [column.time]],
        state[:, column.speed : column.command],
        state[:, column.gap : column.harm],
        params[:, : column.brake_rate],  # without messages, which do not affect the harm
        command,
        clock[:, [CLOCK.START, CLOCK.TIME_STEP, CLOCK.LAST_STEP, CLOCK.HORIZON]],
        who,
    ]
    rows = np.ascontiguousarray(np.concatenate(parts, axis=1) + 0.0, "<f8")  # + 0.0 turns -0.0 into 0.0
    slow = worlds.vehicles.build_up  # other worlds keep the hashes of versions without build-up rates
    forces = np.concatenate(
        [state[:, column.command : column.previous], params[:, column.brake_rate : column.harm_weight]], 1
    )
    further = [forces[k].tobytes() if slow[k] else b"" for k in range(worlds.n)]
    for k in np.flatnonzero(worlds.vehicles.in_pieces):
        pieces = worlds.vehicles.pieces[k]
        there = np.isfinite(pieces)  # without the padding, which depends on the other worlds
        further[k] += there.sum(axis=1).astype("<i8").tobytes() + pieces[there].astype("<f8").tobytes()
    digests = [hashlib.blake2b(row.tobytes() + further[k], digest_size=8).digest() for k, row in enumerate(rows)]
    return np.frombuffer(b"".join(digests), "<u8").astype(np.uint64)


def _checked_vehicles(vehicles: Sequence[int], N: int) -> Ints:
    chosen = list(vehicles)
    if not chosen or len(set(chosen)) != len(chosen) or not all(0 <= i < N for i in chosen):
        raise InvalidInput(
            f"vehicles = {tuple(chosen)}: must be one or more vehicle indices from 0 to {N - 1}, without repetition"
        )
    return np.array(chosen, np.int64)


class Profiles(NamedTuple):
    """One profile per world: phase j of world k lasts from decision ``ends[k, j - 1]`` (0 if j = 0) to ``ends[k, j]``.

    During phase j of world k the commands ``commands_mps2[k, j]`` apply. Phases that a profile does not need are empty:
    they begin and end at the last step.
    """

    ends: Ints  # [n, K] number of the decision at which each phase ends
    commands_mps2: Floats  # [n, K, C] commands in each phase

    def at(self, step: Ints) -> Floats:
        """Return the commands that apply right after decision number ``step`` [n] (from 0) of each world, [n, C] m/s2.

        The command of the last phase also applies after the end of this phase.
        """
        phase = np.minimum((self.ends <= step[:, np.newaxis]).sum(axis=1), self.ends.shape[1] - 1)
        return np.asarray(self.commands_mps2[np.arange(len(phase)), phase], np.float64)

    def take(self, rows: Ints | slice) -> Profiles:
        """Return the profiles of only the worlds with the indices ``rows``."""
        return Profiles(self.ends[rows], self.commands_mps2[rows])

    @staticmethod
    def padded(parts: Sequence[Profiles], least: int) -> list[Profiles]:
        """Return copies of the profiles ``parts``, all with the same number of phases (at least ``least``).

        An added phase is empty: it begins and ends where the profile's last phase ends.
        """
        width = max([least, *(part.ends.shape[1] for part in parts)])
        return [
            Profiles(
                np.pad(part.ends, ((0, 0), (0, width - part.ends.shape[1])), mode="edge"),
                np.pad(part.commands_mps2, ((0, 0), (0, width - part.ends.shape[1]), (0, 0)), mode="edge"),
            )
            for part in parts
        ]


@compiled
def make_search_world(problem: ProfileProblem, k: int, random: UInt64s) -> SearchWorld:
    """Return world number ``k`` of ``problem``, with working memory of its own for simulations.

    ``random`` [n] contains the state of each world's random generator; the result contains entry ``k`` as a view (not a
    copy).
    """
    N = problem.mass.shape[1]
    table = np.zeros((rows_for(problem.pieces.shape[2]), N))
    for i in range(N):
        table[ROW.COMMAND, i], table[ROW.LATENCY, i] = problem.command[k, i], problem.latency[k, i]
        table[ROW.MASS, i], table[ROW.LIMIT, i] = problem.mass[k, i], problem.limit[k, i]
        table[ROW.FRONT_WEIGHT, i], table[ROW.REAR_WEIGHT, i] = problem.weights[k, 0, i], problem.weights[k, 1, i]
    place_rates(table, problem.brake_rate[k], problem.release_rate[k], problem.pieces[k])
    return SearchWorld(Episode(table, problem.clock[k].copy(), problem.vehicles), problem.bounds[k], random[k : k + 1])


@compiled
def follow_worlds(
    problem: ProfileProblem, ends: Ints, commands: Floats, first: Floats, total: Floats, failed: Bools
) -> None:
    """Simulate one profile in each world, and write the harm of each pair to ``first`` and ``total``.

    ``first`` receives the first-impact harm and ``total`` the total harm, [n, P] m2/s2. ``ends`` and ``commands`` are
    the fields of ``Profiles``. If a check of the physics fails in world k, ``failed[k]`` is set to True.
    """
    start, no_random = problem.start, np.zeros(problem.start.shape[0], np.uint64)
    for k in range(start.shape[0]):
        episode = make_search_world(problem, k, no_random).episode
        states = np.zeros((ends.shape[1] + 1, start.shape[1]))
        copy_rows(start[k : k + 1], states, 1)
        episode.clock[CLOCK.STEPWISE] = 1.0
        if follow_whole(episode, ends[k], commands[k], states, math.inf)[1] < 0:
            failed[k] = True
            continue
        for p in range(first.shape[1]):
            first[k, p] = episode.table[ROW.SUM_FIRST_HARM, p]
            total[k, p] = episode.table[ROW.SUM_TOTAL_HARM, p]
