"""The figures of ``ethbrake reproduce``: harm over a number, bars, vehicles along the road, commands, changes."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ethbrake_marl.envs.drawing.scene import vehicle_colour
from ethbrake_marl.evaluation.record import EpisodeRecord
from ethbrake_marl.evaluation.statistics import Estimate
from ethbrake_marl.figures.style import GREY, add_caption, new_figure, series_style, style_axes

_ARROW_STEPS = 10  # the paper draws every tenth time step
_ROW_CHARACTERS = 52  # of a line beside the axis


@dataclass(frozen=True, slots=True)
class Line:
    """Values with their intervals over a number."""

    x: tuple[float, ...]
    y: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]

    @classmethod
    def of(cls, x: Sequence[float], estimates: Sequence[Estimate]) -> Self:
        """From estimates; one without an interval has a width of 0."""
        ends = [each.interval or (each.value, each.value) for each in estimates]
        values = tuple(each.value for each in estimates)
        return cls(tuple(x), values, tuple(low for low, _ in ends), tuple(high for _, high in ends))


def lines_figure(panels: Mapping[str, Mapping[str, Line]], *, x_label: str, y_label: str, caption: str) -> Figure:
    """One panel per title, one line per label, bands: 95 % intervals."""
    figure = new_figure(4.6 * len(panels), 4.2)
    every = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (title, lines) in zip(every, panels.items(), strict=True):
        style_axes(axes)
        for number, (label, line) in enumerate(lines.items()):
            style = series_style(number)
            axes.plot(line.x, line.y, label=label, **style)
            axes.fill_between(line.x, line.low, line.high, color=str(style["color"]), alpha=0.18, linewidth=0.0)
        axes.set_title(title, loc="left", fontsize=10)
        axes.set_xlabel(x_label, fontsize=9)
    every[0].set_ylim(bottom=0.0)
    every[0].set_ylabel(y_label, fontsize=9)
    _legend(figure, every[0], 3)
    add_caption(figure, caption)
    return figure


def bars_figure(
    panels: Mapping[str, Mapping[str, Sequence[Estimate]]], *, groups: Sequence[str], y_label: str, caption: str
) -> Figure:
    """One panel per title: for each group a bar for each label, with its interval where it has one."""
    figure = new_figure(4.6 * len(panels), 4.2)
    every = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (title, bars) in zip(every, panels.items(), strict=True):
        style_axes(axes)
        width = 0.8 / len(bars)
        for number, (label, estimates) in enumerate(bars.items()):
            offset = (number - 0.5 * (len(bars) - 1)) * width
            line = Line.of([k + offset for k in range(len(estimates))], estimates)
            colour = str(series_style(number)["color"])
            axes.bar(line.x, line.y, 0.9 * width, color=colour, label=label)
            axes.vlines(line.x, line.low, line.high, color="black", linewidth=1.0)
        axes.set_xticks(range(len(groups)), list(groups))
        axes.set_title(title, loc="left", fontsize=10)
    every[0].set_ylabel(y_label, fontsize=9)
    _legend(figure, every[0], 3)
    add_caption(figure, caption)
    return figure


def road_figure(records: Mapping[str, EpisodeRecord], *, caption: str) -> Figure:
    """As the paper draws it: position along the road against the vehicle, an arrow at every tenth time step.

    Dashed lines join the vehicles at the same time. One panel per record, two in a row.
    """
    figure = new_figure(10.0, 1.9 * ((len(records) + 1) // 2) + 1.0)
    panels = figure.subplots((len(records) + 1) // 2, 2, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, (title, record) in zip(panels, records.items(), strict=False):
        style_axes(axes)
        _draw_road(axes, record)
        axes.set_title(title, loc="left", fontsize=10)
    for axes in panels[::2]:
        axes.set_ylabel("Vehicle", fontsize=9)
    for axes in panels[-2:]:
        axes.set_xlabel("Position along the road (m)", fontsize=9)
    add_caption(figure, caption)
    return figure


def _draw_road(axes: Axes, record: EpisodeRecord) -> None:
    """Three parallel lines with arrows."""
    vehicles = np.arange(1, record.positions_m.shape[1] + 1)
    every_s = _ARROW_STEPS * record.scenario.time_step_s
    times = np.arange(0.0, record.time_s[-1] + 1e-9, every_s)
    at = np.array([np.interp(times, record.time_s, column) for column in record.positions_m.T])
    axes.plot(at, vehicles, color=GREY, linewidth=0.7, linestyle="--")
    for i, number in enumerate(vehicles):
        colour = vehicle_colour(i)
        axes.plot([at[i].min(), at[i].max()], [number, number], color=colour, linewidth=1.4)
        axes.plot(at[i], np.full(len(times), number), linestyle="none", marker=">", markersize=6, color=colour)
    axes.set_yticks(vehicles)
    axes.set_ylim(0.5, len(vehicles) + 0.5)


def profiles_figure(panels: Mapping[str, Mapping[str, EpisodeRecord]], *, caption: str) -> Figure:
    """The command of the driven vehicle over time: one panel per title, one line per label."""
    figure = new_figure(10.0, 2.3 * ((len(panels) + 1) // 2) + 1.0)
    every = figure.subplots((len(panels) + 1) // 2, 2, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, (title, records) in zip(every, panels.items(), strict=False):
        style_axes(axes)
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        for number, (label, record) in enumerate(records.items()):
            style = {**series_style(number), "marker": ""}
            command = record.command_mps2[:, record.vehicle]
            axes.plot(record.time_s, command, drawstyle="steps-post", label=label, **style)
        axes.set_title(title, loc="left", fontsize=10)
    for axes in every[::2]:
        axes.set_ylabel("Command (m/s²)", fontsize=9)
    for axes in every[-2:]:
        axes.set_xlabel("Time since Vehicle 1 began to brake (s)", fontsize=9)
    _legend(figure, every[0], 4)
    add_caption(figure, caption)
    return figure


def changes_figure(changes: Mapping[str, Mapping[str, Estimate]], *, x_label: str, caption: str) -> Figure:
    """By how much each change moves a number: one row per change, one mark per label, with its interval."""
    rows = list(changes)
    labels = list(dict.fromkeys(label for each in changes.values() for label in each))
    figure = new_figure(9.4, 0.3 * len(rows) + 1.6)
    axes = figure.subplots()
    style_axes(axes)
    axes.axvline(0.0, color=GREY, linewidth=0.9)
    for number, label in enumerate(labels):
        at = [(len(rows) - 1 - k + 0.16 * (0.5 * (len(labels) - 1) - number), changes[row].get(label))
              for k, row in enumerate(rows)]  # fmt: skip
        known = [(y, each) for y, each in at if each is not None]
        line = Line.of([y for y, _ in known], [each for _, each in known])
        style = series_style(number)
        axes.hlines(line.x, line.low, line.high, color=str(style["color"]), linewidth=1.4)
        axes.plot(line.y, line.x, linestyle="none", marker=style["marker"], markersize=4.5, color=style["color"],
                  label=label)  # fmt: skip
    axes.set_yticks(range(len(rows)), [textwrap.fill(row, _ROW_CHARACTERS) for row in rows[::-1]], fontsize=8)
    axes.set_xlabel(x_label, fontsize=9)
    _legend(figure, axes, 3)
    add_caption(figure, caption)
    return figure


def _legend(figure: Figure, axes: Axes, columns: int) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=columns, frameon=False, fontsize=9)
