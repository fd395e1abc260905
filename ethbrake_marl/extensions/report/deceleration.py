"""Figure of the harm of one world at every constant deceleration of the learner, predicted and simulated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.agents.pairwise import pairwise, predicted_harm
from ethbrake_marl.episode.play import hold
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.extensions.report.style import finish, in_our_style, name_axes, new_panels, quantities, series_style
from ethbrake_marl.motion.layout import BRAKING, LATENCY, Floats
from ethbrake_marl.names import open_game
from ethbrake_marl.worlds.game import AnyScenario

POINTS = 2001
COUNTS = (("first", "first-impact harm", 1, "-", "o"), ("total", "total harm", 0, "--", "s"))


def harm_of_decelerations(world: State, body: int, at: Floats, horizon_s: float) -> Floats:
    """Return what vehicle ``body`` does by holding decelerations ``at`` [C] (m/s2), [3, C] m2/s2.

    Rows: predicted by the closed form, and simulated, of first impacts and in total. The others do as in ``world``.
    """
    braking, wait = np.ascontiguousarray(world.car[0, BRAKING]), world.car[0, LATENCY].copy()
    priced: Any = predicted_harm
    predicted = [priced(world.line[0], braking, wait, body, float(a)) for a in at]
    return np.stack([predicted, *hold(world, world.wanted, [body], -at[None, :, None], horizon_s, "first")[:, 0]])


@in_our_style
def deceleration_figure(
    world: State,
    scenario: AnyScenario,
    *,
    known: Mapping[str, float] | None = None,
    title: str = "",
    points: int = POINTS,
) -> Figure:
    """Draw predicted and simulated harm of one world against the constant deceleration of the scenario's learner.

    Marks are the decelerations that E-V2X-BM chooses, by the closed form and by simulation.

    Args:
        world: at the alert.
        scenario: has one learner, and scripts that do not look at the state.
        known: best known harm of this world over all commands, ``first`` and ``total``, drawn as lines.
        title: of the figure; by default the scenario's name.
        points: evenly spaced decelerations from 0 to the braking capacity.

    Raises ``InvalidInput`` for something else.

    """
    loaded, game = open_game(scenario)
    check_whole_number("deceleration_figure: points", points, 2)
    if world.n != 1 or len(loaded.learners) != 1 or game.scripts:
        raise InvalidInput(
            f"deceleration_figure: {world.n} worlds, {len(loaded.learners)} learners, {len(game.scripts)} scripts that"
            " look at the state; must be 1, 1 and 0, for instance worlds.take([0]) of paper-random"
        )
    (body,), horizon_s = loaded.learners, loaded.horizon_s
    chosen = float(pairwise(world, body).deceleration_mps2[0])
    at = np.union1d(np.linspace(0.0, world.car[0, BRAKING, body], points), [chosen])
    predicted, *simulated = harm_of_decelerations(world, body, at, horizon_s)
    figure, (axes,) = new_panels((8.0, 4.9))
    colour = series_style(2)["color"]
    axes.plot(at, predicted, color=colour, linestyle="-.", linewidth=1.4, zorder=4, label="predicted (pairwise)")
    for (_, name, number, dashes, _), harm in zip(COUNTS, simulated, strict=True):
        style = {"color": series_style(number)["color"], "linestyle": dashes, "linewidth": 1.5}
        axes.plot(at, harm, label=f"simulated {name}", **style)
    largest = max(map(float, np.max([predicted, *simulated], axis=1)))
    axes.set_ylim(-0.02 * largest, 1.05 * largest + 1e-3)
    place = int(np.searchsorted(at, chosen))
    before, then = float(predicted[place]), float(simulated[0][place])
    axes.vlines(chosen, before, then, color=colour, linewidth=1.0, linestyle=":")
    axes.plot(
        [chosen], [before], color=colour, marker="D", markersize=6, linestyle="none", clip_on=False, zorder=6,
        label=f"a* = {chosen:.3f} m/s², closed form: {before:.2f} predicted, {then:.2f} simulated",
    )  # fmt: skip
    for count, name, number, dashes, marker in COUNTS:
        best, colour = coupled(world, body, count, horizon_s), series_style(number)["color"]
        a, harm = float(best.deceleration_mps2[0]), float(best.harm[0])
        axes.plot(
            [a], [harm], color=colour, marker=marker, markersize=6 + 4 * (count == "total"), markerfacecolor="none",
            linestyle="none", markeredgewidth=1.4, clip_on=False, zorder=5,
            label=f"a* = {a:.3f} m/s², coupled, least {name}: {harm:.2f}",
        )  # fmt: skip
        if known is not None:
            label = f"best known {name}: {known[count]:.2f}"
            axes.axhline(known[count], color=colour, linewidth=0.9, linestyle=dashes, alpha=0.7, label=label)
    axes.set_xlim(0.0, float(at[-1]))
    what = f"Constant deceleration of Vehicle {body} (m/s²)"
    name_axes(axes, title or f"{loaded.name}: one world", what, "Harm (m²/s²)")
    note = (
        f"{quantities(world)}. Harm until {horizon_s:g} s. Predicted: closed form for each pair alone. Simulated:"
        " motion of the whole line, with all impacts."
    )
    return finish(figure, note, axes, columns=2, fontsize=8.5)
