"""Observations: named features with fixed analytic scalings, the same for every vehicle.

An observation is the vehicle's own features followed by those of its nearest neighbours, front ones first. Each
feature is ``clip(value / scale, low, high)``. What this vehicle does not know, or a neighbour that is absent, reads 0
with its ``known`` flag 0. There are no running statistics: an observation means the same in every run. Over a channel
(``v2x``), ``latency_left`` and what follows from it count the own part of a latency only: nobody knows beforehand when
news that has not arrived will.

Where an obstacle stands ahead of Vehicle 1 (``observation_for``), the vehicle's place in the line and what it knows of
the obstacle follow. Vehicle 1 sees it; any other vehicle knows of it as soon as it has Vehicle 1's news.

Where an observation lists the group ``contact``, it is followed by what three forecasts say (``observations.contact``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import product
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, PhysicsError, unknown_name
from ethbrake_marl.physics import (
    BOUND,
    CONTACT,
    FLAG,
    ROW,
    Bools,
    Floats,
    Ints,
    Packed,
    Vehicles,
    Worlds,
    columns,
    compiled,
    estimate_rows,
    forecast_contacts,
    place_obstacle,
    stopping_distance,
)
from ethbrake_marl.scenario import (
    CONTACT_COMMANDS,
    CONTACT_SIDES,
    GROUPS,
    MOST_NEIGHBOURS,
    Feature,
    RegisteredFeature,
    Scenario,
    feature_named,
    listed_features,
    registered_in,
    side_of,
)

# The features that an observation holds, in order.


@dataclass(frozen=True, slots=True)
class ObservationSpec:
    """How many neighbours an observation holds on each side, and whether place, obstacle and contacts follow.

    With ``chosen`` it holds these features alone, in this order; ``choose_observation`` makes such a one.

    >>> import ethbrake_marl as eb
    >>> spec = eb.ObservationSpec(front=2, rear=0)
    >>> spec.size, spec.features[7].name
    (27, 'front_1.known')
    >>> eb.choose_observation(["own", "front_1.gap"]).size
    8

    """

    front: int = 1  # neighbours ahead, 0 to 64
    rear: int = 1  # neighbours behind
    role: bool = False  # ROLE_FEATURES
    obstacle: bool = False  # OBSTACLE_FEATURES
    chosen: tuple[str, ...] = ()  # full names; the other fields say how far these look
    contact: bool = False  # CONTACT_FEATURES; those of contact_far must be chosen
    time_step_s: float | None = None  # between two decisions; contact features need it, others do not look at it

    def __post_init__(self) -> None:
        """Refuse what is not a number of neighbours, and features that the rest does not fit."""
        for side, count in (("front", self.front), ("rear", self.rear)):
            whole = isinstance(count, int | np.integer) and not isinstance(count, bool)
            if not whole or not 0 <= count <= MOST_NEIGHBOURS:
                raise InvalidInput(f"observation: {side} = {count!r}; must be a whole number in 0..{MOST_NEIGHBOURS}")
        for name, shown in (("role", self.role), ("obstacle", self.obstacle), ("contact", self.contact)):
            if not isinstance(shown, bool):
                raise InvalidInput(f"observation: {name} = {shown!r}; must be True or False")
        if self.time_step_s is not None and not 0.0 < self.time_step_s < math.inf:
            raise InvalidInput(f"observation: time_step_s = {self.time_step_s!r}; must be a positive number of seconds")
        if self.chosen and _reach(self.chosen) != (self.front, self.rear, self.role, self.obstacle, self.contact):
            raise InvalidInput("observation: chosen: the other fields do not fit; use eb.choose_observation([...])")

    @property
    def sides(self) -> tuple[tuple[str, int], ...]:
        """Neighbours as (prefix, offset in the line), front ones first, nearest first."""
        fronts = tuple((f"front_{k}", -k) for k in range(1, self.front + 1))
        return fronts + tuple((f"rear_{k}", k) for k in range(1, self.rear + 1))

    @property
    def features(self) -> tuple[Feature, ...]:
        """Every number of an observation in order; names are unique (``own.speed``, ``front_1.gap``)."""
        return tuple(feature_named(name) for name in self.chosen) or self.whole

    @property
    def whole(self) -> tuple[Feature, ...]:
        """The same with all built-in features of every group that it looks at."""
        groups = [("own", GROUPS.own), *((prefix, GROUPS.neighbour) for prefix, _ in self.sides)]
        groups += [("role", GROUPS.role)] if self.role else []
        groups += [("obstacle", GROUPS.obstacle)] if self.obstacle else []
        groups += [("contact", GROUPS.contact)] if self.contact else []
        groups += [("contact_far", GROUPS.contact_far)] if self.far else []
        return tuple(
            Feature(f"{prefix}.{f.name}", f.unit, f.scale, f.low, f.high, f.meaning)
            for prefix, group in groups
            for f in group
        )

    @property
    def far(self) -> bool:
        """Whether any of GROUPS.contact_far is chosen."""
        return any(name.startswith("contact_far.") for name in self.chosen)

    @property
    def size(self) -> int:
        """Length F of an observation."""
        further = self.role * len(GROUPS.role) + self.obstacle * len(GROUPS.obstacle)
        further += self.contact * len(GROUPS.contact)
        return len(self.chosen) or len(GROUPS.own) + (self.front + self.rear) * len(GROUPS.neighbour) + further

    @property
    def plan(self) -> Plan:
        """Offsets of the neighbours and scaling of every feature, in order; what is picked, and what is added.

        Made once for each specification, not to be changed. Raises ``InvalidInput`` for contact features without a
        time step.
        """
        return _plan(self, tuple(registered_in(self.chosen).items()) if self.chosen else ())

    def at_steps_of(self, time_step_s: float) -> ObservationSpec:
        """The same for decisions every ``time_step_s`` (s), where it needs to know and does not say so itself."""
        return replace(self, time_step_s=time_step_s) if self.contact and self.time_step_s is None else self


Observation = ObservationSpec | Sequence[str] | Mapping[str, Any]  # or a list of groups and features, or the fields


def choose_observation(listed: Observation, time_step_s: float | None = None) -> ObservationSpec:
    """The observation of a list of groups and single features: ``[own, front_1, rear_1.gap, my_feature]``.

    A mapping names the fields of an ``ObservationSpec``, which is what JSON makes of one. ``time_step_s`` (s) is the
    time between two decisions; an environment knows its own, so only who observes without one gives it, for contact
    features. Raises ``UnknownName`` with a suggestion, ``InvalidInput`` for what is no such list.
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
            raise InvalidInput(f"observation: chosen = {chosen!r}; must be a list of features")
        spec = ObservationSpec(**{**listed, "chosen": listed_features(chosen) if chosen else ()})
    else:
        names = listed_features(listed)
        front, rear, role, obstacle, contact = _reach(names)
        spec = ObservationSpec(front, rear, role, obstacle, contact=contact)
        if tuple(feature.name for feature in spec.features) != names:
            spec = replace(spec, chosen=names)
    return spec if time_step_s is None else spec.at_steps_of(time_step_s)


def _reach(names: Sequence[str]) -> tuple[int, int, bool, bool, bool]:
    """How far features look: neighbours in front and behind, the own place, the obstacle, contacts."""
    sides = [side for name in names if (side := side_of(name)) is not None]
    front, rear = (max((k for at, k in sides if at == wanted), default=0) for wanted in ("front", "rear"))
    groups = {name.partition(".")[0] for name in names}
    return front, rear, "role" in groups, "obstacle" in groups, bool(groups & {"contact", "contact_far"})


def observation_for(scenario: Scenario) -> ObservationSpec:
    """What vehicles observe in this scenario unless somebody says otherwise: what it declares.

    Where it declares nothing: one neighbour on each side; where Vehicle 1 has an obstacle ahead, also the own place in
    the line and the obstacle.
    """
    if scenario.observation is not None:
        return choose_observation(scenario.observation, scenario.time_step_s)
    return ObservationSpec(role=scenario.has_obstacle, obstacle=scenario.has_obstacle)


# The contact features: what three forecasts of the vehicle's own command say of its next impacts.
#
# The vehicle looks at the part of the line around it whose news it has, as its other features tell it. It goes on, once
# its own latency has elapsed, with full braking, coasting or full driving. Every other vehicle of that part goes on
# with the command that is observed of it; one of which none is in force brakes fully as soon as its latency has
# elapsed.

FORECAST_S = 10.0  # how far the forecasts look; also the time to an impact that never comes
_OF_PAIR, _HARMS = 4, 2  # numbers of each pair; of the line
_OF_COMMAND = len(CONTACT_SIDES) * _OF_PAIR + _HARMS
_NEAR = len(CONTACT_COMMANDS) * _OF_COMMAND  # columns of contact; behind them are those of contact_far
_FAR = len(CONTACT_SIDES) + _HARMS  # numbers of contact_far for each command


class Contacts(NamedTuple):
    """Which contact features are wanted, and how they are scaled."""

    time_step_s: float  # between two decisions
    commands: Ints  # those to forecast, as places in CONTACT_COMMANDS
    features: Floats  # [3, 30], with far [3, 42]: 1 / scale, low, high of every contact feature


@compiled
def _observe_contacts(
    state: Floats, params: Floats, observers: Ints, time_step: float, commands: Ints, features: Floats,
    out: NDArray[np.float32], failed: Bools,
) -> None:  # fmt: skip
    """Fill ``out``, and ``failed`` [n] where a check of the kernel failed."""
    of = columns(state)
    N, at = (
        of.vehicles,
        1 if state.shape[1] > of.obstacle else 0,
    )  # vehicle i stands in column at + i, behind an obstacle
    line, table = np.zeros((ROW.OF_SEGMENT, N + at)), np.zeros((ROW.OF_SEGMENT, N + at))
    found, value = np.zeros((CONTACT.WIDTH, N + at)), np.zeros(_OF_COMMAND + _FAR)
    for k in range(out.shape[0]):
        for o in range(observers.shape[0]):
            i = observers[o]
            first, last = _place_known(line, state, params, k, i, at)
            for c in commands:
                for j in range(N + at):
                    for row in (ROW.SPEED, ROW.COMMAND, ROW.MASS, ROW.LIMIT, ROW.ONSET, ROW.GAP, ROW.HIT):
                        table[row, j] = line[row, j]
                table[ROW.COMMAND, at + i] = 0.0
                if c == 0:
                    table[ROW.COMMAND, at + i] = -params[k, of.braking + i]
                elif c == 2:
                    table[ROW.COMMAND, at + i] = params[k, of.driving + i]
                if forecast_contacts(table, params[k, of.restitution], FORECAST_S, found) != FLAG.DONE:
                    failed[k] = True
                    break
                _tell(table, found, at + i, first, last, time_step, value)
                for f in range(_OF_COMMAND + _FAR if out.shape[2] > _NEAR else _OF_COMMAND):
                    column = c * _OF_COMMAND + f if f < _OF_COMMAND else _NEAR + c * _FAR + f - _OF_COMMAND
                    scaled = value[f] * features[0, column]
                    out[k, o, column] = min(max(scaled, features[1, column]), features[2, column])


@compiled
def _place_known(table: Floats, state: Floats, params: Floats, k: int, i: int, at: int) -> tuple[int, int]:
    """Write world k, as vehicle i knows it, into a table; its first and last columns that are known.

    Whoever is not known stands far away. Where an obstacle is known, it is the first column.
    """
    of = columns(state)
    N, speed, command, gap, obstacle = of.vehicles, of.speed, of.command, of.gap, of.obstacle
    braking, latency, mass, limit, news = of.braking, of.latency, of.mass, of.limit, of.news
    by_link, time = params.shape[1] > of.own_latency, state[k, of.time]
    own_part = of.own_latency if by_link else latency
    first, last = i, i
    while first > 0 and time >= params[k, news + i * N + first - 1 if by_link else latency + i]:
        first -= 1
    while last < N - 1 and time >= params[k, news + i * N + last + 1 if by_link else latency + i]:
        last += 1
    for j in range(N):
        known = first <= j <= last
        in_force = state[k, command + j]
        table[ROW.SPEED, at + j] = state[k, speed + j] if known else 0.0
        table[ROW.MASS, at + j] = params[k, mass + j]
        table[ROW.LIMIT, at + j] = params[k, limit + j]
        table[ROW.ONSET, at + j] = 0.0
        table[ROW.COMMAND, at + j] = in_force if known else 0.0
        if j == i or in_force == 0.0:
            table[ROW.ONSET, at + j] = max(params[k, own_part + j] - time, 0.0)
            table[ROW.COMMAND, at + j] = -params[k, braking + j] if known else 0.0
        if j < N - 1:
            table[ROW.GAP, at + j] = state[k, gap + j] if first <= j < last else BOUND.FAR_AWAY_M
            table[ROW.HIT, at + j] = state[k, gap + N - 1 + j]
    if at == 1:
        seen = first == 0 and state[k, obstacle] < math.inf
        place_obstacle(table, state[k, obstacle] if seen else BOUND.FAR_AWAY_M, state[k, obstacle + 1])
        return (0 if seen else 1 + first), 1 + last
    return first, last


@compiled
def _tell(table: Floats, found: Floats, own: int, first: int, last: int, time_step: float, value: Floats) -> None:
    """The numbers of one forecast before scaling; 0 for a pair whose other vehicle is not known, or not there.

    An impact at the very end of a decision step belongs to that step, as in the engine.
    """
    for side in range(2):
        p, at = own - 1 + side, side * _OF_PAIR
        if not first <= p < last:
            for f in range(_OF_PAIR):
                value[at + f] = 0.0
            continue
        time = found[CONTACT.TIME, p]
        met = time < math.inf
        steps = (time if met else FORECAST_S) / time_step
        whole = max(math.ceil(steps) - 1.0, 0.0)
        value[at] = time if met else FORECAST_S
        value[at + 1] = found[CONTACT.CLOSING, p]
        value[at + 2] = steps - whole if met else 0.0
        value[at + 3] = whole
    first_harm, total_harm = 0.0, 0.0
    for p in range(first, last):
        first_harm += table[ROW.FIRST_HARM, p]
        total_harm += table[ROW.TOTAL_HARM, p]
    value[2 * _OF_PAIR] = first_harm
    value[2 * _OF_PAIR + 1] = total_harm
    value[_OF_COMMAND], value[_OF_COMMAND + 1] = value[0], value[_OF_PAIR]
    value[_OF_COMMAND + 2], value[_OF_COMMAND + 3] = math.sqrt(first_harm), math.sqrt(total_harm)


# From worlds to observations: compiled loops over the built-in features, then the functions of registered ones.

Observations = NDArray[np.float32]

_OWN, _NEIGHBOUR = len(GROUPS.own), len(GROUPS.neighbour)
_ROLE, _OBSTACLE = len(GROUPS.role), len(GROUPS.obstacle)


def observe(worlds: Worlds, vehicle: int, spec: ObservationSpec) -> Observations:
    """Observation of ``vehicle`` (0 = front) in every world, [n, F] float32 in its own memory."""
    if not 0 <= vehicle < worlds.N:
        raise InvalidInput(f"observe: vehicle index {vehicle}; must be in 0..{worlds.N - 1}")
    packed = Packed.of(worlds)
    return spec.plan.observe(packed.state, packed.params, np.array([vehicle]))[:, 0].copy()


class Scaling(NamedTuple):
    """The groups of a specification as the kernel wants them."""

    offsets: Ints  # of the neighbours in the line
    role: bool
    obstacle: bool
    features: Floats  # [3, F] 1 / scale, low, high


class Extra(NamedTuple):
    """A registered feature in an observation."""

    column: int
    entry: RegisteredFeature
    offset: int  # of the neighbour in the line; 0: its own
    known: int  # column of the neighbour's ``known`` in the whole groups


class Plan(NamedTuple):
    """How an observation is made: by kernels, which fill whole groups, and by functions of registered features."""

    scaling: Scaling
    contacts: Contacts | None  # their group is the last one; None: it holds none
    picked: Ints | None  # [F] columns of the whole groups; None: all of them
    extras: tuple[Extra, ...]

    def observe(self, state: Floats, params: Floats, vehicles: Ints, steps: Floats | None = None) -> Observations:
        """Observations of several vehicles in worlds given as rows of ``physics.batch``, [n, len(vehicles), F].

        ``steps`` [n] is how many steps each world has made, for error texts. Over a channel of periodic messages a
        vehicle sees the worlds as it takes them to be (``physics.messages``). Contact features of commands that are
        not wanted are 0. Raises ``PhysicsError`` naming the worlds in which a forecast of contacts failed.
        """
        if not Packed(state, params).has_messages:
            return self._observe_present(state, params, vehicles, steps)
        estimate, seen = np.empty(state.shape), []
        for vehicle in vehicles.tolist():
            estimate_rows(state, params, vehicle, estimate)
            seen.append(self._observe_present(estimate, params, np.array([vehicle]), steps))
        return np.concatenate(seen, axis=1)

    def _observe_present(self, state: Floats, params: Floats, vehicles: Ints, steps: Floats | None) -> Observations:
        """The same where everything known is known as it is."""
        shape = len(state), len(vehicles)
        whole = np.empty((*shape, self.scaling.features.shape[1]), np.float32)
        _observe_rows(state, params, vehicles, *self.scaling, whole)
        if self.contacts is not None:
            found = np.zeros((*shape, self.contacts.features.shape[1]), np.float32)
            failed = np.zeros(len(state), np.bool_)
            _observe_contacts(state, params, vehicles, *self.contacts, found, failed)
            if failed.any():
                reason = f"a forecast of contacts could not look {FORECAST_S:g} s ahead"
                raise PhysicsError({k: reason for k in np.flatnonzero(failed).tolist()})
            whole = np.concatenate([whole, found], axis=2)
        if self.picked is None:
            return whole
        out: Observations = whole.take(self.picked, axis=2)
        if not self.extras:
            return out
        worlds = Packed(state, params).worlds().read_only()
        for extra, (o, vehicle) in product(self.extras, enumerate(vehicles.tolist())):
            neighbour = vehicle + extra.offset if extra.offset else None
            counts = np.ones(worlds.n, np.bool_) if neighbour is None else whole[:, o, extra.known] == 1.0
            if counts.any():  # one of a neighbour tells where the kernel says that it is known
                values = extra.entry.checked(worlds, vehicle, neighbour, counts, steps)
            else:  # nobody is there, or nobody is heard
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
                "observation: contact features need the time between two decisions; give it as time_step_s, for"
                " instance eb.choose_observation([...], time_step_s=scenario.time_step_s)"
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
    """1 / scale, low, high of every feature, [3, F]."""
    return np.array([[1.0 / f.scale for f in features], [f.low for f in features], [f.high for f in features]])


@compiled
def _observe_rows(
    state: Floats, params: Floats, observers: Ints, offsets: Ints, role: bool, with_obstacle: bool, features: Floats,
    out: Observations,
) -> None:  # fmt: skip
    """Fill ``out`` with the clipped features of each observer, in the order of the lists of features above.

    One long loop on purpose: handing these arrays on to functions made it four times as slow.
    """
    of = columns(state)
    N, speed, command, gap_column, hit, obstacle = of.vehicles, of.speed, of.command, of.gap, of.hit, of.obstacle
    braking, driving, latency, mass, news = of.braking, of.driving, of.latency, of.mass, of.news
    by_link, some_obstacle = params.shape[1] > of.own_latency, state.shape[1] > obstacle
    own_part = of.own_latency if by_link else latency  # of vehicle j's latency: own_part + j
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
                told = i == 0 or time >= params[k, news + i * N if by_link else latency + i]
                for absent in range(c, c + _OBSTACLE):
                    value[absent] = 0.0
                if told and some_obstacle and state[k, obstacle] < math.inf:
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
def _fitting_deceleration(speed: float, latency_left: float, room: float) -> float:
    """Constant deceleration that uses up exactly ``room`` after the own latency: ``v^2 / (2 (room - v tau))``.

    Room below 1 mm counts as 1 mm. Without room it therefore reads as the upper clipping bound (20 m/s2) from 0.2 m/s
    on, and lower for a slower vehicle; at rest it is 0.
    """
    speed = max(speed, 0.0)
    left = max(room - speed * latency_left, 1e-3)
    return speed * speed / (2.0 * left)


# The full state of a line as one vector, for centralised critics: all vehicles, all pairs, the time.
#
# It reuses the features of ``observations`` and hides nothing: no latency keeps a value from a critic. Rows of learners
# may end with it, or with the learner's place among the learners (``appended``).

Appended = Literal["number", "state"]  # what a row holds behind the vehicle's own observation

_OWN_ONLY = ObservationSpec(front=0, rear=0)
_PAIR_MEANING = {"gap": "free distance between the two", "hit": "1 if the pair has had an impact"}
_OBSTACLE_FEATURES = tuple(
    replace(f, name=f"obstacle.{f.name}", meaning=meaning)
    for f in GROUPS.obstacle
    for name, meaning in (("gap", "distance from Vehicle 1 to the obstacle"), ("hit", f.meaning))
    if f.name == name
)
_PAIR_FEATURES = tuple(replace(f, meaning=_PAIR_MEANING[f.name]) for f in GROUPS.neighbour if f.name in _PAIR_MEANING)


def state_features(scenario: Scenario) -> tuple[Feature, ...]:
    """Every number of the state in order: each vehicle's own features, each pair's gap and hit flag, the time.

    Where there is an obstacle ahead of Vehicle 1, its gap and hit flag follow.
    """
    vehicles = [replace(f, name=f"{name}.{f.name}") for name in scenario.vehicle_names for f in GROUPS.own]
    pairs = [replace(f, name=f"pair_{p}.{f.name}") for p in range(1, scenario.vehicles) for f in _PAIR_FEATURES]
    time = Feature("time", "s", scenario.horizon_s, 0.0, 1.0, "time since Vehicle 1 began to brake; scale: the horizon")
    obstacle = _OBSTACLE_FEATURES if scenario.has_obstacle else ()
    return (*vehicles, *pairs, time, *obstacle)


def full_state(worlds: Worlds, scenario: Scenario) -> Observations:
    """State of every world, [n, S] float32 in its own memory; S = 7 N + 2 P + 1, and 2 more with an obstacle ahead."""
    latency = worlds.vehicles.latency_s  # whole, with what a channel has drawn
    whole_latency = replace(worlds.vehicles, own_latency_s=latency, known_from_s=Vehicles.known_at_once(latency))
    vehicles = [observe(replace(worlds, vehicles=whole_latency), i, _OWN_ONLY) for i in range(worlds.N)]
    pair_values = {"gap": worlds.gaps_m, "hit": worlds.pair_hit.astype(np.float64)}
    columns = [pair_values[f.name][:, p] for p in range(worlds.N - 1) for f in _PAIR_FEATURES]
    columns.append(worlds.time_s)
    if scenario.has_obstacle:
        columns += [worlds.obstacle_gap_m, worlds.obstacle_hit.astype(np.float64)]
    features = state_features(scenario)[-len(columns) :]
    rest = [np.clip(c / f.scale, f.low, f.high) for c, f in zip(columns, features, strict=True)]
    return np.concatenate([*vehicles, np.stack(rest, axis=1)], axis=1, dtype=np.float32)


def row_features(own: tuple[Feature, ...], appended: Appended | None, scenario: Scenario) -> tuple[Feature, ...]:
    """Every number of a learner's row in order; raises ``InvalidInput`` for another word than ``Appended`` has."""
    if appended not in (None, *get_args(Appended)):
        raise InvalidInput(f"appended = {appended!r}: must be {' or '.join(get_args(Appended))}, or None")
    if appended is None:
        return own
    if appended == "state":
        return (*own, *state_features(scenario))
    last = len(scenario.learners) - 1
    return (*own, Feature("learner", "1", 1.0, 0.0, float(max(last, 1)), "the learner's place among the learners"))


def appending(appended: Appended, scenario: Scenario) -> Callable[[Worlds, int], Observations]:
    """What stands behind the own observation of one learner, from worlds and vehicle: [n, features]."""

    def number(worlds: Worlds, vehicle: int) -> Observations:
        if vehicle not in scenario.learners:
            raise InvalidInput(f"appended = 'number': vehicle_{vehicle + 1} is no learner of {scenario.name!r}")
        return np.full((worlds.n, 1), scenario.learners.index(vehicle), np.float32)

    return number if appended == "number" else lambda worlds, _: full_state(worlds, scenario)
