"""Worlds that the user gives: one state, columns of a table, or a CSV file. What is fixed comes from the scenario."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import suggestion
from ethbrake_marl.motion.layout import Bools, Floats
from ethbrake_marl.worlds.checks import LEAST_WEIGHT
from ethbrake_marl.worlds.derived import obstacle_gap, on_road
from ethbrake_marl.worlds.quantity import support
from ethbrake_marl.worlds.rules import OPTIONAL, RECORDING, RULES, USUAL, Entry, table_columns
from ethbrake_marl.worlds.sampling import state_of
from ethbrake_marl.worlds.scenario import Scenario
from ethbrake_marl.worlds.table import CsvFile

Naming = Callable[[Entry, int | None], str]  # (entry, row or None) -> how an error message names a value or a column


def worlds_from_state(scenario: Scenario, initial_state: Mapping[str, Any]) -> State:
    """Return one world from ``{"gaps_m": [7, 7], "speeds_mps": [20, 18, 20], ...}``; one number is for all vehicles.

    What has no key has the scenario's value, which must be fixed. Raises ``InvalidInput`` with key and index.
    """
    if not isinstance(initial_state, Mapping):
        raise InvalidInput(f"initial_state = {initial_state!r}: must be a mapping such as {{'gaps_m': [7, 7]}}")
    _refuse_mixture(scenario, "initial_state")
    columns, known = dict[Entry, Floats](), given_keys(scenario)
    for key, value in initial_state.items():
        if key not in known:
            if key in OPTIONAL:
                raise InvalidInput(
                    f"initial_state: {key} cannot be set, because scenario {scenario.name!r} does not declare it"
                )
            hint = suggestion(str(key), known) or f"known: {', '.join(known)}"
            raise InvalidInput(f"initial_state: unknown key {key!r}; {hint}")
        count = RULES[key].count(scenario.vehicles)
        numbers = _numbers(f"initial_state: {key}", value)
        if numbers.shape not in ((), (count,)):
            several = f"must be a list of {count} numbers (for {scenario.vehicles} vehicles), or one number for all"
            right = "must be one number" if RULES[key].per == "world" else several
            raise InvalidInput(f"initial_state: {key} has shape {list(numbers.shape)}; {right}")
        for index, number in enumerate(np.broadcast_to(numbers, (count,))):
            columns[key, index] = np.array([number])

    def name(entry: Entry, row: int | None) -> str:
        key, index = entry
        return f"initial_state: {key}" if RULES[key].per == "world" else f"initial_state: {key}[{index}]"

    return _worlds(scenario, columns, "initial_state", name)


def worlds_from_table(scenario: Scenario, columns: Any) -> State:
    """Return worlds from columns of equal length n: ``{"gap_1_m": [7, 8], "speed_1_mps": [20, 19], ...}``.

    ``columns`` may also be a pandas or polars data frame, or a pyarrow table. Rows are paired by position; pandas
    series with different indexes are refused. Gaps and speeds are needed; any other column of ``given_columns`` may
    follow. What has no column has the scenario's value, which must be fixed. Raises ``InvalidInput`` with column and
    row (from 0).
    """
    table = _as_mapping(columns)
    entries = _entries([*table], scenario, "initial states")
    arrays = [_numbers(f"initial states: {name}", column) for name, column in table.items()]
    if len({array.shape for array in arrays}) != 1 or arrays[0].ndim != 1:
        lengths = ", ".join(f"{name} {list(array.shape)}" for name, array in zip(table, arrays, strict=True))
        raise InvalidInput(
            f"initial states: all columns must be lists of the same length; they have the shapes {lengths}"
        )

    def name(entry: Entry, row: int | None) -> str:
        place = "" if row is None else f", row {row}"
        return f"initial states{place}, column {_column(entry)}"

    return _worlds(scenario, dict(zip(entries, arrays, strict=True)), "initial states", name)


def read_worlds(scenario: Scenario, path: str | Path) -> State:
    """Return the worlds of a CSV file with a header, with the columns of ``worlds_from_table``.

    Raises ``InvalidInput`` with file, line and column.
    """
    file = CsvFile.read(Path(path).expanduser())
    entries = _entries(file.header, scenario, f"{file.path}, line 1")
    table = np.array(file.cells(file.header), np.float64)

    def name(entry: Entry, row: int | None) -> str:
        place = "" if row is None else f", line {file.lines[row]}"
        return f"{file.path}{place}, column {_column(entry)}"

    columns = {entry: table[:, c] for c, entry in enumerate(entries)}
    return _worlds(scenario, columns, str(file.path), name)


def _refuse_mixture(scenario: Scenario, where: str) -> None:
    if scenario.members:
        raise InvalidInput(
            f"{where}: scenario {scenario.name!r} is a mixture, so it is unknown to which of its scenarios a"
            f" world belongs; use one of these scenarios: {', '.join(member.name for member in scenario.members)}"
        )


def given_keys(scenario: Scenario) -> tuple[str, ...]:
    """Return the quantities that worlds of this scenario have: ``gaps_m`` and so on."""
    there = {"obstacle_gap_m": scenario.has_obstacle}
    return USUAL + tuple(key for key in OPTIONAL if there.get(key, scenario.declares(key)))


def given_columns(scenario: Scenario) -> dict[str, Entry]:
    """Return the possible columns of a table of worlds: ``{"gap_1_m": ("gaps_m", 0), ...}``."""
    return table_columns(given_keys(scenario), scenario.vehicles)


def _column(entry: Entry) -> str:
    return RULES[entry[0]].column_of(entry[1])


def _as_mapping(columns: Any) -> Mapping[str, Any]:
    """Return the columns of a mapping or of a data frame. Raises ``InvalidInput`` for series that do not align."""
    if hasattr(columns, "column_names"):  # pyarrow
        return {name: columns.column(name).to_numpy() for name in columns.column_names}
    if not isinstance(columns, Mapping):
        if not hasattr(columns, "columns"):
            raise InvalidInput(
                f"initial states = {columns!r:.60}: must be a mapping from columns to lists of numbers, a data frame or"
                " a pyarrow table"
            )
        return {str(name): columns[name].to_numpy() for name in columns.columns}
    series = [(name, column.index) for name, column in columns.items() if hasattr(column, "to_numpy")
              and hasattr(column, "index")]  # fmt: skip
    for name, index in series[1:]:
        if not index.equals(series[0][1]):
            raise InvalidInput(
                f"initial states: columns {series[0][0]!r} and {name!r} have different pandas indexes; give them the"
                " same index, or pair them by position with .to_numpy()"
            )
    return {name: column.to_numpy() if hasattr(column, "to_numpy") else column for name, column in columns.items()}


def _entries(header: Sequence[str], scenario: Scenario, where: str) -> list[Entry]:
    """Return what the columns of a header mean. Raises ``InvalidInput`` for unknown, repeated and missing columns."""
    _refuse_mixture(scenario, where)
    known = given_columns(scenario)
    if twice := [name for name, times in Counter(header).items() if times > 1]:
        raise InvalidInput(f"{where}: column {twice[0]!r} occurs twice")
    for name in header:
        if name == RECORDING:
            raise InvalidInput(
                f"{where}: column {name!r} is possible only in the table of a scenario; put this table into a scenario"
                " (key table), or remove the column (confidence intervals then treat all worlds as independent)"
            )
        if name not in known:
            hint = suggestion(str(name), known) or f"known: {', '.join(known)}"
            separator = "; columns are separated by commas" if ";" in name or "\t" in name else ""
            raise InvalidInput(f"{where}: unknown column {name!r}; {hint}{separator}")
    for name, (key, _) in known.items():
        if key in ("gaps_m", "speeds_mps") and name not in header:
            raise InvalidInput(
                f"{where}: column {name!r} is missing; a table for {scenario.vehicles} vehicles must have it"
            )
    return [known[name] for name in header]


def _worlds(scenario: Scenario, given: Mapping[Entry, Floats], where: str, name: Naming) -> State:
    """Return worlds of the columns ``given``, each [n], filled in and checked."""
    n, N = len(next(iter(given.values()))) if given else 1, scenario.vehicles
    whole: dict[str, Floats] = {}
    last = ("gaps_m", "obstacle_gap_m")  # may follow from the others
    for key in sorted(given_keys(scenario), key=lambda key: key in last):
        rule = RULES[key]
        whole[key] = np.empty((n, rule.count(N)))
        for index in range(rule.count(N)):
            column = given.get((key, index))
            if column is None:
                column = _fixed(scenario, key, index, whole)
            if column is None:
                missing = name((key, index), None).removeprefix(f"{where}, ").removeprefix(f"{where}: ")
                raise InvalidInput(
                    f"{where}: {missing} is missing; scenario {scenario.name!r} has no fixed value for it"
                )
            column = np.broadcast_to(column, (n,))
            good = (column > 0.0 if rule.positive else column >= 0.0) & (column <= rule.high)
            _require(good, name, (key, index), column, f"must be {rule.interval}")
            whole[key][:, index] = column
    _check_together(scenario, whole, name)
    line = scenario.types_of_line
    equipment_drawn = line is not None and any(kind.v2x is not None for kind in line.kinds)
    if scenario.v2x.by_link and (scenario.v2x.drawn or equipment_drawn):
        raise InvalidInput(
            f"{where}: with v2x: {scenario.v2x.preset}, it is random what the vehicles learn about each other, and"
            " when; worlds of your own need a channel in which this is not random, for instance"
            " scenario.replace(v2x='paper')"
        )

    def no_chance(width: int, stream: tuple[int, ...]) -> Floats:
        return np.zeros((n, width))

    return state_of(scenario, on_road(whole), no_chance, scenario.equipped(), np.full(n, -1, np.int64))


def _fixed(scenario: Scenario, key: str, index: int, whole: Mapping[str, Floats]) -> Floats | None:
    """Return the scenario's fixed value, [n] or [1]; None if it is random.

    A gap may follow from a time gap and the given speed, an obstacle from a margin and the given Vehicle 1.
    """
    if key == "obstacle_gap_m":
        low, high = scenario.ends(key if scenario.declares(key) else "obstacle_margin_m")
        gap = obstacle_gap(scenario, on_road(whole), lambda _: low[np.newaxis])
        return gap[:, 0] if gap is not None and low[0] == high[0] else None
    by_time = key == "gaps_m" and scenario.time_gaps_s is not None
    fixed = scenario.bounds(key, dry=True)[index]
    low, high = support(scenario.declarations("time_gaps_s")[index][0]) if by_time else fixed
    if low != high:
        return None
    return low * whole["speeds_mps"][:, index + 1] if by_time else np.array([low])


def _check_together(scenario: Scenario, whole: Mapping[str, Floats], name: Naming) -> None:
    for index in range(scenario.vehicles):
        latency, speed, limit = (whole[key][:, index] for key in ("latency_s", "speeds_mps", "speed_limit_mps"))
        right = f"must be below horizon_s of the scenario ({scenario.horizon_s:g} s)"
        _require(latency < scenario.horizon_s, name, ("latency_s", index), latency, right)
        good = speed <= limit
        right = f"must not be above speed_limit_mps of vehicle_{index + 1}, {limit[np.argmin(good)]:g} m/s"
        _require(good, name, ("speeds_mps", index), speed, right)
    if "harm_weight" in whole:
        weights = whole["harm_weight"]
        right = f"the weight of at least one vehicle must be {LEAST_WEIGHT:g} or more"
        _require(np.asarray((weights >= LEAST_WEIGHT).any(axis=1)), name, ("harm_weight", 0), weights[:, 0], right)


def _require(good: Bools, name: Naming, entry: Entry, column: Floats, right: str) -> None:
    if not good.all():
        row = int(np.argmin(good))
        raise InvalidInput(f"{name(entry, row)} = {column[row]:.12g}: {right}")


def _numbers(what: str, value: ArrayLike) -> Floats:
    try:
        return real_numbers(value)
    except ValueError as error:
        raise InvalidInput(f"{what} = {value!r}: {error}; must be a number or a list of numbers") from None


def real_numbers(value: Any) -> Floats:
    """Return numbers as float64. Raises ``ValueError`` for what numpy would convert: booleans, masks, texts."""
    if isinstance(value, list | tuple):
        parts = [real_numbers(part) for part in value]
        if len({part.shape for part in parts}) > 1:
            raise ValueError("has inner lists of different lengths")
        return np.array(parts, np.float64)
    if np.ma.is_masked(value):
        raise ValueError("is masked")
    if getattr(value, "requires_grad", False):
        raise ValueError("is a tensor that requires gradients; pass tensor.detach()")
    try:
        array = np.asarray(value)
        if array.dtype.hasobject and array.ndim > 0:
            return real_numbers(list(array))
        entry = array.item() if array.dtype.hasobject else None
        if array.dtype.kind == "b" or isinstance(entry, bool | np.bool_):
            raise ValueError("is a boolean")
        if array.dtype.kind in "fiu" or hasattr(entry, "__float__"):
            return array.astype(np.float64)
    except (TypeError, RuntimeError, OverflowError):
        pass
    raise ValueError("is not a number")
