"""Agents that decide on what was really received: any agent that reads the line, shown a believed world instead."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.protocol import Agent, AgentAround, Knowledge, Source
from ethbrake_marl.engine.memory import Memory, ask_script, begin_script, renew_memory
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.extensions.certified.estimated import Ranges, Told
from ethbrake_marl.physics.state import Floats, Vehicles, Worlds
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.paper_hybrid import HybridAgent


class Odometer(NamedTuple):
    """A vehicle's own way since the alert, from its own speed and command at its decisions."""

    way_m: Floats  # [n]
    time_s: Floats  # [n] of the last decision
    speed_mps: Floats  # [n] then

    @classmethod
    def begun(cls, alert: Worlds, vehicle: int) -> Odometer:
        """Where episodes start."""
        return cls(np.zeros(alert.n), alert.time_s.copy(), alert.speeds_mps[:, vehicle].copy())

    def look(self, worlds: Worlds, vehicle: int) -> Odometer:
        """The way up to now: exact under a constant command, also to a stop; the mean speed counts elsewhere."""
        speed, command, before = worlds.speeds_mps[:, vehicle], worlds.command_mps2[:, vehicle], self.speed_mps
        way = 0.5 * (before + speed) * (worlds.time_s - self.time_s)
        stopped = (speed == 0.0) & (before > 0.0) & (command < 0.0)
        way[stopped] = np.minimum(way, before * before / (-2.0 * np.where(stopped, command, -1.0)))[stopped]
        return Odometer(self.way_m + way, worlds.time_s.copy(), speed.copy())


class Believing(AgentAround):
    """Drives by ``policy``, any agent that reads the line, in the world that its vehicle believes in.

    The policy begins when it is first asked, from what was received by then. It begins anew in the worlds in which it
    hears what nothing foretold: of another vehicle for the first time or, over a channel, that one reacts. The others
    follow the scenario's scripts, as far as is believed. ``predicted_harm`` [n] is what the policy expected when it was
    first asked. ``shows``: the policy is shown the believed world at every decision, not only where it begins. Raises
    ``InvalidInput`` for a mixture.
    """

    def __init__(self, policy: Agent, scenario: Scenario, *, shows: bool = False) -> None:
        super().__init__(policy, f"{policy.name}:believed")
        self.scenario, self._shows = scenario, shows
        self._ranges: dict[int, Ranges] = {}  # by own vehicle
        Ranges.of(scenario, 0, {})  # refuses a mixture at once

    @property
    def knows(self) -> Knowledge:
        """What it received, and the model of the line filled in from the scenario."""
        return Knowledge((Source.BELIEFS,))

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Where these episodes start; nothing has been received yet, so the policy has not begun."""
        return {
            "way": Odometer.begun(alert, vehicle),
            "heard": np.full((alert.n, 2 * alert.N), np.nan),  # that the policy began on; NaN: it has not
            "predicted_harm": np.full(alert.n, np.nan),
            "policy": None,
        }

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """The policy's command, [n] m/s2."""
        way, heard = Odometer(*memory["way"]).look(worlds, vehicle), self._heard(worlds, vehicle)
        policy, predicted = memory["policy"], memory["predicted_harm"]
        rows = np.flatnonzero((heard != memory["heard"]).any(axis=1))
        if rows.size:
            believed = self._believe(worlds.take(rows), vehicle, way.way_m[rows])
            others = self._ranges[vehicle].others
            begun = begin_script(self.policy, self._shown_at_first(believed), vehicle, others)
            policy = begun if policy is None else renew_memory(policy, rows, begun)  # first of all in every row
            if isinstance(policy, Mapping) and "predicted_harm" in policy:
                predicted = np.where(np.isnan(memory["heard"][:, 0]), policy["predicted_harm"], predicted)
        shown = self._believe(worlds, vehicle, way.way_m) if self._shows else worlds
        command, policy = ask_script(self.policy, shown, policy, vehicle)
        return command, {"way": way, "heard": heard, "predicted_harm": predicted, "policy": policy}

    def _shown_at_first(self, believed: Worlds) -> Worlds:
        return believed

    def _heard(self, worlds: Worlds, vehicle: int) -> Floats:
        """What the policy begins anew for when it changes, [n, 2 N]: who is known, and who reacts."""
        told = Told.to(worlds, vehicle)
        unforetold = told.reacts & self.scenario.v2x.by_link  # without a channel the own latencies tell
        return np.concatenate([told.known, unforetold], axis=1).astype(np.float64)

    def _believe(self, worlds: Worlds, vehicle: int, way_m: Floats) -> Worlds:
        if vehicle not in self._ranges:
            self._ranges[vehicle] = Ranges.of(self.scenario, vehicle)
        return self._ranges[vehicle].believe(worlds, way_m)


class BelievingHybrid(Believing):
    """Algorithm 1 on what was received: at the first decision policy and E-V2X-BM are compared as is believed."""

    policy: HybridAgent

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, which drives by what it observes, and what the comparison adds."""
        return Knowledge.of(self.policy.policy, also=Source.BELIEFS)

    def _shown_at_first(self, believed: Worlds) -> Worlds:
        """The comparison is a rollout, which begins at t = 0 without impacts: the same line, its clock put back."""
        v, n = believed.vehicles, believed.n
        latency = np.maximum(v.latency_s - believed.time_s[:, np.newaxis], 0.0)
        vehicles = Vehicles.at_once(
            v.braking_capacity_mps2, v.driving_capacity_mps2, latency, v.mass_t, v.speed_limit_mps, v.restitution,
            v.brake_rate_mps3, v.release_rate_mps3,
        )  # fmt: skip
        return replace(
            believed, vehicles=vehicles, time_s=np.zeros(n), pair_hit=np.zeros_like(believed.pair_hit),
            obstacle_hit=np.zeros(n, np.bool_),
        )  # fmt: skip
