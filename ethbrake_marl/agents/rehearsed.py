"""A policy that rehearses: at the alert it tries small deviations from itself in the engine, and drives the best."""

from __future__ import annotations

import copy

import numpy as np

from ethbrake_marl.agents.driving import drive, introduce, scripted
from ethbrake_marl.agents.protocol import Agent, place
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import HarmCount, check_count
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario

REHEARSALS = 32  # deviations tried beside the policy as it is
SEGMENT_S = 0.8  # a deviation is constant this long
SIZES = (0.05, 0.15, 0.4)  # largest deviations, as shares of the braking capacity, in turn
_SEGMENTS = 64  # of different deviation; the last one goes on


class Rehearsed:
    """Drives by ``policy`` plus the deviation that did the least harm when all of them were rolled out at the alert.

    Deviation 0 is none; each of the other ``rehearsals`` is a fixed sequence of small accelerations, the same in every
    world. The policy goes on reacting to what it observes. ``predicted_harm`` [n] is the least harm of the rollouts
    (m2/s2, under ``count``), never above the policy's own, and what is realised if the other vehicles follow their
    scripts. Equal harms: the smaller number, so a policy that cannot be bettered drives as it is. A world's choice does
    not depend on its batch. Raises ``InvalidInput`` for what is not an agent, fewer than 1 rehearsals, an unknown
    count.
    """

    def __init__(
        self, policy: Agent, scenario: Scenario, *, rehearsals: int = REHEARSALS, count: HarmCount = "first"
    ) -> None:
        if not isinstance(policy, Agent):
            raise InvalidInput(
                f"rehearsed: {policy!r} is not an agent; load_policy(path) or make_agent(name) makes one"
            )
        if isinstance(rehearsals, bool) or not isinstance(rehearsals, int) or not 1 <= rehearsals <= 10_000:
            raise InvalidInput(f"rehearsed: rehearsals = {rehearsals!r}: must be a whole number in 1..10000")
        check_count(count)
        self.name = f"rehearsed({policy.name})"
        self.policy = policy
        self.scenario = scenario
        self.count: HarmCount = count
        self.predicted_harm: Floats = np.empty(0)
        self._chosen: Floats = np.empty(0)  # [n] number of the deviation that is driven
        self._deviations = deviations(rehearsals)
        self._stage = copy.deepcopy(policy)  # rehearsing must not disturb the policy's memory of running episodes

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Rehearse for these rows; ``worlds`` holds those rows only, at the alert."""
        harm = np.stack([self._rehearse(worlds, vehicle, k) for k in range(len(self._deviations))])
        best = harm.argmin(axis=0)
        introduce(self.policy, vehicle, scripted(self.scenario, but=vehicle))
        self.policy.begin(worlds, vehicle, rows)
        self._chosen = place(self._chosen, rows, best.astype(np.float64))
        self.predicted_harm = place(self.predicted_harm, rows, harm[best, np.arange(worlds.n)])

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Wanted signed acceleration, [n] m/s2. Raises ``InvalidInput`` if an episode never began."""
        if not (len(self._chosen) >= worlds.n and np.isfinite(self._chosen[: worlds.n]).all()):
            raise InvalidInput(f"agent {self.name!r}: act on {worlds.n} worlds, but begin was not called for each")
        chosen = self._deviations[self._chosen[: worlds.n].astype(np.int64)]
        return deviated(self.policy.act(worlds, vehicle), chosen, worlds, vehicle)

    def _rehearse(self, worlds: Worlds, vehicle: int, number: int) -> Floats:
        """Harm of one deviation, [n]."""
        chosen = np.broadcast_to(self._deviations[number], (worlds.n, _SEGMENTS))
        return drive(worlds, _Deviating(self._stage, chosen), self.scenario, vehicle).ledger.world_harm(self.count)


class _Deviating:
    """A policy plus one given deviation per world."""

    name = "deviating"

    def __init__(self, policy: Agent, deviation: Floats) -> None:
        self.policy = policy
        self.deviation = deviation  # [n, segments]

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        self.policy.begin(worlds, vehicle, rows)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        return deviated(self.policy.act(worlds, vehicle), self.deviation, worlds, vehicle)


def deviations(rehearsals: int) -> Floats:
    """No deviation, then ``rehearsals`` sequences, as shares of the braking capacity: [1 + rehearsals, segments].

    Uniform in plus or minus one of ``SIZES``; the numbers are Philox's integers, the same for ever.
    """
    integers = np.asarray(np.random.Philox(key=0).random_raw(rehearsals * _SEGMENTS)).reshape(rehearsals, _SEGMENTS)
    share = (integers >> np.uint64(11)).astype(np.float64) * 2.0**-52 - 1.0
    size = np.array(SIZES)[np.arange(rehearsals) % len(SIZES), np.newaxis]
    return np.concatenate([np.zeros((1, _SEGMENTS)), size * share])


def deviated(command_mps2: Floats, deviation: Floats, worlds: Worlds, vehicle: int) -> Floats:
    """Commands [n] plus the deviations [n, segments] in force now, within the vehicle's capacities."""
    segment = np.minimum((worlds.time_s / SEGMENT_S).astype(np.int64), _SEGMENTS - 1)
    braking = worlds.vehicles.braking_capacity_mps2[:, vehicle]
    driving = worlds.vehicles.driving_capacity_mps2[:, vehicle]
    wanted: Floats = command_mps2 + deviation[np.arange(worlds.n), segment] * braking
    return np.clip(wanted, -braking, driving)
