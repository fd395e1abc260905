"""The figures of a report: what each agent reached, how far it stayed from the best known, and how often."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, PercentFormatter

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.conditions import parameter_line, parameters
from ethbrake_marl.evaluation.outcome import Evaluation
from ethbrake_marl.evaluation.regret import assess
from ethbrake_marl.evaluation.table import SummaryRow
from ethbrake_marl.figures.style import COLOURS, add_caption, label_text, new_figure, series_style, style_axes
from ethbrake_marl.harm import HARM_COUNTS
from ethbrake_marl.physics import Floats

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
    figure = new_figure(10.0, 1.2 + 0.36 * len(rows))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, count in zip(panels, HARM_COUNTS, strict=True):
        style_axes(axes)
        for k, row in enumerate(rows):
            estimate = row.first_impact_harm if count == "first" else row.total_harm
            axes.barh(k, estimate.value, height=0.62, color=COLOURS[2])
            ends = estimate.interval or (estimate.value, estimate.value)
            axes.hlines(k, *ends, color=COLOURS[0], linewidth=1.6)
            axes.annotate(
                f"{estimate.value:.2f}", (ends[1], k), xytext=(5, 0), textcoords="offset points", va="center",
                fontsize=9,
            )  # fmt: skip
        distance = rows[0].distance
        best = distance.best_known_first if count == "first" else distance.best_known_total
        if best is not None:
            axes.axvline(best.value, color=COLOURS[3], linewidth=1.6, linestyle="--", label="best known")
        axes.set_xlabel(_TITLES[count], fontsize=9)
        axes.margins(x=0.14)
        axes.set_xlim(left=0.0)
    panels[0].set_yticks(range(len(rows)), [label_text(row.agent) for row in rows])
    panels[0].invert_yaxis()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", frameon=False, fontsize=9)
    add_caption(figure, f"Mean per world; black lines: 95 % intervals. {parameter_line(rows[0].parameters)}.")
    return figure


def regret_distribution(evaluation: Evaluation) -> Figure:
    """Share of the worlds in which an agent's harm is above the best known by more than x, under both counts.

    Where nothing is known to be the best, the same of the harm itself.
    """
    regrets = assess(evaluation)
    figure = new_figure(10.0, 3.8)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, count in zip(panels, HARM_COUNTS, strict=True):
        style_axes(axes)
        for number, (agent, outcome) in enumerate(evaluation.outcomes.items()):
            values = outcome.ledger.world_harm(count) if regrets is None else regrets.regret(outcome, count)
            style = {**series_style(number), "markevery": 40}
            axes.plot(*_exceeded(values), label=label_text(agent), **style)
        axes.set_xscale("symlog", linthresh=1.0, linscale=0.4)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_xlim(left=0.0)
        axes.set_ylim(0.0, 1.0)
        axes.set_xlabel(
            f"{'Harm' if regrets is None else 'Regret'}, {_TITLES[count][0].lower()}{_TITLES[count][1:]}", fontsize=9
        )
    panels[0].set_ylabel("Worlds with more than that", fontsize=9)
    panels[0].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    _legend(figure, panels[0])
    add_caption(figure, f"Linear up to 1 m²/s², logarithmic beyond. {parameter_line(parameters(evaluation))}.")
    return figure


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
    figure = new_figure(10.0, 1.4 + 0.36 * len(evaluation.outcomes))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, count in zip(panels, HARM_COUNTS, strict=True):
        style_axes(axes)
        for k, outcome in enumerate(evaluation.outcomes.values()):
            regret = regrets.regret(outcome, count)
            parts = (regrets.best(count).mean(), (regret * ~avoidable).mean(), (regret * avoidable).mean())
            _stack(axes, k, [float(part) for part in parts])
        axes.set_xlabel(_TITLES[count], fontsize=9)
    panels[0].set_yticks(range(len(evaluation.outcomes)), [label_text(agent) for agent in evaluation.outcomes])
    panels[0].invert_yaxis()
    _legend(figure, panels[0])
    add_caption(figure, f"Mean per world. {parameter_line(parameters(evaluation))}.")
    return figure


def _stack(axes: Axes, k: int, parts: Sequence[float]) -> None:
    left = 0.0
    for part, (label, colour, hatch) in zip(parts, _PARTS, strict=True):
        axes.barh(
            k, part, left=left, height=0.62, color=colour, hatch=hatch, edgecolor="#ffffff", linewidth=0.5,
            label=label if k == 0 else None,
        )  # fmt: skip
        left += part


def _exceeded(values: Floats) -> tuple[Floats, Floats]:
    """Thresholds, and the share of the values above each: the values themselves, or so many of them."""
    ordered = np.sort(values)
    chosen = np.unique(np.linspace(0, len(ordered) - 1, min(_POINTS, len(ordered))).astype(np.int64))
    share = np.array([float((ordered > value).mean()) for value in ordered[chosen]])
    return np.concatenate([[0.0], ordered[chosen]]), np.concatenate([[float((ordered > 0.0).mean())], share])


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=min(len(labels), 5), frameon=False, fontsize=9)
