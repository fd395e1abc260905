"""The stream of episodes: worlds drawn at the alert and advanced to their first decision."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError, count_of
from ethbrake_marl.first_edition.engine.compiled_step import CLOCK_WIDTH, LAST_STEP, START
from ethbrake_marl.first_edition.engine.memory import ask_script, begin_script, is_state_free, within_capacity
from ethbrake_marl.first_edition.engine.scripts import SAMPLED_AT_ONCE, Script
from ethbrake_marl.first_edition.game.definition import Game
from ethbrake_marl.first_edition.game.harm import Ledger
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.columns import Packed
from ethbrake_marl.first_edition.physics.episode import Decisions
from ethbrake_marl.first_edition.physics.left_out import Impacts, leaving_out_failed
from ethbrake_marl.first_edition.physics.rows import FLAG
from ethbrake_marl.first_edition.physics.state import Floats, Ints, Worlds


class Start(NamedTuple):
    """Worlds of new episodes, advanced from the alert to their first decision."""

    origin: Worlds  # worlds at the alert, t = 0: the n worlds and possibly further worlds
    first: int  # row in ``origin`` of the first of the n worlds; the other worlds follow it
    packed: Packed  # the n worlds at the first decision
    clock: Floats  # [n, CLOCK_WIDTH] times and steps of the episodes, see ``compiled_step``
    wanted: Floats  # [n, N] commands of the scripts whose command never changes, 0 for all other vehicles (m/s2)

    @property
    def alert(self) -> Worlds:
        """The n worlds of the new episodes at the alert, t = 0."""
        return self.origin.take(np.arange(self.first, self.first + len(self.clock)))

    def part(self, first: int, count: int) -> Start:
        """Return ``count`` consecutive worlds of this object, beginning with its world number ``first``."""
        rows = slice(first, first + count)
        packed = Packed(self.packed.state[rows], self.packed.params[rows])
        return Start(self.origin, self.first + first, packed, self.clock[rows], self.wanted[rows])


class FailedWorld(UserWarning):
    """Warning that the physics could not advance a world; this world's episode is truncated or left out."""


class Roster:
    """Record of which world runs in each row of an engine's arrays, and which worlds could not be advanced.

    Args:
        n: number of rows.
        seed: seed of the stream from which the worlds come.
        first: number of the world in row 0, counted from the beginning of the stream; row k has world ``first + k``.
            None: the worlds do not come from the stream.
        given: the worlds at the alert, if the caller has passed worlds.

    """

    def __init__(self, n: int, seed: int, first: int | None, given: Worlds | None = None) -> None:
        self.failed: dict[int, str] = {}  # row -> reason, until a new episode begins in that row
        self.warns = True  # whether to warn with ``FailedWorld``; if not, the caller must check ``failed``
        self.seed = seed
        self.given = given  # worlds passed by the caller, at the alert; valid in rows where ``numbers`` is -1
        self.numbers = np.full(n, -1, np.int64) if first is None else first + np.arange(n)  # [n]; -1: passed

    def apart(self) -> Roster:
        """Return a copy of this record; a change of the copy does not change this record."""
        new = copy.copy(self)
        new.failed, new.numbers = dict(self.failed), self.numbers.copy()
        return new

    def renew(self, rows: Ints, first: int) -> None:
        """Record that the worlds with the numbers ``first``, ``first + 1``, ... of the stream now run in ``rows``."""
        self.numbers[rows] = first + np.arange(len(rows))
        for row in self.failed.keys() & rows.tolist() if self.failed else ():
            del self.failed[row]

    def mark(self, status: Ints, from_s: Floats, until_s: Floats) -> None:
        """Record the worlds that a step could not advance, and give a ``FailedWorld`` warning for each of them.

        ``status`` [n] is the status code of the physics, 0 for worlds that were advanced. The last step began at
        ``from_s`` and should have ended at ``until_s``, [n] s.
        """
        new = FLAG.failure(np.where(status == 0, FLAG.DONE, status), from_s, until_s).worlds
        self.failed |= new
        for row, reason in new.items() if self.warns else ():
            number = int(self.numbers[row])
            name = f"world {number} of seed {self.seed}" if number >= 0 else f"the world of row {row}"
            warnings.warn(FailedWorld(f"{name}: {reason}; its episode was truncated there"), stacklevel=4)


class Stream:
    """The training worlds of a seed, one after the other, each advanced to its first decision.

    In the stream, learners, and scripts with a memory, coast until the first decision of the ``deciders``. If a script
    with a memory decides before the first decision of the ``deciders``, the engine advances the worlds once more from
    the alert.

    Args:
        scenario: the scenario from which worlds are drawn.
        deciders: indices (0 = front) of the vehicles at whose decisions the engine's steps begin and end. The first
            decision is at the shortest latency of these vehicles.
        scripts: dictionary from the index of each scripted vehicle to the vehicle's script.
        seed: seed of the stream.

    """

    def __init__(self, scenario: Game, deciders: Sequence[int], scripts: Mapping[int, Script], seed: int) -> None:
        self._scenario = scenario
        self._deciders = list(deciders)
        self._state_free = {i: script for i, script in scripts.items() if is_state_free(script)}
        self._pieces = {i: getattr(script, "braking_pieces", ()) for i, script in scripts.items()}
        # scripts that are passed to each script's ``begin``
        self.known = {i: script for i, script in scripts.items() if i not in self._deciders}
        self.restart(seed)

    def restart(self, seed: int, position: int = 0) -> None:
        """Continue with world number ``position`` (from 0) of the stream that belongs to ``seed``."""
        self.seed, self._drawn = seed, position
        self._pool: Start | None = None
        self._next = 0

    @property
    def position(self) -> int:
        """Number of the world that ``take`` returns next, counted from 0 at the beginning of the stream."""
        return self._drawn - (0 if self._pool is None else len(self._pool.clock) - self._next)

    def take(self, count: int) -> Start:
        """Return the next ``count`` worlds of the stream, at their first decision, and move on by ``count`` worlds."""
        if self._pool is None or self._next + count > len(self._pool.clock):
            self._fill(count)
        assert self._pool is not None
        taken = self._pool.part(self._next, count)
        self._next += count
        return taken

    def _fill(self, count: int) -> None:
        """Draw further worlds and advance them to their first decision, so that ``take`` can return ``count`` worlds.

        If a world cannot be advanced to its first decision, the next world that can be advanced is used in its place,
        so all other worlds keep their numbers in the stream. For each world that cannot be advanced, ``_fill`` gives a
        ``FailedWorld`` warning.
        """
        first, size = self.position, max(4 * count, SAMPLED_AT_ONCE)
        alert = self._scenario.sample(size, self.seed, first=self._drawn, channel="training").worlds
        if self._pool is not None:
            alert = Worlds.concatenate([self._pool.part(self._next, self._drawn - first).alert, alert])
        start, starts, failed = leaving_out_failed(lambda rows: self.prepare(alert.take(rows)), np.arange(alert.n))
        if start is None:
            raise PhysicsError(failed)
        for row, reason in failed.items():
            warnings.warn(
                FailedWorld(f"world {first + row} of seed {self.seed}: {reason}; this world is left out"), stacklevel=2
            )
        if failed:
            later = np.searchsorted(starts, np.arange(alert.n)) % len(starts)
            start = self.prepare(alert.take(starts[later]))
        self._pool, self._next = start, 0
        self._drawn += size

    def prepare(self, alert: Worlds) -> Start:
        """Return the worlds ``alert``, which are at t = 0, advanced to their first decision.

        Raises ``InvalidInput`` if the first decision of a world is not before the horizon.
        """
        alert = alert.play_pieces(self._pieces)
        clock = np.zeros((alert.n, CLOCK_WIDTH))
        clock[:, START] = alert.first_decision_s(self._deciders)
        step, horizon = self._scenario.time_step_s, self._scenario.horizon_s
        if not (clock[:, START] < horizon).all():
            late = float(clock[:, START].max())
            raise InvalidInput(f"reset: the first decision, at {late:g} s, must be before the horizon, {horizon:g} s")
        clock[:, LAST_STEP] = Decisions(clock[:, START], step).before(horizon)
        wanted = np.zeros(alert.speeds_mps.shape)
        for vehicle, script in self._state_free.items():
            memory = begin_script(script, alert, vehicle, self.known)
            command, _ = ask_script(script, alert, memory, vehicle)
            wanted[:, vehicle] = within_capacity(command, alert, vehicle, script)
        return Start(alert, 0, moved(alert, wanted, clock[:, START]), clock, wanted)


def check_alert(worlds: Worlds, n: int, vehicles: int) -> None:
    """Raise ``InvalidInput`` unless ``worlds`` are ``n`` worlds of ``vehicles`` vehicles at t = 0, without impacts."""
    if (worlds.n, worlds.N) != (n, vehicles):
        raise InvalidInput(
            f"reset: got {count_of(worlds.n, 'world')} of {worlds.N} vehicles; {count_of(n, 'world')} of {vehicles}"
            " vehicles must be passed"
        )
    at_alert = (worlds.time_s == 0.0) & ~worlds.pair_hit.any(axis=1) & ~worlds.obstacle_hit
    if not at_alert.all():
        k = int(np.argmin(at_alert))
        what = "after an impact" if worlds.time_s[k] == 0.0 else f"at {worlds.time_s[k]:g} s"
        raise InvalidInput(f"reset: world {k} is {what}; episodes start at the alert, t = 0, without any impact")


def moved(alert: Worlds, wanted: Floats, start_s: Floats) -> Packed:
    """Return worlds advanced from the alert to their first decision, as packed arrays that include the harm so far.

    ``wanted`` [n, N] m/s2 are the constant commands until the first decision, at the time ``start_s`` [n] s.
    """
    after, impacts = advance(alert, wanted, until_s=start_s)
    return packed_with(after, impacts)


def packed_with(worlds: Worlds, harm: Impacts | Ledger) -> Packed:
    """Return ``worlds`` packed into two arrays (layout: ``physics.columns``), with ``harm`` as the harm so far."""
    packed = Packed.of(worlds)
    column, pairs = packed.column, worlds.N - 1
    for group, values in enumerate((harm.first_impact_harm, harm.total_harm, harm.count)):
        packed.state[:, column.harm + group * pairs : column.harm + (group + 1) * pairs] = values
    if packed.has_obstacle:
        obstacle = (harm.obstacle_first_harm, harm.obstacle_total_harm, harm.obstacle_count)
        packed.state[:, column.obstacle + 2 :] = np.column_stack(obstacle)
    return packed
