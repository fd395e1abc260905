"""The figures of an ablation. Loads matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from ethbrake_marl.errors import count_of
from ethbrake_marl.figures.style import COLOURS, GREY, add_caption, new_figure, series_style, style_axes
from ethbrake_marl.harm import HARM_COUNTS, HarmCount

LINEAR = 0.1  # m2/s2; axes are linear up to there and logarithmic beyond: harm falls to a hundredth

_LEAST_IN = 2.6  # height of a figure with few rows: titles and caption need it
_LEAST_TICKS = 4
_BESIDE = 0.42  # of a worse channel, right of its clear one
_TITLES = {"first": "First-impact harm (m²/s²)", "total": "Total harm (m²/s²)"}

Json = dict[str, Any]


def harm_curve(found: Json, caption: str) -> Figure:
    """Harm level by level under both counts, with full braking above and the joint optimum, its limit, below.

    All of it in the worlds in which the joint optimum was searched.
    """
    figure = new_figure(10.5, 4.8)
    ladder = list(dict.fromkeys(level["level"] for level in found["levels"] if level["clear"] is None))
    for axes, harm_count in zip(figure.subplots(1, 2), HARM_COUNTS, strict=True):
        style_axes(axes)
        _limits(axes, found["levels"], ladder, harm_count)
        for number, algorithm in enumerate(_algorithms(found)):
            _reached(axes, found["levels"], ladder, harm_count, algorithm, number)
        axes.set_xticks(range(len(ladder)), [_short(name) for name in ladder], fontsize=8)
        axes.set_yscale("symlog", linthresh=LINEAR)
        axes.yaxis.set_major_formatter(FuncFormatter(_plain))
        axes.set_ylim(0.0, 1.5 * axes.get_ylim()[1])
        axes.set_title(_TITLES[harm_count], loc="left", fontsize=10)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=4, frameon=False, fontsize=8.5)
    worlds = found["levels"][0]["first"]["searched"]["worlds"]
    add_caption(figure, f"{caption} All of this figure: the first {count_of(worlds, 'world')}.")
    return figure


def change_figure(found: Json, caption: str) -> Figure:
    """What each step and each worse channel changes, with its interval: left of the line is less harm."""
    changes = found["steps"] + found["channels"]
    figure = new_figure(10.5, max(_LEAST_IN, 1.6 + 0.6 * len(changes)))
    for axes, harm_count in zip(figure.subplots(1, 2, sharey=True), HARM_COUNTS, strict=True):
        style_axes(axes)
        axes.axvline(0.0, color=GREY, linewidth=0.9)
        for row, change in enumerate(changes):
            estimate = change[harm_count]["difference"]
            value, (low, high) = estimate["value"], _interval(estimate)
            colour = COLOURS[3] if high < 0.0 else COLOURS[1] if low > 0.0 else GREY
            axes.errorbar(
                value, row, xerr=[[value - low], [high - value]], fmt="o", color=colour, capsize=3, markersize=5
            )
            share = 100.0 * change[harm_count]["worse_off"]["value"]
            text = f"{value:+.2f} [{low:+.2f}, {high:+.2f}]\nsomebody worse off in {share:.0f} %"
            axes.text(
                0.99, row - 0.12, text, transform=axes.get_yaxis_transform(), ha="right", va="bottom", fontsize=7,
                color=GREY, bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
            )  # fmt: skip
        axes.set_title(f"Change of {_TITLES[harm_count][0].lower()}{_TITLES[harm_count][1:]}", loc="left", fontsize=10)
        axes.set_xscale("symlog", linthresh=LINEAR)
        axes.margins(x=0.1)
        axes.set_xticks(signed_ticks(*axes.get_xlim()))
        axes.xaxis.set_major_formatter(FuncFormatter(_plain))
        axes.xaxis.set_minor_locator(NullLocator())
    figure.axes[0].set_yticks(range(len(changes)), [_of_change(change, found) for change in changes], fontsize=8)
    figure.axes[0].set_ylim(len(changes) - 0.5, -0.8)  # from top to bottom
    add_caption(figure, caption)
    return figure


def who_pays(found: Json, caption: str) -> Figure:
    """How harm moved between the vehicles from level to level: a matrix of changes, blue is less."""
    changes = found["steps"] + found["channels"]
    figure = new_figure(10.5, max(_LEAST_IN, 1.8 + 0.42 * len(changes)))
    grids = {harm_count: _matrix(changes, harm_count) for harm_count in HARM_COUNTS}
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
        axes.set_title(f"Change of {_TITLES[harm_count][0].lower()}{_TITLES[harm_count][1:]}", loc="left", fontsize=10)
    every[0].set_yticks(range(len(changes)), [_of_change(change, found) for change in changes], fontsize=8)
    bar = figure.colorbar(image, ax=list(every), label="m²/s²", format=FuncFormatter(_plain))
    bar.set_ticks(signed_ticks(-largest, largest))
    bar.ax.yaxis.set_minor_locator(NullLocator())
    add_caption(figure, caption)
    return figure


def signed_ticks(low: float, high: float) -> list[float]:
    """Round numbers from ``low`` to ``high``, 0 among them, for an axis that is linear up to ``LINEAR``: a few."""
    first = -1 if max(-low, high) > LINEAR else -3
    found: list[float] = []
    for steps in ((1,), (1, 3), (1, 2, 5)):
        sizes = [float(f"{step}e{power}") for power in range(first, 6) for step in steps]
        found = [tick for tick in sorted({0.0, *sizes, *(-size for size in sizes)}) if low <= tick <= high]
        if len(found) >= _LEAST_TICKS:
            break
    return found


def _plain(value: float, _: int) -> str:
    """A tick without powers."""
    return f"{value:g}"


def _limits(axes: Axes, levels: Sequence[Json], ladder: Sequence[str], harm_count: HarmCount) -> None:
    """Full braking and the joint optimum of every level, as short lines; shorter ones beside for worse channels."""
    for key, label, colour in (("full_brake", "all brake fully", GREY), ("best_known", "joint optimum", COLOURS[3])):
        shown = [level for level in levels if level[harm_count]["searched"][key] is not None]
        for number, level in enumerate(shown):
            x, half = _place(level, ladder), 0.3 if level["clear"] is None else 0.07
            value, name = level[harm_count]["searched"][key]["value"], "" if number else label
            axes.hlines(value, x - half, x + half, color=colour, linewidth=2.0, label=name)


def _place(level: Json, ladder: Sequence[str]) -> float:
    """Where a level stands: its number in the ladder, a worse channel to the right of its clear one."""
    return ladder.index(level["clear"] or level["level"]) + (0.0 if level["clear"] is None else _BESIDE)


def _reached(
    axes: Axes, levels: Sequence[Json], ladder: Sequence[str], harm_count: HarmCount, algorithm: str, number: int
) -> None:
    """One algorithm: its ladder, and its worse channels beside their clear ones, each seed a dot."""
    own = [level for level in levels if level["algorithm"] in (None, algorithm)]
    steps = [level for level in own if level["clear"] is None]
    style = series_style(number + 1 if number == 0 else number + 3)
    x = [_place(level, ladder) + 0.06 * number for level in steps]
    _with_intervals(axes, x, steps, harm_count, label=algorithm, **style)
    _behind_shield(axes, [(_place(level, ladder) + 0.06 * number, level) for level in own], harm_count, label=algorithm)
    worse = [level for level in own if level["clear"] is not None]
    beside = [_place(level, ladder) + 0.06 * number for level in worse]
    if worse:
        hollow = {**style, "linestyle": "none", "markerfacecolor": "white"}
        _with_intervals(axes, beside, worse, harm_count, label=f"{algorithm}, worse channel", **hollow)
        for place, level in zip(beside, worse, strict=True):
            channel = level["level"].rpartition("-")[2]
            spot = (place, level[harm_count]["searched"]["full_brake"]["value"])
            axes.annotate(channel, spot, xytext=(0, 4), textcoords="offset points", ha="center", fontsize=8)
    for place, level in zip([*x, *beside], [*steps, *worse], strict=True):
        dots = level[harm_count]["searched"]["each_seed"]
        if len(dots) > 1:
            axes.scatter([place + 0.05] * len(dots), dots, s=6, color=str(style["color"]), alpha=0.5, linewidths=0)


def _behind_shield(axes: Axes, placed: Sequence[tuple[float, Json]], harm_count: HarmCount, *, label: str) -> None:
    """What the same teams do behind the step shield, as crosses to the left; nothing where none was put around them."""
    behind = [(x - 0.12, level[harm_count]["shielded"]["searched"]["harm"]) for x, level in placed if _shielded(level)]
    if behind:
        x, values = [x for x, _ in behind], [harm["value"] for _, harm in behind]
        ends = np.array([_interval(harm) for _, harm in behind]).T
        name = f"{label}, shielded"
        axes.errorbar(x, values, yerr=np.abs(ends - values), fmt="x", color=COLOURS[2], capsize=3, label=name)


def _shielded(level: Json) -> bool:
    return level["first"].get("shielded") is not None


def _with_intervals(
    axes: Axes, x: Sequence[float], levels: Sequence[Json], harm_count: HarmCount, **style: Any
) -> None:
    harms = [level[harm_count]["searched"]["harm"] for level in levels]
    values, ends = np.array([harm["value"] for harm in harms]), np.array([_interval(harm) for harm in harms]).T
    axes.errorbar(x, values, yerr=np.abs(ends - values), capsize=3, **style)


def _matrix(changes: Sequence[Json], harm_count: HarmCount) -> Any:
    return np.array([[estimate["value"] for estimate in change[harm_count]["vehicles"]] for change in changes])


def _interval(estimate: Mapping[str, Any]) -> tuple[float, float]:
    """The interval; the value itself where one world gives none."""
    low, high = estimate["interval"] or (estimate["value"], estimate["value"])
    return low, high


def _algorithms(found: Json) -> list[str]:
    return list(dict.fromkeys(level["algorithm"] for level in found["levels"] if level["algorithm"] is not None))


def _short(name: str) -> str:
    """``cooperation-2-paper`` as two lines, ``2`` and ``paper``."""
    return name.removeprefix("cooperation-").replace("-", "\n", 1)


def _of_change(change: Json, found: Json) -> str:
    words = f"{_short(change['from'])} → {_short(change['to'])}".replace("\n", " ")
    return f"{words} ({change['algorithm']})" if len(_algorithms(found)) > 1 else words
