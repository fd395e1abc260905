"""Checkpoints: everything that determines the rest of a training, between two updates.

A checkpoint is a file of ``torch.save`` with plain data and tensors only, read with ``weights_only=True``, so no code
runs. The CRC-32 of its parts, which torch writes but does not check, reveals damage.
"""

from __future__ import annotations

import io
import random
import zipfile
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import recursive_getattr

from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.files.plain import open_plain
from ethbrake_marl.files.store import write_file

COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining", "_total_timesteps")
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
CHECKPOINT_KEYS = {"training", "versions", "steps", "course", "model"}  # of a checkpoint
MOST_CHECKPOINTS = 2  # checkpoints that are kept; if the newest is damaged, training resumes from the one before
LARGEST_BYTES = 1 << 36


def capture(model: BaseAlgorithm) -> dict[str, Any]:
    environment: Any = model.env
    memory: Any = getattr(model, "replay_buffer", None)
    log = model.logger
    return {
        "parameters": model.get_parameters(),
        "variables": {name: recursive_getattr(model, name).detach() for name in model._get_torch_save_params()[1]},
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "environment": environment.snapshot(),
        "last": [model._last_obs, np.array(model._last_episode_starts)],
        "episodes": [[episode["r"], episode["l"]] for episode in model.ep_info_buffer or ()],
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002
        "python": random.getstate(),
        "torch": torch.get_rng_state(),
        "actions": model.action_space.np_random.bit_generator.state,
        "log": {
            name: (np.asarray(value), log.name_to_count[name], log.name_to_excluded[name])
            for name, value in log.name_to_value.items()
        },
        "replay": None if memory is None else (memory.pos, memory.full),
        "stored": {} if memory is None else {name: getattr(memory, name)[: memory.size()] for name in REPLAY},
    }


def restore(model: BaseAlgorithm, saved: Mapping[str, Any]) -> None:
    """Raises errors of Python, NumPy or torch if the state does not fit the model."""
    environment: Any = model.env
    model._last_obs, model._last_episode_starts = environment.reset(), np.ones(environment.num_envs, np.bool_)
    new = capture(model)
    state = {part: restore_types(new[part], saved[part]) for part in ("environment", "last", "numpy", "actions")}
    model.set_parameters(saved["parameters"], device="cpu")
    for name, value in saved["variables"].items():
        recursive_getattr(model, name).data.copy_(value)
    for name in COUNTERS:
        setattr(model, name, saved["counters"][name])
    environment.restore(state["environment"])
    model._last_obs, model._last_episode_starts = state["last"]
    episodes = [{"r": gained, "l": steps, "t": 0.0} for gained, steps in saved["episodes"]]
    model.ep_info_buffer = deque(episodes, model._stats_window_size)
    model.ep_success_buffer = deque(maxlen=model._stats_window_size)
    log = model.logger
    for name, (value, count, excluded) in saved["log"].items():
        log.name_to_value[name] = value.numpy()[()]  # a single precision number is written with fewer digits
        log.name_to_count[name], log.name_to_excluded[name] = count, excluded
    memory: Any = getattr(model, "replay_buffer", None)
    if memory is not None:
        memory.pos, memory.full = saved["replay"]
        for name in REPLAY:
            getattr(memory, name)[: memory.size()] = saved["stored"][name].numpy()
    random.setstate(saved["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(saved["torch"])
    model.action_space.np_random.bit_generator.state = state["actions"]


def restore_types(new: Any, saved: Any) -> Any:
    """Raises ``ValueError`` if keys or lengths differ, or the shape or type of an array."""
    if isinstance(new, np.ndarray):
        array = saved.numpy().copy()
        if (array.shape, array.dtype) != (new.shape, new.dtype):
            raise ValueError(f"an array of {array.dtype} has the shape {array.shape}; must be {new.dtype}, {new.shape}")
        return array
    if isinstance(new, dict):
        if new.keys() != saved.keys():
            raise ValueError(f"has the entries {', '.join(saved)}; must have {', '.join(new)}")
        return {key: restore_types(value, saved[key]) for key, value in new.items()}
    if isinstance(new, list | tuple):
        parts = [restore_types(entry, saved_entry) for entry, saved_entry in zip(new, saved, strict=True)]
        return type(new)(*parts) if hasattr(new, "_fields") else type(new)(parts)
    return saved


def to_tensors(tree: Any) -> Any:
    """Nested data with tensors instead of NumPy arrays, and plain tuples instead of named ones."""
    if isinstance(tree, np.ndarray):
        return torch.from_numpy(tree.copy())  # policies' tensors are read-only
    if isinstance(tree, dict):
        return {key: to_tensors(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        parts = [to_tensors(entry) for entry in tree]
        return parts if isinstance(tree, list) else tuple(parts)
    return tree


def files_in(folder: Path) -> list[Path]:
    return sorted(folder.glob("step_*.pt"), reverse=True)


def write(folder: Path, saved: Mapping[str, Any]) -> None:
    """Deletes all but the newest two."""
    data = io.BytesIO()
    torch.save(to_tensors(dict(saved)), data)
    folder.mkdir(exist_ok=True)
    write_file(folder / f"step_{saved['steps']:012d}.pt", data.getvalue())
    for old in files_in(folder)[MOST_CHECKPOINTS:]:
        old.unlink()


def read(path: Path) -> dict[str, Any]:
    """Raises ``CorruptBundle`` if the file is damaged or not a checkpoint."""
    with open_plain(path, LARGEST_BYTES, refusal=CorruptBundle, follow_links=False) as stream:
        try:
            damaged = zipfile.ZipFile(stream).testzip()
            stream.seek(0)
            saved = torch.load(stream, weights_only=True)
        except Exception as error:  # zipfile and torch raise many kinds for a file that is not theirs
            raise CorruptBundle(f"{path}: is damaged ({' '.join(str(error).split()):.200})") from None
    if damaged or not isinstance(saved, dict) or saved.keys() != CHECKPOINT_KEYS or type(saved["steps"]) is not int:
        raise CorruptBundle(f"{path}: is damaged, or not a checkpoint")
    return saved


def newest_checkpoint(folder: Path) -> tuple[dict[str, Any] | None, list[str]]:
    """None if there is none; and the errors of newer ones, which are deleted."""
    reasons: list[str] = []
    for path in files_in(folder):
        try:
            return read(path), reasons
        except CorruptBundle as error:
            reasons.append(str(error))
            path.unlink()
    return None, reasons
