"""Figures inside a page: SVG with the text as outlines, in the colours of the page, light or dark."""

from __future__ import annotations

import hashlib
import re
from xml.etree import ElementTree

from markupsafe import Markup

from ethbrake_marl.figures.style import Figure, picture_bytes
from ethbrake_marl.pages.frame import Part, shown

_SVG, _LINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
_DROPPED = {f"{{{_SVG}}}metadata", f"{{{_SVG}}}style"}
_PALETTE = {  # colours of figures/style.py by what a page calls them: it has others for the dark
    "#000000": "var(--series-0)",
    "#d55e00": "var(--series-1)",
    "#0072b2": "var(--series-2)",
    "#009e73": "var(--series-3)",
    "#cc79a7": "var(--series-4)",
    "#e69f00": "var(--series-5)",
    "#56b4e9": "var(--series-6)",
    "#ffffff": "var(--paper)",
    "#555555": "var(--quiet)",
    "#262626": "var(--ink)",
    "#dddddd": "var(--grid)",
    "black": "var(--ink)",
    "white": "var(--paper)",
}
_ID = re.compile(r"#([A-Za-z][\w.:-]*)")


def drawing(figure: Figure, title: str, description: str, *, alone: bool = False) -> Part:
    """A figure with its title and, in words, what it shows.

    ``alone``: in colours that must not change, such as those of a map; it then stands on white.
    """
    inner = inline_svg(picture_bytes(figure, "figure.svg"), f"{title}. {description}", recolour=not alone)
    return Part(
        Markup(
            "<figure><figcaption><strong>{}</strong> <span>{}</span></figcaption>"
            '<div class="drawing{}" tabindex="0" role="group" aria-label="{}">{}</div></figure>\n'
        ).format(shown(title), shown(description), " map" * alone, shown(title), inner)
    )


def inline_svg(svg: bytes, label: str, *, recolour: bool = True) -> Markup:
    """An SVG of ours as an element of a page, whose policy allows no ``style``, and where no two names may be alike."""
    root = ElementTree.fromstring(svg)
    prefix = f"f{hashlib.sha256(svg + label.encode()).hexdigest()[:8]}-"
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in _DROPPED:
                parent.remove(child)
    for element in root.iter():
        _restyle(element, recolour)
        _rename(element, prefix)
    for name in ("width", "height", "version"):
        root.attrib.pop(name, None)
    root.attrib |= {"role": "img", "aria-label": shown(label)}
    root.attrib |= {
        "stroke-linejoin": "round",
        "stroke-linecap": "butt",
        "fill": "var(--ink)" if recolour else "#000000",
    }
    ElementTree.register_namespace("", _SVG)
    ElementTree.register_namespace("xlink", _LINK)
    return Markup(ElementTree.tostring(root, encoding="unicode"))


def _restyle(element: ElementTree.Element, recolour: bool) -> None:
    """Write each declaration of ``style`` as the attribute of that name."""
    for declaration in element.attrib.pop("style", "").split(";"):
        name, colon, value = declaration.partition(":")
        if colon:
            element.attrib[name.strip()] = value.strip()
    if recolour:
        for name in ("fill", "stroke"):
            if (colour := element.attrib.get(name, "").lower()) in _PALETTE:
                element.attrib[name] = _PALETTE[colour]


def _rename(element: ElementTree.Element, prefix: str) -> None:
    """Put the prefix before the element's name, and before every name that it points to."""
    if "id" in element.attrib:
        element.attrib["id"] = prefix + element.attrib["id"]
    for name, value in element.attrib.items():
        if name == f"{{{_LINK}}}href" or (name in ("clip-path", "fill", "mask") and value.startswith("url(")):
            element.attrib[name] = value if value.startswith("data:") else _ID.sub(rf"#{prefix}\1", value)
