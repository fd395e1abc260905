"""Records the range of what policies observe in worlds of their training."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.agents.team import Team, play
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.policies.training_range import TrainingRange
from ethbrake_marl.training.fixed_list import Policies
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.open_game import AnyScenario

MOST_WORLDS = 1_000  # of the fixed list that are driven


def with_ranges(policies: Policies, training: Training) -> Policies:
    listed = training.recipe.evaluation
    return record_ranges(policies, training.scenario, min(listed.worlds, MOST_WORLDS), listed.seed) if policies else {}


def record_ranges(policies: Policies, scenario: AnyScenario, worlds: int, seed: int) -> Policies:
    """Learners that share a policy share its range."""
    observed: dict[int, list[Observations]] = {id(policy): [] for policy in policies.values()}
    loaded, game = open_game(scenario, reward="first-impact-harm")  # not used, but defined in every physics
    driven = {body: policies[loaded.vehicle_names[body - 1]] for body in loaded.learners}
    drivers = {body: LearnedAgent(policy) for body, policy in driven.items()}
    for _, state in play(game, loaded.sample(worlds, seed), Team("policy", drivers)):
        running = state.take(~state.ended)
        for body, agent in game.agents(drivers).items():
            observed[id(driven[body])].append(agent.observe(driven[body].observation, running, body))
    ranges = {key: TrainingRange.of(np.concatenate(parts)) for key, parts in observed.items()}
    ranged = {id(policy): policy.with_range(ranges[id(policy)]) for policy in policies.values()}
    return {name: ranged[id(policy)] for name, policy in policies.items()}
