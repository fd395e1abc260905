"""The figures of a report: what each agent reached, how far it stayed from the best known, and how often."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import EngFormatter, FuncFormatter, MaxNLocator, PercentFormatter
from rich.table import Table

from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.envs.drawing.scene import vehicle_colour
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.curves import NO_REGION, CriticalityMap, DecelerationCurve
from ethbrake_marl.evaluation.episodes import EpisodeRecord
from ethbrake_marl.evaluation.measures import assess
from ethbrake_marl.evaluation.outcome import Evaluation, parameter_line, parameters, quantities, quantity_line
from ethbrake_marl.evaluation.shield_modes import NONE, STEP, STEP_ALERT, STEP_CAP, ModeRow, are_teams
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.evaluation.summary import SummaryRow
from ethbrake_marl.figures.style import (
    COLOURS,
    DASHES,
    GREY,
    ends_of,
    finish,
    label_text,
    name_axes,
    new_figure,
    new_panels,
    series_style,
    style_axes,
)
from ethbrake_marl.limits.limits import Limits, Unproven
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.review import OperatingPoint, RobustnessPoint

_TITLES = {"first": "First-impact harm (m²/s²)", "total": "Total harm (m²/s²)"}
_POINTS = 250  # of a curve; more cannot be told apart
_PARTS = (
    ("best known of these worlds", "#bbbbbb", ""),
    ("above it, contact unavoidable", COLOURS[2], "//"),
    ("above it, contact avoidable", COLOURS[1], ".."),
)


def harm_by_agent(rows: Sequence[SummaryRow]) -> Figure:
    """Mean harm of each agent under both counts with 95 % intervals; a line: the best known.

    Raises ``InvalidInput`` without rows.
    """
    if not rows:
        raise InvalidInput("harm_by_agent: no rows; evaluate at least one agent")
    figure, panels = new_panels((10.0, 1.2 + 0.36 * len(rows)), columns=2, sharey=True)
    for axes, count in zip(panels, HARM_COUNTS, strict=True):
        for k, row in enumerate(rows):
            estimate = row.first_impact_harm if count == "first" else row.total_harm
            axes.barh(k, estimate.value, height=0.62, color=COLOURS[2])
            ends = ends_of(estimate)
            axes.hlines(k, *ends, color=COLOURS[0], linewidth=1.6)
            axes.annotate(
                f"{estimate.value:.2f}", (ends[1], k), xytext=(5, 0), textcoords="offset points", va="center",
                fontsize=9,
            )  # fmt: skip
        best = rows[0]["best_known_first_impact_harm" if count == "first" else "best_known_total_harm"]
        if best is not None:
            axes.axvline(best.value, color=COLOURS[3], linewidth=1.6, linestyle="--", label="best known")
        name_axes(axes, x=_TITLES[count])
        axes.margins(x=0.14)
        axes.set_xlim(left=0.0)
    _name_rows(panels[0], [row.agent for row in rows])
    caption = f"Mean per world; black lines: 95 % intervals. {parameter_line(rows[0].parameters)}."
    return finish(figure, caption, panels[0], columns=1, loc="outside upper right")


def _name_rows(axes: Axes, agents: Sequence[str]) -> None:
    """One row per agent, the first on top."""
    axes.set_yticks(range(len(agents)), [label_text(agent) for agent in agents])
    axes.invert_yaxis()


def _no_powers(value: float, _: int) -> str:
    """A tick as it is read."""
    return f"{value:g}"


def regret_distribution(evaluation: Evaluation) -> Figure:
    """Share of the worlds in which an agent's harm is above the best known by more than x, under both counts.

    Where nothing is known to be the best, the same of the harm itself.
    """
    regrets = assess(evaluation)
    figure, panels = new_panels((10.0, 3.8), columns=2, sharey=True)
    for axes, count in zip(panels, HARM_COUNTS, strict=True):
        for number, (agent, outcome) in enumerate(evaluation.outcomes.items()):
            values = outcome.ledger.world_harm(count) if regrets is None else regrets.regret(outcome, count)
            style = {**series_style(number), "markevery": 40}
            axes.plot(*_exceeded(values), label=label_text(agent), **style)
        axes.set_xscale("symlog", linthresh=1.0, linscale=0.4)
        axes.xaxis.set_major_formatter(FuncFormatter(_no_powers))
        axes.set_xlim(left=0.0)
        axes.set_ylim(0.0, 1.0)
        what = "Harm" if regrets is None else "Regret"
        name_axes(axes, x=f"{what}, {_TITLES[count][0].lower()}{_TITLES[count][1:]}")
    name_axes(panels[0], y="Worlds with more than that")
    panels[0].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    caption = f"Linear up to 1 m²/s², logarithmic beyond. {parameter_line(parameters(evaluation))}."
    return finish(figure, caption, panels[0], columns=5)


def harm_in_parts(evaluation: Evaluation) -> Figure:
    """Mean harm of each agent as what nobody is known to avoid, and what it did beyond that, under both counts.

    Raises ``InvalidInput`` where nothing is proven of the worlds.
    """
    regrets = assess(evaluation)
    if regrets is None:
        raise InvalidInput("harm_in_parts: nothing is proven of these worlds, so no part can be told from another")
    avoidable = regrets.limits.proof.avoidable
    if avoidable is None:
        raise InvalidInput("harm_in_parts: where contact can be avoided is not decided for these vehicles")
    figure, panels = new_panels((10.0, 1.4 + 0.36 * len(evaluation.outcomes)), columns=2, sharey=True)
    for axes, count in zip(panels, HARM_COUNTS, strict=True):
        for k, outcome in enumerate(evaluation.outcomes.values()):
            regret, left = regrets.regret(outcome, count), 0.0
            parts = (regrets.best(count).mean(), (regret * ~avoidable).mean(), (regret * avoidable).mean())
            for part, (label, colour, hatch) in zip(map(float, parts), _PARTS, strict=True):
                axes.barh(
                    k, part, left=left, height=0.62, color=colour, hatch=hatch, edgecolor="#ffffff", linewidth=0.5,
                    label=label if k == 0 else None,
                )  # fmt: skip
                left += part
        name_axes(axes, x=_TITLES[count])
    _name_rows(panels[0], list(evaluation.outcomes))
    return finish(figure, f"Mean per world. {parameter_line(parameters(evaluation))}.", panels[0], columns=5)


def _exceeded(values: Floats) -> tuple[Floats, Floats]:
    """Thresholds, and the share of the values above each: the values themselves, or so many of them."""
    ordered = np.sort(values)
    chosen = np.unique(np.linspace(0, len(ordered) - 1, min(_POINTS, len(ordered))).astype(np.int64))
    share = np.array([float((ordered > value).mean()) for value in ordered[chosen]])
    return np.concatenate([[0.0], ordered[chosen]]), np.concatenate([[float((ordered > 0.0).mean())], share])


# The figure of one episode: where the vehicles are, where they hit each other, and what the driven one asked for.


def trajectories(records: Mapping[str, EpisodeRecord], *, caption: str = "") -> Figure:
    """Positions with impacts marked, gaps, and the command of the driven vehicle, over time.

    One column per record (by its title), on common scales: agents in the same world compare at a glance. Without a
    ``caption`` the conditions of the first record stand there. Raises ``InvalidInput`` without records.
    """
    if not records:
        raise InvalidInput("trajectories: no records given")
    first = next(iter(records.values()))
    columns = len(records)
    figure, panels = new_panels(
        (max(3.4 * columns, 6.4), 7.4), 3, columns, sharex=True, sharey="row", height_ratios=(2.2, 1.0, 1.0)
    )
    for k, (title, record) in enumerate(records.items()):
        for axes, draw in zip(panels[k::columns], (_positions, _gaps, _command), strict=True):
            draw(axes, record)
        harms = (float(record.ledger.world_harm(count)[0]) for count in HARM_COUNTS)
        told = "{}\nharm {:.2f} first-impact, {:.2f} total".format(label_text(title), *harms)
        panels[k].set_title(told, loc="left", fontsize=9.5)
        name_axes(axes, x="Time since Vehicle 1 began to brake (s)")
    positions, gaps, commands = panels[::columns]
    positions.set_xlim(0.0, 1.1 * max(_standstill_s(record) for record in records.values()))
    gaps.set_ylim(bottom=0.0)
    commands.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    commands.set_ylim(*_command_range(list(records.values())))
    name_axes(positions, y="Position from Vehicle 1's\nat the alert (m)")
    name_axes(gaps, y="Gap ahead (m)")
    name_axes(commands, y=f"Command of\nVehicle {first.vehicle + 1} (m/s²)")
    return finish(
        figure, caption or f"{first.scenario.name}: {quantity_line(quantities(first.initial))}. {_NOTE}", positions
    )


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
    front = np.maximum(rows.pair, 0)  # of each impact's pair; at the obstacle, Vehicle 1
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
        words = f"{speed_mps:.1f}" if speed_mps >= 0.05 else "< 0.1"  # an impact never reads 0.0
        axes.annotate(
            words, (rows.time_s[k], at[k]), xytext=(7, -7), textcoords="offset points",
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


def _standstill_s(record: EpisodeRecord) -> float:
    """First sampled time from which no vehicle moves any more, or the end."""
    moving = np.flatnonzero((record.speeds_mps != 0.0).any(axis=1))
    last = int(moving[-1]) + 1 if len(moving) else 0
    return float(record.time_s[min(last, len(record.time_s) - 1)])


# The figures of a run. This module loads matplotlib; nothing that `import ethbrake_marl` touches imports it.

_PANELS = (
    ("first_impact_harm", "First-impact harm (m²/s²)"),
    ("total_harm", "Total harm (m²/s²)"),
    ("collision_rate", "Worlds with a collision"),
)
_POLICY_NUMBER = 3  # the series whose colour is the learning policy's
_POLICY = COLOURS[_POLICY_NUMBER]


def learning_curve(
    points: Sequence[Mapping[str, float]], *, references: Sequence[SummaryRow] = (), caption: str = ""
) -> Figure:
    """Both harms and the collision rate of the policy on its fixed list, while it learns.

    Each point has ``steps``, ``first_impact_harm``, ``total_harm`` and ``collision_rate``; ``references`` are drawn as
    level lines. Raises ``InvalidInput`` without points.
    """
    if not points:
        raise InvalidInput("learning_curve: no points; evaluate the policy at least once during training")
    figure, panels = new_panels((10.0, 3.9), columns=3)
    steps = [point["steps"] for point in points]
    for axes, (name, label) in zip(panels, _PANELS, strict=True):
        axes.plot(steps, [point[name] for point in points], color=_POLICY, marker="o", markersize=3.5, label="policy")
        for number, row in enumerate(references):
            style = series_style(number if number < _POLICY_NUMBER else number + 1)
            axes.axhline(
                getattr(row, name).value, color=style["color"], linestyle=style["linestyle"], linewidth=1.2,
                label=label_text(row.agent),
            )  # fmt: skip
        name_axes(axes, label, "Training steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_ylim(bottom=0.0)
    panels[2].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    return finish(figure, caption, panels[0])


def harm_against_total_gap(evaluation: Evaluation, *, agents: Sequence[str] | None = None, bins: int = 12) -> Figure:
    """Mean of both harms against the sum of the gaps at the alert, one line per agent, bands: 95 % intervals.

    Worlds are grouped into ``bins`` equal parts of the range. Raises ``InvalidInput`` for an unknown agent or
    ``bins < 1``.
    """
    if not bins >= 1:
        raise InvalidInput(f"harm_against_total_gap: bins = {bins}; at least 1 is needed")
    gap = evaluation.worlds.gaps_m.sum(axis=1)
    groups, gaps = _groups(gap, bins), [f"d{p}" for p in range(1, evaluation.worlds.N)]
    sum_of_gaps = " + ".join(gaps) if len(gaps) <= 3 else f"d1 + … + {gaps[-1]}"
    figure, panels = new_panels((10.0, 4.6), columns=2, sharey=True)
    for axes, (name, label) in zip(panels, _PANELS[:2], strict=True):
        for number, agent in enumerate(evaluation.outcomes if agents is None else agents):
            harm = getattr(evaluation.outcome(agent), name)
            _band(axes, gap, harm, groups, series_style(number), label_text(agent))
        name_axes(axes, label, f"Total gap at the alert, {sum_of_gaps} (m)")
        axes.set_ylim(bottom=0.0)
    caption = f"Mean per group of worlds; bands: 95 % intervals. {parameter_line(parameters(evaluation))}."
    return finish(figure, caption, panels[0])


def _band(axes: Axes, gap: Floats, harm: Floats, groups: list[Bools], style: dict[str, Any], agent: str) -> None:
    """One agent's mean harm per group, with its intervals where the group has at least two worlds."""
    estimates = [mean(harm[group]) for group in groups]
    at = [float(gap[group].mean()) for group in groups]
    axes.plot(at, [e.value for e in estimates], label=agent, **style)
    ends = np.array([ends_of(estimate) for estimate in estimates])
    if len(groups) > 1:
        axes.fill_between(at, ends[:, 0], ends[:, 1], color=str(style["color"]), alpha=0.18, linewidth=0.0)
    else:
        axes.vlines(at, ends[:, 0], ends[:, 1], color=str(style["color"]), linewidth=1.2)


def _groups(values: Floats, bins: int) -> list[Bools]:
    """Masks of the worlds in each of ``bins`` equal parts of the range that has any."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return [np.ones(len(values), np.bool_)]
    part = np.minimum(((values - low) / (high - low) * bins).astype(np.int64), bins - 1)
    return [part == k for k in range(bins) if (part == k).any()]


# Criticality map: the harm of one agent over both gaps, and the line between avoidable and unavoidable worlds.

LABELLED_SHARE = 0.02  # share of the cells that a region needs to have its name written in it

_HARMS: dict[HarmCount, str] = {"first": "First-impact harm", "total": "Total harm"}


def criticality_figure(found: CriticalityMap) -> Figure:
    """Both harms as colour over both gaps, on one scale; the boundary of avoidability as a line."""
    figure = new_figure(10.0, 4.9)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    largest = max(float(found.harm(harm_count).max()) for harm_count in HARM_COUNTS)
    (agent,) = found.evaluation.outcomes
    for axes, (harm_count, label) in zip(panels, _HARMS.items(), strict=True):
        harm = found.harm(harm_count)
        mesh = axes.pcolormesh(  # white where there is no harm
            found.gap_1_m, found.gap_2_m, np.where(harm > 0.0, harm, np.nan), cmap="viridis_r", vmin=0.0,
            vmax=max(largest, 1e-9), shading="nearest", rasterized=True,
        )  # fmt: skip
        _draw_boundary(axes, found)
        axes.tick_params(labelsize=9, color=GREY)
        name_axes(axes, f"{label} of {label_text(agent)}", "Gap 1, Vehicle 1 to Vehicle 2 (m)")
    name_axes(panels[0], y="Gap 2, Vehicle 2 to Vehicle 3 (m)")
    bar = figure.colorbar(mesh, ax=panels, label="Harm (m²/s²)", pad=0.015)
    bar.ax.tick_params(labelsize=9)
    line = "Line: above it some command of Vehicle 2 avoids all contact, below it none does (proven)."
    if found.boundary_gap_1_m is None:
        line = "Nothing is proven about avoidability for this line-up."
    return finish(figure, f"{line} White: no harm. {parameter_line(parameters(found.evaluation))}.")


def _draw_boundary(axes: Axes, found: CriticalityMap) -> None:
    """The line between avoidable and unavoidable, and the names of both sides."""
    if found.avoidable is None or found.boundary_gap_1_m is None or found.boundary_gap_2_m is None:
        return
    axes.plot(
        found.boundary_gap_1_m, found.boundary_gap_2_m, color=COLOURS[1], linewidth=2.0,
        path_effects=[Stroke(linewidth=4.0, foreground="white"), Normal()],
    )  # fmt: skip
    for name, region in (("avoidable", found.avoidable), ("unavoidable", ~found.avoidable)):
        if not region.mean() > LABELLED_SHARE:
            continue
        cells = np.argwhere(region)
        row, column = cells[np.argmin(((cells - cells.mean(axis=0)) ** 2).sum(axis=1))]
        axes.text(
            found.gap_1_m[column], found.gap_2_m[row], name, fontsize=10, ha="center", va="center",
            bbox={"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )  # fmt: skip


# Harm against the constant deceleration of one vehicle in one world: predicted, realised, and the best known.

_PREDICTED = COLOURS[2]
_COUNTS: tuple[tuple[HarmCount, str, str, str], ...] = (
    ("first", "first-impact harm", COLOURS[1], "-"),
    ("total", "total harm", COLOURS[0], "--"),
)
_REGIMES = {  # name of how a pair first meets: its colour and meaning
    "early": ("#d7c2e8", "before the front vehicle brakes"),
    "A": ("#8f8f8f", "A: rear vehicle still coasts"),
    "A'": ("#5f5f5f", "A': rear vehicle coasts, front one stands"),
    "B": ("#9fd3ee", "B: both brake"),
    "C": ("#f3c98b", "C: front vehicle stands"),
}


def deceleration_figure(curve: DecelerationCurve, *, title: str = "") -> Figure:
    """Predicted and realised harm of one world over the constant deceleration of one vehicle.

    Above: the three curves, the decelerations that E-V2X-BM takes (closed form and coupled, both counts), and as level
    lines the best known harm of any profile, where it is known. Below: how each pair alone first meets.
    """
    scenario, vehicle = curve.task.scenario, curve.task.vehicle
    figure = new_figure(8.0, 5.4)
    axes, strips = figure.subplots(2, 1, sharex=True, height_ratios=(5.0, 0.45 * len(curve.regimes)))
    style_axes(axes)
    _draw_curves(axes, curve)
    _mark_chosen(axes, curve)
    _mark_best_known(axes, curve.limits)
    axes.set_xlim(0.0, float(curve.deceleration_mps2[-1]))
    name_axes(axes, title or f"{scenario.name}: one world", y="Harm (m²/s²)")
    _draw_regimes(strips, curve)
    name_axes(strips, x=f"Constant deceleration of Vehicle {vehicle + 1} (m/s²)")
    conditions = (
        f"{quantity_line(quantities(curve.world))}. Harm until {scenario.horizon_s:g} s."
        " Predicted: each pair alone, all others braking fully."
        " Realised: in the simulation, with velocity exchange and every later impact;"
        f" other vehicles: {_scripts(scenario, vehicle)}. Dotted: where the way changes in which a pair first meets."
    )
    return finish(figure, conditions, axes, columns=2, fontsize=8.5)


def _scripts(scenario: Scenario, vehicle: int) -> str:
    """What the others do, each script once."""
    scripts = [scenario.scripts.get(i, "full_brake") for i in range(scenario.vehicles) if i != vehicle]
    if len(set(scripts)) == 1:
        return scripts[0]
    others = [f"Vehicle {i + 1}" for i in range(scenario.vehicles) if i != vehicle]
    return ", ".join(f"{name} {script}" for name, script in zip(others, scripts, strict=True))


def _draw_curves(axes: Axes, curve: DecelerationCurve) -> None:
    """The three harms, and dotted lines where the way in which a pair first meets changes."""
    at = curve.deceleration_mps2
    axes.plot(
        at, curve.predicted, color=_PREDICTED, linestyle="-.", linewidth=1.4, zorder=4, label="predicted (pairwise)"
    )
    for harm_count, name, colour, dashes in _COUNTS:
        axes.plot(at, curve.harm(harm_count), color=colour, linestyle=dashes, linewidth=1.5, label=f"realised {name}")
    for names in curve.regimes.values():
        for k in np.flatnonzero(names[1:] != names[:-1]):
            axes.axvline(float(at[k + 1]), color=GREY, linewidth=0.6, linestyle=(0, (1, 3)))
    largest = max(float(harm.max()) for harm in (curve.predicted, curve.first_impact_harm, curve.total_harm))
    axes.set_ylim(-0.02 * largest, 1.05 * largest + 1e-3)


def _mark_chosen(axes: Axes, curve: DecelerationCurve) -> None:
    """The decelerations that E-V2X-BM takes: by the closed form, and coupled under either count."""
    chosen, predicted = curve.closed_form.deceleration_mps2, curve.closed_form.harm
    realised = float(curve.first_impact_harm[np.searchsorted(curve.deceleration_mps2, chosen)])
    axes.vlines(chosen, predicted, realised, color=_PREDICTED, linewidth=1.0, linestyle=":")
    axes.plot(
        [chosen], [predicted], color=_PREDICTED, marker="D", markersize=6, linestyle="none", clip_on=False, zorder=6,
        label=f"a* = {chosen:.3f} m/s², closed form: predicts {predicted:.2f}, realises {realised:.2f}",
    )  # fmt: skip
    for (harm_count, name, colour, _), marker, size in zip(_COUNTS, ("o", "s"), (6, 10), strict=True):
        best = curve.coupled[harm_count]
        axes.plot(
            [best.deceleration_mps2], [best.harm], color=colour, marker=marker, markersize=size, markerfacecolor="none",
            linestyle="none", markeredgewidth=1.4, clip_on=False, zorder=5,
            label=f"a* = {best.deceleration_mps2:.3f} m/s², coupled, least {name}: {best.harm:.2f}",
        )  # fmt: skip


def _mark_best_known(axes: Axes, limits: Limits | Unproven) -> None:
    """Level lines at the least harm known of any profile, over all time-varying commands."""
    if isinstance(limits, Unproven) or not limits.known[0]:
        return
    first, total = float(limits.first_impact_harm[0]), float(limits.total_harm[0])
    for (_, _, colour, dashes), harm in zip(_COUNTS, (first, total), strict=True):
        axes.axhline(harm, color=colour, linewidth=0.9, linestyle=dashes, alpha=0.7)
    proof = limits.proof
    least = "" if proof.harm is None else f"; proven: no less than {proof.harm[0]:.2f}"
    told = " (avoidable)" if proof.avoidable is not None and proof.avoidable[0] else least
    axes.annotate(
        f"best known profile: {first:.2f} first-impact, {total:.2f} total{told}", (0.0, max(first, total)),
        xytext=(6, 3), textcoords="offset points", fontsize=8.5, color=GREY,
    )  # fmt: skip


def _draw_regimes(axes: Axes, curve: DecelerationCurve) -> None:
    """One strip per pair, coloured by how it first meets; thin lines where that changes."""
    at, present = curve.deceleration_mps2, []
    for row, names in enumerate(curve.regimes.values()):
        edges = [0, *(np.flatnonzero(names[1:] != names[:-1]) + 1), len(names)]
        for start, stop in pairwise(edges):
            name, left, right = str(names[start]), at[start], at[min(stop, len(at) - 1)]
            if name != NO_REGION:
                colour = _REGIMES[name][0]
                axes.barh(-row, right - left, left=left, height=0.8, color=colour, edgecolor=GREY, linewidth=0.6)
                present.append(name)
    axes.set_yticks([-row for row in range(len(curve.regimes))], list(curve.regimes))
    axes.set_ylim(0.5 - len(curve.regimes), 0.5)
    axes.tick_params(labelsize=9, color=GREY)
    axes.spines[["top", "right"]].set_visible(False)
    handles = [Patch(facecolor=c, edgecolor=GREY, label=m) for r, (c, m) in _REGIMES.items() if r in present]
    handles.append(Patch(facecolor="white", edgecolor=GREY, label="no contact"))
    axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.0, -0.75), ncols=4, frameon=False, fontsize=8)


# The price of the step shield: how often it intervenes against the harm that remains.

LABELLED = 0.01  # points with fewer interventions lie on top of each other: they get no label


def operating_figure(curves: Sequence[tuple[str, Sequence[OperatingPoint]]], *, caption: str = "") -> Figure:
    """One curve per policy, from the strict shield (allowance 0) to none; points off the axis say their allowance.

    Raises ``InvalidInput`` without a point.
    """
    if not curves or not all(points for _, points in curves):
        raise InvalidInput("operating_figure: every curve needs at least one point")
    figure, (axes,) = new_panels((6.4, 4.2))
    for number, (name, points) in enumerate(curves):
        rates, harms = [p.intervention_rate for p in points], [p.harm for p in points]
        axes.plot(rates, harms, label=label_text(name), **series_style(number))
        for point in (p for p in points if p.intervention_rate >= LABELLED):
            axes.annotate(
                f"{point.allowance:g}", (point.intervention_rate, point.harm), fontsize=7.5, xytext=(4, 4),
                textcoords="offset points",
            )  # fmt: skip
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    name_axes(axes, x="Decisions in which the shield intervenes", y="Mean harm (m²/s²)")
    axes.legend(fontsize=9, frameon=False)
    return finish(figure, caption)


_MISMATCH = (("step", "corner"), ("step", "inside"), ("robust", "corner"), ("robust", "inside"))
_PRICE = (("step", "harm", 0), ("robust", "harm", 3), ("robust", "bound", 2))  # with the number of the style
_COLUMNS = ("shield", "truth", "width", "mean harm", "mean bound", "above bound", "mean excess", "noticed")


def robustness_figure(points: Sequence[RobustnessPoint], *, caption: str = "") -> Figure:
    """Left the price where the world is as told; then, where it is not, how often and how far the bound is broken.

    Raises ``InvalidInput`` without a point.
    """
    if not points:
        raise InvalidInput("robustness_figure: at least one point is needed")
    figure, (price, above, excess) = new_panels((11.0, 4.0), columns=3)
    for mode, what, number in _PRICE:
        label = f"{mode}: {'harm' if what == 'harm' else 'bound at the alert'}"
        _curve(price, points, mode, "as told", what, number, label)
    for number, (mode, truth) in enumerate(_MISMATCH):
        label = f"{mode}, {'a corner' if truth == 'corner' else 'inside'}"
        _curve(above, points, mode, truth, "above", number, label)
        _curve(excess, points, mode, truth, "excess", number, label)
    above.yaxis.set_major_formatter(PercentFormatter(1.0))
    titles = ("The world is as told", "The truth differs: above the bound", "The truth differs: excess")
    units = ("Mean over worlds (m²/s²)", "Worlds above the bound at the alert", "Mean excess (m²/s²)")
    for axes, title, unit in zip((price, above, excess), titles, units, strict=True):
        axes.set_title(title, fontsize=9.5, loc="left")
        name_axes(axes, x="Width of the intervals (1: as given)", y=unit)
        axes.set_ylim(bottom=0.0)
        axes.legend(fontsize=8, frameon=False)
    return finish(figure, caption)


def robustness_table(points: Sequence[RobustnessPoint]) -> Table:
    """One row per point."""
    table = Table(*_COLUMNS)
    for p in points:
        table.add_row(
            p.mode, p.truth, f"{p.width:g}", f"{p.harm:.2f}", f"{p.bound:.2f}", f"{p.above:.1%}", f"{p.excess:.3f}",
            f"{p.distrusted:.1%}",
        )  # fmt: skip
    return table


def _curve(
    axes: Axes, points: Sequence[RobustnessPoint], mode: str, truth: str, what: str, number: int, label: str
) -> None:
    chosen = [p for p in points if (p.mode, p.truth) == (mode, truth)]
    values = [float(getattr(p, what)) for p in chosen]
    axes.plot([p.width for p in chosen], values, label=label, **series_style(number))


_OFFSETS = {NONE: -0.2, STEP: 0.0, STEP_ALERT: 0.2, STEP_CAP: 0.35}
_LABELS = {
    NONE: "no shield",
    STEP: "step mode",
    STEP_ALERT: "step mode, rollout at the alert only",
    STEP_CAP: "step mode with caps",
}


def shield_modes_figure(rows: Sequence[ModeRow], *, caption: str = "") -> Figure:
    """Per agent the paired difference to episode mode with its 95 % interval, one mark per mode; left is less harm.

    Of teams, for which there is no episode mode, the difference to no shield. Raises ``InvalidInput`` without a row.
    """
    if not rows:
        raise InvalidInput("shield_modes_figure: at least one agent is needed")
    agents = list(dict.fromkeys(row.agent for row in rows))
    figure, (axes,) = new_panels((7.2, 1.4 + 0.55 * len(agents)))
    for number, mode in enumerate(_OFFSETS):
        for row in (row for row in rows if row.mode == mode):
            against = row.against_none if are_teams(rows) else row.against_episode
            if against is None:
                continue
            value, (low, high) = against.value, ends_of(against)
            style = {**series_style(number), "linestyle": "none"}
            place = agents.index(row.agent)
            axes.errorbar(
                [value], [place + _OFFSETS[mode]], xerr=[[value - low], [high - value]], capsize=2.5,
                label=_LABELS[mode] if place == 0 else None, **style,
            )  # fmt: skip
    axes.axvline(0.0, color=GREY, linewidth=1.0)
    axes.set_xscale("symlog", linthresh=1.0)
    axes.xaxis.set_major_formatter(FuncFormatter(_no_powers))
    axes.set_yticks(range(len(agents)), agents, fontsize=9)
    axes.invert_yaxis()
    other = "without a shield" if are_teams(rows) else "of episode mode"
    name_axes(axes, x=f"Harm minus that {other} (m²/s² per world; linear within ±1)")
    axes.legend(fontsize=8.5, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    return finish(figure, caption)
