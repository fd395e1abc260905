"""The frame of every HTML page: one file that loads nothing, opens from disk, and shows whatever it is told as text.

A page is a title, a sentence or two, and sections. What a section holds are strings, which become paragraphs, and parts
from ``parts``, ``vector`` and ``player``. Strings are never markup: they are escaped, and control and direction
characters are written as in Python.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ethbrake_marl.errors import plain_text

_STAY = "\u00a0"  # a blank at which no line is broken


@dataclass(frozen=True, slots=True)
class Part:
    """A piece of a page, and what it needs there: names of style sheets and scripts of this folder."""

    html: Markup
    styles: tuple[str, ...] = ()
    scripts: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Section:
    """A section of a page.

    >>> from ethbrake_marl.pages.frame import Section, page, paragraph
    >>> section = Section("Results", ["Text with <b> stays text.", paragraph("small print")])
    >>> "Text with &lt;b&gt; stays text." in page("A page", [section])
    True

    """

    title: str
    body: Sequence[str | Part]

    @property
    def parts(self) -> list[Part]:
        """The body, every string as a paragraph."""
        return [paragraph(each) if isinstance(each, str) else each for each in self.body]


def page(title: str, sections: Sequence[Section], *, lead: str = "", served: bool = False) -> str:
    """A whole page as HTML.

    Args:
        title: of the page.
        sections: in this order, each with an entry in the table of contents.
        lead: what the page is about, in a sentence or two below its title.
        served: it comes from a server of ours, which its script may ask; else it asks nobody.

    """
    styles, script = _own_code(sections)
    names = anchors([section.title for section in sections])
    whole = render(
        "page.html.j2",
        title=title,
        lead=lead,
        sections=list(zip(names, sections, strict=True)),
        policy=page_policy(sections, served=served),
        served=served,
        styles=Markup(styles),
        script=Markup(script),
    )
    return str(whole)


def page_policy(sections: Sequence[Section], *, served: bool = False) -> str:
    """The content security policy of a page: its own styles and script, pictures inside it, and nothing else."""
    styles, script = _own_code(sections)
    policy = (
        f"default-src 'none'; style-src {_source(styles)}; script-src {_source(script)}; img-src data:;"
        " base-uri 'none'; form-action 'none'"
    )
    return f"{policy}; connect-src 'self'" if served else policy


def render(template: str, **values: object) -> Markup:
    """A template of this folder with these values; all of them are text but what is Markup already."""
    return Markup(_environment().get_template(template).render(**values))


def shown(value: object) -> str:
    """A value as the text that a page shows: no control or direction character, whoever wrote it."""
    return plain_text(str(value), keep=_STAY)


def paragraph(text: str, kind: str = "") -> Part:
    """Text as a paragraph: ``quiet`` (conditions), ``note`` (what must not be overlooked), or a plain one."""
    return Part(Markup('<p class="{}">{}</p>\n').format(kind, shown(text)))


def anchors(titles: Sequence[str]) -> list[str]:
    """The name of each section of a page with these titles, for links: of letters and digits, no two alike."""
    found: list[str] = []
    for k, title in enumerate(titles):
        name = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")[:40]
        found.append(f"{name}-{k + 1}" if name in found or not name else name)
    return found


@cache
def read_file(name: str) -> str:
    """A file of this folder, as text."""
    return files(__package__).joinpath(name).read_text("utf-8")


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("ethbrake_marl.pages", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: value if isinstance(value, Markup) else shown(value),
    )


def _own_code(sections: Sequence[Section]) -> tuple[str, str]:
    """Styles and script of a page with these sections."""
    parts = [part for section in sections for part in section.parts]
    styles = _joined(["page.css", *(name for part in parts for name in part.styles)])
    return styles, _joined([name for part in parts for name in part.scripts])


def _joined(names: Sequence[str]) -> str:
    """These files one after the other, each once."""
    return "\n".join(read_file(name) for name in dict.fromkeys(names))


def _source(text: str) -> str:
    """What the page's own policy allows: this text and no other."""
    if not text:
        return "'none'"
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


# Parts of pages made from plain data: tables, lists of facts, texts that open, data for scripts.


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
