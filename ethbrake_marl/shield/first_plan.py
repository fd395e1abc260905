"""The plan that a step shield starts with at the alert: the constant actions of least harm.

For one shielded vehicle the constant is the coupled optimum. For several it is the best of these: all brake fully; one
takes its coupled optimum while the others brake fully; and what a descent finds from the best of those, one vehicle
after the other.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.game.actions import command_to_action
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.state import Floats, Worlds
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.certify import CONSTANTS, bettered_plan, descend_constants, plan_harm
from ethbrake_marl.shield.running import Running

LOOKED_AT = np.linspace(0.0, -1.0, 101)  # constant actions, for the bound at the alert where there are several members

GRID = np.linspace(0.0, -1.0, 21)  # ... of the descent of several vehicles

ROUNDS = 2  # of that descent

LADDER = np.linspace(0.0, -1.0, 5)  # actions of the first and of the last vehicle in the constants of several


def best_constants(
    worlds: Worlds,
    running: Running,
    vehicle: int | tuple[int, ...],
    width: int,
    scenario: Scenario,
    harm_count: HarmCount,
) -> Floats:
    """Plans [n, width], of several vehicles [n, width, K], that hold the best constant actions found.

    Args:
        worlds: at the alert, [n].
        running: the same worlds, with all their members.
        vehicle: the shielded one, or several of them.
        width: decisions of a plan.
        scenario: of these worlds.
        harm_count: the harm that is least.

    """
    vehicles = [vehicle] if isinstance(vehicle, int) else list(vehicle)
    others = np.array(running.problem.command[:: running.members, running.problem.command.shape[1] - worlds.N :])
    others[:, vehicles] = -worlds.vehicles.braking_capacity_mps2[:, vehicles]

    def optimum(i: int) -> Floats:
        """The coupled optimum of one vehicle, the other shielded ones braking fully, as an action [n]."""
        best = optimise_coupled(worlds, i, harm_count=harm_count, horizon_s=scenario.horizon_s, others_mps2=others)
        return command_to_action(-best.deceleration_mps2, worlds.vehicles, i)

    if isinstance(vehicle, int):
        plan = np.repeat(optimum(vehicle)[:, np.newaxis], width, axis=1)
    elif running.members > 1:  # a team of one vehicle: no other team is shielded in several possible worlds
        plan = held(optimum(vehicles[0])[:, np.newaxis], width)
    else:
        return held(_best_joint_action(running, [optimum(i) for i in vehicles], width), width)
    return plan if running.members == 1 else bettered_plan(running, plan, LOOKED_AT)[0]


def _best_joint_action(running: Running, optima: list[Floats], width: int) -> Floats:
    """The best constant actions [n, K] of several vehicles: see the top of this file."""
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
    """Constant actions [C, K] of several vehicles, front to rear: all alike, or evenly from one action to another."""
    alike = np.repeat(np.array(CONSTANTS)[:, np.newaxis], vehicles, axis=1)
    share = np.linspace(0.0, 1.0, vehicles)
    ladders = [first + share * (last - first) for first in LADDER for last in LADDER if first != last]
    return np.concatenate([alike, ladders])


def held(action: Floats, width: int) -> Floats:
    """Plans [n, width, K] that hold these actions [n, K]."""
    return np.repeat(action[:, np.newaxis], width, axis=1)
