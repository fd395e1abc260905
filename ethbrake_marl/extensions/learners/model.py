"""Training loop of vine and rollout classification: drive without exploration, try other actions, learn."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from torch import nn

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.motion.layout import Ints
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.training.fixed_list import braking_cost
from ethbrake_marl.training.lines import LinesVecEnv
from ethbrake_marl.training.training import Training


class Line(NamedTuple):
    """One line of vehicles of a training: that of its scenario, or one of a mixture of lines."""

    environment: EthBrakeVecEnv
    tried: int  # decisions per update at which other actions are tried
    cost: float  # returns are divided by it: 1, or in a mixture of lines the cost of full braking

    @property
    def game(self) -> Game:
        return self.environment.game

    @property
    def learners(self) -> int:
        return len(self.environment.bodies)


class Visited(NamedTuple):
    """Decisions of L learners in D visited states of a line."""

    line: Line
    observations: Float32s  # [D * L, F]
    states: State  # [D]


class BranchingModel(BaseAlgorithm):
    """Model of an algorithm that drives all worlds with one deterministic policy. F: features, L: learners."""

    policy: Any  # a torch module

    def __init__(self, training: Training, environment: EthBrakeVecEnv | LinesVecEnv) -> None:
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
        self.rows, self.features = environment, training.row.names
        self.lines = lines_of(training, environment)
        self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self.new_policy()

    @abstractmethod
    def new_policy(self) -> nn.Module:
        """New networks with random weights."""

    @abstractmethod
    def improve(self, visited: Any) -> None:
        """Learn from the decisions that ``collect`` returned."""

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
            visited = self.collect(callback)
            callback.on_rollout_end()
            self._update_current_progress_remaining(self.num_timesteps, total)
            self.improve(visited)
        callback.on_training_end()
        return self

    def collect(self, callback: BaseCallback) -> Any:
        """Drive all worlds for ``n_steps`` decisions; return the decisions of every line, as ``[Visited, ...]``."""
        all_observations: list[Any] = []
        states: list[list[State]] = [[] for _ in self.lines]
        for _ in range(self.recipe.n_steps):
            observations: Any = self._last_obs
            all_observations.append(observations)
            for line, line_states in zip(self.lines, states, strict=True):
                line_states.append(line.environment.episode.take(np.arange(line.environment.n)))
            new_obs, rewards, dones, infos = self.rows.step(self.policy.act(observations)[:, np.newaxis])
            self.num_timesteps += self.n_envs
            ended = [infos[row] for row in np.flatnonzero(dones)]  # only these have statistics
            self._update_info_buffer(ended, dones[dones])
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
            callback.update_locals(locals())
            callback.on_step()
        visited, first = [], 0
        for line, line_states in zip(self.lines, states, strict=True):
            rows = slice(first, first + line.environment.num_envs)
            line_observations = np.concatenate([observations[rows] for observations in all_observations])
            visited.append(Visited(line, line_observations, State.join(line_states)))
            first = rows.stop
        return visited

    def dump_logs(self) -> None:
        self.logger.dump(step=self.num_timesteps)

    def drawn_steps(self, count: int) -> Ints:
        holds = np.array(self.recipe.holds, np.int64)
        return np.asarray(holds[torch.randint(len(holds), (count,)).numpy()])


def lines_of(training: Training, environment: EthBrakeVecEnv | LinesVecEnv) -> list[Line]:
    tried: int = vars(training.recipe)["tried"]
    if isinstance(environment, EthBrakeVecEnv):
        return [Line(environment, tried, 1.0)]
    pairs = zip(environment.environments, training.lines, strict=True)
    return [
        Line(part, max(round(tried * part.n / training.recipe.n_envs), 1), braking_cost(line)) for part, line in pairs
    ]
