"""Attach a shield to an environment, with the same options and checks for every kind of environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_one_learner
from ethbrake_marl.first_edition.agents.learned import LearnedAgent, LearnedPolicy
from ethbrake_marl.first_edition.agents.protocol import Agent, Team
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.game.observations import ObservationSpec
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.shields.contract import Guarded, ShieldGuard
from ethbrake_marl.first_edition.shields.options import ShieldOptions


def proposing_agent(policy: object, where: str) -> Agent:
    """Return ``policy`` as an agent: a learned policy becomes a ``LearnedAgent``.

    Raises ``InvalidInput`` if ``policy`` is neither an agent nor a learned policy; the message begins with ``where``.
    """
    if not isinstance(policy, type):
        if isinstance(policy, Agent):
            return policy
        if callable(policy) and isinstance(getattr(policy, "observation", None), ObservationSpec):
            return LearnedAgent(policy)  # type: ignore[arg-type]  # it is callable, and says what it observes
    raise InvalidInput(
        f"{where}: policy = {policy!r}: must be an agent or a policy (eb.load_policy); eb.policy_agent(function)"
        " makes an agent of a function"
    )


def proposing_agents(
    policy: Agent | LearnedPolicy | Team | Mapping[str, Agent | LearnedPolicy], vehicles: Sequence[int], where: str
) -> dict[int, Agent]:
    """Return the agents that propose the actions of the shielded vehicles: vehicle index -> agent.

    ``policy`` is a team, a mapping from vehicle name to policy, or one policy that proposes the actions of all
    vehicles. ``vehicles`` are the indices of the shielded vehicles. Raises ``InvalidInput``, with a message that begins
    with ``where``, for any other type of ``policy``, and if a team or mapping does not contain exactly the shielded
    vehicles.
    """
    if isinstance(policy, Team):
        drivers: dict[int, Agent] = policy.drivers
    elif isinstance(policy, Mapping):
        by_name = {f"vehicle_{i + 1}": i for i in vehicles}
        drivers = {by_name.get(name, -1): proposing_agent(each, where) for name, each in policy.items()}
    else:
        agent = proposing_agent(policy, where)
        return dict.fromkeys(vehicles, agent)
    if set(drivers) != set(vehicles):
        names = ", ".join(f"vehicle_{i + 1}" for i in vehicles)
        raise InvalidInput(f"{where}: policy must have one policy for each of {names}, and for no other vehicle")
    return {i: drivers[i] for i in vehicles}


Proposing = Agent | LearnedPolicy | Team | Mapping[str, Agent | LearnedPolicy]
"""Proposing policies: one policy for all shielded vehicles, a team, or a mapping from vehicle name to policy."""


def guard_of(engine: Engine, policy: Proposing | None, options: ShieldOptions) -> ShieldGuard:
    """Return a guard that shields all learners of an engine; this function does not change the engine.

    ``policy`` proposes the actions that the caller leaves out; it may be None in all modes except ``episode``. Raises
    ``InvalidInput`` if no vehicle learns, if several vehicles learn and the mode is not ``step``, and if ``policy`` is
    of the wrong type.
    """
    where, mode, scenario, vehicles = options.where, options.mode, engine.scenario, engine.learners
    if not vehicles:
        raise InvalidInput(
            f"{where}: no vehicle of scenario {scenario.name!r} learns, and only learners can be shielded; make the"
            " environment with learners=['vehicle_2']"
        )
    if mode != "step":
        check_one_learner(
            scenario.name,
            [scenario.vehicle_names[i] for i in vehicles],
            f"{where} needs exactly one learner in mode {mode}: its bound holds only if every other vehicle follows a"
            " script; use mode='step', which shields several learners together, or make the environment with"
            " learners=['vehicle_2']",
        )
    if mode == "episode":
        return options.guard(engine, {vehicles[0]: proposing_agent(policy, where)})
    policies = {} if policy is None else proposing_agents(policy, vehicles, where)
    return options.guard(engine, policies, warns=True)


class Attached:
    """The link between the shield wrapper of an environment and the guard in the environment's engine.

    Args:
        env: the environment to shield.
        interface: class of which ``env`` must be an instance, such as ``gymnasium.Env``.
        maker: code that makes an environment that this wrapper accepts, such as ``eb.parallel_env``; error messages
            contain this code.
        policy: policy that proposes the actions that the caller leaves out; None: no policy.
        where: name with which error messages begin: the name of the shield wrapper.
        options: keywords of ``ShieldOptions``.

    Raises ``InvalidInput`` if ``env`` is not an environment of this package, or if ``env`` already has a shield.

    """

    def __init__(
        self, env: object, interface: type, maker: str, policy: Proposing | None, where: str, options: Mapping[str, Any]
    ) -> None:
        self.options, self._env = ShieldOptions(**options, where=where), env
        engine = self._reached()
        if isinstance(engine, Engine) and isinstance(engine.guard, ShieldGuard):
            first = engine.guard
            raise InvalidInput(
                f"{where}: this environment already has a shield, a {first.where} (mode {first.mode.name.lower()}),"
                " and can have only one; close() that shield before you add another"
            )
        if isinstance(getattr(env, "attached", None), Attached):
            raise InvalidInput(f"{where}: {env} is a shield that was closed; pass the environment inside it instead")
        if not (isinstance(env, interface) and isinstance(engine, Engine)):
            raise InvalidInput(
                f"{where}: {env}: must be an environment made by {maker}; eb.shield(env) chooses the right wrapper for"
                " any environment of this package"
            )
        if engine.components and self.options.intervention_penalty > 0.0:
            raise InvalidInput(
                f"{where}: intervention_penalty = {self.options.intervention_penalty:g}: cannot be subtracted, because"
                " the rewards of this environment are vectors; leave intervention_penalty out"
            )
        self.engine, self._left = engine, Guarded(None, {})
        self.guard = guard_of(engine, policy, self.options)
        engine.protect(self.guard)

    @property
    def memory(self) -> Guarded:
        """Present memory of the guard; after ``close``, the memory that the guard had when the shield was closed."""
        memory: Guarded | None = self.engine.guarded if self.engine.guard is self.guard else self._left
        return Guarded(None, {}) if memory is None else memory

    @property
    def shield(self) -> Any:
        """Current state of the shield, for reading only; None before the first reset.

        In mode ``step`` the state is a ``StepShield``, in mode ``episode`` the memory of the ``HybridAgent``. An
        extension defines the type of the state for its own mode.
        """
        return self.memory.shield

    def _reached(self) -> Any:
        """Return the engine that the wrapped environment has now; None if it has no engine."""
        return getattr(getattr(self._env, "unwrapped", self._env), "engine", None)

    def check_open(self) -> None:
        """Raise ``InvalidInput`` if this shield was closed, or if the environment inside the wrapper was replaced."""
        if self._reached() is not self.engine:
            raise InvalidInput(
                f"{self.options.where}: the environment inside this wrapper was replaced; put a new shield around the"
                " new environment"
            )
        if self.engine.guard is not self.guard:
            raise InvalidInput(f"{self.options.where}: this shield was closed; put a new shield around the environment")

    def close(self) -> None:
        """Remove this shield from the environment; the attributes ``memory`` and ``shield`` keep their last values."""
        if self.engine.guard is self.guard:
            self._left = self.memory
            self.engine.protect(None)

    def penalty(self) -> Floats:
        """Return each learner's intervention penalty in the last step, [n, L], to be subtracted from the reward."""
        self.check_open()
        ruling = self.engine.ruling
        if ruling is None:
            return np.zeros((self.engine.n, len(self.engine.learners)))
        intervened = self.guard.intervened(ruling) & ruling.asked[:, np.newaxis]
        return np.asarray(self.options.intervention_penalty * intervened, np.float64)
