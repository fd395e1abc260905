"""Whole episodes, exact at every moment: motions, films and datasets."""

from __future__ import annotations

import copy
import io
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from importlib.metadata import version
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.agents import Agent, Driver, Episodes, Team, drive, episode_engine, script_agents
from ethbrake_marl.engine import Engine, Step
from ethbrake_marl.envs import Frame, Report, Scene, Trace, action_box, animate_films, feature_box
from ethbrake_marl.errors import (
    AlreadyExists,
    InvalidInput,
    PhysicsError,
    check_one_learner,
    check_whole_number,
    count_of,
    naming_extras,
    need,
    renumbered,
    unknown_name,
)
from ethbrake_marl.evaluation.inputs import LIST_SEED, make_lineup, policies_of, result_versions, scenario_sha256
from ethbrake_marl.evaluation.measures import LeftOut, Tape
from ethbrake_marl.evaluation.rollout import ShovedFront, controlled_vehicle
from ethbrake_marl.files.sheet import parquet_file
from ethbrake_marl.files.store import check_target, check_writable, new_folder
from ethbrake_marl.harm import HARM_COUNTS, Ledger
from ethbrake_marl.observations import Observation, ObservationSpec, choose_observation
from ethbrake_marl.physics import Bools, Floats, ImpactRows, Ints, Worlds, advance, leaving_out_failed, segment_pieces
from ethbrake_marl.rewards import Reward, RewardParams, reward_params
from ethbrake_marl.scenario import Sample, Scenario, load_scenario, observation_for
from ethbrake_marl.shield import HybridAgent

_SAME = 1e-9  # m, m/s: a piece that goes on like the one before it is part of it
_SHORT_S = 1e-4  # pieces of a cascade of tiny bounces may be shorter; they are not told apart


@dataclass(frozen=True, slots=True)
class EpisodeMotion:
    """One world from the alert to the end of its episode, driven by one agent."""

    world: Worlds  # n = 1, at the alert
    # [k, 1 + 4 N] time (s), place of Vehicle 1 (m), gaps, speeds, accelerations and jerks where each begins
    pieces: Floats
    end_s: float
    impacts: ImpactRows  # in order of time; world is 0
    stepped_in_s: Floats  # beginnings of the decisions in which a shield replaced what was proposed
    ledger: Ledger  # n = 1
    final: Worlds  # n = 1, as the episode left it
    at_rest: bool  # the line came to rest; else the horizon cut the episode off

    @property
    def harm(self) -> tuple[float, float]:
        """Harm of the line, by first impacts and in total (m2/s2)."""
        first, total = (float(self.ledger.world_harm(count)[0]) for count in HARM_COUNTS)
        return first, total


def follow_episodes(worlds: Worlds, agent: Driver, scenario: Scenario) -> list[EpisodeMotion]:
    """Let an agent drive the scenario's learners through every world, as ``evaluate`` does, and keep every motion.

    Args:
        worlds: at the alert.
        agent: drives each learner, or, as a team, its vehicles; it is left as it is.
        scenario: of the worlds; its scripts drive the other vehicles.

    Raises ``PhysicsError`` naming the worlds that could not be advanced.

    """
    team = Team.of(agent, scenario.learners)
    engine = episode_engine(worlds, team, scenario)
    follower = _Follower(worlds, team, engine)
    episodes = Episodes.of(engine, worlds, [follower])
    return follower.motions(episodes)


class _Follower(Tape):
    """Keeps the steps, and in which decisions a shield stepped in."""

    def __init__(self, worlds: Worlds, team: Team, engine: Engine) -> None:
        super().__init__(worlds)
        self._hybrids = {i for i, driver in team.drivers.items() if isinstance(driver, HybridAgent)}
        self._first_s = worlds.first_decision_s(list(team.drivers))
        self._stepped_in: list[list[float]] = [[] for _ in range(worlds.n)]
        self._engine, self._ruling = engine, engine.ruling

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Keep one step."""
        super().see(before, command_mps2, until_s)
        ruling = self._engine.ruling
        if ruling is not None and ruling is not self._ruling:  # a step is shown in parts
            for k in np.flatnonzero(ruling.stepped_in & ruling.asked).tolist():
                self._stepped_in[k].append(float(before.time_s[k]))
            self._ruling = ruling

    def motions(self, episodes: Episodes) -> list[EpisodeMotion]:
        """What was seen, world by world."""
        n, N = self.worlds.n, self.worlds.N
        impacts, pieces = self.impacts(), self._pieces()
        ends = np.searchsorted(impacts.world, np.arange(n + 1))
        found = []
        for k in range(n):
            mine = slice(*ends[k : k + 2])
            rows = ImpactRows(*(getattr(impacts, f.name)[mine] for f in fields(ImpactRows)))
            ledger = episodes.ledger.take([k])
            final, taken_over = episodes.final.take([k]), list(self._stepped_in[k])
            chosen = [memory["chosen_policy"][k] for i, memory in episodes.memories.items() if i in self._hybrids]
            if not all(chosen):
                taken_over.append(float(self._first_s[k]))
            found.append(
                EpisodeMotion(
                    self.worlds.take([k]),
                    join_pieces(pieces[k], N),
                    float(final.time_s[0]),
                    replace(rows, world=np.zeros_like(rows.world)),
                    np.array(sorted(taken_over)),
                    ledger,
                    final,
                    bool(episodes.at_rest[k]),
                )
            )
        return found

    def _pieces(self) -> list[Floats]:
        """The pieces of each world's motion, one after the other; one piece where it ends at once."""
        parts: list[list[Floats]] = [[] for _ in range(self.worlds.n)]
        way_m = np.zeros(self.worlds.n)
        for before, command, until_s in self.steps:
            some = np.flatnonzero(until_s > before.time_s)
            seen = segment_pieces(before.take(some), command[some], until_s[some])
            for k, pieces in zip(some.tolist(), seen, strict=True):
                way = float(state_at(pieces[-1], float(until_s[k]), self.worlds.N)[0])
                pieces[:, 1] += way_m[k]
                parts[k].append(pieces)
                way_m[k] += way
        w = self.worlds
        standing = np.concatenate(
            [w.time_s[:, np.newaxis], np.zeros((w.n, 1)), w.gaps_m, w.speeds_mps, np.zeros((w.n, 2 * w.N))], axis=1
        )
        return [np.concatenate(each) if each else standing[[k]] for k, each in enumerate(parts)]


def join_pieces(pieces: Floats, vehicles: int) -> Floats:
    """The pieces without those that go on like the one before; of many within ``_SHORT_S`` the last one stays."""
    last_of_many = np.append(np.diff(np.floor(pieces[:, 0] / _SHORT_S)) > 0.0, True)
    last_of_many[0] = True
    kept: list[Floats] = []
    for row in pieces[last_of_many]:
        if not kept or not (np.abs(state_at(kept[-1], row[0], vehicles) - row[1:]) <= _SAME).all():
            kept.append(row)
    return np.array(kept)


def state_at(piece: Floats, time_s: float, vehicles: int) -> Floats:
    """Place of Vehicle 1, gaps, speeds, accelerations and jerks [4 N] at a time of a piece [1 + 4 N]."""
    t, N = time_s - piece[0], vehicles
    speeds, rates, jerks = (piece[1 + part * N : 1 + (part + 1) * N] for part in (1, 2, 3))
    way = (speeds + 0.5 * (rates + jerks * t / 3.0) * t) * t
    gaps = piece[2 : 1 + N] + way[:-1] - way[1:]
    after = speeds + (rates + 0.5 * jerks * t) * t
    return np.concatenate([[piece[1] + way[0]], gaps, after, rates + jerks * t, jerks])


# One episode at fine time resolution: what a figure or a viewer draws.
#
# Between decisions the motion follows from the state and the command alone, so the episode is first run as in an
# evaluation, and then sampled inside its steps: every sample is advanced straight from the beginning of its step.

SAMPLE_S = 0.02


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """One world from the alert to its end, at k times; row 0 is the alert.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> world = scenario.sample(1, seed=7).worlds
    >>> record = eb.record_episode(world, eb.make_agent("full_brake"), scenario=scenario)
    >>> record.positions_m.shape, record.impacts.time_s.round(2), record.at_rest
    ((196, 3), array([2.17, 3.3 ]), True)

    """

    agent: str  # its name
    scenario: Scenario  # of the world
    vehicle: int  # index (0 = front) of the vehicle that the agent drove
    initial: Worlds  # n = 1, at the alert
    time_s: Floats  # [k] since Vehicle 1 began to brake, ascending
    gaps_m: Floats  # [k, P]
    speeds_mps: Floats  # [k, N]
    positions_m: Floats  # [k, N] front bumpers along the road; a vehicle's length is not counted
    command_mps2: Floats  # [k, N] signed acceleration asked for from then on; 0 before the latency has elapsed
    impacts: ImpactRows  # in order of time; world is 0
    ledger: Ledger  # n = 1
    at_rest: bool  # the line came to rest; else the horizon cut the episode off

    def __repr__(self) -> str:
        first, total = (float(self.ledger.world_harm(harm_count)[0]) for harm_count in HARM_COUNTS)
        return (
            f"EpisodeRecord({self.agent!r:.60} on {self.scenario.name!r}, {len(self.time_s)} samples to"
            f" {self.time_s[-1]:g} s, {count_of(len(self.impacts.time_s), 'impact')}, harm {first:.2f} first-impact,"
            f" {total:.2f} total)"
        )


def record_episode(
    world: Worlds, agent: Agent, *, scenario: Scenario, vehicle: int | str | None = None, sample_s: float = SAMPLE_S
) -> EpisodeRecord:
    """Record one world from the alert on, exactly as ``evaluate`` runs it.

    Args:
        world: at the alert, n = 1.
        agent: drives one vehicle; it is left as it is.
        scenario: of the world; its scripts drive the other vehicles.
        vehicle: the one that is driven, by name (``vehicle_2``) or index (0 = front); None: the scenario's only
            learner.
        sample_s: samples lie at most so far apart (s), and at every decision.

    Raises ``InvalidInput`` for more than one world or ``sample_s`` not above 0.

    """
    if world.n != 1:
        raise InvalidInput(
            f"record_episode: {count_of(world.n, 'world')} given; exactly 1 is needed, for instance worlds.take([0])"
        )
    if not (sample_s > 0.0 and math.isfinite(sample_s)):
        raise InvalidInput(f"record_episode: sample_s = {sample_s}; must be finite and above 0")
    driven = controlled_vehicle(scenario, vehicle)
    tape = Tape(world)
    episodes = drive(world, agent, scenario, driven, watched_by=[tape])
    samples = list(_samples(tape.steps, sample_s))
    time, gaps, speeds, positions, command = (np.concatenate(column) for column in zip(*samples, strict=True))
    return EpisodeRecord(
        agent.name, scenario, driven, world, time, gaps, speeds, positions, command, tape.impacts(), episodes.ledger,
        bool(episodes.at_rest[0]),
    )  # fmt: skip


def _samples(segments: Sequence[tuple[Worlds, Floats, Floats]], sample_s: float) -> Iterator[tuple[Floats, ...]]:
    """Rows of (time, gaps, speeds, positions, command from then on), segment by segment, the last with its end.

    Worlds know gaps and speeds only. An obstacle ahead of Vehicle 1, the world's own or one that is out of reach, makes
    its position one more gap.
    """
    front = 0.0  # position of Vehicle 1 at the start of the segment
    for number, (before, command, until_s) in enumerate(segments):
        start, end = float(before.time_s[0]), float(until_s[0])
        count = max(math.ceil((end - start) / sample_s - 1e-9), 1) if end > start else 0
        times = np.linspace(start, end, count + 1)
        post = before.with_post_ahead(np.array([end - start]))
        copies = post.take(np.zeros(count + 1, np.int64))
        moved, _ = advance(copies, command, until_s=times)
        position, gaps, speeds = front + (post.obstacle_gap_m - moved.obstacle_gap_m), moved.gaps_m, moved.speeds_mps
        wanted = before.vehicles.piece_commands(command, times)
        in_force = np.where(before.vehicles.latency_s <= times[:, np.newaxis], wanted, 0.0)
        rows = slice(None) if number == len(segments) - 1 else slice(count)
        columns = (times, gaps, speeds, line_positions(position, gaps), in_force)
        yield tuple(column[rows] for column in columns)
        front = float(position[-1])


def line_positions(front: Floats, gaps: Floats) -> Floats:
    """Positions [k, N] from those of Vehicle 1 [k] and the gaps [k, P]."""
    return np.concatenate([front[:, np.newaxis], front[:, np.newaxis] - np.cumsum(gaps, axis=1)], axis=1)


# An episode as a film, in real time: the environment's own pictures as a GIF or MP4, or a moving drawing as SVG.

Films = Mapping[str, Sequence[Scene]]  # of one world, by title

FILM_FPS = 25
MOST_FILMS = 12  # one below the other
MOST_PICTURES = 2_500  # of all films together: 1.8 GB in memory
_COLOURS = 64


def film_scenes(world: Worlds, agent: Driver, *, scenario: Scenario, fps: float = FILM_FPS) -> list[Scene]:
    """What one world shows from the alert to the end of its episode, ``fps`` moments per second, then its end.

    Args:
        world: at the alert, n = 1.
        agent: drives the learner, or, as a team, its vehicles; it is left as it is.
        scenario: of the world; its scripts drive the other vehicles.
        fps: moments per second of the world.

    Raises ``InvalidInput`` for more than one world, ``PhysicsError`` for one that could not be advanced.

    """
    if world.n != 1:
        raise InvalidInput(f"film_scenes: {count_of(world.n, 'world')} given; exactly 1 is needed: worlds.take([0])")
    engine = episode_engine(world, Team.of(agent, scenario.learners), scenario)
    trace = Trace(engine, whole=True, alert=world)
    while not engine.ended.all():
        engine.step({})
    if engine.roster.failed:
        raise PhysicsError(engine.roster.failed)
    end = float(engine.worlds.time_s[0])
    times = np.append(np.arange(int(np.ceil(end * fps - 1e-9))) / fps, end)
    shown: list[Scene] = []
    for motion in trace.motions(engine):
        start, until = float(motion.start.time_s[0]), float(motion.until_s[0])
        mine = times[(times >= start if motion.fresh[0] else times > start) & (times <= until)]
        shown += motion.scenes(engine, 0, mine) if len(mine) else []
    return shown


def film(world: Worlds, agents: Mapping[str, Driver], ending: str, *, scenario: Scenario) -> bytes:
    """``film_bytes`` of what agents, each under its title, do in one world; refuses before any work what it can."""
    check_film(ending, len(agents))
    films = {title: film_scenes(world, agent, scenario=scenario) for title, agent in agents.items()}
    return film_bytes(films, ending)


def film_bytes(films: Films, ending: str, *, fps: int = FILM_FPS) -> bytes:
    """Films of one world, titled and one below the other, in real time: an endless GIF or SVG, or an MP4.

    A film that ends before the others shows its end. Raises ``InvalidInput`` without films, for more than
    ``MOST_FILMS`` or ``MOST_PICTURES``, for an ``ending`` that is
    none of ``.gif``, ``.mp4`` and ``.svg``, for an ``fps`` whose frames do not last whole hundredths of a second, as a
    GIF needs, and for an MP4 where the library that writes it is missing.
    """
    check_film(ending, len(films))
    if not films or not all(films.values()):
        raise InvalidInput("film_bytes: no films given")
    if not fps > 0 or 100 % fps:
        raise InvalidInput(f"film_bytes: fps = {fps}: must divide 100, for instance 10, 20, 25 or 50")
    pictures = len(films) * max(map(len, films.values()))
    if pictures > MOST_PICTURES:
        raise InvalidInput(
            f"film of {len(films)} agents for {pictures // len(films) / fps:g} s: needs {pictures:,} pictures,"
            f" and at most {MOST_PICTURES:,} are kept; give fewer agents, or a scenario with a shorter horizon_s"
        )
    return _WRITERS[ending](films, fps)


def check_film(ending: str, films: int = 1) -> None:
    """Refuse, before any work, what ``film_bytes`` cannot write: that ending, or so many films."""
    if ending not in _WRITERS:
        raise InvalidInput(f"a film that ends in {ending!r}: films are written as {', '.join(_WRITERS)}")
    if ending == ".mp4":
        need("imageio_ffmpeg")
    if films > MOST_FILMS:
        raise InvalidInput(f"film: {films} agents, one below the other; at most {MOST_FILMS} are shown")


def _stacked(films: Films) -> Iterator[Frame]:
    """The frames of all films, one below the other."""
    for k in range(max(map(len, films.values()))):
        each = (shown[min(k, len(shown) - 1)]._replace(title=title) for title, shown in films.items())
        yield np.concatenate([scene.frame() for scene in each])


def _write_gif(films: Films, fps: int) -> bytes:
    from PIL import Image

    pictures = [
        Image.fromarray(frame).quantize(_COLOURS, method=Image.Quantize.FASTOCTREE) for frame in _stacked(films)
    ]
    buffer = io.BytesIO()
    pictures[0].save(buffer, "GIF", save_all=True, append_images=pictures[1:], duration=1000 // fps, loop=0)
    return buffer.getvalue()


def _write_mp4(films: Films, fps: int) -> bytes:
    from imageio_ffmpeg import write_frames

    frames = list(_stacked(films))
    height, width, _ = frames[0].shape
    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        writer = write_frames(str(path), (width, height), fps=fps, quality=8)
        writer.send(None)
        for frame in frames:
            writer.send(frame)
        writer.close()
        return path.read_bytes()


_WRITERS: dict[str, Callable[[Films, int], bytes]] = {
    ".gif": _write_gif,
    ".mp4": _write_mp4,
    ".svg": lambda films, fps: animate_films(films, fps=fps).encode(),
}


# Episodes as a learner of any interface meets them, with the actions that an agent chose.
#
# An agent drives as in an evaluation, where its commands (float64, m/s2) are applied as they are. A learner's action is
# a float32 in [-1, 1], of which most commands are no exact image. So each command is rounded to an action, and those
# actions are played from the alert on: what is recorded is that second episode, and so it replays to the same bits. On
# the edge of an impact a last bit decides about it: of the roundings to the nearest, downwards and upwards, each world
# gets the one whose harm is nearest to that of the commands.

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


# Episodes as a Parquet file: one row per agent, world and decision, one row group per batch of worlds.

KEY = "ethbrake_marl"  # of the file's metadata: what was recorded, as JSON

Columns = dict[str, NDArray[Any]]
_OF_STEPS = ("reward", "terminated", "truncated")


@contextmanager
def parquet_dataset(path: Path, told: Mapping[str, Any]) -> Iterator[Callable[[Recording], None]]:
    """Give what adds recordings to the file, which appears at ``path`` when the block ends well.

    ``told`` is read at the end, and stands in the file's metadata under ``KEY``. Raises ``MissingExtra``.
    """
    with naming_extras():
        import pyarrow

    with parquet_file(path, told=lambda: {KEY: json.dumps(told)}) as write:

        def add(recording: Recording) -> None:
            columns = decision_columns(recording)
            write(columns | {"agent": pyarrow.array(columns["agent"]).dictionary_encode()}, together=True)

        yield add


def decision_columns(recording: Recording) -> Columns:
    """One entry per decision, world by world; docs/datasets.md lists the columns."""
    running = recording.running
    before = recording.told

    def each(values: NDArray[Any]) -> NDArray[Any]:
        """Values [T or T + 1, n, ...], of each decision's begin, decision by decision."""
        return values[: running.shape[1]].swapaxes(0, 1)[running]

    def whole(values: NDArray[Any]) -> NDArray[Any]:
        """A value of each episode [n] in all of its rows."""
        return np.repeat(values, recording.decisions)

    in_force, chosen = before("command_in_force_mps2"), before("chosen_command_mps2")[1:]
    terms = recording.terms()
    stacked = {name: np.stack([getattr(step, name) for step in recording.steps]) for name in _OF_STEPS}
    columns: Columns = {
        "agent": np.full(int(running.sum()), recording.agent),
        "world_seed": np.full(int(running.sum()), recording.task.seed),
        "world": whole(recording.index),
        "decision": np.nonzero(running)[1],
        "time_s": each(before("time_s")[:, :, 0]),
    }
    for i in range(recording.task.scenario.vehicles):
        columns |= {
            f"position_{i + 1}_m": each(recording.positions_m[:, :, i]),
            f"speed_{i + 1}_mps": each(recording.speeds_mps[:, :, i]),
            f"command_in_force_{i + 1}_mps2": each(in_force[:, :, i]),
        }
    for c, i in enumerate(recording.learners):
        seen = {feature.name: f for f, feature in enumerate(recording.task.observation.features)}
        columns |= {
            **{f"observation_{i + 1}.{name}": each(recording.observations[:, :, c, f]) for name, f in seen.items()},
            f"action_{i + 1}": each(recording.actions[:, :, c]),
            f"chosen_command_{i + 1}_mps2": each(chosen[:, :, i]),
            f"reward_{i + 1}": each(stacked["reward"][:, :, i]),
            **{f"reward_{name}_{i + 1}": each(term[1:, :, c]) for name, term in terms.items()},
        }
    return columns | {
        "cost": each(np.stack([told.cost for told in recording.reports[1:]])),
        "terminated": each(stacked["terminated"]),
        "truncated": each(stacked["truncated"]),
        "first_impact_harm": whole(recording.ledger.world_harm("first")),
        "total_harm": whole(recording.ledger.world_harm("total")),
    }


# Episodes of one learner as a dataset of Minari, which replays to the recorded bits in the environment it recovers.
#
# An episode's ``seed`` and ``options`` put its world back: ``env.reset(seed=seed, options=options)``.

DATA = "data"  # the folder of the data inside a dataset's
_DATASET_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]*-v\d+")


def check_folder(path: Path, *, force: bool = False) -> None:
    """Refuse what cannot become a dataset's folder, before any work.

    Raises ``AlreadyExists`` for one that is there, ``InvalidInput`` for what ``force`` does not replace: it replaces
    datasets of Minari alone.
    """
    if _DATASET_NAME.fullmatch(path.name) is None:
        raise InvalidInput(f"{path}: a dataset of Minari is a folder called NAME-vNUMBER, for instance brakes-v0")
    if path.is_symlink() or path.exists():
        if not force:
            raise AlreadyExists(f"{path}: is there already; give another name or use force (--force)")
        if path.is_symlink() or not (path / DATA / "metadata.json").is_file():
            raise InvalidInput(f"{path}: is no dataset of Minari, and is not replaced; give another name")
    if not path.parent.is_dir():
        raise InvalidInput(f"{path}: there is no folder {path.parent}; make it first")
    try:
        check_writable(path.parent)
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be written ({error.strerror})") from None


@contextmanager
def minari_folder(
    path: Path, task: Task, told: Mapping[str, Any], *, force: bool
) -> Iterator[Callable[[Recording], None]]:
    """Give what adds recordings to the dataset, whose folder appears at ``path`` when the block ends well.

    ``told`` is read at the end, and stands in its metadata under ``KEY``, as JSON. Raises ``MissingExtra``.
    """
    with naming_extras():
        import h5py  # noqa: F401  # minari's own message would name another line
        from minari.data_collector.episode_buffer import EpisodeBuffer
        from minari.dataset.minari_storage import MinariStorage

    with new_folder(path, replace=force) as partial:
        storage = MinariStorage.new(
            partial.resolve() / DATA,  # of a relative path Minari 0.5.4 looks for its own files in the wrong place
            observation_space=feature_box(task.observation.features),
            action_space=action_box(),
            env_spec=env_spec(task),
        )
        storage.update_metadata({"dataset_id": path.name, "minari_version": version("minari")})

        def add(recording: Recording) -> None:
            first = storage.total_episodes
            episodes = list(_episodes(recording))
            storage.update_episodes(EpisodeBuffer(**episode) for episode in episodes)
            harms = zip(*(recording.ledger.world_harm(count).tolist() for count in HARM_COUNTS), strict=True)
            beside = [{"agent": recording.agent, "first_impact_harm": one, "total_harm": whole} for one, whole in harms]
            storage.update_episode_metadata(beside, range(first, first + len(episodes)))

        yield add
        storage.update_metadata(
            {
                "algorithm_name": ", ".join(told["agents"]),
                "description": f"{task.scenario.name}: {task.scenario.title or 'emergency braking'}",
                "requirements": [f"ethbrake-marl>={version('ethbrake-marl')}"],
                KEY: json.dumps(told),
            }
        )


def env_spec(task: Task) -> EnvSpec:
    """What ``gymnasium.make`` makes the same environment of, of plain data alone: it survives JSON.

    Raises ``InvalidInput`` unless exactly one vehicle learns.
    """
    names = [task.scenario.vehicle_names[i] for i in task.scenario.learners]
    check_one_learner(
        task.scenario.name, names, "a dataset of Minari is one learner's; give the others a script, or write Parquet"
    )
    spec = copy.deepcopy(gymnasium.spec("EthBrake-v0"))
    spec.kwargs = {"scenario": task.scenario.declared(), "reward": task.reward.model_dump(mode="json")}
    if task.observation != observation_for(task.scenario):
        spec.kwargs["observation"] = [feature.name for feature in task.observation.features]
    return spec


def _episodes(recording: Recording) -> Iterator[dict[str, Any]]:
    """The fields of an ``EpisodeBuffer``, world by world."""
    vehicle, seed = recording.learners[0], recording.task.seed
    infos = _infos(recording, vehicle)
    reward, terminated, truncated = (np.stack([getattr(step, name) for step in recording.steps]) for name in _OF_STEPS)
    for k, (world, end) in enumerate(zip(recording.index.tolist(), recording.decisions.tolist(), strict=True)):
        yield {
            "seed": seed,
            "options": {"listed_world": {"seed": seed, "number": world}},
            "observations": recording.observations[: end + 1, k, 0],
            "actions": recording.actions[:end, k],
            "rewards": reward[:end, k, vehicle],
            "terminations": terminated[:end, k],
            "truncations": truncated[:end, k],
            "infos": {name: values[: end + 1, k] for name, values in infos.items()},
        }


def _infos(recording: Recording, vehicle: int) -> dict[str, NDArray[Any]]:
    """The infos of the environment, [T + 1, n, ...]."""
    told = {name: recording.told(name)[:, :, vehicle] for name in recording.reports[0].columns()}
    cost = np.stack([each.cost for each in recording.reports])
    news = [each.known_from_s[:, vehicle] for each in recording.reports if each.known_from_s is not None]
    return {
        **told,
        "collided": told["collided"] == 1.0,
        "chosen_action": told["chosen_action"].astype(np.float32)[:, :, np.newaxis],
        "cost": cost,
        "world_seed": np.full(cost.shape, recording.task.seed),
        "world": np.stack([each.world for each in recording.reports]),
        **{f"reward_{name}": term[:, :, 0] for name, term in recording.terms().items()},
        **({"known_from_s": np.stack(news)} if news else {}),
    }


BATCH = 500  # worlds recorded together: bounds memory, changes no episode

DatasetFormat = Literal["parquet", "minari"]
_NEEDED_PACKAGES: dict[DatasetFormat, tuple[str, ...]] = {"parquet": ("pyarrow",), "minari": ("minari", "h5py")}


@dataclass(frozen=True, slots=True)
class DatasetSummary:
    """What ``write_dataset`` wrote."""

    path: Path
    format: DatasetFormat
    episodes: Mapping[str, int]  # by agent
    decisions: int  # of all episodes
    off_by: Mapping[str, float]  # by agent: by how much (m2/s2) rounding to actions changed a world's harm, at most
    left_out: tuple[LeftOut, ...]  # worlds that could not be advanced


def write_dataset(
    path: str | Path,
    agents: str | Sequence[str] | Mapping[str, Driver],
    *,
    scenario: str | Path | Scenario,
    episodes: int,
    seed: int = LIST_SEED,
    format: DatasetFormat | None = None,
    reward: Reward = "harm",
    observation: Observation | None = None,
    force: bool = False,
    on_progress: Callable[[str, int], None] | None = None,
) -> DatasetSummary:
    """Record agents, each in the same worlds of a list, as a Parquet file or as a dataset of Minari.

    The recorded actions replay to the recorded bits; docs/datasets.md says what is in it.

    Args:
        path: the file (``.parquet``), or the folder (``NAME-v0``) to write.
        agents: specs as on the command line, or name -> agent, or team, that drives the scenario's learners; they are
            left as they are.
        scenario: whose worlds are driven in, also by name or path.
        episodes: worlds of the list, from its first one on.
        seed: of the list.
        format: ``parquet`` or ``minari``; None: as the path's ending says.
        reward: what a learner is rewarded with.
        observation: what a learner observes; None: ``observation_for(scenario)``.
        force: replace a dataset that is there.
        on_progress: is called with an agent's name and its worlds done so far.

    Raises ``InvalidInput``, ``AlreadyExists`` and ``MissingExtra`` before the work, ``PhysicsError`` where no world is
    left.

    """
    check_whole_number("write_dataset: episodes", episodes, 1)
    check_whole_number("write_dataset: seed", seed, 0)
    scenario = load_scenario(scenario)
    if isinstance(agents, Sequence):
        agents = make_lineup(agents, scenario)
    if not agents:
        raise InvalidInput("write_dataset: no agents given; at least one is needed, for instance full_brake")
    chosen = check_dataset(path, scenario, format, force=force)
    spec = observation_for(scenario) if observation is None else choose_observation(observation)
    task = Task(scenario, int(seed), reward_params(reward), spec)
    told = tell(task, agents, episodes)
    sink = (
        parquet_dataset(Path(path), told) if chosen == "parquet" else minari_folder(Path(path), task, told, force=force)
    )
    recorded, off_by, left_out, decisions = dict.fromkeys(agents, 0), dict.fromkeys(agents, 0.0), [], 0
    with sink as add:
        for name, first in product(agents, range(0, int(episodes), BATCH)):
            count = min(BATCH, int(episodes) - first)
            sample = scenario.sample(count, task.seed, first=first)

            def of(rows: Any, sample: Sample = sample, name: str = name) -> Recording:
                return record_episodes(
                    Sample(sample.worlds.take(rows), sample.index[rows], 0), agents[name], name, task
                )

            recording, _, failed = leaving_out_failed(of, np.arange(count))
            left_out += [LeftOut(first + row, task.seed, name, why) for row, why in failed.items()]
            if recording is not None:
                add(recording)
                recorded[name] += len(recording.index)
                decisions += int(recording.decisions.sum())
                off_by[name] = max(off_by[name], recording.off_by)
            if on_progress is not None:
                on_progress(name, first + count)
        if not decisions:
            raise PhysicsError({left.world: f"{left.agent}: {left.reason}" for left in left_out})
        told["left_out"] = [left._asdict() for left in left_out]
        told["off_by"] = off_by
    return DatasetSummary(Path(path), chosen, recorded, decisions, off_by, tuple(left_out))


def check_dataset(
    path: str | Path, scenario: Scenario, format: str | None = None, *, force: bool = False
) -> DatasetFormat:
    """The format of a dataset that can be written to ``path``; raises as ``write_dataset`` does before its work."""
    target = Path(path)
    is_file = target.suffix.lower() == ".parquet"
    chosen: Any = format if format is not None else "parquet" if is_file else "minari"
    if chosen not in get_args(DatasetFormat):
        raise unknown_name("format", chosen, get_args(DatasetFormat))
    if is_file != (chosen == "parquet"):
        right = "a file ending in .parquet" if chosen == "parquet" else "a folder called NAME-vNUMBER"
        raise InvalidInput(f"{target}: the format {chosen} is written to {right}")
    for package in _NEEDED_PACKAGES[chosen]:
        need(package)
    if not scenario.learners:
        raise InvalidInput(
            f"scenario {scenario.name!r} has no learner to record: scenario.with_learners(['vehicle_2'])"
        )
    if chosen == "parquet":
        check_target(target, force=force)
    else:
        env_spec(Task(scenario, LIST_SEED, reward_params("harm"), observation_for(scenario)))
        check_folder(target, force=force)
    return chosen  # type: ignore[no-any-return]  # one of them


def tell(task: Task, agents: Mapping[str, Driver], episodes: int) -> dict[str, Any]:
    """What is recorded, as plain data: the metadata of every dataset."""
    scenario = task.scenario
    teams = {name: Team.of(driver, scenario.learners).drivers for name, driver in agents.items()}
    return {
        "scenario": scenario.declared(),
        "scenario_sha256": scenario_sha256(scenario),
        "seed": task.seed,
        "episodes": int(episodes),
        "learners": [scenario.vehicle_names[i] for i in scenario.learners],
        "agents": {
            name: dict.fromkeys(scenario.vehicle_names[i] for i in drivers) | policies_of(drivers)
            for name, drivers in teams.items()
        },
        "observation": [feature.name for feature in task.observation.features],
        "reward": task.reward.model_dump(mode="json"),
        "versions": result_versions(),
    }
