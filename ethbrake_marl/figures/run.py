"""The figures of a run. This module loads matplotlib; nothing that `import ethbrake_marl` touches imports it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.conditions import parameter_line, parameters
from ethbrake_marl.evaluation.outcome import Evaluation
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.evaluation.table import SummaryRow
from ethbrake_marl.figures.style import (
    COLOURS,
    add_caption,
    label_text,
    new_figure,
    series_style,
    style_axes,
)
from ethbrake_marl.physics import Bools, Floats

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
    figure = new_figure(10.0, 3.9)
    steps = [point["steps"] for point in points]
    panels = figure.subplots(1, 3)
    for axes, (name, label) in zip(panels, _PANELS, strict=True):
        style_axes(axes)
        axes.plot(steps, [point[name] for point in points], color=_POLICY, marker="o", markersize=3.5, label="policy")
        for number, row in enumerate(references):
            style = series_style(number if number < _POLICY_NUMBER else number + 1)
            axes.axhline(
                getattr(row, name).value, color=style["color"], linestyle=style["linestyle"], linewidth=1.2,
                label=label_text(row.agent),
            )  # fmt: skip
        axes.set_title(label, loc="left", fontsize=10)
        axes.set_xlabel("Training steps", fontsize=9)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_ylim(bottom=0.0)
    panels[2].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    _legend(figure, panels[0])
    add_caption(figure, caption)
    return figure


def harm_against_total_gap(evaluation: Evaluation, *, agents: Sequence[str] | None = None, bins: int = 12) -> Figure:
    """Mean of both harms against the sum of the gaps at the alert, one line per agent, bands: 95 % intervals.

    Worlds are grouped into ``bins`` equal parts of the range. Raises ``InvalidInput`` for an unknown agent or
    ``bins < 1``.
    """
    if not bins >= 1:
        raise InvalidInput(f"harm_against_total_gap: bins = {bins}; at least 1 is needed")
    gap = evaluation.worlds.gaps_m.sum(axis=1)
    groups = _groups(gap, bins)
    figure = new_figure(10.0, 4.6)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (name, label) in zip(panels, _PANELS[:2], strict=True):
        style_axes(axes)
        for number, agent in enumerate(evaluation.outcomes if agents is None else agents):
            harm = getattr(evaluation.outcome(agent), name)
            _band(axes, gap, harm, groups, series_style(number), label_text(agent))
        axes.set_title(label, loc="left", fontsize=10)
        axes.set_xlabel(f"Total gap at the alert, {_gap_sum(evaluation.worlds.N)} (m)", fontsize=9)
        axes.set_ylim(bottom=0.0)
    _legend(figure, panels[0])
    add_caption(figure, f"Mean per group of worlds; bands: 95 % intervals. {parameter_line(parameters(evaluation))}.")
    return figure


def _band(axes: Axes, gap: Floats, harm: Floats, groups: list[Bools], style: dict[str, object], agent: str) -> None:
    """One agent's mean harm per group, with its intervals where the group has at least two worlds."""
    estimates = [mean(harm[group]) for group in groups]
    at = [float(gap[group].mean()) for group in groups]
    axes.plot(at, [e.value for e in estimates], label=agent, **style)  # type: ignore[arg-type]
    ends = np.array([(e.value, e.value) if e.interval is None else e.interval for e in estimates])
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


def _gap_sum(vehicles: int) -> str:
    gaps = [f"d{p}" for p in range(1, vehicles)]
    return " + ".join(gaps) if len(gaps) <= 3 else f"d1 + … + {gaps[-1]}"


def _legend(figure: Figure, axes: Axes) -> None:
    """One legend for all panels, above them."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=min(len(labels), 6), frameon=False, fontsize=9)
