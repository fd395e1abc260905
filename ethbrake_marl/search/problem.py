"""The problem of choosing whole profiles: whose, in which worlds, on which grid of decisions."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.physics import Floats, Ints, UInt64s, Worlds, advance
from ethbrake_marl.physics.episode import (
    CLOCK_WIDTH,
    HARM_IS_TOTAL,
    HORIZON,
    LAST_STEP,
    RESTITUTION,
    START,
    STEPWISE,
    TIME_STEP,
    first_decision_s,
    number_of_decisions,
)
from ethbrake_marl.physics.obstacle import ahead, obstacle_ahead, with_obstacle
from ethbrake_marl.physics.rows import TIME, command_at, gap_at, harm_at, pack, params_at, speed_at

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
