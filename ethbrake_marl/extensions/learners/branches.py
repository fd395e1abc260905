"""Branches: copies of a running episode, each of which is simulated to its end with slightly different actions.

In a branch, an offset is added to one learner's actions for a few steps; then the policy acts without an offset. Two
branches from the same state differ only in the offset: they use the same random numbers, so the same messages are lost.

L is the number of learners, F the number of features of an observation, and m the number of worlds (or, in ``visit``,
of decisions in all worlds together). ``engine`` simulates n worlds or branches; the functions that simulate change its
state. ``act`` is the policy of all learners. ``gamma`` is the discount factor per time step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.engine.state import State
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.game.objectives import objective_harm, objectives_of
from ethbrake_marl.first_edition.game.observations import Observations
from ethbrake_marl.first_edition.physics.columns import columns
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints
from ethbrake_marl.first_edition.policies.network_spec import Float32s

ROUNDING_MPS2 = 1e-5  # commands closer than this are equal: a network's rounding depends on its batch size

Act = Callable[[Observations], Float32s]  # observations [rows, F] -> actions [rows] in [-1, 1]

Decide = Callable[[Observations, Ints, int], Floats]  # (observations [m, L, F], rows [m], steps so far) -> [m, L]


class Offsets(NamedTuple):
    """Offsets that are added to the actions of one learner in each of n branches.

    For example, ``learner = [0, 0]``, ``size = [0.1, -0.1]`` and ``steps = [3, 3]`` describe two branches. In the first
    branch the foremost learner brakes less for three steps, in the second branch it brakes harder for three steps.
    """

    learner: Ints  # [n] index, among the learners, of the learner with the offset (0 = foremost)
    size: Floats  # [n] offset added to the actions of this learner; the sum is clipped to [-1, 1]
    steps: Ints  # [n] number of steps with the offset, counted from the start of the branch


def play_to_the_end(engine: Engine, act: Act, offsets: Offsets, gamma: float) -> tuple[Floats, Floats]:
    """Simulate every branch to its end, with an offset added to one learner's actions.

    Returns two arrays [n]. The first is the discounted return of the learner with the offset, from the start of the
    branch on (NaN if the simulation failed). The second is the sum, over the steps, of the difference that the offset
    makes to the action after clipping to [-1, 1]. If harm is the only term of the reward, a branch ends as soon as all
    its vehicles are at rest and will stay at rest.
    """
    moved, most = np.zeros(engine.n), int(offsets.steps.max(initial=0))

    def decide(seen: Observations, rows: Ints, number: int) -> Floats:
        wanted = act(seen.reshape(-1, seen.shape[2])).astype(np.float64).reshape(seen.shape[:2])
        some = np.flatnonzero(number < offsets.steps[rows])  # rows whose offset still applies
        lasting = rows[some]
        before = wanted[some, offsets.learner[lasting]]
        after = np.clip(before + offsets.size[lasting], -1.0, 1.0)
        wanted[some, offsets.learner[lasting]] = after
        moved[lasting] += after - before
        return wanted

    gained = play_on(engine, decide, gamma, at_least=most)
    return gained[np.arange(engine.n), offsets.learner], moved


def play_on(engine: Engine, decide: Decide, gamma: float, *, at_least: int = 0) -> Floats:
    """Simulate all n worlds of an engine to the end, and return each learner's discounted return, [n, L].

    ``decide`` gets the observations [m, L, F], the indices of the m worlds whose simulation has not ended, and the
    number of steps so far; it returns the actions, [m, L].

    If harm is the only term of the reward, a simulation ends as soon as all vehicles are at rest and will stay at rest,
    but not in the first ``at_least`` steps. If the simulation of a world fails, its return is NaN.
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
    """Simulate all worlds to the end; return observations [m, L, F] and states at all decisions, ordered by time."""
    seen_then, moments = [], []

    def decide(seen: Observations, rows: Ints, number: int) -> Floats:
        seen_then.append(seen)
        moments.append(engine.moment().take(rows))
        return act(seen.reshape(-1, seen.shape[2])).astype(np.float64).reshape(seen.shape[:2])

    play_on(engine, decide, 1.0)
    return np.concatenate(seen_then), State.join(moments)


def _stands_for_good(engine: Engine, before: Floats, rows: Ints) -> Bools:
    """Return a mask [m]: True for worlds in which all vehicles are at rest and will stay at rest.

    ``rows`` [m] are the indices of the worlds in the engine; ``before`` [m, columns] is their packed state one time
    step earlier. For a world in which a latency has not elapsed, or whose state (apart from the time) has changed in
    this step, the result is False. When a latency elapses, the observation may change, so that a policy may move a
    vehicle again.
    """
    if engine.packed.has_messages or engine.in_pieces:
        return np.zeros(len(rows), np.bool_)  # a message may still change the observation, or a profile the command
    (state, params), stands = engine.packed, np.empty(len(rows), np.bool_)
    find_standing(state, before, params, rows, stands)
    return stands


@compiled
def find_standing(state: Floats, before: Floats, params: Floats, rows: Ints, stands: Bools) -> None:
    """Compiled part of ``_stands_for_good``: write the mask into ``stands`` [m].

    ``state`` and ``params`` are the packed state and constants of all worlds of the engine, one row per world.
    """
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


def counted_harm(engine: Engine, count: HarmCount) -> Floats:
    """Return the harm, up to the present time, that each learner should make small, [n, L] m2/s2.

    This is the value of the learner's own objective if the reward has objectives; otherwise it is the harm of the line.
    """
    declared, shape = engine.reward.objective, (engine.n, len(engine.learners))
    if declared is None:
        return np.broadcast_to(engine.ledger.world_harm(count)[:, np.newaxis], shape)
    harm = objective_harm(engine.ledger, count, objectives_of(declared, engine.scenario.vehicles))
    return harm[:, list(engine.learners)]


def other_count(count: HarmCount) -> HarmCount:
    """Return the harm count other than ``count``."""
    return "total" if count == "first" else "first"


def moving_rows(moments: State) -> Bools:
    """Return a mask [n]: True for states in which at least one vehicle moves.

    Training ignores states in which all vehicles are at rest, because actions have no effect there.
    """
    column = moments.packed.column
    moving: Bools = (moments.motion[:, column.speed : column.command] != 0.0).any(axis=1)
    return moving
