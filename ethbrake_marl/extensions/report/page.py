"""HTML pages, filled from the templates in this folder. A page is one file, which loads no other.

Texts are escaped. Control characters, and characters that change the writing direction, become Python escapes.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from ethbrake_marl.errors import plain_text
from ethbrake_marl.extensions.report.style import picture_bytes
from ethbrake_marl.files.sheet import Sheet

SLIM_IN, BROAD_IN = 3.8, 7.5  # a phone shows a slim figure without scrolling; a broad one has several panels

_STYLES = ("page.css", "player.css")
_SCRIPTS = ("player-motion.js", "player-view.js", "player.js")
_STAY = "\u00a0"  # no-break space
_AFTER_SIGN = re.compile(r"(?<=[:+@,/])(?=.)")


class Section(NamedTuple):
    title: str  # heading, and entry in the table of contents
    body: Sequence[str]  # HTML (``Markup``), and texts, which become paragraphs
    folded: bool = False  # whether the reader must open it


def whole_page(title: str, lead: str, opening: Sequence[str], sections: Sequence[Section]) -> str:
    style, script = (Markup("\n".join(map(read_file, names))) for names in (_STYLES, _SCRIPTS))
    values = {"title": title, "lead": lead, "opening": opening, "sections": sections, "style": style, "script": script}
    return str(fill("page.html.j2", **values))


def page_part(name: str, *values: object) -> Markup:
    macros = _environment().get_template("parts.html.j2").module
    return Markup(getattr(macros, name)(*values))


def table(sheet: Sheet) -> Markup:
    """HTML of a table, with its title and note."""
    return page_part("table", sheet)


def drawing(figure: Figure, title: str, description: str) -> Markup:
    """HTML of a figure, whose caption becomes text of the page. ``title``, ``description``: for screen readers."""
    caption = " ".join(figure.get_supxlabel().split())
    figure.supxlabel("")
    svg = base64.b64encode(picture_bytes(figure, "figure.svg")).decode()
    width_in = figure.get_figwidth()
    kind = "broad" if width_in > BROAD_IN else "slim" if width_in <= SLIM_IN else ""
    return page_part("drawing", title, description, kind, svg, caption)


def data(name: str, content: object) -> Markup:
    """``content`` as JSON for the page's scripts, in an element with the id ``name``, which it cannot end."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return Markup('<script type="application/json" id="{}">{}</script>\n').format(name, Markup(text))


def fill(file: str, **values: Any) -> Markup:
    """HTML of the template ``file``. Values that are HTML (``Markup``) stay; all others are escaped."""
    return Markup(_environment().get_template(file).render(values))


def printable_text(value: object) -> str:
    """``value`` as text without control characters and changes of direction. HTML (``Markup``) stays."""
    return value if isinstance(value, Markup) else plain_text(str(value), keep=_STAY)


def breakable(name: str) -> Markup:
    """HTML of a name that may break after ``:``, ``+``, ``@``, ``,`` and ``/``. HTML (``Markup``) stays."""
    return name if isinstance(name, Markup) else Markup("<wbr>").join(map(printable_text, _AFTER_SIGN.split(name)))


@cache
def read_file(name: str) -> str:
    return files(__package__).joinpath(name).read_text("utf-8")


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("ethbrake_marl.extensions.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=printable_text,
    )
    environment.filters |= {"sha256": _sha256, "breakable": breakable}
    environment.filters["anchor"] = lambda title: title.lower().replace(" ", "-")
    return environment


def _sha256(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
