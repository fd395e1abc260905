"""Whole command profiles: play them, and search for the one of least harm."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.physics import (
    CLOCK,
    GOES_ON,
    ROW,
    Bools,
    Decisions,
    Episode,
    Floats,
    Ints,
    Packed,
    UInt64s,
    Worlds,
    advance,
    compiled,
    exp,
    follow,
    follow_whole,
    grid_of,
    harm_so_far,
    place_rates,
    restore,
    rows_for,
    save,
    step_again,
    value_of,
)

# The search for the profile of least harm in one world, compiled: one call per world, no Python inside.
#
# Method: given profiles (constants among them) and random ones are tried; the best of them, all different, are improved
# by random changes of any size, each success being repeated twice as large; after each round the better half goes on.
# The last one is divided into more phases and improved further, at the end decision by decision, as the engine runs.
# Letters as in ``physics.kernel``; Q given profiles, M of them and of the random ones improved.

# Random profiles and random changes of profiles, compiled, from one small random stream per world.
#
# ``bounds`` [C, 2] are the smallest and the largest command of each controlled vehicle (m/s2); the other letters are
# those of ``physics.kernel``.

RESOLUTION = 1048576.0  # commands are multiples of 1 / 2^20 m/s2: short to store, exact to repeat, and off any edge
LONGEST_DRAWN = 25.0  # steps of a phase that is drawn
LN_SMALLEST = -13.815510557964275  # changes of a command range over six decades below the whole range

# kinds of change
COMMAND_CHANGE, TRADE, SET_COMMAND, MOVE_END = 0, 1, 2, 3
# columns of a change
KIND, VEHICLE, PHASE, AMOUNT = range(4)
CHANGE_WIDTH = 4


@compiled
def draw(random: UInt64s) -> float:
    """The next number of the stream (splitmix64; its state is one word), uniform in [0, 1)."""
    random[0] += np.uint64(0x9E3779B97F4A7C15)
    z = random[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) * 2.0**-53


@compiled
def draw_below(random: UInt64s, n: int) -> int:
    """A whole number from 0 to n - 1."""
    return min(int(draw(random) * n), n - 1)


@compiled
def allowed(command: float, low: float, high: float) -> float:
    """The command within its bounds, rounded toward 0 to the resolution."""
    command = min(max(command, low), high)
    return int(command * RESOLUTION) / RESOLUTION


@compiled
def draw_command(random: UInt64s, low: float, high: float) -> float:
    """A command: often a bound or none, else anything between."""
    u = draw(random)
    if u < 0.35:
        return low
    if u < 0.5:
        return high
    if u < 0.6:
        return 0.0
    return allowed(low + (high - low) * draw(random), low, high)


@compiled
def apply_change(change: Floats, bounds: Floats, ends: Ints, commands: Floats) -> bool:
    """Change a profile in place; False if nothing changed.

    COMMAND_CHANGE adds to one command. TRADE also changes the next one, so that the speed after both stays (a change of
    place only). SET_COMMAND replaces a command. MOVE_END moves the border between two phases by whole steps.
    """
    kind, c, k, amount = int(change[KIND]), int(change[VEHICLE]), int(change[PHASE]), change[AMOUNT]
    low, high, before = bounds[c, 0], bounds[c, 1], commands[k, c]
    begin = ends[k - 1] if k > 0 else 0
    if kind == SET_COMMAND:
        commands[k, c] = amount
        return bool(amount != before)
    if kind == COMMAND_CHANGE:
        commands[k, c] = allowed(before + amount, low, high)
        return bool(commands[k, c] != before)
    if k == ends.shape[0] - 1:
        return False
    here, there = ends[k] - begin, ends[k + 1] - ends[k]
    if kind == TRADE:
        if here == 0 or there == 0:
            return False
        commands[k, c] = allowed(before + amount, low, high)
        commands[k + 1, c] = allowed(commands[k + 1, c] - (commands[k, c] - before) * here / there, low, high)
        return bool(commands[k, c] != before)
    end = min(max(ends[k] + int(amount), begin), ends[k + 1])
    moved = end != ends[k]
    ends[k] = end
    return bool(moved)


@compiled
def compact(ends: Ints, commands: Floats, phases: int) -> int:
    """Drop the empty ones of the first ``phases`` phases and join equal neighbours, in place; how many are left."""
    last, kept = ends[ends.shape[0] - 1], 0
    for k in range(phases):
        begin = ends[kept - 1] if kept > 0 else 0
        if ends[k] <= begin:
            continue
        same = kept > 0
        for c in range(commands.shape[1]):
            same = same and commands[kept - 1, c] == commands[k, c]
        if same:
            ends[kept - 1] = ends[k]
            continue
        ends[kept] = ends[k]
        for c in range(commands.shape[1]):
            commands[kept, c] = commands[k, c]
        kept += 1
    ends[kept - 1] = last
    return kept


MOST_PHASES = 12
DRAWN_PHASES = 6  # of a random profile
DRAWN_SHARE = 0.35  # of the budget, for given and random profiles
ROUNDS_SHARE = 0.50  # for the rounds of improvement that each halve the field
STEPWISE_SHARE = 0.02  # for the last improvement; its candidates cost several times more
PER_PROFILE = 400  # candidates of the budget for each profile of the first round, and at most
SMALLEST_FIELD, LARGEST_FIELD = 4, 128  # profiles there
SAME = 1e-6  # values (m2/s2) closer than this belong to the same profile
ATTENTION_STEPS = 30  # phases are divided within these first steps


class SearchWorld(NamedTuple):
    """One world as candidates run in it."""

    episode: Episode
    bounds: Floats  # [C, 2] smallest and largest command (m/s2)
    random: UInt64s  # [1] state of the world's random numbers


class Population(NamedTuple):
    """Profiles that are improved together."""

    ends: Ints  # [M, K]
    commands: Floats  # [M, K, C]
    phases: Ints  # [M] how many of the K are used; 0 for an empty place
    values: Floats  # [M] what is minimised


@compiled
def search_world(
    world: SearchWorld, start: Floats, seed_ends: Ints, seed_commands: Floats, budget: int, ends: Ints, commands: Floats
) -> int:
    """Fill ``ends`` [K] and ``commands`` [K, C] with the best profile found; its number of phases.

    ``start`` [S] is the state at the first decision; ``seed_ends`` [Q, K] and ``seed_commands`` [Q, K, C] are given
    profiles, and the result is never worse than any of them. 0 if the kernel failed on every profile.
    """
    K, C = commands.shape
    states = np.zeros((K + 1, start.shape[0]))
    copy_rows(start.reshape(1, -1), states, 1)
    M, rounds = SMALLEST_FIELD, 3
    while budget >= 2 * M * PER_PROFILE and M < LARGEST_FIELD:
        M *= 2
        rounds += 1
    field = Population(np.zeros((M, K), np.int64), np.zeros((M, K, C)), np.zeros(M, np.int64), np.full(M, math.inf))
    drawn = max(int(DRAWN_SHARE * budget) - seed_ends.shape[0], 0)
    in_rounds, stepwise = int(ROUNDS_SHARE * budget), int(STEPWISE_SHARE * budget)
    gather(world, seed_ends, seed_commands, states, drawn, field)
    for stage in range(rounds + 2):
        left = max(M >> stage, 1)
        each = in_rounds // (rounds * left)
        if stage == rounds:
            divide(world, field)
            each = budget - drawn - in_rounds - stepwise
        elif stage == rounds + 1:
            select_stepwise(world, seed_ends, seed_commands, states, field)
            each = stepwise
        for m in range(left):
            used = field.phases[m]
            if used > 0 and field.values[0] > 0.0:
                field.values[m] = improve(world, field.ends[m, :used], field.commands[m, :used], states, each)
        sort(field, left)
    used = field.phases[0]
    if used == 0:
        return 0
    copy_profile(field.ends[0], field.commands[0], ends, commands)
    used = compact(ends[:used], commands[:used], used)
    for k in range(used, K):
        ends[k] = int(world.episode.clock[CLOCK.LAST_STEP])
        for c in range(C):
            commands[k, c] = commands[used - 1, c]
    return used


@compiled
def copy_profile(ends: Ints, commands: Floats, to_ends: Ints, to_commands: Floats) -> None:
    """Copy the phases of one profile over the first ones of another."""
    for k in range(ends.shape[0]):
        to_ends[k] = ends[k]
    copy_rows(commands, to_commands, commands.shape[0])


@compiled
def copy_rows(rows: Floats, to_rows: Floats, n: int) -> None:
    """Copy the first ``n`` rows. (An assignment of slices compiles ten times longer, for its message of an error.)"""
    for k in range(n):
        for c in range(rows.shape[1]):
            to_rows[k, c] = rows[k, c]


@compiled(apart=True)
def improve(world: SearchWorld, ends: Ints, commands: Floats, states: Floats, budget: int) -> float:
    """Better and better neighbours of a profile, in place, until ``budget`` candidates have run; its value."""
    new_ends, new_commands, new_states = ends.copy(), commands.copy(), states.copy()
    change = np.zeros(CHANGE_WIDTH)
    value, active, spent, phase, again = math.inf, 0, -1, 0, False  # the first candidate is the profile itself
    for _ in range(4 * budget + 1):  # a change that changes nothing costs no candidate
        if spent >= budget or value <= 0.0:
            break
        if spent >= 0:
            if not again:
                u = draw(world.random)
                phase, vehicle = draw_below(world.random, active), draw_below(world.random, world.bounds.shape[0])
                sign = 1.0 if draw(world.random) < 0.5 else -1.0
                size = draw(world.random)
                low, high = world.bounds[vehicle, 0], world.bounds[vehicle, 1]
                change[VEHICLE] = vehicle
                change[PHASE] = phase
                if u < 0.70:
                    change[KIND] = COMMAND_CHANGE if u < 0.45 else TRADE
                    change[AMOUNT] = sign * (high - low) * exp(LN_SMALLEST * size)
                elif u < 0.78:
                    change[KIND] = SET_COMMAND
                    change[AMOUNT] = draw_command(world.random, low, high)
                else:
                    change[KIND] = MOVE_END
                    change[AMOUNT] = sign * (1 + int(8.0 * size * size * size))
            copy_profile(ends, commands, new_ends, new_commands)
            again = False
            if not apply_change(change, world.bounds, new_ends, new_commands):
                continue
            copy_rows(states[phase:], new_states[phase:], 1)
        spent += 1
        new_value, reached = follow(world.episode, new_ends, new_commands, new_states, phase, value)
        if reached < 0 or not new_value < value:
            if active == 0:
                return math.inf
            continue
        value, active = new_value, reached
        copy_profile(new_ends, new_commands, ends, commands)
        copy_rows(new_states[phase + 1 :], states[phase + 1 :], reached - phase)
        change[AMOUNT] *= 2.0
        again = spent > 0 and change[KIND] != SET_COMMAND
    for k in range(active - 1, ends.shape[0]):
        ends[k] = int(world.episode.clock[CLOCK.LAST_STEP])  # the episode is over by then
    return value


@compiled(apart=True)
def gather(
    world: SearchWorld, seed_ends: Ints, seed_commands: Floats, states: Floats, drawn: int, field: Population
) -> None:
    """Fill the field with the best of the given profiles and of ``drawn`` random ones, all of different value."""
    Q, K = seed_ends.shape
    last = int(world.episode.clock[CLOCK.LAST_STEP])
    ends, commands = np.zeros(K, np.int64), np.zeros(field.commands.shape[1:])
    worst = 0
    for s in range(Q + drawn):
        used = DRAWN_PHASES
        if s < Q:
            copy_profile(seed_ends[s], seed_commands[s], ends, commands)
            used = 1
            while used < K and ends[used - 1] != last:
                used += 1
        else:
            step = 0
            for k in range(used):  # phases are short rather than long
                u = draw(world.random)
                step = min(step + 1 + int(u * u * LONGEST_DRAWN), last)
                ends[k] = step
                for c in range(world.bounds.shape[0]):
                    commands[k, c] = draw_command(world.random, world.bounds[c, 0], world.bounds[c, 1])
            ends[used - 1] = last
        value, reached = follow_whole(world.episode, ends[:used], commands[:used], states, field.values[worst])
        if reached < 0 or not value < field.values[worst] or is_among(value, field.values):
            continue
        copy_profile(ends, commands, field.ends[worst], field.commands[worst])
        field.phases[worst] = used
        field.values[worst] = value
        if value <= 0.0:
            break
        worst = largest(field.values)
    sort(field, field.values.shape[0])


@compiled(apart=True)
def sort(field: Population, left: int) -> None:
    """Put the first ``left`` places of the field in order of value."""
    for here in range(1, left):
        m = here
        while m > 0 and field.values[m] < field.values[m - 1]:
            field.values[m], field.values[m - 1] = field.values[m - 1], field.values[m]
            field.phases[m], field.phases[m - 1] = field.phases[m - 1], field.phases[m]
            for k in range(field.ends.shape[1]):
                field.ends[m, k], field.ends[m - 1, k] = field.ends[m - 1, k], field.ends[m, k]
                for c in range(field.commands.shape[2]):
                    before = field.commands[m - 1, k, c]
                    field.commands[m - 1, k, c] = field.commands[m, k, c]
                    field.commands[m, k, c] = before
            m -= 1


@compiled
def is_among(value: float, values: Floats) -> bool:
    """Whether one of ``values`` belongs to the same profile as this one."""
    for other in values:  # noqa: SIM110  # any() is not compiled
        if abs(other - value) < SAME:
            return True
    return False


@compiled
def largest(values: Floats) -> int:
    """Place of the first largest value."""
    place = 0
    for k in range(values.shape[0]):
        if values[k] > values[place]:
            place = k
    return place


@compiled(apart=True)
def divide(world: SearchWorld, field: Population) -> None:
    """Give the best of the field as many phases as there may be."""
    used = field.phases[0]
    if used > 0 and field.values[0] > 0.0:
        K = field.ends.shape[1]
        used = compact(field.ends[0, :used], field.commands[0, :used], used)
        phases = used
        attention = min(ATTENTION_STEPS, int(world.episode.clock[CLOCK.LAST_STEP]))
        while phases < K:
            longest, length = 0, -1
            for k in range(phases):
                begin = field.ends[0, k - 1] if k > 0 else 0
                here = min(field.ends[0, k], attention) - min(begin, attention)
                if here > length:
                    longest, length = k, here
            for k in range(phases, longest, -1):
                field.ends[0, k] = field.ends[0, k - 1]
                for c in range(field.commands.shape[2]):
                    field.commands[0, k, c] = field.commands[0, k - 1, c]
            begin = field.ends[0, longest - 1] if longest > 0 else 0
            field.ends[0, longest] = begin + max(length // 2, 0)
            phases += 1
        field.phases[0] = K


@compiled(apart=True)
def select_stepwise(
    world: SearchWorld, seed_ends: Ints, seed_commands: Floats, states: Floats, field: Population
) -> None:
    """From now on advance decision by decision; put the best of the field and the given profiles in the first place.

    Rounding may decide on which side of a jump a profile lands.
    """
    world.episode.clock[CLOCK.STEPWISE] = 1.0
    Q, K = seed_ends.shape
    best_ends, best_commands = np.zeros(K, np.int64), np.zeros(field.commands.shape[1:])
    least, size = math.inf, 0
    for s in range(SMALLEST_FIELD + Q):
        given = s >= SMALLEST_FIELD
        n = K if given else field.phases[s]
        if n == 0:
            continue
        ends = seed_ends[s - SMALLEST_FIELD] if given else field.ends[s, :n]
        commands = seed_commands[s - SMALLEST_FIELD] if given else field.commands[s, :n]
        value, reached = follow_whole(world.episode, ends, commands, states, least)
        if reached > 0 and value < least:
            least, size = value, n
            copy_profile(ends, commands, best_ends, best_commands)
            if value <= 0.0:
                break
    copy_profile(best_ends, best_commands, field.ends[0], field.commands[0])
    field.phases[0] = size
    field.values[0] = least


# Profiles of commands for many worlds: what a search is given and what it finds, and what a profile does.
#
# Worlds are independent: a world's result does not depend on its batch, its place in it, or the number of threads.
# Threads run at the same time because the kernels release Python's lock.

# The problem of choosing whole profiles: whose, in which worlds, on which grid of decisions.

TIME_STEP_S = 0.1  # between two decisions, where nobody says otherwise
_MIX = 0xD1342543DE82EF95  # an odd number: spreads seeds over 64 bits


class ProfileProblem(NamedTuple):
    """Whose commands are chosen, in which worlds, on which grid of decisions. Build it with ``profile_problem``."""

    vehicles: Ints  # [C] controlled, index from 0; in lines with an obstacle from 1, it being vehicle 0 of every column
    start: Floats  # [n, S] at the first decision
    clock: Floats  # [n, CLOCK_WIDTH]
    bounds: Floats  # [n, C, 2] m/s2
    command: Floats  # [n, N] of the others
    latency: Floats  # [n, N]
    mass: Floats  # [n, N]
    limit: Floats  # [n, N]
    brake_rate: Floats  # [n, N] m/s3
    release_rate: Floats  # [n, N]
    pieces: Floats  # [n, N, 2 K]
    identity: UInt64s  # [n]

    @property
    def n(self) -> int:
        """Number of worlds."""
        return len(self.start)

    def take(self, rows: Ints) -> ProfileProblem:
        """That of some of the worlds."""
        arrays: dict[str, Any] = {name: getattr(self, name)[rows] for name in self._fields[1:]}
        return self._replace(**arrays)

    def put(self, rows: Ints, new: ProfileProblem) -> ProfileProblem:
        """A copy with the worlds of a ``new`` one in these rows."""
        arrays: dict[str, Any] = {name: getattr(self, name).copy() for name in self._fields[1:]}
        for name, array in arrays.items():
            array[rows] = getattr(new, name)
        return self._replace(**arrays)

    @property
    def last_step(self) -> Ints:
        """Number of decisions up to the horizon, [n]."""
        return self.clock[:, CLOCK.LAST_STEP].astype(np.int64)

    def constant(self, commands_mps2: Floats) -> Profiles:
        """Profiles [n * Q] that hold the given commands [n, Q, C], divided into phases for a search to change."""
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
        """``number`` commands from each vehicle's least to its greatest, evenly spaced, both included.

        [n, number, C] m/s2. ``low + (high - low)`` may lie an ulp beyond ``high``, so the greatest is taken as it is.
        """
        low, high = self.bounds[:, np.newaxis, :, 0], self.bounds[:, np.newaxis, :, 1]
        share = np.linspace(0.0, 1.0, number)[:, np.newaxis]
        return np.asarray(np.minimum(low + share * (high - low), high), np.float64)

    def follow(self, profiles: Profiles) -> tuple[Floats, Floats]:
        """First-impact and total harm [n] of one profile per world, as the engine counts it, to the same bits.

        Raises ``InvalidInput`` for profiles that do not fit the problem or exceed a capacity, ``PhysicsError`` naming
        the worlds in which a check of the kernel failed.
        """
        self.check(profiles)
        n = self.n
        first, total, failed = np.zeros(n), np.zeros(n), np.zeros(n, np.bool_)
        ends, commands = np.ascontiguousarray(profiles.ends, np.int64), np.ascontiguousarray(profiles.commands_mps2)
        follow_worlds(self, ends, commands, first, total, failed)
        if failed.any():
            raise PhysicsError({k: "its profile could not be followed" for k in np.flatnonzero(failed).tolist()})
        return first, total

    def check(self, profiles: Profiles) -> None:
        """Raise ``InvalidInput`` unless there is one profile per world, within the capacities, its phases in order."""
        n, C = self.n, len(self.vehicles)
        K = profiles.ends.shape[-1]
        if profiles.ends.shape != (n, K) or profiles.commands_mps2.shape != (n, K, C):
            raise InvalidInput(
                f"profiles: shapes {profiles.ends.shape} and {profiles.commands_mps2.shape}; ({n}, K) and ({n}, K, {C})"
                " are needed"
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
            raise InvalidInput("profiles: phases must end in order, the last one at the last step")


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
    """The problem of choosing the whole profiles of ``vehicles`` (indices from 0) so as to do the least harm.

    The first decision falls on the smallest latency of the ``deciders`` (default: ``vehicles``) or on the worlds' time,
    whichever is later; one follows every ``time_step_s``. Where any world has an obstacle ahead, it is written out as a
    vehicle in front (``Worlds.with_obstacle``; in the others one that nobody reaches): all columns of the problem are
    those of that line. The other vehicles follow ``others_mps2`` [n, N] (default: full braking; the columns of
    ``vehicles`` are ignored). Raises ``InvalidInput`` for no vehicle, one given twice or not there, an unknown count, a
    command beyond capacity, or a horizon before the first decision.
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
    obstacle = worlds.obstacle_ahead
    if obstacle.any() or written_out:
        found = profile_problem(
            worlds.with_post_ahead(np.full(worlds.n, horizon_s)).with_obstacle(),
            [i + 1 for i in chosen.tolist()],
            harm_count=harm_count,
            horizon_s=horizon_s,
            time_step_s=time_step_s,
            others_mps2=np.concatenate([np.zeros((len(command), 1)), command], axis=1),
            deciders=None if deciders is None else [i + 1 for i in deciders],
        )
        if not obstacle.all():  # a world is searched as it is beside any others
            free = np.flatnonzero(~obstacle)
            found.identity[free] = profile_problem(
                worlds.take(free), vehicles, harm_count=harm_count, horizon_s=horizon_s, time_step_s=time_step_s,
                others_mps2=command[free], deciders=deciders,
            ).identity  # fmt: skip
        return found
    decide = _checked_vehicles(vehicles if deciders is None else deciders, worlds.N)
    first = worlds.first_decision_s(decide.tolist())
    if not (first < horizon_s).all():
        raise InvalidInput(f"horizon_s {horizon_s:g}: must be after the first decision at {first.max():g} s")
    clock = np.empty((worlds.n, CLOCK.WIDTH))
    clock[:, CLOCK.START], clock[:, CLOCK.TIME_STEP], clock[:, CLOCK.HORIZON] = first, time_step_s, horizon_s
    clock[:, CLOCK.LAST_STEP] = Decisions(first, time_step_s).before(horizon_s)
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
        identities(worlds, command, clock, chosen),
    )  # fmt: skip


def identities(worlds: Worlds, command: Floats, clock: Floats, vehicles: Ints) -> UInt64s:
    """What tells one world's problem from another's, [n]: 8 bytes of BLAKE2b over all that the harm depends on.

    State and parameters of the world, the other vehicles' commands, the decisions (first, step, number), the horizon
    and the controlled vehicles; not the count.
    """
    packed = Packed.of(worlds)
    (state, params), column = packed, packed.column
    who = np.zeros((worlds.n, worlds.N))
    who[:, vehicles] = 1.0
    parts = [
        state[:, [column.time]],
        state[:, column.speed : column.command],
        state[:, column.gap : column.harm],
        params[:, : column.brake_rate],  # the news of others changes no harm
        command,
        clock[:, [CLOCK.START, CLOCK.TIME_STEP, CLOCK.LAST_STEP, CLOCK.HORIZON]],
        who,
    ]
    rows = np.ascontiguousarray(np.concatenate(parts, axis=1) + 0.0, "<f8")  # + 0.0: one zero, not two
    slow = worlds.vehicles.build_up  # others have the names that they had before there were rates
    forces = np.concatenate(
        [state[:, column.command : column.previous], params[:, column.brake_rate : column.own_latency]], 1
    )
    further = [forces[k].tobytes() if slow[k] else b"" for k in range(worlds.n)]
    for k in np.flatnonzero(worlds.vehicles.in_pieces):
        pieces = worlds.vehicles.pieces[k]
        there = np.isfinite(pieces)  # not how many others of the batch have
        further[k] += there.sum(axis=1).astype("<i8").tobytes() + pieces[there].astype("<f8").tobytes()
    digests = [hashlib.blake2b(row.tobytes() + further[k], digest_size=8).digest() for k, row in enumerate(rows)]
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
        return np.asarray(self.commands_mps2[np.arange(len(phase)), phase], np.float64)

    def take(self, rows: Ints | slice) -> Profiles:
        """Those of some worlds."""
        return Profiles(self.ends[rows], self.commands_mps2[rows])

    @staticmethod
    def padded(parts: Sequence[Profiles], least: int) -> list[Profiles]:
        """The same profiles, all with as many phases (at least ``least``): empty ones are added.

        In their own memory.
        """
        width = max([least, *(part.ends.shape[1] for part in parts)])
        return [
            Profiles(
                np.pad(part.ends, ((0, 0), (0, width - part.ends.shape[1])), mode="edge"),
                np.pad(part.commands_mps2, ((0, 0), (0, width - part.ends.shape[1]), (0, 0)), mode="edge"),
            )
            for part in parts
        ]

    def grown(self, n: int) -> Profiles:
        """These and as many meaningless ones as make ``n`` in all; in their own memory."""
        more = n - len(self.ends)
        return Profiles(np.pad(self.ends, ((0, more), (0, 0))), np.pad(self.commands_mps2, ((0, more), (0, 0), (0, 0))))


Found = tuple[Profiles, dict[HarmCount, Floats]]


def search_profiles(problem: ProfileProblem, given: Profiles, *, budget: int, seed: int = 0, threads: int = 1) -> Found:
    """The best profiles of at most ``MOST_PHASES`` phases that about ``budget`` candidates per world find.

    And their harm [n] under each count (m2/s2), as the engine counts it.

    ``given`` [n * Q]: Q profiles of each world, world by world, from which to start; the result is never worse than
    any of them. Raises ``InvalidInput`` for a budget below 1 and ``PhysicsError`` naming the worlds of which no
    profile could be followed.
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


@compiled
def make_search_world(problem: ProfileProblem, k: int, random: UInt64s) -> SearchWorld:
    """The surroundings of world k, with room to work in; ``random`` [n]: the states of all worlds' random numbers."""
    N = problem.mass.shape[1]
    table = np.zeros((rows_for(problem.pieces.shape[2]), N))
    for i in range(N):
        table[ROW.COMMAND, i], table[ROW.LATENCY, i] = problem.command[k, i], problem.latency[k, i]
        table[ROW.MASS, i], table[ROW.LIMIT, i] = problem.mass[k, i], problem.limit[k, i]
    place_rates(table, problem.brake_rate[k], problem.release_rate[k], problem.pieces[k])
    return SearchWorld(Episode(table, problem.clock[k].copy(), problem.vehicles), problem.bounds[k], random[k : k + 1])


@compiled
def follow_worlds(
    problem: ProfileProblem, ends: Ints, commands: Floats, first: Floats, total: Floats, failed: Bools
) -> None:
    """Fill ``first`` and ``total`` [n] with the harm of one profile per world, and ``failed`` [n] where it ended."""
    start, no_random = problem.start, np.zeros(problem.start.shape[0], np.uint64)
    for k in range(start.shape[0]):
        episode = make_search_world(problem, k, no_random).episode
        states = np.zeros((ends.shape[1] + 1, start.shape[1]))
        copy_rows(start[k : k + 1], states, 1)
        episode.clock[CLOCK.STEPWISE] = 1.0
        if follow_whole(episode, ends[k], commands[k], states, math.inf)[1] < 0:
            failed[k] = True
            continue
        first[k], total[k] = harm_so_far(episode.table, 0.0), harm_so_far(episode.table, 1.0)


# The refinement of an episode: a compiled search around the commands that somebody gives in its steps.
#
# Two climbs, each by random changes of a few neighbouring steps: one from the given commands, and one from the best of
# some random templates (one command, another one for a short while, then full braking), as what is best may lie in a
# valley of its own. Everything advances decision by decision, as the engine does: what is found will happen, to the
# bit.

TEMPLATE_SHARE, THEIR_CLIMB_SHARE = 0.3, 0.3  # of the budget; the rest is for the climb from the given commands
ATTENTION_S = 3.0  # from the first decision on; later steps are changed only together with earlier ones
LONGEST_CHANGE_S = 0.6
LONGEST_WHILE_S = 0.8  # of a template
SET_SHARE = 0.1  # of the changes, which replace commands; the others add to them
FULL_BRAKE_SHARE = 0.8  # of the templates, which begin with full braking
LN_SMALLEST_CHANGE = (
    -6.907755278982138
)  # amounts that are added range over three decades below the whole range of commands
WORSE = 5.0  # m2/s2: a template may be worse by so much before it is climbed from
NO_HARM = 1e-9  # m2/s2


class Plan(NamedTuple):
    """Commands of one world, and where they lead."""

    commands: Floats  # [T]
    states: Floats  # [T + 1, S] at the start of each step


def refine(problem: ProfileProblem, commands_mps2: Floats, *, budget: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Search around ``commands_mps2`` [n, T] of the one controlled vehicle, with ``budget`` candidates per world.

    Returns the commands found, never worse than the given ones, and their harm [n] under the problem's count, as
    the engine counts it (m2/s2).
    Worlds are independent of each other. Raises ``InvalidInput`` for several vehicles, commands of another shape or
    beyond a capacity, or a budget below 1, ``PhysicsError`` naming worlds in which the given commands cannot be
    played.
    """
    check_whole_number("budget", budget, 1)
    n, steps = problem.n, int(problem.last_step.max(initial=0))
    low, high = problem.bounds[:, :1, 0], problem.bounds[:, :1, 1]
    if len(problem.vehicles) != 1 or commands_mps2.shape != (n, steps):
        raise InvalidInput(f"refine: commands of shape {commands_mps2.shape}; ({n}, {steps}) of one vehicle are needed")
    if not ((commands_mps2 >= low) & (commands_mps2 <= high)).all():
        raise InvalidInput("refine: a command is beyond the vehicle's capacity")
    best, first, total = commands_mps2.copy(), np.zeros(n), np.zeros(n)
    failed = np.zeros(n, np.bool_)
    _refine_worlds(problem, seeded(problem.identity, seed), budget, best, first, total, failed)
    if failed.any():
        raise PhysicsError({k: "its commands could not be played" for k in np.flatnonzero(failed).tolist()})
    return best, np.where(problem.clock[:, CLOCK.HARM_IS_TOTAL] == 1.0, total, first)


@compiled
def _refine_worlds(
    problem: ProfileProblem, random: UInt64s, budget: int, commands: Floats, first: Floats, total: Floats,
    failed: Bools,
) -> None:  # fmt: skip
    """Improve ``commands`` in place, and fill the other outputs [n]."""
    start, T, S = problem.start, commands.shape[1], problem.start.shape[1]
    mine, other = Plan(np.zeros(T), np.zeros((T + 1, S))), Plan(np.zeros(T), np.zeros((T + 1, S)))
    room = Plan(np.zeros(T), np.zeros((T + 1, S)))
    for k in range(start.shape[0]):
        world = make_search_world(problem, k, random)
        for plan in (mine, other, room):
            copy_rows(start[k : k + 1], plan.states, 1)
        copy_steps(commands[k], mine.commands, 0)
        if not _refine_world(world, mine, other, room, budget):
            failed[k] = True
            continue
        copy_steps(mine.commands, commands[k], 0)
        follow_steps(world.episode, mine, 0, math.inf)
        first[k], total[k] = harm_so_far(world.episode.table, 0.0), harm_so_far(world.episode.table, 1.0)


@compiled(apart=True)
def _refine_world(world: SearchWorld, mine: Plan, other: Plan, room: Plan, budget: int) -> bool:
    """Improve ``mine``; False if it cannot be played."""
    templates, theirs = int(TEMPLATE_SHARE * budget), int(THEIR_CLIMB_SHARE * budget)
    value, reached = follow_steps(world.episode, mine, 0, math.inf)
    if reached < 0:
        return False
    value, reached = climb(world, mine, room, value, reached, budget - templates - theirs)
    if value <= NO_HARM:
        return True
    least, played = draw_templates(world, other, room, value + WORSE, templates)
    if played > 0:
        least, played = climb(world, other, room, least, played, theirs)
        if least < value:
            copy_steps(other.commands, mine.commands, 0)
    return True


@compiled(apart=True)
def follow_steps(world: Episode, plan: Plan, begin: int, bound: float) -> tuple[float, int]:
    """Play a plan from the start of step ``begin`` on, and fill its states; the value, and the steps up to the end.

    Gives up as soon as the value is not below ``bound``: harm never falls again. -1 steps if the kernel failed.
    """
    table, clock = world.table, world.clock
    grid, restitution, total, last = (
        grid_of(clock),
        clock[CLOCK.RESTITUTION],
        clock[CLOCK.HARM_IS_TOTAL],
        int(clock[CLOCK.LAST_STEP]),
    )
    no_rows = table[:0]
    restore(table, plan.states[begin])
    value = value_of(table, total)
    for step in range(begin, last):
        table[ROW.COMMAND, world.controlled[0]] = plan.commands[step]
        outcome = step_again(table, restitution, grid, step, step + 1, no_rows)
        if outcome < GOES_ON:
            return value, -1
        value = value_of(table, total)
        save(table, plan.states[step + 1])
        if value >= bound or outcome != GOES_ON:
            return value, step + 1
    return value, last


@compiled(apart=True)
def climb(world: SearchWorld, plan: Plan, room: Plan, value: float, reached: int, budget: int) -> tuple[float, int]:
    """Change a plan of this value for the better, in place, with ``budget`` candidates; its value and steps.

    A success by addition is repeated twice as large.
    """
    low, high = world.bounds[0, 0], world.bounds[0, 1]
    longest = steps_in(world.episode, LONGEST_CHANGE_S)
    first, length, amount, adds, again = 0, 0, 0.0, True, False
    for _ in range(budget):
        if value <= NO_HARM:
            break
        if not again:
            adds = draw(world.random) >= SET_SHARE
            first = draw_below(world.random, min(reached, steps_in(world.episode, ATTENTION_S)))
            u = draw(world.random)
            length = 1 + int(u * u * longest)
            if adds:  # of either sign; its logarithm is uniform over the decades below the whole range
                sign = 1.0 if draw(world.random) < 0.5 else -1.0
                amount = sign * (high - low) * exp(LN_SMALLEST_CHANGE * draw(world.random))
            else:
                amount = draw_command(world.random, low, high)
        again = False
        any_change = False
        for t in range(first, plan.commands.shape[0]):
            room.commands[t] = plan.commands[t]
            if t < first + length:
                room.commands[t] = allowed(plan.commands[t] + amount, low, high) if adds else amount
                any_change = any_change or room.commands[t] != plan.commands[t]
        if not any_change:
            continue
        copy_rows(plan.states[first:], room.states[first:], 1)
        new, played = follow_steps(world.episode, room, first, value)
        if played < 0 or not new < value:
            continue
        value, reached = new, played
        copy_steps(room.commands, plan.commands, first)
        copy_rows(room.states[first:], plan.states[first:], played - first + 1)
        amount *= 2.0
        again = adds
    return value, reached


@compiled(apart=True)
def draw_templates(world: SearchWorld, best: Plan, room: Plan, bound: float, number: int) -> tuple[float, int]:
    """Fill ``best`` with the best of some random templates; its value and steps, 0 if none is below ``bound``."""
    low, high, T = world.bounds[0, 0], world.bounds[0, 1], room.commands.shape[0]
    attention, longest = steps_in(world.episode, ATTENTION_S), steps_in(world.episode, LONGEST_WHILE_S)
    reached = 0
    for _ in range(number):
        first, length = draw_below(world.random, attention), 1 + draw_below(world.random, longest)
        between = draw_command(world.random, low, high)
        before = low if draw(world.random) < FULL_BRAKE_SHARE else draw_command(world.random, low, high)
        for t in range(T):
            room.commands[t] = before if t < first else (between if t < first + length else low)
        value, played = follow_steps(world.episode, room, 0, bound)
        if played > 0 and value < bound:
            bound, reached = value, played
            copy_steps(room.commands, best.commands, 0)
            copy_rows(room.states, best.states, played + 1)
    return bound, reached


@compiled
def steps_in(world: Episode, duration_s: float) -> int:
    """How many steps fit into a time, at least 1."""
    return max(int(duration_s / world.clock[CLOCK.TIME_STEP] + 0.5), 1)


@compiled
def copy_steps(commands: Floats, to: Floats, first: int) -> None:
    """Copy the commands from step ``first`` on."""
    for t in range(first, commands.shape[0]):
        to[t] = commands[t]


# Random templates of a whole episode, of which the best one in each world is kept: brake fully, give way, brake again.
#
# They show how a world could be driven quite otherwise than a policy drives it (``refine`` climbs from the same
# ones). Nothing is improved: what does little harm as it was drawn stands on no edge, and a policy can imitate it.


def best_templates(problem: ProfileProblem, bound: Floats, *, number: int, seed: int = 0) -> tuple[Floats, Ints]:
    """The best of ``number`` templates below ``bound`` [n] (m2/s2) in each world, of the one controlled vehicle.

    Returns its commands [n, T] (m/s2), and in how many steps it was played to its end [n]: 0 where none was below.
    Each world draws its own; worlds are independent of each other. Raises ``InvalidInput`` for several vehicles, or
    no template.
    """
    check_whole_number("templates", number, 1)
    if len(problem.vehicles) != 1:
        raise InvalidInput(f"templates: {len(problem.vehicles)} vehicles; they are of one")
    commands = np.zeros((problem.n, int(problem.last_step.max(initial=0))))
    steps = np.zeros(problem.n, np.int64)
    _best_templates(problem, seeded(problem.identity, seed), bound, number, commands, steps)
    return commands, steps


@compiled
def _best_templates(
    problem: ProfileProblem, random: UInt64s, bound: Floats, number: int, commands: Floats, steps: Ints
) -> None:
    """Fill ``commands`` and ``steps``."""
    start, T, S = problem.start, commands.shape[1], problem.start.shape[1]
    best, room = Plan(np.zeros(T), np.zeros((T + 1, S))), Plan(np.zeros(T), np.zeros((T + 1, S)))
    for k in range(start.shape[0]):
        world = make_search_world(problem, k, random)
        copy_rows(start[k : k + 1], best.states, 1)
        copy_rows(start[k : k + 1], room.states, 1)
        steps[k] = draw_templates(world, best, room, bound[k], number)[1]
        if steps[k] > 0:
            copy_steps(best.commands, commands[k], 0)
