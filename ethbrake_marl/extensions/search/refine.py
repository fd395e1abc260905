"""Compiled random search that improves the commands of an episode.

The search improves two sequences of commands by random changes of a few neighbouring steps. The first sequence comes
from the caller. The second is the best of some random *templates*; it is needed because small changes of the caller's
commands may miss the best commands. A template is a random braking profile of three phases: one command, then another
command for a short while, then full braking. The search simulates one decision after the other, as the engine does, and
therefore computes exactly the same harm as the engine.

Arguments that several functions share: ``budget`` is the number of candidates (sequences of commands) to simulate in
each world. ``room`` has arrays for intermediate results. ``world`` is the world to simulate; a ``SearchWorld`` also has
the bounds of the commands and a random stream.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number, count_of
from ethbrake_marl.extensions.search.problem import seeded
from ethbrake_marl.extensions.search.profiles import allowed, draw, draw_below, draw_command
from ethbrake_marl.first_edition.engine.profiles import ProfileProblem, SearchWorld, copy_rows, make_search_world
from ethbrake_marl.first_edition.physics.elementary import exp
from ethbrake_marl.first_edition.physics.episode import (
    CLOCK,
    GOES_ON,
    Episode,
    grid_of,
    restore,
    save,
    step_again,
    value_of,
)
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.rows import ROW
from ethbrake_marl.first_edition.physics.state import Bools, Floats, UInt64s

# fractions of the budget for drawing templates and for improving the best one; the rest improves the given commands
TEMPLATE_SHARE, THEIR_CLIMB_SHARE = 0.3, 0.3

ATTENTION_S = 3.0  # a change begins at most this time after the first decision

LONGEST_CHANGE_S = 0.6  # largest duration of a change

LONGEST_WHILE_S = 0.8  # largest duration of the second command of a template

SET_SHARE = 0.1  # fraction of changes that replace commands; the other changes add an amount to commands

FULL_BRAKE_SHARE = 0.8  # probability that a template begins with full braking

# ln of the smallest added amount, relative to the whole range of commands: three decades
LN_SMALLEST_CHANGE = -6.907755278982138

WORSE = 5.0  # m2/s2; a template is improved only if its harm exceeds the best harm so far by less than this

NO_HARM = 1e-9  # m2/s2; less harm than this is treated as 0


class Plan(NamedTuple):
    """Commands of the controlled vehicle in every step of one world, and the states that these commands lead to."""

    commands: Floats  # [T] command of the controlled vehicle in each step, m/s2
    states: Floats  # [T + 1, S] state of the simulation at the start of each step


def refine(problem: ProfileProblem, commands_mps2: Floats, *, budget: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Improve commands by a search; return the commands with the least harm, [n, T] m/s2, and their harm, [n] m2/s2.

    The harm of the returned commands is at most the harm of the given commands. The harm is the quantity that
    ``problem`` minimises, and equals the harm that the engine computes. The result for a world does not depend on the
    other worlds. Raises ``InvalidInput`` if several vehicles are controlled, if the commands have a wrong shape or
    exceed a capacity, or if ``budget`` is below 1. Raises ``PhysicsError``, which names the worlds, if the given
    commands cannot be simulated.

    ``commands_mps2`` [n, T] is the command of the controlled vehicle in each step, with which the search starts.
    """
    check_whole_number("budget", budget, 1)
    n, steps = problem.n, int(problem.last_step.max(initial=0))
    low, high = problem.bounds[:, :1, 0], problem.bounds[:, :1, 1]
    if len(problem.vehicles) != 1 or commands_mps2.shape != (n, steps):
        raise InvalidInput(
            f"refine: the problem has {count_of(len(problem.vehicles), 'controlled vehicle')}, and the commands have"
            f" the shape {commands_mps2.shape}; give one controlled vehicle and commands of shape ({n}, {steps})"
        )
    if not ((commands_mps2 >= low) & (commands_mps2 <= high)).all():
        raise InvalidInput(
            "refine: a command exceeds the capacity of the vehicle; give commands between minus the braking capacity"
            " and the driving capacity"
        )
    best, value, failed = commands_mps2.copy(), np.zeros(n), np.zeros(n, np.bool_)
    _refine_worlds(problem, seeded(problem.identity, seed), budget, best, value, failed)
    if failed.any():
        raise PhysicsError({k: "the given commands cannot be simulated" for k in np.flatnonzero(failed).tolist()})
    return best, value


@compiled
def _refine_worlds(
    problem: ProfileProblem, random: UInt64s, budget: int, commands: Floats, value: Floats, failed: Bools
) -> None:
    """Improve the commands [n, T] of each world, in place.

    ``random`` [n] is the initial state of each world's random stream. Outputs: ``value`` [n], the harm of the improved
    commands, m2/s2; ``failed`` [n], True for worlds in which the given commands cannot be simulated.
    """
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
        value[k] = value_of(world.episode.table, world.episode.clock, 0.0)


@compiled(apart=True)
def _refine_world(world: SearchWorld, mine: Plan, other: Plan, room: Plan, budget: int) -> bool:
    """Improve the commands ``mine`` in place. Return False if the given commands cannot be simulated.

    ``other`` is for intermediate results, like ``room``.
    """
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
    """Simulate the commands of ``plan`` from step ``begin`` on, and write the state after each step into ``plan``.

    Returns the harm (m2/s2) and the number of steps of the episode; -1 steps if the simulation fails. ``plan`` must
    contain the state at step ``begin``. The simulation stops as soon as the harm is at least ``bound``, m2/s2.
    """
    table, clock = world.table, world.clock
    grid, restitution, last = grid_of(clock), clock[CLOCK.RESTITUTION], int(clock[CLOCK.LAST_STEP])
    no_rows = table[:0]
    restore(table, plan.states[begin])
    value = value_of(table, clock)
    for step in range(begin, last):
        table[ROW.COMMAND, world.controlled[0]] = plan.commands[step]
        outcome = step_again(table, restitution, grid, step, step + 1, no_rows)
        if outcome < GOES_ON:
            return value, -1
        value = value_of(table, clock)
        save(table, plan.states[step + 1])
        if value >= bound or outcome != GOES_ON:
            return value, step + 1
    return value, last


@compiled(apart=True)
def climb(world: SearchWorld, plan: Plan, room: Plan, value: float, reached: int, budget: int) -> tuple[float, int]:
    """Improve ``plan`` in place by random changes; return its new harm (m2/s2) and the number of steps of its episode.

    Most changes add an amount to the commands of some neighbouring steps; the others replace these commands. If adding
    an amount lowers the harm, the next change adds twice this amount to the commands of the same steps. ``value`` and
    ``reached`` are the harm and the number of steps before the improvement.
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
            if adds:  # an amount of either sign, log-uniform
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
    """Simulate ``number`` random templates, and write the one with the least harm to ``best``.

    Returns the least harm (m2/s2) and the number of steps of this template's episode; 0 steps if no template does less
    harm than ``bound``.
    """
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
    """Return the number of decision steps of ``world`` in ``duration_s``, rounded to a whole number of at least 1."""
    return max(int(duration_s / world.clock[CLOCK.TIME_STEP] + 0.5), 1)


@compiled
def copy_steps(commands: Floats, to: Floats, first: int) -> None:
    """Copy the commands from step ``first`` on into the array ``to``."""
    for t in range(first, commands.shape[0]):
        to[t] = commands[t]
