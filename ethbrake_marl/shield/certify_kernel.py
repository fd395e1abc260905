"""The compiled decisions of the step shield.

Everything that is certified is advanced decision by decision with the very operations of the engine's step
(``run_segment``, ``time_of`` and ``at_rest`` of ``search.motion``): what was certified is what will be
executed, to the same bits. Only the search for a promising constant runs in one segment to the horizon; what it finds
is certified step by step before it counts.

A world has M members, worlds that must all keep the bound: one without uncertainty, then nothing here costs more.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.actions import command_of
from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.impact import MASS
from ethbrake_marl.physics.segment import COMMAND, DONE, LIMIT, ROW_WIDTH, TABLE_ROWS
from ethbrake_marl.search.motion import (
    HARM_IS_TOTAL,
    LAST_STEP,
    RESTITUTION,
    at_rest,
    restore,
    run_segment,
    save,
    time_of,
)

# reasons of a decision, in the order of REASONS of shield.certify
SAME_AS_PLAN, PLAN_REMAINS, CONSTANT, NO_CERTIFICATE, NOT_A_NUMBER, ENDED = range(6)
NEARLY = 1e-9  # a constant whose harm (m2/s2) in one segment is above the limit by less is certified step by step


class Members(NamedTuple):
    """The members of one world, and room to work in."""

    table: Floats  # of physics.segment
    harm: Floats  # [2, P] first-impact and total harm so far
    no_rows: Floats  # no list of impacts is kept
    clock: Floats  # [M, CLOCK_WIDTH]
    bounds: Floats  # [M, 2] m/s2
    command: Floats  # [M, N] of the others
    latency: Floats  # [M, N]
    mass: Floats  # [M, N]
    limit: Floats  # [M, N]
    vehicle: int
    critical: Ints  # [1] the member that broke a limit last: it is tried first; no result depends on it


@compiled
def counted(harm: Floats, total: float) -> float:
    """Harm of the world so far under the count that is guaranteed, summed front to rear as the ledger does."""
    value, row = 0.0, 1 if total == 1.0 else 0
    for p in range(harm.shape[1]):
        value += harm[row, p]
    return value


@compiled
def advance_decisions(
    table: Floats, harm: Floats, latency: Floats, clock: Floats, step: int, end: int, no_rows: Floats
) -> int:
    """From decision ``step`` to decision ``end`` under the commands in the table.

    1: the episode has ended, 0: not yet, -1: the physics failed.
    """
    time, until = time_of(clock, step), time_of(clock, end)
    if run_segment(table, harm, latency, clock[RESTITUTION], time, until, no_rows) != DONE:
        return -1
    return 1 if end >= clock[LAST_STEP] or at_rest(table) else 0


@compiled
def enter(world: Members, m: int, state: Floats) -> None:
    """Member ``m`` in a saved state."""
    table, command, mass, limit = world.table, world.command[m], world.mass[m], world.limit[m]
    for i in range(table.shape[1]):
        table[COMMAND, i], table[MASS, i], table[LIMIT, i] = command[i], mass[i], limit[i]
    restore(table, world.harm, state)


@compiled
def act(world: Members, m: int, action: float) -> None:
    """The shielded vehicle's command of an action, in member ``m``."""
    world.table[COMMAND, world.vehicle] = command_of(action, -world.bounds[m, 0], world.bounds[m, 1])


@compiled_apart
def take_step(world: Members, m: int, state: Floats, step: int, action: float, after: Floats) -> int:
    """The step of one action from ``state``; fills ``after``. Returns as ``advance_decisions``."""
    table, harm = world.table, world.harm
    enter(world, m, state)
    act(world, m, action)
    ended = advance_decisions(table, harm, world.latency[m], world.clock[m], step, step + 1, world.no_rows)
    save(table, harm, after)
    return ended


@compiled
def take_steps(
    world: Members, states: Floats, ended: Bools, step: int, action: float, after: Floats, over: Bools
) -> int:
    """The step of one action in every member; how many episodes go on, or -1 if the physics failed."""
    going = 0
    for m in range(ended.shape[0]):
        status = 1
        if ended[m]:
            after[m, :] = states[m]
        else:
            status = take_step(world, m, states[m], step, action, after[m])
        if status < 0:
            return -1
        over[m] = status == 1
        going += 1 - status
    return going


@compiled
def worst_so_far(world: Members, states: Floats) -> float:
    """Largest harm so far over the members."""
    worst = 0.0
    for m in range(states.shape[0]):
        restore(world.table, world.harm, states[m])
        worst = max(worst, counted(world.harm, world.clock[m, HARM_IS_TOTAL]))
    return worst


@compiled_apart
def follow_plan(world: Members, m: int, state: Floats, ended: bool, step: int, plan: Floats, most: float) -> float:
    """Harm of the episode if the plan's actions are executed from ``state`` at ``step`` on, as the engine does.

    Gives up with infinity as soon as it is above ``most`` (harm never falls), or where the physics fails.
    """
    table, harm, latency, clock = world.table, world.harm, world.latency[m], world.clock[m]
    vehicle, braking, driving, no_rows = world.vehicle, -world.bounds[m, 0], world.bounds[m, 1], world.no_rows
    enter(world, m, state)
    status, value = 1 if ended else 0, counted(harm, clock[HARM_IS_TOTAL])
    while status == 0:
        table[COMMAND, vehicle] = command_of(plan[step], braking, driving)
        status = advance_decisions(table, harm, latency, clock, step, step + 1, no_rows)
        value = counted(harm, clock[HARM_IS_TOTAL])
        if status < 0 or value > most:
            return math.inf
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
    table, harm, clock = world.table, world.harm, world.clock[m]
    enter(world, m, state)
    act(world, m, action)
    if not ended:
        last = int(clock[LAST_STEP])
        if advance_decisions(table, harm, world.latency[m], clock, step, last, world.no_rows) < 0:
            return math.inf
    return counted(harm, clock[HARM_IS_TOTAL])


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
    table, harm, critical = np.zeros((TABLE_ROWS, N)), np.zeros((2, N - 1)), np.zeros(1, np.int64)
    no_rows = np.empty((0, ROW_WIDTH))
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
            table, harm, no_rows, clock[a:b], bounds[a:b], command[a:b], latency[a:b], mass[a:b], limit[a:b], vehicle,
            critical,
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
    table, harm, critical = np.zeros((TABLE_ROWS, N)), np.zeros((2, N - 1)), np.zeros(1, np.int64)
    no_rows = np.empty((0, ROW_WIDTH))
    trial = np.zeros(plans.shape[1])
    M = states.shape[0] // max(n, 1)
    for k in range(n):
        a, b = k * M, k * M + M
        world = Members(
            table, harm, no_rows, clock[a:b], bounds[a:b], command[a:b], latency[a:b], mass[a:b], limit[a:b], vehicle,
            critical,
        )  # fmt: skip
        value[k] = worst_of_plan(world, states[a:b], ended[a:b], steps[k], plans[k], math.inf)
        if constants.shape[0] > 0:
            value[k], _ = better_plan(
                world, states[a:b], ended[a:b], steps[k], constants, value[k], value[k], plans[k], trial
            )
