"""Write recorded episodes as a Minari dataset or a Parquet file.

A Minari dataset also contains the environment, which ``dataset.recover_environment()`` returns. In this environment,
the recorded actions repeat the episodes bit for bit. To start in the world of an episode, call ``env.reset(seed=seed,
options=options)`` with the ``seed`` and ``options`` in the metadata of the episode.

Letters in shapes mean the same as in ``recording``.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.envs.making import action_box, feature_box
from ethbrake_marl.errors import (
    AlreadyExists,
    InvalidInput,
    PhysicsError,
    check_one_learner,
    check_whole_number,
    naming_extras,
    need,
    unknown_name,
)
from ethbrake_marl.evaluation.identity import LIST_SEED, policies_of, result_versions, scenario_sha256
from ethbrake_marl.evaluation.lineup import make_lineup
from ethbrake_marl.evaluation.outcome import LeftOut
from ethbrake_marl.extensions.datasets.parquet import KEY, OF_STEPS, parquet_dataset
from ethbrake_marl.extensions.datasets.recording import Recording, Task, record_episodes
from ethbrake_marl.files.store import check_target, check_writable, new_folder
from ethbrake_marl.game.harm import HARM_COUNTS
from ethbrake_marl.game.observations import Observation, choose_observation
from ethbrake_marl.game.observed import observation_for
from ethbrake_marl.game.rewards import Reward, reward_params
from ethbrake_marl.physics.left_out import leaving_out_failed
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.schema import Scenario

DATA = "data"  # name of Minari's data folder inside the folder of a dataset

_DATASET_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]*-v\d+")


def check_folder(path: Path, *, force: bool = False) -> None:
    """Check, before episodes are recorded, that a Minari dataset can be written to the folder ``path``.

    With ``force``, ``path`` may be an existing Minari dataset. Raises ``AlreadyExists`` if ``path`` exists and
    ``force`` is false. Raises ``InvalidInput`` if the name of the folder does not have the form ``NAME-vNUMBER``, if
    its parent folder is missing or not writable, or if ``path`` exists but is not a Minari dataset.
    """
    if _DATASET_NAME.fullmatch(path.name) is None:
        raise InvalidInput(f"{path}: the folder of a Minari dataset must be named NAME-vNUMBER, for instance brakes-v0")
    if path.is_symlink() or path.exists():
        if not force:
            raise AlreadyExists(
                f"{path}: already exists; give another name, or pass force=True (--force) to overwrite it"
            )
        if path.is_symlink() or not (path / DATA / "metadata.json").is_file():
            raise InvalidInput(
                f"{path}: this is not a Minari dataset, so force (--force) does not replace it; give another name"
            )
    if not path.parent.is_dir():
        raise InvalidInput(f"{path}: the folder {path.parent} does not exist; create it first")
    try:
        check_writable(path.parent)
    except OSError as error:
        raise InvalidInput(f"{path}: the folder cannot be written ({error.strerror})") from None


@contextmanager
def minari_folder(
    path: Path, task: Task, told: Mapping[str, Any], *, force: bool
) -> Iterator[Callable[[Recording], None]]:
    """Context manager that opens a new Minari dataset, and yields a function that adds a recording to the dataset.

    The folder appears at ``path`` (named ``NAME-vNUMBER``) when the ``with`` block ends without an exception. The
    metadata ``told`` (result of ``tell``) are then stored as JSON under the key ``ethbrake_marl``; the caller may add
    entries until then. Raises ``MissingExtra`` if minari or h5py is not installed.
    """
    with naming_extras():
        import h5py  # noqa: F401  # imported here so that a missing h5py raises our message, not Minari's
        from minari.data_collector.episode_buffer import EpisodeBuffer
        from minari.dataset.minari_storage import MinariStorage

    with new_folder(path, replace=force) as partial:
        storage = MinariStorage.new(
            partial.resolve() / DATA,  # absolute: with a relative path Minari 0.5.4 looks in the wrong folder
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
    """Return a Gymnasium spec of the environment in which recorded actions can be repeated.

    The spec contains only plain data, so it can be stored as JSON. Raises ``InvalidInput`` if the scenario does not
    have exactly one learner.
    """
    names = [task.scenario.vehicle_names[i] for i in task.scenario.learners]
    check_one_learner(
        task.scenario.name,
        names,
        "a Minari dataset has one learner; give the other learners a script, or write a Parquet file",
    )
    spec = copy.deepcopy(gymnasium.spec("EthBrake-v1"))
    spec.kwargs = {"scenario": task.scenario.declared(), "reward": task.reward.model_dump(mode="json")}
    if task.observation != observation_for(task.scenario):
        spec.kwargs["observation"] = [feature.name for feature in task.observation.features]
    return spec


def _episodes(recording: Recording) -> Iterator[dict[str, Any]]:
    """Yield the keyword arguments of Minari's ``EpisodeBuffer`` for each recorded episode."""
    vehicle, seed = recording.learners[0], recording.task.seed
    infos = _infos(recording, vehicle)
    reward, terminated, truncated = (np.stack([getattr(step, name) for step in recording.steps]) for name in OF_STEPS)
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
    """Return the environment's ``info`` for ``vehicle`` (0 = front): key -> values [T + 1, n, ...]."""
    infos = {name: recording.told(name)[:, :, vehicle] for name in recording.reports[0].columns()}
    cost = np.stack([each.cost for each in recording.reports])
    news = [each.known_from_s[:, vehicle] for each in recording.reports if each.known_from_s is not None]
    return {
        **infos,
        "collided": infos["collided"] == 1.0,
        "chosen_action": infos["chosen_action"].astype(np.float32)[:, :, np.newaxis],
        "cost": cost,
        "world_seed": np.full(cost.shape, recording.task.seed),
        "world": np.stack([each.world for each in recording.reports]),
        **{f"reward_{name}": term[:, :, 0] for name, term in recording.terms().items()},
        **({"known_from_s": np.stack(news)} if news else {}),
    }


BATCH = 500  # number of worlds recorded together; it limits memory and has no effect on the episodes

DatasetFormat = Literal["parquet", "minari"]

_NEEDED_PACKAGES: dict[DatasetFormat, tuple[str, ...]] = {"parquet": ("pyarrow",), "minari": ("minari", "h5py")}


@dataclass(frozen=True, slots=True)
class DatasetSummary:
    """Result of ``write_dataset``."""

    path: Path  # path of the file or folder
    format: DatasetFormat  # ``parquet`` or ``minari``
    episodes: Mapping[str, int]  # number of recorded episodes, by name of the agent
    decisions: int  # number of decisions in all episodes of all agents
    # Largest difference, by name of the agent, between the harm of a recorded episode, whose actions are rounded to
    # float32, and the harm with the agent's exact commands (m2/s2).
    off_by: Mapping[str, float]
    left_out: tuple[LeftOut, ...]  # worlds that were not recorded, because the physics could not simulate them


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
    """Let agents drive in worlds of a scenario, and write the episodes as a Parquet file or a Minari dataset.

    An environment that starts in a recorded world and gets the recorded actions repeats the episode bit for bit.
    docs/extensions/datasets.md describes the files. Before the first episode, the function raises ``InvalidInput`` if
    an argument is invalid, ``AlreadyExists`` if ``path`` exists and ``force`` is false, and ``MissingExtra`` if a
    library is not installed. After the last episode, the function raises ``PhysicsError`` if the physics could simulate
    none of the worlds.

    Args:
        path: file (``.parquet``) or folder (``NAME-v0``) to write.
        agents: names of agents as on the command line, or a mapping from names to agents or teams. Each drives all
            learners of the scenario in its own episodes. Agents are not changed.
        scenario: a ``Scenario``, or its name or path.
        episodes: number of worlds in which each agent drives: the worlds 0 to ``episodes`` - 1 of ``seed``.
        seed: seed from which the worlds are drawn.
        format: ``parquet`` or ``minari``; None: by the ending of ``path``.
        reward: reward to record: a name such as ``harm``, or the weights of the reward's terms.
        observation: features to record; None: the features that ``observation_for(scenario)`` returns.
        force: whether to replace an existing dataset.
        on_progress: called with the name of an agent and the number of its worlds recorded so far.

    """
    check_whole_number("write_dataset: episodes", episodes, 1)
    check_whole_number("write_dataset: seed", seed, 0)
    scenario = load_scenario(scenario)
    if isinstance(agents, Sequence):
        agents = make_lineup(agents, scenario)
    if not agents:
        raise InvalidInput("write_dataset: there are no agents; give at least one agent, for instance full_brake")
    chosen = check_dataset(path, scenario, format, force=force)
    spec = observation_for(scenario) if observation is None else choose_observation(observation)
    task = Task(scenario, int(seed), reward_params(reward), spec)
    metadata = tell(task, agents, episodes)
    sink = (
        parquet_dataset(Path(path), metadata)
        if chosen == "parquet"
        else minari_folder(Path(path), task, metadata, force=force)
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
        metadata["left_out"] = [left._asdict() for left in left_out]
        metadata["off_by"] = off_by
    return DatasetSummary(Path(path), chosen, recorded, decisions, off_by, tuple(left_out))


def check_dataset(
    path: str | Path, scenario: Scenario, format: str | None = None, *, force: bool = False
) -> DatasetFormat:
    """Check that a dataset of ``scenario`` can be written to ``path``; return its format.

    The arguments mean the same as in ``write_dataset``. Raises the exceptions that ``write_dataset`` raises before the
    first episode.
    """
    target = Path(path)
    is_file = target.suffix.lower() == ".parquet"
    chosen: Any = format if format is not None else "parquet" if is_file else "minari"
    if chosen not in get_args(DatasetFormat):
        raise unknown_name("format", chosen, get_args(DatasetFormat))
    if is_file != (chosen == "parquet"):
        right = "a file ending in .parquet" if chosen == "parquet" else "a folder called NAME-vNUMBER"
        raise InvalidInput(f"{target}: a dataset in the format {chosen} must be {right}; change the name or the format")
    for package in _NEEDED_PACKAGES[chosen]:
        need(package)
    if not scenario.learners:
        raise InvalidInput(
            f"scenario {scenario.name!r} has no learner to record; use scenario.with_learners(['vehicle_2'])"
        )
    if chosen == "parquet":
        check_target(target, force=force)
    else:
        env_spec(Task(scenario, LIST_SEED, reward_params("harm"), observation_for(scenario)))
        check_folder(target, force=force)
    return chosen  # type: ignore[no-any-return]  # a DatasetFormat: checked above


def tell(task: Task, agents: Mapping[str, Driver], episodes: int) -> dict[str, Any]:
    """Return the metadata of a dataset as plain data: scenario, seed, agents, observation, reward and versions."""
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
