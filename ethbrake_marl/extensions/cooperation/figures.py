"""Figures of an ablation: harm at each level, and change of harm from level to level.

``results`` is the content of ``ablation.json``.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.ticker import FuncFormatter, NullLocator

from ethbrake_marl.envs.rendering import COLOURS
from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.cooperation.curves import Json, algorithms, sweep_figures, swept_axis, with_intervals
from ethbrake_marl.extensions.report.style import (
    ALARM,
    GREY,
    TITLES,
    finish,
    name_axes,
    new_figure,
    new_panels,
    plain,
    series_style,
)
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.game.harm import HARM_COUNTS, HarmCount

LINEAR = 0.1  # m2/s2; axes are linear below this harm and logarithmic above it, because harm varies by a factor of 100

_LEAST_IN = 2.6  # least height of a figure, which leaves space for titles and caption (inches)

_LEAST_TICKS = 4

_BESIDE = 0.42  # distance at which a level with a worse channel is drawn to the right of its level


def ablation_figures(results: Json, caption: str) -> list[Figure]:
    """Return the three figures of an ablation, or the two figures of a sweep (``sweep_figures``).

    The three figures show the line's harm at each level, the change of the line's harm from level to level, and the
    change of each vehicle's harm. Red text above a figure names the levels whose trained policies do worse than full
    braking.
    """
    if swept_axis(results) is None:
        figures = [_harm_curve(results, caption), _change_figure(results, caption), _who_pays(results, caption)]
    else:
        figures = sweep_figures(results, caption)
    for figure in figures if results["undertrained"] else ():
        text = "\n".join(textwrap.fill(line, int(figure.get_figwidth() * 13.0)) for line in results["undertrained"])
        for legend in figure.legends:  # the text goes into the legend, because a figure title would overlap it
            legend.set_title(text, prop=FontProperties(size=9))
            legend.set_alignment("left")
            legend.get_title().set_color(ALARM)
        if not figure.legends:
            figure.suptitle(text, x=0.01, ha="left", fontsize=9, color=ALARM)
    return figures


def _harm_curve(results: Json, caption: str) -> Figure:
    """Draw the mean harm of the trained policies, of full braking and of the joint optimum at each level.

    All means are over the worlds in which the joint optimum was searched.
    """
    figure, panels = new_panels((10.5, 4.8), columns=2)
    ladder = list(dict.fromkeys(level["level"] for level in results["levels"] if level["clear"] is None))
    for axes, harm_count in zip(panels, HARM_COUNTS, strict=True):
        for key, label, colour in (
            ("full_brake", "all brake fully", GREY),
            ("best_known", "joint optimum", COLOURS[3]),
        ):
            shown = [level for level in results["levels"] if level[harm_count]["searched"][key] is not None]
            for number, level in enumerate(shown):  # short horizontal lines, shorter for levels with a worse channel
                x, half = _place(level, ladder), 0.3 if level["clear"] is None else 0.07
                value, name = level[harm_count]["searched"][key]["value"], "" if number else label
                axes.hlines(value, x - half, x + half, color=colour, linewidth=2.0, label=name)
        for number, algorithm in enumerate(algorithms(results)):
            _reached(axes, results["levels"], ladder, harm_count, algorithm, number)
        axes.set_xticks(range(len(ladder)), [_short(name) for name in ladder], fontsize=8)
        if axes.dataLim.ymin < 1.0:
            axes.set_yscale("symlog", linthresh=LINEAR)
        axes.yaxis.set_major_formatter(FuncFormatter(plain))
        axes.set_ylim(0.0, (1.5 if axes.get_yscale() == "symlog" else 1.1) * axes.get_ylim()[1])
        name_axes(axes, TITLES[harm_count])
    worlds = results["levels"][0]["first"]["searched"]["worlds"]
    text = f"{caption} All values of this figure: means over the first {count_of(worlds, 'world')}."
    return finish(figure, text, panels[0], columns=4, fontsize=8.5)


def _change_figure(results: Json, caption: str) -> Figure:
    """Draw the change of harm from level to level and from each level to its copies with a worse V2X channel.

    Whiskers show 95 % confidence intervals. A mark to the left of 0 means less harm at the level that the label names
    last.
    """
    changes = results["steps"] + results["channels"]
    figure, panels = new_panels((10.5, max(_LEAST_IN, 1.6 + 0.6 * len(changes))), columns=2, sharey=True)
    for axes, harm_count in zip(panels, HARM_COUNTS, strict=True):
        axes.axvline(0.0, color=GREY, linewidth=0.9)
        for row, change in enumerate(changes):
            estimate = Estimate(**change[harm_count]["difference"])
            low, high = estimate.ends
            colour = COLOURS[3] if high < 0.0 else COLOURS[1] if low > 0.0 else GREY
            with_intervals(axes, [row], [estimate], upright=False, fmt="o", color=colour, capsize=3, markersize=5)
            share = 100.0 * change[harm_count]["worse_off"]["value"]
            text = f"{estimate.value:+.2f} [{low:+.2f}, {high:+.2f}]\nsomebody worse off in {share:.0f} %"
            axes.text(
                0.99, row - 0.12, text, transform=axes.get_yaxis_transform(), ha="right", va="bottom", fontsize=7,
                color=GREY, bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
            )  # fmt: skip
        axes.set_title(f"Change of {TITLES[harm_count][0].lower()}{TITLES[harm_count][1:]}", loc="left", fontsize=10)
        axes.set_xscale("symlog", linthresh=LINEAR)
        axes.margins(x=0.1)
        axes.set_xticks(signed_ticks(*axes.get_xlim()))
        axes.xaxis.set_major_formatter(FuncFormatter(plain))
        axes.xaxis.set_minor_locator(NullLocator())
    panels[0].set_yticks(range(len(changes)), _of_changes(results), fontsize=8)
    panels[0].set_ylim(len(changes) - 0.5, -0.8)  # from top to bottom
    return finish(figure, caption)


def _who_pays(results: Json, caption: str) -> Figure:
    """Draw the change of each vehicle's harm from level to level as a coloured matrix; blue cells mean less harm."""
    changes = results["steps"] + results["channels"]
    figure = new_figure(10.5, max(_LEAST_IN, 1.8 + 0.42 * len(changes)))
    grids = {
        count: np.array([[estimate["value"] for estimate in change[count]["vehicles"]] for change in changes])
        for count in HARM_COUNTS
    }
    largest = max(float(np.abs(grid).max()) for grid in grids.values()) or 1.0
    every = figure.subplots(1, 2, sharey=True)
    for axes, (harm_count, grid) in zip(every, grids.items(), strict=True):
        norm = SymLogNorm(LINEAR, vmin=-largest, vmax=largest)
        image = axes.imshow(grid, cmap="RdBu_r", norm=norm, aspect="auto")
        for row, values in enumerate(grid):
            for column, value in enumerate(values):
                colour = "white" if abs(float(norm(value)) - 0.5) > 0.28 else "black"
                axes.text(column, row, f"{value:+.2f}", ha="center", va="center", fontsize=8, color=colour)
        axes.set_xticks(range(grid.shape[1]), [f"Vehicle {i + 1}" for i in range(grid.shape[1])], fontsize=9)
        axes.set_title(f"Change of {TITLES[harm_count][0].lower()}{TITLES[harm_count][1:]}", loc="left", fontsize=10)
    every[0].set_yticks(range(len(changes)), _of_changes(results), fontsize=8)
    bar = figure.colorbar(image, ax=list(every), label="m²/s²", format=FuncFormatter(plain))
    bar.set_ticks(signed_ticks(-largest, largest))
    bar.ax.yaxis.set_minor_locator(NullLocator())
    return finish(figure, caption)


def signed_ticks(low: float, high: float) -> list[float]:
    """Return the ticks of an axis from ``low`` to ``high``: 0 and round numbers.

    The axis is linear between -0.1 and 0.1 m2/s2 (``LINEAR``), and logarithmic outside.
    """
    first = -1 if max(-low, high) > LINEAR else -3
    ticks: list[float] = []
    for steps in ((1,), (1, 3), (1, 2, 5)):
        sizes = [float(f"{step}e{power}") for power in range(first, 6) for step in steps]
        ticks = [tick for tick in sorted({0.0, *sizes, *(-size for size in sizes)}) if low <= tick <= high]
        if len(ticks) >= _LEAST_TICKS:
            break
    return ticks


def _place(level: Json, ladder: Sequence[str]) -> float:
    """Return the x position of a level: its index in ``ladder``.

    A copy of an earlier level with a worse V2X channel is drawn to the right of that level.
    """
    return ladder.index(level["clear"] or level["level"]) + (0.0 if level["clear"] is None else _BESIDE)


def _reached(
    axes: Axes, levels: Sequence[Json], ladder: Sequence[str], harm_count: HarmCount, algorithm: str, number: int
) -> None:
    """Draw the harm of one algorithm's trained policies at each level, with a dot for each training seed.

    ``number`` is the index of the algorithm, which determines colour and offset of its marks.
    """
    own = [level for level in levels if level["algorithm"] in (None, algorithm)]
    style = series_style(number + 1 if number == 0 else number + 3)
    hollow = {**style, "linestyle": "none", "markerfacecolor": "white"}
    steps, worse = ([level for level in own if (level["clear"] is None) == clear] for clear in (True, False))
    shielded = [level for level in own if level["first"].get("shielded") is not None]
    for some, key, beside, look in (
        (steps, steps, 0.0, {**style, "label": algorithm}),
        # results of the same teams with the step shield are crosses, to the left of the marks
        (
            shielded, [{harm_count: level[harm_count]["shielded"]} for level in shielded], -0.12,
            {"fmt": "x", "color": COLOURS[2], "label": f"{algorithm}, shielded"},
        ),
        (worse, worse, 0.0, {**hollow, "label": f"{algorithm}, worse messages"}),
    ):  # fmt: skip
        x = [_place(level, ladder) + 0.06 * number + beside for level in some]
        if some:
            harms = [Estimate(**each[harm_count]["searched"]["harm"]) for each in key]
            with_intervals(axes, x, harms, capsize=3, **look)
    for level in [*steps, *worse]:
        place, searched = _place(level, ladder) + 0.06 * number, level[harm_count]["searched"]
        if level["clear"] is not None:
            channel, spot = level["level"].rpartition("-")[2], (place, searched["full_brake"]["value"])
            axes.annotate(channel, spot, xytext=(0, 4), textcoords="offset points", ha="center", fontsize=8)
        dots = searched["each_seed"]
        if len(dots) > 1:
            axes.scatter([place + 0.05] * len(dots), dots, s=6, color=str(style["color"]), alpha=0.5, linewidths=0)


def _short(name: str) -> str:
    """Return the name of a level for an axis: without ``cooperation-``, and with a line break at the first hyphen."""
    return name.removeprefix("cooperation-").replace("-", "\n", 1)


def _of_changes(results: Json) -> list[str]:
    """Return a label ``LEVEL → LEVEL`` for each change from level to level, then for each change of the V2X channel."""
    changes, several = results["steps"] + results["channels"], len(algorithms(results)) > 1
    words = [f"{_short(change['from'])} → {_short(change['to'])}".replace("\n", " ") for change in changes]
    return [f"{each} ({c['algorithm']})" if several else each for each, c in zip(words, changes, strict=True)]
