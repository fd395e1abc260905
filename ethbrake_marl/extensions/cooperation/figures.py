"""Figure of an ablation or a sweep, from the content of ``ablation.json``."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from ethbrake_marl.episode.counts import COLUMN
from ethbrake_marl.extensions.report.style import GREY, TITLES, finish, in_our_style, new_panels, plain, series_style
from ethbrake_marl.files.sheet import Estimate

LINEAR = 0.1  # m2/s2; axes are linear below this harm and logarithmic above it, because harm varies by a factor of 100
LEVEL_IN, NARROWEST_IN, WIDEST_IN = 1.05, 5.0, 10.5  # width of a level, and of the figure
PANEL_IN = 2.8  # height of a panel

Json = dict[str, Any]


@in_our_style
def ablation_figure(results: Json, caption: str) -> Figure:
    """Draw both harms and the honest cost at each level or swept value, with 95 % intervals and a dot for each seed.

    All means are over the worlds in which the joint optimum is known.
    """
    levels, swept = results["levels"], results["settings"]["swept"]
    names = list(dict.fromkeys(level["level"] for level in levels))
    at = {level["level"]: level.get("swept_number", names.index(level["level"])) for level in levels}
    unit = (max(at.values()) - min(at.values())) / (len(at) - 1)  # mean distance between neighbours
    width = min(max(LEVEL_IN * len(at), NARROWEST_IN), WIDEST_IN)
    figure, panels = new_panels((width, PANEL_IN * len(COLUMN)), rows=len(COLUMN))
    for axes, count in zip(panels, COLUMN, strict=True):
        points = [(at[level["level"]], level["algorithm"], level[count]["searched"]) for level in levels]
        _draw_bounds(axes, points, 0.3 * unit)
        for number, algorithm in enumerate(results["settings"]["recipes"]):
            own = [(x + 0.06 * unit * number, each) for x, name, each in points if name in (None, algorithm)]
            _draw_algorithm(axes, own, unit, algorithm, series_style(1 if number == 0 else number + 3))
        if swept is None:
            words = [name.removeprefix("cooperation-").replace("-", "\n", 1) for name in names]
            axes.set_xticks([at[name] for name in names], words, fontsize=8)
        if axes.dataLim.ymin < 1.0:
            axes.set_yscale("symlog", linthresh=LINEAR)
        axes.yaxis.set_major_formatter(FuncFormatter(plain))
        axes.set_ylim(0.0, (1.5 if axes.get_yscale() == "symlog" else 1.1) * axes.get_ylim()[1])
        axes.set(title=TITLES[count], xlabel=swept or "")
    return finish(figure, " ".join([*results["undertrained"], caption]), panels[0], columns=2, fontsize=8.5)


def _draw_bounds(axes: Axes, points: list[tuple[float, str | None, Json]], half: float) -> None:
    for key, label, colour in (
        ("full_brake", "full braking", GREY),
        ("best_known", "joint optimum", series_style(3)["color"]),
    ):
        shown = [(x, each[key]["value"]) for x, _, each in points if each[key] is not None]
        for number, (x, value) in enumerate(shown):
            name = "" if number else label
            axes.hlines(value, x - half, x + half, color=colour, linewidth=2.0, label=name)


def _draw_algorithm(
    axes: Axes, own: list[tuple[float, Json]], unit: float, algorithm: str, style: dict[str, Any]
) -> None:
    harms = [Estimate(**each["harm"]) for _, each in own]
    errors = list(zip(*((h.value - h.ends[0], h.ends[1] - h.value) for h in harms), strict=True))
    look = style | {"linestyle": "none"}
    axes.errorbar([x for x, _ in own], [h.value for h in harms], yerr=errors, capsize=3, label=algorithm, **look)
    for x, each in own:
        dots = each["each_seed"]
        if len(dots) > 1:
            axes.scatter([x + 0.05 * unit] * len(dots), dots, s=6, color=style["color"], alpha=0.5, linewidths=0)
