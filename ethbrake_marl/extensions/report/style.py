"""Style of all figures: colours, axes, caption, and writing a figure to a file."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font

from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, plain_text
from ethbrake_marl.evaluation.captions import caption, ranges_of
from ethbrake_marl.extensions.rendering.picture import COLOURS
from ethbrake_marl.files.store import write_output
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.describe import quantities_of

# Curves differ by marker and dashes as well as by colour.
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

DASHES: tuple[str | tuple[int, tuple[int, ...]], ...] = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1)), "-", "--")

# Decorator of every function that draws a figure: a user's matplotlibrc or style has no effect on our figures.
in_our_style = matplotlib.style.context("default")

GREY = "#555555"

DPI = 150
CAPTION_PT = 7.5

_CHARACTERS_PER_INCH = 17.0  # characters per inch of a caption

_NO_DATES: dict[str, dict[str, None]] = {  # metadata to omit, because they differ between files of the same figure
    ".png": {"Software": None},
    ".svg": {"Date": None, "Creator": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}


class ShownFigure(Figure):
    """Figure that a notebook displays without pyplot."""

    def _repr_png_(self) -> bytes:
        return picture_bytes(self, "shown.png")


def series_style(number: int) -> dict[str, Any]:
    """Return the style of curve ``number`` (from 0), as keyword arguments of matplotlib's ``plot``.

    The styles repeat: curve 7 has the style of curve 0.
    """
    k = number % len(COLOURS)
    return {"color": COLOURS[k], "marker": MARKERS[k], "linestyle": DASHES[k], "linewidth": 1.6, "markersize": 4.5}


def label_text(text: str, most: int = 40) -> str:
    """Return ``text`` as a label of at most ``most`` characters.

    Dollar signs do not start a formula, and characters that the font lacks are escaped.
    """
    signs = font_signs()
    label = "".join(c if ord(c) in signs else c.encode("unicode_escape").decode() for c in plain_text(text))
    return (label if len(label) <= most else f"{label[: most - 16]}…{label[-15:]}").replace("$", r"\$")


@cache
def font_signs() -> frozenset[int]:
    """Return the code points of all characters in the font of the figures."""
    return frozenset(get_font(findfont("DejaVu Sans")).get_charmap())


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure with automatic layout. Width and height are in inches."""
    return ShownFigure(figsize=(width_in, height_in), layout="constrained")


def style_axes(axes: Axes, labelsize: float = 9) -> None:
    """Set a thin grid behind the data, and remove the top and right frame lines."""
    axes.grid(visible=True, color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=labelsize, color=GREY)


def new_panels(size_in: tuple[float, float], rows: int = 1, columns: int = 1, **how: Any) -> tuple[Figure, list[Axes]]:
    """Return a figure with ``rows`` times ``columns`` panels, and the axes of the panels, row by row.

    ``size_in`` is width and height in inches. ``how`` are keyword arguments for matplotlib's ``subplots``.
    """
    figure = new_figure(*size_in)
    panels = list(figure.subplots(rows, columns, squeeze=False, **how).ravel())
    for axes in panels:
        style_axes(axes)
    return figure, panels


def name_axes(axes: Axes, title: str = "", x: str = "", y: str = "") -> None:
    """Set the title of a panel and the labels ``x`` and ``y`` of its axes.

    An empty text leaves the title or label as it is.
    """
    in_style = ((title, partial(axes.set_title, loc="left"), 10), (x, axes.set_xlabel, 9), (y, axes.set_ylabel, 9))
    for text, write, size in in_style:
        if text:
            write(text, fontsize=size)


def finish(
    figure: Figure, caption: str, legend: Axes | None = None, *, columns: int = 6, fontsize: float = 9
) -> Figure:
    """Add a caption and the legend of one panel (None: no legend) to a figure, and return the figure.

    ``columns`` and ``fontsize`` are for the legend.
    """
    if legend is not None:
        named = legend.get_legend_handles_labels()
        figure.legend(*named, loc="outside upper left", ncols=columns, frameon=False, fontsize=fontsize)
    add_caption(figure, caption)
    return figure


def band(axes: Axes, x: Sequence[float] | Floats, low: Any, high: Any, style: Mapping[str, Any]) -> None:
    """Fill the area between the curves ``low`` and ``high`` over ``x``, in the colour of ``style``."""
    axes.fill_between(x, low, high, color=str(style["color"]), alpha=0.18, linewidth=0.0)


def add_caption(figure: Figure, text: str) -> None:
    """Write ``text`` below the figure, in a small font."""
    width = int(figure.get_figwidth() * _CHARACTERS_PER_INCH)
    figure.supxlabel(textwrap.fill(text, width), x=0.01, ha="left", fontsize=CAPTION_PT, color=GREY)


def picture_ending(path: str | Path) -> str:
    """Return the ending of a picture's file name: .png, .svg or .pdf.

    Raises ``InvalidInput`` if the file name has a different ending.
    """
    ending = Path(path).suffix.lower()
    if ending not in _NO_DATES:
        raise InvalidInput(f"{path}: the name of a picture file must end in .png, .svg or .pdf")
    return ending


def picture_bytes(figure: Figure, path: str | Path) -> bytes:
    """Return the bytes of a PNG, SVG or PDF file with the figure. The ending of ``path`` selects the format.

    The same figure always gives the same bytes. Raises ``InvalidInput`` if the ending is not .png, .svg or .pdf.
    """
    ending = picture_ending(path)
    buffer = io.BytesIO()
    # fonts are embedded, as outlines in SVG and as TrueType in PDF
    own = {"savefig.facecolor": "white", "svg.hashsalt": "ethbrake", "svg.fonttype": "path", "pdf.fonttype": 42}
    with matplotlib.style.context(["default", own]):
        figure.savefig(buffer, format=ending[1:], dpi=DPI, metadata=_NO_DATES[ending])
    return buffer.getvalue()


def write_picture(path: str | Path, figure: Figure, *, force: bool = False) -> None:
    """Write ``figure`` to a PNG, SVG or PDF file. The ending of ``path`` selects the format.

    If writing fails, an existing file stays unchanged. Raises ``InvalidInput`` if the ending of ``path`` is not .png,
    .svg or .pdf or if the file cannot be written, and ``AlreadyExists`` if the file exists and ``force`` is false.
    """
    write_output(path, picture_bytes(figure, path), force=force)


TITLES = {"first": "First-impact harm (m²/s²)", "total": "Total harm (m²/s²)"}


def plain(value: float, _: int) -> str:
    """Return the number at a tick of an axis as text such as 1000, not as a power of ten."""
    return f"{value:g}"


def quantities(world: State) -> str:
    """Return the quantities of one world in words: ``d = (7, 7) m; v = (20, 18, 20) m/s; ...``."""
    ranges = ranges_of(quantities_of(world))
    return caption({"scenario": "", "count": 1, **ranges}).partition("; ")[2]
