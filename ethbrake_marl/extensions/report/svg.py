"""Convert a figure to an SVG element inside an HTML page."""

from __future__ import annotations

import hashlib
import re
from xml.etree import ElementTree

from matplotlib.figure import Figure

from ethbrake_marl.errors import InvalidInput, plain_text
from ethbrake_marl.extensions.report.style import CAPTION, CAPTION_PT, picture_bytes

_SVG, _LINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"

_DROPPED = {f"{{{_SVG}}}metadata", f"{{{_SVG}}}style"}

_PALETTE = {  # colour in a figure -> variable of the page, which has another value in dark mode
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
    "#b00020": "var(--alarm)",
    "#dddddd": "var(--grid)",
    "black": "var(--ink)",
    "white": "var(--paper)",
}

_ID = re.compile(r"#([A-Za-z][\w.:-]*)")

_CLIP = re.compile(r"url\(#[A-Za-z][\w.:-]*\)")

_HREF = f"{{{_LINK}}}href"

_TAGS = {
    f"{{{_SVG}}}{name}" for name in ("svg", "g", "defs", "path", "use", "clipPath", "rect")
}  # elements of our figures

_ATTRIBUTES = {
    "id", "d", "x", "y", "width", "height", "viewBox", "transform", "clip-path", "fill", "fill-opacity", "opacity",
    "stroke", "stroke-width", "stroke-opacity", "stroke-linecap", "stroke-linejoin", "stroke-dasharray",
    "stroke-dashoffset", "stroke-miterlimit", "version",
}  # fmt: skip

_MOST_DEEP = 50

_LINE_PT = 1.2 * CAPTION_PT  # line spacing of a caption

_NARROW_PT = 540.0  # figures up to this width have one panel

SLIM_IN = 3.8  # a figure of this width can be read on a phone without scrolling


def inline_svg(figure: Figure | bytes, label: str, *, recolour: bool = True) -> tuple[str, str]:
    """Return a figure as an SVG element, and its caption as text.

    The SVG element contains no caption and no ``style`` attributes, because the security policy of the page forbids
    such attributes. All ids get a prefix that depends on ``label``, so that two figures of a page have no id in common.
    Raises ``InvalidInput`` if ``figure`` is an SVG file with elements or attributes that this package never writes,
    because somebody may have changed the file.

    Args:
        figure: figure of matplotlib, or the bytes of an SVG file with a figure.
        label: description for readers who cannot see the figure.
        recolour: True: use the colours of the page, light or dark; False: keep the colours of the figure.

    """
    svg = figure if isinstance(figure, bytes) else picture_bytes(figure, "figure.svg")
    if svg is figure and not _is_ours(svg):
        raise InvalidInput("the file is not an SVG figure of this package; draw the figure again (--force)")
    root = ElementTree.fromstring(svg, ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True)))
    group, caption = root.find(f".//{{{_SVG}}}g[@id='{CAPTION}']"), ""
    if group is not None:  # the caption is in comments; later texts use the outlines of its letters, so these stay
        lines = [(each.text or "").strip() for each in group.iter(ElementTree.Comment)]  # type: ignore[arg-type]
        outlines = list(group.iter(f"{{{_SVG}}}defs"))
        for child in list(group):
            group.remove(child)
        group.extend(outlines)
        width, height = _size_pt(root)
        if height > len(lines) * _LINE_PT:
            root.attrib["viewBox"] = f"0 0 {width:g} {height - len(lines) * _LINE_PT:g}"
        caption = "".join(line if re.search(r"\w-$", line) else f"{line} " for line in lines).strip()
    prefix = f"f{hashlib.sha256(svg + label.encode()).hexdigest()[:8]}-"
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in _DROPPED or not isinstance(child.tag, str):  # a tag that is no string is a comment
                parent.remove(child)
    for element in root.iter():
        _restyle(element, recolour)
        if "id" in element.attrib:
            element.attrib["id"] = prefix + element.attrib["id"]
        for name, value in element.attrib.items():  # ids that the element refers to
            if name == _HREF or (name in ("clip-path", "fill", "mask") and value.startswith("url(")):
                element.attrib[name] = value if value.startswith("data:") else _ID.sub(rf"#{prefix}\1", value)
    for name in ("width", "height", "version"):
        root.attrib.pop(name, None)
    if _size_pt(root)[0] > _NARROW_PT:
        root.attrib["class"] = "broad"
    elif _size_pt(root)[0] <= 72.0 * SLIM_IN + 0.1:
        root.attrib["class"] = "slim"
    root.attrib |= {"role": "img", "aria-label": plain_text(label, keep="\u00a0")}
    root.attrib |= {
        "stroke-linejoin": "round",
        "stroke-linecap": "butt",
        "fill": "var(--ink)" if recolour else "#000000",
    }
    ElementTree.register_namespace("", _SVG)
    ElementTree.register_namespace("xlink", _LINK)
    return ElementTree.tostring(root, encoding="unicode"), caption


def _size_pt(root: ElementTree.Element) -> tuple[float, float]:
    """Return the width and height of an SVG figure in points; (0, 0) if its ``viewBox`` cannot be read."""
    match = re.fullmatch(r"0 0 (\d+(?:\.\d+)?) (\d+(?:\.\d+)?)", root.attrib.get("viewBox", ""))
    return (float(match[1]), float(match[2])) if match else (0.0, 0.0)


def _is_ours(svg: bytes) -> bool:
    """Return whether an SVG file contains only those elements and attributes that figures of this package have."""
    try:
        level = [ElementTree.fromstring(svg)]
    except (ElementTree.ParseError, LookupError, ValueError):  # not XML, or an unknown encoding
        return False
    for _ in range(_MOST_DEEP):
        level = [element for element in level if element.tag not in _DROPPED]
        for element in level:
            _restyle(element, recolour=False)
            if element.tag not in _TAGS:
                return False
            for name, value in element.attrib.items():  # attributes may only draw, and may not refer to other files
                inside = name == "transform" or "(" not in value or _CLIP.fullmatch(value) is not None
                if not (_ID.fullmatch(value) if name == _HREF else name in _ATTRIBUTES and inside):
                    return False
        level = [child for element in level for child in element]
    return not level


def _restyle(element: ElementTree.Element, recolour: bool) -> None:
    """Replace the ``style`` attribute of ``element`` by one attribute for each CSS property.

    If ``recolour`` is true, the colours of the figure are replaced by the colours of the page.
    """
    for declaration in element.attrib.pop("style", "").split(";"):
        name, colon, value = declaration.partition(":")
        if colon:
            element.attrib[name.strip()] = value.strip()
    if recolour:
        for name in ("fill", "stroke"):
            if (colour := element.attrib.get(name, "").lower()) in _PALETTE:
                element.attrib[name] = _PALETTE[colour]
