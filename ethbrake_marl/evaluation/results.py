"""Results in files: ``results.json``, one object per team, and beside it a table with one row per team and world."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.errors import EthBrakeError, InvalidInput, naming_extras
from ethbrake_marl.evaluation.evaluate import Columns, Result
from ethbrake_marl.evaluation.measures import Measure, Values
from ethbrake_marl.evaluation.named_measures import MEASURES
from ethbrake_marl.evaluation.summary import IDENTITY, SummaryTable
from ethbrake_marl.files.plain import parse_strict_json, read_plain
from ethbrake_marl.files.sheet import Estimate, parquet_file
from ethbrake_marl.files.store import check_target, write_output

RESULTS, WORLDS = "results.json", "worlds"  # names of files in the folder of an evaluation
HARMS = ("first_impact_harm", "total_harm")
MOST_BYTES, MOST_ROWS_BYTES = 64 << 20, 4 << 30
LARGEST = 1e100  # of a number in a file; squares of larger ones overflow
TYPES = {"b": np.bool_, "i": np.int64, "u": np.int64, "f": np.float64, "U": np.str_}

Rows = Literal["csv", "parquet", "json"]


class Saved(NamedTuple):
    """Content of ``results.json`` after the checks of ``read_result``."""

    path: Path
    agents: Mapping[str, Mapping[str, Any]]  # team -> its object
    result: Result | None  # of the rows per world
    no_rows_because: str  # "" if there are rows

    @property
    def about(self) -> Mapping[str, Any]:
        """Object of the first team, for what is the same in all."""
        return next(iter(self.agents.values()))

    def estimate(self, agent: str, key: str) -> Estimate:
        """Return a mean with its interval and its standard error."""
        own = self.agents[agent]
        ends = own[f"{key}_interval"]
        return Estimate(own[key], ends and (ends[0], ends[1]), own[f"{key}_error"], own[f"{key}_freedom"])


def write_results(
    folder: str | Path,
    table: SummaryTable,
    result: Result | None = None,
    rows: Rows | None = None,
    *,
    more: Mapping[str, Any] | None = None,
    name: str = RESULTS,
    force: bool = False,
) -> list[Path]:
    """Write ``FOLDER/results.json`` and, with ``rows``, ``FOLDER/worlds.csv`` (``.parquet``, ``.json``); return paths.

    ``name``: other name of the first file. ``more``: plain data that every object gets, such as settings. Raises
    ``AlreadyExists`` if a file exists and ``force`` is false, and ``MissingExtra`` for Parquet without pyarrow.
    """
    target, objects = Path(folder), [{**each, **(more or {})} for each in table.to_json()]
    written = [check_target(target / name, force=force)]
    if result is not None and rows is not None:
        file = check_target(target / f"{WORLDS}.{rows}", force=force)
        write_rows(file, result, force=force)
        beside = {
            "file": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
            "worlds": {name: each.dtype.kind for name, each in result.worlds.items()},
            "columns": {name: each.dtype.kind for own in result.columns.values() for name, each in own.items()},
            "measures": {measure.name: measure.unit for measure in result.measures},
        }  # fmt: skip
        objects = [{**each, "per_world": beside} for each in objects]
        written.append(file)
    digest = _digest(objects)
    text = json.dumps([{**each, "results_sha256": digest} for each in objects], indent=2, allow_nan=False)
    write_output(written[0], f"{text}\n".encode(), force=force)
    return written


def write_rows(path: str | Path, result: Result, *, force: bool = False) -> None:
    """Write one row per team and world as CSV, Parquet or JSON, as the ending of ``path`` says.

    Truth values are 1 and 0, a missing value is empty. Raises the errors of ``write_results``.
    """
    table = {name: each.astype(np.int64) if each.dtype == np.bool_ else each for name, each in result.arrays().items()}
    ending = Path(path).suffix.lower()
    if ending == ".parquet":
        with naming_extras():
            import pyarrow
        with parquet_file(check_target(path, force=force)) as write:
            write({name: pyarrow.array(each, from_pandas=True) for name, each in table.items()})
        return
    plain = {name: [None if value != value else value for value in each.tolist()] for name, each in table.items()}
    if ending == ".json":
        text = json.dumps(plain, allow_nan=False)
    elif ending == ".csv":
        stream = io.StringIO(newline="")
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(plain)
        writer.writerows(zip(*plain.values(), strict=True))
        text = stream.getvalue()
    else:
        raise InvalidInput(f"{path}: the name of the file must end in .csv, .parquet or .json")
    write_output(path, text.encode(), force=force)


def read_result(path: str | Path) -> Saved:
    """Read ``results.json`` and the rows beside it, if there are any.

    Raises ``InvalidInput``, in one line, for another file, and for one that was edited or damaged.
    """
    file = Path(path)
    try:
        content = parse_strict_json(read_plain(file, MOST_BYTES))
    except ValueError as error:
        if isinstance(error, EthBrakeError):
            raise
        raise InvalidInput(f"{file}: must contain complete JSON: {error}") from None
    objects = content if isinstance(content, list) else [content]
    if not objects or not all(isinstance(each, dict) and each.get("kind") == "evaluate" for each in objects):
        raise InvalidInput(f"{file}: is not a results file; give {RESULTS} of ethbrake evaluate --output")
    plain = [{key: value for key, value in each.items() if key != "results_sha256"} for each in objects]
    if {each.get("results_sha256") for each in objects} != {_digest(plain)}:
        raise InvalidInput(f"{file}: was edited after it was written, or is of another version; evaluate again")
    for each in plain:
        _check(file, each)
    agents = {each["agent"]: each for each in plain}
    if len(agents) < len(plain):
        raise InvalidInput(f"{file}: lists an agent twice; evaluate each agent once")
    result, because = _beside(file, agents)
    return Saved(file, agents, result, because)


def _digest(objects: Sequence[Mapping[str, Any]]) -> str:
    return hashlib.sha256(json.dumps(objects, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _check(file: Path, own: Mapping[str, Any]) -> None:
    """Refuse an object whose numbers cannot be those of an evaluation, whoever wrote its digest."""
    kinds = {
        "agent": str, "knows": str, "episodes": int, "collisions": int, "horizon_ends": int, "worlds_sha256": str,
        "policy_sha256": dict, "versions": dict, "parameters": dict, "exploits": list,
    }  # fmt: skip
    for key, kind in kinds.items():
        if type(own.get(key)) is not kind:
            raise InvalidInput(f"{file}: {key} is missing or not of type {kind.__name__}; evaluate again")
    worlds = own["episodes"]
    if not (worlds >= 1 and all(0 <= own[key] <= worlds for key in ("collisions", "horizon_ends"))):
        raise InvalidInput(f"{file}: {own['agent']:.40}: episodes, collisions, horizon_ends must be numbers of worlds")
    for key in HARMS:
        mean, ends, error, freedom = (own.get(f"{key}{end}") for end in ("", "_interval", "_error", "_freedom"))
        numbers = [mean, *(ends if isinstance(ends, list) else ()), *(n for n in (error, freedom) if n is not None)]
        good = all(type(n) in (int, float) and 0.0 <= n <= LARGEST for n in numbers) and (
            ends is None or len(ends) == 2
        )
        if not good or (ends is not None and not ends[0] <= mean <= ends[1]) or (error is None) != (freedom is None):
            raise InvalidInput(
                f"{file}: {own['agent']:.40}: {key} = {mean!s:.40}, {key}_interval = {ends!s:.60}: must be a mean harm,"
                " and an interval [low, high] that contains it"
            )


def _beside(file: Path, agents: Mapping[str, Mapping[str, Any]]) -> tuple[Result | None, str]:
    """Return the rows per world, or None and why there are none."""
    own = next(iter(agents.values()))
    beside = own.get("per_world")
    if beside is None:
        return None, f"{file} was written without a file that has one row per world; evaluate again with --per-world"
    try:
        rows = file.parent / Path(beside["file"]).name
        if not rows.is_file():
            return None, f"{rows}, the file with one row per world of {file}, does not exist"
        data = read_plain(rows, MOST_ROWS_BYTES)
        if hashlib.sha256(data).hexdigest() != beside["sha256"]:
            return None, f"{rows} was changed after {file} was written; evaluate again"
        table = _table(rows, data)
        worlds = {name: np.dtype(TYPES[kind]).type for name, kind in beside["worlds"].items()}
        kinds = {name: np.dtype(TYPES[kind]).type for name, kind in beside["columns"].items()}
        parts = {name: np.array(table["agent"]) == name for name in agents}
        columns: dict[str, Columns] = {
            name: {key: column for key, kind in kinds.items() if (column := _typed(table[key], part, kind)) is not None}
            for name, part in parts.items()
        }
        described = {name: _typed(table[name], parts[own["agent"]], kind) for name, kind in worlds.items()}
        sizes = {name: int(part.sum()) for name, part in parts.items()}
        if set(sizes.values()) != {own["episodes"]} or sum(sizes.values()) != len(table["agent"]):
            raise ValueError(f"{rows.name} has rows of other agents, or not {own['episodes']} of each")
        measures = tuple(
            MEASURES.loaded.get(name, Measure(name, unit=str(unit))) for name, unit in beside["measures"].items()
        )
        about = {**own["parameters"], **{key: own[key] for key in IDENTITY if key in own}}
        return Result(
            columns, {name: each for name, each in described.items() if each is not None}, measures,
            {name: each["knows"] for name, each in agents.items()},
            {name: each["policy_sha256"] for name, each in agents.items()}, about,
        ), ""  # fmt: skip
    except (KeyError, TypeError, ValueError, AttributeError, NotImplementedError, OSError, csv.Error) as error:
        if isinstance(error, EthBrakeError):
            raise
        raise InvalidInput(f"{file}: its rows per world cannot be read: {error}") from None


def _table(path: Path, data: bytes) -> dict[str, list[Any]]:
    """Return the columns of a table, missing values as None."""
    if path.suffix.lower() == ".parquet":
        with naming_extras():
            from pyarrow.parquet import ParquetFile
        table: dict[str, list[Any]] = ParquetFile(io.BytesIO(data)).read().to_pydict()
        return table
    if path.suffix.lower() == ".json":
        table = parse_strict_json(data)
        return table
    heads, *lines = csv.reader(data.decode("utf-8").splitlines())
    cells = zip(*lines, strict=True)
    return {head: [cell or None for cell in column] for head, column in zip(heads, cells, strict=True)}


def _typed(column: Sequence[Any], rows: Values, kind: Any) -> Values | None:
    """Return the values of some rows in their own type; None if all are missing."""
    some = [value for value, mine in zip(column, rows.tolist(), strict=True) if mine]
    if kind is np.str_:
        return np.array(["" if value is None else str(value) for value in some]) if any(some) else None
    numbers = np.array([math.nan if value is None else float(value) for value in some])
    if np.isnan(numbers).all():
        return None
    if not (np.abs(numbers[~np.isnan(numbers)]) <= LARGEST).all():
        raise ValueError(f"a number is larger than {LARGEST:g}")
    return numbers.astype(kind)
