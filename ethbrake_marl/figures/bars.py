"""Bars of several series side by side, one group for each name, in panels below each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.statistics import Estimate
from ethbrake_marl.figures.style import GREY, add_caption, label_text, new_figure, series_style, style_axes

Series = Sequence[tuple[str, Sequence[Estimate]]]
"""Label and estimates, one for each name."""


def draw_bars(names: Sequence[str], panels: Sequence[tuple[str, Series]], *, caption: str = "") -> Figure:
    """A group of bars for every name, one bar of each series in it with its interval; ``InvalidInput`` without any.

    Args:
        names: of the groups, from left to right.
        panels: what the values are, with their unit, and the series; all panels have the same names and labels.
        caption: below the figure.

    """
    if not names or not panels or any(len(each) != len(names) for _, series in panels for _, each in series):
        raise InvalidInput("draw_bars: every series needs a value for each of at least one name")
    figure = new_figure(8.4, 1.2 + 3.0 * len(panels))
    at = np.arange(len(names))
    for axes, (unit, series) in zip(
        figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0], panels, strict=True
    ):
        style_axes(axes)
        width = 0.8 / max(len(series), 1)
        for number, (label, estimates) in enumerate(series):
            place = at + (number - (len(series) - 1) / 2) * width
            value = np.array([each.value for each in estimates])
            ends = np.array([each.interval or (each.value, each.value) for each in estimates]).T
            axes.bar(
                place, value, width, label=label_text(label), color=series_style(number)["color"],
                yerr=np.abs(ends - value), error_kw={"ecolor": GREY, "elinewidth": 0.8},
            )  # fmt: skip
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set_ylabel(unit, fontsize=9)
    axes.set_xticks(at, [label_text(name) for name in names], rotation=30, ha="right", fontsize=8.5)
    figure.axes[0].legend(fontsize=8.5, frameon=False)
    add_caption(figure, caption)
    return figure
