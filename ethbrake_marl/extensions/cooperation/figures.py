"""Figure of an ablation or a sweep: harm of the trained policies, of full braking and of the joint optimum.

``results`` is the content of ``ablation.json``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.report.style import (
    GREY,
    TITLES,
    finish,
    in_our_style,
    name_axes,
    new_panels,
    plain,
    series_style,
)
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.first_edition.envs.rendering import COLOURS
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount

LINEAR = 0.1  # m2/s2; axes are linear below this harm and logarithmic above it, because harm varies by a factor of 100

_BESIDE = 0.42  # distance at which a level with a worse channel is drawn to the right of its level

Json = dict[str, Any]


def swept_axis(results: Json) -> str | None:
    """Return the label of the x axis, such as ``v2x.lost`` or ``objective = social:…``; None without a sweep."""
    first = results["levels"][0]
    if "swept_key" not in first:
        return None
    word, colon, _ = first["swept_value"].rpartition(":")
    return f"{first['swept_key']} = {word}:…" if colon else str(first["swept_key"])


@in_our_style
def ablation_figure(results: Json, caption: str) -> Figure:
    """Draw both harms at each level, or at each value of a sweep, with 95 % confidence intervals.

    All means are over the worlds in which the joint optimum was searched.
    """
    figure, panels = new_panels((10.5, 4.8), columns=2)
    swept = swept_axis(results)
    places = _places(results["levels"])
    unit = 1.0 if swept is None else (max(places.values()) - min(places.values())) / (len(places) - 1)
    algorithms = list(dict.fromkeys(each["algorithm"] for each in results["levels"] if each["algorithm"] is not None))
    for axes, harm_count in zip(panels, HARM_COUNTS, strict=True):
        for key, label, colour in (
            ("full_brake", "all brake fully", GREY),
            ("best_known", "joint optimum", COLOURS[3]),
        ):
            shown = [level for level in results["levels"] if level[harm_count]["searched"][key] is not None]
            for number, level in enumerate(shown):  # short horizontal lines, shorter for levels with a worse channel
                x, half = places[level["level"]], unit * (0.3 if level["clear"] is None else 0.07)
                value, name = level[harm_count]["searched"][key]["value"], "" if number else label
                axes.hlines(value, x - half, x + half, color=colour, linewidth=2.0, label=name)
        for number, algorithm in enumerate(algorithms):
            own = [level for level in results["levels"] if level["algorithm"] in (None, algorithm)]
            at = [places[level["level"]] + 0.06 * unit * number for level in own]
            _draw_algorithm(axes, own, at, unit, harm_count, algorithm, number)
        if swept is None:
            ladder = [level["level"] for level in results["levels"] if level["clear"] is None]
            axes.set_xticks([places[name] for name in ladder], [_short(name) for name in ladder], fontsize=8)
        if axes.dataLim.ymin < 1.0:
            axes.set_yscale("symlog", linthresh=LINEAR)
        axes.yaxis.set_major_formatter(FuncFormatter(plain))
        axes.set_ylim(0.0, (1.5 if axes.get_yscale() == "symlog" else 1.1) * axes.get_ylim()[1])
        name_axes(axes, TITLES[harm_count], swept or "")
    worlds = count_of(results["levels"][0]["first"]["searched"]["worlds"], "world")
    text = " ".join([*results["undertrained"], caption, f"All values of this figure: means over the first {worlds}."])
    return finish(figure, text, panels[0], columns=4, fontsize=8.5)


def _places(levels: Sequence[Json]) -> dict[str, float]:
    """Return the x position of each level: its number in the ladder, or its value in a sweep.

    A copy of an earlier level with a worse V2X channel is drawn to the right of that level.
    """
    ladder = list(dict.fromkeys(level["level"] for level in levels if level["clear"] is None))
    return {
        level["level"]: level["swept_number"]
        if "swept_number" in level
        else ladder.index(level["clear"] or level["level"]) + (0.0 if level["clear"] is None else _BESIDE)
        for level in levels
    }


def _draw_algorithm(
    axes: Axes,
    own: Sequence[Json],
    at: Sequence[float],
    unit: float,
    harm_count: HarmCount,
    algorithm: str,
    number: int,
) -> None:
    """Draw the harm of one algorithm's trained policies at each level, with a dot for each training seed.

    ``number`` is the index of the algorithm, ``at`` are the x positions, and ``unit`` is the distance of two levels.
    """
    style = series_style(number + 1 if number == 0 else number + 3)
    hollow = {**style, "linestyle": "none", "markerfacecolor": "white"}
    searched = [level[harm_count]["searched"] for level in own]
    shielded = [level[harm_count]["shielded"] and level[harm_count]["shielded"]["searched"] for level in own]
    steps, worse = ([level["clear"] is None for level in own], [level["clear"] is not None for level in own])
    for some, values, beside, look in (
        (steps, searched, 0.0, {**style, "label": algorithm}),
        ([each is not None for each in shielded], shielded, -0.12,
         {"fmt": "x", "color": COLOURS[2], "label": f"{algorithm}, shielded"}),
        (worse, searched, 0.0, {**hollow, "label": f"{algorithm}, worse messages"}),
    ):  # fmt: skip
        harms = [Estimate(**value["harm"]) for value, chosen in zip(values, some, strict=True) if chosen]
        if harms:
            x = [place + beside * unit for place, chosen in zip(at, some, strict=True) if chosen]
            errors = list(zip(*((h.value - h.ends[0], h.ends[1] - h.value) for h in harms), strict=True))
            axes.errorbar(x, [harm.value for harm in harms], yerr=errors, capsize=3, **look)
    for place, level, value in zip(at, own, searched, strict=True):
        if level["clear"] is not None:
            spot = (place, value["full_brake"]["value"])
            name = level["level"].rpartition("-")[2]
            axes.annotate(name, spot, xytext=(0, 4), textcoords="offset points", ha="center", fontsize=8)
        dots = value["each_seed"]
        if len(dots) > 1:
            x = [place + 0.05 * unit] * len(dots)
            axes.scatter(x, dots, s=6, color=str(style["color"]), alpha=0.5, linewidths=0)


def _short(name: str) -> str:
    """Return the name of a level for an axis: without ``cooperation-``, and with a line break at the first hyphen."""
    return name.removeprefix("cooperation-").replace("-", "\n", 1)
