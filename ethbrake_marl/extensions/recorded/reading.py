"""Read the columns of a file of recorded traffic (CSV, text with blanks, Parquet) as numbers, one batch at a time."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from ethbrake_marl.first_edition.physics.state import Floats

HEAD = 11  # number of first lines that may be the header

BATCH_BYTES, BATCH_ROWS = 1 << 23, 1 << 17  # amount of a text file and of a Parquet file that is read at once

LONGEST_HEAD, LARGEST_BYTES = 1 << 16, 1 << 40  # limits of a line of the heading and of a file, in bytes

_OTHER_NAMES = {"preceeding": "preceding"}  # misspelt column in some files of NGSIM

_THOUSANDS = re.compile(r"-?\d{1,3}(,\d{3})+(\.\d*)?")  # number with a comma after every thousand


class NotARecording(InvalidInput):
    """Raised for a file that is not a recording, because it lacks more than half of the format's columns."""


class Source(NamedTuple):
    """A file of recorded traffic, and where its columns are."""

    file: Path
    names: Sequence[str]  # names of all columns
    at: Mapping[str, int]  # quantity -> index of its column; for numbered columns ``speed1``, ``speed2``, ...
    heading: int = 0  # number of lines up to the header
    separator: str = ","

    def place(self, row: int, quantity: str = "") -> str:
        """Return the place of a row (0 is the first) for error messages: file, line or row, and column."""
        column = f", column {self.names[self.at[quantity]]}" if quantity else ""
        if _is_parquet(self.file):
            return f"{self.file}, row {row + 1}{column}"
        with _reading(self.file) as stream:
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


def open_source(file: Path, entry: Format) -> Source:
    """Find the columns of a format in a file.

    Raises ``InvalidInput`` if a column is missing, or ``NotARecording`` if more than half of them are, and if two
    columns have the same name.
    """
    missing = list(entry.columns.values())
    with _reading(file) as stream:
        for names, heading, separator in _headers(file, entry, stream):
            at, lacking = _match(file, entry, names)
            if not lacking:
                return Source(file, names, at, heading, separator)
            missing = min(missing, lacking, key=len)
    refusal = NotARecording if 2 * len(missing) > len(entry.columns) else InvalidInput
    raise refusal(f"{file}: lacks columns that files of {entry.title} have: {', '.join(missing)}")


def read_columns(
    source: Source, entry: Format, quantities: Sequence[str], progress: Callable[[int, int], None]
) -> Iterator[Any]:
    """Yield the columns of these quantities as data frames, whose index is the number of the row in the file.

    Numbers are finite, but if the format has gaps, empty cells are NaN. Names are texts. ``progress`` is called with
    the amount of data read so far and the size of the file (KiB).

    Raises ``InvalidInput``, which names file, line and column, for a cell that is empty or not a number.
    """
    first, names = 0, [str(source.at[quantity]) for quantity in quantities]
    with _reading(source.file) as stream:
        for batch in _parquet(stream, names) if _is_parquet(source.file) else _text(source, stream, names):
            progress(stream.tell() >> 10, os.fstat(stream.fileno()).st_size >> 10)
            columns = {}
            for quantity, name in zip(quantities, names, strict=True):
                cells = batch.column(name)
                if quantity in entry.texts:
                    cells = compute.fill_null(cells.cast(pyarrow.string()), "")
                    columns[quantity] = compute.utf8_trim_whitespace(cells).to_pandas()
                else:
                    columns[quantity] = _numbers(source, quantity, cells, first, entry.gaps and quantity != "time")
            rows = pd.DataFrame(columns).set_axis(range(first, first + batch.num_rows))
            yield rows[~rows["location"].isin(entry.streets)] if "location" in rows else rows
            first += batch.num_rows


def _is_parquet(file: Path) -> bool:
    return file.suffix.lower() == ".parquet"


@contextmanager
def _reading(file: Path) -> Iterator[BufferedReader]:
    try:
        with open_plain(file, LARGEST_BYTES) as stream:
            yield stream
    except pyarrow.ArrowException as error:
        right = "rows are counted from the header; is the file complete?"
        raise InvalidInput(f"{file}: cannot be read ({plain_text(str(error))[:200]}); {right}") from None


def _headers(file: Path, entry: Format, stream: BufferedReader) -> Iterator[tuple[Sequence[str], int, str]]:
    """Yield what may be the names of the columns, the number of lines up to the header, and the separator."""
    if _is_parquet(file):
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
    small = [_OTHER_NAMES.get(name.lower(), name.lower()) for name in names]
    at, missing, twice = dict[str, int](), list[str](), list[str]()
    for quantity, column in entry.columns.items():
        pattern = re.escape(column.lower()).replace(re.escape(NUMBER), "([1-9][0-9]*)")
        matches = [(k, match) for k, name in enumerate(small) if (match := re.fullmatch(pattern, name))]
        for k, match in matches:
            key = "".join([quantity, *match.groups()])
            if key in at:
                twice.append(names[k])
            at[key] = k
        if not matches:
            missing.append(column)
    if twice and not missing:
        raise InvalidInput(f"{file}: column {', '.join(twice)}: each name must occur only once")
    if entry.streets and "location" in small:
        at["location"] = small.index("location")
    return at, missing


def _parquet(stream: BufferedReader, used: Sequence[str]) -> Iterator[Any]:
    table = ParquetFile(stream)
    names = table.schema_arrow.names
    for batch in table.iter_batches(BATCH_ROWS, columns=[names[int(k)] for k in used]):
        yield batch.rename_columns([str(names.index(name)) for name in batch.schema.names])


def _text(source: Source, stream: BufferedReader, used: Sequence[str]) -> Iterator[Any]:
    for _ in range(source.heading):
        stream.readline()
    text: Any = stream
    if source.separator == " ":
        text = BytesIO(re.sub(rb"[ \t]+", b",", re.sub(rb"(?m)^[ \t]+|[ \t\r]+$", b"", stream.read())))
    names = [str(k) for k in range(len(source.names))]
    yield from csv.open_csv(
        text,
        csv.ReadOptions(column_names=names, block_size=BATCH_BYTES, use_threads=False),
        csv.ParseOptions(delimiter=source.separator.replace(" ", ",")),
        csv.ConvertOptions(include_columns=used, column_types=dict.fromkeys(used, pyarrow.string())),
    )


def _numbers(source: Source, quantity: str, cells: Any, first: int, empty_cells: bool) -> Floats:
    try:
        values: Floats = cells.cast(pyarrow.float64()).to_numpy(zero_copy_only=False)
    except pyarrow.ArrowException:
        texts = [(cell or "").strip() for cell in cells.cast(pyarrow.string()).to_pylist()]
        values = np.array([_number(cell, source.separator) for cell in texts])
    for k in np.flatnonzero(~np.isfinite(values)):
        cell = str(cells[k].as_py() or "").strip()
        if not empty_cells or cell.lower() not in ("", "nan"):
            place = source.place(first + int(k), quantity)
            raise InvalidInput(f"{place}: must be a finite number, but is {repr(cell) if cell else 'empty'}"[:300])
    return values


def _number(cell: str, separator: str) -> float:
    """Return the number in a cell; NaN if it is not a number."""
    if separator == "," and _THOUSANDS.fullmatch(cell):  # with other separators, a comma may be a decimal comma
        cell = cell.replace(",", "")
    number = parse_numeral(cell)
    return math.nan if number is None else number
