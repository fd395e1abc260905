"""Plans in phases: what a vehicle intends to do, phase by phase, and what it has heard of the others' plans.

A plan is PLAN_NUMBERS numbers: the times at which all phases but the first begin (s after the alert; infinite: never),
then the command of each phase (m/s2). All NaN: there is no plan.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.state import State
from ethbrake_marl.motion.forces import capacities
from ethbrake_marl.motion.layout import BRAKING, DRIVING, Bools, Floats

PHASES = 3
CHANGES = slice(0, PHASES - 1)  # places of the times
COMMANDS = slice(PHASES - 1, 2 * PHASES - 1)  # places of the commands
PLAN_NUMBERS = 2 * PHASES - 1
PLANS_KEY = "plans"  # of the plans that a vehicle knows, [n, PLAN_NUMBERS, N + 1], in the memories of what it sees


class PlanMemory(NamedTuple):
    """Memory of an agent that plans. Messages can tell the plan of any agent with this memory (key ``v2x.tells``)."""

    plan: Floats  # [n, PLAN_NUMBERS] in force since its last decision
    begun_s: Floats  # [n] when it began to brake (s after the alert); infinite: not yet


def no_plans(state: State) -> Floats:
    """Plans of bodies that have none, [n, PLAN_NUMBERS, N + 1]."""
    return np.full((state.n, PLAN_NUMBERS, state.vehicles + 1), np.nan)


def are_plans(plan: Floats) -> Bools:
    """Whether each row of ``plan`` is a plan, or only NaN, [n]."""
    if plan.shape[1:] != (PLAN_NUMBERS,) or plan.dtype.kind not in "fiu":
        return np.zeros(len(plan), np.bool_)
    times, commands = plan[:, CHANGES], plan[:, COMMANDS]
    in_order = (times > -np.inf).all(axis=1) & (times[:, 1:] >= times[:, :-1]).all(axis=1)
    return np.asarray((in_order & np.isfinite(commands).all(axis=1)) | np.isnan(plan).all(axis=1))


def plans_of(state: State) -> Floats:
    """Plans of all bodies, [n, PLAN_NUMBERS, N + 1], with commands within their capacities."""
    plans = no_plans(state)
    for body, memory in state.memories.items():
        if isinstance(memory, PlanMemory):
            plans[:, :, body] = memory.plan
    least, most = -capacities(state.car, BRAKING), capacities(state.car, DRIVING)
    plans[:, COMMANDS] = np.clip(plans[:, COMMANDS], least[:, np.newaxis], most[:, np.newaxis])
    return plans
