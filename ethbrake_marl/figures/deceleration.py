"""Harm against the constant deceleration of one vehicle in one world: predicted, realised, and the best known.

The prediction is the closed form of E-V2X-BM, which treats the pairs as independent; the realised curves are the same
decelerations in the engine, where the other vehicles follow their scripts.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from ethbrake_marl.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.agents.e_v2x_bm.pairwise import optimise_pairwise, pairwise_breakpoints, pairwise_harm
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.conditions import quantities, quantity_line
from ethbrake_marl.figures.style import COLOURS, GREY, add_caption, new_figure, style_axes
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.limits.best_harm import scripted_commands
from ethbrake_marl.limits.limits import Limits, Unproven, known_limits
from ethbrake_marl.physics import Floats, Worlds, advance, forecast, make_worlds
from ethbrake_marl.scenario import Scenario, Task

POINTS = 2001  # evenly spaced decelerations; the breakpoints of the closed form come on top
NONE = "none"

_LONG_S = 1e4  # whoever still coasts has met or will never meet
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


@dataclass(frozen=True, slots=True)
class DecelerationCurve:
    """Harm (m2/s2) of one world at K constant decelerations of one vehicle, in rising order."""

    deceleration_mps2: Floats  # [K] from 0 to the braking capacity
    predicted: Floats  # [K] pairwise, in closed form
    first_impact_harm: Floats  # [K] realised
    total_harm: Floats  # [K] realised
    regimes: dict[str, NDArray[np.str_]]  # per pair of the vehicle ("front pair", "rear pair"): [K] how it first meets


def deceleration_curve(scenario: Scenario, world: Worlds, vehicle: int, *, points: int = POINTS) -> DecelerationCurve:
    """The three harms of one world at evenly spaced decelerations of ``vehicle``, and at those of the closed form.

    The prediction lets all others brake fully; in the simulation they follow the scenario's scripts. Raises
    ``InvalidInput`` unless there is exactly one world, ``points`` is at least 2 and every script is fixed at the alert.
    """
    if world.n != 1:
        raise InvalidInput(f"deceleration curve: {world.n} worlds given; exactly one is drawn")
    if not points >= 2:
        raise InvalidInput(f"deceleration curve: points = {points}; at least 2 are needed")
    capacity = float(world.vehicles.braking_capacity_mps2[0, vehicle])
    special = np.append(pairwise_breakpoints(world, vehicle)[0], optimise_pairwise(world, vehicle).deceleration_mps2)
    at = np.union1d(np.linspace(0.0, capacity, points), special)
    others = scripted_commands(scenario, world, [vehicle])
    first, total = forecast(world, others, vehicle, -at[None, :], scenario.horizon_s)
    deceleration = np.repeat(world.vehicles.braking_capacity_mps2, at.size, axis=0)
    deceleration[:, vehicle] = at
    copies = world.take(np.zeros(at.size, np.int64))
    contacts = pairwise_harm(copies, deceleration)
    pairs = {"front pair": vehicle - 1, "rear pair": vehicle}
    own = {name: p for name, p in pairs.items() if 0 <= p < world.N - 1}
    regimes = {name: regimes_of(copies, p, deceleration) for name, p in own.items()}
    return DecelerationCurve(at, contacts[:, list(own.values())].sum(axis=1), first[0], total[0], regimes)


def regimes_of(worlds: Worlds, pair: int, deceleration_mps2: Floats) -> NDArray[np.str_]:
    """How one pair, alone, first meets under constant decelerations [n, N] from now (t = 0) on, [n].

    ``A``, ``A'``, ``B`` or ``C`` as in docs/baselines.md, ``early``: before the pair's leader brakes, or ``none``.
    """
    own = slice(pair, pair + 2)
    v = worlds.vehicles
    alone = make_worlds(
        worlds.gaps_m[:, [pair]], worlds.speeds_mps[:, own], braking_capacity_mps2=v.braking_capacity_mps2[:, own],
        driving_capacity_mps2=0.0, latency_s=v.latency_s[:, own], mass_t=1.0, restitution=0.0,
        speed_limit_mps=v.speed_limit_mps[:, own],
    )  # fmt: skip
    stop_s = _standstill_s(worlds.speeds_mps[:, own], deceleration_mps2[:, own], v.latency_s[:, own])
    rows = advance(alone, -deceleration_mps2[:, own], until_s=_LONG_S, record=True)[1].rows
    assert rows is not None
    meets_s = np.full(worlds.n, np.inf)
    meets_s[rows.world[rows.first]] = rows.time_s[rows.first]
    coasting, stands = meets_s <= v.latency_s[:, pair + 1], meets_s >= stop_s[:, 0]
    cases = [np.isinf(meets_s), meets_s < v.latency_s[:, pair], coasting & stands, coasting, stands]
    return np.select(cases, [NONE, "early", "A'", "A", "C"], "B")


def deceleration_figure(scenario: Scenario, world: Worlds, vehicle: int, *, title: str = "") -> Figure:
    """Predicted and realised harm of one world over the constant deceleration of ``vehicle``.

    Above: the three curves, the decelerations that E-V2X-BM takes (closed form and coupled, both counts), and as level
    lines the best known harm of any profile, where it is known. Below: how each pair alone first meets. Raises
    ``InvalidInput`` unless exactly one world is given.
    """
    curve = deceleration_curve(scenario, world, vehicle)
    figure = new_figure(8.0, 5.4)
    axes, strips = figure.subplots(2, 1, sharex=True, height_ratios=(5.0, 0.45 * len(curve.regimes)))
    style_axes(axes)
    _draw_curves(axes, curve)
    _mark_chosen(axes, curve, scenario, world, vehicle)
    _mark_best_known(axes, known_limits(world, Task(scenario, (vehicle,))))
    axes.set_xlim(0.0, float(curve.deceleration_mps2[-1]))
    axes.set_ylabel("Harm (m²/s²)", fontsize=9)
    axes.set_title(title or f"{scenario.name}: one world", loc="left", fontsize=10)
    _draw_regimes(strips, curve)
    strips.set_xlabel(f"Constant deceleration of Vehicle {vehicle + 1} (m/s²)", fontsize=9)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False, fontsize=8.5)
    conditions = (
        f"{quantity_line(quantities(world))}. Harm until {scenario.horizon_s:g} s. Predicted: each pair alone, all"
        " others braking fully. Realised: in the simulation, with velocity exchange and every later impact; other"
        f" vehicles: {_scripts(scenario, vehicle)}. Dotted: where the way changes in which a pair first meets."
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
    for harm, (_, name, colour, dashes) in zip((curve.first_impact_harm, curve.total_harm), _COUNTS, strict=True):
        axes.plot(at, harm, color=colour, linestyle=dashes, linewidth=1.5, label=f"realised {name}")
    for names in curve.regimes.values():
        for k in np.flatnonzero(names[1:] != names[:-1]):
            axes.axvline(float(at[k + 1]), color=GREY, linewidth=0.6, linestyle=(0, (1, 3)))
    largest = max(float(harm.max()) for harm in (curve.predicted, curve.first_impact_harm, curve.total_harm))
    axes.set_ylim(-0.02 * largest, 1.05 * largest + 1e-3)


def _mark_chosen(axes: Axes, curve: DecelerationCurve, scenario: Scenario, world: Worlds, vehicle: int) -> None:
    """The decelerations that E-V2X-BM takes: by the closed form, and coupled under either count."""
    chosen = float(optimise_pairwise(world, vehicle).deceleration_mps2[0])
    k = int(np.searchsorted(curve.deceleration_mps2, chosen))
    predicted, realised = float(curve.predicted[k]), float(curve.first_impact_harm[k])
    axes.vlines(chosen, predicted, realised, color=_PREDICTED, linewidth=1.0, linestyle=":")
    axes.plot(
        [chosen], [predicted], color=_PREDICTED, marker="D", markersize=6, linestyle="none", clip_on=False, zorder=6,
        label=f"a* = {chosen:.3f} m/s², closed form: predicts {predicted:.2f}, realises {realised:.2f}",
    )  # fmt: skip
    others = scripted_commands(scenario, world, [vehicle])
    for (count, name, colour, _), marker, size in zip(_COUNTS, ("o", "s"), (6, 10), strict=True):
        best = optimise_coupled(world, vehicle, count=count, horizon_s=scenario.horizon_s, others_mps2=others)
        chosen, harm = float(best.deceleration_mps2[0]), float(best.harm[0])
        axes.plot(
            [chosen], [harm], color=colour, marker=marker, markersize=size, markerfacecolor="none", linestyle="none",
            markeredgewidth=1.4, clip_on=False, zorder=5,
            label=f"a* = {chosen:.3f} m/s², coupled, least {name}: {harm:.2f}",
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
    told = " (avoidable)" if proof.avoidable[0] else least
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


def _standstill_s(speed_mps: Floats, deceleration_mps2: Floats, latency_s: Floats) -> Floats:
    """When each vehicle would stand, ``latency + v / a``; inf without braking."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(speed_mps > 0.0, latency_s + speed_mps / deceleration_mps2, 0.0)
