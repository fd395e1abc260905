"""Parts of pages made from plain data: tables, lists of facts, texts that open, data for scripts."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from markupsafe import Markup

from ethbrake_marl.pages.frame import Part, shown


class Cell(NamedTuple):
    """A cell of a table: a value, and in small letters below it an interval or a remark."""

    value: object
    below: object = ""
    words: bool = False  # text, which may be broken into lines


class Block(NamedTuple):
    """A heading across a table; the rows after it belong to it."""

    title: str


Row = Sequence[object] | Block
_AFTER_SIGN = re.compile(r"(?<=[:+@,/])(?=.)")


def table(head: Sequence[object], rows: Iterable[Row], *, caption: str = "") -> Part:
    """A table that scrolls by itself where it is wider than the page.

    Args:
        head: one heading per column.
        rows: each with one value, ``Cell`` or Markup per heading, the first a heading of its row; or a ``Block``.
        caption: what the table is.

    """
    rows = list(rows)
    lines = [Markup('<div class="wide" tabindex="0" role="region" aria-label="{}"><table>').format(
        shown(caption or f"Table: {head[0]}")
    )]  # fmt: skip
    lines += [Markup("<caption>{}</caption>").format(shown(caption))] if caption else []
    headings = Markup("").join(_heading(text, k, rows) for k, text in enumerate(head))
    lines += [Markup("<thead><tr>{}</tr></thead>").format(headings), Markup("<tbody>")]
    lines += [_row(row, len(head)) for row in rows]
    lines.append(Markup("</tbody></table></div>\n"))
    return Part(Markup("\n").join(lines))


def _heading(text: object, column: int, rows: Sequence[Row]) -> Markup:
    """The heading of a column, above its words where it has some."""
    cells = [row[column] for row in rows if not isinstance(row, Block)]
    words = any(isinstance(cell, Cell) and cell.words for cell in cells)
    return Markup('<th scope="col"{}>{}</th>').format(Markup(' class="words"') if words else Markup(), _text(text))


def _row(row: Row, columns: int) -> Markup:
    if isinstance(row, Block):
        return Markup('<tr class="block"><th colspan="{}" scope="rowgroup">{}</th></tr>').format(
            columns, shown(row.title)
        )
    first, *rest = row
    cells = Markup("").join(_cell(each) for each in rest)
    return Markup('<tr><th scope="row">{}</th>{}</tr>').format(_name(first), cells)


def _name(value: object) -> Markup:
    """The heading of a row; a long name such as e_v2x_bm:pairwise is broken after a sign before it is inside a word."""
    if isinstance(value, Markup):
        return value
    return Markup("<wbr>").join(_AFTER_SIGN.split(shown(value)))


def _cell(value: object) -> Markup:
    if not isinstance(value, Cell):
        return Markup("<td>{}</td>").format(_text(value))
    below = Markup('<span class="interval">{}</span>').format(shown(value.below)) if value.below else Markup()
    kind = Markup(' class="words"') if value.words else Markup()
    return Markup("<td{}>{}{}</td>").format(kind, _text(value.value), below)


def _text(value: object) -> str:
    return value if isinstance(value, Markup) else shown(value)


def facts(found: Mapping[str, object]) -> Part:
    """Names and values, one below the other."""
    lines = [Markup("<dt>{}</dt><dd>{}</dd>").format(shown(name), _text(value)) for name, value in found.items()]
    return Part(Markup("<dl>\n{}\n</dl>\n").format(Markup("\n").join(lines)))


def heading(text: str) -> Part:
    """A heading inside a section."""
    return Part(Markup("<h3>{}</h3>\n").format(shown(text)))


def opened(title: str, parts: Sequence[Part]) -> Part:
    """Parts that show when their title is chosen."""
    inside = Markup("").join(part.html for part in parts)
    styles, scripts = (tuple(n for part in parts for n in getattr(part, what)) for what in ("styles", "scripts"))
    return Part(Markup("<details><summary>{}</summary>\n{}</details>\n").format(shown(title), inside), styles, scripts)


def data(name: str, content: object) -> Markup:
    """Plain data for a script of the page: JSON in which nothing can end the element or begin another."""
    text = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return Markup('<script type="application/json" id="{}">{}</script>\n').format(name, Markup(text))
