"""Read the columns of a file of recorded traffic (CSV, text with blanks, Parquet) as numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BufferedReader, BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow
from pyarrow import compute, csv
from pyarrow.parquet import ParquetFile

from ethbrake_marl.errors import InvalidInput, plain_text
from ethbrake_marl.extensions.recorded.formats import NUMBER, Format
from ethbrake_marl.files.plain import open_plain
from ethbrake_marl.files.yaml import parse_numeral

HEAD = 11  # number of first lines that may be the header
LONGEST_HEAD, LARGEST_BYTES = 1 << 16, 1 << 40  # limits of a line of the heading and of a file, in bytes
OTHER_NAMES = {"preceeding": "preceding"}  # misspelt column in some files of NGSIM
THOUSANDS = re.compile(r"-?\d{1,3}(,\d{3})+(\.\d*)?")  # number with a comma after every thousand


class NotARecording(InvalidInput):
    """Raised for a file that is not a recording, because it lacks more than half of the format's columns."""


class Source(NamedTuple):
    """A file of recorded traffic, and where its columns are."""

    file: Path
    names: Sequence[str]  # names of all columns
    at: Mapping[str, int]  # quantity -> index of its column; for numbered columns ``speed1``, ``speed2``, ...
    heading: int = 0  # number of lines up to the header
    separator: str = ","

    @property
    def is_parquet(self) -> bool:
        return self.file.suffix.lower() == ".parquet"

    def place(self, row: int, quantity: str = "") -> str:
        """Return the place of a row (0 is the first) for error messages: file, line or row, and column."""
        column = f", column {self.names[self.at[quantity]]}" if quantity else ""
        if self.is_parquet:
            return f"{self.file}, row {row + 1}{column}"
        with reading(self.file) as stream:
            lines = (number for number, line in enumerate(stream, 1) if number > self.heading and line.strip())
            return f"{self.file}, line {next(islice(lines, row, None))}{column}"

    def refuse(self, bad: Any, quantity: str, values: Any, right: str) -> None:
        """Raise ``InvalidInput``, which names file, line and column, if at least one value is wrong.

        ``bad`` and ``values`` are series with the number of the row as index. The message shows the first wrong value;
        ``right`` is its end, which says what a valid value is.
        """
        if bad.any():
            row = bad.idxmax()
            raise InvalidInput(f"{self.place(row, quantity)}: {values[row]:.12} {right}")


@contextmanager
def reading(file: Path) -> Iterator[BufferedReader]:
    """Open a file; what goes wrong inside pyarrow is one ``InvalidInput``."""
    try:
        with open_plain(file, LARGEST_BYTES) as stream:
            yield stream
    except pyarrow.ArrowException as error:
        right = "rows are counted from the header; is the file complete?"
        raise InvalidInput(f"{file}: cannot be read ({plain_text(str(error))[:200]}); {right}") from None


def open_source(file: Path, entry: Format) -> Source:
    """Find the columns of a format in a file.

    Raises ``InvalidInput`` if a column is missing, or ``NotARecording`` if more than half of them are, and if two
    columns have the same name.
    """
    missing = list(entry.columns.values())
    with reading(file) as stream:
        for names, heading, separator in _headers(file, entry, stream):
            at, lacking = _match(file, entry, names)
            if not lacking:
                return Source(file, names, at, heading, separator)
            missing = min(missing, lacking, key=len)
    refusal = NotARecording if 2 * len(missing) > len(entry.columns) else InvalidInput
    raise refusal(f"{file}: lacks columns that files of {entry.title} have: {', '.join(missing)}")


def _headers(file: Path, entry: Format, stream: BufferedReader) -> Iterator[tuple[Sequence[str], int, str]]:
    """Yield what may be the names of the columns, the number of lines up to the header, and the separator."""
    if Source(file, [], {}).is_parquet:
        yield ParquetFile(stream).schema_arrow.names, 0, ","
        return
    for number in range(1, HEAD + 1):
        line = stream.readline(LONGEST_HEAD).decode("utf-8-sig")
        row = line.split()
        if number == 1 and 2 * sum(parse_numeral(cell) is not None for cell in row) > len(row) > 1:
            yield entry.headless, 0, " "
        for separator in ",;\t":
            yield [cell.strip().strip('"') for cell in line.split(separator)], number, separator


def _match(file: Path, entry: Format, names: Sequence[str]) -> tuple[dict[str, int], list[str]]:
    """Find the columns of a format among ``names``; return their indices by quantity, and the missing columns."""
    at, missing, twice = dict[str, int](), list[str](), list[str]()
    for quantity, column in entry.columns.items():
        pattern = re.escape(column.lower()).replace(re.escape(NUMBER), "([1-9][0-9]*)")
        before = len(at) + len(twice)
        for k, name in enumerate(names):
            match = re.fullmatch(pattern, OTHER_NAMES.get(name.lower(), name.lower()))
            key = "".join([quantity, *match.groups()]) if match else ""
            if key in at:
                twice.append(name)
            elif key:
                at[key] = k
        if len(at) + len(twice) == before and quantity not in entry.optional:
            missing.append(column)
    if twice and not missing:
        raise InvalidInput(f"{file}: column {', '.join(twice)}: each name must occur only once")
    return at, missing


def read_columns(source: Source, entry: Format) -> Any:
    """Return the columns of a file as a data frame, whose index is the number of the row in the file.

    Numbers are finite, but if the format has gaps, empty cells are NaN. Names are texts. Raises ``InvalidInput``, which
    names file, line and column, for a cell that is empty or not a number.
    """
    columns, used = {}, [str(k) for k in source.at.values()]
    with reading(source.file) as stream:
        if source.is_parquet:
            table = ParquetFile(stream).read([source.names[k] for k in source.at.values()])
            table = table.rename_columns([str(source.names.index(name)) for name in table.column_names])
        else:
            table = _text(source, stream, used)
        for quantity, name in zip(source.at, used, strict=True):
            cells = table.column(name)
            if quantity in entry.texts:
                cells = compute.fill_null(cells.cast(pyarrow.string()), "")
                columns[quantity] = compute.utf8_trim_whitespace(cells).to_pandas()
            else:
                columns[quantity] = _numbers(source, quantity, cells, entry.gaps and quantity != "time")
    rows = pd.DataFrame(columns)
    return rows[~rows["location"].isin(entry.streets)] if "location" in rows else rows


def _text(source: Source, stream: Any, used: Sequence[str]) -> Any:
    for _ in range(source.heading):
        stream.readline()
    if source.separator == " ":
        stream = BytesIO(re.sub(rb"[ \t]+", b",", re.sub(rb"(?m)^[ \t]+|[ \t\r]+$", b"", stream.read())))
    return csv.read_csv(
        stream,
        csv.ReadOptions(column_names=[str(k) for k in range(len(source.names))], use_threads=False),
        csv.ParseOptions(delimiter=source.separator.replace(" ", ",")),
        csv.ConvertOptions(include_columns=used, column_types=dict.fromkeys(used, pyarrow.string())),
    )


def _numbers(source: Source, quantity: str, cells: Any, may_be_empty: bool) -> Any:
    try:
        values = cells.cast(pyarrow.float64()).to_numpy()
    except pyarrow.ArrowException:
        values = np.array([_number(cell or "", source.separator) for cell in cells.cast(pyarrow.string()).to_pylist()])
    for k in np.flatnonzero(~np.isfinite(values)):
        cell = str(cells[k].as_py() or "").strip()
        if not may_be_empty or cell.lower() not in ("", "nan"):
            place = source.place(int(k), quantity)
            raise InvalidInput(f"{place}: must be a finite number, but is {repr(cell) if cell else 'empty'}"[:300])
    return values


def _number(cell: str, separator: str) -> float:
    """Return the number in a cell; NaN if it is not a number."""
    cell = cell.strip()
    if separator == "," and THOUSANDS.fullmatch(cell):  # with other separators, a comma may be a decimal comma
        cell = cell.replace(",", "")
    number = parse_numeral(cell)
    return math.nan if number is None else number
