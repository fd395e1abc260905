"""The aftermath of a line: where Vehicle 1 ends, and how much of that others pushed it.

Worlds know gaps and speeds, no places: a post ahead (``physics.obstacle``) makes the way of Vehicle 1 one more gap.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.agents.rollout import script_agents
from ethbrake_marl.engine.stream import is_state_free
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.episode import decision_s, first_decision_s, onset_s
from ethbrake_marl.physics.events import solo_motion
from ethbrake_marl.physics.failed import failure
from ethbrake_marl.physics.impact import GAP, MASS, SPEED
from ethbrake_marl.physics.obstacle import obstacle_ahead, place_obstacle, with_post_ahead
from ethbrake_marl.physics.sampled import sample_numbers, sample_worlds
from ethbrake_marl.physics.segment import COMMAND, DONE, HIT, LIMIT, ONSET, ROW_WIDTH, TABLE_ROWS, advance_table
from ethbrake_marl.physics.worlds import sum_rows
from ethbrake_marl.scenario import Scenario, Task
from ethbrake_marl.scenario.roles import constant_command


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
        """What watches these worlds (at the alert); None where Vehicle 1 is driven, or its script needs the state."""
        script = None if 0 in task.vehicles else task.scenario.scripts.get(0)
        vehicles = worlds.vehicles
        command = None if script is None else constant_command(script, vehicles.braking_capacity_mps2[:, 0])
        if command is None:
            return None
        columns = (worlds.speeds_mps, vehicles.latency_s, vehicles.speed_limit_mps)
        speed, latency, limit = (column[:, 0] for column in columns)
        way = np.empty(worlds.n)
        find_own_ways(speed, np.asarray(command, np.float64), latency, limit, task.scenario.horizon_s, way)
        return cls(worlds, way)

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Add the way of one step, by a post ahead: the world's own obstacle, or one out of reach."""
        v = before.vehicles
        post_m = with_post_ahead(before, until_s - before.time_s).obstacle_gap_m
        status = np.full(before.n, DONE)
        add_front_ways(
            post_m, before.obstacle_hit, before.gaps_m, before.speeds_mps, before.time_s, before.pair_hit, command_mps2,
            until_s, v.latency_s, v.mass_t, v.speed_limit_mps, v.restitution, self._way_m, status,
        )  # fmt: skip
        if (status != DONE).any():
            raise failure(status, before.time_s, until_s)

    @property
    def metres(self) -> Floats:
        """How far Vehicle 1 was shoved in each world so far, [n]."""
        shoved: Floats = self._way_m - self._own_way_m
        return shoved


@compiled
def find_own_ways(speed: Floats, command: Floats, latency: Floats, limit: Floats, duration: float, way: Floats) -> None:
    """How far each of n vehicles comes on its own, into ``way`` [n] (m)."""
    for k in range(way.shape[0]):
        way[k] = solo_motion(speed[k], command[k], latency[k], limit[k], duration)[1]


@compiled
def add_front_ways(
    post: Floats, post_hit: Bools, gaps: Floats, speeds: Floats, time: Floats, hit: Bools, command: Floats,
    until: Floats, latency: Floats, mass: Floats, limit: Floats, restitution: Floats, way: Floats, status: Ints,
) -> None:  # fmt: skip
    """Add to ``way`` [n] how far Vehicle 1 comes in the step to ``until``: the change of its gap to the ``post``.

    As ``advance`` of these worlds with the post as their obstacle, to the same bits. Worlds that have ended stay;
    ``status`` [n] tells which could not be advanced.
    """
    vehicles = speeds.shape[1]
    table = np.zeros((TABLE_ROWS, vehicles + 1))
    no_rows = np.empty((0, ROW_WIDTH))
    for k in range(speeds.shape[0]):
        if not until[k] > time[k]:
            continue
        place_obstacle(table, post[k], 1.0 if post_hit[k] else 0.0)
        table[SPEED, 0] = 0.0
        for i in range(vehicles):
            table[COMMAND, i + 1] = command[k, i]
            table[SPEED, i + 1] = speeds[k, i]
            table[MASS, i + 1] = mass[k, i]
            table[LIMIT, i + 1] = limit[k, i]
            table[ONSET, i + 1] = onset_s(latency[k, i], time[k])
        for p in range(vehicles - 1):
            table[GAP, p + 1] = gaps[k, p]
            table[HIT, p + 1] = 1.0 if hit[k, p] else 0.0
        status[k] = advance_table(table, restitution[k], until[k] - time[k], time[k], k, no_rows, 0)[1]
        way[k] += post[k] - table[GAP, 0]


VEHICLE_2 = 1  # the map's samples begin with its latency


class SampledHarm:
    """Watches episodes and replays their commands, step by step, through the map of ``advance_sampled``.

    Each world goes to the horizon; after the end of its exact episode the last commands are held. The agent decided on
    the exact motion; nobody decides anew. See ``of`` for whom it exists.
    """

    def __init__(self, worlds: Worlds, scenario: Scenario) -> None:
        self._vehicles = worlds.vehicles
        self._gaps_m, self._speeds_mps = worlds.gaps_m.copy(), worlds.speeds_mps.copy()
        self._time_s, self._pair_hit = worlds.time_s.copy(), worlds.pair_hit.copy()
        self._command = np.zeros(worlds.speeds_mps.shape)
        self._harm = np.zeros(worlds.n)
        self._start_s = first_decision_s(worlds, [VEHICLE_2])
        self._step_s, self._horizon_s = scenario.time_step_s, scenario.horizon_s
        self._samples = -1  # steps of the map so far; the time before its first sample is the first

    @classmethod
    def of(cls, worlds: Worlds, task: Task) -> SampledHarm | None:
        """What watches these worlds (at the alert); None with an obstacle, or if others decide than Vehicle 2.

        The map knows no obstacle, and its samples are the decisions of Vehicle 2.
        """
        if task.vehicles != (VEHICLE_2,) or obstacle_ahead(worlds).any():
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
        next_s = np.minimum(decision_s(self._start_s, self._step_s, self._samples), self._horizon_s)
        until_s, v = np.maximum(next_s, self._time_s), self._vehicles
        first, last = sample_numbers(self._time_s, until_s, v.latency_s[:, VEHICLE_2], self._step_s)
        shape = self._gaps_m.shape
        harm = np.zeros(shape)
        sample_worlds(
            self._gaps_m, self._speeds_mps, self._time_s, self._pair_hit, self._command, until_s, self._step_s, first,
            last, v.latency_s, v.mass_t, v.speed_limit_mps, v.restitution, np.zeros(shape), harm,
            np.zeros(shape, np.int64),
        )  # fmt: skip
        self._harm += sum_rows(harm)

    def finish(self) -> Floats:
        """Go on to the horizon; gives the sum of each world, [n] m2/s2."""
        while (self._time_s < self._horizon_s - 1e-6 * self._step_s).any():
            self._move()
        return self._harm
