"""Agents that search whole profiles in the engine's physics: planner, best profile known, search around a policy."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.believed import Believing
from ethbrake_marl.agents.e_v2x_bm import optimise_coupled, optimise_pairwise
from ethbrake_marl.agents.registry import (
    Agent,
    AgentAround,
    AgentSettings,
    Source,
    check_agent,
    fixed_commands,
    make_agent,
    record_commands,
)
from ethbrake_marl.engine import Memory, Script, renew_memory, take_memory
from ethbrake_marl.errors import InvalidInput, check_whole_number, renumbered
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.physics import CLOCK, Bools, Decisions, Floats, Ints, Worlds
from ethbrake_marl.registry import Part
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search import TIME_STEP_S, ProfileProblem, Profiles, profile_problem, refine, search_profiles

MOST_CANDIDATES = 1_000_000  # per world and decision


class _Outlook(NamedTuple):
    """How an agent looks ahead for its vehicle: whose harm counts, how far, and when the vehicle decides."""

    harm_count: HarmCount
    horizon_s: float
    time_step_s: float

    @property
    def decisions(self) -> int:
        """Of a whole episode, at most."""
        return int(np.ceil(self.horizon_s / self.time_step_s)) + 1

    def problem(self, worlds: Worlds, vehicle: int, others_mps2: Floats) -> ProfileProblem:
        """The search for the vehicle's profile from now on."""
        return profile_problem(
            worlds, [vehicle], harm_count=self.harm_count, horizon_s=self.horizon_s, time_step_s=self.time_step_s,
            others_mps2=others_mps2,
        )  # fmt: skip

    def due(self, worlds: Worlds, planned_s: Floats) -> Ints:
        """The worlds in which it is time to plan again: some vehicle moves, and a decision has come since."""
        moving = (worlds.speeds_mps != 0.0).any(axis=1)
        return np.flatnonzero((worlds.time_s > planned_s) & (worlds.time_s < self.horizon_s) & moving)

    def command(self, worlds: Worlds, memory: Memory) -> Floats:
        """What ``commands_mps2`` [n, decisions], from ``start_s`` on, say now, [n]."""
        step = Decisions(memory["start_s"], self.time_step_s).latest(worlds.time_s)
        now: Floats = memory["commands_mps2"][np.arange(worlds.n), np.clip(step, 0, self.decisions - 1)]
        return now


def _budget(argument: str) -> int | None:
    """The number of candidates that an argument is; None: it is none."""
    number = int(argument) if re.fullmatch("[0-9]{1,7}", argument) else 0
    return number if 1 <= number <= MOST_CANDIDATES else None


CANDIDATES = 256  # per world and decision


class Planner:
    """Receding horizon: the own profile is searched anew at each decision, the others following their scripts.

    Each search starts from the plan so far, from constants and, at first, from the pairwise optimum. ``predicted_harm``
    [n] is that of the first plan (m2/s2); no more is done if the others do as expected. Vehicles without a script
    (learners) are taken to brake fully. Raises ``InvalidInput`` for an unusable argument or count and, when
    an episode begins, for another vehicle's script whose command is not fixed at the alert.

    Args:
        argument: candidates per world and decision.
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
        budget = CANDIDATES if argument is None else _budget(argument)
        if budget is None:
            raise InvalidInput(
                f"agent 'planner:{argument}': the argument must be a number of candidates per decision, for instance"
                f" {CANDIDATES}, at most {MOST_CANDIDATES:,}"
            )
        self.name = "planner" if argument is None else f"planner:{argument}"
        self._candidates = budget if most_candidates is None else min(budget, most_candidates)
        self._outlook = _Outlook(harm_count, horizon_s, time_step_s)

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Make the first plan of these episodes."""
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        problem = self._outlook.problem(alert, vehicle, others)
        pairwise = -optimise_pairwise(alert, vehicle).deceleration_mps2
        plan, harm = self._search(problem, problem.constant(pairwise[:, np.newaxis, np.newaxis]))
        start_s = np.maximum(alert.vehicles.latency_s[:, vehicle], alert.time_s)
        return {"plan": plan, "planned_s": start_s, "others_mps2": others, "predicted_harm": harm}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """The first command of the new plans, [n] m/s2."""
        rows = self._outlook.due(worlds, memory["planned_s"])
        if rows.size:
            now, held = worlds.take(rows), take_memory(memory, rows)
            problem = self._outlook.problem(now, vehicle, held["others_mps2"])
            plan, _ = self._search(problem, self._rest(held, now.time_s, problem))
            memory = renew_memory(memory, rows, {"plan": plan, "planned_s": now.time_s})
        return Profiles(*memory["plan"]).commands_mps2[:, 0, 0], memory

    def _rest(self, held: Memory, time_s: Floats, problem: ProfileProblem) -> Profiles:
        """What is left of the plans from ``time_s`` on."""
        plan = Profiles(*held["plan"])
        passed = np.rint((time_s - held["planned_s"]) / self._outlook.time_step_s).astype(np.int64)[:, np.newaxis]
        ends = np.minimum(np.maximum(plan.ends - passed, 0), problem.last_step[:, np.newaxis])
        ends[:, -1] = problem.last_step
        return Profiles(ends, plan.commands_mps2)

    def _search(self, problem: ProfileProblem, plan: Profiles) -> tuple[Profiles, Floats]:
        """The best plans found from these and from constants, with their harm under the own count."""
        constants = problem.constant(problem.even_grid(15))
        n, K = plan.ends.shape  # each world's plan, then its constants: [n * Q]
        ends = np.concatenate([plan.ends[:, np.newaxis], constants.ends.reshape(n, -1, K)], axis=1)
        commands = constants.commands_mps2.reshape(n, -1, K, 1)
        commands = np.concatenate([plan.commands_mps2[:, np.newaxis], commands], axis=1)
        given = Profiles(ends.reshape(-1, K), commands.reshape(-1, K, 1))
        plan, harm = search_profiles(problem, given, budget=self._candidates, seed=0)
        return plan, harm[self._outlook.harm_count]


def make_planner(argument: str | None, settings: AgentSettings) -> Agent:
    """``planner`` or ``planner:CANDIDATES``; with ``:believed`` behind, in the believed world."""
    planner = Planner(
        argument, harm_count=settings.harm_count, horizon_s=settings.horizon_s,
        most_candidates=settings.most_candidates, time_step_s=settings.time_step_s,
    )  # fmt: skip
    return Believing(planner, settings.needed_scenario(), shows=True) if settings.believes else planner


# An agent that drives the best profile known: one kept beforehand where there is one, else searched at the alert.

PROFILE_BUDGET = 20_000  # candidates in a world of which nothing is known
START = "universal@shipped"  # whose episode a search also starts from

Recall = Callable[[ProfileProblem, HarmCount], tuple[Profiles, Bools]]
"""Kept profiles [n] of a problem, and where there is one [n]; the others are ignored."""


class BestHarm:
    """Drives the profile of least harm known, while the others follow their scripts (without one: brake fully).

    ``recall`` gives the kept profiles. A world without one is searched at the alert with ``budget`` candidates. Where
    no other vehicle of a known ``scenario`` learns, a second search with as many candidates starts from the better of
    that result and the episode of ``universal``: the harm is never above that policy's. Decisions fall every
    ``time_step_s`` from the vehicle's latency on. ``predicted_harm`` [n] is what the engine will count (m2/s2), to the
    same bits, if the engine's time step is that. Raises ``InvalidInput`` for a budget below 1 or an unknown count and,
    when an episode begins, for another vehicle's script whose command is not fixed at the alert.
    """

    name = "best_harm"
    knows = Source.MODEL

    def __init__(
        self,
        recall: Recall,
        *,
        scenario: Scenario | None = None,
        harm_count: HarmCount = "first",
        horizon_s: float = 8.0,
        budget: int = PROFILE_BUDGET,
        time_step_s: float = TIME_STEP_S,
    ) -> None:
        if not budget >= 1:
            raise InvalidInput(f"best_harm: budget = {budget}; at least 1 candidate is needed")
        check_harm_count(harm_count)
        self._recall, self._budget, self._scenario = recall, budget, scenario
        self._outlook = _Outlook(harm_count, horizon_s, time_step_s)

    @classmethod
    def make(cls, argument: str | None, settings: AgentSettings, recall: Recall) -> BestHarm:
        """``best_harm`` or ``best_harm:CANDIDATES``; raises ``InvalidInput`` for an argument that is no such number."""
        budget = PROFILE_BUDGET if argument is None else _budget(argument)
        if budget is None:
            raise InvalidInput(
                f"agent 'best_harm:{argument}': the argument must be a number of candidates, for instance"
                f" {PROFILE_BUDGET}, at most {MOST_CANDIDATES:,}"
            )
        return cls(
            recall, scenario=settings.scenario, harm_count=settings.harm_count, horizon_s=settings.horizon_s,
            time_step_s=settings.time_step_s,
            budget=budget if settings.most_candidates is None else min(budget, settings.most_candidates),
        )  # fmt: skip

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Look these worlds up, and search those that are not known."""
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        problem, outlook = self._outlook.problem(alert, vehicle, others), self._outlook
        profiles, known = self._recall(problem, outlook.harm_count)
        first, total = problem.follow(profiles)
        harm, commands = (first if outlook.harm_count == "first" else total), self._stepwise(profiles)
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
        """The command of the phase in force, [n] m/s2."""
        return self._outlook.command(worlds, memory), memory

    def _search(self, worlds: Worlds, vehicle: int, others: Floats) -> tuple[Floats, Floats]:
        """The best commands that are found in these worlds, [n, decisions] m/s2, and their harm [n] m2/s2."""
        problem, outlook = self._outlook.problem(worlds, vehicle, others), self._outlook
        coupled = optimise_coupled(
            worlds, vehicle, harm_count=outlook.harm_count, horizon_s=outlook.horizon_s, others_mps2=others
        )
        given = problem.constant(-coupled.deceleration_mps2[:, np.newaxis, np.newaxis])
        found, harms = search_profiles(problem, given, budget=self._budget)
        best = self._stepwise(found)
        if self._scenario is None or set(self._scenario.learners) - {vehicle}:
            return best, harms[outlook.harm_count]
        policy, steps = make_agent(START, scenario=self._scenario), int(problem.last_step.max())
        driven = record_commands(policy, worlds, self._scenario, vehicle, steps)
        of_policy = refine(problem, driven, budget=1)[1]
        better = (of_policy < harms[outlook.harm_count])[:, np.newaxis]
        best[:, :steps], harm = refine(problem, np.where(better, driven, best[:, :steps]), budget=self._budget)
        return best, harm

    def _stepwise(self, profiles: Profiles) -> Floats:
        """The commands of profiles decision by decision, [n, decisions] m/s2."""
        n = len(profiles.ends)
        steps = [profiles.at(np.full(n, step))[:, 0] for step in range(self._outlook.decisions)]
        return np.stack(steps, axis=1)


# A search around the own episode of a policy at the alert: what it finds then drives.


class Searched(AgentAround):
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
        self._outlook = _Outlook(harm_count, scenario.horizon_s, scenario.time_step_s)

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Search in these worlds."""
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        problem = self._outlook.problem(alert, vehicle, others)
        own = record_commands(self.policy, alert, self.scenario, vehicle, int(problem.last_step.max()))
        commands, harm = refine(problem, own, budget=self._candidates)
        return {
            "commands_mps2": np.pad(commands, ((0, 0), (0, self._outlook.decisions - own.shape[1])), mode="edge"),
            "start_s": problem.clock[:, CLOCK.START].copy(),  # of the first decision
            "predicted_harm": harm,
        }

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """The command of the step, [n] m/s2."""
        return self._outlook.command(worlds, memory), memory


def search_around(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """``+search`` around an agent, which takes no argument."""
    return Searched(policy, settings.needed_scenario(), harm_count=settings.harm_count)


# What this package's entry points name (pyproject.toml).


PLANNER = Part(
    make_planner,
    form="planner[:CANDIDATES][:believed]",
    about="a search in the simulation at every decision, with so many candidates each; believed: as above",
    knows=Source.MODEL,
)
SEARCH = Part(
    search_around,
    form="+search",
    about="drives the best commands that a search around its own episode finds at the alert",
    knows=Source.MODEL,
    inner=True,
)
