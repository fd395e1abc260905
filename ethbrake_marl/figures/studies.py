"""The figures of an ablation. Loads matplotlib."""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, NullFormatter, NullLocator, StrMethodFormatter

from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.envs.drawing.scene import vehicle_colour
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.evaluation.episodes import EpisodeRecord
from ethbrake_marl.evaluation.statistics import Estimate
from ethbrake_marl.figures.style import COLOURS, GREY, ends_of, finish, name_axes, new_figure, new_panels, series_style
from ethbrake_marl.physics import Floats

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
    figure, panels = new_panels((10.5, 4.8), columns=2)
    ladder = list(dict.fromkeys(level["level"] for level in found["levels"] if level["clear"] is None))
    for axes, harm_count in zip(panels, HARM_COUNTS, strict=True):
        _limits(axes, found["levels"], ladder, harm_count)
        for number, algorithm in enumerate(_algorithms(found)):
            _reached(axes, found["levels"], ladder, harm_count, algorithm, number)
        axes.set_xticks(range(len(ladder)), [_short(name) for name in ladder], fontsize=8)
        axes.set_yscale("symlog", linthresh=LINEAR)
        axes.yaxis.set_major_formatter(FuncFormatter(_plain))
        axes.set_ylim(0.0, 1.5 * axes.get_ylim()[1])
        name_axes(axes, _TITLES[harm_count])
    worlds = found["levels"][0]["first"]["searched"]["worlds"]
    told = f"{caption} All of this figure: the first {count_of(worlds, 'world')}."
    return finish(figure, told, panels[0], columns=4, fontsize=8.5)


def change_figure(found: Json, caption: str) -> Figure:
    """What each step and each worse channel changes, with its interval: left of the line is less harm."""
    changes = found["steps"] + found["channels"]
    figure, panels = new_panels((10.5, max(_LEAST_IN, 1.6 + 0.6 * len(changes))), columns=2, sharey=True)
    for axes, harm_count in zip(panels, HARM_COUNTS, strict=True):
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
    panels[0].set_yticks(range(len(changes)), _of_changes(found), fontsize=8)
    panels[0].set_ylim(len(changes) - 0.5, -0.8)  # from top to bottom
    return finish(figure, caption)


def who_pays(found: Json, caption: str) -> Figure:
    """How harm moved between the vehicles from level to level: a matrix of changes, blue is less."""
    changes = found["steps"] + found["channels"]
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
        axes.set_title(f"Change of {_TITLES[harm_count][0].lower()}{_TITLES[harm_count][1:]}", loc="left", fontsize=10)
    every[0].set_yticks(range(len(changes)), _of_changes(found), fontsize=8)
    bar = figure.colorbar(image, ax=list(every), label="m²/s²", format=FuncFormatter(_plain))
    bar.set_ticks(signed_ticks(-largest, largest))
    bar.ax.yaxis.set_minor_locator(NullLocator())
    return finish(figure, caption)


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


def _interval(estimate: Mapping[str, Any]) -> tuple[float, float]:
    """The interval; the value itself where one world gives none."""
    low, high = estimate["interval"] or (estimate["value"], estimate["value"])
    return low, high


def _algorithms(found: Json) -> list[str]:
    return list(dict.fromkeys(level["algorithm"] for level in found["levels"] if level["algorithm"] is not None))


def _short(name: str) -> str:
    """``cooperation-2-paper`` as two lines, ``2`` and ``paper``."""
    return name.removeprefix("cooperation-").replace("-", "\n", 1)


def _of_changes(found: Json) -> list[str]:
    """What each step and each worse channel is called."""
    changes, several = found["steps"] + found["channels"], len(_algorithms(found)) > 1
    words = [f"{_short(change['from'])} → {_short(change['to'])}".replace("\n", " ") for change in changes]
    return [f"{each} ({c['algorithm']})" if several else each for each, c in zip(words, changes, strict=True)]


# Curves of several trainings: harm over training steps, with the spread over seeds.


@dataclass(frozen=True, slots=True)
class SeedCurve:
    """One figure of several trainings of one recipe, at the same steps."""

    steps: Floats  # [k]
    values: Floats  # [seeds, k]


def seed_curves(
    panels: Mapping[str, Mapping[str, SeedCurve]], *, logarithmic: Collection[str] = (), caption: str = ""
) -> Figure:
    """One panel per label, one line per recipe: the mean over seeds, bands one standard deviation to either side.

    Panels in ``logarithmic`` have a logarithmic axis if their means allow it: harm falls to a tenth, and the last
    tenth is what matters. Raises ``InvalidInput`` without panels or lines.
    """
    if not panels or not all(panels.values()):
        raise InvalidInput("seed_curves: nothing to draw; at least one training with one evaluation is needed")
    figure, every = new_panels((5.0 * len(panels), 4.2), columns=len(panels))
    for axes, (label, curves) in zip(every, panels.items(), strict=True):
        for number, (recipe, curve) in enumerate(curves.items()):
            style = series_style(number + 1)
            mean, seeds = curve.values.mean(axis=0), len(curve.values)
            spread = curve.values.std(axis=0, ddof=1) if seeds > 1 else mean * 0.0  # of one seed nothing is known
            axes.plot(curve.steps, mean, label=f"{recipe}, {seeds} seed{'s' * (seeds != 1)}", **style)
            axes.fill_between(
                curve.steps, mean - spread, mean + spread, color=str(style["color"]), alpha=0.18, linewidth=0.0
            )
        if label in logarithmic and all((curve.values > 0.0).all() for curve in curves.values()):
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        name_axes(axes, label, "Training steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    return finish(figure, caption, every[0])


def at_common_steps(trainings: Sequence[Mapping[int, float]]) -> SeedCurve:
    """Figures of several trainings, by step, at the steps that all of them have. Raises ``InvalidInput`` for none."""
    common = sorted(set.intersection(*(set(training) for training in trainings))) if trainings else []
    if not common:
        raise InvalidInput("at_common_steps: the trainings were never evaluated at the same step")
    values = [[training[step] for step in common] for training in trainings]
    return SeedCurve(np.array(common, np.float64), np.array(values, np.float64))


# The figures of ``ethbrake reproduce``: harm over a number, bars, vehicles along the road, commands, changes.

_ARROW_STEPS = 10  # the paper draws every tenth time step
_ROW_CHARACTERS = 52  # of a line beside the axis


@dataclass(frozen=True, slots=True)
class Line:
    """Values with their intervals over a number."""

    x: tuple[float, ...]
    y: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]

    @classmethod
    def of(cls, x: Sequence[float], estimates: Sequence[Estimate]) -> Self:
        """From estimates; one without an interval has a width of 0."""
        ends = [ends_of(each) for each in estimates]
        values = tuple(each.value for each in estimates)
        return cls(tuple(x), values, tuple(low for low, _ in ends), tuple(high for _, high in ends))


def lines_figure(panels: Mapping[str, Mapping[str, Line]], *, x_label: str, y_label: str, caption: str) -> Figure:
    """One panel per title, one line per label, bands: 95 % intervals."""
    figure, every = new_panels((4.6 * len(panels), 4.2), columns=len(panels), sharey=True)
    for axes, (title, lines) in zip(every, panels.items(), strict=True):
        for number, (label, line) in enumerate(lines.items()):
            style = series_style(number)
            axes.plot(line.x, line.y, label=label, **style)
            axes.fill_between(line.x, line.low, line.high, color=str(style["color"]), alpha=0.18, linewidth=0.0)
        name_axes(axes, title, x_label)
    every[0].set_ylim(bottom=0.0)
    name_axes(every[0], y=y_label)
    return finish(figure, caption, every[0], columns=3)


def bars_figure(
    panels: Mapping[str, Mapping[str, Sequence[Estimate]]], *, groups: Sequence[str], y_label: str, caption: str
) -> Figure:
    """One panel per title: for each group a bar for each label, with its interval where it has one."""
    figure, every = new_panels((4.6 * len(panels), 4.2), columns=len(panels), sharey=True)
    for axes, (title, bars) in zip(every, panels.items(), strict=True):
        width = 0.8 / len(bars)
        for number, (label, estimates) in enumerate(bars.items()):
            offset = (number - 0.5 * (len(bars) - 1)) * width
            line = Line.of([k + offset for k in range(len(estimates))], estimates)
            colour = str(series_style(number)["color"])
            axes.bar(line.x, line.y, 0.9 * width, color=colour, label=label)
            axes.vlines(line.x, line.low, line.high, color="black", linewidth=1.0)
        axes.set_xticks(range(len(groups)), list(groups))
        name_axes(axes, title)
    name_axes(every[0], y=y_label)
    return finish(figure, caption, every[0], columns=3)


def road_figure(records: Mapping[str, EpisodeRecord], *, caption: str) -> Figure:
    """As the paper draws it: position along the road against the vehicle, an arrow at every tenth time step.

    Dashed lines join the vehicles at the same time. One panel per record, two in a row.
    """
    figure, panels = _in_pairs(len(records), 1.9, "Position along the road (m)", "Vehicle")
    for axes, (title, record) in zip(panels, records.items(), strict=False):
        vehicles = np.arange(1, record.positions_m.shape[1] + 1)
        times = np.arange(0.0, record.time_s[-1] + 1e-9, _ARROW_STEPS * record.scenario.time_step_s)
        at = np.array([np.interp(times, record.time_s, column) for column in record.positions_m.T])
        axes.plot(at, vehicles, color=GREY, linewidth=0.7, linestyle="--")
        for i, number in enumerate(vehicles):
            colour = vehicle_colour(i)
            axes.plot([at[i].min(), at[i].max()], [number, number], color=colour, linewidth=1.4)
            axes.plot(at[i], np.full(len(times), number), linestyle="none", marker=">", markersize=6, color=colour)
        axes.set_yticks(vehicles)
        axes.set_ylim(0.5, len(vehicles) + 0.5)
        name_axes(axes, title)
    return finish(figure, caption)


def _in_pairs(panels: int, height_in: float, x: str, y: str) -> tuple[Figure, list[Axes]]:
    """Panels on common scales, two in a row, named at the left and below."""
    rows = (panels + 1) // 2
    figure, every = new_panels((10.0, height_in * rows + 1.0), rows, 2, sharex=True, sharey=True)
    for axes in every[::2]:
        name_axes(axes, y=y)
    for axes in every[-2:]:
        name_axes(axes, x=x)
    return figure, every


def profiles_figure(panels: Mapping[str, Mapping[str, EpisodeRecord]], *, caption: str) -> Figure:
    """The command of the driven vehicle over time: one panel per title, one line per label."""
    figure, every = _in_pairs(len(panels), 2.3, "Time since Vehicle 1 began to brake (s)", "Command (m/s²)")
    for axes, (title, records) in zip(every, panels.items(), strict=False):
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        for number, (label, record) in enumerate(records.items()):
            style = {**series_style(number), "marker": ""}
            command = record.command_mps2[:, record.vehicle]
            axes.plot(record.time_s, command, drawstyle="steps-post", label=label, **style)
        name_axes(axes, title)
    return finish(figure, caption, every[0], columns=4)


def changes_figure(changes: Mapping[str, Mapping[str, Estimate]], *, x_label: str, caption: str) -> Figure:
    """By how much each change moves a number: one row per change, one mark per label, with its interval."""
    rows = list(changes)
    labels = list(dict.fromkeys(label for each in changes.values() for label in each))
    figure, (axes,) = new_panels((9.4, 0.3 * len(rows) + 1.6))
    axes.axvline(0.0, color=GREY, linewidth=0.9)
    for number, label in enumerate(labels):
        at = [(len(rows) - 1 - k + 0.16 * (0.5 * (len(labels) - 1) - number), changes[row].get(label))
              for k, row in enumerate(rows)]  # fmt: skip
        known = [(y, each) for y, each in at if each is not None]
        line = Line.of([y for y, _ in known], [each for _, each in known])
        style = series_style(number)
        axes.hlines(line.x, line.low, line.high, color=str(style["color"]), linewidth=1.4)
        axes.plot(line.y, line.x, linestyle="none", marker=style["marker"], markersize=4.5, color=style["color"],
                  label=label)  # fmt: skip
    axes.set_yticks(range(len(rows)), [textwrap.fill(row, _ROW_CHARACTERS) for row in rows[::-1]], fontsize=8)
    name_axes(axes, x=x_label)
    return finish(figure, caption, axes, columns=3)
