"""HTML pages. Each page is a single file, which loads no other file.

A page consists of a title, a short lead and sections. A section consists of strings, which become paragraphs, and of
parts: tables, figures or the episode player. Strings are escaped, so characters such as < are shown and never act as
HTML. Control characters, and characters that change the writing direction, are shown as Python escapes.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from typing import TYPE_CHECKING

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ethbrake_marl.errors import plain_text
from ethbrake_marl.files.sheet import Sheet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SLIM_IN = 3.8  # a figure of this width can be read on a phone without scrolling

_NARROW_PT = 540.0  # figures up to this width have one panel

_STAY = "\u00a0"  # no-break space


@dataclass(frozen=True, slots=True)
class Part:
    """Part of an HTML page: its HTML text, and the names of the style sheets and scripts that it needs.

    The class methods return common parts, for instance ``Part.paragraph("Text")``.
    """

    html: Markup  # HTML text of the part
    styles: tuple[str, ...] = ()  # names of style sheets in this folder
    scripts: tuple[str, ...] = ()  # names of scripts in this folder

    @classmethod
    def paragraph(cls, text: str, kind: str = "") -> Part:
        """Return ``text`` as a paragraph.

        ``kind`` is its style: ``quiet`` (small print), ``note`` (important remark), ``alarm``, or empty.
        """
        return cls(Markup('<p class="{}">{}</p>\n').format(kind, shown(text)))

    @classmethod
    def heading(cls, text: str) -> Part:
        """Return ``text`` as a heading inside a section."""
        return cls(Markup("<h3>{}</h3>\n").format(shown(text)))

    @classmethod
    def facts(cls, facts: Mapping[str, object]) -> Part:
        """Return a list of the entries of ``facts``, each as a name with its value."""
        lines = [Markup("<dt>{}</dt><dd>{}</dd>").format(shown(name), _text(value)) for name, value in facts.items()]
        return cls(Markup("<dl>\n{}\n</dl>\n").format(Markup("\n").join(lines)))

    @classmethod
    def remarks(cls, texts: Sequence[str]) -> Part:
        """Return a list of important remarks; the part is empty if ``texts`` is empty."""
        lines = [Markup("<li>{}</li>").format(shown(text)) for text in texts]
        return cls(Markup('<ul class="remarks">\n{}\n</ul>\n').format(Markup("\n").join(lines)) if lines else Markup())

    @classmethod
    def box(cls, title: str, meanings: Mapping[str, str]) -> Part:
        """Return a box that explains words; ``meanings`` maps each word to its meaning."""
        markup = Markup('<aside class="box"><strong>{}</strong>{}</aside>\n')
        return cls(markup.format(shown(title), cls.facts(meanings).html))

    @classmethod
    def beside(cls, parts: Sequence[Part]) -> Part:
        """Return a part that shows ``parts`` side by side, or one below the other on a narrow screen."""
        return cls._around('<div class="beside">{}</div>\n', parts)

    @classmethod
    def opened(cls, title: str, parts: Sequence[Part]) -> Part:
        """Return a part that shows ``parts`` under a title; they are hidden until the reader clicks on the title."""
        return cls._around("<details><summary>{}</summary>\n{}</details>\n", parts, shown(title))

    @classmethod
    def _around(cls, markup: str, parts: Sequence[Part], *texts: str) -> Part:
        inside = Markup("").join(part.html for part in parts)
        styles, scripts = (tuple(n for part in parts for n in getattr(part, what)) for what in ("styles", "scripts"))
        return cls(Markup(markup).format(*texts, inside), styles, scripts)

    @classmethod
    def data(cls, name: str, content: object, styles: tuple[str, ...] = (), scripts: tuple[str, ...] = ()) -> Part:
        """Return ``content`` as JSON in an HTML element ``script``, for the scripts of the page.

        The characters < > and & are escaped, so the content cannot end the element or begin a new element. ``name`` is
        the id of the element. ``styles`` and ``scripts`` are the names of the style sheets and scripts that read the
        data.
        """
        text = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
        for sign in "<>&":
            text = text.replace(sign, f"\\u{ord(sign):04x}")
        html = Markup('<script type="application/json" id="{}">{}</script>\n').format(name, Markup(text))
        return cls(html, styles, scripts)

    @classmethod
    def template(cls, file: str, styles: tuple[str, ...] = (), scripts: tuple[str, ...] = (), **values: object) -> Part:
        """Return the template ``file`` from the folder of this module, filled with ``values``.

        Values of the type ``Markup`` (HTML text) are inserted unchanged; other values are escaped. The part needs the
        style sheets ``styles`` and the scripts ``scripts`` of the same folder.
        """
        return cls(Markup(_environment().get_template(file).render(**values)), styles, scripts)

    @classmethod
    def table(cls, sheet: Sheet) -> Part:
        """Return ``sheet`` as a table, which can be scrolled if it is wider than the page.

        To put HTML such as a button into a cell, give a ``Shown`` object whose value has the type ``Markup``. The texts
        of all other cells are escaped.
        """
        return cls(Markup(sheet.html() + "\n"))

    @classmethod
    def drawing(cls, figure: Figure | bytes, title: str, description: str) -> Part:
        """Return a part that shows a figure, or the bytes of an SVG file, with a title and a description.

        The caption of a figure becomes text of the page, because the text of a wide figure is too small on a phone.
        """
        from ethbrake_marl.extensions.report.style import picture_bytes

        caption = Markup()
        if isinstance(figure, bytes):
            svg = figure
        else:
            text = figure.get_supxlabel()
            figure.supxlabel("")
            svg = picture_bytes(figure, "figure.svg")
            figure.supxlabel(text)
            caption = Markup('<p class="quiet">{}</p>').format(shown(" ".join(text.split()))) if text else caption
        size = re.search(rb'width="([0-9.]+)pt"', svg)
        width_pt = float(size[1]) if size else 0.0
        kind = "broad" if width_pt > _NARROW_PT else "slim" if width_pt <= 72.0 * SLIM_IN + 0.1 else ""
        return cls(
            Markup(
                "<figure><figcaption><strong>{}</strong> <span>{}</span></figcaption>"
                '<div class="drawing" tabindex="0" role="group" aria-label="{}">'
                '<img class="{}" alt="{}" src="data:image/svg+xml;base64,{}"></div>{}</figure>\n'
            ).format(
                shown(title), shown(description), shown(title), kind, shown(f"{title}. {description}"),
                base64.b64encode(svg).decode(), caption,
            )
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Section:
    """Section of a page."""

    title: str  # heading, and entry in the table of contents
    body: Sequence[str | Part]  # strings, which become paragraphs, and parts

    @property
    def parts(self) -> list[Part]:
        """Body of the section as a list of parts."""
        return [Part.paragraph(each) if isinstance(each, str) else each for each in self.body]


@dataclass(frozen=True)
class Page:
    """A whole HTML page.

    Args:
        title: title of the page.
        sections: sections in order; each has an entry in the table of contents.
        lead: one or two sentences below the title.
        opening: parts of the page between the lead and the table of contents.

    >>> from ethbrake_marl.extensions.report.page import Page, Part, Section
    >>> section = Section("Results", ["Text with <b> stays text.", Part.paragraph("small print")])
    >>> "Text with &lt;b&gt; stays text." in Page("A page", [section]).html
    True

    """

    title: str  # title of the page
    sections: Sequence[Section]  # sections in order
    lead: str = ""  # text below the title
    opening: Sequence[Part] = ()  # parts between the lead and the table of contents

    @cached_property
    def _parts(self) -> list[Part]:
        return [*self.opening, *(part for section in self.sections for part in section.parts)]

    @cached_property
    def _code(self) -> tuple[str, str]:
        """Text of all style sheets of the page, and text of all its scripts, each file once."""
        styles = dict.fromkeys(["page.css", *(name for part in self._parts for name in part.styles)])
        scripts = dict.fromkeys(name for part in self._parts for name in part.scripts)
        return "\n".join(map(read_file, styles)), "\n".join(map(read_file, scripts))

    @property
    def policy(self) -> str:
        """Content security policy of the page, which allows only the page's own styles, scripts and pictures."""
        styles, script = (
            f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" if text else "'none'"
            for text in self._code
        )
        return (
            f"default-src 'none'; style-src {styles}; script-src {script}; img-src data:;"
            " base-uri 'none'; form-action 'none'"
        )

    @staticmethod
    def anchors(titles: Sequence[str]) -> list[str]:
        """Return a unique anchor for each title, made of letters, digits and hyphens ("worst-ten-worlds")."""
        anchors: list[str] = []
        for k, title in enumerate(titles):
            name = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")[:40]
            anchors.append(f"{name}-{k + 1}" if name in anchors or not name else name)
        return anchors

    @cached_property
    def html(self) -> str:
        """HTML text of the whole page."""
        styles, script = self._code
        names = self.anchors([section.title for section in self.sections])
        whole = Part.template(
            "page.html.j2",
            title=self.title,
            lead=self.lead,
            opening=self.opening,
            sections=list(zip(names, self.sections, strict=True)),
            policy=self.policy,
            style=Markup(styles),
            script=Markup(script),
        )
        return str(whole.html)


def shown(value: object) -> str:
    """Return ``value`` as text, with control characters and characters that change the writing direction escaped."""
    return plain_text(str(value), keep=_STAY)


@cache
def read_file(name: str) -> str:
    """Return the text of the file ``name`` in the folder of this module."""
    return files(__package__).joinpath(name).read_text("utf-8")


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("ethbrake_marl.extensions.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_text,
    )


def _text(value: object) -> str:
    return value if isinstance(value, Markup) else shown(value)
