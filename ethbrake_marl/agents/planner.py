"""Agents that search whole profiles in the engine's physics: a planner, the best profile known, refined policies."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping
from itertools import count
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
    drive,
    fixed_commands,
    make_agent,
    record_commands,
)
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine import Memory, Script, ask_script, begin_script, renew_memory, take_memory
from ethbrake_marl.errors import InvalidInput, check_whole_number, renumbered
from ethbrake_marl.harm import check_harm_count
from ethbrake_marl.physics import CLOCK, Bools, Decisions, Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search import TIME_STEP_S, ProfileProblem, Profiles, profile_problem

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


def _budget(argument: str, unit: str = "", longest: float = 0.0, each: int = 0) -> tuple[int, float] | None:
    """Candidates per decision (0 of time), or those of ``each`` round and a number of units of time; else None."""
    match = re.fullmatch(rf"([0-9]+(?:\.[0-9]+)?)({unit})?", argument)
    number = float(match[1]) if match else 0.0
    if match and match[2]:
        return (each, number) if 0.0 < number <= longest else None
    return (int(number), 0.0) if 1.0 <= number <= MOST_CANDIDATES and "." not in argument else None


def _rounds(seconds: float) -> Iterator[int]:
    """The seeds of rounds that follow each other, one at least, as long as there is time."""
    stop = time.perf_counter() + seconds
    for seed in count():
        yield seed
        if time.perf_counter() >= stop:
            return


CANDIDATES = 256  # per world and decision
ROUND = 256  # candidates between two looks at the clock
MOST_MILLISECONDS = 60_000.0  # per world and decision


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
        budget = (CANDIDATES, 0.0) if argument is None else _budget(argument, "ms", MOST_MILLISECONDS, ROUND)
        if budget is None:
            raise InvalidInput(
                f"agent 'planner:{argument}': the argument must be a number of candidates per decision, for instance"
                f" {CANDIDATES} (at most {MOST_CANDIDATES:,}), or a time per decision, for instance 20ms (at most"
                f" {MOST_MILLISECONDS:,.0f}ms)"
            )
        self.name = "planner" if argument is None else f"planner:{argument}"
        self._candidates, self._seconds = budget[0], 1e-3 * budget[1]
        if most_candidates is not None:
            self._candidates, self._seconds = min(self._candidates, most_candidates), 0.0
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
        for seed in _rounds(self._seconds * problem.n):
            n, K = plan.ends.shape  # each world's plan, then its constants: [n * Q]
            ends = np.concatenate([plan.ends[:, np.newaxis], constants.ends.reshape(n, -1, K)], axis=1)
            commands = constants.commands_mps2.reshape(n, -1, K, 1)
            commands = np.concatenate([plan.commands_mps2[:, np.newaxis], commands], axis=1)
            given = Profiles(ends.reshape(-1, K), commands.reshape(-1, K, 1))
            plan, harm = problem.search(given, budget=self._candidates, seed=seed)
        return plan, harm[self._outlook.harm_count]


def make_planner(argument: str | None, settings: AgentSettings) -> Agent:
    """``planner``, ``planner:CANDIDATES`` or ``planner:20ms``; with ``:believed`` behind, in the believed world."""
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
        budget = (PROFILE_BUDGET, 0.0) if argument is None else _budget(argument)
        if budget is None:
            raise InvalidInput(
                f"agent 'best_harm:{argument}': the argument must be a number of candidates, for instance"
                f" {PROFILE_BUDGET}, at most {MOST_CANDIDATES:,}"
            )
        return cls(
            recall, scenario=settings.scenario, harm_count=settings.harm_count, horizon_s=settings.horizon_s,
            time_step_s=settings.time_step_s,
            budget=budget[0] if settings.most_candidates is None else min(budget[0], settings.most_candidates),
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
        found, harms = problem.search(given, budget=self._budget)
        best = self._stepwise(found)
        if self._scenario is None or set(self._scenario.learners) - {vehicle}:
            return best, harms[outlook.harm_count]
        policy, steps = make_agent(START, scenario=self._scenario), int(problem.last_step.max())
        driven = record_commands(policy, worlds, self._scenario, vehicle, steps)
        of_policy = problem.refine(driven, budget=1)[1]
        better = (of_policy < harms[outlook.harm_count])[:, np.newaxis]
        best[:, :steps], harm = problem.refine(np.where(better, driven, best[:, :steps]), budget=self._budget)
        return best, harm

    def _stepwise(self, profiles: Profiles) -> Floats:
        """The commands of profiles decision by decision, [n, decisions] m/s2."""
        n = len(profiles.ends)
        steps = [profiles.at(np.full(n, step))[:, 0] for step in range(self._outlook.decisions)]
        return np.stack(steps, axis=1)


# The compiled refinement of a policy: a search around its own episode at the alert, which then drives.


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

    adds = Source.MODEL

    def __init__(
        self, policy: Agent, scenario: Scenario, *, candidates: int = 500, harm_count: HarmCount = "first"
    ) -> None:
        check_agent(policy, "refined")
        check_whole_number("refined: candidates", candidates, 1, MOST_CANDIDATES)
        check_harm_count(harm_count)
        super().__init__(policy, f"{policy.name}+refined:profile")
        self.scenario, self._candidates, self._seconds = scenario, candidates, 0.0
        self._outlook = _Outlook(harm_count, scenario.horizon_s, scenario.time_step_s)

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Search in these worlds."""
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        problem = self._outlook.problem(alert, vehicle, others)
        own = record_commands(self.policy, alert, self.scenario, vehicle, int(problem.last_step.max()))
        commands, harm = self._search(problem, own)
        start_s = problem.clock[:, CLOCK.START].copy()  # of the first decision
        return {
            "commands_mps2": np.pad(commands, ((0, 0), (0, self._outlook.decisions - own.shape[1])), mode="edge"),
            "start_s": start_s,
            "planned_s": start_s,
            "others_mps2": others,
            "predicted_harm": harm,
        }

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """The command of the step, [n] m/s2."""
        return self._outlook.command(worlds, memory), memory

    def _search(self, problem: ProfileProblem, commands_mps2: Floats) -> tuple[Floats, Floats]:
        """The best that is found around these commands in the budget, with its harm under the own count."""
        for seed in _rounds(self._seconds * problem.n):
            commands_mps2, harm = problem.refine(commands_mps2, budget=self._candidates, seed=seed)
        return commands_mps2, harm


# The compiled refinement once more at every decision, from the worlds as they are then.

MOST_MICROSECONDS = 60_000_000


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

    def __init__(self, policy: Agent, scenario: Scenario, argument: str, *, harm_count: HarmCount = "first") -> None:
        budget = _budget(argument, "us", MOST_MICROSECONDS, 50)  # candidates between two looks at the clock
        if budget is None:
            raise InvalidInput(
                f"+refined:{argument}: must be profile (one search at the alert), a number of candidates per decision,"
                f" for instance 50 (at most {MOST_CANDIDATES:,}), or a time per decision, for instance 200us (at most"
                f" {MOST_MICROSECONDS:,}us)"
            )
        super().__init__(policy, scenario, candidates=budget[0], harm_count=harm_count)
        self._seconds = 1e-6 * budget[1]
        self.name = f"{policy.name}+refined:{argument}"

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """The first command of the new plans, [n] m/s2."""
        rows = self._outlook.due(worlds, memory["planned_s"])
        if rows.size:
            plan = self._plan_again(worlds.take(rows), vehicle, take_memory(memory, rows))
            memory = renew_memory(memory, rows, {"commands_mps2": plan, "planned_s": worlds.time_s[rows]})
        return super().act(worlds, memory, vehicle)

    def _plan_again(self, worlds: Worlds, vehicle: int, held: Memory) -> Floats:
        """The plans [m, steps] with what is left of them searched around, from the worlds as they are now."""
        plan: Floats = held["commands_mps2"]
        problem = self._outlook.problem(worlds, vehicle, held["others_mps2"])
        step = Decisions(held["start_s"], self._outlook.time_step_s).latest(worlds.time_s)
        later = step[:, np.newaxis] + np.arange(int(problem.last_step.max()))
        rows, last = np.arange(worlds.n)[:, np.newaxis], self._outlook.decisions - 1
        found, _ = self._search(problem, plan[rows, np.minimum(later, last)])
        inside = later <= last
        plan[np.broadcast_to(rows, later.shape)[inside], later[inside]] = found[inside]
        return plan


TRIES = 32  # deviations tried in each round
ROUNDS = 6  # each starts from the best of the rounds before
SEGMENT_S = 0.4  # a deviation changes at multiples of this time
HOLDS = (2, 3, 6)  # segments for which it stays the same, in turn
SIZES = (0.05, 0.15, 0.4)  # largest change in one round, as shares of the braking capacity, in turn
_SEGMENTS = 64  # of different deviation; the last one goes on
_BLOCK = 4096  # worlds rolled out together: bounds memory, changes no result


class Refined(AgentAround):
    """Drives by ``policy`` plus the deviation that did the least harm when many were rolled out at the alert.

    A deviation is a sequence of accelerations added to what the policy does, which goes on reacting to what it
    observes. Each round adds fixed changes, the same in every world, to the best deviation so far; the first is none.
    ``predicted_harm`` [n] (m2/s2) is the least harm found, never above the policy's own, and is realised if the other
    vehicles follow their scripts. Equal harms: the earlier one. A world's choice does not depend on its batch. Raises
    ``InvalidInput`` for what is not an agent, or numbers outside 1 to 10,000.

    Args:
        policy: any agent.
        scenario: in which it tries them.
        tries: deviations of each round.
        rounds: each starts from the best of those before.
        harm_count: which harm is least, ``first`` or ``total``.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> refined = eb.make_agent("constant:5+refined", scenario=scenario)
    >>> outcome = eb.evaluate(scenario.sample(2, seed=7), {"refined": refined}, scenario=scenario).outcome("refined")
    >>> bool((outcome.first_impact_harm == outcome.predicted_harm).all())
    True

    """

    adds = Source.MODEL  # in which it tries them

    def __init__(
        self,
        policy: Agent,
        scenario: Scenario,
        *,
        tries: int = TRIES,
        rounds: int = ROUNDS,
        harm_count: HarmCount = "first",
    ) -> None:
        check_agent(policy, "refined")
        for name, number in (("tries", tries), ("rounds", rounds)):
            check_whole_number(f"refined: {name}", number, 1, 10_000)
        check_harm_count(harm_count)
        super().__init__(policy, f"{policy.name}+refined")
        self.scenario = scenario
        self.tries = tries
        self.rounds = rounds
        self.harm_count: HarmCount = harm_count

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Search in these worlds."""
        best = np.zeros((alert.n, _SEGMENTS))
        least = self._harm(alert, vehicle, best)
        for number in range(self.rounds):
            change = changes(number, self.tries)
            open_rows = np.flatnonzero(least > 0.0)
            step = max(1, _BLOCK // self.tries)
            for some in (open_rows[i : i + step] for i in range(0, len(open_rows), step)):
                tried = best[some, np.newaxis] + change  # [worlds, tries, segments]
                each = np.repeat(some, len(change))
                with renumbered(each):
                    harm = self._harm(alert.take(each), vehicle, tried.reshape(-1, _SEGMENTS))
                harm = harm.reshape(len(some), len(change))
                chosen = harm.argmin(axis=1)
                better = harm[np.arange(len(some)), chosen] < least[some]
                best[some[better]] = tried[better, chosen[better]]
                least[some[better]] = harm[better, chosen[better]]
        policy = begin_script(self.policy, alert, vehicle, scripts)
        return {"policy": policy, "deviation": best, "predicted_harm": least}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Wanted signed acceleration, [n] m/s2."""
        command, policy = ask_script(self.policy, worlds, memory["policy"], vehicle)
        return deviate(command, memory["deviation"], worlds, vehicle), {**memory, "policy": policy}

    def _harm(self, worlds: Worlds, vehicle: int, deviation: Floats) -> Floats:
        """Harm under one deviation per world, [n]."""
        return drive(worlds, _Deviating(self.policy, deviation, self.name), self.scenario, vehicle).ledger.world_harm(
            self.harm_count
        )


def refine(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """``+refined``, ``+refined:profile``, ``+refined:50`` or ``+refined:200us`` around an agent."""
    if argument not in (None, "profile"):
        return RefinedAgain(policy, settings.needed_scenario(), argument, harm_count=settings.harm_count)
    if argument is not None:
        return RefinedProfile(policy, settings.needed_scenario(), harm_count=settings.harm_count)
    return Refined(policy, settings.needed_scenario(), harm_count=settings.harm_count)


class _Deviating(AgentAround):
    """A policy plus one given deviation per world."""

    def __init__(self, policy: Agent, deviation: Floats, name: str) -> None:
        super().__init__(policy, name)
        self.deviation = deviation  # [n, segments]

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        command, memory = ask_script(self.policy, worlds, memory, vehicle)
        return deviate(command, self.deviation, worlds, vehicle), memory


def changes(number: int, tries: int) -> Floats:
    """What round ``number`` adds to a deviation, as shares of the braking capacity: [tries, segments].

    Change k is constant over ``HOLDS`` segments and uniform in plus or minus one of ``SIZES``, in turn; the numbers are
    Philox's integers with the round as their key, the same for ever.
    """
    integers = np.asarray(np.random.Philox(key=number).random_raw(tries * _SEGMENTS))
    share = (integers >> np.uint64(11)).astype(np.float64).reshape(tries, _SEGMENTS) * 2.0**-52 - 1.0
    kind = np.arange(tries)
    hold = np.array(HOLDS)[(kind // len(SIZES)) % len(HOLDS), np.newaxis]
    held = np.take_along_axis(share, np.arange(_SEGMENTS) // hold, axis=1)
    return np.array(SIZES)[kind % len(SIZES), np.newaxis] * held


def deviate(command_mps2: Floats, deviation: Floats, worlds: Worlds, vehicle: int) -> Floats:
    """Commands [n] plus the deviations [n, segments] in force now, within the vehicle's capacities."""
    segment = np.minimum((worlds.time_s / SEGMENT_S).astype(np.int64), _SEGMENTS - 1)
    braking = worlds.vehicles.braking_capacity_mps2[:, vehicle]
    driving = worlds.vehicles.driving_capacity_mps2[:, vehicle]
    wanted: Floats = command_mps2 + deviation[np.arange(worlds.n), segment] * braking
    return np.clip(wanted, -braking, driving)
