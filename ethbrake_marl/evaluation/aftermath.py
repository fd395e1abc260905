"""Watches beside harm while episodes are driven: how far Vehicle 1 is shoved, and the paper's sum over
samples.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.agents.driving import script_agents
from ethbrake_marl.engine.memory import is_state_free
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.episode import Decisions
from ethbrake_marl.physics.estimates import move_on
from ethbrake_marl.physics.paper_map import sample_on
from ethbrake_marl.physics.state import Floats, Worlds, sum_rows
from ethbrake_marl.scenario.roles import ScriptSpec
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.task import Task


class ShovedFront:
    """Watches episodes: how far Vehicle 1 ends beyond where it would by itself, following its script undisturbed.

    ``shoved = way - solo way to the horizon``. At rest, that is the distance from its own stopping point; where the
    horizon cuts an episode off, from where it would be by then. Negative where Vehicle 1 ends short of it, as by an
    obstacle that throws it back. See ``of`` for whom it exists.
    """

    def __init__(self, worlds: Worlds, own_way_m: Floats) -> None:
        self._own_way_m = own_way_m
        self._way_m = np.zeros(worlds.n)

    @classmethod
    def of(cls, worlds: Worlds, task: Task) -> ShovedFront | None:
        """What watches these worlds (at the alert).

        None where Vehicle 1 is driven, its script needs the state, or brakes build up.
        """
        script = None if 0 in task.vehicles else task.scenario.scripts.get(0)
        vehicles = worlds.vehicles
        command = None if script is None else ScriptSpec.parse(script).command(vehicles.braking_capacity_mps2[:, 0])
        if command is None or vehicles.build_up.any():
            return None
        columns = (worlds.speeds_mps[:, 0], command, vehicles.latency_s[:, 0], vehicles.speed_limit_mps[:, 0])
        speed, command, latency, limit = (np.array(column, np.float64)[:, np.newaxis] for column in columns)
        _, way = move_on(speed, command, latency, limit, np.full(speed.shape, task.scenario.horizon_s))
        return cls(worlds, way[:, 0])

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Add the way of one step, by a post ahead: the world's own obstacle, or one out of reach."""
        post = before.with_post_ahead(until_s - before.time_s)
        after, _ = advance(post, command_mps2, until_s=until_s)
        self._way_m += post.obstacle_gap_m - after.obstacle_gap_m

    @property
    def metres(self) -> Floats:
        """How far Vehicle 1 was shoved in each world so far, [n]."""
        shoved: Floats = self._way_m - self._own_way_m
        return shoved


VEHICLE_2 = 1  # the map's samples begin with its latency


class SampledHarm:
    """Watches episodes and replays their commands, step by step, through the map of ``advance_sampled``.

    Each world goes to the horizon; after the end of its exact episode the last commands are held. The agent decided on
    the exact motion; nobody decides anew. See ``of`` for whom it exists.
    """

    def __init__(self, worlds: Worlds, scenario: Scenario) -> None:
        self._worlds = worlds.copy()
        self._command = np.zeros(worlds.speeds_mps.shape)
        self._harm = np.zeros(worlds.n)
        self._start_s = worlds.first_decision_s([VEHICLE_2])
        self._step_s, self._horizon_s = scenario.time_step_s, scenario.horizon_s
        self._samples = -1  # steps of the map so far; the time before its first sample is the first

    @classmethod
    def of(cls, worlds: Worlds, task: Task) -> SampledHarm | None:
        """What watches these worlds (at the alert).

        None with an obstacle or brakes that build up, which the map does not know, or if others decide than Vehicle 2,
        whose decisions are its samples.
        """
        obstacle = task.scenario.has_obstacle or worlds.obstacle_ahead.any()
        if task.vehicles != (VEHICLE_2,) or obstacle or worlds.vehicles.build_up.any():
            return None
        if not all(map(is_state_free, script_agents(task.scenario, except_for=VEHICLE_2).values())):
            return None
        return cls(worlds, task.scenario)

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Replay one step; the commands of a world whose episode has ended stay what they were."""
        running = until_s > before.time_s
        self._command = np.where(running[:, np.newaxis] | (self._samples < 0), command_mps2, self._command)
        self._move()

    def _move(self) -> None:
        """Go on by one step: every world to its next sample, none beyond its first one at or after the horizon."""
        self._samples += 1
        next_s = np.minimum(Decisions(self._start_s, self._step_s).at(self._samples), self._horizon_s)
        until_s = np.maximum(next_s, self._worlds.time_s)
        impacts = sample_on(self._worlds, self._command, until_s, self._step_s)
        self._harm += sum_rows(impacts.total_harm)

    def finish(self) -> Floats:
        """Go on to the horizon; gives the sum of each world, [n] m2/s2."""
        while (self._worlds.time_s < self._horizon_s - 1e-6 * self._step_s).any():
            self._move()
        return self._harm
