"""Step mode as a Gymnasium wrapper."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from ethbrake_marl.actions import checked_action
from ethbrake_marl.agents.learned import LearnedPolicy
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.observations import Observations
from ethbrake_marl.shield.engine_shield import AttachedShield
from ethbrake_marl.shield.settings import check_amount, engine_of
from ethbrake_marl.shield.uncertainty import Uncertainty


class ShieldedEnv(gymnasium.Wrapper[Observations, NDArray[Any], Observations, NDArray[Any]], RecordConstructorArgs):
    """``EthBrake-v0`` behind the step shield: each action is certified, or replaced; see ``StepShield``.

    ``info["shield"]`` says what was done; ``intervention_penalty`` is taken off the reward of a step in which
    something else than the proposal was applied. ``policy`` (or None) is rolled out at each alert: where it harms no
    more than the coupled optimum, its harm is the bound.
    """

    def __init__(
        self,
        env: gymnasium.Env[Observations, NDArray[Any]],
        policy: Agent | LearnedPolicy | None = None,
        *,
        count: HarmCount = "first",
        allowance: float = 0.0,
        uncertainty: Uncertainty | str | None = None,
        intervention_penalty: float = 0.0,
        logging: bool = False,
    ) -> None:
        RecordConstructorArgs.__init__(
            self,
            policy=policy,
            count=count,
            allowance=allowance,
            uncertainty=uncertainty,
            intervention_penalty=intervention_penalty,
            logging=logging,
        )
        check_amount("intervention_penalty", intervention_penalty, "ShieldedEnv")
        engine = engine_of(env, gymnasium.Env, "ShieldedEnv", "gymnasium.make('EthBrake-v0')")
        self.attached = AttachedShield(
            engine, policy, count=count, allowance=allowance, uncertainty=uncertainty, logging=logging,
            where="ShieldedEnv",
        )  # fmt: skip
        super().__init__(env)
        self.intervention_penalty = intervention_penalty

    def step(self, action: NDArray[Any]) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Advance by one step with the action certified or replaced."""
        shield = self.attached
        if shield.shield.running is None or shield.engine.ended[0]:
            return self.env.step(action)  # type: ignore[return-value]  # says what is wrong
        proposed = checked_action(action, (1,), shield.engine.scenario.vehicle_names[shield.vehicle])
        observation, reward, terminated, truncated, info = self.env.step(shield.decide(proposed))
        shield.confirm()
        told = info["shield"] = shield.info(0, float(proposed[0]))
        paid = float(reward) - self.intervention_penalty * float(told["intervened"])
        return observation, paid, terminated, truncated, info

    def close(self) -> None:
        """Let go of the environment, and close it."""
        self.attached.detach()
        super().close()
