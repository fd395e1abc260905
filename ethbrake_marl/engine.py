"""Episodes of ``n`` worlds at once: reset, step, roles, latency gates, episode ends.

Every interface of the environment, every evaluation and every search is a thin layer on this. An episode starts at
t = 0, when Vehicle 1 brakes; ``reset`` moves exactly to the first moment at which a learner's latency has elapsed.
"""

from __future__ import annotations

import copy
import inspect
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import checked_action, command_of
from ethbrake_marl.errors import (
    AgentFailed,
    EthBrakeError,
    InvalidInput,
    PhysicsError,
    UncertifiedStep,
    count_of,
    describe_error,
    renumbered,
)
from ethbrake_marl.harm import Ledger, empty_ledger, objective_harm
from ethbrake_marl.observations import Observation, Observations, ObservationSpec, Plan
from ethbrake_marl.physics import (
    BOUND,
    FLAG,
    LISTED,
    ROW,
    Bools,
    Decisions,
    Floats,
    Impacts,
    Ints,
    Packed,
    Worlds,
    advance,
    advance_table,
    columns,
    command_acts,
    compiled,
    force_at,
    hear_rows,
    leaving_out_failed,
    onset_s,
    place_forces,
    place_obstacle,
    rows_for,
    stands,
    step_end_s,
)
from ethbrake_marl.rewards import Reward, RewardParams, StepOutcome, reward_params
from ethbrake_marl.scenario import Scenario, common_observation, observations_of

# The compiled step of the engine: actions to commands, motion, episode ends, the terms of reward that all share.
#
# Worlds are rows of ``physics.batch``; ``clock`` [n, 4] holds what an episode needs beside them.

# columns of clock
START = 0  # time of the first decision (s)
STEP = 1  # steps taken
LAST_STEP = 2  # the step that ends at the horizon
ENDED = 3  # 1 once the episode has ended
CLOCK_WIDTH = 4
# rows of outcome: what the step brought to each world
STEP_FIRST_HARM = 0
STEP_TOTAL_HARM = 1
TERMINATED = 2  # 1 if the step ended the episode in this way, else 0
TRUNCATED = 3
SAFE_END = 4  # without any collision
FAILED = 5  # what went wrong (a status of the kernel) where the world could not be advanced, else 0
OUTCOME_ROWS = 6
# places in settings
TIME_STEP, HORIZON, HARM_WEIGHT, HARM_IS_TOTAL, TERMINAL_WEIGHT = range(5)
BAD_ACTION = -1


class Step(NamedTuple):
    """What one step brought, for every world of the batch."""

    reward: Floats  # [n, N]
    outcome: Floats  # [OUTCOME_ROWS, n] as the kernel tells it; read it through the properties
    params: RewardParams
    further: dict[str, Floats]  # unweighted reward terms that differ between vehicles or need the motion, each [n, N]

    @property
    def terminated(self) -> Bools:
        """Episodes that ended with this step with everything at rest and no command that would move it, [n]."""
        return self._is(TERMINATED)

    @property
    def truncated(self) -> Bools:
        """Episodes that reached the horizon with this step, [n]."""
        return self._is(TRUNCATED)

    @property
    def ended(self) -> Bools:
        """Episodes that ended with this step, [n]."""
        return self.terminated | self.truncated

    @property
    def failed(self) -> Ints:
        """What went wrong in the worlds that could not be advanced (a status of the kernel), 0 elsewhere, [n]."""
        return np.asarray(self.outcome[FAILED], np.int64)

    @property
    def safe_end(self) -> Bools:
        """Episodes that ended with this step without any collision, [n]."""
        return self._is(SAFE_END)

    @property
    def first_impact_harm(self) -> Floats:
        """Of the whole line in this step, [n]."""
        return np.asarray(self.outcome[STEP_FIRST_HARM], np.float64)

    @property
    def total_harm(self) -> Floats:
        """Likewise, every impact counted, [n]."""
        return np.asarray(self.outcome[STEP_TOTAL_HARM], np.float64)

    @property
    def shared(self) -> dict[str, Floats]:
        """Unweighted reward terms that are the same for all vehicles of a world, each [n]."""
        return self.params.shared(self.counted_harm, self.outcome[SAFE_END])

    @property
    def counted_harm(self) -> Floats:
        """Harm of the whole line in this step, as the reward counts impacts, [n]."""
        return self.first_impact_harm if self.params.harm_count == "first" else self.total_harm

    def _is(self, row: int) -> Bools:
        return np.asarray(self.outcome[row] == 1.0, np.bool_)


@compiled(apart=True, bare=True)
def place_row(table: Floats, state: Floats, params: Floats, k: int, pieces: Floats) -> None:
    """``place_forces`` of a row; a function of its own, as worlds without rates would pay for it in their loop."""
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
    """Advance every running world by one step, in place (state, clock, wanted); fills the last two arrays.

    ``actions`` [n, L] become the learners' commands in ``wanted`` [n, N]; nothing is moved if one of them is not in
    [-1, 1]. A world that cannot be advanced stays where it was; its episode is cut off there, without a reward, and
    marked in ``outcome``. Without ``builds_up`` no world's brakes do, nor come in ``pieces`` [N, 2 K], those of all
    worlds. Returns a world and what went wrong there (BAD_ACTION, or the status of one that could not be advanced), or
    (-1, DONE).
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
    at = 1 if state.shape[1] > obstacle else 0  # vehicle i stands in column at + i, behind an obstacle
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


# Who drives: scripts, and what they remember.

_SAMPLED_AT_ONCE = 1024  # training worlds are drawn in blocks of at least this many


class Script(Protocol):
    """Drives one vehicle in every world of a batch of ``n``. An ``Agent`` is one with a name.

    It is asked when the latency of its vehicle has elapsed, and every time step from then on, whoever learns.

    One that remembers nothing has ``act(worlds, vehicle)``, which gives the wanted signed acceleration of ``vehicle``
    (index from 0) in every world, [n] m/s2. One that remembers has two methods, and keeps nothing in itself:

    - ``begin(alert, vehicle, scripts) -> memory``: episodes start in the worlds ``alert``, at t = 0. ``scripts`` drive
      the vehicles that are scripted, by index; all others are free to decide.
    - ``act(worlds, memory, vehicle) -> (command, memory)``: the command [n] m/s2, and what it remembers then. Not each
      world need have a decision now: of the others neither is used.

    A memory is None, an array whose first axis is the world, or a tuple or mapping of such. Whoever runs the episodes
    owns it: takes rows of it, begins some anew, tries what would be. So it is never changed in place. What a mapping
    holds as ``predicted_harm`` [n] (m2/s2) is what the agent expected when the episode began.

    With an attribute ``state_free = True`` it is asked only once per episode, right after ``begin``: its command is
    fixed at the alert and never changes.
    """

    def act(self, *args: Any, **kwargs: Any) -> Any:
        """The command [n] m/s2, of one that remembers with its memory."""


# Memories: trees of arrays, row by row.

Memory = Any  # None, an array [n, ...], or a tuple or mapping of memories
_SHAPES = (
    "one that remembers has begin(alert, vehicle, scripts) -> memory and act(worlds, memory, vehicle) -> (command,"
    " memory); one that remembers nothing has no begin, and act(worlds, vehicle) -> command"
)


def map_memory(function: Callable[..., Any], memory: Memory, *others: Memory) -> Memory:
    """The function of every array of a memory, together with those in its place in the others."""
    if memory is None:
        return None
    if isinstance(memory, Mapping):
        return {key: map_memory(function, part, *(other[key] for other in others)) for key, part in memory.items()}
    if isinstance(memory, tuple | list):
        return tuple(map_memory(function, *parts) for parts in zip(memory, *others, strict=True))
    return function(memory, *others)


def take_memory(memory: Memory, rows: Ints) -> Memory:
    """The memory of some rows, in its own arrays."""
    return map_memory(lambda array: array[rows], memory)


def renew_memory(memory: Memory, rows: Ints, part: Memory) -> Memory:
    """The memory with that of ``rows`` from another; what that does not hold, or not yet, stays as it is."""
    if part is None:
        return memory
    if memory is None or (isinstance(part, Mapping) and not part.keys() <= memory.keys()):
        raise InvalidInput("agent: what begins anew remembers other things than what began before")
    if isinstance(part, Mapping):
        return {key: renew_memory(of, rows, part.get(key)) for key, of in memory.items()}
    if isinstance(part, tuple | list):
        return tuple(renew_memory(old, rows, new) for old, new in zip(memory, part, strict=True))
    renewed = memory[np.arange(len(memory))]
    renewed[rows] = part
    return renewed


def checked_memory(memory: Memory, n: int, what: str = "state") -> Memory:
    """A memory of ``n`` worlds; raises ``InvalidInput``, with ``what`` it is, for an array of another number.

    Arrays of objects are refused, too: a copy of one still holds the same objects. So are keys that are no names:
    a snapshot writes them down with a dot between those of one array.
    """

    def check(array: Any) -> Any:
        shape = tuple(getattr(array, "shape", ()))
        if not shape or shape[0] != n:
            raise InvalidInput(
                f"{what}: {type(array).__name__} of shape {shape}; its first axis must be the {n} worlds"
            )
        if array.dtype.hasobject:
            raise InvalidInput(f"{what}: an array of objects; it must hold numbers, truths or texts")
        return array

    parts = [memory]
    for part in parts:
        if isinstance(part, Mapping):
            for key in part:
                if not (isinstance(key, str) and key.isidentifier()):
                    raise InvalidInput(f"{what}: key {key!r}; must be a name, for instance 'asked_s'")
            parts += part.values()
        elif isinstance(part, tuple | list):
            parts += part
    return map_memory(check, memory)


Arrays = dict[str, NDArray[Any]]


def _flat(memory: Memory) -> Arrays:
    """The arrays of a memory, by their place in it; an empty one stands for what is not remembered yet."""
    if isinstance(memory, Mapping | tuple):
        parts = memory.items() if isinstance(memory, Mapping) else enumerate(memory)
        return {f"{key}.{name}" if name else str(key): array for key, of in parts for name, array in _flat(of).items()}
    return {"": np.zeros(0) if memory is None else np.array(memory)}


def _unflat(arrays: Mapping[str, NDArray[Any]], place: str) -> Memory:
    """The memory whose arrays stand at a place, in its own arrays; numbers are places in a tuple."""
    if place in arrays:
        return np.array(arrays[place]) if arrays[place].shape != (0,) else None
    inner = dict.fromkeys(name[len(place) + 1 :].partition(".")[0] for name in arrays if name.startswith(f"{place}."))
    if not inner:
        raise InvalidInput(f"engine snapshot: {place} is nothing; the memory of that vehicle's script is needed")
    parts = {name: _unflat(arrays, f"{place}.{name}") for name in inner}
    return tuple(parts[str(k)] for k in range(len(parts))) if "0" in parts else parts


def _check_kept(before: Memory, after: Memory, who: str) -> None:
    """Raise ``InvalidInput`` for a memory of another form than it began with: rows that begin anew would not fit."""
    began, told = (map_memory(lambda array: (array.dtype, *array.shape[1:]), each) for each in (before, after))
    if began != told:
        raise InvalidInput(
            f"{who}: act gave a memory of another form ({told}) than it was given ({began}); keys, shapes and dtypes"
            " are those of begin"
        )


def is_state_free(script: Script) -> bool:
    """Whether the script's command never changes during an episode."""
    return bool(getattr(script, "state_free", False))


def is_ours(script: Script) -> bool:
    """Whether this package made the script; any other gets worlds that it cannot write to, as they are everybody's."""
    return type(script).__module__.startswith("ethbrake_marl.")


def begin_script(script: Script, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
    """What a script remembers once episodes start in these worlds; None of one that remembers nothing.

    Raises ``InvalidInput`` naming it for whatever a script that is not ours raises, and for a memory that is none.
    """
    begin = getattr(script, "begin", None)
    if begin is None:
        return None
    try:
        if is_ours(script):
            return begin(alert, vehicle, scripts)
        if len(inspect.signature(script.act).parameters) == 2:
            raise InvalidInput(f"{_who(script, vehicle)}: has begin, and act without a memory; {_SHAPES}")
        with _as_it_was(script, vehicle):
            return checked_memory(
                begin(alert.read_only(), vehicle, scripts), alert.n, f"{_who(script, vehicle)}: memory"
            )
    except Exception as error:
        raise _named(error, script, "begin", alert, vehicle) from error


def ask_script(script: Script, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
    """The command of a script, [n] m/s2, and what it remembers then.

    Raises ``AgentFailed`` naming it, world, moment and shape for a command of another shape, or of no numbers, and
    ``InvalidInput`` naming it for whatever a script that is not ours raises, or where it keeps something in itself.
    """
    remembers = hasattr(script, "begin")
    try:
        if is_ours(script):
            answer = script.act(worlds, memory, vehicle) if remembers else script.act(worlds, vehicle)
        else:
            own = (take_memory(memory, np.arange(worlds.n)),) if remembers else ()
            with _as_it_was(script, vehicle):
                answer = script.act(worlds.read_only(), *own, vehicle)
            if remembers:
                if not (isinstance(answer, tuple) and len(answer) == 2):
                    raise InvalidInput(f"{_who(script, vehicle)}: act gave {type(answer).__name__}; {_SHAPES}")
                who = f"{_who(script, vehicle)}: memory"
                _check_kept(memory, checked_memory(answer[1], worlds.n, who), who)
    except Exception as error:
        raise _named(error, script, "act", worlds, vehicle) from error
    command, memory = answer if remembers else (answer, None)
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
    return command, memory


@contextmanager
def _as_it_was(script: Script, vehicle: int) -> Iterator[None]:
    """Refuse, with ``InvalidInput``, a script that changes its own attributes: they would be those of all episodes."""
    before = dict(getattr(script, "__dict__", {}))
    yield
    for name in {**before, **getattr(script, "__dict__", {})}:
        is_cached = name not in before and isinstance(getattr(type(script), name, None), cached_property)
        if not is_cached and (name not in before or getattr(script, name, None) is not before[name]):
            raise InvalidInput(f"{_who(script, vehicle)}: keeps something in its attribute {name!r}; {_SHAPES}")


def _who(script: Script, vehicle: int) -> str:
    return f"agent {getattr(script, 'name', type(script).__name__)!r} of vehicle_{vehicle + 1}"


def _named(error: Exception, script: Script, what: str, worlds: Worlds, vehicle: int) -> Exception:
    """The error to raise for what a script raised: its own, where it speaks for itself."""
    if isinstance(error, EthBrakeError) or is_ours(script):
        return error
    who = _who(script, vehicle)
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


# The stream of episodes: worlds at the alert, made ready for their first decision.


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


class FailedWorld(UserWarning):
    """A running episode was cut off: its world could not be advanced. (The rest of the batch goes on.)"""


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
        new = FLAG.failure(np.where(status == 0, FLAG.DONE, status), from_s, until_s).worlds
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
        self._pieces = {i: getattr(script, "braking_pieces", ()) for i, script in scripts.items()}
        self.known = {i: script for i, script in scripts.items() if i not in self._deciders}  # to who looks ahead
        self.restart(seed)

    def restart(self, seed: int, position: int = 0) -> None:
        """Go to a world of ``seed``, the first one where no other is named."""
        self.seed, self._drawn = seed, position
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
        """Draw and prepare more worlds behind those that are left.

        One that cannot be advanced to its first decision gives its place to the next one that can; a ``FailedWorld``
        warning names it. So worlds keep their places in the stream, and a training goes on.
        """
        first, size = self.position, max(4 * count, _SAMPLED_AT_ONCE)
        alert = self._scenario.sample(size, self.seed, first=self._drawn, channel="training").worlds
        if self._pool is not None:
            alert = Worlds.concatenate([self._pool.part(self._next, self._drawn - first).alert, alert])
        start, kept, failed = leaving_out_failed(lambda rows: self.prepare(alert.take(rows)), np.arange(alert.n))
        if start is None:
            raise PhysicsError(failed)
        for row, reason in failed.items():
            warnings.warn(FailedWorld(f"world {first + row} of seed {self.seed}: {reason}; left out"), stacklevel=2)
        if failed:
            later = np.searchsorted(kept, np.arange(alert.n)) % len(kept)
            start = self.prepare(alert.take(kept[later]))
        self._pool, self._next = start, 0
        self._drawn += size

    def prepare(self, alert: Worlds) -> Start:
        """Worlds at t = 0, made ready for their first decision. Raises ``InvalidInput`` if nobody may ever decide."""
        alert = alert.play_pieces(self._pieces)
        clock = np.zeros((alert.n, CLOCK_WIDTH))
        clock[:, START] = alert.first_decision_s(self._deciders)
        step, horizon = self._scenario.time_step_s, self._scenario.horizon_s
        if not (clock[:, START] < horizon).all():
            late = float(clock[:, START].max())
            raise InvalidInput(f"reset: nobody decides before the horizon ({late:g} s >= {horizon:g} s)")
        clock[:, LAST_STEP] = Decisions(clock[:, START], step).before(horizon)
        wanted = np.zeros(alert.speeds_mps.shape)
        for vehicle, script in self._state_free.items():
            memory = begin_script(script, alert, vehicle, self.known)
            command, _ = ask_script(script, alert, memory, vehicle)
            wanted[:, vehicle] = within_capacity(command, alert, vehicle, script)
        return Start(alert, 0, moved(alert, wanted, clock[:, START]), clock, wanted)


def check_alert(worlds: Worlds, n: int, vehicles: int) -> None:
    """Refuse worlds, with ``InvalidInput``, that are not ``n`` lines of ``vehicles`` at the alert: t = 0, no impact."""
    if (worlds.n, worlds.N) != (n, vehicles):
        raise InvalidInput(
            f"reset: {count_of(worlds.n, 'world')} of {worlds.N} vehicles are given; {n} of {vehicles} vehicles needed"
        )
    at_alert = (worlds.time_s == 0.0) & ~worlds.pair_hit.any(axis=1) & ~worlds.obstacle_hit
    if not at_alert.all():
        k = int(np.argmin(at_alert))
        what = "after an impact" if worlds.time_s[k] == 0.0 else f"at {worlds.time_s[k]:g} s"
        raise InvalidInput(f"reset: world {k} is {what}; episodes start at the alert, t = 0, without any impact")


def moved(alert: Worlds, wanted: Floats, start_s: Floats) -> Packed:
    """Worlds at t = 0 moved to their first decision, harm on the way included."""
    after, impacts = advance(alert, wanted, until_s=start_s)
    return packed_with(after, impacts)


def packed_with(worlds: Worlds, harm: Impacts | Ledger) -> Packed:
    """Worlds, and the harm so far, as rows."""
    packed = Packed.of(worlds)
    column, pairs = packed.column, worlds.N - 1
    for group, values in enumerate((harm.first_impact_harm, harm.total_harm, harm.count)):
        packed.state[:, column.harm + group * pairs : column.harm + (group + 1) * pairs] = values
    if packed.has_obstacle:
        obstacle = (harm.obstacle_first_harm, harm.obstacle_total_harm, harm.obstacle_count)
        packed.state[:, column.obstacle + 2 :] = np.column_stack(obstacle)
    return packed


_NO_ROWS = np.empty((0, LISTED.WIDTH))  # no list of impacts is kept

RUNNING = ("_state", "_params", "_clock", "_wanted", "_potential")  # arrays of an engine that every step changes


# Terms of the reward that the compiled step does not know: they need the motion, the future or an objective.


class Terms:
    """The reward of a batch, resolved: what is added to every step beside the terms that all vehicles share.

    Args:
        reward: a name, a mapping of settings, or ``RewardParams``.
        scenario: whose objective holds where the reward names none.
        learners: indices of the vehicles (0 = front) that learn.

    """

    def __init__(self, reward: Reward, scenario: Scenario, learners: Sequence[int]) -> None:
        self.params, self._objectives = reward_params(reward).settled(scenario.objective, scenario.vehicles)
        self._learners, self._learner_index = tuple(learners), np.array(learners, np.int64)
        self._moving, self._own = self.params.moving, self.params.registered
        self.by_objective = bool(self._objectives)  # each vehicle's harm by an objective
        self.are_foreign = bool(self._own)  # one is code that somebody registered, and so may fail
        self.add_something = bool(self._moving or self._own) or self.params.shaping > 0.0 or self.by_objective

    @property
    def shared_harm(self) -> float:
        """Weight of the harm of the whole line, which the compiled step counts: 0 where each has its objective."""
        return 0.0 if self._objectives else self.params.harm

    def objective_harm(self, running: Engine) -> Floats:
        """What the objective of each vehicle makes of the harm so far, [n, N]; only where there are objectives."""
        return objective_harm(running.ledger, self.params.harm_count, self._objectives)

    def add(self, step: Step, running: Engine, before: Floats | None) -> None:
        """Add what a step has brought to its reward; nothing for rows that stood still.

        ``before``: ``objective_harm`` before the step, None without objectives.
        """
        if before is not None and self.params.harm > 0.0:
            step.further["harm"] = before - self.objective_harm(running)
        standing = running.ended & ~step.ended
        if self._moving or self._own:
            (state, params), column = running.packed, running.packed.column
            outcome = StepOutcome(
                step.first_impact_harm,
                step.total_harm,
                step.safe_end,
                state[:, column.gap : column.hit],
                state[:, column.speed : column.command],
                state[:, column.command : column.previous],
                state[:, column.previous : column.gap],
                running.scenario.time_step_s,
                state[:, column.time],
                params[:, column.braking : column.driving],
                params[:, column.driving : column.latency],
                params[:, column.latency : column.mass],
                params[:, column.mass : column.limit],
                self._learner_index.view(),
            )
            step.further.update(outcome.built_in(self._moving, self.params))
            if self._own:
                counts = ~standing & (step.failed == 0)
                step.further.update(outcome.registered(self._own, counts, running.steps))
        if self.params.shaping > 0.0:  # potentials are 0 where an episode terminated
            old = running._potential
            running._potential = self.potentials(running.worlds, running.scenario)
            running._potential[step.terminated] = 0.0
            step.further["shaping"] = self.params.shaping_discount * running._potential - old
        extra = self.params.weighted_sum(step.further, step.reward.shape)
        extra[standing] = 0.0
        step.reward[:] += extra

    def potentials(self, worlds: Worlds, scenario: Scenario) -> Floats:
        """Potential of every learner, 0 for other vehicles, [n, N]."""
        potentials = np.zeros(worlds.speeds_mps.shape)
        shared = self.params.potential(worlds, self._learners, scenario.horizon_s)
        potentials[:, self._learner_index] = shared[:, np.newaxis]
        return potentials


ROUNDING = 1e-9  # of a time step: moments that are so close are one
Actions = Mapping[int, NDArray[np.floating]] | NDArray[np.floating]


class Way(NamedTuple):
    """What a step brought before the last stop on its way, where a script on a grid of its own decided."""

    reward: Floats  # [n, N] of what all vehicles share
    harm: Floats  # [2, n] of the line, by both counts
    stopped: Bools  # [n]
    failed: Ints  # [n] status of the kernel where the world could not be moved, else 0
    in_force: Floats  # [n, N] commands when the step began


class Watcher(Protocol):
    """Looks on while an engine's episodes run, as the trace of a picture does; it changes nothing.

    What it remembers is kept by the engine beside the worlds (``Engine.memory``): both change in one piece, or, where
    anything fails or is interrupted, neither does. A memory is therefore never changed in place.
    """

    def begun(self, memory: Any, alert: Worlds, rows: Ints) -> Any:
        """The memory once episodes start in these rows; ``alert`` holds those worlds only, at t = 0."""

    def stepped(self, memory: Any, before: Engine, after: Engine) -> Any:
        """The memory once the engine, as it was ``before`` this step, is as ``after``."""


class Ruling(NamedTuple):
    """What a guard lets happen in one step, of n worlds and L learners."""

    proposed: Floats  # [n, L] actions; NaN: none, or no number
    applied: Floats  # [n, L] actions
    stepped_in: Bools  # [n] something else is applied than what was proposed
    asked: Bools  # [n] worlds that it is about
    decision: Any  # what else there is to tell of it
    memory: Any  # the guard's once the step is made


class Guard(Protocol):
    """Stands between what is proposed to an engine and what is applied: a shield.

    It is asked inside ``Engine.step``, so nothing that reaches the engine passes it by. What it remembers is kept by
    the engine: worlds, memory and ruling change in one piece, or, where anything fails or is interrupted, none does. A
    memory is therefore never changed in place.
    """

    def begin(self, memory: Any, alert: Worlds, rows: Ints) -> Any:
        """The memory once episodes start in these rows, None before; ``alert`` holds those worlds only, at t = 0."""

    def decide(self, running: Engine, memory: Any, proposed: Floats) -> Ruling:
        """What is applied instead of the actions [n, L]. A column of NaN: nothing was proposed for that learner."""

    def check(self, ruling: Ruling, after: Engine) -> Any:
        """The memory now that the step led to ``after``. Raises ``UncertifiedStep``: then it was not made."""

    def report(self, running: Engine) -> dict[str, NDArray[Any]]:
        """What infos say of each vehicle, by name, each [n, N]: of its last step, or of the alert before the first."""


class Moment(NamedTuple):
    """Running worlds between two steps, row by row."""

    state: Floats  # as rows of ``physics.batch``
    params: Floats
    clock: Floats
    wanted: Floats
    memories: dict[int, Memory]  # by vehicle, of the scripts that remember
    guarded: Any = None  # what the engine's guard remembers; None without one

    def take(self, rows: Ints) -> Moment:
        """Some of the rows, or one of them several times."""
        guarded = None if self.guarded is None else self.guarded.take(rows)
        state, params, clock, wanted, memories = take_memory(self[:5], rows)
        return Moment(state, params, clock, wanted, memories, guarded)

    @staticmethod
    def join(moments: list[Moment]) -> Moment:
        """The rows of all of them, one after the other; all are of one engine without a guard."""
        if moments[0].guarded is not None:
            raise InvalidInput("moments: a shield stands in their engine; what it remembers is not joined")
        return Moment(*map_memory(lambda *parts: np.concatenate(parts), *(moment[:5] for moment in moments)))


class Engine:
    """A batch of ``n`` running episodes of one scenario.

    Steps start when the first of the ``deciders`` may act; with none, at t = 0. A ``guard`` (a shield) may stand
    between what is proposed and what is applied. A world that the physics cannot advance takes no other with it: its
    episode is cut off (truncated), and the ``roster`` names it.

    Args:
        scenario: of every episode.
        n: worlds that are advanced together, at least 1.
        learners: indices of the vehicles (0 = front) that need an action in every step.
        scripts: vehicle index -> what drives it, for every vehicle that does not learn.
        reward: a name, a mapping of settings, or ``RewardParams``.
        observation: what vehicles observe, or by name what each does; None: as the scenario says.
        seed: of the scenario's training stream, from which worlds come unless they are given.
        deciders: indices of the vehicles that set the grid of decisions; None: the learners. An evaluated agent drives
            its vehicle as a script, on a learner's grid.
        worlds: of the first episodes, at t = 0; None: from the stream.
        guard: makes what stands between proposed and applied actions; None: what is proposed is applied.

    >>> import ethbrake_marl as eb
    >>> engine = eb.make_engine("paper-random", 4, seed=7)
    >>> engine.n, engine.learners, engine.worlds.time_s
    (4, (1,), array([0.5, 0.5, 0.5, 0.5]))

    """

    roster: Roster  # who runs in which row, and which worlds failed
    _state: Floats  # of the running episodes, as rows of ``physics.batch``
    _params: Floats
    _clock: Floats  # [n, CLOCK_WIDTH]
    _wanted: Floats  # [n, N] m/s2
    _potential: Floats  # [n, N]
    _obstacle: bool  # the rows have columns of an obstacle
    _by_link: bool  # ... of news by link
    _builds_up: bool  # brakes of some world may build up, or come in pieces
    _pieces: Floats  # [N, 2 K] of all worlds, as in ``Vehicles``
    _plans: tuple[Plan, ...]  # of what each vehicle observes
    _alike: bool  # all observe the same features

    def __init__(
        self,
        scenario: Scenario,
        n: int,
        *,
        learners: Sequence[int],
        scripts: Mapping[int, Script],
        reward: Reward = "harm",
        observation: Observation | None = None,
        seed: int = 0,
        deciders: Sequence[int] | None = None,
        worlds: Worlds | None = None,
        guard: Callable[[Engine], Guard] | None = None,
    ) -> None:
        if not n >= 1:
            raise InvalidInput(f"engine: n = {n} worlds; at least 1 is needed")
        self.scenario, self.n = scenario, n
        self.learners = tuple(learners)
        self.scripts = dict(scripts)
        unassigned = set(range(scenario.vehicles)) - set(self.learners) - set(self.scripts)
        if unassigned or set(self.learners) & set(self.scripts):
            raise InvalidInput(
                f"engine: learners {self.learners} and scripts {tuple(self.scripts)} must name each of the"
                f" {scenario.vehicles} vehicles exactly once"
            )
        self.deciders = self.learners if deciders is None else tuple(deciders)
        if not set(self.deciders) <= set(range(scenario.vehicles)):
            raise InvalidInput(f"engine: deciders {self.deciders} must be from 0 to {scenario.vehicles - 1}")
        self._terms = Terms(reward, scenario, self.learners)
        self.reward = self._terms.params
        self.observations = observations_of(scenario, observation)  # of each vehicle
        self._plans = tuple(each.plan for each in self.observations)
        self._alike = len(set(self.observations)) == 1
        self._watched: dict[Watcher, Any] = {}
        self.memories: dict[int, Memory] = {}  # by vehicle, of the scripts that remember; never changed in place
        self._remembering = {i: s for i, s in self.scripts.items() if not is_state_free(s)}
        self._on_own_grid = {i: s for i, s in self._remembering.items() if i not in self.deciders}
        self._stops: list[tuple[Floats, Floats]] = []  # of the last step: the states there, and what led to them
        self._learner_index = np.array(self.learners, np.int64)
        total = float(self.reward.harm_count == "total")
        times = scenario.time_step_s, scenario.horizon_s
        self._settings = np.array([*times, self._terms.shared_harm, total, self.reward.terminal])
        self.reward_terms = self.reward.counted  # names of those whose values each step tells
        self.check_time_step(self.scripts)
        self._stream = Stream(scenario, self.deciders, self.scripts, seed)
        self.protect(None if guard is None else guard(self))
        self.reset(worlds=worlds)

    def check_time_step(self, drivers: Mapping[int, Script]) -> None:
        """Raise ``InvalidInput`` for one that was made for decisions at another distance in time (``time_step_s``)."""
        for script in drivers.values():
            step, here = getattr(script, "time_step_s", None), self.scenario.time_step_s
            if step not in (None, here):
                raise InvalidInput(
                    f"agent {getattr(script, 'name', type(script).__name__)!r} was made for decisions every {step:g} s;"
                    f" scenario {self.scenario.name!r} has one every {here:g} s: make_agent(..., scenario=...) knows"
                )

    @property
    def observation(self) -> ObservationSpec:
        """What all learners observe; raises ``InvalidInput`` where they observe different features."""
        return common_observation(self.observations, self.scenario)

    @property
    def seed(self) -> int:
        """Seed of the training stream."""
        return self._stream.seed

    @property
    def packed(self) -> Packed:
        """The running worlds themselves, as rows of ``physics.batch``: for kernels to read, not to be changed."""
        return Packed(self._state, self._params)

    @property
    def wanted_mps2(self) -> Floats:
        """What each vehicle wanted in the last step, [n, N]: for kernels to read, not to be changed."""
        return self._wanted

    @property
    def worlds(self) -> Worlds:
        """The worlds as they are now, in their own memory."""
        return self._unpacked(self.packed)

    @property
    def in_pieces(self) -> bool:
        """Whether some script brakes in pieces."""
        return bool(self._pieces.shape[1] > 0)

    def _unpacked(self, packed: Packed) -> Worlds:
        worlds = packed.worlds()
        if not self.in_pieces:
            return worlds
        pieces = np.repeat(self._pieces[np.newaxis], worlds.n, axis=0)
        return replace(worlds, vehicles=replace(worlds.vehicles, pieces=pieces))

    @property
    def ledger(self) -> Ledger:
        """Harm of the running episodes so far, in its own memory."""
        packed, column = self.packed, self.packed.column
        of_worlds = packed.params[:, column.mass : column.limit], packed.params[:, column.restitution]
        return Ledger(*packed.ledger(), *(each.copy() for each in of_worlds))

    @property
    def ended(self) -> Bools:
        """Episodes that have ended, [n]."""
        return np.asarray(self._clock[:, ENDED] == 1.0, np.bool_)

    @property
    def steps(self) -> Ints:
        """Steps that the running episodes have taken, [n]."""
        return self._clock[:, STEP].astype(np.int64)

    def observe(self, vehicle: int) -> Observations:
        """Current observation of one vehicle, [n, F]."""
        if not isinstance(vehicle, int | np.integer) or not 0 <= vehicle < self.scenario.vehicles:
            raise InvalidInput(f"observe: vehicle index {vehicle!r}; must be in 0..{self.scenario.vehicles - 1}")
        return self.observe_all(np.array([vehicle]))[:, 0]

    def observe_all(self, vehicles: Ints | None = None, rows: Ints | None = None) -> Observations:
        """Current observations of several vehicles, of all learners if none are given, [n, len(vehicles), F].

        Only of the worlds ``rows`` if given. Raises ``InvalidInput`` where these vehicles observe different features.
        """
        vehicles = self._learner_index if vehicles is None else vehicles
        if not self._alike and len({self.observations[i] for i in vehicles.tolist()}) > 1:
            names = ", ".join(self.scenario.vehicle_names[i] for i in vehicles.tolist())
            raise InvalidInput(f"observe_all: {names} observe different features; use observe for each")
        state, params = self._state, self._params
        plan: Plan = self._plans[0 if self._alike else int(vehicles[0])]
        if rows is not None:
            state, params = state.take(rows, axis=0), params.take(rows, axis=0)
        if not plan.extras:
            return plan.observe(state, params, vehicles)
        steps = self._clock[:, STEP] if rows is None else self._clock[rows, STEP]
        return plan.observe(state, params, vehicles, steps)

    def _kept(self, packed: Packed) -> Packed:
        """Rows as wide as they are kept: with columns of an obstacle, and of news by link, if the first had such."""
        return packed.widened(self._obstacle, self._by_link)

    def memory(self, watcher: Watcher) -> Any:
        """What a watcher remembers of the running episodes."""
        return self._watched[watcher]

    def watch(self, watcher: Watcher, memory: Any) -> None:
        """Let a watcher follow, from ``memory`` on."""
        self._watched = {**self._watched, watcher: memory}

    def protect(self, guard: Guard | None) -> None:
        """Let a guard stand between what is proposed and what is applied, from the next reset on; None: nobody does."""
        self.guard, self.guarded, self.ruling = guard, None, None

    def reset(self, *, seed: int | None = None, worlds: Worlds | None = None) -> None:
        """Start new episodes in all rows: the given worlds (at t = 0), or the next ones of the training stream.

        With ``seed`` the stream starts again from its beginning. Whatever fails, the running episodes go on.
        """
        if worlds is not None:
            check_alert(worlds, self.n, self.scenario.vehicles)
        stream = copy.copy(self._stream)
        if seed is not None:
            stream.restart(seed)
        first = None if worlds is not None else stream.position
        start = stream.take(self.n) if worlds is None else stream.prepare(worlds)
        new = copy.copy(self)
        new._stream, new.roster = stream, Roster(self.n, stream.seed, first, worlds)
        new._obstacle = self.scenario.has_obstacle or start.packed.has_obstacle
        new._by_link = self.scenario.by_link or start.packed.has_news
        new._pieces = start.origin.vehicles.pieces[0].copy()
        new._builds_up = new._may_build_up(start.packed)
        new._state, new._params = (array.copy() for array in new._kept(start.packed))
        new._clock, new._wanted = start.clock.copy(), start.wanted.copy()
        new._potential = np.zeros(start.wanted.shape)
        new._stops, new.ruling, new.memories = [], None, {}
        new._begin(np.arange(self.n), start)
        self.__dict__.update(new.__dict__)  # in one piece: not even an interrupt comes between

    def _may_build_up(self, packed: Packed) -> bool:
        return self.scenario.builds_up or packed.builds_up or self.in_pieces

    def renew(self, rows: Ints) -> None:
        """Start new episodes of the training stream in these rows (autoreset). Whatever fails, nothing is changed."""
        if len(rows) == 0:
            return
        if not 0 <= np.min(rows) <= np.max(rows) < self.n or np.bincount(rows).max() > 1:
            raise InvalidInput(f"renew: rows {rows}; must be different numbers from 0 to {self.n - 1}")
        if not (self._watched or self._remembering or self.guard):
            self._renew(rows)
            return
        new = self._apart()
        new._stream = copy.copy(self._stream)
        new._renew(rows)
        self.__dict__.update(new.__dict__)

    def cut(self, step: Step, most_steps: int) -> None:
        """Truncate the episodes that have taken ``most_steps`` with the last ``step``, here and in what that tells."""
        cut = (self.steps >= most_steps) & (step.ended | ~self.ended)
        step.outcome[TRUNCATED, cut] = self._clock[cut, ENDED] = 1.0

    def _apart(self) -> Engine:
        """An engine that goes on from here without changing this one."""
        new = copy.copy(self)
        new.__dict__.update({name: getattr(new, name).copy() for name in RUNNING})
        new.roster = new.roster.apart()
        return new

    def _renew(self, rows: Ints) -> None:
        position = self._stream.position
        start = self._stream.take(len(rows))
        self.roster.renew(rows, position)
        self._state[rows], self._params[rows] = self._kept(start.packed)
        self._clock[rows], self._wanted[rows] = start.clock, start.wanted
        self._begin(rows, start)

    def step(self, actions: Actions) -> Step:
        """Advance every running episode by one time step.

        ``actions``: for each learner (by vehicle index, or as columns [n, L] in the order of ``learners``) a number in
        [-1, 1] per world; by index a guarded one may be left out. Rows whose episode has ended stay as they are until
        ``renew`` or ``reset``. What the guard refuses does not happen: the worlds stay as they are.
        """
        columns = self._columns(actions)
        if not (self.guard or self._watched or self._terms.are_foreign or self._on_own_grid):  # nobody can refuse it
            return self._advance(columns)
        before = copy.copy(self)  # of one moment, whatever another thread does meanwhile
        new = before._apart()
        if self.guard is not None:
            if before.guarded is None:
                raise UncertifiedStep("shield: this episode began before the shield was put around it; reset first")
            proposed = columns if isinstance(actions, Mapping) else self._in_range(columns)  # those of one are checked
            ruling = self.guard.decide(before, before.guarded, proposed)
            columns = np.ascontiguousarray(ruling.applied)
        step = new._advance(columns)
        if self.guard is not None:
            new.ruling, new.guarded = ruling, self.guard.check(ruling, new)
        new._watched = {w: w.stepped(memory, before, new) for w, memory in self._watched.items()}
        self.__dict__.update(new.__dict__)  # in one piece: not even an interrupt comes between
        return step

    def _advance(self, columns: Floats) -> Step:
        """Advance every running episode by one time step, in place."""
        asked: dict[int, Memory] = {}
        if len(self._remembering) > len(self._on_own_grid):
            worlds = self.worlds
            for vehicle in self._remembering.keys() - self._on_own_grid.keys():
                script = self._remembering[vehicle]
                command, asked[vehicle] = ask_script(script, worlds, self.memories[vehicle], vehicle)
                self._wanted[:, vehicle] = within_capacity(command, worlds, vehicle, script)
        before = self._terms.objective_harm(self) if self._terms.by_objective else None
        self._stops = []
        way = self._start_on_own_grid(columns) if self._on_own_grid else None
        was = self._state.copy() if self.packed.has_messages else None
        reward, outcome = np.empty(self._wanted.shape), np.empty((OUTCOME_ROWS, self.n))
        status = self._step_worlds(columns, reward, outcome)
        if status == BAD_ACTION:  # nothing was moved
            status = self._step_worlds(self._in_range(columns), reward, outcome)
        self.memories = self.memories | asked
        if was is not None:
            until_s = self._state[:, self.packed.column.time]
            hear_rows(was, self._params, self._wanted, until_s, until_s, self.scenario.time_step_s, self._pieces)
        if way is not None:
            status = self._add_way(way, reward, outcome, status)
        step = Step(reward, outcome, self.reward, {})
        if status != FLAG.DONE:
            times = self._state[:, 0]
            self.roster.mark(step.failed, times, np.minimum(times + self.scenario.time_step_s, self.scenario.horizon_s))
        if self._terms.add_something:
            self._terms.add(step, self, before)
        return step

    def _columns(self, actions: Actions) -> Floats:
        """The learners' actions as [n, L]; their range is checked where they are used."""
        shape = (self.n, len(self.learners))
        if type(actions) is np.ndarray and actions.shape == shape and actions.dtype.kind in "fiu":
            return np.ascontiguousarray(actions, np.float64)
        if not isinstance(actions, Mapping):
            return checked_action(actions, shape, "the learners")
        for vehicle in actions:
            if vehicle not in self.learners:
                raise InvalidInput(
                    f"step: an action for vehicle index {vehicle!r}; the learners have the indices {self.learners}"
                )
        columns = np.empty(shape)
        for c, vehicle in enumerate(self.learners):
            if vehicle not in actions and self.guard is not None:
                columns[:, c] = np.nan
                continue
            if vehicle not in actions:
                raise InvalidInput(f"step: no action for the learner vehicle_{vehicle + 1}")
            columns[:, c] = checked_action(actions[vehicle], (self.n,), f"vehicle_{vehicle + 1}")
        return columns

    def _step_worlds(self, columns: Floats, reward: Floats, outcome: Floats) -> int:
        _, status = step_worlds(
            self._state, self._params, self._clock, columns, self._learner_index, self._settings, _NO_ROWS,
            self._builds_up, self._pieces, self._wanted, reward, outcome,
        )  # fmt: skip
        return status

    def _in_range(self, columns: Floats) -> Floats:
        """The actions [n, L] without the last rounding of a float32; ``InvalidInput`` for one out of range."""
        each = [checked_action(columns[:, c], (self.n,), f"vehicle_{i + 1}") for c, i in enumerate(self.learners)]
        return np.stack(each, axis=1) if each else columns

    def _begin(self, rows: Ints, start: Start) -> None:
        """Tell those who must know that episodes start in ``rows``, and move what depends on them."""
        if self.guard or self._watched or self._remembering:
            alert = start.alert
            with renumbered(rows):
                if self.guard is not None:
                    self.guarded = self.guard.begin(self.guarded, alert, rows)
                self._watched = {w: w.begun(memory, alert, rows) for w, memory in self._watched.items()}
                begun = {i: begin_script(s, alert, i, self._stream.known) for i, s in self._remembering.items()}
            self.memories = renew_memory(self.memories, rows, begun) if self.memories else begun
        if self._on_own_grid:
            self._begin_on_own_grid(rows, start.alert, start.clock[:, START])
        elif self.packed.has_messages:
            moving, params, start_s = (
                self._kept(Packed.of(start.alert)).state,
                self._params[rows],
                self._state[rows, self.packed.column.time],
            )
            hear_rows(moving, params, self._wanted[rows], start_s, start_s, self.scenario.time_step_s, self._pieces)
            self._params[rows] = params
        if self.reward.shaping > 0.0:
            worlds = self._unpacked(Packed(self._state[rows], self._params[rows]))
            self._potential[rows] = self._terms.potentials(worlds, self.scenario)

    def _start_on_own_grid(self, columns: Floats) -> Way:
        """Let the scripts on their own grids decide within the step that begins; what comes of the way there."""
        column = self.packed.column
        in_force = self._state[:, column.command : column.previous].copy()
        steps, last, start_s = (self._clock[:, at] for at in (STEP, LAST_STEP, START))
        until_s = Decisions(start_s, self.scenario.time_step_s).at(steps + 1.0)
        until_s = np.where(steps + 1.0 >= last, self.scenario.horizon_s, until_s)
        way = self._decide_on_the_way(~self.ended, until_s, self._in_range(columns))
        self._clock[way.failed != 0, ENDED] = 1.0
        return way._replace(in_force=in_force)

    def _add_way(self, way: Way, reward: Floats, outcome: Floats, status: int) -> int:
        """Add the way to the last stop to what came after it, in place; the status of both."""
        reward += way.reward
        outcome[: len(way.harm)] += way.harm
        column = self.packed.column
        self._state[way.stopped, column.previous : column.gap] = way.in_force[way.stopped]
        lost = way.failed != 0
        outcome[TRUNCATED, lost], outcome[FAILED, lost] = 1.0, way.failed[lost]
        return int(way.failed[lost][0]) if lost.any() else status

    def _decide_on_the_way(self, running: Bools, until_s: Floats, columns: Floats) -> Way:
        """Let the scripts on their own grids make all decisions before ``until_s`` [n] in the ``running`` worlds.

        A world is moved to a decision only where that changes a command: the bits depend on where motion changes.
        """
        (n, N), column = self._wanted.shape, self.packed.column
        vehicles, step_s = list(self._on_own_grid), self.scenario.time_step_s
        first_s = self._params[:, column.latency : column.mass][:, vehicles].T
        made = np.maximum(Decisions(first_s, step_s).before(self._state[:, column.time]), 0.0)
        due = np.where(running, np.maximum(Decisions(first_s, step_s).before(until_s), 0.0), made)
        way = Way(np.zeros((n, N)), np.zeros((2, n)), np.zeros(n, np.bool_), np.zeros(n, np.int64), np.empty(0))
        while (made < due).any():
            next_s = np.where(made < due, first_s + made * step_s, np.inf)
            moment = next_s.min(axis=0)
            asked = next_s <= moment + ROUNDING * step_s
            asked &= made < due
            now = self._state[:, column.time]
            moment = np.where((moment < np.inf) & (moment > now + ROUNDING * step_s), moment, now)
            ahead, reward, outcome = self._look_ahead(moment, until_s, columns)
            worlds, wanted = self._unpacked(ahead), self._wanted.copy()
            for (vehicle, script), here in zip(self._on_own_grid.items(), asked, strict=True):
                if here.any():
                    before, idle = self.memories[vehicle], np.flatnonzero(~here)
                    command, after = ask_script(script, worlds, before, vehicle)
                    command = np.where(here, command, 0.0)
                    wanted[here, vehicle] = within_capacity(command, worlds, vehicle, script, here)[here]
                    self.memories = self.memories | {vehicle: renew_memory(after, idle, take_memory(before, idle))}
            changed = (wanted != self._wanted)[:, vehicles] & (made > 0.0).T  # a first one waits for the latency anyway
            stops = (moment > now) & changed.any(axis=1) & (outcome[FAILED] == 0.0)
            way.failed[:] = np.where(outcome[FAILED] != 0.0, outcome[FAILED], way.failed)
            if stops.any():
                self._stop(stops, ahead)
                way.reward[stops] += reward[stops]
                way.harm[:, stops] += outcome[: len(way.harm), stops]
                way.stopped[stops] = True
            self._wanted[:] = wanted
            made += asked
            made = np.where(way.failed != 0, due, made)
        return way

    def _look_ahead(self, until_s: Floats, decision_s: Floats, columns: Floats) -> tuple[Packed, Floats, Floats]:
        """The worlds at ``until_s`` [n], and reward [n, N] and outcome of the way there; ``decision_s``: the next one.

        Only the learners' commands in ``_wanted`` are changed, by ``columns`` [n, L]; none without any.
        """
        clock, settings = np.zeros(self._clock.shape), self._settings.copy()
        clock[:, START], clock[:, STEP], clock[:, LAST_STEP] = until_s, -1.0, np.inf  # a step from -1 to 0 ends there
        clock[:, ENDED] = ~(until_s > self._state[:, self.packed.column.time])
        settings[TERMINAL_WEIGHT] = 0.0
        reward, outcome = np.empty(self._wanted.shape), np.empty((OUTCOME_ROWS, self.n))
        state, params = self._state.copy(), self._params.copy()
        step_worlds(
            state, params, clock, columns, self._learner_index[: columns.shape[1]], settings, _NO_ROWS,
            self._builds_up, self._pieces, self._wanted, reward, outcome,
        )  # fmt: skip
        if self.packed.has_messages:
            time_s = state[:, self.packed.column.time]
            step_s = self.scenario.time_step_s
            hear_rows(self._state.copy(), params, self._wanted, time_s, decision_s, step_s, self._pieces)
        return Packed(state, params), reward, outcome

    def _stop(self, rows: Bools, ahead: Packed) -> None:
        """Move these rows to where the look ahead found them."""
        self._state[rows], self._params[rows] = ahead.state[rows], ahead.params[rows]
        self._stops.append((self._state.copy(), self._wanted.copy()))

    def _begin_on_own_grid(self, rows: Ints, alert: Worlds, start_s: Floats) -> None:
        """From the alert on scripts with a memory decide on their own grids; then the first decision is near.

        Deciders do not: like a learner they coast, and are seen to coast, until their first decision.
        """
        began = self._kept(Packed.of(alert)).state
        self._stops = [(state.copy(), wanted) for state, wanted in self._stops]  # of who goes on; the others did not
        for state in (self._state, *(state for state, _ in self._stops)):
            state[rows] = began
        time_s = self._state[:, self.packed.column.time]
        running, until_s, none = np.zeros(self.n, np.bool_), time_s.copy(), np.empty((self.n, 0))
        running[rows], until_s[rows] = True, start_s
        way = self._decide_on_the_way(running, until_s, none)
        ahead, _, outcome = self._look_ahead(until_s, until_s, none)
        failed = np.where(way.failed != 0, way.failed, outcome[FAILED].astype(np.int64))
        if failed.any():
            raise FLAG.failure(np.where(failed == 0, FLAG.DONE, failed), time_s, until_s)
        self._state[rows], self._params[rows] = ahead.state[rows], ahead.params[rows]

    def segments(self, before: Worlds, last_mps2: Floats) -> Iterator[tuple[Worlds, Floats, Floats]]:
        """The last step, made from ``before`` (after a reset: the alert), in parts within which nobody decides.

        Each is worlds, the commands [n, N] that they followed, ``last_mps2`` in the last part, and until when [n].
        """
        for state, wanted in self._stops:
            then = Packed(state, self._params).worlds(before.vehicles)
            yield before, wanted, then.time_s
            before = then
        yield before, last_mps2, self._state[:, self.packed.column.time].copy()

    def snapshot(self) -> Arrays:
        """Copies of everything that changes while it runs: its rows, its place in the stream, the scripts' memories.

        The stream is one number: worlds are pure functions of the seed and of where they stand in it.
        """
        arrays: Arrays = {name.lstrip("_"): getattr(self, name).copy() for name in RUNNING}
        arrays["stream"] = np.array([self.seed, self._stream.position], np.uint64)
        arrays["numbers"] = self.roster.numbers.copy()
        return arrays | {f"script.{name}": array for name, array in _flat(self.memories).items()}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Go on from the ``snapshot`` of an engine of the same scenario, size and scripts, as if nothing had happened.

        Raises ``InvalidInput``, before anything is changed, naming the array that is missing or has another shape, and
        where a shield stands in the engine, which would know nothing of these worlds.
        """
        if self.guard is not None:
            raise InvalidInput(
                "engine snapshot: a shield stands in this engine; restore first, then put the shield around"
            )
        wanted = {name.lstrip("_"): getattr(self, name).shape for name in RUNNING} | {"numbers": (self.n,)}
        for name, needed in wanted.items():
            have = arrays.get(name)
            if have is None or have.shape != needed:
                shape = "nothing" if have is None else have.shape
                raise InvalidInput(f"engine snapshot: {name} is {shape}; {needed} is needed")
        memories = {vehicle: checked_memory(_unflat(arrays, f"script.{vehicle}"), self.n) for vehicle in self.memories}
        for name in RUNNING:
            setattr(self, name, np.array(arrays[name.lstrip("_")], np.float64))
        self._builds_up = self._may_build_up(self.packed)
        seed, taken = (int(number) for number in arrays["stream"])
        self._stream.restart(seed, taken)
        self.roster = Roster(self.n, seed, None)
        self.roster.numbers = np.array(arrays["numbers"], np.int64)
        self.memories = memories

    def place(self, worlds: Worlds, ledger: Ledger | None = None, *, ended: Bools | None = None) -> None:
        """Put the running worlds in all rows as somebody else has moved them, with their ``ledger`` so far.

        Vehicles, memories and the grid of decisions stay those of the last reset: the next step goes to the next
        decision after the worlds' time. ``ended`` [n]: those that no step moves; None: those at the horizon. Raises
        ``InvalidInput`` for another number of worlds or vehicles.
        """
        if worlds.speeds_mps.shape != self._wanted.shape:
            n, N = self._wanted.shape
            raise InvalidInput(f"place: {worlds.n} worlds of {worlds.N} vehicles; {n} of {N} needed")
        state = self._kept(packed_with(worlds, empty_ledger(worlds) if ledger is None else ledger)).state
        made = Decisions(self._clock[:, START], self.scenario.time_step_s).latest(worlds.time_s)
        self._state, self._clock, self.ruling = state, self._clock.copy(), None
        self._clock[:, STEP] = np.maximum(made, 0)
        self._clock[:, ENDED] = worlds.time_s >= self.scenario.horizon_s if ended is None else ended

    def moment(self) -> Moment:
        """The present moment of all rows, in its own memory."""
        rows = [array.copy() for array in (self._state, self._params, self._clock, self._wanted)]
        return Moment(rows[0], rows[1], rows[2], rows[3], self.memories, self.guarded)

    def first_moments(self, count: int) -> tuple[Worlds, Moment]:
        """The first ``count`` worlds of the training stream, at the alert, and at their first decision."""
        stream = copy.copy(self._stream)
        stream.restart(self.seed)
        alert, new = stream.take(count).alert, self._unwatched(count)
        new.protect(None)
        new.reset(worlds=alert)
        return alert, new.moment()

    def branch(self, moment: Moment) -> Engine:
        """An engine of the same scenario whose rows go on from ``moment``, under the same guard; this one stays.

        Raises ``InvalidInput`` for an engine with a reward that is shaped, which tells of more than what happens.
        """
        if self.reward.shaping > 0.0:
            raise InvalidInput(f"branches: reward: shaping = {self.reward.shaping:g}: must be 0; a branch has an end")
        new = self._unwatched(len(moment.state))
        new.memories, new.guarded, new.ruling = moment.memories, moment.guarded, None
        new.roster = Roster(new.n, self.seed, None)
        new.roster.warns = False
        new._state, new._params, new._clock, new._wanted = (array.copy() for array in moment[:4])
        new._builds_up = new._may_build_up(new.packed)
        new._potential = np.zeros(moment.wanted.shape)
        return new

    def _unwatched(self, n: int) -> Engine:
        """An engine of the same scenario for ``n`` worlds, which nobody watches; its rows are still to be set."""
        new = copy.copy(self)
        new.n, new._watched = n, {}
        return new
