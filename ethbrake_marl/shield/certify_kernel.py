"""The compiled decisions of the step shield, for one shielded vehicle or several of one line.

Everything that is certified is advanced decision by decision by ``physics.episode.step_episode``, with the operations
of the engine's step: what was certified is what will be executed, to the same bits. Only the search for a
promising constant runs in one segment to the horizon; what it finds is certified step by step before it counts.

The members of a world, its K shielded vehicles, actions [K] and plans [L, K] are those of ``shield.members``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.actions import command_of
from ethbrake_marl.harm import front_share
from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.kernel import CLOCK, GOES_ON, ROW, grid_of, harm_so_far, restore, save, step_again

# The members of a world, advanced decision by decision under the actions of the vehicles that are shielded.
#
# A world has M members, worlds that must all keep the bound: one without uncertainty, then nothing here costs more. K
# of
# its vehicles are shielded; an action is a row [K], a plan [L, K] holds one for each decision.

# rows of the lines: command of those that are not shielded (m/s2), latency (s), mass (t), speed limit (m/s), and the
# harm that each vehicle may bear (m2/s2), a row that is missing where there is no such limit
OF_COMMAND, OF_LATENCY, OF_MASS, OF_LIMIT, OF_CAP = range(5)


class Members(NamedTuple):
    """The members of one world, and room to work in."""

    table: Floats  # of physics.episode
    clock: Floats  # [M, CLOCK_WIDTH]
    bounds: Floats  # [M, K, 2] m/s2
    lines: Floats  # [M, rows, N] of its vehicles; one array for all, because each is counted at every call
    vehicles: Ints  # [K] that are shielded, front to rear
    critical: Ints  # [1] the member that broke a limit last: it is tried first; no result depends on it


@compiled
def gather(
    lines: Floats, first: int, command: Floats, latency: Floats, mass: Floats, limit: Floats, caps: Floats
) -> None:
    """Fill the lines of a world whose members are the rows from ``first`` on."""
    for m in range(lines.shape[0]):
        for i in range(lines.shape[2]):
            lines[m, OF_COMMAND, i], lines[m, OF_LATENCY, i] = command[first + m, i], latency[first + m, i]
            lines[m, OF_MASS, i], lines[m, OF_LIMIT, i] = mass[first + m, i], limit[first + m, i]
            if caps.shape[1] > 0:
                lines[m, OF_CAP, i] = caps[first + m, i]


@compiled
def rows_of(caps: Floats) -> int:
    """Number of rows of the lines."""
    return OF_CAP + 1 if caps.shape[1] > 0 else OF_CAP


@compiled
def enter(world: Members, m: int, state: Floats) -> None:
    """Member ``m`` in a saved state."""
    table, lines = world.table, world.lines
    for i in range(table.shape[1]):
        table[ROW.COMMAND, i], table[ROW.LATENCY, i] = lines[m, OF_COMMAND, i], lines[m, OF_LATENCY, i]
        table[ROW.MASS, i], table[ROW.LIMIT, i] = lines[m, OF_MASS, i], lines[m, OF_LIMIT, i]
    restore(table, state)


@compiled
def act(world: Members, m: int, action: Floats) -> None:
    """The shielded vehicles' commands of an action [K], in member ``m``."""
    for c in range(world.vehicles.shape[0]):
        braking, driving = -world.bounds[m, c, 0], world.bounds[m, c, 1]
        world.table[ROW.COMMAND, world.vehicles[c]] = command_of(action[c], braking, driving)


@compiled_apart
def take_step(world: Members, m: int, state: Floats, step: int, action: Floats, after: Floats) -> int:
    """The step of one action from ``state``; fills ``after``. Returns as ``step_episode``."""
    enter(world, m, state)
    act(world, m, action)
    outcome = step_again(
        world.table, world.clock[m, CLOCK.RESTITUTION], grid_of(world.clock[m]), step, step + 1, world.table[:0]
    )
    save(world.table, after)
    return outcome


@compiled
def take_steps(
    world: Members, states: Floats, ended: Bools, step: int, action: Floats, after: Floats, over: Bools
) -> int:
    """The step of one action in every member; how many episodes go on, or -1 if the physics failed."""
    going = 0
    for m in range(ended.shape[0]):
        if ended[m]:
            over[m] = True
            for c in range(states.shape[1]):  # not by rows: see ``put`` in limits.first_meeting
                after[m, c] = states[m, c]
            continue
        outcome = take_step(world, m, states[m], step, action, after[m])
        if outcome < GOES_ON:
            return -1
        over[m] = outcome != GOES_ON
        going += 0 if over[m] else 1
    return going


@compiled
def borne_by(table: Floats, total: float, i: int) -> float:
    """Harm that vehicle i has borne since the episode began, under one count, to the bits of the ledger (m2/s2).

    An obstacle ahead, the vehicle 0 of infinite mass, bears none; who hits it bears it all.
    """
    row, value = ROW.SUM_TOTAL_HARM if total == 1.0 else ROW.SUM_FIRST_HARM, 0.0
    if table[ROW.MASS, i] == math.inf:
        return value
    behind_obstacle = i > 0 and table[ROW.MASS, i - 1] == math.inf
    if i > 0 and not behind_obstacle:
        value += table[row, i - 1] - front_share(table[row, i - 1], table[ROW.MASS, i - 1], table[ROW.MASS, i])
    if i < table.shape[1] - 1:
        value += front_share(table[row, i], table[ROW.MASS, i], table[ROW.MASS, i + 1])
    return value + table[row, 0] if behind_obstacle else value


@compiled
def within_caps(world: Members, m: int) -> bool:
    """Whether no vehicle of member ``m``, as it is in the table, has borne more than it may."""
    if world.lines.shape[1] > OF_CAP:
        for i in range(world.lines.shape[2]):
            if borne_by(world.table, world.clock[m, CLOCK.HARM_IS_TOTAL], i) > world.lines[m, OF_CAP, i]:
                return False
    return True


@compiled
def worst_so_far(world: Members, states: Floats) -> float:
    """Largest harm so far over the members; infinity where a vehicle has borne more than it may."""
    worst = 0.0
    for m in range(states.shape[0]):
        enter(world, m, states[m])
        worst = max(worst, harm_so_far(world.table, world.clock[m, CLOCK.HARM_IS_TOTAL]))
        if not within_caps(world, m):
            return math.inf
    return worst


@compiled_apart
def follow_plan(world: Members, m: int, state: Floats, ended: bool, step: int, plan: Floats, most: float) -> float:
    """Harm of the episode if the plan's actions are executed from ``state`` at ``step`` on, as the engine does.

    Gives up with infinity as soon as it is above ``most`` (harm never falls), where a vehicle bears more than it may,
    or where the physics fails.
    """
    table, no_rows, total = world.table, world.table[:0], world.clock[m, CLOCK.HARM_IS_TOTAL]
    restitution, grid = world.clock[m, CLOCK.RESTITUTION], grid_of(world.clock[m])
    vehicles, bounds = world.vehicles, world.bounds
    enter(world, m, state)
    goes_on, value = not ended, harm_so_far(table, total)
    while goes_on:
        for c in range(vehicles.shape[0]):
            table[ROW.COMMAND, vehicles[c]] = command_of(plan[step, c], -bounds[m, c, 0], bounds[m, c, 1])
        outcome = step_again(table, restitution, grid, step, step + 1, no_rows)
        value = harm_so_far(table, total)
        if outcome < GOES_ON or value > most:
            return math.inf
        goes_on = outcome == GOES_ON
        step += 1
    return value if within_caps(world, m) else math.inf


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
def hold_constant(world: Members, m: int, state: Floats, ended: bool, step: int, constants: Floats, c: int) -> float:
    """Harm of the episode under constant ``c`` of [C, K] from here, in one segment; infinity: the physics fails."""
    table, clock, vehicles, bounds = world.table, world.clock[m], world.vehicles, world.bounds
    enter(world, m, state)
    for i in range(vehicles.shape[0]):
        table[ROW.COMMAND, vehicles[i]] = command_of(constants[c, i], -bounds[m, i, 0], bounds[m, i, 1])
    if not ended:
        last, grid = int(clock[CLOCK.LAST_STEP]), grid_of(clock)
        if step_again(table, clock[CLOCK.RESTITUTION], grid, step, last, table[:0]) < GOES_ON:
            return math.inf
    return harm_so_far(table, clock[CLOCK.HARM_IS_TOTAL])


# reasons of a decision, in the order of REASONS of shield.certify
SAME_AS_PLAN, PLAN_REMAINS, CONSTANT, NO_CERTIFICATE, NOT_A_NUMBER, ENDED = range(6)
APPLIED, REASON, BOUND, MARGIN = range(4)  # columns of what is told of each vehicle
NEARLY = 1e-9  # a constant whose harm (m2/s2) in one segment is above the limit by less is certified step by step


@compiled_apart
def best_constant(world: Members, states: Floats, ended: Bools, step: int, constants: Floats) -> tuple[int, float]:
    """Which constant action [C, K] has the least worst harm from here on, and that harm, each in one segment."""
    best, least, critical = 0, math.inf, 0
    for c in range(constants.shape[0]):
        worst, first = 0.0, critical
        for j in range(ended.shape[0]):
            m = (first + j) % ended.shape[0]
            value = hold_constant(world, m, states[m], ended[m], step, constants, c)
            if value > worst:
                worst, critical = value, m
            if not worst < least:
                break
        if worst < least:
            best, least = c, worst
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
    best, least = best_constant(world, states, ended, step, constants)
    if not least < value or least > most + NEARLY:
        return value, min(value, least)
    for j in range(step, trial.shape[0]):
        copy_action(constants[best], trial[j])
    certified = worst_of_plan(world, states, ended, step, trial, most)
    if not certified < value:
        return value, min(value, least)
    for j in range(step, plan.shape[0]):
        copy_action(constants[best], plan[j])
    return certified, certified


@compiled
def copy_action(action: Floats, to: Floats) -> None:
    """Copy the actions of one decision, one for each vehicle, or what else is a row of numbers."""
    for c in range(to.shape[0]):
        to[c] = action[c]


@compiled
def is_planned(action: Floats, planned: Floats) -> bool:
    """Whether all vehicles do what the plan says."""
    for c in range(planned.shape[0]):  # noqa: SIM110  # all() is not compiled
        if action[c] != planned[c]:
            return False
    return True


@compiled_apart
def try_action(
    world: Members, states: Floats, ended: Bools, step: int, action: Floats, budget: float, certified: float,
    constants: Floats, plan: Floats, room: Floats, after: Floats, over: Bools,
) -> tuple[float, float, int]:  # fmt: skip
    """Take the step of an action [K], and look for a plan after it: harm certified, least harm found, and the reason.

    Where the harm is within the budget, action and plan are in ``plan`` afterwards; else that is as it was, and its
    harm ``certified``. An action from which the physics fails is not certified.
    """
    going = take_steps(world, states, ended, step, action, after, over)
    value = worst_so_far(world, after) if going >= 0 else math.inf
    reason, least = PLAN_REMAINS, value
    if is_planned(action, plan[step]) and going >= 0:
        reason, value = SAME_AS_PLAN, certified
    elif going > 0:
        for j in range(plan.shape[0]):
            copy_action(plan[j], room[0, j])
        value = worst_of_plan(world, after, over, step + 1, plan, budget)
        reason = CONSTANT if value > budget else PLAN_REMAINS
        value, least = better_plan(world, after, over, step + 1, constants, value, budget, room[0], room[1])
        if value <= budget:
            for j in range(plan.shape[0]):
                copy_action(room[0, j], plan[j])
    if value <= budget:
        copy_action(action, plan[step])
    return value, least, reason


@compiled
def clip_proposals(proposed: Floats, planned: Floats, wanted: Floats, out: Floats) -> int:
    """Fill ``wanted`` [K] with what is proposed, clipped; the plan's where it is no number. How many deviate from it.

    Their reason is open (-1).
    """
    deviating = 0
    for c in range(proposed.shape[0]):
        usable = not math.isnan(proposed[c])
        wanted[c] = min(max(proposed[c], -1.0), 1.0) if usable else planned[c]
        out[c, REASON] = SAME_AS_PLAN if usable else NOT_A_NUMBER
        if wanted[c] != planned[c]:
            out[c, REASON] = -1
            deviating += 1
    return deviating


@compiled
def tell_action(out: Floats, action: Floats, bound: float, margin: float) -> None:
    """Note in ``out`` [K, 4] what is applied, its bound, and the margin of those that did not deviate."""
    for c in range(action.shape[0]):
        out[c, APPLIED], out[c, BOUND] = action[c], bound
        if out[c, REASON] != NO_CERTIFICATE:
            out[c, MARGIN] = margin


@compiled_apart
def decide_world(
    world: Members, states: Floats, ended: Bools, step: int, proposed: Floats, budget: float, certified: float,
    constants: Floats, plan: Floats, room: Floats, tried: Floats, after: Floats, over: Bools, out: Floats,
) -> bool:  # fmt: skip
    """Decide in one world, see ``certify``: fills ``after``, ``over`` (by member) and ``out`` (by vehicle: applied,
    reason, bound, margin); the plan is the one whose harm is ``out``'s bound. First all proposals [K] together; if they
    have no certificate, one vehicle after the other, front to rear, each beside what is in the plan by then. Returns
    whether the physics did not fail with what is applied.
    """
    deviating = clip_proposals(proposed, plan[step], tried[0], out)
    value, least, reason = try_action(
        world, states, ended, step, tried[0], budget, certified, constants, plan, room, after, over
    )  # fmt: skip
    if value <= budget:
        for c in range(out.shape[0]):
            out[c, REASON] = reason if out[c, REASON] == -1 else out[c, REASON]
        tell_action(out, plan[step], value, budget - value)
        return True
    bound, accepted = certified, 0
    for c in range(out.shape[0]):
        if out[c, REASON] != -1:
            continue
        if deviating > 1:
            copy_action(plan[step], tried[1])
            tried[1, c] = tried[0, c]
            value, least, reason = try_action(
                world, states, ended, step, tried[1], budget, bound, constants, plan, room, after, over
            )  # fmt: skip
        fits = value <= budget
        out[c, REASON], out[c, MARGIN] = reason if fits else NO_CERTIFICATE, budget - least
        if fits:
            bound, accepted = value, accepted + 1
    going = take_steps(world, states, ended, step, plan[step], after, over)
    if going > 0 and accepted == 0:
        bound, _ = better_plan(world, after, over, step + 1, constants, bound, bound, plan, room[1])
    tell_action(out, plan[step], bound, budget - bound)
    return going >= 0


@compiled
def certify_worlds(
    states: Floats, steps: Ints, ended: Bools, clock: Floats, bounds: Floats, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, caps: Floats, vehicles: Ints, proposed: Floats, budget: Floats, certified: Floats,
    constants: Floats, plans: Floats, after: Floats, out: Floats, over: Bools, failed: Bools,
) -> None:  # fmt: skip
    """``decide_world`` in every world whose episode runs; ``failed`` [n] where it did. ``plans`` change in place.

    World k's members are the rows from k * M on, M of them.
    """
    N, n = mass.shape[1], steps.shape[0]
    table, critical = np.zeros((ROW.OF_EPISODE, N)), np.zeros(1, np.int64)
    room, tried = np.zeros((2, plans.shape[1], plans.shape[2])), np.zeros((2, plans.shape[2]))
    M = states.shape[0] // max(n, 1)
    lines = np.empty((M, rows_of(caps), N))
    for k in range(n):
        a, b = k * M, k * M + M
        if ended[a:b].all():
            for m in range(a, b):
                copy_action(states[m], after[m])
            last = min(steps[k], plans.shape[1] - 1)
            for c in range(plans.shape[2]):
                out[k, c, APPLIED], out[k, c, REASON] = plans[k, last, c], ENDED
                out[k, c, BOUND], out[k, c, MARGIN] = certified[k], budget[k] - certified[k]
            over[a:b] = True
            continue
        gather(lines, a, command, latency, mass, limit, caps)
        world = Members(table, clock[a:b], bounds[a:b], lines, vehicles, critical)
        good = decide_world(
            world, states[a:b], ended[a:b], steps[k], proposed[k], budget[k], certified[k], constants, plans[k], room,
            tried, after[a:b], over[a:b], out[k],
        )  # fmt: skip
        failed[k] = not good


@compiled
def harm_of_plans(
    states: Floats, steps: Ints, ended: Bools, clock: Floats, bounds: Floats, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, caps: Floats, vehicles: Ints, constants: Floats, plans: Floats, value: Floats,
) -> None:  # fmt: skip
    """Fill ``value`` [n] with the worst harm of the episodes if the plans are executed from here; infinity: it failed.

    Where one of the ``constants`` is better, it replaces the plan (in place) first.
    """
    N, n = mass.shape[1], steps.shape[0]
    table, critical = np.zeros((ROW.OF_EPISODE, N)), np.zeros(1, np.int64)
    trial = np.zeros((plans.shape[1], plans.shape[2]))
    M = states.shape[0] // max(n, 1)
    lines = np.empty((M, rows_of(caps), N))
    for k in range(n):
        a, b = k * M, k * M + M
        gather(lines, a, command, latency, mass, limit, caps)
        world = Members(table, clock[a:b], bounds[a:b], lines, vehicles, critical)
        value[k] = worst_of_plan(world, states[a:b], ended[a:b], steps[k], plans[k], math.inf)
        if constants.shape[0] > 0:
            value[k], _ = better_plan(
                world, states[a:b], ended[a:b], steps[k], constants, value[k], value[k], plans[k], trial
            )
