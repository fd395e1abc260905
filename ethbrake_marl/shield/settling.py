"""The test whether a world comes to rest before the horizon, where every bound ends."""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.episode import EPISODE_ROWS, at_rest
from ethbrake_marl.shield.certify import Running, no_caps
from ethbrake_marl.shield.members import Members, follow_plan, gather, rows_of


def plan_rests(running: Running, plan: Floats) -> Bools:
    """Where everything rests at the horizon if the plans are executed from here, in every member, [n]."""
    problem, rests = running.problem, np.empty(running.n, np.bool_)
    rests_after_plans(
        running.states, running.steps, running.ended, problem.clock, problem.bounds, problem.command,
        problem.latency, problem.mass, problem.limit, no_caps(problem.n), problem.vehicles,
        np.ascontiguousarray(plan).reshape(*plan.shape[:2], len(problem.vehicles)), rests,
    )  # fmt: skip
    return rests


@compiled
def rests_after_plans(
    states: Floats, steps: Ints, ended: Bools, clock: Floats, bounds: Floats, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, caps: Floats, vehicles: Ints, plans: Floats, rests: Bools,
) -> None:  # fmt: skip
    """Fill ``rests`` [n]: under the plan every member of the world comes to rest before the horizon, and stays so."""
    N, n = mass.shape[1], steps.shape[0]
    table, critical = np.zeros((EPISODE_ROWS, N)), np.zeros(1, np.int64)
    M = states.shape[0] // max(n, 1)
    lines = np.empty((states.shape[0], rows_of(caps), N))
    gather(lines, 0, command, latency, mass, limit, caps)
    world = Members(table, clock, bounds, lines, vehicles, critical)
    for k in range(n):
        rests[k] = True
        for m in range(k * M, k * M + M):
            follow_plan(world, m, states[m], ended[m], steps[k], plans[k], math.inf)
            rests[k] = rests[k] and at_rest(table)
