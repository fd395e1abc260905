"""The compiled step of an engine: it turns actions into commands, moves the vehicles, ends episodes, computes rewards.

Each of n worlds is a row of the arrays ``state`` and ``params``, whose columns ``physics.columns`` defines. Further
arrays that several functions share:

- ``clock`` [n, CLOCK_WIDTH]: time of the first decision, number of steps taken, number of the step that ends at the
  horizon, and whether the episode has ended.
- ``actions`` [n, L]: actions of the L learners, in [-1, 1].
- ``pieces`` [N, 2 K]: braking profiles with K pieces, as in ``Vehicles``; K may be 0.
- ``wanted`` [n, N]: commands of all vehicles, m/s2. A step overwrites the learners' commands.
- ``reward`` [n, N]: receives the reward of each vehicle.
- ``outcome`` [OUTCOME_ROWS, n]: receives the harm of the step and whether the episode has ended.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.game.actions import command_of
from ethbrake_marl.first_edition.game.rewards import RewardParams
from ethbrake_marl.first_edition.physics.columns import Packed, columns
from ethbrake_marl.first_edition.physics.episode import onset_s, stands, step_end_s
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND, command_acts
from ethbrake_marl.first_edition.physics.pieces import force_at
from ethbrake_marl.first_edition.physics.rows import FLAG, LISTED, ROW, place_forces, place_obstacle, rows_for
from ethbrake_marl.first_edition.physics.segment import advance_table
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds

# columns of ``clock``
START = 0  # time of the first decision (s)

STEP = 1  # number of steps taken

LAST_STEP = 2  # number of the step that ends at the horizon

ENDED = 3  # 1 after the episode has ended, else 0

CLOCK_WIDTH = 4

# rows of ``outcome``: results of the step in each world
STEP_FIRST_HARM = 0  # first-impact harm of the step (m2/s2)

STEP_TOTAL_HARM = 1  # total harm of the step (m2/s2)

TERMINATED = 2  # 1 if the step ended the episode at rest, else 0

TRUNCATED = 3  # 1 if the step ended the episode at the horizon, else 0

SAFE_END = 4  # 1 if the episode ended without any impact, else 0

FAILED = 5  # status code of the kernel if the world could not be advanced, else 0

OUTCOME_ROWS = 6

# indices of ``settings``
TIME_STEP, HORIZON, HARM_WEIGHT, HARM_IS_TOTAL, TERMINAL_WEIGHT = range(5)

BAD_ACTION = -1


class Step(NamedTuple):
    """Results of one step of n worlds with N vehicles."""

    reward: Floats  # [n, N] reward of each vehicle
    outcome: Floats  # [OUTCOME_ROWS, n] raw results of the compiled step; use the properties to read them
    params: RewardParams  # settings of the reward
    further: dict[str, Floats]  # name -> unweighted reward term that the compiled step does not know, [n] or [n, N]
    vector: Floats | None = None  # [n, N, K] vector reward of each vehicle; None unless the engine was asked for one

    @property
    def terminated(self) -> Bools:
        """Whether this step ended the episode because the line is at rest and no command would move a vehicle, [n]."""
        return self._is(TERMINATED)

    @property
    def truncated(self) -> Bools:
        """Whether this step ended the episode at the horizon, or because the world could not be advanced, [n]."""
        return self._is(TRUNCATED)

    @property
    def ended(self) -> Bools:
        """Whether this step terminated or truncated the episode, [n]."""
        return self.terminated | self.truncated

    @property
    def failed(self) -> Ints:
        """Status code of the physics for each world that this step could not advance, 0 for all other worlds, [n]."""
        return np.asarray(self.outcome[FAILED], np.int64)

    @property
    def safe_end(self) -> Bools:
        """Whether this step ended an episode that had no impact from beginning to end, [n]."""
        return self._is(SAFE_END)

    @property
    def first_impact_harm(self) -> Floats:
        """First-impact harm of this step, summed over the line, [n] m2/s2."""
        return np.asarray(self.outcome[STEP_FIRST_HARM], np.float64)

    @property
    def total_harm(self) -> Floats:
        """Total harm of this step, summed over the line, [n] m2/s2."""
        return np.asarray(self.outcome[STEP_TOTAL_HARM], np.float64)

    @property
    def shared(self) -> dict[str, Floats]:
        """Unweighted reward terms that have the same value for all vehicles of a world: {name: values, [n]}."""
        return self.params.shared(self.counted_harm, self.outcome[SAFE_END])

    @property
    def terms(self) -> dict[str, Floats]:
        """All unweighted reward terms: {name: values}; [n] if all vehicles have the same value, else [n, N]."""
        return self.shared | self.further

    @property
    def counted_harm(self) -> Floats:
        """Harm of this step, summed over the line, [n] m2/s2, under the harm count that the reward uses."""
        return self.first_impact_harm if self.params.harm_count == "first" else self.total_harm

    def _is(self, row: int) -> Bools:
        return np.asarray(self.outcome[row] == 1.0, np.bool_)


@compiled(apart=True, bare=True)
def place_row(table: Floats, state: Floats, params: Floats, k: int, pieces: Floats) -> None:
    """Write into ``table`` the quantities of world ``k`` that are needed only if brakes take time to build up.

    This code is not inside the loop of ``step_worlds``, because there it would slow down the simulation of worlds whose
    brakes act at once.
    """
    column, N = columns(state), pieces.shape[0]
    command, brake_rate, release_rate = column.command, column.brake_rate, column.release_rate
    place_forces(
        table, state[k, command : command + N], params[k, brake_rate : brake_rate + N],
        params[k, release_rate : release_rate + N], pieces,
    )  # fmt: skip


@compiled
def step_worlds(  # noqa: C901  # one loop on purpose: handing these arrays to functions costs more than the work
    state: Floats, params: Floats, clock: Floats, actions: Floats, learners: Ints, settings: Floats, no_rows: Floats,
    builds_up: bool, pieces: Floats, wanted: Floats, reward: Floats, outcome: Floats,
) -> tuple[int, int]:  # fmt: skip
    """Advance the world of every running episode by one step.

    If an action is outside [-1, 1], no world moves. A world that the physics cannot advance keeps its state; its
    episode is truncated with the reward 0, and ``outcome`` contains the status code of the failure. ``state`` and
    ``clock`` change in place. ``learners`` and ``settings`` are the fields of ``Rules``. ``no_rows`` is ``NO_ROWS``, so
    that the physics keeps no list of single impacts. ``pieces`` are used only if ``builds_up`` is True: if brakes take
    time to build up in some world, or if a script follows a braking profile.

    Returns ``(-1, FLAG.DONE)`` if all worlds were advanced. If at least one world was not advanced, returns the row
    number of one of these worlds, and ``BAD_ACTION`` or the status code of the physics.
    """
    n, N = wanted.shape
    for k in range(n):
        for c in range(learners.shape[0]):
            if not -1.0 <= actions[k, c] <= 1.0:
                return k, BAD_ACTION
    column = columns(state)
    speed, command, previous, gap, harm = column.speed, column.command, column.previous, column.gap, column.harm
    braking, driving, latency, mass, limit = column.braking, column.driving, column.latency, column.mass, column.limit
    P, obstacle = N - 1, column.obstacle
    worst, worst_status = -1, FLAG.DONE
    at = 1 if state.shape[1] > obstacle else 0  # vehicle i is in column at + i; an obstacle is in column 0
    table = np.zeros((rows_for(pieces.shape[1]) if builds_up else ROW.OF_SEGMENT, N + at))
    for k in range(n):
        if clock[k, ENDED] == 1.0:
            for f in range(OUTCOME_ROWS):
                outcome[f, k] = 0.0
            for i in range(N):
                reward[k, i] = 0.0
            continue
        for c in range(learners.shape[0]):
            i = learners[c]
            wanted[k, i] = command_of(actions[k, c], params[k, braking + i], params[k, driving + i])
        clock[k, STEP] += 1.0
        at_horizon = clock[k, STEP] >= clock[k, LAST_STEP]
        time = state[k, column.time]
        until = step_end_s(clock[k, STEP], clock[k, LAST_STEP], clock[k, START], settings[TIME_STEP], settings[HORIZON])
        if at == 1:
            place_obstacle(table, min(state[k, obstacle], BOUND.FAR_AWAY_M), state[k, obstacle + 1])
        for i in range(N):
            table[ROW.SPEED, at + i] = state[k, speed + i]
            table[ROW.COMMAND, at + i] = wanted[k, i]
            table[ROW.MASS, at + i] = params[k, mass + i]
            table[ROW.LIMIT, at + i] = params[k, limit + i]
            table[ROW.ONSET, at + i] = onset_s(params[k, latency + i], time)
            state[k, previous + i] = state[k, command + i]
            if not builds_up:
                state[k, command + i] = wanted[k, i] if command_acts(params[k, latency + i], until) else 0.0
        if builds_up:
            place_row(table, state, params, k, pieces)
        for p in range(P):
            table[ROW.GAP, at + p] = state[k, gap + p]
            table[ROW.HIT, at + p] = state[k, gap + P + p]
        status = advance_table(table, params[k, column.restitution], until - time, time, k, no_rows, 0)[1]
        outcome[FAILED, k] = 0.0
        if status != FLAG.DONE:
            worst, worst_status = k, status
            for f in range(OUTCOME_ROWS):
                outcome[f, k] = 0.0
            outcome[TRUNCATED, k], outcome[FAILED, k] = 1.0, status
            clock[k, ENDED] = 1.0
            clock[k, STEP] -= 1.0
            for i in range(N):
                state[k, command + i] = state[k, previous + i]
                reward[k, i] = 0.0
            continue
        state[k, column.time] = until
        at_rest = True
        for i in range(N):
            state[k, speed + i] = table[ROW.SPEED, at + i]
            at_rest = at_rest and stands(table[ROW.SPEED, at + i], wanted[k, i])
        if builds_up:
            for i in range(N):
                state[k, command + i] = force_at(table, at + i, wanted[k, i], params[k, latency + i], until)
                at_rest = at_rest and state[k, command + i] <= 0.0
        impacts, first_harm, total_harm = 0.0, 0.0, 0.0
        if at == 1 and state[k, obstacle] < math.inf:
            state[k, obstacle] = table[ROW.GAP, 0]
            state[k, obstacle + 1] = table[ROW.HIT, 0]
            state[k, obstacle + 2] += table[ROW.FIRST_HARM, 0]
            state[k, obstacle + 3] += table[ROW.TOTAL_HARM, 0]
            state[k, obstacle + 4] += table[ROW.COUNT, 0]
            first_harm = table[ROW.FIRST_HARM, 0]
            total_harm = table[ROW.TOTAL_HARM, 0]
            impacts = state[k, obstacle + 4]
        for p in range(P):
            state[k, gap + p] = table[ROW.GAP, at + p]
            state[k, gap + P + p] = table[ROW.HIT, at + p]
            state[k, harm + p] += table[ROW.FIRST_HARM, at + p]
            state[k, harm + P + p] += table[ROW.TOTAL_HARM, at + p]
            state[k, harm + 2 * P + p] += table[ROW.COUNT, at + p]
            first_harm += table[ROW.FIRST_HARM, at + p]
            total_harm += table[ROW.TOTAL_HARM, at + p]
            impacts += state[k, harm + 2 * P + p]
        outcome[STEP_FIRST_HARM, k] = first_harm
        outcome[STEP_TOTAL_HARM, k] = total_harm
        over = at_rest or at_horizon
        clock[k, ENDED] = 1.0 if over else 0.0
        outcome[TERMINATED, k] = 1.0 if at_rest else 0.0
        outcome[TRUNCATED, k] = 1.0 if over and not at_rest else 0.0
        outcome[SAFE_END, k] = 1.0 if over and impacts == 0.0 else 0.0
        shared = settings[TERMINAL_WEIGHT] if outcome[SAFE_END, k] == 1.0 else 0.0
        shared -= settings[HARM_WEIGHT] * (total_harm if settings[HARM_IS_TOTAL] == 1.0 else first_harm)
        for i in range(N):
            reward[k, i] = shared
    return worst, worst_status


NO_ROWS = np.empty((0, LISTED.WIDTH))  # an empty array of impacts, so that no impact is recorded


class Rules(NamedTuple):
    """The settings of an engine's steps, and the compiled step that uses these settings."""

    learners: Ints  # [L] indices of the learners
    settings: Floats  # [5] TIME_STEP, HORIZON, HARM_WEIGHT, HARM_IS_TOTAL, TERMINAL_WEIGHT
    builds_up: bool  # whether brakes take time to build up in some world, or a script follows a braking profile
    pieces: Floats  # [N, 2 K] braking profiles (see the module docstring)

    def step(
        self, worlds: Packed, clock: Floats, actions: Floats, wanted: Floats, reward: Floats, outcome: Floats
    ) -> int:
        """Advance the world of every running episode by one step, in place, and return a status code.

        The status code is ``FLAG.DONE`` if all worlds were advanced. The status code is ``BAD_ACTION`` if an action is
        outside [-1, 1]; in this case no world was moved. Any other status code means that a check of the physics failed
        in at least one world.
        """
        _, status = step_worlds(
            *worlds, clock, actions, self.learners, self.settings, NO_ROWS, self.builds_up, self.pieces, wanted,
            reward, outcome,
        )  # fmt: skip
        return status

    def unpack(self, packed: Packed) -> Worlds:
        """Return packed worlds as ``Worlds`` with new arrays; their vehicles follow the braking profiles ``pieces``."""
        worlds = packed.worlds()
        if self.pieces.shape[1] == 0:
            return worlds
        pieces = np.repeat(self.pieces[np.newaxis], worlds.n, axis=0)
        return replace(worlds, vehicles=replace(worlds.vehicles, pieces=pieces))
