"""A policy that rehearses: at the alert it tries deviations from itself in the engine, and drives the best it found."""

from __future__ import annotations

import copy

import numpy as np

from ethbrake_marl.agents.around import AgentAround
from ethbrake_marl.agents.knowledge import Source
from ethbrake_marl.agents.protocol import Agent, check_agent, place, recall
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.agents.rollout import drive, introduce, scripted
from ethbrake_marl.errors import check_whole_number
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario

REHEARSALS = 32  # deviations tried in each round
ROUNDS = 6  # each starts from the best of the rounds before
SEGMENT_S = 0.4  # a deviation changes at multiples of this time
HOLDS = (2, 3, 6)  # segments for which it stays the same, in turn
SIZES = (0.05, 0.15, 0.4)  # largest change in one round, as shares of the braking capacity, in turn
_SEGMENTS = 64  # of different deviation; the last one goes on
_BLOCK = 4096  # worlds rolled out together: bounds memory, changes no result


class Rehearsed(AgentAround):
    """Drives by ``policy`` plus the deviation that did the least harm when many were rolled out at the alert.

    A deviation is a sequence of accelerations added to what the policy does; the policy goes on reacting to what it
    observes. The first one is none. In each of ``rounds`` rounds ``rehearsals`` fixed changes, the same in every world,
    are added to the best deviation so far, and the least harm of all is kept: a random local search around the policy.
    ``predicted_harm`` [n] is that least harm (m2/s2, under ``harm_count``), never above the policy's own, and what is
    realised if the other vehicles follow their scripts. Equal harms: the earlier one, so a policy that cannot be
    bettered drives as it is. A world's choice does not depend on its batch. Raises ``InvalidInput`` for what is not an
    agent, numbers of rehearsals or rounds outside 1 to 10,000, an unknown count.
    """

    adds = Source.MODEL  # in which it rehearses
    divides_along = ("_deviation", "predicted_harm")

    def __init__(
        self,
        policy: Agent,
        scenario: Scenario,
        *,
        rehearsals: int = REHEARSALS,
        rounds: int = ROUNDS,
        harm_count: HarmCount = "first",
    ) -> None:
        check_agent(policy, "rehearsed")
        for name, number in (("rehearsals", rehearsals), ("rounds", rounds)):
            check_whole_number(f"rehearsed: {name}", number, 1, 10_000)
        check_harm_count(harm_count)
        super().__init__(policy, f"{policy.name}+refined")
        self.scenario = scenario
        self.rehearsals = rehearsals
        self.rounds = rounds
        self.harm_count: HarmCount = harm_count
        self.predicted_harm: Floats = np.empty(0)
        self._deviation: Floats = np.empty((0, _SEGMENTS))  # [n, segments] that is driven
        self._stage = copy.deepcopy(policy)  # rehearsing must not disturb the policy's memory of running episodes

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Rehearse for these rows; ``worlds`` holds those rows only, at the alert."""
        best = np.zeros((worlds.n, _SEGMENTS))
        least = self._harm(worlds, vehicle, best)
        for number in range(self.rounds):
            change = changes(number, self.rehearsals)
            open_rows = np.flatnonzero(least > 0.0)
            step = max(1, _BLOCK // self.rehearsals)
            for some in (open_rows[i : i + step] for i in range(0, len(open_rows), step)):
                tried = best[some, np.newaxis] + change  # [worlds, rehearsals, segments]
                harm = self._harm(worlds.take(np.repeat(some, len(change))), vehicle, tried.reshape(-1, _SEGMENTS))
                harm = harm.reshape(len(some), len(change))
                chosen = harm.argmin(axis=1)
                better = harm[np.arange(len(some)), chosen] < least[some]
                best[some[better]] = tried[better, chosen[better]]
                least[some[better]] = harm[better, chosen[better]]
        introduce(self.policy, vehicle, scripted(self.scenario, but=vehicle))
        self.policy.begin(worlds, vehicle, rows)
        self._deviation = place(self._deviation, rows, best)
        self.predicted_harm = place(self.predicted_harm, rows, least)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Wanted signed acceleration, [n] m/s2. Raises ``InvalidInput`` if an episode never began."""
        deviation = recall(self._deviation, worlds.n, self.name)
        return deviated(self.policy.act(worlds, vehicle), deviation, worlds, vehicle)

    def _harm(self, worlds: Worlds, vehicle: int, deviation: Floats) -> Floats:
        """Harm under one deviation per world, [n]."""
        return drive(worlds, _Deviating(self._stage, deviation), self.scenario, vehicle).ledger.world_harm(
            self.harm_count
        )


def refine(policy: Agent, argument: None, settings: AgentSettings) -> Agent:
    """``+refined`` around an agent."""
    return Rehearsed(policy, settings.needed_scenario(), harm_count=settings.harm_count)


class _Deviating(AgentAround):
    """A policy plus one given deviation per world."""

    def __init__(self, policy: Agent, deviation: Floats) -> None:
        super().__init__(policy, "deviating")
        self.deviation = deviation  # [n, segments]

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        return deviated(self.policy.act(worlds, vehicle), self.deviation, worlds, vehicle)


def changes(number: int, rehearsals: int) -> Floats:
    """What round ``number`` adds to a deviation, as shares of the braking capacity: [rehearsals, segments].

    Change k is constant over ``HOLDS`` segments and uniform in plus or minus one of ``SIZES``, in turn; the numbers are
    Philox's integers with the round as their key, the same for ever.
    """
    integers = np.asarray(np.random.Philox(key=number).random_raw(rehearsals * _SEGMENTS))
    share = (integers >> np.uint64(11)).astype(np.float64).reshape(rehearsals, _SEGMENTS) * 2.0**-52 - 1.0
    kind = np.arange(rehearsals)
    hold = np.array(HOLDS)[(kind // len(SIZES)) % len(HOLDS), np.newaxis]
    held = np.take_along_axis(share, np.arange(_SEGMENTS) // hold, axis=1)
    return np.array(SIZES)[kind % len(SIZES), np.newaxis] * held


def deviated(command_mps2: Floats, deviation: Floats, worlds: Worlds, vehicle: int) -> Floats:
    """Commands [n] plus the deviations [n, segments] in force now, within the vehicle's capacities."""
    segment = np.minimum((worlds.time_s / SEGMENT_S).astype(np.int64), _SEGMENTS - 1)
    braking = worlds.vehicles.braking_capacity_mps2[:, vehicle]
    driving = worlds.vehicles.driving_capacity_mps2[:, vehicle]
    wanted: Floats = command_mps2 + deviation[np.arange(worlds.n), segment] * braking
    return np.clip(wanted, -braking, driving)
