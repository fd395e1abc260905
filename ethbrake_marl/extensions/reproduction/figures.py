"""Figures of a reproduction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ethbrake_marl.evaluation.record import EpisodeRecord
from ethbrake_marl.extensions.report.style import GREY, band, finish, in_our_style, name_axes, new_panels, series_style
from ethbrake_marl.files.sheet import Estimate

ARROW_S = 1.0  # between arrows: ten steps, as in the paper
VEHICLE_2 = 1  # column of arrays


@in_our_style
def estimates_figure(
    panels: Mapping[str, Mapping[str, Mapping[Any, Estimate]]], y_label: str, caption: str, x_label: str = ""
) -> Figure:
    """Draw estimates with intervals: title of a panel -> label of a series -> x -> estimate.

    With an ``x_label``, x are numbers, of lines with bands; without it they are texts, of groups of bars.
    """
    figure, every = new_panels((4.6 * len(panels), 4.2), columns=len(panels), sharey=True)
    for axes, (title, lines) in zip(every, panels.items(), strict=True):
        width = 0.8 / len(lines)
        for number, (label, line) in enumerate(lines.items()):
            style, y = series_style(number), [each.value for each in line.values()]
            low, high = zip(*(each.ends for each in line.values()), strict=True)
            if x_label:
                axes.plot(list(line), y, label=label, **style)
                band(axes, list(line), low, high, style)
                continue
            x = [k + (number - 0.5 * (len(lines) - 1)) * width for k in range(len(line))]
            axes.bar(x, y, 0.9 * width, color=str(style["color"]), label=label)
            axes.vlines(x, low, high, color="black", linewidth=1.0)
            axes.set_xticks(range(len(line)), list(line))
        name_axes(axes, title, x_label)
    if x_label:
        every[0].set_ylim(bottom=0.0)
    name_axes(every[0], y=y_label)
    return finish(figure, caption, every[0], columns=3)


def in_pairs(panels: int, height_in: float, x: str, y: str) -> tuple[Figure, list[Axes]]:
    """Return a figure with two panels in a row, all on the same scales."""
    rows = (panels + 1) // 2
    figure, every = new_panels((10.0, height_in * rows + 1.0), rows, 2, sharex=True, sharey=True)
    for axes in every[::2]:
        name_axes(axes, y=y)
    for axes in every[-2:]:
        name_axes(axes, x=x)
    return figure, every


@in_our_style
def road_figure(records: Mapping[str, EpisodeRecord], caption: str) -> Figure:
    """Draw vehicles along the road as the paper does: a row each, an arrow every second, dashes join equal times."""
    figure, panels = in_pairs(len(records), 1.9, "Position along the road (m)", "Vehicle")
    for axes, (title, record) in zip(panels, records.items(), strict=True):
        vehicles = np.arange(1, record.positions_m.shape[1] + 1)
        times = np.arange(0.0, record.time_s[-1] + 1e-9, ARROW_S)
        at = np.array([np.interp(times, record.time_s, column) for column in record.positions_m.T])
        axes.plot(at, vehicles, color=GREY, linewidth=0.7, linestyle="--")
        for i, number in enumerate(vehicles):
            colour = str(series_style(i)["color"])
            axes.plot([at[i].min(), at[i].max()], [number, number], color=colour, linewidth=1.4)
            axes.plot(at[i], np.full(len(times), number), linestyle="none", marker=">", markersize=6, color=colour)
        axes.set_yticks(vehicles)
        axes.set_ylim(0.5, len(vehicles) + 0.5)
        name_axes(axes, title)
    return finish(figure, caption)


@in_our_style
def profiles_figure(panels: Mapping[str, Mapping[str, EpisodeRecord]], caption: str) -> Figure:
    """Draw the command of Vehicle 2 over time: title of a panel -> label of a curve -> episode."""
    figure, every = in_pairs(len(panels), 2.3, "Time since Vehicle 1 began to brake (s)", "Command (m/s²)")
    for axes, (title, records) in zip(every, panels.items(), strict=True):
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        for number, (label, record) in enumerate(records.items()):
            style = {**series_style(number), "marker": ""}
            command = record.command_mps2[:, VEHICLE_2]
            axes.plot(record.time_s, command, drawstyle="steps-post", label=label, **style)
        name_axes(axes, title)
    return finish(figure, caption, every[0], columns=4)
