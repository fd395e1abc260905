"""Prediction of the harm if vehicles hold constant commands, without stops at decisions.

The prediction is fast, but rounds differently from an episode; ``episode.play`` has the same bits as the episode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ethbrake_marl.episode.counts import AnyCount, HarmCount, amount_so_far, pair_amount
from ethbrake_marl.episode.state import HORIZON, State, require
from ethbrake_marl.episode.step import note_motion
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.forces import capacity
from ethbrake_marl.motion.interval import FAILED, STOPPED, move_line
from ethbrake_marl.motion.layout import (
    BRAKING,
    FIRST,
    LINE_ROWS,
    NEW_FIRST,
    NEW_TOTAL,
    TOTAL,
    Floats,
    Ints,
    scratch_for,
)


@large
def hold_worlds(inputs, weights, tie_weights, out):
    """Write the harm (m2/s2) of the trials to ``out`` [2, n, C].

    Row 0 is the harm in the count with the weights ``weights`` [6], row 1 in the count with ``tie_weights`` [6].
    ``inputs``: ``kernel_inputs``.
    """
    line, car, wanted, bodies, trials, time, until, horizon, memory = inputs
    for k in range(trials.shape[0]):
        for j in range(trials.shape[1]):
            failed = hold_world(
                line[k], car[k], wanted[k], bodies, trials[k, j], time[k], until[k], horizon[k], memory,
                (weights, math.inf),
            )  # fmt: skip
            out[0, k, j] = math.inf if failed else amount_so_far(memory[1], weights)
            out[1, k, j] = math.inf if failed else amount_so_far(memory[1], tie_weights)


@kernel
def exceeds(line, scratch, limit):
    """Whether the harm so far, within an interval, is above a limit; ``limit``: the count's weights [6], and m2/s2.

    The sum has the order of ``amount_so_far``, and no summand ever falls: so the harm at the end is above the limit,
    too, also after rounding.
    """
    (weights, most), amount = limit, 0.0
    for p in range(line.shape[1] - 1):
        first, total = line[FIRST, p], line[TOTAL, p]
        line[FIRST, p], line[TOTAL, p] = first + scratch[NEW_FIRST, p], total + scratch[NEW_TOTAL, p]
        amount += pair_amount(line, p, weights)
        line[FIRST, p], line[TOTAL, p] = first, total
    return amount > most


@kernel
def hold_world(line, car, wanted, bodies, trial, time, until, horizon, memory, limit):
    """Write the line at ``until`` to ``memory`` if ``bodies`` hold the commands ``trial`` [B] (m/s2), in one world.

    Returns whether the harm exceeds the ``limit`` (``exceeds``), or a check of the physics failed. Other arguments: a
    row of ``kernel_inputs``.
    """
    scratch, line_copy, commands = memory
    for row in range(line_copy.shape[0]):
        for i in range(len(commands)):
            line_copy[row, i] = line[row, i]
    for i in range(len(commands)):
        commands[i] = wanted[i]
    for b in range(len(bodies)):
        commands[bodies[b]] = trial[b]
    outcome = move_line(line_copy, car, commands, scratch, time, until, exceeds, limit)
    if until >= horizon:
        note_motion(line_copy, car)
    return outcome in (FAILED, STOPPED)


@kernel
def repeats(trials, j):
    """Whether the trial ``j`` equals an earlier one; ``trials`` [M, C, B] belong to the M states of one world."""
    for earlier in range(j):
        same = True
        for m in range(trials.shape[0]):
            for b in range(trials.shape[2]):
                same = same and trials[m, earlier, b] == trials[m, j, b]
        if same:
            return True
    return False


@large
def choose_worlds(inputs, weights, best, least):
    """Write the number of the best trial to ``best`` [n], and its harm (m2/s2) to ``least`` [n].

    Before, ``least`` is the harm that a trial must stay below. ``inputs`` (``kernel_inputs``) have a row for each of
    the M possible states of a world. Harm never falls, so the search ends once ``least`` is the harm so far, and what
    can only be worse is not simulated.
    """
    line, car, wanted, bodies, trials, time, until, horizon, memory = inputs
    M = len(line) // len(least)
    for k in range(len(least)):
        states, so_far = range(k * M, (k + 1) * M), 0.0
        for row in states:
            so_far = max(so_far, amount_so_far(line[row], weights))
        for j in range(trials.shape[1]):
            if least[k] <= so_far:
                break
            if repeats(trials[k * M : (k + 1) * M], j):
                continue
            largest = 0.0
            for row in states:
                if largest >= least[k]:
                    break
                limit = weights, least[k]
                worse = hold_world(
                    line[row], car[row], wanted[row], bodies, trials[row, j], time[row], until[row], horizon[row],
                    memory, limit,
                )  # fmt: skip
                largest = max(largest, math.inf if worse else amount_so_far(memory[1], weights))
            if largest < least[k]:
                best[k], least[k] = j, largest


@large
def descend_worlds(inputs, shares, rounds, weights, best, least):
    """Write the commands that ``descend`` chooses to the ``wanted`` of the inputs, and their harm (m2/s2) to ``least``.

    ``inputs``: ``kernel_inputs``, of which the trials, [1, C, 1] for C ``shares``, are working memory, as is ``best``
    [1].
    """
    line, car, wanted, bodies, trials, time, until, horizon, memory = inputs
    for k in range(len(least)):
        least[k] = 0.0
        for i in range(wanted.shape[1]):
            wanted[k, i] = -capacity(car[k], BRAKING, i)
        for turn in range(rounds * len(bodies)):
            b = turn % len(bodies)
            for j in range(len(shares)):
                trials[0, j, 0] = -capacity(car[k], BRAKING, bodies[b]) * shares[j]
            best[0], least[k], row = 0, math.inf, slice(k, k + 1)
            moments = time[row], until[row], horizon[row]
            world = line[row], car[row], wanted[row], bodies[b : b + 1], trials, *moments, memory
            choose_worlds(world, weights, best, least[row])
            wanted[k, bodies[b]] = trials[0, best[0], 0]


def hold(
    state: State, wanted: Floats, bodies: Sequence[int], trials: Floats, until_s: float | Floats, harm_count: AnyCount
) -> Floats:
    """Harm if ``bodies`` hold constant commands until ``until_s`` (one time or [n]), [2, n, C] m2/s2.

    The first row is the harm in ``harm_count``, the second the harm in the count that breaks ties. ``trials`` [n, C, B]
    are C sets of commands for the B bodies (m/s2); all other bodies hold ``wanted`` [n, N + 1] (m/s2).
    """
    count, out = HarmCount.of(harm_count), np.empty((2, *trials.shape[:2]))
    inputs = kernel_inputs(state, wanted, bodies, trials, until_s)
    hold_worlds(inputs, count.weight_array, count.tie_breaker.weight_array, out)
    return out


def choose(
    state: State,
    wanted: Floats,
    bodies: Sequence[int] | Ints,
    trials: Floats,
    until_s: float | Floats,
    count: HarmCount,
    below: Floats,
) -> tuple[Ints, Floats]:
    """Number of the first trial with the least harm, [n], and this harm, [n] m2/s2.

    Only harm under ``below`` [n] (m2/s2) counts; where there is none, the results are 0 and ``below``. Other arguments
    as in ``hold``, but ``state`` may contain M possible states of each world, in consecutive rows; then the largest
    harm over these states counts.
    """
    best, least = np.zeros(len(below), np.int64), below.copy()
    choose_worlds(kernel_inputs(state, wanted, bodies, trials, until_s), count.weight_array, best, least)
    return best, least


def kernel_inputs(
    state: State, wanted: Floats, bodies: Sequence[int] | Ints, trials: Floats, until_s: float | Floats
) -> tuple[Any, ...]:
    """Trials as the kernels need them. Raises ``InvalidInput`` for worlds of another physics.

    Each of C trials starts from ``line``: ``bodies`` [B] hold the commands ``trials`` [n, C, B] (m/s2), all others hold
    ``wanted``, from ``time`` to ``until`` (s, [n] each). Motion then has a price, unless it is before the ``horizon``
    (s, [n]). ``line``, ``car`` and ``wanted`` are arrays of a ``State``. ``memory`` is working memory: scratch of the
    physics, one line, and the commands of this line.
    """
    features = "e_v2x_bm other than pairwise, shields other than episode:pairwise"
    require(state, f"a plan of constant commands ({features})", simulates=True)
    until, bodies = np.full(state.n, until_s, np.float64), np.asarray(bodies, np.int64)
    time, horizon, trials = state.time_s.copy(), state.clock[:, HORIZON].copy(), np.ascontiguousarray(trials)
    return state.line, state.car, wanted, bodies, trials, time, until, horizon, memory_for(wanted.shape[1])


def memory_for(bodies: int) -> tuple[Floats, Floats, Floats]:
    """Working memory of the kernels for lines of this number of ``bodies``: the last entry of ``kernel_inputs``."""
    return scratch_for(bodies), np.zeros((LINE_ROWS, bodies)), np.zeros(bodies)


def descend(
    state: State, bodies: Sequence[int], shares: Floats, rounds: int, until_s: float | Floats, count: HarmCount
) -> tuple[Floats, Floats]:
    """Choose a constant share of the brakes for each of ``bodies``, by coordinate descent; all others brake fully.

    All ``bodies`` start from full braking and take turns, ``rounds`` times: each picks the best of ``shares`` (in [0,
    1]) for the others' latest choice. Commands are held until ``until_s``. Returns the commands of all bodies, [n, N +
    1] m/s2, and the harm of the episode, [n] m2/s2.
    """
    commands, least = np.empty(state.wanted.shape), np.empty(state.n)
    inputs = kernel_inputs(state, commands, bodies, np.empty((1, len(shares), 1)), until_s)
    descend_worlds(inputs, shares, rounds, count.weight_array, np.zeros(1, np.int64), least)
    return commands, least
