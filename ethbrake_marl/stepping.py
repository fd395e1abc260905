"""The compiled step of the engine: actions to commands, motion, episode ends, and the terms of reward that all share.

Worlds are rows of ``physics.packed``; ``clock`` [n, 4] holds what an episode needs beside them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import command_of
from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.impact import GAP, MASS, SPEED
from ethbrake_marl.physics.packed import (
    RESTITUTION,
    TIME,
    command_at,
    gap_at,
    harm_at,
    params_at,
    previous_at,
    speed_at,
)
from ethbrake_marl.physics.segment import (
    COMMAND,
    COUNT,
    DONE,
    FIRST_HARM,
    HIT,
    LIMIT,
    ONSET,
    TABLE_ROWS,
    TOTAL_HARM,
    advance_table,
)

# columns of clock
START = 0  # time of the first decision (s)
STEP = 1  # steps taken
LAST_STEP = 2  # the step that ends at the horizon
ENDED = 3  # 1 once the episode has ended
CLOCK_WIDTH = 4
# rows of step_harm: what the step brought to each world
STEP_FIRST_HARM = 0
STEP_TOTAL_HARM = 1
HARM_ROWS = 2
# rows of flags: how the step ended each episode, if it did
TERMINATED = 0
TRUNCATED = 1
SAFE_END = 2  # without any collision
FLAG_ROWS = 3
Flags = NDArray[np.uint8]  # truth values; to hand over an array of booleans takes longer than to step a world
# places in settings
TIME_STEP, HORIZON, HARM_WEIGHT, HARM_IS_TOTAL, TERMINAL_WEIGHT = range(5)
BAD_ACTION = -1


@compiled
def step_worlds(  # noqa: C901  # one loop on purpose: handing these arrays to functions costs more than the work
    state: Floats, params: Floats, clock: Floats, actions: Floats, learners: Ints, settings: Floats, no_rows: Floats,
    wanted: Floats, reward: Floats, step_harm: Floats, flags: Flags,
) -> tuple[int, int]:  # fmt: skip
    """Advance every running world by one step, in place (state, clock, wanted); fills the last three arrays.

    ``actions`` [n, L] become the learners' commands in ``wanted`` [n, N]; nothing is moved if one of them is not in
    [-1, 1]. Returns a world and what went wrong there (BAD_ACTION or a status of the kernel), or (-1, DONE).
    """
    n, N = wanted.shape
    for k in range(n):
        for c in range(learners.shape[0]):
            if not -1.0 <= actions[k, c] <= 1.0:
                return k, BAD_ACTION
    speed, command, previous, gap, harm = speed_at(N), command_at(N), previous_at(N), gap_at(N), harm_at(N)
    braking, driving, latency, mass, limit = (
        params_at(0, N), params_at(1, N), params_at(2, N), params_at(3, N), params_at(4, N),
    )  # fmt: skip
    P = N - 1
    table = np.zeros((TABLE_ROWS, N))
    for k in range(n):
        if clock[k, ENDED] == 1.0:
            for f in range(HARM_ROWS):
                step_harm[f, k] = 0.0
            for f in range(FLAG_ROWS):
                flags[f, k] = 0
            for i in range(N):
                reward[k, i] = 0.0
            continue
        for c in range(learners.shape[0]):
            i = learners[c]
            wanted[k, i] = command_of(actions[k, c], params[k, braking + i], params[k, driving + i])
        clock[k, STEP] += 1.0
        at_horizon = clock[k, STEP] >= clock[k, LAST_STEP]
        time = state[k, TIME]
        until = settings[HORIZON] if at_horizon else clock[k, START] + clock[k, STEP] * settings[TIME_STEP]
        for i in range(N):
            table[SPEED, i] = state[k, speed + i]
            table[COMMAND, i] = wanted[k, i]
            table[MASS, i] = params[k, mass + i]
            table[LIMIT, i] = params[k, limit + i]
            table[ONSET, i] = params[k, latency + i] - time
            state[k, previous + i] = state[k, command + i]
            state[k, command + i] = wanted[k, i] if params[k, latency + i] <= until else 0.0
        for p in range(P):
            table[GAP, p] = state[k, gap + p]
            table[HIT, p] = state[k, gap + P + p]
        status = advance_table(table, params[k, RESTITUTION], until - time, time, k, no_rows, 0)[1]
        if status != DONE:
            return k, status
        state[k, TIME] = until
        at_rest = True
        for i in range(N):
            state[k, speed + i] = table[SPEED, i]
            at_rest = at_rest and table[SPEED, i] == 0.0 and wanted[k, i] <= 0.0
        impacts, first_harm, total_harm = 0.0, 0.0, 0.0
        for p in range(P):
            state[k, gap + p] = table[GAP, p]
            state[k, gap + P + p] = table[HIT, p]
            state[k, harm + p] += table[FIRST_HARM, p]
            state[k, harm + P + p] += table[TOTAL_HARM, p]
            state[k, harm + 2 * P + p] += table[COUNT, p]
            first_harm += table[FIRST_HARM, p]
            total_harm += table[TOTAL_HARM, p]
            impacts += state[k, harm + 2 * P + p]
        step_harm[STEP_FIRST_HARM, k] = first_harm
        step_harm[STEP_TOTAL_HARM, k] = total_harm
        over = at_rest or at_horizon
        clock[k, ENDED] = 1.0 if over else 0.0
        flags[TERMINATED, k] = at_rest
        flags[TRUNCATED, k] = over and not at_rest
        flags[SAFE_END, k] = over and impacts == 0.0
        shared = settings[TERMINAL_WEIGHT] if flags[SAFE_END, k] == 1 else 0.0
        shared -= settings[HARM_WEIGHT] * (total_harm if settings[HARM_IS_TOTAL] == 1.0 else first_harm)
        for i in range(N):
            reward[k, i] = shared
    return -1, DONE
