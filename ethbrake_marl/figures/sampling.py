"""How errors of harm shrink with the step of the paper's map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from ethbrake_marl.figures.style import GREY, Figure, add_caption, new_figure, series_style, style_axes
from ethbrake_marl.physics import Floats

Series = tuple[str, Floats]  # label, absolute error (m2/s2) at every step


def draw_errors(panels: Mapping[str, Sequence[Series]], *, steps_s: Sequence[float], caption: str) -> Figure:
    """Absolute errors over the step, both on logarithmic axes, one panel per title, with a line of order 1."""
    figure = new_figure(7.4, 3.9)
    places = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (title, series) in zip(places, panels.items(), strict=True):
        _draw(axes, title, series, steps_s)
    places[0].set_ylabel("Absolute error of harm (m²/s²)", fontsize=9)
    handles, labels = places[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=2, frameon=False, fontsize=9)
    add_caption(figure, caption)
    return figure


def _draw(axes: Axes, title: str, series: Sequence[Series], steps_s: Sequence[float]) -> None:
    """One panel: a line for each series, and one of order 1 (ten times the step)."""
    style_axes(axes)
    for number, (label, errors) in enumerate(series):
        axes.loglog(steps_s, errors, label=label, **series_style(number))
    ends = np.array([min(steps_s), max(steps_s)])
    axes.loglog(ends, 10.0 * ends, color=GREY, linewidth=0.9, label="order 1")
    axes.set_xticks(steps_s, [f"{step:g}" for step in steps_s])
    axes.minorticks_off()
    axes.tick_params(labelsize=8)
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_xlabel("Step (s)", fontsize=9)
