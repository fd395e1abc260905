"""Sharded evaluations: shards in processes, what is finished in a folder, and the merged tally."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.process import BaseProcess
from operator import add
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ethbrake_marl.errors import AlreadyExists, InvalidInput, check_whole_number
from ethbrake_marl.evaluation.shards.question import BLOCK, LEAF, Asked, answer_shard, shard_bounds
from ethbrake_marl.evaluation.shards.tally import Tally
from ethbrake_marl.files.durable import remove_unfinished, write_file
from ethbrake_marl.files.plain import parse_strict_json, read_plain
from ethbrake_marl.files.plugins import Plugin, load_the_same, loaded_plugins
from ethbrake_marl.progress import OnProgress, Progress

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

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep others out of the folder while the block runs; raises ``InvalidInput`` where one is in it."""
        self.path.mkdir(parents=True, exist_ok=True)
        try:
            with FileLock(self.path / _LOCK, timeout=0):
                yield
        except Timeout:
            raise InvalidInput(f"{self.path}: another evaluation works in it; wait for it, or end it") from None

    def rows_of(self, bounds: Bounds) -> Path | None:
        """The file with the rows of a shard; None where none are kept."""
        return self.path / f"worlds-{_name(bounds)}.parquet" if self.with_rows else None

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
    folder: ShardFolder | None = None,
    block: int = BLOCK,
    tell: OnProgress | None = None,
) -> Tally:
    """The merged tally of all worlds of a list; the same bits whatever ``shards``, ``jobs`` and ``block`` are.

    Args:
        asked: the question.
        shards: parts of the list; finished ones are kept.
        jobs: processes; 1: this one.
        folder: keeps finished shards, and those that it has are not driven again, whatever ``shards`` was then.
        block: worlds advanced together, a multiple of 1,000.
        tell: is told the worlds done so far.

    Raises what ``answer_shard`` and ``ShardFolder`` raise.

    """
    check_whole_number("jobs", jobs, 1, MOST_JOBS)
    if folder is None:
        return _merge(asked, {}, shards, jobs, None, block, tell)
    with folder.alone():
        folder.prepare()
        folder.clear()
        return _merge(asked, folder.finished(), shards, jobs, folder, block, tell)


def _merge(
    asked: Asked,
    done: dict[Bounds, Tally],
    shards: int,
    jobs: int,
    folder: ShardFolder | None,
    block: int,
    tell: OnProgress | None,
) -> Tally:
    episodes = asked.question.episodes
    worlds = sum(end - first for first, end in done)
    whole = reduce(add, done.values(), Tally())

    def say() -> None:
        if tell is not None:
            tell(Progress("worlds", worlds, episodes))

    say()
    tasks = [
        (asked, first, end, None if folder is None else folder.rows_of((first, end)), block)
        for first, end in _missing(shard_bounds(episodes, shards), done)
    ]
    for bounds, tally in _answers(tasks, jobs):
        if folder is not None:
            folder.keep(bounds, tally)
        whole += tally
        worlds += bounds[1] - bounds[0]
        say()
    return whole


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


def _answer(task: _Task) -> tuple[Bounds, Tally]:
    return (task[1], task[2]), answer_shard(*task)


def _answers(tasks: Sequence[_Task], jobs: int) -> Iterator[tuple[Bounds, Tally]]:
    """The tallies as they are finished; what is worked on is dropped when one fails, or on Ctrl-C."""
    if jobs == 1 or len(tasks) < 2:
        yield from map(_answer, tasks)
        return
    plugins, spawn = loaded_plugins(), get_context("spawn")
    load_the_same(plugins)  # a file that was changed since is told here, in one line
    workers = min(jobs, len(tasks))
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=_begin_worker, initargs=(plugins,)) as pool:
        try:
            for future in as_completed([pool.submit(_answer, task) for task in tasks]):
                yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in active_children():
                worker.terminate()
            raise


def _begin_worker(plugins: Sequence[Plugin]) -> None:
    """Leave Ctrl-C to the parent, end with the parent however that ends, load its plug-ins."""
    os.setpgrp()
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    load_the_same(plugins)


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


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
