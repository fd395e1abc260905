"""Episodes of one learner as a dataset of Minari, which replays to the recorded bits in the environment it recovers.

An episode's ``seed`` and ``options`` put its world back: ``env.reset(seed=seed, options=options)``.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from ethbrake_marl.envs.infos import COLUMNS
from ethbrake_marl.envs.registration import GYMNASIUM_ID
from ethbrake_marl.envs.setup import LISTED_WORLD, action_box, feature_box
from ethbrake_marl.errors import AlreadyExists, InvalidInput, check_one_learner, naming_extras
from ethbrake_marl.evaluation.dataset.parquet import KEY
from ethbrake_marl.evaluation.dataset.recording import Recording, Task
from ethbrake_marl.files.durable import check_writable, new_folder
from ethbrake_marl.observations import observation_for

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
