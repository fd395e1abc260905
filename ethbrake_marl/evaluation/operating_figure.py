"""The price of the step shield: how often it intervenes against the harm that remains."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.figure_style import add_caption, new_figure, series_style, style_axes
from ethbrake_marl.shield.forensics import OperatingPoint

LABELLED = 0.01  # points with fewer interventions lie on top of each other: they get no label


def operating_figure(curves: Sequence[tuple[str, Sequence[OperatingPoint]]], *, caption: str = "") -> Figure:
    """One curve per policy, from the strict shield (allowance 0) to none; points off the axis say their allowance.

    Raises ``InvalidInput`` without a point.
    """
    if not curves or not all(points for _, points in curves):
        raise InvalidInput("operating_figure: every curve needs at least one point")
    figure = new_figure(6.4, 4.2)
    axes = figure.subplots()
    style_axes(axes)
    for number, (name, points) in enumerate(curves):
        rates, harms = [p.intervention_rate for p in points], [p.harm for p in points]
        axes.plot(rates, harms, label=name, **series_style(number))  # type: ignore[arg-type]  # a style's values
        for point in (p for p in points if p.intervention_rate >= LABELLED):
            axes.annotate(
                f"{point.allowance:g}", (point.intervention_rate, point.harm), fontsize=7.5, xytext=(4, 4),
                textcoords="offset points",
            )  # fmt: skip
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel("Decisions in which the shield intervenes", fontsize=9)
    axes.set_ylabel("Mean harm (m²/s²)", fontsize=9)
    axes.legend(fontsize=9, frameon=False)
    add_caption(figure, caption)
    return figure
