"""Training loop of vine and rollout classification: drive without exploration, try other actions, learn."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, Self

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from torch import nn

from ethbrake_marl.episode.state import State
from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.motion.layout import Ints
from ethbrake_marl.training.training import Training


class BranchingModel(BaseAlgorithm):
    """Model of an algorithm that drives all worlds with one deterministic policy. F: features, L: learners."""

    policy: Any  # a torch module

    def __init__(self, training: Training, environment: EthBrakeVecEnv) -> None:
        recipe = training.recipe
        super().__init__(
            nn.Module,  # type: ignore[arg-type]  # only models that explore need a policy of Stable-Baselines3
            environment,
            learning_rate=recipe.learning_rate.at,
            stats_window_size=max(100, environment.num_envs),
            device="cpu",
            support_multi_env=True,
            seed=recipe.seed,
        )
        self.recipe: Any = recipe
        self.rows, self.game, self.learners = environment, environment.game, len(training.learners)
        self.features = training.row.names
        self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self.new_policy()

    @abstractmethod
    def new_policy(self) -> nn.Module:
        """New networks with random weights."""

    @abstractmethod
    def improve(self, observations: Any, states: Any) -> None:
        """Learn from the observations and states that ``collect`` returned."""

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Repeat ``collect`` and ``improve`` for ``total_timesteps`` decisions, with the calls of Stable-Baselines3."""
        total, callback = self._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total:
            callback.on_rollout_start()
            observations, states = self.collect(callback)
            callback.on_rollout_end()
            self._update_current_progress_remaining(self.num_timesteps, total)
            self.improve(observations, states)
        callback.on_training_end()
        return self

    def collect(self, callback: BaseCallback) -> tuple[Any, Any]:
        """Drive all n worlds for ``n_steps`` decisions.

        Returns the observations, [n_steps * n * L, F], and the states, [n_steps * n].
        """
        all_observations, states, all_rows = [], [], np.arange(self.rows.n)
        for _ in range(self.recipe.n_steps):
            observations: Any = self._last_obs
            all_observations.append(observations)
            states.append(self.rows.episode.take(all_rows))
            new_obs, rewards, dones, infos = self.rows.step(self.policy.act(observations)[:, np.newaxis])
            self.num_timesteps += self.n_envs
            ended = [infos[row] for row in np.flatnonzero(dones)]  # only these have statistics
            self._update_info_buffer(ended, dones[dones])
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
            callback.update_locals(locals())
            callback.on_step()
        return np.concatenate(all_observations), State.join(states)

    def dump_logs(self) -> None:
        self.logger.dump(step=self.num_timesteps)

    def drawn_steps(self, count: int) -> Ints:
        holds = np.array(self.recipe.holds, np.int64)
        return np.asarray(holds[torch.randint(len(holds), (count,)).numpy()])
