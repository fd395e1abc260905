"""The paper's hybrid (Algorithm 1): at the alert, choose between policy and baseline for the whole episode.

The policy is rolled out in the engine from the alert on. Its harm, each impact summed once, is compared with the
baseline's ``H*``; whichever is lower drives the episode.

With the coupled ``H*``, realised in the same engine, the hybrid is never worse than the baseline in any world, as long
as the policy drives as it did in the rollout. A policy that draws its actions does not, and needs the step shield. With
the paper's pairwise ``H*`` this does not hold: it treats the two pairs as independent, and is about half of the harm
that the same deceleration realises.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from ethbrake_marl.agents.driving import drive
from ethbrake_marl.agents.e_v2x_bm.coupled import EV2XBM
from ethbrake_marl.agents.protocol import Agent, AgentAround, Source, check_agent
from ethbrake_marl.engine.engine import Engine, Ruling
from ethbrake_marl.engine.memory import Memory, ask_script, begin_script, renew_memory
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.game.actions import command_to_action
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.checks import check_scenario
from ethbrake_marl.shield.contract import Guarded, ShieldGuard, ShieldMode

Bound = Literal["coupled", "pairwise"]  # whose H* and a*: of the engine's physics, or the paper's closed form


class HybridAgent(AgentAround):
    """Drive by ``policy`` in the worlds where its rolled-out harm is at most ``H*``, else by E-V2X-BM.

    ``bound`` chooses ``H*`` and ``a*``, ``harm_count`` the harm that counts. The memory holds ``chosen_policy`` [n],
    where the policy drives; ``policy_harm`` [n] and ``bound_harm`` [n], which were compared; and ``predicted_harm``
    [n], the lower one of the two. Raises ``InvalidInput`` for an unknown ``bound`` or ``harm_count``, and for what is
    not an agent.
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
        """Roll the policy out, and choose in each world."""
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
    """One command per world, held for the whole episode."""

    name = "fixed"

    def __init__(self, command_mps2: Floats) -> None:
        self.command_mps2 = command_mps2

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The command of each world, [n] m/s2."""
        return self.command_mps2


ROUNDING = 1e-6  # of an action in 32 bits


class EpisodeGuard(ShieldGuard):
    """Mode ``episode``: the hybrid chooses who drives at each alert, whatever is proposed.

    A proposal counts as replaced where it differs from the applied action by more than the rounding of 32 bits.
    """

    def __init__(self, engine: Engine, hybrid: HybridAgent, *, where: str = "shield") -> None:
        super().__init__(engine, {}, None, mode=ShieldMode.EPISODE, where=where)  # the hybrid asks its policy itself
        self._hybrid = hybrid

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
