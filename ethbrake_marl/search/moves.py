"""Random profiles and random changes of profiles, compiled, from one small random stream per world.

``bounds`` [C, 2] are the smallest and the largest command of each controlled vehicle (m/s2); the other letters are
those of ``profile_motion``.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics import Floats, Ints, UInt64s
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.elementary import exp

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
def draw_profile(random: UInt64s, bounds: Floats, ends: Ints, commands: Floats, last: int) -> None:
    """Fill ``ends`` [K] and ``commands`` [K, C] at random; phases are short rather than long."""
    step = 0
    for k in range(ends.shape[0]):
        u = draw(random)
        step = min(step + 1 + int(u * u * LONGEST_DRAWN), last)
        ends[k] = step
        for c in range(bounds.shape[0]):
            commands[k, c] = draw_command(random, bounds[c, 0], bounds[c, 1])
    ends[ends.shape[0] - 1] = last


@compiled
def draw_change(random: UInt64s, bounds: Floats, active: int, change: Floats) -> int:
    """Fill ``change`` [CHANGE_WIDTH] at random, for one of the first ``active`` phases; returns the phase."""
    u = draw(random)
    phase, vehicle = draw_below(random, active), draw_below(random, bounds.shape[0])
    sign = 1.0 if draw(random) < 0.5 else -1.0
    size = draw(random)
    low, high = bounds[vehicle, 0], bounds[vehicle, 1]
    change[VEHICLE] = vehicle
    change[PHASE] = phase
    if u < 0.70:
        change[KIND] = COMMAND_CHANGE if u < 0.45 else TRADE
        change[AMOUNT] = sign * (high - low) * exp(LN_SMALLEST * size)
    elif u < 0.78:
        change[KIND] = SET_COMMAND
        change[AMOUNT] = draw_command(random, low, high)
    else:
        change[KIND] = MOVE_END
        change[AMOUNT] = sign * (1 + int(8.0 * size * size * size))
    return phase


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


@compiled
def split_phases(ends: Ints, commands: Floats, phases: int, wanted: int, attention: int) -> None:
    """Halve the longest phases, in place, until there are ``wanted``; steps after ``attention`` count as nothing."""
    while phases < wanted:
        longest, length = 0, -1
        for k in range(phases):
            begin = ends[k - 1] if k > 0 else 0
            here = min(ends[k], attention) - min(begin, attention)
            if here > length:
                longest, length = k, here
        for k in range(phases, longest, -1):
            ends[k] = ends[k - 1]
            for c in range(commands.shape[1]):
                commands[k, c] = commands[k - 1, c]
        begin = ends[longest - 1] if longest > 0 else 0
        ends[longest] = begin + max(length // 2, 0)
        phases += 1
