"""The agent ``AGENT+search``: at the alert it improves the commands of AGENT by a search, and drives the result."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ethbrake_marl.errors import check_whole_number
from ethbrake_marl.extensions.search.outlook import MOST_CANDIDATES, Outlook
from ethbrake_marl.extensions.search.refine import refine
from ethbrake_marl.first_edition.agents.driving import record_commands
from ethbrake_marl.first_edition.agents.protocol import Agent, AgentAround, Source, check_agent, fixed_commands
from ethbrake_marl.first_edition.agents.settings import AgentSettings
from ethbrake_marl.first_edition.engine.memory import Memory
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.game.harm import HarmCount, check_harm_count
from ethbrake_marl.first_edition.physics.episode import CLOCK
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.registry import Part


class Searched(AgentAround):
    """Agent that improves another agent's commands by a search at the alert, and then drives the best commands.

    The search simulates the line; all vehicles but the controlled one follow their scripts. After the search the agent
    does not react to what it observes. ``predicted_harm`` [n] (m2/s2) is never above the harm of the agent ``policy``.
    If the other vehicles follow their scripts, ``predicted_harm`` equals the simulated harm exactly. Raises
    ``InvalidInput`` if ``policy`` is not an agent, or if ``candidates`` is outside 1 to 1,000,000. ``begin`` raises
    ``InvalidInput`` if the command of another vehicle's script is not fixed at the alert.

    Args:
        policy: agent; the search starts from the commands of this agent.
        scenario: scenario of the worlds; the search minimises the scenario's objective.
        candidates: number of command sequences that the search simulates in each world.
        harm_count: harm count to minimise, ``first`` or ``total``.

    >>> import ethbrake_marl.first_edition as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> searched = eb.make_agent("constant:5+search", scenario=scenario)
    >>> outcome = eb.evaluate(scenario.sample(2, seed=7), {"searched": searched}, scenario=scenario).outcome("searched")
    >>> bool((outcome.first_impact_harm == outcome.predicted_harm).all())
    True

    """

    adds = Source.MODEL

    def __init__(
        self, policy: Agent, scenario: Scenario, *, candidates: int = 500, harm_count: HarmCount = "first"
    ) -> None:
        check_agent(policy, "search")
        check_whole_number("search: candidates", candidates, 1, MOST_CANDIDATES)
        check_harm_count(harm_count)
        super().__init__(policy, f"{policy.name}+search")
        self.scenario, self._candidates = scenario, candidates
        self._outlook = Outlook(harm_count, scenario.horizon_s, scenario.time_step_s, scenario.objective)

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Simulate the policy's episode, improve its commands by a search, and return the best commands as memory."""
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        problem = self._outlook.problem(alert, vehicle, others)
        own = record_commands(self.policy, alert, self.scenario, vehicle, int(problem.last_step.max()))
        commands, harm = refine(problem, own, budget=self._candidates)
        return {
            "commands_mps2": np.pad(commands, ((0, 0), (0, self._outlook.decisions - own.shape[1])), mode="edge"),
            "start_s": problem.clock[:, CLOCK.START].copy(),  # time of the first decision
            "predicted_harm": harm,
        }

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Return the command of the present step, [n] m/s2, and the unchanged memory. ``vehicle`` is not used."""
        return self._outlook.command(worlds, memory), memory


def search_around(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """Return the agent ``+search``; ``argument`` has no effect."""
    return Searched(policy, settings.needed_scenario(), harm_count=settings.harm_count)


SEARCH = Part(
    search_around,
    form="+search",
    about="drives the best commands that a search around the agent's own commands finds at the alert",
    knows=Source.MODEL,
    inner=True,
)
