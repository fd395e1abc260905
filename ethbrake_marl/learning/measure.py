"""Measuring policies while they learn, on a fixed list of worlds that training never sees."""

from __future__ import annotations

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.team import Driver, Team
from ethbrake_marl.evaluation import evaluate, summarise
from ethbrake_marl.learning.loop import Evaluate
from ethbrake_marl.learning.training import Training
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.team import Trained
from ethbrake_marl.scenario import Scenario

METRICS = ("first_impact_harm", "total_harm", "collision_rate")


def measure_on_list(training: Training) -> Evaluate:
    """What measures the learners' policies on the recipe's fixed list: the means that ``evaluate`` gives on it."""
    recipe, scenario = training.recipe, training.scenario
    worlds = scenario.sample(recipe.evaluation.worlds, recipe.evaluation.seed)

    def measure(trained: Trained) -> dict[str, float]:
        row = summarise(evaluate(worlds, {"policy": driver_of(trained, scenario)}, scenario=scenario, aftermath=False))[
            0
        ]
        return {name: getattr(row, name).value for name in METRICS}

    return measure


def driver_of(trained: Trained, scenario: Scenario, name: str = "policy") -> Driver:
    """What drives the scenario's learners by what was trained for them."""
    if isinstance(trained, Policy):
        return LearnedAgent(trained, name)
    numbers = {each: i for i, each in enumerate(scenario.vehicle_names)}
    return Team({numbers[each]: LearnedAgent(policy, name) for each, policy in trained.members.items()}, name)
