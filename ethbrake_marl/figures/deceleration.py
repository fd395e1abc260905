"""Harm against the constant deceleration of one vehicle in one world: predicted, realised, and the best known."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ethbrake_marl.evaluation.conditions import quantities, quantity_line
from ethbrake_marl.evaluation.deceleration import NONE, DecelerationCurve
from ethbrake_marl.figures.style import COLOURS, GREY, add_caption, new_figure, style_axes
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.limits.limits import Limits, Unproven
from ethbrake_marl.scenario import Scenario

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
    axes.set_ylabel("Harm (m²/s²)", fontsize=9)
    axes.set_title(title or f"{scenario.name}: one world", loc="left", fontsize=10)
    _draw_regimes(strips, curve)
    strips.set_xlabel(f"Constant deceleration of Vehicle {vehicle + 1} (m/s²)", fontsize=9)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False, fontsize=8.5)
    conditions = (
        f"{quantity_line(quantities(curve.world))}. Harm until {scenario.horizon_s:g} s."
        " Predicted: each pair alone, all others braking fully."
        " Realised: in the simulation, with velocity exchange and every later impact;"
        f" other vehicles: {_scripts(scenario, vehicle)}. Dotted: where the way changes in which a pair first meets."
    )
    add_caption(figure, conditions)
    return figure


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
            if name != NONE:
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
