"""Predicts what would happen if vehicles held constant commands, without stops at decisions.

It is fast, but rounded differently than the episode; ``episode.play`` has the bits of the episode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ethbrake_marl.episode.counts import Count, amount_so_far, other_count, weights_of
from ethbrake_marl.episode.state import State, check_exact
from ethbrake_marl.episode.step import note_motion
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.forces import capacities
from ethbrake_marl.motion.interval import FAILED, move_line
from ethbrake_marl.motion.layout import BRAKING, Floats, scratch_for


@large
def hold_worlds(line, car, wanted, bodies, trials, time, until, weights, tie_weights, memory, out):
    """Write the harm to ``out`` [2, n, C] if ``bodies`` [B] hold the commands ``trials`` [n, C, B] (m/s2).

    The other bodies hold ``wanted``. Row 0 of ``out`` counts by ``weights`` [6], row 1 by ``tie_weights``. ``time``
    and ``until`` [n] (s): from when to when they hold. ``line``, ``car`` and ``wanted`` are arrays of a ``State``;
    ``memory``: working memory of the physics, of one line and of its commands, overwritten.
    """
    scratch, line_copy, commands = memory
    for k in range(trials.shape[0]):
        for i in range(len(commands)):
            commands[i] = wanted[k, i]
        for j in range(trials.shape[1]):
            for row in range(line_copy.shape[0]):
                for i in range(len(commands)):
                    line_copy[row, i] = line[k, row, i]
            for b in range(len(bodies)):
                commands[bodies[b]] = trials[k, j, b]
            failed = move_line(line_copy, car[k], commands, scratch, time[k], until[k]) == FAILED
            note_motion(line_copy)
            out[0, k, j] = math.inf if failed else amount_so_far(line_copy, weights)
            out[1, k, j] = math.inf if failed else amount_so_far(line_copy, tie_weights)


def hold(
    state: State, wanted: Floats, bodies: Sequence[int], trials: Floats, until_s: float | Floats, count: Count
) -> Floats:
    """Harm if ``bodies`` hold constant commands until ``until_s`` (one time or [n]), [2, n, C] m2/s2.

    The first row is the harm in ``count``, the second in the count that decides ties. ``trials`` [n, C, B] are C sets
    of commands for the B bodies (m/s2); the other bodies hold ``wanted`` [n, N + 1].
    """
    features = "e_v2x_bm other than pairwise, shields other than episode:pairwise, shaping"
    check_exact(state, f"a plan of constant commands ({features})")
    out, weights = np.empty((2, *trials.shape[:2])), (weights_of(count), weights_of(other_count(count)))
    memory = scratch_for(wanted.shape[1]), np.zeros(state.line.shape[1:]), np.zeros(wanted.shape[1])
    hold_worlds(
        state.line, state.car, wanted, np.asarray(bodies, np.int64), np.ascontiguousarray(trials),
        state.time_s.copy(), np.full(state.n, until_s, np.float64), *weights, memory, out,
    )  # fmt: skip
    return out


def descend(
    state: State, bodies: Sequence[int], shares: Floats, rounds: int, until_s: float | Floats, count: Count
) -> tuple[Floats, Floats]:
    """Choose the best constant share of each body's brakes, one body after the other, while all others brake fully.

    ``shares`` are the candidates, in [0, 1]. The bodies take turns in ``rounds`` rounds, each with the others' latest
    choice. Returns the commands of all bodies, [n, N + 1] m/s2, and the harm of the episode, [n] m2/s2.
    """
    braking = capacities(state.car, BRAKING, state.time_s)
    commands, least = -braking, np.zeros(state.n)
    for body in list(bodies) * rounds:
        trials = -braking[:, [body]] * shares
        harm = hold(state, commands, [body], trials[:, :, np.newaxis], until_s, count)[0]
        commands[:, body] = np.take_along_axis(trials, harm.argmin(axis=1)[:, np.newaxis], 1)[:, 0]
        least = harm.min(axis=1)
    return commands, least
