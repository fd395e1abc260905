"""What each mode of the shield makes of an agent's harm, beside episode mode."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.figure_style import GREY, add_caption, new_figure, series_style, style_axes
from ethbrake_marl.evaluation.shield_modes import NONE, STEP, STEP_ALERT, ModeRow

_OFFSETS = {NONE: -0.2, STEP: 0.0, STEP_ALERT: 0.2}
_LABELS = {NONE: "no shield", STEP: "step mode", STEP_ALERT: "step mode, rollout at the alert only"}


def shield_modes_figure(rows: Sequence[ModeRow], *, caption: str = "") -> Figure:
    """Per agent the paired difference to episode mode with its 95 % interval, one mark per mode; left is less harm.

    Raises ``InvalidInput`` without a row.
    """
    if not rows:
        raise InvalidInput("shield_modes_figure: at least one agent is needed")
    agents = list(dict.fromkeys(row.agent for row in rows))
    figure = new_figure(7.2, 1.4 + 0.55 * len(agents))
    axes = figure.subplots()
    style_axes(axes)
    for number, mode in enumerate(_OFFSETS):
        for row in (row for row in rows if row.mode == mode and row.against_episode is not None):
            assert row.against_episode is not None
            value, interval = row.against_episode.value, row.against_episode.interval
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
    axes.set_xlabel("Harm minus that of episode mode (m²/s² per world; linear within ±1)", fontsize=9)
    axes.legend(fontsize=8.5, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    add_caption(figure, caption)
    return figure
