"""Figure of the worlds of a scenario: distributions and scatter plots of quantities, and three worlds to scale."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ethbrake_marl.episode.state import NUMBER
from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.rendering.picture import vehicle_colour
from ethbrake_marl.extensions.rendering.scene import BODY_M
from ethbrake_marl.extensions.report.style import (
    GREY,
    finish,
    in_our_style,
    label_text,
    name_axes,
    new_figure,
    series_style,
    style_axes,
    write_picture,
)
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.describe import kinds_of, quantities_of
from ethbrake_marl.worlds.rules import RULES, Rule
from ethbrake_marl.worlds.sampling import Drawn
from ethbrake_marl.worlds.scenario import Scenario

ABREAST = 4  # distributions in a row of the figure
MOST_APART = 4  # outlines in a distribution with a legend
MOST_PAIRED = 5  # quantities that are drawn in pairs
MOST_NAMED = 8  # vehicles for which gaps and speeds are written
LABEL_CHARACTERS = 18  # in a line of a label
SHOWN = {0.0: "shortest line", 0.5: "median line", 1.0: "longest line"}  # by relative rank of the sum of gaps

Varying = dict[str, dict[int, Floats]]  # key of a quantity -> vehicle or pair (from 0) -> values [n], not all alike


def write_worlds(path: Path, scenario: Scenario, episodes: int, *, seed: int, force: bool = False) -> None:
    """Write the picture of ``ethbrake scenario sample``. Raises the errors of ``write_picture``."""
    write_picture(path, worlds_figure(scenario, scenario.draw(episodes, seed), seed=seed), force=force)


@in_our_style
def worlds_figure(scenario: Scenario, drawn: Drawn, *, seed: int) -> Figure:
    """Draw what differs between worlds, and three of them to scale.

    The scatter plots prefer quantities of the first learner and of the gap ahead of it. Colours of points: members of a
    mixture, or else vehicle types of the first learner.
    """
    worlds, varying = drawn.worlds, _varying(drawn)
    focus = scenario.learners[0] - 1 if scenario.learners else 0
    kinds = kinds_of(drawn)
    kind = kinds.get("scenario", kinds.get(f"vehicle_{focus + 1}_type", np.full(worlds.n, "")))
    paired, ranked = _paired(varying, focus), np.argsort(worlds.gaps_m.sum(axis=1), kind="stable")
    shown = {int(ranked[round(rank * (worlds.n - 1))]): name for rank, name in SHOWN.items()}
    drawings = [
        (1.6 * -(-len(varying) // ABREAST), partial(_distributions, varying, scenario)),
        (1.35 * len(paired) - 0.95 if len(paired) > 1 else 0.0, partial(_pairs, paired, kind)),
        (0.4 + 0.95 * len(shown), partial(_lines, drawn, shown)),
    ]
    drawings = [(height_in, draw) for height_in, draw in drawings if height_in]
    heights_in = [height_in for height_in, _ in drawings]
    figure = new_figure(8.0, sum(heights_in) + 0.4)
    parts = figure.subfigures(len(drawings), 1, squeeze=False, height_ratios=heights_in).ravel()
    for part, (_, draw) in zip(parts, drawings, strict=True):
        draw(part)
    return finish(
        figure,
        f"{label_text(scenario.name, 80)}, {count_of(worlds.n, 'world')} of the list of seed {seed}. Worlds are drawn"
        f" to scale, with vehicles {BODY_M:g} m long; above: gaps (m), below: speeds (m/s).",
    )


def label(rule: Rule) -> str:
    """Return the name of a quantity with its unit: ``braking capacity (m/s²)``."""
    name = rule.key.removesuffix(f"_{rule.unit}") if rule.unit else rule.key
    unit = {"mps": "m/s", "mps2": "m/s²", "mps3": "m/s³"}.get(rule.unit, rule.unit)
    return name.replace("_", " ") + (f" ({unit})" if unit else "")


def _varying(drawn: Drawn) -> Varying:
    columns, varying = quantities_of(drawn.worlds, drawn.friction), dict[str, dict[int, Floats]]()
    for key, rule in RULES.items():
        for i in range(rule.count(drawn.worlds.vehicles) if rule.column else 0):
            values = columns.get(rule.column_of(i))
            if values is not None and np.nanmin(values) < np.nanmax(values):
                varying.setdefault(key, {})[i] = values
    return varying


def _paired(varying: Varying, focus: int) -> dict[str, Floats]:
    """Return at most ``MOST_PAIRED`` quantities, label -> values [n], those near the vehicle ``focus`` (from 0) first.

    A quantity that only some worlds have is left out.
    """
    found: list[tuple[int, str, Floats]] = []
    for key, entries in varying.items():
        rule = RULES[key]
        own = {"vehicle": focus, "pair": max(focus - 1, 0), "world": 0}[rule.per]
        nearest = sorted(entries, key=lambda i: (abs(i - own), i))
        for i, values in entries.items():
            owner = "" if rule.per == "world" else f"{rule.per.capitalize()} {i + 1}, "
            if not np.isnan(values).any():
                found.append((nearest.index(i), textwrap.fill(owner + label(rule), LABEL_CHARACTERS), values))
    chosen = np.argsort([place for place, *_ in found], kind="stable")[:MOST_PAIRED]
    return {found[k][1]: found[k][2] for k in sorted(chosen)}


def _distributions(varying: Varying, scenario: Scenario, part: Any) -> None:
    """Draw a panel for each quantity; vehicles for which the scenario declares the same ends share an outline."""
    columns = min(len(varying), ABREAST)
    every = part.subplots(-(-len(varying) // columns), columns, squeeze=False).ravel()
    for axes in every[len(varying) :]:
        axes.set_axis_off()
    for axes, (key, entries) in zip(every, varying.items(), strict=False):
        style_axes(axes, 7)
        rule, groups = RULES[key], dict[Any, list[int]]()
        for i in entries:
            groups.setdefault(None if rule.per == "world" else scenario.bounds(key)[i], []).append(i)
        whole = np.concatenate(list(entries.values()))
        ends = np.linspace(np.nanmin(whole), np.nanmax(whole), 25)
        for number, alike in enumerate(groups.values()):
            values = np.concatenate([entries[i][~np.isnan(entries[i])] for i in alike])
            style, names = series_style(number + 2), ", ".join(rule.owner(i) for i in alike)
            axes.hist(
                values, ends, weights=np.full(values.size, 1.0 / values.size),
                histtype="step" if number else "stepfilled", color=style["color"], linestyle=style["linestyle"],
                linewidth=1.4, label=label_text(names.replace("vehicle_", "Vehicle "), 30),
            )  # fmt: skip
        if 1 < len(groups) <= MOST_APART:
            axes.legend(fontsize=6.5, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 0.98), borderpad=0.0)
        axes.locator_params(nbins=3)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        name_axes(axes, x=label(rule))
    name_axes(every[0], y="Share of worlds")


def _pairs(paired: Mapping[str, Floats], kind: Any, part: Any) -> None:
    labels, values, names = list(paired), list(paired.values()), np.unique(kind)
    grid = part.subplots(len(paired) - 1, len(paired) - 1, squeeze=False, sharex="col", sharey="row")
    for axes in grid[np.triu_indices(len(grid), 1)]:
        axes.set_axis_off()
    for row, column in zip(*np.tril_indices(len(grid)), strict=True):
        axes = grid[row, column]
        style_axes(axes, 7)
        for number, name in enumerate(names):
            chosen, style = kind == name, series_style(number + 2)
            axes.scatter(
                values[column][chosen], values[row + 1][chosen], s=5.0, alpha=0.5, linewidths=0.0, rasterized=True,
                marker=style["marker"], color=style["color"], label=label_text(str(name)),
            )  # fmt: skip
        axes.locator_params(nbins=3)
        name_axes(axes, x=labels[column], y=labels[row + 1])
        axes.label_outer()
    if len(names) > 1:
        part.legend(*grid[0][0].get_legend_handles_labels(), fontsize=8, frameon=False, markerscale=2.5)


def _lines(drawn: Drawn, shown: Mapping[int, str], part: Any) -> None:
    """Draw the vehicles of some worlds at the alert, to scale, one world below the other."""
    worlds, every = drawn.worlds, part.subplots(len(shown), 1, squeeze=False, sharex=True).ravel()
    for axes, (row, name) in zip(every, shown.items(), strict=True):
        style_axes(axes, 7)
        axes.set(yticks=[], ylim=(-1.5, 1.0))
        axes.use_sticky_edges = False  # leaves some road ahead and behind
        axes.axhline(-0.4, color=GREY, linewidth=0.8)
        name_axes(axes, f"World {worlds.clock[row, NUMBER]:.0f}, {name}")
        gaps, ahead = worlds.gaps_m[row], float(worlds.obstacle_gap_m[row])
        fronts = -np.concatenate([[0.0], np.cumsum(gaps + BODY_M)])
        colours = [vehicle_colour(body) for body in range(1, worlds.vehicles + 1)]
        axes.barh(np.zeros(worlds.vehicles), BODY_M, 0.8, left=fronts - BODY_M, color=colours)
        labels = [(front + 0.5 * gap, 0.65, f"{gap:.1f}") for front, gap in zip(fronts[1:], gaps, strict=True)]
        for i, front in enumerate(fronts - 0.5 * BODY_M):
            kind = f"\n{label_text(str(drawn.types[row, i]), 20)}" if drawn.types[row, i] else ""
            labels += [(front, 0.0, f"{i + 1}"), (front, -0.95, f"{worlds.speeds_mps[row, i]:.1f}{kind}")]
        if np.isfinite(ahead):
            axes.axvline(ahead, 0.2, 1.0, color="black", linewidth=4.0)
            labels.append((0.5 * ahead, 0.65, f"{ahead:.1f} to the obstacle"))
        for x, y, text in labels if worlds.vehicles <= MOST_NAMED else ():
            axes.text(x, y, text, ha="center", va="center", fontsize=7, color="black" if y else "white")
    name_axes(every[-1], x="Position from the front of Vehicle 1, at the alert (m)")
