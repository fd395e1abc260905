"""Figure of curves with intervals: harm over distance, training steps or delay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from ethbrake_marl.extensions.report.style import band, finish, in_our_style, label_text, new_panels, series_style
from ethbrake_marl.files.sheet import Estimate

LONG = 30  # characters of a label that make a legend narrow
Curve = Mapping[Any, Estimate]  # x -> estimate; texts stand side by side


def over_seeds(trainings: Sequence[Mapping[Any, float]]) -> Curve:
    """Return the mean of several training runs, plus and minus one standard deviation over the seeds.

    ``trainings``: for each run, step or progress -> value. The curve has the steps that all runs have.
    """
    curve = {}
    for step in sorted(set.intersection(*map(set, trainings))):
        values = [training[step] for training in trainings]
        mean, spread = np.mean(values), np.std(values, ddof=1) if len(values) > 1 else 0.0
        curve[float(step)] = Estimate(float(mean), (float(mean - spread), float(mean + spread)))
    return curve


@in_our_style
def curves_figure(
    panels: Mapping[str, Mapping[str, Curve]],
    x_label: str,
    caption: str,
    *,
    lines: Mapping[str, Mapping[str, float]] | None = None,
    y_label: str = "",
) -> Figure:
    """Draw curves with a band between the ends of their intervals, one panel for each title.

    ``panels``: title -> label of a curve -> curve; the first panel must have all labels, for the legend. ``lines``:
    value of a horizontal line, title -> label -> value. ``y_label``: shared by all panels; "": each has its own.
    """
    figure, every = new_panels((5.0 * len(panels), 4.2), columns=len(panels), sharey=bool(y_label))
    labels = [*dict.fromkeys(label for curves in panels.values() for label in curves)]
    for axes, (title, curves) in zip(every, panels.items(), strict=True):
        for label, curve in curves.items():
            style, x = series_style(labels.index(label)), list(curve)
            axes.plot(x, [each.value for each in curve.values()], label=label_text(label), **style)
            low, high = zip(*(each.ends for each in curve.values()), strict=True)
            band(axes, x, low, high, style)
        for number, (label, value) in enumerate((lines or {}).get(title, {}).items(), len(labels)):
            style = series_style(number) | {"marker": ""}
            axes.axhline(value, label=label_text(label), **style)
        axes.set(title=title, xlabel=x_label)
        if axes.dataLim.xmax >= 1000.0:
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    for axes in every:  # after all curves are drawn
        if axes.dataLim.ymin >= 0.0:
            axes.set_ylim(bottom=0.0)
    every[0].set_ylabel(y_label)
    narrow = len(panels) == 1 or max(map(len, labels), default=0) > LONG
    return finish(figure, caption, every[0], columns=3 if narrow else 5)
