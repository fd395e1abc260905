"""Figures of trainings: the course of one, and the mean and spread of several with other seeds."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, PercentFormatter, StrMethodFormatter

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.summary_row import SummaryRow
from ethbrake_marl.extensions.report.style import (
    GREY,
    TITLES,
    band,
    finish,
    in_our_style,
    label_text,
    name_axes,
    new_panels,
    series_style,
)
from ethbrake_marl.motion.layout import Floats


@dataclass(frozen=True, slots=True)
class SeedCurve:
    """Values of one quantity at k steps of several training runs that differ only in their seeds."""

    steps: Floats  # [k] training steps (or another quantity of the x axis)
    values: Floats  # [seeds, k] values of the quantity

    @classmethod
    def of(cls, trainings: Sequence[Mapping[int, float]]) -> Self:
        """Return the values of several training runs at the steps that they all have in common.

        ``trainings`` has a mapping from training step to value for each run. Raises ``InvalidInput`` if the runs have
        no step in common.
        """
        common = sorted(set.intersection(*(set(training) for training in trainings))) if trainings else []
        if not common:
            raise InvalidInput(
                "SeedCurve.of: the training runs have no evaluated step in common; give training runs that were"
                " evaluated at the same steps"
            )
        values = [[training[step] for step in common] for training in trainings]
        return cls(np.array(common, np.float64), np.array(values, np.float64))


@in_our_style
def seed_curves(
    panels: Mapping[str, Mapping[str, SeedCurve]],
    *,
    logarithmic: Collection[str] = (),
    caption: str = "",
    x_label: str = "Training steps",
    known: Mapping[str, float] | None = None,
) -> Figure:
    """Draw a panel for each quantity, with a line for each recipe: the mean over the seeds.

    A band around each line shows plus and minus one standard deviation over the seeds.

    Args:
        panels: label of a quantity -> name of a recipe -> values of the quantity.
        logarithmic: labels of the quantities with a logarithmic axis; a panel with a value that is not positive gets a
            linear axis instead.
        caption: text below the figure.
        x_label: label of the x axis.
        known: best known value of each quantity, by label, drawn as a dashed line.

    """
    figure, every = new_panels((5.0 * len(panels), 4.2), columns=len(panels))
    for axes, (label, curves) in zip(every, panels.items(), strict=True):
        for number, (recipe, curve) in enumerate(curves.items()):
            style = series_style(number + 1)
            mean, seeds = curve.values.mean(axis=0), len(curve.values)
            spread = curve.values.std(axis=0, ddof=1) if seeds > 1 else mean * 0.0  # one seed has no spread
            axes.plot(curve.steps, mean, label=f"{recipe}, {seeds} seed{'s' * (seeds != 1)}", **style)
            band(axes, curve.steps, mean - spread, mean + spread, style)
        if label in logarithmic and all((curve.values > 0.0).all() for curve in curves.values()):
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        if known is not None:
            axes.axhline(known[label], label="best known", color=GREY, linestyle="--", linewidth=1.0)
        name_axes(axes, label, x_label)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    return finish(figure, caption, every[0])


PANELS = (
    ("first_impact_harm", TITLES["first"]),
    ("total_harm", TITLES["total"]),
    ("collision_rate", "Worlds with a collision"),
)
LEARNED = 3  # number of the style of what learns; references have the others


@in_our_style
def learning_curve(
    points: Sequence[Mapping[str, float]],
    *,
    learned: str = "policy",
    references: Sequence[SummaryRow] = (),
    caption: str = "",
) -> Figure:
    """Draw both harms and the collision rate of what learns against the number of training steps.

    Args:
        points: evaluations, earliest first, with ``steps``, ``first_impact_harm``, ``total_harm``, ``collision_rate``.
        learned: its name in the legend.
        references: agents whose results are horizontal lines.
        caption: text below the figure.

    """
    figure, panels = new_panels((10.0, 3.9), columns=3)
    steps, style = [point["steps"] for point in points], series_style(LEARNED)
    for axes, (name, label) in zip(panels, PANELS, strict=True):
        values = [point[name] for point in points]
        axes.plot(steps, values, color=style["color"], marker="o", markersize=3.5, label=learned)
        for number, row in enumerate(references):
            look = series_style(number if number < LEARNED else number + 1)
            value = row.estimates[name]
            assert value is not None
            axes.axhline(
                value.value, color=look["color"], linestyle=look["linestyle"], linewidth=1.2,
                label=label_text(row.agent),
            )  # fmt: skip
        name_axes(axes, label, "Training steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_ylim(bottom=0.0)
    panels[2].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    return finish(figure, caption, panels[0])
