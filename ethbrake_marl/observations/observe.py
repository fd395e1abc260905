"""From worlds to observations: compiled loops over the built-in features, then the functions of registered ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations.contact import Contacts, contacts_of, observe_contacts
from ethbrake_marl.observations.spec import ObservationSpec
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.estimates import estimate_rows
from ethbrake_marl.physics.events import stopping_distance
from ethbrake_marl.physics.rows import (
    RESTITUTION,
    TIME,
    Packed,
    command_at,
    gap_at,
    has_messages,
    has_news,
    pack,
    params_at,
    speed_at,
    state_width,
    unpack,
    vehicles_in,
)
from ethbrake_marl.physics.worlds import read_only
from ethbrake_marl.scenario.features import (
    CONTACT_FAR_FEATURES,
    CONTACT_FEATURES,
    NEIGHBOUR_FEATURES,
    OBSTACLE_FEATURES,
    OWN_FEATURES,
    ROLE_FEATURES,
    RegisteredFeature,
    registered_in,
)
from ethbrake_marl.scenario.registered_features import checked_values

Observations = NDArray[np.float32]

_OWN, _NEIGHBOUR = len(OWN_FEATURES), len(NEIGHBOUR_FEATURES)
_ROLE, _OBSTACLE = len(ROLE_FEATURES), len(OBSTACLE_FEATURES)


def observe(worlds: Worlds, vehicle: int, spec: ObservationSpec) -> Observations:
    """Observation of ``vehicle`` (0 = front) in every world, [n, F] float32 in its own memory."""
    if not 0 <= vehicle < worlds.N:
        raise InvalidInput(f"observe: vehicle index {vehicle}; must be in 0..{worlds.N - 1}")
    packed = pack(worlds)
    return observe_packed(packed.state, packed.params, np.array([vehicle]), plan_of(spec))[:, 0].copy()


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


def plan_of(spec: ObservationSpec) -> Plan:
    """Offsets of the neighbours and scaling of every feature, in order; what is picked, and what is added.

    Made once for each specification, not to be changed.
    """
    return _plan(spec, tuple(registered_in(spec.chosen).items()) if spec.chosen else ())


@cache
def _plan(spec: ObservationSpec, registered: tuple[tuple[str, RegisteredFeature], ...]) -> Plan:
    whole, entries = spec.whole, dict(registered)
    usual = whole[: len(whole) - spec.contact * len(CONTACT_FEATURES) - spec.far * len(CONTACT_FAR_FEATURES)]
    scaling = Scaling(
        np.array([offset for _, offset in spec.sides], np.int64),
        spec.role,
        spec.obstacle,
        np.array([[1.0 / f.scale for f in usual], [f.low for f in usual], [f.high for f in usual]]),
    )
    contacts = _contacts(spec) if spec.contact else None
    if not spec.chosen:
        return Plan(scaling, contacts, None, ())
    place, offsets = {feature.name: c for c, feature in enumerate(whole)}, dict(spec.sides)
    extras = []
    for column, name in enumerate(spec.chosen):
        if name not in place:
            side, _, own = name.rpartition(".")
            extras.append(Extra(column, entries[own], offsets.get(side, 0), place.get(f"{side}.known", 0)))
    picked = np.array([place.get(name, 0) for name in spec.chosen], np.int64)
    return Plan(scaling, contacts, picked, tuple(extras))


def _contacts(spec: ObservationSpec) -> Contacts:
    inside = (name.partition(".") for name in spec.chosen or (feature.name for feature in spec.whole))
    names = {own for group, _, own in inside if group in ("contact", "contact_far")}
    return contacts_of(names, spec.time_step_s, far=spec.far)


def observe_packed(
    state: Floats, params: Floats, vehicles: Ints, plan: Plan, steps: Floats | None = None
) -> Observations:
    """Observations of several vehicles in worlds given as rows of ``physics.rows``, [n, len(vehicles), F].

    ``steps`` [n] is how many steps each world has made, for error texts. Over a channel of periodic messages a vehicle
    sees the worlds as it takes them to be (``physics.estimates``).
    """
    if not has_messages(state, params):
        return _observe_present(state, params, vehicles, plan, steps)
    estimate, seen = np.empty(state.shape), []
    for vehicle in vehicles.tolist():
        estimate_rows(state, params, vehicle, estimate)
        seen.append(_observe_present(estimate, params, np.array([vehicle]), plan, steps))
    return np.concatenate(seen, axis=1)


def _observe_present(state: Floats, params: Floats, vehicles: Ints, plan: Plan, steps: Floats | None) -> Observations:
    """The same where everything known is known as it is."""
    whole = np.empty((len(state), len(vehicles), plan.scaling.features.shape[1]), np.float32)
    _observe_rows(state, params, vehicles, *plan.scaling, whole)
    if plan.contacts is not None:
        whole = np.concatenate([whole, observe_contacts(state, params, vehicles, plan.contacts)], axis=2)
    if plan.picked is None:
        return whole
    observation: Observations = whole.take(plan.picked, axis=2)
    if plan.extras:
        _add_extras(observation, whole, read_only(unpack(Packed(state, params))), vehicles, plan.extras, steps)
    return observation


def _add_extras(
    out: Observations, whole: Observations, worlds: Worlds, vehicles: Ints, extras: Sequence[Extra],
    steps: Floats | None,
) -> None:  # fmt: skip
    """Fill the columns of registered features; one of a neighbour tells where the kernel says that it is known."""
    for extra in extras:
        for o, vehicle in enumerate(vehicles.tolist()):
            neighbour = vehicle + extra.offset if extra.offset else None
            counts = np.ones(worlds.n, np.bool_) if neighbour is None else whole[:, o, extra.known] == 1.0
            if counts.any():
                values = checked_values(extra.entry, worlds, vehicle, neighbour, counts, steps)
            else:  # nobody is there, or nobody is heard
                values = extra.entry.scaled(np.full(worlds.n, extra.entry.unknown))
            out[:, o, extra.column] = values


@compiled
def _observe_rows(  # noqa: C901
    state: Floats, params: Floats, observers: Ints, offsets: Ints, role: bool, with_obstacle: bool, features: Floats,
    out: Observations,
) -> None:  # fmt: skip
    """Fill ``out`` with the clipped features of each observer, in the order of the lists of features above.

    One long loop on purpose: handing these arrays on to functions made it four times as slow.
    """
    N = vehicles_in(state)
    speed, command, gap_column = speed_at(N), command_at(N), gap_at(N)
    hit = gap_column + N - 1
    braking, driving, latency, mass = params_at(0, N), params_at(1, N), params_at(2, N), params_at(3, N)
    news, obstacle = params_at(6, N), state_width(N)
    by_link, some_obstacle = has_news(params, N), state.shape[1] > obstacle
    own_part = params_at(5, N) if by_link else latency  # of vehicle j's latency: own_part + j
    value = np.zeros(out.shape[2])
    for k in range(out.shape[0]):
        time = state[k, TIME]
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
            value[6] = params[k, RESTITUTION]
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
