"""Read files of recorded traffic (CSV, text with blanks, Parquet), some lines at a time.

Each row of numbers is stored with its line number for error messages. In a Parquet file this is the row number.
"""

from __future__ import annotations

import csv
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from io import TextIOWrapper
from itertools import chain, count, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, naming_extras
from ethbrake_marl.extensions.recorded.formats import FORMATS, NUMBER, REFUSED, Format
from ethbrake_marl.files.plain import open_plain
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.physics.state import Bools, Floats

PIECE, HEAD = 50_000, 11  # number of lines that are read at once; number of first lines that may be the header

LONGEST_LINE, LARGEST_BYTES = 1 << 16, 1 << 40  # limits of a line (characters) and of a file

_OTHER_NAMES = {"preceeding": "preceding"}  # misspelt column in some files of NGSIM

_THOUSANDS = re.compile(r"-?\d{1,3}(,\d{3})+(\.\d*)?")  # number with a comma after every thousand

_Row = tuple[int, Sequence[str]]  # number of the line, and its cells

_Table = tuple[Sequence[str], Sequence[int], Iterator[_Row]]  # names of all columns, indices of columns to read, rows


class NotARecording(InvalidInput):
    """Raised for a file that is not a recording, because it lacks more than half of the format's columns."""


class Piece(NamedTuple):
    """Consecutive rows of a file, as numbers."""

    file: Path  # path of the file
    columns: Sequence[str]  # names of the columns that were read
    values: Floats  # [rows, columns] numbers in these columns
    lines: Floats  # [rows] number of the line of each row

    def refuse(self, bad: Bools, k: int, right: str, shown: Floats | None = None) -> None:
        """Raise ``InvalidInput``, which names file, line and column, if at least one value of column ``k`` is wrong.

        ``bad`` [rows] is True for wrong rows; the message names the first. ``right`` is the end of the message, which
        says what a valid value is. ``shown`` [rows] are values to show instead of those in column ``k``, for instance
        in another unit.
        """
        if bad.any():
            value = (self.values[:, k] if shown is None else shown)[bad][0]
            place = place_of(self.file, self.lines[bad][0])
            raise InvalidInput(f"{place}, column {self.columns[k]}: {value:.12g} {right}")


def place_of(file: Path, line: float) -> str:
    """Return the place of a row for error messages: the file, and the line number (in a Parquet file, row number)."""
    return f"{file}, {'row' if _is_parquet(file) else 'line'} {line:.0f}"


def read_pieces(
    file: Path,
    entry: Format,
    columns: Sequence[str],
    names: dict[str, float] | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Iterator[Piece]:
    """Yield the numbers in the columns ``columns`` of a file, in this order, with up to ``PIECE`` rows at a time.

    All numbers are finite, but if the format has gaps instead of positions, empty cells become NaN. ``names`` maps
    names of vehicles and lanes to numbers, for columns that contain names; new names are added to it. ``progress`` is
    called with the amount of data read so far and the size of the file (KiB).

    Raises ``InvalidInput``, which names file, line and column, for a missing column or a cell that is not a number.
    Raises ``NotARecording`` for a table that is not a recording of traffic.
    """
    with open_plain(file, LARGEST_BYTES) as stream:
        text, empty = TextIOWrapper(stream, "utf-8-sig"), True
        shown, used, rows = (_parquet if _is_parquet(file) else _text)(text, file, entry, columns)
        later, names = _measured if entry.gaps else _number, {} if names is None else names
        read = [partial(_number_of, names) if k in entry.texts else later if k else _number for k in range(len(used))]
        numbers, head = _numbers(file, rows, shown, list(zip(used, read, strict=True))), [shown[k] for k in used]
        while some := list(islice(numbers, PIECE)):
            progress(stream.tell() >> 10, os.fstat(stream.fileno()).st_size >> 10)
            piece = Piece(file, head, np.array([values for _, values in some]), np.array([line for line, _ in some]))
            for k in range(len(used)):
                value = piece.values[:, k]
                piece.refuse(
                    np.isinf(value) | (np.isnan(value) & (not entry.gaps or k == 0)), k, "must be a finite number"
                )
            empty = False
            yield piece
        if empty:
            raise InvalidInput(f"{file}: contains no rows of data")


def _is_parquet(file: Path) -> bool:
    return file.suffix.lower() == ".parquet"


def _numbers(
    file: Path, rows: Iterable[_Row], shown: Sequence[str], readers: Sequence[tuple[int, Callable[[str], float]]]
) -> Iterator[tuple[int, list[float]]]:
    """Yield, for each row, its line number and the numbers in the cells that ``readers`` selects.

    ``readers`` has, for each cell to read, its index and the function that converts its text to a number.
    """
    for line, cells in rows:
        if len(cells) != len(shown):
            right = f"but the header names {len(shown)} columns; is the file complete?"
            raise InvalidInput(f"{place_of(file, line)}: the line has {len(cells)} values, {right}")
        k = 0
        try:
            yield line, [reader(cells[k := at]) for at, reader in readers]
        except ValueError:
            cell = cells[k].strip()
            right = f"{cell!r:.60} is not a number" if cell else "the value is empty"
            raise InvalidInput(f"{place_of(file, line)}, column {shown[k]}: {right}") from None


def _parquet(text: TextIOWrapper, file: Path, entry: Format, columns: Sequence[str]) -> _Table:
    """Open a Parquet file; return the names of the columns to read, their indices, and an iterator over the rows."""
    with naming_extras():
        import pyarrow
        from pyarrow.parquet import ParquetFile

    @contextmanager
    def refusing() -> Iterator[None]:
        try:
            yield
        except (pyarrow.ArrowException, OSError) as error:
            raise InvalidInput(f"{file}: cannot be read as Parquet ({error})") from None

    def rows() -> Iterator[_Row]:
        number = count(1)
        with refusing():
            for batch in table.iter_batches(PIECE, columns=names):
                cells = [column.cast(pyarrow.string()).fill_null("").to_pylist() for column in batch.columns]
                yield from ((next(number), row) for row in zip(*cells, strict=True))

    with refusing():
        table = ParquetFile(text.buffer)
    used, missing = _match(file, columns, table.schema_arrow.names)
    if missing:
        raise _unknown(file, entry, missing, table.schema_arrow.names)
    names = [table.schema_arrow.names[k] for k in used]
    return names, range(len(names)), rows()


def _text(text: TextIOWrapper, file: Path, entry: Format, columns: Sequence[str]) -> _Table:
    """Find the header among the first lines of a text file.

    Returns the names of all columns, the indices of the columns ``columns``, and an iterator over the rows of data.
    """
    lines, best, have = _lines(file, text), list(columns), list[str]()
    for number, line in islice(lines, HEAD):
        row = line.split()
        numbers = sum(parse_numeral(cell) is not None for cell in row)
        if entry.headless and number == 1 and 2 * numbers > len(row) > 1:
            if len(row) != len(entry.headless):
                right = f"in a text file of {entry.title} without a header each line has {len(entry.headless)}"
                raise InvalidInput(f"{file}, line {number}: the line has {len(row)} values; {right}")
            used, _ = _match(file, columns, entry.headless)
            return entry.headless, used, _rows(file, chain([(number, line)], lines), " ", entry.elsewhere)
        for separator in entry.separators:
            shown = [cell.strip() for cell in _cells(line, separator)]
            used, missing = _match(file, columns, shown)
            if not missing:
                return shown, used, _rows(file, lines, separator, entry.elsewhere)
            best, have = min(best, missing, key=len), have + shown
    raise _unknown(file, entry, best, have)


def _rows(file: Path, lines: Iterator[tuple[int, str]], separator: str, streets: Sequence[str]) -> Iterator[_Row]:
    """Yield line number and cells of each line that is not blank and contains none of the texts in ``streets``."""
    elsewhere = seen = 0
    for number, line in lines:
        if streets and any(street in line for street in streets):
            elsewhere += 1
        elif line.strip():
            seen += 1
            yield number, _cells(line, separator)
    if elsewhere and not seen:
        raise InvalidInput(
            f"{file}: all {elsewhere:,} rows are from {' or '.join(streets)}, which have crossings; such rows are left"
            " out; give recordings of a motorway"
        )


def _lines(file: Path, text: TextIOWrapper) -> Iterator[tuple[int, str]]:
    for number, line in zip(count(1), iter(partial(text.readline, LONGEST_LINE), ""), strict=False):
        if len(line) == LONGEST_LINE:
            raise InvalidInput(f"{file}, line {number}: the line must have fewer than {LONGEST_LINE:,} characters")
        yield number, line


def _cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line, without quotes and without commas between thousands.

    If ``separator`` is " ", any number of blanks separates two cells.
    """
    if '"' not in line:
        return line.split(None if separator == " " else separator)
    cells = next(csv.reader([line], delimiter=separator))
    commas = separator == ","  # with other separators, a comma may be a decimal comma
    return [cell.replace(",", "") if commas and "," in cell and _THOUSANDS.fullmatch(cell) else cell for cell in cells]


def _number(cell: str) -> float:
    if "_" in cell:  # ``float`` accepts 1_000
        raise ValueError
    return float(cell)


def _measured(cell: str) -> float:
    """Return the number in a cell; NaN if the cell is empty."""
    return _number(cell) if cell.strip() else math.nan


def _number_of(names: dict[str, float], cell: str) -> float:
    """Return the number of the name in ``cell``; a new name gets the next whole number.

    Raises ``ValueError`` for an empty name.
    """
    if not (name := cell.strip()):
        raise ValueError
    return names.setdefault(name, len(names) + 1.0)


def _match(file: Path, columns: Sequence[str], shown: Sequence[str]) -> tuple[list[int], list[str]]:
    """Find columns of a file by name; return the indices of these columns, and the names of the missing columns.

    If a name matches numbered columns (Speed1, Speed2, ...), the indices are in the order of these numbers. ``shown``
    are the names of all columns. Raises ``InvalidInput`` if two columns of the file have the same name.
    """
    small = [_OTHER_NAMES.get(name.lower(), name.lower()) for name in shown]
    ordered = sorted((len(name), name, k) for k, name in enumerate(small))  # Speed2 before Speed10
    patterns = [re.compile(re.escape(each.lower()).replace(re.escape(NUMBER), "[1-9][0-9]*")) for each in columns]
    at = [[k for _, name, k in ordered if each.fullmatch(name)] for each in patterns]
    used, missing = [k for each in at for k in each], [name for name, each in zip(columns, at, strict=True) if not each]
    if not missing and len({small[k] for k in used}) < len(used):
        raise InvalidInput(f"{file}: columns {', '.join(shown[k] for k in used)}: each name must occur only once")
    return used, missing


def _unknown(file: Path, entry: Format, missing: list[str], have: Sequence[str]) -> InvalidInput:
    """Return the error for a file that lacks the columns ``missing``.

    If ``have``, the cells of the file's first lines, are the column names of another format, the message names it.
    """
    small = {name.lower() for name in have}
    for title, (there, absent) in REFUSED.items():
        if small >= there and not small & absent:
            return InvalidInput(f"{file}: is a file of {title}, which cannot be used because it has no lanes")
    for each in FORMATS.values():
        if each is not entry and not _match(file, list(each.columns.values()), sorted(small))[1]:
            return InvalidInput(f"{file}: is not a file of {entry.title}, but of {each.title}")
    hint = "; commas must separate the columns" * any(";" in name for name in have)
    text = f"{file}: lacks columns that files of {entry.title} have: {', '.join(missing)}{hint}"
    return (
        NotARecording(text)
        if entry.mixed and not hint and 2 * len(missing) > len(entry.columns)
        else InvalidInput(text)
    )
