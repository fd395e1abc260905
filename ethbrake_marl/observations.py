"""Observations: named features with fixed analytic scalings, the same for every vehicle.

An observation is the vehicle's own features followed by those of its nearest neighbours, front ones first. Each
feature is ``clip(value / scale, low, high)``. What this vehicle does not know, or a neighbour that is absent, reads 0
with its ``known`` flag 0. There are no running statistics: an observation means the same in every run. Over a channel
(``v2x``), ``latency_left`` and what follows from it count the own part of a latency only: nobody knows beforehand when
news that has not arrived will.

Where an obstacle stands ahead of Vehicle 1 (``observation_for``), the vehicle's place in the line and what it knows of
the obstacle follow. Vehicle 1 sees it; any other vehicle knows of it as soon as it has Vehicle 1's news.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.events import stopping_distance
from ethbrake_marl.physics.rows import (
    RESTITUTION,
    TIME,
    command_at,
    gap_at,
    has_news,
    pack,
    params_at,
    speed_at,
    state_width,
    vehicles_in,
)
from ethbrake_marl.scenario import Scenario

Observations = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Feature:
    """One number of an observation: ``clip(value / scale, low, high)``."""

    name: str
    unit: str
    scale: float
    low: float
    high: float
    meaning: str


OWN_FEATURES = (
    Feature("speed", "m/s", 20.0, -2.0, 4.0, "own speed"),
    Feature("acceleration", "m/s2", 10.0, -2.0, 2.0, "own command in force"),
    Feature("braking_capacity", "m/s2", 10.0, 0.0, 2.0, "own largest deceleration"),
    Feature("driving_capacity", "m/s2", 10.0, 0.0, 2.0, "own largest forward acceleration"),
    Feature("mass", "t", 10.0, 0.0, 8.0, "own mass"),
    Feature("latency_left", "s", 1.0, 0.0, 4.0, "time until own commands take effect"),
    Feature("restitution", "1", 1.0, 0.0, 1.0, "coefficient of restitution"),
)
NEIGHBOUR_FEATURES = (
    Feature("known", "1", 1.0, 0.0, 1.0, "1 if this neighbour exists and its message has arrived"),
    Feature("gap", "m", 10.0, 0.0, 10.0, "free distance to it, other vehicles between not counted as length"),
    Feature("closing_speed", "m/s", 10.0, -4.0, 4.0, "positive when the two approach"),
    Feature("acceleration", "m/s2", 10.0, -2.0, 2.0, "its command in force"),
    Feature("braking_capacity", "m/s2", 10.0, 0.0, 2.0, "its largest deceleration"),
    Feature("mass", "t", 10.0, 0.0, 8.0, "its mass"),
    Feature("latency_left", "s", 1.0, 0.0, 4.0, "time until its commands take effect"),
    Feature("hit", "1", 1.0, 0.0, 1.0, "1 if the pair on its side has had an impact"),
    Feature("stopping_margin", "m", 10.0, -15.0, 20.0, "gap left at rest if both brake fully as soon as they can"),
    Feature(
        "fitting_deceleration",
        "m/s2",
        10.0,
        0.0,
        2.0,
        "own constant deceleration with which the two would come to rest touching, the neighbour braking fully",
    ),
)

ROLE_FEATURES = (
    Feature("vehicles_ahead", "1", 1.0, 0.0, 2.0, "how many vehicles are ahead in the line; 2 stands for 2 or more"),
    Feature("vehicles_behind", "1", 1.0, 0.0, 2.0, "how many are behind"),
)
OBSTACLE_FEATURES = (
    Feature("known", "1", 1.0, 0.0, 1.0, "1 if there is an obstacle ahead of the line and this vehicle knows of it"),
    Feature("gap", "m", 10.0, 0.0, 10.0, "free distance to it, vehicles between not counted as length"),
    Feature("hit", "1", 1.0, 0.0, 1.0, "1 if Vehicle 1 has had an impact with it"),
    Feature("stopping_margin", "m", 10.0, -15.0, 20.0, "distance left at rest after braking fully as soon as possible"),
    Feature("fitting_deceleration", "m/s2", 10.0, 0.0, 2.0, "own constant deceleration that ends at rest, touching it"),
)

_OWN, _NEIGHBOUR = len(OWN_FEATURES), len(NEIGHBOUR_FEATURES)
_ROLE, _OBSTACLE = len(ROLE_FEATURES), len(OBSTACLE_FEATURES)


@dataclass(frozen=True, slots=True)
class ObservationSpec:
    """How many neighbours an observation holds on each side, and whether its own place and an obstacle follow.

    >>> import ethbrake_marl as eb
    >>> spec = eb.ObservationSpec(front=2, rear=0)
    >>> spec.size, spec.features[7].name
    (27, 'front_1.known')

    """

    front: int = 1  # neighbours ahead, 0 to 64
    rear: int = 1  # neighbours behind
    role: bool = False  # ROLE_FEATURES
    obstacle: bool = False  # OBSTACLE_FEATURES

    def __post_init__(self) -> None:
        """Refuse what is not a number of neighbours."""
        for side, count in (("front", self.front), ("rear", self.rear)):
            if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 0 <= count <= 64:
                raise InvalidInput(f"observation: {side} = {count!r}; must be a whole number in 0..64")
        for name, shown in (("role", self.role), ("obstacle", self.obstacle)):
            if not isinstance(shown, bool):
                raise InvalidInput(f"observation: {name} = {shown!r}; must be True or False")

    @property
    def sides(self) -> tuple[tuple[str, int], ...]:
        """Neighbours as (prefix, offset in the line), front ones first, nearest first."""
        fronts = tuple((f"front_{k}", -k) for k in range(1, self.front + 1))
        return fronts + tuple((f"rear_{k}", k) for k in range(1, self.rear + 1))

    @property
    def features(self) -> tuple[Feature, ...]:
        """Every number of an observation in order; names are unique (``own.speed``, ``front_1.gap``)."""
        groups = [("own", OWN_FEATURES), *((prefix, NEIGHBOUR_FEATURES) for prefix, _ in self.sides)]
        groups += [("role", ROLE_FEATURES)] if self.role else []
        groups += [("obstacle", OBSTACLE_FEATURES)] if self.obstacle else []
        return tuple(
            Feature(f"{prefix}.{f.name}", f.unit, f.scale, f.low, f.high, f.meaning)
            for prefix, group in groups
            for f in group
        )

    @property
    def size(self) -> int:
        """Length F of an observation."""
        further = self.role * len(ROLE_FEATURES) + self.obstacle * len(OBSTACLE_FEATURES)
        return _OWN + (self.front + self.rear) * _NEIGHBOUR + further


def observation_for(scenario: Scenario) -> ObservationSpec:
    """What vehicles observe in this scenario unless somebody says otherwise: one neighbour on each side.

    Where Vehicle 1 has an obstacle ahead, also the own place in the line and the obstacle.
    """
    return ObservationSpec(role=scenario.has_obstacle, obstacle=scenario.has_obstacle)


def observe(worlds: Worlds, vehicle: int, spec: ObservationSpec) -> Observations:
    """Observation of ``vehicle`` (0 = front) in every world, [n, F] float32 in its own memory."""
    if not 0 <= vehicle < worlds.N:
        raise InvalidInput(f"observe: vehicle index {vehicle}; must be in 0..{worlds.N - 1}")
    packed = pack(worlds)
    return observe_packed(packed.state, packed.params, np.array([vehicle]), scaling(spec))[:, 0].copy()


class Scaling(NamedTuple):
    """A specification as the kernel wants it."""

    offsets: Ints  # of the neighbours in the line
    role: bool
    obstacle: bool
    features: Floats  # [3, F] 1 / scale, low, high


@cache
def scaling(spec: ObservationSpec) -> Scaling:
    """Offsets of the neighbours and scaling of every feature, in order; made once, not to be changed."""
    features = spec.features
    return Scaling(
        np.array([offset for _, offset in spec.sides], np.int64),
        spec.role,
        spec.obstacle,
        np.array([[1.0 / f.scale for f in features], [f.low for f in features], [f.high for f in features]]),
    )


def observe_packed(state: Floats, params: Floats, vehicles: Ints, scale: Scaling) -> Observations:
    """Observations of several vehicles in worlds given as rows of ``physics.rows``, [n, len(vehicles), F]."""
    observation = np.empty((len(state), len(vehicles), scale.features.shape[1]), np.float32)
    _observe_rows(state, params, vehicles, *scale, observation)
    return observation


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
