"""The step of an episode, compiled: onset of the commands, motion, harm, rest, and the times of the decisions.

Search and shield advance an episode by ``step_episode``. The engine, whose loop keeps its worlds in rows, is made of
the same rules (``step_end_s``, ``onset_s``, ``force_at``, ``stands``) around the same ``advance_table``, so
all three agree to the bit (decision 0025). Search and shield copy one world at a time into the table of
``physics.kernel``, which is longer here by the rows below.

A *profile* holds the commands of the controlled vehicles in each of its phases. Phases begin and end on the grid of
decisions, so an agent can drive it. Letters beside those of ``physics.worlds``:

===  ===========================================================
C    controlled vehicles
K    phases, in order of time; ``ends[k]`` is the step in which phase k ends, the last one reaches the horizon
S    columns of a saved state: speeds N, gaps P, hit flags P, first-impact harm P, total harm P, forces N (which mean
     nothing where no brakes build up)
===  ===========================================================
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.rows import FLAG, ROW, builds_up
from ethbrake_marl.physics.segment import advance_table
from ethbrake_marl.physics.state import Floats, Ints

# rows of the table after those of a segment


# what a step brought; what is below 0 is a failure: minus the status of the kernel
GOES_ON, AT_REST, AT_HORIZON = 0, 1, 2


class _Clock(NamedTuple):
    """Entries of an episode's clock."""

    START: int = 0  # first decision (s)
    TIME_STEP: int = 1  # s
    LAST_STEP: int = 2  # number of steps
    HORIZON: int = 3  # s
    RESTITUTION: int = 4
    HARM_IS_TOTAL: int = 5  # 1 to minimise total harm
    STEPWISE: int = 6  # 1 to advance decision by decision
    WIDTH: int = 7


CLOCK = _Clock()

OTHER_WEIGHT = 1e-8  # of the other count in the value that is minimised: it decides between equal harms

_ROUNDING = 1e-9  # of a step: by less than this the horizon may lie beyond the last whole step

_ON_GRID = 1e-6  # of a step: a time this close before a decision is that decision


class Grid(NamedTuple):
    """The decisions of one episode: one every ``time_step_s`` from ``first_s`` on, ``last_step`` of them."""

    first_s: float
    time_step_s: float
    last_step: float
    horizon_s: float  # where the last step ends


class Episode(NamedTuple):
    """One world as its profiles run."""

    table: Floats  # [rows_for(2 K), N] with latencies, masses, speed limits and the other vehicles' commands
    clock: Floats  # [CLOCK.WIDTH]
    controlled: Ints  # [C] vehicles


class Decisions(NamedTuple):
    """Moments at which somebody decides, of one world or of many: at ``first_s``, and each time step from then on."""

    first_s: Floats  # s
    time_step_s: Floats | float  # s

    def before(self, time_s: Floats | float) -> Floats:
        """How many fall before the horizon, or another time."""
        return np.ceil((time_s - self.first_s) / self.time_step_s - _ROUNDING)

    def latest(self, time_s: Floats) -> Ints:
        """Number of the latest one at these times; below 0 before the first one."""
        number: Floats = np.floor((time_s - self.first_s) / self.time_step_s + _ON_GRID)
        return number.astype(np.int64)

    def at(self, step: Floats | Ints | float) -> Floats:
        """Time of a decision by its number: when that step, unless it is the last one, begins (s)."""
        return self.first_s + step * self.time_step_s


@compiled
def grid_of(clock: Floats) -> Grid:
    """The decisions that a clock [CLOCK.WIDTH] tells of."""
    return Grid(clock[CLOCK.START], clock[CLOCK.TIME_STEP], clock[CLOCK.LAST_STEP], clock[CLOCK.HORIZON])


@compiled
def step_end_s(step: float, last_step: float, first_s: float, time_step_s: float, horizon_s: float) -> float:
    """Time (s) at which the step with this number, from 1, ends; the last one ends at the horizon."""
    return horizon_s if step >= last_step else first_s + step * time_step_s


@compiled
def time_of(grid: Grid, step: int) -> float:
    """Time at which a step, counted from 0, begins (s)."""
    return step_end_s(step, grid.last_step, grid.first_s, grid.time_step_s, grid.horizon_s)


@compiled
def onset_s(latency_s: float, time_s: float) -> float:
    """How long after ``time_s`` a command takes effect (s); not above 0: at once."""
    return latency_s - time_s


@compiled
def stands(speed_mps: float, command_mps2: float) -> bool:
    """Whether a vehicle stands and its command would not move it."""
    return speed_mps == 0.0 and command_mps2 <= 0.0


@compiled(within=True)
def at_rest(table: Floats) -> bool:
    """Whether the episode has ended: everything stands and no command would move it."""
    for i in range(table.shape[1]):  # all() is not compiled
        command = table[ROW.COMMAND, i]
        if not stands(table[ROW.SPEED, i], max(command, table[ROW.FORCE, i]) if builds_up(table) else command):
            return False
    return True


@compiled(within=True)
def step_episode(
    table: Floats, restitution: float, time: float, until: float, horizon_s: float, no_rows: Floats
) -> int:
    """THE step: from ``time`` to ``until`` (s) under the commands in the table, and the harm of it.

    Returns GOES_ON, AT_REST, AT_HORIZON (still moving, or told to move), or minus the kernel's status of a failure; the
    table is then of no use. ``no_rows`` is an empty list of impacts, as ``table[:0]``. The bits depend on where steps
    end: what the engine does is a step from each decision to the next one.
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
    """``step_episode`` from decision ``step`` to decision ``end`` of a table that stays loaded from step to step."""
    time = time_of(grid, step)
    for i in range(table.shape[1]):
        table[ROW.ONSET, i] = onset_s(table[ROW.LATENCY, i], time)
    return step_episode(table, restitution, time, time_of(grid, end), grid.horizon_s, no_rows)


@compiled
def harm_so_far(table: Floats, total: float) -> float:
    """Harm of the line since the episode began, under one count (1: total harm), summed front to rear (m2/s2)."""
    value, row = 0.0, ROW.SUM_TOTAL_HARM if total == 1.0 else ROW.SUM_FIRST_HARM
    for p in range(table.shape[1] - 1):
        value += table[row, p]
    return value


@compiled
def value_of(table: Floats, total: float) -> float:
    """What a search minimises: the harm under one count, and a very little of the other one (m2/s2)."""
    return harm_so_far(table, total) + OTHER_WEIGHT * harm_so_far(table, 1.0 - total)


@compiled
def save(table: Floats, state: Floats) -> None:
    """Keep a world's state and its harm so far in one row [S]."""
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
    """Bring back what ``save`` kept."""
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
    """``follow`` a profile from its first phase on."""
    phase = min(0, ends.shape[0])  # 0, but no literal, for which everything would be compiled a second time
    return follow(world, ends, commands, states, phase, bound)


@compiled
def follow(world: Episode, ends: Ints, commands: Floats, states: Floats, phase: int, bound: float) -> tuple[float, int]:
    """Follow a profile from the start of ``phase`` on; ``states[k]`` [K + 1, S] is the state at the start of phase k.

    ``ends`` [K], ``commands`` [K, C]. Gives up as soon as the value is not below ``bound``: harm never falls again.
    With ``clock[STEPWISE]`` it advances decision by decision, as the engine does, to the same bits; otherwise phase by
    phase, which is several times faster and differs by rounding. Returns the value and the number of phases up to the
    end of the episode; -1 for that number if the kernel failed.
    """
    table, clock, controlled = world.table, world.clock, world.controlled
    grid, restitution, total = grid_of(clock), clock[CLOCK.RESTITUTION], clock[CLOCK.HARM_IS_TOTAL]
    no_rows = table[:0]
    restore(table, states[phase])
    value = value_of(table, total)
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
            value = value_of(table, total)
        save(table, states[k + 1])
        if value >= bound or outcome == AT_REST:
            return value, k + 1
    return value, ends.shape[0]
