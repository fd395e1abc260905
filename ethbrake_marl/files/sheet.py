"""A table of estimates and texts, written as a terminal, a document, a notebook, a CSV file or JSON needs it."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from ethbrake_marl.errors import naming_extras, plain_text
from ethbrake_marl.files.store import new_file

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType, RenderResult

DASH = "–"  # for what does not exist
_AFTER_SIGN = re.compile(r"(?<=[:+@,/])(?=.)")
WIDE = 120  # characters of a terminal that show every column


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value and its interval; the interval is None where the data cannot give one (a single world)."""

    value: float
    interval: tuple[float, float] | None

    @property
    def ends(self) -> tuple[float, float]:
        """Its interval; the value itself where there is none."""
        return self.interval or (self.value, self.value)

    def in_words(self, *, digits: int = 2, scale: float = 1.0, unit: str = "") -> str:
        """``24.19 [23.85, 24.53]``: value and interval, each times ``scale``."""
        return Column("", digits=digits, scale=scale, unit=unit).show(self).in_words

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON: ``value``, and ``interval`` as ``[low, high]`` or null."""
        return {"value": self.value, "interval": None if self.interval is None else list(self.interval)}

    @staticmethod
    def side_by_side(estimates: Mapping[str, Estimate | None]) -> dict[str, Any]:
        """Estimates by name as plain data, side by side: ``{name: value, name_interval: [low, high]}``.

        What does not exist is null.
        """
        found: dict[str, Any] = {}
        for name, estimate in estimates.items():
            told = {"value": None, "interval": None} if estimate is None else estimate.to_json()
            found |= {name: told["value"], f"{name}_interval": told["interval"]}
        return found


class Shown(NamedTuple):
    """A cell in words."""

    value: str
    interval: str = ""  # ``23.85, 24.53``

    @property
    def in_words(self) -> str:
        """In one line: ``24.19 [23.85, 24.53]``."""
        return f"{self.value} [{self.interval}]" if self.interval else self.value


Cell = Estimate | Shown | float | int | str | None


@dataclass(frozen=True, slots=True)
class Column:
    """One column, and how its numbers are written: each times ``scale``, with ``digits``, then its ``unit``.

    A whole number is written as it is, a text too, whatever the column's digits are.
    """

    heading: str
    key: str = ""  # its name in CSV and JSON; "": the heading
    digits: int = 2
    scale: float = 1.0
    unit: str = ""
    sign: Literal["z", "+"] = "z"  # as in a format: never -0.00, or always a sign
    text: bool = False  # flush left, and folded where a terminal is narrow
    short: str = ""  # the heading for a terminal; "": the heading
    wide: bool = False  # shown only in a terminal of ``WIDE`` characters
    interval: Literal["beside", "below", "hidden"] = "beside"  # of an estimate, in a terminal

    @property
    def name(self) -> str:
        """Its name in CSV and JSON."""
        return self.key or self.heading

    def show(self, cell: Cell) -> Shown:
        """A cell of this column in words."""
        if cell is None or isinstance(cell, Shown):
            return cell or Shown(DASH)
        if isinstance(cell, str | int):
            return Shown(str(cell))
        if not isinstance(cell, Estimate):
            return Shown(self._number(cell) + self.unit)
        ends = () if cell.interval is None else cell.interval
        return Shown(self._number(cell.value) + self.unit, ", ".join(map(self._number, ends)))

    def _number(self, value: float) -> str:
        return f"{self.scale * value:{self.sign}.{self.digits}f}"


Row = Sequence[Any] | str  # of cells; Any spares callers a list's type


@dataclass(frozen=True, slots=True)
class Sheet:
    """A table: a title, columns, rows of cells, and a note below.

    A column may be given as its heading: it holds texts. A row that is a text begins a section of that name. A row may
    end early; what is missing is empty.

    >>> from ethbrake_marl.files.sheet import Column, Estimate, Sheet
    >>> sheet = Sheet("Harm", ["Agent", Column("Total", "total_harm")], [("coast", Estimate(1.5, (1.0, 2.0)))])
    >>> print(sheet.markdown())
    | Agent | Total |
    | --- | ---: |
    | coast | 1.50 [1.00, 2.00] |
    >>> sheet.json()
    [{'Agent': 'coast', 'total_harm': 1.5, 'total_harm_interval': [1.0, 2.0]}]

    """

    title: str
    columns: Sequence[Column | str]
    rows: Sequence[Row]
    note: str = ""
    gap: Literal[1, 2, 3] = 3  # blanks between two columns in a terminal

    def _columns(self) -> list[Column]:
        return [column if isinstance(column, Column) else Column(column, text=True) for column in self.columns]

    @property
    def headings(self) -> list[str]:
        """Of its columns."""
        return [column.heading for column in self._columns()]

    @property
    def names(self) -> list[str]:
        """Of its columns, in CSV and JSON."""
        return [column.name for column in self._columns()]

    def shown(self) -> Iterator[str | tuple[Shown, ...]]:
        """Its rows in words, each of as many cells as there are columns; sections are their names."""
        columns = self._columns()
        for row in self.rows:
            if isinstance(row, str):
                yield row
            else:
                cells = [column.show(cell) for column, cell in zip(columns, row, strict=False)]
                yield (*cells, *[Shown("")] * (len(columns) - len(cells)))

    def only(self, columns: Iterable[int]) -> Sheet:
        """That of some columns, by number."""
        kept = list(columns)
        rows = [row if isinstance(row, str) else [row[k] for k in kept if k < len(row)] for row in self.rows]
        return replace(self, columns=[self.columns[k] for k in kept], rows=rows)

    def filled(self) -> list[int]:
        """Numbers of the columns in which some row has a value; all of them without rows."""
        rows = [row for row in self.rows if not isinstance(row, str)]
        return [
            k for k in range(len(self.columns)) if not rows or any(k < len(row) and row[k] is not None for row in rows)
        ]

    def rich(self, width: int = WIDE) -> RenderableType:
        """For a terminal of this width, the note below; all lines of a cell but its first are dim."""
        from rich import box
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table(
            box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, int(self.gap > 1), 0, int(self.gap > 2)),
            title=Text(self.title, "table.title") if self.title else None, title_justify="left",
        )  # fmt: skip
        columns = self._columns()
        kept = [k for k, column in enumerate(columns) if width >= WIDE or not column.wide]
        for column in (columns[k] for k in kept):
            heading = Text(plain_text(column.short or column.heading, keep="\n"))
            if column.text:
                table.add_column(heading, overflow="fold")
            else:
                table.add_column(heading, justify="right", no_wrap=True)
        for row in self.shown():
            if isinstance(row, str):
                table.add_section()
                table.add_row(Text(plain_text(row), style="dim"))
                continue
            cells = []
            for k in kept:
                how, (value, interval) = columns[k].interval, row[k]
                below = f"\n{interval}" if interval and how == "below" else ""
                first, line, rest = ((row[k].in_words if how == "beside" else value) + below).partition("\n")
                cells.append(Text(plain_text(first)).append(plain_text(line + rest, keep="\n"), style="dim"))
            table.add_row(*cells)
        return Group(table, Text(), Text(self.note, "dim")) if self.note else table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield self.rich(options.max_width)

    def markdown(self) -> str:
        """For a document, without title and note; rows of a section are named after it."""
        columns, section = self._columns(), ""
        lines = [[column.heading for column in columns], ["---" if column.text else "---:" for column in columns]]
        for row in self.shown():
            if isinstance(row, str):
                section = f"{row}: "
                continue
            words = [shown.in_words.replace("|", "\\|").replace("\n", " ") for shown in row]
            lines.append([section + words[0], *words[1:]])
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)

    def html(self) -> str:
        """For a notebook or a page: the title above, the note below, intervals in brackets behind their values.

        Everything is text but what says by ``__html__`` that it is none. The first cell of a row is its heading. The
        text of a column after it may be broken into lines if the column is one of texts.
        """
        columns, label = self._columns(), self.title or f"Table: {self.headings[0]}"
        kinds = [' class="words"' if k and self.rows and column.text else "" for k, column in enumerate(columns)]
        heads = zip(kinds, self.headings, strict=True)
        lines = [
            f'<div class="wide" tabindex="0" role="region" aria-label="{_html(label)}"><table>',
            *([f"<caption>{_html(self.title)}</caption>"] if self.title else []),
            *("<thead><tr>", *(f'<th scope="col"{kind}>{_html(each)}</th>' for kind, each in heads)),
            *("</tr></thead>", "<tbody>"),
        ]
        for row in self.shown():
            if isinstance(row, str):
                lines.append(f'<tr class="block"><th colspan="{len(columns)}" scope="rowgroup">{_html(row)}</th></tr>')
                continue
            name = row[0].in_words  # a long one such as e_v2x_bm:pairwise is broken after a sign before inside a word
            if not hasattr(row[0].value, "__html__"):
                name = "<wbr>".join(map(_html, _AFTER_SIGN.split(name)))
            lines.append(f'<tr><th scope="row">{name}</th>')
            for kind, (value, interval) in zip(kinds[1:], row[1:], strict=True):
                below = f' <span class="interval">[{_html(interval)}]</span>' if interval else ""
                lines.append(f"<td{kind}>{_html(value)}{below}</td>")
            lines.append("</tr>")
        note = [f"<p>{_html(self.note)}</p>"] if self.note else []
        return "\n".join([*lines, "</tbody>", "</table></div>", *note])

    def json(self) -> list[dict[str, Any]]:
        """One object per row, sections apart: cells by the names of their columns, estimates with their intervals."""
        columns, found = self._columns(), []
        for row in self.rows:
            cells = {} if isinstance(row, str) else dict(zip(columns, row, strict=False))
            told: dict[str, Any] = {}
            for column, cell in cells.items():
                estimate = isinstance(cell, Estimate)
                told |= Estimate.side_by_side({column.name: cell}) if estimate else {column.name: cell}
            found += [told] if cells else []
        return found

    def csv(self) -> str:
        """One line per row; the interval of column ``x`` is ``x_low`` and ``x_high``, what does not exist is empty."""
        return csv_text(self.json())


def terminal_text(*shown: RenderableType) -> str:
    """Tables and texts as ``print`` shows them, as wide as the terminal."""
    from rich.console import Console

    console = Console(highlight=False)
    with console.capture() as captured:
        console.print(*shown)
    return captured.get()


def csv_text(rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> str:
    """A CSV file of objects, with the ``columns`` given or all that some row has, in the order of their appearance.

    The interval of ``x``, under ``x_interval``, becomes ``x_low`` and ``x_high``; None and what is missing is empty.
    """
    flat: list[dict[str, Any]] = []
    for row in rows:
        line: dict[str, Any] = {}
        for name, value in row.items():
            if name.endswith("_interval"):
                stem = name.removesuffix("_interval")
                line[f"{stem}_low"], line[f"{stem}_high"] = value or (None, None)
            else:
                line[name] = value
        flat.append(line)
    text = io.StringIO(newline="")
    names = list(dict.fromkeys(name for line in flat for name in line)) if columns is None else list(columns)
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue()


@contextmanager
def parquet_file(
    path: Path, *, told: Callable[[], Mapping[str, str]] | None = None, **options: Any
) -> Iterator[Callable[..., None]]:
    """Give what adds columns of arrays by name to a Parquet file, which appears when the block ends well.

    ``together`` keeps what is added at once in one row group. ``told`` is asked for metadata at the end; ``options``
    are those of ``pyarrow.parquet.ParquetWriter``. Raises ``MissingExtra`` without pyarrow.
    """
    with naming_extras():
        import pyarrow
        from pyarrow.parquet import ParquetWriter

    writer = None
    with new_file(path) as partial:

        def add(columns: Mapping[str, Any], *, together: bool = False) -> None:
            nonlocal writer
            table = pyarrow.table(dict(columns))
            if writer is None:
                writer = ParquetWriter(partial, table.schema, **options)
            writer.write_table(table, row_group_size=max(table.num_rows, 1) if together else None)

        try:
            yield add
        finally:
            if writer is not None:
                if told is not None:
                    writer.add_key_value_metadata(told())
                writer.close()


def _html(value: object) -> str:
    """A value as text of a page: no control or direction character, whoever wrote it."""
    known: Callable[[], str] | None = getattr(value, "__html__", None)
    return escape(plain_text(str(value), keep="\u00a0")) if known is None else known()
