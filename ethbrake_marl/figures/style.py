"""The style of every figure: sizes, colours that colour-blind readers tell apart, captions, PNG."""

from __future__ import annotations

import io
import textwrap

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Figure  # the type that every figure has, for modules outside this folder

# Okabe and Ito's palette without its yellow (invisible on white); markers and dashes repeat the distinction.
COLOURS = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
DASHES: tuple[str | tuple[int, tuple[int, ...]], ...] = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1)), "-", "--")
GREY = "#555555"
DPI = 150

_CHARACTERS_PER_INCH = 17.0  # of a caption


def series_style(number: int) -> dict[str, object]:
    """Colour, marker and dashes of the series with this number (from 0); they repeat after seven."""
    k = number % len(COLOURS)
    return {"color": COLOURS[k], "marker": MARKERS[k], "linestyle": DASHES[k], "linewidth": 1.6, "markersize": 4.5}


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure that lays itself out; it belongs to no window."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def style_axes(axes: Axes) -> None:
    """Thin grid behind the data, no frame where nothing is read off."""
    axes.grid(visible=True, color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9, color=GREY)


def add_caption(figure: Figure, text: str) -> None:
    """The conditions of a figure, small, below it."""
    width = int(figure.get_figwidth() * _CHARACTERS_PER_INCH)
    figure.supxlabel(textwrap.fill(text, width), x=0.01, ha="left", fontsize=7.5, color=GREY)


def png_bytes(figure: Figure) -> bytes:
    """The figure as PNG; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    with matplotlib.rc_context({"savefig.facecolor": "white"}):
        figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()
