"""PPO with several learners: a policy for each (independent), or one policy with a critic that sees the whole line.

Independent learners drive in the same worlds. Each learns from its own rows, by Stable-Baselines3's ``PPO.train``. The
last entry of an observation is the number of the learner, from 0 (``appended="number"``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from gymnasium.spaces import Box
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import Tensor, nn

from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.training.training import Training


class CentralCriticPolicy(ActorCriticPolicy):
    def __init__(self, *arguments: Any, actor_size: int, **settings: Any) -> None:
        self.actor_size = actor_size  # set before ``super().__init__``, which builds the networks
        super().__init__(*arguments, **settings)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = _CentralCriticExtractor(
            self.actor_size, self.features_dim, self.net_arch, self.activation_fn
        )


class _CentralCriticExtractor(MlpExtractor):
    """The actor sees the first ``actor_size`` entries of an observation, the critic all."""

    def __init__(self, actor_size: int, critic_size: int, net_arch: Any, activation_fn: Any) -> None:
        super().__init__(actor_size, net_arch, activation_fn, device="cpu")
        self.value_net = MlpExtractor(critic_size, net_arch, activation_fn, device="cpu").value_net
        self.actor_size = actor_size

    def forward_actor(self, features: Tensor) -> Tensor:
        return super().forward_actor(features[:, : self.actor_size])


class SeparatePolicies(BasePolicy):
    """``columns``: for each learner, the columns of an observation that it sees. ``network``: further arguments of
    Stable-Baselines3's ``ActorCriticPolicy``.
    """

    def __init__(
        self,
        observation_space: Any,
        action_space: Any,
        lr_schedule: Any,
        use_sde: bool = False,
        *,
        columns: Sequence[Sequence[int]],
        **network: Any,
    ) -> None:
        super().__init__(observation_space, action_space)
        low, high, kind = observation_space.low, observation_space.high, observation_space.dtype.type
        spaces = [Box(low[list(indices)], high[list(indices)], dtype=kind) for indices in columns]
        self.columns = columns
        self.members = nn.ModuleList(
            ActorCriticPolicy(space, action_space, lr_schedule, use_sde=use_sde, **network) for space in spaces
        )

    @property
    def log_std(self) -> Tensor:
        """One for each learner, [L]."""
        return torch.cat([member.log_std for member in self.policies])

    @property
    def policies(self) -> list[ActorCriticPolicy]:
        return [member for member in self.members if isinstance(member, ActorCriticPolicy)]

    def forward(self, observation: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Actions [n, 1], values [n, 1] and log-probabilities [n] for observations [n, F + 1].

        The last column of an observation is the learner's number in its world, from 0.
        """
        count = len(observation)
        actions, values, likelihood = torch.empty(count, 1), torch.empty(count, 1), torch.empty(count)
        for number, policy, rows in self._by_learner(observation):
            part = observation[rows][:, self.columns[number]]
            actions[rows], values[rows], likelihood[rows] = policy(part, deterministic)
        return actions, values, likelihood

    def predict_values(self, observation: Any) -> Tensor:
        """As in ``forward``."""
        values = torch.empty(len(observation), 1)
        for number, policy, rows in self._by_learner(observation):
            values[rows] = policy.predict_values(observation[rows][:, self.columns[number]])
        return values

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        return self.forward(observation, deterministic)[0]

    def _by_learner(self, observation: Tensor) -> Iterator[tuple[int, ActorCriticPolicy, Tensor]]:
        numbers = observation[:, -1]
        for number, policy in enumerate(self.policies):
            rows = (numbers == number).nonzero()[:, 0]
            if len(rows):
                yield number, policy, rows


class IndependentPPO(PPO):
    policy: SeparatePolicies  # type: ignore[assignment]  # has the parts of an actor-critic policy that PPO uses

    def __init__(
        self, environment: EthBrakeVecEnv, training: Training, policy_kwargs: dict[str, Any], **settings: Any
    ) -> None:
        self.names = training.learners
        network = {**policy_kwargs, "columns": training.columns}
        super().__init__(SeparatePolicies, environment, policy_kwargs=network, **settings)  # type: ignore[arg-type]

    def train(self) -> None:
        joint, buffer, log, updates = self.policy, self.rollout_buffer, self._logger, self._n_updates
        parts = [self._part(buffer, number) for number in range(len(self.names))]
        try:
            for name, policy, part in zip(self.names, joint.policies, parts, strict=True):
                self.policy, self.rollout_buffer = policy, part  # type: ignore[assignment]
                self._logger, self._n_updates = Logger(None, []), updates
                super().train()
                for key, value in self._logger.name_to_value.items():
                    log.record(key.replace("train", name, 1), value, self._logger.name_to_excluded[key])
        finally:
            self.policy, self.rollout_buffer, self._logger = joint, buffer, log

    def _part(self, buffer: RolloutBuffer, number: int) -> RolloutBuffer:
        space, count = self.policy.policies[number].observation_space, len(self.names)
        part = RolloutBuffer(
            buffer.buffer_size, space, self.action_space, self.device, self.gae_lambda, self.gamma, self.n_envs // count
        )
        for name in ("actions", "rewards", "episode_starts", "values", "log_probs", "returns", "advantages"):
            setattr(part, name, getattr(buffer, name)[:, number::count].copy())
        part.observations = buffer.observations[:, number::count][:, :, self.policy.columns[number]]
        part.pos, part.full = buffer.buffer_size, True
        return part

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", *(f"policy.members.{k}.optimizer" for k in range(len(self.names)))], []
