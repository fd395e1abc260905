"""The current policies drive a fixed list of worlds during training."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.agents.scripts import FULL_BRAKE
from ethbrake_marl.agents.team import CHUNK, Agent, Team, play_to_end
from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.episode.objectives import OBJECTIVES, amounts, objectives_of
from ethbrake_marl.episode.state import State
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training.training import Training

Policies = Mapping[str, Policy]  # learner -> policy, front to rear; learners may share one
Evaluate = Callable[[Policies], Mapping[str, float]]  # returns metrics of policies, by name
PolicyMeasure = Callable[[Training], Evaluate]

OBJECTIVE_METRIC = "objective"  # mean of what the learners minimise, where that is not the harm of the line


def measure_on_list(training: Training) -> Evaluate:
    drive = drive_list(training)
    return lambda policies: drive({name: LearnedAgent(policy) for name, policy in policies.items()})


def drive_list(training: Training) -> Callable[[Mapping[str, Agent]], dict[str, float]]:
    """The function takes agents (learner -> agent). Its metrics are means over the worlds: the columns of all counts of
    harm (``total_harm``), ``collision_rate`` and ``horizon_rate`` (a vehicle still moves at the horizon). If a
    learner's objective is not the harm of the line, there is also each learner's objective (``objective_vehicle_2``),
    and their mean ``objective``.
    """
    plan, count = training.recipe.evaluation, training.recipe.reward.harm_count
    scenario, game = open_game(training.scenario, reward={"harm_count": count})
    worlds = scenario.sample(plan.worlds, plan.seed)
    parts = [worlds.take(slice(first, first + CHUNK)) for first in range(0, plan.worlds, CHUNK)]

    def drive(agents: Mapping[str, Agent]) -> dict[str, float]:
        team = Team("policy", {1 + scenario.vehicle_names.index(name): agent for name, agent in agents.items()})
        return metrics_of(training, State.join([play_to_end(game, part, team) for part in parts]))

    return drive


def full_braking(training: Training) -> dict[str, float]:
    return drive_list(training)(dict.fromkeys(training.learners, FULL_BRAKE))


def metrics_of(training: Training, last: State) -> dict[str, float]:
    """The count that is minimised comes first."""
    reward, scenario = training.recipe.reward, training.scenario
    counts = dict.fromkeys([reward.harm_count, *last.counts])  # what is counted comes first
    metrics = {count.column: exact_mean(last.harm(count)) for count in counts}
    metrics["collision_rate"] = float(last.collided.mean())
    metrics["horizon_rate"] = float(last.moving.mean())
    objectives = objectives_of(reward.objective or scenario.objective, scenario.vehicles)
    if reward.harm > 0.0 and any(objective.kind is not OBJECTIVES["total"] for objective in objectives):
        harm = amounts(objectives, None, last, reward.harm_count)
        learner_harm = {scenario.vehicle_names[body - 1]: exact_mean(harm[:, body - 1]) for body in scenario.learners}
        metrics[OBJECTIVE_METRIC] = sum(learner_harm.values()) / len(learner_harm)
        metrics |= {f"{OBJECTIVE_METRIC}_{name}": value for name, value in learner_harm.items()}
    return metrics


def exact_mean(values: Floats) -> float:
    return math.fsum(values) / len(values)


def deciding(metrics: Mapping[str, float], count: HarmCount) -> float:
    """The lowest value is best. NaN if not measured."""
    return metrics.get(OBJECTIVE_METRIC, metrics.get(count.column, np.nan))
