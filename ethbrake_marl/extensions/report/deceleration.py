"""Figure of the harm of one world at every constant deceleration of the learner, predicted and simulated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.agents.pairwise import pairwise, predicted_harm
from ethbrake_marl.episode.counts import HARM, IN_WORDS
from ethbrake_marl.episode.play import hold
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.report.style import finish, in_our_style, new_panels, quantities, series_style
from ethbrake_marl.motion.layout import BRAKING, LATENCY, Floats
from ethbrake_marl.names import open_game
from ethbrake_marl.worlds.game import AnyScenario

POINTS = 2001  # evenly spaced decelerations


def harm_of_decelerations(world: State, body: int, at: Floats, horizon_s: float) -> Floats:
    """Return the harm if vehicle ``body`` holds each of the decelerations ``at`` [C] (m/s2), [3, C] m2/s2.

    Rows: first-impact harm predicted by the paper's closed form, and simulated first-impact and total harm.
    """
    braking, wait = np.ascontiguousarray(world.car[0, BRAKING]), world.car[0, LATENCY].copy()
    priced: Any = predicted_harm
    predicted = [priced(world.line[0], braking, wait, body, float(a)) for a in at]
    return np.stack([predicted, *hold(world, world.wanted, [body], -at[None, :, None], horizon_s, "first")[:, 0]])


@in_our_style
def deceleration_figure(
    world: State, scenario: AnyScenario, *, known: Mapping[str, float] | None = None, title: str = ""
) -> Figure:
    """Draw predicted and simulated harm of one world against the constant deceleration of the scenario's learner.

    Marks show the decelerations that E-V2X-BM chooses, by the closed form and by simulation. ``known``: best known harm
    of this world over all commands, ``first`` and ``total``, drawn as lines.

    Raises ``InvalidInput`` unless there is one world, one learner, and no script that looks at the state.
    """
    loaded, game = open_game(scenario)
    if world.n != 1 or len(loaded.learners) != 1 or game.scripts:
        raise InvalidInput(
            f"deceleration_figure: {world.n} worlds, {len(loaded.learners)} learners, {len(game.scripts)} scripts that"
            " look at the state; must be 1, 1 and 0, for instance worlds.take([0]) of paper-random"
        )
    (body,), horizon_s = loaded.learners, loaded.horizon_s
    chosen = float(pairwise(world, body).deceleration_mps2[0])
    at = np.union1d(np.linspace(0.0, world.car[0, BRAKING, body], POINTS), [chosen])
    predicted, first, total = harm_of_decelerations(world, body, at, horizon_s)
    place = int(np.searchsorted(at, chosen))
    figure, (axes,) = new_panels((8.0, 4.9))
    styles = [series_style(number) | {"marker": "", "linewidth": 1.5} for number in range(3)]
    mark: dict[str, Any] = {"linestyle": "none", "markerfacecolor": "none", "clip_on": False, "zorder": 5}
    axes.plot(at, predicted, label="predicted (pairwise)", **styles[2])
    for count, harm, style in zip(HARM, (first, total), styles, strict=False):
        axes.plot(at, harm, label=f"simulated {IN_WORDS[count]}", **style)
    axes.vlines(chosen, predicted[place], first[place], color=styles[2]["color"], linewidth=1.0, linestyle=":")
    harms = f"{predicted[place]:.2f} predicted, {first[place]:.2f} simulated"
    axes.plot(
        [chosen], [predicted[place]], label=f"a* = {chosen:.3f} m/s², closed form: {harms}",
        **{**styles[2], **mark, "marker": "D", "markersize": 6},
    )  # fmt: skip
    for count, style, size in zip(HARM, styles, (6, 10), strict=False):
        best = coupled(world, body, count, horizon_s)
        a, least = float(best.deceleration_mps2[0]), float(best.harm[0])
        axes.plot(
            [a], [least], label=f"a* = {a:.3f} m/s², coupled, least {IN_WORDS[count]}: {least:.2f}",
            **{**style, **mark, "marker": "o", "markersize": size},
        )  # fmt: skip
        if known is not None:
            axes.axhline(
                known[count], label=f"best known {IN_WORDS[count]}: {known[count]:.2f}", **style | {"linewidth": 0.9}
            )
    axes.set(
        title=title or f"{loaded.name}: one world",
        xlabel=f"Constant deceleration of Vehicle {body} (m/s²)",
        ylabel="Harm (m²/s²)",
        xlim=(0.0, float(at[-1])),
        ylim=(0.0, None),
    )
    note = (
        f"{quantities(world)}. Harm until {horizon_s:g} s. Predicted: closed form for each pair alone. Simulated:"
        " motion of the whole line, with all impacts."
    )
    return finish(figure, note, axes, columns=2, fontsize=8)
