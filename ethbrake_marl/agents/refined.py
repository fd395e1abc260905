"""The refinement of a policy: at the alert it tries deviations in the engine, and drives the best it found."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping

import numpy as np

from ethbrake_marl.agents.protocol import Agent, AgentAround, Source, check_agent, fixed_commands
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.agents.rollout import drive, record_commands
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine import Memory, Script, ask_script, begin_script, take_memory
from ethbrake_marl.errors import InvalidInput, check_whole_number, renumbered
from ethbrake_marl.harm import check_harm_count
from ethbrake_marl.physics import CLOCK, Decisions, Floats, Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search import ProfileProblem, profile_problem

# The compiled refinement of a policy: a search around its own episode at the alert, which then drives.

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

    def __init__(
        self, policy: Agent, scenario: Scenario, *, candidates: int = CANDIDATES, harm_count: HarmCount = "first"
    ) -> None:
        check_agent(policy, "refined")
        check_whole_number("refined: candidates", candidates, 1, 1_000_000)
        check_harm_count(harm_count)
        super().__init__(policy, f"{policy.name}+refined:profile")
        self.scenario, self.candidates = scenario, candidates
        self.harm_count: HarmCount = harm_count
        self._steps = int(np.ceil(scenario.horizon_s / scenario.time_step_s)) + 1

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Search in these worlds."""
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        problem = self._problem(alert, vehicle, others)
        own = record_commands(self.policy, alert, self.scenario, vehicle, int(problem.last_step.max()))
        commands, harm = self._search(problem, own)
        return {
            "commands_mps2": np.pad(commands, ((0, 0), (0, self._steps - own.shape[1])), mode="edge"),
            "start_s": problem.clock[:, CLOCK.START].copy(),  # of the first decision
            "predicted_harm": harm,
        }

    def _problem(self, worlds: Worlds, vehicle: int, others_mps2: Floats) -> ProfileProblem:
        return profile_problem(
            worlds,
            [vehicle],
            harm_count=self.harm_count,
            horizon_s=self.scenario.horizon_s,
            time_step_s=self.scenario.time_step_s,
            others_mps2=others_mps2,
        )

    def _search(self, problem: ProfileProblem, commands_mps2: Floats) -> tuple[Floats, Floats]:
        """The best commands that are found around these, and their harm."""
        return problem.refine(commands_mps2, budget=self.candidates)

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """The command of the step, [n] m/s2."""
        step = Decisions(memory["start_s"], self.scenario.time_step_s).latest(worlds.time_s)
        return memory["commands_mps2"][np.arange(worlds.n), np.clip(step, 0, self._steps - 1)], memory


# The compiled refinement once more at every decision, from the worlds as they are then.

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

    def __init__(self, policy: Agent, scenario: Scenario, argument: str, *, harm_count: HarmCount = "first") -> None:
        candidates, self._microseconds = _budget(argument)
        super().__init__(policy, scenario, candidates=candidates, harm_count=harm_count)
        self.name = f"{policy.name}+refined:{argument}"

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Make the first plan of these episodes."""
        begun = super().begin(alert, vehicle, scripts)
        others = fixed_commands(scripts, alert, f"agent {self.name!r}", vehicle=vehicle)
        return {**begun, "others_mps2": others, "planned_s": begun["start_s"]}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """The first command of the new plans, [n] m/s2."""
        planned = memory["planned_s"]
        moving = (worlds.speeds_mps != 0.0).any(axis=1)
        rows = np.flatnonzero((worlds.time_s > planned) & (worlds.time_s < self.scenario.horizon_s) & moving)
        if rows.size:
            plan, planned = memory["commands_mps2"].copy(), planned.copy()
            plan[rows] = self._plan_again(worlds.take(rows), vehicle, take_memory(memory, rows))
            planned[rows] = worlds.time_s[rows]
            memory = {**memory, "commands_mps2": plan, "planned_s": planned}
        return super().act(worlds, memory, vehicle)

    def _plan_again(self, worlds: Worlds, vehicle: int, held: Memory) -> Floats:
        """The plans [m, steps] with what is left of them searched around, from the worlds as they are now."""
        plan: Floats = held["commands_mps2"]
        problem = self._problem(worlds, vehicle, held["others_mps2"])
        step = Decisions(held["start_s"], self.scenario.time_step_s).latest(worlds.time_s)
        later = step[:, np.newaxis] + np.arange(int(problem.last_step.max()))
        rows, last = np.arange(worlds.n)[:, np.newaxis], self._steps - 1
        found = self._search(problem, plan[rows, np.minimum(later, last)])[0]
        inside = later <= last
        plan[np.broadcast_to(rows, later.shape)[inside], later[inside]] = found[inside]
        return plan

    def _search(self, problem: ProfileProblem, commands_mps2: Floats) -> tuple[Floats, Floats]:
        """The best that is found around these commands in the budget."""
        stop = time.perf_counter() + 1e-6 * self._microseconds * problem.n
        found, seed = problem.refine(commands_mps2, budget=self.candidates), 0
        while time.perf_counter() < stop:
            seed += 1
            found = problem.refine(found[0], budget=self.candidates, seed=seed)
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
