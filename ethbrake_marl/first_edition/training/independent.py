"""Independent learners: one PPO per learner, with its own network and optimiser; all learners drive in the same worlds.

The last entry of an observation row is the number of the learner that observes the row, 0 = foremost
(``make_sb3_vec_env(..., appended="number")``). Rollouts are collected for all learners together. From these rollouts,
each learner learns from the observation rows that have the learner's number, with Stable-Baselines3's ``PPO.train``.
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
    """One actor-critic policy and one optimiser for each learner, together with the interface of a single policy.

    Learners whose numbers are in ``resting`` do not explore: they take the mean action. ``columns`` has, for each
    learner, front to rear, the columns of an observation row that the learner observes. ``network`` has further keyword
    arguments of Stable-Baselines3's ``ActorCriticPolicy``, for each learner's policy; the other arguments are the same
    as there.
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
        """Logarithm of the exploration noise of each learner, front to rear, [number of learners]."""
        return torch.cat([member.log_std for member in self.policies])

    @property
    def policies(self) -> list[ActorCriticPolicy]:
        """Policies of the learners, front to rear."""
        return [member for member in self.members if isinstance(member, ActorCriticPolicy)]

    def forward(self, observation: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions [n, 1], values [n, 1] and log-probabilities [n] for n observation rows, [n, F + 1].

        With ``deterministic``, all learners take the mean action instead of exploring.
        """
        count = len(observation)
        actions, values, likelihood = torch.empty(count, 1), torch.empty(count, 1), torch.empty(count)
        for number, policy, rows in self._by_learner(observation):
            still = deterministic or number in self.resting
            actions[rows], values[rows], likelihood[rows] = policy(observation[rows][:, self.columns[number]], still)
        return actions, values, likelihood

    def predict_values(self, observation: Any) -> Tensor:
        """Return the critics' values [n, 1] for n observation rows, [n, F + 1]."""
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
    """PPO with a separate policy for each learner.

    If ``turns`` is None, all learners learn in every update. If ``turns`` is a number, each learner has this number of
    turns: only one learner learns at a time, and the other learners take their mean actions. The learner that learns
    changes from turn to turn, and all turns have about the same number of updates. The columns of the log have names
    such as ``vehicle_2/loss``.

    ``names`` are the names of the learners, front to rear. For ``columns``, see ``SeparatePolicies``. ``settings`` has
    further keyword arguments of Stable-Baselines3's ``PPO``.
    """

    policy: SeparatePolicies  # type: ignore[assignment]  # has the parts of an actor-critic policy that PPO uses

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
        """Collect rollouts as PPO does; only learners that learn in the next update explore.

        The arguments and the result are the same as in Stable-Baselines3's ``PPO.collect_rollouts``.
        """
        everyone = range(len(self.names))
        self._learning = tuple(everyone) if self.turns is None else (self._whose_turn(self.turns),)
        self.policy.resting = frozenset(everyone) - frozenset(self._learning)
        return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)

    def train(self) -> None:
        """Update each learner whose turn it is with ``PPO.train``, from its own data and with its own optimiser."""
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
        """Return the number of the learner that learns in the next update.

        The result depends only on the number of decisions so far, so a resumed training run has the same turns.
        """
        rollout = self.n_envs * self.n_steps
        planned = -(-self._total_timesteps // rollout)
        stretch = self.num_timesteps // rollout * turns * len(self.names) // planned
        return stretch % len(self.names)

    def _part(self, buffer: RolloutBuffer, number: int) -> RolloutBuffer:
        """Return a new rollout buffer with the data of learner ``number``."""
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
