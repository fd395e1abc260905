"""Functions that draw the figures of a reproduction of the paper."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ethbrake_marl.extensions.report.style import GREY, band, finish, in_our_style, name_axes, new_panels, series_style
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.first_edition.envs.rendering import vehicle_colour
from ethbrake_marl.first_edition.evaluation.record import EpisodeRecord

_ARROW_STEPS = 10  # time steps between arrows, as in the paper

_ROW_CHARACTERS = 52  # characters in a line of a row's label


@in_our_style
def estimates_figure(
    panels: Mapping[str, Mapping[str, Mapping[Any, Estimate]]], *, y_label: str, caption: str, x_label: str = ""
) -> Figure:
    """Draw estimates with their 95 % intervals, in one or more panels.

    ``panels`` maps title of the panel -> label of the series -> x -> estimate. With an ``x_label``, x must be numbers,
    and lines with bands are drawn; without it, x must be texts, and groups of bars are drawn.
    """
    figure, every = new_panels((4.6 * len(panels), 4.2), columns=len(panels), sharey=True)
    for axes, (title, lines) in zip(every, panels.items(), strict=True):
        width, groups = 0.8 / len(lines), list(next(iter(lines.values())))
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
        if not x_label:
            axes.set_xticks(range(len(groups)), groups)
        name_axes(axes, title, x_label)
    if x_label:
        every[0].set_ylim(bottom=0.0)
    name_axes(every[0], y=y_label)
    return finish(figure, caption, every[0], columns=3)


@in_our_style
def road_figure(records: Mapping[str, EpisodeRecord], *, caption: str) -> Figure:
    """Draw the positions of all vehicles on the road, as in the paper's figure.

    Each episode of ``records`` has a panel with its key as title, and each vehicle has a row in the panel. An arrow
    marks the position of a vehicle every ten time steps. Dashed lines connect positions at the same time.
    """
    figure, panels = _in_pairs(len(records), 1.9, "Position along the road (m)", "Vehicle")
    for axes, (title, record) in zip(panels, records.items(), strict=False):
        vehicles = np.arange(1, record.positions_m.shape[1] + 1)
        times = np.arange(0.0, record.time_s[-1] + 1e-9, _ARROW_STEPS * record.scenario.time_step_s)
        at = np.array([np.interp(times, record.time_s, column) for column in record.positions_m.T])
        axes.plot(at, vehicles, color=GREY, linewidth=0.7, linestyle="--")
        for i, number in enumerate(vehicles):
            colour = vehicle_colour(i)
            axes.plot([at[i].min(), at[i].max()], [number, number], color=colour, linewidth=1.4)
            axes.plot(at[i], np.full(len(times), number), linestyle="none", marker=">", markersize=6, color=colour)
        axes.set_yticks(vehicles)
        axes.set_ylim(0.5, len(vehicles) + 0.5)
        name_axes(axes, title)
    return finish(figure, caption)


def _in_pairs(panels: int, height_in: float, x: str, y: str) -> tuple[Figure, list[Axes]]:
    """Return a figure with two panels in each row, all with the same scales, and the axes of its panels.

    ``height_in`` is the height of one panel in inches; ``x`` and ``y`` are labels.
    """
    rows = (panels + 1) // 2
    figure, every = new_panels((10.0, height_in * rows + 1.0), rows, 2, sharex=True, sharey=True)
    for axes in every[::2]:
        name_axes(axes, y=y)
    for axes in every[-2:]:
        name_axes(axes, x=x)
    return figure, every


@in_our_style
def profiles_figure(panels: Mapping[str, Mapping[str, EpisodeRecord]], *, caption: str) -> Figure:
    """Draw the command of the controlled vehicle against time, in one or more panels.

    ``panels`` maps title of the panel -> label of the curve -> recorded episode.
    """
    figure, every = _in_pairs(len(panels), 2.3, "Time since Vehicle 1 began to brake (s)", "Command (m/s²)")
    for axes, (title, records) in zip(every, panels.items(), strict=False):
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        for number, (label, record) in enumerate(records.items()):
            style = {**series_style(number), "marker": ""}
            command = record.command_mps2[:, record.vehicle]
            axes.plot(record.time_s, command, drawstyle="steps-post", label=label, **style)
        name_axes(axes, title)
    return finish(figure, caption, every[0], columns=4)


@in_our_style
def changes_figure(changes: Mapping[str, Mapping[str, Estimate]], *, x_label: str, caption: str) -> Figure:
    """Draw the effects of several changes with their 95 % intervals, one row for each change.

    ``changes`` maps name of the change -> label (for instance a strategy) -> effect; each label has its own marker.
    """
    rows = list(changes)
    labels = list(dict.fromkeys(label for each in changes.values() for label in each))
    figure, (axes,) = new_panels((9.4, 0.3 * len(rows) + 1.6))
    axes.axvline(0.0, color=GREY, linewidth=0.9)
    for number, label in enumerate(labels):
        at = [(len(rows) - 1 - k + 0.16 * (0.5 * (len(labels) - 1) - number), changes[row].get(label))
              for k, row in enumerate(rows)]  # fmt: skip
        known = [(y, each.value, *each.ends) for y, each in at if each is not None]
        y, value, low, high = zip(*known, strict=True)
        style = series_style(number)
        axes.hlines(y, low, high, color=str(style["color"]), linewidth=1.4)
        axes.plot(value, y, linestyle="none", marker=style["marker"], markersize=4.5, color=style["color"],
                  label=label)  # fmt: skip
    axes.set_yticks(range(len(rows)), [textwrap.fill(row, _ROW_CHARACTERS) for row in rows[::-1]], fontsize=8)
    name_axes(axes, x=x_label)
    return finish(figure, caption, axes, columns=3)
