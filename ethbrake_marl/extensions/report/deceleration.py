"""Compute and draw the harm of one world at many constant decelerations of one vehicle, predicted and simulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.report.style import GREY, finish, in_our_style, name_axes, new_figure, style_axes
from ethbrake_marl.extensions.search.best_harm import scripted_commands
from ethbrake_marl.extensions.search.limits import Limits, Unproven, known_limits
from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.first_edition.agents.e_v2x_bm.pairwise import optimise_pairwise, pairwise_harm
from ethbrake_marl.first_edition.envs.rendering import COLOURS
from ethbrake_marl.first_edition.evaluation.conditions import Conditions
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.forecast import forecast
from ethbrake_marl.first_edition.physics.state import Floats, Worlds, make_worlds
from ethbrake_marl.first_edition.scenario.task import Task

POINTS = 2001  # number of evenly spaced decelerations; the breakpoints of the closed form are added

_LONG_S = 1e4  # s; two vehicles that have not met until then never meet


@dataclass(frozen=True, slots=True)
class Choice:
    """Constant deceleration that E-V2X-BM chooses in one world, and the harm that E-V2X-BM computes for it."""

    deceleration_mps2: float  # chosen deceleration, m/s2
    harm: float  # predicted or simulated harm at the chosen deceleration, m2/s2


@dataclass(frozen=True, slots=True)
class DecelerationCurve:
    """Harm in one world at K constant decelerations of one vehicle, the smallest deceleration first."""

    task: Task  # scenario, and the one controlled vehicle
    world: Worlds  # world at the alert, n = 1
    deceleration_mps2: Floats  # [K] decelerations from 0 to the braking capacity, m/s2
    predicted: Floats  # [K] harm predicted by the pairwise closed form, m2/s2
    first_impact_harm: Floats  # [K] simulated first-impact harm, m2/s2
    total_harm: Floats  # [K] simulated total harm, m2/s2
    # for "front pair" and "rear pair": [K] way in which the pair first meets, a value of ``regimes_of``
    regimes: dict[str, NDArray[np.str_]]
    closed_form: Choice  # deceleration that the pairwise closed form chooses, with its predicted harm
    coupled: Mapping[HarmCount, Choice]  # by harm count: deceleration with the least simulated harm
    limits: Limits | Unproven  # best known harm and proven bound over all time-varying commands

    def harm(self, harm_count: HarmCount) -> Floats:
        """Return the simulated harm, [K] m2/s2, under ``harm_count``: ``first`` or ``total``."""
        return self.first_impact_harm if harm_count == "first" else self.total_harm


def deceleration_curve(world: Worlds, task: Task, *, points: int = POINTS) -> DecelerationCurve:
    """Compute predicted, first-impact and total harm of one world at many constant decelerations of one vehicle.

    ``points`` of the decelerations are evenly spaced. At the other decelerations the predicted harm (the pairwise
    closed form) has a kink, a jump or its minimum. The prediction assumes that all other vehicles brake fully. In the
    simulation, the other vehicles follow the scripts of the scenario. Raises ``InvalidInput`` if there is not exactly
    one world, if ``points`` is below 2, or if a script reacts to what happens after the alert.

    Args:
        world: world at the alert, n = 1.
        task: scenario, with exactly one controlled vehicle.
        points: number of evenly spaced decelerations from 0 to the braking capacity.

    """
    if world.n != 1:
        raise InvalidInput(
            f"deceleration_curve: world has {world.n} worlds; give exactly one, for instance worlds.take([0])"
        )
    if not points >= 2:
        raise InvalidInput(f"deceleration_curve: points = {points}: the number of points must be at least 2")
    scenario, vehicle = task.scenario, task.vehicle
    capacity = float(world.vehicles.braking_capacity_mps2[0, vehicle])
    pairwise = optimise_pairwise(world, vehicle)
    chosen = pairwise.deceleration_mps2
    special = np.append(pairwise.breakpoints_mps2[0], chosen)
    at = np.union1d(np.linspace(0.0, capacity, points), special)
    others = scripted_commands(world, task)
    first, total = forecast(world, others, vehicle, -at[None, :], scenario.horizon_s)
    deceleration = np.repeat(world.vehicles.braking_capacity_mps2, at.size, axis=0)
    deceleration[:, vehicle] = at
    copies = world.take(np.zeros(at.size, np.int64))
    contacts = pairwise_harm(copies, deceleration)
    pairs = {"front pair": vehicle - 1, "rear pair": vehicle}
    own = {name: p for name, p in pairs.items() if 0 <= p < world.N - 1}
    regimes = {name: regimes_of(copies, p, deceleration) for name, p in own.items()}
    predicted = contacts[:, list(own.values())].sum(axis=1)
    coupled = {}
    for rule in HARM_COUNTS:
        best = optimise_coupled(world, vehicle, harm_count=rule, horizon_s=scenario.horizon_s, others_mps2=others)
        coupled[rule] = Choice(float(best.deceleration_mps2[0]), float(best.harm[0]))
    closed_form = Choice(float(chosen[0]), float(predicted[np.searchsorted(at, chosen[0])]))
    return DecelerationCurve(
        task, world, at, predicted, first[0], total[0], regimes, closed_form,
        coupled, known_limits(world, task),
    )  # fmt: skip


def regimes_of(worlds: Worlds, pair: int, deceleration_mps2: Floats) -> NDArray[np.str_]:
    """Return how one pair of vehicles makes its first contact in each world, [n].

    Each vehicle of the pair coasts during its latency and then brakes with a constant deceleration. All other vehicles
    are ignored. The values are ``early`` (contact before the front vehicle brakes), ``A`` (the front vehicle brakes,
    the rear vehicle coasts), ``A'`` (the front vehicle is at rest, the rear vehicle coasts), ``B`` (both vehicles
    brake), ``C`` (the front vehicle is at rest, the rear vehicle brakes) and ``none`` (no contact). Formulas:
    docs/internals/proofs/constant-deceleration.md.

    Args:
        worlds: worlds at the alert, [n].
        pair: index of the front vehicle of the pair.
        deceleration_mps2: constant deceleration of each vehicle, [n, N] m/s2.

    """
    own = slice(pair, pair + 2)
    v = worlds.vehicles
    alone = make_worlds(
        worlds.gaps_m[:, [pair]], worlds.speeds_mps[:, own], braking_capacity_mps2=v.braking_capacity_mps2[:, own],
        driving_capacity_mps2=0.0, latency_s=v.latency_s[:, own], mass_t=1.0, restitution=0.0,
        speed_limit_mps=v.speed_limit_mps[:, own],
    )  # fmt: skip
    with np.errstate(divide="ignore", invalid="ignore"):  # standstill time; infinite without braking
        speed = worlds.speeds_mps[:, own]
        stop_s = np.where(speed > 0.0, v.latency_s[:, own] + speed / deceleration_mps2[:, own], 0.0)
    rows = advance(alone, -deceleration_mps2[:, own], until_s=_LONG_S, record=True)[1].rows
    assert rows is not None
    meets_s = np.full(worlds.n, np.inf)
    meets_s[rows.world[rows.first]] = rows.time_s[rows.first]
    coasting, stands = meets_s <= v.latency_s[:, pair + 1], meets_s >= stop_s[:, 0]
    cases = [np.isinf(meets_s), meets_s < v.latency_s[:, pair], coasting & stands, coasting, stands]
    return np.select(cases, ["none", "early", "A'", "A", "C"], "B")


_PREDICTED = COLOURS[2]

_COUNTS: tuple[tuple[HarmCount, str, str, str], ...] = (
    ("first", "first-impact harm", COLOURS[1], "-"),
    ("total", "total harm", COLOURS[0], "--"),
)

_REGIMES = {  # colour and meaning of each regime
    "early": ("#d7c2e8", "before the front vehicle brakes"),
    "A": ("#8f8f8f", "A: rear vehicle still coasts"),
    "A'": ("#5f5f5f", "A': rear vehicle coasts, front vehicle at rest"),
    "B": ("#9fd3ee", "B: both brake"),
    "C": ("#f3c98b", "C: front vehicle at rest"),
}


@in_our_style
def deceleration_figure(curve: DecelerationCurve, *, title: str = "") -> Figure:
    """Draw predicted and simulated harm of one world against the constant deceleration of one vehicle.

    The upper panel shows the predicted harm, the simulated harm under both counts, and the decelerations that the
    pairwise and the coupled E-V2X-BM choose. Two horizontal lines mark the best known harm of this world over all
    commands, constant or not, under each count. The lower panel shows how each pair makes its first contact (see
    ``regimes_of``).

    Args:
        curve: result of ``deceleration_curve``.
        title: title of the figure; empty: the name of the scenario.

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
        axes.plot(at, curve.harm(harm_count), color=colour, linestyle=dashes, linewidth=1.5, label=f"simulated {name}")
    for changed in changes.values():
        for k in np.flatnonzero(changed):
            axes.axvline(float(at[k + 1]), color=GREY, linewidth=0.6, linestyle=(0, (1, 3)))
    largest = max(float(harm.max()) for harm in (curve.predicted, curve.first_impact_harm, curve.total_harm))
    axes.set_ylim(-0.02 * largest, 1.05 * largest + 1e-3)
    chosen, predicted = curve.closed_form.deceleration_mps2, curve.closed_form.harm
    simulated = float(curve.first_impact_harm[np.searchsorted(at, chosen)])
    axes.vlines(chosen, predicted, simulated, color=_PREDICTED, linewidth=1.0, linestyle=":")
    axes.plot(
        [chosen], [predicted], color=_PREDICTED, marker="D", markersize=6, linestyle="none", clip_on=False, zorder=6,
        label=f"a* = {chosen:.3f} m/s², closed form: {predicted:.2f} predicted, {simulated:.2f} simulated",
    )  # fmt: skip
    for (harm_count, name, colour, _), marker, size in zip(_COUNTS, ("o", "s"), (6, 10), strict=True):
        best = curve.coupled[harm_count]
        axes.plot(
            [best.deceleration_mps2], [best.harm], color=colour, marker=marker, markersize=size, markerfacecolor="none",
            linestyle="none", markeredgewidth=1.4, clip_on=False, zorder=5,
            label=f"a* = {best.deceleration_mps2:.3f} m/s², coupled, least {name}: {best.harm:.2f}",
        )  # fmt: skip
    limits = curve.limits
    if not isinstance(limits, Unproven) and limits.known[0]:  # best known harm over all time-varying commands
        first, total = float(limits.first_impact_harm[0]), float(limits.total_harm[0])
        for (_, _, colour, dashes), harm in zip(_COUNTS, (first, total), strict=True):
            axes.axhline(harm, color=colour, linewidth=0.9, linestyle=dashes, alpha=0.7)
        proof = limits.proof
        least = "" if proof.harm is None else f"; proven lower bound {proof.harm[0]:.2f}"
        text = " (avoidable)" if proof.avoidable is not None and proof.avoidable[0] else least
        axes.annotate(
            f"best known harm: {first:.2f} first-impact, {total:.2f} total{text}", (0.0, max(first, total)),
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
        " Predicted: closed form for each pair alone, if all other vehicles brake fully."
        " Simulated: motion of the whole line, with all impacts;"
        f" scripts of the other vehicles: {scripts}. Dotted lines: the way in which a pair first meets changes."
    )
    return finish(figure, conditions, axes, columns=2, fontsize=8.5)
