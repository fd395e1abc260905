"""Datasets of any agents on a scenario's list of worlds, written batch by batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ethbrake_marl.agents.team import Driver, team_of
from ethbrake_marl.defaults import LIST_SEED, DatasetFormat
from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number, need, unknown_name
from ethbrake_marl.evaluation.dataset.minari_folder import check_folder, env_spec, minari_folder
from ethbrake_marl.evaluation.dataset.parquet import parquet_file
from ethbrake_marl.evaluation.dataset.recording import Recording, Task, record_episodes
from ethbrake_marl.evaluation.frame import PARQUET
from ethbrake_marl.evaluation.identity import policy_sha256, result_versions, scenario_sha256
from ethbrake_marl.evaluation.outcome import LeftOut
from ethbrake_marl.evaluation.per_world import check_target
from ethbrake_marl.observations import Observation, choose_observation, observation_for
from ethbrake_marl.physics import leaving_out_failed
from ethbrake_marl.rewards import Reward, reward_params
from ethbrake_marl.scenario import Sample, Scenario

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
        return parquet_file(path, told)
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
