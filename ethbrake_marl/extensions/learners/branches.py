"""Branches of running episodes: the same moment, played on to the end in more than one way.

A learner's action is moved by an offset for a few steps; then the policy goes on in closed loop. Two branches differ
by the offset alone. Everything else in them is the same, to the bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.state import State
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.game.observations import Observations
from ethbrake_marl.physics.columns import columns
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Bools, Floats, Ints
from ethbrake_marl.policies.network_spec import Float32s

ROUNDING_MPS2 = 1e-5  # a command that differs by less is the same: networks round by the size of their batch

Act = Callable[[Observations], Float32s]  # observations [rows, F] -> actions [rows] in [-1, 1]

Decide = Callable[[Observations, Ints, int], Floats]  # what is seen [m, L, F] in rows [m], steps made -> actions [m, L]


class Offsets(NamedTuple):
    """How one learner's actions in each row differ from those of its policy."""

    learner: Ints  # [n] place among the learners
    size: Floats  # [n] added to its action, which stays in [-1, 1]
    steps: Ints  # [n] for so many steps, at least 1


def play_to_the_end(engine: Engine, act: Act, offsets: Offsets, gamma: float) -> tuple[Floats, Floats]:
    """Play every row to the end of its episode. Return what its moved learner gains, and how far it was moved.

    Args:
        engine: branches, which this changes.
        act: drives all learners, from their observations alone.
        offsets: the learner whose actions are moved in each row, how far, and for how many steps.
        gamma: discount of one time step.

    Returns the return [n] of the moved learner from now on (NaN for a row that could not be advanced), and the sum of
    its offsets [n], each cut so that the action stays in [-1, 1]. If the reward is harm alone, a row ends as soon as
    nothing can change any more.

    """
    moved, most = np.zeros(engine.n), int(offsets.steps.max(initial=0))

    def decide(seen: Observations, rows: Ints, number: int) -> Floats:
        wanted = act(seen.reshape(-1, seen.shape[2])).astype(np.float64).reshape(seen.shape[:2])
        some = np.flatnonzero(number < offsets.steps[rows])  # whose offset still lasts
        lasting = rows[some]
        before = wanted[some, offsets.learner[lasting]]
        after = np.clip(before + offsets.size[lasting], -1.0, 1.0)
        wanted[some, offsets.learner[lasting]] = after
        moved[lasting] += after - before
        return wanted

    gained = play_on(engine, decide, gamma, at_least=most)
    return gained[np.arange(engine.n), offsets.learner], moved


def play_on(engine: Engine, decide: Decide, gamma: float, *, at_least: int = 0) -> Floats:
    """Play every row to the end of its episode, and for ``at_least`` so many steps. Return each learner's gain [n, L].

    ``decide`` returns the learners' actions. The rest is as for ``play_to_the_end``.
    """
    vehicles = np.array(engine.learners, np.int64)
    gained, actions = np.zeros((engine.n, len(vehicles))), np.zeros((engine.n, len(vehicles)))
    running, discount, number = np.flatnonzero(~engine.ended), 1.0, 0
    only_harm = set(engine.reward_terms) <= {"harm"}
    while len(running):
        before = engine.packed.state.take(running, axis=0)
        actions[running] = decide(engine.observe_all(vehicles, running), running, number)
        step = engine.step(actions)
        gained[running] += discount * step.reward[running][:, vehicles]
        goes_on = ~engine.ended[running]
        if only_harm and number >= at_least:
            goes_on &= ~_stands_for_good(engine, before, running)
        running = running[goes_on]
        discount *= gamma
        number += 1
    gained[list(engine.roster.failed)] = np.nan
    return gained


def visit(engine: Engine, act: Act) -> tuple[Observations, State]:
    """Play every row to its end by ``act``. Return the observations at each decision [m, L, F], and the states [m]."""
    seen_then, moments = [], []

    def decide(seen: Observations, rows: Ints, number: int) -> Floats:
        seen_then.append(seen)
        moments.append(engine.moment().take(rows))
        return act(seen.reshape(-1, seen.shape[2])).astype(np.float64).reshape(seen.shape[:2])

    play_on(engine, decide, 1.0)
    return np.concatenate(seen_then), State.join(moments)


def _stands_for_good(engine: Engine, before: Floats, rows: Ints) -> Bools:
    """Whether everything in these ``rows`` stands as it stood ``before`` [rows], and will stay so.

    A policy that observes the same does the same. Rows count only if no latency or news can change the observation.
    """
    if engine.packed.has_messages or engine.in_pieces:
        return np.zeros(len(rows), np.bool_)  # what is still on its way may change what it sees, or what holds
    (state, params), stands = engine.packed, np.empty(len(rows), np.bool_)
    find_standing(state, before, params, rows, stands)
    return stands


@compiled
def find_standing(state: Floats, before: Floats, params: Floats, rows: Ints, stands: Bools) -> None:
    """Fill ``stands`` [m] for ``rows`` [m] of ``state``, which stood as ``before`` [m]."""
    column = columns(state)
    by_link = params.shape[1] > column.own_latency
    for m in range(rows.shape[0]):
        k, same = rows[m], True
        for c in range(column.speed, column.command):
            same = same and before[m, c] == 0.0 and state[k, c] == 0.0
        if same:
            for c in range(column.gap, column.harm):
                same = same and state[k, c] == before[m, c]
            for c in range(column.command, column.previous):
                same = same and abs(state[k, c] - before[m, c]) < ROUNDING_MPS2
            for c in range(column.latency, params.shape[1]):
                known = column.latency <= c < column.mass or (by_link and c >= column.news)
                same = same and (not known or params[k, c] < before[m, column.time] or np.isinf(params[k, c]))
        stands[m] = same


def other_count(count: HarmCount) -> HarmCount:
    """The harm count that is not ``count``."""
    return "total" if count == "first" else "first"


def moving_rows(moments: State) -> Bools:
    """Whether some vehicle moves, for each row. A row in which everything stands teaches nothing."""
    column = moments.packed.column
    moving: Bools = (moments.motion[:, column.speed : column.command] != 0.0).any(axis=1)
    return moving
