"""The plan that a step shield makes at the alert: the constant actions that do the least harm.

For one shielded vehicle the plan repeats the action of E-V2X-BM (the coupled optimum). For several shielded vehicles,
the following plans are compared, and the one that does the least harm is used:

- Full braking: all shielded vehicles brake fully.

- E-V2X-BM for one vehicle: this vehicle repeats the action of E-V2X-BM, and the other shielded vehicles brake fully.

- Coordinate descent: each shielded vehicle repeats the action that a coordinate descent over the vehicles finds. The
  descent starts from whichever of the plans above does the least harm.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.first_edition.game.actions import command_to_action
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.certify import CONSTANTS, bettered_plan, descend_constants, plan_harm
from ethbrake_marl.first_edition.shields.running import Running

LOOKED_AT = np.linspace(0.0, -1.0, 101)  # constant actions tried at the alert if a world has several possible worlds

GRID = np.linspace(0.0, -1.0, 21)  # actions that the coordinate descent tries for each vehicle

ROUNDS = 2  # rounds of the coordinate descent

LADDER = np.linspace(0.0, -1.0, 5)  # actions of the first and the last vehicle in ``joint_constants``


def best_constants(
    worlds: Worlds,
    running: Running,
    vehicle: int | tuple[int, ...],
    width: int,
    scenario: Scenario,
    harm_count: HarmCount,
) -> Floats:
    """Return plans that repeat the constant actions with the least harm found: [n, width], or [n, width, K].

    Args:
        worlds: n worlds at the alert.
        running: the episodes in ``worlds``, with all possible worlds of each world.
        vehicle: index of the shielded vehicle (0 = front), or indices of several.
        width: number of decisions of a plan.
        scenario: the scenario of ``worlds``.
        harm_count: ``first`` (first impact of each pair) or ``total`` (every impact).

    """
    vehicles = [vehicle] if isinstance(vehicle, int) else list(vehicle)
    others = np.array(running.problem.command[:: running.members, running.problem.command.shape[1] - worlds.N :])
    others[:, vehicles] = -worlds.vehicles.braking_capacity_mps2[:, vehicles]

    def optimum(i: int) -> Floats:
        """Return E-V2X-BM's action for vehicle ``i`` while the other shielded vehicles brake fully, [n]."""
        best = optimise_coupled(worlds, i, harm_count=harm_count, horizon_s=scenario.horizon_s, others_mps2=others)
        return command_to_action(-best.deceleration_mps2, worlds.vehicles, i)

    if isinstance(vehicle, int):
        plan = np.repeat(optimum(vehicle)[:, np.newaxis], width, axis=1)
    elif running.members > 1:  # a team of one vehicle: larger teams cannot have several possible worlds
        plan = held(optimum(vehicles[0])[:, np.newaxis], width)
    else:
        return held(_best_joint_action(running, [optimum(i) for i in vehicles], width), width)
    return plan if running.members == 1 else bettered_plan(running, plan, LOOKED_AT)[0]


def _best_joint_action(running: Running, optima: list[Floats], width: int) -> Floats:
    """Return the constant actions of K vehicles that together do the least harm in each world, [n, K] in [-1, 1].

    ``optima`` are K arrays [n]: for each vehicle, the constant action that does the least harm while the other K - 1
    vehicles brake fully. ``width`` is the number of decisions of a plan.
    """
    best = np.full((running.n, len(optima)), -1.0)
    least = plan_harm(running, held(best, width))
    for c in range(len(optima) + 1):
        if c < len(optima):
            action = np.full_like(best, -1.0)
            action[:, c] = optima[c]
        else:
            action = best.copy()
            descend_constants(running.uncapped, GRID, ROUNDS, action)
        harm = plan_harm(running, held(action, width))
        best, least = np.where((harm < least)[:, np.newaxis], action, best), np.minimum(harm, least)
    return best


def joint_constants(vehicles: int) -> Floats:
    """Return C combinations of constant actions of K = ``vehicles`` vehicles to try, [C, K] in [-1, 0], front to rear.

    In each combination the actions of all vehicles are equal, or they change linearly from the first to the last
    vehicle.
    """
    alike = np.repeat(np.array(CONSTANTS)[:, np.newaxis], vehicles, axis=1)
    share = np.linspace(0.0, 1.0, vehicles)
    ladders = [first + share * (last - first) for first in LADDER for last in LADDER if first != last]
    return np.concatenate([alike, ladders])


def held(action: Floats, width: int) -> Floats:
    """Return plans [n, width, K] that repeat the actions ``action`` [n, K] at each of ``width`` decisions."""
    return np.repeat(action[:, np.newaxis], width, axis=1)
