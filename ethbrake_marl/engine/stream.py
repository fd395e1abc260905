"""The stream of episodes: worlds at the alert, made ready for their first decision."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from ethbrake_marl.engine.step import CLOCK_WIDTH, LAST_STEP, START
from ethbrake_marl.errors import (
    AgentFailed,
    EthBrakeError,
    FailedWorld,
    InvalidInput,
    PhysicsError,
    count_of,
    describe_error,
)
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, advance, concatenate, leaving_out_failed
from ethbrake_marl.physics.advance import Packed, failure, harm_at, has_obstacle, pack, state_width
from ethbrake_marl.physics.kernel import FLAG, first_decision_s, number_of_decisions
from ethbrake_marl.physics.worlds import read_only
from ethbrake_marl.scenario import Scenario

_SAMPLED_AT_ONCE = 1024  # training worlds are drawn in blocks of at least this many


class Script(Protocol):
    """Drives one vehicle in every world of a batch of ``n``; one object per vehicle. An ``Agent`` is one with a name.

    It is asked when the latency of its vehicle has elapsed, and every time step from then on, whoever learns. With an
    attribute ``state_free = True`` it is asked only once per episode, right after ``begin``: its command is fixed at
    the alert and never changes. What it remembers of each episode stands in arrays whose first axis is the world.
    """

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """New episodes start in these rows of the batch.

        ``worlds`` holds those rows only (``len(rows)`` worlds), in their state at the alert. The first call of a
        batch has ``rows = 0..n-1``; later ones, after an automatic reset, any subset.
        """

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Wanted signed acceleration of ``vehicle`` (index from 0) in every world of the batch, [n] m/s2.

        Not each world need have a decision now: of the others the command is not used, and its memory put back.
        """


class Start(NamedTuple):
    """Worlds ready for their first decision."""

    origin: Worlds  # at t = 0: these worlds are its ``first``, ``first + 1``, ...
    first: int
    packed: Packed  # at the first decision
    clock: Floats  # [n, CLOCK_WIDTH]
    wanted: Floats  # [n, N] commands of the state-free scripts, 0 for all others

    @property
    def alert(self) -> Worlds:
        """These worlds at the alert, t = 0."""
        return self.origin.take(np.arange(self.first, self.first + len(self.clock)))

    def part(self, first: int, count: int) -> Start:
        """``count`` worlds of these, from ``first`` on."""
        rows = slice(first, first + count)
        packed = Packed(self.packed.state[rows], self.packed.params[rows])
        return Start(self.origin, self.first + first, packed, self.clock[rows], self.wanted[rows])


class Roster:
    """Which world of the stream stands in each row of a batch, and which of them could not be advanced.

    ``first`` is the number of row 0's world, the others follow; None: the worlds were given, and have no number.
    """

    def __init__(self, n: int, seed: int, first: int | None, given: Worlds | None = None) -> None:
        self.failed: dict[int, str] = {}  # by row, and why; until a new episode begins there
        self.warns = True  # with a ``FailedWorld`` that names the world; off: the caller looks at ``failed``
        self.seed = seed
        self.given = given  # the worlds that were given, at the alert: where ``numbers`` are -1
        self.numbers = np.full(n, -1, np.int64) if first is None else first + np.arange(n)  # by row; -1: given

    def apart(self) -> Roster:
        """One that goes on from here without changing this one."""
        new = copy.copy(self)
        new.failed, new.numbers = dict(self.failed), self.numbers.copy()
        return new

    def renew(self, rows: Ints, first: int) -> None:
        """World ``first`` of the stream and those after it now stand in these rows."""
        self.numbers[rows] = first + np.arange(len(rows))
        for row in self.failed.keys() & rows.tolist() if self.failed else ():
            del self.failed[row]

    def mark(self, status: Ints, from_s: Floats, until_s: Floats) -> None:
        """Enter the worlds with a ``status``: a step from ``from_s`` to ``until_s`` [n] could not advance them."""
        new = failure(np.where(status == 0, FLAG.DONE, status), from_s, until_s).worlds
        self.failed |= new
        for row, reason in new.items() if self.warns else ():
            number = int(self.numbers[row])
            name = f"world {number} of seed {self.seed}" if number >= 0 else f"the world of row {row}"
            warnings.warn(FailedWorld(f"{name}: {reason}; its episode was cut off there"), stacklevel=4)


class Stream:
    """The training worlds of a seed, one after the other, each ready for its first decision.

    Learners and scripts with a memory coast until then: whoever uses them moves their worlds anew (``moved``).
    """

    def __init__(self, scenario: Scenario, deciders: Sequence[int], scripts: Mapping[int, Script], seed: int) -> None:
        self._scenario = scenario
        self._deciders = list(deciders)
        self._state_free = {i: script for i, script in scripts.items() if is_state_free(script)}
        self.restart(seed)

    def restart(self, seed: int) -> None:
        """Go back to the first world of ``seed``."""
        self.seed = seed
        self._drawn = 0
        self._pool: Start | None = None
        self._next = 0

    @property
    def position(self) -> int:
        """Number of the next world in the stream."""
        return self._drawn - (0 if self._pool is None else len(self._pool.clock) - self._next)

    def take(self, count: int) -> Start:
        """The next ``count`` worlds."""
        if self._pool is None or self._next + count > len(self._pool.clock):
            self._fill(count)
        assert self._pool is not None
        taken = self._pool.part(self._next, count)
        self._next += count
        return taken

    def _fill(self, count: int) -> None:
        left = None
        if self._pool is not None:
            left = self._pool.part(self._next, len(self._pool.clock) - self._next).alert
        size = max(4 * count, _SAMPLED_AT_ONCE)
        sample = self._scenario.sample(size, self.seed, first=self._drawn, channel="training")
        self._pool = self._prepare_all(sample.worlds if left is None else concatenate([left, sample.worlds]))
        self._drawn += size
        self._next = 0

    def _prepare_all(self, alert: Worlds) -> Start:
        """``prepare``; a world that cannot be advanced to its first decision gives its place to the next one that can.

        A ``FailedWorld`` warning names it. So worlds keep their places in the stream, and a training goes on.
        """
        start, kept, failed = leaving_out_failed(lambda rows: self.prepare(alert.take(rows)), np.arange(alert.n))
        if start is None:
            raise PhysicsError(failed)
        if not failed:
            return start
        first = self.position
        for row, reason in failed.items():
            warnings.warn(FailedWorld(f"world {first + row} of seed {self.seed}: {reason}; left out"), stacklevel=2)
        later = np.searchsorted(kept, np.arange(alert.n)) % len(kept)
        return self.prepare(alert.take(kept[later]))

    def prepare(self, alert: Worlds) -> Start:
        """Worlds at t = 0, made ready for their first decision. Raises ``InvalidInput`` if nobody may ever decide."""
        clock = np.zeros((alert.n, CLOCK_WIDTH))
        clock[:, START] = first_decision_s(alert, self._deciders)
        step, horizon = self._scenario.time_step_s, self._scenario.horizon_s
        if not (clock[:, START] < horizon).all():
            late = float(clock[:, START].max())
            raise InvalidInput(f"reset: nobody decides before the horizon ({late:g} s >= {horizon:g} s)")
        clock[:, LAST_STEP] = number_of_decisions(clock[:, START], step, horizon)
        wanted = np.zeros(alert.speeds_mps.shape)
        for vehicle, script in self._state_free.items():
            begin_script(script, alert, vehicle, np.arange(alert.n))
            wanted[:, vehicle] = within_capacity(ask_script(script, alert, vehicle), alert, vehicle, script)
        return Start(alert, 0, moved(alert, wanted, clock[:, START]), clock, wanted)


def check_alert(worlds: Worlds, n: int, vehicles: int) -> None:
    """Refuse worlds, with ``InvalidInput``, that are not ``n`` lines of ``vehicles`` at the alert: t = 0, no impact."""
    if (worlds.n, worlds.N) != (n, vehicles):
        raise InvalidInput(
            f"reset: {count_of(worlds.n, 'world')} of {worlds.N} vehicles given; {n} of {vehicles} needed"
        )
    at_alert = (worlds.time_s == 0.0) & ~worlds.pair_hit.any(axis=1) & ~worlds.obstacle_hit
    if not at_alert.all():
        k = int(np.argmin(at_alert))
        what = "after an impact" if worlds.time_s[k] == 0.0 else f"at {worlds.time_s[k]:g} s"
        raise InvalidInput(f"reset: world {k} is {what}; episodes start at the alert, t = 0, without any impact")


def is_state_free(script: Script) -> bool:
    """Whether the script's command never changes during an episode."""
    return bool(getattr(script, "state_free", False))


def moved(alert: Worlds, wanted: Floats, start_s: Floats) -> Packed:
    """Worlds at t = 0 moved to their first decision, harm on the way included."""
    after, impacts = advance(alert, wanted, until_s=start_s)
    packed = pack(after)
    at, pairs = harm_at(alert.N), alert.N - 1
    for group, harm in enumerate((impacts.first_impact_harm, impacts.total_harm, impacts.count)):
        packed.state[:, at + group * pairs : at + (group + 1) * pairs] = harm
    if has_obstacle(packed.state, alert.N):
        obstacle = (impacts.obstacle_first_harm, impacts.obstacle_total_harm, impacts.obstacle_count)
        packed.state[:, state_width(alert.N) + 2 :] = np.column_stack(obstacle)
    return packed


def is_ours(script: Script) -> bool:
    """Whether this package made the script; any other gets worlds that it cannot write to, as they are everybody's."""
    return type(script).__module__.startswith("ethbrake_marl.")


def begin_script(script: Script, worlds: Worlds, vehicle: int, rows: Ints) -> None:
    """Tell a script that episodes begin; what one that is not ours raises becomes ``InvalidInput`` naming it."""
    try:
        if is_ours(script):
            script.begin(worlds, vehicle, rows)
        else:
            script.begin(read_only(worlds), vehicle, rows.copy())
    except Exception as error:
        raise _named(error, script, "begin", worlds, vehicle) from error


def ask_script(script: Script, worlds: Worlds, vehicle: int) -> Floats:
    """The command of a script, [n] m/s2.

    Raises ``AgentFailed`` naming it, world, moment and shape for a command of another shape, or of no numbers, and
    ``InvalidInput`` naming it for whatever a script that is not ours raises.
    """
    try:
        command = script.act(worlds if is_ours(script) else read_only(worlds), vehicle)
    except Exception as error:
        raise _named(error, script, "act", worlds, vehicle) from error
    given = np.asarray(command)
    if given.shape != (worlds.n,) or given.dtype.kind not in "fiub":
        short = given.ndim > 0 and len(given) < worlds.n
        row = len(given) if short else 0
        raise AgentFailed(
            getattr(script, "name", type(script).__name__),
            row if worlds.n else None,
            f"vehicle_{vehicle + 1} at {worlds.time_s[row : row + 1].min(initial=np.inf):.2f} s: gave {given.dtype} of"
            f" shape {given.shape}; one number per world is needed, shape ({worlds.n},)",
        )
    return command


def ask_where_due(script: Script, worlds: Worlds, vehicle: int, due: Bools) -> Floats:
    """The command of a script where its decision is due, 0 elsewhere, [n] m/s2; there its memory stays as it was."""
    before = {} if due.all() else copy.deepcopy(memory_of(script))
    command = np.where(due, ask_script(script, worlds, vehicle), 0.0)
    for name, array in memory_of(script).items():
        if name in before and array.shape == before[name].shape and len(array) == worlds.n:
            array[~due] = before[name][~due]
    return within_capacity(command, worlds, vehicle, script, due)


def memory_of(owner: object) -> dict[str, Any]:
    """The arrays that a script keeps, by name: attributes, what stands in tuples and mappings, agents inside it."""
    if is_agent := hasattr(owner, "begin") and hasattr(owner, "act"):
        parts = dict(vars(owner)) if hasattr(owner, "__dict__") else {}
    elif isinstance(owner, Mapping):
        parts = dict(owner)
    elif isinstance(owner, tuple | list):
        parts = {str(at): value for at, value in enumerate(owner)}
    else:
        return {}
    arrays: dict[str, Any] = {}
    for name, value in parts.items():
        if getattr(value, "shape", ()):
            arrays[str(name)] = value
        elif is_agent or not hasattr(value, "act"):  # the others of one that looks ahead are not inside it
            arrays |= {f"{name}.{inner}": array for inner, array in memory_of(value).items()}
    return arrays


def _named(error: Exception, script: Script, what: str, worlds: Worlds, vehicle: int) -> Exception:
    """The error to raise for what a script raised: its own, where it speaks for itself."""
    if isinstance(error, EthBrakeError) or is_ours(script):
        return error
    who = f"agent {getattr(script, 'name', type(script).__name__)!r} of vehicle_{vehicle + 1}"
    moment = f"{count_of(worlds.n, 'world')} at {worlds.time_s.min(initial=np.inf):.2f} s"
    return InvalidInput(f"{who}: {what} on {moment}: {describe_error(error)}")


def within_capacity(
    command_mps2: Floats, worlds: Worlds, vehicle: int, script: Script, due: Bools | None = None
) -> Floats:
    """A script's command [n], refused with ``AgentFailed`` where it is ``due`` and not within the capacities."""
    low, high = -worlds.vehicles.braking_capacity_mps2[:, vehicle], worlds.vehicles.driving_capacity_mps2[:, vehicle]
    good = (command_mps2 >= low) & (command_mps2 <= high)
    if due is not None:
        good |= ~due
    if not good.all():
        k = int(np.argmin(good))
        raise AgentFailed(
            getattr(script, "name", type(script).__name__),
            k,
            f"vehicle_{vehicle + 1} at {worlds.time_s[k]:.2f} s: command {command_mps2[k]:g} m/s2; must be in"
            f" [{low[k]:g}, {high[k]:g}]",
        )
    return command_mps2
