"""Step mode of the shield: a guaranteed harm that holds at every step, whoever proposes the actions.

**Claim.** Let ``B`` be the bound at the first decision: the harm of the backup plan, executed in the engine. If in each
step what ``certify`` says is applied, the harm realised at the end of the episode is at most ``B``, whatever is
proposed; and the bound never rises on the way. The end is rest or the scenario's horizon: of what still moves then, and
of what happens afterwards, nothing is claimed.

**Induction.** Between two decisions the shield holds a *plan* (an action for every decision up to the horizon) and its
harm ``c``: the harm of the whole episode, past harm and which pairs were hit before included, if that plan is executed
from the present state. Both come out of one function, ``follow_plan``, which advances decision by decision with the
operations of the engine's step in their order, and adds harm in its order. So:

1. *Start.* ``c = B``.
2. *The proposal is applied* only with a plan from the next state whose harm, computed by ``follow_plan`` from that very
   state, is at most the budget; that plan is held from now on, and ``c`` is its harm. (If the proposal is what the plan
   says, the rest of the plan is that plan, with the same ``c``: the same operations on the same numbers.)
3. *The plan's action is applied* otherwise. The rest of the plan is executed from a state that ``follow_plan`` passed
   through when it found ``c``: the harm remains ``c`` to the last bit. A plan that harms less may replace it.
4. *End.* When the episode ends nothing is left to execute, and ``c`` is the harm realised.

The budget is ``c`` (or anything between ``c`` and ``B``), so ``c <= B`` always. ∎ No tolerance enters: where the engine
does what it is said to do, realised harm and the last bound are the same double.

**Several vehicles.** Where several are shielded, an action above is a row of them, one for each vehicle, and so is each
entry of the plan; what is proven is the same. All proposals together are tried first. If they have no certificate, the
vehicles are taken from front to rear: each proposal replaces that vehicle's action in the joint plan, and is accepted
with a plan behind it whose harm is at most the budget; otherwise that vehicle's planned action stays. Each attempt
begins with a plan that is certified, and ends with one.

**Several members.** Where a world has more than one (``shield.uncertainty``), every harm above is the largest over
them, each member being advanced by the same actions: then the realised harm of *every* member is at most ``B``.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from itertools import product
from typing import Any, Literal, NamedTuple, TypeVar, cast, get_args

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import action_to_command, command_of, command_to_action
from ethbrake_marl.agents import (
    Agent,
    AgentAround,
    Odometer,
    Ranges,
    Team,
    Told,
    episode_engine,
    fixed_commands,
    optimise_coupled,
    script_agents,
    write_down,
)
from ethbrake_marl.engine import Memory, Script, ask_script, begin_script, renew_memory, take_memory
from ethbrake_marl.errors import InvalidInput, PhysicsError, count_of, renumbered, unknown_name
from ethbrake_marl.harm import HarmCount, check_harm_count, front_share
from ethbrake_marl.physics import (
    CLOCK,
    GOES_ON,
    ROW,
    Bools,
    Decisions,
    Floats,
    Ints,
    Packed,
    Worlds,
    at_rest,
    compiled,
    grid_of,
    harm_so_far,
    has_acted,
    place_rates,
    restore,
    rows_for,
    save,
    step_again,
)
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search import ProfileProblem, profile_problem
from ethbrake_marl.shield.enclosure import CORNERS, INTERIOR, Boxes, checked_robust
from ethbrake_marl.shield.uncertainty import MOST_CORNERS, Uncertainty, check_amount, check_scenario

# The compiled decisions of the step shield, for one shielded vehicle or several of one line.
#
# Everything that is certified is advanced decision by decision by ``physics.kernel.step_episode``, with the operations
# of the engine's step: what was certified is what will be executed, to the same bits. Only the search for a
# promising constant runs in one segment to the horizon; what it finds is certified step by step before it counts.
#
# The members of a world, its K shielded vehicles, actions [K] and plans [L, K] are those of ``Members`` below.

# The members of a world, advanced decision by decision under the actions of the vehicles that are shielded.
#
# A world has M members, worlds that must all keep the bound: one without uncertainty, then nothing here costs more. K
# of its vehicles are shielded; an action is a row [K], a plan [L, K] holds one for each decision.

# rows of the lines: command of those that are not shielded (m/s2), latency (s), mass (t), speed limit (m/s), rates at
# which brakes build up and are released (m/s3), and the harm that each vehicle may bear (m2/s2), a row that is missing
# where there is no such limit
OF_COMMAND, OF_LATENCY, OF_MASS, OF_LIMIT, OF_BRAKE_RATE, OF_RELEASE_RATE, OF_CAP = range(7)


class Members(NamedTuple):
    """The members of one world, or of all of a batch, and room to work in."""

    table: Floats  # of physics.kernel
    clock: Floats  # [M, CLOCK_WIDTH]
    bounds: Floats  # [M, K, 2] m/s2
    lines: Floats  # [M, rows, N] of its vehicles; one array for all, because each is counted at every call
    pieces: Floats  # [M, N, 2 P] of the vehicles that brake in pieces
    vehicles: Ints  # [K] that are shielded, front to rear
    critical: Ints  # [1] the member that broke a limit last: it is tried first; no result depends on it


@compiled
def all_members(running: Running) -> Members:
    """The members of every world."""
    problem = running.problem
    rows, N = problem.mass.shape
    lines = np.empty((rows, OF_CAP + 1 if running.caps.shape[1] > 0 else OF_CAP, N))
    for m in range(rows):
        for i in range(N):
            lines[m, OF_COMMAND, i], lines[m, OF_LATENCY, i] = problem.command[m, i], problem.latency[m, i]
            lines[m, OF_MASS, i], lines[m, OF_LIMIT, i] = problem.mass[m, i], problem.limit[m, i]
            lines[m, OF_BRAKE_RATE, i], lines[m, OF_RELEASE_RATE, i] = (
                problem.brake_rate[m, i],
                problem.release_rate[m, i],
            )
            if running.caps.shape[1] > 0:
                lines[m, OF_CAP, i] = running.caps[m, i]
    table, critical = np.zeros((rows_for(problem.pieces.shape[2]), N)), np.zeros(1, np.int64)
    return Members(table, problem.clock, problem.bounds, lines, problem.pieces, problem.vehicles, critical)


@compiled
def members_from(every: Members, a: int, b: int) -> Members:
    """Those in the rows a to b - 1."""
    clock, bounds, lines, pieces = every.clock[a:b], every.bounds[a:b], every.lines[a:b], every.pieces[a:b]
    return Members(every.table, clock, bounds, lines, pieces, every.vehicles, every.critical)


@compiled
def enter(world: Members, m: int, state: Floats) -> None:
    """Member ``m`` in a saved state."""
    table, lines = world.table, world.lines
    for i in range(table.shape[1]):
        table[ROW.COMMAND, i], table[ROW.LATENCY, i] = lines[m, OF_COMMAND, i], lines[m, OF_LATENCY, i]
        table[ROW.MASS, i], table[ROW.LIMIT, i] = lines[m, OF_MASS, i], lines[m, OF_LIMIT, i]
    place_rates(table, lines[m, OF_BRAKE_RATE], lines[m, OF_RELEASE_RATE], world.pieces[m])
    restore(table, state)


@compiled(apart=True)
def take_step(world: Members, m: int, state: Floats, step: int, action: Floats, after: Floats) -> int:
    """The step of one action from ``state``; fills ``after``. Returns as ``step_episode``."""
    enter(world, m, state)
    for c in range(world.vehicles.shape[0]):
        braking, driving = -world.bounds[m, c, 0], world.bounds[m, c, 1]
        world.table[ROW.COMMAND, world.vehicles[c]] = command_of(action[c], braking, driving)
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
            for c in range(states.shape[1]):  # not by rows: see ``put`` in limits.lower_bound
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


@compiled(apart=True)
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


class ShieldReason(IntEnum):
    """Why a shield accepted or replaced an action: the code ``shield_reason`` of the infos. ``text``: in words.

    >>> import ethbrake_marl as eb
    >>> eb.ShieldReason(3).name, eb.ShieldReason.NO_CERTIFICATE.text
    ('NO_CERTIFICATE', 'no certificate')

    """

    NO_DECISION = -1  # before the first step of an episode, and always for a vehicle that follows a script
    SAME_AS_PLAN = 0  # the proposal is the plan's action
    PLAN_REMAINS = 1  # the rest of the plan still keeps the budget after the proposal
    CONSTANT = 2  # a constant action after the proposal keeps it
    NO_CERTIFICATE = 3  # neither does: the plan's action was applied
    NOT_A_NUMBER = 4  # nothing usable was proposed: the plan's action was applied
    ENDED = 5  # the episode is over
    ASSUMPTION_BROKEN = 6  # the world did not do what was predicted: the fallback was applied
    POLICY_ROLLOUT = 7  # nothing else kept the budget, but the policy itself does, rolled out after the proposal

    @property
    def text(self) -> str:
        """The reason in words."""
        return self.name.lower().replace("_", " ")


# those that kernels give
SAME_AS_PLAN, PLAN_REMAINS, CONSTANT, NO_CERTIFICATE, NOT_A_NUMBER, ENDED = map(int, list(ShieldReason)[1:7])
APPLIED, REASON, BOUND, MARGIN = range(4)  # columns of what is told of each vehicle
NEARLY = 1e-9  # a constant whose harm (m2/s2) in one segment is above the limit by less is certified step by step


@compiled(apart=True)
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


@compiled(apart=True)
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


@compiled(apart=True)
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
def tell_action(out: Floats, action: Floats, bound: float, margin: float) -> None:
    """Note in ``out`` [K, 4] what is applied, its bound, and the margin of those that did not deviate."""
    for c in range(action.shape[0]):
        out[c, APPLIED], out[c, BOUND] = action[c], bound
        if out[c, REASON] != NO_CERTIFICATE:
            out[c, MARGIN] = margin


@compiled(apart=True)
def decide_world(
    world: Members, states: Floats, ended: Bools, step: int, proposed: Floats, budget: float, certified: float,
    constants: Floats, plan: Floats, room: Floats, tried: Floats, after: Floats, over: Bools, out: Floats,
) -> bool:  # fmt: skip
    """Decide in one world, see ``certify``: fills ``after``, ``over`` (by member) and ``out`` (by vehicle: applied,
    reason, bound, margin); the plan is the one whose harm is ``out``'s bound. First all proposals [K] together; if they
    have no certificate, one vehicle after the other, front to rear, each beside what is in the plan by then. Returns
    whether the physics did not fail with what is applied.
    """
    deviating = 0
    for c in range(proposed.shape[0]):
        usable = not math.isnan(proposed[c])
        tried[0, c] = min(max(proposed[c], -1.0), 1.0) if usable else plan[step, c]
        out[c, REASON] = SAME_AS_PLAN if usable else NOT_A_NUMBER
        if tried[0, c] != plan[step, c]:
            out[c, REASON] = -1  # open
            deviating += 1
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
    running: Running, proposed: Floats, budget: Floats, certified: Floats, constants: Floats, plans: Floats,
    after: Floats, out: Floats, over: Bools, failed: Bools,
) -> None:  # fmt: skip
    """``decide_world`` in every world whose episode runs; ``failed`` [n] where it did. ``plans`` change in place."""
    n, every = running.steps.shape[0], all_members(running)
    room, tried = np.zeros((2, plans.shape[1], plans.shape[2])), np.zeros((2, plans.shape[2]))
    M = running.states.shape[0] // max(n, 1)
    for k in range(n):
        a, b = k * M, k * M + M
        if running.ended[a:b].all():
            for m in range(a, b):
                copy_action(running.states[m], after[m])
            last = min(running.steps[k], plans.shape[1] - 1)
            for c in range(plans.shape[2]):
                out[k, c, APPLIED], out[k, c, REASON] = plans[k, last, c], ENDED
                out[k, c, BOUND], out[k, c, MARGIN] = certified[k], budget[k] - certified[k]
            over[a:b] = True
            continue
        good = decide_world(
            members_from(every, a, b), running.states[a:b], running.ended[a:b], running.steps[k], proposed[k],
            budget[k], certified[k], constants, plans[k], room, tried, after[a:b], over[a:b], out[k],
        )  # fmt: skip
        failed[k] = not good


@compiled
def harm_of_plans(running: Running, constants: Floats, plans: Floats, value: Floats) -> None:
    """Fill ``value`` [n] with the worst harm of the episodes if the plans are executed from here; infinity: it failed.

    Where one of the ``constants`` is better, it replaces the plan (in place) first.
    """
    n, every = running.steps.shape[0], all_members(running)
    trial = np.zeros((plans.shape[1], plans.shape[2]))
    M = running.states.shape[0] // max(n, 1)
    for k in range(n):
        a, b = k * M, k * M + M
        world, step, plan = members_from(every, a, b), running.steps[k], plans[k]
        value[k] = worst_of_plan(world, running.states[a:b], running.ended[a:b], step, plan, math.inf)
        if constants.shape[0] > 0:
            value[k], _ = better_plan(
                world, running.states[a:b], running.ended[a:b], step, constants, value[k], value[k], plan, trial
            )


@compiled
def ends_of_plans(running: Running, plans: Floats, rests: Bools, borne: Floats) -> None:
    """How the episodes end if the plans are executed from here.

    Fills ``rests`` [n]: every member comes to rest before the horizon, and stays so; and ``borne`` [n * M, N]: the harm
    that each vehicle bears then, an obstacle ahead none.
    """
    n, every = running.steps.shape[0], all_members(running)
    M = running.states.shape[0] // max(n, 1)
    for k in range(n):
        rests[k] = True
        for m in range(k * M, k * M + M):
            follow_plan(every, m, running.states[m], running.ended[m], running.steps[k], plans[k], math.inf)
            rests[k] = rests[k] and at_rest(every.table)
            for i in range(borne.shape[1]):
                borne[m, i] = borne_by(every.table, running.problem.clock[m, CLOCK.HARM_IS_TOTAL], i)


@compiled
def descend_constants(running: Running, grid: Floats, rounds: int, action: Floats) -> None:
    """Replace each vehicle's constant action [n, K] in turn by the best of the grid, by harm in one segment.

    In place, one vehicle after the other; of worlds with one member each.
    """
    every, states, ended, steps = all_members(running), running.states, running.ended, running.steps
    for k in range(states.shape[0]):
        least = hold_constant(every, k, states[k], ended[k], steps[k], action, k)
        for turn in range(rounds * action.shape[1]):
            c = turn % action.shape[1]
            best = action[k, c]
            for g in range(grid.shape[0]):
                action[k, c] = grid[g]
                value = hold_constant(every, k, states[k], ended[k], steps[k], action, k)
                if value < least:
                    best, least = grid[g], value
            action[k, c] = best


CONSTANTS = tuple(-k / 10 for k in range(11))  # actions that are tried as constants: coasting to full braking


class Running(NamedTuple):
    """Running episodes at a decision, as the shield knows them: n worlds with M members each (``shield.uncertainty``).

    World k's members are the rows k * M to k * M + M - 1, the nominal one first; without uncertainty M is 1. Of several
    shielded vehicles, proposals and actions are [n, K], and plans [n, L, K]; of one they are [n] and [n, L], or [n, 1]
    and [n, L, 1].
    """

    problem: ProfileProblem  # parameters, commands of the others, grid of decisions; K vehicles; n * M rows
    states: Floats  # [n * M, S] of ``physics.kernel``: speeds, gaps, hit flags, both harms so far, forces
    steps: Ints  # [n] number of the decision
    ended: Bools  # [n * M]
    caps: Floats = np.zeros((0, 0))  # [n * M, N] most harm that each vehicle may bear (m2/s2); [0, 0]: any

    @property
    def uncapped(self) -> Running:
        """The same, whoever bears the harm."""
        return self._replace(caps=np.zeros((0, 0)))

    @property
    def n(self) -> int:
        """Number of worlds."""
        return len(self.steps)

    @property
    def members(self) -> int:
        """Number of members of each world (M)."""
        return len(self.ended) // max(self.n, 1)

    @property
    def finished(self) -> Bools:
        """Worlds in which every member's episode is over, [n]."""
        return np.asarray(self.ended.reshape(self.n, -1).all(axis=1), np.bool_)

    @property
    def time_s(self) -> Floats:
        """Time of the decision in the nominal member, [n] s."""
        clock = self.problem.clock[:: self.members]
        return Decisions(clock[:, CLOCK.START], clock[:, CLOCK.TIME_STEP]).at(self.steps)

    def rows_of(self, worlds: Ints) -> Ints:
        """The rows of the members of some worlds."""
        return np.asarray((worlds[:, np.newaxis] * self.members + np.arange(self.members)).ravel(), np.int64)

    def take(self, worlds: Ints) -> Running:
        """Some of the worlds, with all their members."""
        return self._select(self.rows_of(worlds), worlds)

    def nominal(self) -> Running:
        """Every world with its nominal member alone."""
        if self.members == 1:
            return self
        return self._select(np.arange(self.n) * self.members, np.arange(self.n))

    def _select(self, rows: Ints, worlds: Ints) -> Running:
        caps = self.caps[rows] if self.caps.size else self.caps
        return Running(self.problem.take(rows), self.states[rows], self.steps[worlds], self.ended[rows], caps)


class Backup(NamedTuple):
    """What is executed if nothing else is certified."""

    plan: Floats  # [n, L] or [n, L, K] actions, column j for decision j
    harm: Floats  # [n] of the episode if it is executed from now on, in the worst member (m2/s2)
    constants: Floats = np.array(CONSTANTS)  # [C] or [C, K] actions that may replace the rest of a plan


class Decision(NamedTuple):
    """What is applied, why, and what holds from now on."""

    applied: Floats  # [n] or [n, K] actions in [-1, 1]
    intervened: Bools  # [n] or [n, K] what is applied is not what was proposed (clipped)
    reason: NDArray[np.int64]  # [n] or [n, K] values of ShieldReason
    bound: Floats  # [n] harm of the episode is at most this from now on (m2/s2)
    margin: Floats  # [n] or [n, K] budget minus the least harm found after the proposal; negative: why it was rejected
    after: Running  # as it will be at the next decision
    backup: Backup  # the plan that goes with the bound

    @property
    def reason_names(self) -> NDArray[np.str_]:
        """The reasons in words, [n] or [n, K]."""
        texts = [ShieldReason(code).text for code in self.reason.ravel().tolist()]
        return np.array(texts).reshape(self.reason.shape)

    def put(self, rows: Ints, other: Decision, taken: Ints) -> Decision:
        """A copy in which some worlds, with the plans and bounds that go on, are those ``taken`` from another one."""
        columns: dict[str, Any] = {
            name: put(getattr(self, name), rows, getattr(other, name)[taken]) for name in self._fields[:5]
        }
        at, where = self.after.rows_of(rows), other.after.rows_of(taken)
        after = self.after._replace(
            states=put(self.after.states, at, other.after.states[where]),
            ended=put(self.after.ended, at, other.after.ended[where]),
        )
        plan = put(self.backup.plan, rows, other.backup.plan[taken])
        harm = put(self.backup.harm, rows, other.bound[taken])
        return self._replace(**columns, after=after, backup=self.backup._replace(plan=plan, harm=harm))


def begin_running(problem: ProfileProblem, members: int = 1) -> Running:
    """The episodes of a problem at their first decision; its rows are worlds with ``members`` each."""
    steps, ended = np.zeros(problem.n // members, np.int64), np.zeros(problem.n, np.bool_)
    return Running(problem, problem.start, steps, ended)


def plan_harm(running: Running, plan: Floats) -> Floats:
    """Harm of the episodes, in the worst member, if the plans are executed from here, [n] m2/s2; whoever bears it.

    It is to the engine's bits.
    """
    return bettered_plan(running, plan, np.zeros(0))[1]


def bettered_plan(running: Running, plan: Floats, constants: Floats) -> tuple[Floats, Floats]:
    """The plans, or where it harms less in the worst member the best of the constant actions; and that harm."""
    value = np.empty(running.n)
    _check_plan(running, plan)
    plans = np.array(plan, np.float64, order="C")
    K = len(running.problem.vehicles)
    each = plans.reshape(*plans.shape[:2], K)
    harm_of_plans(running.uncapped, constants.reshape(len(constants), K), each, value)
    _raise_if_any(~np.isfinite(value))
    return plans, value


def from_now(past: Floats, later: Floats | float, steps: Ints) -> Floats:
    """The plans that are ``past`` before the decisions ``steps`` [n], which was applied, and ``later`` after."""
    made = np.arange(past.shape[1]) < steps[:, np.newaxis]
    return np.where(made if past.ndim == 2 else made[:, :, np.newaxis], past, later)


def certify(running: Running, proposed: Floats, backup: Backup, budget: Floats) -> Decision:
    """Decide in every world which proposed actions ([n], or [n, K]) are applied, and where the backup's; see the claim.

    ``budget`` [n] is the harm that is guaranteed, at least the backup's. A proposal beyond [-1, 1] is clipped first;
    one that is no number is replaced. Nothing given is changed. Raises ``InvalidInput`` for shapes that do not fit or a
    budget below the backup's harm, ``PhysicsError`` naming the worlds that cannot be advanced by what would be applied.
    """
    n, problem, vehicles = running.n, running.problem, len(running.problem.vehicles)
    _check_plan(running, backup.plan)
    given = np.ascontiguousarray(proposed, np.float64)
    shape = (n, *backup.plan.shape[2:])
    if not (given.shape == shape and backup.harm.shape == budget.shape == (n,)):
        raise InvalidInput(
            f"certify: proposed {given.shape}, backup's harm {backup.harm.shape}, budget {budget.shape};"
            f" {shape}, and twice ({n},) needed"
        )
    if not (budget >= backup.harm).all():
        raise InvalidInput("certify: a budget is below the backup's harm; nothing could be guaranteed")
    plans, after, out = backup.plan.copy(), np.empty_like(running.states), np.empty((n, vehicles, 4))
    over, failed = np.zeros(problem.n, np.bool_), np.zeros(n, np.bool_)
    certify_worlds(
        running, given.reshape(n, vehicles), budget, backup.harm,
        backup.constants.reshape(-1, vehicles), plans.reshape(n, plans.shape[1], vehicles), after, out, over, failed,
    )  # fmt: skip
    _raise_if_any(failed)
    applied, bound, margin = out[:, :, 0].reshape(shape), out[:, 0, 2].copy(), out[:, :, 3].reshape(shape)
    reason = out[:, :, 1].astype(np.int64).reshape(shape)
    intervened = (reason == NO_CERTIFICATE) | (reason == NOT_A_NUMBER)
    later = running._replace(states=after, steps=running.steps + ~running.finished, ended=over)
    return Decision(applied, intervened, reason, bound, margin, later, backup._replace(plan=plans, harm=bound))


def _raise_if_any(failed: Bools) -> None:
    if failed.any():
        raise PhysicsError({k: "the shield could not follow its plan" for k in np.flatnonzero(failed).tolist()})


def _check_plan(running: Running, plan: Floats) -> None:
    most = int(running.problem.last_step.max(initial=0))
    vehicles = len(running.problem.vehicles)
    fits = vehicles == 1 if plan.ndim == 2 else plan.shape[2:] == (vehicles,)
    if not fits or plan.shape[0] != running.n or plan.shape[1] < most:
        wanted = f"({running.n}, at least {most}{'' if vehicles == 1 else f', {vehicles}'})"
        raise InvalidInput(f"shield: plan {plan.shape}; {wanted} is needed")


# The comparison of what happened with what was predicted: to the last bit, the harm so far included.

SLACK = 1e-9  # by more than this (m, m/s) a world lies outside what several members predict; one member is exact
GROUPS = (("gap", " m"), ("hit flag", ""), ("first-impact harm", " m2/s2"), ("total harm", " m2/s2"))  # of each pair


def seen_columns(packed: Packed) -> Floats:
    """Running worlds and their harm so far in the columns of ``Running.states``, [n, S]: to be compared with them.

    Those are speeds, gaps, hit flags and both harms, with the obstacle first in each group where there is one. Raises
    ``InvalidInput`` where only some of the worlds have one.
    """
    state, column = packed.state, packed.column
    speeds, first, pairs, at = state[:, column.speed : column.command], column.gap, column.vehicles - 1, column.obstacle
    if packed.has_obstacle:
        groups = [state[:, first + g * pairs : first + (g + 1) * pairs] for g in range(len(GROUPS))]
        whole = [part for g, group in enumerate(groups) for part in (state[:, at + g : at + g + 1], group)]
        return np.concatenate([np.zeros((len(state), 1)), speeds, *whole], axis=1)
    return np.concatenate([speeds, state[:, first : first + len(GROUPS) * pairs]], axis=1)


def worlds_at(worlds: Worlds, states: Floats) -> Worlds:
    """These worlds in the states [n, S] of a problem with them: speeds, gaps, hit flags, and those of the obstacle."""
    added = (states.shape[1] + 4) // 6 - worlds.N  # 1: columns of an obstacle, or of a post, in front of each group
    N = worlds.N + added
    gaps, hit = states[:, N : 2 * N - 1], states[:, 2 * N - 1 : 3 * N - 2] == 1.0
    return replace(
        worlds,
        speeds_mps=states[:, added:N].copy(),
        gaps_m=gaps[:, added:].copy(),
        pair_hit=hit[:, added:].copy(),
        obstacle_gap_m=np.where(worlds.obstacle_ahead, gaps[:, 0], np.inf) if added else worlds.obstacle_gap_m,
        obstacle_hit=hit[:, 0].copy() if added else worlds.obstacle_hit,
    )


def difference(predicted: Floats, seen: Floats) -> str:
    """The first number in which a world as seen [S] is not as predicted [S], in words; "nothing" where all are."""
    vehicles = (len(predicted) + 4) // 6
    for column in np.flatnonzero(~(seen == predicted[: len(seen)])).tolist():
        if column < vehicles:
            what, unit = f"speed of vehicle {column + 1} of the line", " m/s"
        else:
            group, pair = divmod(column - vehicles, vehicles - 1)
            what, unit = f"{GROUPS[group][0]} of pair {pair + 1}", GROUPS[group][1]
        return f"{what} is {seen[column]:.17g}{unit}, certified was {predicted[column]:.17g}{unit}"
    return "nothing"


def ends_under(running: Running, plan: Floats) -> tuple[Bools, Floats]:
    """How the episodes end if the plans are executed from here.

    Where everything rests at the horizon, in every member, [n]; and the harm of the whole episode that each vehicle
    bears, split by mass as in the ledger, to the same bits, [n * M, N] m2/s2. With an obstacle ahead its column comes
    first, and is 0.
    """
    rests, borne = np.empty(running.n, np.bool_), np.empty(running.problem.mass.shape)
    plans = np.ascontiguousarray(plan).reshape(*plan.shape[:2], len(running.problem.vehicles))
    ends_of_plans(running.uncapped, plans, rests, borne)
    return rests, borne


# The log of a step shield: every decision in which something else than the proposal was applied.


class Intervention(NamedTuple):
    """One decision in which something else than the proposal was applied."""

    world: int  # row of the batch
    vehicle: int  # index of the shielded vehicle, 0 = front
    episode: int  # of that row, from 0
    step: int  # number of the decision
    time_s: float
    proposed: float  # action, as it was given
    applied: float  # action
    reason: int  # value of ShieldReason
    bound: float  # m2/s2, from now on
    margin: float  # m2/s2; negative: what the proposal would have cost beyond the budget at least
    state: Floats  # [S] at the decision
    plan: Floats  # [L] that was held, of several vehicles [L, K]; before ``step`` what was applied


def interventions(
    now: Running, episode: Ints, vehicles: Sequence[int], proposed: Floats, decision: Decision, held: Backup
) -> list[Intervention]:
    """What a decision made from ``now`` replaced; ``episode`` [n] numbers the rows' episodes."""
    times, states, shape = now.time_s, now.nominal().states, (now.n, len(vehicles))
    columns = (proposed, decision.applied, decision.reason, decision.margin, decision.intervened)
    given, applied, reason, margin, replaced = (np.reshape(column, shape) for column in columns)
    return [
        Intervention(
            k, vehicles[c], int(episode[k]), int(now.steps[k]), float(times[k]), float(given[k, c]),
            float(applied[k, c]), int(reason[k, c]), float(decision.bound[k]), float(margin[k, c]), states[k].copy(),
            held.plan[k].copy(),
        )
        for k, c in np.argwhere(replaced).tolist()
    ]  # fmt: skip


# Rollouts of the policies that propose: their actions from the alert, and from any later decision, as plans.
#
# What a rollout does is written down as a plan and certified like any other (``plan_harm``): a policy that would drive
# differently the second time costs interventions, never the bound.

Number = TypeVar("Number", bound=np.generic)


class Proposer(NamedTuple):
    """Who proposes, and what they see now: enough to try, on copies, what they would do later."""

    policies: Mapping[int, Agent]  # by shielded vehicle, front to rear
    memories: Mapping[int, Memory]  # theirs of the running episodes, this decision's action included
    worlds: Worlds  # [n] now


def rolled_out(
    worlds: Worlds, policies: Mapping[int, Agent], scenario: Scenario, vehicle: int | tuple[int, ...], width: int
) -> Floats:
    """The actions [n, width] (several vehicles: [n, width, K]) of policies that drive unshielded from the alert.

    Full braking beyond their episode's end.
    """
    team = Team({i: _Rounded(policy) for i, policy in policies.items()}, next(iter(policies.values())).name)
    engine = episode_engine(worlds, team, scenario)
    columns = write_down(engine, width, lambda: np.stack([engine.memories[i]["action"] for i in team.drivers], axis=1))
    actions = np.where(np.isnan(columns), -1.0, columns)
    return actions[:, :, 0] if isinstance(vehicle, int) else actions


def certify_rollouts(
    running: Running, proposed: Floats, rows: Ints, budget: Floats, held: Floats, proposer: Proposer
) -> Decision:
    """Decide again in ``rows``, where the proposals found no certificate, with the policy itself as the later plan.

    The plan that is tried is the proposal (clipped, a number), then what the policy does from the state after it. Where
    it keeps the budget it becomes the backup, and the proposal is "what the plan says"; elsewhere the reason says that
    something else must be applied. ``running``, ``proposed``, ``budget`` and the plans ``held`` are those of the
    whole batch. Of several vehicles, who proposes no number keeps its planned action. Returns the decision of those
    rows alone.
    """
    part, least, silent = running.take(rows), budget[rows], np.isnan(proposed[rows])
    planned = held[rows, np.minimum(running.steps[rows], held.shape[1] - 1)]
    first = np.where(silent, planned, np.clip(proposed[rows], -1.0, 1.0))
    plan = _later_plan(running.nominal(), first, rows, budget, held, proposer)
    with renumbered(rows):
        harm = plan_harm(part, plan)
        kept = harm <= least
        if part.caps.size:
            within = (ends_under(part, plan)[1] <= part.caps).all(axis=1)
            kept &= within.reshape(part.n, -1).all(axis=1)
        decision = certify(part, first, Backup(plan, harm, no_constants(plan)), np.maximum(least, harm))
    each = kept.reshape(-1, *[1] * (first.ndim - 1))
    told = np.where(silent, NOT_A_NUMBER, ShieldReason.POLICY_ROLLOUT)
    margin = np.broadcast_to((least - harm).reshape(each.shape), first.shape)
    return decision._replace(intervened=silent | ~each, margin=margin, reason=np.where(each, told, NO_CERTIFICATE))


def _later_plan(
    running: Running, first: Floats, rows: Ints, budget: Floats, held: Floats, proposer: Proposer
) -> Floats:
    """The plans of ``rows``: what was applied, the ``first`` action ([m] or [m, K]), then the policies'.

    Given up once above the budget.
    """
    policies, memories, worlds = proposer
    memories, seen = take_memory(memories, rows), worlds.take(rows)
    episodes, most, action = running.take(rows), budget[rows], first
    plan, nothing = from_now(held[rows], -1.0, episodes.steps), np.zeros(len(rows))
    while True:
        going = np.flatnonzero(~episodes.ended)
        plan[going, episodes.steps[going]] = action[going]
        with renumbered(rows):
            episodes = certify(episodes, action, Backup(plan, nothing, no_constants(plan)), nothing).after
        N = episodes.problem.mass.shape[1]
        harm = 4 * N - 3 if episodes.problem.clock[0, CLOCK.HARM_IS_TOTAL] == 1.0 else 3 * N - 2
        so_far = episodes.states[:, harm : harm + N - 1].sum(axis=1)
        episodes = episodes._replace(ended=episodes.ended | (so_far > most))
        if episodes.ended.all():
            return plan
        # as a driver sees them at the next decisions, the last actions in force
        commands = episodes.problem.command[:, -seen.N :].copy()  # without an obstacle ahead
        for c, vehicle in enumerate(policies):
            column = action if action.ndim == 1 else action[:, c]
            commands[:, vehicle] = action_to_command(column, seen.vehicles, vehicle)
        time, vehicles, force = episodes.time_s, seen.vehicles, episodes.states[:, -seen.N :]
        commands = vehicles.piece_commands(commands, time)
        acts = np.where(has_acted(vehicles.latency_s, time[:, np.newaxis]), commands, 0.0)
        at_once = np.isinf(np.where(acts < force, vehicles.brake_rate_mps3, vehicles.release_rate_mps3))
        in_force = np.where(at_once, acts, force)
        seen = replace(worlds_at(seen, episodes.states), time_s=time, command_mps2=in_force)
        with renumbered(rows):
            proposed, memories = proposed_actions(policies, memories, seen)
        action = proposed.reshape(first.shape)
        action = np.where(np.isnan(action), -1.0, action)  # the shield would not apply what is no number either


def no_constants(plan: Floats) -> Floats:
    """No constant action to replace the rest of a plan."""
    return np.zeros((0, *plan.shape[2:]))


def proposed_actions(
    policies: Mapping[int, Agent], memories: Mapping[int, Memory], worlds: Worlds
) -> tuple[Floats, dict[int, Memory]]:
    """What the policies propose, [n, K], and what they remember then."""
    asked = {i: proposed_action(policy, worlds, memories[i], i) for i, policy in policies.items()}
    after = {i: memory for i, (_, memory) in asked.items()}
    return np.stack([action for action, _ in asked.values()], axis=1), after


def proposed_action(policy: Agent, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
    """What a policy proposes, as actions [n] in [-1, 1]; a command that is no number stays none. And its memory."""
    command, memory = ask_script(policy, worlds, memory, vehicle)
    return np.where(np.isnan(command), np.nan, command_to_action(command, worlds.vehicles, vehicle)), memory


class _Rounded(AgentAround):
    """A policy whose commands are applied as its actions are written down; it remembers the last ``action``."""

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        return {"policy": begin_script(self.policy, alert, vehicle, scripts), "action": np.zeros(alert.n)}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        action, policy = proposed_action(self.policy, worlds, memory["policy"], vehicle)
        action = np.where(np.isnan(action), -1.0, action)
        return action_to_command(action, worlds.vehicles, vehicle), {"policy": policy, "action": action}


def put(old: NDArray[Number], rows: Ints, new: NDArray[Number]) -> NDArray[Number]:
    """A copy of ``old`` with ``new`` in these rows."""
    placed = old.copy()
    placed[rows] = new
    return placed


# Step mode for a batch of running episodes: what ``certify`` decides, kept from step to step, watched and logged.

# The plan that a shield starts with at the alert: constants of least harm, or what the policies do, if that is better.
#
# For one shielded vehicle the constant is the coupled optimum. For several it is the best of these: all brake fully,
# one of them takes its coupled optimum while the others brake fully, and what a descent finds from the best of those,
# one vehicle after the other.

LOOKED_AT = np.linspace(0.0, -1.0, 101)  # constant actions, for the bound at the alert where there are several members
GRID = np.linspace(0.0, -1.0, 21)  # ... of the descent of several vehicles
ROUNDS = 2  # of that descent
LADDER = np.linspace(0.0, -1.0, 5)  # actions of the first and of the last vehicle in the constants of several

Cap = Literal["baseline"]  # whose plan a vehicle's harm is the most that it may bear


def joint_constants(vehicles: int) -> Floats:
    """Constant actions [C, K] of several vehicles, front to rear: all alike, or evenly from one action to another."""
    alike = np.repeat(np.array(CONSTANTS)[:, np.newaxis], vehicles, axis=1)
    share = np.linspace(0.0, 1.0, vehicles)
    ladders = [first + share * (last - first) for first in LADDER for last in LADDER if first != last]
    return np.concatenate([alike, ladders])


def held(action: Floats, width: int) -> Floats:
    """The plans [n, width, K] that hold these actions [n, K]."""
    return np.repeat(action[:, np.newaxis], width, axis=1)


class StepShield:
    """Guarantees the harm of a batch: ``begin`` when episodes start, ``decide`` in every step.

    Both change it in one piece, and nothing that it holds is changed in place: what fails, or is interrupted, leaves
    bound, plan and trust as they were, and a ``copy.copy`` goes on apart.

    The bound starts as the harm of the coupled optimum, realised decision by decision, or as that of a ``policy``
    rolled out from the alert where that is lower, and only ever falls; ``allowance`` (m2/s2) is what the budget grants
    above it (0: none), and the bound is then that budget until the episode ends. It bounds the harm up to the
    scenario's horizon and says nothing of what still moves then, or of what happens afterwards (``settles`` [n]: where
    the plan held at the alert leaves nothing moving). The other vehicles follow ``others``
    (default: the scenario's scripts), whose commands must be fixed at the alert. What happens is compared with what was
    predicted, bit by bit: where it differs (a vehicle that brakes beyond its capacity, a number that is none, a message
    that never came) ``distrusted`` [n] is set, nothing is guaranteed any more, and for the rest of the episode the
    fallback ``best constant`` drives: the better one of the plan's rest and the constants, chosen again after every
    surprise. In a world that is asked ``only`` after its episode was to be over, full braking is applied. With an
    ``uncertainty`` (robust mode) all of this holds for the worst member of each world, and what is seen must lie within
    the range of their predictions. Raises ``InvalidInput`` for an unknown count or vehicle, a negative allowance,
    others whose commands are not fixed, or what ``robust`` interior cannot certify.
    """

    def __init__(
        self,
        scenario: Scenario,
        vehicle: int | Sequence[int],
        *,
        harm_count: HarmCount = "first",
        allowance: float = 0.0,
        others: Mapping[int, Script] | None = None,
        uncertainty: Uncertainty | None = None,
        cap: Cap | None = None,
        robust: str = CORNERS,
        logging: bool = False,
    ) -> None:
        check_harm_count(harm_count)
        check_scenario(scenario, "shield")
        check_amount("allowance", allowance, "shield", " m2/s2")
        several = isinstance(vehicle, Sequence) and not isinstance(vehicle, str)
        each: tuple[Any, ...] = tuple(cast(Sequence[Any], vehicle)) if several else (vehicle,)
        known = range(scenario.vehicles)
        if not each or any(not isinstance(i, int | np.integer) or isinstance(i, bool) or i not in known for i in each):
            raise InvalidInput(f"shield: vehicle = {vehicle!r}: must be an index from 0 to {scenario.vehicles - 1}")
        if list(each) != sorted(set(each)):
            raise InvalidInput(f"shield: vehicle = {vehicle!r}: several are named front to rear, each once")
        self.vehicles = tuple(map(int, each))
        self.vehicle = self.vehicles if several else self.vehicles[0]
        if uncertainty is not None and (len(self.vehicles) > 1 or cap is not None):
            what = "several vehicles" if cap is None else "a cap"
            raise InvalidInput(f"shield: uncertainty: {what} with it: not covered; mode robust shields one vehicle")
        if cap not in (None, *get_args(Cap)):
            raise unknown_name("shield cap", cap, get_args(Cap))
        self.scenario, self.harm_count, self.allowance = scenario, harm_count, allowance
        self.uncertainty, self.cap = uncertainty, cap
        self.robust = checked_robust(robust, "shield")
        self.boxes: Boxes | None = None  # where every world of them is certified
        self.logging = logging
        self._entries: list[Intervention] = []  # shared with copies; the first ``_logged`` of them are of this one
        self._logged = 0
        self.running: Running | None = None
        self.backup = Backup(np.zeros((0, 0)), np.zeros(0))
        self.first_bound: Floats = np.zeros(0)  # [n] harm of the backup at the first decision
        self.alone_harm: Floats = np.zeros(0)  # [n] of the policy rolled out; infinity without one
        self.settles: Bools = np.zeros(0, np.bool_)  # [n] under the plan of the first decision all rest at the horizon
        self.replaced: Ints = np.zeros(0, np.int64)  # [n] or [n, K] actions so far in the running episodes
        self.episode: Ints = np.zeros(0, np.int64)  # [n] number of each row's running episode
        self.distrusted: Bools = np.zeros(0, np.bool_)
        self.baseline_shares: Floats = np.zeros((0, 0))  # [n, N] what each vehicle bears under the best constants
        scripts = script_agents(scenario, except_for=self.vehicles) if others is None else others
        self._others = {i: script for i, script in scripts.items() if i not in self.vehicles}
        Boxes.check_possible(self.robust, scenario, harm_count, self._others)
        self._width = int(Decisions(np.zeros(1), scenario.time_step_s).before(scenario.horizon_s)[0]) + 1

    @property
    def bound(self) -> Floats:
        """Harm of each running episode is at most this, [n] m2/s2: what certificates may reach."""
        if self.running is None or self.allowance == 0.0:
            return self.backup.harm
        granted = np.where(self.running.finished, 0.0, self.first_bound + self.allowance)
        return np.maximum(self.backup.harm, granted)

    @property
    def predicted_harm(self) -> Floats:
        """What was told at the alert, [n] m2/s2."""
        return self.first_bound + self.allowance

    @property
    def chosen_policy(self) -> Bools:
        """Where everything proposed was applied so far, [n]."""
        return np.asarray(self.interventions == 0, np.bool_)

    @property
    def log(self) -> list[Intervention] | None:
        """Every decision so far in which something else than the proposal was applied; None without ``logging``."""
        return self._entries[: self._logged] if self.logging else None

    def clear_log(self) -> None:
        """Forget what was logged so far: it grows until then."""
        self._entries, self._logged = [], 0

    @property
    def interventions(self) -> Ints:
        """Actions that were replaced so far in each running episode, of all vehicles together, [n]."""
        return np.asarray(self.replaced.reshape(len(self.replaced), -1).sum(axis=1), np.int64)

    def shares(self) -> Floats:
        """What each vehicle bears of the harm if the plan that is held now is executed, [n, N] m2/s2."""
        if self.running is None:
            raise InvalidInput("shield: shares, but no episode has begun; call begin first")
        return ends_under(self.running.nominal(), self.backup.plan)[1][:, -self.scenario.vehicles :]

    def take(self, rows: Ints) -> StepShield:
        """The shield of some rows, which goes on apart."""
        part, held = copy.copy(self), self.backup
        part.running = None if self.running is None else self.running.take(rows)
        part.boxes = None if self.boxes is None else self.boxes.take(rows)
        part.backup = held._replace(plan=held.plan[rows], harm=held.harm[rows])
        for name in ("first_bound", "alone_harm", "settles", "replaced", "distrusted", "baseline_shares", "episode"):
            setattr(part, name, getattr(self, name)[rows])
        return part

    def begin(
        self,
        worlds: Worlds,
        rows: Ints,
        policy: Agent | Mapping[int, Agent] | None = None,
        *,
        possible: Worlds | None = None,
    ) -> None:
        """New episodes start in these rows; ``worlds`` holds those rows only, at the alert, as they are believed.

        The ``policy`` that proposes (of several vehicles: one for each, by index) is rolled out from there. Certified
        are the members of the ``uncertainty``, or the ``possible`` worlds [n * M], each world's own one first.
        Rows 0 to k - 1 together may also begin a larger batch. Raises ``InvalidInput`` for rows that are not there.
        """
        running_rows = len(self.first_bound)
        if not (rows < running_rows).all() and sorted(rows.tolist()) != list(range(len(rows))):
            raise InvalidInput(
                f"shield: begin in row {rows.max()} of a batch of {running_rows}: a larger batch begins with all of its"
                " rows at once"
            )
        new = copy.copy(self)
        new._begin(worlds, rows, policy, possible)
        self.__dict__.update(new.__dict__)

    def _begin(
        self, worlds: Worlds, rows: Ints, policy: Agent | Mapping[int, Agent] | None, possible: Worlds | None
    ) -> None:
        """Find the plan to start with in each of these worlds, and keep it in their rows."""
        if possible is None:
            possible = worlds if self.uncertainty is None else self.uncertainty.members(worlds)
        members, vehicles, horizon_s = possible.n // worlds.n, self.vehicles, self.scenario.horizon_s
        if members > 1 and self.cap is not None:
            raise InvalidInput(f"shield: cap {self.cap!r} and {members} possible worlds: give one of the two")
        latest = possible.vehicles.latency_s[:, list(vehicles)].min(axis=1).max()
        if members > 1 and not latest < horizon_s:
            raise InvalidInput(
                f"uncertainty: {self.uncertainty}: vehicle_{vehicles[0] + 1} may decide first at {latest:g} s; must be"
                f" before the horizon, {horizon_s:g} s"
            )
        try:
            others = fixed_commands(self._others, possible, "shield", vehicle=None)
        except InvalidInput as error:
            raise error if members == 1 else InvalidInput(f"uncertainty: {self.uncertainty}: {error}") from None
        with renumbered(np.repeat(np.arange(worlds.n), members)):
            problem = profile_problem(
                possible, vehicles, harm_count=self.harm_count, horizon_s=horizon_s,
                time_step_s=self.scenario.time_step_s, others_mps2=others, written_out=self.scenario.has_obstacle,
            )  # fmt: skip
        running = begin_running(problem, members)
        plan = self._best_constants(worlds, running)
        if members > 1:
            plan = bettered_plan(running, plan, LOOKED_AT)[0]
        harm, alone = plan_harm(running, plan), np.full(worlds.n, np.inf)
        borne = ends_under(running, plan)[1]
        if self.cap is not None:
            running = running._replace(caps=borne)
        if policy is not None:
            policies = policy if isinstance(policy, Mapping) else dict.fromkeys(vehicles[:1], policy)
            if set(policies) != set(vehicles):
                raise InvalidInput(f"shield: policies for vehicles {sorted(policies)}, shielded are {list(vehicles)}")
            drivers = {i: policies[i] for i in vehicles}
            actions = rolled_out(worlds, drivers, self.scenario, self.vehicle, self._width)
            alone = plan_harm(running, actions)
            better = alone <= harm
            if self.cap is not None:
                better &= (ends_under(running, actions)[1] <= borne).all(axis=1)
            plan[better] = actions[better]
            harm = np.where(better, alone, harm)
        settles = ends_under(running, plan)[0]
        if members > 1 and self.robust == INTERIOR:
            boxes = Boxes.of(possible, problem, worlds.n, self.scenario, self._others)
            harm = boxes.at_alert(plan, harm)
            self.boxes = boxes.placed(self.boxes, rows)
        constants = joint_constants(len(vehicles)) if len(vehicles) > 1 else np.array(CONSTANTS)
        new: dict[str, NDArray[Any]] = {
            "first_bound": harm, "alone_harm": alone, "settles": settles,
            "replaced": np.zeros((worlds.n, *plan.shape[2:]), np.int64), "distrusted": np.zeros(worlds.n, np.bool_),
            "baseline_shares": borne[::members, borne.shape[1] - worlds.N :],
        }  # fmt: skip
        old, order = self.running, np.argsort(rows)
        if old is None or worlds.n >= old.n:
            self.running, self.backup = running.take(order), Backup(plan[order], harm[order], constants)
            new = {name: values[order] for name, values in new.items()}
            new["episode"] = np.full(worlds.n, self.episode.max(initial=-1) + 1)
        else:
            at = old.rows_of(rows)
            self.running = Running(
                old.problem.put(at, problem), put(old.states, at, running.states), put(old.steps, rows, running.steps),
                put(old.ended, at, running.ended), put(old.caps, at, running.caps) if old.caps.size else old.caps,
            )  # fmt: skip
            self.backup = Backup(put(self.backup.plan, rows, plan), put(self.backup.harm, rows, harm), constants)
            new["episode"] = self.episode[rows] + 1
            new = {name: put(getattr(self, name), rows, values) for name, values in new.items()}
        self.__dict__.update(new)

    def _best_constants(self, worlds: Worlds, running: Running) -> Floats:
        """The plans [n, L] or [n, L, K] of the best constant actions found."""
        vehicles, members = list(self.vehicles), running.members
        others = np.array(running.problem.command[::members, running.problem.command.shape[1] - worlds.N :])
        others[:, vehicles] = -worlds.vehicles.braking_capacity_mps2[:, vehicles]

        def alone(vehicle: int) -> Floats:
            best = optimise_coupled(
                worlds, vehicle, harm_count=self.harm_count, horizon_s=self.scenario.horizon_s, others_mps2=others
            ).deceleration_mps2
            return command_to_action(-best, worlds.vehicles, vehicle)

        if isinstance(self.vehicle, int):
            return np.repeat(alone(self.vehicle)[:, np.newaxis], self._width, axis=1)
        if members > 1:  # a team of one vehicle: no other team is shielded against uncertainty
            return held(alone(vehicles[0])[:, np.newaxis], self._width)
        best = np.full((worlds.n, len(vehicles)), -1.0)
        least = plan_harm(running, held(best, self._width))
        for c in range(len(vehicles) + 1):
            if c < len(vehicles):
                action = np.full_like(best, -1.0)
                action[:, c] = alone(vehicles[c])
            else:
                action = best.copy()
                descend_constants(running.uncapped, GRID, ROUNDS, action)
            harm = plan_harm(running, held(action, self._width))
            best, least = np.where((harm < least)[:, np.newaxis], action, best), np.minimum(harm, least)
        return held(best, self._width)

    def decide(
        self,
        proposed: Floats,
        *,
        seen: Floats | None = None,
        only: Bools | None = None,
        proposer: Proposer | None = None,
    ) -> Decision:
        """Decide in every running episode, or ``only`` in some; the others stay as they are.

        ``seen`` [n, columns]: the worlds as they are now, in the first columns of ``Running.states``. Where nothing
        else certifies a proposal, the ``proposer`` (if given) is rolled out from the state after it.
        """
        if self.running is None:
            raise InvalidInput("shield: decide, but no episode has begun; call begin first")
        if np.shape(proposed) != (shape := (*self.distrusted.shape, *self.backup.plan.shape[2:])):
            raise InvalidInput(f"shield: proposed {np.shape(proposed)}; {shape} is needed")
        after = copy.copy(self)
        decision = after._decided(proposed, seen, ~self.running.finished if only is None else only, proposer)
        self.__dict__.update(after.__dict__)  # in one piece: not even an interrupt comes between
        return decision

    def _decided(self, proposed: Floats, seen: Floats | None, asked: Bools, proposer: Proposer | None) -> Decision:
        """Decide, and become the shield as it will be once that was carried out."""
        assert self.running is not None
        if seen is not None:
            self._compare(seen, asked)
        before = self.running
        goes_on, asked = asked & before.finished, asked & ~before.finished
        each = np.repeat(asked, before.members)
        now = before._replace(ended=before.ended | ~each)
        given = np.array(proposed, np.float64)
        given[self.distrusted] = np.nan
        held, budget = self.backup, self.bound
        decision = certify(now, given, held, budget)
        rejected = (decision.reason == NO_CERTIFICATE).reshape(len(asked), -1).any(axis=1)
        if proposer is not None and (rows := np.flatnonzero(rejected)).size:
            found = certify_rollouts(now, given, rows, budget, held.plan, proposer)
            margin, plan = decision.margin.copy(), found.backup.plan
            margin[rows] = np.maximum(margin[rows], found.margin)
            assert (plan == from_now(decision.backup.plan[rows], plan, found.after.steps - 1)).all()  # one past
            kept = np.flatnonzero((found.reason != NO_CERTIFICATE).reshape(len(rows), -1).all(axis=1))
            decision = decision._replace(margin=margin).put(rows[kept], found._replace(margin=margin[rows]), kept)
        decision = certify_inside(self.boxes, now, held, budget, decision, asked & ~self.distrusted)
        decision.reason[asked & self.distrusted] = ShieldReason.ASSUMPTION_BROKEN
        decision.applied[goes_on] = -1.0  # its episode was to be over: it holds the brakes
        self.replaced = self.replaced + (decision.intervened.T & asked).T
        self.running = decision.after._replace(ended=np.where(each, decision.after.ended, before.ended))
        self.backup = decision.backup
        decision = decision._replace(bound=self.bound)
        if self.logging:
            if len(self._entries) > self._logged:  # of a step that was not made, or of a copy
                self._entries = self._entries[: self._logged]
            self._entries.extend(interventions(now, self.episode, self.vehicles, proposed, decision, held))
            self._logged = len(self._entries)
        return decision

    def as_seen(self, seen: Floats) -> Floats:
        """What is seen, with a post ahead where it was predicted: nothing stands there."""
        assert self.running is not None
        N = self.running.problem.mass.shape[1]
        if self.scenario.vehicles == N:
            return seen
        seen = seen.copy()
        seen[:, N] = np.where(np.isposinf(seen[:, N]), self.running.states[:: self.running.members, N], seen[:, N])
        return seen

    def expects(self, seen: Floats) -> Bools:
        """Where what is seen now [n, columns] does not contradict what was predicted, [n].

        One member: where it is what was predicted, to the bit. Several: where it lies within the range of their
        predictions, by column; once one of them has had an impact, worlds between the corners may leave that range, and
        any finite numbers will do. So they will where the own latency of a box is uncertain (a decision falls at
        another time in each of its worlds then), and where friction is.
        """
        running, boxes = self.running, self.boxes
        assert running is not None
        seen = self.as_seen(seen)
        columns, N = seen.shape[1], running.problem.mass.shape[1]
        if running.members == 1:
            return np.asarray((seen == running.states[:, :columns]).all(axis=1), np.bool_)
        predicted = running.states.reshape(running.n, running.members, -1)
        low, high = predicted[:, :, :columns].min(axis=1) - SLACK, predicted[:, :, :columns].max(axis=1) + SLACK
        within = np.asarray(((seen >= low) & (seen <= high)).all(axis=1), np.bool_)
        anywhere = (predicted[:, :, 2 * N - 1 : 3 * N - 2] == 1.0).any(axis=(1, 2))
        if boxes is not None:
            own = 2 * boxes.limit.shape[1] + boxes.vehicle
            anywhere |= boxes.high[:, own] > boxes.low[:, own]
        if self.uncertainty is not None and self.uncertainty.moves_together:
            anywhere[:] = True
        return np.asarray(within | (anywhere & np.isfinite(seen).all(axis=1)), np.bool_)

    def _compare(self, seen: Floats, asked: Bools) -> None:
        """Find the worlds that did not do what was predicted, and choose anew there from what is seen."""
        assert self.running is not None
        running, seen = self.running, self.as_seen(seen)
        columns, surprising = seen.shape[1], asked & ~self.expects(seen)
        if not surprising.any():
            return
        self.distrusted = self.distrusted | surprising
        known = np.isfinite(seen).all(axis=1) & ~running.finished  # others: what was predicted goes on, or the brakes
        rows = np.flatnonzero(surprising & known)
        states, ended, at = running.states.copy(), running.ended.copy(), running.rows_of(rows)
        states[at, :columns] = np.repeat(seen[rows], running.members, axis=0)
        ended[at] = np.repeat(running.steps[rows], running.members) >= running.problem.last_step[at]
        self.running = running._replace(states=states, ended=ended)
        plan, harm, held = self.backup.plan.copy(), self.backup.harm.copy(), self.backup.plan
        harm[rows] = np.inf
        for constant in (None, *self.backup.constants):
            trial = held if constant is None else from_now(held, constant, running.steps)
            with renumbered(rows):
                found = plan_harm(self.running.take(rows), trial[rows])
            better = rows[found < harm[rows]]
            harm[rows] = np.minimum(found, harm[rows])
            plan[better] = trial[better]
        self.backup = self.backup._replace(plan=plan, harm=harm)


def certify_inside(
    boxes: Boxes | None, running: Running, held: Backup, budget: Floats, decision: Decision, asked: Bools
) -> Decision:
    """A decision that the corners allow, refused where its plan is not certified for every world of the box, if any.

    ``held`` is the backup before it. A plan without a certificate never replaces the held one. Episodes end at the
    horizon: that all corners rest does not mean that every world does.
    """
    if boxes is None:
        return decision
    plan, other = decision.backup.plan.copy(), (decision.backup.plan != held.plan).any(axis=1)
    bound = np.where(asked & ~other, held.harm, decision.bound)  # of the corners alone, where the plan is the same
    changed = np.flatnonzero(asked & other)
    found = boxes.bound(changed, plan[changed], budget[changed], only_enough=True)
    least = np.where(decision.intervened, held.harm, budget)[changed]
    good = found <= least
    bound[changed[good]] = found[good]
    known = np.isfinite(found)
    decision.margin[changed[known]] = (budget[changed] - found)[known]
    bad = changed[~good]
    plan[bad], bound[bad] = held.plan[bad], held.harm[bad]
    decision = decision._replace(bound=bound, backup=decision.backup._replace(plan=plan, harm=bound))
    refused = bad[~decision.intervened[bad]]
    if refused.size:  # the held plan's action instead
        part, plan = running.take(refused), held.plan[refused]
        action, harm = plan[np.arange(len(plan)), part.steps], held.harm[refused]
        with renumbered(refused):
            instead = certify(part, action, Backup(plan, harm, held.constants), harm)
        every, reason = np.ones(len(refused), np.bool_), np.full(len(refused), NO_CERTIFICATE)
        instead = instead._replace(intervened=every, reason=reason, margin=decision.margin[refused])
        decision = decision.put(refused, instead, np.arange(len(refused)))
    after = decision.after
    over = np.repeat(after.steps, after.members) >= after.problem.last_step
    each = np.repeat(asked, after.members)
    return decision._replace(after=after._replace(ended=np.where(each, over, after.ended)))


# Shields over a believed world: what is certified is certified on what was received, and nothing else is looked at.
#
# ``step``: every action is certified in the world that the vehicle believes in, with what is not known in the middle of
# its range. That promises nothing of the world as it is. ``robust``: in every corner of the ranges of what is not
# known. If the world is such a corner, its harm up to the horizon is at most the first bound: what is heard later
# leaves those corners standing that it agrees with, and the plan that was held is held on unless a better one for them
# is found.

PER_WORLD = ("predicted_harm", "interventions", "_heard", "_asked_s", "_wanted", "_impact_s")  # arrays [n, ...]
SURPRISE = 1e-6  # by more than this (m, m/s) what is measured is not what was foretold


def _hold_better(shield: StepShield, rows: Ints, before: StepShield) -> None:
    """Where it began anew, count the members' harm so far, and hold the old plan's rest if that harms no more."""
    running, old = shield.running, before.running
    assert running is not None and old is not None
    at, plan, width = running.rows_of(rows), shield.backup.plan[rows].copy(), before.backup.plan.shape[1]
    N, states = running.problem.mass.shape[1], running.states.copy()
    states[at, 3 * N - 2 : 5 * N - 4] = old.states[at, 3 * N - 2 : 5 * N - 4]  # harm
    shield.running = running._replace(states=states)
    column = np.arange(width) + old.steps[rows, np.newaxis]
    rest = np.take_along_axis(before.backup.plan[rows], np.minimum(column, width - 1), axis=1)
    rest = np.where(column < width, rest, -1.0)  # full braking after the plan
    part = shield.running.take(rows)
    harm, still = plan_harm(part, plan), plan_harm(part, rest)
    plan[still <= harm] = rest[still <= harm]
    shield.backup = shield.backup._replace(
        plan=put(shield.backup.plan, rows, plan), harm=put(shield.backup.harm, rows, np.minimum(still, harm))
    )


class BelievedShield:
    """A ``StepShield`` that certifies what one vehicle proposes on what was really received.

    It begins at the first decision, and anew whenever another vehicle is heard for the first time, is heard to react,
    or moves otherwise than was foretold; what is left of its plan is a candidate for the next one. After the first
    decision ``predicted_harm`` [n] is the first bound; infinite where the vehicle had an impact before, whose harm
    nobody told it. ``robust`` says in which worlds it certifies: None in the middle of what is not known, ``corners``
    also in all corners of its range, and ``interior`` in all worlds of the box around them, once, at the first
    decision. Raises ``InvalidInput`` for a mixture, a scenario with more than ``MOST_CORNERS`` corners, and what
    interior mode cannot certify. ``others`` are scripts of the other vehicles, by index; None: those of the scenario.
    """

    def __init__(
        self,
        scenario: Scenario,
        vehicle: int,
        *,
        harm_count: HarmCount = "first",
        robust: str | None = None,
        others: Mapping[int, Script] | None = None,
    ) -> None:
        self.scenario, self.vehicle = scenario, vehicle
        self.robust = None if robust is None else checked_robust(robust, "believed")
        self.predicted_harm: Floats = np.zeros(0)
        self.interventions: Ints = np.zeros(0, np.int64)  # [n] so far in the running episodes
        self.decision: Decision | None = None  # the last one
        self._harm_count: HarmCount = harm_count
        self._others = script_agents(scenario, except_for=vehicle) if others is None else others
        self._odometer: tuple[Floats, ...] = ()  # an ``Odometer``
        self._heard: Floats = np.zeros((0, 0))  # what the shield began on; NaN where it has not begun
        self._asked_s: Floats = np.zeros(0)  # [n] time of the last decision
        self._wanted: Floats = np.zeros(0)  # [n] actions
        self._totals: Floats = np.zeros((0, 0, 0))  # [n, M, pairs] foretold total harm at the last decision (m2/s2)
        self._impact_s: Floats = np.zeros((0, 0))  # [n, N] last time at which an impact of this vehicle was foretold
        self._ranges = Ranges.of(scenario, vehicle, self._others)
        numbers = len(self._ranges.uncertain)
        if self.robust is not None and 2**numbers > MOST_CORNERS:
            raise InvalidInput(
                f"robust:believed: scenario {scenario.name!r} leaves {numbers} numbers of the other vehicles open,"
                f" which make {2**numbers} corners; at most {MOST_CORNERS} can be certified"
            )
        self.shield = self._make()

    def _make(self) -> StepShield:
        certain = self.robust or CORNERS
        return StepShield(self.scenario, self.vehicle, harm_count=self._harm_count, others=self._others, robust=certain)

    @property
    def members(self) -> int:
        """Worlds that are certified for each one: the middle, and all corners."""
        return 1 + len(self._corners())

    def __copy__(self) -> BelievedShield:
        """One that goes on apart: what it decides leaves this one as it is."""
        apart = object.__new__(BelievedShield)
        apart.__dict__.update(self.__dict__)
        apart.shield = copy.copy(self.shield)
        for name in PER_WORLD:
            setattr(apart, name, getattr(self, name).copy())
        return apart

    def take(self, rows: Ints) -> BelievedShield:
        """The shield of some rows, which goes on apart."""
        apart = copy.copy(self)
        if self.shield.running is not None:
            apart.shield = self.shield.take(rows)
        apart._odometer = take_memory(self._odometer, rows)
        for name in (*PER_WORLD, *(("_totals",) if len(self._totals) else ())):
            setattr(apart, name, getattr(self, name)[rows])
        return apart

    def begin(self, worlds: Worlds, rows: Ints) -> None:
        """Remember where these episodes start; nothing has been received yet."""
        if len(rows) >= len(self._wanted):
            self.shield, self._wanted, self._totals = self._make(), np.zeros(0), np.zeros((0, 0, 0))
        n, N, fresh = len(rows), worlds.N, self._wanted.size == 0
        begun = {
            "_odometer": Odometer.begun(worlds, self.vehicle), "predicted_harm": np.full(n, np.nan),
            "_heard": np.full((n, 2 * N), np.nan), "_impact_s": np.full((n, N), -1.0), "_asked_s": np.full(n, np.nan),
            "_wanted": np.zeros(n), "interventions": np.zeros(n, np.int64),
        }  # fmt: skip
        for name, part in begun.items():
            setattr(self, name, part if fresh else renew_memory(getattr(self, name), rows, part))

    def decide(
        self, worlds: Worlds, proposed: Floats, proposer: Proposer | None = None, *, only: Bools | None = None
    ) -> Floats:
        """The certified actions [n], 0 before the vehicle's latency has elapsed; the same if asked again.

        Args:
            worlds: as they are; of them only what the vehicle received is read.
            proposed: actions [n].
            proposer: is rolled out in the believed worlds where nothing else certifies a proposal.
            only: worlds that decide now; None: all.

        Raises ``InvalidInput`` if an episode never began.

        """
        shield, vehicle = self.shield, self.vehicle
        if worlds.n > len(self._heard):
            raise InvalidInput(
                f"shield: believed: act on {count_of(worlds.n, 'world')}, but begin was not called for each"
            )
        self._odometer = odometer = Odometer(*self._odometer).look(worlds, vehicle)
        past = worlds.vehicles.latency_s[:, vehicle] <= worlds.time_s
        due = past & (worlds.time_s != self._asked_s) & (worlds.time_s < self.scenario.horizon_s)
        due &= True if only is None else only
        if due.any():
            believed = self._believe(worlds, odometer.way_m, None)
            self._begin_anew(worlds, believed, odometer.way_m, due)
            proposer = None if proposer is None else proposer._replace(worlds=believed)
            self.decision = decision = shield.decide(proposed, only=due, proposer=proposer)
            self._wanted[due] = decision.applied[due]
            self.interventions = self.interventions + (decision.intervened & due)
            self._asked_s[due] = worlds.time_s[due]
        return self._wanted.copy()

    def _begin_anew(self, worlds: Worlds, believed: Worlds, way_m: Floats, due: Bools) -> None:
        """Let the shield begin where it has not, or where what was heard was not foretold."""
        shield, vehicle = self.shield, self.vehicle
        told = Told.to(worlds, vehicle)
        heard = np.concatenate([told.known, told.reacts], axis=1).astype(np.float64)
        fresh, begun = np.isnan(self._heard[:, 0]), shield.running is not None
        keeps, anew = np.zeros_like(told.known), fresh
        if self.robust != INTERIOR:  # its plans are certified from the first decision on, whatever is heard later
            if begun:
                self._note_impacts(worlds)
            keeps = self._keeps(told, worlds.time_s)
            surprised = self._is_surprised(believed, told.known & ~keeps) if begun else fresh
            anew = fresh | surprised | (heard != self._heard).any(axis=1)
        rows = np.flatnonzero(due & anew)
        rows = rows if begun else np.arange(worlds.n)
        if not rows.size:
            return
        before = copy.copy(shield) if begun and self.robust != INTERIOR else None
        keeps = keeps & ~fresh[:, np.newaxis]
        self._begin_shield(worlds.take(rows), believed.take(rows), way_m[rows], rows, keeps[rows], before)
        if before is not None and (held_before := rows[~fresh[rows]]).size:
            _hold_better(shield, held_before, before)
        rows = rows[due[rows]]  # the others begin anew at their own first decision
        first, self._heard[rows] = rows[fresh[rows]], heard[rows]
        felt = worlds.pair_hit[first, max(vehicle - 1, 0) : vehicle + 1].any(axis=1)
        felt |= worlds.obstacle_hit[first] & (vehicle == 0)
        self.predicted_harm[first] = np.where(felt, np.inf, shield.backup.harm[first])

    def _begin_shield(
        self, worlds: Worlds, believed: Worlds, way_m: Floats, rows: Ints, keeps: Bools, before: StepShield | None
    ) -> None:
        """Begin in ``rows``: in the middle of what is open, and for a robust shield in its corners."""
        parts = []
        for m, share in enumerate([None, *self._corners()]):
            foretold = None
            if before is not None:
                assert before.running is not None
                expected = worlds_at(believed, before.running.states[rows * before.running.members + m])
                known = keeps.any(axis=1, keepdims=True)
                foretold = (replace(expected, pair_hit=expected.pair_hit & known), keeps)
            parts.append(self._believe(worlds, way_m, share, foretold))
        self.shield.begin(parts[0], rows, possible=Uncertainty.interleaved(parts))

    def _keeps(self, told: Told, time_s: Floats) -> Bools:
        """Whose foretold state tells more than what was told, [n, N]: nobody told anything, or not since an impact."""
        running = self.shield.running
        if running is None:
            return np.zeros(told.known.shape, np.bool_)
        n, N = told.known.shape
        whole = running.problem.mass.shape[1]  # vehicles of the columns, an obstacle ahead included
        gaps = running.states.reshape(n, running.members, -1)[:, :, whole : 2 * whole - 1]
        touching: Bools = np.any(gaps == 0.0, axis=1)
        pressed = np.zeros((n, whole), np.bool_)
        pressed[:, :-1], pressed[:, 1:] = touching, pressed[:, 1:] | touching
        since = (told.at_s < self._impact_s) | (pressed[:, whole - N :] & (told.at_s < time_s[:, np.newaxis]))
        keeps: Bools = ~told.known | ((self._heard[:, :N] == 1.0) & since)
        keeps[:, self.vehicle] = False
        return keeps

    def _note_impacts(self, worlds: Worlds) -> None:
        """Write down which vehicles met in some member since the last decision."""
        running = self.shield.running
        assert running is not None
        pairs = running.problem.mass.shape[1] - 1
        totals = running.states[:, 4 * pairs + 1 : 5 * pairs + 1].reshape(worlds.n, running.members, pairs)
        if self._totals.shape == totals.shape:
            met: Bools = np.any(totals > self._totals, axis=1)
            for p in range(pairs):
                for j in {p - pairs + worlds.N - 1, p - pairs + worlds.N} & set(range(worlds.N)):
                    self._impact_s[met[:, p], j] = worlds.time_s[met[:, p]]
        self._totals = totals.copy()

    def _is_surprised(self, believed: Worlds, heard: Bools) -> Bools:
        """Where somebody of whom was ``heard`` [n, N] is not within what the shield foretold, [n]."""
        assert self.shield.running is not None
        seen, wrong = seen_columns(Packed.of(believed)), np.zeros(believed.n, np.bool_)
        first = (seen.shape[1] + 4) // 5 - believed.N  # 1: an obstacle ahead is vehicle 0 of the columns
        foretold = self.shield.running.states[:, : seen.shape[1]].reshape(believed.n, self.shield.running.members, -1)
        outside: Bools = (seen < foretold.min(axis=1) - SURPRISE) | (seen > foretold.max(axis=1) + SURPRISE)
        for i in range(believed.N):
            wrong |= heard[:, i] & outside[:, first + i]
        for p in range(believed.N - 1):
            wrong |= heard[:, p] & heard[:, p + 1] & outside[:, 2 * first + believed.N + p]
        return wrong

    def _corners(self) -> list[dict[tuple[str, int], float]]:
        uncertain = self._ranges.uncertain
        shares = [] if self.robust is None else product((0.0, 1.0), repeat=len(uncertain))
        return [dict(zip(uncertain, each, strict=True)) for each in shares]

    def _believe(
        self,
        worlds: Worlds,
        way_m: Floats,
        share: dict[tuple[str, int], float] | None,
        foretold: tuple[Worlds, Bools] | None = None,
    ) -> Worlds:
        return self._ranges.believe(worlds, way_m, share, foretold)
