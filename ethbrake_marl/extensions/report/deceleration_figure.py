"""Harm against the constant deceleration of one vehicle in one world: predicted, realised, and the best known."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ethbrake_marl.env.rendering import COLOURS
from ethbrake_marl.evaluation.conditions import Conditions
from ethbrake_marl.extensions.report.deceleration_curve import DecelerationCurve
from ethbrake_marl.extensions.report.style import GREY, finish, name_axes, new_figure, style_axes
from ethbrake_marl.extensions.search.limits import Unproven
from ethbrake_marl.game.harm import HarmCount

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
    at, changes = curve.deceleration_mps2, {pair: names[1:] != names[:-1] for pair, names in curve.regimes.items()}
    axes.plot(
        at, curve.predicted, color=_PREDICTED, linestyle="-.", linewidth=1.4, zorder=4, label="predicted (pairwise)"
    )
    for harm_count, name, colour, dashes in _COUNTS:
        axes.plot(at, curve.harm(harm_count), color=colour, linestyle=dashes, linewidth=1.5, label=f"realised {name}")
    for changed in changes.values():
        for k in np.flatnonzero(changed):
            axes.axvline(float(at[k + 1]), color=GREY, linewidth=0.6, linestyle=(0, (1, 3)))
    largest = max(float(harm.max()) for harm in (curve.predicted, curve.first_impact_harm, curve.total_harm))
    axes.set_ylim(-0.02 * largest, 1.05 * largest + 1e-3)
    chosen, predicted = curve.closed_form.deceleration_mps2, curve.closed_form.harm
    realised = float(curve.first_impact_harm[np.searchsorted(at, chosen)])
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
    limits = curve.limits
    if not isinstance(limits, Unproven) and limits.known[0]:  # of any profile, over all time-varying commands
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
    axes.set_xlim(0.0, float(at[-1]))
    name_axes(axes, title or f"{scenario.name}: one world", y="Harm (m²/s²)")
    present = []
    for row, (pair, names) in enumerate(curve.regimes.items()):
        for start, stop in pairwise([0, *(np.flatnonzero(changes[pair]) + 1), len(names)]):
            name, left, right = str(names[start]), at[start], at[min(stop, len(at) - 1)]
            if name in _REGIMES:
                colour = _REGIMES[name][0]
                strips.barh(-row, right - left, left=left, height=0.8, color=colour, edgecolor=GREY, linewidth=0.6)
                present.append(name)
    strips.set_yticks([-row for row in range(len(curve.regimes))], list(curve.regimes))
    strips.set_ylim(0.5 - len(curve.regimes), 0.5)
    strips.tick_params(labelsize=9, color=GREY)
    strips.spines[["top", "right"]].set_visible(False)
    handles = [Patch(facecolor=c, edgecolor=GREY, label=m) for r, (c, m) in _REGIMES.items() if r in present]
    handles.append(Patch(facecolor="white", edgecolor=GREY, label="no contact"))
    strips.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.0, -0.75), ncols=4, frameon=False, fontsize=8)
    name_axes(strips, x=f"Constant deceleration of Vehicle {vehicle + 1} (m/s²)")
    others = {i: scenario.scripts.get(i, "full_brake") for i in range(scenario.vehicles) if i != vehicle}
    scripts = ", ".join(dict.fromkeys(others.values()))
    if len(set(others.values())) != 1:
        scripts = ", ".join(f"Vehicle {i + 1} {script}" for i, script in others.items())
    conditions = (
        f"{Conditions.of(curve.world).quantities}. Harm until {scenario.horizon_s:g} s."
        " Predicted: each pair alone, all others braking fully."
        " Realised: in the simulation, with velocity exchange and every later impact;"
        f" other vehicles: {scripts}. Dotted: where the way changes in which a pair first meets."
    )
    return finish(figure, conditions, axes, columns=2, fontsize=8.5)
