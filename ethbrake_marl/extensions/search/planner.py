"""``planner``: an agent that searches for the best command profile at every decision."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.e_v2x_bm.pairwise import optimise_pairwise
from ethbrake_marl.agents.protocol import Agent, Source, fixed_commands
from ethbrake_marl.agents.settings import AgentSettings
from ethbrake_marl.engine.memory import Memory, renew_memory, take_memory
from ethbrake_marl.engine.profiles import TIME_STEP_S, ProfileProblem, Profiles, profile_problem
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.estimating_agents import Estimating
from ethbrake_marl.extensions.search.problem import minimising, search_profiles
from ethbrake_marl.game.harm import HarmCount, check_harm_count
from ethbrake_marl.game.objectives import Declared
from ethbrake_marl.physics.episode import Decisions
from ethbrake_marl.physics.state import Floats, Ints, Worlds
from ethbrake_marl.registry import Part

MOST_CANDIDATES = 1_000_000  # most candidates per world and decision


class Outlook(NamedTuple):
    """Settings of an agent that searches for commands, with methods that read the agent's plan."""

    harm_count: HarmCount  # harm count to minimise: ``first`` or ``total``
    horizon_s: float  # end of the simulated episode, s
    time_step_s: float  # time between two decisions, s
    objective: Declared = "total"  # objective to minimise, as a scenario declares it

    @property
    def decisions(self) -> int:
        """Largest possible number of decisions in an episode."""
        return int(np.ceil(self.horizon_s / self.time_step_s)) + 1

    def problem(self, worlds: Worlds, vehicle: int, others_mps2: Floats) -> ProfileProblem:
        """Return the problem of a search for the best commands of ``vehicle`` from the present time to the horizon.

        ``worlds`` are in their present state; ``others_mps2`` [n, N] are the commands of the other vehicles.
        """
        problem = profile_problem(
            worlds, [vehicle], harm_count=self.harm_count, horizon_s=self.horizon_s, time_step_s=self.time_step_s,
            others_mps2=others_mps2,
        )  # fmt: skip
        return minimising(problem, worlds, self.objective, [vehicle])

    def due(self, worlds: Worlds, planned_s: Floats) -> Ints:
        """Return the indices of worlds that need a new plan.

        A world needs a new plan if a vehicle moves, the horizon is not reached, and the last plan was made before the
        present time. ``planned_s`` [n] is the time of the last plan, s.
        """
        moving = (worlds.speeds_mps != 0.0).any(axis=1)
        return np.flatnonzero((worlds.time_s > planned_s) & (worlds.time_s < self.horizon_s) & moving)

    def command(self, worlds: Worlds, memory: Memory) -> Floats:
        """Return the command of the agent's plan for the present time of each world, [n] m/s2.

        ``memory`` has ``commands_mps2`` [n, decisions], one command for each decision, and ``start_s`` [n], the time of
        the first decision, s.
        """
        step = Decisions(memory["start_s"], self.time_step_s).latest(worlds.time_s)
        now: Floats = memory["commands_mps2"][np.arange(worlds.n), np.clip(step, 0, self.decisions - 1)]
        return now


def budget_of(argument: str) -> int | None:
    """Convert ``argument`` to a number; return None if it is no whole number from 1 to ``MOST_CANDIDATES``."""
    number = int(argument) if re.fullmatch("[0-9]{1,7}", argument) else 0
    return number if 1 <= number <= MOST_CANDIDATES else None


CANDIDATES = 256  # default number of candidates per world and decision


class Planner:
    """Receding-horizon planner: at each decision it searches for the best commands until the horizon.

    Each search starts from constant commands and the previous plan; the first search starts from constant commands and
    the command of pairwise E-V2X-BM. The planner expects that the other vehicles follow their scripts, and that other
    learners brake fully. ``predicted_harm`` [n] is the harm of the plan made at the alert, m2/s2. If the other vehicles
    do what the planner expects, the simulated harm is at most ``predicted_harm``. Raises ``InvalidInput`` if
    ``argument`` is not a whole number from 1 to ``MOST_CANDIDATES``, or if ``harm_count`` is unknown. ``begin`` raises
    ``InvalidInput`` if the script of another vehicle may react to what happens after the alert.

    Args:
        argument: number of profiles that are simulated in each world at each decision, as text; None: ``CANDIDATES``.
        harm_count: harm count to minimise, ``first`` or ``total``.
        horizon_s: end of the simulated episode, s.
        most_candidates: a number in ``argument`` above this limit is lowered to this limit; None: no limit.
        time_step_s: time between two decisions, s.
        objective: objective to minimise; ``predicted_harm`` is the value of this objective.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> planner = eb.make_agent("planner:16", scenario=scenario)
    >>> outcome = eb.evaluate(scenario.sample(2, seed=7), {"planner": planner}, scenario=scenario).outcome("planner")
    >>> bool((outcome.first_impact_harm <= outcome.predicted_harm + 1e-9).all())
    True

    """

    knows = Source.MODEL

    def __init__(
        self,
        argument: str | None = None,
        *,
        harm_count: HarmCount = "first",
        horizon_s: float = 8.0,
        most_candidates: int | None = None,
        time_step_s: float = TIME_STEP_S,
        objective: Declared = "total",
    ) -> None:
        check_harm_count(harm_count)
        budget = CANDIDATES if argument is None else budget_of(argument)
        if budget is None:
            raise InvalidInput(
                f"agent 'planner:{argument}': after the colon, give the number of profiles to try at each decision,"
                f" from 1 to {MOST_CANDIDATES:,}, for instance planner:{CANDIDATES}"
            )
        self.name = "planner" if argument is None else f"planner:{argument}"
        self._candidates = budget if most_candidates is None else min(budget, most_candidates)
        self._outlook = Outlook(harm_count, horizon_s, time_step_s, objective)

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Search for the first plan of each world, and return these plans as memory."""
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        problem = self._outlook.problem(alert, vehicle, others)
        pairwise = -optimise_pairwise(alert, vehicle).deceleration_mps2
        plan, harm = self._search(problem, problem.constant(pairwise[:, np.newaxis, np.newaxis]))
        start_s = np.maximum(alert.vehicles.latency_s[:, vehicle], alert.time_s)
        return {"plan": plan, "planned_s": start_s, "others_mps2": others, "predicted_harm": harm}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Return the first command of each world's plan, [n] m/s2, and the new memory.

        Worlds in which a decision is due get a new plan from a new search.
        """
        rows = self._outlook.due(worlds, memory["planned_s"])
        if rows.size:
            now, held = worlds.take(rows), take_memory(memory, rows)
            problem = self._outlook.problem(now, vehicle, held["others_mps2"])
            plan, _ = self._search(problem, self._rest(held, now.time_s, problem))
            memory = renew_memory(memory, rows, {"plan": plan, "planned_s": now.time_s})
        return Profiles(*memory["plan"]).commands_mps2[:, 0, 0], memory

    def _rest(self, held: Memory, time_s: Floats, problem: ProfileProblem) -> Profiles:
        """Return the rest of each of the m plans in ``held``, from the present time ``time_s`` [m] (s) on."""
        plan = Profiles(*held["plan"])
        passed = np.rint((time_s - held["planned_s"]) / self._outlook.time_step_s).astype(np.int64)[:, np.newaxis]
        ends = np.minimum(np.maximum(plan.ends - passed, 0), problem.last_step[:, np.newaxis])
        ends[:, -1] = problem.last_step
        return Profiles(ends, plan.commands_mps2)

    def _search(self, problem: ProfileProblem, plan: Profiles) -> tuple[Profiles, Floats]:
        """Search from ``plan`` and constant commands; return each world's best profile and its harm, [n] m2/s2."""
        constants = problem.constant(problem.even_grid(15))
        n, K = plan.ends.shape  # [n * Q]: for each world its plan, then constants
        ends = np.concatenate([plan.ends[:, np.newaxis], constants.ends.reshape(n, -1, K)], axis=1)
        commands = constants.commands_mps2.reshape(n, -1, K, 1)
        commands = np.concatenate([plan.commands_mps2[:, np.newaxis], commands], axis=1)
        starts = Profiles(ends.reshape(-1, K), commands.reshape(-1, K, 1))
        plan, harm = search_profiles(problem, starts, budget=self._candidates, seed=0)
        return plan, harm[self._outlook.harm_count]


def make_planner(argument: str | None, settings: AgentSettings) -> Agent:
    """Return the agent ``planner`` or ``planner:CANDIDATES``."""
    return Planner(
        argument, harm_count=settings.harm_count, horizon_s=settings.horizon_s,
        most_candidates=settings.most_candidates, time_step_s=settings.time_step_s,
        objective="total" if settings.scenario is None else settings.scenario.objective,
    )  # fmt: skip


def make_estimating_planner(argument: str | None, settings: AgentSettings) -> Agent:
    """Return the agent ``planner:estimated`` or ``planner:CANDIDATES:estimated``; it plans in the estimated world."""
    return Estimating(make_planner(argument, settings), settings.needed_scenario(), shows=True)


PLANNER = Part(
    make_planner,
    form="planner[:CANDIDATES]",
    about="searches by simulation at every decision, with CANDIDATES candidates",
    knows=Source.MODEL,
)

ESTIMATED_PLANNER = Part(make_estimating_planner, about="the same search in the estimated world")
