"""Figures inside a page: SVG with the text as outlines, in the colours of the page, light or dark."""

from __future__ import annotations

import hashlib
import re
from xml.etree import ElementTree

from markupsafe import Markup

from ethbrake_marl.errors import InvalidInput
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
_CLIP = re.compile(r"url\(#[A-Za-z][\w.:-]*\)")
_HREF = f"{{{_LINK}}}href"
_TAGS = {f"{{{_SVG}}}{name}" for name in ("svg", "g", "defs", "path", "use", "clipPath", "rect")}  # of a figure of ours
_ATTRIBUTES = {
    "id", "d", "x", "y", "width", "height", "viewBox", "transform", "clip-path", "fill", "fill-opacity", "opacity",
    "stroke", "stroke-width", "stroke-opacity", "stroke-linecap", "stroke-linejoin", "stroke-dasharray",
    "stroke-dashoffset", "stroke-miterlimit", "version",
}  # fmt: skip
_MOST_DEEP = 50


def drawing(figure: Figure, title: str, description: str, *, alone: bool = False) -> Part:
    """A figure with its title and, in words, what it shows.

    ``alone``: in colours that must not change, such as those of a map; it then stands on white.
    """
    svg = picture_bytes(figure, "figure.svg")
    return _framed(inline_svg(svg, f"{title}. {description}", recolour=not alone), title, description, alone=alone)


def kept_drawing(svg: bytes, title: str, description: str, where: str) -> Part:
    """A figure that was written to a file before, as ``drawing`` shows it.

    Raises ``InvalidInput`` that begins with ``where`` for one that holds what no figure of ours does: somebody else may
    have changed the file.
    """
    try:
        ours = _is_ours(ElementTree.fromstring(svg))
    except (ElementTree.ParseError, LookupError, ValueError):  # no XML, or in a coding that nobody knows
        ours = False
    if not ours:
        raise InvalidInput(f"{where}: is not a figure as it was drawn; make it again (--force)")
    return _framed(inline_svg(svg, f"{title}. {description}"), title, description)


def _framed(inner: Markup, title: str, description: str, *, alone: bool = False) -> Part:
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


def _is_ours(root: ElementTree.Element) -> bool:
    """Whether all that a page would take from an SVG is what our figures are made of."""
    level = [root]
    for _ in range(_MOST_DEEP):
        level = [element for element in level if element.tag not in _DROPPED]
        for element in level:
            _restyle(element, recolour=False)
            if element.tag not in _TAGS or not all(map(_is_drawn, element.attrib, element.attrib.values())):
                return False
        level = [child for element in level for child in element]
    return not level


def _is_drawn(name: str, value: str) -> bool:
    """Whether an attribute only draws, and points to nothing outside its figure."""
    if name == _HREF:
        return _ID.fullmatch(value) is not None
    return name in _ATTRIBUTES and (name == "transform" or "(" not in value or _CLIP.fullmatch(value) is not None)


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
        if name == _HREF or (name in ("clip-path", "fill", "mask") and value.startswith("url(")):
            element.attrib[name] = value if value.startswith("data:") else _ID.sub(rf"#{prefix}\1", value)
