"""Compiled random search for the profile with the least harm in one world. Each world has its own random stream.

Arguments that several functions share: a profile has at most K phases. ``ends`` [K] are the time steps at which the
phases end, and ``commands`` [K, C] are the commands of the C controlled vehicles in each phase, m/s2. ``seed_ends`` [Q,
K] and ``seed_commands`` [Q, K, C] are Q starting profiles. ``world`` has the ``bounds`` [C, 2], which are the least and
the largest command of each vehicle (m/s2), and the state of its random stream, ``random`` [1]. ``states`` [K + 1, S]
receives the state of the world at the start of each phase, S numbers; row 0 must already contain the state at the first
decision.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.engine.profiles import SearchWorld, copy_rows
from ethbrake_marl.first_edition.physics.elementary import exp
from ethbrake_marl.first_edition.physics.episode import CLOCK, follow, follow_whole
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Floats, Ints, UInt64s

RESOLUTION = 1048576.0  # commands are multiples of 1 / 2^20 m/s2: short to store and exactly repeatable

LONGEST_DRAWN = 25.0  # longest random phase, in steps

LN_SMALLEST = -13.815510557964275  # ln of the smallest change of a command, relative to the whole range: six decades

# kinds of change
COMMAND_CHANGE, TRADE, SET_COMMAND, MOVE_END = 0, 1, 2, 3

# columns of a change
KIND, VEHICLE, PHASE, AMOUNT = range(4)

CHANGE_WIDTH = 4


@compiled
def draw(random: UInt64s) -> float:
    """Return the next random number, uniform in [0, 1), of a splitmix64 generator."""
    random[0] += np.uint64(0x9E3779B97F4A7C15)
    z = random[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) * 2.0**-53


@compiled
def draw_below(random: UInt64s, n: int) -> int:
    """Return a random whole number from 0 to ``n`` - 1."""
    return min(int(draw(random) * n), n - 1)


@compiled
def allowed(command: float, low: float, high: float) -> float:
    """Return ``command`` limited to ``low`` and ``high``, and rounded toward 0 to a multiple of 1 / 2^20, m/s2."""
    command = min(max(command, low), high)
    return int(command * RESOLUTION) / RESOLUTION


@compiled
def draw_command(random: UInt64s, low: float, high: float) -> float:
    """Return a random command, m/s2.

    The command is ``low`` with probability 0.35, ``high`` with probability 0.15, 0 with probability 0.1, and otherwise
    uniformly distributed between ``low`` and ``high``.
    """
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
    """Apply one change to a profile, in place. Return False if the change leaves the profile as it was.

    The four numbers of ``change`` are KIND, VEHICLE, PHASE and AMOUNT (m/s2; for MOVE_END steps). COMMAND_CHANGE adds
    an amount to the command of one phase. TRADE adds an amount to the command of one phase, and changes the command of
    the next phase so that the vehicle has the same speed after both phases, but another position. SET_COMMAND replaces
    the command of one phase. MOVE_END moves the border between two phases by whole time steps.
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
    """Remove empty phases and join neighbouring phases with equal commands, in place; return how many phases remain.

    ``phases`` is the number of phases that the profile uses before the call.
    """
    last, count = ends[ends.shape[0] - 1], 0
    for k in range(phases):
        begin = ends[count - 1] if count > 0 else 0
        if ends[k] <= begin:
            continue
        same = count > 0
        for c in range(commands.shape[1]):
            same = same and commands[count - 1, c] == commands[k, c]
        if same:
            ends[count - 1] = ends[k]
            continue
        ends[count] = ends[k]
        for c in range(commands.shape[1]):
            commands[count, c] = commands[k, c]
        count += 1
    ends[count - 1] = last
    return count


DRAWN_PHASES = 6  # number of phases of a random profile

DRAWN_SHARE = 0.35  # fraction of the budget for starting profiles and random profiles

ROUNDS_SHARE = 0.50  # fraction of the budget for the rounds of improvement, each of which halves the field

STEPWISE_SHARE = 0.02  # fraction of the budget for the last improvement, whose candidates take several times longer

PER_PROFILE = 400  # the first field has one profile for this number of candidates in the budget, within the limits:

SMALLEST_FIELD, LARGEST_FIELD = 4, 128  # limits of the number of profiles in the first field

SAME = 1e-6  # m2/s2; two profiles whose harm differs by less are treated as the same profile

ATTENTION_STEPS = 30  # phases are divided within this number of steps from the first decision


class Population(NamedTuple):
    """The *field*: M profiles that the search improves at the same time."""

    ends: Ints  # [M, K] steps at which the phases end
    commands: Floats  # [M, K, C] commands of the C controlled vehicles in each phase, m/s2
    phases: Ints  # [M] number of phases in use; 0 for an empty place
    values: Floats  # [M] harm to minimise (m2/s2)


@compiled
def search_world(
    world: SearchWorld, start: Floats, seed_ends: Ints, seed_commands: Floats, budget: int, ends: Ints, commands: Floats
) -> int:
    """Search for the profile with the least harm in one world, and write the profile to ``ends`` and ``commands``.

    Returns the number of phases of this profile; 0 if the physics could simulate no profile. The harm of the written
    profile is at most the harm of each starting profile. ``start`` [S] is the state of the world at the first decision.
    ``budget`` is the number of profiles to simulate.
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
    """Copy the phases of one profile over the first phases of another profile."""
    for k in range(ends.shape[0]):
        to_ends[k] = ends[k]
    copy_rows(commands, to_commands, commands.shape[0])


@compiled(apart=True)
def improve(world: SearchWorld, ends: Ints, commands: Floats, states: Floats, budget: int) -> float:
    """Improve a profile in place, simulating ``budget`` changed profiles; return the new harm, m2/s2.

    Returns infinity if the physics could not simulate the profile.
    """
    new_ends, new_commands, new_states = ends.copy(), commands.copy(), states.copy()
    change = np.zeros(CHANGE_WIDTH)
    value, active, spent, phase, again = math.inf, 0, -1, 0, False  # the first candidate is the profile itself
    for _ in range(4 * budget + 1):  # a change without effect costs no candidate
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
        ends[k] = int(world.episode.clock[CLOCK.LAST_STEP])  # the episode ends before the later phases begin
    return value


@compiled(apart=True)
def gather(
    world: SearchWorld, seed_ends: Ints, seed_commands: Floats, states: Floats, drawn: int, field: Population
) -> None:
    """Fill ``field`` with the best of the starting profiles and of ``drawn`` random profiles.

    No two profiles in the field have the same harm.
    """
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
            for k in range(used):  # short phases are more likely than long ones
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
    """Sort the first ``left`` profiles of ``field`` by harm, least first, in place."""
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
    """Return whether ``value`` differs from at least one of ``values`` by less than ``SAME``."""
    for other in values:  # noqa: SIM110  # any() is not compiled
        if abs(other - value) < SAME:
            return True
    return False


@compiled
def largest(values: Floats) -> int:
    """Return the index of the largest number in ``values``, the first one if several are equally large."""
    place = 0
    for k in range(values.shape[0]):
        if values[k] > values[place]:
            place = k
    return place


@compiled(apart=True)
def divide(world: SearchWorld, field: Population) -> None:
    """Halve phases of the best profile of ``field``, in place, until this profile has K phases.

    The longest phase is halved first. The length of a phase is counted only within the first ``ATTENTION_STEPS`` steps
    of the episode.
    """
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
    """Switch ``world`` to stepwise simulation; write the profile with the least harm to the first place of ``field``.

    The function compares the harm of the first ``SMALLEST_FIELD`` profiles of ``field`` and of all starting profiles.
    Stepwise simulation computes one decision after the other, with the same rounding errors as the engine. The rounding
    errors matter if harm is a discontinuous function of the commands: rounding may then decide how much harm a profile
    causes.
    """
    world.episode.clock[CLOCK.STEPWISE] = 1.0
    Q, K = seed_ends.shape
    best_ends, best_commands = np.zeros(K, np.int64), np.zeros(field.commands.shape[1:])
    least, size = math.inf, 0
    for s in range(SMALLEST_FIELD + Q):
        speed = s >= SMALLEST_FIELD
        n = K if speed else field.phases[s]
        if n == 0:
            continue
        ends = seed_ends[s - SMALLEST_FIELD] if speed else field.ends[s, :n]
        commands = seed_commands[s - SMALLEST_FIELD] if speed else field.commands[s, :n]
        value, reached = follow_whole(world.episode, ends, commands, states, least)
        if reached > 0 and value < least:
            least, size = value, n
            copy_profile(ends, commands, best_ends, best_commands)
            if value <= 0.0:
                break
    copy_profile(best_ends, best_commands, field.ends[0], field.commands[0])
    field.phases[0] = size
    field.values[0] = least
