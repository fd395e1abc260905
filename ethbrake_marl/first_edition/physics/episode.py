"""Compiled rules of one step of an episode: when commands take effect, motion, harm, rest, and decision times.

Searches and shields copy one world at a time into a table and advance this world with ``step_episode``. The engine
stores all its worlds in the rows of two arrays and advances them in its own loop, with the same rules (``step_end_s``,
``onset_s``, ``force_at``, ``stands``) and the same function ``advance_table``. Therefore engine, searches and shields
compute results that are equal to the last bit (decision 0025).

A *profile* here is a sequence of constant commands of the controlled vehicles; a *phase* is the time interval of one
command. Phases begin and end at decisions, so an agent can carry out a profile. This module uses the following shape
letters in addition to those of ``physics.state``:

===  ===========================================================
C    controlled vehicles
K    phases, in order of time; phase k ends at the end of step ``ends[k]``, and the last phase reaches the horizon
S    columns of a saved state: speeds N, gaps P, hit flags P, first-impact harm P, total harm P, forces N (unused if no
     brakes build up)
===  ===========================================================

Arguments that several functions share:

- ``table``: one world in the layout of ``physics.rows``, with at least ``ROW.OF_EPISODE`` rows
- ``restitution``: coefficient of restitution of every impact
- ``clock``: decision times and settings of the episode, [CLOCK.WIDTH]
- ``no_rows``: ``table[:0]`` or another empty array, so that no single impact is recorded
- ``step``, ``end``: numbers of decisions, from 0 (in ``step_end_s``: of a step, from 1)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.rows import FLAG, ROW, builds_up
from ethbrake_marl.first_edition.physics.segment import advance_table
from ethbrake_marl.first_edition.physics.state import Floats, Ints

# state of an episode after a step; a value below 0 is minus the status of a kernel that failed
GOES_ON, AT_REST, AT_HORIZON = 0, 1, 2


class _Clock(NamedTuple):
    """Index of each entry of the array ``clock`` [WIDTH]: decision times and settings of an episode."""

    START: int = 0  # time of the first decision (s)
    TIME_STEP: int = 1  # time between decisions (s)
    LAST_STEP: int = 2  # number of steps
    HORIZON: int = 3  # end of the last step (s)
    RESTITUTION: int = 4  # coefficient of restitution of every impact
    HARM_IS_TOTAL: int = 5  # 1 if total harm is to be minimised, 0 for first-impact harm
    STEPWISE: int = 6  # 1 to advance decision by decision; 0 phase by phase (intervals of constant command)
    AIM: int = 7  # what a search minimises: WHOLE, WEIGHTED or LARGEST
    WIDTH: int = 8  # number of entries


CLOCK = _Clock()

# entries of CLOCK.AIM: the harm of the line, the weighted harm of its vehicles, or the largest weighted one
WHOLE, WEIGHTED, LARGEST = 0.0, 1.0, 2.0

OTHER_WEIGHT = 1e-8  # weight of the other harm count in the minimised value: a tie-breaker

_ROUNDING = 1e-9  # part of a step by which the horizon may lie beyond the last whole step

_ON_GRID = 1e-6  # part of a step: a time this close before a decision counts as the decision


class Grid(NamedTuple):
    """Decision times of one episode: at ``first_s``, then every ``time_step_s``, up to the horizon."""

    first_s: float  # time of the first decision (s)
    time_step_s: float  # time between two decisions (s)
    last_step: float  # number of steps (a whole number)
    horizon_s: float  # end of the last step (s)


class Episode(NamedTuple):
    """One world, prepared for simulating profiles."""

    # [rows_for(2 K), N] table in the layout of ``physics.rows``, for K pieces of braking per vehicle; filled with
    # latencies, masses, limits and other vehicles' commands
    table: Floats
    clock: Floats  # [CLOCK.WIDTH] decision times and settings, see ``CLOCK``
    controlled: Ints  # [C] indices of the controlled vehicles


class Decisions(NamedTuple):
    """Decision times of one or many worlds: the first decision at ``first_s``, then one every ``time_step_s``."""

    first_s: Floats  # time of the first decision in each world, [n] or one number (s)
    time_step_s: Floats | float  # time between two decisions (s)

    def before(self, time_s: Floats | float) -> Floats:
        """Return how many decisions are before ``time_s`` (s)."""
        return np.ceil((time_s - self.first_s) / self.time_step_s - _ROUNDING)

    def latest(self, time_s: Floats) -> Ints:
        """Return the number of the latest decision at or before each time (s); negative before decision 0."""
        number: Floats = np.floor((time_s - self.first_s) / self.time_step_s + _ON_GRID)
        return number.astype(np.int64)

    def at(self, step: Floats | Ints | float) -> Floats:
        """Return the time (s) of decision number ``step``."""
        return self.first_s + step * self.time_step_s


@compiled
def grid_of(clock: Floats) -> Grid:
    """Return the decision times of an episode from its ``clock``."""
    return Grid(clock[CLOCK.START], clock[CLOCK.TIME_STEP], clock[CLOCK.LAST_STEP], clock[CLOCK.HORIZON])


@compiled
def step_end_s(step: float, last_step: float, first_s: float, time_step_s: float, horizon_s: float) -> float:
    """Return the time (s) at which step number ``step`` (from 1) ends; the last step ends at the horizon.

    A step is the time between two decisions. The other arguments are the fields of ``Grid``.
    """
    return horizon_s if step >= last_step else first_s + step * time_step_s


@compiled
def time_of(grid: Grid, step: int) -> float:
    """Return the time (s) of decision number ``step``, or the horizon if there is no such decision."""
    return step_end_s(step, grid.last_step, grid.first_s, grid.time_step_s, grid.horizon_s)


@compiled
def onset_s(latency_s: float, time_s: float) -> float:
    """Return the time (s) from ``time_s`` until a vehicle's command takes effect; 0 or less if it acts at once.

    ``latency_s`` and ``time_s`` are in seconds from the alert.
    """
    return latency_s - time_s


@compiled
def stands(speed_mps: float, command_mps2: float) -> bool:
    """Return whether a vehicle is at rest and its command (m/s2) is at most 0, so that it does not drive away."""
    return speed_mps == 0.0 and command_mps2 <= 0.0


@compiled(within=True)
def at_rest(table: Floats) -> bool:
    """Return whether all vehicles are at rest and no command or force would move one, so that the episode has ended."""
    for i in range(table.shape[1]):  # numba does not compile all()
        command = table[ROW.COMMAND, i]
        if not stands(table[ROW.SPEED, i], max(command, table[ROW.FORCE, i]) if builds_up(table) else command):
            return False
    return True


@compiled(within=True)
def step_episode(
    table: Floats, restitution: float, time: float, until: float, horizon_s: float, no_rows: Floats
) -> int:
    """Advance one world from ``time`` to ``until`` (s) under its commands, and add the harm of this step to the table.

    Returns AT_REST (``at_rest`` is True), AT_HORIZON (``at_rest`` is False at the horizon), GOES_ON (neither of the
    two), or minus the status code of ``FLAG`` if a check of the physics failed. After a failure the table is invalid.
    The last bits of the result depend on the times at which steps end. To get the same bits as the engine, call the
    function once for each step from one decision to the next.
    """
    status = advance_table(table, restitution, until - time, time, 0, no_rows, 0)[1]
    if status != FLAG.DONE:
        return -status
    for p in range(table.shape[1] - 1):
        table[ROW.SUM_FIRST_HARM, p] += table[ROW.FIRST_HARM, p]
        table[ROW.SUM_TOTAL_HARM, p] += table[ROW.TOTAL_HARM, p]
    if at_rest(table):
        return AT_REST
    return AT_HORIZON if until >= horizon_s else GOES_ON


@compiled(within=True)
def step_again(table: Floats, restitution: float, grid: Grid, step: int, end: int, no_rows: Floats) -> int:
    """Advance a world from decision number ``step`` to decision number ``end``; return the result of ``step_episode``.

    Apart from the commands, the table must contain what the previous step or ``restore`` wrote into it. For each
    vehicle, the function computes anew the time until the vehicle's command takes effect.
    """
    time = time_of(grid, step)
    for i in range(table.shape[1]):
        table[ROW.ONSET, i] = onset_s(table[ROW.LATENCY, i], time)
    return step_episode(table, restitution, time, time_of(grid, end), grid.horizon_s, no_rows)


@compiled
def harm_so_far(table: Floats, total: float) -> float:
    """Return the harm (m2/s2) of all pairs since the episode began, summed from front to rear.

    ``total`` is 1 for total harm, 0 for first-impact harm.
    """
    value, row = 0.0, ROW.SUM_TOTAL_HARM if total == 1.0 else ROW.SUM_FIRST_HARM
    for p in range(table.shape[1] - 1):
        value += table[row, p]
    return value


@compiled
def value_of(table: Floats, clock: Floats, other_weight: float = OTHER_WEIGHT) -> float:
    """Return the harm of the episode so far (m2/s2), as a search minimises it; this harm never decreases in an episode.

    The entry ``AIM`` of ``clock`` chooses one of three harms: the harm of the line, the weighted sum of the vehicles'
    harms, or the largest weighted harm of a vehicle. The entry ``HARM_IS_TOTAL`` chooses the count of harm. To break
    ties, the function adds ``other_weight`` times the line's harm in the other count.
    """
    total, aim = clock[CLOCK.HARM_IS_TOTAL], clock[CLOCK.AIM]
    other = other_weight * harm_so_far(table, 1.0 - total)
    if aim == WHOLE:
        return harm_so_far(table, total) + other
    row = ROW.SUM_TOTAL_HARM if total == 1.0 else ROW.SUM_FIRST_HARM
    value, from_ahead = 0.0, 0.0
    for i in range(table.shape[1]):
        borne = from_ahead  # by vehicle i, times its weight
        if i < table.shape[1] - 1:
            borne += table[ROW.FRONT_WEIGHT, i] * table[row, i]
            from_ahead = table[ROW.REAR_WEIGHT, i] * table[row, i]
        value = max(value, borne) if aim == LARGEST else value + borne
    return value + other


@compiled
def save(table: Floats, state: Floats) -> None:
    """Save the state of a world, and its harm so far, from its ``table`` into the array ``state`` [S]."""
    vehicles = table.shape[1]
    pairs = vehicles - 1
    for i in range(vehicles):
        state[i] = table[ROW.SPEED, i]
    for p in range(pairs):
        state[vehicles + p] = table[ROW.GAP, p]
        state[vehicles + pairs + p] = table[ROW.HIT, p]
        state[vehicles + 2 * pairs + p] = table[ROW.SUM_FIRST_HARM, p]
        state[vehicles + 3 * pairs + p] = table[ROW.SUM_TOTAL_HARM, p]
    for i in range(vehicles):
        state[vehicles + 4 * pairs + i] = table[ROW.FORCE, i]


@compiled
def restore(table: Floats, state: Floats) -> None:
    """Load the array ``state`` [S], which ``save`` wrote, into the ``table`` of a world."""
    vehicles = table.shape[1]
    pairs = vehicles - 1
    for i in range(vehicles):
        table[ROW.SPEED, i] = state[i]
    for p in range(pairs):
        table[ROW.GAP, p] = state[vehicles + p]
        table[ROW.HIT, p] = state[vehicles + pairs + p]
        table[ROW.SUM_FIRST_HARM, p] = state[vehicles + 2 * pairs + p]
        table[ROW.SUM_TOTAL_HARM, p] = state[vehicles + 3 * pairs + p]
    for i in range(vehicles):
        table[ROW.FORCE, i] = state[vehicles + 4 * pairs + i]


@compiled(apart=True)
def follow_whole(world: Episode, ends: Ints, commands: Floats, states: Floats, bound: float) -> tuple[float, int]:
    """Simulate a whole profile: ``follow`` with ``phase`` 0."""
    phase = min(0, ends.shape[0])  # 0, but not as a literal: numba would compile everything again for it
    return follow(world, ends, commands, states, phase, bound)


@compiled
def follow(world: Episode, ends: Ints, commands: Floats, states: Floats, phase: int, bound: float) -> tuple[float, int]:
    """Simulate a profile from ``phase`` on; return its harm (m2/s2) and the number of phases until the simulation ends.

    The harm is computed by ``value_of``. The number of phases is -1 if a check of the physics failed. If
    ``world.clock[CLOCK.STEPWISE]`` is 1, the simulation moves from decision to decision, and the result has the same
    bits as in the engine. If ``STEPWISE`` is 0, the simulation moves from phase to phase, which is several times
    faster, and the result differs from the engine's by rounding errors.

    Args:
        world: the world, with its decision times; its table is overwritten.
        ends: for each phase, the number of the decision at which it ends, [K].
        commands: for each phase, the commands of the controlled vehicles, [K, C] m/s2.
        states: states as ``save`` writes them, [K + 1, S]. The simulation starts from ``states[phase]`` and writes the
            state at the end of phase k to ``states[k + 1]``.
        phase: number of the first phase to simulate, from 0.
        bound: the simulation stops after the phase in which the harm reaches this bound, m2/s2.

    """
    table, clock, controlled = world.table, world.clock, world.controlled
    grid, restitution = grid_of(clock), clock[CLOCK.RESTITUTION]
    no_rows = table[:0]
    restore(table, states[phase])
    value = value_of(table, clock)
    for k in range(phase, ends.shape[0]):
        begin = ends[k - 1] if k > 0 else 0
        outcome = GOES_ON
        if ends[k] > begin:
            for c in range(controlled.shape[0]):
                table[ROW.COMMAND, controlled[c]] = commands[k, c]
            length = 1 if clock[CLOCK.STEPWISE] == 1.0 else ends[k] - begin
            for step in range(begin, ends[k], length):
                outcome = step_again(table, restitution, grid, step, step + length, no_rows)
                if outcome != GOES_ON:
                    break
            if outcome < GOES_ON:
                return value, -1
            value = value_of(table, clock)
        save(table, states[k + 1])
        if value >= bound or outcome == AT_REST:
            return value, k + 1
    return value, ends.shape[0]
