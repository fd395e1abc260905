"""Results in files: ``results.json`` with one object per team, and a table with one row per team and world."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import HARM
from ethbrake_marl.errors import InvalidInput, naming_extras
from ethbrake_marl.evaluation.evaluate import Columns, Result
from ethbrake_marl.evaluation.summary import SummaryTable
from ethbrake_marl.files.plain import parse_strict_json, read_plain
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.files.store import check_target, write_output

RESULTS, WORLDS = "results.json", "worlds"  # names of files in the folder of an evaluation
HARMS = tuple(HARM.values())
PAIRED = {"agent": np.str_, "world": np.int64, "recording": np.str_} | dict.fromkeys(HARMS, np.float64)
MOST_BYTES, MOST_ROWS_BYTES = 64 << 20, 4 << 30

Rows = Literal["csv", "parquet"]


class Saved(NamedTuple):
    """Content of ``results.json`` and of its table."""

    path: Path
    agents: Mapping[str, Mapping[str, Any]]  # team -> its object
    rows: Columns | None  # what ``compare`` needs of the table with one row per team and world: column -> values
    no_rows_because: str  # "" if there are rows

    @property
    def about(self) -> Mapping[str, Any]:
        """Entries that are the same for all teams."""
        return next(iter(self.agents.values()))

    def estimate(self, agent: str, key: str) -> Estimate:
        own = self.agents[agent]
        ends = own[f"{key}_interval"]
        return Estimate(own[key], ends and (ends[0], ends[1]), own[f"{key}_error"], own[f"{key}_freedom"])


def write_results(
    folder: str | Path,
    table: SummaryTable,
    result: Result | None = None,
    rows: Rows | None = None,
    *,
    name: str = RESULTS,
    force: bool = False,
) -> list[Path]:
    """Write ``FOLDER/results.json`` and, with ``rows``, ``FOLDER/worlds.csv`` or ``.parquet``; return their paths.

    ``name`` is another name for the first file. Raises ``AlreadyExists`` if a file exists, unless ``force``, and
    ``MissingExtra`` for Parquet without pyarrow.
    """
    target, objects = Path(folder).expanduser(), table.to_json()
    written = [check_target(target / name, force=force)]
    if result is not None and rows is not None:
        file = target / f"{WORLDS}.{rows}"
        write_rows(file, result, force=force)
        beside = {"file": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
        objects = [{**each, "per_world": beside} for each in objects]
        written.append(file)
    digest = _digest(objects)
    text = json.dumps([{**each, "results_sha256": digest} for each in objects], indent=2, allow_nan=False)
    write_output(written[0], f"{text}\n".encode(), force=force)
    return written


def write_rows(path: str | Path, result: Result, *, force: bool = False) -> None:
    """Write one row per team and world as CSV or Parquet, depending on the ending of ``path``.

    Truth values are 1 and 0, missing values are empty. Raises the errors of ``write_results``.
    """
    path, table = Path(path).expanduser(), result.arrays()
    plain = {name: each.astype(np.int64) if each.dtype == np.bool_ else each for name, each in table.items()}
    stream: Any
    if path.suffix.lower() == ".parquet":
        with naming_extras():
            import pyarrow
            from pyarrow.parquet import write_table
        stream = io.BytesIO()
        write_table(
            pyarrow.table({name: pyarrow.array(each, from_pandas=True) for name, each in plain.items()}), stream
        )
        data = stream.getvalue()
    elif path.suffix.lower() == ".csv":
        stream = io.StringIO(newline="")
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(plain)
        columns = [["" if value != value else value for value in each.tolist()] for each in plain.values()]
        writer.writerows(zip(*columns, strict=True))
        data = stream.getvalue().encode()
    else:
        raise InvalidInput(f"{path}: the name of the file must end in .csv or .parquet")
    write_output(path, data, force=force)


def read_result(path: str | Path) -> Saved:
    """Read ``results.json``, and its table if there is one.

    Raises ``InvalidInput`` for any other file, and for one that was edited or damaged.
    """
    file = Path(path).expanduser()
    data = read_plain(file, MOST_BYTES)
    try:
        content = parse_strict_json(data)
    except ValueError as error:
        raise InvalidInput(f"{file}: must contain complete JSON: {error}") from None
    objects = content if isinstance(content, list) else [content]
    if not objects or not all(isinstance(each, dict) and each.get("kind") == "evaluate" for each in objects):
        raise InvalidInput(f"{file}: is not a results file; give {RESULTS} of ethbrake evaluate --output")
    plain = [{key: value for key, value in each.items() if key != "results_sha256"} for each in objects]
    if {each.get("results_sha256") for each in objects} != {_digest(plain)}:
        raise InvalidInput(f"{file}: was edited after it was written, or is of another version; evaluate again")
    rows, because = _beside(file, plain[0].get("per_world"))
    return Saved(file, {each["agent"]: each for each in plain}, rows, because)


def _digest(objects: Sequence[Mapping[str, Any]]) -> str:
    return hashlib.sha256(json.dumps(objects, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _beside(file: Path, beside: Mapping[str, str] | None) -> tuple[Columns | None, str]:
    if beside is None:
        return None, f"{file} was written without a file that has one row per world; evaluate again with --per-world"
    rows = file.parent / beside["file"]
    if not rows.is_file():
        return None, f"{rows}, the file with one row per world of {file}, does not exist"
    data = read_plain(rows, MOST_ROWS_BYTES)
    if hashlib.sha256(data).hexdigest() != beside["sha256"]:
        return None, f"{rows} was changed after {file} was written; evaluate again"
    table: Mapping[str, Sequence[Any]]
    if rows.suffix == ".parquet":
        with naming_extras():
            from pyarrow.parquet import read_table
        table = read_table(io.BytesIO(data)).to_pydict()
    else:
        heads, *lines = csv.reader(io.StringIO(data.decode(), newline=""))
        table = dict(zip(heads, zip(*lines, strict=True), strict=True))
    return {name: np.array(table[name], kind) for name, kind in PAIRED.items() if name in table}, ""
