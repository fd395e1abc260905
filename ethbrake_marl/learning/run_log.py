"""The logs of a run while it learns: ``progress.csv`` and TensorBoard's event files.

``progress.csv`` has one row per update, its columns in an order that is the same in every run.
"""

from __future__ import annotations

import csv
import io
import os
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import KVWriter, filter_excluded_keys
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from ethbrake_marl.files.durable import write_file


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
