"""The shield as a Gymnasium wrapper."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from ethbrake_marl.actions import checked_action
from ethbrake_marl.agents.learned import LearnedPolicy
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.observations import Observations
from ethbrake_marl.shield.engine_episode import attach
from ethbrake_marl.shield.options import read_options
from ethbrake_marl.shield.settings import engine_of


class ShieldedEnv(gymnasium.Wrapper[Observations, NDArray[Any], Observations, NDArray[Any]], RecordConstructorArgs):
    """``EthBrake-v0`` behind a shield, by default in mode ``step``: each action is certified, or replaced.

    The ``options`` are those of ``ShieldOptions``. ``info["shield"]`` says what was done. ``policy`` (in mode ``step``
    and ``robust`` it may be None) is rolled out at each alert: where it harms no more than the coupled optimum, its
    harm is the bound.
    """

    def __init__(
        self,
        env: gymnasium.Env[Observations, NDArray[Any]],
        policy: Agent | LearnedPolicy | None = None,
        **options: Any,
    ) -> None:
        RecordConstructorArgs.__init__(self, policy=policy, **options)
        settings = read_options("ShieldedEnv", options)
        engine = engine_of(env, gymnasium.Env, "ShieldedEnv", "gymnasium.make('EthBrake-v0')")
        self.attached = attach(engine, policy, settings)
        super().__init__(env)

    def step(self, action: NDArray[Any]) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Advance by one step with the action certified or replaced."""
        shield = self.attached
        if not shield.running or shield.engine.ended[0]:
            return self.env.step(action)  # type: ignore[return-value]  # says what is wrong
        proposed = checked_action(action, (1,), shield.engine.scenario.vehicle_names[shield.vehicle])
        observation, reward, terminated, truncated, info = self.env.step(shield.decide(proposed))
        shield.confirm()
        told = info["shield"] = shield.info(0, float(proposed[0]))
        paid = float(reward) - shield.options.intervention_penalty * float(told["intervened"])
        return observation, paid, terminated, truncated, info

    def close(self) -> None:
        """Let go of the environment, and close it."""
        self.attached.detach()
        super().close()
