"""One row per agent and world as a data frame, and as a Parquet file."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, naming_extras, need, unknown_name
from ethbrake_marl.evaluation.outcome import Evaluation
from ethbrake_marl.evaluation.per_world import per_world_columns, write_output, write_per_world_csv
from ethbrake_marl.objectives import Declared

CSV, PARQUET = ".csv", ".parquet"
COLUMNS = "columns"
LIBRARIES = ("pandas", "polars")  # in the order of preference
_MOST_HARM = 1e100  # m2/s2; a number that can be squared
_HARMS = ("agent", "world", "first_impact_harm", "total_harm")
_TEXTS = {"agent", "scenario", "unavoidable_reason", "best_known_source", "ended", "knows"}


def typed_columns(evaluation: Evaluation, objectives: Sequence[Declared] = ()) -> dict[str, NDArray[Any]]:
    """The columns of ``per_world_columns`` as arrays: NaN for no number, the empty text for no text."""
    return {name: _typed(name, values) for name, values in per_world_columns(evaluation, objectives).items()}


def _typed(name: str, values: list[Any]) -> NDArray[Any]:
    if name in _TEXTS or (name.startswith("vehicle_") and name.endswith("_type")):
        return np.array([value or "" for value in values])
    return np.array([np.nan if value is None else value for value in values])


def make_frame(evaluation: Evaluation, library: str | None = None) -> Any:
    """``Evaluation.to_frame``."""
    columns = typed_columns(evaluation)
    if library is None:
        library = next((name for name in LIBRARIES if find_spec(name) is not None), COLUMNS)
    if library not in (*LIBRARIES, COLUMNS):
        raise unknown_name("library", library, (*LIBRARIES, COLUMNS))
    if library == COLUMNS:
        return columns
    if find_spec(library) is None:
        raise InvalidInput(f"to_frame: {library} is not installed: {sys.executable} -m pip install {library}")
    return import_module(library).DataFrame(columns)


def write_per_world(
    path: str | Path, evaluation: Evaluation, *, objectives: Sequence[Declared] = (), force: bool = False
) -> None:
    """Write one row per agent and world: Parquet where the name ends in ``.parquet``, else CSV.

    Raises as ``write_per_world_csv``, and as ``check_per_world``.
    """
    check_per_world(path)
    if Path(path).suffix.lower() != PARQUET:
        write_per_world_csv(path, evaluation, objectives=objectives, force=force)
        return
    arrow, parquet = _import_extra("pyarrow"), _import_extra("pyarrow.parquet")
    columns = typed_columns(evaluation, objectives)
    buffer = io.BytesIO()
    table = arrow.table({name: arrow.array(values, from_pandas=True) for name, values in columns.items()})
    parquet.write_table(table, buffer)
    write_output(path, buffer.getvalue(), force=force)


def check_per_world(path: str | Path) -> None:
    """Refuse a file that ``write_per_world`` cannot write, before work whose result goes there.

    Raises ``InvalidInput`` for another ending than .csv or .parquet, ``MissingExtra`` without pyarrow for Parquet.
    """
    ending = Path(path).suffix.lower()
    if ending not in (CSV, PARQUET):
        raise InvalidInput(f"{path}: must end in {CSV} or {PARQUET}")
    if ending == PARQUET:
        need("pyarrow")


def read_harms(path: Path, data: bytes) -> dict[str, dict[int, tuple[float, ...]]]:
    """Agent -> world -> harm (m2/s2) under both counts, of ``data``, what ``write_per_world`` wrote to ``path``.

    Worlds that were left out are not among them. Raises ``InvalidInput`` for a file without these columns.
    """
    try:
        if path.suffix.lower() == PARQUET:
            table = _import_extra("pyarrow.parquet").read_table(io.BytesIO(data), columns=list(_HARMS)).to_pydict()
            rows = list(zip(*(table[name] for name in _HARMS), strict=True))
        else:
            lines = csv.DictReader(data.decode("utf-8").splitlines())
            rows = [tuple(line[name] for name in _HARMS) for line in lines]
        found: dict[str, dict[int, tuple[float, ...]]] = {}
        for agent, world, *harms in rows:
            if harms[0] not in (None, ""):
                values = tuple(map(float, harms))
                if not all(0.0 <= value <= _MOST_HARM for value in values):
                    raise ValueError(f"world {world}: harm {harms}")
                found.setdefault(agent, {})[int(world)] = values
        return found
    except (KeyError, TypeError, ValueError, NotImplementedError, OSError, csv.Error) as error:
        raise InvalidInput(f"{path}: is no file of --per-world: {error}") from None


def _import_extra(module: str) -> Any:
    """A module of an extra; raises ``MissingExtra``."""
    with naming_extras():
        return import_module(module)
