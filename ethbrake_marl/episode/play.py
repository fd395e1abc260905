"""Prediction of episodes in which the learners follow a plan, decision by decision, with the bits of the episode."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ethbrake_marl.episode.commands import write_commands
from ethbrake_marl.episode.counts import AnyCount, HarmCount, amount_so_far
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import ENDED, STEPS, State
from ethbrake_marl.episode.step import advance
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.interval import FAILED
from ethbrake_marl.motion.layout import Floats, scratch_for


@large
def play_worlds(line, car, clock, wanted, plans, most, learners, time_step_s, weights, scratch, out):
    """Follow the plans [n, T, L] of the L learners to the end, in place; write the harm (m2/s2) to ``out`` [n].

    An episode stops when its harm is above ``most`` [n] (m2/s2). After T decisions the last actions repeat. The other
    arguments are those of ``step.step_worlds``.
    """
    for k in range(len(out)):
        harm = amount_so_far(line[k], weights)
        while clock[k, ENDED] == 0.0 and harm <= most[k]:
            actions = plans[k, min(int(clock[k, STEPS]), plans.shape[1] - 1)]
            write_commands(car[k], wanted[k], learners, actions)
            outcome, _ = advance(line[k], car[k], clock[k], wanted[k], scratch, time_step_s)
            harm = math.inf if outcome == FAILED else amount_so_far(line[k], weights)
        out[k] = harm


def follow_plans(
    game: Game, state: State, plans: Floats, count: HarmCount, most: Any = math.inf
) -> tuple[State, Floats]:
    """Last states of episodes whose learners follow ``plans`` from ``state`` on, and the episodes' harm, [n] m2/s2.

    ``plans`` [n, T, L] are the actions of the L learners at the first T decisions of the episode; after these the last
    actions repeat. An episode stops when its harm is above ``most`` [n] (m2/s2); the result is then its harm so far. If
    a check of the physics fails, the harm is infinite; but in games with scripts, ``PhysicsError`` is raised.
    """
    most = np.full(len(plans), most)
    if game.scripts or game.physics is not None:
        rows = np.arange(len(plans))
        while (~state.ended & (state.harm(count) <= most)).any():
            decision = np.minimum(state.steps, plans.shape[1] - 1)
            state, _ = game.follow(state, plans[rows, decision])
        return state, state.harm(count)
    line, car, clock, know, wanted, memories = state
    line, clock, wanted = line.copy(), clock.copy(), wanted.copy()
    out, settings = np.empty(len(plans)), game.settings
    play_worlds(
        line, car, clock, wanted, plans, most, settings.learners, settings.time_step_s, count.weight_array,
        scratch_for(wanted.shape[1]), out,
    )  # fmt: skip
    return State(line, car, clock, know, wanted, memories), out


def price(game: Game, state: State, plans: Floats, harm_count: AnyCount, most: Any = math.inf) -> Floats:
    """Harm of every episode, [n] m2/s2, if the learners follow ``plans`` from ``state`` on (see ``follow_plans``).

    An episode stops when its harm is above ``most`` (m2/s2); the result is then its harm so far.
    """
    return follow_plans(game, state, plans, HarmCount.of(harm_count), most)[1]
