"""What a whole profile of commands leads to, compiled: the candidate evaluation of every search.

A profile holds the commands of the controlled vehicles in each of its phases. Phases begin and end on the grid of
decisions, so an agent can drive it. All arrays belong to one world; letters beside those of ``physics.worlds``:

===  ===========================================================
C    controlled vehicles
K    phases, in order of time; ``ends[k]`` is the step in which phase k ends, the last one reaches the horizon
S    columns of a saved state: speeds N, gaps P, hit flags P, first-impact harm P, total harm P
===  ===========================================================
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.impact import GAP, SPEED
from ethbrake_marl.physics.segment import (
    COMMAND,
    DONE,
    FIRST_HARM,
    HIT,
    ONSET,
    ROW_WIDTH,
    TOTAL_HARM,
    advance_table,
)

UInt64s = NDArray[np.uint64]

OTHER_WEIGHT = 1e-8  # of the other count in the value that is minimised: it decides between equal harms
# columns of clock: first decision (s), time step (s), number of steps, horizon (s), restitution, 1 to minimise total
# harm, 1 to advance decision by decision
START, TIME_STEP, LAST_STEP, HORIZON, RESTITUTION, HARM_IS_TOTAL, STEPWISE = range(7)
CLOCK_WIDTH = 7


class SearchWorld(NamedTuple):
    """One world as candidates run in it."""

    table: Floats  # of physics.segment, with masses, speed limits and the other vehicles' commands
    harm: Floats  # [2, P] first-impact and total harm so far, room to work in
    latency: Floats  # [N] s
    clock: Floats  # [CLOCK_WIDTH]
    controlled: Ints  # [C] vehicles
    bounds: Floats  # [C, 2] smallest and largest command (m/s2)
    random: UInt64s  # [1] state of the world's random numbers


@compiled
def state_width(vehicles: int) -> int:
    """Columns of a saved state (S)."""
    return vehicles + 4 * (vehicles - 1)


@compiled
def save(table: Floats, harm: Floats, state: Floats) -> None:
    """Keep a world's state and its harm [2, P] so far in one row [S]."""
    vehicles = table.shape[1]
    pairs = vehicles - 1
    for i in range(vehicles):
        state[i] = table[SPEED, i]
    for p in range(pairs):
        state[vehicles + p] = table[GAP, p]
        state[vehicles + pairs + p] = table[HIT, p]
        state[vehicles + 2 * pairs + p] = harm[0, p]
        state[vehicles + 3 * pairs + p] = harm[1, p]


@compiled
def restore(table: Floats, harm: Floats, state: Floats) -> None:
    """Bring back what ``save`` kept."""
    vehicles = table.shape[1]
    pairs = vehicles - 1
    for i in range(vehicles):
        table[SPEED, i] = state[i]
    for p in range(pairs):
        table[GAP, p] = state[vehicles + p]
        table[HIT, p] = state[vehicles + pairs + p]
        harm[0, p] = state[vehicles + 2 * pairs + p]
        harm[1, p] = state[vehicles + 3 * pairs + p]


@compiled
def time_of(clock: Floats, step: int) -> float:
    """Time at which a step begins (s), as the engine counts; the last one ends at the horizon."""
    return float(clock[HORIZON] if step >= clock[LAST_STEP] else clock[START] + step * clock[TIME_STEP])


@compiled
def value_of(harm: Floats, total: float) -> float:
    """What is minimised: the harm under one count, and a very little of the other one (m2/s2)."""
    first_sum, total_sum = 0.0, 0.0
    for p in range(harm.shape[1]):
        first_sum += harm[0, p]
        total_sum += harm[1, p]
    if total == 1.0:
        return total_sum + OTHER_WEIGHT * first_sum
    return first_sum + OTHER_WEIGHT * total_sum


@compiled
def run_segment(
    table: Floats, harm: Floats, latency: Floats, restitution: float, time: float, until: float, no_rows: Floats
) -> int:
    """Advance under the commands in the table and add the harm; the kernel's status."""
    for i in range(table.shape[1]):
        table[ONSET, i] = latency[i] - time
    status = advance_table(table, restitution, until - time, time, 0, no_rows, 0)[1]
    for p in range(table.shape[1] - 1):
        harm[0, p] += table[FIRST_HARM, p]
        harm[1, p] += table[TOTAL_HARM, p]
    return status


@compiled
def at_rest(table: Floats) -> bool:
    """Whether the episode has ended: everything stands and no command would move it."""
    for i in range(table.shape[1]):  # noqa: SIM110  # all() is not compiled
        if table[SPEED, i] != 0.0 or table[COMMAND, i] > 0.0:
            return False
    return True


@compiled_apart
def follow_whole(world: SearchWorld, ends: Ints, commands: Floats, states: Floats, bound: float) -> tuple[float, int]:
    """``follow`` a profile from its first phase on."""
    phase = min(0, ends.shape[0])  # 0, but no literal, for which everything would be compiled a second time
    return follow(world, ends, commands, states, phase, bound)


@compiled
def follow(
    world: SearchWorld, ends: Ints, commands: Floats, states: Floats, phase: int, bound: float
) -> tuple[float, int]:
    """Follow a profile from the start of ``phase`` on; ``states[k]`` [K + 1, S] is the state at the start of phase k.

    ``ends`` [K], ``commands`` [K, C]. Gives up as soon as the value is not below ``bound``: harm never falls again.
    With ``clock[STEPWISE]`` it advances decision by decision, as the engine does, to the same bits; otherwise phase by
    phase, which is several times faster and differs by rounding. Returns the value and the number of phases up to the
    end of the episode; -1 for that number if the kernel failed.
    """
    table, harm, latency, clock, controlled = world.table, world.harm, world.latency, world.clock, world.controlled
    no_rows = np.empty((0, ROW_WIDTH))
    restore(table, harm, states[phase])
    value = value_of(harm, clock[HARM_IS_TOTAL])
    for k in range(phase, ends.shape[0]):
        begin = ends[k - 1] if k > 0 else 0
        ended = False
        if ends[k] > begin:
            for c in range(controlled.shape[0]):
                table[COMMAND, controlled[c]] = commands[k, c]
            length = 1 if clock[STEPWISE] == 1.0 else ends[k] - begin
            for step in range(begin, ends[k], length):
                time, until = time_of(clock, step), time_of(clock, step + length)
                if run_segment(table, harm, latency, clock[RESTITUTION], time, until, no_rows) != DONE:
                    return value, -1
                ended = at_rest(table)
                if ended:
                    break
            value = value_of(harm, clock[HARM_IS_TOTAL])
        save(table, harm, states[k + 1])
        if value >= bound or ended:
            return value, k + 1
    return value, ends.shape[0]
