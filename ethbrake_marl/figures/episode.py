"""The figure of one episode: where the vehicles are, where they hit each other, and what the driven one asked for."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ethbrake_marl.envs.drawing.scene import vehicle_colour
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.conditions import quantities, quantity_line
from ethbrake_marl.evaluation.record import EpisodeRecord
from ethbrake_marl.figures.style import DASHES, GREY, add_caption, label_text, new_figure, style_axes
from ethbrake_marl.physics import Floats


def trajectories(records: Mapping[str, EpisodeRecord], *, caption: str = "") -> Figure:
    """Positions with impacts marked, gaps, and the command of the driven vehicle, over time.

    One column per record (by its title), on common scales: agents in the same world compare at a glance. Without a
    ``caption`` the conditions of the first record stand there. Raises ``InvalidInput`` without records.
    """
    if not records:
        raise InvalidInput("trajectories: no records given")
    first = next(iter(records.values()))
    figure = new_figure(max(3.4 * len(records), 6.4), 7.4)
    panels = figure.subplots(3, len(records), sharex=True, sharey="row", height_ratios=(2.2, 1.0, 1.0), squeeze=False)
    for (title, record), column in zip(records.items(), panels.T, strict=True):
        for axes, draw in zip(column, (_positions, _gaps, _command), strict=True):
            style_axes(axes)
            draw(axes, record)
        harms = (float(record.ledger.world_harm(count)[0]) for count in ("first", "total"))
        column[0].set_title(
            "{}\nharm {:.2f} first-impact, {:.2f} total".format(label_text(title), *harms), loc="left", fontsize=9.5
        )
        column[-1].set_xlabel("Time since Vehicle 1 began to brake (s)", fontsize=9)
    panels[0, 0].set_xlim(0.0, 1.1 * max(_standstill_s(record) for record in records.values()))
    panels[1, 0].set_ylim(bottom=0.0)
    panels[2, 0].yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    panels[2, 0].set_ylim(*_command_range(list(records.values())))
    labels = (
        "Position from Vehicle 1's\nat the alert (m)",
        "Gap ahead (m)",
        f"Command of\nVehicle {first.vehicle + 1} (m/s²)",
    )
    for axes, label in zip(panels[:, 0], labels, strict=True):
        axes.set_ylabel(label, fontsize=9)
    handles, names = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper left", ncols=6, frameon=False, fontsize=9)
    add_caption(figure, caption or f"{first.scenario.name}: {quantity_line(quantities(first.initial))}. {_NOTE}")
    return figure


_NOTE = "Figures at impacts: closing speed in m/s. Vehicles are drawn without length. Harm in m²/s²."


def _positions(axes: Axes, record: EpisodeRecord) -> None:
    for i in range(record.positions_m.shape[1]):
        colour, dashes = _vehicle_style(i)
        axes.plot(
            record.time_s,
            record.positions_m[:, i],
            color=colour,
            linestyle=dashes,
            linewidth=1.6,
            label=f"Vehicle {i + 1}",
        )
    if np.isfinite(record.initial.obstacle_gap_m[0]):
        axes.axhline(float(record.initial.obstacle_gap_m[0]), color="black", linewidth=2.5, label="obstacle")
    rows = record.impacts
    at = _at(record, rows.time_s, rows.pair)
    for first, fill, size, label in ((True, "black", 60.0, "first impact"), (False, "white", 26.0, "later impact")):
        chosen = rows.first == first
        axes.scatter(
            rows.time_s[chosen], at[chosen], marker="X", s=size, facecolor=fill, edgecolor="black", linewidth=0.8,
            zorder=5 if first else 4, label=label,
        )  # fmt: skip
    for k in np.flatnonzero(rows.first):
        axes.annotate(
            _speed(rows.closing_speed_mps[k]), (rows.time_s[k], at[k]), xytext=(7, -7), textcoords="offset points",
            fontsize=8.5, va="top", zorder=6,
            bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )  # fmt: skip


def _gaps(axes: Axes, record: EpisodeRecord) -> None:
    for p in range(record.gaps_m.shape[1]):
        colour, dashes = _vehicle_style(p + 1)
        axes.plot(record.time_s, record.gaps_m[:, p], color=colour, linestyle=dashes, linewidth=1.6)
    times = record.impacts.time_s[record.impacts.first]
    axes.scatter(
        times, np.zeros(len(times)), marker="X", s=60.0, facecolor="black", edgecolor="black", linewidth=0.8, zorder=5,
        clip_on=False,
    )  # fmt: skip


def _command(axes: Axes, record: EpisodeRecord) -> None:
    i = record.vehicle
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.plot(
        record.time_s, record.command_mps2[:, i], drawstyle="steps-post", color=_vehicle_style(i)[0], linewidth=1.4
    )
    latency = float(record.initial.vehicles.latency_s[0, i])
    axes.axvline(latency, color=GREY, linewidth=0.8, linestyle=":")
    axes.annotate(
        f"acts from {latency:g} s", (latency, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -1),
        textcoords="offset points", fontsize=8, color=GREY, va="top",
    )  # fmt: skip


def _command_range(records: list[EpisodeRecord]) -> tuple[float, float]:
    """From full braking to the largest command, with room for a line of text above it."""
    capacity = max(float(record.initial.vehicles.braking_capacity_mps2[0, record.vehicle]) for record in records)
    largest = max(float(record.command_mps2[:, record.vehicle].max()) for record in records)
    return -1.1 * capacity, max(largest, 0.0) + 0.4 * capacity


def _vehicle_style(i: int) -> tuple[str, str | tuple[int, tuple[int, ...]]]:
    """Colour and dashes of Vehicle ``i + 1``, and of the gap ahead of it."""
    return vehicle_colour(i), DASHES[i % len(DASHES)]


def _at(record: EpisodeRecord, time_s: Floats, pair: np.ndarray) -> Floats:
    """Position at which the front vehicle of each impact's pair was at that time; at the obstacle, Vehicle 1."""
    front = np.maximum(pair, 0)
    return np.array([np.interp(t, record.time_s, record.positions_m[:, i]) for t, i in zip(time_s, front, strict=True)])


def _speed(speed_mps: float) -> str:
    """One decimal; an impact never reads 0.0."""
    return f"{speed_mps:.1f}" if speed_mps >= 0.05 else "< 0.1"


def _standstill_s(record: EpisodeRecord) -> float:
    """First sampled time from which no vehicle moves any more, or the end."""
    moving = np.flatnonzero((record.speeds_mps != 0.0).any(axis=1))
    last = int(moving[-1]) + 1 if len(moving) else 0
    return float(record.time_s[min(last, len(record.time_s) - 1)])
