"""Record episodes of any agent, with the actions in [-1, 1] that make a learner drive like the agent.

An agent's commands are float64 numbers in m/s2. A learner's action is a float32 number in [-1, 1], so most commands do
not correspond exactly to an action. Therefore each world is simulated twice. In the first episode, the agent drives,
and its commands are rounded to actions. In the second episode, which is recorded, learners take these actions. An
environment that gets the recorded actions repeats the second episode bit for bit.

If two vehicles almost miss each other, the last bit of an action can decide whether they have an impact. Therefore, if
rounding to the nearest action changes the harm of a world, the code also tries to round all actions of this world down,
and all up. The recording contains the rounding that changes the harm of the world least.

In the shapes, ``n`` is the number of worlds, ``T`` the number of decisions in the longest episode, ``L`` the number of
learners, and ``F`` the number of observed features.
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

SLACK = 1e-6  # m2/s2; if rounding to the nearest action changes harm by less, no other rounding is tried


@dataclass(frozen=True, slots=True)
class Task:
    """Settings of a recording: scenario, seed from which worlds are drawn, reward and observed features."""

    scenario: Scenario  # scenario of the worlds; its learners are recorded
    seed: int  # seed from which the worlds are drawn
    reward: RewardParams  # reward that the learners receive
    observation: ObservationSpec  # features that each learner observes


@dataclass(frozen=True)
class Recording:
    """Recorded episodes of one agent in ``n`` worlds.

    If an episode has fewer than T decisions, array elements after its end have no meaning.
    """

    agent: str  # name of the agent
    task: Task  # scenario, seed, reward and observation
    index: Ints  # [n] number of each world in the list of the seed
    decisions: Ints  # [n] number of decisions of each episode
    observations: Float32s  # [T + 1, n, L, F] observations at each decision and at the end of the episode
    actions: Float32s  # [T, n, L] actions in [-1, 1]
    steps: tuple[Step, ...]  # T results of ``Engine.step``, with rewards and ends of episodes
    reports: tuple[Report, ...]  # T + 1 reports of infos: ``reports[0]`` at the alert, ``reports[t + 1]`` after step t
    positions_m: Floats  # [T + 1, n, N] positions of the front bumpers; Vehicle 1 is at 0 at the alert
    speeds_mps: Floats  # [T + 1, n, N] speeds
    ledger: Ledger  # harm of all impacts of each episode
    off_by: float  # largest change of a world's harm by rounding the commands to float32 actions (m2/s2)

    @property
    def learners(self) -> tuple[int, ...]:
        """Indices (0 = front) of the L learners that are recorded."""
        return self.task.scenario.learners

    @cached_property
    def running(self) -> Bools:
        """Whether decision t belongs to the episode of world k, [n, T]; False after the end of the episode."""
        mask: Bools = np.arange(len(self.steps)) < self.decisions[:, np.newaxis]
        return mask

    def told(self, column: str) -> Floats:
        """Return the values, [T + 1, n, N], that the environment's ``info`` has under the key ``column``."""
        return np.stack([each.columns()[column] for each in self.reports])

    def terms(self) -> dict[str, Floats]:
        """Return the terms of the reward without their weights: name of the term -> values [T + 1, n, L].

        Values with the first index t + 1 belong to time step t. Values with the first index 0 are 0.
        """
        shape = (len(self.index), self.task.scenario.vehicles)
        terms = {}
        for name in self.reports[0].terms:
            each = [report.terms[name] for report in self.reports]
            whole = [np.broadcast_to(t[:, np.newaxis] if t.ndim == 1 else t, shape) for t in each]
            terms[name] = np.stack([term[:, list(self.learners)] for term in whole])
        return terms


def record_episodes(sample: Sample, driver: Driver, name: str, task: Task) -> Recording:
    """Let an agent drive the learners of the scenario, and record the episodes.

    ``sample`` are worlds at the alert. Raises ``PhysicsError``, which names the worlds that the physics cannot
    simulate. Raises the exceptions of ``episode_engine`` before the first episode begins.
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
    front, before = ShovedFront(sample.worlds, np.zeros(sample.worlds.n)), sample.worlds  # Worlds has no positions
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
    """Round the commands to float32 actions; in each world, choose the rounding that changes the harm least.

    The roundings down and up are tried only if the nearest actions change the harm by more than ``SLACK``.
    ``commanded`` [T, n, L] are the commands as float64 actions, and ``evaluated`` is the harm of the episodes with
    these. Returns the rounded actions, [T, n, L], and the change of harm, [n] m2/s2.
    """
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
    """Return by how much the harm with ``actions`` [T, n, L] differs from the harm ``evaluated``, [n] m2/s2.

    The result is the larger of two absolute differences: of first-impact harm, and of total harm.
    """
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
    """Return an engine at the alert in which the learners of ``task`` take actions, as in an environment."""
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
