"""The shield as a PettingZoo wrapper."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from pettingzoo.utils.conversions import parallel_to_aec

from ethbrake_marl.actions import checked_action
from ethbrake_marl.agents.learned import LearnedPolicy
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import Observations
from ethbrake_marl.shield.agents import HybridAgent
from ethbrake_marl.shield.engine_episode import AttachedHybrid, attach
from ethbrake_marl.shield.options import read_options
from ethbrake_marl.shield.settings import engine_of, only_shielded

Told = tuple[Any, Any, Any, Any, dict[str, dict[str, Any]]]  # what a step of the environment returns


class HybridShield(BaseParallelWrapper[str, Observations, NDArray[Any]]):  # type: ignore[misc]  # PettingZoo is untyped
    """Shield a learner of a parallel environment (``eb.parallel_env``) that is driven by ``policy``, or by an agent.

    Mode ``episode`` is the paper's Algorithm 1: when an episode starts, ``policy`` is rolled out from the alert and its
    harm compared with ``H*`` (``bound``, ``count``); the lower one drives that episode. What is certified is the
    policy, not single actions: while it drives, its own deterministic action is applied, whatever is proposed.
    ``infos[agent]["shield"]`` holds proposed and applied action, who drives, and both harms. Mode ``step`` certifies
    every action that is proposed (by the caller, or by ``policy`` where none is passed), and replaces those that cannot
    keep the bound: see ``StepShield``; its infos say why. Mode ``robust`` is step mode with an ``uncertainty``
    (``"latency_s=0.1"``): what is certified must hold in every member. The other ``options`` are those of
    ``ShieldOptions``; where a mode has none, giving one is refused. The claim of a bound holds for one shielded
    vehicle, the others following their scripts.
    """

    def __init__(
        self,
        env: ParallelEnv[str, Observations, NDArray[Any]],
        policy: Agent | LearnedPolicy | None = None,
        *,
        mode: str = "episode",
        agents: Sequence[str] | None = None,
        **options: Any,
    ) -> None:
        settings = read_options("HybridShield", {"mode": mode, **options})
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
        self.attached: Any = attach(engine, policy, settings)  # what it is depends on the mode

    @property
    def hybrid(self) -> HybridAgent:
        """Who drives the running episode, in mode ``episode``. Raises ``InvalidInput`` in another mode."""
        if not isinstance(self.attached, AttachedHybrid):
            raise InvalidInput(f"HybridShield: hybrid: mode {self.mode} chooses nobody for a whole episode")
        return self.attached.hybrid

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
        attached = self.attached
        given = attached.proposal() if proposed is None else checked_action(proposed, (1,), agent)
        told: Told = super().step({**actions, agent: attached.decide(given)})
        attached.confirm()
        shown = told[4][agent]["shield"] = attached.info(0, float(given[0]))
        if shown["intervened"]:
            told[1][agent] -= attached.options.intervention_penalty
        return told

    def close(self) -> None:
        """Let go of the environment: this shield no longer follows it."""
        self.attached.detach()
        super().close()


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
