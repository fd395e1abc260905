"""Observations: choose the features that a vehicle observes, and compute their values in a batch of worlds.

Arguments that several functions share: ``state`` has time, motion and harm, and ``params`` the parameters of the
vehicles, with one row per world (layout: ``physics.columns``). ``vehicles`` or ``observers`` are the indices of the
observing vehicles (0 = front). ``steps`` is the number of steps that each episode has taken, [n], for error messages.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, PhysicsError, unknown_name
from ethbrake_marl.first_edition.game.contact_features import FORECAST_S, Contacts, observe_contacts
from ethbrake_marl.first_edition.game.features import (
    CONTACT_COMMANDS,
    GROUPS,
    MOST_NEIGHBOURS,
    Feature,
    RegisteredFeature,
    feature_named,
    listed_features,
    registered_in,
    side_of,
)
from ethbrake_marl.first_edition.physics.columns import Packed, columns
from ethbrake_marl.first_edition.physics.estimates import estimate_rows
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.messages import (
    ACCELERATION,
    BRAKING_CAPACITY,
    INTENT,
    LATENCY,
    MASS,
    PIECES,
    PLACE,
    SPEED,
    Messages,
    knows_piece,
)
from ethbrake_marl.first_edition.physics.motion import stopping_distance
from ethbrake_marl.first_edition.physics.state import Floats, Ints, Worlds


@dataclass(frozen=True, slots=True)
class ObservationSpec:
    """The features that a vehicle observes.

    A vehicle observes its own features, features of neighbours and, optionally, its place in the line, the obstacle and
    forecast impacts. If ``chosen`` is not empty, it lists exactly the observed features, in order; to make such a
    specification, use ``choose_observation``.

    >>> import ethbrake_marl.first_edition as eb
    >>> spec = eb.ObservationSpec(front=2, rear=0)
    >>> spec.size, spec.features[7].name
    (27, 'front_1.known')
    >>> eb.choose_observation(["own", "front_1.gap"]).size
    8
    """

    front: int = 1  # number of observed neighbours ahead, 0 to 64
    rear: int = 1  # number of observed neighbours behind, 0 to 64
    role: bool = False  # whether the vehicle's place in the line is observed (GROUPS.role)
    obstacle: bool = False  # whether the obstacle ahead is observed (GROUPS.obstacle)
    chosen: tuple[str, ...] = ()  # full names of all features, in order; the fields above and ``contact`` must fit them
    contact: bool = False  # whether forecast impacts are observed (GROUPS.contact); contact_far needs ``chosen``
    time_step_s: float | None = None  # time between two decisions (s); only contact features need it

    def __post_init__(self) -> None:
        """Raise ``InvalidInput`` for a field that is invalid or contradicts ``chosen``."""
        for side, count in (("front", self.front), ("rear", self.rear)):
            whole = isinstance(count, int | np.integer) and not isinstance(count, bool)
            if not whole or not 0 <= count <= MOST_NEIGHBOURS:
                raise InvalidInput(
                    f"observation: {side} = {count!r}: must be a whole number from 0 to {MOST_NEIGHBOURS}"
                )
        for name, shown in (("role", self.role), ("obstacle", self.obstacle), ("contact", self.contact)):
            if not isinstance(shown, bool):
                raise InvalidInput(f"observation: {name} = {shown!r}: must be True or False")
        if self.time_step_s is not None and not 0.0 < self.time_step_s < math.inf:
            raise InvalidInput(
                f"observation: time_step_s = {self.time_step_s!r}: must be a finite number of seconds above 0"
            )
        if self.chosen and _reach(self.chosen) != (self.front, self.rear, self.role, self.obstacle, self.contact):
            raise InvalidInput(
                "observation: the fields front, rear, role, obstacle and contact contradict the list of features in the"
                " field 'chosen';"
                " make the observation with eb.choose_observation([...])"
            )

    @property
    def sides(self) -> tuple[tuple[str, int], ...]:
        """Observed neighbours as pairs (prefix, offset): ``("front_1", -1)`` is the next vehicle ahead.

        The offset is the neighbour's index minus the observer's index. Neighbours ahead are listed before neighbours
        behind, the nearest first.
        """
        fronts = tuple((f"front_{k}", -k) for k in range(1, self.front + 1))
        return fronts + tuple((f"rear_{k}", k) for k in range(1, self.rear + 1))

    @property
    def features(self) -> tuple[Feature, ...]:
        """All features of the observation, in order; each has a different name, such as ``front_1.gap``."""
        return tuple(feature_named(name) for name in self.chosen) or self.whole

    @property
    def whole(self) -> tuple[Feature, ...]:
        """All features, in order, of the built-in groups from which the features of this observation are selected."""
        groups = [("own", GROUPS.own), *((prefix, GROUPS.neighbour) for prefix, _ in self.sides)]
        groups += [("role", GROUPS.role)] if self.role else []
        groups += [("obstacle", GROUPS.obstacle)] if self.obstacle else []
        groups += [("contact", GROUPS.contact)] if self.contact else []
        groups += [("contact_far", GROUPS.contact_far)] if self.far else []
        return tuple(replace(f, name=f"{prefix}.{f.name}") for prefix, group in groups for f in group)

    @property
    def far(self) -> bool:
        """Whether the observation has features of ``GROUPS.contact_far``."""
        return any(name.startswith("contact_far.") for name in self.chosen)

    @property
    def size(self) -> int:
        """Number of features of the observation, F."""
        return len(self.features)

    @property
    def plan(self) -> Plan:
        """The cached ``Plan`` that computes this observation from worlds; do not change it.

        Raises ``InvalidInput`` if the observation has contact features and ``time_step_s`` is None.
        """
        return _plan(self, tuple(registered_in(self.chosen).items()) if self.chosen else ())

    def at_steps_of(self, time_step_s: float) -> ObservationSpec:
        """Return a copy with the time step ``time_step_s`` (s) if this specification needs a time step and has none."""
        return replace(self, time_step_s=time_step_s) if self.contact and self.time_step_s is None else self


# a specification, a list of groups and features, or a mapping with the fields of a specification
Observation = ObservationSpec | Sequence[str] | Mapping[str, Any]


def choose_observation(listed: Observation, time_step_s: float | None = None) -> ObservationSpec:
    """Return the specification of an observation with the listed features.

    ``listed`` is a list of groups and features, such as ``["own", "front_1", "rear_1.gap"]``, a mapping with the fields
    of an ``ObservationSpec``, or an ``ObservationSpec``. ``time_step_s`` is the time between two decisions (s), which
    contact features need outside an environment. Raises ``UnknownName`` with a suggestion for an unknown name, and
    ``InvalidInput`` for an invalid list.
    """
    if isinstance(listed, ObservationSpec):
        spec = listed
    elif isinstance(listed, Mapping):
        known = [field.name for field in fields(ObservationSpec)]
        for name in listed:
            if name not in known:
                raise unknown_name("observation", name, known)
        chosen = listed.get("chosen", ())
        if not isinstance(chosen, list | tuple):
            raise InvalidInput(f"observation: chosen = {chosen!r}: must be a list of names of features")
        spec = ObservationSpec(**{**listed, "chosen": listed_features(chosen) if chosen else ()})
    else:
        names = listed_features(listed)
        front, rear, role, obstacle, contact = _reach(names)
        spec = ObservationSpec(front, rear, role, obstacle, contact=contact)
        if tuple(feature.name for feature in spec.features) != names:
            spec = replace(spec, chosen=names)
    return spec if time_step_s is None else spec.at_steps_of(time_step_s)


def _reach(names: Sequence[str]) -> tuple[int, int, bool, bool, bool]:
    """Return the ``ObservationSpec`` fields front, rear, role, obstacle and contact for the features ``names``."""
    sides = [side for name in names if (side := side_of(name)) is not None]
    front, rear = (max((k for at, k in sides if at == wanted), default=0) for wanted in ("front", "rear"))
    groups = {name.partition(".")[0] for name in names}
    return front, rear, "role" in groups, "obstacle" in groups, bool(groups & {"contact", "contact_far"})


Observations = NDArray[np.float32]

_OWN, _NEIGHBOUR = len(GROUPS.own), len(GROUPS.neighbour)

_ROLE, _OBSTACLE = len(GROUPS.role), len(GROUPS.obstacle)


def observe(worlds: Worlds, vehicle: int, spec: ObservationSpec) -> Observations:
    """Return the observation of ``vehicle`` (index, 0 = front) in every world, a new array [n, F] float32.

    Raises ``InvalidInput`` if no vehicle has the index ``vehicle``.
    """
    if not 0 <= vehicle < worlds.N:
        raise InvalidInput(f"observe: vehicle = {vehicle}: must be an index from 0 to {worlds.N - 1}")
    packed = Packed.of(worlds)
    return spec.plan.observe(packed.state, packed.params, np.array([vehicle]))[:, 0].copy()


class Scaling(NamedTuple):
    """Arguments of ``_observe_rows``, which computes all built-in groups of features except the contact features."""

    offsets: Ints  # index of each observed neighbour minus index of the observer; -1 is the next vehicle ahead
    role: bool  # whether the place in the line is observed
    obstacle: bool  # whether the obstacle ahead is observed
    features: Floats  # [3, F] scaling of the features: rows 1 / scale, low and high, one column per feature


class Extra(NamedTuple):
    """A feature of an observation that is computed by its own function, and not with a built-in group of features."""

    column: int  # column of the feature in the observation
    entry: RegisteredFeature  # the feature and its function
    offset: int  # index of the neighbour minus index of the vehicle; 0: the feature is of the vehicle itself
    known: int  # column of the neighbour's feature ``known`` among the built-in features

    def known_in(self, worlds: Worlds, vehicle: int, neighbour: int) -> NDArray[np.bool_]:
        """Return, for each world [n], whether ``vehicle`` knows all data of ``neighbour`` that the feature reads.

        Raises ``InvalidInput`` if messages leave out some data and the feature was registered without ``reads``.
        """
        messages, reads = Messages.of(worlds), self.entry.reads
        if not messages.says_contents:
            return np.full(worlds.n, PIECES[INTENT] not in (reads or ()))
        if reads is None:
            for piece in messages.lacks(neighbour):
                raise InvalidInput(
                    f"feature {self.entry.feature.name!r}: may read everything that a message can contain, but messages"
                    f" of vehicle_{neighbour + 1} do not contain its {piece}; add {piece} to the key v2x.tells of the"
                    " scenario, or list what the feature reads: register_feature(..., reads=['place'])"
                )
            return np.ones(worlds.n, np.bool_)
        known = messages.known_pieces(vehicle, worlds.time_s)[:, neighbour]
        return np.asarray(known[:, [PIECES.index(piece) for piece in reads]].all(axis=1), np.bool_)


class Plan(NamedTuple):
    """All data needed to compute an observation: arguments of compiled functions, and the registered features."""

    scaling: Scaling  # arguments for the built-in features except the contact features
    contacts: Contacts | None  # arguments for the contact features, which follow all other groups; None: none observed
    picked: Ints | None  # [F] columns of the observation among the features of whole groups; None: all columns
    extras: tuple[Extra, ...]  # registered features in the observation

    def observe(self, state: Floats, params: Floats, vehicles: Ints, steps: Floats | None = None) -> Observations:
        """Return the observations of several vehicles, [n, len(vehicles), F] float32.

        If vehicles send periodic messages, a vehicle observes its own estimate of each world (``physics.estimates``).
        Raises ``PhysicsError``, which lists the worlds in which a forecast of impacts failed.
        """
        packed = Packed(state, params)
        if not packed.has_messages:
            return self._observe_present(state, params, vehicles, steps)
        messages = Messages(params[:, packed.column.messages :], packed.column.vehicles)
        says = messages.says_contents
        if not messages.periodic.any():
            return self._observe_present(state, params, vehicles, steps, says=says)
        estimate, seen = np.empty(state.shape), []
        for vehicle in vehicles.tolist():
            estimate_rows(state, params, vehicle, estimate)
            seen.append(self._observe_present(estimate, params, np.array([vehicle]), steps, says=says))
        return np.concatenate(seen, axis=1)

    def _observe_present(
        self, state: Floats, params: Floats, vehicles: Ints, steps: Floats | None, *, says: bool = False
    ) -> Observations:
        """Return the observations, [n, len(vehicles), F], of vehicles that know the present states in ``state``.

        ``says``: whether the scenario restricts what messages contain (``v2x: tells``).
        """
        shape = len(state), len(vehicles)
        whole = np.empty((*shape, self.scaling.features.shape[1]), np.float32)
        _observe_rows(state, params, vehicles, *self.scaling, whole)
        if says:
            _hide_untold(state, params, vehicles, *self.scaling[:3], whole)
        if self.contacts is not None:
            features = np.zeros((*shape, self.contacts.features.shape[1]), np.float32)
            failed = np.zeros(len(state), np.bool_)
            observe_contacts(state, params, vehicles, *self.contacts, features, failed)
            if failed.any():
                reason = f"a forecast of contacts failed before the end of its {FORECAST_S:g} s"
                raise PhysicsError({k: reason for k in np.flatnonzero(failed).tolist()})
            whole = np.concatenate([whole, features], axis=2)
        if self.picked is None:
            return whole
        out: Observations = whole.take(self.picked, axis=2)
        if not self.extras:
            return out
        worlds = Packed(state, params).worlds().read_only()
        for extra, (o, vehicle) in product(self.extras, enumerate(vehicles.tolist())):
            neighbour = vehicle + extra.offset if extra.offset else None
            counts = np.ones(worlds.n, np.bool_) if neighbour is None else whole[:, o, extra.known] == 1.0
            if neighbour is not None and counts.any():
                counts &= extra.known_in(worlds, vehicle, neighbour)
            if counts.any():  # the value of a neighbour's feature is used in worlds where the neighbour is known
                values = extra.entry.checked(worlds, vehicle, neighbour, counts, steps)
            else:  # the neighbour does not exist or is unknown in all worlds
                values = extra.entry.scaled(np.full(worlds.n, extra.entry.unknown))
            out[:, o, extra.column] = values
        return out


@cache
def _plan(spec: ObservationSpec, registered: tuple[tuple[str, RegisteredFeature], ...]) -> Plan:
    whole, entries = spec.whole, dict(registered)
    usual = whole[: len(whole) - spec.contact * len(GROUPS.contact) - spec.far * len(GROUPS.contact_far)]
    offsets = np.array([offset for _, offset in spec.sides], np.int64)
    scaling, contacts = Scaling(offsets, spec.role, spec.obstacle, _scales(usual)), None
    if spec.contact:
        if spec.time_step_s is None:
            raise InvalidInput(
                "observation: features of the groups contact and contact_far need the time between two decisions; pass"
                " time_step_s, for instance eb.choose_observation([...], time_step_s=scenario.time_step_s)"
            )
        inside = [name.partition(".") for name in spec.chosen or (feature.name for feature in spec.whole)]
        names = [own for group, _, own in inside if group in ("contact", "contact_far")]
        wanted = [c for c, each in enumerate(CONTACT_COMMANDS) if any(n.startswith(f"{each}_") for n in names)]
        features = GROUPS.contact + GROUPS.contact_far if spec.far else GROUPS.contact
        contacts = Contacts(spec.time_step_s, np.array(wanted, np.int64), _scales(features))
    if not spec.chosen:
        return Plan(scaling, contacts, None, ())
    place, sides = {feature.name: c for c, feature in enumerate(whole)}, dict(spec.sides)
    extras = []
    for column, name in enumerate(spec.chosen):
        if name not in place:
            side, _, own = name.rpartition(".")
            extras.append(Extra(column, entries[own], sides.get(side, 0), place.get(f"{side}.known", 0)))
    picked = np.array([place.get(name, 0) for name in spec.chosen], np.int64)
    return Plan(scaling, contacts, picked, tuple(extras))


def _scales(features: Sequence[Feature]) -> Floats:
    """Return ``Scaling.features`` for ``features``, [3, F]."""
    return np.array([[1.0 / f.scale for f in features], [f.low for f in features], [f.high for f in features]])


@compiled
def _observe_rows(
    state: Floats, params: Floats, observers: Ints, offsets: Ints, role: bool, with_obstacle: bool, features: Floats,
    out: Observations,
) -> None:  # fmt: skip
    """Write the features of each observer into ``out``, [n, observers, F], group by group.

    The function is one long loop, because it was four times slower when the loop called smaller functions. For the
    arguments from ``offsets`` to ``features``, see ``Scaling``.
    """
    of = columns(state)
    N, speed, command, gap_column, hit, obstacle = of.vehicles, of.speed, of.command, of.gap, of.hit, of.obstacle
    braking, driving, latency, mass, news = of.braking, of.driving, of.latency, of.mass, of.news
    by_link, some_obstacle = params.shape[1] > of.own_latency, state.shape[1] > obstacle
    own_part = of.own_latency if by_link else latency  # column own_part + j has vehicle j's own latency
    value = np.zeros(out.shape[2])
    for k in range(out.shape[0]):
        time = state[k, of.time]
        for o in range(observers.shape[0]):
            i = observers[o]
            own_speed, own_latency = state[k, speed + i], max(params[k, own_part + i] - time, 0.0)
            own_stop = stopping_distance(own_speed, own_latency, params[k, braking + i])
            value[0] = own_speed
            value[1] = state[k, command + i]
            value[2] = params[k, braking + i]
            value[3] = params[k, driving + i]
            value[4] = params[k, mass + i]
            value[5] = own_latency
            value[6] = params[k, of.restitution]
            c = _OWN
            for offset in offsets:
                j = i + offset
                if not (0 <= j < N and time >= params[k, news + i * N + j if by_link else latency + i]):
                    for absent in range(c, c + _NEIGHBOUR):
                        value[absent] = 0.0
                    c += _NEIGHBOUR
                    continue
                gap = 0.0
                for p in range(min(i, j), max(i, j)):
                    gap += state[k, gap_column + p]
                in_front = j < i
                other_speed = state[k, speed + j]
                other_latency = max(params[k, own_part + j] - time, 0.0)
                other_stop = stopping_distance(other_speed, other_latency, params[k, braking + j])
                room = gap + other_stop if in_front else other_stop - gap
                value[c] = 1.0
                value[c + 1] = gap
                value[c + 2] = own_speed - other_speed if in_front else other_speed - own_speed
                value[c + 3] = state[k, command + j]
                value[c + 4] = params[k, braking + j]
                value[c + 5] = params[k, mass + j]
                value[c + 6] = other_latency
                value[c + 7] = state[k, hit + (i - 1 if in_front else i)]
                value[c + 8] = gap + other_stop - own_stop if in_front else gap + own_stop - other_stop
                value[c + 9] = _fitting_deceleration(own_speed, own_latency, room)
                c += _NEIGHBOUR
            if role:
                value[c] = i
                value[c + 1] = N - 1 - i
                c += _ROLE
            if with_obstacle:
                knows = i == 0 or time >= params[k, news + i * N if by_link else latency + i]
                for absent in range(c, c + _OBSTACLE):
                    value[absent] = 0.0
                if knows and some_obstacle and state[k, obstacle] < math.inf:
                    gap = state[k, obstacle]
                    for p in range(i):
                        gap += state[k, gap_column + p]
                    value[c] = 1.0
                    value[c + 1] = gap
                    value[c + 2] = state[k, obstacle + 1]
                    value[c + 3] = gap - own_stop
                    value[c + 4] = _fitting_deceleration(own_speed, own_latency, gap)
            for c in range(out.shape[2]):
                out[k, o, c] = min(max(value[c] * features[0, c], features[1, c]), features[2, c])


@compiled
def _hide_untold(
    state: Floats, params: Floats, observers: Ints, offsets: Ints, role: bool, with_obstacle: bool, out: Observations
) -> None:
    """Set to 0 in ``out`` each feature for which the observer lacks data, because messages do not contain these data.

    If the observer knows no data of a neighbour, all features of this neighbour become 0. An observer knows the
    obstacle only if it knows the place of Vehicle 1.
    """
    of = columns(state)
    N, knows = of.vehicles, np.zeros(len(PIECES), np.bool_)
    for k in range(out.shape[0]):
        messages, time = params[k, of.messages :], state[k, of.time]
        for o in range(observers.shape[0]):
            i, c = observers[o], _OWN
            for offset in offsets:
                if out[k, o, c] == 1.0:
                    for piece in range(len(PIECES)):
                        knows[piece] = knows_piece(messages, N, i, i + offset, piece, time)
                    stops = knows[PLACE] and knows[SPEED] and knows[BRAKING_CAPACITY] and knows[LATENCY]
                    known = (
                        knows.any(), knows[PLACE], knows[SPEED], knows[ACCELERATION], knows[BRAKING_CAPACITY],
                        knows[MASS], knows[LATENCY], knows.any(), stops, stops,
                    )  # fmt: skip
                    for f in range(_NEIGHBOUR):
                        out[k, o, c + f] = out[k, o, c + f] if known[f] else 0.0
                c += _NEIGHBOUR
            c += _ROLE if role else 0
            if with_obstacle and i > 0 and not knows_piece(messages, N, i, 0, PLACE, time):
                out[k, o, c : c + _OBSTACLE] = 0.0


@compiled
def _fitting_deceleration(speed: float, latency_left: float, room: float) -> float:
    """Return the deceleration (m/s2) with which a vehicle stops after the distance ``room`` (m): ``v^2 / (2 b)``.

    Here ``b = room - v tau`` is the distance that is left when the vehicle begins to brake, v is its ``speed`` (m/s)
    and tau the time ``latency_left`` until its brakes act (s). If b is below 1 mm, 1 mm is used instead, and the result
    is at least 20 m/s2, the largest value that a vehicle can observe, unless the speed is below 0.2 m/s. For a vehicle
    at rest the result is 0.
    """
    speed = max(speed, 0.0)
    left = max(room - speed * latency_left, 1e-3)
    return speed * speed / (2.0 * left)
