"""Branches: copies of running episodes that are played to their end with other actions.

Branches of one state have the same random numbers, so they differ only in the actions. n: branches, or worlds; m: those
that still run; L: learners, front to rear; F: features.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import State
from ethbrake_marl.motion.layout import FORCE, GAP, HIT, LATENCY, SPEED, Bools, Floats, Ints
from ethbrake_marl.policies.layers import Float32s

ROUNDING_MPS2 = 1e-5  # forces closer than this are equal: a network's rounding depends on its batch size

Act = Callable[[Observations], Float32s]  # observations [rows, F] -> actions [rows] in [-1, 1]


class Moment(NamedTuple):
    """A decision in all branches that still run."""

    state: State
    seen: Observations  # [m, L, F]
    rows: Ints  # [m] number of each branch, from 0
    number: int  # steps so far

    def ask(self, act: Act) -> Floats:
        """Return the actions of all learners by one policy, [m, L] float64."""
        return act(self.seen.reshape(-1, self.seen.shape[2])).astype(np.float64).reshape(self.seen.shape[:2])


Decide = Callable[[Moment], Floats]  # returns the learners' actions, [m, L]


class Offsets(NamedTuple):
    """What is added to the actions of one learner in the first steps of every branch."""

    learner: Ints  # [n] from 0, the foremost
    size: Floats  # [n] offset; the sum is clipped to [-1, 1]
    steps: Ints  # [n] number of steps with the offset


def play_on(game: Game, state: State, decide: Decide, gamma: float, *, at_least: int = 0) -> tuple[Floats, State]:
    """Play episodes to the end; return each learner's discounted return, [n, L], and the last states.

    ``decide`` is asked for those that still run. If harm is the only term of the reward, an episode also ends once
    everything stands for good, but not in its first ``at_least`` steps.
    """
    learners = game.rules.learners
    gained, last, rows = np.zeros((state.n, len(learners))), state, np.flatnonzero(~state.ended)
    only_harm = set(game.rewarding.counted) <= {"harm"}
    now, discount, number = state.take(rows), 1.0, 0
    while len(rows):
        after, step = game.step(now, decide(Moment(now, game.observe_alike(now, learners), rows, number)))
        gained[rows] += discount * step.reward[:, learners - 1]
        over = after.ended
        if only_harm and number >= at_least:
            over |= stands_for_good(now, after)
        if over.any():
            last = last.put(rows[over], after.take(over), donate=last is not state)
            rows, after = rows[~over], after.take(~over)
        now, discount, number = after, discount * gamma, number + 1
    return gained, last


def stands_for_good(before: State, after: State) -> Bools:
    """Return where all vehicles stand, and a policy that only looks at its observation never moves one again, [n].

    There nothing has changed in this step, and nobody waits for a latency or for news. It is never sure with scripts or
    messages that have a memory.
    """
    stands = ~(before.line[:, SPEED].any(axis=1) | after.line[:, SPEED].any(axis=1))
    if after.memories or not stands.any():
        return np.zeros(after.n, np.bool_)
    time = before.time_s[:, np.newaxis]
    late = after.car[:, LATENCY]
    stands &= (before.line[:, (GAP, HIT)] == after.line[:, (GAP, HIT)]).all(axis=(1, 2))
    stands &= (np.abs(after.line[:, FORCE] - before.line[:, FORCE]) < ROUNDING_MPS2).all(axis=1)
    stands &= ((late < time) | np.isinf(late)).all(axis=1)
    known = (after.know < time[:, np.newaxis]) | np.isinf(after.know)
    return np.asarray(stands & known.all(axis=(1, 2)))


def play_to_the_end(game: Game, state: State, act: Act, offsets: Offsets, gamma: float) -> tuple[Floats, Floats]:
    """Let a policy play branches with offsets to the end.

    Returns the return of the learner with the offset, [n], and by how much the offset has moved its actions, after
    clipping, summed over the steps, [n].
    """
    moved = np.zeros(state.n)

    def decide(now: Moment) -> Floats:
        actions = now.ask(act)
        some = np.flatnonzero(now.number < offsets.steps[now.rows])
        row = now.rows[some]
        learner = offsets.learner[row]
        before = actions[some, learner]
        after = np.clip(before + offsets.size[row], -1.0, 1.0)
        actions[some, learner] = after
        moved[row] += after - before
        return actions

    gained, _ = play_on(game, state, decide, gamma, at_least=int(offsets.steps.max(initial=0)))
    return gained[np.arange(state.n), offsets.learner], moved


def moving(state: State) -> Bools:
    """Return where a vehicle moves, [n]; elsewhere no action has an effect."""
    return np.asarray(state.line[:, SPEED].any(axis=1))


def other_count(count: str) -> str:
    """Return the other count of harm."""
    return "total" if count == "first" else "first"
