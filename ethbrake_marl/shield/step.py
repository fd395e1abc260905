"""Step mode as an agent: the policy proposes, the shield certifies, every step."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.agents.driving import introduce, scripted
from ethbrake_marl.agents.protocol import Agent, place
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.guard import StepShield


class StepShieldAgent:
    """Drives by ``policy`` as far as ``StepShield`` certifies it.

    At the alert the policy is rolled out once: where it harms no more than the coupled optimum, it drives unhindered,
    and its harm is the bound. Elsewhere each of its actions must be certified. After ``begin``, ``predicted_harm``
    [n] is the bound: realised harm (``count``) is at most that. ``chosen_policy`` [n]: no intervention so far;
    ``shield`` holds the rest. Raises ``InvalidInput`` for what is not an agent, and what ``StepShield`` raises.
    """

    def __init__(
        self,
        policy: Agent,
        scenario: Scenario,
        *,
        count: HarmCount = "first",
        allowance: float = 0.0,
        logging: bool = False,
    ) -> None:
        if not isinstance(policy, Agent):
            raise InvalidInput(f"step: {policy!r} is not an agent; load_policy(path) or make_agent(name) makes one")
        self.name = f"step({policy.name})"
        self.policy = policy
        self.scenario = scenario
        self.shield: StepShield | None = None
        self.predicted_harm: Floats = np.zeros(0)
        self._settings = {"count": count, "allowance": allowance, "logging": logging}
        self._wanted: Floats = np.zeros(0)
        self._make(0)  # refuses bad settings at once

    @property
    def chosen_policy(self) -> Bools:
        """Where everything proposed was applied so far, [n]."""
        assert self.shield is not None
        untouched: Bools = self.shield.interventions == 0
        return untouched

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Find the bound of these rows; ``worlds`` holds those rows only, at the alert."""
        if self.shield is None or self.shield.vehicle != vehicle:
            self.shield = self._make(vehicle)
        introduce(self.policy, vehicle, scripted(self.scenario, but=vehicle))
        self.policy.begin(worlds, vehicle, rows)
        self.shield.begin(worlds, rows, self.policy)
        bound = self.shield.first_bound[rows] + self.shield.allowance
        self.predicted_harm = place(self.predicted_harm, rows, bound)
        self._wanted = place(self._wanted, rows, np.zeros(worlds.n))

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The certified command, [n] m/s2. Asked twice at the same moment, it says the same."""
        shield = self.shield
        if shield is None or shield.running is None or len(self._wanted) != worlds.n:
            raise InvalidInput(f"agent {self.name!r}: act on {worlds.n} worlds, but begin was not called for each")
        proposed = command_to_action(self.policy.act(worlds, vehicle), worlds.vehicles, vehicle)
        due = worlds.time_s == shield.running.time_s
        seen = np.concatenate([worlds.speeds_mps, worlds.gaps_m, worlds.pair_hit], axis=1)
        decision = shield.decide(proposed, seen=seen, only=due)
        self._wanted = np.where(due, shield.commands(decision.applied), self._wanted)
        return self._wanted.copy()

    def _make(self, vehicle: int) -> StepShield:
        return StepShield(self.scenario, vehicle, **self._settings)  # type: ignore[arg-type]
