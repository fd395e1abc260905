"""The members of a world, advanced decision by decision under the actions of the vehicles that are shielded.

A world has M members, worlds that must all keep the bound: one without uncertainty, then nothing here costs more. K of
its vehicles are shielded; an action is a row [K], a plan [L, K] holds one for each decision.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ethbrake_marl.actions import command_of
from ethbrake_marl.harm import front_share
from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.episode import (
    GOES_ON,
    HARM_IS_TOTAL,
    LAST_STEP,
    LATENCY,
    RESTITUTION,
    SUM_FIRST_HARM,
    SUM_TOTAL_HARM,
    grid_of,
    harm_so_far,
    restore,
    save,
    step_again,
)
from ethbrake_marl.physics.impact import MASS
from ethbrake_marl.physics.segment import COMMAND, LIMIT

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
        table[COMMAND, i], table[LATENCY, i] = lines[m, OF_COMMAND, i], lines[m, OF_LATENCY, i]
        table[MASS, i], table[LIMIT, i] = lines[m, OF_MASS, i], lines[m, OF_LIMIT, i]
    restore(table, state)


@compiled
def act(world: Members, m: int, action: Floats) -> None:
    """The shielded vehicles' commands of an action [K], in member ``m``."""
    for c in range(world.vehicles.shape[0]):
        braking, driving = -world.bounds[m, c, 0], world.bounds[m, c, 1]
        world.table[COMMAND, world.vehicles[c]] = command_of(action[c], braking, driving)


@compiled_apart
def take_step(world: Members, m: int, state: Floats, step: int, action: Floats, after: Floats) -> int:
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
    row, value = SUM_TOTAL_HARM if total == 1.0 else SUM_FIRST_HARM, 0.0
    if table[MASS, i] == math.inf:
        return value
    behind_obstacle = i > 0 and table[MASS, i - 1] == math.inf
    if i > 0 and not behind_obstacle:
        value += table[row, i - 1] - front_share(table[row, i - 1], table[MASS, i - 1], table[MASS, i])
    if i < table.shape[1] - 1:
        value += front_share(table[row, i], table[MASS, i], table[MASS, i + 1])
    return value + table[row, 0] if behind_obstacle else value


@compiled
def within_caps(world: Members, m: int) -> bool:
    """Whether no vehicle of member ``m``, as it is in the table, has borne more than it may."""
    if world.lines.shape[1] > OF_CAP:
        for i in range(world.lines.shape[2]):
            if borne_by(world.table, world.clock[m, HARM_IS_TOTAL], i) > world.lines[m, OF_CAP, i]:
                return False
    return True


@compiled
def worst_so_far(world: Members, states: Floats) -> float:
    """Largest harm so far over the members; infinity where a vehicle has borne more than it may."""
    worst = 0.0
    for m in range(states.shape[0]):
        enter(world, m, states[m])
        worst = max(worst, harm_so_far(world.table, world.clock[m, HARM_IS_TOTAL]))
        if not within_caps(world, m):
            return math.inf
    return worst


@compiled_apart
def follow_plan(world: Members, m: int, state: Floats, ended: bool, step: int, plan: Floats, most: float) -> float:
    """Harm of the episode if the plan's actions are executed from ``state`` at ``step`` on, as the engine does.

    Gives up with infinity as soon as it is above ``most`` (harm never falls), where a vehicle bears more than it may,
    or where the physics fails.
    """
    table, no_rows, total = world.table, world.table[:0], world.clock[m, HARM_IS_TOTAL]
    restitution, grid = world.clock[m, RESTITUTION], grid_of(world.clock[m])
    vehicles, bounds = world.vehicles, world.bounds
    enter(world, m, state)
    goes_on, value = not ended, harm_so_far(table, total)
    while goes_on:
        for c in range(vehicles.shape[0]):
            table[COMMAND, vehicles[c]] = command_of(plan[step, c], -bounds[m, c, 0], bounds[m, c, 1])
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
        table[COMMAND, vehicles[i]] = command_of(constants[c, i], -bounds[m, i, 0], bounds[m, i, 1])
    if not ended:
        last, grid = int(clock[LAST_STEP]), grid_of(clock)
        if step_again(table, clock[RESTITUTION], grid, step, last, table[:0]) < GOES_ON:
            return math.inf
    return harm_so_far(table, clock[HARM_IS_TOTAL])
