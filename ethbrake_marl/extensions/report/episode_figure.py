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
from ethbrake_marl.extensions.report.style import DASHES, GREY, finish, in_our_style, label_text, new_panels, quantities

NOTE = "Numbers at impacts: closing speed in m/s. Vehicles are drawn without length. Harm in m²/s²."
IMPACT: dict[str, Any] = {"marker": "X", "s": 60.0, "edgecolor": "black", "linewidth": 0.8, "zorder": 5}


@in_our_style
def trajectories(records: Mapping[str, EpisodeRecord]) -> Figure:
    """Draw recorded episodes (title -> episode), one column each, all with the same scales.

    A caption states the quantities of the first world. Raises ``InvalidInput`` if there are no episodes.
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
        panels[k].set_title(text, fontsize=9.5)
        panels[-1 - k].set_xlabel("Time since Vehicle 1 began to brake (s)")
    positions, gaps, commands = panels[::columns]
    positions.set_xlim(0.0, 1.1 * max(map(_rest_s, records.values())))
    gaps.set_ylim(bottom=0.0)
    commands.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    low, high = commands.get_ylim()
    commands.set_ylim(low, high + 0.35 * (high - low))  # leaves space for texts
    positions.set_ylabel("Position from Vehicle 1's\nat the alert (m)")
    gaps.set_ylabel("Gap ahead (m)")
    numbers = ", ".join(map(str, first.vehicles))
    commands.set_ylabel(f"Command of\nVehicle{'s' * (len(first.vehicles) > 1)} {numbers} (m/s²)")
    return finish(figure, f"{first.scenario}: {quantities(first.initial)}. {NOTE}", positions)


def _rest_s(record: EpisodeRecord) -> float:
    moving = np.flatnonzero((record.speeds_mps != 0.0).any(axis=1))
    return float(record.time_s[min(moving.max(initial=0) + 1, len(record.time_s) - 1)])


def _style(body: int) -> dict[str, Any]:
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
    axes.scatter(rows.time_s[is_first], at[is_first], facecolor="black", label="first impact", **IMPACT)
    later = IMPACT | {"s": 26.0, "zorder": 4}
    axes.scatter(rows.time_s[~is_first], at[~is_first], facecolor="white", label="later impact", **later)
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
    axes.scatter(times, np.zeros(len(times)), facecolor="black", clip_on=False, **IMPACT)


def _commands(axes: Axes, record: EpisodeRecord) -> None:
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    for line, body in enumerate(record.vehicles):
        colour, latency = vehicle_colour(body), float(record.initial.latency_s[0, body - 1])
        axes.plot(record.time_s, record.command_mps2[:, body - 1], drawstyle="steps-post", color=colour, linewidth=1.4)
        axes.axvline(latency, color=colour, linewidth=0.8, linestyle=":")
        axes.annotate(
            f"acts from {latency:g} s", (latency, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -1 - 10 * line),
            textcoords="offset points", fontsize=8, color=colour, va="top",
        )  # fmt: skip
