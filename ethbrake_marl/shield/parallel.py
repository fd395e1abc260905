"""The shield as a PettingZoo wrapper."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from pettingzoo.utils.conversions import parallel_to_aec

from ethbrake_marl.actions import checked_action
from ethbrake_marl.agents.learned import LearnedPolicy
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.observations import Observations
from ethbrake_marl.shield.agents import Bound, HybridAgent
from ethbrake_marl.shield.engine_shield import AttachedHybrid, AttachedShield
from ethbrake_marl.shield.settings import engine_of, only_shielded
from ethbrake_marl.shield.uncertainty import Uncertainty, mode_uncertainty

MODES = ("episode", "step", "robust")
Told = tuple[Any, Any, Any, Any, dict[str, dict[str, Any]]]  # what a step of the environment returns


class HybridShield(BaseParallelWrapper[str, Observations, NDArray[Any]]):  # type: ignore[misc]  # PettingZoo is untyped
    """Shield a learner of a parallel environment (``eb.parallel_env``) that is driven by ``policy``, or by an agent.

    Mode ``episode`` is the paper's Algorithm 1: when an episode starts, ``policy`` is rolled out from the alert and its
    harm compared with ``H*`` (``bound``, ``count``); the lower one drives that episode. What is certified is the
    policy, not single actions: while it drives, its own deterministic action is applied, whatever is proposed.
    ``infos[agent]["shield"]`` holds proposed and applied action, who drives, and both harms. Mode ``step`` certifies
    every action that is proposed (by the caller, or by ``policy`` where none is passed), and replaces those that cannot
    keep the bound: see ``StepShield``; its infos say why. Mode ``robust`` is step mode with an ``uncertainty``
    (``"latency_s=0.1"``): what is certified must hold in every member. ``bound`` is the episode mode's, ``allowance``
    (m2/s2 above the bound) that of the others; where a mode has none, giving one is refused. The claim of a bound holds
    for one shielded vehicle, the others following their scripts.
    """

    def __init__(
        self,
        env: ParallelEnv[str, Observations, NDArray[Any]],
        policy: Agent | LearnedPolicy | None = None,
        *,
        mode: str = "episode",
        bound: Bound = "coupled",
        count: HarmCount = "first",
        allowance: float = 0.0,
        uncertainty: Uncertainty | str | None = None,
        agents: Sequence[str] | None = None,
    ) -> None:
        if mode not in MODES:
            raise unknown_name("shield mode", mode, MODES)
        intervals = mode_uncertainty(mode, uncertainty, "HybridShield")
        if mode == "episode" and allowance != 0.0:
            raise InvalidInput(f"HybridShield: allowance = {allowance!r}: mode episode takes none; step and robust do")
        if mode != "episode" and bound != "coupled":
            raise InvalidInput(f"HybridShield: bound = {bound!r}: mode {mode} takes none; episode does")
        engine = engine_of(env, ParallelEnv, "HybridShield", "eb.parallel_env")
        super().__init__(env)
        self._engine = engine
        names = engine.scenario.vehicle_names
        shielded = tuple(names[i] for i in engine.learners) if agents is None else _names(agents)
        only_shielded(engine, "HybridShield")
        if len(shielded) != 1 or shielded[0] not in names or names.index(shielded[0]) not in engine.learners:
            raise InvalidInput(f"HybridShield: shields exactly one learner in mode {mode!r}; got {shielded}")
        self.mode = mode
        self.shielded = shielded[0]
        self.attached: AttachedShield | None = None
        self._chooser: AttachedHybrid | None = None
        if mode == "episode":
            self._chooser = AttachedHybrid(engine, policy, bound=bound, count=count, where="HybridShield")
        else:
            self.attached = AttachedShield(
                engine, policy, count=count, allowance=allowance, uncertainty=intervals, where="HybridShield"
            )

    @property
    def hybrid(self) -> HybridAgent:
        """Who drives the running episode, in mode ``episode``. Raises ``InvalidInput`` in another mode."""
        if self._chooser is None:
            raise InvalidInput(f"HybridShield: hybrid: mode {self.mode} chooses nobody for a whole episode")
        return self._chooser.hybrid

    def step(self, actions: Mapping[str, Any]) -> Told:
        """Advance by one step with the shielded agent's action replaced; it may also be left out."""
        agent = self.shielded
        if not isinstance(actions, Mapping):
            raise InvalidInput(
                f"HybridShield: actions = {actions!r}: must be a dict, for instance {{{agent!r}: [0.0]}}"
            )
        proposed = actions.get(agent)
        if proposed is not None:
            checked_action(proposed, (1,), agent)
        if not self.env.agents:
            return self.env.step(actions)  # type: ignore[no-any-return]  # says that no episode is running
        if self._chooser is not None:
            applied = self._chooser.decide()
            told: Told = super().step({**actions, agent: applied})
            self._chooser.confirm()
            told[4][agent]["shield"] = self._info(proposed, float(applied[0]))
            return told
        attached = self.attached
        assert attached is not None
        given = attached.proposal() if proposed is None else checked_action(proposed, (1,), agent)
        told = super().step({**actions, agent: attached.decide(given)})
        attached.confirm()
        told[4][agent]["shield"] = attached.info(0, float(given[0]))
        return told

    def close(self) -> None:
        """Let go of the environment: this shield no longer follows it."""
        for attached in (self.attached, self._chooser):
            if attached is not None:
                attached.detach()
        super().close()

    def _info(self, proposed: Any, applied: float) -> dict[str, Any]:
        """What the shield did, for ``infos``; ``proposed_action`` is NaN when nothing was proposed."""
        value = float("nan") if proposed is None else float(np.asarray(proposed).item())
        return {
            "mode": self.mode,
            "proposed_action": value,
            "applied_action": applied,
            "chosen_policy": bool(self.hybrid.chosen_policy[0]),
            "policy_harm": float(self.hybrid.policy_harm[0]),
            "bound_harm": float(self.hybrid.bound_harm[0]),
        }


def shielded_aec(env: ParallelEnv[str, Observations, NDArray[Any]], *args: Any, **settings: Any) -> Any:
    """``HybridShield`` with agents acting in turn (AEC), front to rear; arguments as ``HybridShield``.

    ``env`` is the parallel environment: in AEC all actions of a step are known only when the last agent has acted.
    """
    if isinstance(env, AECEnv):
        raise InvalidInput("shielded_aec: give the parallel environment (eb.parallel_env), not the AEC one")
    return parallel_to_aec(HybridShield(env, *args, **settings))


def _names(agents: object) -> tuple[Any, ...]:
    if isinstance(agents, str) or not isinstance(agents, Iterable):
        raise InvalidInput(f"HybridShield: agents = {agents!r}: must be a list of names, for instance ['vehicle_2']")
    return tuple(agents)
