"""Curves of several trainings: harm over training steps, with the spread over seeds."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, StrMethodFormatter

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.figures.style import add_caption, new_figure, series_style, style_axes
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
