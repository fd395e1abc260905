"""Figures of harm: mean harm, distribution of regret, and harm in worlds with avoidable and unavoidable contact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, PercentFormatter

from ethbrake_marl.extensions.report.page import SLIM_IN
from ethbrake_marl.extensions.report.style import (
    TITLES,
    finish,
    in_our_style,
    label_text,
    name_axes,
    new_panels,
    plain,
    series_style,
)
from ethbrake_marl.extensions.search.limit_measures import best_known_words
from ethbrake_marl.extensions.search.regret import regrets_of
from ethbrake_marl.first_edition.envs.rendering import COLOURS
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount

_POINTS = 250  # number of points of a curve; more points would not be visible

_PARTS = (
    ("best known harm", "#bbbbbb", ""),
    ("regret, contact unavoidable", COLOURS[2], "//"),
    ("regret, contact avoidable", COLOURS[1], ".."),
)


@in_our_style
def harm_by_agent(
    rows: Sequence[SummaryRow],
    harm_count: HarmCount = "first",
    elsewhere: Mapping[str, Sequence[SummaryRow]] | None = None,
) -> Figure:
    """Draw the mean harm of each agent as a bar with its 95 % interval.

    A vertical line marks the mean best known harm. Markers show the agent's mean harm in other tests; ``elsewhere`` has
    the results of each test under its title. The figure is narrow enough for the screen of a phone.
    """
    figure, (axes,) = new_panels((SLIM_IN, 0.9 + 0.24 * len(rows)))
    name = {"first": "first_impact_harm", "total": "total_harm"}[harm_count]
    for k, row in enumerate(rows):
        axes.barh(k, getattr(row, name).value, height=0.62, color=COLOURS[2])
        axes.hlines(k, *getattr(row, name).ends, color=COLOURS[0], linewidth=1.6)
    if (best := rows[0][f"best_known_{name}"]) is not None:
        axes.axvline(best.value, color=COLOURS[3], linewidth=1.6, linestyle="--", label=best_known_words(rows[0]))
    for number, (title, others) in enumerate((elsewhere or {}).items()):
        harms = {row.agent: getattr(row, name).value for row in others}
        places = [k for k, row in enumerate(rows) if row.agent in harms]
        style = series_style(number + 4) | {"linestyle": "none", "markersize": 6.0}
        axes.plot([harms[rows[k].agent] for k in places], places, label=label_text(title.lower(), 22), **style)
    name_axes(axes, x=TITLES[harm_count])
    axes.set_xlim(left=0.0)
    _name_rows(axes, [row.agent for row in rows], most=22)
    axes.tick_params(labelsize=8)
    named = axes.get_legend_handles_labels()
    figure.legend(
        *named, loc="outside upper right", ncols=3, frameon=False, fontsize=8, handletextpad=0.4, columnspacing=1
    )
    return figure


def _name_rows(axes: Axes, agents: Sequence[str], most: int = 40) -> None:
    """Label the rows of a figure with the agents' names, at most ``most`` characters each, the first agent on top."""
    axes.set_yticks(range(len(agents)), [label_text(agent, most) for agent in agents])
    axes.invert_yaxis()


@in_our_style
def regret_distribution(evaluation: Evaluation) -> Figure:
    """Draw, for every x, the fraction of worlds in which an agent's regret exceeds x, for each agent and harm count.

    If the best known harm of the worlds was not computed, the figure shows the agents' harm instead of their regret.
    """
    regrets = regrets_of(evaluation)
    figure, panels = new_panels((10.0, 3.8), columns=2, sharey=True)
    for axes, count in zip(panels, HARM_COUNTS, strict=True):
        for number, (agent, outcome) in enumerate(evaluation.outcomes.items()):
            values = outcome.ledger.world_harm(count) if regrets is None else regrets.regret(outcome, count)
            ordered = np.sort(values)  # thresholds: the values themselves, thinned to _POINTS
            chosen = np.unique(np.linspace(0, len(ordered) - 1, min(_POINTS, len(ordered))).astype(np.int64))
            thresholds = np.concatenate([[0.0], ordered[chosen]])
            share = [float((ordered > threshold).mean()) for threshold in thresholds]
            style = {**series_style(number), "markevery": 40}
            axes.plot(thresholds, share, label=label_text(agent), **style)
        axes.set_xscale("symlog", linthresh=1.0, linscale=0.4)
        axes.xaxis.set_major_formatter(FuncFormatter(plain))
        axes.set_xlim(left=0.0)
        axes.set_ylim(0.0, 1.0)
        what = "Harm" if regrets is None else "Regret"
        name_axes(axes, x=f"{what}, {TITLES[count][0].lower()}{TITLES[count][1:]}")
    name_axes(panels[0], y="Worlds above this value")
    panels[0].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    caption = f"Linear up to 1 m²/s², logarithmic beyond. {evaluation.conditions.line}."
    return finish(figure, caption, panels[0], columns=5)


@in_our_style
def harm_in_parts(evaluation: Evaluation) -> Figure:
    """Draw the mean harm of each agent as a bar of three parts.

    The parts are the best known harm, the regret in worlds with unavoidable contact, and the regret in worlds with
    avoidable contact. The evaluation needs a proof, for each world, whether contact is avoidable.
    """
    regrets = regrets_of(evaluation)
    avoidable = None if regrets is None else regrets.limits.proof.avoidable
    assert regrets is not None and avoidable is not None
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
        name_axes(axes, x=TITLES[count])
    _name_rows(panels[0], list(evaluation.outcomes))
    return finish(figure, f"Mean over the worlds. {evaluation.conditions.line}.", panels[0], columns=5)
