"""The compiled decisions of the step shield.

Everything that is certified is advanced decision by decision by ``physics.episode.step_episode``, with the operations
of the engine's step: what was certified is what will be executed, to the same bits. Only the search for a
promising constant runs in one segment to the horizon; what it finds is certified step by step before it counts.

A world has M members, worlds that must all keep the bound: one without uncertainty, then nothing here costs more.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.actions import command_of
from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.episode import (
    EPISODE_ROWS,
    GOES_ON,
    HARM_IS_TOTAL,
    LAST_STEP,
    LATENCY,
    RESTITUTION,
    grid_of,
    harm_so_far,
    restore,
    save,
    step_again,
)
from ethbrake_marl.physics.impact import MASS
from ethbrake_marl.physics.segment import COMMAND, LIMIT

# reasons of a decision, in the order of REASONS of shield.certify
SAME_AS_PLAN, PLAN_REMAINS, CONSTANT, NO_CERTIFICATE, NOT_A_NUMBER, ENDED = range(6)
NEARLY = 1e-9  # a constant whose harm (m2/s2) in one segment is above the limit by less is certified step by step


class Members(NamedTuple):
    """The members of one world, and room to work in."""

    table: Floats  # of physics.episode
    clock: Floats  # [M, CLOCK_WIDTH]
    bounds: Floats  # [M, 2] m/s2
    command: Floats  # [M, N] of the others
    latency: Floats  # [M, N]
    mass: Floats  # [M, N]
    limit: Floats  # [M, N]
    vehicle: int
    critical: Ints  # [1] the member that broke a limit last: it is tried first; no result depends on it


@compiled
def enter(world: Members, m: int, state: Floats) -> None:
    """Member ``m`` in a saved state."""
    table = world.table
    for i in range(table.shape[1]):
        table[COMMAND, i], table[LATENCY, i] = world.command[m, i], world.latency[m, i]
        table[MASS, i], table[LIMIT, i] = world.mass[m, i], world.limit[m, i]
    restore(table, state)


@compiled
def act(world: Members, m: int, action: float) -> None:
    """The shielded vehicle's command of an action, in member ``m``."""
    world.table[COMMAND, world.vehicle] = command_of(action, -world.bounds[m, 0], world.bounds[m, 1])


@compiled_apart
def take_step(world: Members, m: int, state: Floats, step: int, action: float, after: Floats) -> int:
    """The step of one action from ``state``; fills ``after``. Returns as ``step_episode``."""
    enter(world, m, state)
    act(world, m, action)
    outcome = step_again(
        world.table, world.clock[m, RESTITUTION], grid_of(world.clock[m]), step, step + 1, world.table[:0]
    )
    save(world.table, after)
    return outcome


@compiled
def take_steps(
    world: Members, states: Floats, ended: Bools, step: int, action: float, after: Floats, over: Bools
) -> int:
    """The step of one action in every member; how many episodes go on, or -1 if the physics failed."""
    going = 0
    for m in range(ended.shape[0]):
        if ended[m]:
            after[m, :], over[m] = states[m], True
            continue
        outcome = take_step(world, m, states[m], step, action, after[m])
        if outcome < GOES_ON:
            return -1
        over[m] = outcome != GOES_ON
        going += 0 if over[m] else 1
    return going


@compiled
def worst_so_far(world: Members, states: Floats) -> float:
    """Largest harm so far over the members."""
    worst = 0.0
    for m in range(states.shape[0]):
        restore(world.table, states[m])
        worst = max(worst, harm_so_far(world.table, world.clock[m, HARM_IS_TOTAL]))
    return worst


@compiled_apart
def follow_plan(world: Members, m: int, state: Floats, ended: bool, step: int, plan: Floats, most: float) -> float:
    """Harm of the episode if the plan's actions are executed from ``state`` at ``step`` on, as the engine does.

    Gives up with infinity as soon as it is above ``most`` (harm never falls), or where the physics fails.
    """
    table, no_rows, total = world.table, world.table[:0], world.clock[m, HARM_IS_TOTAL]
    restitution, grid = world.clock[m, RESTITUTION], grid_of(world.clock[m])
    vehicle, braking, driving = world.vehicle, -world.bounds[m, 0], world.bounds[m, 1]
    enter(world, m, state)
    goes_on, value = not ended, harm_so_far(table, total)
    while goes_on:
        table[COMMAND, vehicle] = command_of(plan[step], braking, driving)
        outcome = step_again(table, restitution, grid, step, step + 1, no_rows)
        value = harm_so_far(table, total)
        if outcome < GOES_ON or value > most:
            return math.inf
        goes_on = outcome == GOES_ON
        step += 1
    return value


@compiled
def worst_of_plan(world: Members, states: Floats, ended: Bools, step: int, plan: Floats, most: float) -> float:
    """Largest harm of a plan over the members; infinity as soon as one of them is above ``most``."""
    worst, first = 0.0, world.critical[0]
    for j in range(ended.shape[0]):
        m = (first + j) % ended.shape[0]
        worst = max(worst, follow_plan(world, m, states[m], ended[m], step, plan, most))
        if worst == math.inf:
            world.critical[0] = m
            break
    return worst


@compiled
def hold_constant(world: Members, m: int, state: Floats, ended: bool, step: int, action: float) -> float:
    """Harm of the episode under a constant action from here, in one segment; infinity where the physics fails."""
    table, clock = world.table, world.clock[m]
    enter(world, m, state)
    act(world, m, action)
    if not ended:
        last, grid = int(clock[LAST_STEP]), grid_of(clock)
        if step_again(table, clock[RESTITUTION], grid, step, last, table[:0]) < GOES_ON:
            return math.inf
    return harm_so_far(table, clock[HARM_IS_TOTAL])


@compiled_apart
def best_constant(world: Members, states: Floats, ended: Bools, step: int, constants: Floats) -> tuple[float, float]:
    """The constant action of least worst harm from here on, and that harm, each in one segment."""
    best, least, critical = 0.0, math.inf, 0
    for c in range(constants.shape[0]):
        worst, first = 0.0, critical
        for j in range(ended.shape[0]):
            m = (first + j) % ended.shape[0]
            value = hold_constant(world, m, states[m], ended[m], step, constants[c])
            if value > worst:
                worst, critical = value, m
            if not worst < least:
                break
        if worst < least:
            best, least = constants[c], worst
    return best, least


@compiled_apart
def better_plan(
    world: Members, states: Floats, ended: Bools, step: int, constants: Floats, value: float, most: float,
    plan: Floats, trial: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Replace the plan from ``step`` on by the best constant, if that harms less than ``value`` and at most ``most``.

    Returns the harm that is certified now, and the least harm found, certified or not.
    """
    so_far = worst_so_far(world, states)
    if value <= so_far or so_far > most:  # nothing can be better
        return value, min(value, so_far) if value <= so_far else so_far
    action, least = best_constant(world, states, ended, step, constants)
    if not least < value or least > most + NEARLY:
        return value, min(value, least)
    for j in range(step, trial.shape[0]):
        trial[j] = action
    certified = worst_of_plan(world, states, ended, step, trial, most)
    if not certified < value:
        return value, min(value, least)
    for j in range(step, plan.shape[0]):
        plan[j] = action
    return certified, certified


@compiled_apart
def decide_world(
    world: Members, states: Floats, ended: Bools, step: int, proposed: float, budget: float, certified: float,
    constants: Floats, plan: Floats, room: Floats, after: Floats, over: Bools, out: Floats,
) -> bool:  # fmt: skip
    """Decide in one world, see ``certify``: fills ``after``, ``over`` (by member) and ``out`` (applied, reason, bound,
    margin); the plan is the one whose harm is ``out``'s bound. A proposal from which the physics fails is not
    certified. Returns whether the physics did not fail with what is applied.
    """
    usable = not math.isnan(proposed)
    proposal = min(max(proposed, -1.0), 1.0) if usable else plan[step]
    going = take_steps(world, states, ended, step, proposal, after, over)
    value = worst_so_far(world, after) if going >= 0 else math.inf
    reason, least = PLAN_REMAINS, value
    if proposal == plan[step] and going >= 0:
        reason, value = SAME_AS_PLAN if usable else NOT_A_NUMBER, certified
    elif going > 0:
        room[0, :] = plan
        value = worst_of_plan(world, after, over, step + 1, plan, budget)
        reason = CONSTANT if value > budget else PLAN_REMAINS
        value, least = better_plan(world, after, over, step + 1, constants, value, budget, room[0], room[1])
        if value <= budget:
            plan[:] = room[0]
    if value <= budget:
        plan[step] = proposal
        out[0], out[1], out[2], out[3] = proposal, reason, value, budget - value
        return True
    going = take_steps(world, states, ended, step, plan[step], after, over)
    out[0], out[1], out[2], out[3] = plan[step], NO_CERTIFICATE, certified, budget - least
    if going > 0:
        out[2], _ = better_plan(world, after, over, step + 1, constants, certified, certified, plan, room[1])
    return going >= 0


@compiled
def certify_worlds(
    states: Floats, steps: Ints, ended: Bools, clock: Floats, bounds: Floats, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, vehicle: int, proposed: Floats, budget: Floats, certified: Floats, constants: Floats,
    plans: Floats, after: Floats, out: Floats, over: Bools, failed: Bools,
) -> None:  # fmt: skip
    """``decide_world`` in every world whose episode runs; ``failed`` [n] where it did. ``plans`` change in place.

    World k's members are the rows from k * M on, M of them.
    """
    N, n = mass.shape[1], steps.shape[0]
    table, critical = np.zeros((EPISODE_ROWS, N)), np.zeros(1, np.int64)
    room = np.zeros((2, plans.shape[1]))
    M = states.shape[0] // max(n, 1)
    for k in range(n):
        a, b = k * M, k * M + M
        if ended[a:b].all():
            after[a:b] = states[a:b]
            last = min(steps[k], plans.shape[1] - 1)
            out[k, 0], out[k, 1], out[k, 2], out[k, 3] = plans[k, last], ENDED, certified[k], budget[k] - certified[k]
            over[a:b] = True
            continue
        world = Members(
            table, clock[a:b], bounds[a:b], command[a:b], latency[a:b], mass[a:b], limit[a:b], vehicle, critical
        )  # fmt: skip
        good = decide_world(
            world, states[a:b], ended[a:b], steps[k], proposed[k], budget[k], certified[k], constants, plans[k], room,
            after[a:b], over[a:b], out[k],
        )  # fmt: skip
        failed[k] = not good


@compiled
def harm_of_plans(
    states: Floats, steps: Ints, ended: Bools, clock: Floats, bounds: Floats, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, vehicle: int, constants: Floats, plans: Floats, value: Floats,
) -> None:  # fmt: skip
    """Fill ``value`` [n] with the worst harm of the episodes if the plans are executed from here; infinity: it failed.

    Where one of the ``constants`` is better, it replaces the plan (in place) first.
    """
    N, n = mass.shape[1], steps.shape[0]
    table, critical = np.zeros((EPISODE_ROWS, N)), np.zeros(1, np.int64)
    trial = np.zeros(plans.shape[1])
    M = states.shape[0] // max(n, 1)
    for k in range(n):
        a, b = k * M, k * M + M
        world = Members(
            table, clock[a:b], bounds[a:b], command[a:b], latency[a:b], mass[a:b], limit[a:b], vehicle, critical
        )  # fmt: skip
        value[k] = worst_of_plan(world, states[a:b], ended[a:b], steps[k], plans[k], math.inf)
        if constants.shape[0] > 0:
            value[k], _ = better_plan(
                world, states[a:b], ended[a:b], steps[k], constants, value[k], value[k], plans[k], trial
            )
