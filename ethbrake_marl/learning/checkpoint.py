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

from ethbrake_marl.engine.snapshot import Arrays
from ethbrake_marl.errors import CorruptBundle, EthBrakeError
from ethbrake_marl.files.arrays import map_npy, safetensors_headers
from ethbrake_marl.files.durable import new_folder, remove_folder, write_file
from ethbrake_marl.files.plain import open_plain, read_plain
from ethbrake_marl.learning.checkpoint_schema import Listing, Numbers, check_json
from ethbrake_marl.learning.run_log import parse_progress
from ethbrake_marl.policies.team import Trained, read_trained, save_trained

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
_HELD_LIMITS_BYTES = {_NUMBERS: 256 << 20, _ARRAYS: 1 << 30, _TABLE: 256 << 20}  # of what is read as a whole
_SIZE_LIMIT_BYTES = 1 << 36  # of any other file: a replay memory of ten million decisions
_DTYPES = {"BOOL", "F32", "F64", "I32", "I64", "U8", "U32", "U64"}


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
    listing, data = _check_files(folder)
    try:
        place = folder / _NUMBERS
        numbers = check_json(Numbers, data[_NUMBERS])
        place = folder / _ARRAYS
        arrays = _arrays(data[_ARRAYS])
        replay = {}
        for place in sorted(folder.glob(f"{_MEMORY}-*.npy")):
            with open_plain(place, _SIZE_LIMIT_BYTES, refusal=CorruptBundle, follow_links=False) as stream:
                replay[place.stem.removeprefix(f"{_MEMORY}-")] = map_npy(stream, place.stem)
        place = folder / _TABLE
        parse_progress(data[_TABLE])
        place = folder / _POLICY
        return TrainingState(
            steps=listing["steps"],
            updates=listing["updates"],
            numbers=numbers,
            arrays=arrays,
            replay=replay,
            policy=read_trained(folder / _POLICY),
            best=read_trained(folder / _BEST) if (folder / _BEST).is_dir() else None,
            table=data[_TABLE],
            versions=listing["versions"],
        )
    except EthBrakeError as error:
        raise CorruptBundle(f"{folder}: {error}") from None
    except KeyError as error:
        raise CorruptBundle(f"{folder / error.args[0]}: is missing") from None
    except (ValueError, SafetensorError) as error:
        raise CorruptBundle(f"{place}: {error}") from None


def _arrays(data: bytes) -> Arrays:
    for name, header in safetensors_headers(data).items():
        if header.dtype not in _DTYPES:
            raise ValueError(f"array {name!r} is {header.dtype}; must be one of {', '.join(sorted(_DTYPES))}")
    return dict(safetensors.numpy.load(data))


def checkpoint_folders(folder: Path) -> list[Path]:
    """Checkpoints in ``folder``, the newest first; whether they are whole is not known yet."""
    return sorted((path for path in folder.glob("step_*") if _is_folder(path)), reverse=True)


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


def _check_files(folder: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The listing, and the content of the files beside it; every file is there, and is what the listing says."""
    path = folder / LISTING
    try:
        listing = check_json(Listing, _read(path, _LISTING_LIMIT_BYTES))
        found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if not _is_folder(path)}
    except OSError as error:
        raise CorruptBundle(f"{folder}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        if isinstance(error, CorruptBundle):
            raise
        raise CorruptBundle(f"{path}: is damaged ({error})") from None
    files = listing["files"]
    if found.keys() != files.keys() | {LISTING}:
        different = sorted(found.keys() ^ (files.keys() | {LISTING}))[0]
        raise CorruptBundle(f"{folder / different}: is {'extra' if different in found else 'missing'}")
    data = {}
    for name, entry in files.items():
        digest, size = hashlib.sha256(), 0
        if name in _HELD_LIMITS_BYTES:
            data[name] = _read(found[name], _HELD_LIMITS_BYTES[name])
            digest, size = hashlib.sha256(data[name]), len(data[name])
        else:
            with open_plain(found[name], _SIZE_LIMIT_BYTES, refusal=CorruptBundle, follow_links=False) as stream:
                digest, size = hashlib.file_digest(stream, "sha256"), stream.tell()
        if (size, digest.hexdigest()) != (entry["bytes"], entry["sha256"]):
            raise CorruptBundle(f"{found[name]}: is not the file that was written (size or SHA-256 differ)")
    return listing, data


def _read(path: Path, limit_bytes: int) -> bytes:
    return read_plain(path, limit_bytes, refusal=CorruptBundle, follow_links=False)


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


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
