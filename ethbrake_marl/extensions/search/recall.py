"""``best_harm``: an agent that drives the best known profile of a world, from a table or from a search at the alert."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ethbrake_marl.errors import InvalidInput, renumbered
from ethbrake_marl.extensions.search.outlook import MOST_CANDIDATES, Outlook, budget_of
from ethbrake_marl.extensions.search.problem import search_profiles
from ethbrake_marl.extensions.search.refine import refine
from ethbrake_marl.extensions.search.shipped import shipped_profiles
from ethbrake_marl.first_edition.agents.driving import record_commands
from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.protocol import Agent, Source, fixed_commands
from ethbrake_marl.first_edition.agents.settings import AgentSettings
from ethbrake_marl.first_edition.engine.memory import Memory
from ethbrake_marl.first_edition.engine.profiles import TIME_STEP_S, Profiles
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.game.harm import HarmCount, check_harm_count
from ethbrake_marl.first_edition.physics.episode import CLOCK
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.registry import Part

PROFILE_BUDGET = 20_000  # candidates in a world that is in no table

START = "universal"  # policy whose episode a search also starts from


class BestHarm:
    """Agent that drives the command profile with the least known harm.

    In a world without a stored profile, the agent searches for a profile at the alert. If the controlled vehicle is the
    only learner, a second search follows. It starts from the better one of two profiles: the result of the first
    search, and the commands of the shipped policy ``universal``. Therefore the result is never worse than
    ``universal``. If the environment has the agent's time step, the simulated harm is exactly ``predicted_harm`` [n]
    (m2/s2). Raises ``InvalidInput`` if ``budget`` is below 1 or ``harm_count`` is unknown. ``begin`` raises
    ``InvalidInput`` if the command of another vehicle's script is not fixed at the alert.

    Args:
        scenario: scenario of the worlds; the agent minimises the scenario's objective (if it is not ``total``, the
            agent uses no stored profile and searches every world). If ``scenario`` is None, the agent minimises the
            harm of the line, and does not search a second time.
        harm_count: harm count to minimise, ``first`` or ``total``.
        horizon_s: end of the episode, s.
        budget: number of profiles that each search simulates in a world without a stored profile.
        time_step_s: time between two decisions, s.

    """

    name = "best_harm"
    knows = Source.MODEL

    def __init__(
        self,
        *,
        scenario: Scenario | None = None,
        harm_count: HarmCount = "first",
        horizon_s: float = 8.0,
        budget: int = PROFILE_BUDGET,
        time_step_s: float = TIME_STEP_S,
    ) -> None:
        if not budget >= 1:
            raise InvalidInput(f"best_harm: budget = {budget}: the number of profiles to try must be at least 1")
        check_harm_count(harm_count)
        self._budget, self._scenario = budget, scenario
        self._outlook = Outlook(harm_count, horizon_s, time_step_s, "total" if scenario is None else scenario.objective)

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Read the stored profiles, search the worlds without a stored profile, and return the commands as memory."""
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        problem, outlook = self._outlook.problem(alert, vehicle, others), self._outlook
        profiles, known = shipped_profiles(problem, outlook.harm_count)
        if outlook.objective != "total":  # the stored profiles minimise the harm of the line
            known = np.zeros(alert.n, np.bool_)
        harm, commands = problem.values(profiles)[outlook.harm_count], self._stepwise(profiles)
        unknown = np.flatnonzero(~known)
        if unknown.size:
            with renumbered(unknown):
                commands[unknown], harm[unknown] = self._search(alert.take(unknown), vehicle, others[unknown])
        return {
            "predicted_harm": harm,
            "searched": ~known,
            "start_s": problem.clock[:, CLOCK.START].copy(),
            "commands_mps2": commands,
        }

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Return the command of the present step, [n] m/s2, and the unchanged memory. ``vehicle`` is not used."""
        return self._outlook.command(worlds, memory), memory

    def _search(self, worlds: Worlds, vehicle: int, others: Floats) -> tuple[Floats, Floats]:
        """Search each world; return the command of each decision, [n, decisions] m/s2, and the harm, [n] m2/s2."""
        problem, outlook = self._outlook.problem(worlds, vehicle, others), self._outlook
        coupled = optimise_coupled(
            worlds, vehicle, harm_count=outlook.harm_count, horizon_s=outlook.horizon_s, others_mps2=others
        )
        starts = problem.constant(-coupled.deceleration_mps2[:, np.newaxis, np.newaxis])
        profiles, harms = search_profiles(problem, starts, budget=self._budget)
        best = self._stepwise(profiles)
        if self._scenario is None or set(self._scenario.learners) - {vehicle}:
            return best, harms[outlook.harm_count]
        policy, steps = make_agent(START, scenario=self._scenario), int(problem.last_step.max())
        commands_ = record_commands(policy, worlds, self._scenario, vehicle, steps)
        of_policy = refine(problem, commands_, budget=1)[1]
        better = (of_policy < harms[outlook.harm_count])[:, np.newaxis]
        best[:, :steps], harm = refine(problem, np.where(better, commands_, best[:, :steps]), budget=self._budget)
        return best, harm

    def _stepwise(self, profiles: Profiles) -> Floats:
        """Return the command of each profile at each decision, [n, decisions] m/s2."""
        n = len(profiles.ends)
        steps = [profiles.at(np.full(n, step))[:, 0] for step in range(self._outlook.decisions)]
        return np.stack(steps, axis=1)


def make_best_harm(argument: str | None, settings: AgentSettings) -> Agent:
    """Return the agent ``best_harm`` or ``best_harm:CANDIDATES``.

    ``argument`` is the number of profiles that a search simulates, as text; None: ``PROFILE_BUDGET``. Raises
    ``InvalidInput`` if ``argument`` is not a whole number from 1 to ``MOST_CANDIDATES``.
    """
    budget = PROFILE_BUDGET if argument is None else budget_of(argument)
    if budget is None:
        raise InvalidInput(
            f"agent 'best_harm:{argument}': after the colon, give the number of profiles to try in each world,"
            f" from 1 to {MOST_CANDIDATES:,}, for instance best_harm:{PROFILE_BUDGET}"
        )
    return BestHarm(
        scenario=settings.scenario, harm_count=settings.harm_count, horizon_s=settings.horizon_s,
        time_step_s=settings.time_step_s,
        budget=budget if settings.most_candidates is None else min(budget, settings.most_candidates),
    )  # fmt: skip


BEST_HARM = Part(  # target of the entry point in pyproject.toml
    make_best_harm,
    form="best_harm[:CANDIDATES]",
    about="drives the best known profile; searches at the alert if no profile is stored",
    knows=Source.MODEL,
)

RUNGS = ("best_harm",)  # agents that ``--agents ladder`` adds above the core's
