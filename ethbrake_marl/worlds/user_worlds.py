"""Worlds from the user: one state, columns of a table, or a CSV file. The scenario supplies the rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.state import KEY, State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import suggestion
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.derived import mistakes, obstacle_gap, world_values
from ethbrake_marl.worlds.describe import LABELS, OF_RESULTS
from ethbrake_marl.worlds.open_game import AnyScenario
from ethbrake_marl.worlds.quantities import OPTIONAL, QUANTITIES, USUAL, QuantityEntry, table_columns
from ethbrake_marl.worlds.sampling import state_of
from ethbrake_marl.worlds.scenario import Scenario
from ethbrake_marl.worlds.table import CsvFile


def worlds_from_state(scenario: Scenario, initial_state: Mapping[str, Any]) -> State:
    """One world from ``{"gaps_m": [7, 7], "speeds_mps": [20, 18, 20], ...}``; a single number is for all vehicles.

    A missing key takes the scenario's value, which must be fixed. Raises ``InvalidInput``, with key and index.
    """
    where = "initial_state"
    if not isinstance(initial_state, Mapping):
        raise InvalidInput(f"{where} = {initial_state!r}: must be a mapping such as {{'gaps_m': [7, 7]}}")
    columns = dict[QuantityEntry, Floats]()
    for key, value in initial_state.items():
        _check_known(f"{where}: unknown key {key!r}", str(key), world_keys(scenario))
        count, numbers = QUANTITIES[key].count(scenario.vehicles), _numbers(f"{where}: {key}", value)
        if numbers.shape not in ((), (count,)):
            several = f"must be a list of {count} numbers (for {scenario.vehicles} vehicles), or one number for all"
            right = "must be one number" if QUANTITIES[key].per == "world" else several
            raise InvalidInput(f"{where}: {key} has shape {list(numbers.shape)}; {right}")
        columns |= {(key, i): number for i, number in enumerate(np.broadcast_to(numbers, (count,))[:, np.newaxis])}
    return _worlds(scenario, columns, where)


def worlds_from_table(scenario: AnyScenario, columns: Any) -> State:
    """Worlds from columns of equal length n: ``{"gap_1_m": [7, 8], "speed_1_mps": [20, 19], ...}``.

    ``columns`` may also be a pandas or polars data frame, a pyarrow table or a structured array of numpy; rows are
    matched by position. A missing column (of ``world_columns``) takes the scenario's value, which must be fixed. A
    column with another name is a label: results have it as text. Raises ``InvalidInput``, with column and row (from 0),
    for a bad value, and for a name that is like that of a quantity.
    """
    scenario, where = load_scenario(scenario), "initial states"
    columns = columns.collect() if callable(getattr(columns, "collect", None)) else columns  # a LazyFrame of polars
    names: Any = columns  # or the attribute of pyarrow, of a frame, or of a structured array
    if not isinstance(columns, Mapping):
        of_array = getattr(getattr(columns, "dtype", None), "names", None)
        names = getattr(columns, "column_names", getattr(columns, "columns", of_array))
    if not hasattr(names, "__len__"):
        raise InvalidInput(
            f"{where}: type {type(columns).__name__}: must be a mapping from columns to lists of numbers, a pandas or"
            " polars frame, a pyarrow table, or a structured array of numpy"
        )
    series = [columns[name] for name in names if hasattr(columns[name], "iloc")]
    if not all(column.index.equals(series[0].index) for column in series):
        raise InvalidInput(
            f"{where}: columns have different pandas indexes; give them the same index, or pair them by position with"
            " .to_numpy()"
        )
    header = [str(name) for name in names]
    entries = _entries(header, scenario, where)
    arrays = [
        np.array(["" if _is_missing(cell) else str(cell) for cell in columns[name]])
        if str(name) not in entries
        else _numbers(f"{where}: {name}", columns[name])
        for name in names
    ]
    if len({array.shape for array in arrays}) != 1 or arrays[0].ndim != 1:
        shapes = ", ".join(f"{name} {list(array.shape)}" for name, array in zip(header, arrays, strict=True))
        raise InvalidInput(f"{where}: all columns must be lists of the same length; they have the shapes {shapes}")
    values = {entries[name]: array for name, array in zip(header, arrays, strict=True) if name in entries}
    labels = {name: array for name, array in zip(header, arrays, strict=True) if name not in entries}
    return _with_labels(_worlds(scenario, values, where, lambda row: f", row {row}"), labels)


def read_worlds(scenario: AnyScenario, path: str | Path) -> State:
    """Worlds from a CSV file with commas and the columns of ``worlds_from_table``."""
    if not isinstance(path, str | PathLike):
        raise InvalidInput(
            f"path: type {type(path).__name__}: must be the path of a CSV file; worlds_from_table reads a table"
        )
    scenario, file = load_scenario(scenario), CsvFile.read(Path(path).expanduser())
    entries = _entries(file.header, scenario, f"{file.path}, line 1")
    labels = [name for name in file.header if name not in entries]
    columns = dict(zip(file.header, zip(*file.cells(file.header, labels), strict=True), strict=True))
    values = {entry: np.array(columns[name], np.float64) for name, entry in entries.items()}
    worlds = _worlds(scenario, values, str(file.path), lambda row: f", line {[*file.rows][row]}")
    return _with_labels(worlds, {name: np.array(columns[name]) for name in labels})


def world_keys(scenario: Scenario) -> tuple[str, ...]:
    special_cases = {"obstacle_gap_m": scenario.has_obstacle}
    return USUAL + tuple(key for key in OPTIONAL if special_cases.get(key, key in scenario.sources))


def world_columns(scenario: Scenario) -> dict[str, QuantityEntry]:
    """Columns that a table of worlds may have: name -> (key of the quantity, index of the vehicle or pair, from 0)."""
    return table_columns(world_keys(scenario), scenario.vehicles)


def _check_known(what: str, name: str, known: Sequence[str]) -> None:
    if name not in known:
        raise InvalidInput(f"{what}; {suggestion(name, known) or 'known: ' + ', '.join(known)}")


def _entries(header: Sequence[str], scenario: Scenario, where: str) -> dict[str, QuantityEntry]:
    """Name -> (key, index); the other columns of ``header`` are labels."""
    possible_columns, of_all_scenarios = world_columns(scenario), table_columns(USUAL + OPTIONAL, scenario.vehicles)
    for name in header:
        if header.count(name) > 1:
            raise InvalidInput(f"{where}: column {name!r} occurs twice")
        if name in OF_RESULTS or not name.isprintable() or not name:
            raise InvalidInput(
                f"{where}: column {name!r:.60}: a column of your own needs another name, which results do not use"
            )
        if name in of_all_scenarios or suggestion(name, possible_columns):
            _check_known(f"{where}: unknown column {name!r}", name, [*possible_columns])
    return {name: possible_columns[name] for name in header if name in possible_columns}


def _with_labels(worlds: State, labels: Mapping[str, NDArray[Any]]) -> State:
    return worlds._replace(memories={**worlds.memories, LABELS: dict(labels)}) if labels else worlds


def _is_missing(cell: Any) -> bool:
    return cell is None or type(cell).__name__ == "NAType" or (isinstance(cell, float) and math.isnan(cell))


def _worlds(
    scenario: Scenario,
    columns: Mapping[QuantityEntry, Floats],
    where: str,
    row_text: Callable[[int], str] | None = None,
) -> State:
    """Checked worlds from ``columns``, (key, index) -> [n], and the scenario's fixed values.

    Error messages begin with ``where``. ``row_text(row)`` names a row in them; None: there is one world, so messages
    name only key and index.
    """
    if scenario.members:
        raise InvalidInput(
            f"{where}: scenario {scenario.name!r} is a mixture, so it is unknown to which of its scenarios a"
            f" world belongs; use one of these scenarios: {', '.join(member.name for member in scenario.members)}"
        )
    n = len(next(iter(columns.values()))) if columns else 1

    def refuse(key: str, i: int, row: int, right: str) -> NoReturn:
        by_key = key if QUANTITIES[key].per == "world" else f"{key}[{i}]"
        place = f": {by_key}" if row_text is None else f"{row_text(row)}, column {QUANTITIES[key].column_of(i)}"
        raise InvalidInput(f"{where}{place}{right}")

    def fixed_values(key: str) -> Floats:
        low, high = scenario.ends(key)
        return np.where(low == high, low, np.nan)[np.newaxis]

    def settle(key: str, defaults: Floats) -> Floats:
        rule, values = QUANTITIES[key], np.empty((n, defaults.shape[1]))
        for i in range(values.shape[1]):
            column = values[:, i] = columns.get((key, i), defaults[:, i])
            if (key, i) not in columns and np.isnan(column).any():
                refuse(key, i, 0, f" is missing; scenario {scenario.name!r} has no fixed value for it")
            good = (column > 0.0 if rule.positive else column >= 0.0) & (column <= rule.high)
            for row in np.flatnonzero(~good).tolist():
                refuse(key, i, row, f" = {column[row]:.12g}: must be {rule.interval}")
        return values

    values = world_values(scenario, fixed_values, settle)
    if scenario.has_obstacle:
        values["obstacle_gap_m"] = settle("obstacle_gap_m", obstacle_gap(scenario, values, fixed_values))
    for mistake, i, row, right in mistakes(scenario, values, values):
        key = "latency_s" if mistake == "v2x" else mistake
        refuse(key, i, row, f" = {values[key][row, i]:.12g}: {right}")
    line = scenario.types_of_line
    equipment_drawn = line is not None and any(kind.v2x is not None for kind in line.kinds)
    if scenario.v2x.drawn or equipment_drawn:
        raise InvalidInput(
            f"{where}: with v2x: {scenario.v2x.preset}, it is random what the vehicles learn about each other, and"
            " when; worlds of your own need a channel in which this is not random, for instance"
            " scenario.replace(v2x='paper')"
        )

    def no_chance(width: int, stream: tuple[int, ...]) -> Floats:
        return np.zeros((n, width))

    worlds = state_of(scenario, values, no_chance, scenario.unheard(), np.full(n, -1))
    worlds.clock[:, KEY] = np.arange(n)
    return worlds


def _short_text(value: Any) -> str:
    kind = getattr(value, "dtype", getattr(value, "type", None))
    return f"{value!r:.60}" if kind is None else f"{type(value).__name__} of {kind}"


def _numbers(what: str, value: Any) -> Floats:
    """NaN where one is missing. Refuses booleans, masks and texts, which numpy would convert."""
    try:
        cells = np.asarray(value)
        if cells.dtype.kind == "O":
            cells = np.array([_number(cell) for cell in cells.flat], np.float64).reshape(cells.shape)
        kinds = {type(cell) for cell in np.asarray(value, object).flat} if isinstance(value, list | tuple) else set()
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:  # ragged lists, tensors on a GPU, texts
        raise InvalidInput(f"{what} = {_short_text(value)}: must be a number or a list of numbers: {error}") from None
    if cells.dtype.kind not in "fiu" or isinstance(value, np.ma.MaskedArray) or kinds & {bool, np.bool_}:
        raise InvalidInput(
            f"{what} = {_short_text(value)}: must be a number or a list of numbers; no booleans, texts or masks"
        )
    return cells.astype(np.float64)


def _number(cell: Any) -> float:
    """NaN for a missing number, which may be None or the ``NAType`` of pandas."""
    if _is_missing(cell):
        return math.nan
    if isinstance(cell, bool) or not isinstance(cell, Real | Decimal):
        raise TypeError(f"it contains {cell!r:.60}")
    return float(cell)
