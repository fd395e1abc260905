"""The search for the profile of least harm in one world, compiled: one call per world, no Python inside.

Method: given profiles (constants among them) and random ones are tried; the best of them, all different, are improved
by random changes of any size, each success being repeated twice as large; after each round the better half goes on.
The last one is divided into more phases and improved further, at the end decision by decision, as the engine runs.
Letters as in ``profile_motion``; Q given profiles, M of them and of the random ones improved.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.profile_motion import LAST_STEP, STEPWISE, Setting, follow, follow_whole
from ethbrake_marl.agents.profile_moves import (
    AMOUNT,
    CHANGE_WIDTH,
    KIND,
    SET_COMMAND,
    apply_change,
    compact,
    draw_change,
    draw_profile,
    split_phases,
)
from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.physics.compiled import compiled

MOST_PHASES = 12
DRAWN_PHASES = 6  # of a random profile
DRAWN_SHARE = 0.35  # of the budget, for given and random profiles
ROUNDS_SHARE = 0.50  # for the rounds of improvement that each halve the field
STEPWISE_SHARE = 0.02  # for the last improvement; its candidates cost several times more
PER_PROFILE = 400  # candidates of the budget for each profile of the first round, and at most
SMALLEST_FIELD, LARGEST_FIELD = 4, 128  # profiles there
SAME = 1e-6  # values (m2/s2) closer than this belong to the same profile
ATTENTION_STEPS = 30  # phases are divided within these first steps


class Field(NamedTuple):
    """Profiles that are improved together."""

    ends: Ints  # [M, K]
    commands: Floats  # [M, K, C]
    phases: Ints  # [M] how many of the K are used; 0 for an empty place
    values: Floats  # [M] what is minimised


@compiled
def search_world(
    world: Setting, start: Floats, seed_ends: Ints, seed_commands: Floats, budget: int, ends: Ints, commands: Floats
) -> int:
    """Fill ``ends`` [K] and ``commands`` [K, C] with the best profile found; its number of phases.

    ``start`` [S] is the state at the first decision; ``seed_ends`` [Q, K] and ``seed_commands`` [Q, K, C] are given
    profiles, and the result is never worse than any of them. 0 if the kernel failed on every profile.
    """
    K, C = commands.shape
    states = np.zeros((K + 1, start.shape[0]))
    states[0] = start
    M, rounds = SMALLEST_FIELD, 3
    while budget >= 2 * M * PER_PROFILE and M < LARGEST_FIELD:
        M *= 2
        rounds += 1
    field = Field(np.zeros((M, K), np.int64), np.zeros((M, K, C)), np.zeros(M, np.int64), np.full(M, math.inf))
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
        # The only place that calls improve, which is the larger part of what is compiled here.
        for m in range(left):
            used = field.phases[m]
            if used > 0 and field.values[0] > 0.0:
                field.values[m] = improve(world, field.ends[m, :used], field.commands[m, :used], states, each)
        sort(field, left)
    used = field.phases[0]
    ends[:] = field.ends[0]
    commands[:] = field.commands[0]
    if used == 0:
        return 0
    used = compact(ends[:used], commands[:used], used)
    ends[used:] = int(world.clock[LAST_STEP])
    commands[used:] = commands[used - 1]
    return used


@compiled
def improve(world: Setting, ends: Ints, commands: Floats, states: Floats, budget: int) -> float:
    """Better and better neighbours of a profile, in place, until ``budget`` candidates have run; its value."""
    new_ends, new_commands, new_states = ends.copy(), commands.copy(), states.copy()
    change = np.zeros(CHANGE_WIDTH)
    value, active, spent, phase, again = math.inf, 0, -1, 0, False  # the first candidate is the profile itself
    for _ in range(4 * budget + 1):  # a change that changes nothing costs no candidate
        if spent >= budget or value <= 0.0:
            break
        if spent >= 0:
            if not again:
                phase = draw_change(world.random, world.bounds, active, change)
            new_ends[:] = ends
            new_commands[:] = commands
            again = False
            if not apply_change(change, world.bounds, new_ends, new_commands):
                continue
            new_states[phase] = states[phase]
        spent += 1
        new_value, reached = follow(world, new_ends, new_commands, new_states, phase, value)
        if reached < 0 or not new_value < value:
            if active == 0:
                return math.inf
            continue
        value, active = new_value, reached
        ends[:] = new_ends
        commands[:] = new_commands
        states[phase + 1 : reached + 1] = new_states[phase + 1 : reached + 1]
        change[AMOUNT] *= 2.0
        again = spent > 0 and change[KIND] != SET_COMMAND
    ends[active - 1 :] = int(world.clock[LAST_STEP])  # the episode is over by then
    return value


@compiled
def gather(world: Setting, seed_ends: Ints, seed_commands: Floats, states: Floats, drawn: int, field: Field) -> None:
    """Fill the field with the best of the given profiles and of ``drawn`` random ones, all of different value."""
    Q, K = seed_ends.shape
    last = int(world.clock[LAST_STEP])
    ends, commands = np.zeros(K, np.int64), np.zeros(field.commands.shape[1:])
    worst = 0
    for s in range(Q + drawn):
        used = DRAWN_PHASES
        if s < Q:
            ends[:] = seed_ends[s]
            commands[:] = seed_commands[s]
            used = int(np.argmax(ends == last)) + 1
        else:
            draw_profile(world.random, world.bounds, ends[:used], commands[:used], last)
        value, reached = follow_whole(world, ends[:used], commands[:used], states, field.values[worst])
        if reached < 0 or not value < field.values[worst] or np.min(np.abs(field.values - value)) < SAME:
            continue
        field.ends[worst] = ends
        field.commands[worst] = commands
        field.phases[worst] = used
        field.values[worst] = value
        if value <= 0.0:
            break
        worst = int(np.argmax(field.values))
    sort(field, field.values.shape[0])


@compiled
def sort(field: Field, left: int) -> None:
    """Put the first ``left`` places of the field in order of value."""
    order = np.argsort(field.values[:left], kind="mergesort")
    field.values[:left] = field.values[:left][order]
    field.phases[:left] = field.phases[:left][order]
    field.ends[:left] = field.ends[:left][order]
    field.commands[:left] = field.commands[:left][order]


@compiled
def divide(world: Setting, field: Field) -> None:
    """Give the best of the field as many phases as there may be."""
    used = field.phases[0]
    if used > 0 and field.values[0] > 0.0:
        K = field.ends.shape[1]
        used = compact(field.ends[0, :used], field.commands[0, :used], used)
        split_phases(field.ends[0], field.commands[0], used, K, min(ATTENTION_STEPS, int(world.clock[LAST_STEP])))
        field.phases[0] = K


@compiled
def select_stepwise(world: Setting, seed_ends: Ints, seed_commands: Floats, states: Floats, field: Field) -> None:
    """From now on advance decision by decision; put the best of the field and the given profiles in the first place.

    Rounding may decide on which side of a jump a profile lands.
    """
    world.clock[STEPWISE] = 1.0
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
        value, reached = follow_whole(world, ends, commands, states, least)
        if reached > 0 and value < least:
            least, size = value, n
            best_ends[:n] = ends
            best_commands[:n] = commands
            if value <= 0.0:
                break
    field.ends[0] = best_ends
    field.commands[0] = best_commands
    field.phases[0] = size
    field.values[0] = least
