"""Tables of measured values: every world takes one row, with the same row for all its columns."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from operator import not_
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, model_validator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import UNSHOWN, refuse, require, suggestion
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.quantity import Number, Numbers, Part, pick, positive
from ethbrake_marl.worlds.rules import RECORDING, RULES, Entry

SIZE_LIMIT = 64 << 20  # bytes of a CSV file

Cell = Annotated[
    Annotated[Number, Tag("#number")] | Annotated[str, Tag("#text")],
    Discriminator(lambda value: "#text" if isinstance(value, str) else "#number"),
]
Row = Annotated[tuple[Cell, ...], Field(strict=False)]


@dataclass(frozen=True, slots=True, eq=False)
class TableColumn:
    """A column of a table, which is drawn like a distribution."""

    rows: NDArray[Any]  # value of each row; texts in the column ``recording``
    weights: Floats  # of each row

    @property
    def support(self) -> tuple[float, float]:
        return float(self.rows.min()), float(self.rows.max())

    def value(self, u: Floats) -> NDArray[Any]:
        return self.rows[pick(self.weights, u)]


class Table(Part):
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
    weights: str | Numbers | None = Field(
        default=None,
        exclude_if=not_,
        description="how likely each row is: a list with one number per row, or the name of a column of the file",
    )
    rows: Annotated[tuple[Row, ...], Field(strict=False, min_length=1)] | None = Field(
        default=None, description="rows with one number per column (a text for recording); left out if file is given"
    )

    @model_validator(mode="after")
    def _complete(self) -> Table:
        both = "cannot be combined with rows; leave one of them out"
        require(not (self.file and self.rows), ("file",), self.file, both)
        read = "must be given as lists here; only load_scenario reads the rows from a file"
        require(self.rows is not None and not isinstance(self.weights, str), ("rows",), UNSHOWN, read)
        for k, row in enumerate(self.rows or ()):
            right = f"has {len(row)} values; must have one for each of the {len(self.columns)} columns"
            require(len(row) == len(self.columns), ("rows", k), UNSHOWN, right)
        require(len({*self.columns}) == len(self.columns), ("columns",), self.columns, "must not list a column twice")
        require(self.columns != (RECORDING,), ("columns",), self.columns, "must also have a column of numbers")
        if isinstance(self.weights, tuple):
            fits = f"must be {len(self.rows or ())} numbers, one per row, all above 0 and with a finite sum"
            good = len(self.weights) == len(self.rows or ()) and positive(self.weights)
            require(good, ("weights",), UNSHOWN, fits)
        return self

    def check_cells(self, known: Mapping[str, Entry]) -> None:
        """Raise, in a pydantic validator, the error for a column that is not ``known``, or a bad cell."""
        hint = f"known: {', '.join((*known, RECORDING))}"
        for c, name in enumerate(self.columns):
            rule = RULES[known[name][0]] if name in known else None
            unknown = f"unknown column; {suggestion(name, known) or hint}"
            require(rule is not None or name == RECORDING, ("columns",), name, unknown)
            right = f"{name} must be {rule.interval if rule else 'a printable text, such as drive_1.csv: 2-3-4'}"
            for k, cell in enumerate(row[c] for row in self.rows or ()):
                if isinstance(cell, str):
                    good = rule is None and cell.isprintable() and cell.strip() == cell != ""
                else:
                    good = rule is not None and rule.allows(cell, cell)
                if not good:
                    refuse(("rows", k, c), cell, right)

    def to_csv(self) -> str:
        """Return the rows as the text of a CSV file; its column ``weight`` has their weights."""
        weighed = isinstance(self.weights, tuple)
        rows = [[*row, self.weights[k]] if weighed else row for k, row in enumerate(self.rows or ())]  # type: ignore[index]
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([[*self.columns, *(["weight"] if weighed else [])], *rows])
        return text.getvalue()

    def column_values(self) -> dict[str, TableColumn]:
        """Return the columns by name, ``recording`` among them."""
        rows = self.rows or ()
        weights = np.asarray(self.weights if isinstance(self.weights, tuple) else (1.0,) * len(rows))
        columns = zip(self.columns, zip(*rows, strict=True), strict=True)
        return {name: TableColumn(np.array(column), weights) for name, column in columns}


class CsvFile(NamedTuple):
    """A CSV file with a header and at least one row; its cells are unchecked texts."""

    path: Path
    header: list[str]
    rows: list[list[str]]
    lines: list[int]  # line on which each row begins

    @classmethod
    def read(cls, path: Path) -> CsvFile:
        """Read a file. Raises ``InvalidInput`` if it is no CSV file, or has no header or no row."""
        rows, lines = list[list[str]](), [1]
        data = read_plain(path, SIZE_LIMIT)
        try:
            reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
            for row in reader:
                rows.append(row)
                lines.append(reader.line_num + 1)
        except (csv.Error, ValueError) as error:
            raise InvalidInput(f"{path}: cannot be read as CSV: {error}") from None
        while rows and not rows[-1]:
            rows.pop()  # blank lines at the end
        if not rows or not rows[0]:
            raise InvalidInput(f"{path}, line 1: must name the columns, for instance gap_1_m,gap_2_m,speed_1_mps,...")
        if len(rows) == 1:
            raise InvalidInput(f"{path}: has a header but no rows; add one row per world")
        return cls(path, [name.strip() for name in rows[0]], rows[1:], lines[1:])

    def cells(self, columns: list[str]) -> list[list[float | str]]:
        """Return the ``columns`` of each row: numbers, and texts in the column ``recording``."""
        cells = []
        for row, line in zip(self.rows, self.lines, strict=False):
            if len(row) != len(self.header):
                raise InvalidInput(
                    f"{self.path}, line {line}: has {len(row)} values, but the header has {len(self.header)} columns"
                )
            texts = dict(zip(self.header, row, strict=True))
            cells.append([self._cell(texts[name].strip(), line, name) for name in columns])
        return cells

    def _cell(self, text: str, line: int, column: str) -> float | str:
        number = parse_numeral(text)
        if number is None and column != RECORDING:
            raise InvalidInput(f"{self.path}, line {line}, column {column}: {text!r:.60} is not a number")
        return text if number is None or column == RECORDING else number


def read_rows(path: Path, columns: object, weights: object) -> dict[str, Any]:
    """Return ``rows`` of a scenario's table, and ``weights`` unless they are None, from a CSV file.

    ``columns`` and ``weights`` are names of columns as the scenario file has them; this function checks them.
    """
    file = CsvFile.read(path)
    if not isinstance(columns, list | tuple):
        raise InvalidInput(
            f"{path}: columns = {columns!r:.60}: must be a list of columns of this file, which are"
            f" {', '.join(file.header)}"
        )
    names = [*columns, *([] if weights is None else [weights])]
    for name in names:
        if file.header.count(name) != 1:
            many = "occurs twice" if name in file.header else f"is missing; {suggestion(str(name), file.header)}"
            raise InvalidInput(f"{path}, line 1: column {name!r:.60} {many.removesuffix('; ')}")
    cells = file.cells(names)
    rows = {"rows": [row[: len(columns)] for row in cells]}
    return rows if weights is None else {**rows, "weights": [row[-1] for row in cells]}
