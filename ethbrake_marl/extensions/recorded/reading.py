"""Read the columns of a text file of recorded traffic as numbers and names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow
from pyarrow import compute, csv

from ethbrake_marl.errors import InvalidInput, plain_text
from ethbrake_marl.extensions.recorded.formats import VEHICLE_PLACEHOLDER, Format
from ethbrake_marl.files.plain import open_plain

HEADER_LINES = 11  # number of first lines that may be the header
LONGEST_HEAD, LARGEST_BYTES = 1 << 16, 1 << 40  # limits of a line of the heading and of a file, in bytes
OTHER_NAMES = {"preceeding": "preceding"}  # misspelt column in some files of NGSIM


class NotARecording(InvalidInput):
    """A file lacks more than half of the columns of its format."""


class Cells(NamedTuple):
    """Columns of a recorded file that its format uses. Index of ``frame``: number of the row in the file, from 0."""

    file: Path
    names: Mapping[str, str]  # quantity -> name of its column; for numbered columns ``speed1``, ``speed2``, ...
    heading: int  # number of lines up to the header
    frame: Any  # quantity -> finite numbers, or texts; in a format with gaps an empty cell is NaN

    def place(self, row: int, quantity: str = "") -> str:
        with reading(self.file) as stream:
            lines = (number for number, line in enumerate(stream, 1) if number > self.heading and line.strip())
            line = next(islice(lines, row, None))
        return f"{self.file}, line {line}{f', column {self.names[quantity]}' if quantity else ''}"

    def refuse(self, bad: Any, quantity: str, values: Any, right: str) -> None:
        """Raise ``InvalidInput`` with file, line and column of the first value in the mask ``bad``, if there is one."""
        if bad.any():
            row = bad.idxmax()
            raise InvalidInput(f"{self.place(row, quantity)}: {values[row]:.12} {right}")


@contextmanager
def reading(file: Path) -> Iterator[BufferedReader]:
    """Open a file. Errors of pyarrow, and bytes that are no text, become ``InvalidInput``."""
    try:
        with open_plain(file, LARGEST_BYTES) as stream:
            yield stream
    except (pyarrow.ArrowException, UnicodeDecodeError) as error:
        right = "rows are counted from the header; is the file complete?"
        raise InvalidInput(f"{file}: cannot be read ({plain_text(str(error))[:200]}); {right}") from None


def read_cells(file: Path, entry: Format) -> Cells:
    """Columns that the format ``entry`` uses, without lines before the header and without ``entry.streets``.

    Raises ``InvalidInput``, with file, line and column, for a missing or repeated column, and a cell that is empty or
    not a number; ``NotARecording`` if more than half of the columns are missing.
    """
    with reading(file) as stream:
        heading, separator, names, at = _header(file, entry, stream)
        # Columns are named by their places, because the names in a header may occur twice.
        column_numbers = [str(k) for k in at.values()]
        table = csv.read_csv(
            stream,
            csv.ReadOptions(column_names=[str(k) for k in range(len(names))], use_threads=False),
            csv.ParseOptions(delimiter=separator),
            csv.ConvertOptions(
                include_columns=column_numbers, column_types=dict.fromkeys(column_numbers, pyarrow.string())
            ),
        )
    columns: dict[str, Any] = {}
    cells = Cells(file, {quantity: names[k] for quantity, k in at.items()}, heading, None)
    for quantity, name in zip(at, column_numbers, strict=True):
        column = table.column(name)
        if quantity in entry.texts:
            columns[quantity] = compute.utf8_trim_whitespace(column).to_pandas()
        else:
            columns[quantity] = _numbers(cells, quantity, column, entry.gaps and quantity != "time")
    frame = pd.DataFrame(columns)
    return cells._replace(frame=frame[~frame["location"].isin(entry.streets)] if "location" in frame else frame)


def _header(file: Path, entry: Format, stream: BufferedReader) -> tuple[int, str, Sequence[str], dict[str, int]]:
    """Line number of the header (from 1), separator, names of all columns, and quantity -> place of its column (from
    0).

    The header is the first line with all columns of the format. Without one, raises ``NotARecording`` if the best line
    lacks more than half of them, else ``InvalidInput``.
    """
    missing = list(entry.columns.values())
    for number in range(1, HEADER_LINES + 1):
        line = stream.readline(LONGEST_HEAD).decode("utf-8-sig")
        for separator in ",;\t":
            names = [cell.strip().strip('"') for cell in line.split(separator)]
            at, lacking = _match(file, entry, names)
            if not lacking:
                return number, separator, names, at
            missing = min(missing, lacking, key=len)
    refusal = NotARecording if 2 * len(missing) > len(entry.columns) else InvalidInput
    raise refusal(f"{file}: lacks columns that files of {entry.title} have: {', '.join(missing)}")


def _match(file: Path, entry: Format, names: Sequence[str]) -> tuple[dict[str, int], list[str]]:
    """Quantity -> place of its column in ``names`` (from 0), and the format's columns that ``names`` lacks."""
    at, missing, twice = dict[str, int](), list[str](), list[str]()
    for quantity, column in entry.columns.items():
        pattern = re.escape(column.lower()).replace(re.escape(VEHICLE_PLACEHOLDER), "([1-9][0-9]*)")
        matches = [re.fullmatch(pattern, OTHER_NAMES.get(name.lower(), name.lower())) for name in names]
        for k, match in enumerate(matches):
            key = "".join([quantity, *match.groups()]) if match else ""
            if key in at:
                twice.append(names[k])
            elif key:
                at[key] = k
        if not any(matches) and quantity not in entry.optional:
            missing.append(column)
    if twice and not missing:
        raise InvalidInput(f"{file}: column {', '.join(twice)}: each name must occur only once")
    return at, missing


def _numbers(cells: Cells, quantity: str, column: Any, may_be_empty: bool) -> Any:
    """Cells of a column as numbers; commas may group thousands. Empty cells become NaN if they are allowed."""
    try:
        values = column.cast(pyarrow.float64()).to_numpy()
    except pyarrow.ArrowException:
        texts = column.to_pandas().str.strip().str.replace(r"(?<=\d),(?=\d{3}(\D|$))", "", regex=True)
        values = pd.to_numeric(texts, errors="coerce").to_numpy(np.float64)
    for k in np.flatnonzero(~np.isfinite(values)):
        cell = column[k].as_py().strip()
        if not may_be_empty or cell.lower() not in ("", "nan"):
            place = cells.place(int(k), quantity)
            raise InvalidInput(f"{place}: must be a finite number, but is {repr(cell) if cell else 'empty'}"[:300])
    return values
