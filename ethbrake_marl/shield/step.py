"""Step mode as an agent: the policy proposes, the shield certifies, every step."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.actions import action_to_command
from ethbrake_marl.agents.driving import introduce, scripted
from ethbrake_marl.agents.knowledge import Knowledge, Source, combined
from ethbrake_marl.agents.profile_problem import state_columns
from ethbrake_marl.agents.protocol import Agent, check_agent, place
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.guard import StepShield
from ethbrake_marl.shield.rollouts import Proposer, proposed_action
from ethbrake_marl.shield.uncertainty import Uncertainty, checked_uncertainty


def first_decision_s(worlds: Worlds, vehicle: int) -> Floats:
    """Time of a vehicle's first decision in worlds at the alert, [n] s."""
    return np.maximum(worlds.vehicles.latency_s[:, vehicle], worlds.time_s)


class StepShieldAgent:
    """Drives by ``policy`` as far as ``StepShield`` certifies it.

    At the alert the policy is rolled out once: where it harms no more than the coupled optimum, it drives unhindered,
    and its harm is the bound. Elsewhere each of its actions must be certified: by the rest of the plan, by a constant,
    or (``later_rollouts``) by the policy itself, rolled out from the state after the action. After ``begin``,
    ``predicted_harm`` [n] is the bound: realised harm (``count``) is at most that. ``chosen_policy`` [n]: no
    intervention so far; ``shield`` holds the rest. Raises ``InvalidInput`` for what is not an agent, and what
    ``StepShield`` raises.

    With an ``uncertainty`` this is robust mode: what is certified must hold in every member. ``believed`` (row k for
    row k of the batch) is what the shield takes for the worlds at the alert; the policy sees the worlds themselves.
    """

    def __init__(
        self,
        policy: Agent,
        scenario: Scenario,
        *,
        count: HarmCount = "first",
        allowance: float = 0.0,
        logging: bool = False,
        later_rollouts: bool = True,
        uncertainty: Uncertainty | str | None = None,
        believed: Worlds | None = None,
    ) -> None:
        check_agent(policy, "step")
        if not (believed is None or isinstance(believed, Worlds)):
            raise InvalidInput(f"step: believed = {believed!r}: must be worlds at the alert, or None")
        uncertainty = checked_uncertainty(uncertainty)
        self.name = f"{'step' if uncertainty is None else 'robust'}({policy.name})"
        self.policy = policy
        self.scenario = scenario
        self.shield: StepShield | None = None
        self.predicted_harm: Floats = np.zeros(0)
        self._believed = believed
        self._settings = {"count": count, "allowance": allowance, "logging": logging, "uncertainty": uncertainty}
        self._later_rollouts = later_rollouts
        self._wanted: Floats = np.zeros(0)
        self._first_s: Floats = np.zeros(0)  # [n] time of the first decision
        self._make(0)  # refuses bad settings at once

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, and the model in which its actions are certified."""
        return combined(self.policy, also=Source.MODEL)

    @property
    def chosen_policy(self) -> Bools:
        """Where everything proposed was applied so far, [n]."""
        assert self.shield is not None
        untouched: Bools = self.shield.interventions == 0
        return untouched

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Find the bound of these rows; ``worlds`` holds those rows only, at the alert."""
        if self._believed is not None and not (rows < self._believed.n).all():
            raise InvalidInput(f"step: believed holds {self._believed.n} worlds, but row {rows.max()} begins")
        if self.shield is None or self.shield.vehicle != vehicle:
            self.shield = self._make(vehicle)
        introduce(self.policy, vehicle, scripted(self.scenario, but=vehicle))
        self.policy.begin(worlds, vehicle, rows)
        self.shield.begin(worlds if self._believed is None else self._believed.take(rows), rows, self.policy)
        bound = self.shield.first_bound[rows] + self.shield.allowance
        self.predicted_harm = place(self.predicted_harm, rows, bound)
        self._wanted = place(self._wanted, rows, np.zeros(worlds.n))
        self._first_s = place(self._first_s, rows, first_decision_s(worlds, vehicle))

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The certified command, [n] m/s2. Asked twice at the same moment, it says the same."""
        shield = self.shield
        if shield is None or shield.running is None or len(self._wanted) < worlds.n:
            raise InvalidInput(f"agent {self.name!r}: act on {worlds.n} worlds, but begin was not called for each")
        if len(self._wanted) > worlds.n:  # a smaller batch has begun
            shield.keep(worlds.n)
            self.predicted_harm, self._wanted, self._first_s = (
                values[: worlds.n] for values in (self.predicted_harm, self._wanted, self._first_s)
            )
        proposed = proposed_action(self.policy, worlds, vehicle)
        due = worlds.time_s == self._first_s + shield.running.steps * self.scenario.time_step_s
        seen = state_columns(worlds)
        proposer = Proposer(self.policy, worlds) if self._later_rollouts else None
        decision = shield.decide(proposed, seen=seen, only=due, proposer=proposer)
        self._wanted = np.where(due, action_to_command(decision.applied, worlds.vehicles, vehicle), self._wanted)
        return self._wanted.copy()

    def _make(self, vehicle: int) -> StepShield:
        return StepShield(self.scenario, vehicle, **self._settings)  # type: ignore[arg-type]
