"""Figures of ``ethbrake run``: the learning curve, and harm against the sum of the gaps at the alert."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.report.style import (
    band,
    finish,
    in_our_style,
    label_text,
    name_axes,
    new_panels,
    series_style,
)
from ethbrake_marl.first_edition.envs.rendering import COLOURS
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.statistics import mean
from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow

_PANELS = (
    ("first_impact_harm", "First-impact harm (m²/s²)"),
    ("total_harm", "Total harm (m²/s²)"),
    ("collision_rate", "Worlds with a collision"),
)

_POLICY_NUMBER = 3  # index of the colour of the trained policy

_POLICY = COLOURS[_POLICY_NUMBER]


@in_our_style
def learning_curve(
    points: Sequence[Mapping[str, float]],
    *,
    learned: str = "policy",
    references: Sequence[SummaryRow] = (),
    caption: str = "",
) -> Figure:
    """Draw first-impact harm, total harm and collision rate of a policy or team against the number of training steps.

    Args:
        points: evaluations, earliest first; each has ``steps``, ``first_impact_harm``, ``total_harm`` and
            ``collision_rate``.
        learned: name of the policy or team in the legend.
        references: agents whose results are drawn as horizontal lines.
        caption: text below the figure.

    """
    figure, panels = new_panels((10.0, 3.9), columns=3)
    steps = [point["steps"] for point in points]
    for axes, (name, label) in zip(panels, _PANELS, strict=True):
        axes.plot(steps, [point[name] for point in points], color=_POLICY, marker="o", markersize=3.5, label=learned)
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


@in_our_style
def harm_against_total_gap(evaluation: Evaluation, *, bins: int = 12) -> Figure:
    """Draw mean first-impact harm and mean total harm against the sum of the gaps at the alert.

    The figure has a line for each agent, with a band that shows the 95 % interval of the mean. Raises ``InvalidInput``
    if ``bins`` is below 1.

    Args:
        evaluation: evaluation of the agents.
        bins: number of intervals of equal width into which the sum of the gaps is divided.

    """
    if not bins >= 1:
        raise InvalidInput(f"harm_against_total_gap: bins = {bins}: the number of bins must be at least 1")
    by = evaluation.clusters
    gap, gaps = evaluation.worlds.gaps_m.sum(axis=1), [f"d{p}" for p in range(1, evaluation.worlds.N)]
    part = np.minimum(((gap - gap.min()) / (np.ptp(gap) or 1.0) * bins).astype(np.int64), bins - 1)
    groups = [part == k for k in np.unique(part)]
    sum_of_gaps = " + ".join(gaps) if len(gaps) <= 3 else f"d1 + … + {gaps[-1]}"
    figure, panels = new_panels((10.0, 4.6), columns=2, sharey=True)
    for axes, (name, label) in zip(panels, _PANELS[:2], strict=True):
        for number, agent in enumerate(evaluation.outcomes):
            harm, style = getattr(evaluation.outcome(agent), name), series_style(number)
            estimates = [mean(harm[group], None if by is None else by[group]) for group in groups]
            at = [float(gap[group].mean()) for group in groups]
            axes.plot(at, [each.value for each in estimates], label=label_text(agent), **style)
            ends = np.array([each.ends for each in estimates])
            if len(groups) > 1:
                band(axes, at, ends[:, 0], ends[:, 1], style)
            else:
                axes.vlines(at, ends[:, 0], ends[:, 1], color=str(style["color"]), linewidth=1.2)
        name_axes(axes, label, f"Total gap at the alert, {sum_of_gaps} (m)")
    panels[0].set_ylim(bottom=0.0)  # sets the limit of both panels, after all curves are drawn
    caption = f"Mean over worlds with similar gaps; bands: 95 % intervals. {evaluation.conditions.line}."
    return finish(figure, caption, panels[0])
