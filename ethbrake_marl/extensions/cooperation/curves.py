"""Figures of a sweep: harm of the line and of each vehicle (y axis) for each value of the swept key (x axis).

``results`` is the content of ``ablation.json``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ethbrake_marl.envs.rendering import COLOURS
from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.report.style import GREY, TITLES, band, finish, name_axes, new_panels, series_style
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.game.harm import HARM_COUNTS

_MOST_TICKS = 12

_ROOM = 0.05  # least distance between two ticks, as a share of the axis

_BESIDE = 0.008  # horizontal distance between marks for the same number, as a share of the axis

_MARGIN = 0.06  # margin at both ends of the axis, as a share of the axis

Json = dict[str, Any]


def swept_axis(results: Json) -> str | None:
    """Return the label of the x axis, such as ``v2x.lost`` or ``objective = social:…``; None without a sweep."""
    first = results["levels"][0]
    if "swept_key" not in first:
        return None
    word, colon, _ = first["swept_value"].rpartition(":")
    return f"{first['swept_key']} = {word}:…" if colon else str(first["swept_key"])


def sweep_figures(results: Json, caption: str) -> list[Figure]:
    """Return the two figures of a sweep, with swept values on a linear x axis, and with 95 % confidence intervals."""
    return [_harm_curves(results, caption), _who_bears(results, caption)]


def _harm_curves(results: Json, caption: str) -> Figure:
    """Draw the mean harm of the trained policies, of full braking and of the joint optimum at each swept value.

    All means are over the worlds in which the joint optimum was searched.
    """
    figure, panels = new_panels((10.5, 4.8), columns=2)
    for axes, harm_count in zip(panels, HARM_COUNTS, strict=True):
        first = _of(results, algorithms(results)[0])
        for key, label, colour in (
            ("full_brake", "all brake fully", GREY),
            ("best_known", "joint optimum", COLOURS[3]),
        ):
            ends = [Estimate(**level[harm_count]["searched"][key]) for level in first]
            _curve(axes, first, ends, shade=True, color=colour, label=label, linewidth=2.0)
        for number, algorithm in enumerate(algorithms(results)):
            levels = _of(results, algorithm)
            style = series_style(number + 1 if number == 0 else number + 3)
            reached = [Estimate(**level[harm_count]["searched"]["harm"]) for level in levels]
            _curve(axes, levels, reached, 3 * number, capsize=3, label=algorithm, **style)
            for at, level in zip(_places(levels, 3 * number + 2), levels, strict=True):
                dots = level[harm_count]["searched"]["each_seed"]
                if len(dots) > 1:
                    axes.scatter([at] * len(dots), dots, s=8, color=str(style["color"]), alpha=0.5, linewidths=0)
            if levels[0][harm_count]["shielded"] is not None:
                behind = [Estimate(**level[harm_count]["shielded"]["searched"]["harm"]) for level in levels]
                cross = {**style, "marker": "x", "linestyle": ":"}
                _curve(axes, levels, behind, -2 - 2 * number, capsize=3, label=f"{algorithm}, shielded", **cross)
        _number_axis(axes, results)
        name_axes(axes, TITLES[harm_count])
    worlds = results["levels"][0]["first"]["searched"]["worlds"]
    text = f"{caption} All values of this figure: means over the first {count_of(worlds, 'world')}."
    return finish(figure, text, panels[0], columns=4, fontsize=8.5)


def _who_bears(results: Json, caption: str) -> Figure:
    """Draw the mean harm of each vehicle over all worlds, with one line style for each training algorithm."""
    figure, panels = new_panels((10.5, 4.8), columns=2)
    several = len(algorithms(results))
    for axes, harm_count in zip(panels, HARM_COUNTS, strict=True):
        for number, algorithm in enumerate(algorithms(results)):
            levels = _of(results, algorithm)
            for i in range(len(levels[0][harm_count]["vehicles"])):
                borne = [Estimate(**level[harm_count]["vehicles"][i]) for level in levels]
                name = f"Vehicle {i + 1}" + (f", {algorithm}" if several > 1 else "")
                style = {**series_style(i), "linestyle": series_style(number)["linestyle"]}
                _curve(axes, levels, borne, several * i + number, capsize=3, label=name, clip_on=False, **style)
        _number_axis(axes, results)
        name_axes(axes, f"{TITLES[harm_count]} that each vehicle bears")
    return finish(figure, caption, panels[0], columns=4, fontsize=8.5)


def algorithms(results: Json) -> list[str]:
    """Return the names of the training algorithms, without repetitions."""
    return list(dict.fromkeys(level["algorithm"] for level in results["levels"] if level["algorithm"] is not None))


def with_intervals(
    axes: Axes, at: Sequence[float], estimates: Sequence[Estimate], *, upright: bool = True, **style: Any
) -> None:
    """Draw each estimate as a mark at the positions ``at``, and its confidence interval as whiskers.

    The y axis shows the values if ``upright`` is true, otherwise the x axis. ``style`` is for matplotlib's
    ``errorbar``.
    """
    values = np.array([each.value for each in estimates])
    errors = np.abs(np.array([each.ends for each in estimates]).T - values)
    if upright:
        axes.errorbar(at, values, yerr=errors, **style)
    else:
        axes.errorbar(values, at, xerr=errors, **style)


def _of(results: Json, algorithm: str) -> list[Json]:
    return [level for level in results["levels"] if level["algorithm"] == algorithm]


def _curve(
    axes: Axes,
    levels: Sequence[Json],
    estimates: Sequence[Estimate],
    beside: int = 0,
    *,
    shade: bool = False,
    **style: Any,
) -> None:
    """Draw an estimate for each swept value, with its confidence interval as a band (``shade``) or as whiskers."""
    at = _places(levels, beside)
    if not shade:
        with_intervals(axes, at, estimates, **style)
        return
    low, high = np.array([each.ends for each in estimates]).T
    axes.plot(at, [each.value for each in estimates], **style)
    band(axes, at, low, high, style)


def _places(levels: Sequence[Json], beside: int) -> list[float]:
    """Return the x position of each level's mark: the swept value plus ``beside * _BESIDE`` times the axis' length."""
    low, high = _span(levels)
    return [level["swept_number"] + beside * _BESIDE * (high - low) for level in levels]


def _span(levels: Sequence[Json]) -> tuple[float, float]:
    """Return the ends of the x axis, which covers 0 and the swept values."""
    numbers = [level["swept_number"] for level in levels]
    return min(*numbers, 0.0), max(*numbers, 0.0)


def _number_axis(axes: Axes, results: Json) -> None:
    """Set range, ticks and label of the x axis, and let the y axis begin at 0.

    The x axis has ticks at 0 and at each swept value, unless their labels would overlap.
    """
    numbers = sorted({0.0, *(level["swept_number"] for level in results["levels"])})
    low, high = _span(results["levels"])
    margin = _MARGIN * (high - low)
    axes.set_xlim(low - margin, high + margin)
    if len(numbers) <= _MOST_TICKS and np.diff(numbers).min() >= _ROOM * (high - low):
        axes.set_xticks(numbers)
    axes.set_xlabel(swept_axis(results) or "", fontsize=9)
    axes.set_ylim(0.0, 1.02 * axes.get_ylim()[1])
