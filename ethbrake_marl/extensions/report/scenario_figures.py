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

from ethbrake_marl.errors import count_of
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
from ethbrake_marl.first_edition.envs.rendering import BODY_M, vehicle_colour
from ethbrake_marl.first_edition.evaluation.varying import drawn_alike
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.scenario.fields import QUANTITY
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import Scenario

_ABREAST = 4  # number of distributions in a row of the figure

_MOST_APART = 4  # largest number of outlines in a distribution with a legend

_MOST_PAIRED = 5  # largest number of quantities that are drawn in pairs

_LABEL_CHARACTERS = 18  # number of characters in a line of text of a label

_MOST_NAMED = 8  # largest number of vehicles for which gaps and speeds are written

_SHOWN = {0.0: "shortest line", 0.5: "median line", 1.0: "longest line"}  # by relative rank of the sum of gaps


def write_worlds(path: Path, scenario: Any, episodes: int, *, seed: int, force: bool = False) -> None:
    """Write the picture of ``ethbrake scenario sample``, of ``episodes`` worlds of the seed, to the file ``path``.

    Raises the exceptions of ``write_picture``.
    """
    first_edition = Scenario(**scenario.declared())
    write_picture(path, worlds_figure(first_edition, first_edition.sample(episodes, seed), seed=seed), force=force)


@in_our_style
def worlds_figure(scenario: Scenario, sample: Sample, *, seed: int) -> Figure:
    """Draw distributions and scatter plots of the quantities that vary between the worlds, and three worlds to scale.

    The scatter plots prefer quantities of the first learner and of the gap ahead of it. The colour of a point shows the
    scenario of its world if ``scenario`` is a mixture, and otherwise the vehicle type of the first learner. The caption
    states ``seed``, the seed of the list of worlds.
    """
    worlds, panels = sample.worlds, drawn_alike(sample.worlds, scenario)
    focus = scenario.learners[0] if scenario.learners else 0
    kinds = sample.kinds.get("scenario", sample.kinds.get(f"vehicle_{focus + 1}_type", np.full(worlds.n, "")))
    paired, ranked = _paired(worlds, focus), np.argsort(worlds.gaps_m.sum(axis=1), kind="stable")
    shown = {int(ranked[round(rank * (worlds.n - 1))]): name for rank, name in _SHOWN.items()}
    drawings = [
        (1.6 * -(-len(panels) // _ABREAST), partial(_distributions, panels)),
        (1.35 * len(paired) - 0.95 if len(paired) > 1 else 0.0, partial(_pairs, paired, kinds)),
        (0.4 + 0.95 * len(shown), partial(_lines, sample, shown)),
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


def _paired(worlds: Worlds, focus: int) -> dict[str, Floats]:
    """Return the quantities to draw in scatter plots: label -> values [n].

    Quantities that do not vary are omitted. Of the others, at most ``_MOST_PAIRED`` are returned; those near the
    vehicle ``focus`` are chosen first.
    """
    pairs: list[tuple[int, str, Floats]] = []
    for rule in QUANTITY.of(worlds).values():
        values, own = rule.of(worlds), {"vehicle": focus, "pair": max(focus - 1, 0), "world": 0}[rule.per]
        varying = np.flatnonzero(
            np.ptp(values, axis=0) > 0.0
        )  # leaves out an obstacle that only some worlds have (infinite values)
        nearest = varying[np.argsort(np.abs(varying - own), kind="stable")].tolist()
        for i in sorted(nearest):
            owner = "" if rule.per == "world" else f"{rule.per.capitalize()} {i + 1}, "
            pairs.append((nearest.index(i), textwrap.fill(owner + rule.label, _LABEL_CHARACTERS), values[:, i]))
    chosen = np.argsort([place for place, *_ in pairs], kind="stable")[:_MOST_PAIRED]
    return {pairs[k][1]: pairs[k][2] for k in sorted(chosen)}


def _distributions(panels: Mapping[str, Mapping[str, Floats]], part: Any) -> None:
    """Draw the distribution of each quantity in its own panel.

    ``panels`` maps the key of each quantity to its histograms: name of the vehicles -> values of these vehicles, [n,
    ...]. Vehicles with the same distribution share one histogram. ``part`` is the sub-figure to draw in.
    """
    columns = min(len(panels), _ABREAST)
    every = part.subplots(-(-len(panels) // columns), columns, squeeze=False).ravel()
    for axes in every[len(panels) :]:
        axes.set_axis_off()
    for axes, (key, drawn) in zip(every, panels.items(), strict=False):
        style_axes(axes, 7)
        every_value = np.concatenate([values.ravel() for values in drawn.values()])
        for number, (owners, values) in enumerate(drawn.items()):
            style, shares = series_style(number + 2), np.full(values.size, 1.0 / values.size)
            axes.hist(
                values.ravel(), np.linspace(every_value.min(), every_value.max(), 25), weights=shares,
                histtype="step" if number else "stepfilled", color=style["color"], linestyle=style["linestyle"],
                linewidth=1.4, label=owners.replace("vehicle_", "Vehicle "),
            )  # fmt: skip
        if "" not in drawn and len(drawn) <= _MOST_APART:
            axes.legend(fontsize=6.5, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 0.98), borderpad=0.0)
        axes.locator_params(nbins=3)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        name_axes(axes, x=QUANTITY.declared[key].label)
    name_axes(every[0], y="Share of worlds")


def _pairs(paired: Mapping[str, Floats], kinds: Any, part: Any) -> None:
    """Draw a scatter plot for every two quantities; the colour of a point shows the kind of its world.

    ``paired`` maps labels to values [n]. ``kinds`` [n] are names of scenarios or vehicle types. ``part`` is the
    sub-figure to draw in.
    """
    labels, values, names = list(paired), list(paired.values()), np.unique(kinds)
    grid = part.subplots(len(paired) - 1, len(paired) - 1, squeeze=False, sharex="col", sharey="row")
    for axes in grid[np.triu_indices(len(grid), 1)]:
        axes.set_axis_off()
    for row, column in zip(*np.tril_indices(len(grid)), strict=True):
        axes = grid[row, column]
        style_axes(axes, 7)
        for number, name in enumerate(names):
            chosen, style = kinds == name, series_style(number + 2)
            axes.scatter(
                values[column][chosen], values[row + 1][chosen], s=5.0, alpha=0.5, linewidths=0.0, rasterized=True,
                marker=style["marker"], color=style["color"], label=label_text(str(name)),
            )  # fmt: skip
        axes.locator_params(nbins=3)
        name_axes(axes, x=labels[column], y=labels[row + 1])
        axes.label_outer()
    if len(names) > 1:
        part.legend(*grid[0][0].get_legend_handles_labels(), fontsize=8, frameon=False, markerscale=2.5)


def _lines(sample: Sample, shown: Mapping[int, str], part: Any) -> None:
    """Draw the vehicles of some worlds at the alert, to scale, one world below the other.

    ``shown`` maps the index of each drawn world in ``sample`` to words for its title, such as ``shortest line``.
    ``part`` is the sub-figure to draw in.
    """
    worlds, every = sample.worlds, part.subplots(len(shown), 1, squeeze=False, sharex=True).ravel()
    for axes, (row, name) in zip(every, shown.items(), strict=True):
        style_axes(axes, 7)
        axes.set(yticks=[], ylim=(-1.5, 1.0))
        axes.use_sticky_edges = False  # leaves some road ahead and behind
        axes.axhline(-0.4, color=GREY, linewidth=0.8)
        name_axes(axes, f"World {sample.index[row]}, {name}")
        gaps, ahead = worlds.gaps_m[row], worlds.obstacle_gap_m[row]
        fronts = -np.concatenate([[0.0], np.cumsum(gaps + BODY_M)])
        bodies = {"left": fronts - BODY_M, "color": [vehicle_colour(i) for i in range(worlds.N)]}
        axes.barh(np.zeros(worlds.N), BODY_M, 0.8, **bodies)
        labels = [(front + 0.5 * gap, 0.65, f"{gap:.1f}") for front, gap in zip(fronts[1:], gaps, strict=True)]
        for i, front in enumerate(fronts - 0.5 * BODY_M):
            kind = "" if sample.types is None else f"\n{label_text(str(sample.types[row, i]), 20)}"
            labels += [(front, 0.0, f"{i + 1}"), (front, -0.95, f"{worlds.speeds_mps[row, i]:.1f}{kind}")]
        if worlds.obstacle_ahead[row]:
            axes.axvline(ahead, 0.2, 1.0, color="black", linewidth=4.0)
            labels.append((0.5 * ahead, 0.65, f"{ahead:.1f} to the obstacle"))
        for x, y, text in labels if worlds.N <= _MOST_NAMED else ():
            axes.text(x, y, text, ha="center", va="center", fontsize=7, color="black" if y else "white")
    name_axes(every[-1], x="Position from the front of Vehicle 1, at the alert (m)")
