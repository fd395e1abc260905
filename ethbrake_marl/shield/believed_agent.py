"""The agent that drives by a policy behind a shield over a believed world."""

from __future__ import annotations

from ethbrake_marl.agents.believing import SUFFIX
from ethbrake_marl.agents.knowledge import Source
from ethbrake_marl.agents.protocol import Agent, AgentAround, check_agent
from ethbrake_marl.agents.rollout import script_agents, set_others
from ethbrake_marl.engine.stream import begin_script
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.believed import BelievedShield
from ethbrake_marl.shield.interior import CORNERS
from ethbrake_marl.shield.rollouts import proposed_action


class BelievedShieldAgent(AgentAround):
    """Drives by ``policy`` as far as a ``BelievedShield`` certifies it: ``POLICY+step:believed``, ``+robust:believed``.

    ``robust`` is None, ``corners`` or ``interior``. Raises ``InvalidInput`` for what is not an agent, and what
    ``BelievedShield`` raises.
    """

    adds = Source.BELIEFS

    def __init__(
        self, policy: Agent, scenario: Scenario, *, harm_count: HarmCount = "first", robust: str | None = None
    ) -> None:
        check_agent(policy, SUFFIX)
        mode = "step" if robust is None else "robust" if robust == CORNERS else f"robust:{robust}"
        super().__init__(policy, f"{policy.name}+{mode}:{SUFFIX}")
        self.scenario = scenario
        self.believed = BelievedShield(scenario, harm_count=harm_count, robust=robust)

    @property
    def predicted_harm(self) -> Floats:
        """The first bound, [n] m2/s2; NaN before the first decision."""
        return self.believed.predicted_harm

    @property
    def interventions(self) -> Ints:
        """How many proposals were replaced so far in the running episodes, [n]."""
        return self.believed.interventions

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Remember where these episodes start; nothing has been received yet."""
        self.believed.begin(worlds, vehicle, rows)
        set_others(self.policy, vehicle, script_agents(self.scenario, except_for=vehicle))
        begin_script(self.policy, worlds, vehicle, rows)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The certified command, [n] m/s2. Raises ``InvalidInput`` if an episode never began."""
        policies = {vehicle: self.policy}
        return self.believed.decide(worlds, vehicle, lambda: proposed_action(self.policy, worlds, vehicle), policies)
