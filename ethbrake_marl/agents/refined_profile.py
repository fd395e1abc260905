"""The compiled refinement of a policy: a search around its own episode at the alert, which then drives."""

from __future__ import annotations

import copy
from typing import ClassVar

import numpy as np

from ethbrake_marl.agents.knowledge import Source
from ethbrake_marl.agents.protocol import Agent, AgentAround, check_agent, fixed_commands, place, recall
from ethbrake_marl.agents.recorded import record_commands
from ethbrake_marl.agents.rollout import script_agents
from ethbrake_marl.errors import check_whole_number
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.physics.episode import START, decision_at
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search.problem import ProfileProblem, profile_problem
from ethbrake_marl.search.refine import Refinement, refine_commands

CANDIDATES = 500  # per world, at the alert


class RefinedProfile(AgentAround):
    """Drives the commands that a search around the policy's episode found at the alert, step by step.

    It knows the model of the line and the other vehicles' scripts, and does not react to what happens otherwise.
    ``predicted_harm`` [n] (m2/s2) is never above the policy's own, and is realised to the bit if the others follow
    their scripts. A world's commands do not depend on its batch. Raises ``InvalidInput`` for what is not an agent, a
    number of candidates outside 1 to 1,000,000 and, when an episode begins, for another vehicle's script whose command
    is not fixed at the alert.

    Args:
        policy: any agent.
        scenario: in which it searches.
        candidates: tried in each world.
        harm_count: which harm is least, ``first`` or ``total``.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> refined = eb.make_agent("constant:5+refined:profile", scenario=scenario)
    >>> outcome = eb.evaluate(scenario.sample(2, seed=7), {"refined": refined}, scenario=scenario).outcome("refined")
    >>> bool((outcome.first_impact_harm == outcome.predicted_harm).all())
    True

    """

    adds = Source.MODEL
    divides_along: ClassVar[tuple[str, ...]] = ("_commands", "_start_s", "predicted_harm")

    def __init__(
        self, policy: Agent, scenario: Scenario, *, candidates: int = CANDIDATES, harm_count: HarmCount = "first"
    ) -> None:
        check_agent(policy, "refined")
        check_whole_number("refined: candidates", candidates, 1, 1_000_000)
        check_harm_count(harm_count)
        super().__init__(policy, f"{policy.name}+refined:profile")
        self.scenario, self.candidates = scenario, candidates
        self.harm_count: HarmCount = harm_count
        self.predicted_harm: Floats = np.empty(0)
        steps = int(np.ceil(scenario.horizon_s / scenario.time_step_s)) + 1
        self._commands: Floats = np.empty((0, steps))  # [n, steps] m/s2
        self._start_s: Floats = np.empty(0)  # of the first decision
        self._stage = copy.deepcopy(policy)

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Search for these rows; ``worlds`` holds those rows only, at the alert."""
        scripts = script_agents(self.scenario, except_for=vehicle)
        others = fixed_commands(scripts, worlds, f"agent {self.name!r}", vehicle=vehicle)
        problem = self._problem(worlds, vehicle, others)
        own = record_commands(self._stage, worlds, self.scenario, vehicle, int(problem.last_step.max()))
        found = self._search(problem, own)
        more = self._commands.shape[1] - own.shape[1]
        commands = np.pad(found.commands_mps2, ((0, 0), (0, more)), mode="edge")
        self._commands = place(self._commands, rows, commands)
        self._start_s = place(self._start_s, rows, problem.clock[:, START])
        harm = found.first_impact_harm if self.harm_count == "first" else found.total_harm
        self.predicted_harm = place(self.predicted_harm, rows, harm)

    def _problem(self, worlds: Worlds, vehicle: int, others_mps2: Floats) -> ProfileProblem:
        return profile_problem(
            worlds,
            [vehicle],
            harm_count=self.harm_count,
            horizon_s=self.scenario.horizon_s,
            time_step_s=self.scenario.time_step_s,
            others_mps2=others_mps2,
        )

    def _search(self, problem: ProfileProblem, commands_mps2: Floats) -> Refinement:
        """The best that is found around these commands."""
        return refine_commands(problem, commands_mps2, budget=self.candidates)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The command of the step, [n] m/s2. Raises ``InvalidInput`` if an episode never began."""
        start = recall(self._start_s, worlds.n, self.name)
        step = decision_at(worlds.time_s, start, self.scenario.time_step_s)
        at: Floats = self._commands[np.arange(worlds.n), np.clip(step, 0, self._commands.shape[1] - 1)]
        return at
