"""The shield as a Stable-Baselines3 ``VecEnvWrapper``: training under the shield. Importing this file imports torch."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from ethbrake_marl.envs.pettingzoo import SeededInside
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.game.observations import Observations
from ethbrake_marl.physics.state import Bools
from ethbrake_marl.shield.attach import Attached, Proposing


class ShieldedVecEnv(SeededInside, VecEnvWrapper):
    """``make_sb3_vec_env`` behind a shield, by default in mode ``step``, in which the rows of a world decide together.

    The ``options`` are those of ``ShieldOptions``; the penalty is not taken off the return in
    ``infos[row]["episode"]``. Without a ``policy`` the bound is the coupled optimum's harm. Each row's infos hold
    ``shield_bound_harm`` and its like in every step, and ``reset_infos`` those of the alert. Raises ``InvalidInput``
    for another environment, or several learners in another mode.

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> env = eb.ShieldedVecEnv(eb.make_sb3_vec_env("paper-random", 4, seed=7))
    >>> observations = env.reset()
    >>> observations, rewards, dones, infos = env.step(np.full((4, 1), 1.0))
    >>> [info["shield_intervened"] for info in infos]
    [True, True, True, True]

    """

    def __init__(self, venv: EthBrakeVecEnv, policy: Proposing | None = None, **options: Any) -> None:
        self.attached = Attached(venv, VecEnv, "make_sb3_vec_env", policy, "ShieldedVecEnv", options)
        super().__init__(venv)

    def reset(self) -> Observations:
        """As the environment's own reset."""
        self.attached.check_open()
        observation: Observations = self.venv.reset()  # type: ignore[assignment]
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Pass the actions [rows, 1] on."""
        self.attached.check_open()
        self.venv.step_async(actions)

    def step_wait(self) -> tuple[Observations, NDArray[np.float32], Bools, list[dict[str, Any]]]:
        """Advance every world by one step with the actions certified or replaced."""
        self.attached.check_open()
        observation, reward, done, infos = self.venv.step_wait()
        paid = reward - self.attached.penalty().reshape(-1).astype(np.float32)
        return observation, paid, done, infos  # type: ignore[return-value]

    @property
    def reset_infos(self) -> list[dict[str, Any]]:
        """The infos with which the running episodes began, row by row; wrappers inside keep none of their own."""
        infos: list[dict[str, Any]] = self.unwrapped.reset_infos
        return infos

    @reset_infos.setter
    def reset_infos(self, infos: list[dict[str, Any]]) -> None:
        """Nothing: SB3's constructor assigns empty ones."""

    def __getstate__(self) -> dict[str, Any]:
        """State for a copy, without the table of the class that SB3 keeps in every wrapper and nobody can pickle."""
        return {name: value for name, value in self.__dict__.items() if name != "class_attributes"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Become that copy."""
        self.__dict__.update(state)
        self.class_attributes = dict(inspect.getmembers(self.__class__))

    def close(self) -> None:
        """Take the shield off the environment, and close that."""
        self.attached.close()
        super().close()
