"""Figure of an ablation or a sweep: harm of the trained policies, of full braking and of the joint optimum.

``results`` is the content of ``ablation.json``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from ethbrake_marl.extensions.report.style import GREY, TITLES, finish, in_our_style, new_panels, plain, series_style
from ethbrake_marl.files.sheet import Estimate

LINEAR = 0.1  # m2/s2; axes are linear below this harm and logarithmic above it, because harm varies by a factor of 100
BESIDE = 0.42  # distance at which a level with a worse channel is drawn to the right of its level
LEVEL_IN, PANEL_IN, HEIGHT_IN = 1.05, 3.4, 4.8  # width of a level, least width of a panel, height

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
    """Draw both harms at each level, or at each value of a sweep, with 95 % intervals.

    All means are over the worlds in which the joint optimum was searched. The figure is as wide as its levels need.
    """
    levels, swept = results["levels"], swept_axis(results)
    places = _places(levels)
    ladder = list(dict.fromkeys(level["level"] for level in levels if level["clear"] is None))
    unit = 1.0 if swept is None else (max(places.values()) - min(places.values())) / (len(places) - 1)
    width = 2.0 * max(PANEL_IN, LEVEL_IN * (1 + max(places.values()) if swept is None else len(places)))
    figure, panels = new_panels((min(width, 10.5), HEIGHT_IN), columns=2)
    algorithms = list(dict.fromkeys(level["algorithm"] for level in levels if level["algorithm"] is not None))
    for axes, count in zip(panels, TITLES, strict=True):
        for key, label, colour in (
            ("full_brake", "all brake fully", GREY),
            ("best_known", "joint optimum", series_style(3)["color"]),
        ):
            shown = [level for level in levels if level[count]["searched"][key] is not None]
            for number, level in enumerate(shown):  # short horizontal lines, shorter for levels with a worse channel
                x, half = places[level["level"]], unit * (0.3 if level["clear"] is None else 0.07)
                value, name = level[count]["searched"][key]["value"], "" if number else label
                axes.hlines(value, x - half, x + half, color=colour, linewidth=2.0, label=name)
        for number, algorithm in enumerate(algorithms):
            own = [level for level in levels if level["algorithm"] in (None, algorithm)]
            at = [places[level["level"]] + 0.06 * unit * number for level in own]
            _draw_algorithm(axes, own, at, unit, count, algorithm, series_style(1 if number == 0 else number + 3))
        if swept is None:
            names = [name.removeprefix("cooperation-").replace("-", "\n", 1) for name in ladder]
            axes.set_xticks([places[name] for name in ladder], names, fontsize=8)
        if axes.dataLim.ymin < 1.0:
            axes.set_yscale("symlog", linthresh=LINEAR)
        axes.yaxis.set_major_formatter(FuncFormatter(plain))
        axes.set_ylim(0.0, (1.5 if axes.get_yscale() == "symlog" else 1.1) * axes.get_ylim()[1])
        axes.set(title=TITLES[count], xlabel=swept or "")
    return finish(figure, " ".join([*results["undertrained"], caption]), panels[0], columns=2, fontsize=8.5)


def _places(levels: Sequence[Json]) -> dict[str, float]:
    """Return the x position of each level: its number in the ladder, or its value in a sweep.

    A copy of an earlier level with a worse V2X channel is drawn to the right of that level.
    """
    ladder = list(dict.fromkeys(level["level"] for level in levels if level["clear"] is None))
    return {
        level["level"]: level["swept_number"]
        if "swept_number" in level
        else ladder.index(level["clear"] or level["level"]) + (0.0 if level["clear"] is None else BESIDE)
        for level in levels
    }


def _draw_algorithm(
    axes: Axes, own: Sequence[Json], at: Sequence[float], unit: float, count: str, algorithm: str, style: Json
) -> None:
    """Draw the harm of one algorithm's policies at each level, with a dot for each seed; ``at`` are x positions."""
    searched = [level[count]["searched"] for level in own]
    shielded = [level[count]["shielded"] and level[count]["shielded"]["searched"] for level in own]
    clear = [level["clear"] is None for level in own]
    hollow = {**style, "linestyle": "none", "markerfacecolor": "white"}
    cross = {"fmt": "x", "color": series_style(2)["color"]}
    for some, values, beside, look, name in (
        (clear, searched, 0.0, style, algorithm),
        ([each is not None for each in shielded], shielded, -0.12, cross, f"{algorithm}, shielded"),
        ([not each for each in clear], searched, 0.0, hollow, f"{algorithm}, worse messages"),
    ):
        harms = [Estimate(**value["harm"]) for value, chosen in zip(values, some, strict=True) if chosen]
        if harms:
            x = [place + beside * unit for place, chosen in zip(at, some, strict=True) if chosen]
            errors = list(zip(*((h.value - h.ends[0], h.ends[1] - h.value) for h in harms), strict=True))
            axes.errorbar(x, [harm.value for harm in harms], yerr=errors, capsize=3, label=name, **look)
    for place, level, value in zip(at, own, searched, strict=True):
        if level["clear"] is not None:
            spot, name = (place, value["full_brake"]["value"]), level["level"].rpartition("-")[2]
            axes.annotate(name, spot, xytext=(0, 4), textcoords="offset points", ha="center", fontsize=8)
        dots = value["each_seed"]
        if len(dots) > 1:
            axes.scatter([place + 0.05 * unit] * len(dots), dots, s=6, color=style["color"], alpha=0.5, linewidths=0)
