"""The paper's hybrid (Algorithm 1): at the alert, choose between policy and baseline for the whole episode.

The policy is rolled out in the engine from the alert on; its harm (each impact summed once) is compared with the
baseline's ``H*`` and the lower one drives the episode. With ``H*`` coupled (realised in the same engine) the hybrid
is never worse than the baseline, in any world. With the paper's pairwise ``H*``, which treats the two pairs as
independent, that does not hold: the pairwise figure is about half of what the same deceleration realises.
"""

from __future__ import annotations

import copy
from typing import Literal

import numpy as np

from ethbrake_marl.agents.driving import drive, introduce, scripted
from ethbrake_marl.agents.e_v2x_bm import EV2XBM
from ethbrake_marl.agents.knowledge import Knowledge, Source, combined
from ethbrake_marl.agents.protocol import Agent, check_agent, place, recall
from ethbrake_marl.agents.rehearsed import Rehearsed
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.settings import check_scenario

Bound = Literal["coupled", "pairwise"]


class HybridAgent:
    """Drives by ``policy`` in the worlds where its rolled-out harm is at most ``H*``, else by E-V2X-BM.

    ``bound`` says which ``H*`` and ``a*``; ``count`` which harm counts. After ``begin``, ``chosen_policy`` [n] says
    who drives; ``policy_harm`` [n] and ``bound_harm`` [n] were compared and ``predicted_harm`` [n] is the lower one.
    Raises ``InvalidInput`` for an unknown ``bound`` or ``count``, and for what is not an agent.
    """

    def __init__(
        self, policy: Agent, scenario: Scenario, *, bound: Bound = "coupled", count: HarmCount = "first"
    ) -> None:
        check_agent(policy, "hybrid")
        check_scenario(scenario, "hybrid")
        self.policy = policy
        self.backup = EV2XBM(bound, count=count, horizon_s=scenario.horizon_s)
        self.scenario = scenario
        self.bound: Bound = bound
        self.count: HarmCount = count
        self.name = f"hybrid({policy.name})" if bound == "coupled" else f"hybrid:pairwise({policy.name})"
        self.policy_harm: Floats = np.zeros(0)
        self.bound_harm: Floats = np.zeros(0)
        self._rehearsal = copy.deepcopy(policy)  # predicting must not disturb the policy's memory of running episodes

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, and the model in which both are compared."""
        return combined(self.policy, also=Source.MODEL)

    @property
    def chosen_policy(self) -> Bools:
        """Where the policy drives, [n]."""
        chosen: Bools = self.policy_harm <= self.bound_harm
        return chosen

    @property
    def predicted_harm(self) -> Floats:
        """Harm expected at the alert, [n] m2/s2."""
        return np.minimum(self.policy_harm, self.bound_harm)

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Choose for these rows; ``worlds`` holds those rows only, at the alert."""
        scripts = scripted(self.scenario, but=vehicle)
        for agent in (self.policy, self.backup):
            introduce(agent, vehicle, scripts)
            agent.begin(worlds, vehicle, rows)
        if isinstance(self.policy, Rehearsed):  # was rolled out just now
            policy_harm = self.policy.predicted_harm[rows]
        else:
            policy_harm = self._harm(worlds, self._rehearsal, vehicle)
        bound = self.backup.predicted_harm[rows]
        if self.bound == "coupled":
            bound = self._harm(worlds, FixedCommand(-self.backup.deceleration_mps2[rows]), vehicle)
        self.bound_harm = place(self.bound_harm, rows, bound)
        self.policy_harm = place(self.policy_harm, rows, policy_harm)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Wanted signed acceleration of the chosen strategy, [n] m/s2."""
        self.policy_harm = recall(self.policy_harm, worlds.n, self.name)  # of this batch; an earlier one may be larger
        self.bound_harm = recall(self.bound_harm, worlds.n, self.name)
        return np.where(self.chosen_policy, self.policy.act(worlds, vehicle), self.backup.act(worlds, vehicle))

    def _harm(self, worlds: Worlds, agent: Agent, vehicle: int) -> Floats:
        return drive(worlds, agent, self.scenario, vehicle).ledger.world_harm(self.count)


class FixedCommand:
    """One given command per world, for all of its episode."""

    name = "fixed"

    def __init__(self, command_mps2: Floats) -> None:
        self.command_mps2 = command_mps2

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Nothing to prepare."""

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The command of each world, [n] m/s2."""
        return self.command_mps2
