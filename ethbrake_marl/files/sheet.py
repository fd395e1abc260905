"""``Sheet``: a table of numbers, intervals and texts, for a terminal, CSV and JSON."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from ethbrake_marl.errors import plain_text

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType, RenderResult

DASH = "–"  # shown for a missing value


@dataclass(frozen=True, slots=True)
class Estimate:
    value: float
    interval: tuple[float, float] | None  # low and high end; None if it cannot be computed, as for one world
    # standard error, and its degrees of freedom; None where they are not known
    error: float | None = field(default=None, compare=False)
    freedom: float | None = field(default=None, compare=False)

    @property
    def ends(self) -> tuple[float, float]:
        """Both equal the value if there is no interval."""
        return self.interval or (self.value, self.value)

    def in_words(self, *, digits: int = 2, scale: float = 1.0, unit: str = "") -> str:
        """Such as ``24.19 [23.85, 24.53]``; ``scale`` is a factor."""
        return Column("", digits=digits, scale=scale, unit=unit).show(self).in_words

    def to_json(self) -> dict[str, Any]:
        """``{"value": ..., "interval": [low, high] or None}``."""
        return {"value": self.value, "interval": None if self.interval is None else list(self.interval)}

    @staticmethod
    def side_by_side(estimates: Mapping[str, Estimate | None]) -> dict[str, Any]:
        """``{"x": 1.5, "x_interval": [1.0, 2.0]}``; None for unknown ones."""
        cells: dict[str, Any] = {}
        for name, estimate in estimates.items():
            cells[name] = None if estimate is None else estimate.value
            cells[f"{name}_interval"] = (
                None if estimate is None or estimate.interval is None else list(estimate.interval)
            )
        return cells


class CellText(NamedTuple):
    value: str  # the number with its unit, or the text
    interval: str = ""  # ``23.85, 24.53``

    @property
    def in_words(self) -> str:
        return f"{self.value} [{self.interval}]" if self.interval else self.value


Cell = Estimate | CellText | float | int | str | None


@dataclass(frozen=True, slots=True)
class Column:
    """Integers and texts are shown as they are."""

    heading: str  # heading in documents
    key: str = ""  # name in CSV and JSON; "": the heading
    digits: int = 2  # number of digits after the decimal point
    scale: float = 1.0  # factor that multiplies the numbers, such as 100 for per cent
    unit: str = ""  # text directly after the number, such as " %"
    sign: Literal["z", "+"] = "z"  # format option: "z" never shows -0.00, "+" always shows a sign
    text: bool = False  # whether the cells are left-aligned texts, which a narrow terminal wraps
    short: str = ""  # heading in a terminal; "": the heading
    interval: Literal["beside", "below", "hidden"] = "beside"  # where a terminal shows the interval of an estimate

    @property
    def name(self) -> str:
        return self.key or self.heading

    def show(self, cell: Cell) -> CellText:
        """A dash for None."""
        if cell is None or isinstance(cell, CellText):
            return cell or CellText(DASH)
        if isinstance(cell, str | int):
            return CellText(str(cell))
        if not isinstance(cell, Estimate):
            return CellText(self._number(cell) + self.unit)
        ends = () if cell.interval is None else cell.interval
        return CellText(self._number(cell.value) + self.unit, ", ".join(map(self._number, ends)))

    def in_terminal(self, cell: CellText) -> str:
        """A second line (the interval) is shown dim."""
        if self.interval == "beside":
            return cell.in_words
        return cell.value + (f"\n{cell.interval}" if cell.interval and self.interval == "below" else "")

    def _number(self, value: float) -> str:
        return f"{self.scale * value:{self.sign}.{self.digits}f}"


Row = Sequence[Any] | str  # a row of cells, or the name of a section that begins here


@dataclass(frozen=True, slots=True)
class Sheet:
    """A table. A row may be shorter than the list of columns; its missing cells are empty.

    >>> from ethbrake_marl.files.sheet import Column, Estimate, Sheet
    >>> sheet = Sheet("Harm", ["Agent", Column("Total", "total_harm")], [("coast", Estimate(1.5, (1.0, 2.0)))])
    >>> [cell.in_words for row in sheet.formatted_rows() for cell in row]
    ['coast', '1.50 [1.00, 2.00]']
    >>> sheet.json()
    [{'Agent': 'coast', 'total_harm': 1.5, 'total_harm_interval': [1.0, 2.0]}]

    """

    title: str  # title above the table; "": no title
    columns: Sequence[Column | str]  # a string is the heading of a column of texts
    rows: Sequence[Row]
    note: str = ""  # text below the table
    gap: Literal[1, 2, 3] = 3  # spaces between two columns in a terminal
    keep: int | None = None  # number of first columns that every terminal shows, others only if they fit; None: all

    @property
    def formats(self) -> list[Column]:
        return [column if isinstance(column, Column) else Column(column, text=True) for column in self.columns]

    @property
    def headings(self) -> list[str]:
        return [column.heading for column in self.formats]

    @property
    def names(self) -> list[str]:
        return [column.name for column in self.formats]

    def formatted_rows(self) -> Iterator[str | tuple[CellText, ...]]:
        """A tuple of formatted cells, or the name of a section that begins."""
        columns = self.formats
        for row in self.rows:
            if isinstance(row, str):
                yield row
            else:
                cells = [column.show(cell) for column, cell in zip(columns, row, strict=False)]
                yield (*cells, *[CellText("")] * (len(columns) - len(cells)))

    def only(self, columns: Iterable[int]) -> Sheet:
        """Indices from 0."""
        names = list(columns)
        rows = [row if isinstance(row, str) else [row[k] for k in names if k < len(row)] for row in self.rows]
        return replace(self, columns=[self.columns[k] for k in names], rows=rows)

    def filled(self) -> list[int]:
        """Columns with a value in some row; all if the table has no rows."""
        rows = [row for row in self.rows if not isinstance(row, str)]
        return [
            k for k in range(len(self.columns)) if not rows or any(k < len(row) and row[k] is not None for row in rows)
        ]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """With the note below. Texts that do not fit are folded."""
        from rich import box
        from rich.table import Table
        from rich.text import Text

        table = Table(
            box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, int(self.gap > 1), 0, int(self.gap > 2)),
            title=Text(self.title, "table.title") if self.title else None, title_justify="left",
        )  # fmt: skip
        columns = self.formats
        rows = [
            row
            if isinstance(row, str)
            else [column.in_terminal(cell) for column, cell in zip(columns, row, strict=True)]
            for row in self.formatted_rows()
        ]
        column_count = self._fitting(options.max_width, [row for row in rows if not isinstance(row, str)])
        for column in columns[:column_count]:
            heading = Text(plain_text(column.short or column.heading, keep="\n"))
            justify: Literal["left", "right"] = "left" if column.text else "right"
            table.add_column(heading, justify=justify, overflow="fold", no_wrap=not column.text)
        for row in rows:
            if isinstance(row, str):
                table.add_section()
                table.add_row(Text(plain_text(row), style="dim"))
                continue
            cells: list[Text] = []
            for text in row[:column_count]:
                first, line, rest = text.partition("\n")
                cells.append(Text(plain_text(first)).append(plain_text(line + rest, keep="\n"), style="dim"))
            table.add_row(*cells)
        yield table
        if self.note:
            yield Text(f"\n{self.note}", "dim")

    def _fitting(self, width: int, rows: Sequence[Sequence[str]]) -> int:
        """``width`` in characters; at least ``keep``."""
        columns = self.formats
        texts = [[column.short or column.heading, *(row[k] for row in rows)] for k, column in enumerate(columns)]
        wide = [max(len(line) for text in column for line in text.split("\n")) for column in texts]
        wide[0] = min(wide[0], width // 2)
        column_count, keep = len(columns), self.keep or len(columns)
        while column_count > keep and sum(wide[:column_count]) + self.gap * (column_count - 1) > width:
            column_count -= 1
        return column_count

    def json(self) -> list[dict[str, Any]]:
        """Column name -> cell, without names of sections. An interval has an entry of its own."""
        rows = []
        for row in self.rows:
            if not isinstance(row, str):
                values: dict[str, Any] = {}
                for name, cell in zip(self.names, row, strict=False):
                    values |= Estimate.side_by_side({name: cell}) if isinstance(cell, Estimate) else {name: cell}
                rows.append(values)
        return rows

    def csv(self) -> str:
        return csv_text(self.json())


def terminal_text(*parts: RenderableType) -> str:
    from rich.console import Console

    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"  # such as cp1252 or ASCII
    content = io.BytesIO()
    text = io.TextIOWrapper(content, encoding, errors="replace", newline="\n")
    console = Console(file=text, highlight=False, color_system=None, force_jupyter=False, force_terminal=False)
    console.print(*parts)
    text.flush()
    return content.getvalue().decode(encoding)


def flat_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """``x_low`` and ``x_high`` replace each pair ``x_interval``."""
    line: dict[str, Any] = {}
    for name, value in row.items():
        if name.endswith("_interval"):
            stem = name.removesuffix("_interval")
            line[f"{stem}_low"], line[f"{stem}_high"] = value or (None, None)
        else:
            line[name] = value
    return line


def csv_text(rows: Iterable[Mapping[str, Any]]) -> str:
    """The header has all columns in order of appearance; missing values are empty."""
    lines = [flat_row(row) for row in rows]
    text = io.StringIO(newline="")
    names = dict.fromkeys(name for line in lines for name in line)
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()
