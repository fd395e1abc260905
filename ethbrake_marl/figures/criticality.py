"""Criticality map: the harm of one agent over both gaps, and the line between avoidable and unavoidable worlds."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke

from ethbrake_marl.evaluation.conditions import parameter_line, parameters
from ethbrake_marl.evaluation.criticality import CriticalityMap
from ethbrake_marl.figures.style import COLOURS, GREY, add_caption, label_text, new_figure
from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.physics import Floats

LABELLED = 0.02  # share of the cells that a region needs to have its name written in it

_TITLES: dict[HarmCount, str] = {"first": "First-impact harm", "total": "Total harm"}


def criticality_figure(found: CriticalityMap) -> Figure:
    """Both harms as colour over both gaps, on one scale; the boundary of avoidability as a line."""
    figure = new_figure(10.0, 4.9)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    largest = max(float(found.harm(harm_count).max()) for harm_count in HARM_COUNTS)
    (agent,) = found.evaluation.outcomes
    for axes, (harm_count, label) in zip(panels, _TITLES.items(), strict=True):
        mesh = _draw_harm(axes, found, found.harm(harm_count), largest)
        _draw_boundary(axes, found)
        axes.set_title(f"{label} of {label_text(agent)}", loc="left", fontsize=10)
        axes.set_xlabel("Gap 1, Vehicle 1 to Vehicle 2 (m)", fontsize=9)
    panels[0].set_ylabel("Gap 2, Vehicle 2 to Vehicle 3 (m)", fontsize=9)
    bar = figure.colorbar(mesh, ax=panels, label="Harm (m²/s²)", pad=0.015)
    bar.ax.tick_params(labelsize=9)
    line = "Line: above it some command of Vehicle 2 avoids all contact, below it none does (proven)."
    if found.boundary_gap_1_m is None:
        line = "Nothing is proven about avoidability for this line-up."
    add_caption(figure, f"{line} White: no harm. {parameter_line(parameters(found.evaluation))}.")
    return figure


def _draw_harm(axes: Axes, found: CriticalityMap, harm: Floats, largest: float) -> QuadMesh:
    """Cells coloured by harm, white where there is none."""
    axes.tick_params(labelsize=9, color=GREY)
    return axes.pcolormesh(
        found.gap_1_m, found.gap_2_m, np.where(harm > 0.0, harm, np.nan), cmap="viridis_r", vmin=0.0,
        vmax=max(largest, 1e-9), shading="nearest", rasterized=True,
    )  # fmt: skip


def _draw_boundary(axes: Axes, found: CriticalityMap) -> None:
    """The line between avoidable and unavoidable, and the names of both sides."""
    if found.avoidable is None or found.boundary_gap_1_m is None or found.boundary_gap_2_m is None:
        return
    axes.plot(
        found.boundary_gap_1_m, found.boundary_gap_2_m, color=COLOURS[1], linewidth=2.0,
        path_effects=[Stroke(linewidth=4.0, foreground="white"), Normal()],
    )  # fmt: skip
    for name, region in (("avoidable", found.avoidable), ("unavoidable", ~found.avoidable)):
        if not region.mean() > LABELLED:
            continue
        cells = np.argwhere(region)
        row, column = cells[np.argmin(((cells - cells.mean(axis=0)) ** 2).sum(axis=1))]
        axes.text(
            found.gap_1_m[column], found.gap_2_m[row], name, fontsize=10, ha="center", va="center",
            bbox={"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )  # fmt: skip
