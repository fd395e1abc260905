"""Results in files: ``results.json`` with one object per team, and a table with one row per team and world."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.summary import SummaryTable
from ethbrake_marl.files.plain import parse_strict_json, read_plain
from ethbrake_marl.files.store import check_target, write_output

RESULTS, WORLDS = "results.json", "worlds"  # names of files in the folder of an evaluation
MOST_BYTES = 64 << 20


def write_results(
    folder: str | Path,
    table: SummaryTable,
    result: Result | None = None,
    rows: Literal["csv"] | None = None,
    *,
    name: str = RESULTS,
    force: bool = False,
) -> list[Path]:
    """Write ``FOLDER/NAME`` and, with ``rows``, ``FOLDER/worlds.csv``; return their paths.

    Raises ``AlreadyExists`` if a file exists, unless ``force``.
    """
    target, objects = Path(folder).expanduser(), table.to_json()
    written = [check_target(target / name, force=force)]
    if result is not None and rows is not None:
        file = target / f"{WORLDS}.{rows}"
        write_rows(file, result, force=force)
        beside = {"file": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
        objects = [{**entry, "per_world": beside} for entry in objects]
        written.append(file)
    digest = _digest(objects)
    text = json.dumps([{**entry, "results_sha256": digest} for entry in objects], indent=2, allow_nan=False)
    write_output(written[0], f"{text}\n".encode(), force=force)
    return written


def write_rows(path: str | Path, result: Result, *, force: bool = False) -> None:
    """Write one row per team and world as CSV; truth values are 1 and 0, missing values empty."""
    path, table, stream = Path(path).expanduser(), result.arrays(), io.StringIO(newline="")
    if path.suffix.lower() != ".csv":
        raise InvalidInput(f"{path}: the name of the file must end in .csv")
    plain = {name: column.astype(np.int64) if column.dtype == np.bool_ else column for name, column in table.items()}
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(plain)
    columns = [["" if value != value else value for value in column.tolist()] for column in plain.values()]
    writer.writerows(zip(*columns, strict=True))
    write_output(path, stream.getvalue().encode(), force=force)


def read_result(path: str | Path) -> dict[str, dict[str, Any]]:
    """Content of a ``results.json``, team -> object. Raises ``InvalidInput`` for one that was edited, and for other
    files.
    """
    file = Path(path).expanduser()
    data = read_plain(file, MOST_BYTES)
    try:
        content = parse_strict_json(data)
    except ValueError as error:
        raise InvalidInput(f"{file}: must contain complete JSON: {error}") from None
    objects = content if isinstance(content, list) else [content]
    if not objects or not all(isinstance(entry, dict) and entry.get("kind") == "evaluate" for entry in objects):
        raise InvalidInput(f"{file}: is not a results file; give {RESULTS} of ethbrake evaluate --output")
    plain = [{key: value for key, value in entry.items() if key != "results_sha256"} for entry in objects]
    if {entry.get("results_sha256") for entry in objects} != {_digest(plain)}:
        raise InvalidInput(f"{file}: was edited after it was written, or is of another version; evaluate again")
    return {entry["agent"]: entry for entry in plain}


def _digest(objects: Sequence[Mapping[str, Any]]) -> str:
    return hashlib.sha256(json.dumps(objects, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
