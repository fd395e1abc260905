"""What not knowing costs, as a figure and as a table."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from rich.table import Table

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.figure_style import add_caption, new_figure, series_style, style_axes
from ethbrake_marl.shield.robustness import RobustnessPoint

_MISMATCH = (("step", "corner"), ("step", "inside"), ("robust", "corner"), ("robust", "inside"))
_PRICE = (("step", "harm", 0), ("robust", "harm", 3), ("robust", "bound", 2))  # with the number of the style
_COLUMNS = ("shield", "truth", "width", "mean harm", "mean bound", "above bound", "mean excess", "noticed")


def robustness_figure(points: Sequence[RobustnessPoint], *, caption: str = "") -> Figure:
    """Left the price where the world is as told; then, where it is not, how often and how far the bound is broken.

    Raises ``InvalidInput`` without a point.
    """
    if not points:
        raise InvalidInput("robustness_figure: at least one point is needed")
    figure = new_figure(11.0, 4.0)
    price, above, excess = figure.subplots(1, 3)
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
        style_axes(axes)
        axes.set_title(title, fontsize=9.5, loc="left")
        axes.set_ylabel(unit, fontsize=9)
        axes.set_xlabel("Width of the intervals (1: as given)", fontsize=9)
        axes.set_ylim(bottom=0.0)
        axes.legend(fontsize=8, frameon=False)
    add_caption(figure, caption)
    return figure


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
    axes.plot([p.width for p in chosen], values, label=label, **series_style(number))  # type: ignore[arg-type]
