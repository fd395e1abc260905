"""The shield as a Gymnasium vector wrapper."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import VectorWrapper
from numpy.typing import NDArray

from ethbrake_marl.actions import checked_action
from ethbrake_marl.agents.learned import LearnedPolicy
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.envs.vector import EthBrakeVectorEnv
from ethbrake_marl.observations import Observations
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.shield.engine_episode import attach
from ethbrake_marl.shield.options import read_options
from ethbrake_marl.shield.settings import engine_of


class ShieldedVectorEnv(VectorWrapper):
    """``EthBrakeVectorEnv`` behind a shield, by default in mode ``step``: each row's action is certified, or replaced.

    The ``options`` are those of ``ShieldOptions``.

    ``infos["shield"]`` tells the step that was made, also of rows whose episode ended with it: one array per key,
    marked by ``infos["_shield"]`` (rows that the autoreset mode spends on a reset are not). Raises ``InvalidInput`` for
    another environment.
    """

    def __init__(
        self,
        env: EthBrakeVectorEnv,
        policy: Agent | LearnedPolicy | None = None,
        **options: Any,
    ) -> None:
        settings = read_options("ShieldedVectorEnv", options)
        engine = engine_of(env, EthBrakeVectorEnv, "ShieldedVectorEnv", "gymnasium.make_vec('EthBrake-v0')")
        self.attached = attach(engine, policy, settings)
        super().__init__(env)

    def step(self, actions: NDArray[Any]) -> tuple[Observations, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every world by one time step with the actions [rows, 1] certified or replaced."""
        attached = self.attached
        if not attached.running:
            return self.env.step(actions)  # says that no episode is running
        before = attached.engine.ended
        given = np.array(actions)
        if before.any() and given.shape[:1] == before.shape:
            given[before] = 0.0  # whatever stands there, the autoreset mode ignores it
        proposed = checked_action(given, (self.num_envs, 1), "the learners")[:, 0]
        applied = attached.decide(proposed)
        observation, reward, terminated, truncated, infos = self.env.step(applied[:, np.newaxis])
        attached.confirm()
        told = attached.infos(proposed)
        infos |= {"shield": told, "_shield": ~before}
        paid = reward - attached.options.intervention_penalty * (told["intervened"] & ~before)
        return observation, paid, terminated, truncated, infos

    def close(self, **kwargs: Any) -> None:
        """Let go of the environment, and close it."""
        self.attached.detach()
        super().close(**kwargs)
