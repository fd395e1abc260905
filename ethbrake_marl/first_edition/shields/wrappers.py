"""Shield wrappers for every kind of environment: each wrapper puts a guard into the engine."""

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

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.learned import LearnedPolicy
from ethbrake_marl.first_edition.agents.protocol import Agent, Team
from ethbrake_marl.first_edition.envs.pettingzoo import InTurns, Ordered, SeededInside
from ethbrake_marl.first_edition.game.observations import Observations
from ethbrake_marl.first_edition.physics.state import Bools, Floats
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.shields.attach import Attached, Proposing
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver, shielded
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent

Step = tuple[Any, Any, Any, Any, dict[str, dict[str, Any]]]  # observations, rewards, terminated, truncated, infos


class _Closing:
    """Mixin with a method ``close``, which removes the guard from the engine and then closes the environment."""

    attached: Attached  # the link to the engine and its guard

    def close(self, **settings: Any) -> None:
        self.attached.close()
        super().close(**settings)  # type: ignore[misc]  # of the wrapper's own library


class HybridShield(_Closing, SeededInside, BaseParallelWrapper[str, Observations, NDArray[Any]]):  # type: ignore[misc]  # PettingZoo is untyped
    """Shield all learners of a parallel environment.

    Mode ``step`` (the default) certifies or replaces the actions of all learners together. In mode ``episode`` (the
    paper's Algorithm 1) the policy or E-V2X-BM drives the whole episode, whatever actions are proposed. The bounds hold
    as long as the other vehicles follow their scripts. ``infos[agent]`` describes the shield's decision under the keys
    ``shield_...``. See docs/shield.md.

    Args:
        env: ``eb.parallel_env(...)`` with one learner (in mode ``step`` one or more), or a wrapper around it.
        policy: an agent, a policy, a ``Team``, or a mapping from learner name to policy. The policy proposes the
            actions that the caller leaves out. In worlds where the policy does less harm than E-V2X-BM, the policy's
            harm is the bound. Mode ``episode`` needs a policy.
        agents: names of the learners to shield; must contain every learner. None: all learners.
        options: keywords of ``ShieldOptions``, including ``mode``.

    Raises ``InvalidInput`` for invalid arguments.

    >>> import ethbrake_marl.first_edition as eb
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
                f"HybridShield: agents = {agents!r}: must be a list of vehicle names, for instance ['vehicle_2']"
            )
        self.attached = Attached(env, ParallelEnv, "eb.parallel_env", policy, "HybridShield", options)
        super().__init__(env)
        engine = self.attached.engine
        self.shielded = tuple(engine.scenario.vehicle_names[i] for i in engine.learners)  # front to rear
        asked = self.shielded if agents is None else tuple(agents)
        if set(asked) != set(self.shielded):
            self.attached.close()
            raise InvalidInput(
                f"HybridShield: agents = {asked}: must be all learners, {self.shielded}, because the bound is proven"
                " only if all other vehicles follow scripts; a vehicle that you leave out of learners=[...] when you"
                " make the environment follows a script"
            )

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observations], dict[str, dict[str, Any]]]:
        """Start an episode; return the observations and infos of the agents.

        ``infos[agent]["shield_bound_harm"]`` is the bound of the episode, m2/s2.
        """
        self.attached.check_open()
        result: tuple[dict[str, Observations], dict[str, dict[str, Any]]] = super().reset(seed=seed, options=options)
        self.attached.check_open()
        return result

    def step(self, actions: Mapping[str, Any]) -> Step:
        """Advance by one step; the shield certifies or replaces the learners' actions.

        ``actions`` maps agent names to actions [1]; the policy proposes the actions of agents that are left out.
        Returns five dictionaries by agent name: observations, rewards (with the intervention penalty subtracted),
        terminations, truncations and infos.
        """
        self.attached.check_open()
        result: Step = super().step(actions)
        if not self.attached.engine.components:
            for agent, penalty in zip(self.shielded, self.attached.penalty()[0].tolist(), strict=True):
                result[1][agent] -= penalty
        return result


def shielded_aec(env: ParallelEnv[str, Observations, NDArray[Any]], *args: Any, **settings: Any) -> Any:
    """Return a shielded environment in which the agents act one after the other (AEC), front to rear.

    ``env`` is a parallel environment, because the shield needs the actions of all agents at once. ``args`` and
    ``settings`` are the other arguments of ``HybridShield``.
    """
    return InTurns.around(HybridShield(env, *args, **settings))


class ShieldedEnv(
    _Closing, gymnasium.Wrapper[Observations, NDArray[Any], Observations, NDArray[Any]], RecordConstructorArgs
):
    """``EthBrake-v1`` behind a shield, by default in mode ``step``, which certifies or replaces each action.

    The info describes the shield's decision under the keys ``shield_...``, such as ``shield_reason``.

    Args:
        env: an ``EthBrake-v1`` environment, or a wrapper around it.
        policy: policy that is simulated from the alert on. In worlds where the policy does less harm than E-V2X-BM, the
            policy's harm is the bound. In all modes except ``episode``, ``policy`` may be None.
        options: keywords of ``ShieldOptions``, including ``mode``.

    Raises ``InvalidInput`` if ``env`` is another kind of environment, and for invalid arguments.

    >>> import ethbrake_marl.first_edition as eb
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
        self.attached = Attached(env, gymnasium.Env, "gymnasium.make('EthBrake-v1')", policy, "ShieldedEnv", options)
        super().__init__(env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; return observation and info.

        ``info["shield_bound_harm"]`` is the bound of the episode, m2/s2.
        """
        self.attached.check_open()
        result = self.env.reset(seed=seed, options=options)
        self.attached.check_open()  # a wrapper inside may have put another environment there
        return result

    def step(self, action: NDArray[Any]) -> Any:
        """Advance by one time step; the shield certifies or replaces the action [1].

        Returns what ``step`` of the wrapped environment returns (with a ``CostEnv`` inside, also the cost), but with
        the intervention penalty subtracted from the reward.
        """
        self.attached.check_open()
        observation, reward, *others = self.env.step(action)
        if not self.attached.engine.components:
            reward = float(reward) - self.attached.penalty().item()
        return observation, reward, *others


class ShieldedVectorEnv(_Closing, VectorWrapper):
    """``EthBrakeVectorEnv`` behind a shield, by default in mode ``step``, which certifies or replaces each action.

    In a row where a new episode has just started, ``infos["shield_bound_harm"]`` and the other infos describe the alert
    of this episode. ``infos["final_info"]`` describes the last step of the old episode in this row.

    Args:
        env: an ``EthBrakeVectorEnv``, or a wrapper around it.
        policy: policy that is simulated from the alert on. In worlds where the policy does less harm than E-V2X-BM, the
            policy's harm is the bound. In all modes except ``episode``, ``policy`` may be None.
        options: keywords of ``ShieldOptions``, including ``mode``.

    Raises ``InvalidInput`` if ``env`` is another kind of environment, and for invalid arguments.

    >>> import ethbrake_marl.first_edition as eb
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
        maker = "gymnasium.make_vec('EthBrake-v1')"
        self.attached = Attached(env, VectorEnv, maker, policy, "ShieldedVectorEnv", options)
        super().__init__(env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode in every row; return observations [rows, F] and infos.

        ``infos["shield_bound_harm"]`` [rows] contains the bound of each episode, m2/s2.
        """
        self.attached.check_open()
        result = self.env.reset(seed=seed, options=options)
        self.attached.check_open()  # a wrapper inside may have put another environment there
        return result

    def step(self, actions: NDArray[Any]) -> tuple[Observations, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every world by one time step; the shield certifies or replaces the actions [rows, 1].

        Returns observations [rows, F], rewards [rows] with the intervention penalty subtracted, terminated [rows],
        truncated [rows], and infos.
        """
        self.attached.check_open()
        observation, reward, terminated, truncated, infos = self.env.step(actions)
        if not self.attached.engine.components:
            reward = reward - self.attached.penalty()[:, 0]
        return observation, reward, terminated, truncated, infos


def shield(env: Any, policy: Proposing | None = None, mode: str | None = None, **options: Any) -> Any:
    """Put a shield around an environment, an agent or a team.

    Args:
        env: an environment of this package, possibly wrapped: PettingZoo parallel or AEC, a Gymnasium or Gymnasium
            vector environment, or a Stable-Baselines3 ``VecEnv``. If wrappers inside the shield change an action, the
            shield certifies the changed action. ``env`` may also be an agent or a team; ``options`` must then contain
            ``scenario``, the scenario in which actions are certified.
        policy: policy that proposes the actions that the caller leaves out. In worlds where the policy does less harm
            than E-V2X-BM, the policy's harm is the bound. In all modes except ``episode``, ``policy`` may be None.
        mode: ``step``, ``episode``, or the mode of an extension. None means ``step``; but if the mode ``step`` does not
            accept one of the ``options``, None means the first mode that accepts all of them.
        options: further keywords of ``ShieldOptions``.

    Returns a ``HybridShield`` (for AEC, an AEC environment around a ``HybridShield``), a ``ShieldedEnv``, a
    ``ShieldedVectorEnv`` or a ``ShieldedVecEnv``. If ``env`` is an agent or a team, returns the same agent or team with
    a shield. Raises ``InvalidInput`` if ``env`` is of any other type, and for invalid arguments.

    >>> import ethbrake_marl.first_edition as eb
    >>> env = eb.shield(eb.parallel_env(scenario="paper-random"))
    >>> observations, infos = env.reset(seed=7)
    >>> env.step({"vehicle_2": [1.0]})[4]["vehicle_2"]["shield_intervened"]
    True

    """
    settings = {"mode": mode, **options}
    if isinstance(env, Agent | Team | ShieldedDriver):
        if isinstance(env, HybridAgent | ShieldedDriver) or (isinstance(env, Team) and env.shield is not None):
            raise InvalidInput(f"shield: agent {env.name!r} already has a shield")
        if policy is not None or "scenario" not in options:
            raise InvalidInput(
                f"shield: to shield the agent {env.name!r}, pass scenario=... (the scenario in which it drives), and"
                " leave out policy=..."
            )
        return shielded(env, load_scenario(settings.pop("scenario")), **settings)
    if isinstance(env, AECEnv):
        inside: Any = env
        while type(inside) in (InTurns, Ordered, OrderEnforcingWrapper):  # of eb.env; other wrappers may change actions
            inside = inside.env
        if not isinstance(inside, ParallelEnv):
            raise InvalidInput(
                f"shield: in {inside} the agents act one after the other; make a shielded environment of this kind from"
                " a parallel environment: eb.shielded_aec(parallel)"
            )
        return shielded_aec(inside, policy, **settings)
    if isinstance(env, VectorEnv):
        return ShieldedVectorEnv(env, policy, **settings)  # type: ignore[arg-type]
    if isinstance(env, gymnasium.Env):
        return ShieldedEnv(env, policy, **settings)  # type: ignore[arg-type]
    vec_env = getattr(sys.modules.get("stable_baselines3.common.vec_env"), "VecEnv", None)
    if vec_env is not None and isinstance(env, vec_env):
        from ethbrake_marl.first_edition.shields.sb3 import ShieldedVecEnv  # imports torch

        return ShieldedVecEnv(env, policy, **settings)
    if isinstance(env, ParallelEnv):
        return HybridShield(env, policy, **settings)
    raise InvalidInput(
        f"shield: {env!r:.200}: must be an agent, a team, or an environment made by eb.parallel_env, eb.env,"
        " eb.EthBrakeEnv, eb.EthBrakeVectorEnv or eb.make_sb3_vec_env"
    )
