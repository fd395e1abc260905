"""Figure of a front: the line's harm against the largest harm of a vehicle.

``results`` is the content of ``front.json``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from ethbrake_marl.envs.rendering import COLOURS
from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.report.style import (
    MARKERS,
    finish,
    in_our_style,
    label_text,
    name_axes,
    new_panels,
    plain,
)
from ethbrake_marl.physics.state import Floats

WIDTH_IN = 5.6  # narrow enough for a phone

Json = dict[str, Any]


@in_our_style
def front_figure(results: Json) -> Figure:
    """Draw the mean harm of the line (horizontally) against the mean harm of the vehicle that bears most (vertically).

    The figure has one point for each choice of weights.
    """
    figure, (axes,) = new_panels((WIDTH_IN, 4.6))
    for name, harm, style in _series(results):
        axes.plot(harm.sum(axis=1), harm.max(axis=1), label=label_text(name, 34), **style, fillstyle="none")
    if all((harm.max(axis=1) > 0.0).all() for _, harm, _ in _series(results)):
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(FuncFormatter(plain))
            axis.set_minor_formatter(FuncFormatter(plain))
    axes.tick_params(which="minor", labelsize=7)
    count = {"first": "first impacts", "total": "all impacts"}[results["harm_count"]]
    name_axes(axes, x=f"Harm of the line, {count} (m²/s²)", y="Harm of the vehicle that bears most (m²/s²)")
    return finish(figure, _caption(results), axes, columns=2, fontsize=8)


def _series(results: Json) -> list[tuple[str, Floats, dict[str, Any]]]:
    """Return (name, mean harm [W, N] in m2/s2, style) for the front, full braking, maximin, and each agent."""
    count = results["harm_count"]

    def harm(points: Sequence[Mapping[str, Any]]) -> Floats:
        return np.array([[each["value"] for each in point["vehicles"][count]] for point in points])

    named = [("front", harm(results["points"]))]
    named += [(name, harm([{"vehicles": vehicles}])) for name, vehicles in results["beside"].items()]
    named += [(name, np.unique(harm(points), axis=0)) for name, points in results["agents"].items()]
    styles = ({"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)]} for k in range(len(named)))
    return [
        (name, values, {**style, "linestyle": "none", "markersize": 5.0})
        for (name, values), style in zip(named, styles, strict=True)
    ]


def _caption(results: Json) -> str:
    worlds = count_of(results["episodes"], "world")
    return f"{results['scenario']}, {worlds}; one point for each of {len(results['points'])} choices of the weights."
