"""The shield as a Stable-Baselines3 ``VecEnvWrapper``, for training under the shield. Imports torch."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from ethbrake_marl.first_edition.envs.pettingzoo import SeededInside
from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.first_edition.game.observations import Observations
from ethbrake_marl.first_edition.physics.state import Bools
from ethbrake_marl.first_edition.shields.attach import Attached, Proposing


class ShieldedVecEnv(SeededInside, VecEnvWrapper):
    """The environment of ``make_sb3_vec_env`` behind a shield, by default in mode ``step``.

    Each row of the environment belongs to one learner of one world. The shield decides on all learners of one world
    together. At every step the infos of each row contain ``shield_bound_harm`` and the other ``shield_...`` keys.
    ``reset_infos`` contains the ``shield_...`` keys for the alert. The episode's return in ``infos[row]["episode"]``
    does not include the intervention penalty.

    Args:
        venv: an environment made by ``make_sb3_vec_env``.
        policy: policy that is simulated from the alert on. In worlds where the policy does less harm than E-V2X-BM, the
            policy's harm is the bound. None: the bound is the harm of E-V2X-BM.
        options: keywords of ``ShieldOptions``.

    Raises ``InvalidInput`` if ``venv`` is another kind of environment, and if several vehicles learn and the mode is
    not ``step``.

    >>> import ethbrake_marl.first_edition as eb
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
        """Start an episode in every world; return the observations, [rows, F] float32."""
        self.attached.check_open()
        observation: Observations = self.venv.reset()  # type: ignore[assignment]
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Pass the proposed actions [rows, 1] to the environment; ``step_wait`` then makes the step."""
        self.attached.check_open()
        self.venv.step_async(actions)

    def step_wait(self) -> tuple[Observations, NDArray[np.float32], Bools, list[dict[str, Any]]]:
        """Advance every world by one step; the shield certifies or replaces the actions.

        Returns observations [rows, F], rewards [rows] with the intervention penalty subtracted, whether each episode
        ended [rows], and one dictionary of infos per row.
        """
        self.attached.check_open()
        observation, reward, done, infos = self.venv.step_wait()
        paid = reward - self.attached.penalty().reshape(-1).astype(np.float32)
        return observation, paid, done, infos  # type: ignore[return-value]

    @property
    def reset_infos(self) -> list[dict[str, Any]]:
        """Infos at the start of the running episodes, one dictionary per row."""
        infos: list[dict[str, Any]] = self.unwrapped.reset_infos
        return infos

    @reset_infos.setter
    def reset_infos(self, infos: list[dict[str, Any]]) -> None:
        """Ignore the empty infos that SB3's constructor assigns; the infos of the wrapped environment stay."""

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickling, without ``class_attributes``, which SB3 sets and pickle cannot handle."""
        return {name: value for name, value in self.__dict__.items() if name != "class_attributes"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the pickled state, and set ``class_attributes`` again."""
        self.__dict__.update(state)
        self.class_attributes = dict(inspect.getmembers(self.__class__))

    def close(self) -> None:
        """Remove the shield from the environment, and close the environment."""
        self.attached.close()
        super().close()
