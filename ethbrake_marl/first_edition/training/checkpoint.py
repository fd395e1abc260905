"""Checkpoint of a training run between two updates: a folder with arrays and JSON, written atomically."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.files.plain import open_plain, parse_strict_json, read_plain
from ethbrake_marl.files.store import new_file, new_folder, remove_folder, write_file
from ethbrake_marl.first_edition.engine.memory import Arrays

ARRAYS, NUMBERS = "arrays.safetensors", "numbers.json"

_KINDS = {
    "training": str,
    "versions": dict,
    "steps": int,
    "updates": int,
    "ended": dict,
    "course": dict,
    "progress": str,
}

MOST_CHECKPOINTS = 2  # number of checkpoints to keep; if the newest is damaged, training resumes from the older one


class TrainingState(NamedTuple):
    """State of a training run between two updates, from which the training continues as if it had not stopped."""

    numbers: dict[str, Any]  # counters, settings and log, as plain data for JSON
    arrays: Arrays  # weights, optimiser states, environment and random generators, by name

    @property
    def steps(self) -> int:
        """Number of decisions that all learners together have made so far."""
        return int(self.numbers["steps"])


def write_checkpoint(folder: Path, state: TrainingState) -> None:
    """Write ``state`` as a checkpoint to a new ``folder``, and delete all but the two newest checkpoints.

    If writing fails, no incomplete checkpoint is left behind, because the folder gets its name only after all bytes are
    on the disk.
    """
    arrays = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in state.arrays.items()}
    with new_folder(folder) as partial:
        with new_file(partial / ARRAYS) as file:
            safetensors.numpy.save_file(arrays, file)
        with (partial / ARRAYS).open("rb") as stream:
            numbers = state.numbers | {"sha256": _digest(stream, state.numbers)}
        write_file(partial / NUMBERS, json.dumps(numbers, allow_nan=False).encode())
    for old in checkpoint_folders(folder.parent)[MOST_CHECKPOINTS:]:
        remove_folder(old)


def read_checkpoint(folder: Path) -> TrainingState:
    """Read and check the checkpoint in ``folder``.

    Raises ``CorruptBundle`` if the checkpoint is damaged, ``InvalidInput`` if it has another format.
    """
    if not os.path.lexists(folder / NUMBERS):
        raise InvalidInput(
            f"{folder}: the checkpoint has no {NUMBERS}, so another version of this package wrote it; install that"
            " version, or delete this checkpoint to resume from an earlier one"
        )
    data = read_plain(folder / NUMBERS, 256 << 20, refusal=CorruptBundle, follow_links=False)
    with open_plain(folder / ARRAYS, 1 << 36, refusal=CorruptBundle, follow_links=False) as stream:
        try:
            numbers = parse_strict_json(data)
            whole = isinstance(numbers, dict) and numbers.pop("sha256", None) == _digest(stream, numbers)
        except ValueError:
            whole = False
    if not whole:
        raise CorruptBundle(f"{folder}: the files of the checkpoint are damaged (their SHA-256 differs)")
    try:
        state = TrainingState(numbers, safetensors.numpy.load_file(folder / ARRAYS))
    except SafetensorError as error:
        raise InvalidInput(
            f"{folder / ARRAYS}: {error}; delete this checkpoint to resume from an earlier one"
        ) from None
    for name, kind in _KINDS.items():
        if type(numbers.get(name)) is not kind:
            raise InvalidInput(
                f"{folder / NUMBERS}: {name} = {numbers.get(name)!r:.60}: must be of type {kind.__name__}; delete this"
                " checkpoint to resume from an earlier one"
            )
    return state


def _digest(arrays: BufferedReader, numbers: Mapping[str, Any]) -> str:
    """Return the SHA-256 (hexadecimal) of a checkpoint: the open file ``arrays``, followed by ``numbers`` as JSON."""
    digest = hashlib.file_digest(arrays, "sha256")
    digest.update(json.dumps(numbers, sort_keys=True).encode())
    return digest.hexdigest()


def checkpoint_folders(folder: Path) -> list[Path]:
    """Return the folders of all checkpoints inside ``folder``, newest first; the checkpoints are not checked."""
    folders = (path for path in folder.glob("step_*") if path.is_dir() and not path.is_symlink())
    return sorted(folders, reverse=True)


def newest_usable(folder: Path) -> tuple[TrainingState | None, list[str]]:
    """Read the newest undamaged checkpoint inside ``folder``, and delete newer checkpoints, which are damaged.

    Returns the state of the training run (None if there is no undamaged checkpoint), and an error message for each
    damaged checkpoint. If a checkpoint has another format, ``InvalidInput`` is raised, and this checkpoint is not
    deleted.
    """
    reasons: list[str] = []
    for path in checkpoint_folders(folder):
        try:
            return read_checkpoint(path), reasons
        except CorruptBundle as error:
            reasons.append(str(error))
            remove_folder(path)
    return None, reasons
