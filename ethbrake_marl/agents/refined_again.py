"""The compiled refinement once more at every decision, from the worlds as they are then."""

from __future__ import annotations

import re
import time
from typing import ClassVar

import numpy as np

from ethbrake_marl.agents.protocol import Agent, fixed_commands, place, recall
from ethbrake_marl.agents.refined_profile import RefinedProfile
from ethbrake_marl.agents.rollout import script_agents
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.physics.episode import decision_at
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search.problem import ProfileProblem
from ethbrake_marl.search.refine import Refinement, refine_commands

ROUND = 50  # candidates between two looks at the clock
MOST_CANDIDATES, MOST_MICROSECONDS = 1_000_000, 60_000_000
_ARGUMENT = re.compile(r"(?P<number>[1-9][0-9]{0,7})(?P<unit>us)?")


class RefinedAgain(RefinedProfile):
    """Drives the first command of a plan that begins as the policy's own episode and is searched around ever again.

    Each decision begins with what is left of the last plan, from the worlds as they have become: where another vehicle
    does not follow its script, the next plan knows. If all do, ``predicted_harm`` [n] (m2/s2) is what the plan at the
    alert leads to, and the later ones lead to no more. Raises ``InvalidInput`` as ``RefinedProfile``.

    Args:
        policy: any agent.
        scenario: in which it searches.
        argument: candidates per world and decision (deterministic), or a time like ``200us`` for each (as many rounds
            as fit, at least one; depends on the machine).
        harm_count: which harm is least, ``first`` or ``total``.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> refined = eb.make_agent("constant:5+refined:20", scenario=scenario)
    >>> outcome = eb.evaluate(scenario.sample(2, seed=7), {"refined": refined}, scenario=scenario).outcome("refined")
    >>> bool((outcome.first_impact_harm <= outcome.predicted_harm).all())
    True

    """

    divides_along: ClassVar[tuple[str, ...]] = (*RefinedProfile.divides_along, "_others_mps2", "_planned_s")

    def __init__(self, policy: Agent, scenario: Scenario, argument: str, *, harm_count: HarmCount = "first") -> None:
        candidates, self._microseconds = _budget(argument)
        super().__init__(policy, scenario, candidates=candidates, harm_count=harm_count)
        self.name = f"{policy.name}+refined:{argument}"
        self._others_mps2: Floats = np.empty((0, scenario.vehicles))  # [n, N]
        self._planned_s: Floats = np.empty(0)  # [n] when the plan was made

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Make the first plan of these rows' episodes."""
        super().begin(worlds, vehicle, rows)
        scripts = script_agents(self.scenario, except_for=vehicle)
        others = fixed_commands(scripts, worlds, f"agent {self.name!r}", vehicle=vehicle)
        self._others_mps2 = place(self._others_mps2, rows, others)
        self._planned_s = place(self._planned_s, rows, self._start_s[rows])

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The first command of the new plans, [n] m/s2. Raises ``InvalidInput`` if an episode never began."""
        planned = recall(self._planned_s, worlds.n, self.name)
        moving = (worlds.speeds_mps != 0.0).any(axis=1)
        rows = np.flatnonzero((worlds.time_s > planned) & (worlds.time_s < self.scenario.horizon_s) & moving)
        if rows.size:
            self._plan_again(worlds.take(rows), vehicle, rows)
        return super().act(worlds, vehicle)

    def _plan_again(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Search around what is left of the plans of ``rows``; ``worlds`` holds those rows only, as they are now."""
        problem = self._problem(worlds, vehicle, self._others_mps2[rows])
        step = decision_at(worlds.time_s, self._start_s[rows], self.scenario.time_step_s)
        later = step[:, np.newaxis] + np.arange(int(problem.last_step.max()))
        last = self._commands.shape[1] - 1
        left = self._commands[rows[:, np.newaxis], np.minimum(later, last)]
        found = self._search(problem, left).commands_mps2
        inside = later <= last
        self._commands[np.broadcast_to(rows[:, np.newaxis], later.shape)[inside], later[inside]] = found[inside]
        self._planned_s[rows] = worlds.time_s

    def _search(self, problem: ProfileProblem, commands_mps2: Floats) -> Refinement:
        """The best that is found around these commands in the budget."""
        stop = time.perf_counter() + 1e-6 * self._microseconds * problem.n
        found, seed = refine_commands(problem, commands_mps2, budget=self.candidates), 0
        while time.perf_counter() < stop:
            seed += 1
            found = refine_commands(problem, found.commands_mps2, budget=self.candidates, seed=seed)
        return found


def _budget(argument: str) -> tuple[int, int]:
    """Candidates per decision or round, and microseconds (0: exactly one round)."""
    match = _ARGUMENT.fullmatch(argument)
    if match is not None:
        number = int(match["number"])
        if match["unit"] and number <= MOST_MICROSECONDS:
            return ROUND, number
        if not match["unit"] and number <= MOST_CANDIDATES:
            return number, 0
    raise InvalidInput(
        f"+refined:{argument}: must be profile (one search at the alert), a number of candidates per decision, for"
        f" instance 50 (at most {MOST_CANDIDATES:,}), or a time per decision, for instance 200us (at most"
        f" {MOST_MICROSECONDS:,}us)"
    )
