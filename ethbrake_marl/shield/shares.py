"""Each vehicle's share under a plan: the harm of its pairs, split by mass as in the ledger, to the same bits."""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.episode import EPISODE_ROWS, HARM_IS_TOTAL
from ethbrake_marl.shield.certify import Running, no_caps
from ethbrake_marl.shield.members import Members, borne_by, follow_plan, gather, rows_of


def borne_under(running: Running, plan: Floats) -> Floats:
    """Harm of the whole episode that each vehicle bears if the plans are executed from here, [n * M, N] m2/s2.

    With an obstacle ahead its column comes first, and is 0.
    """
    problem = running.problem
    borne = np.empty(problem.mass.shape)
    borne_under_plans(
        running.states, running.steps, running.ended, problem.clock, problem.bounds, problem.command,
        problem.latency, problem.mass, problem.limit, no_caps(problem.n), problem.vehicles,
        np.ascontiguousarray(plan).reshape(*plan.shape[:2], len(problem.vehicles)), borne,
    )  # fmt: skip
    return borne


def keeps_caps(running: Running, plan: Floats) -> Bools:
    """Where no vehicle bears more than it may if the plans are executed from here, [n]; everywhere without caps."""
    if not running.caps.size:
        return np.ones(running.n, np.bool_)
    within = (borne_under(running, plan) <= running.caps).all(axis=1)
    return np.asarray(within.reshape(running.n, -1).all(axis=1), np.bool_)


@compiled
def borne_under_plans(
    states: Floats, steps: Ints, ended: Bools, clock: Floats, bounds: Floats, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, caps: Floats, vehicles: Ints, plans: Floats, borne: Floats,
) -> None:  # fmt: skip
    """Fill ``borne`` [n * M, N]."""
    N, n = mass.shape[1], steps.shape[0]
    table, critical = np.zeros((EPISODE_ROWS, N)), np.zeros(1, np.int64)
    M = states.shape[0] // max(n, 1)
    lines = np.empty((states.shape[0], rows_of(caps), N))
    gather(lines, 0, command, latency, mass, limit, caps)
    world = Members(table, clock, bounds, lines, vehicles, critical)
    for k in range(n):
        for m in range(k * M, k * M + M):
            follow_plan(world, m, states[m], ended[m], steps[k], plans[k], math.inf)
            for i in range(N):
                borne[m, i] = borne_by(table, clock[m, HARM_IS_TOTAL], i)
