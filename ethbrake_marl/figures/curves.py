"""Curves over a number: harm over training, errors over the step of the paper's map, cost over worlds and vehicles."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, StrMethodFormatter

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.figures.style import GREY, add_caption, new_figure, series_style, style_axes
from ethbrake_marl.physics import Floats


@dataclass(frozen=True, slots=True)
class SeedCurve:
    """One figure of several trainings of one recipe, at the same steps."""

    steps: Floats  # [k]
    values: Floats  # [seeds, k]


def seed_curves(
    panels: Mapping[str, Mapping[str, SeedCurve]], *, logarithmic: Collection[str] = (), caption: str = ""
) -> Figure:
    """One panel per label, one line per recipe: the mean over seeds, bands one standard deviation to either side.

    Panels in ``logarithmic`` have a logarithmic axis if their means allow it: harm falls to a tenth, and the last
    tenth is what matters. Raises ``InvalidInput`` without panels or lines.
    """
    if not panels or not all(panels.values()):
        raise InvalidInput("seed_curves: nothing to draw; at least one training with one evaluation is needed")
    figure = new_figure(5.0 * len(panels), 4.2)
    every = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (label, curves) in zip(every, panels.items(), strict=True):
        style_axes(axes)
        for number, (recipe, curve) in enumerate(curves.items()):
            style = series_style(number + 1)
            mean, spread = curve.values.mean(axis=0), _spread(curve.values)
            seeds = len(curve.values)
            axes.plot(curve.steps, mean, label=f"{recipe}, {seeds} seed{'s' * (seeds != 1)}", **style)
            axes.fill_between(
                curve.steps, mean - spread, mean + spread, color=str(style["color"]), alpha=0.18, linewidth=0.0
            )
        if label in logarithmic and all((curve.values > 0.0).all() for curve in curves.values()):
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_title(label, loc="left", fontsize=10)
        axes.set_xlabel("Training steps", fontsize=9)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    handles, labels = every[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=min(len(labels), 6), frameon=False, fontsize=9)
    add_caption(figure, caption)
    return figure


def at_common_steps(trainings: Sequence[Mapping[int, float]]) -> SeedCurve:
    """Figures of several trainings, by step, at the steps that all of them have. Raises ``InvalidInput`` for none."""
    common = sorted(set.intersection(*(set(training) for training in trainings))) if trainings else []
    if not common:
        raise InvalidInput("at_common_steps: the trainings were never evaluated at the same step")
    values = [[training[step] for step in common] for training in trainings]
    return SeedCurve(np.array(common, np.float64), np.array(values, np.float64))


def _spread(values: Floats) -> Floats:
    """Standard deviation over seeds; 0 with one seed, of which nothing is known."""
    spread: Floats = values.std(axis=0, ddof=1) if len(values) > 1 else values[0] * 0.0
    return spread


Series = tuple[str, Floats]  # label, absolute error (m2/s2) at every step


def draw_errors(panels: Mapping[str, Sequence[Series]], *, steps_s: Sequence[float], caption: str) -> Figure:
    """Absolute errors over the step, both on logarithmic axes, one panel per title, with a line of order 1."""
    figure = new_figure(7.4, 3.9)
    places = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (title, series) in zip(places, panels.items(), strict=True):
        _draw_errors_of(axes, title, series, steps_s)
    places[0].set_ylabel("Absolute error of harm (m²/s²)", fontsize=9)
    handles, labels = places[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=2, frameon=False, fontsize=9)
    add_caption(figure, caption)
    return figure


def _draw_errors_of(axes: Axes, title: str, series: Sequence[Series], steps_s: Sequence[float]) -> None:
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


Point = tuple[str, int, float]  # name of the series, number of worlds or vehicles, cost


def draw_costs(batches: Sequence[Point], single: Sequence[Point], *, vehicles: Sequence[int], caption: str) -> Figure:
    """Cost of a step over n (``batches``, µs) and over N (``single``, ns); logarithmic axes, with lines of slope 1.

    ``vehicles`` are the ticks of N.
    """
    figure = new_figure(7.4, 3.9)
    left, right = figure.subplots(1, 2)
    _draw_costs_of(left, batches)
    left.set_xlabel("Worlds n, of three vehicles", fontsize=9)
    left.set_ylabel("One step of all n worlds (µs)", fontsize=9)
    _draw_costs_of(right, single)
    right.set_xlabel("Vehicles N in a world", fontsize=9)
    right.set_ylabel("One step of one world (ns)", fontsize=9)
    right.set_xticks(vehicles, [str(each) for each in vehicles])
    right.minorticks_off()
    add_caption(figure, caption)
    return figure


def _draw_costs_of(axes: Axes, points: Sequence[Point]) -> None:
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
