"""``planner``: an agent that searches whole command profiles at every decision."""

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
    """Settings of an agent that looks ahead, and the methods with which it decides when to plan and what to command."""

    harm_count: HarmCount  # harm to minimise: ``first`` or ``total``
    horizon_s: float  # time up to which it looks ahead, s
    time_step_s: float  # time between two decisions, s
    objective: Declared = "total"  # whose harm it minimises, as a scenario declares it

    @property
    def decisions(self) -> int:
        """Largest number of decisions in an episode."""
        return int(np.ceil(self.horizon_s / self.time_step_s)) + 1

    def problem(self, worlds: Worlds, vehicle: int, others_mps2: Floats) -> ProfileProblem:
        """Return the search problem: choose the command profile of ``vehicle`` from the present time of ``worlds`` on.

        ``others_mps2`` [n, N] are the commands of the other vehicles.
        """
        problem = profile_problem(
            worlds, [vehicle], harm_count=self.harm_count, horizon_s=self.horizon_s, time_step_s=self.time_step_s,
            others_mps2=others_mps2,
        )  # fmt: skip
        return minimising(problem, worlds, self.objective, [vehicle])

    def due(self, worlds: Worlds, planned_s: Floats) -> Ints:
        """Return the indices of worlds that need a new plan: something moves, and a decision was due since the last
        plan.

        ``planned_s`` [n] is the time of the last plan, s.
        """
        moving = (worlds.speeds_mps != 0.0).any(axis=1)
        return np.flatnonzero((worlds.time_s > planned_s) & (worlds.time_s < self.horizon_s) & moving)

    def command(self, worlds: Worlds, memory: Memory) -> Floats:
        """Return the present command in each world, [n] m/s2.

        Args:
            worlds: the worlds now, [n]; only their time is read.
            memory: holds ``commands_mps2`` [n, decisions], one command for each decision, and ``start_s`` [n], the time
                of the first one.

        """
        step = Decisions(memory["start_s"], self.time_step_s).latest(worlds.time_s)
        now: Floats = memory["commands_mps2"][np.arange(worlds.n), np.clip(step, 0, self.decisions - 1)]
        return now


def budget_of(argument: str) -> int | None:
    """Return ``argument`` as a number of candidates (1 to ``MOST_CANDIDATES``), or None if it is not such a number."""
    number = int(argument) if re.fullmatch("[0-9]{1,7}", argument) else 0
    return number if 1 <= number <= MOST_CANDIDATES else None


CANDIDATES = 256  # default number of candidates per world and decision


class Planner:
    """Receding-horizon planner: at each decision it searches its own profile, while the others follow their scripts.

    Each search starts from the previous plan, from constants and, at the first decision, from the pairwise optimum.
    ``predicted_harm`` [n] is the harm of the first plan (m2/s2); the simulated harm is no larger if the others behave
    as expected. Vehicles without a script (learners) are assumed to brake fully. Raises ``InvalidInput`` for an invalid
    argument or count and, when an episode begins, for another vehicle's script whose command is not fixed at the alert.

    Args:
        argument: number of candidates per world and decision, as text; None: ``CANDIDATES``.
        harm_count: harm to minimise, ``first`` or ``total``.
        horizon_s: time up to which it looks ahead, s.
        most_candidates: upper limit of the number of candidates, whatever ``argument`` says; None: no limit.
        time_step_s: time between two decisions, s.
        objective: whose harm it minimises; ``predicted_harm`` is then the amount of this objective.

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
                f"agent 'planner:{argument}': the argument must be a number of candidates per decision, for instance"
                f" {CANDIDATES}, at most {MOST_CANDIDATES:,}"
            )
        self.name = "planner" if argument is None else f"planner:{argument}"
        self._candidates = budget if most_candidates is None else min(budget, most_candidates)
        self._outlook = Outlook(harm_count, horizon_s, time_step_s, objective)

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Make the first plan of these episodes, and return the memory.

        Args:
            alert: the worlds at the alert, [n].
            vehicle: index of the controlled vehicle.
            scripts: scripts of the other vehicles, by index.

        """
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        problem = self._outlook.problem(alert, vehicle, others)
        pairwise = -optimise_pairwise(alert, vehicle).deceleration_mps2
        plan, harm = self._search(problem, problem.constant(pairwise[:, np.newaxis, np.newaxis]))
        start_s = np.maximum(alert.vehicles.latency_s[:, vehicle], alert.time_s)
        return {"plan": plan, "planned_s": start_s, "others_mps2": others, "predicted_harm": harm}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Return the first command of each world's plan, [n] m/s2, and the new memory. A new plan is searched where a
        decision is due.

        Args:
            worlds: the worlds now, [n].
            memory: memory from ``begin`` or the previous ``act``.
            vehicle: index of the controlled vehicle.

        """
        rows = self._outlook.due(worlds, memory["planned_s"])
        if rows.size:
            now, held = worlds.take(rows), take_memory(memory, rows)
            problem = self._outlook.problem(now, vehicle, held["others_mps2"])
            plan, _ = self._search(problem, self._rest(held, now.time_s, problem))
            memory = renew_memory(memory, rows, {"plan": plan, "planned_s": now.time_s})
        return Profiles(*memory["plan"]).commands_mps2[:, 0, 0], memory

    def _rest(self, held: Memory, time_s: Floats, problem: ProfileProblem) -> Profiles:
        """Return the part of each stored plan that is still ahead, as profiles [m] for the new problem.

        Args:
            held: memory of the worlds that plan again.
            time_s: [m] present time, s.
            problem: the search problem from that time on.

        """
        plan = Profiles(*held["plan"])
        passed = np.rint((time_s - held["planned_s"]) / self._outlook.time_step_s).astype(np.int64)[:, np.newaxis]
        ends = np.minimum(np.maximum(plan.ends - passed, 0), problem.last_step[:, np.newaxis])
        ends[:, -1] = problem.last_step
        return Profiles(ends, plan.commands_mps2)

    def _search(self, problem: ProfileProblem, plan: Profiles) -> tuple[Profiles, Floats]:
        """Return the best plan of each world, and its harm [n] (m2/s2), from a search that starts with ``plan`` and
        constants.
        """
        constants = problem.constant(problem.even_grid(15))
        n, K = plan.ends.shape  # [n * Q]: for each world its plan, then constants
        ends = np.concatenate([plan.ends[:, np.newaxis], constants.ends.reshape(n, -1, K)], axis=1)
        commands = constants.commands_mps2.reshape(n, -1, K, 1)
        commands = np.concatenate([plan.commands_mps2[:, np.newaxis], commands], axis=1)
        starts = Profiles(ends.reshape(-1, K), commands.reshape(-1, K, 1))
        plan, harm = search_profiles(problem, starts, budget=self._candidates, seed=0)
        return plan, harm[self._outlook.harm_count]


def make_planner(argument: str | None, settings: AgentSettings) -> Agent:
    """Make the agent ``planner`` or ``planner:CANDIDATES``. ``argument`` is the number of candidates, or None."""
    return Planner(
        argument, harm_count=settings.harm_count, horizon_s=settings.horizon_s,
        most_candidates=settings.most_candidates, time_step_s=settings.time_step_s,
        objective="total" if settings.scenario is None else settings.scenario.objective,
    )  # fmt: skip


def make_estimating_planner(argument: str | None, settings: AgentSettings) -> Agent:
    """Make the agent ``planner:estimated`` or ``planner:CANDIDATES:estimated``, which searches in the estimated world.

    ``argument`` is the number of candidates, or None.
    """
    return Estimating(make_planner(argument, settings), settings.needed_scenario(), shows=True)


PLANNER = Part(
    make_planner,
    form="planner[:CANDIDATES]",
    about="a search in the simulation at every decision, with so many candidates each",
    knows=Source.MODEL,
)

ESTIMATED_PLANNER = Part(make_estimating_planner, about="as above")
