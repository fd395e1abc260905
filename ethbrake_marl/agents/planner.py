"""A planner: at every decision it searches the rest of the episode in the engine's physics, and drives one step."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping

import numpy as np

from ethbrake_marl.agents.believed import Believing, split_believed
from ethbrake_marl.agents.e_v2x_bm import optimise_coupled, optimise_pairwise
from ethbrake_marl.agents.protocol import Agent, Source, fixed_commands
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine import Memory, Script, renew_memory, take_memory
from ethbrake_marl.errors import InvalidInput, renumbered
from ethbrake_marl.harm import check_harm_count
from ethbrake_marl.physics import CLOCK, Bools, Decisions, Floats, Ints, Worlds
from ethbrake_marl.search import MOST_PHASES, TIME_STEP_S, ProfileProblem, Profiles, profile_problem

CANDIDATES = 256  # per world and decision
ROUND = 256  # candidates between two looks at the clock
MOST_CANDIDATES, MOST_MILLISECONDS = 1_000_000, 60_000.0  # per world and decision
_CONSTANTS = 15
_ARGUMENT = re.compile(r"(?P<number>[0-9]+(\.[0-9]+)?)(?P<unit>ms)?")


class Planner:
    """Receding horizon: the own profile is searched anew at each decision, the others following their scripts.

    Each search starts from the plan so far, from constants and, at first, from the pairwise optimum. ``predicted_harm``
    [n] is that of the first plan (m2/s2); no more is done if the others do as expected. Vehicles without a script
    (learners) are taken to brake fully. Raises ``InvalidInput`` for an unusable argument or count and, when
    an episode begins, for another vehicle's script whose command is not fixed at the alert.

    Args:
        argument: candidates per world and decision (deterministic), or a time like ``20ms`` for each (as many rounds as
            fit, at least one; depends on the machine).
        harm_count: which harm it minimises, ``first`` or ``total``.
        horizon_s: until when it looks ahead, s.
        most_candidates: of a search, whatever the argument says.
        time_step_s: between two decisions, s.

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
    ) -> None:
        check_harm_count(harm_count)
        self.name = "planner" if argument is None else f"planner:{argument}"
        self._candidates, self._milliseconds = _budget(argument)
        if most_candidates is not None:
            self._candidates, self._milliseconds = min(self._candidates, most_candidates), 0.0
        self._harm_count: HarmCount = harm_count
        self._horizon_s, self._time_step_s = horizon_s, time_step_s

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Make the first plan of these episodes."""
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        problem = self._problem(alert, vehicle, others)
        pairwise = -optimise_pairwise(alert, vehicle).deceleration_mps2
        plan, harm = self._search(problem, problem.constant(pairwise[:, np.newaxis, np.newaxis]))
        start_s = np.maximum(alert.vehicles.latency_s[:, vehicle], alert.time_s)
        return {"plan": plan, "planned_s": start_s, "others_mps2": others, "predicted_harm": harm}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """The first command of the new plans, [n] m/s2."""
        moving = (worlds.speeds_mps != 0.0).any(axis=1)
        rows = np.flatnonzero((worlds.time_s > memory["planned_s"]) & (worlds.time_s < self._horizon_s) & moving)
        if rows.size:
            now, held = worlds.take(rows), take_memory(memory, rows)
            problem = self._problem(now, vehicle, held["others_mps2"])
            plan, _ = self._search(problem, self._rest(held, now.time_s, problem))
            memory = renew_memory(memory, rows, {"plan": plan, "planned_s": now.time_s})
        return Profiles(*memory["plan"]).commands_mps2[:, 0, 0], memory

    def _problem(self, worlds: Worlds, vehicle: int, others: Floats) -> ProfileProblem:
        return profile_problem(
            worlds, [vehicle], harm_count=self._harm_count, horizon_s=self._horizon_s, time_step_s=self._time_step_s,
            others_mps2=others,
        )  # fmt: skip

    def _rest(self, held: Memory, time_s: Floats, problem: ProfileProblem) -> Profiles:
        """What is left of the plans from ``time_s`` on."""
        plan = Profiles(*held["plan"])
        passed = np.rint((time_s - held["planned_s"]) / self._time_step_s).astype(np.int64)[:, np.newaxis]
        ends = np.minimum(np.maximum(plan.ends - passed, 0), problem.last_step[:, np.newaxis])
        ends[:, -1] = problem.last_step
        return Profiles(ends, plan.commands_mps2)

    def _search(self, problem: ProfileProblem, plan: Profiles) -> tuple[Profiles, Floats]:
        """The best plans found from these and from constants, with their harm under the own count."""
        stop = time.perf_counter() + 1e-3 * self._milliseconds * problem.n
        seed = 0
        while True:
            given = _with_constants(problem, plan)
            plan, harm = problem.search(given, budget=self._candidates, seed=seed)
            seed += 1
            if time.perf_counter() >= stop:
                return plan, harm[self._harm_count]


def _with_constants(problem: ProfileProblem, plan: Profiles) -> Profiles:
    """Each world's plan, then constants: [n * Q]."""
    constants = problem.constant(problem.even_grid(_CONSTANTS))
    n, K = plan.ends.shape
    ends = np.concatenate([plan.ends[:, np.newaxis], constants.ends.reshape(n, -1, K)], axis=1)
    commands = constants.commands_mps2.reshape(n, -1, K, 1)
    commands = np.concatenate([plan.commands_mps2[:, np.newaxis], commands], axis=1)
    return Profiles(ends.reshape(-1, K), commands.reshape(-1, K, 1))


def _budget(argument: str | None) -> tuple[int, float]:
    """Candidates per decision (or round), and milliseconds (0: exactly one round)."""
    if argument is None:
        return CANDIDATES, 0.0
    match = _ARGUMENT.fullmatch(argument)
    if match is not None:
        number = float(match["number"])
        if match["unit"] == "ms" and 0.0 < number <= MOST_MILLISECONDS:
            return ROUND, number
        if match["unit"] is None and number.is_integer() and 1.0 <= number <= MOST_CANDIDATES and "." not in argument:
            return int(number), 0.0
    raise InvalidInput(
        f"agent 'planner:{argument}': the argument must be a number of candidates per decision, for instance 256 (at"
        f" most {MOST_CANDIDATES:,}), or a time per decision, for instance 20ms (at most {MOST_MILLISECONDS:,.0f}ms)"
    )


def make_planner(argument: str | None, settings: AgentSettings) -> Agent:
    """``planner``, ``planner:CANDIDATES`` or ``planner:20ms``; with ``:believed`` behind, in the believed world."""
    budget, believes = split_believed(argument)
    planner = Planner(
        budget, harm_count=settings.harm_count, horizon_s=settings.horizon_s, most_candidates=settings.most_candidates,
        time_step_s=settings.time_step_s,
    )  # fmt: skip
    return Believing(planner, settings.needed_scenario(), shows=True) if believes else planner


# An agent that drives the best profile known: one kept beforehand where there is one, else searched at the alert.

PROFILE_BUDGET = 20_000  # candidates in a world of which nothing is known

Recall = Callable[[ProfileProblem, HarmCount], tuple[Profiles, Bools]]
"""Kept profiles [n] of a problem, and where there is one [n]; the others are ignored."""


class BestHarm:
    """Drives the profile of least harm known, while the others follow their scripts (without one: brake fully).

    ``recall`` gives the kept profiles; a world without one is searched at the alert with ``budget`` candidates.
    Decisions fall every ``time_step_s`` from the vehicle's latency on. ``predicted_harm`` [n] is what the engine will
    count (m2/s2), to the same bits, if the engine's time step is that. Raises ``InvalidInput`` for a budget below 1 or
    an unknown count and, when an episode begins, for another vehicle's script whose command is not fixed at the alert.
    """

    knows = Source.MODEL

    def __init__(
        self,
        recall: Recall,
        *,
        harm_count: HarmCount = "first",
        horizon_s: float = 8.0,
        budget: int = PROFILE_BUDGET,
        time_step_s: float = TIME_STEP_S,
    ) -> None:
        if not budget >= 1:
            raise InvalidInput(f"best_harm: budget = {budget}; at least 1 candidate is needed")
        check_harm_count(harm_count)
        self.name = "best_harm"
        self._recall = recall
        self._harm_count: HarmCount = harm_count
        self._horizon_s, self._time_step_s = horizon_s, time_step_s
        self._budget = budget
        self._steps = np.arange(int(np.ceil(horizon_s / time_step_s)) + 1)

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Look these worlds up, and search those that are not known."""
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        problem = self._problem(alert, vehicle, others)
        profiles, known = self._recall(problem, self._harm_count)
        unknown = np.flatnonzero(~known)
        if unknown.size:
            profiles = self._search(alert, vehicle, others, profiles, unknown)
        first, total = problem.follow(profiles)
        return {
            "predicted_harm": first if self._harm_count == "first" else total,
            "searched": ~known,
            "start_s": problem.clock[:, CLOCK.START].copy(),
            "commands_mps2": np.stack([profiles.at(np.full(alert.n, step))[:, 0] for step in self._steps], axis=1),
        }

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """The command of the phase in force, [n] m/s2."""
        step = Decisions(memory["start_s"], self._time_step_s).latest(worlds.time_s)
        return memory["commands_mps2"][np.arange(worlds.n), np.clip(step, 0, self._steps[-1])], memory

    def _problem(self, worlds: Worlds, vehicle: int, others: Floats) -> ProfileProblem:
        return profile_problem(
            worlds, [vehicle], harm_count=self._harm_count, horizon_s=self._horizon_s, time_step_s=self._time_step_s,
            others_mps2=others,
        )  # fmt: skip

    def _search(self, worlds: Worlds, vehicle: int, others: Floats, profiles: Profiles, unknown: Ints) -> Profiles:
        """The given profiles with those of ``unknown`` worlds replaced by searched ones."""
        part, theirs = worlds.take(unknown), others[unknown]
        problem = self._problem(part, vehicle, theirs)
        horizon_s, harm_count = self._horizon_s, self._harm_count
        with renumbered(unknown):
            coupled = optimise_coupled(part, vehicle, harm_count=harm_count, horizon_s=horizon_s, others_mps2=theirs)
            given = problem.constant(-coupled.deceleration_mps2[:, np.newaxis, np.newaxis])
            found, _ = problem.search(given, budget=self._budget)
        whole, found = Profiles.padded([profiles, found], MOST_PHASES)
        whole.ends[unknown] = found.ends
        whole.commands_mps2[unknown] = found.commands_mps2
        return whole
