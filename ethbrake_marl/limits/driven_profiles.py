"""Episodes that agents drive, as profiles: what one does better than the best known becomes the best known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.recorded import record_commands
from ethbrake_marl.errors import check_one_learner
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.limits.best_harm import scripted_commands, world_identity
from ethbrake_marl.limits.best_harm_table import BestHarmTable
from ethbrake_marl.physics import Floats, Ints, Worlds, leaving_out_failed
from ethbrake_marl.scenario import Scenario, Task
from ethbrake_marl.search.problem import profile_problem
from ethbrake_marl.search.profiles import Profiles, follow_profiles

LOWERED = "lowered_by"  # key of a table's header: agent -> count -> in how many worlds it did less harm


def fold_agent(
    table: BestHarmTable, scenario: Scenario, worlds: Worlds, name: str, agents: Mapping[HarmCount, Agent]
) -> BestHarmTable:
    """The table with the episodes of ``agents`` in it where they do less harm; its header says in how many worlds.

    ``agents``: for each count, ``name`` made to minimise it. Each drives the scenario's learner through ``worlds`` (at
    t = 0; those that are known to end without harm are left out), and either count takes from either episode. Harms are
    those of the profiles, driven again. Where an agent cannot drive a world to its end, the table stays as it is.
    Raises ``InvalidInput`` if the scenario has not exactly one learner.
    """
    learners = [scenario.vehicle_names[i] for i in scenario.learners]
    check_one_learner(scenario.name, learners, "agents whose episodes are kept drive exactly one")
    task = Task(scenario, scenario.learners)
    identity = world_identity(worlds, task)
    known = np.max([table.harm(identity, harm_count) for harm_count in table.best], axis=0)
    hard = np.flatnonzero(known > 0.0)
    lowered = dict.fromkeys(table.best, 0)
    if hard.size:
        worlds, identity = worlds.take(hard), identity[hard]
        problem = profile_problem(
            worlds,
            task.vehicles,
            horizon_s=scenario.horizon_s,
            time_step_s=scenario.time_step_s,
            others_mps2=scripted_commands(worlds, task),
        )
        for agent in agents.values():
            work = partial(_driven_in, agent, worlds, task, problem.last_step)
            profiles, rows, _ = leaving_out_failed(work, np.arange(worlds.n))
            if profiles is None:
                continue
            first, total = follow_profiles(problem.take(rows), profiles)
            for harm_count in table.best:
                table, better = table.improved(
                    identity[rows], harm_count, first if harm_count == "first" else total, profiles
                )
                lowered[harm_count] += int(better.sum())
    before = table.header.get(LOWERED, {})
    return replace(table, header={**table.header, LOWERED: {**before, name: lowered}})


def _driven_in(agent: Agent, every: Worlds, task: Task, last_step: Ints, rows: Ints) -> Profiles:
    return driven_profiles(agent, every.take(rows), task, last_step[rows])


def driven_profiles(agent: Agent, worlds: Worlds, task: Task, last_step: Ints) -> Profiles:
    """What ``agent`` commands the vehicle in every step of its episodes, as profiles; equal neighbours are joined."""
    commands = record_commands(agent, worlds, task.scenario, task.vehicle, int(last_step.max()))
    return _joined(commands, last_step)


def _joined(commands_mps2: Floats, last_step: Ints) -> Profiles:
    """Step by step commands [n, steps] as profiles with one phase per change."""
    steps = commands_mps2.shape[1]
    ends = [np.append(np.flatnonzero(row[1:] != row[:-1]) + 1, steps) for row in commands_mps2]
    width = max(len(each) for each in ends)
    padded = np.array([np.append(each, np.full(width - len(each), steps)) for each in ends])
    chosen = np.take_along_axis(commands_mps2, padded - 1, axis=1)
    return Profiles(np.minimum(padded, last_step[:, np.newaxis]), chosen[:, :, np.newaxis])
