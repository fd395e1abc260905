"""How the cost of a step grows: over the number of worlds beside the number of vehicles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from ethbrake_marl.figures.style import GREY, Figure, add_caption, new_figure, series_style, style_axes

Point = tuple[str, int, float]  # name of the series, number of worlds or vehicles, cost


def draw_costs(batches: Sequence[Point], single: Sequence[Point], *, vehicles: Sequence[int], caption: str) -> Figure:
    """Cost of a step over n (``batches``, µs) and over N (``single``, ns); logarithmic axes, with lines of slope 1.

    ``vehicles`` are the ticks of N.
    """
    figure = new_figure(7.4, 3.9)
    left, right = figure.subplots(1, 2)
    _draw(left, batches)
    left.set_xlabel("Worlds n, of three vehicles", fontsize=9)
    left.set_ylabel("One step of all n worlds (µs)", fontsize=9)
    _draw(right, single)
    right.set_xlabel("Vehicles N in a world", fontsize=9)
    right.set_ylabel("One step of one world (ns)", fontsize=9)
    right.set_xticks(vehicles, [str(each) for each in vehicles])
    right.minorticks_off()
    add_caption(figure, caption)
    return figure


def _draw(axes: Axes, points: Sequence[Point]) -> None:
    """A line for each series, and through the last point of each a line of slope 1."""
    style_axes(axes)
    series = dict.fromkeys(name for name, _, _ in points)
    lines = {what: np.array([point[1:] for point in points if point[0] == what]).T for what in series}
    for number, (what, (counts, costs)) in enumerate(lines.items()):
        axes.loglog(counts, costs, label=what, **series_style(number))
    for number, (counts, costs) in enumerate(lines.values()):
        label = "proportional" if number == 0 else None
        axes.loglog(counts, costs[-1] / counts[-1] * counts, color=GREY, linewidth=0.8, label=label, zorder=1)
    axes.legend(frameon=False, fontsize=8, loc="upper left")
