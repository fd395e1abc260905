"""Simulate the possible worlds of a world, decision by decision, with the same floating-point operations as the engine.

The shield's bound must hold in each of the M possible worlds (*members*) of a world. Usually M is 1: the world itself
is its only member. K of the N vehicles are shielded. A plan has an action [K] for each of L decisions, [L, K].

Arguments that several functions share:

- ``world``: parameters of the possible worlds; ``m``: index of one of them.
- ``states`` [M, S], ``ended`` [M]: present state of each possible world, in the layout of ``Running.states``, and
  whether its episode has ended. For one possible world: ``state`` [S] and ``ended``.
- ``step``: number of the present decision.
- ``action`` [K], ``plan`` [L, K]: actions of the shielded vehicles at one decision and at every decision.
- ``after`` [M, S] or [S], ``over`` [M]: receive the states after the step, and whether the episodes have then ended.
- ``most``: a simulation stops as soon as the harm exceeds this number, m2/s2, because harm never falls during an
  episode.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.game.actions import command_of
from ethbrake_marl.first_edition.game.harm import front_share
from ethbrake_marl.first_edition.physics.episode import CLOCK, GOES_ON, grid_of, harm_so_far, restore, save, step_again
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.rows import ROW, place_rates, rows_for
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints
from ethbrake_marl.first_edition.shields.running import Running

# Rows of ``Members.lines``: command of the unshielded vehicles (m/s2), latency (s), mass (t), speed limit (m/s), rates
# at which brakes build up and are released (m/s3), and the cap of each vehicle (m2/s2). Without caps the last row is
# missing.
OF_COMMAND, OF_LATENCY, OF_MASS, OF_LIMIT, OF_BRAKE_RATE, OF_RELEASE_RATE, OF_CAP = range(7)


class Members(NamedTuple):
    """Parameters of M possible worlds, and an array to simulate in, as input for the package's compiled functions.

    ``all_members`` returns the possible worlds of a whole batch, and ``members_from`` the possible worlds of one world.
    """

    table: Floats  # workspace in which one possible world is simulated, see ``physics.rows``
    clock: Floats  # [M, CLOCK.WIDTH] times of the decisions, and settings of the episode, see ``physics.episode``
    bounds: Floats  # [M, K, 2] smallest and largest command of the shielded vehicles (m/s2)
    lines: Floats  # [M, rows, N] parameters of the vehicles, in the rows ``OF_COMMAND`` to ``OF_CAP``
    pieces: Floats  # [M, N, 2 P] braking profiles with P intervals of constant command, as in ``Vehicles``
    vehicles: Ints  # [K] indices of the shielded vehicles, front to rear
    critical: Ints  # [1] index of the possible world that last exceeded a limit; simulating it first saves time


@compiled
def all_members(running: Running) -> Members:
    """Return the possible worlds of every world in ``running``, as input for the compiled functions."""
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
    """Return the rows ``a`` to ``b - 1`` of ``every`` (the result of ``all_members``) as views, not as copies."""
    clock, bounds, lines, pieces = every.clock[a:b], every.bounds[a:b], every.lines[a:b], every.pieces[a:b]
    return Members(every.table, clock, bounds, lines, pieces, every.vehicles, every.critical)


@compiled
def enter(world: Members, m: int, state: Floats) -> None:
    """Write possible world ``m`` with its ``state`` into the workspace ``world.table``."""
    table, lines = world.table, world.lines
    for i in range(table.shape[1]):
        table[ROW.COMMAND, i], table[ROW.LATENCY, i] = lines[m, OF_COMMAND, i], lines[m, OF_LATENCY, i]
        table[ROW.MASS, i], table[ROW.LIMIT, i] = lines[m, OF_MASS, i], lines[m, OF_LIMIT, i]
    place_rates(table, lines[m, OF_BRAKE_RATE], lines[m, OF_RELEASE_RATE], world.pieces[m])
    restore(table, state)


@compiled(apart=True)
def take_step(world: Members, m: int, state: Floats, step: int, action: Floats, after: Floats) -> int:
    """Advance one possible world from one decision to the next, and save its new state.

    Returns ``GOES_ON`` (0) if the episode continues, a positive code if the episode ended, or a negative code if the
    physics failed.
    """
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
    """Advance every possible world of one world from one decision to the next, with the same action.

    A possible world whose episode has ended keeps its state. Returns the number of possible worlds whose episode
    continues, or -1 if the physics failed in one of them.
    """
    going = 0
    for m in range(ended.shape[0]):
        if ended[m]:
            over[m] = True
            for c in range(states.shape[1]):  # element by element, because a row copy compiles slowly
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
    """Return the harm that vehicle ``i`` has borne since the episode began, m2/s2.

    ``table`` contains the state of one simulated world, in the layout of ``physics.rows``. ``total`` is 1 for total
    harm, 0 for first-impact harm. The result equals, to the bit, the harm of this vehicle in the engine's ledger. An
    obstacle ahead (vehicle 0, infinite mass) bears no harm; the vehicle that hits the obstacle bears all harm of the
    impact.
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
    """Return whether every vehicle bears at most its cap in possible world ``m``; True if there are no caps.

    ``world.table`` must contain the state of possible world ``m``.
    """
    if world.lines.shape[1] > OF_CAP:
        for i in range(world.lines.shape[2]):
            if borne_by(world.table, world.clock[m, CLOCK.HARM_IS_TOTAL], i) > world.lines[m, OF_CAP, i]:
                return False
    return True


@compiled
def worst_so_far(world: Members, states: Floats) -> float:
    """Return the largest harm so far over the possible worlds, m2/s2; infinity if a cap is exceeded."""
    worst = 0.0
    for m in range(states.shape[0]):
        enter(world, m, states[m])
        worst = max(worst, harm_so_far(world.table, world.clock[m, CLOCK.HARM_IS_TOTAL]))
        if not within_caps(world, m):
            return math.inf
    return worst


@compiled(apart=True)
def follow_plan(world: Members, m: int, state: Floats, ended: bool, step: int, plan: Floats, most: float) -> float:
    """Return the harm of the whole episode if a plan is executed in one possible world from now on, m2/s2.

    The harm equals, to the bit, the harm that the engine would count, because the operations are the same. Returns
    infinity if the harm exceeds ``most``, if a vehicle bears more than its cap, or if the physics fails.
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
    """Return the largest harm of ``follow_plan`` over the possible worlds of one world, m2/s2."""
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
    """Return the harm in one possible world if action ``c`` of ``constants`` [C, K] is held to the horizon, m2/s2.

    The time until the horizon is simulated as one segment, not decision by decision. Returns infinity if the physics
    fails.
    """
    table, clock, vehicles, bounds = world.table, world.clock[m], world.vehicles, world.bounds
    enter(world, m, state)
    for i in range(vehicles.shape[0]):
        table[ROW.COMMAND, vehicles[i]] = command_of(constants[c, i], -bounds[m, i, 0], bounds[m, i, 1])
    if not ended:
        last, grid = int(clock[CLOCK.LAST_STEP]), grid_of(clock)
        if step_again(table, clock[CLOCK.RESTITUTION], grid, step, last, table[:0]) < GOES_ON:
            return math.inf
    return harm_so_far(table, clock[CLOCK.HARM_IS_TOTAL])
