"""Sharded evaluations: shards in processes, what is finished in a folder, and the merged tally."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import reduce
from itertools import pairwise
from operator import add
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import InvalidInput, OnProgress, Progress, check_whole_number, count_of
from ethbrake_marl.evaluation.shards import BLOCK, Asked, Tally, answer_shard, shard_bounds
from ethbrake_marl.studies.jobs import Job, JobFolder, Workers, each, run_jobs

MOST_JOBS = 256

Bounds = tuple[int, int]  # first world of a shard, and its end


def evaluate_shards(
    asked: Asked,
    *,
    shards: int,
    jobs: int = 1,
    workers: Workers | None = None,
    folder: Path | None = None,
    with_rows: bool = False,
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
        with_rows: a file with one row per world and agent is kept in the folder for each shard.
        block: worlds advanced together, a multiple of 1,000.
        tell: is told the worlds done so far.

    Raises what ``answer_shard`` and ``JobFolder.work`` raise, ``WorkerLost`` where a shard was lost again and again.

    """
    check_whole_number("jobs", jobs, 1, MOST_JOBS)
    done: dict[Bounds, Tally] = {}
    run, note = run_jobs, ""
    with ExitStack() as stack:
        if folder is not None:
            kept = JobFolder(folder, "shards", {**asked.identity, "rows": with_rows}, beside=())
            stack.enter_context(kept.work())
            done, note = _finished(kept, with_rows)
            run = kept.run
        whole, worlds = reduce(add, done.values(), Tally()), sum(end - first for first, end in done)

        def say(note: str = "") -> None:
            if tell is not None:
                tell(Progress("worlds", worlds, asked.question.episodes, note=note))

        def take(job: Job, found: dict[str, Any]) -> None:
            nonlocal whole, worlds
            whole += Tally.from_json(found["tally"])
            worlds += found["end"] - found["first"]
            say()

        say(note)
        left = [
            Job(
                name := f"{first:013d}-{end:013d}",
                _answer,
                (asked, first, end, _rows_file(folder, with_rows, name), block),
            )
            for first, end in _missing(shard_bounds(asked.question.episodes, shards), done)
        ]
        if not run(left, workers or (jobs if len(left) > 1 else 1), each(take)):
            raise KeyboardInterrupt
        return whole


def _rows_file(folder: Path | None, with_rows: bool, name: str) -> Path | None:
    return None if folder is None or not with_rows else folder.absolute() / f"worlds-{name}.parquet"


def _answer(asked: Asked, first: int, end: int, rows: Path | None, block: int) -> dict[str, Any]:
    tally = answer_shard(asked, first, end, rows, block)
    size = None if rows is None else rows.stat().st_size
    return {"first": first, "end": end, "rows_bytes": size, "tally": tally.to_json()}


def _finished(folder: JobFolder, with_rows: bool) -> tuple[dict[Bounds, Tally], str]:
    """Every finished shard with its rows, and a word on those that are damaged; rows of other shards are deleted.

    Raises ``InvalidInput`` where two shards overlap.
    """
    found, damaged = folder.kept()
    done: dict[Bounds, Tally] = {}
    files = {file.stem.removeprefix("worlds-"): file for file in folder.path.glob("worlds-*.parquet")}
    for name, told in found.items():
        if with_rows and (name not in files or files[name].stat().st_size != told["rows_bytes"]):
            damaged += 1
            continue
        done[told["first"], told["end"]] = Tally.from_json(told["tally"])
        files.pop(name, None)
    for file in files.values():
        file.unlink()
    if any(one[1] > other[0] for one, other in pairwise(sorted(done))):
        raise InvalidInput(f"{folder.path}: two of its shards overlap; give another folder")
    return done, f"{count_of(damaged, 'finished shard')} damaged: driven again" if damaged else ""


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
