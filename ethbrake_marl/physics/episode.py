"""The step of an episode, compiled: onset of the commands, motion, harm, rest, and the times of the decisions.

Search and shield advance an episode by ``step_episode``. The engine, whose loop keeps its worlds in rows, is made of
the same rules (``step_end_s``, ``onset_s``, ``command_in_force``, ``stands``) around the same ``advance_table``, so all
three agree to the bit (decision 0025). Search and shield copy one world at a time into the table of
``physics.segment``, which is longer here by the rows below.

A *profile* holds the commands of the controlled vehicles in each of its phases. Phases begin and end on the grid of
decisions, so an agent can drive it. Letters beside those of ``physics.worlds``:

===  ===========================================================
C    controlled vehicles
K    phases, in order of time; ``ends[k]`` is the step in which phase k ends, the last one reaches the horizon
S    columns of a saved state: speeds N, gaps P, hit flags P, first-impact harm P, total harm P
===  ===========================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ethbrake_marl.physics.compiled import compiled, compiled_apart, compiled_within
from ethbrake_marl.physics.kernel import (
    ACCELERATION,
    ACTIVE,
    COMMAND,
    DONE,
    FIRST_HARM,
    GAP,
    HIT,
    LIMIT,
    MASS,
    MOST_EVENTS,
    ONSET,
    SPEED,
    TABLE_ROWS,
    TOTAL_HARM,
    accelerate,
    advance_table,
    move,
    next_event,
    place_obstacle,
    resolve_impacts,
    start_events,
    with_post_ahead,
)
from ethbrake_marl.physics.worlds import Floats, Ints, Worlds

# rows of the table after those of a segment
LATENCY = TABLE_ROWS  # per vehicle: when its command takes effect (s since Vehicle 1 began to brake)
SUM_FIRST_HARM = TABLE_ROWS + 1  # per pair: harm since the episode began (m2/s2)
SUM_TOTAL_HARM = TABLE_ROWS + 2
EPISODE_ROWS = TABLE_ROWS + 3

# what a step brought; what is below 0 is a failure: minus the status of the kernel
GOES_ON, AT_REST, AT_HORIZON = 0, 1, 2

# columns of clock: first decision (s), time step (s), number of steps, horizon (s), restitution, 1 to minimise total
# harm, 1 to advance decision by decision
START, TIME_STEP, LAST_STEP, HORIZON, RESTITUTION, HARM_IS_TOTAL, STEPWISE = range(7)
CLOCK_WIDTH = 7
OTHER_WEIGHT = 1e-8  # of the other count in the value that is minimised: it decides between equal harms
_ROUNDING = 1e-9  # of a step: by less than this the horizon may lie beyond the last whole step
_ON_GRID = 1e-6  # of a step: a time this close before a decision is that decision

Number = TypeVar("Number", float, Floats)


class Grid(NamedTuple):
    """The decisions of one episode: one every ``time_step_s`` from ``first_s`` on, ``last_step`` of them."""

    first_s: float
    time_step_s: float
    last_step: float
    horizon_s: float  # where the last step ends


class Episode(NamedTuple):
    """One world as its profiles run."""

    table: Floats  # [EPISODE_ROWS, N] with latencies, masses, speed limits and the other vehicles' commands
    clock: Floats  # [CLOCK_WIDTH]
    controlled: Ints  # [C] vehicles


def first_decision_s(worlds: Worlds, deciders: Sequence[int]) -> Floats:
    """Time of the first decision, [n] s: the least latency of the ``deciders``, or the worlds' time where it is later.

    With nobody to decide it is the worlds' time.
    """
    if len(deciders) == 0:
        return worlds.time_s.copy()
    first: Floats = np.maximum(worlds.vehicles.latency_s[:, list(deciders)].min(axis=1), worlds.time_s)
    return first


def number_of_decisions(first_s: Floats, time_step_s: float, horizon_s: Floats | float) -> Floats:
    """How many decisions fall before the horizon, or another time, the first one at ``first_s``, whose shape it has."""
    return np.ceil((horizon_s - first_s) / time_step_s - _ROUNDING)


def decision_at(time_s: Floats, first_s: Floats, time_step_s: Floats | float) -> Ints:
    """Number of the latest decision at these times, [n]; below 0 before the first one."""
    return np.floor((time_s - first_s) / time_step_s + _ON_GRID).astype(np.int64)


def decision_s(first_s: Number, time_step_s: Any, step: Any) -> Number:
    """Time at which a step before the last one begins: of one world or of many, s."""
    time: Number = first_s + step * time_step_s
    return time


_decision_s = compiled(decision_s)


@compiled
def grid_of(clock: Floats) -> Grid:
    """The decisions that a clock [CLOCK_WIDTH] tells of."""
    return Grid(clock[START], clock[TIME_STEP], clock[LAST_STEP], clock[HORIZON])


@compiled
def step_end_s(step: float, last_step: float, first_s: float, time_step_s: float, horizon_s: float) -> float:
    """Time (s) at which the step with this number, from 1, ends; the last one ends at the horizon."""
    return horizon_s if step >= last_step else _decision_s(first_s, time_step_s, step)


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


@compiled
def command_in_force(command: float, latency_s: float, time_s: float) -> float:
    """The command that acts at a time: none before the vehicle's latency has elapsed (m/s2)."""
    return command if latency_s <= time_s else 0.0


@compiled_within
def at_rest(table: Floats) -> bool:
    """Whether the episode has ended: everything stands and no command would move it."""
    for i in range(table.shape[1]):  # noqa: SIM110  # all() is not compiled
        if not stands(table[SPEED, i], table[COMMAND, i]):
            return False
    return True


@compiled_within
def step_episode(
    table: Floats, restitution: float, time: float, until: float, horizon_s: float, no_rows: Floats
) -> int:
    """THE step: from ``time`` to ``until`` (s) under the commands in the table, and the harm of it.

    Returns GOES_ON, AT_REST, AT_HORIZON (still moving, or told to move), or minus the kernel's status of a failure; the
    table is then of no use. ``no_rows`` is an empty list of impacts, as ``table[:0]``. The bits depend on where steps
    end: what the engine does is a step from each decision to the next one.
    """
    status = advance_table(table, restitution, until - time, time, 0, no_rows, 0)[1]
    if status != DONE:
        return -status
    for p in range(table.shape[1] - 1):
        table[SUM_FIRST_HARM, p] += table[FIRST_HARM, p]
        table[SUM_TOTAL_HARM, p] += table[TOTAL_HARM, p]
    if at_rest(table):
        return AT_REST
    return AT_HORIZON if until >= horizon_s else GOES_ON


@compiled_within
def step_again(table: Floats, restitution: float, grid: Grid, step: int, end: int, no_rows: Floats) -> int:
    """``step_episode`` from decision ``step`` to decision ``end`` of a table that stays loaded from step to step."""
    time = time_of(grid, step)
    for i in range(table.shape[1]):
        table[ONSET, i] = onset_s(table[LATENCY, i], time)
    return step_episode(table, restitution, time, time_of(grid, end), grid.horizon_s, no_rows)


@compiled
def harm_so_far(table: Floats, total: float) -> float:
    """Harm of the line since the episode began, under one count (1: total harm), summed front to rear (m2/s2)."""
    value, row = 0.0, SUM_TOTAL_HARM if total == 1.0 else SUM_FIRST_HARM
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
        state[i] = table[SPEED, i]
    for p in range(pairs):
        state[vehicles + p] = table[GAP, p]
        state[vehicles + pairs + p] = table[HIT, p]
        state[vehicles + 2 * pairs + p] = table[SUM_FIRST_HARM, p]
        state[vehicles + 3 * pairs + p] = table[SUM_TOTAL_HARM, p]


@compiled
def restore(table: Floats, state: Floats) -> None:
    """Bring back what ``save`` kept."""
    vehicles = table.shape[1]
    pairs = vehicles - 1
    for i in range(vehicles):
        table[SPEED, i] = state[i]
    for p in range(pairs):
        table[GAP, p] = state[vehicles + p]
        table[HIT, p] = state[vehicles + pairs + p]
        table[SUM_FIRST_HARM, p] = state[vehicles + 2 * pairs + p]
        table[SUM_TOTAL_HARM, p] = state[vehicles + 3 * pairs + p]


@compiled_apart
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
    grid, restitution, total = grid_of(clock), clock[RESTITUTION], clock[HARM_IS_TOTAL]
    no_rows = table[:0]
    restore(table, states[phase])
    value = value_of(table, total)
    for k in range(phase, ends.shape[0]):
        begin = ends[k - 1] if k > 0 else 0
        outcome = GOES_ON
        if ends[k] > begin:
            for c in range(controlled.shape[0]):
                table[COMMAND, controlled[c]] = commands[k, c]
            length = 1 if clock[STEPWISE] == 1.0 else ends[k] - begin
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


# A segment of constant command as pieces of constant acceleration: what a picture needs to be exact between events.

_CAPACITY = 64


@compiled
def _pieces(table: Floats, restitution: float, duration: float, rows: Floats) -> int:
    """Write down time from the start, gaps, speeds and accelerations at the beginning of each piece; their number.

    Those that do not fit into ``rows`` [capacity, 1 + P + 2 N] are only counted; minus their number where a contact
    was missed.
    """
    vehicles = table.shape[1]
    start_events(table)
    now, count = 0.0, 0
    for _ in range(MOST_EVENTS):
        if resolve_impacts(table, restitution):
            continue
        if now >= duration:
            break
        accelerate(table)
        if count < rows.shape[0]:
            rows[count, 0] = now
            for p in range(vehicles - 1):
                rows[count, 1 + p] = table[GAP, p]
            for i in range(vehicles):
                rows[count, vehicles + i] = table[SPEED, i]
                rows[count, 2 * vehicles + i] = table[ACCELERATION, i]
        count += 1
        passed = next_event(table, now, duration)
        if not move(table, passed):
            return -count
        for i in range(vehicles):
            if table[ONSET, i] - now <= passed:
                table[ACTIVE, i] = 1.0
        now = duration if passed >= duration - now else now + passed
    return count


def segment_pieces(worlds: Worlds, command_mps2: Floats, until_s: Floats) -> list[Floats]:
    """The motion of each world until a time, under one command: a row per piece of constant acceleration.

    Args:
        worlds: n, of N vehicles; they stay as they are.
        command_mps2: signed accelerations wanted, [n, N] m/s2.
        until_s: where the segments end, [n] s.

    Returns for each world [k, 1 + N + 2 N]: the absolute time at which the piece begins (s), how far Vehicle 1 has come
    since the segment began, the gaps (m), the speeds (m/s) and the accelerations (m/s2).

    """
    v, N, durations = worlds.vehicles, worlds.N, until_s - worlds.time_s
    front_gaps = with_post_ahead(worlds, durations).obstacle_gap_m  # says where Vehicle 1 is
    latencies, restitutions = v.latency_s, v.restitution
    wanted = [*range(N + 1), *range(N + 2, 2 * N + 2), *range(2 * N + 3, 3 * N + 3)]  # all but the post's own
    found = []
    for k in range(worlds.n):
        start = float(worlds.time_s[k])
        table = np.zeros((TABLE_ROWS, N + 1))
        place_obstacle(table, float(front_gaps[k]), 0.0)
        table[COMMAND, 1:], table[SPEED, 1:] = command_mps2[k], worlds.speeds_mps[k]
        table[MASS, 1:], table[LIMIT, 1:] = v.mass_t[k], v.speed_limit_mps[k]
        table[ONSET, 0], table[ONSET, 1:] = onset_s(0.0, start), latencies[k] - start
        table[GAP, 1:N] = worlds.gaps_m[k]
        capacity = _CAPACITY
        while True:
            rows = np.empty((capacity, 3 * (N + 1)))
            count = abs(_pieces(table.copy(), float(restitutions[k]), float(durations[k]), rows))
            if count <= capacity:
                break
            capacity = count
        pieces = rows[:count, wanted]
        pieces[:, 0] += start
        pieces[:, 1] = front_gaps[k] - pieces[:, 1]
        found.append(pieces)
    return found
