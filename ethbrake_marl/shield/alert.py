"""The plan that a shield starts with at the alert: constants of least harm, or what the policies do, if that is better.

For one shielded vehicle the constant is the coupled optimum. For several it is the best of these: all brake fully, one
of them takes its coupled optimum while the others brake fully, and what a descent finds from the best of those, one
vehicle after the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.agents.protocol import Agent, fixed_commands
from ethbrake_marl.engine.stream import Script
from ethbrake_marl.errors import InvalidInput, renumbered
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.episode import EPISODE_ROWS
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search.problem import ProfileProblem, profile_problem
from ethbrake_marl.shield.certify import CONSTANTS, Backup, Running, begin_running, bettered_plan, no_caps, plan_harm
from ethbrake_marl.shield.members import Members, gather, hold_constant, rows_of
from ethbrake_marl.shield.rollouts import rolled_out
from ethbrake_marl.shield.settling import plan_rests
from ethbrake_marl.shield.shares import borne_under
from ethbrake_marl.shield.uncertainty import Uncertainty

LOOKED_AT = np.linspace(0.0, -1.0, 101)  # constant actions, for the bound at the alert where there are several members
GRID = np.linspace(0.0, -1.0, 21)  # ... of the descent of several vehicles
ROUNDS = 2  # of that descent
LADDER = np.linspace(0.0, -1.0, 5)  # actions of the first and of the last vehicle in the constants of several

Cap = Literal["baseline"]
CAPS = ("baseline",)  # of whose plan a vehicle's harm is the most that it may bear


class Settings(NamedTuple):
    """What a shield is set to."""

    scenario: Scenario
    vehicle: int | tuple[int, ...]  # shielded: one, whose actions are [n], or several, [n, K]
    harm_count: HarmCount
    others: Mapping[int, Script]
    uncertainty: Uncertainty | None
    cap: Cap | None
    width: int  # decisions of a plan

    @property
    def vehicles(self) -> tuple[int, ...]:
        """Indices of the shielded vehicles."""
        return (self.vehicle,) if isinstance(self.vehicle, int) else self.vehicle


class Start(NamedTuple):
    """What a shield knows at the alert, of n worlds."""

    running: Running
    backup: Backup
    alone: Floats  # [n] harm of the policies, rolled out; infinity without (m2/s2)
    settles: Bools  # [n] under the plan all rest at the horizon
    baseline: Floats  # [n, N] what each vehicle bears under the best constant (m2/s2)


def start_of(settings: Settings, worlds: Worlds, policies: Mapping[int, Agent] | None) -> Start:
    """The plan to start with in each of these worlds, which are at the alert, as they are believed."""
    possible = worlds if settings.uncertainty is None else settings.uncertainty.members(worlds)
    members = possible.n // worlds.n
    _check_latest(settings, possible, members)
    running = begin_running(*_problem(settings, possible, members))
    constants = joint_constants(len(settings.vehicles)) if len(settings.vehicles) > 1 else np.array(CONSTANTS)
    plan = _baseline(settings, worlds, running)
    if members > 1:
        plan = bettered_plan(running, plan, LOOKED_AT)[0]
    harm, alone = plan_harm(running, plan), np.full(worlds.n, np.inf)
    borne = borne_under(running, plan)
    if settings.cap is not None:
        running = running._replace(caps=borne)
    if policies is not None:
        actions = rolled_out(
            worlds, policies, settings.scenario, settings.vehicle, running.nominal().problem, settings.width
        )
        alone = plan_harm(running, actions)
        better = alone <= harm
        if settings.cap is not None:
            better &= (borne_under(running, actions) <= borne).all(axis=1)
        plan[better] = actions[better]
        harm = np.where(better, alone, harm)
    baseline = borne[::members, borne.shape[1] - worlds.N :]
    return Start(running, Backup(plan, harm, constants), alone, plan_rests(running, plan), baseline)


def joint_constants(vehicles: int) -> Floats:
    """Constant actions [C, K] of several vehicles, front to rear: all alike, or evenly from one action to another."""
    alike = np.repeat(np.array(CONSTANTS)[:, np.newaxis], vehicles, axis=1)
    share = np.linspace(0.0, 1.0, vehicles)
    ladders = [first + share * (last - first) for first in LADDER for last in LADDER if first != last]
    return np.concatenate([alike, ladders])


def _problem(settings: Settings, possible: Worlds, members: int) -> tuple[ProfileProblem, int]:
    others = fixed_commands(settings.others, possible, "shield", vehicle=None)
    with renumbered(np.repeat(np.arange(possible.n // members), members)):
        problem = profile_problem(
            possible, settings.vehicles, harm_count=settings.harm_count, horizon_s=settings.scenario.horizon_s,
            time_step_s=settings.scenario.time_step_s, others_mps2=others,
        )  # fmt: skip
    return problem, members


def _check_latest(settings: Settings, possible: Worlds, members: int) -> None:
    latest = possible.vehicles.latency_s[:, list(settings.vehicles)].min(axis=1).max()
    if members > 1 and not latest < settings.scenario.horizon_s:
        raise InvalidInput(
            f"uncertainty: {settings.uncertainty}: vehicle_{settings.vehicles[0] + 1} may decide first at {latest:g} s;"
            f" must be before the horizon, {settings.scenario.horizon_s:g} s"
        )


def _baseline(settings: Settings, worlds: Worlds, running: Running) -> Floats:
    """The plans [n, L] or [n, L, K] of the best constant actions found."""
    vehicles, members = settings.vehicles, running.members
    others = np.array(running.problem.command[::members, running.problem.command.shape[1] - worlds.N :])
    others[:, list(vehicles)] = -worlds.vehicles.braking_capacity_mps2[:, list(vehicles)]

    def alone(vehicle: int) -> Floats:
        best = optimise_coupled(
            worlds, vehicle, harm_count=settings.harm_count, horizon_s=settings.scenario.horizon_s, others_mps2=others
        ).deceleration_mps2
        return command_to_action(-best, worlds.vehicles, vehicle)

    if isinstance(settings.vehicle, int):
        return np.repeat(alone(settings.vehicle)[:, np.newaxis], settings.width, axis=1)
    if members > 1:  # a team of one vehicle: no other team is shielded against uncertainty
        return held(alone(vehicles[0])[:, np.newaxis], settings.width)
    braking = np.full((worlds.n, len(vehicles)), -1.0)
    best, least = braking, plan_harm(running, held(braking, settings.width))
    for c, vehicle in enumerate(vehicles):
        action = braking.copy()
        action[:, c] = alone(vehicle)
        best, least = _better(running, best, least, action, settings.width)
    action = best.copy()
    _descend(running, action)
    best, _ = _better(running, best, least, action, settings.width)
    return held(best, settings.width)


def held(action: Floats, width: int) -> Floats:
    """The plans [n, width, K] that hold these actions [n, K]."""
    return np.repeat(action[:, np.newaxis], width, axis=1)


def _better(running: Running, best: Floats, least: Floats, action: Floats, width: int) -> tuple[Floats, Floats]:
    """The actions of less harm, decision by decision; and that harm."""
    harm = plan_harm(running, held(action, width))
    return np.where((harm < least)[:, np.newaxis], action, best), np.minimum(harm, least)


def _descend(running: Running, action: Floats) -> None:
    """Improve constant actions [n, K] in place, one vehicle after the other; of worlds with one member each."""
    problem = running.problem
    assert len(running.states) == len(action)  # the kernel does not look
    descend_constants(
        running.states, running.steps, running.ended, problem.clock, problem.bounds, problem.command, problem.latency,
        problem.mass, problem.limit, no_caps(problem.n), problem.vehicles, GRID, ROUNDS, action,
    )  # fmt: skip


@compiled
def descend_constants(
    states: Floats, steps: Ints, ended: Bools, clock: Floats, bounds: Floats, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, caps: Floats, vehicles: Ints, grid: Floats, rounds: int, action: Floats,
) -> None:  # fmt: skip
    """Replace each vehicle's constant action [n, K] in turn by the best of the grid, by harm in one segment."""
    table, critical = np.zeros((EPISODE_ROWS, mass.shape[1])), np.zeros(1, np.int64)
    lines = np.empty((states.shape[0], rows_of(caps), mass.shape[1]))
    gather(lines, 0, command, latency, mass, limit, caps)
    world = Members(table, clock, bounds, lines, vehicles, critical)
    for k in range(states.shape[0]):
        least = hold_constant(world, k, states[k], ended[k], steps[k], action, k)
        for turn in range(rounds * action.shape[1]):
            c = turn % action.shape[1]
            best = action[k, c]
            for g in range(grid.shape[0]):
                action[k, c] = grid[g]
                value = hold_constant(world, k, states[k], ended[k], steps[k], action, k)
                if value < least:
                    best, least = grid[g], value
            action[k, c] = best
