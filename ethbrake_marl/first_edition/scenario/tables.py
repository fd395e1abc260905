"""Build worlds from initial conditions of the user: a table with one row per world, or a state for ``reset``."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import suggestion
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds, make_worlds, real_numbers
from ethbrake_marl.first_edition.scenario.declared import ScenarioFields, obstacle_gap, on_road
from ethbrake_marl.first_edition.scenario.distributions import support
from ethbrake_marl.first_edition.scenario.fields import QUANTITY, RECORDING, Entry, QuantityRule, columns_of_table
from ethbrake_marl.first_edition.scenario.vehicle_types import Table

SIZE_LIMIT = 64 << 20  # largest size of a table in bytes

WEIGHT = "weight"  # column of ``rows_text`` with the weight of each row

_ALWAYS_IN_A_TABLE = ("gaps_m", "speeds_mps")


@dataclass(frozen=True, slots=True)
class _Naming:
    """How error messages name a value: by column and row of a table, or by key and index of a state."""

    where: str  # path of the file, or a description such as ``initial states``
    kind: Literal["file", "table", "state"]  # CSV file, columns in memory, or one state by key
    lines: Sequence[int] = ()  # for a file: line on which each row begins

    def entry(self, entry: Entry) -> str:
        field, index = entry
        if self.kind != "state":
            return f"column {QUANTITY.declared[field].column_of(index)}"
        return field if QUANTITY.declared[field].per == "world" else f"{field}[{index}]"

    def value(self, entry: Entry, row: int) -> str:
        if self.kind == "state":
            return f"{self.where}: {self.entry(entry)}"
        place = f"line {self.lines[row]}" if self.kind == "file" else f"row {row}"
        return f"{self.where}, {place}, {self.entry(entry)}"


def _quantities(scenario: ScenarioFields) -> dict[str, QuantityRule]:
    """Return the quantities that every world of this scenario has, by key."""
    there = {"obstacle_gap_m": scenario.has_obstacle, "friction": scenario.has_friction}
    return QUANTITY.usual | {
        key: rule for key, rule in QUANTITY.optional.items() if there.get(key, scenario.declares(key))
    }


def _worlds(given: Mapping[Entry, Floats], scenario: ScenarioFields, naming: _Naming) -> Worlds:
    """Build worlds from the columns ``given``; a quantity without a column has the scenario's value.

    ``given`` maps (key of the quantity, index of the vehicle or pair) to the values in the n worlds, [n]. Raises
    ``InvalidInput`` for a value out of range, and for a random quantity without a column.
    """
    if scenario.members:
        raise InvalidInput(
            f"{naming.where}: scenario {scenario.name!r} is a mixture, so it is unknown to which of its scenarios a"
            f" world belongs; use one of these scenarios: {', '.join(member.name for member in scenario.members)}"
        )
    n = len(next(iter(given.values()))) if given else 1
    full: dict[str, Floats] = {}
    rules = _quantities(scenario)
    last = ("gaps_m", "obstacle_gap_m")  # these may be derived from the others
    for field, rule in sorted(rules.items(), key=lambda item: item[0] in last):
        full[field] = np.empty((n, rule.count(scenario.vehicles)))
        for index in range(rule.count(scenario.vehicles)):
            column = given.get((field, index))
            if column is None:
                column = _fixed(scenario, field, index, full)
            if column is None:
                missing = naming.entry((field, index))
                raise InvalidInput(
                    f"{naming.where}: {missing} is missing; scenario {scenario.name!r} has no fixed value for it"
                )
            good = (column > 0.0 if rule.positive else column >= 0.0) & (column <= rule.high)
            _require_all(good, naming, (field, index), column, f"must be {rule.interval}")
            full[field][:, index] = column
    _check_together(full, scenario, naming)
    of_world = {field: full.pop(field)[:, 0] for field, rule in rules.items() if rule.per == "world"}
    worlds = make_worlds(full.pop("gaps_m"), full.pop("speeds_mps"), **of_world, **full)
    line = scenario.types_of_line
    drawn = line is not None and any(kind.v2x is not None for kind in line.kinds)
    return scenario.v2x.with_fixed_news(
        scenario.play_pieces(worlds), scenario.time_step_s, naming.where, None if drawn else scenario.equipped()
    )


def _fixed(scenario: ScenarioFields, field: str, index: int, full: Mapping[str, Floats]) -> Floats | None:
    """Return the scenario's fixed value of a quantity of one vehicle or pair, [n] or [1]; None if it is random.

    A gap is computed from a declared time gap and the speeds in ``full``, and the distance to the obstacle from a
    declared margin and the values of Vehicle 1 in ``full``. ``full`` has the quantities that are known already: key ->
    values, [n, entries].
    """
    if field == "obstacle_gap_m":
        low, high = support(scenario.quantities(field if scenario.declares(field) else "obstacle_margin_m")[0])
        return obstacle_gap(scenario, on_road(full), lambda key: np.array([low])) if low == high else None
    by_time = field == "gaps_m" and scenario.time_gaps_s is not None
    fixed = scenario.bounds(field, dry=True)[index]
    low, high = support(scenario.quantities("time_gaps_s")[index]) if by_time else fixed
    if low != high:
        return None
    return low * full["speeds_mps"][:, index + 1] if by_time else np.array([low])


def _check_together(full: Mapping[str, Floats], scenario: ScenarioFields, naming: _Naming) -> None:
    for index in range(scenario.vehicles):
        latency, speed, limit = (full[f][:, index] for f in ("latency_s", "speeds_mps", "speed_limit_mps"))
        right = f"must be below horizon_s of the scenario ({scenario.horizon_s:g} s)"
        _require_all(latency < scenario.horizon_s, naming, ("latency_s", index), latency, right)
        good = speed <= limit
        limit_mps = limit[np.argmin(good)]  # limit in the world that the message names
        right = f"must not be above speed_limit_mps of vehicle_{index + 1}, {limit_mps:g} m/s"
        _require_all(good, naming, ("speeds_mps", index), speed, right)


def _require_all(good: Bools, naming: _Naming, entry: Entry, column: Floats, right: str) -> None:
    """Raise ``InvalidInput`` for the first world in which ``good`` [n] is False.

    ``column`` has the checked values, [n], and ``entry`` their quantity and vehicle or pair. ``right`` says what would
    be valid.
    """
    if not good.all():
        row = int(np.argmin(good))
        raise InvalidInput(f"{naming.value(entry, row)} = {column[row]:.12g}: {right}")


def _known_columns(header: list[str], scenario: ScenarioFields, where: str) -> list[Entry]:
    """Return, for each column name in ``header``, the key of its quantity and the index of its vehicle or pair.

    Raises ``InvalidInput``, whose message begins with ``where``, for unknown, repeated and missing columns.
    """
    known = table_columns(scenario)
    if twice := [name for name, times in Counter(header).items() if times > 1]:
        raise InvalidInput(f"{where}: column {twice[0]!r} occurs twice")
    for name in header:
        if name == RECORDING:
            raise InvalidInput(
                f"{where}: column {name!r} is possible only in the table of a scenario; put this table into a scenario"
                " (key table), or remove the column (confidence intervals then treat all worlds as independent)"
            )
        if name not in known:
            hint = suggestion(name, known) or f"known: {', '.join(known)}"
            separator = "; columns are separated by commas" if ";" in name or "\t" in name else ""
            raise InvalidInput(f"{where}: unknown column {name!r}; {hint}{separator}")
    for name, (field, _) in known.items():
        if field in _ALWAYS_IN_A_TABLE and name not in header:
            raise InvalidInput(
                f"{where}: column {name!r} is missing; a table for {scenario.vehicles} vehicles must have it"
            )
    return [known[name] for name in header]


def _numbers(what: str, value: ArrayLike) -> Floats:
    try:
        return real_numbers(value)
    except ValueError as error:
        raise InvalidInput(f"{what} = {value!r}: {error}; must be a number or a list of numbers") from None


def _read_csv(file: Path) -> tuple[list[str], list[list[str]], list[int]]:
    """Return the header of a CSV file, its rows (at least one), and the line at which each row begins.

    The cells of the rows are unchecked texts.
    """
    rows: list[list[str]] = []
    lines: list[int] = []
    data = read_plain(file, SIZE_LIMIT)
    try:
        reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
        begins = 1
        for row in reader:
            rows.append(row)
            lines.append(begins)
            begins = reader.line_num + 1
    except (csv.Error, ValueError) as error:
        raise InvalidInput(f"{file}: cannot be read as CSV: {error}") from None
    while rows and not rows[-1]:
        rows.pop()  # blank lines at the end
    if not rows or not rows[0]:
        raise InvalidInput(f"{file}, line 1: must name the columns, for instance gap_1_m,gap_2_m,speed_1_mps,...")
    if len(rows) == 1:
        raise InvalidInput(f"{file}: has a header but no rows; add one row per world")
    return [name.strip() for name in rows[0]], rows[1:], lines[1:]


def _cell_at(file: Path, header: list[str], row: list[str], line: int, column: str) -> float | str:
    """Return the value in one column of a CSV row: a number, or a text in the column ``recording``.

    Raises ``InvalidInput`` if the row has the wrong length or the value is not a number. The error message names
    ``file`` and ``line``.
    """
    if len(row) != len(header):
        raise InvalidInput(f"{file}, line {line}: has {len(row)} values, but the header has {len(header)} columns")
    text = row[header.index(column)]
    number = parse_numeral(text.strip()) if column != RECORDING else text.strip()
    if number is None:
        raise InvalidInput(f"{file}, line {line}, column {column}: {text!r:.60} is not a number")
    return number


def table_columns(scenario: ScenarioFields) -> dict[str, Entry]:
    """Return the possible columns of a table of initial states: name -> (key of quantity, index of vehicle or pair).

    An example is ``{"gap_1_m": ("gaps_m", 0), "speed_1_mps": ("speeds_mps", 0)}``.
    """
    return columns_of_table(_quantities(scenario), scenario.vehicles)


def read_worlds(scenario: ScenarioFields, path: str | Path) -> Worlds:
    """Read worlds from a CSV file with a header line and the same columns as in ``worlds_from_table``.

    Raises ``InvalidInput`` with file, line and column for an unknown, repeated or missing column, a value that is not a
    number or out of range, a row of the wrong length, a file without rows, or a file larger than ``SIZE_LIMIT``.
    """
    file = Path(path)
    header, rows, lines = _read_csv(file)
    entries = _known_columns(header, scenario, f"{file}, line 1")
    table = np.empty((len(rows), len(header)))
    for r, row in enumerate(rows):
        table[r] = [_cell_at(file, header, row, lines[r], name) for name in header]
    columns = {entry: table[:, c] for c, entry in enumerate(entries)}
    return _worlds(columns, scenario, _Naming(str(file), "file", lines))


def read_rows(file: Path, columns: object, weights: object) -> dict[str, Any]:
    """Read the rows of a scenario's table, and their weights, from a CSV file with a header line.

    Returns ``{"rows": [[7.0, 8.0], ...]}``, and also ``"weights": [1.0, ...]`` unless ``weights`` is None. ``columns``
    are the names of the columns to read, as the scenario file lists them; this function checks the names. ``weights``
    is the name of the column with the weight of each row. Raises ``InvalidInput`` for an invalid file; the message
    names file, line and column.
    """
    header, rows, lines = _read_csv(file)
    weights_of = [] if weights is None else [weights]
    if not isinstance(columns, list | tuple):
        raise InvalidInput(
            f"{file}: columns = {columns!r:.60}: must be a list of columns of this file, which are {', '.join(header)}"
        )
    for name in (*columns, *weights_of):
        if header.count(name) != 1:
            many = "occurs twice" if name in header else f"is missing; {suggestion(str(name), header)}"
            raise InvalidInput(f"{file}, line 1: column {name!r:.60} {many.removesuffix('; ')}")
    cells = [
        [_cell_at(file, header, row, line, str(name)) for name in (*columns, *weights_of)]
        for row, line in zip(rows, lines, strict=False)  # ignore blank lines at the end
    ]
    settings: dict[str, Any] = {"rows": [row[: len(columns)] for row in cells]}
    return settings if weights is None else settings | {"weights": [row[-1] for row in cells]}


def rows_text(table: Table) -> str:
    """Return the rows of a scenario's table as CSV text; the column ``weight`` has the weights of the rows."""
    rows, weights = table.rows or (), table.weights
    listed = [[*row, weights[k]] for k, row in enumerate(rows)] if isinstance(weights, tuple) else rows
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([[*table.columns, *([] if weights is None else [WEIGHT])], *listed])
    return text.getvalue()


def worlds_from_table(scenario: ScenarioFields, columns: Mapping[str, ArrayLike]) -> Worlds:
    """Build worlds from columns of equal length n: ``{"gap_1_m": [7, 8], "speed_1_mps": [20, 19], ...}``.

    Columns of gaps and speeds are required. Optional columns are ``braking_capacity_1_mps2``,
    ``driving_capacity_1_mps2``, ``latency_1_s``, ``mass_1_t``, ``speed_limit_1_mps`` and the like for each vehicle,
    ``restitution``, and ``obstacle_gap_m`` if the scenario has an obstacle. Quantities without a column have the
    scenario's value, which must be a fixed number. Raises ``InvalidInput``, which names the column and the row (from
    0), for an invalid value.
    """
    entries = _known_columns(list(columns), scenario, "initial states")
    by_entry = {
        entry: _numbers(f"initial states: {name}", column)
        for entry, (name, column) in zip(entries, columns.items(), strict=True)
    }
    shapes = {column.shape for column in by_entry.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 1:
        lengths = ", ".join(f"{name} {list(np.shape(column))}" for name, column in columns.items())
        raise InvalidInput(
            f"initial states: all columns must be lists of the same length; they have the shapes {lengths}"
        )
    return _worlds(by_entry, scenario, _Naming("initial states", "table"))


def worlds_from_state(scenario: ScenarioFields, initial_state: Mapping[str, Any]) -> Worlds:
    """Build one world (n = 1) from a state ``{"gaps_m": [7, 7], "speeds_mps": [20, 18, 20], ...}``.

    The keys are quantities of a scenario. A single number applies to every vehicle. Quantities without a key have the
    scenario's value, which must be a fixed number. Raises ``InvalidInput``, which names the key and the index, for an
    invalid value.
    """
    if not isinstance(initial_state, Mapping):
        raise InvalidInput(f"initial_state = {initial_state!r}: must be a mapping such as {{'gaps_m': [7, 7]}}")
    columns: dict[Entry, Floats] = {}
    known = _quantities(scenario)
    for field, value in initial_state.items():
        if field not in known:
            if field in QUANTITY.optional:
                raise InvalidInput(
                    f"initial_state: {field} cannot be set, because scenario {scenario.name!r} does not declare it"
                )
            hint = suggestion(str(field), known) or f"known: {', '.join(known)}"
            raise InvalidInput(f"initial_state: unknown key {field!r}; {hint}")
        count = known[field].count(scenario.vehicles)
        numbers = _numbers(f"initial_state: {field}", value)
        if numbers.shape not in ((), (count,)):
            several = f"must be a list of {count} numbers (for {scenario.vehicles} vehicles), or one number for all"
            right = "must be one number" if known[field].per == "world" else several
            raise InvalidInput(f"initial_state: {field} has shape {list(numbers.shape)}; {right}")
        for index, number in enumerate(np.broadcast_to(numbers, (count,))):
            columns[field, index] = np.array([number])
    return _worlds(columns, scenario, _Naming("initial_state", "state"))
