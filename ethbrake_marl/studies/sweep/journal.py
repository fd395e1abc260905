"""The journal of a sweep: a line for every attempt that has ended, with what it found and when.

What a job finds stands in its run's folder. The journal saves reading all of them when the sweep goes on, and holds
what must not be in the table: times, attempts and where a job ran. A line that is missing or damaged costs a look at
one folder, and no result.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ethbrake_marl.errors import describe_error, one_line
from ethbrake_marl.files.plain import parse_strict_json
from ethbrake_marl.studies.jobs.run import Attempt
from ethbrake_marl.studies.sweep.job import RESULTS
from ethbrake_marl.studies.sweep.plan import Row

JOURNAL = "journal.jsonl"
_LAST_LINES, _TAIL_BYTES = 10, 8192  # of what a failed job printed

Results = dict[str, tuple[str, ...]]  # hash -> values of ``RESULTS``


@dataclass(frozen=True, slots=True)
class Failure:
    """A job that has failed for good."""

    row: Row
    attempts: int
    reason: str
    last_lines: str


def read_journal(folder: Path) -> tuple[Results, int]:
    """What the finished jobs of a sweep found, and how many lines are damaged (a writer that was killed leaves one)."""
    found: Results = {}
    damaged = 0
    if not (folder / JOURNAL).is_file():
        return found, damaged
    with (folder / JOURNAL).open("rb") as file:
        for line in file:
            try:
                entry = parse_strict_json(line)
                if entry["status"] == "finished":
                    found[entry["hash"]] = _checked(entry["results"])
            except (ValueError, TypeError, KeyError):
                damaged += 1
    return found, damaged


def _checked(results: Mapping[str, Any]) -> tuple[str, ...]:
    values = tuple(results[name] for name in RESULTS)
    if not all(isinstance(value, str) for value in values):
        raise ValueError("results must be text")
    return values


class Journal:
    """Writes the journal, line by line; a line is on its way to the disk when ``note`` returns."""

    def __init__(self, folder: Path) -> None:
        path = folder / JOURNAL
        torn = _ends_in_a_line(path)
        self._file = path.open("a", encoding="utf-8")
        if torn:
            self._write("\n")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()

    def note(self, row: Row, attempt: Attempt) -> None:
        """Write down one attempt."""
        answer = attempt.answer
        told: dict[str, Any] = {"results": dict(zip(RESULTS, answer.value or (), strict=False))}
        if answer.value is None:
            told = {"reason": reason_of(attempt)}
        status = "finished" if answer.value is not None else "failed" if attempt.last else "again"
        entry = {
            "hash": row.identity,
            "job": row.name,
            "status": status,
            "attempt": attempt.attempt,
            "ended_utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "wall_s": round(answer.wall_s, 3),
            "where": answer.where,
            **told,
        }
        self._write(json.dumps(entry) + "\n")

    def _write(self, text: str) -> None:
        self._file.write(text)
        self._file.flush()


def _ends_in_a_line(path: Path) -> bool:
    """Whether the last line was not written to its end."""
    if not path.is_file() or not path.stat().st_size:
        return False
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read() != b"\n"


def reason_of(attempt: Attempt) -> str:
    """Why an attempt found nothing, in one line."""
    error = attempt.answer.error
    return one_line("was stopped from outside" if error is None else describe_error(error))


def last_lines(log: Path) -> str:
    """The end of what a job printed."""
    if not log.is_file():
        return ""
    with log.open("rb") as file:
        file.seek(max(log.stat().st_size - _TAIL_BYTES, 0))
        return "\n".join(file.read().decode("utf-8", "replace").splitlines()[-_LAST_LINES:])
