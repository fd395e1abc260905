"""Style of all figures, and writing a figure to a file."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font

from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, plain_text
from ethbrake_marl.evaluation.summary import caption, ranges_of
from ethbrake_marl.extensions.rendering.picture import PALETTE
from ethbrake_marl.files.store import write_output
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.describe import quantities_of

# Curves differ by marker and dashes as well as by colour.
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

DASHES: tuple[str | tuple[int, tuple[int, ...]], ...] = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1)), "-", "--")

GREY = "#555555"

STYLE: dict[str, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.labelsize": 9,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "pdf.fonttype": 42,  # embeds fonts as TrueType
    "savefig.dpi": 150,
    "savefig.facecolor": "white",
    "svg.fonttype": "path",  # embeds fonts as outlines
    "svg.hashsalt": "ethbrake",
    "xtick.color": GREY,
    "xtick.labelcolor": "black",
    "xtick.labelsize": 9,
    "ytick.color": GREY,
    "ytick.labelcolor": "black",
    "ytick.labelsize": 9,
}

# Decorator of every function that draws a figure: a user's matplotlibrc or style has no effect on our figures.
in_our_style = matplotlib.style.context(["default", STYLE])


def axis_title(count: HarmCount) -> str:
    return f"{count.words.capitalize()} (m²/s²)"


_CHARACTERS_PER_INCH = 17.0  # of a caption

_NO_DATES: dict[str, dict[str, None]] = {  # metadata to omit, because they differ between files of the same figure
    ".png": {"Software": None},
    ".svg": {"Date": None, "Creator": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}


class ShownFigure(Figure):
    """Figure that a notebook displays without pyplot."""

    def _repr_png_(self) -> bytes:
        return picture_bytes(self, "shown.png")


def new_figure(width_in: float, height_in: float) -> Figure:
    return ShownFigure(figsize=(width_in, height_in), layout="constrained")


def new_panels(size_in: tuple[float, float], rows: int = 1, columns: int = 1, **how: Any) -> tuple[Figure, list[Axes]]:
    figure = new_figure(*size_in)
    return figure, list(figure.subplots(rows, columns, squeeze=False, **how).ravel())


def series_style(number: int) -> dict[str, Any]:
    """Style of curve ``number`` (from 0), as arguments of matplotlib's ``plot``. The seven styles repeat."""
    k = number % len(PALETTE)
    return {"color": PALETTE[k], "marker": MARKERS[k], "linestyle": DASHES[k], "linewidth": 1.6, "markersize": 4.5}


def label_text(text: str, most: int = 40) -> str:
    """``text`` as a label, cut in the middle. A dollar sign starts no formula; unknown characters are escaped."""
    signs = font_signs()
    label = "".join(c if ord(c) in signs else c.encode("unicode_escape").decode() for c in plain_text(text))
    return (label if len(label) <= most else f"{label[: most - 16]}…{label[-15:]}").replace("$", r"\$")


@cache
def font_signs() -> frozenset[int]:
    return frozenset(get_font(findfont("DejaVu Sans")).get_charmap())


def band(axes: Axes, x: Sequence[float] | Floats, low: Any, high: Any, style: Mapping[str, Any]) -> None:
    axes.fill_between(x, low, high, color=str(style["color"]), alpha=0.18, linewidth=0.0)


def finish(
    figure: Figure, caption: str, legend: Axes | None = None, *, columns: int = 6, fontsize: float = 9
) -> Figure:
    """Figure with a caption, and the legend of the panel ``legend`` above all panels."""
    if legend is not None:
        named = legend.get_legend_handles_labels()
        figure.legend(*named, loc="outside upper left", ncols=columns, frameon=False, fontsize=fontsize)
    text = textwrap.fill(caption, int(figure.get_figwidth() * _CHARACTERS_PER_INCH))
    figure.supxlabel(text, x=0.01, ha="left", fontsize=7.5, color=GREY)
    return figure


@in_our_style
def picture_bytes(figure: Figure, path: str | Path) -> bytes:
    """Content of a PNG, SVG or PDF file; the ending of ``path`` selects the format. The same figure gives the same
    bytes.
    """
    ending = Path(path).suffix.lower()
    if ending not in _NO_DATES:
        raise InvalidInput(f"{path}: the name of a picture file must end in .png, .svg or .pdf")
    buffer = io.BytesIO()
    figure.savefig(buffer, format=ending[1:], metadata=_NO_DATES[ending])
    return buffer.getvalue()


def write_picture(path: str | Path, figure: Figure, *, force: bool = False) -> None:
    """Write ``figure`` to a PNG, SVG or PDF file. If writing fails, an existing file stays.

    Raises ``InvalidInput`` for any other ending or if the file cannot be written, and ``AlreadyExists`` if the file
    exists and ``force`` is false.
    """
    write_output(path, picture_bytes(figure, path), force=force)


def plain_number(value: float, _: int) -> str:
    """Number on an axis as text such as 1000, not as a power of ten."""
    return f"{value:g}"


def quantities(world: State) -> str:
    """Quantities of one world as text such as ``d = (7, 7) m; v = (20, 18, 20) m/s; ...``."""
    ranges = ranges_of(quantities_of(world))
    return caption({"scenario": "", "count": 1, **ranges}).partition("; ")[2]
