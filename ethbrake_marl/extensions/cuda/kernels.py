"""Kernels in which each thread simulates one world: it copies the world into its own memory and calls the core there.

``step_worlds`` and ``observe_worlds`` are the core's functions; they are called with a batch of one world, so no rule
is written a second time. The same text runs on a GPU (``device``), and on a processor, one world after the other.

In arrays that all threads share, the index of the world is last, so that neighbouring threads read neighbouring
numbers. n: worlds, B: bodies, L: learners, F: features.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.observe import N_NEIGHBOUR, N_OBSTACLE, N_OWN, N_ROLE, observe_worlds
from ethbrake_marl.episode.state import CLOCK_COLUMNS, ENDED
from ethbrake_marl.episode.step import OUT_ROWS, step_worlds
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.layout import CAR_ROWS, LINE_ROWS, SCRATCH_ROWS

# what a launch of `play` does
STEP_MODE = 0  # a step; an episode that has ended stays as it is
RENEW = 1  # a step; an episode that ends is replaced by one in the next world of the pool
BEGIN = 2  # replaces every episode
LOOK = 3  # only observes

# what may be wrong in a world
FINE, NO_ACTION, PHYSICS_FAILED = 0, 1, 2


class StoredEpisodes(NamedTuple):
    """Episodes of n worlds: the arrays of ``State``, with the index of the world last."""

    line: Any  # [LINE_ROWS, B, n]
    car: Any  # [CAR_ROWS, B, n]
    clock: Any  # [CLOCK_COLUMNS, n]
    know: Any  # [B, B, n]
    wanted: Any  # [B, n]


class Results(NamedTuple):
    """Results of one launch in n worlds."""

    out: Any  # [OUT_ROWS, n] rows as in `Step.out`
    reward: Any  # [n] of every learner
    observations: Any  # [n, L, F] float32
    status: Any  # [n] FINE, NO_ACTION or PHYSICS_FAILED


class KernelSettings(NamedTuple):
    """Settings of a game that a step needs, as in ``StepSettings``."""

    learners: Any  # [L]
    time_step_s: Any
    harm: Any
    terminal: Any
    weights: Any  # [6]


class ViewArrays(NamedTuple):
    """Arrays that say which features the learners observe, as in ``View.plan``."""

    offsets: Any
    role: Any
    obstacle: Any
    places: Any
    scaling: Any  # [3, F]


class ThreadMemory(NamedTuple):
    """Working memory of one thread: one world, the actions in it, and the results of a step."""

    line: Any
    car: Any
    clock: Any
    know: Any
    wanted: Any
    actions: Any
    scratch: Any
    out: Any
    reward: Any
    value: Any
    seen: Any  # float32, all others float64


def memory_of(bodies: int, learners: int, features: int, neighbours: int) -> ThreadMemory:
    """Working memory of one thread, as arrays on a processor."""
    return ThreadMemory(
        line=np.zeros((1, LINE_ROWS, bodies)),
        car=np.zeros((1, CAR_ROWS, bodies)),
        clock=np.zeros((1, CLOCK_COLUMNS)),
        know=np.zeros((1, bodies, bodies)),
        wanted=np.zeros((1, bodies)),
        actions=np.zeros((1, learners)),
        scratch=np.zeros((SCRATCH_ROWS, bodies)),
        out=np.zeros((OUT_ROWS, 1)),
        reward=np.zeros((1, bodies - 1)),
        value=np.zeros(N_OWN + N_NEIGHBOUR * neighbours + N_ROLE + N_OBSTACLE),
        seen=np.zeros((1, learners, features), np.float32),
    )


@large
def load_world(t, stored, memory):
    """Copy world t of ``stored`` to the memory of this thread."""
    for i in range(memory.wanted.shape[1]):
        for row in range(memory.line.shape[1]):
            memory.line[0, row, i] = stored.line[row, i, t]
        for row in range(memory.car.shape[1]):
            memory.car[0, row, i] = stored.car[row, i, t]
        for j in range(memory.wanted.shape[1]):
            memory.know[0, i, j] = stored.know[i, j, t]
        memory.wanted[0, i] = stored.wanted[i, t]
    for row in range(memory.clock.shape[1]):
        memory.clock[0, row] = stored.clock[row, t]


@large
def save_world(t, stored, memory, is_new):
    """Copy the world from the memory of this thread to world t of ``stored``; if it ``is_new``, also its constants."""
    for i in range(memory.wanted.shape[1]):
        for row in range(memory.line.shape[1]):
            stored.line[row, i, t] = memory.line[0, row, i]
        stored.wanted[i, t] = memory.wanted[0, i]
        if is_new:
            for row in range(memory.car.shape[1]):
                stored.car[row, i, t] = memory.car[0, row, i]
            for j in range(memory.wanted.shape[1]):
                stored.know[i, j, t] = memory.know[0, i, j]
    for row in range(memory.clock.shape[1]):
        stored.clock[row, t] = memory.clock[0, row]


@large
def play_world(t, memory, stored, pool, following, actions, results, settings, view, mode):
    """Do what ``mode`` says in world t: take a step, begin an episode, or nothing. Then observe the world.

    ``memory`` is the memory of this thread. ``stored`` contains the running episodes, ``pool`` the worlds in which
    episodes begin; ``following`` [n] is the number of the world in the pool in which the next episode begins.
    ``actions`` [n, L] float32 are clipped to [-1, 1]. If an action is NaN, nothing moves in this world and
    ``results.status`` says so. ``settings``: a ``KernelSettings``. ``view``: a ``ViewArrays``.
    """
    load_world(t, stored, memory)
    is_new = mode == BEGIN
    if mode in (STEP_MODE, RENEW):
        runs = memory.clock[0, ENDED] == 0.0
        for j in range(memory.actions.shape[1]):
            action = float(actions[t, j])
            memory.actions[0, j] = 1.0 if action > 1.0 else (-1.0 if action < -1.0 else action)
        refused, failed = step_worlds(
            memory.line, memory.clock, memory.wanted, False, 0, 1, memory.line, memory.car, memory.clock, memory.wanted,
            memory.actions, memory.scratch, memory.out, memory.reward, settings.learners,
            settings.time_step_s, settings.harm, settings.terminal, settings.harm_count.weights,
        )  # fmt: skip
        for row in range(memory.out.shape[0]):
            results.out[row, t] = memory.out[row, 0] if refused < 0 else 0.0
        results.reward[t] = memory.reward[0, 0] if refused < 0 else 0.0
        if failed >= 0:
            results.status[t] = PHYSICS_FAILED
        elif refused >= 0 and runs:
            results.status[t] = NO_ACTION
        is_new = mode == RENEW and memory.clock[0, ENDED] == 1.0
    if is_new:
        load_world(following[t], pool, memory)
        following[t] = (following[t] + following.shape[0]) % pool.wanted.shape[1]
    if mode != LOOK:
        save_world(t, stored, memory, is_new)
    observe_worlds(
        memory.line, memory.car, memory.clock, memory.know, settings.learners, view.offsets, view.role, view.obstacle,
        view.places, view.scaling, memory.value, memory.seen,
    )  # fmt: skip
    for j in range(memory.seen.shape[1]):
        for f in range(memory.seen.shape[2]):
            results.observations[t, j, f] = memory.seen[0, j, f]


@large
def play_each(memory, stored, pool, following, actions, results, settings, view, mode, n):
    """Call ``play_world`` for n worlds, one after the other, on a processor."""
    for t in range(n):
        play_world(t, memory, stored, pool, following, actions, results, settings, view, mode)
