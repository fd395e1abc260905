"""The paper's hybrid (Algorithm 1): at the alert, choose the policy or the baseline for the whole episode.

The policy is rolled out (simulated) in the engine from the alert on. The harm of this rollout is compared with ``H*``,
the harm of the baseline E-V2X-BM. The policy or the baseline, whichever does less harm, drives the whole episode.

The coupled ``H*`` is computed in the same engine as the policy's harm. With the coupled ``H*``, the hybrid does at most
the harm of the baseline in every world, provided that the policy drives exactly as in its rollout. A policy with random
actions does not repeat its rollout; use the step shield for such a policy. With the paper's pairwise ``H*`` there is no
guarantee. The pairwise ``H*`` is only about half of the harm that E-V2X-BM's deceleration causes in the engine.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import EV2XBM
from ethbrake_marl.first_edition.agents.protocol import Agent, AgentAround, Source, check_agent
from ethbrake_marl.first_edition.engine.engine import Engine, Ruling
from ethbrake_marl.first_edition.engine.memory import Memory, ask_script, begin_script, renew_memory
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.game.actions import command_to_action
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.messages import refuse_untold
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.checks import check_scenario
from ethbrake_marl.first_edition.shields.contract import Guarded, ShieldGuard, ShieldMode

Bound = Literal["coupled", "pairwise"]  # method to compute H* and a*: the engine's physics, or the paper's closed form


class HybridAgent(AgentAround):
    """Agent that drives by ``policy`` where the policy's rollout does at most the harm ``H*``, otherwise by E-V2X-BM.

    Args:
        policy: the agent that is compared with E-V2X-BM in each world, and chosen or rejected.
        scenario: the scenario in which ``policy`` and E-V2X-BM are compared.
        bound: method to compute E-V2X-BM's deceleration and ``H*``: ``coupled`` (the engine's physics) or ``pairwise``
            (the paper's closed form).
        harm_count: which harm is compared: ``first`` (first impact of each pair) or ``total`` (every impact).

    The memory contains ``chosen_policy`` [n], True where the policy drives; ``policy_harm`` [n], the harm of the
    policy's rollout; ``bound_harm`` [n], which is ``H*``; and ``predicted_harm`` [n], the lower of these two harms.
    Raises ``InvalidInput`` for an unknown ``bound`` or ``harm_count``, and if ``policy`` is not an agent.

    """

    adds = Source.MODEL  # policy and baseline are compared in the true model

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
        """Simulate the policy's episode, choose the driver of each world, and return the memory."""
        refuse_untold(alert, [vehicle], f"agent {self.name!r}")
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
        """Return the command of the driver that ``begin`` chose at the alert, [n] m/s2, and the new memory."""
        command, policy = ask_script(self.policy, worlds, memory["policy"], vehicle)
        constant, _ = self.backup.act(worlds, memory["backup"], vehicle)
        return np.where(memory["chosen_policy"], command, constant), {**memory, "policy": policy}

    def _harm(self, worlds: Worlds, agent: Agent, vehicle: int) -> Floats:
        return drive(worlds, agent, self.scenario, vehicle).ledger.world_harm(self.harm_count)


class FixedCommand:
    """Agent that holds the command ``command_mps2`` [n] of each world for the whole episode."""

    name = "fixed"

    def __init__(self, command_mps2: Floats) -> None:
        self.command_mps2 = command_mps2

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Return the fixed command of each world, [n] m/s2."""
        return self.command_mps2


ROUNDING = 1e-6  # rounding error of an action in 32 bits


class EpisodeGuard(ShieldGuard):
    """Guard of mode ``episode``: at each alert the agent ``hybrid`` chooses the driver of the whole episode.

    The driver is either the policy inside ``hybrid`` or E-V2X-BM, whatever actions the caller proposes. A proposal
    counts as replaced if it differs from the applied action by more than the rounding error of a 32-bit number. Error
    messages begin with ``where``.
    """

    def __init__(self, engine: Engine, hybrid: HybridAgent, *, where: str = "shield") -> None:
        super().__init__(engine, {}, None, mode=ShieldMode.EPISODE, where=where)  # the hybrid queries its policy itself
        self._hybrid = hybrid

    def _started(self, shield: Memory, alert: Worlds, rows: Ints) -> Memory:
        memory = begin_script(self._hybrid, alert, self.vehicles[0], self.scripts)
        return memory if shield is None else renew_memory(shield, rows, memory)

    def decide(self, running: Engine, memory: Guarded, proposed: Floats) -> Ruling:
        """Return the actions of the driver that was chosen at the alert; the proposed actions have no effect."""
        worlds = running.worlds
        command, hybrid = ask_script(self._hybrid, worlds, memory.shield, self.vehicles[0])
        applied = command_to_action(command, worlds.vehicles, self.vehicles[0])[:, np.newaxis]
        memory = memory._replace(shield=hybrid)
        return Ruling(proposed, applied, ~hybrid["chosen_policy"], ~running.ended, None, memory)

    def intervened(self, ruling: Ruling) -> Bools:
        """Return whether the decision ``ruling`` replaced the proposed action, [n, 1]."""
        return np.asarray(abs(ruling.applied - ruling.proposed) > ROUNDING, np.bool_)

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Return the infos by name: chosen driver, harm of the policy, harm of E-V2X-BM (each [n]), and the actions.

        The info ``proposed_action`` is NaN where no action was proposed.
        """
        compared = {name: memory.shield[name] for name in ("chosen_policy", "policy_harm", "bound_harm")}
        return self._of_step(ruling) | compared
