"""Measure policies in training on the recipe's fixed list of worlds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.game.objectives import objective_harm
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.teams import Trained
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.training import Training

AT_HORIZON = "horizon_rate"  # share of the fixed list's episodes in which something still moves at the horizon

Evaluate = Callable[[Any], Mapping[str, float]]  # a ``Policy`` or a ``PolicyTeam`` -> metrics

Measure = Callable[[Training], Evaluate]


def measure_on_list(training: Training) -> Evaluate:
    """Draw the recipe's fixed list, and return the function that measures policies on it.

    Metrics are means over the list, as ``evaluate`` gives them. If a learner has another objective than total harm,
    the value of each learner's objective and their mean come after them.
    """
    recipe, scenario = training.recipe, training.scenario
    names = scenario.vehicle_names
    objectives = recipe.reward.settled(scenario.objective, scenario.vehicles)[1]
    worlds = scenario.sample(recipe.evaluation.worlds, recipe.evaluation.seed)

    def measure(trained: Trained) -> dict[str, float]:
        driver: Driver = (
            LearnedAgent(trained, "policy")
            if isinstance(trained, Policy)
            else Team({names.index(name): LearnedAgent(p, "policy") for name, p in trained.drivers.items()}, "policy")
        )
        outcome = evaluate(worlds, {"policy": driver}, scenario=scenario, aftermath=False).outcome("policy")
        metrics = {
            "first_impact_harm": mean(outcome.first_impact_harm).value,
            "total_harm": mean(outcome.total_harm).value,
            "collision_rate": float(outcome.collided.mean()),
            AT_HORIZON: float((~outcome.at_rest).mean()),
        }
        if objectives:
            harm = objective_harm(outcome.ledger, recipe.reward.harm_count, objectives)
            each = {names[i]: mean(harm[:, i]).value for i in scenario.learners}
            metrics[RunDirectory.OBJECTIVE] = sum(each.values()) / len(each)
            metrics |= {f"{RunDirectory.OBJECTIVE}_{name}": value for name, value in each.items()}
        return metrics

    return measure
