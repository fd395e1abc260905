"""The shield as a wrapper for each interface: it puts a guard into the engine, which reports in the infos."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from ethbrake_marl.agents.learned import LearnedPolicy
from ethbrake_marl.agents.protocol import Agent, Team
from ethbrake_marl.envs.pettingzoo import InTurns, Ordered, SeededInside
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.game.observations import Observations
from ethbrake_marl.physics.state import Bools, Floats
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.shields.attach import Attached, Proposing
from ethbrake_marl.shields.drivers import ShieldedDriver, shielded
from ethbrake_marl.shields.paper_hybrid import HybridAgent

Told = tuple[Any, Any, Any, Any, dict[str, dict[str, Any]]]  # observations, rewards, terminated, truncated, infos


class _Closing:
    """Mixin for wrappers, with a ``close`` that removes the guard from the engine and then closes the environment."""

    attached: Attached  # the link to the engine and its guard

    def close(self, **settings: Any) -> None:
        """Remove the shield from the environment, then close the environment with its keywords ``settings``."""
        self.attached.close()
        super().close(**settings)  # type: ignore[misc]  # of the wrapper's own library


class HybridShield(_Closing, SeededInside, BaseParallelWrapper[str, Observations, NDArray[Any]]):  # type: ignore[misc]  # PettingZoo is untyped
    """Shield the learners of a parallel environment; the caller's actions or a policy propose.

    Mode ``step``, the default, certifies every action of all learners together, or replaces it. Mode ``episode`` is the
    paper's Algorithm 1: policy or E-V2X-BM drives the whole episode, whatever is proposed. Bounds hold where the other
    vehicles follow their scripts. ``infos[agent]`` reports each decision under ``shield_reason`` and other
    ``shield_...`` keys. See docs/shield.md.

    Args:
        env: ``eb.parallel_env(...)`` with one learner (mode ``step``: one or more), or a wrapper around it.
        policy: an agent or a policy, a ``Team``, or a mapping from learner name to policy. Mode ``episode`` needs one.
            In the other modes, its harm is the bound (the guaranteed harm) where it is lower than that of E-V2X-BM.
        agents: names of the shielded learners; must be all learners, which is also the meaning of None.
        options: keywords of ``ShieldOptions``, including ``mode``.

    Raises ``InvalidInput`` for arguments that do not fit.

    >>> import ethbrake_marl as eb
    >>> env = eb.HybridShield(eb.parallel_env(scenario="paper-random"))
    >>> observations, infos = env.reset(seed=7)
    >>> infos = env.step({"vehicle_2": [1.0]})[4]
    >>> infos["vehicle_2"]["shield_intervened"]
    True

    """

    def __init__(
        self,
        env: ParallelEnv[str, Observations, NDArray[Any]],
        policy: Proposing | None = None,
        *,
        agents: Sequence[str] | None = None,
        **options: Any,
    ) -> None:
        if isinstance(agents, str) or not (agents is None or isinstance(agents, Iterable)):
            raise InvalidInput(
                f"HybridShield: agents = {agents!r}: must be a list of names, for instance ['vehicle_2']"
            )
        self.attached = Attached(env, ParallelEnv, "eb.parallel_env", policy, "HybridShield", options)
        super().__init__(env)
        engine = self.attached.engine
        self.shielded = tuple(engine.scenario.vehicle_names[i] for i in engine.learners)  # front to rear
        asked = self.shielded if agents is None else tuple(agents)
        if set(asked) != set(self.shielded):
            self.attached.close()
            raise InvalidInput(
                f"HybridShield: shields every learner, {self.shielded}, and nobody else; got {asked}. What an"
                " unshielded one does is an assumption that nothing checks: give it a script (learners=[...] of the"
                " environment)"
            )

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observations], dict[str, dict[str, Any]]]:
        """Start an episode; return the observations and infos of the agents.

        ``seed`` and ``options`` are the environment's. ``infos[agent]["shield_bound_harm"]`` already holds the bound.
        """
        self.attached.check_open()
        result: tuple[dict[str, Observations], dict[str, dict[str, Any]]] = super().reset(seed=seed, options=options)
        self.attached.check_open()
        return result

    def step(self, actions: Mapping[str, Any]) -> Told:
        """Advance by one step with the learners' actions certified or replaced.

        ``actions`` maps agent names to actions [1]; the policy proposes for agents that are left out. Returns
        observations, rewards (with the intervention penalty subtracted), terminations, truncations and infos, each by
        agent name.
        """
        self.attached.check_open()
        result: Told = super().step(actions)
        if not self.attached.engine.components:
            for agent, penalty in zip(self.shielded, self.attached.penalty()[0].tolist(), strict=True):
                result[1][agent] -= penalty
        return result


def shielded_aec(env: ParallelEnv[str, Observations, NDArray[Any]], *args: Any, **settings: Any) -> Any:
    """Return a shielded environment with agents acting in turn (AEC), front to rear.

    ``env`` is the parallel environment: in AEC, the actions of a step are complete only after the last agent has acted.
    ``args`` and ``settings`` are the further arguments of ``HybridShield``.
    """
    return InTurns.around(HybridShield(env, *args, **settings))


class ShieldedEnv(
    _Closing, gymnasium.Wrapper[Observations, NDArray[Any], Observations, NDArray[Any]], RecordConstructorArgs
):
    """``EthBrake-v0`` behind a shield, by default in mode ``step``: each action is certified, or replaced.

    ``options`` are keywords of ``ShieldOptions``. The info reports each decision under ``shield_reason`` and other
    ``shield_...`` keys. ``policy``, required only in mode ``episode``, is simulated from each alert: where it harms no
    more than E-V2X-BM, its harm is the bound.

    >>> import ethbrake_marl as eb
    >>> env = eb.ShieldedEnv(eb.EthBrakeEnv("paper-random"))
    >>> observation, info = env.reset(seed=7)
    >>> info = env.step([1.0])[4]
    >>> info["shield_intervened"], eb.ShieldReason(info["shield_reason"]).name
    (True, 'NO_CERTIFICATE')

    """

    def __init__(
        self,
        env: gymnasium.Env[Observations, NDArray[Any]],
        policy: Agent | LearnedPolicy | None = None,
        **options: Any,
    ) -> None:
        RecordConstructorArgs.__init__(self, policy=policy, **options)
        self.attached = Attached(env, gymnasium.Env, "gymnasium.make('EthBrake-v0')", policy, "ShieldedEnv", options)
        super().__init__(env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; return observation and info.

        ``seed`` and ``options`` are the environment's. ``info["shield_bound_harm"]`` already holds the bound.
        """
        self.attached.check_open()
        result = self.env.reset(seed=seed, options=options)
        self.attached.check_open()  # a wrapper inside may have put another environment there
        return result

    def step(self, action: NDArray[Any]) -> Any:
        """Advance by one time step with the action [1] certified or replaced.

        Returns what the wrapped environment returns, with the intervention penalty subtracted from the reward; around
        ``CostEnv`` that includes the cost.
        """
        self.attached.check_open()
        observation, reward, *others = self.env.step(action)
        if not self.attached.engine.components:
            reward = float(reward) - self.attached.penalty().item()
        return observation, reward, *others


class ShieldedVectorEnv(_Closing, VectorWrapper):
    """``EthBrakeVectorEnv`` behind a shield, by default in mode ``step``: each row's action is certified, or replaced.

    ``options`` are keywords of ``ShieldOptions``. ``policy``, required only in mode ``episode``, is simulated from each
    alert: where it harms no more than E-V2X-BM, its harm is the bound. ``infos["shield_bound_harm"]`` and the other
    shield entries describe the same moment as the other infos: in a restarted row the new alert, while
    ``infos["final_info"]`` describes the last step. Raises ``InvalidInput`` for another environment.

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> env = eb.ShieldedVectorEnv(eb.EthBrakeVectorEnv(num_envs=4, scenario="paper-random"))
    >>> observations, infos = env.reset(seed=7)
    >>> infos = env.step(np.full((4, 1), 1.0))[4]
    >>> infos["shield_intervened"]
    array([ True,  True,  True,  True])

    """

    def __init__(
        self, env: VectorEnv[Any, Any, Any], policy: Agent | LearnedPolicy | None = None, **options: Any
    ) -> None:
        maker = "gymnasium.make_vec('EthBrake-v0')"
        self.attached = Attached(env, VectorEnv, maker, policy, "ShieldedVectorEnv", options)
        super().__init__(env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode in every row; return observations [rows, F] and infos.

        ``seed`` and ``options`` are the environment's. ``infos["shield_bound_harm"]`` already holds the bounds.
        """
        self.attached.check_open()
        result = self.env.reset(seed=seed, options=options)
        self.attached.check_open()  # a wrapper inside may have put another environment there
        return result

    def step(self, actions: NDArray[Any]) -> tuple[Observations, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every world by one time step with the actions [rows, 1] certified or replaced.

        Returns observations, rewards with the intervention penalty subtracted, terminated, truncated (each [rows]) and
        infos.
        """
        self.attached.check_open()
        observation, reward, terminated, truncated, infos = self.env.step(actions)
        if not self.attached.engine.components:
            reward = reward - self.attached.penalty()[:, 0]
        return observation, reward, terminated, truncated, infos


def shield(env: Any, policy: Proposing | None = None, mode: str | None = None, **options: Any) -> Any:
    """Put a shield around an environment, with the wrapper for its interface, or around an agent.

    Args:
        env: an environment of this package, possibly wrapped: PettingZoo parallel or AEC, Gymnasium, its vector
            interface, or Stable-Baselines3's ``VecEnv``. Inner wrappers may change actions: the action that reaches the
            engine is certified. Or an agent or a team, which needs ``scenario``, the scenario in which actions are
            certified.
        policy: proposes where the caller gives no action, and lowers the bound (the harm that the shield guarantees) to
            its own harm where that is lower. Mode ``episode`` needs it. None: nobody.
        mode: ``step``, ``episode``, or a mode of an extension. None: ``step``, unless the options belong to another
            mode.
        options: further keywords of ``ShieldOptions``.

    Returns ``HybridShield``, the same with agents acting in turn, ``ShieldedEnv``, ``ShieldedVectorEnv`` or
    ``ShieldedVecEnv``; an agent or a team for an agent or a team. Raises ``InvalidInput`` for anything else, and for
    arguments that these refuse.

    >>> import ethbrake_marl as eb
    >>> env = eb.shield(eb.parallel_env(scenario="paper-random"))
    >>> observations, infos = env.reset(seed=7)
    >>> env.step({"vehicle_2": [1.0]})[4]["vehicle_2"]["shield_intervened"]
    True

    """
    settings = {"mode": mode, **options}
    if isinstance(env, Agent | Team | ShieldedDriver):
        if isinstance(env, HybridAgent | ShieldedDriver) or (isinstance(env, Team) and env.shield is not None):
            raise InvalidInput(f"shield: agent {env.name!r} is behind a shield already")
        if policy is not None or "scenario" not in options:
            raise InvalidInput(f"shield: agent {env.name!r} needs scenario=, in which to certify, and takes no policy")
        return shielded(env, load_scenario(settings.pop("scenario")), **settings)
    if isinstance(env, AECEnv):
        inside: Any = env
        while type(inside) in (InTurns, Ordered, OrderEnforcingWrapper):  # as in eb.env; others may change actions
            inside = inside.env
        if not isinstance(inside, ParallelEnv):
            raise InvalidInput(
                f"shield: {inside} acts in turns: put the shield inside it, as eb.shielded_aec(parallel)"
            )
        return shielded_aec(inside, policy, **settings)
    if isinstance(env, VectorEnv):
        return ShieldedVectorEnv(env, policy, **settings)  # type: ignore[arg-type]
    if isinstance(env, gymnasium.Env):
        return ShieldedEnv(env, policy, **settings)  # type: ignore[arg-type]
    vec_env = getattr(sys.modules.get("stable_baselines3.common.vec_env"), "VecEnv", None)
    if vec_env is not None and isinstance(env, vec_env):
        from ethbrake_marl.shields.sb3 import ShieldedVecEnv  # torch: only where there is such an environment

        return ShieldedVecEnv(env, policy, **settings)
    if isinstance(env, ParallelEnv):
        return HybridShield(env, policy, **settings)
    raise InvalidInput(
        f"shield: {env!r:.200} has none of the interfaces: parallel_env, env (agents in turn), EthBrakeEnv,"
        " EthBrakeVectorEnv, make_sb3_vec_env, or an agent"
    )
