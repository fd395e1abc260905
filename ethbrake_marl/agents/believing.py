"""Agents that decide on what was really received: any agent that reads the line, shown a believed world instead."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.agents.believed import Ranges, believed_worlds, ranges_of, told_to
from ethbrake_marl.agents.knowledge import Knowledge, Source
from ethbrake_marl.agents.protocol import Agent, AgentAround, PredictingAgent, place
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario

SUFFIX = "believed"


def split_believed(argument: str | None) -> tuple[str | None, bool]:
    """The argument of an agent without ``believed`` at its end, and whether it was there."""
    if argument == SUFFIX:
        return None, True
    if argument is not None and argument.endswith(f":{SUFFIX}"):
        return argument.removesuffix(f":{SUFFIX}"), True
    return argument, False


class Odometer:
    """A vehicle's own way since the alert, from its own speed and command at its decisions, [n] m."""

    def __init__(self) -> None:
        self.way_m: Floats = np.zeros(0)
        self.time_s: Floats = np.zeros(0)
        self.speed_mps: Floats = np.zeros(0)

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Episodes start in these rows."""
        self.way_m = place(self.way_m, rows, np.zeros(len(rows)))
        self.time_s = place(self.time_s, rows, worlds.time_s)
        self.speed_mps = place(self.speed_mps, rows, worlds.speeds_mps[:, vehicle])

    def look(self, worlds: Worlds, vehicle: int) -> Floats:
        """The way up to now, [n]: exact under a constant command, also to a stop; the mean speed counts elsewhere."""
        n, speed, command = worlds.n, worlds.speeds_mps[:, vehicle], worlds.command_mps2[:, vehicle]
        before, passed = self.speed_mps[:n], worlds.time_s - self.time_s[:n]
        way = 0.5 * (before + speed) * passed
        stopped = (speed == 0.0) & (before > 0.0) & (command < 0.0)
        way[stopped] = np.minimum(way, before * before / (-2.0 * np.where(stopped, command, -1.0)))[stopped]
        self.way_m[:n] += way
        self.time_s[:n], self.speed_mps[:n] = worlds.time_s, speed
        return self.way_m[:n].copy()


class Believing(AgentAround):
    """Drives by ``policy``, any agent that reads the line, in the world that its vehicle believes in.

    The policy begins when it is first asked, from what was received by then. It begins anew in the worlds in which it
    hears what nothing foretold: of another vehicle for the first time or, over a channel, that one reacts.
    ``predicted_harm`` [n] is what it expected when it was first asked. ``shows``: the policy is shown the believed
    world at every decision, not only where it begins. Raises ``InvalidInput`` for a mixture.
    """

    def __init__(self, policy: Agent, scenario: Scenario, *, name: str | None = None, shows: bool = False) -> None:
        super().__init__(policy, f"{policy.name}:{SUFFIX}" if name is None else name)
        self.scenario = scenario
        self._shows = shows
        self._odometer = Odometer()
        self.predicted_harm: Floats = np.zeros(0)
        self._signature: Floats = np.zeros((0, 0))  # NaN where the policy has not begun
        self._ranges: tuple[int, Ranges] | None = None
        self._ranges_of(0)  # refuses a mixture at once

    @property
    def knows(self) -> Knowledge:
        """What it received, and the model of the line filled in from the scenario."""
        return (Source.BELIEFS,)

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Remember where these episodes start; nothing has been received yet."""
        self._odometer.begin(worlds, vehicle, rows)
        self._signature = place(self._signature, rows, np.full((len(rows), 2 * worlds.N), np.nan))
        self.predicted_harm = place(self.predicted_harm, rows, np.full(len(rows), np.nan))

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The policy's command, [n] m/s2. Raises ``InvalidInput`` if an episode never began."""
        n = worlds.n
        if n > len(self._signature):
            raise InvalidInput(
                f"agent {self.name!r}: act on {count_of(n, 'world')}, but begin was not called for each of them"
            )
        way = self._odometer.look(worlds, vehicle)
        signature = self._heard(worlds, vehicle)
        changed = (signature != self._signature[:n]).any(axis=1)
        rows = np.flatnonzero(changed)
        if rows.size:
            self._begin_policy(self._believe(worlds.take(rows), vehicle, way[rows]), vehicle, rows)
            first, self._signature[rows] = rows[np.isnan(self._signature[rows, 0])], signature[rows]
            if isinstance(self.policy, PredictingAgent):
                self.predicted_harm[first] = self.policy.predicted_harm[first]
        shown = self._believe(worlds, vehicle, way) if self._shows else worlds
        return self.policy.act(shown, vehicle)

    def _begin_policy(self, believed: Worlds, vehicle: int, rows: Ints) -> None:
        self.policy.begin(believed, vehicle, rows)

    def _heard(self, worlds: Worlds, vehicle: int) -> Floats:
        """What the policy begins anew for when it changes, [n, 2 N]: who is known, and who reacts."""
        told = told_to(worlds, vehicle)
        unforetold = told.reacts & self.scenario.v2x.by_link  # without a channel the own latencies tell
        return np.concatenate([told.known, unforetold], axis=1).astype(np.float64)

    def _believe(self, worlds: Worlds, vehicle: int, way_m: Floats) -> Worlds:
        return believed_worlds(worlds, vehicle, self._ranges_of(vehicle), self.others, way_m)

    def _ranges_of(self, vehicle: int) -> Ranges:
        if self._ranges is None or self._ranges[0] != vehicle:
            self._ranges = vehicle, ranges_of(self.scenario, vehicle)
        return self._ranges[1]
