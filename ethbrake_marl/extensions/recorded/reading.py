"""Files of recorded traffic to numbers, piece by piece: CSV, text with blanks, Parquet.

Each number keeps the line (of Parquet: the row) in which it stands, so that a message can name it.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from io import TextIOWrapper
from itertools import chain, count, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, naming_extras
from ethbrake_marl.extensions.recorded.formats import FORMATS, REFUSED, Format
from ethbrake_marl.files.plain import open_plain
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.physics.state import Bools, Floats

PIECE, HEAD = 50_000, 11  # lines read at once; number of first lines in which the header is searched

LONGEST_LINE, LARGEST_BYTES = 1 << 16, 1 << 40  # limits of a line (characters) and of a file

_OTHER_NAMES = {"preceeding": "preceding"}  # misspelt column in some files of NGSIM

_NUMBERED = "[1-9][0-9]*"

_Line = tuple[int, str]


class NotARecording(InvalidInput):
    """A file that has fewer than half of the format's columns, and so is something else beside the recordings."""


class Piece(NamedTuple):
    """Some rows of a file: ``values`` [rows, columns] and ``lines`` [rows], the line of each row."""

    file: Path
    columns: Sequence[str]
    values: Floats
    lines: Floats

    def of(self, rows: Bools) -> Piece:
        """Return the piece with only those rows for which ``rows`` [rows] is true."""
        return self._replace(values=self.values[rows], lines=self.lines[rows])

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
    progress: Callable[[int], None] = lambda _: None,
) -> Iterator[Piece]:
    """Yield the numbers of a file piece by piece.

    All values are finite numbers, except that an empty cell of a format with gaps is NaN.

    Args:
        file: the file.
        entry: its format.
        columns: names of the columns to read, in this order.
        names: number of each name in columns of names; new names are added.
        progress: called with the KiB read.

    Raises ``InvalidInput`` with file, line and column for a missing column or a cell that is not a number, and
    ``NotARecording`` for a file that is something else.

    """
    known = {} if names is None else names
    with open_plain(file, LARGEST_BYTES) as stream:
        text, empty = TextIOWrapper(stream, "utf-8-sig"), True
        pieces = _parquet_pieces if _is_parquet(file) else _text_pieces
        for piece in pieces(text, file, entry, columns, known):
            progress(stream.tell() >> 10)
            for k in range(1 if entry.gaps else len(piece.columns)):
                piece.refuse(~np.isfinite(piece.values[:, k]), k, "must be a finite number")
            empty = False
            yield piece
        if empty:
            raise InvalidInput(f"{file}: has no rows")


def _number_of(names: dict[str, float], cell: str) -> float:
    """Return the number of a name: 1 for the first one, 2 for the next. Raise ``ValueError`` for an empty name."""
    if not (name := cell.strip()):
        raise ValueError("empty")
    return names.setdefault(name, len(names) + 1.0)


def _is_parquet(file: Path) -> bool:
    return file.suffix.lower() == ".parquet"


def _parquet_pieces(
    text: TextIOWrapper, file: Path, entry: Format, columns: Sequence[str], names: dict[str, float]
) -> Iterator[Piece]:
    with naming_extras():
        import pyarrow
        from pyarrow.parquet import ParquetFile
    try:
        table, begins = ParquetFile(text.buffer), 1
        cells = table.schema_arrow.names
        used = _used(file, "", entry, columns, cells)
        if used is None:
            raise _unknown(file, entry, columns, [cells])
        for batch in table.iter_batches(PIECE, columns=[cells[k] for k in used]):
            lines, values = np.arange(begins, begins + batch.num_rows), np.empty((batch.num_rows, len(used)))
            begins += batch.num_rows
            for k, at in enumerate(used):
                cast = batch.column(cells[at]).cast(pyarrow.string() if k in entry.texts else pyarrow.float64())
                if k in entry.texts:
                    cast = np.array([np.nan if not cell else _number_of(names, cell) for cell in cast.to_pylist()])
                values[:, k] = cast
            yield Piece(file, [cells[k] for k in used], values, lines)
    except (pyarrow.ArrowException, OSError) as error:
        raise InvalidInput(f"{file}: cannot be read as Parquet with numbers ({error})") from None


def _text_pieces(
    text: TextIOWrapper, file: Path, entry: Format, columns: Sequence[str], names: dict[str, float]
) -> Iterator[Piece]:
    cells, used, separator, source = _header(file, entry, columns, _lines(file, text))
    converters: dict[int | str, Callable[[str], Any]] | None
    converters = {used[k]: partial(_number_of, names) for k in entry.texts} or None
    elsewhere = seen = 0
    while piece := list(islice(source, PIECE)):
        there = [(number, _plain(line, separator)) for number, line in piece if line.strip()]
        kept = [(number, line) for number, line in there if not any(at in line for at in entry.elsewhere)]
        elsewhere, seen = elsewhere + len(there) - len(kept), seen + len(kept)
        if not kept:
            continue
        for number, line in kept:
            if line.count(separator) + 1 != len(cells):
                raise InvalidInput(
                    f"{file}, line {number}: {line.count(separator) + 1} values, but the header has"
                    f" {len(cells)} columns; is the file whole?"
                )
        lines = [re.sub(r",(?=,|\s*$)", ",nan", line) if entry.gaps else line for _, line in kept]
        try:
            values = np.loadtxt(lines, float, None, separator, converters, usecols=used, ndmin=2)
        except ValueError:
            raise _not_a_number(file, kept, lines, cells, used, separator, entry) from None
        yield Piece(file, [cells[k] for k in used], values, np.array([number for number, _ in kept]))
    if elsewhere and not seen:
        raise InvalidInput(
            f"{file}: all {elsewhere:,} rows are of {' or '.join(entry.elsewhere)}: streets with crossings, which are"
            " left out"
        )


def _lines(file: Path, text: TextIOWrapper) -> Iterator[_Line]:
    for number, line in zip(count(1), iter(partial(text.readline, LONGEST_LINE), ""), strict=False):
        if len(line) == LONGEST_LINE:
            raise InvalidInput(f"{file}, line {number}: longer than {LONGEST_LINE:,} characters")
        yield number, line


def _plain(line: str, separator: str) -> str:
    """Return a line without quotes, thousands separators in quotes, and blanks as separators: cells by ``separator``.

    ``separator`` " " stands for any blanks.
    """
    if separator == " ":
        return " ".join(line.split())
    if '"' not in line:
        return line
    return separator.join([cell.replace(",", "") for cell in next(csv.reader([line], delimiter=separator))])


def _not_a_number(
    file: Path,
    kept: list[_Line],
    lines: list[str],
    cells: Sequence[str],
    used: Sequence[int],
    separator: str,
    entry: Format,
) -> InvalidInput:
    """Return the error that names the first cell that is no number, or an empty name, in the ``used`` columns."""
    names = {used[k] for k in entry.texts}
    for (number, _), line in zip(kept, lines, strict=True):
        row = [cell.strip() for cell in line.split(separator)]
        for k in used:
            if row[k] == "" if k in names else parse_numeral(row[k]) is None and row[k] != "nan":
                right = "must not be empty" if k in names else "is not a number"
                return InvalidInput(f"{file}, line {number}, column {cells[k]}: {row[k]!r:.60} {right}")
    return InvalidInput(f"{file}, lines {kept[0][0]} to {kept[-1][0]}: cannot be read as numbers")


def _header(
    file: Path, entry: Format, columns: Sequence[str], source: Iterator[_Line]
) -> tuple[Sequence[str], list[int], str, Iterator[_Line]]:
    """Find the header among the first lines of ``source``.

    Return the names of all columns, the indices of ``columns``, the separator of cells, and the lines that follow.
    """
    looked_at = []
    for number, line in islice(source, HEAD):
        row = line.split()
        numbers = sum(parse_numeral(cell) is not None for cell in row)
        if entry.headless and number == 1 and 2 * numbers > len(row) > 1:
            if len(row) != len(entry.headless):
                right = f"the text files of {entry.title} have {len(entry.headless)}"
                raise InvalidInput(f"{file}, line {number}: {len(row)} values without a header; {right}")
            at = [entry.headless.index(name) for name in columns]
            return entry.headless, at, " ", chain([(number, line)], source)
        for separator in entry.separators:
            cells = [cell.strip() for cell in _plain(line, separator).split(separator)]
            looked_at.append(cells)
            if (used := _used(file, f", line {number}", entry, columns, cells)) is not None:
                return cells, used, separator, source
    raise _unknown(file, entry, columns, looked_at)


def _small(cells: Sequence[str]) -> list[str]:
    return [_OTHER_NAMES.get(name.lower(), name.lower()) for name in cells]


def _missing(columns: Sequence[str], cells: Sequence[str]) -> list[str]:
    """Return those of ``columns`` that no name in ``cells`` matches."""
    small = _small(cells)
    return [each for each in columns if not any(_pattern(each).fullmatch(name) for name in small)]


def _pattern(column: str) -> re.Pattern[str]:
    return re.compile(re.escape(column.lower()).replace(r"\#", _NUMBERED))


def _used(file: Path, place: str, entry: Format, columns: Sequence[str], cells: Sequence[str]) -> list[int] | None:
    """Return the indices in ``cells`` of the columns to read; None if one is missing.

    Raises ``InvalidInput`` for a column that is there twice. Numbered columns are in the order of their numbers.
    """
    if _missing(columns, cells):
        return None
    small = _small(cells)
    ordered = sorted((len(name), name, k) for k, name in enumerate(small))  # Speed2 before Speed10
    used = [k for each in columns for _, name, k in ordered if _pattern(each).fullmatch(name)]
    if len({small[k] for k in used}) < len(used):
        raise InvalidInput(f"{file}{place}: {', '.join(cells[k] for k in used)}: each column must be there once")
    return used


def _unknown(file: Path, entry: Format, columns: Sequence[str], looked_at: list[list[str]]) -> InvalidInput:
    """Return the error for a file without one of ``columns``; ``looked_at``: the cells of its first lines."""
    missing = min((_missing(columns, cells) for cells in looked_at), key=len, default=list(columns))
    have = {name for cells in looked_at for name in _small(cells)}
    for title, (there, absent) in REFUSED.items():
        if have >= there and not have & absent:
            return InvalidInput(f"{file}: this is {title}, which has no lanes to follow")
    for each in FORMATS.values():
        if each is not entry and not _missing(list(each.columns.values()), list(have)):
            return InvalidInput(f"{file}: is not {entry.title}; this is {each.title}")
    hint = "; columns are separated by commas" * (";" in str(have))
    text = f"{file}: has no column {', '.join(missing)}, as files of {entry.title} have{hint}"
    return NotARecording(text) if entry.mixed and 2 * len(missing) > len(columns) else InvalidInput(text)
