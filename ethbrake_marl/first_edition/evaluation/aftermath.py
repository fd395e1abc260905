"""Two measures that are computed while episodes run: how far Vehicle 1 is shoved, and the paper's sampled harm.

Create the object of a measure with ``of``, and call ``see`` for each step (arguments: ``Tape.see``).
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.first_edition.agents.driving import script_agents
from ethbrake_marl.first_edition.engine.memory import is_state_free
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.episode import Decisions
from ethbrake_marl.first_edition.physics.estimates import move_on
from ethbrake_marl.first_edition.physics.paper_map import sample_on
from ethbrake_marl.first_edition.physics.state import Floats, Worlds, sum_rows
from ethbrake_marl.first_edition.scenario.roles import ScriptSpec
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task


class ShovedFront:
    """Measure how far other vehicles shove Vehicle 1 beyond the place that it would reach if nobody touched it.

    ``shoved = distance that Vehicle 1 drives - own_way_m``, where ``own_way_m`` [n] is the distance that Vehicle 1
    would drive until the horizon if nobody touched it. ``shoved`` is negative if Vehicle 1 ends short of that place,
    for instance because an obstacle threw it back.
    """

    def __init__(self, worlds: Worlds, own_way_m: Floats) -> None:
        self._own_way_m = own_way_m
        self._way_m = np.zeros(worlds.n)

    @classmethod
    def of(cls, worlds: Worlds, task: Task) -> ShovedFront | None:
        """Return the object for ``worlds`` at the alert, or None if shoving is not defined.

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
        """Add the distance that Vehicle 1 drives in one step.

        The distance is the decrease of Vehicle 1's gap to an obstacle. For this computation, an obstacle is put into
        worlds without an obstacle, so far ahead that Vehicle 1 cannot reach it in this step.
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
    fixed step (``advance_sampled``), up to the horizon. The agents make no new decisions. If the episode of a world
    ended earlier in the exact physics, the last commands of its vehicles remain in force.
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
        """Return the object for ``worlds`` at the alert, or None if sampled harm is not defined.

        The time samples are the times of Vehicle 2's decisions. Sampled harm is therefore defined only if Vehicle 2 is
        the only controlled vehicle and no script reacts to the state of the world. It is not defined with an obstacle
        or with brake force that builds up gradually, because the paper's equations describe neither obstacles nor such
        brakes.
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
        """Advance every world to the horizon, and return its sampled harm, [n] m2/s2."""
        while (self._worlds.time_s < self._horizon_s - 1e-6 * self._step_s).any():
            self._move()
        return self._harm
