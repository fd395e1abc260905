"""A training at rest between two updates, as a folder of plain files: whole or not there, and checked when read.

``checkpoint.json`` lists every other file with its size and SHA-256; numbers are JSON, safetensors and ``.npy``
without objects, so reading one runs no code from it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError

from ethbrake_marl.durable_files import new_folder, remove_folder, write_file
from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.learning.policy_team import Trained, read_trained, save_trained
from ethbrake_marl.snapshots import Arrays
from ethbrake_marl.strict_json import parse_strict_json

FORMAT_VERSION = 1
LISTING = "checkpoint.json"
KEPT = 2  # checkpoints of a running training; a torn last one leaves the one before

_NUMBERS, _ARRAYS, _TABLE, _POLICY, _BEST, _MEMORY = (
    "state.json",
    "arrays.safetensors",
    "progress.csv",
    "policy",
    "best",
    "replay",
)
_LISTING_LIMIT_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class TrainingState:
    """What a training needs to go on."""

    steps: int
    updates: int
    numbers: dict[str, Any]  # plain JSON
    arrays: Arrays
    replay: Arrays  # memory-mapped when read
    policy: Trained  # as it was checked last
    best: Trained | None  # of least harm so far
    table: bytes  # progress.csv
    versions: Mapping[str, str]


def write_checkpoint(folder: Path, state: TrainingState) -> None:
    """Write ``folder``, completely or not at all, with every byte on the disk before it has its name."""
    with new_folder(folder) as partial:
        write_file(partial / _NUMBERS, json.dumps(state.numbers, allow_nan=False).encode())
        write_file(partial / _ARRAYS, safetensors.numpy.save(_contiguous(state.arrays)))
        write_file(partial / _TABLE, state.table)
        save_trained(state.policy, partial / _POLICY)
        if state.best is not None:
            save_trained(state.best, partial / _BEST)
        for name, array in state.replay.items():
            _write_array(partial / f"{_MEMORY}-{name}.npy", array)
        files = sorted(path for path in partial.rglob("*") if path.is_file())
        listing = {
            "format": "ethbrake-checkpoint",
            "format_version": FORMAT_VERSION,
            "steps": state.steps,
            "updates": state.updates,
            "versions": dict(state.versions),
            "files": {
                path.relative_to(partial).as_posix(): {"bytes": path.stat().st_size, "sha256": _sha256(path)}
                for path in files
            },
        }
        write_file(partial / LISTING, json.dumps(listing, indent=2).encode() + b"\n")


def read_checkpoint(folder: Path) -> TrainingState:
    """Read and check every file of ``folder``; raises ``CorruptBundle`` naming the file and what is wrong with it."""
    listing = _checked_listing(folder)
    try:
        return TrainingState(
            steps=listing["steps"],
            updates=listing["updates"],
            numbers=parse_strict_json((folder / _NUMBERS).read_bytes()),
            arrays=dict(safetensors.numpy.load((folder / _ARRAYS).read_bytes())),
            replay={
                file.stem.removeprefix(f"{_MEMORY}-"): np.load(file, mmap_mode="r", allow_pickle=False)
                for file in sorted(folder.glob(f"{_MEMORY}-*.npy"))
            },
            policy=read_trained(folder / _POLICY),
            best=read_trained(folder / _BEST) if (folder / _BEST).is_dir() else None,
            table=(folder / _TABLE).read_bytes(),
            versions=listing["versions"],
        )
    except (ValueError, SafetensorError) as error:
        raise CorruptBundle(f"{folder}: {error}") from None


def checkpoint_folders(folder: Path) -> list[Path]:
    """Checkpoints in ``folder``, the newest first; whether they are whole is not known yet."""
    return sorted((path for path in folder.glob("step_*") if path.is_dir()), reverse=True)


def newest_usable(folder: Path) -> tuple[TrainingState | None, list[str]]:
    """The newest checkpoint in ``folder`` that is whole, and why each newer one is not; damaged ones are deleted."""
    reasons: list[str] = []
    for path in checkpoint_folders(folder):
        try:
            return read_checkpoint(path), reasons
        except CorruptBundle as error:
            reasons.append(str(error))
            remove_folder(path)
    return None, reasons


def prune(folder: Path, keep: int = KEPT) -> None:
    """Delete all but the newest ``keep`` checkpoints."""
    for path in checkpoint_folders(folder)[keep:]:
        remove_folder(path)


def _checked_listing(folder: Path) -> dict[str, Any]:
    path = folder / LISTING
    try:
        with path.open("rb") as file:
            listing: Any = parse_strict_json(file.read(_LISTING_LIMIT_BYTES))
        wanted = ("ethbrake-checkpoint", FORMAT_VERSION)
        if (listing["format"], listing["format_version"]) != wanted:
            raise CorruptBundle(f"{path}: is not of format {wanted[0]} {wanted[1]}")
        files = {str(name): (int(entry["bytes"]), str(entry["sha256"])) for name, entry in listing["files"].items()}
    except OSError as error:
        raise CorruptBundle(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, CorruptBundle):
            raise
        raise CorruptBundle(f"{path}: is damaged ({error})") from None
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    if found.keys() != files.keys() | {LISTING}:
        different = sorted(found.keys() ^ (files.keys() | {LISTING}))[0]
        raise CorruptBundle(f"{folder / different}: is {'extra' if different in found else 'missing'}")
    for name, (size, digest) in files.items():
        if found[name].stat().st_size != size or _sha256(found[name]) != digest:
            raise CorruptBundle(f"{found[name]}: is not the file that was written (size or SHA-256 differ)")
    return dict(listing)


def _contiguous(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    return {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in arrays.items()}


def _write_array(path: Path, array: NDArray[Any]) -> None:
    with path.open("wb") as file:
        np.lib.format.write_array(file, np.asarray(array), allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
