"""Independent learners: one PPO each, with a network, an optimiser and a buffer of its own, in the same worlds.

A row of the environment ends with its learner's number (``make_sb3_vec_env(..., appended="number")``). Rollouts are
collected for all of them together; then each learns from its own part, by Stable-Baselines3's own ``PPO.train``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from gymnasium.spaces import Box, Space
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn


class SeparatePolicies(BasePolicy):
    """An actor, a critic and an optimiser for each learner; a row's last number says which of them sees the row.

    Of the rest of it, it sees its own ``columns``. ``resting`` learners do not explore: they act by their mean.
    """

    def __init__(
        self,
        observation_space: Space[Any],
        action_space: Any,
        lr_schedule: Schedule,
        use_sde: bool = False,
        *,
        columns: Sequence[Sequence[int]],
        **network: Any,
    ) -> None:
        super().__init__(observation_space, action_space)
        assert isinstance(observation_space, Box)
        low, high, kind = observation_space.low, observation_space.high, observation_space.dtype.type
        own = [Box(low[list(each)], high[list(each)], dtype=kind) for each in columns]
        self.columns = columns
        self.members = nn.ModuleList(
            ActorCriticPolicy(space, action_space, lr_schedule, use_sde=use_sde, **network) for space in own
        )
        self.resting: frozenset[int] = frozenset()

    @property
    def log_std(self) -> Tensor:
        """Exploration noise of all learners, one after the other."""
        return torch.cat([member.log_std for member in self.policies])

    @property
    def policies(self) -> list[ActorCriticPolicy]:
        """The learners' policies, front to rear."""
        return [member for member in self.members if isinstance(member, ActorCriticPolicy)]

    def forward(self, observation: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Actions [n, 1], values [n, 1] and log-probabilities [n] of rows [n, F + 1]."""
        count = len(observation)
        actions, values, likelihood = torch.empty(count, 1), torch.empty(count, 1), torch.empty(count)
        for number, policy, rows in self._by_learner(observation):
            still = deterministic or number in self.resting
            actions[rows], values[rows], likelihood[rows] = policy(observation[rows][:, self.columns[number]], still)
        return actions, values, likelihood

    def predict_values(self, observation: Any) -> Tensor:
        """Values [n, 1] of rows [n, F + 1]."""
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
    """A PPO for each of the ``names`` (learners, front to rear), all at once, or in ``turns``: N rounds, one by one.

    In a turn the others drive by their means and do not learn; the turns divide the training's updates evenly. What
    is logged of the learning of ``vehicle_2`` is called ``vehicle_2/loss`` and so on.
    """

    policy: SeparatePolicies  # type: ignore[assignment]  # of an actor-critic it has what PPO asks for

    def __init__(
        self, env: VecEnv, names: Sequence[str], turns: int | None, columns: Sequence[Sequence[int]], **settings: Any
    ) -> None:
        self.names, self.turns = tuple(names), turns
        arguments = {**settings.pop("policy_kwargs"), "columns": columns}
        super().__init__(SeparatePolicies, env, policy_kwargs=arguments, **settings)  # type: ignore[arg-type]
        self._learning: tuple[int, ...] = ()

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Collect as PPO does, those whose turn it is not without exploration."""
        everyone = range(len(self.names))
        self._learning = tuple(everyone) if self.turns is None else (self._whose_turn(self.turns),)
        self.policy.resting = frozenset(everyone) - frozenset(self._learning)
        return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)

    def train(self) -> None:
        """Let each learner whose turn it is learn from its own rows, with its own optimiser."""
        joint, buffer, log, updates = self.policy, self.rollout_buffer, self._logger, self._n_updates
        parts = {number: self._part(buffer, number) for number in self._learning}
        try:
            for number, part in parts.items():
                self.policy, self.rollout_buffer = joint.policies[number], part  # type: ignore[assignment]
                self._logger, self._n_updates = Logger(None, []), updates
                super().train()
                for name, value in self._logger.name_to_value.items():
                    excluded = self._logger.name_to_excluded[name]
                    log.record(name.replace("train", self.names[number], 1), value, excluded)
        finally:
            self.policy, self.rollout_buffer, self._logger = joint, buffer, log

    def _whose_turn(self, turns: int) -> int:
        """The learner of the update that begins; a function of the steps done, so a resumed training asks nothing."""
        rollout = self.n_envs * self.n_steps
        planned = -(-self._total_timesteps // rollout)
        stretch = self.num_timesteps // rollout * turns * len(self.names) // planned
        return stretch % len(self.names)

    def _part(self, buffer: RolloutBuffer, number: int) -> RolloutBuffer:
        """What one learner has lived through, in a buffer of its own."""
        own = self.policy.policies[number].observation_space
        count = len(self.names)
        part = RolloutBuffer(
            buffer.buffer_size,
            own,
            self.action_space,
            self.device,
            gae_lambda=self.gae_lambda,
            gamma=self.gamma,
            n_envs=self.n_envs // count,
        )
        for name in ("actions", "rewards", "episode_starts", "values", "log_probs", "returns", "advantages"):
            setattr(part, name, getattr(buffer, name)[:, number::count].copy())
        part.observations = buffer.observations[:, number::count][:, :, self.policy.columns[number]]
        part.pos, part.full = buffer.buffer_size, True
        return part
