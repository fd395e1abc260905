"""The shield as a wrapper of PettingZoo, of Gymnasium, and of its vector interface."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorWrapper
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from ethbrake_marl.actions import checked_action
from ethbrake_marl.agents.policy import LearnedPolicy
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.envs.gym import EthBrakeVectorEnv
from ethbrake_marl.envs.parallel import in_turns
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import Observations
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.shield.agents import HybridAgent
from ethbrake_marl.shield.guard import AttachedHybrid, Proposing, attach, read_options
from ethbrake_marl.shield.uncertainty import engine_of, shielded_vehicles

Told = tuple[Any, Any, Any, Any, dict[str, dict[str, Any]]]  # what a step of the environment returns


class HybridShield(BaseParallelWrapper[str, Observations, NDArray[Any]]):  # type: ignore[misc]  # PettingZoo is untyped
    """Shield the learners of a parallel environment, who are driven by the caller's actions or by a policy.

    Mode ``episode`` is the paper's Algorithm 1: policy or E-V2X-BM drives a whole episode, whatever is proposed. Mode
    ``step`` certifies every action, or replaces it, of several learners together; ``robust`` does so in every member of
    an uncertainty. Bounds hold where the other vehicles follow their scripts. ``infos[agent]["shield"]`` says what was
    done. See docs/shield.md.

    Args:
        env: ``eb.parallel_env(...)`` with one learner (mode ``step``: or more), or what wraps it.
        policy: an agent or a policy, a ``Team``, or one for each learner by its name; mode ``episode`` needs one, the
            others take its harm as bound where that is lower.
        mode: ``episode``, ``step`` or ``robust``.
        agents: the learners that are shielded, as a list of names: all there are, which None also says.
        options: keywords of ``ShieldOptions``; raises ``InvalidInput`` for one that the mode does not take.

    >>> import ethbrake_marl as eb
    >>> env = eb.HybridShield(eb.parallel_env(scenario="paper-random"), mode="step")
    >>> observations, infos = env.reset(seed=7)
    >>> infos = env.step({"vehicle_2": [1.0]})[4]
    >>> infos["vehicle_2"]["shield"]["intervened"]
    True

    """

    def __init__(
        self,
        env: ParallelEnv[str, Observations, NDArray[Any]],
        policy: Proposing | None = None,
        *,
        mode: str = "episode",
        agents: Sequence[str] | None = None,
        **options: Any,
    ) -> None:
        settings = read_options("HybridShield", {"mode": mode, **options})
        engine = engine_of(
            env, ParallelEnv, "HybridShield", "eb.parallel_env; with agents acting in turn eb.shielded_aec(that)"
        )
        super().__init__(env)
        self._engine = engine
        names = engine.scenario.vehicle_names
        learners = tuple(names[i] for i in sorted(engine.learners))
        given = learners if agents is None else _names(agents)
        shielded_vehicles(engine, "HybridShield", settings.mode)
        if len(given) != len(learners) or set(given) != set(learners):
            raise InvalidInput(
                f"HybridShield: shields every learner, {learners}, and nobody else; got {given}. What an unshielded one"
                " does is an assumption that nothing checks: give it a script (learners=[...] of the environment)"
            )
        self.mode = mode
        self.shielded = learners  # names, front to rear
        self.attached: Any = attach(engine, policy, settings)  # what it is depends on the mode

    @property
    def hybrid(self) -> HybridAgent:
        """Who drives the running episode, in mode ``episode``. Raises ``InvalidInput`` in another mode."""
        if not isinstance(self.attached, AttachedHybrid):
            raise InvalidInput(f"HybridShield: hybrid: mode {self.mode} chooses nobody for a whole episode")
        return self.attached.hybrid

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observations], dict[str, dict[str, Any]]]:
        """Start an episode; the bound stands in ``infos[agent]["shield"]`` already."""
        self.attached.check_open()
        observations, infos = super().reset(seed=seed, options=options)
        for c, agent in enumerate(self.shielded):
            infos[agent]["shield"] = self.attached.start_info(0, c)
        return observations, infos

    def step(self, actions: Mapping[str, Any]) -> Told:
        """Advance by one step with the shielded agents' actions certified or replaced; they may also be left out."""
        attached, agents = self.attached, self.shielded
        attached.check_open()
        if not isinstance(actions, Mapping):
            raise InvalidInput(
                f"HybridShield: actions = {actions!r}: must be a dict, for instance {{{agents[0]!r}: [0.0]}}"
            )
        given = {a: checked_action(actions[a], (1,), a) for a in agents if actions.get(a) is not None}
        if not self.env.agents:
            return self.env.step(actions)  # type: ignore[no-any-return]  # says that no episode is running
        if len(given) < len(agents):
            own = attached.proposal().reshape(len(agents), 1)
            given = {a: given.get(a, own[c]) for c, a in enumerate(agents)}
        whole = given[agents[0]] if len(agents) == 1 else np.stack([given[a][0] for a in agents])[np.newaxis]
        applied = attached.decide(whole).reshape(len(agents), 1)
        told: Told = super().step({**actions, **dict(zip(agents, applied, strict=True))})
        attached.confirm()
        for c, agent in enumerate(agents):
            shown = told[4][agent]["shield"] = attached.info(0, float(given[agent][0]), c)
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
    return in_turns(HybridShield(env, *args, **settings))


def _names(agents: object) -> tuple[Any, ...]:
    if isinstance(agents, str) or not isinstance(agents, Iterable):
        raise InvalidInput(f"HybridShield: agents = {agents!r}: must be a list of names, for instance ['vehicle_2']")
    return tuple(agents)


class ShieldedEnv(gymnasium.Wrapper[Observations, NDArray[Any], Observations, NDArray[Any]], RecordConstructorArgs):
    """``EthBrake-v0`` behind a shield, by default in mode ``step``: each action is certified, or replaced.

    The ``options`` are those of ``ShieldOptions``. ``info["shield"]`` says what was done. ``policy`` (in mode ``step``
    and ``robust`` it may be None) is rolled out at each alert: where it harms no more than the coupled optimum, its
    harm is the bound.

    >>> import ethbrake_marl as eb
    >>> env = eb.ShieldedEnv(eb.EthBrakeEnv("paper-random"))
    >>> observation, info = env.reset(seed=7)
    >>> info = env.step([1.0])[4]
    >>> info["shield"]["intervened"], info["shield"]["reason"]
    (True, 'no certificate')

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

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; the bound stands in ``info["shield"]`` already."""
        self.attached.check_open()
        observation, info = self.env.reset(seed=seed, options=options)
        info["shield"] = self.attached.start_info(0)
        return observation, info

    def step(self, action: NDArray[Any]) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Advance by one step with the action certified or replaced."""
        shield = self.attached
        shield.check_open()
        if not shield.running or shield.engine.ended[0]:
            return self.env.step(action)  # type: ignore[return-value]  # says what is wrong
        proposed = checked_action(action, (1,), shield.engine.scenario.vehicle_names[shield.vehicles[0]])
        observation, reward, terminated, truncated, info = self.env.step(shield.decide(proposed))
        shield.confirm()
        told = info["shield"] = shield.info(0, float(proposed[0]))
        paid = float(reward) - shield.options.intervention_penalty * float(told["intervened"])
        return observation, paid, terminated, truncated, info

    def close(self) -> None:
        """Let go of the environment, and close it."""
        self.attached.detach()
        super().close()


class ShieldedVectorEnv(VectorWrapper):
    """``EthBrakeVectorEnv`` behind a shield, by default in mode ``step``: each row's action is certified, or replaced.

    The ``options`` are those of ``ShieldOptions``.

    ``infos["shield"]`` tells the step that was made, also of rows whose episode ended with it: one array per key,
    marked by ``infos["_shield"]`` (rows that the autoreset mode spends on a reset are not). Raises ``InvalidInput`` for
    another environment.

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> env = eb.ShieldedVectorEnv(eb.EthBrakeVectorEnv(num_envs=4, scenario="paper-random"))
    >>> observations, infos = env.reset(seed=7)
    >>> infos = env.step(np.full((4, 1), 1.0))[4]
    >>> infos["shield"]["intervened"]
    array([ True,  True,  True,  True])

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

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode in every row; the bounds stand in ``infos["shield"]`` already."""
        self.attached.check_open()
        observations, infos = self.env.reset(seed=seed, options=options)
        infos |= {"shield": self.attached.start_infos(), "_shield": np.ones(self.num_envs, np.bool_)}
        return observations, infos

    def step(self, actions: NDArray[Any]) -> tuple[Observations, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every world by one time step with the actions [rows, 1] certified or replaced."""
        attached = self.attached
        attached.check_open()
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
