"""Files of recorded traffic to numbers, piece by piece: CSV, text with blanks, Parquet.

Each number keeps the line (of Parquet: the row) in which it stands, so that a message can name it.
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

PIECE, HEAD = 50_000, 11  # lines read at once; number of first lines in which the header is searched

LONGEST_LINE, LARGEST_BYTES = 1 << 16, 1 << 40  # limits of a line (characters) and of a file

_OTHER_NAMES = {"preceeding": "preceding"}  # misspelt column in some files of NGSIM

_THOUSANDS = re.compile(r"-?\d{1,3}(,\d{3})+(\.\d*)?")  # in quotes, where commas are separators, too

_Row = tuple[int, Sequence[str]]  # line, and cells

_Table = tuple[Sequence[str], Sequence[int], Iterator[_Row]]  # names of columns, indices of those to read, rows


class NotARecording(InvalidInput):
    """A file that has fewer than half of the format's columns, and so is something else beside the recordings."""


class Piece(NamedTuple):
    """Some rows of a file: ``values`` [rows, columns] and ``lines`` [rows], the line of each row."""

    file: Path
    columns: Sequence[str]
    values: Floats
    lines: Floats

    def refuse(self, bad: Bools, k: int, right: str, shown: Floats | None = None) -> None:
        """Raise ``InvalidInput`` with file, line and column for the first row in which ``bad`` [rows] is true.

        Args:
            bad: rows to refuse, [rows].
            k: index of the column.
            right: what would be right.
            shown: values to show, [rows]; None: those of the column.

        """
        if bad.any():
            value = (self.values[:, k] if shown is None else shown)[bad][0]
            place = place_of(self.file, self.lines[bad][0])
            raise InvalidInput(f"{place}, column {self.columns[k]}: {value:.12g} {right}")


def place_of(file: Path, line: float) -> str:
    """Return file and line as messages name them; Parquet has rows instead of lines."""
    return f"{file}, {'row' if _is_parquet(file) else 'line'} {line:.0f}"


def read_pieces(
    file: Path,
    entry: Format,
    columns: Sequence[str],
    names: dict[str, float] | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Iterator[Piece]:
    """Yield the numbers of a file piece by piece.

    All values are finite numbers, except that an empty cell of a format with gaps is NaN.

    Args:
        file: the file.
        entry: its format.
        columns: names of the columns to read, in this order.
        names: number of each name in columns of names; new names are added.
        progress: called with the KiB read, and the size of the file in KiB.

    Raises ``InvalidInput`` with file, line and column for a missing column or a cell that is not a number, and
    ``NotARecording`` for a file that is something else.

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
            raise InvalidInput(f"{file}: has no rows")


def _is_parquet(file: Path) -> bool:
    return file.suffix.lower() == ".parquet"


def _numbers(
    file: Path, rows: Iterable[_Row], shown: Sequence[str], readers: Sequence[tuple[int, Callable[[str], float]]]
) -> Iterator[tuple[int, list[float]]]:
    """Yield the line of each row, and the numbers in its cells of which ``readers`` has the index and a reader."""
    for line, cells in rows:
        if len(cells) != len(shown):
            right = f"but the header has {len(shown)} columns; is the file whole?"
            raise InvalidInput(f"{place_of(file, line)}: {len(cells)} values, {right}")
        k = 0
        try:
            yield line, [reader(cells[k := at]) for at, reader in readers]
        except ValueError:
            cell = cells[k].strip()
            right = f"{cell!r:.60} is not a number" if cell else "is empty"
            raise InvalidInput(f"{place_of(file, line)}, column {shown[k]}: {right}") from None


def _parquet(text: TextIOWrapper, file: Path, entry: Format, columns: Sequence[str]) -> _Table:
    """Return the names of the columns to read of a Parquet file, their indices, and its rows."""
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
    """Find the header among the first lines; return the names of all columns, the indices of ``columns``, and rows."""
    lines, best, have = _lines(file, text), list(columns), list[str]()
    for number, line in islice(lines, HEAD):
        row = line.split()
        numbers = sum(parse_numeral(cell) is not None for cell in row)
        if entry.headless and number == 1 and 2 * numbers > len(row) > 1:
            if len(row) != len(entry.headless):
                right = f"the text files of {entry.title} have {len(entry.headless)}"
                raise InvalidInput(f"{file}, line {number}: {len(row)} values without a header; {right}")
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
    """Yield the cells of each line that is not blank, and not of one of the ``streets``."""
    elsewhere = seen = 0
    for number, line in lines:
        if streets and any(street in line for street in streets):
            elsewhere += 1
        elif line.strip():
            seen += 1
            yield number, _cells(line, separator)
    if elsewhere and not seen:
        why = f"{' or '.join(streets)}: streets with crossings, which are left out"
        raise InvalidInput(f"{file}: all {elsewhere:,} rows are of {why}")


def _lines(file: Path, text: TextIOWrapper) -> Iterator[tuple[int, str]]:
    for number, line in zip(count(1), iter(partial(text.readline, LONGEST_LINE), ""), strict=False):
        if len(line) == LONGEST_LINE:
            raise InvalidInput(f"{file}, line {number}: longer than {LONGEST_LINE:,} characters")
        yield number, line


def _cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line, without quotes and separators of thousands; the separator " " stands for blanks."""
    if '"' not in line:
        return line.split(None if separator == " " else separator)
    cells = next(csv.reader([line], delimiter=separator))
    commas = separator == ","  # in other files a comma may be that of a decimal
    return [cell.replace(",", "") if commas and "," in cell and _THOUSANDS.fullmatch(cell) else cell for cell in cells]


def _number(cell: str) -> float:
    if "_" in cell:  # Python reads 1_000
        raise ValueError
    return float(cell)


def _measured(cell: str) -> float:
    """Return the number in a cell, NaN if it is empty."""
    return _number(cell) if cell.strip() else math.nan


def _number_of(names: dict[str, float], cell: str) -> float:
    """Return the number of a name: 1 for the first one, 2 for the next. Raise ``ValueError`` for an empty name."""
    if not (name := cell.strip()):
        raise ValueError
    return names.setdefault(name, len(names) + 1.0)


def _match(file: Path, columns: Sequence[str], shown: Sequence[str]) -> tuple[list[int], list[str]]:
    """Return the indices in ``shown`` of the columns to read, and those of ``columns`` that are not there.

    Numbered columns are in the order of their numbers. Raises ``InvalidInput`` for a column that is there twice.
    """
    small = [_OTHER_NAMES.get(name.lower(), name.lower()) for name in shown]
    ordered = sorted((len(name), name, k) for k, name in enumerate(small))  # Speed2 before Speed10
    patterns = [re.compile(re.escape(each.lower()).replace(re.escape(NUMBER), "[1-9][0-9]*")) for each in columns]
    at = [[k for _, name, k in ordered if each.fullmatch(name)] for each in patterns]
    used, missing = [k for each in at for k in each], [name for name, each in zip(columns, at, strict=True) if not each]
    if not missing and len({small[k] for k in used}) < len(used):
        raise InvalidInput(f"{file}: {', '.join(shown[k] for k in used)}: each column must be there once")
    return used, missing


def _unknown(file: Path, entry: Format, missing: list[str], have: Sequence[str]) -> InvalidInput:
    """Return the error for a file without ``missing`` columns; ``have``: the cells of its first lines."""
    small = {name.lower() for name in have}
    for title, (there, absent) in REFUSED.items():
        if small >= there and not small & absent:
            return InvalidInput(f"{file}: this is {title}, which has no lanes to follow")
    for each in FORMATS.values():
        if each is not entry and not _match(file, list(each.columns.values()), sorted(small))[1]:
            return InvalidInput(f"{file}: is not {entry.title}; this is {each.title}")
    hint = "; columns are separated by commas" * any(";" in name for name in have)
    text = f"{file}: has no column {', '.join(missing)}, as files of {entry.title} have{hint}"
    return (
        NotARecording(text)
        if entry.mixed and not hint and 2 * len(missing) > len(entry.columns)
        else InvalidInput(text)
    )
