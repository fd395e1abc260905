"""Figure of recorded episodes: positions with impacts, gaps, and commands over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.record import EpisodeRecord
from ethbrake_marl.extensions.rendering.picture import vehicle_colour
from ethbrake_marl.extensions.report.style import (
    DASHES,
    GREY,
    finish,
    in_our_style,
    label_text,
    name_axes,
    new_panels,
    quantities,
)

NOTE = "Numbers at impacts: closing speed in m/s. Vehicles are drawn without length. Harm in m²/s²."


@in_our_style
def trajectories(records: Mapping[str, EpisodeRecord], *, caption: str = "") -> Figure:
    """Draw recorded episodes, one column each, all with the same scales.

    Raises ``InvalidInput`` if there are none.

    Args:
        records: title of a column -> episode.
        caption: text below; by default the quantities of the first world.

    """
    if not records:
        raise InvalidInput("trajectories: there are no records; give at least one recorded episode")
    first, columns = next(iter(records.values())), len(records)
    figure, panels = new_panels(
        (max(3.4 * columns, 6.4), 7.4), 3, columns, sharex=True, sharey="row", height_ratios=(2.2, 1.0, 1.0)
    )
    for k, (title, record) in enumerate(records.items()):
        for axes, draw in zip(panels[k::columns], (_positions, _gaps, _commands), strict=True):
            draw(axes, record)
        harms = (float(record.last.harm(count)[0]) for count in ("first", "total"))
        text = "{}\nharm {:.2f} first-impact, {:.2f} total".format(label_text(title), *harms)
        panels[k].set_title(text, loc="left", fontsize=9.5)
        name_axes(axes, x="Time since Vehicle 1 began to brake (s)")
    positions, gaps, commands = panels[::columns]
    positions.set_xlim(0.0, 1.1 * max(map(_rest_s, records.values())))
    gaps.set_ylim(bottom=0.0)
    commands.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    driven = [(each, [body - 1 for body in each.vehicles]) for each in records.values()]
    capacity = max(float(each.initial.braking_capacity_mps2[0, some].max()) for each, some in driven)
    largest = max(float(each.command_mps2[:, some].max()) for each, some in driven)
    commands.set_ylim(-1.1 * capacity, max(largest, 0.0) + 0.4 * capacity)  # leaves space for a line of text
    name_axes(positions, y="Position from Vehicle 1's\nat the alert (m)")
    name_axes(gaps, y="Gap ahead (m)")
    numbers = ", ".join(map(str, first.vehicles))
    name_axes(commands, y=f"Command of\nVehicle{'s' * (len(first.vehicles) > 1)} {numbers} (m/s²)")
    return finish(figure, caption or f"{first.scenario}: {quantities(first.initial)}. {NOTE}", positions)


def _rest_s(record: EpisodeRecord) -> float:
    """Return the first sample after which no vehicle moves, or the last one (s)."""
    moving = np.flatnonzero((record.speeds_mps != 0.0).any(axis=1))
    return float(record.time_s[min(moving[-1] + 1 if len(moving) else 0, len(record.time_s) - 1)])


def _style(body: int) -> dict[str, Any]:
    """Return the style of the curves of a vehicle (1: Vehicle 1) and of the gap ahead of it."""
    return {"color": vehicle_colour(body), "linestyle": DASHES[(body - 1) % len(DASHES)], "linewidth": 1.6}


def _positions(axes: Axes, record: EpisodeRecord) -> None:
    for i, places in enumerate(record.positions_m.T):
        axes.plot(record.time_s, places, label=f"Vehicle {i + 1}", **_style(i + 1))
    obstacle = float(record.initial.obstacle_gap_m[0])
    if np.isfinite(obstacle):
        axes.axhline(obstacle, color="black", linewidth=2.5, label="obstacle")
    rows, is_first = record.impacts, record.impacts.first_impact_harm > 0.0
    front = np.maximum(rows.pair - 1, 0)  # front vehicle of each impact, from 0; Vehicle 1 at the obstacle
    at = np.array([
        np.interp(t, record.time_s, record.positions_m[:, i]) for t, i in zip(rows.time_s, front, strict=True)
    ])  # fmt: skip
    for chosen, fill, size, label in ((is_first, "black", 60.0, "first"), (~is_first, "white", 26.0, "later")):
        axes.scatter(
            rows.time_s[chosen], at[chosen], marker="X", s=size, facecolor=fill, edgecolor="black", linewidth=0.8,
            zorder=5 if label == "first" else 4, label=f"{label} impact",
        )  # fmt: skip
    for k in np.flatnonzero(is_first):
        speed_mps = rows.closing_speed_mps[k]
        axes.annotate(
            f"{speed_mps:.1f}" if speed_mps >= 0.05 else "< 0.1",  # 0.0 would mean no impact
            (rows.time_s[k], at[k]), xytext=(7, -7), textcoords="offset points", fontsize=8.5, va="top", zorder=6,
            bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )  # fmt: skip


def _gaps(axes: Axes, record: EpisodeRecord) -> None:
    for p, gaps in enumerate(record.gaps_m.T):
        axes.plot(record.time_s, gaps, **_style(p + 2))
    times = record.impacts.time_s[record.impacts.first_impact_harm > 0.0]
    style: dict[str, Any] = {
        "marker": "X",
        "s": 60.0,
        "facecolor": "black",
        "edgecolor": "black",
        "linewidth": 0.8,
        "zorder": 5,
    }
    axes.scatter(times, np.zeros(len(times)), clip_on=False, **style)


def _commands(axes: Axes, record: EpisodeRecord) -> None:
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    for line, body in enumerate(record.vehicles):
        colour = vehicle_colour(body)
        axes.plot(record.time_s, record.command_mps2[:, body - 1], drawstyle="steps-post", color=colour, linewidth=1.4)
        latency, mark = float(record.initial.latency_s[0, body - 1]), GREY if len(record.vehicles) == 1 else colour
        axes.axvline(latency, color=mark, linewidth=0.8, linestyle=":")
        axes.annotate(
            f"acts from {latency:g} s", (latency, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -1 - 10 * line),
            textcoords="offset points", fontsize=8, color=mark, va="top",
        )  # fmt: skip
