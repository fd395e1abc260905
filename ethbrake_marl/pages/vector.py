"""Figures inside a page: SVG with the text as outlines, in the colours of the page, light or dark.

The caption of a figure is taken out of the SVG and stands below it as text of the page, which a phone can show.
"""

from __future__ import annotations

import hashlib
import re
from xml.etree import ElementTree

from markupsafe import Markup

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.figures.style import CAPTION, CAPTION_PT, Figure, picture_bytes
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
_LINE_PT = 1.2 * CAPTION_PT  # of a caption, from one line to the next
_NARROW_PT = 540.0  # figures up to this width have one panel


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
    return drawing(svg, title, description)


def drawing(figure: Figure | bytes, title: str, description: str, *, alone: bool = False, known: str = "") -> Part:
    """A figure, or the SVG of one of ours, with its title and, in words, what it shows.

    ``alone``: in colours that must not change, such as those of a map; it then stands on white. ``known``: what its
    caption need not say, because the page does.
    """
    svg = figure if isinstance(figure, bytes) else picture_bytes(figure, "figure.svg")
    inner, caption = inline_svg(svg, f"{title}. {description}", recolour=not alone)
    for told in (known.strip(), description):
        caption = caption.replace(told, "").strip() if told else caption
    below = Markup('<p class="quiet">{}</p>').format(shown(caption)) if caption else Markup()
    return Part(
        Markup(
            "<figure><figcaption><strong>{}</strong> <span>{}</span></figcaption>"
            '<div class="drawing{}" tabindex="0" role="group" aria-label="{}">{}</div>{}</figure>\n'
        ).format(shown(title), shown(description), " map" * alone, shown(title), inner, below)
    )


def inline_svg(svg: bytes, label: str, *, recolour: bool = True) -> tuple[Markup, str]:
    """An SVG of ours as an element of a page, whose policy allows no ``style``, and its caption, which is taken out.

    No two names in a page may be alike.
    """
    root = ElementTree.fromstring(svg, ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True)))
    caption = _take_caption(root)
    prefix = f"f{hashlib.sha256(svg + label.encode()).hexdigest()[:8]}-"
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in _DROPPED or not isinstance(child.tag, str):  # the latter are comments
                parent.remove(child)
    for element in root.iter():
        _restyle(element, recolour)
        _rename(element, prefix)
    for name in ("width", "height", "version"):
        root.attrib.pop(name, None)
    if _size_pt(root)[0] > _NARROW_PT:
        root.attrib["class"] = "broad"
    root.attrib |= {"role": "img", "aria-label": shown(label)}
    root.attrib |= {
        "stroke-linejoin": "round",
        "stroke-linecap": "butt",
        "fill": "var(--ink)" if recolour else "#000000",
    }
    ElementTree.register_namespace("", _SVG)
    ElementTree.register_namespace("xlink", _LINK)
    return Markup(ElementTree.tostring(root, encoding="unicode")), caption


def _take_caption(root: ElementTree.Element) -> str:
    """Take the caption out of a figure, and the room below that it had; gives its text, which stands in comments.

    Outlines of its letters stay, because texts drawn after it use them.
    """
    group = root.find(f".//{{{_SVG}}}g[@id='{CAPTION}']")
    if group is None:
        return ""
    lines = [(each.text or "").strip() for each in group.iter(ElementTree.Comment)]  # type: ignore[arg-type]
    outlines = list(group.iter(f"{{{_SVG}}}defs"))
    for child in list(group):
        group.remove(child)
    group.extend(outlines)
    width, height = _size_pt(root)
    if height > len(lines) * _LINE_PT:
        root.attrib["viewBox"] = f"0 0 {width:g} {height - len(lines) * _LINE_PT:g}"
    joined = "".join(line if re.search(r"\w-$", line) else f"{line} " for line in lines)
    return joined.strip()


def _size_pt(root: ElementTree.Element) -> tuple[float, float]:
    """Width and height of a figure; 0 where it does not say them as ours do."""
    found = re.fullmatch(r"0 0 (\d+(?:\.\d+)?) (\d+(?:\.\d+)?)", root.attrib.get("viewBox", ""))
    return (float(found[1]), float(found[2])) if found else (0.0, 0.0)


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
