"""Prediction of the harm if vehicles hold constant commands, without stops at decisions.

The prediction is fast, but rounds differently from an episode; ``episode.play`` has the same bits as the episode.
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
    """Write the harm (m2/s2) to ``out`` [2, n, C] if ``bodies`` [B] hold the commands ``trials`` [n, C, B] (m/s2).

    Each of C trials starts from ``line``; all other bodies hold ``wanted``. Row 0 of ``out`` is the harm in the count
    with the weights ``weights`` [6], row 1 in the count with ``tie_weights`` [6]. The commands hold from ``time`` to
    ``until`` (s, [n] each). ``line``, ``car`` and ``wanted`` are arrays of a ``State``. ``memory`` is working memory:
    scratch of the physics, one line, and the commands of this line.
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

    The first row is the harm in ``count``, the second the harm in the count that breaks ties. ``trials`` [n, C, B] are
    C sets of commands for the B bodies (m/s2); all other bodies hold ``wanted`` [n, N + 1] (m/s2).
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
    """Choose a constant share of the brakes for each of ``bodies``, by coordinate descent; all others brake fully.

    All ``bodies`` start from full braking and take turns, ``rounds`` times: each picks the best of ``shares`` (in [0,
    1]) for the others' latest choice. Commands are held until ``until_s``. Returns the commands of all bodies, [n, N +
    1] m/s2, and the harm of the episode, [n] m2/s2.
    """
    braking = capacities(state.car, BRAKING, state.time_s)
    commands, least = -braking, np.zeros(state.n)
    for body in list(bodies) * rounds:
        trials = -braking[:, [body]] * shares
        harm = hold(state, commands, [body], trials[:, :, np.newaxis], until_s, count)[0]
        commands[:, body] = np.take_along_axis(trials, harm.argmin(axis=1)[:, np.newaxis], 1)[:, 0]
        least = harm.min(axis=1)
    return commands, least
