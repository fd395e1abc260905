"""Measurement of policies during training, on the fixed list of worlds that the recipe's key ``evaluation`` defines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import AgentFailed, PhysicsError
from ethbrake_marl.first_edition.agents.driving import Episodes, drive, script_agents
from ethbrake_marl.first_edition.agents.learned import LearnedAgent
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.evaluation.lineup import make_agents
from ethbrake_marl.first_edition.evaluation.statistics import mean
from ethbrake_marl.first_edition.game.objectives import objective_harm
from ethbrake_marl.first_edition.physics.left_out import leaving_out_failed
from ethbrake_marl.first_edition.physics.state import Worlds
from ethbrake_marl.first_edition.policies.teams import Trained
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.first_edition.training.training import Training

AT_HORIZON = "horizon_rate"  # fraction of the fixed list's worlds in which a vehicle still moves at the horizon

CHUNK = 2_500  # number of worlds simulated together, to limit memory; does not change results

Evaluate = Callable[[Any], Mapping[str, float]]  # function that returns the metrics of a ``Policy`` or ``PolicyTeam``

Measure = Callable[[Training], Evaluate]  # function that returns the ``Evaluate`` function of a training


def measure_on_list(training: Training) -> Evaluate:
    """Draw the fixed list of worlds, and return a function that measures policies in these worlds.

    The returned function takes a ``Policy`` or ``PolicyTeam``, and returns the metrics of ``measure_team``.
    """
    names, worlds = training.scenario.vehicle_names, fixed_list(training)

    def measure(trained: Trained) -> dict[str, float]:
        drivers = {names.index(name): LearnedAgent(policy, "policy") for name, policy in trained.drivers.items()}
        return measure_team(training, worlds, Team(drivers, "policy"))

    return measure


def measure_full_braking(training: Training) -> dict[str, float]:
    """Return the metrics (``measure_team``) of learners that brake fully, on the fixed list of worlds."""
    scenario = training.scenario
    braking: Any = make_agents(["full_brake"], scenario)["full_brake"]
    return measure_team(training, fixed_list(training), Team(dict.fromkeys(scenario.learners, braking), "full_brake"))


def fixed_list(training: Training) -> Worlds:
    """Return the worlds, at the alert, of the fixed list on which policies are measured."""
    plan = training.recipe.evaluation
    return training.scenario.sample(plan.worlds, plan.seed).worlds


def measure_team(training: Training, worlds: Worlds, team: Team) -> dict[str, float]:
    """Let a team drive ``worlds``, and return metrics of the team, each a mean over these worlds.

    The metrics are ``first_impact_harm``, ``total_harm``, ``collision_rate`` and ``horizon_rate``, with the same values
    as in ``evaluate``. If a learner has another objective than the harm of the line, the result also has the objective
    of each learner (``objective_vehicle_2`` and so on) and the mean of these objectives (``objective``).
    """
    recipe, scenario = training.recipe, training.scenario
    names, harm_count = scenario.vehicle_names, recipe.reward.harm_count
    objectives = recipe.reward.settled(scenario.objective, scenario.vehicles)[1]
    parts = list(drive_list(worlds, team, scenario))

    def joined(column: Callable[[Episodes], NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([column(part) for part in parts])

    metrics = {
        "first_impact_harm": mean(joined(lambda part: part.ledger.world_harm("first"))).value,
        "total_harm": mean(joined(lambda part: part.ledger.world_harm("total"))).value,
        "collision_rate": float(joined(lambda part: part.ledger.collided).mean()),
        AT_HORIZON: float(joined(lambda part: ~part.at_rest).mean()),
    }
    if objectives:
        harm = joined(lambda part: objective_harm(part.ledger, harm_count, objectives))
        each = {names[i]: mean(harm[:, i]).value for i in scenario.learners}
        metrics[RunDirectory.OBJECTIVE] = sum(each.values()) / len(each)
        metrics |= {f"{RunDirectory.OBJECTIVE}_{name}": value for name, value in each.items()}
    return metrics


def drive_list(worlds: Worlds, team: Team, scenario: Scenario) -> Iterator[Episodes]:
    """Let a team drive worlds from the alert in batches of at most 2,500 worlds, and yield the results of each batch.

    Worlds whose simulation fails are left out. Raises ``PhysicsError`` if the simulation of every world fails.
    """
    scripts = [script.name for script in script_agents(scenario, except_for=team.drivers).values()]
    failed: dict[int, str] = {}
    for first in range(0, worlds.n, CHUNK):
        rows = np.arange(first, min(first + CHUNK, worlds.n))
        with AgentFailed.naming(team.name, scripts):
            episodes, _, lost = leaving_out_failed(lambda some: drive(worlds.take(some), team, scenario), rows)
        failed |= lost
        if episodes is not None:
            yield episodes
    if len(failed) == worlds.n:
        raise PhysicsError(failed)
