"""Branches: copies of running episodes that are simulated to their end with other actions.

Branches of one state have the same random numbers, so they differ only in the actions. n: branches, or worlds; m:
branches that still run; L: learners, front to rear; F: features.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import beside_harm
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import TIME, State
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.layout import FORCE, GAP, HIT, LATENCY, SPEED, Bools, Floats, Ints
from ethbrake_marl.policies.layers import Float32s

ROUNDING_MPS2 = 1e-5  # forces closer than this are equal: a network's rounding depends on its batch size

Act = Callable[[Observations], Float32s]  # observations [rows, F] -> actions [rows] in [-1, 1]


class Moment(NamedTuple):
    """One decision in all branches (simulated copies of episodes) that still run."""

    state: State
    seen: Observations  # [m, L, F]
    rows: Ints  # [m] number of each branch, from 0
    number: int  # steps so far

    def ask(self, act: Act) -> Floats:
        """Actions of all learners, chosen by the policy ``act``, [m, L] float64."""
        return act(self.seen.reshape(-1, self.seen.shape[2])).astype(np.float64).reshape(self.seen.shape[:2])


Decide = Callable[[Moment], Floats]  # returns the learners' actions, [m, L]


def play_on(game: Game, state: State, decide: Decide, gamma: float, *, at_least: int = 0) -> tuple[Floats, State]:
    """Simulate episodes to the end; return each learner's discounted return, [n, L], and the last states.

    ``decide``: function that returns the learners' actions at a ``Moment``. ``gamma``: discount per step. If harm is
    the reward's only term, an episode also ends, after ``at_least`` steps, when no vehicle will ever move again.
    """
    learners, only_harm = game.settings.learners, set(game.rewarding.counted) <= {"harm"}
    gained, over = np.zeros((state.n, len(learners))), state.ended
    rows, ended, last = np.flatnonzero(~over), [np.flatnonzero(over)], [state.take(over)]
    now, discount, number = state.take(rows), 1.0, 0
    while len(rows):
        after, step = game.step(now, decide(Moment(now, game.observe_alike(now, learners), rows, number)))
        gained[rows] += discount * step.reward[:, learners - 1]
        over = after.ended
        if only_harm and number >= at_least:
            over |= stands_for_good(now, after, game.settings.harm_count.weights)
        if over.any():
            ended.append(rows[over])
            last.append(after.take(over))
            rows, after = rows[~over], after.take(~over)
        now, discount, number = after, discount * gamma, number + 1
    return gained, State.join(last).take(np.argsort(np.concatenate(ended)))


def stands_for_good(before: State, after: State, weights: Floats) -> Bools:
    """Whether all vehicles of a world stand and will never move again, if actions depend only on observations, [n].

    True if this step changed nothing, no vehicle waits for its latency or a message, and no vehicle presses against one
    that it could still push (found with ``weights`` [6] of the count of harm). Always False if scripts, messages or a
    shield have a memory.
    """
    out = np.zeros(after.n, np.bool_)
    if not after.memories:
        find_standing(before.line, after.line, after.car, after.know, before.clock, weights, out)
    return out


@large
def find_standing(
    before: Floats, line: Floats, car: Floats, know: Floats, clock: Floats, weights: Floats, out: Bools
) -> None:
    """Write to ``out`` [n] whether nothing changed in this step, and no vehicle waits for its latency or for a message.

    ``before``, ``line``: ``State.line`` before and after the step. ``car``, ``know``: as in ``State`` after the step,
    ``clock``: before. ``weights``: as for ``stands_for_good``.
    """
    bodies = line.shape[2]
    for k in range(len(out)):
        time = clock[k, TIME]
        grown = beside_harm(line[k], weights) - beside_harm(before[k], weights)
        stands = grown == 0.0
        for i in range(bodies):
            stands = stands and before[k, SPEED, i] == 0.0 and line[k, SPEED, i] == 0.0
        if stands:
            for i in range(bodies):
                stands = stands and before[k, GAP, i] == line[k, GAP, i] and before[k, HIT, i] == line[k, HIT, i]
                stands = stands and abs(before[k, FORCE, i] - line[k, FORCE, i]) < ROUNDING_MPS2
                stands = stands and (car[k, LATENCY, i] < time or car[k, LATENCY, i] == math.inf)
                for j in range(bodies):
                    stands = stands and (know[k, i, j] < time or know[k, i, j] == math.inf)
        out[k] = stands


def moving(state: State) -> Bools:
    """Whether any vehicle of a world moves, [n]."""
    return np.asarray(state.line[:, SPEED].any(axis=1))
