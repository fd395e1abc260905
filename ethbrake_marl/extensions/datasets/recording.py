"""Episodes as a learner of any interface meets them, with the actions that an agent chose.

An agent drives as in an evaluation, where its commands (float64, m/s2) are applied as they are. A learner's action is
a float32 in [-1, 1], of which most commands are no exact image. So each command is rounded to an action, and those
actions are played from the alert on: what is recorded is that second episode, and so it replays to the same bits. On
the edge of an impact a last bit decides about it: of the roundings to the nearest, downwards and upwards, each world
gets the one whose harm is nearest to that of the commands.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.driving import episode_engine, script_agents
from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.engine.compiled_step import Step
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.envs.infos import Report
from ethbrake_marl.errors import PhysicsError, renumbered
from ethbrake_marl.evaluation.aftermath import ShovedFront
from ethbrake_marl.evaluation.record import line_positions
from ethbrake_marl.game.actions import command_to_action
from ethbrake_marl.game.harm import HARM_COUNTS, Ledger
from ethbrake_marl.game.observations import ObservationSpec
from ethbrake_marl.game.rewards import RewardParams
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.schema import Scenario

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
        return np.stack([each.columns()[column] for each in self.reports])

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
    scenario, learners = task.scenario, task.scenario.learners
    engine = episode_engine(sample.worlds, Team.of(driver, learners), scenario)
    asked = []
    while not engine.ended.all():
        engine.step({})
        columns = [command_to_action(engine.wanted_mps2[:, i], sample.worlds.vehicles, i) for i in learners]
        asked.append(np.stack(columns, axis=1))
    _refuse_failed(engine)
    actions, off_by = _rounded(np.stack(asked), sample.worlds, engine.ledger, task)
    engine = _learners_engine(sample.worlds, task)
    steps: list[Step] = []
    front, before = ShovedFront(sample.worlds, np.zeros(sample.worlds.n)), sample.worlds  # worlds know gaps, no places
    observations, reports, positions, speeds = [], [], [], []
    decisions = np.zeros(engine.n, np.int64)
    while True:
        for part in engine.segments(before, engine.wanted_mps2):
            front.see(*part)
        before = engine.worlds
        observations.append(engine.observe_all(np.array(engine.learners, np.int64)))
        reports.append(Report.of(engine, steps[-1] if steps else None))
        positions.append(line_positions(front.metres, before.gaps_m))
        speeds.append(before.speeds_mps)
        if engine.ended.all():
            break
        decisions += ~engine.ended
        steps.append(engine.step(actions[min(len(steps), len(actions) - 1)]))
    _refuse_failed(engine)
    played = np.stack([actions[min(t, len(actions) - 1)] for t in range(len(steps))])
    return Recording(
        name, task, sample.index, decisions, np.stack(observations), played, tuple(steps), tuple(reports),
        np.stack(positions), np.stack(speeds), engine.ledger, float(off_by.max()),
    )  # fmt: skip


def _rounded(commanded: Floats, worlds: Worlds, evaluated: Ledger, task: Task) -> tuple[Float32s, Floats]:
    """The actions [T, n, L] to play, and by how much their harm differs from the evaluated one, [n] m2/s2."""
    nearest = commanded.astype(np.float32)
    best, off_by = nearest.copy(), _off_by(nearest, worlds, evaluated, task)
    rows = np.flatnonzero(off_by > SLACK)
    for end in (-1.0, 1.0) if len(rows) else ():
        beyond = np.where((nearest - commanded) * end >= 0.0, nearest, np.nextafter(nearest, np.float32(end)))[:, rows]
        part = evaluated.take(rows)
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
