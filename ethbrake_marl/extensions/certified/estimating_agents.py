"""Agents that decide in the estimated world, which is received information, completed from the scenario's ranges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ethbrake_marl.extensions.certified.estimated import Ranges
from ethbrake_marl.first_edition.agents.protocol import Agent, AgentAround, Knowledge, Source
from ethbrake_marl.first_edition.agents.received import Received
from ethbrake_marl.first_edition.engine.memory import Memory, ask_script, begin_script, renew_memory
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.physics.messages import LATENCY
from ethbrake_marl.first_edition.physics.state import Floats, Vehicles, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent


class Odometer(NamedTuple):
    """Distance of a vehicle from its position at the alert, computed from its speed and command at each decision."""

    way_m: Floats  # [n] distance since the alert, m
    time_s: Floats  # [n] time of the last decision, s
    speed_mps: Floats  # [n] speed at the last decision, m/s

    @classmethod
    def begun(cls, alert: Worlds, vehicle: int) -> Odometer:
        """Return the odometer of the vehicle with index ``vehicle`` at the start of episodes; ``alert`` [n] are the
        worlds at the alert.
        """
        return cls(np.zeros(alert.n), alert.time_s.copy(), alert.speeds_mps[:, vehicle].copy())

    def look(self, worlds: Worlds, vehicle: int) -> Odometer:
        """Return the odometer for the present ``worlds`` [n].

        The method adds the distance since the last decision: mean speed times time, or the stopping distance if a
        braking vehicle stopped. The added distance is exact if the command was constant.
        """
        speed, command, before = worlds.speeds_mps[:, vehicle], worlds.command_mps2[:, vehicle], self.speed_mps
        way = 0.5 * (before + speed) * (worlds.time_s - self.time_s)
        stopped = (speed == 0.0) & (before > 0.0) & (command < 0.0)
        way[stopped] = np.minimum(way, before * before / (-2.0 * np.where(stopped, command, -1.0)))[stopped]
        return Odometer(self.way_m + way, worlds.time_s.copy(), speed.copy())


class Estimating(AgentAround):
    """Agent whose vehicle is controlled by another agent, ``policy``, which starts in the estimated world.

    The policy starts at its first decision, with the information received by then. The policy restarts in a world when
    the vehicle learns of a further vehicle, or when a message over a channel says that another vehicle reacts. The
    estimate assumes that the other vehicles follow the scenario's scripts. ``predicted_harm`` [n] is the harm that the
    policy expected at its first decision.

    Args:
        policy: any agent that reads the state of the line.
        scenario: the scenario, which declares the ranges of all unknown quantities; a mixture of scenarios raises
            ``InvalidInput``.

    """

    def __init__(self, policy: Agent, scenario: Scenario) -> None:
        super().__init__(policy, f"{policy.name}:estimated")
        self.scenario = scenario
        self._ranges: dict[int, Ranges] = {}  # ranges by the index of the agent's vehicle
        Ranges.of(scenario, 0, {})  # raises InvalidInput for a mixture

    @property
    def knows(self) -> Knowledge:
        """Information that the agent uses: received messages, completed by the scenario's model of the line."""
        return Knowledge((Source.ESTIMATES,))

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Return the agent's memory at the start of episodes; ``alert`` [n] are the worlds at the alert.

        This method does not start the policy, because the vehicle has not received any information yet. It does not use
        ``scripts``.
        """
        return {
            "way": Odometer.begun(alert, vehicle),
            "heard": np.full((alert.n, 2 * alert.N), np.nan),  # information at the last start; NaN: not started
            "predicted_harm": np.full(alert.n, np.nan),
            "policy": None,
        }

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Return the policy's command, [n] m/s2, and the agent's new memory.

        Of the true ``worlds``, only the information that the vehicle received is read.
        """
        way, heard = Odometer(*memory["way"]).look(worlds, vehicle), self._heard(worlds, vehicle)
        policy, predicted = memory["policy"], memory["predicted_harm"]
        rows = np.flatnonzero((heard != memory["heard"]).any(axis=1))
        if rows.size:
            estimated = self._estimate(worlds.take(rows), vehicle, way.way_m[rows])
            others = self._ranges[vehicle].others
            begun = begin_script(self.policy, self._shown_at_first(estimated), vehicle, others)
            policy = begun if policy is None else renew_memory(policy, rows, begun)  # the first call covers all rows
            if isinstance(policy, Mapping) and "predicted_harm" in policy:
                predicted = np.where(np.isnan(memory["heard"][:, 0]), policy["predicted_harm"], predicted)
        command, policy = ask_script(self.policy, worlds, policy, vehicle)
        return command, {"way": way, "heard": heard, "predicted_harm": predicted, "policy": policy}

    def _shown_at_first(self, estimated: Worlds) -> Worlds:
        return estimated

    def _heard(self, worlds: Worlds, vehicle: int) -> Floats:
        """Return a summary of the information that ``vehicle`` has received about each vehicle, [n, 2 N].

        The first N columns contain the amount of information about each vehicle (``Received.heard``). The other N
        columns contain a 1 for each vehicle whose reaction was reported in a message but not predicted, otherwise 0.
        The policy restarts in worlds in which this summary changes.
        """
        known = Received.by(worlds, vehicle)
        # a received latency predicts the reaction, unless a channel may delay the reaction
        unforetold = known.reacts & (self.scenario.v2x.delays | ~known.pieces[..., LATENCY])
        return np.concatenate([known.heard, unforetold], axis=1)

    def _estimate(self, worlds: Worlds, vehicle: int, way_m: Floats) -> Worlds:
        if vehicle not in self._ranges:
            self._ranges[vehicle] = Ranges.of(self.scenario, vehicle)
        return self._ranges[vehicle].estimate(worlds, way_m)


class EstimatingHybrid(Estimating):
    """The paper's Algorithm 1 in the estimated world.

    At the first decision the agent predicts the harm of the policy and of E-V2X-BM, and lets the one with less
    predicted harm control the vehicle for the whole episode.
    """

    policy: HybridAgent

    @property
    def knows(self) -> Knowledge:
        """Information that the policy uses, and the estimated world, in which the agent compares the policy with
        E-V2X-BM.
        """
        return Knowledge.of(self.policy.policy, also=Source.ESTIMATES)

    def _shown_at_first(self, estimated: Worlds) -> Worlds:
        """Return the estimated worlds with the present time set to 0 and past impacts removed.

        The rollouts (simulated episodes) that compare the policy with E-V2X-BM start in these worlds.
        """
        v, n = estimated.vehicles, estimated.n
        latency = np.maximum(v.latency_s - estimated.time_s[:, np.newaxis], 0.0)
        vehicles = Vehicles.at_once(
            v.braking_capacity_mps2, v.driving_capacity_mps2, latency, v.mass_t, v.speed_limit_mps, v.restitution,
            v.brake_rate_mps3, v.release_rate_mps3, harm_weight=v.harm_weight,
        )  # fmt: skip
        return replace(
            estimated, vehicles=vehicles, time_s=np.zeros(n), pair_hit=np.zeros_like(estimated.pair_hit),
            obstacle_hit=np.zeros(n, np.bool_),
        )  # fmt: skip
