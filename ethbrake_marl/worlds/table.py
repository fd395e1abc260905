"""Tables of measured values: a world takes its values from one row, the same for all columns."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import not_
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, model_validator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import UNSHOWN, require, suggestion
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.worlds.quantities import QUANTITIES, RECORDING, QuantityEntry
from ethbrake_marl.worlds.quantity import Number, ScenarioPart, pick

CSV_SIZE_LIMIT = 64 << 20  # bytes of a CSV file

CsvCell = Annotated[
    Annotated[Number, Tag("#number")] | Annotated[str, Tag("#text")],
    Discriminator(lambda value: "#text" if isinstance(value, str) else "#number"),
]
CsvRow = Annotated[tuple[CsvCell, ...], Field(strict=False)]


@dataclass(frozen=True, slots=True, eq=False)
class TableColumn:
    """A column of a table, used like a distribution: every row is equally likely."""

    rows: NDArray[Any]  # value of each row; texts in the column ``recording``

    @property
    def support(self) -> tuple[float, float]:
        return float(self.rows.min()), float(self.rows.max())

    def value(self, u: Floats) -> NDArray[Any]:
        return self.rows[pick(np.ones(len(self.rows)), u)]


class Table(ScenarioPart):
    """The key ``table`` of a scenario. A scenario file may name a CSV file with the rows.

    Rows with the same text in the column ``recording`` come from the same vehicles in the same recording, so they are
    not independent of each other.
    """

    file: str = Field(
        default="", exclude_if=not_, description="path of a CSV file with a header, relative to the scenario's folder"
    )
    columns: Annotated[tuple[str, ...], Field(strict=False, min_length=1)] = Field(
        description="names of the columns, or of the columns of the file that are used: gap_1_m, speed_2_mps, ...;"
        " the column recording has texts that name the recording and the vehicles of a row"
    )
    rows: Annotated[tuple[CsvRow, ...], Field(strict=False, min_length=1)] | None = Field(
        default=None, description="rows with one number per column (a text for recording); left out if file is given"
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        require(not (self.file and self.rows), ("file",), self.file, "cannot be combined with rows; leave one out")
        read = "must be given as lists here; only load_scenario reads the rows from a file"
        require(self.rows is not None, ("rows",), UNSHOWN, read)
        for k, row in enumerate(self.rows or ()):
            right = f"has {len(row)} values; must have one for each of the {len(self.columns)} columns"
            require(len(row) == len(self.columns), ("rows", k), UNSHOWN, right)
        require(len({*self.columns}) == len(self.columns), ("columns",), self.columns, "must not list a column twice")
        require(self.columns != (RECORDING,), ("columns",), self.columns, "must also have a column of numbers")
        return self

    def check_cells(self, known: Mapping[str, QuantityEntry]) -> None:
        """``known``: possible columns of numbers, name -> (key, index from 0)."""
        hint = f"known: {', '.join((*known, RECORDING))}"
        for c, name in enumerate(self.columns):
            unknown = f"unknown column; {suggestion(name, known) or hint}"
            require(name in known or name == RECORDING, ("columns",), name, unknown)
            rule = QUANTITIES[known[name][0]] if name in known else None
            right = f"{name} must be {rule.interval if rule else 'a printable text, such as drive_1.csv: 2-3-4'}"
            for k, cell in enumerate(row[c] for row in self.rows or ()):
                if isinstance(cell, str):
                    good = rule is None and cell.isprintable() and cell.strip() == cell != ""
                else:
                    good = rule is not None and rule.allows(cell, cell)
                require(good, ("rows", k, c), cell, right)

    @cached_property
    def origins(self) -> Ints:
        """For each row a number from 1, the same for equal rows."""
        origins: Ints = np.unique([repr(row) for row in self.rows or ()], return_inverse=True)[1] + 1
        return origins

    @cached_property
    def by_name(self) -> dict[str, TableColumn]:
        columns = zip(self.columns, zip(*(self.rows or ()), strict=True), strict=True)
        return {name: TableColumn(np.array(column)) for name, column in columns}


class CsvFile(NamedTuple):
    path: Path
    header: list[str]
    rows: dict[int, list[str]]  # line on which a row begins -> its cells

    @classmethod
    def read(cls, path: Path) -> CsvFile:
        """Raises ``InvalidInput`` if the file is not CSV or has no rows."""
        rows, line = dict[int, list[str]](), 1
        data = read_plain(path, CSV_SIZE_LIMIT)
        try:
            reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
            for row in reader:
                rows |= {line: row} if row else {}  # without blank lines
                line = reader.line_num + 1
        except (csv.Error, ValueError) as error:
            raise InvalidInput(f"{path}: cannot be read as CSV: {error}") from None
        if len(rows) < 2:
            raise InvalidInput(f"{path}: must have a header, for instance gap_1_m,gap_2_m,speed_1_mps,... and rows")
        first, *_ = rows
        header = [name.strip() for name in rows.pop(first)]
        for mark, what in ((";", "semicolons"), ("\t", "tabs")):
            if len(header) == 1 and mark in header[0]:
                raise InvalidInput(
                    f"{path}, line {first}: columns are separated by {what}; separate them by commas, and write"
                    " decimals with a point (in Excel: save as CSV with English number formats)"
                )
        return cls(path, header, rows)

    def cells(self, columns: Sequence[str], texts_in: Collection[str] = (RECORDING,)) -> list[list[float | str]]:
        """Cells of ``columns``, row by row: numbers, but texts in the columns ``texts_in``. Raises ``InvalidInput``."""
        cells: list[list[Any]] = []
        for line, row in self.rows.items():
            if len(row) != len(self.header):
                raise InvalidInput(
                    f"{self.path}, line {line}: has {len(row)} values, but the header has {len(self.header)} columns"
                )
            texts = dict(zip(self.header, map(str.strip, row), strict=True))
            numbers = {name: parse_numeral(texts[name]) for name in columns if name not in texts_in}
            if bad := [name for name, number in numbers.items() if number is None]:
                raise InvalidInput(f"{self.path}, line {line}, column {bad[0]}: {texts[bad[0]]!r:.60} is not a number")
            cells.append([{**texts, **numbers}[name] for name in columns])
        return cells


def read_rows(path: Path, columns: object) -> list[list[float | str]]:
    """``columns``: the value of this key in a scenario's ``table``.

    Ranges are not checked. Raises ``InvalidInput`` for a column that is missing or occurs twice.
    """
    file = CsvFile.read(path)
    hint = f"the columns of this file are {', '.join(file.header)}"
    if not isinstance(columns, list | tuple):
        raise InvalidInput(f"{path}: columns = {columns!r:.60}: must be a list; {hint}")
    for name in columns:
        if file.header.count(name) != 1:
            missing = f"is missing; {suggestion(str(name), file.header) or hint}"
            raise InvalidInput(f"{path}: column {name!r:.60} {'occurs twice' if name in file.header else missing}")
    return file.cells(columns)
