"""``LinesVecEnv``: the environments of several lines of vehicles as one environment of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.motion.layout import Bools


class LinesVecEnv(VecEnv):
    """The rows of the first environment, then those of the second, and so on."""

    def __init__(self, environments: Sequence[EthBrakeVecEnv]) -> None:
        self.environments, first = environments, environments[0]
        super().__init__(sum(part.num_envs for part in environments), first.observation_space, first.action_space)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Every environment gets this seed, so that trainings keep their worlds."""
        return [row_seed for part in self.environments for row_seed in part.seed(seed)]

    def reset(self) -> Observations:
        return np.concatenate([part.reset() for part in self.environments])

    def step_async(self, actions: Any) -> None:
        ends = np.cumsum([part.num_envs for part in self.environments])
        for part, part_actions in zip(self.environments, np.split(actions, ends[:-1]), strict=True):
            part.step_async(part_actions)

    def step_wait(self) -> tuple[Observations, Any, Bools, list[dict[str, Any]]]:
        observations, rewards, dones, infos = zip(*(part.step_wait() for part in self.environments), strict=True)
        all_infos = [info for part_infos in infos for info in part_infos]
        return np.concatenate(observations), np.concatenate(rewards), np.concatenate(dones), all_infos

    def snapshot(self) -> list[dict[str, Any]]:
        return [part.snapshot() for part in self.environments]

    def restore(self, saved: Sequence[dict[str, Any]]) -> None:
        for part, part_saved in zip(self.environments, saved, strict=True):
            part.restore(part_saved)

    def close(self) -> None:
        for part in self.environments:
            part.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        values = [value for part in self.environments for value in part.get_attr(attr_name)]
        return [values[row] for row in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        for part in self.environments:
            part.set_attr(attr_name, value, indices)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [
            result
            for part in self.environments
            for result in part.env_method(method_name, *args, indices=indices, **kwargs)
        ]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
