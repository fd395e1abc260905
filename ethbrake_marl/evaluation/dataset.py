"""Datasets of any agents on a scenario's list of worlds, written batch by batch."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, fields
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.agents.protocol import Driver, team_of
from ethbrake_marl.agents.rollout import episode_engine, script_agents
from ethbrake_marl.defaults import HARM_COUNTS, LIST_SEED, DatasetFormat
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.step import Step
from ethbrake_marl.envs.common import COLUMNS, LISTED_WORLD, Report, action_box, feature_box, report
from ethbrake_marl.envs.registration import GYMNASIUM_ID
from ethbrake_marl.errors import (
    AlreadyExists,
    InvalidInput,
    PhysicsError,
    check_one_learner,
    check_whole_number,
    naming_extras,
    need,
    renumbered,
    unknown_name,
)
from ethbrake_marl.evaluation.episodes import line_positions
from ethbrake_marl.evaluation.inputs import policy_sha256, result_versions, scenario_sha256
from ethbrake_marl.evaluation.outcome import LeftOut
from ethbrake_marl.evaluation.results import PARQUET, check_target
from ethbrake_marl.evaluation.rollout import ShovedFront
from ethbrake_marl.files.sheet import parquet_file
from ethbrake_marl.files.store import check_writable, new_folder
from ethbrake_marl.harm import Ledger
from ethbrake_marl.observations import Observation, ObservationSpec, choose_observation, observation_for
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, leaving_out_failed
from ethbrake_marl.rewards import Reward, RewardParams, reward_params
from ethbrake_marl.scenario import Sample, Scenario

# Episodes as a learner of any interface meets them, with the actions that an agent chose.
#
# An agent drives as in an evaluation, where its commands (float64, m/s2) are applied as they are. A learner's action is
# a
# float32 in [-1, 1], of which most commands are no exact image. So each command is rounded to an action, and those
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
        self._before, self._front = alert, ShovedFront(alert, np.zeros(alert.n))
        self.positions_m: list[Floats] = []
        self.speeds_mps: list[Floats] = []
        self.follow(engine)

    def follow(self, engine: Engine) -> None:
        """The engine has made a step, the first one from the alert to the first decision."""
        for part in engine.segments(self._before, engine.wanted_mps2):
            self._front.see(*part)
        self._before = engine.worlds
        self.positions_m.append(line_positions(self._front.metres, self._before.gaps_m))
        self.speeds_mps.append(self._before.speeds_mps)


# Episodes as a Parquet file: one row per agent, world and decision, one row group per batch of worlds.

KEY = "ethbrake_marl"  # of the file's metadata: what was recorded, as JSON

Columns = dict[str, NDArray[Any]]


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
    before, after = recording.told, recording.reports[1:]

    def each(values: NDArray[Any]) -> NDArray[Any]:
        """Values [T or T + 1, n, ...], of each decision's begin, decision by decision."""
        return values[: running.shape[1]].swapaxes(0, 1)[running]

    def whole(values: NDArray[Any]) -> NDArray[Any]:
        """A value of each episode [n] in all of its rows."""
        return np.repeat(values, recording.decisions)

    columns: Columns = {
        "agent": np.full(int(running.sum()), recording.agent),
        "world_seed": np.full(int(running.sum()), recording.task.seed),
        "world": whole(recording.index),
        "decision": np.nonzero(running)[1],
        "time_s": each(before("time_s")[:, :, 0]),
    }
    in_force = before("command_in_force_mps2")
    for i in range(recording.task.scenario.vehicles):
        columns[f"position_{i + 1}_m"] = each(recording.positions_m[:, :, i])
        columns[f"speed_{i + 1}_mps"] = each(recording.speeds_mps[:, :, i])
        columns[f"command_in_force_{i + 1}_mps2"] = each(in_force[:, :, i])
    columns |= _learner_columns(recording, each)
    columns["cost"] = each(np.stack([told.cost for told in after]))
    columns["terminated"] = each(np.stack([step.terminated for step in recording.steps]))
    columns["truncated"] = each(np.stack([step.truncated for step in recording.steps]))
    columns["first_impact_harm"] = whole(recording.ledger.world_harm("first"))
    columns["total_harm"] = whole(recording.ledger.world_harm("total"))
    return columns


def _learner_columns(recording: Recording, each: Callable[[NDArray[Any]], NDArray[Any]]) -> Columns:
    """What each learner observes, does, and is rewarded with."""
    columns: Columns = {}
    chosen, terms = recording.told("chosen_command_mps2")[1:], recording.terms()
    reward = np.stack([step.reward for step in recording.steps])
    for c, i in enumerate(recording.learners):
        for f, feature in enumerate(recording.task.observation.features):
            columns[f"observation_{i + 1}.{feature.name}"] = each(recording.observations[:, :, c, f])
        columns[f"action_{i + 1}"] = each(recording.actions[:, :, c])
        columns[f"chosen_command_{i + 1}_mps2"] = each(chosen[:, :, i])
        columns[f"reward_{i + 1}"] = each(reward[:, :, i])
        columns |= {f"reward_{name}_{i + 1}": each(term[1:, :, c]) for name, term in terms.items()}
    return columns


# Episodes of one learner as a dataset of Minari, which replays to the recorded bits in the environment it recovers.
#
# An episode's ``seed`` and ``options`` put its world back: ``env.reset(seed=seed, options=options)``.

DATA = "data"  # the folder of the data inside a dataset's
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]*-v\d+")


def check_folder(path: Path, *, force: bool = False) -> None:
    """Refuse what cannot become a dataset's folder, before any work.

    Raises ``AlreadyExists`` for one that is there, ``InvalidInput`` for what ``force`` does not replace: it replaces
    datasets of Minari alone.
    """
    if _NAME.fullmatch(path.name) is None:
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
            storage.update_episode_metadata(_harms(recording), range(first, first + len(episodes)))

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
        task.scenario.name, names, "a dataset of Minari is one learner's: --vehicle NAME, or --format parquet"
    )
    spec = copy.deepcopy(gymnasium.spec(GYMNASIUM_ID))
    spec.kwargs = {"scenario": task.scenario.declared(), "reward": task.reward.model_dump(mode="json")}
    if task.observation != observation_for(task.scenario):
        spec.kwargs["observation"] = [feature.name for feature in task.observation.features]
    return spec


def _episodes(recording: Recording) -> Iterator[dict[str, Any]]:
    """The fields of an ``EpisodeBuffer``, world by world."""
    vehicle, seed = recording.learners[0], recording.task.seed
    infos = _infos(recording, vehicle)
    reward = np.stack([step.reward[:, vehicle] for step in recording.steps])
    terminated, truncated = (
        np.stack([getattr(step, name) for step in recording.steps]) for name in ("terminated", "truncated")
    )
    for k, (world, end) in enumerate(zip(recording.index.tolist(), recording.decisions.tolist(), strict=True)):
        yield {
            "seed": seed,
            "options": {LISTED_WORLD: {"seed": seed, "number": world}},
            "observations": recording.observations[: end + 1, k, 0],
            "actions": recording.actions[:end, k],
            "rewards": reward[:end, k],
            "terminations": terminated[:end, k],
            "truncations": truncated[:end, k],
            "infos": {name: values[: end + 1, k] for name, values in infos.items()},
        }


def _infos(recording: Recording, vehicle: int) -> dict[str, NDArray[Any]]:
    """The infos of the environment, [T + 1, n, ...]."""
    infos: dict[str, NDArray[Any]] = {name: recording.told(name)[:, :, vehicle] for name in COLUMNS}
    infos["collided"] = infos["collided"] == 1.0
    infos["chosen_action"] = infos["chosen_action"].astype(np.float32)[:, :, np.newaxis]
    infos["cost"] = np.stack([told.cost for told in recording.reports])
    infos["world_seed"] = np.full(infos["cost"].shape, recording.task.seed)
    infos["world"] = np.stack([told.world for told in recording.reports])
    infos |= {f"reward_{name}": term[:, :, 0] for name, term in recording.terms().items()}
    news = [told.known_from_s[:, vehicle] for told in recording.reports if told.known_from_s is not None]
    if news:
        infos["known_from_s"] = np.stack(news)
    return infos


def _harms(recording: Recording) -> list[dict[str, Any]]:
    """What stands beside each episode."""
    first, total = (recording.ledger.world_harm(harm_count) for harm_count in ("first", "total"))
    return [
        {"agent": recording.agent, "first_impact_harm": float(one), "total_harm": float(all_)}
        for one, all_ in zip(first, total, strict=True)
    ]


BATCH = 500  # worlds recorded together: bounds memory, changes no episode

_PACKAGES: dict[DatasetFormat, tuple[str, ...]] = {"parquet": ("pyarrow",), "minari": ("minari", "h5py")}


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
    agents: Mapping[str, Driver],
    *,
    scenario: Scenario,
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
        agents: name -> agent, or team, that drives the scenario's learners; they are left as they are.
        scenario: whose worlds are driven in.
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
    if not agents:
        raise InvalidInput("write_dataset: no agents given; at least one is needed, for instance full_brake")
    chosen = check_dataset(path, scenario, format, force=force)
    spec = observation_for(scenario) if observation is None else choose_observation(observation)
    task = Task(scenario, int(seed), reward_params(reward), spec)
    work = _Work(task, int(episodes), on_progress, tell(task, agents, episodes))
    with _sink(Path(path), chosen, task, work.told, force=force) as add:
        for name, driver in agents.items():
            work.record(name, driver, add)
        if not work.decisions:
            raise PhysicsError({left.world: f"{left.agent}: {left.reason}" for left in work.left_out})
        work.told["left_out"] = [left._asdict() for left in work.left_out]
        work.told["off_by"] = work.off_by
    return DatasetSummary(Path(path), chosen, work.episodes, work.decisions, work.off_by, tuple(work.left_out))


def check_dataset(
    path: str | Path, scenario: Scenario, format: str | None = None, *, force: bool = False
) -> DatasetFormat:
    """The format of a dataset that can be written to ``path``; raises as ``write_dataset`` does before its work."""
    target = Path(path)
    is_file = target.suffix.lower() == PARQUET
    chosen: Any = format if format is not None else "parquet" if is_file else "minari"
    if chosen not in get_args(DatasetFormat):
        raise unknown_name("format", chosen, get_args(DatasetFormat))
    if is_file != (chosen == "parquet"):
        right = f"a file ending in {PARQUET}" if chosen == "parquet" else "a folder called NAME-vNUMBER"
        raise InvalidInput(f"{target}: the format {chosen} is written to {right}")
    for package in _PACKAGES[chosen]:
        need(package)
    if not scenario.learners:
        raise InvalidInput(
            f"scenario {scenario.name!r} has no learner to record; say who is driven: --vehicle vehicle_2"
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
    teams = {name: team_of(driver, scenario.learners).drivers for name, driver in agents.items()}
    return {
        "scenario": scenario.declared(),
        "scenario_sha256": scenario_sha256(scenario),
        "seed": task.seed,
        "episodes": int(episodes),
        "learners": [scenario.vehicle_names[i] for i in scenario.learners],
        "agents": {
            name: {scenario.vehicle_names[i]: policy_sha256(agent) for i, agent in drivers.items()}
            for name, drivers in teams.items()
        },
        "observation": [feature.name for feature in task.observation.features],
        "reward": task.reward.model_dump(mode="json"),
        "versions": result_versions(),
    }


def _sink(
    path: Path, format: DatasetFormat, task: Task, told: Mapping[str, Any], *, force: bool
) -> AbstractContextManager[Callable[[Recording], None]]:
    if format == "parquet":
        return parquet_dataset(path, told)
    return minari_folder(path, task, told, force=force)


class _Work:
    """What is to be recorded, and how far it is."""

    def __init__(
        self, task: Task, worlds: int, on_progress: Callable[[str, int], None] | None, told: dict[str, Any]
    ) -> None:
        self.task, self.worlds, self.told = task, worlds, told
        self.on_progress = on_progress
        self.episodes: dict[str, int] = {}
        self.off_by: dict[str, float] = {}
        self.left_out: list[LeftOut] = []
        self.decisions = 0

    def record(self, name: str, driver: Driver, add: Callable[[Recording], None]) -> None:
        """Record an agent in every world, batch by batch."""
        self.episodes[name], self.off_by[name] = 0, 0.0
        for first in range(0, self.worlds, BATCH):
            count = min(BATCH, self.worlds - first)
            sample = self.task.scenario.sample(count, self.task.seed, first=first)

            def of(rows: Any, sample: Sample = sample) -> Recording:
                part = Sample(sample.worlds.take(rows), sample.index[rows], 0)
                return record_episodes(part, driver, name, self.task)

            recording, _, failed = leaving_out_failed(of, np.arange(count))
            self.left_out += [LeftOut(first + row, self.task.seed, name, why) for row, why in failed.items()]
            if recording is not None:
                add(recording)
                self.episodes[name] += len(recording.index)
                self.decisions += int(recording.decisions.sum())
                self.off_by[name] = max(self.off_by[name], recording.off_by)
            if self.on_progress is not None:
                self.on_progress(name, first + count)
