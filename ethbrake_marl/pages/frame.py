"""The frame of every HTML page: one file that loads nothing, opens from disk, and shows whatever it is told as text.

A page is a title, a sentence or two, and sections. What a section holds are strings, which become paragraphs, and parts
from ``parts``, ``vector`` and ``player``. Strings are never markup: they are escaped, and control and direction
characters are written as in Python.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

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
