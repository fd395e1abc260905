"""Checkpoints: everything on which the rest of a training depends, between two updates. Reading one runs no code.

A checkpoint is a file of ``torch.save`` with plain data and tensors only, read with ``weights_only=True``. The CRC-32
of its parts, which torch writes and does not check, shows damage.
"""

from __future__ import annotations

import io
import random
import zipfile
from collections import deque
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import recursive_getattr

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.files.plain import open_plain
from ethbrake_marl.files.store import write_file

COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining", "_total_timesteps")
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
KINDS = {"training": str, "versions": dict, "model": dict, "course": dict, "steps": int}  # what a checkpoint holds
MOST = 2  # checkpoints that are kept; if the newest is damaged, training resumes from the one before
LARGEST_BYTES = 1 << 36
LARGEST_COUNT = 1 << 53


def capture(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the state of a model, its environment and the global random generators, as plain data and arrays."""
    environment: Any = model.env
    memory: Any = getattr(model, "replay_buffer", None)
    log = model.logger
    return {
        "parameters": model.get_parameters(),
        "variables": {name: recursive_getattr(model, name).detach() for name in model._get_torch_save_params()[1]},
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "environment": environment.snapshot(),
        "last": [model._last_obs, np.array(model._last_episode_starts)],
        "episodes": [[each["r"], each["l"]] for each in model.ep_info_buffer or ()],
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002
        "python": random.getstate(),
        "torch": torch.get_rng_state(),
        "actions": model.action_space.np_random.bit_generator.state,
        "log": {
            name: [float(value), log.name_to_count[name], list(log.name_to_excluded[name] or ())]
            for name, value in log.name_to_value.items()
        },
        "replay": None if memory is None else [memory.pos, memory.full],
        "stored": {} if memory is None else {name: getattr(memory, name)[: memory.size()] for name in REPLAY},
    }


def restore(model: BaseAlgorithm, saved: Mapping[str, Any]) -> None:
    """Let a new model of the same training, which has a logger, go on from what ``capture`` returned.

    Raises an error of Python, NumPy or torch if it does not fit.
    """
    environment: Any = model.env
    model._last_obs, model._last_episode_starts = environment.reset(), np.ones(environment.num_envs, np.bool_)
    new = capture(model)
    fitting = {
        part: like(new[part], saved[part], part)
        for part in ("variables", "counters", "environment", "last", "numpy", "torch", "actions")
    }
    model.set_parameters(dict(saved["parameters"]), device="cpu")
    for name in saved["parameters"]:
        _try_step(recursive_getattr(model, name))
    for name, value in fitting["variables"].items():
        recursive_getattr(model, name).data.copy_(value)
    for name, value in fitting["counters"].items():
        if isinstance(value, int) and not 0 <= value < LARGEST_COUNT:
            raise ValueError(f"{name} = {value}: must be a whole number, at least 0")
        setattr(model, name, value)
    environment.restore(fitting["environment"])
    model._last_obs, model._last_episode_starts = fitting["last"]
    episodes = [{"r": float(gained), "l": int(steps), "t": 0.0} for gained, steps in saved["episodes"]]
    model.ep_info_buffer = deque(episodes, model._stats_window_size)
    model.ep_success_buffer = deque(maxlen=model._stats_window_size)
    for name, (value, count, excluded) in saved["log"].items():
        model.logger.name_to_value[name] = float(value)
        model.logger.name_to_count[name] = int(count)
        model.logger.name_to_excluded[name] = tuple(excluded)
    if saved["replay"] is not None:
        _restore_replay(model, saved)
    version, numbers, cached = saved["python"]
    random.setstate((version, tuple(numbers), cached))
    np.random.set_state(fitting["numpy"])  # noqa: NPY002
    torch.set_rng_state(fitting["torch"])
    model.action_space.np_random.bit_generator.state = fitting["actions"]


def _restore_replay(model: Any, saved: Mapping[str, Any]) -> None:
    memory, (position, full) = model.replay_buffer, saved["replay"]
    if (type(position), type(full)) != (int, bool) or not 0 <= position < memory.buffer_size:
        raise ValueError(f"replay = {saved['replay']!r:.60}: must be the next position, and whether the buffer is full")
    memory.pos, memory.full = position, full
    for name in REPLAY:
        filled = getattr(memory, name)[: memory.size()]
        filled[:] = like(filled, saved["stored"][name], name)


def _try_step(optimizer: Any) -> None:
    """Let a copy of an optimiser make a step; torch raises an error if its state does not fit the weights."""
    if isinstance(optimizer, torch.optim.Optimizer):
        tried = deepcopy(optimizer)
        for group in tried.param_groups:
            for weights in group["params"]:
                weights.grad = torch.zeros_like(weights)
        tried.step()


def like(new: Any, saved: Any, place: str) -> Any:
    """Return a tree of plain data and tensors as a tree with the types of ``new``, and arrays of its shapes.

    Raises ``ValueError`` if they differ.
    """
    if isinstance(new, np.ndarray):
        array = saved.numpy() if isinstance(saved, torch.Tensor) else None
        if array is None or (array.shape, array.dtype) != (new.shape, new.dtype):
            raise ValueError(f"{place}: must be an array of {new.dtype} with shape {new.shape}")
        return array.copy()
    if isinstance(new, torch.Tensor):
        return torch.from_numpy(like(new.numpy(), saved, place))
    if isinstance(new, dict) and isinstance(saved, dict) and new.keys() == saved.keys():
        return {key: like(value, saved[key], f"{place}.{key}") for key, value in new.items()}
    if isinstance(new, list | tuple) and isinstance(saved, list | tuple) and len(new) == len(saved):
        parts = [like(each, other, f"{place}[{k}]") for k, (each, other) in enumerate(zip(new, saved, strict=True))]
        return type(new)(*parts) if hasattr(new, "_fields") else type(new)(parts)
    if isinstance(new, dict | list | tuple) or type(new) is not type(saved):
        raise ValueError(f"{place}: must be of type {type(new).__name__}, and have the same entries")
    return saved


def to_tensors(tree: Any) -> Any:
    """Return a tree with tensors in place of arrays, and plain tuples in place of named ones."""
    if isinstance(tree, np.ndarray):
        return torch.from_numpy(tree.copy())  # policies' tensors are read-only
    if isinstance(tree, dict):
        return {key: to_tensors(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        parts = [to_tensors(each) for each in tree]
        return parts if isinstance(tree, list) else tuple(parts)
    return tree


def path_of(folder: Path, steps: int) -> Path:
    """Return the file of the checkpoint after ``steps`` decisions of all learners together."""
    return folder / f"step_{steps:012d}.pt"


def files_in(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder, newest first, unread."""
    return sorted(folder.glob("step_*.pt"), reverse=True)


def write(folder: Path, saved: Mapping[str, Any]) -> None:
    """Write a checkpoint, whole or not at all, and delete all but the newest two."""
    data = io.BytesIO()
    torch.save(to_tensors(dict(saved)), data)
    folder.mkdir(exist_ok=True)
    write_file(path_of(folder, saved["steps"]), data.getvalue())
    for old in files_in(folder)[MOST:]:
        old.unlink()


def read(path: Path) -> dict[str, Any]:
    """Read a checkpoint. Raises ``CorruptBundle`` if it is damaged or has other content."""
    with open_plain(path, LARGEST_BYTES, refusal=CorruptBundle, follow_links=False) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                stored = all(part.compress_type == zipfile.ZIP_STORED for part in archive.infolist())
                whole = stored and archive.testzip() is None
            stream.seek(0)
            saved = torch.load(stream, weights_only=True) if whole else None
        except Exception as error:  # zipfile and torch raise many kinds for a file that is not theirs
            raise CorruptBundle(f"{path}: is damaged ({' '.join(str(error).split()):.200})") from None
    if not isinstance(saved, dict) or any(type(saved.get(key)) is not kind for key, kind in KINDS.items()):
        raise CorruptBundle(f"{path}: is damaged, or not a checkpoint")
    return saved


def newest(folder: Path) -> tuple[dict[str, Any] | None, list[str]]:
    """Return the newest checkpoint that is whole, or None, and why newer ones are not: these are deleted.

    Raises ``InvalidInput`` if there are checkpoints of another version only.
    """
    reasons: list[str] = []
    for path in files_in(folder):
        try:
            return read(path), reasons
        except CorruptBundle as error:
            reasons.append(str(error))
            path.unlink()
    if others := sorted(folder.glob("step_*")):
        raise InvalidInput(
            f"{others[-1]}: another version of this package wrote this checkpoint; install that version, or delete"
            " it to train from the beginning"
        )
    return None, reasons
