"""The policies of a BenchMARL experiment as agents of this package."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ethbrake_marl.agents.policy_agent import PolicyAgent, policy_agent
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.reward import reward_params
from ethbrake_marl.extensions.benchmarl.task import GROUP


def drivers_of(experiment: Any) -> dict[str, PolicyAgent]:
    """Agents with the deterministic policies of a BenchMARL experiment, vehicle -> agent, for ``eb.evaluate``.

    Every vehicle decides from its own observation alone. Raises ``InvalidInput`` if the experiment's discount is too
    large for the shaping of the task's reward.
    """
    reward_params(experiment.task.config.get("reward", "shaped")).check_gamma(experiment.config.gamma, "config.gamma")
    task, actor = experiment.task, experiment.group_policies[GROUP]
    learners, actions = task.group_map(None)[GROUP], task.config.get("actions")

    def act(number: int, observations: Observations) -> Any:
        rows = torch.from_numpy(observations)[:, None].expand(-1, len(learners), -1)  # [n, L, F]
        group = TensorDict({"observation": rows}, rows.shape[:2])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return actor(TensorDict({GROUP: group}, rows.shape[:1]))[GROUP, "action"][:, number]

    settings = {"name": experiment.algorithm_name, "scenario": task.scenario, "clip": True, "actions": actions}
    return {vehicle: policy_agent(partial(act, number), **settings) for number, vehicle in enumerate(learners)}
