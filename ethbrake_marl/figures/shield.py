"""The price of the step shield: how often it intervenes against the harm that remains."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, PercentFormatter
from rich.table import Table

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.shield_modes import NONE, STEP, STEP_ALERT, STEP_CAP, ModeRow, are_teams
from ethbrake_marl.figures.style import GREY, add_caption, label_text, new_figure, series_style, style_axes
from ethbrake_marl.shield.review import OperatingPoint
from ethbrake_marl.shield.robustness import RobustnessPoint

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
        axes.plot(rates, harms, label=label_text(name), **series_style(number))  # type: ignore[arg-type]  # a style's values
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
    figure = new_figure(7.2, 1.4 + 0.55 * len(agents))
    axes = figure.subplots()
    style_axes(axes)
    for number, mode in enumerate(_OFFSETS):
        for row in (row for row in rows if row.mode == mode):
            against = row.against_none if are_teams(rows) else row.against_episode
            if against is None:
                continue
            value, interval = against.value, against.interval
            low, high = (value, value) if interval is None else interval
            style = {**series_style(number), "linestyle": "none"}
            place = agents.index(row.agent)
            axes.errorbar(
                [value], [place + _OFFSETS[mode]], xerr=[[value - low], [high - value]], capsize=2.5,
                label=_LABELS[mode] if place == 0 else None, **style,  # type: ignore[arg-type]  # a style's values
            )  # fmt: skip
    axes.axvline(0.0, color=GREY, linewidth=1.0)
    axes.set_xscale("symlog", linthresh=1.0)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_yticks(range(len(agents)), agents, fontsize=9)
    axes.invert_yaxis()
    other = "without a shield" if are_teams(rows) else "of episode mode"
    axes.set_xlabel(f"Harm minus that {other} (m²/s² per world; linear within ±1)", fontsize=9)
    axes.legend(fontsize=8.5, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    add_caption(figure, caption)
    return figure
