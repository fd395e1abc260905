"""The paper's hybrid (Algorithm 1): at the alert, choose between policy and baseline for the whole episode.

The policy is rolled out in the engine from the alert on; its harm (each impact summed once) is compared with the
baseline's ``H*`` and the lower one drives the episode. With ``H*`` coupled (realised in the same engine) the hybrid
is never worse than the baseline, in any world, as long as the policy drives as it did in that rollout; one that draws
its actions does not, and needs the step shield. With the paper's pairwise ``H*``, which treats the two pairs as
independent, that does not hold: the pairwise figure is about half of what the same deceleration realises.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ethbrake_marl.agents.driving import drive
from ethbrake_marl.agents.e_v2x_bm.coupled import EV2XBM
from ethbrake_marl.agents.protocol import Agent, AgentAround, Source, check_agent
from ethbrake_marl.engine.engine import Engine, Ruling
from ethbrake_marl.engine.memory import Memory, ask_script, begin_script, renew_memory
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.errors import InvalidInput, check_one_learner
from ethbrake_marl.game.actions import command_to_action
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.checks import check_scenario
from ethbrake_marl.shield.options import (
    BelievedGuard,
    Bound,
    Guarded,
    Proposing,
    ShieldGuard,
    ShieldOptions,
    StepGuard,
    proposing_agent,
    proposing_agents,
    read_options,
)


class HybridAgent(AgentAround):
    """Drives by ``policy`` in the worlds where its rolled-out harm is at most ``H*``, else by E-V2X-BM.

    ``bound`` says which ``H*`` and ``a*``; ``harm_count`` which harm counts. Its memory holds ``chosen_policy`` [n],
    who drives; ``policy_harm`` [n] and ``bound_harm`` [n] were compared, ``predicted_harm`` [n] is the lower one.
    Raises ``InvalidInput`` for an unknown ``bound`` or ``harm_count``, and for what is not an agent.
    """

    adds = Source.MODEL  # in which both are compared

    def __init__(
        self, policy: Agent, scenario: Scenario, *, bound: Bound = "coupled", harm_count: HarmCount = "first"
    ) -> None:
        check_agent(policy, "hybrid")
        check_scenario(scenario, "hybrid")
        super().__init__(policy, f"{policy.name}+episode{'' if bound == 'coupled' else ':pairwise'}")
        self.backup = EV2XBM(bound, harm_count=harm_count, horizon_s=scenario.horizon_s)
        self.scenario = scenario
        self.bound: Bound = bound
        self.harm_count: HarmCount = harm_count

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Choose in these worlds."""
        policy = begin_script(self.policy, alert, vehicle, scripts)
        backup = begin_script(self.backup, alert, vehicle, scripts)
        policy_harm = self._harm(alert, self.policy, vehicle)
        bound = backup["predicted_harm"]
        if self.bound == "coupled":
            bound = self._harm(alert, FixedCommand(-backup["deceleration_mps2"]), vehicle)
        return {
            "policy": policy, "backup": backup, "policy_harm": policy_harm, "bound_harm": bound,
            "predicted_harm": np.minimum(policy_harm, bound), "chosen_policy": policy_harm <= bound,
        }  # fmt: skip

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Wanted signed acceleration of the chosen strategy, [n] m/s2."""
        command, policy = ask_script(self.policy, worlds, memory["policy"], vehicle)
        constant, _ = self.backup.act(worlds, memory["backup"], vehicle)
        return np.where(memory["chosen_policy"], command, constant), {**memory, "policy": policy}

    def _harm(self, worlds: Worlds, agent: Agent, vehicle: int) -> Floats:
        return drive(worlds, agent, self.scenario, vehicle).ledger.world_harm(self.harm_count)


class FixedCommand:
    """One given command per world, for all of its episode."""

    name = "fixed"

    def __init__(self, command_mps2: Floats) -> None:
        self.command_mps2 = command_mps2

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The command of each world, [n] m/s2."""
        return self.command_mps2


ROUNDING = 1e-6  # of an action in 32 bits


class EpisodeGuard(ShieldGuard):
    """Mode ``episode``: ``HybridAgent`` chooses who drives at each alert, whatever is proposed.

    A proposal counts as replaced where it differs by more than the rounding of its 32 bits.
    """

    def _make(self) -> None:
        (policy,) = self._policies.values()
        self._hybrid = HybridAgent(policy, self.scenario, bound=self.options.bound, harm_count=self.options.harm_count)
        self._policies = {}  # the hybrid asks

    def _started(self, shield: Memory, alert: Worlds, rows: Ints) -> Memory:
        begun = begin_script(self._hybrid, alert, self.vehicles[0], self.scripts)
        return begun if shield is None else renew_memory(shield, rows, begun)

    def decide(self, running: Engine, memory: Guarded, proposed: Floats) -> Ruling:
        """What the chosen agent does."""
        worlds = running.worlds
        command, hybrid = ask_script(self._hybrid, worlds, memory.shield, self.vehicles[0])
        applied = command_to_action(command, worlds.vehicles, self.vehicles[0])[:, np.newaxis]
        memory = memory._replace(shield=hybrid)
        return Ruling(proposed, applied, ~hybrid["chosen_policy"], ~running.ended, None, memory)

    def intervened(self, ruling: Ruling) -> Bools:
        """Where something else was applied than what was proposed, [n, L]."""
        return np.asarray(abs(ruling.applied - ruling.proposed) > ROUNDING, np.bool_)

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Who drives, and what was compared; ``proposed_action`` is NaN where nothing was proposed."""
        compared = {name: memory.shield[name] for name in ("chosen_policy", "policy_harm", "bound_harm")}
        return self._of_step(ruling) | compared


def guard_of(engine: Engine, policy: Proposing | None, options: ShieldOptions) -> ShieldGuard:
    """The guard of the options' mode for all learners of an engine, who proposes among them.

    Raises ``InvalidInput`` where nobody learns, for several learners in another mode than ``step``, and for what is no
    policy.
    """
    where, mode, scenario, vehicles = options.where, options.mode, engine.scenario, engine.learners
    if not vehicles:
        raise InvalidInput(
            f"{where}: no vehicle of scenario {scenario.name!r} learns, so there is nobody to shield; pass"
            " learners=['vehicle_2'] to the environment"
        )
    if mode != "step":
        check_one_learner(
            scenario.name,
            [scenario.vehicle_names[i] for i in vehicles],
            f"{where} needs exactly one learner in mode {mode}: what it certifies is known only if every other vehicle"
            " follows a script; mode step shields several together; or pass learners=['vehicle_2'] to the environment",
        )
    if mode == "episode":
        return EpisodeGuard(engine, {vehicles[0]: proposing_agent(policy, where)}, options)
    policies = {} if policy is None else proposing_agents(policy, vehicles, where)
    if options.believed:
        return BelievedGuard(engine, policies, options)
    return StepGuard(engine, policies, options, warns=True)


class Attached:
    """A guard in the engine of an environment, for the wrapper that put it there.

    Raises ``InvalidInput`` for what is not one of this package's environments, or is shielded already.
    """

    def __init__(
        self, env: object, interface: type, maker: str, policy: Proposing | None, where: str, options: Mapping[str, Any]
    ) -> None:
        self.options, self._env = read_options(where, options), env
        engine = self._reached()
        if isinstance(engine, Engine) and isinstance(engine.guard, ShieldGuard):
            first = engine.guard.options
            raise InvalidInput(
                f"{where}: a {first.where} (mode {first.mode}) shields this environment already, and its bound"
                " holds for one shield alone; give that one other options, or close() it first"
            )
        if isinstance(getattr(env, "attached", None), Attached):
            raise InvalidInput(f"{where}: {env} is a shield that was closed; put this one around what that is around")
        if not (isinstance(env, interface) and isinstance(engine, Engine)):
            raise InvalidInput(
                f"{where}: goes around {maker}, not {env}; eb.shield(env) chooses the one for an environment of ours"
            )
        self.engine, self._left = engine, Guarded(None, {})
        self.guard = guard_of(engine, policy, self.options)
        engine.protect(self.guard)

    @property
    def memory(self) -> Guarded:
        """What the guard remembers now, or, once it was closed, remembered last."""
        memory: Guarded | None = self.engine.guarded if self.engine.guard is self.guard else self._left
        return Guarded(None, {}) if memory is None else memory

    @property
    def shield(self) -> Any:
        """As it is now, to be read; None before a reset.

        A ``StepShield`` or ``BelievedShield``; in mode ``episode`` what the ``HybridAgent`` remembers.
        """
        return self.memory.shield

    def _reached(self) -> Any:
        """The engine of the environment inside, as it is now."""
        return getattr(getattr(self._env, "unwrapped", self._env), "engine", None)

    def check_open(self) -> None:
        """Raise ``InvalidInput`` where this shield bounds nothing: it was closed, or another environment is inside."""
        if self._reached() is not self.engine:
            raise InvalidInput(
                f"{self.options.where}: another environment is inside than the one that is shielded; put a shield"
                " around that one"
            )
        if self.engine.guard is not self.guard:
            raise InvalidInput(f"{self.options.where}: this shield was closed; put a new one around the environment")

    def close(self) -> None:
        """Let go of the engine."""
        if self.engine.guard is self.guard:
            self._left = self.memory
            self.engine.protect(None)

    def penalty(self) -> Floats:
        """What the interventions of the last step take off the rewards, [n, L]."""
        self.check_open()
        ruling = self.engine.ruling
        if ruling is None:
            return np.zeros((self.engine.n, len(self.engine.learners)))
        intervened = self.guard.intervened(ruling) & ruling.asked[:, np.newaxis]
        return np.asarray(self.options.intervention_penalty * intervened, np.float64)
