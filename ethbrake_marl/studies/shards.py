"""Sharded evaluations: shards in processes, what is finished in a folder, and the merged tally."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from operator import add
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import AlreadyExists, InvalidInput, OnProgress, Progress, check_whole_number
from ethbrake_marl.evaluation.shards import BLOCK, LEAF, Asked, Tally, answer_shard, shard_bounds
from ethbrake_marl.files.store import hold_lock, parse_strict_json, read_plain, remove_unfinished, write_file
from ethbrake_marl.studies.jobs import Attempt, LocalWorkers, Workers, pack, run_jobs

MOST_JOBS = 256
_LIMIT_BYTES = 64 << 20  # of the file of a shard: worlds that were left out are named there
_QUESTION, _LOCK = "question.json", ".lock"

Bounds = tuple[int, int]  # first world of a shard, and its end


@dataclass(frozen=True, slots=True)
class ShardFolder:
    """The finished shards of one question.

    Args:
        path: the folder.
        asked: the question that it answers.
        with_rows: one row per world and agent is kept beside each tally.

    """

    path: Path
    asked: Asked
    with_rows: bool = False

    def prepare(self) -> None:
        """Make the folder, or find it as one that answers this question; raises ``InvalidInput`` for another one."""
        told = {**self.asked.identity, "rows": self.with_rows}
        file = self.path / _QUESTION
        if file.is_file():
            before = _read_json(file)
            other = sorted(key for key in {*told, *before} if before.get(key) != told.get(key))
            if other:
                raise InvalidInput(
                    f"{self.path}: answers another question ({', '.join(other)} differ): give another folder, or the"
                    " same options and versions"
                )
            return
        self.path.mkdir(parents=True, exist_ok=True)
        if any(each.name != _LOCK for each in self.path.iterdir()):
            raise AlreadyExists(f"{self.path}: is there already, and no folder of shards; give another name")
        write_file(file, _to_bytes(told))

    def alone(self) -> AbstractContextManager[None]:
        """Keep others out of the folder while the block runs; raises ``InvalidInput`` where one is in it."""
        self.path.mkdir(parents=True, exist_ok=True)
        return hold_lock(self.path / _LOCK, "another evaluation works in it; wait for it, or end it")

    def rows_of(self, bounds: Bounds) -> Path | None:
        """The file with the rows of a shard; None where none are kept."""
        return self.path.absolute() / f"worlds-{_name(bounds)}.parquet" if self.with_rows else None

    def keep(self, bounds: Bounds, tally: Tally) -> None:
        """Write the file of a finished shard, in one step."""
        told = tally.to_json()
        rows = self.rows_of(bounds)
        content = {
            "asked": self.asked.sha256,
            "first": bounds[0],
            "end": bounds[1],
            "sha256": hashlib.sha256(_to_bytes(told)).hexdigest(),
            "rows": None if rows is None else {"file": rows.name, "bytes": rows.stat().st_size},
            "tally": told,
        }
        write_file(self.path / f"shard-{_name(bounds)}.json", _to_bytes(content))

    def clear(self) -> None:
        """Delete what shards that were killed left; nobody else may be in the folder."""
        remove_unfinished(self.path)
        for file in self.path.glob("worlds-*.parquet"):
            if not (self.path / f"shard-{file.stem.removeprefix('worlds-')}.json").is_file():
                file.unlink()

    def finished(self) -> dict[Bounds, Tally]:
        """Every finished shard; raises ``InvalidInput`` naming a file that is damaged or does not belong here."""
        found: dict[Bounds, Tally] = {}
        for file in sorted(self.path.glob("shard-*.json")):
            bounds, tally = self._read(file)
            found[bounds] = tally
        ends = sorted(found)
        if any(one[1] > other[0] for one, other in pairwise(ends)):
            raise InvalidInput(f"{self.path}: two of its shards overlap; give another folder")
        return found

    def _read(self, file: Path) -> tuple[Bounds, Tally]:
        told = _read_json(file)
        bounds = told.get("first"), told.get("end")
        if told.get("sha256") != hashlib.sha256(_to_bytes(told.get("tally"))).hexdigest():
            raise InvalidInput(f"{file}: is damaged; delete it, and its worlds are driven again")
        first, end = (each if type(each) is int else -1 for each in bounds)
        episodes = self.asked.question.episodes
        whole = 0 <= first < end <= episodes and first % LEAF == 0 and (end % LEAF == 0 or end == episodes)
        if told.get("asked") != self.asked.sha256 or not whole or file.name != f"shard-{_name((first, end))}.json":
            raise InvalidInput(f"{file}: answers another question; delete it, or give another folder")
        rows = self.rows_of((first, end))
        if rows is not None and (not rows.is_file() or rows.stat().st_size != (told.get("rows") or {}).get("bytes")):
            raise InvalidInput(f"{rows}: is not the one that was written with {file.name}; delete both")
        tally = Tally.from_json(told["tally"])
        if tally.worlds + len(tally.left_out) != end - first or (
            tally.worlds and set(tally.agents) != set(self.asked.identity["agents"])
        ):
            raise InvalidInput(f"{file}: does not count its worlds; delete it, and they are driven again")
        return (first, end), tally


def evaluate_shards(
    asked: Asked,
    *,
    shards: int,
    jobs: int = 1,
    workers: Workers | None = None,
    folder: ShardFolder | None = None,
    block: int = BLOCK,
    tell: OnProgress | None = None,
) -> Tally:
    """The merged tally of all worlds of a list; the same bits whatever ``shards``, ``jobs`` and ``block`` are.

    Args:
        asked: the question.
        shards: parts of the list; finished ones are kept.
        jobs: processes; 1: this one.
        workers: where shards are answered, of a cluster for instance, in place of ``jobs``; not closed here.
        folder: keeps finished shards, and those that it has are not driven again, whatever ``shards`` was then.
        block: worlds advanced together, a multiple of 1,000.
        tell: is told the worlds done so far.

    Raises what ``answer_shard`` and ``ShardFolder`` raise, ``WorkerLost`` where a shard was lost again and again.

    """
    check_whole_number("jobs", jobs, 1, MOST_JOBS)
    with ExitStack() as stack:
        done: dict[Bounds, Tally] = {}
        if folder is not None:
            stack.enter_context(folder.alone())
            folder.prepare()
            folder.clear()
            done = folder.finished()
        work = _Merging(asked, done, folder, tell)
        left = _missing(shard_bounds(asked.question.episodes, shards), done)
        tasks = [(asked, *bounds, None if folder is None else folder.rows_of(bounds), block) for bounds in left]
        if workers is None and jobs > 1 and len(tasks) > 1:
            workers = stack.enter_context(closing(LocalWorkers(min(jobs, len(tasks)))))
        if workers is not None:
            _answer_all(tasks, workers, work.add)
        else:
            for bounds, task in zip(left, tasks, strict=True):
                work.add(bounds, _answer(task))
        return work.whole


class _Merging:
    """The tally so far, and who is told of it."""

    def __init__(
        self, asked: Asked, done: dict[Bounds, Tally], folder: ShardFolder | None, tell: OnProgress | None
    ) -> None:
        self._episodes, self._folder, self._tell = asked.question.episodes, folder, tell
        self._worlds = sum(end - first for first, end in done)
        self.whole = reduce(add, done.values(), Tally())
        self._say()

    def add(self, bounds: Bounds, tally: Tally) -> None:
        """Take in, and keep, a shard that is finished."""
        if self._folder is not None:
            self._folder.keep(bounds, tally)
        self.whole += tally
        self._worlds += bounds[1] - bounds[0]
        self._say()

    def _say(self) -> None:
        if self._tell is not None:
            self._tell(Progress("worlds", self._worlds, self._episodes))


def _missing(bounds: Sequence[Bounds], done: dict[Bounds, Tally]) -> list[Bounds]:
    """The parts of the shards that no finished one holds."""
    found = []
    for first, end in bounds:
        for have, until in sorted(done):
            if until <= first or have >= end:
                continue
            if have > first:
                found.append((first, have))
            first = until
        if first < end:
            found.append((first, end))
    return found


_Task = tuple[Asked, int, int, Path | None, int]


def _answer(task: _Task) -> Tally:
    return answer_shard(*task)


def _answer_all(tasks: Sequence[_Task], workers: Workers, note: Callable[[Bounds, Tally], None]) -> None:
    """Tell every tally as it is finished; what is worked on is dropped when a shard fails, or on Ctrl-C."""

    def take(attempt: Attempt) -> None:
        if attempt.answer.error is not None and attempt.last:
            raise attempt.answer.error
        if attempt.answer.value is not None:
            _, first, end, *_ = tasks[attempt.number]
            note((first, end), attempt.answer.value)

    if not run_jobs(lambda number: pack(_answer, tasks[number]), len(tasks), workers, take):
        raise KeyboardInterrupt


def _name(bounds: Bounds) -> str:
    return f"{bounds[0]:013d}-{bounds[1]:013d}"


def _to_bytes(content: Any) -> bytes:
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()


def _read_json(file: Path) -> dict[str, Any]:
    try:
        found = parse_strict_json(read_plain(file, _LIMIT_BYTES, follow_links=False))
    except ValueError as error:
        if isinstance(error, InvalidInput):
            raise
        raise InvalidInput(f"{file}: is no JSON ({error}); delete it") from None
    if not isinstance(found, dict):
        raise InvalidInput(f"{file}: is no object; delete it")
    return found
