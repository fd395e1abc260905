"""The tables of a sweep: one row per finished job in the order of the file, and one per failure.

The first is made of the plan and of what the jobs found alone, so that it is the same, byte for byte, in whatever order
and wherever they ran, and however often they were stopped.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from ethbrake_marl.errors import naming_extras
from ethbrake_marl.files.durable import new_file, write_file
from ethbrake_marl.studies.sweep.job import RESULTS
from ethbrake_marl.studies.sweep.journal import Failure, Results
from ethbrake_marl.studies.sweep.plan import Row, SweepPlan

TableFormat = Literal["csv", "parquet"]
TABLE, FAILURES = "results", "failures.csv"  # the table's name without its ending

_ABOUT = ("hash", "scenario", "level", "recipe", "algorithm", "scheme", "seed", "total_steps")
_WHOLE = {"seed", "total_steps", "steps", "policy_steps"}
_TEXT = {"hash", "scenario", "level", "recipe", "algorithm", "scheme", "policy_sha256"}


def table_file(folder: Path, form: TableFormat) -> Path:
    """Where the table stands."""
    return folder / f"{TABLE}.{form}"


def write_tables(
    folder: Path, plan: SweepPlan, results: Results, failures: Sequence[Failure], form: TableFormat
) -> Path:
    """Write the table of the finished jobs, give its path, and write that of the failures where there are any.

    A setting's column is called ``set.KEY``. Parquet has numbers for results and text for settings.
    """
    path = table_file(folder, form)
    {"csv": _write_csv, "parquet": _write_parquet}[form](path, plan, results)
    if failures:
        write_file(folder / FAILURES, _failures_csv(failures).encode())
    else:
        (folder / FAILURES).unlink(missing_ok=True)
    return path


def _columns(plan: SweepPlan) -> list[str]:
    return [*_ABOUT, *(f"set.{key}" for key in plan.keys), *RESULTS]


def _rows(plan: SweepPlan, results: Mapping[str, tuple[str, ...]]) -> Iterator[list[str]]:
    """The finished jobs."""
    keys = plan.keys
    for row in plan.rows:
        found = results.get(row.identity)
        if found is not None:
            settings = row.settings
            yield [*_about(row), *(settings.get(key, "") for key in keys), *found]


def _about(row: Row) -> list[str]:
    asked = row.asked
    return [
        row.identity, asked.scenario, asked.level, asked.recipe, row.algorithm, row.scheme, str(asked.seed),
        str(row.steps),
    ]  # fmt: skip


def _write_csv(path: Path, plan: SweepPlan, results: Results) -> None:
    with new_file(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_columns(plan))
        writer.writerows(_rows(plan, results))


def _write_parquet(path: Path, plan: SweepPlan, results: Results) -> None:
    with naming_extras():
        import pyarrow as pa
        import pyarrow.parquet as pq
    columns = _columns(plan)
    values = list(zip(*_rows(plan, results), strict=True)) or [()] * len(columns)
    arrays = {}
    for name, column in zip(columns, values, strict=True):
        kind, read = _kind(name)
        arrays[name] = pa.array([read(value) if value else None for value in column], getattr(pa, kind)())
    with new_file(path) as partial:
        pq.write_table(pa.table(arrays), partial)


def _kind(column: str) -> tuple[str, Callable[[str], Any]]:
    """Arrow's type of a column, and what makes a value of its text."""
    if column in _WHOLE:
        return "int64", int
    return ("string", str) if column in _TEXT or column.startswith("set.") else ("float64", float)


def _failures_csv(failures: Sequence[Failure]) -> str:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_ABOUT, "set", "attempts", "reason", "last_lines"])
    for failure in failures:
        settings = " ".join(failure.row.asked.settings)
        writer.writerow([*_about(failure.row), settings, failure.attempts, failure.reason, failure.last_lines])
    return text.getvalue()
