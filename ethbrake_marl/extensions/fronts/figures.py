"""Figure of a front: the line's harm against the largest harm of a vehicle."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.report.style import (
    TITLES,
    finish,
    in_our_style,
    label_text,
    new_panels,
    plain,
    series_style,
)

SIZE_IN = (5.6, 4.6)  # narrow enough for a phone

Json = dict[str, Any]


@in_our_style
def front_figure(results: Json) -> Figure:
    """Draw one point for each choice of weights: the line's mean harm against that of the vehicle that bears most.

    ``results``: the content of ``front.json``.
    """
    beside = {name: [{"vehicles": vehicles}] for name, vehicles in results["beside"].items()}
    count, all_positive = results["harm_count"], True
    figure, (axes,) = new_panels(SIZE_IN)
    for number, (name, points) in enumerate({"Pareto front": results["points"], **beside, **results["agents"]}.items()):
        harm = np.array([[each["value"] for each in point["vehicles"][count]] for point in points])
        style = series_style(number) | {"linestyle": "none", "markersize": 5.0, "fillstyle": "none"}
        axes.plot(harm.sum(axis=1), harm.max(axis=1), label=label_text(name, 34), **style)
        all_positive &= bool((harm.max(axis=1) > 0.0).all())
    if all_positive:
        axes.set(xscale="log", yscale="log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(FuncFormatter(plain))
            axis.set_minor_formatter(FuncFormatter(plain))
    axes.tick_params(which="minor", labelsize=7)
    axes.set(xlabel=f"Line: {TITLES[count].lower()}", ylabel=f"Vehicle that bears most: {TITLES[count].lower()}")
    worlds = count_of(results["episodes"], "world")
    caption = f"{results['scenario']}, {worlds}; one point for each of {len(results['points'])} choices of the weights."
    return finish(figure, caption, axes, columns=2, fontsize=8)
