"""``progress.csv``: one row per update, columns in an order that is the same in every run."""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from stable_baselines3.common.logger import KVWriter, filter_excluded_keys
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.durable import new_folder, write_file
from ethbrake_marl.files.json import parse_strict_json
from ethbrake_marl.files.plain import read_plain


class ProgressTable(KVWriter):
    """Writer for Stable-Baselines3's logger; its own CSV writer orders columns by the hash of their names."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows: list[dict[str, Any]] = []
        self._columns: list[str] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Add a row; when a column is new the table is written again, in one step, with that column."""
        values = {"steps": step} | filter_excluded_keys(key_values, key_excluded, "csv")
        row = {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
        self._rows.append(row)
        if row.keys() <= set(self._columns):
            with self._path.open("a", newline="", encoding="utf-8") as file:
                file.write(_lines([row], self._columns))
            return
        self._columns = ["steps", *sorted({name for row in self._rows for name in row} - {"steps"})]
        heading = _lines([dict(zip(self._columns, self._columns, strict=True))], self._columns)
        write_file(self._path, (heading + _lines(self._rows, self._columns)).encode())

    def content(self) -> bytes:
        """The file as it is; empty before the first row."""
        return self._path.read_bytes() if self._rows else b""

    def restore(self, content: bytes) -> None:
        """Go back to an earlier ``content``, in the file too."""
        self._columns, self._rows = parse_progress(content)
        write_file(self._path, content)

    def close(self) -> None:
        """Nothing is held open between rows."""


def parse_progress(content: bytes) -> tuple[list[str], list[dict[str, Any]]]:
    """Columns and rows of a progress table, whose first column is ``steps``; what is empty is not there.

    Raises ``ValueError`` for anything that no ``ProgressTable`` has written.
    """
    try:
        lines = list(csv.reader(io.StringIO(content.decode("utf-8"), newline=""), strict=True))
    except csv.Error as error:
        raise ValueError(f"the progress table is no CSV ({error})") from None
    columns, rows = (lines[0], lines[1:]) if lines else ([], [])
    if columns and (columns[0] != "steps" or len(set(columns)) < len(columns)):
        raise ValueError("the progress table must have the column steps first, and no column twice")
    for number, row in enumerate(rows, start=1):
        if len(row) != len(columns) or not row[0].isdecimal():
            raise ValueError(f"row {number} of the progress table must have {len(columns)} values, the first one steps")
    return columns, [{n: value for n, value in zip(columns, row, strict=True) if value != ""} for row in rows]


def _lines(rows: list[dict[str, Any]], columns: list[str]) -> str:
    text = io.StringIO()
    csv.DictWriter(text, columns, restval="", lineterminator="\n").writerows(rows)
    return text.getvalue()


_PREFIX = "events.out.tfevents."
_VERSION = "brain.Event:2"  # first record of every file


class EventFile(KVWriter):
    """Writer for Stable-Baselines3's logger: a new file of numbers, which TensorBoard reads after all that are there.

    Its name ends in a number of ten digits, one more than the largest in the folder (files of TensorBoard's own writer
    carry their second in that place); the first is 1. Every row is in the file when ``write`` returns.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        found = (re.match(rf"{re.escape(_PREFIX)}(\d{{10}})", path.name) for path in folder.iterdir())
        number = max((int(match[1]) for match in found if match), default=0) + 1
        self._file = (folder / f"{_PREFIX}{number:010d}").open("xb")
        self._records = RecordWriter(self._file)
        self._add(Event(wall_time=time.time(), file_version=_VERSION))

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Add one row of numbers."""
        row = filter_excluded_keys(key_values, key_excluded, "tensorboard")
        values = [Summary.Value(tag=name, simple_value=float(row[name])) for name in sorted(row)]
        self._add(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _add(self, event: Any) -> None:
        self._records.write(event.SerializeToString())
        self._file.flush()


def event_sizes(folder: Path) -> dict[str, int]:
    """Name -> bytes of the event files."""
    return {path.name: path.stat().st_size for path in sorted(folder.iterdir())} if folder.is_dir() else {}


def cut_back(folder: Path, sizes: Mapping[str, int]) -> None:
    """Drop what was written after ``event_sizes`` gave ``sizes``: later records, and later files.

    Only plain files are cut; links and pipes in their place go, folders stay.
    """
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            continue  # nothing that a training wrote
        if path.name not in sizes or path.is_symlink() or not path.is_file():
            path.unlink()  # of a link the link alone
        elif path.stat().st_size > sizes[path.name]:
            os.truncate(path, sizes[path.name])


_LIMIT_BYTES = 16 << 20  # of a JSON file

RunStatus = Literal["running", "finished", "interrupted", "failed"]


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """Names inside a run's folder."""

    path: Path

    @property
    def config(self) -> Path:
        """What was asked for: recipe, scenario, seeds, versions."""
        return self.path / "config.json"

    @property
    def status(self) -> Path:
        """How far it came: ``running``, ``finished``, ``interrupted`` or ``failed``, steps, updates, wall time."""
        return self.path / "run.json"

    @property
    def progress(self) -> Path:
        """One row per update."""
        return self.path / "progress.csv"

    @property
    def tensorboard(self) -> Path:
        """The same numbers as TensorBoard events."""
        return self.path / "tensorboard"

    @property
    def policy(self) -> Path:
        """The bundle to use: the policy of least harm on the fixed list, or the last where no harm is measured."""
        return self.path / "policy"

    @property
    def last_policy(self) -> Path:
        """The bundle at the end of the run."""
        return self.path / "policy-last"

    @property
    def team(self) -> Path:
        """Which bundle drives which vehicle."""
        return self.path / "team.json"

    @property
    def checkpoints(self) -> Path:
        """Where the training can go on; empty once it has finished."""
        return self.path / "checkpoints"

    def checkpoint(self, steps: int) -> Path:
        """The checkpoint after ``steps`` decisions."""
        return self.checkpoints / f"step_{steps:012d}"

    def write_json(self, file: Path, content: Mapping[str, Any]) -> None:
        """Replace ``file`` in one step."""
        write_file(file, json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")


class RunRecord:
    """Keeps ``run.json``: ``running`` from the moment it is made, something else from ``end`` on."""

    def __init__(self, run: RunDirectory) -> None:
        self._run = run
        self._started = read_object(run.status).get("started_utc") or _now()
        write_status(run, "running", {"started_utc": self._started})

    def end(self, status: RunStatus, reason: str | None, left: Mapping[str, Any]) -> None:
        """Say how the run ended, why if it failed, and what it leaves."""
        policy = self._run.policy.name if self._run.policy.is_dir() else None
        left_over = () if status == "finished" else self._run.checkpoints.glob("step_*")
        checkpoints = sorted(path.name for path in left_over)
        more = {"ended_utc": _now(), "reason": reason, **left, "policy": policy, "checkpoints": checkpoints}
        write_status(self._run, status, {"started_utc": self._started, **more})


def write_status(run: RunDirectory, status: RunStatus, more: Mapping[str, Any]) -> None:
    """Replace ``run.json``."""
    run.write_json(run.status, {"format": "ethbrake-run", "format_version": 1, "status": status, **more})


def read_object(file: Path) -> dict[str, Any]:
    """The JSON object in a file of a run; raises ``InvalidInput`` naming the file and what is wrong with it."""
    if not os.path.lexists(file):
        raise InvalidInput(f"{file}: is missing; without it this training cannot go on")
    data = read_plain(file, _LIMIT_BYTES)
    try:
        content = parse_strict_json(data)
    except ValueError as error:
        raise InvalidInput(f"{file}: is damaged: {error}") from None
    if not isinstance(content, dict):
        raise InvalidInput(f"{file}: is damaged: holds no JSON object")
    return content


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def create_run(
    path: Path, config: Mapping[str, Any], *, team: Mapping[str, Any] | None = None, force: bool = False
) -> RunDirectory:
    """Make the folder of a run with its configuration and its record, in one step: it can be resumed from then on.

    ``team`` is the content of ``team.json``. Raises ``AlreadyExists`` when there is something; with ``force`` an
    earlier run (a folder with a ``run.json``) or an empty folder is replaced, and anything else is still refused.
    """
    run = RunDirectory(path)
    replace = force and path.is_dir() and not path.is_symlink() and (run.status.is_file() or not any(path.iterdir()))
    if not replace and (path.exists() or path.is_symlink()):
        if not run.status.is_file():
            raise AlreadyExists(f"{path}: is there already, and is no run; give another name")
        raise AlreadyExists(
            f"{path}: is there already; give another name (--name), go on with it (ethbrake resume), or replace it with"
            " force (--force; make run ARGS=--force)"
        )
    with new_folder(path, replace=replace) as partial:
        new = RunDirectory(partial)
        new.write_json(new.config, config)
        if team is not None:
            new.write_json(new.team, team)
        write_status(new, "running", {"started_utc": _now()})
    return run


def open_run(path: Path) -> tuple[RunDirectory, dict[str, Any]]:
    """The run in ``path`` and its configuration.

    Raises ``InvalidInput`` when there is none, or naming the file of it that is damaged.
    """
    run = RunDirectory(path)
    if not (os.path.lexists(run.status) or os.path.lexists(run.config)):
        raise InvalidInput(f"{path}: holds no training; give the folder of a run, for instance runs/my-run")
    for folder in (run.checkpoints, run.tensorboard):
        if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
            raise InvalidInput(f"{folder}: is not a plain folder; a training deletes in it what it no longer needs")
    status, config = read_object(run.status), read_object(run.config)
    for key, right in (("format", ("ethbrake-run",)), ("status", get_args(RunStatus))):
        if status.get(key) not in right:
            raise InvalidInput(f"{run.status}: {key} = {status.get(key)!r:.60}: must be {' or '.join(right)}")
    return run, config


def has_finished(run: RunDirectory) -> bool:
    """Whether the training in an open run has come to its end, though its report may not."""
    status = read_object(run.status)
    resumable = any(run.checkpoints.glob("step_*"))
    return status.get("status") == "finished" or (status.get("stage") is not None and not resumable)


@contextmanager
def only_process(run: RunDirectory) -> Iterator[None]:
    """Hold the run's lock, which ends with the process however it ends.

    Raises ``InvalidInput`` when another process trains in this folder.
    """
    path = run.path / "run.lock"
    try:
        # What stands there is neither emptied nor, where it is a link, followed, and a pipe keeps nobody waiting.
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be used as a lock ({error.strerror}); delete it") from None
    with os.fdopen(lock, "rb+", buffering=0) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InvalidInput(f"{run.path}: another process is training here") from None
        yield
