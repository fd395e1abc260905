"""State and parameters of ``n`` independent worlds, each a line of ``N`` vehicles.

Shape letters that the whole package uses:

===  =========================================================
n    worlds, advanced together and independent of each other
N    vehicles in a line, index 0 = ``vehicle_1`` = the front one
P    pairs, ``P = N - 1``; pair p is (vehicle p, vehicle p + 1)
L    learners
F    features of an observation
===  =========================================================

A *braking profile* is a fixed sequence of commands that one vehicle follows (``Vehicles.pieces``).

Worlds store gaps and not absolute positions, because positions would lose precision as the line moves on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.errors import InvalidInput, count_of

Floats = NDArray[np.float64]

Bools = NDArray[np.bool_]

Ints = NDArray[np.int64]

UInt64s = NDArray[np.uint64]

GRAVITY_MPS2 = 9.81

LEAST_WEIGHT = 1e-6  # least weight of harm that one vehicle of a line must have, so that shares of weights are exact

_ON_ROADS = ("braking_capacity_mps2", "driving_capacity_mps2")  # limited by friction


def as_road_allows(quantities: Mapping[str, Floats], friction: Floats) -> dict[str, Floats]:
    """Return a copy of ``quantities`` with braking and driving capacities limited to ``friction * GRAVITY_MPS2``.

    ``quantities`` maps field names such as ``braking_capacity_mps2`` to arrays; ``friction`` is broadcast to their
    shape.
    """
    most = friction * GRAVITY_MPS2
    return {key: np.minimum(value, most) if key in _ON_ROADS else value for key, value in quantities.items()}


@dataclass(frozen=True, slots=True)
class Vehicles:
    """Parameters of the vehicles of ``n`` worlds, constant during an episode."""

    braking_capacity_mps2: Floats  # [n, N] largest deceleration, > 0
    driving_capacity_mps2: Floats  # [n, N] largest forward acceleration, >= 0
    latency_s: Floats  # [n, N] commands have no effect before this time, >= 0; includes delays of a ``v2x`` channel
    mass_t: Floats  # [n, N] > 0
    speed_limit_mps: Floats  # [n, N] speed up to which a vehicle drives, > 0
    restitution: Floats  # [n] in [0, 1]
    # [n, N] > 0, rates at which the acceleration in force falls to a lower command and rises to a higher one (m/s3);
    # infinite: at once
    brake_rate_mps3: Floats
    release_rate_mps3: Floats
    # [n, N, 2 K] braking in pieces: start of each of K pieces (s after the latency; infinite: none), then their
    # commands (m/s2), which replace every other command; [n, N, 0]: no vehicle brakes in pieces
    pieces: Floats
    harm_weight: Floats  # [n, N] >= 0, weight of the harm that a vehicle bears in the objective ``preference``
    own_latency_s: Floats  # [n, N] part of the latency without the channel; messages report this part
    # [n, N, N] time from which vehicle i acts on news of vehicle j; infinite: never. At least latency_s of vehicle i,
    # and equal to it for i = j. Without a channel this and own_latency_s share the memory of latency_s
    known_from_s: Floats

    def __repr__(self) -> str:
        n, N = self.mass_t.shape
        return f"Vehicles({count_of(n, 'world')} of {N}, masses {_span(self.mass_t)} t)"

    def take(self, rows: ArrayLike) -> Vehicles:
        """Return a copy of the parameters of the worlds that ``rows`` selects (indices, or a mask [n])."""
        index = np.asarray(rows)
        return _combined(lambda column: np.ascontiguousarray(column[index]), self)

    @classmethod
    def at_once(
        cls,
        braking_mps2: Floats,
        driving_mps2: Floats,
        latency_s: Floats,
        mass_t: Floats,
        limit_mps: Floats,
        restitution: Floats,
        brake_rate_mps3: Floats | None = None,
        release_rate_mps3: Floats | None = None,
        pieces: Floats | None = None,
        harm_weight: Floats | None = None,
    ) -> Vehicles:
        """Return parameters of vehicles without a V2X channel: each knows everything once its latency has elapsed.

        Shapes and units are as in the fields of this class. If a rate is None, the acceleration reaches a new command
        at once. If ``pieces`` is None, no vehicle has a braking profile. If ``harm_weight`` is None, every weight is 1.
        """
        known = cls.known_at_once(latency_s)
        at_once = np.full(mass_t.shape, np.inf)
        return cls(
            braking_mps2, driving_mps2, latency_s, mass_t, limit_mps, restitution,
            at_once if brake_rate_mps3 is None else brake_rate_mps3,
            at_once if release_rate_mps3 is None else release_rate_mps3,
            np.zeros((*mass_t.shape, 0)) if pieces is None else pieces,
            np.ones(mass_t.shape) if harm_weight is None else harm_weight, latency_s, known,
        )  # fmt: skip

    @staticmethod
    def known_at_once(latency_s: Floats) -> Floats:
        """Return the field ``known_from_s`` [n, N, N] of vehicles without a V2X channel, from their latencies [n, N] s.

        Without a channel vehicle i acts on news of every vehicle once its own latency has elapsed. The result is a
        read-only view of ``latency_s``; the last axis has stride 0, so the result takes no memory of its own.
        """
        latency = np.ascontiguousarray(latency_s, np.float64)
        (n, N), size = latency.shape, latency.itemsize
        view: Floats = np.ndarray((n, N, N), np.float64, latency, strides=(N * size, size, 0))
        view.flags.writeable = False
        return view

    @property
    def build_up(self) -> Bools:
        """For each world, whether any vehicle has a finite brake or release rate, or a braking profile, [n]."""
        rates = np.minimum(self.brake_rate_mps3, self.release_rate_mps3)
        return np.asarray(np.isfinite(rates).any(axis=1) | self.in_pieces)

    @property
    def in_pieces(self) -> Bools:
        """For each world, whether any vehicle has a braking profile, [n]."""
        return np.asarray(np.isfinite(self.pieces).any(axis=(1, 2)))

    def piece_commands(self, command_mps2: Floats, time_s: Floats) -> Floats:
        """Return the commands of all vehicles at the absolute time ``time_s`` [n], [n, N] m/s2.

        The commands are those of the braking profiles, and ``command_mps2`` for vehicles without a braking profile.
        """
        command, count = command_mps2, self.pieces.shape[2] // 2
        for piece in range(count):
            begins = self.latency_s + self.pieces[:, :, piece]
            started = (begins <= time_s[:, np.newaxis]) if piece else np.isfinite(begins)
            command = np.where(started, self.pieces[:, :, count + piece], command)
        return command

    def hide_from(self, vehicle: int) -> Bools:
        """Return for each world whether a V2X channel hides information from ``vehicle`` at its first decision, [n].

        The channel hides information if news of another vehicle has not arrived by the first decision of ``vehicle``,
        or if the channel extends the latency of another vehicle, because messages report that latency without the
        extension.
        """
        late = self.latency_s > self.own_latency_s
        hidden = (self.known_from_s[:, vehicle] > self.latency_s[:, [vehicle]]) | late
        hidden[:, vehicle] = False
        return np.asarray(hidden.any(axis=1))

    @property
    def is_known_at_once(self) -> bool:
        """Whether every vehicle knows everything once its own latency has elapsed, as it does without a V2X channel."""
        if self._is_view:
            return True
        own, latency = self.own_latency_s, self.latency_s
        return bool((own == latency).all() and (self.known_from_s == latency[:, :, np.newaxis]).all())

    @property
    def _is_view(self) -> bool:
        """Whether ``own_latency_s`` and ``known_from_s`` share the memory of ``latency_s``: there is no V2X channel."""
        latency, news = self.latency_s, self.known_from_s
        return self.own_latency_s is latency and news.base is latency and news.strides[1:] == (latency.itemsize, 0)


_OF_VEHICLES = tuple(f.name for f in fields(Vehicles))

_WITHOUT_NEWS = _OF_VEHICLES[:-2]


@dataclass(frozen=True, slots=True)
class Worlds:
    """State of ``n`` worlds, each at its own time ``time_s``.

    >>> import ethbrake_marl.first_edition as eb
    >>> worlds = eb.make_worlds(
    ...     [7.0, 7.0], [20.0, 18.0, 20.0], braking_capacity_mps2=[6.0, 7.0, 6.0], driving_capacity_mps2=3.0,
    ...     latency_s=[0.0, 0.5, 0.8], mass_t=[4.5, 5.5, 5.9], restitution=0.1,
    ... )
    >>> worlds.n, worlds.N, worlds.gaps_m
    (1, 3, array([[7., 7.]]))

    """

    vehicles: Vehicles  # constant parameters
    gaps_m: Floats  # [n, P] bumper to bumper, >= 0 (negative only in the paper's fixed-step map)
    speeds_mps: Floats  # [n, N] forward positive; negative only after a bounce-back
    time_s: Floats  # [n] since Vehicle 1 began to brake
    pair_hit: Bools  # [n, P] whether the pair has had an impact
    command_mps2: Floats  # [n, N] signed acceleration in force up to this time; 0 up to the latency
    obstacle_gap_m: Floats  # [n] from Vehicle 1's front to an unmovable obstacle ahead, >= 0; infinite: there is none
    obstacle_hit: Bools  # [n] whether Vehicle 1 has had an impact with the obstacle
    messages: Floats  # [n, M] state of the periodic messages (``physics.messages``); [n, 0] without them
    # [n, 1 + 2 N] friction of the road, and braking and driving capacities on a dry road (m/s2), from which friction
    # gives the capacities of ``vehicles``; [n, 0]: no friction is modelled
    road: Floats

    def __repr__(self) -> str:
        summary = f"gaps {_span(self.gaps_m)} m, speeds {_span(self.speeds_mps)} m/s, at {_span(self.time_s)} s"
        return f"Worlds({count_of(self.n, 'world')} of {self.N} vehicles: {summary})"

    @property
    def n(self) -> int:
        """Number of worlds."""
        return int(self.speeds_mps.shape[0])

    @property
    def N(self) -> int:
        """Number of vehicles in each line."""
        return int(self.speeds_mps.shape[1])

    def _each(self, change: Callable[..., NDArray[Any]], *others: Worlds) -> Worlds:
        """Return new worlds with ``change`` applied to each field: ``change(field of self, field of others[0], ...)``.

        ``change`` returns one array, with selected or joined rows.
        """
        parts = (self, *others)
        columns = (change(*(getattr(w, name) for w in parts)) for name in _OF_WORLDS)
        return Worlds(_combined(change, *(w.vehicles for w in parts)), *columns)

    def copy(self) -> Worlds:
        """Return a copy of the state in new memory; the copy shares ``vehicles``."""
        return Worlds(self.vehicles, *(getattr(self, name).copy() for name in _OF_WORLDS))

    def take(self, rows: ArrayLike) -> Worlds:
        """Return a copy of the worlds that ``rows`` selects (indices, or a mask [n])."""
        index = np.asarray(rows)
        return self._each(lambda column: np.ascontiguousarray(column[index]))

    @staticmethod
    def concatenate(parts: Sequence[Worlds]) -> Worlds:
        """Join ``parts`` in this order into one batch; all parts must have the same number of vehicles."""
        parts = _alike(parts)
        return parts[0]._each(lambda *columns: np.concatenate(columns), *parts[1:])

    def assign(self, rows: Ints, fresh: Worlds) -> Worlds:
        """Return a copy of the batch with the worlds at indices ``rows`` [k] replaced by the k worlds of ``fresh``."""

        def assigned(whole: NDArray[Any], part: NDArray[Any]) -> NDArray[Any]:
            copy = whole.copy()
            copy[rows] = part
            return copy

        whole, part = _alike((self, fresh))
        return whole._each(assigned, part)

    def running(
        self,
        time_s: ArrayLike,
        gaps_m: ArrayLike,
        speeds_mps: ArrayLike,
        *,
        command_mps2: ArrayLike = 0.0,
        pair_hit: ArrayLike = False,
    ) -> Worlds:
        """Return these worlds with a new state at a later time, for example a state from another simulator.

        >>> import ethbrake_marl.first_edition as eb
        >>> alert = eb.load_scenario("paper-random").sample(2, seed=7).worlds
        >>> alert.running(0.7, [4.0, 6.0], [18.0, 17.0, 19.0], command_mps2=[-5.0, -2.0, 0.0]).time_s
        array([0.7, 0.7])

        Args:
            time_s: time since Vehicle 1 began to brake, broadcast to [n], s.
            gaps_m: gaps, bumper to bumper, broadcast to [n, P], m.
            speeds_mps: speeds, broadcast to [n, N], m/s.
            command_mps2: acceleration in force of each vehicle, broadcast to [n, N], m/s2.
            pair_hit: whether each pair has had an impact, broadcast to [n, P].

        Raises ``InvalidInput``, with the field and its first invalid entry, for a value out of range.

        """
        (n, N), inf = self.speeds_mps.shape, math.inf
        return replace(
            self,
            time_s=_full("time_s", time_s, (n,), 0.0, inf),
            gaps_m=_full("gaps_m", gaps_m, (n, N - 1), 0.0, inf),
            speeds_mps=_full("speeds_mps", speeds_mps, (n, N), -inf, inf),
            command_mps2=_full("command_mps2", command_mps2, (n, N), -inf, inf),
            pair_hit=_full("pair_hit", np.asarray(pair_hit, np.float64), (n, N - 1), 0.0, 1.0) == 1.0,
        )

    def read_only(self) -> Worlds:
        """Return the same worlds, with their arrays as read-only views."""
        return self._each(_unwritable)

    def on_road(self, friction: Floats, dry: Mapping[str, Floats] | None = None) -> Worlds:
        """Return these worlds on a road with this ``friction`` [n]; capacities are at most ``friction * GRAVITY_MPS2``.

        ``dry`` maps field names to new capacities on a dry road, [n, N] m/s2, for example
        ``{"braking_capacity_mps2": array}``. Capacities that are missing from ``dry`` do not change on a dry road.
        """
        on_dry = {name: self.dry(name) for name in _ON_ROADS} | dict(dry or {})
        vehicles = replace(self.vehicles, **as_road_allows(on_dry, friction[:, np.newaxis]))
        return replace(
            self, vehicles=vehicles, road=np.concatenate([friction[:, np.newaxis], *on_dry.values()], axis=1)
        )

    @property
    def friction(self) -> Floats:
        """Friction coefficient of the road, [n]; infinite if no friction is modelled."""
        return self.road[:, 0] if self.road.shape[1] else np.full(self.n, np.inf)

    def dry(self, name: str) -> Floats:
        """Return the field ``name`` of ``vehicles``, [n, N]; for a capacity, return the capacity on a dry road."""
        value: Floats = getattr(self.vehicles, name)
        if self.road.shape[1] and name in _ON_ROADS:
            begin = 1 + self.N * _ON_ROADS.index(name)
            value = self.road[:, begin : begin + self.N]
        return value

    def play_pieces(self, pieces: Mapping[int, Sequence[tuple[float, float]]]) -> Worlds:
        """Return these worlds with braking profiles for the vehicles in ``pieces``.

        ``pieces`` maps a vehicle (index from 0) to a sequence of pairs (start, deceleration), one for each command. The
        start is in s after the vehicle's latency, and the first start is 0. The deceleration is in m/s2. A vehicle
        whose sequence has a single pair gets no profile.
        """
        several = {i: np.array(each, np.float64) for i, each in pieces.items() if len(each) > 1}
        if not several and not self.vehicles.pieces.shape[2]:
            return self
        most = max(map(len, several.values()), default=0)
        commands = np.full((self.n, self.N, 2, most), np.inf)
        for i, each in several.items():
            commands[:, i, 0, : len(each)], commands[:, i, 1, : len(each)] = each[:, 0], 0.0 - each[:, 1]
        return replace(self, vehicles=replace(self.vehicles, pieces=commands.reshape(self.n, self.N, 2 * most)))

    def refuse_build_up(self, who: str) -> None:
        """Raise ``InvalidInput`` if any vehicle has a finite brake or release rate, or a braking profile.

        A function whose result would not be exact in these cases calls this check. ``who`` is the name of that function
        in the error message.
        """
        slow = self.vehicles.build_up
        if self.vehicles.in_pieces.any():
            raise InvalidInput(
                f"{who}: a vehicle of world {int(np.argmax(self.vehicles.in_pieces))} follows a braking profile, for"
                " which the result would not be exact; use a script with a constant command"
            )
        if slow.any():
            raise InvalidInput(
                f"{who}: the result would not be exact, because brakes in world {int(np.argmax(slow))} build up at a"
                " finite rate; leave out brake_rate_mps3 and release_rate_mps3"
            )

    def first_decision_s(self, deciders: Sequence[int]) -> Floats:
        """Return the time of the first decision, [n] s: the least latency of ``deciders``, but at least ``time_s``.

        ``deciders`` are the indices (from 0) of the vehicles that choose their commands. If ``deciders`` is empty, the
        result is ``time_s``.
        """
        if len(deciders) == 0:
            return self.time_s.copy()
        first: Floats = np.maximum(self.vehicles.latency_s[:, list(deciders)].min(axis=1), self.time_s)
        return first

    # The kernels treat the obstacle ahead of Vehicle 1 as one more vehicle in front, which nothing moves. In the other
    # modules the obstacle has columns of its own, so the vehicles keep their indices.

    @property
    def obstacle_ahead(self) -> Bools:
        """For each world, whether it has an obstacle ahead of Vehicle 1, [n]."""
        return np.isfinite(self.obstacle_gap_m)

    def with_obstacle(self) -> Worlds:
        """Return these worlds with the obstacle as vehicle 0, so that vehicle i becomes vehicle i + 1.

        Every world must have an obstacle.
        """

        def ahead(value: float, columns: Floats) -> Floats:
            return np.concatenate([np.full((len(columns), 1), value), columns], axis=1)

        vehicles = self.vehicles
        written_out = Vehicles.at_once(  # the physics needs no observations
            ahead(0.0, vehicles.braking_capacity_mps2),
            ahead(0.0, vehicles.driving_capacity_mps2),
            ahead(0.0, vehicles.latency_s),
            ahead(math.inf, vehicles.mass_t),
            ahead(0.0, vehicles.speed_limit_mps),
            vehicles.restitution,
            ahead(math.inf, vehicles.brake_rate_mps3),
            ahead(math.inf, vehicles.release_rate_mps3),
            np.concatenate([np.full((self.n, 1, vehicles.pieces.shape[2]), np.inf), vehicles.pieces], axis=1),
        )
        return Worlds(
            written_out,
            np.concatenate([self.obstacle_gap_m[:, np.newaxis], self.gaps_m], axis=1),
            ahead(0.0, self.speeds_mps),
            self.time_s,
            np.concatenate([self.obstacle_hit[:, np.newaxis], self.pair_hit], axis=1),
            ahead(0.0, self.command_mps2),
            np.full(self.n, np.inf),
            np.zeros(self.n, np.bool_),
            self.messages,
            np.zeros((self.n, 0)),
        )

    def with_post_ahead(self, duration_s: Floats) -> Worlds:
        """Return these worlds; a world without an obstacle gets one that no vehicle reaches within ``duration_s`` [n].

        The change of the gap to an added obstacle is the distance that Vehicle 1 travels, which worlds do not store. An
        added obstacle changes no motion, because its gap is larger than ``T sqrt(2 E / m_1)``: the distance that
        Vehicle 1, of mass m_1, would travel in the time T = ``duration_s`` if it had all the energy E that the line can
        have within T. Impacts and brakes only remove energy. A vehicle of mass m that drives at the speed v with the
        acceleration a adds at most the energy ``m a v`` per second, and only up to the speed limit.
        """
        vehicles = self.vehicles
        driving = vehicles.driving_capacity_mps2 * vehicles.speed_limit_mps * duration_s[:, np.newaxis]
        energy = sum_rows(vehicles.mass_t * (self.speeds_mps * self.speeds_mps / 2.0 + driving))
        farthest = 1.01 * duration_s * np.sqrt(2.0 * energy / vehicles.mass_t[:, 0])
        return replace(self, obstacle_gap_m=np.where(self.obstacle_ahead, self.obstacle_gap_m, farthest + 1.0))


def _alike(parts: Sequence[Worlds]) -> Sequence[Worlds]:
    """Return the batches ``parts`` with arrays of equal width, so that they can be joined.

    All batches get the width of the widest array ``Vehicles.pieces``. If some batches model the friction of the road,
    the others get infinite friction.
    """
    most = max(part.vehicles.pieces.shape[2] for part in parts)
    if any(part.vehicles.pieces.shape[2] < most for part in parts):
        parts = [
            replace(part, vehicles=replace(part.vehicles, pieces=_padded(part.vehicles.pieces, most))) for part in parts
        ]
    if len({part.road.shape[1] for part in parts}) == 1:
        return parts
    return [part if part.road.shape[1] else part.on_road(part.friction) for part in parts]


def _padded(pieces: Floats, most: int) -> Floats:
    """Return ``pieces`` [n, N, 2 K] as [n, N, most], with infinite starts and commands for the missing pieces.

    ``most`` is even.
    """
    n, N, width = pieces.shape
    halves = pieces.reshape(n, N, 2, width // 2)
    more = [(0, 0), (0, 0), (0, 0), (0, (most - width) // 2)]
    return np.pad(halves, more, constant_values=np.inf).reshape(n, N, most)


_OF_WORLDS = tuple(f.name for f in fields(Worlds))[1:]


def _unwritable(array: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only view of ``array``; ``array`` itself stays writable."""
    view = array.view()
    view.flags.writeable = False
    return view


def _span(values: Floats) -> str:
    """Return the smallest and the largest of ``values`` as text, one number if they are equal, ``none`` if empty."""
    if not values.size:
        return "none"
    low, high = float(values.min()), float(values.max())
    return f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"


def _combined(change: Callable[..., NDArray[Any]], *parts: Vehicles) -> Vehicles:
    """Return new vehicles with ``change`` applied to each field: ``change(field of parts[0], field of parts[1], ...)``.

    ``change`` returns one array, with selected or joined rows. If no entry of ``parts`` has a V2X channel,
    ``latency_s``, ``own_latency_s`` and ``known_from_s`` of the result share memory, as in the result of ``at_once``.
    """
    at_once = all(part._is_view for part in parts)
    columns = [
        change(*(getattr(part, name) for part in parts)) for name in (_WITHOUT_NEWS if at_once else _OF_VEHICLES)
    ]
    return Vehicles.at_once(*columns) if at_once else Vehicles(*columns)


def sum_rows(values: Floats) -> Floats:
    """Return ``values.sum(axis=1)`` with the same bits, but faster for rows of fewer than 8 entries."""
    if not 0 < values.shape[1] < 8:
        total: Floats = values.sum(axis=1)
        return total
    total = values[:, 0].copy()
    for column in values.T[1:]:
        total += column
    return total


def real_numbers(value: ArrayLike) -> Floats:
    """Return ``value`` as float64, without a copy if it is a float64 array already.

    Raises ``ValueError``, with the reason as its text, for a value that is not numeric, and for some values that numpy
    would convert: booleans, masked entries, texts, and tensors that need gradients or are on another device.
    """
    if type(value) is np.ndarray and value.dtype.kind in "fiu":
        return np.asarray(value, np.float64)
    if isinstance(value, list | tuple):
        parts = [real_numbers(part) for part in value]
        if len({part.shape for part in parts}) > 1:
            raise ValueError("has inner lists of different lengths")
        return np.array(parts, np.float64)
    if np.ma.is_masked(value):
        raise ValueError("is masked")
    if getattr(value, "requires_grad", False):
        raise ValueError("is a tensor that requires gradients; pass tensor.detach()")
    try:
        array = np.asarray(value)
        if array.dtype.hasobject and array.ndim > 0:
            return real_numbers(list(array))
        entry = array.item() if array.dtype.hasobject else None
        if array.dtype.kind == "b" or isinstance(entry, bool | np.bool_):
            raise ValueError("is a boolean")
        if array.dtype.kind in "fiu" or hasattr(entry, "__float__"):
            return array.astype(np.float64)
    except (TypeError, RuntimeError, OverflowError):
        pass
    raise ValueError("is not a number")


def checked_numbers(name: str, value: ArrayLike) -> Floats:
    """Return ``value`` as a float64 array; if it is not numeric, raise ``InvalidInput`` with ``name`` and the value."""
    try:
        return real_numbers(value)
    except ValueError as error:
        raise InvalidInput(f"{name}: {value!r} {error}; must be a number or an array of numbers") from None


def make_worlds(
    gaps_m: ArrayLike,
    speeds_mps: ArrayLike,
    *,
    braking_capacity_mps2: ArrayLike,
    driving_capacity_mps2: ArrayLike,
    latency_s: ArrayLike,
    mass_t: ArrayLike,
    restitution: ArrayLike,
    speed_limit_mps: ArrayLike = 40.0,
    brake_rate_mps3: ArrayLike = np.inf,
    release_rate_mps3: ArrayLike = np.inf,
    obstacle_gap_m: ArrayLike | None = None,
    friction: ArrayLike | None = None,
    harm_weight: ArrayLike = 1.0,
) -> Worlds:
    """Build and check worlds at ``t = 0``; every argument is broadcast to its full shape.

    Args:
        gaps_m: gaps, bumper to bumper, [n, P], [P] or one number, m.
        speeds_mps: speeds, [n, N] or [N], m/s.
        braking_capacity_mps2: largest deceleration, m/s2, broadcast to [n, N].
        driving_capacity_mps2: largest forward acceleration, m/s2, broadcast to [n, N].
        latency_s: time before which commands have no effect, s, broadcast to [n, N].
        mass_t: masses, tonnes, broadcast to [n, N].
        restitution: coefficient of restitution of every impact, in [0, 1], broadcast to [n].
        speed_limit_mps: speed up to which a vehicle drives, m/s, broadcast to [n, N].
        brake_rate_mps3: rate at which the acceleration falls to a lower command, m/s3, broadcast to [n, N]; inf: at
            once.
        release_rate_mps3: rate at which the acceleration rises to a higher command, m/s3, broadcast to [n, N]; inf: at
            once.
        obstacle_gap_m: gap from Vehicle 1 to an obstacle ahead, m, broadcast to [n]; None: no obstacle.
        friction: friction coefficient of the road, broadcast to [n]; braking and driving capacities are at most
            ``friction * GRAVITY_MPS2``. None: no limit.
        harm_weight: weight of each vehicle's harm in the objective ``preference``, at least 0, broadcast to [n, N]; at
            least one vehicle of each world needs a weight of ``LEAST_WEIGHT`` or more.

    Raises ``InvalidInput`` with the field, its first invalid entry and the valid range.

    """
    speeds = np.atleast_2d(checked_numbers("speeds_mps", speeds_mps))
    if speeds.ndim != 2 or speeds.shape[1] < 2:
        raise InvalidInput(f"speeds_mps: has shape {speeds.shape}; must have shape [n, N] with N >= 2 vehicles")
    gaps = checked_numbers("gaps_m", gaps_m)
    n = speeds.shape[0] if gaps.ndim < 2 else max(speeds.shape[0], gaps.shape[0])
    N = speeds.shape[1]
    restitution_ = _full("restitution", restitution, (n,), 0.0, 1.0)
    vehicles = Vehicles.at_once(
        _full("braking_capacity_mps2", braking_capacity_mps2, (n, N), 0.0, np.inf, open_low=True),
        _full("driving_capacity_mps2", driving_capacity_mps2, (n, N), 0.0, np.inf),
        _full("latency_s", latency_s, (n, N), 0.0, np.inf),
        _full("mass_t", mass_t, (n, N), 0.0, np.inf, open_low=True),
        _full("speed_limit_mps", speed_limit_mps, (n, N), 0.0, np.inf, open_low=True),
        restitution_,
        _full("brake_rate_mps3", brake_rate_mps3, (n, N), 0.0, np.inf, open_low=True, finite=False),
        _full("release_rate_mps3", release_rate_mps3, (n, N), 0.0, np.inf, open_low=True, finite=False),
        harm_weight=_full("harm_weight", harm_weight, (n, N), 0.0, np.inf),
    )
    nobody = ~(vehicles.harm_weight >= LEAST_WEIGHT).any(axis=1)
    if nobody.any():
        raise InvalidInput(
            f"harm_weight of world {int(np.argmax(nobody))}: the weight of at least one vehicle must be"
            f" {LEAST_WEIGHT:g} or more"
        )
    speeds = _full("speeds_mps", speeds, (n, N), 0.0, np.inf)
    if not np.all(speeds <= vehicles.speed_limit_mps):
        world, vehicle = np.argwhere(~(speeds <= vehicles.speed_limit_mps))[0]
        raise InvalidInput(
            f"speeds_mps[{world}, {vehicle}] = {speeds[world, vehicle]:g}: must be at most this vehicle's"
            f" speed_limit_mps {vehicles.speed_limit_mps[world, vehicle]:g}"
        )
    worlds = Worlds(
        vehicles,
        _full("gaps_m", gaps, (n, N - 1), 0.0, np.inf),
        speeds,
        np.zeros(n),
        np.zeros((n, N - 1), dtype=np.bool_),
        np.zeros((n, N)),
        np.full(n, np.inf) if obstacle_gap_m is None else _full("obstacle_gap_m", obstacle_gap_m, (n,), 0.0, np.inf),
        np.zeros(n, dtype=np.bool_),
        np.zeros((n, 0)),
        np.zeros((n, 0)),
    )
    return worlds if friction is None else worlds.on_road(_full("friction", friction, (n,), 0.0, np.inf, open_low=True))


def _full(
    name: str,
    value: ArrayLike,
    shape: tuple[int, ...],
    low: float,
    high: float,
    *,
    open_low: bool = False,
    finite: bool = True,
) -> Floats:
    """Return a new array, ``value`` broadcast to ``shape``; raise ``InvalidInput`` for an entry outside [low, high].

    ``open_low`` makes ``low`` itself invalid, ``finite`` makes infinite entries invalid. ``name`` is the field in the
    error message.
    """
    numbers = checked_numbers(name, value)
    try:
        full = np.array(np.broadcast_to(numbers, shape), dtype=np.float64, order="C")
    except ValueError:
        raise InvalidInput(f"{name}: has shape {numbers.shape}; must have shape {shape} or broadcast to it") from None
    good = (
        (np.isfinite(full) if finite else ~np.isnan(full))
        & (full <= high)
        & ((full > low) if open_low else (full >= low))
    )
    if not good.all():
        at = tuple(int(k) for k in np.argwhere(~good)[0])
        bracket = "(" if open_low else "["
        finite_too = "finite and " if finite else ""
        raise InvalidInput(f"{name}{list(at)} = {full[at]:g}: must be {finite_too}in {bracket}{low:g}, {high:g}]")
    return full
