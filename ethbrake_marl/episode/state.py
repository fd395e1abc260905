"""The state of a batch of episodes, as an immutable value."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence, Set as AbstractSet
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import HONEST, AnyCount, HarmCount, all_counts, amount_so_far, pair_amounts
from ethbrake_marl.episode.departures import MARKS, SHOWN, departing_worlds
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.forces import capacities
from ethbrake_marl.motion.layout import (
    BRAKING,
    DRIVING,
    FAR_M,
    FORCE,
    GAP,
    HIT,
    IMPACTS,
    LATENCY,
    MASS,
    RESTITUTION,
    SPEED,
    Bools,
    Floats,
    Ints,
)

# columns of `clock`
TIME = 0  # time since the alert (s)
FIRST_DECISION = 1  # time of the first decision (s)
STEPS = 2  # number of steps taken
LAST = 3  # number of the last step, unless all vehicles come to rest before
ENDED = 4  # 1 once the episode has ended
NUMBER = 5  # number of the world in its list; -1: the caller has made it
END = 6  # time at which the last step ends (s): the horizon, or earlier after `StepSettings.most_steps`
HORIZON = 7  # the game's horizon (s), at which motion has a price
KEY = 8  # key of the world's random generators
ORIGIN = 9  # number of the table's row from which the world comes, from 1, the same for equal rows; 0: no table
FIRST_IN_LIST = -2  # NUMBER of world 0 of an evaluation list that a reset asked for; the next ones are -3, -4, ...
CLOCK_COLUMNS = 10


class State(NamedTuple):
    """State of n episodes with N vehicles each, one row per world. It is never changed; a step returns a new state.

    The arrays have a column for each body 0 to N (``motion.layout``). The properties, for agents and terms, have a
    column for each vehicle or pair: column i belongs to ``vehicle_{i + 1}``, or to the pair of ``vehicle_{i + 1}`` and
    the vehicle behind it. Properties may be views of the arrays: copy them before you change them.

    >>> import ethbrake_marl as eb
    >>> worlds = eb.load_scenario("paper-random").sample(2, seed=7)
    >>> worlds.n, worlds.vehicles, worlds.latency_s[0], worlds.take([1]).gaps_m.shape
    (2, 3, array([0. , 0.5, 0.8]), (1, 2))

    """

    line: Floats  # [n, LINE_ROWS, N + 1] speeds, forces, gaps, harm
    car: Floats  # [n, CAR_ROWS, N + 1] parameters
    clock: Floats  # [n, CLOCK_COLUMNS]
    know: Floats  # [n, N + 1, N + 1] time from which body i knows the state of body j (s); infinite: never
    wanted: Floats  # [n, N + 1] last commands (m/s2), negative brakes
    memories: Mapping[Any, Any]  # body -> memory of its script; a name -> memory of a shield or term

    def take(self, rows: Any) -> State:
        """State of the episodes in ``rows`` (indices, a mask or a slice)."""
        state: State = take(self, rows)
        return state

    def put(self, rows: Any, new: State, *, donate: bool = False) -> State:
        """State with the episodes ``new`` in place of those in ``rows``. ``donate``: its arrays may be overwritten."""
        state: State = put_rows(self, rows, new, donate)
        return state

    @staticmethod
    def join(parts: Sequence[State], merged: Callable[[Sequence[Any]], Any] = np.concatenate) -> State:
        """One state with the episodes of several states, whose memories have the same structure.

        ``merged`` turns a list of arrays, one per state, into one array; by default it concatenates them.
        """
        marks = [name for part in parts for name in part.memories.get(MARKS, ())]
        state: State = map_arrays(lambda *arrays: merged(arrays), *(mark(part, marks) for part in parts))
        return state

    def read_only(self) -> State:
        """The same state with read-only arrays; memories are the same objects."""
        line, car, clock, know, wanted = (array.view() for array in self[:5])
        for view in (line, car, clock, know, wanted):
            view.setflags(write=False)
        return State(line, car, clock, know, wanted, self.memories)

    def generators(self, body: int) -> list[np.random.Generator]:
        """Random generator of each world for what happens to vehicle ``body``, such as its reaction time, [n].

        It depends on seed and number of the world alone, so it is the same for every agent. Each call returns new
        generators, at their first number. Raises ``InvalidInput`` for a vehicle that the line lacks.
        """
        check_whole_number("body", body, 1, self.vehicles)
        keys = np.ascontiguousarray(self.clock[:, KEY]).view(np.uint64)
        return [np.random.Generator(np.random.Philox(key=[key, body])) for key in keys.tolist()]

    @property
    def n(self) -> int:
        return len(self.line)

    @property
    def vehicles(self) -> int:
        """Number N of vehicles."""
        return self.wanted.shape[1] - 1

    @property
    def time_s(self) -> Floats:
        """Time since the alert, [n] s."""
        return self.clock[:, TIME]

    @property
    def steps(self) -> Ints:
        """Number of steps taken, which is also the number of the next decision, [n]."""
        return self.clock[:, STEPS].astype(np.int64)

    @property
    def ended(self) -> Bools:
        """Whether the episode has ended, [n]."""
        return self.clock[:, ENDED] == 1.0

    @property
    def at_rest(self) -> Bools:
        """Whether every vehicle is at rest and no command or force would move it, [n]."""
        moves = (self.line[:, SPEED] != 0.0) | (self.wanted > 0.0) | (self.line[:, FORCE] > 0.0)
        return ~moves[:, 1:].any(axis=1)

    @property
    def moving(self) -> Bools:
        """Whether at least one vehicle moves, [n]."""
        return np.asarray((self.line[:, SPEED, 1:] != 0.0).any(axis=1))

    @property
    def speeds_mps(self) -> Floats:
        """Speeds, [n, N] m/s."""
        return self.line[:, SPEED, 1:]

    @property
    def gaps_m(self) -> Floats:
        """Gaps between neighbours, bumper to bumper, [n, N - 1] m."""
        return self.line[:, GAP, 1:-1]

    @property
    def obstacle_gap_m(self) -> Floats:
        """Gap between the obstacle and Vehicle 1, [n] m; infinite if there is no obstacle."""
        gap = self.line[:, GAP, 0]
        return np.where(gap < FAR_M, gap, np.inf)

    @property
    def forces_mps2(self) -> Floats:
        """Present acceleration by brakes or engine alone, [n, N] m/s2."""
        return self.line[:, FORCE, 1:]

    @property
    def commands_mps2(self) -> Floats:
        """Last commands, [n, N] m/s2. A command takes effect after the vehicle's latency."""
        return self.wanted[:, 1:]

    @property
    def pair_hit(self) -> Bools:
        """Whether the pair of neighbouring vehicles has had an impact, [n, N - 1]."""
        return self.line[:, HIT, 1:-1] == 1.0

    @property
    def braking_capacity_mps2(self) -> Floats:
        """Largest deceleration, [n, N] m/s2."""
        return capacities(self.car, BRAKING)[:, 1:]

    @property
    def driving_capacity_mps2(self) -> Floats:
        """Largest forward acceleration, [n, N] m/s2."""
        return capacities(self.car, DRIVING)[:, 1:]

    @property
    def mass_t(self) -> Floats:
        """Masses, [n, N] t."""
        return self.car[:, MASS, 1:]

    @property
    def restitution(self) -> Floats:
        """Coefficient of restitution of the world's impacts, [n]."""
        return self.car[:, RESTITUTION, 0]

    @property
    def latency_s(self) -> Floats:
        """Time from the alert until commands take effect, [n, N] s."""
        return self.car[:, LATENCY, 1:]

    @property
    def collided(self) -> Bools:
        """Whether the world has had an impact, [n]."""
        return np.asarray(self.line[:, IMPACTS].any(axis=1))

    def harm(self, harm_count: AnyCount = HONEST) -> Floats:
        """Harm of each world so far, [n] m2/s2; ``harm_count`` is the count of harm (``episode.counts``)."""
        count, out = self.defined(harm_count), np.empty(self.n)
        _harm(self.line, count.weight_array, out)
        return out

    def pair_harm(self, harm_count: AnyCount = HONEST) -> Floats:
        """Harm of each pair of neighbouring vehicles so far, [n, N - 1] m2/s2.

        The pair of the obstacle and Vehicle 1 is left out. So the result lacks the harm of impacts with the obstacle
        and, in the honest cost, the price of Vehicle 1's driving and motion.
        """
        return pair_amounts(self.line, self.defined(harm_count))[0, :, 1:-1]

    def borne_harm(self, harm_count: AnyCount = HONEST) -> Floats:
        """Harm that each vehicle has borne so far, [n, N] m2/s2. It sums to the harm of the line."""
        pairs, unshared, conduct = pair_amounts(self.line, self.defined(harm_count))
        out = np.empty((self.n, self.vehicles))
        split_harm(pairs - unshared, self.car[:, MASS].copy(), out)  # one world or many: one compiled function
        return out + conduct[:, :-1]

    @property
    def departures(self) -> frozenset[str]:
        """Names of all departures of these worlds from the plain game (``episode.departures``)."""
        return frozenset(departing_worlds(self.line, self.car, self.memories.get(MARKS, ())))

    @property
    def is_exact(self) -> bool:
        """Whether these worlds move and collide as ``motion`` computes, because nothing marks them as departing."""
        return MARKS not in self.memories

    def defines(self, count: HarmCount) -> bool:
        """Whether these worlds have everything that the count requires."""
        return self.is_exact or not count.requires

    @property
    def counts(self) -> list[HarmCount]:
        """All counts of harm that are defined in these worlds."""
        return [count for count in all_counts() if self.defines(count)]

    def defined(self, harm_count: AnyCount) -> HarmCount:
        """The count; raises ``InvalidInput`` if it is not defined in these worlds."""
        count = HarmCount.of(harm_count)
        if not self.defines(count):
            require(self, f"the {count.words}", simulates=True)
        return count


def mark(state: State, names: Iterable[str]) -> State:
    """The same worlds, marked with departures that their arrays do not show."""
    marks = dict.fromkeys([*state.memories.get(MARKS, ()), *names])
    return state._replace(memories={**state.memories, MARKS: marks}) if marks else state


def require(state: State, who: str, allows: AbstractSet[str] = frozenset(), *, simulates: bool = False) -> None:
    """Raise ``InvalidInput`` if worlds depart from the plain game in a way that a feature does not cover.

    ``who`` names the feature, ``allows`` the departures that it covers. A feature that ``simulates`` whole states with
    ``motion`` covers all departures that stand in their arrays.
    """
    if simulates and MARKS not in state.memories:
        return
    marks = state.memories.get(MARKS, {})
    worlds = departing_worlds(state.line, state.car, marks, allows)
    names = sorted(worlds.keys() & marks.keys() if simulates else worlds)
    if names:
        where = f"world {int(np.argmax(worlds[names[0]]))} departs from the plain game"
        covered = ", ".join(sorted(allows | SHOWN if simulates else allows)) or "none"
        raise InvalidInput(f"{who} does not cover {names[0]}, by which {where}; departures that it covers: {covered}")


def map_arrays(function: Callable[..., Any], memory: Any, *siblings: Any) -> Any:
    """A memory with ``function(array, ...)`` in place of each array.

    A memory is None, an array with one row per world, or a tuple or mapping of memories; a state is one, too.
    ``siblings`` are memories of the same structure, whose arrays are further arguments of ``function``.
    """
    if isinstance(memory, np.ndarray):  # first, because the check for a mapping is slow
        return function(memory, *siblings)
    if isinstance(memory, tuple):
        parts = [map_arrays(function, *aligned_parts) for aligned_parts in zip(memory, *siblings, strict=True)]
        return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)
    if isinstance(memory, Mapping):
        return {
            owner: map_arrays(function, part, *(sibling[owner] for sibling in siblings))
            for owner, part in memory.items()
        }
    return None if memory is None else function(memory, *siblings)


def arrays_of(memory: Any) -> list[Any]:
    """All arrays of a memory (``map_arrays``), in order."""
    arrays: list[Any] = []
    map_arrays(arrays.append, memory)
    return arrays


def take(memory: Any, rows: Any) -> Any:
    """A copy of a memory (defined in ``map_arrays``; a state is one) with only the worlds ``rows``: a slice, numbers or
    a mask [n].
    """
    if isinstance(rows, slice):
        return map_arrays(lambda array: array[rows].copy(), memory)
    places = np.asarray(rows, None if len(rows) else np.int64)
    places = np.flatnonzero(places) if places.dtype == np.bool_ else places
    return map_arrays(lambda array: array.take(places, axis=0), memory)  # more than twice as fast as array[rows]


def put_rows(memory: Any, rows: Any, new: Any, donate: bool = False) -> Any:
    """A memory (``map_arrays``) with the arrays of ``new`` in the worlds ``rows``.

    The old arrays are copied first; with ``donate``, those that are writable are overwritten.
    """

    def write_rows(old: Any, part: Any) -> Any:
        array = old if donate and old.flags.writeable else old.copy()
        array[rows] = part
        return array

    return map_arrays(write_rows, memory, new)


@large
def _harm(line, weights, out):
    for k in range(len(out)):
        out[k] = amount_so_far(line[k], weights)


@kernel
def front_share(harm, front_mass, rear_mass):
    """Part of a pair's harm that its front vehicle bears: ``harm m_rear / (m_front + m_rear)``, with masses in t.

    The larger part is computed by the formula and the smaller part is the rest, so both sum to ``harm`` exactly.
    """
    if front_mass <= rear_mass:
        return rear_mass / (front_mass + rear_mass) * harm
    return harm - front_mass / (front_mass + rear_mass) * harm


@kernel
def split_world(pair_harm, mass, borne):
    """Split the harm of each pair between its two vehicles, in one world: write each vehicle's part (m2/s2) to
    ``borne`` [N].

    ``pair_harm`` [N + 1]: harm of each pair (m2/s2); pair 0 is the obstacle and Vehicle 1, which bears all of it.
    ``mass`` [N + 1]: mass of each body (t).
    """
    rear = 0.0
    for p in range(1, len(borne)):
        front = front_share(pair_harm[p], mass[p], mass[p + 1])
        borne[p - 1] = rear + front
        rear = pair_harm[p] - front
    borne[len(borne) - 1] = rear
    borne[0] += pair_harm[0]


@large
def split_harm(pair_harm, mass, out):
    """Write the harm (m2/s2) that each vehicle of n worlds bears to ``out`` [n, N] (see ``split_world``).

    ``pair_harm`` (m2/s2) and ``mass`` (t) are [n, N + 1].
    """
    for k in range(len(out)):
        split_world(pair_harm[k], mass[k], out[k])
