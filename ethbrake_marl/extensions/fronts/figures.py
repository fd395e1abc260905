"""Figures of a front: who bears which share of the harm, and the line's harm against the largest harm of a vehicle.

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
    GREY,
    MARKERS,
    finish,
    label_text,
    name_axes,
    new_figure,
    new_panels,
    plain,
)
from ethbrake_marl.physics.state import Floats

WIDTH_IN = 5.6  # narrow enough for a phone

_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]])  # corners of the triangle for Vehicles 1, 2 and 3

Json = dict[str, Any]


def front_figures(results: Json) -> dict[str, Figure]:
    """Return all figures of a front by file name; the ternary plot is drawn only for a line of three vehicles."""
    figures = {"front.png": sum_figure(results)}
    if len(results["vehicles"]) == 3:
        figures["front-ternary.png"] = ternary_figure(results)
    return figures


def sum_figure(results: Json) -> Figure:
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


def ternary_figure(results: Json) -> Figure:
    """Draw the shares of the harm that three vehicles bear, in a triangle; the colour shows the harm of the line."""
    figure = new_figure(WIDTH_IN, 5.4)
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.plot(*_CORNERS[[0, 1, 2, 0]].T, color=GREY, linewidth=1.0)
    for share in (0.25, 0.5, 0.75):
        for i in range(3):
            ends = np.full((2, 3), 0.0)
            ends[:, i] = share
            ends[0, (i + 1) % 3] = ends[1, (i + 2) % 3] = 1.0 - share
            axes.plot(*_places(ends), color="#dddddd", linewidth=0.6, zorder=0)
    for name, at, up in zip(results["vehicles"], _CORNERS, ("top", "top", "bottom"), strict=True):
        axes.annotate(
            f"{name} bears all",
            at,
            ha="center",
            va=up,
            fontsize=8,
            xytext=(0, -4 if up == "top" else 4),
            textcoords="offset points",
        )
    series = list(_series(results))
    sums = np.concatenate([harm.sum(axis=1) for _, harm, _ in series])
    for name, harm, style in series:
        whole = harm.sum(axis=1)
        some = whole > 0.0
        x, y = _places(harm[some] / whole[some, np.newaxis])
        points = axes.scatter(
            x, y, s=34.0, c=whole[some], marker=style["marker"], cmap="viridis", edgecolors="white", linewidths=0.5,
            vmin=sums.min(), vmax=sums.max(), zorder=3 if name == "front" else 2,
        )  # fmt: skip
        axes.plot([], [], label=label_text(name, 34), **{**style, "color": GREY})  # in the legend, without a sum
    bar = figure.colorbar(points, ax=axes, shrink=0.7, location="bottom", pad=0.02)
    bar.set_label("Harm of the line (m²/s²)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    return finish(figure, _caption(results), axes, columns=2, fontsize=8)


def _places(shares: Floats) -> Floats:
    """Return the positions of k points in the ternary plot, [2, k].

    ``shares`` [k, 3] are the vehicles' shares of the harm; at a corner of the triangle, one vehicle bears all harm.
    """
    places: Floats = (shares[:, :, np.newaxis] * _CORNERS).sum(axis=1).T
    return places


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
