"""Episodes as a learner of any interface meets them, with the actions that an agent chose.

An agent drives as in an evaluation, where its commands (float64, m/s2) are applied as they are. A learner's action is a
float32 in [-1, 1], of which most commands are no exact image. So each command is rounded to an action, and those
actions are played from the alert on: what is recorded is that second episode, and so it replays to the same bits. On
the edge of an impact a last bit decides about it: of the roundings to the nearest, downwards and upwards, each world
gets the one whose harm is nearest to that of the commands.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.agents.rollout import episode_engine, script_agents
from ethbrake_marl.agents.team import Driver, team_of
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.step import Step
from ethbrake_marl.envs.infos import COLUMNS, Report, report
from ethbrake_marl.errors import PhysicsError, renumbered
from ethbrake_marl.harm import HARM_COUNTS, Ledger
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, advance
from ethbrake_marl.physics.obstacle import with_post_ahead
from ethbrake_marl.rewards import RewardParams
from ethbrake_marl.scenario import Sample, Scenario

Float32s = NDArray[np.float32]
SLACK = 1e-6  # m2/s2; a smaller difference of harm is not worth another rounding


@dataclass(frozen=True, slots=True)
class Task:
    """What is recorded: the scenario, whose learners are driven, the list of its worlds, and what a learner is told."""

    scenario: Scenario
    seed: int  # of the list of worlds
    reward: RewardParams
    observation: ObservationSpec


@dataclass(frozen=True)
class Recording:
    """Episodes of n worlds; T is the longest one's number of decisions, what stands behind an episode's end is void."""

    agent: str
    task: Task
    index: Ints  # [n] numbers of the worlds in their list
    decisions: Ints  # [n] of each episode
    observations: Float32s  # [T + 1, n, L, F], the last one at the end of the episode
    actions: Float32s  # [T, n, L]
    steps: tuple[Step, ...]  # T
    reports: tuple[Report, ...]  # T + 1; ``reports[t + 1]`` tells what step t brought
    positions_m: Floats  # [T + 1, n, N] front bumpers along the road; Vehicle 1 is at 0 at the alert
    speeds_mps: Floats  # [T + 1, n, N]
    ledger: Ledger  # [n] harm of the episodes
    off_by: (
        float  # largest difference (m2/s2) of a world's harm from that of the commands as they were, before rounding
    )

    @property
    def learners(self) -> tuple[int, ...]:
        """Indices of the driven vehicles."""
        return self.task.scenario.learners

    @cached_property
    def running(self) -> Bools:
        """[n, T] where a decision was made."""
        mask: Bools = np.arange(len(self.steps)) < self.decisions[:, np.newaxis]
        return mask

    def told(self, column: str) -> Floats:
        """A column of the infos of every vehicle, [T + 1, n, N]."""
        at = COLUMNS.index(column)
        return np.stack([each.values[:, :, at] for each in self.reports])

    def terms(self) -> dict[str, Floats]:
        """Each term of the reward, before its weight, after every step: [T + 1, n, L]; row 0 is 0."""
        shape = (len(self.index), self.task.scenario.vehicles)
        found = {}
        for name in self.reports[0].terms:
            each = [told.terms[name] for told in self.reports]
            whole = [np.broadcast_to(t[:, np.newaxis] if t.ndim == 1 else t, shape) for t in each]
            found[name] = np.stack([term[:, list(self.learners)] for term in whole])
        return found


def record_episodes(sample: Sample, driver: Driver, name: str, task: Task) -> Recording:
    """Let ``driver`` drive the scenario's learners through these worlds, and record the episodes of its actions.

    Raises ``PhysicsError`` naming worlds that could not be advanced, and what ``episode_engine`` raises.
    """
    commanded, evaluated = _evaluated_actions(sample.worlds, driver, task.scenario)
    actions, off_by = _rounded(commanded, sample.worlds, evaluated, task)
    engine = _learners_engine(sample.worlds, task)
    learners = np.array(engine.learners, np.int64)
    road = _Road(sample.worlds, engine)
    observations, reports = [engine.observe_all(learners)], [report(engine)]
    steps: list[Step] = []
    decisions = np.zeros(engine.n, np.int64)
    while not engine.ended.all():
        decisions += ~engine.ended
        step = engine.step(actions[min(len(steps), len(actions) - 1)])
        steps.append(step)
        reports.append(report(engine, step))
        observations.append(engine.observe_all(learners))
        road.follow(engine)
    _refuse_failed(engine)
    played = np.stack([actions[min(t, len(actions) - 1)] for t in range(len(steps))])
    return Recording(
        name, task, sample.index, decisions, np.stack(observations), played, tuple(steps), tuple(reports),
        np.stack(road.positions_m), np.stack(road.speeds_mps), engine.ledger, float(off_by.max()),
    )  # fmt: skip


def _evaluated_actions(worlds: Worlds, driver: Driver, scenario: Scenario) -> tuple[Floats, Ledger]:
    """What the driver commands in an evaluation, as actions before rounding [T, n, L], and its harm there."""
    learners = scenario.learners
    engine = episode_engine(worlds, team_of(driver, learners), scenario)
    actions = []
    while not engine.ended.all():
        engine.step({})
        columns = [command_to_action(engine.wanted_mps2[:, i], worlds.vehicles, i) for i in learners]
        actions.append(np.stack(columns, axis=1))
    _refuse_failed(engine)
    return np.stack(actions), engine.ledger


def _rounded(commanded: Floats, worlds: Worlds, evaluated: Ledger, task: Task) -> tuple[Float32s, Floats]:
    """The actions [T, n, L] to play, and by how much their harm differs from the evaluated one, [n] m2/s2."""
    nearest = commanded.astype(np.float32)
    best, off_by = nearest.copy(), _off_by(nearest, worlds, evaluated, task)
    rows = np.flatnonzero(off_by > SLACK)
    for end in (-1.0, 1.0) if len(rows) else ():
        beyond = np.where((nearest - commanded) * end >= 0.0, nearest, np.nextafter(nearest, np.float32(end)))[:, rows]
        part = Ledger(*(getattr(evaluated, field.name)[rows] for field in fields(Ledger)))
        with renumbered(rows):
            off = _off_by(beyond, worlds.take(rows), part, task)
        better = off < off_by[rows]
        best[:, rows[better]], off_by[rows[better]] = beyond[:, better], off[better]
    return best, off_by


def _off_by(actions: Float32s, worlds: Worlds, evaluated: Ledger, task: Task) -> Floats:
    """By how much the harm of these actions differs from the evaluated one, the larger of both counts, [n] m2/s2."""
    engine = _learners_engine(worlds, task)
    step = 0
    while not engine.ended.all():
        engine.step(actions[min(step, len(actions) - 1)])
        step += 1
    _refuse_failed(engine)
    ledger = engine.ledger
    off: Floats = np.max([np.abs(ledger.world_harm(c) - evaluated.world_harm(c)) for c in HARM_COUNTS], axis=0)
    return off


def _learners_engine(worlds: Worlds, task: Task) -> Engine:
    """An engine over worlds at the alert, as an interface has it: the learners take actions."""
    engine = Engine(
        task.scenario,
        worlds.n,
        learners=task.scenario.learners,
        scripts=script_agents(task.scenario),
        reward=task.reward,
        observation=task.observation,
        seed=task.seed,
        worlds=worlds,
    )
    engine.roster.warns = False
    return engine


def _refuse_failed(engine: Engine) -> None:
    if engine.roster.failed:
        raise PhysicsError(engine.roster.failed)


class _Road:
    """Follows an engine: where every vehicle is, and how fast, after each step. Worlds know gaps and speeds only."""

    def __init__(self, alert: Worlds, engine: Engine) -> None:
        self._before, self._front_m = alert, np.zeros(alert.n)
        self.positions_m: list[Floats] = []
        self.speeds_mps: list[Floats] = []
        self.follow(engine)

    def follow(self, engine: Engine) -> None:
        """The engine has made a step, the first one from the alert to the first decision."""
        now = engine.worlds
        for before, command, end_s in engine.segments(self._before, engine.wanted_mps2):
            moving = np.flatnonzero(end_s > before.time_s)
            until_s = end_s[moving]
            post = with_post_ahead(before.take(moving), until_s - before.time_s[moving])
            after, _ = advance(post, command[moving], until_s=until_s)
            self._front_m[moving] += post.obstacle_gap_m - after.obstacle_gap_m
        front = self._front_m[:, np.newaxis]
        self.positions_m.append(np.concatenate([front, front - np.cumsum(now.gaps_m, axis=1)], axis=1))
        self.speeds_mps.append(now.speeds_mps)
        self._before = now
