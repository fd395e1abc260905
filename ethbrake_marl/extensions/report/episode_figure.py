"""Figure of episodes: positions of the vehicles, gaps, impacts, and commands of the controlled vehicles over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.report.style import DASHES, GREY, finish, in_our_style, label_text, name_axes, new_panels
from ethbrake_marl.first_edition.envs.rendering import vehicle_colour
from ethbrake_marl.first_edition.evaluation.conditions import Conditions
from ethbrake_marl.first_edition.evaluation.record import EpisodeRecord
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS


@in_our_style
def trajectories(records: Mapping[str, EpisodeRecord], *, caption: str = "") -> Figure:
    """Draw positions with impacts, gaps, and commands of the controlled vehicles over time.

    The figure has one column for each recorded episode. All columns have the same scales. Raises ``InvalidInput`` if
    ``records`` is empty.

    Args:
        records: recorded episodes; the key of an episode is the title of its column.
        caption: text below the figure; empty: the gaps, speeds and other parameters of the first world.

    """
    if not records:
        raise InvalidInput("trajectories: there are no records; give at least one recorded episode")
    first = next(iter(records.values()))
    columns = len(records)
    figure, panels = new_panels(
        (max(3.4 * columns, 6.4), 7.4), 3, columns, sharex=True, sharey="row", height_ratios=(2.2, 1.0, 1.0)
    )
    for k, (title, record) in enumerate(records.items()):
        for axes, draw in zip(panels[k::columns], (_positions, _gaps, _command), strict=True):
            draw(axes, record)
        harms = (float(record.ledger.world_harm(count)[0]) for count in HARM_COUNTS)
        text = "{}\nharm {:.2f} first-impact, {:.2f} total".format(label_text(title), *harms)
        panels[k].set_title(text, loc="left", fontsize=9.5)
        name_axes(axes, x="Time since Vehicle 1 began to brake (s)")
    positions, gaps, commands = panels[::columns]
    moving = [np.flatnonzero((each.speeds_mps != 0.0).any(axis=1)) for each in records.values()]
    # the axis ends at the first sample after which no vehicle moves, or at the last sample
    ends = [
        float(each.time_s[min(rows[-1] + 1 if len(rows) else 0, len(each.time_s) - 1)])
        for each, rows in zip(records.values(), moving, strict=True)
    ]
    positions.set_xlim(0.0, 1.1 * max(ends))
    gaps.set_ylim(bottom=0.0)
    commands.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    motions = [(each, list(each.vehicles)) for each in records.values()]
    capacity = max(float(each.initial.vehicles.braking_capacity_mps2[0, some].max()) for each, some in motions)
    largest = max(float(each.command_mps2[:, some].max()) for each, some in motions)
    commands.set_ylim(-1.1 * capacity, max(largest, 0.0) + 0.4 * capacity)  # leaves space for a line of text
    name_axes(positions, y="Position from Vehicle 1's\nat the alert (m)")
    name_axes(gaps, y="Gap ahead (m)")
    numbers = ", ".join(str(i + 1) for i in first.vehicles)
    name_axes(commands, y=f"Command of\nVehicle{'s' * (len(first.vehicles) > 1)} {numbers} (m/s²)")
    return finish(
        figure, caption or f"{first.scenario.name}: {Conditions.of(first.initial).quantities}. {_NOTE}", positions
    )


_NOTE = "Numbers at impacts: closing speed in m/s. Vehicles are drawn without length. Harm in m²/s²."


def _positions(axes: Axes, record: EpisodeRecord) -> None:
    for i in range(record.positions_m.shape[1]):
        axes.plot(record.time_s, record.positions_m[:, i], label=f"Vehicle {i + 1}", **_vehicle_style(i))
    if np.isfinite(record.initial.obstacle_gap_m[0]):
        axes.axhline(float(record.initial.obstacle_gap_m[0]), color="black", linewidth=2.5, label="obstacle")
    rows = record.impacts
    front = np.maximum(rows.pair, 0)  # front vehicle of each impact's pair; Vehicle 1 at the obstacle
    at = np.array([
        np.interp(t, record.time_s, record.positions_m[:, i]) for t, i in zip(rows.time_s, front, strict=True)
    ])  # fmt: skip
    for first, fill, size, label in ((True, "black", 60.0, "first impact"), (False, "white", 26.0, "later impact")):
        chosen = rows.first == first
        axes.scatter(
            rows.time_s[chosen], at[chosen], marker="X", s=size, facecolor=fill, edgecolor="black", linewidth=0.8,
            zorder=5 if first else 4, label=label,
        )  # fmt: skip
    for k in np.flatnonzero(rows.first):
        speed_mps = rows.closing_speed_mps[k]
        words = f"{speed_mps:.1f}" if speed_mps >= 0.05 else "< 0.1"  # 0.0 would mean no impact
        axes.annotate(
            words, (rows.time_s[k], at[k]), xytext=(7, -7), textcoords="offset points",
            fontsize=8.5, va="top", zorder=6,
            bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )  # fmt: skip


def _gaps(axes: Axes, record: EpisodeRecord) -> None:
    for p in range(record.gaps_m.shape[1]):
        axes.plot(record.time_s, record.gaps_m[:, p], **_vehicle_style(p + 1))
    times = record.impacts.time_s[record.impacts.first]
    axes.scatter(
        times, np.zeros(len(times)), marker="X", s=60.0, facecolor="black", edgecolor="black", linewidth=0.8, zorder=5,
        clip_on=False,
    )  # fmt: skip


def _command(axes: Axes, record: EpisodeRecord) -> None:
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    alone = len(record.vehicles) == 1
    for line, i in enumerate(record.vehicles):
        colour = vehicle_colour(i)
        axes.plot(record.time_s, record.command_mps2[:, i], drawstyle="steps-post", color=colour, linewidth=1.4)
        latency = float(record.initial.vehicles.latency_s[0, i])
        axes.axvline(latency, color=GREY if alone else colour, linewidth=0.8, linestyle=":")
        axes.annotate(
            f"acts from {latency:g} s", (latency, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -1 - 10 * line),
            textcoords="offset points", fontsize=8, color=GREY if alone else colour, va="top",
        )  # fmt: skip


def _vehicle_style(i: int) -> dict[str, Any]:
    """Return the style of the curves of Vehicle ``i + 1`` and of the gap ahead of it."""
    return {"color": vehicle_colour(i), "linestyle": DASHES[i % len(DASHES)], "linewidth": 1.6}
