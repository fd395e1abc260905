"""Two measures that are computed while episodes run: how far Vehicle 1 is shoved, and the paper's sampled harm."""

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
    """Measure how far other vehicles shove Vehicle 1 beyond the place that it would reach if nobody touched it.

    ``shoved = distance that Vehicle 1 drives - distance that it would drive until the horizon if nobody touched it``.
    ``shoved`` is negative if Vehicle 1 ends short of the place that it would reach, for instance because an obstacle
    threw it back. Create the object with ``of``, and call ``see`` for each step.

    Args:
        worlds: the n worlds at the alert.
        own_way_m: distance that Vehicle 1 would drive until the horizon if nobody touched it, [n] m.

    """

    def __init__(self, worlds: Worlds, own_way_m: Floats) -> None:
        self._own_way_m = own_way_m
        self._way_m = np.zeros(worlds.n)

    @classmethod
    def of(cls, worlds: Worlds, task: Task) -> ShovedFront | None:
        """Return the object that measures shoving in ``worlds``, or None if shoving is not defined for the task.

        Shoving is not defined if Vehicle 1 is controlled, if its script reacts to the state of the world, or if brake
        force builds up gradually.
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
        """Add the distance that Vehicle 1 drives in one step to the distance that it has driven so far.

        The distance that Vehicle 1 drives is computed as the decrease of its gap to an obstacle. For this computation,
        an obstacle is put into worlds without an obstacle, so far ahead that Vehicle 1 cannot reach it in this step.

        Args:
            before: the worlds at the beginning of the step.
            command_mps2: commanded accelerations during the step (m/s2), [n, N].
            until_s: time since the alert at which the step ends (s), [n].

        """
        post = before.with_post_ahead(until_s - before.time_s)
        after, _ = advance(post, command_mps2, until_s=until_s)
        self._way_m += post.obstacle_gap_m - after.obstacle_gap_m

    @property
    def metres(self) -> Floats:
        """Distance by which Vehicle 1 was shoved in each world so far, [n] m."""
        shoved: Floats = self._way_m - self._own_way_m
        return shoved


VEHICLE_2 = 1  # index of the vehicle whose latency sets the time of the map's first sample


class SampledHarm:
    """Compute the sampled harm of the episodes: the paper's sum of squared closing speeds over time samples.

    The commands that the agents gave in the exact physics are applied again in the paper's equations of motion with a
    fixed step (``advance_sampled``). The agents make no new decisions. Every world is simulated in the paper's
    equations up to the horizon. If the episode of a world ended earlier in the exact physics, the last commands of its
    vehicles remain in force. Create the object with ``of``, call ``see`` for each step, and get the harm from
    ``finish``.

    Args:
        worlds: the n worlds at the alert; they are copied.
        scenario: scenario of the worlds, which sets the time step and the horizon.

    """

    def __init__(self, worlds: Worlds, scenario: Scenario) -> None:
        self._worlds = worlds.copy()
        self._command = np.zeros(worlds.speeds_mps.shape)
        self._harm = np.zeros(worlds.n)
        self._start_s = worlds.first_decision_s([VEHICLE_2])
        self._step_s, self._horizon_s = scenario.time_step_s, scenario.horizon_s
        self._samples = -1  # number of the last sample; the first step of the map ends at sample 0

    @classmethod
    def of(cls, worlds: Worlds, task: Task) -> SampledHarm | None:
        """Return the object that computes the sampled harm in ``worlds``, or None if sampled harm is not defined.

        The time samples of sampled harm are the times of Vehicle 2's decisions. Sampled harm is therefore defined only
        if Vehicle 2 is the only controlled vehicle and no script reacts to the state of the world. With an obstacle, or
        with brake force that builds up gradually, sampled harm is not defined, because the paper's equations describe
        neither obstacles nor such brakes.
        """
        obstacle = task.scenario.has_obstacle or worlds.obstacle_ahead.any()
        if task.vehicles != (VEHICLE_2,) or obstacle or worlds.vehicles.build_up.any():
            return None
        if not all(map(is_state_free, script_agents(task.scenario, except_for=VEHICLE_2).values())):
            return None
        return cls(worlds, task.scenario)

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Apply the commands of one step in the paper's equations of motion, and add the harm of one time sample.

        In a world whose episode has ended, the last commands of the vehicles are applied again.

        Args:
            before: the worlds at the beginning of the step.
            command_mps2: commanded accelerations during the step (m/s2), [n, N].
            until_s: time since the alert at which the step ends (s), [n]; in a world whose episode has ended, the time
                at which the episode ended.

        """
        running = until_s > before.time_s
        self._command = np.where(running[:, np.newaxis] | (self._samples < 0), command_mps2, self._command)
        self._move()

    def _move(self) -> None:
        """Advance every world to its next time sample or, if the horizon comes earlier, to the horizon."""
        self._samples += 1
        next_s = np.minimum(Decisions(self._start_s, self._step_s).at(self._samples), self._horizon_s)
        until_s = np.maximum(next_s, self._worlds.time_s)
        impacts = sample_on(self._worlds, self._command, until_s, self._step_s)
        self._harm += sum_rows(impacts.total_harm)

    def finish(self) -> Floats:
        """Advance every world to the horizon, and return the sampled harm of each world, [n] m2/s2."""
        while (self._worlds.time_s < self._horizon_s - 1e-6 * self._step_s).any():
            self._move()
        return self._harm
