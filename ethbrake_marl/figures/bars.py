"""Bars of several series side by side, one group for each name."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.figures.style import Figure, add_caption, label_text, new_figure, series_style, style_axes


def draw_bars(
    names: Sequence[str], series: Sequence[tuple[str, Sequence[float]]], unit: str, *, caption: str = ""
) -> Figure:
    """A group of bars for every name, one bar of each (label, values) in it; raises ``InvalidInput`` without any.

    Args:
        names: of the groups, from left to right.
        series: label and values, a value for each name.
        unit: what the values are, with their unit.
        caption: below the figure.

    """
    if not names or not series or any(len(values) != len(names) for _, values in series):
        raise InvalidInput("draw_bars: every series needs a value for each of at least one name")
    figure = new_figure(8.4, 4.2)
    axes = figure.subplots()
    style_axes(axes)
    at, width = np.arange(len(names)), 0.8 / len(series)
    for number, (label, values) in enumerate(series):
        place = at + (number - (len(series) - 1) / 2) * width
        axes.bar(place, values, width, label=label_text(label), color=series_style(number)["color"])
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.set_xticks(at, [label_text(name) for name in names], rotation=30, ha="right", fontsize=8.5)
    axes.set_ylabel(unit, fontsize=9)
    axes.legend(fontsize=8.5, frameon=False)
    add_caption(figure, caption)
    return figure
