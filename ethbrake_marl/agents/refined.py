"""The refinement of a policy: at the alert it tries deviations in the engine, and drives the best it found."""

from __future__ import annotations

import copy

import numpy as np

from ethbrake_marl.agents.knowledge import Source
from ethbrake_marl.agents.protocol import Agent, AgentAround, check_agent, place, recall
from ethbrake_marl.agents.refined_again import RefinedAgain
from ethbrake_marl.agents.refined_profile import RefinedProfile
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.agents.rollout import drive, script_agents, set_others
from ethbrake_marl.engine.stream import ask_script, begin_script
from ethbrake_marl.errors import check_whole_number, renumbered
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario

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
    divides_along = ("_deviation", "predicted_harm")

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
        self.predicted_harm: Floats = np.empty(0)
        self._deviation: Floats = np.empty((0, _SEGMENTS))  # [n, segments] that is driven
        self._stage = copy.deepcopy(policy)  # trying must not disturb the policy's memory of running episodes

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Search for these rows; ``worlds`` holds those rows only, at the alert."""
        best = np.zeros((worlds.n, _SEGMENTS))
        least = self._harm(worlds, vehicle, best)
        for number in range(self.rounds):
            change = changes(number, self.tries)
            open_rows = np.flatnonzero(least > 0.0)
            step = max(1, _BLOCK // self.tries)
            for some in (open_rows[i : i + step] for i in range(0, len(open_rows), step)):
                tried = best[some, np.newaxis] + change  # [worlds, tries, segments]
                each = np.repeat(some, len(change))
                with renumbered(each):
                    harm = self._harm(worlds.take(each), vehicle, tried.reshape(-1, _SEGMENTS))
                harm = harm.reshape(len(some), len(change))
                chosen = harm.argmin(axis=1)
                better = harm[np.arange(len(some)), chosen] < least[some]
                best[some[better]] = tried[better, chosen[better]]
                least[some[better]] = harm[better, chosen[better]]
        set_others(self.policy, vehicle, script_agents(self.scenario, except_for=vehicle))
        begin_script(self.policy, worlds, vehicle, rows)
        self._deviation = place(self._deviation, rows, best)
        self.predicted_harm = place(self.predicted_harm, rows, least)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Wanted signed acceleration, [n] m/s2. Raises ``InvalidInput`` if an episode never began."""
        deviation = recall(self._deviation, worlds.n, self.name)
        return deviate(ask_script(self.policy, worlds, vehicle), deviation, worlds, vehicle)

    def _harm(self, worlds: Worlds, vehicle: int, deviation: Floats) -> Floats:
        """Harm under one deviation per world, [n]."""
        return drive(worlds, _Deviating(self._stage, deviation, self.name), self.scenario, vehicle).ledger.world_harm(
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

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        return deviate(ask_script(self.policy, worlds, vehicle), self.deviation, worlds, vehicle)


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
