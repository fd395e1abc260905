"""PettingZoo's interface with agents acting in turn (AEC), around a parallel one."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from ethbrake_marl.actions import checked_action
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import Observations


class InTurns(parallel_to_aec_wrapper):  # type: ignore[misc]  # PettingZoo is untyped
    """As PettingZoo's, but an unusable action is refused in its agent's own turn, which stays: nothing is lost."""

    def step(self, action: Any) -> None:
        """Take the action of ``agent_selection``; the last one's advances all by one step.

        Raises ``InvalidInput`` for an unusable action of a learner, and for any but None once its episode is over.
        """
        agent, engine = self.agent_selection, self.env.unwrapped.engine
        assert isinstance(engine, Engine)
        if self.terminations[agent] or self.truncations[agent]:
            if action is not None:
                raise InvalidInput(f"step: the episode of {agent} is over; only None may follow, or reset")
        elif engine.scenario.vehicle_names.index(agent) in engine.learners:
            left_out = action is None and agent in getattr(self.env, "shielded", ())  # a shield may choose alone
            if not left_out:
                checked_action(action, (1,), agent)
        super().step(action)


def in_turns(
    env: ParallelEnv[str, Observations, NDArray[Any]],
) -> AECEnv[str, Observations, NDArray[Any]]:
    """The AEC environment of a parallel one of this package, whatever wraps it; order is enforced."""
    return OrderEnforcingWrapper(InTurns(env))
