"""Compiled random search for the best commands in one world: simulate profiles, keep good ones, improve the best.

A profile has ``ends`` [K], the decisions at which its phases end, and ``commands`` [K, B] (m/s2). Each world has a
random stream of its own, so its result does not depend on other worlds. *Plans* are profiles with one phase for each
decision.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import amount_so_far
from ethbrake_marl.episode.state import END, FIRST_DECISION, HORIZON, LAST
from ethbrake_marl.episode.step import note_motion, stands
from ethbrake_marl.extensions.search.pricing import UInt64s, worth
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.elementary import exp
from ethbrake_marl.motion.interval import FAILED, move_line
from ethbrake_marl.motion.layout import Floats, Ints

OTHER_WEIGHT = 1e-8  # weight of the other count of harm in what is minimised: it decides ties
RESOLUTION = 1048576.0  # commands are multiples of 1 / 2^20 m/s2: short to store and exactly repeatable

# places in `World.numbers`
TIME_STEP, AIM, STEPWISE, NUMBERS = range(4)

# how random changes are drawn: of a phase of a profile, or of some decisions of a plan
KIND, ATTENTION, LONGEST_CHANGE, DRAWING = range(4)
PROFILE, PLAN = 0, 1

# a change, and its kinds
WHAT, VEHICLE, PHASE, LENGTH, AMOUNT, CHANGE = range(6)
ADD = 0  # adds an amount to the command of some phases
TRADE = 1  # also changes the command of the next phase, so that the speed after both stays
SET = 2  # replaces the command of some phases
MOVE_END = 3  # moves the border between two phases by whole steps


class World(NamedTuple):
    """Data of one world for the search."""

    car: Floats  # [CAR_ROWS, N + 1]
    clock: Floats  # [CLOCK_COLUMNS] at the first decision
    wanted: Floats  # [N + 1] commands of all bodies (m/s2); overwritten
    bodies: Ints  # [B] vehicles that are controlled
    bounds: Floats  # [B, 2] their smallest and largest command (m/s2)
    shares: Floats  # [3, N + 1], as in `Problem`
    numbers: Floats  # [NUMBERS] time step (s), aim, whether step by step
    weights: Floats  # [2, 6] of the count of harm that is minimised, and of the count that decides ties
    random: UInt64s  # [1] state of the random stream
    scratch: Floats  # of the physics


class Room(NamedTuple):
    """Working memory of a search: the profile that is being tried, and the states at the beginning of its phases."""

    lines: Floats  # [K + 1, LINE_ROWS, N + 1] of the best profile; lines[0] is the state at the first decision
    tried: Floats  # [K + 1, LINE_ROWS, N + 1] of the profile that is tried
    ends: Ints  # [K]
    commands: Floats  # [K, B]
    change: Floats  # [CHANGE]


class Field(NamedTuple):
    """The best M profiles (commands over time) of one world so far."""

    ends: Ints  # [M, K]
    commands: Floats  # [M, K, B]
    phases: Ints  # [M] number of phases in use; 0: an empty place
    values: Floats  # [M] what is minimised (m2/s2)


@kernel
def search_value(world, line):
    """What the search minimises (m2/s2), plus a little of another count of harm, which decides ties."""
    aim = world.numbers[AIM]
    return worth(line, world.shares, world.weights[0], aim) + OTHER_WEIGHT * amount_so_far(line, world.weights[1])


@kernel
def copy_line(line, into):
    for row in range(line.shape[0]):
        for i in range(line.shape[1]):
            into[row, i] = line[row, i]


@large
def follow(world, lines, ends, commands, phase, most):
    """Simulate a profile from ``phase`` on; return its value (m2/s2), and the number of phases until the end.

    Starts from ``lines[phase]`` and writes the state after phase p to ``lines[p + 1]``. Ends when all vehicles are at
    rest, or the value reaches ``most`` (m2/s2). The number of phases is -1 if a check of the physics fails. Step by
    step (``STEPWISE``) the result has the bits of the episode; phase by phase it is several times faster and rounds
    differently.
    """
    numbers, clock = world.numbers, world.clock
    value = search_value(world, lines[phase])
    for p in range(phase, ends.shape[0]):
        step, at_rest, line = ends[p - 1] if p > 0 else 0, False, lines[p + 1]
        copy_line(lines[p], line)
        if ends[p] > step:
            for b in range(world.bodies.shape[0]):
                world.wanted[world.bodies[b]] = commands[p, b]
            while step < ends[p] and not at_rest:
                start = clock[FIRST_DECISION] + step * numbers[TIME_STEP]
                step = step + 1 if numbers[STEPWISE] == 1.0 else ends[p]
                until = clock[FIRST_DECISION] + step * numbers[TIME_STEP]
                until = clock[END] if step >= clock[LAST] else until
                if move_line(line, world.car, world.wanted, world.scratch, start, until) == FAILED:
                    return value, -1
                at_rest = stands(line, world.wanted)
                if step >= clock[LAST] and clock[END] >= clock[HORIZON]:
                    note_motion(line, world.car)
            value = search_value(world, line)
        if value >= most or at_rest:
            return value, p + 1
    return value, ends.shape[0]


@large
def next_uniform(random):
    """Next random number in [0, 1) of a splitmix64 generator, whose state is ``random`` [1]."""
    random[0] += np.uint64(0x9E3779B97F4A7C15)
    z = random[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) * 2.0**-53


@large
def draw_below(random, n):
    return min(int(next_uniform(random) * n), n - 1)


@large
def draw_sign(random):
    return 1.0 if next_uniform(random) < 0.5 else -1.0


@kernel
def limit_command(command, low, high):
    """Command limited to ``low`` ... ``high``, rounded toward 0 to a multiple of 1 / RESOLUTION (m/s2)."""
    return int(min(max(command, low), high) * RESOLUTION) / RESOLUTION


@large
def draw_command(world, b):
    """Random command (m/s2) of the vehicle ``bodies[b]``: often full braking, full driving, 0, or that of the vehicle
    ahead.
    """
    random, body, low, high = world.random, world.bodies[b], world.bounds[b, 0], world.bounds[b, 1]
    u = next_uniform(random)
    if u < 0.35:
        return low
    if u < 0.5:
        return high
    if u < 0.6:
        return 0.0
    if u < 0.7:
        return limit_command(world.wanted[body - 1], low, high)
    return limit_command(low + (high - low) * next_uniform(random), low, high)


@large
def draw_profile(world, ends, commands):
    """Write six phases of random commands, most of them short, to ``ends`` [K] and ``commands`` [K, B]; return 6."""
    random, bounds, last = world.random, world.bounds, int(world.clock[LAST])
    step = 0
    for p in range(6):
        u = next_uniform(random)
        step = min(step + 1 + int(u * u * 25.0), last)
        ends[p] = step
        for b in range(bounds.shape[0]):
            commands[p, b] = draw_command(world, b)
    ends[5] = last
    return 6


@large
def draw_change(world, active, drawing, change):
    """Write a random change of one of the first ``active`` phases of a profile to ``change`` [CHANGE].

    The logarithm of an added amount is uniform.
    """
    random, bounds = world.random, world.bounds
    if drawing[KIND] == PLAN:
        low, high = bounds[0, 0], bounds[0, 1]
        change[WHAT], change[VEHICLE] = ADD if next_uniform(random) >= 0.1 else SET, 0
        change[PHASE] = draw_below(random, min(active, drawing[ATTENTION]))
        u = next_uniform(random)
        change[LENGTH] = 1 + int(u * u * drawing[LONGEST_CHANGE])
        if change[WHAT] == ADD:  # down to a thousandth of all commands
            sign = draw_sign(random)
            change[AMOUNT] = sign * (high - low) * exp(-6.907755278982138 * next_uniform(random))
        else:
            change[AMOUNT] = draw_command(world, 0)
        return
    u = next_uniform(random)
    change[PHASE], b, change[LENGTH] = draw_below(random, active), draw_below(random, bounds.shape[0]), 1
    sign, size, low, high = draw_sign(random), next_uniform(random), bounds[b, 0], bounds[b, 1]
    change[VEHICLE] = b
    if u < 0.70:  # down to a millionth of all commands
        change[WHAT] = ADD if u < 0.45 else TRADE
        change[AMOUNT] = sign * (high - low) * exp(-13.815510557964275 * size)
    elif u < 0.78:
        change[WHAT], change[AMOUNT] = SET, draw_command(world, b)
    else:
        change[WHAT], change[AMOUNT] = MOVE_END, sign * (1 + int(8.0 * size * size * size))


@large
def apply_change(change, bounds, ends, commands):
    """Apply ``change`` [CHANGE] to a profile, within ``bounds`` [B, 2]; return whether the profile is now different."""
    what, b, p, amount = int(change[WHAT]), int(change[VEHICLE]), int(change[PHASE]), change[AMOUNT]
    low, high, phases = bounds[b, 0], bounds[b, 1], ends.shape[0]
    begin, changed = ends[p - 1] if p > 0 else 0, False
    if what in (MOVE_END, TRADE):
        if p == phases - 1:
            return False
        here, there = ends[p] - begin, ends[p + 1] - ends[p]
        if what == MOVE_END:
            end = min(max(ends[p] + int(amount), begin), ends[p + 1])
            changed = end != ends[p]
            ends[p] = end
            return changed
        if here == 0 or there == 0:
            return False
        before = commands[p, b]
        commands[p, b] = limit_command(before + amount, low, high)
        commands[p + 1, b] = limit_command(commands[p + 1, b] - (commands[p, b] - before) * here / there, low, high)
        return commands[p, b] != before
    for q in range(p, min(p + int(change[LENGTH]), phases)):
        before = commands[q, b]
        commands[q, b] = amount if what == SET else limit_command(before + amount, low, high)
        changed = changed or commands[q, b] != before
    return changed


@large
def copy_profile(ends, commands, to_ends, to_commands):
    for p in range(ends.shape[0]):
        to_ends[p] = ends[p]
        for b in range(commands.shape[1]):
            to_commands[p, b] = commands[p, b]


@kernel
def largest_place(values):
    place = 0
    for m in range(1, values.shape[0]):
        if values[m] > values[place]:
            place = m
    return place


@large
def gather(world, room, ends, commands, phases, random_count, tolerance, field):
    """Fill ``field`` with the best of Q profiles and ``random_count`` random profiles; its places are not sorted.

    ``ends`` [Q, K], ``commands`` [Q, K, B], ``phases`` [Q]: the profiles (0 phases: empty place). Of profiles whose
    values differ by less than ``tolerance`` (m2/s2), only the first is kept.
    """
    worst, number = 0, ends.shape[0]
    begin = min(worst, number)  # 0, but no literal: numba would compile the physics again for it
    for s in range(number + random_count):
        phase_count = phases[s] if s < number else 0
        if s < number:
            copy_profile(ends[s], commands[s], room.ends, room.commands)
        else:
            phase_count = draw_profile(world, room.ends, room.commands)
        if phase_count == 0:
            continue
        trial_ends, trial_commands = room.ends[:phase_count], room.commands[:phase_count]
        value, reached = follow(world, room.lines, trial_ends, trial_commands, begin, field.values[worst])
        is_accepted = reached > 0 and value < field.values[worst]
        for m in range(field.values.shape[0]):
            is_accepted = is_accepted and not abs(field.values[m] - value) < tolerance
        if not is_accepted:
            continue
        copy_profile(trial_ends, trial_commands, field.ends[worst], field.commands[worst])
        field.phases[worst], field.values[worst] = phase_count, value
        if value <= 0.0:
            break
        worst = largest_place(field.values)


@large
def improve(world, room, ends, commands, budget, drawing):
    """Improve a profile in place by random changes, at most ``budget``, until its value is 0.

    A change that helps is repeated with twice the amount. A change that leaves the profile as it was costs no budget,
    unless ``drawing`` is of the kind ``PLAN``. Returns the value (m2/s2; infinite if it cannot be simulated), and the
    number of phases until the episode ends.
    """
    change, lines, trial_lines = room.change, room.lines, room.tried
    new_ends, new_commands = room.ends[: ends.shape[0]], room.commands[: ends.shape[0]]
    begin = min(0, ends.shape[0])  # no literal, as in `gather`
    value, active = follow(world, lines, ends, commands, begin, math.inf)
    if active < 0 or not value < math.inf:
        return math.inf, 0
    spent, again = 0, False
    for _ in range(4 * budget):
        if spent >= budget or value <= 0.0:
            break
        if not again:
            draw_change(world, active, drawing, change)
        phase, again = int(change[PHASE]), False
        copy_profile(ends, commands, new_ends, new_commands)
        if not apply_change(change, world.bounds, new_ends, new_commands):
            spent += 1 if drawing[KIND] == PLAN else 0
            continue
        spent += 1
        copy_line(lines[phase], trial_lines[phase])
        new, reached = follow(world, trial_lines, new_ends, new_commands, phase, value)
        if reached < 0 or not new < value:
            continue
        value, active = new, reached
        copy_profile(new_ends, new_commands, ends, commands)
        for p in range(phase + 1, reached + 1):
            copy_line(trial_lines[p], lines[p])
        change[AMOUNT] *= 2.0
        again = change[WHAT] != SET
    return value, active


@large
def try_all(world, room, ends, commands, values):
    """Write the value (m2/s2) of each of Q profiles to ``values`` [Q]; infinite if a profile cannot be simulated."""
    begin = min(0, ends.shape[0])  # no literal, as in `gather`
    for q in range(ends.shape[0]):
        value, reached = follow(world, room.lines, ends[q], commands[q], begin, math.inf)
        values[q] = value if reached > 0 else math.inf
