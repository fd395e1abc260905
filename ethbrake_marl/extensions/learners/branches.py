"""Branches: copies of a running episode. Each copy is simulated to its end with slightly different actions.

In a branch, an offset (a small number) is added to one learner's actions for a few steps. After these steps the
policy's actions are used without an offset. Two branches from the same state differ only in the offset: they use the
same random numbers, so the same messages are lost.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.state import State
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.game.objectives import objective_harm, objectives_of
from ethbrake_marl.game.observations import Observations
from ethbrake_marl.physics.columns import columns
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Bools, Floats, Ints
from ethbrake_marl.policies.network_spec import Float32s

ROUNDING_MPS2 = 1e-5  # commands closer than this are equal: a network's rounding depends on its batch size

Act = Callable[[Observations], Float32s]  # observations [rows, F] -> actions [rows] in [-1, 1]

Decide = Callable[[Observations, Ints, int], Floats]  # (observations [m, L, F], rows [m], steps so far) -> [m, L]


class Offsets(NamedTuple):
    """Offsets that are added to the actions of one learner in each of n branches (copies of a running episode).

    For example, ``learner = [0, 0]``, ``size = [0.1, -0.1]`` and ``steps = [3, 3]`` describe two branches. In the first
    branch the foremost learner brakes less for three steps, in the second branch it brakes harder for three steps.
    """

    learner: Ints  # [n] index, among the learners, of the learner with the offset (0 = foremost)
    size: Floats  # [n] offset added to the actions of this learner; the sum is clipped to [-1, 1]
    steps: Ints  # [n] number of steps with the offset, counted from the start of the branch


def play_to_the_end(engine: Engine, act: Act, offsets: Offsets, gamma: float) -> tuple[Floats, Floats]:
    """Simulate every branch (copy of a running episode) to its end, with an offset added to one learner's actions.

    Args:
        engine: engine that simulates the n branches; its state is changed.
        act: policy of all learners: a function from observations to actions.
        offsets: for each branch, the offset, the learner that gets the offset, and the number of steps with this
            offset.
        gamma: discount factor per time step.

    Returns two arrays with one number for each branch, [n]. The first array contains the discounted return of the
    learner with the offset, from the start of the branch on (NaN if the simulation failed). The second array contains
    the sum, over the steps, of the difference that the offset makes to the action (after clipping to [-1, 1]). If harm
    is the only term of the reward, a branch ends as soon as all its vehicles are at rest and will stay at rest.

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

    L is the number of learners, F the number of features of an observation, and m the number of worlds whose
    simulation has not ended.

    Args:
        engine: engine that simulates the n worlds; its state is changed.
        decide: function that returns the actions of the learners, [m, L]. The three arguments of ``decide`` are the
            observations [m, L, F], the indices of the m worlds, and the number of steps so far.
        gamma: discount factor per time step.
        at_least: for this number of steps from the start, no simulation ends early, even if all vehicles are at rest.

    If harm is the only term of the reward, the simulation of a world ends as soon as all its vehicles are at rest and
    will stay at rest. If the simulation of a world fails, its return is NaN.

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
    """Simulate all worlds of an engine to the end, and return the observations and states at all decisions.

    ``act`` is the policy of all learners. Returns the observations [m, L, F] and the states of the worlds at all
    decisions, ordered by time. Here m is the number of decisions in all worlds together. L is the number of learners, F
    the number of features of an observation.
    """
    seen_then, moments = [], []

    def decide(seen: Observations, rows: Ints, number: int) -> Floats:
        seen_then.append(seen)
        moments.append(engine.moment().take(rows))
        return act(seen.reshape(-1, seen.shape[2])).astype(np.float64).reshape(seen.shape[:2])

    play_on(engine, decide, 1.0)
    return np.concatenate(seen_then), State.join(moments)


def _stands_for_good(engine: Engine, before: Floats, rows: Ints) -> Bools:
    """Return, for each of m worlds, whether all its vehicles are at rest and will stay at rest, [m] bool.

    ``rows`` [m] are the indices of the worlds in the engine; ``before`` [m, columns] is the packed state of these
    worlds one time step earlier. For a world in which a latency has not elapsed, or whose state (apart from the time)
    has changed in this step, the result is False. When a latency elapses, the observation may change, so that a policy
    may move a vehicle again.
    """
    if engine.packed.has_messages or engine.in_pieces:
        return np.zeros(len(rows), np.bool_)  # a message may still change the observation, or a profile the command
    (state, params), stands = engine.packed, np.empty(len(rows), np.bool_)
    find_standing(state, before, params, rows, stands)
    return stands


@compiled
def find_standing(state: Floats, before: Floats, params: Floats, rows: Ints, stands: Bools) -> None:
    """Write into ``stands`` [m], for each of m worlds, whether all its vehicles are at rest and will stay at rest.

    Args:
        state: packed state of all worlds of an engine: one row of numbers per world.
        before: [m, columns] packed state of the m worlds one time step earlier.
        params: packed constants of all worlds of the engine: one row per world, with masses, latencies and so on.
        rows: [m] indices of the worlds to check, in ``state`` and ``params``.
        stands: [m] bool array into which the result is written (True: all vehicles stay at rest).

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
    """Return, for each of the L learners of an engine, the harm (up to the present time) that this learner should make
    small, [n, L] m2/s2.

    If the reward has objectives, each learner should make the value of its own objective small. If the reward has no
    objectives, each learner should make the harm of the whole line small. ``count`` is the count of harm: ``first``
    (each pair's first impact) or ``total`` (all impacts).
    """
    declared, shape = engine.reward.objective, (engine.n, len(engine.learners))
    if declared is None:
        return np.broadcast_to(engine.ledger.world_harm(count)[:, np.newaxis], shape)
    harm = objective_harm(engine.ledger, count, objectives_of(declared, engine.scenario.vehicles))
    return harm[:, list(engine.learners)]


def other_count(count: HarmCount) -> HarmCount:
    """Return the harm count other than ``count``: ``total`` for ``first``, and ``first`` for ``total``."""
    return "total" if count == "first" else "first"


def moving_rows(moments: State) -> Bools:
    """Return, for each of the n states ``moments``, whether at least one vehicle moves, [n] bool.

    A training run ignores states in which all vehicles are at rest, because actions have no effect there.
    """
    column = moments.packed.column
    moving: Bools = (moments.motion[:, column.speed : column.command] != 0.0).any(axis=1)
    return moving
