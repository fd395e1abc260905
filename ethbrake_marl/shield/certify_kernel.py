"""The compiled decisions of the step shield.

Everything that is certified is advanced decision by decision with the very operations of the engine's step
(``run_segment``, ``time_of`` and ``at_rest`` of ``agents.profile_motion``): what was certified is what will be
executed, to the same bits. Only the search for a promising constant runs in one segment to the horizon; what it finds
is certified step by step before it counts.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.actions import command_of
from ethbrake_marl.agents.profile_motion import (
    HARM_IS_TOTAL,
    LAST_STEP,
    RESTITUTION,
    at_rest,
    restore,
    run_segment,
    save,
    time_of,
)
from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.impact import MASS
from ethbrake_marl.physics.segment import COMMAND, DONE, LIMIT, ROW_WIDTH, TABLE_ROWS

# reasons of a decision, in the order of REASONS of shield.certify
SAME_AS_PLAN, PLAN_REMAINS, CONSTANT, NO_CERTIFICATE, NOT_A_NUMBER, ENDED = range(6)
NEARLY = 1e-9  # a constant whose harm (m2/s2) in one segment is above the limit by less is certified step by step


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


@compiled_apart
def take_step(
    table: Floats, harm: Floats, latency: Floats, clock: Floats, vehicle: int, bounds: Floats, state: Floats,
    step: int, action: float, after: Floats,
) -> int:  # fmt: skip
    """The step of one action from ``state``; fills ``after``. Returns as ``advance_decisions``."""
    restore(table, harm, state)
    table[COMMAND, vehicle] = command_of(action, -bounds[0], bounds[1])
    ended = advance_decisions(table, harm, latency, clock, step, step + 1, np.empty((0, ROW_WIDTH)))
    save(table, harm, after)
    return ended


@compiled_apart
def follow_plan(
    table: Floats, harm: Floats, latency: Floats, clock: Floats, vehicle: int, bounds: Floats, state: Floats,
    step: int, plan: Floats, most: float,
) -> float:  # fmt: skip
    """Harm of the episode if the plan's actions are executed from ``state`` at ``step`` on, as the engine does.

    Gives up with infinity as soon as it is above ``most`` (harm never falls), or where the physics fails.
    """
    restore(table, harm, state)
    no_rows = np.empty((0, ROW_WIDTH))
    ended, value = 0, counted(harm, clock[HARM_IS_TOTAL])
    while ended == 0:
        table[COMMAND, vehicle] = command_of(plan[step], -bounds[0], bounds[1])
        ended = advance_decisions(table, harm, latency, clock, step, step + 1, no_rows)
        value = counted(harm, clock[HARM_IS_TOTAL])
        if ended < 0 or value > most:
            return math.inf
        step += 1
    return value


@compiled_apart
def best_constant(
    table: Floats, harm: Floats, latency: Floats, clock: Floats, vehicle: int, bounds: Floats, state: Floats,
    step: int, constants: Floats,
) -> tuple[float, float]:  # fmt: skip
    """The constant action of least harm from ``state`` at ``step`` on, and that harm, each in one segment."""
    best, least, last = 0.0, math.inf, int(clock[LAST_STEP])
    no_rows = np.empty((0, ROW_WIDTH))
    for c in range(constants.shape[0]):
        restore(table, harm, state)
        table[COMMAND, vehicle] = command_of(constants[c], -bounds[0], bounds[1])
        if advance_decisions(table, harm, latency, clock, step, last, no_rows) < 0:
            continue
        value = counted(harm, clock[HARM_IS_TOTAL])
        if value < least:
            best, least = constants[c], value
    return best, least


@compiled_apart
def better_plan(
    table: Floats, harm: Floats, latency: Floats, clock: Floats, vehicle: int, bounds: Floats, state: Floats,
    step: int, constants: Floats, value: float, most: float, plan: Floats, trial: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Replace the plan from ``step`` on by the best constant, if that harms less than ``value`` and at most ``most``.

    Returns the harm that is certified now, and the least harm found, certified or not.
    """
    restore(table, harm, state)
    so_far = counted(harm, clock[HARM_IS_TOTAL])
    if value <= so_far or so_far > most:  # nothing can be better
        return value, min(value, so_far) if value <= so_far else so_far
    action, least = best_constant(table, harm, latency, clock, vehicle, bounds, state, step, constants)
    if not least < value or least > most + NEARLY:
        return value, min(value, least)
    for j in range(step, trial.shape[0]):
        trial[j] = action
    certified = follow_plan(table, harm, latency, clock, vehicle, bounds, state, step, trial, most)
    if not certified < value:
        return value, min(value, least)
    for j in range(step, plan.shape[0]):
        plan[j] = action
    return certified, certified


@compiled_apart
def decide_world(
    table: Floats, harm: Floats, latency: Floats, clock: Floats, vehicle: int, bounds: Floats, state: Floats,
    step: int, proposed: float, budget: float, certified: float, constants: Floats, plan: Floats, room: Floats,
    after: Floats, out: Floats,
) -> int:  # fmt: skip
    """Decide in one world, see ``certify``: fills ``after`` and ``out`` (applied, reason, bound, margin); the plan is
    the one whose harm is ``out``'s bound. Returns 1 if the episode ends with this step, 0 if not, -1 if it failed.
    """
    usable = not math.isnan(proposed)
    proposal = min(max(proposed, -1.0), 1.0) if usable else plan[step]
    ended = take_step(table, harm, latency, clock, vehicle, bounds, state, step, proposal, after)
    if ended < 0:
        return -1
    value = counted(harm, clock[HARM_IS_TOTAL])  # so far
    reason, least = PLAN_REMAINS, value
    if proposal == plan[step]:
        reason, value = SAME_AS_PLAN if usable else NOT_A_NUMBER, certified
    elif ended == 0:
        room[0, :] = plan
        value = follow_plan(table, harm, latency, clock, vehicle, bounds, after, step + 1, plan, budget)
        reason = CONSTANT if value > budget else PLAN_REMAINS
        value, least = better_plan(
            table, harm, latency, clock, vehicle, bounds, after, step + 1, constants, value, budget, room[0], room[1]
        )
        if value <= budget:
            plan[:] = room[0]
    if value <= budget:
        plan[step] = proposal
        out[0], out[1], out[2], out[3] = proposal, reason, value, budget - value
        return ended
    ended = take_step(table, harm, latency, clock, vehicle, bounds, state, step, plan[step], after)
    out[0], out[1], out[2], out[3] = plan[step], NO_CERTIFICATE, certified, budget - least
    if ended == 0:
        out[2], _ = better_plan(
            table, harm, latency, clock, vehicle, bounds, after, step + 1, constants, certified, certified, plan,
            room[1],
        )  # fmt: skip
    return ended


@compiled
def certify_worlds(
    states: Floats, steps: Ints, ended: Bools, clock: Floats, bounds: Floats, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, vehicle: int, proposed: Floats, budget: Floats, certified: Floats, constants: Floats,
    plans: Floats, after: Floats, out: Floats, over: Bools,
) -> int:  # fmt: skip
    """``decide_world`` in every world whose episode runs; a world that failed, or -1. ``plans`` change in place."""
    N = mass.shape[1]
    table, harm = np.zeros((TABLE_ROWS, N)), np.zeros((2, N - 1))
    room = np.zeros((2, plans.shape[1]))
    for k in range(states.shape[0]):
        if ended[k]:
            after[k, :] = states[k]
            last = min(steps[k], plans.shape[1] - 1)
            out[k, 0], out[k, 1], out[k, 2], out[k, 3] = plans[k, last], ENDED, certified[k], budget[k] - certified[k]
            over[k] = True
            continue
        load(table, command[k], mass[k], limit[k])
        status = decide_world(
            table, harm, latency[k], clock[k], vehicle, bounds[k], states[k], steps[k], proposed[k], budget[k],
            certified[k], constants, plans[k], room, after[k], out[k],
        )  # fmt: skip
        if status < 0:
            return k
        over[k] = status == 1
    return -1


@compiled
def harm_of_plans(
    states: Floats, steps: Ints, clock: Floats, bounds: Floats, command: Floats, latency: Floats, mass: Floats,
    limit: Floats, vehicle: int, plans: Floats, value: Floats,
) -> None:  # fmt: skip
    """Fill ``value`` [n] with the harm of the episodes if the plans are executed from here; infinity: it failed."""
    N = mass.shape[1]
    table, harm = np.zeros((TABLE_ROWS, N)), np.zeros((2, N - 1))
    for k in range(states.shape[0]):
        load(table, command[k], mass[k], limit[k])
        value[k] = follow_plan(
            table, harm, latency[k], clock[k], vehicle, bounds[k], states[k], steps[k], plans[k], math.inf
        )


@compiled
def load(table: Floats, command: Floats, mass: Floats, limit: Floats) -> None:
    """One world's masses, speed limits and the other vehicles' commands."""
    for i in range(mass.shape[0]):
        table[COMMAND, i], table[MASS, i], table[LIMIT, i] = command[i], mass[i], limit[i]
