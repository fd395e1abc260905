"""What a vehicle observes: named features with fixed analytic scalings, the same for every vehicle.

An observation is the vehicle's own features followed by those of its nearest neighbours, front ones first. Each
feature is ``clip(value / scale, low, high)``. What this vehicle does not know, or a neighbour that is absent, reads 0
with its ``known`` flag 0. There are no running statistics: an observation means the same in every run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats, Worlds
from ethbrake_marl.v2x import informed

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
    Feature("stopping_margin", "m", 10.0, -5.0, 5.0, "gap left at rest if both brake fully as soon as they can"),
    Feature(
        "fitting_deceleration",
        "m/s2",
        10.0,
        0.0,
        2.0,
        "own constant deceleration with which the two would come to rest touching, the neighbour braking fully",
    ),
)


@dataclass(frozen=True, slots=True)
class ObservationSpec:
    """How many neighbours an observation holds on each side."""

    front: int = 1
    rear: int = 1

    def __post_init__(self) -> None:
        """Refuse negative numbers of neighbours."""
        if not (0 <= self.front <= 64 and 0 <= self.rear <= 64):
            raise InvalidInput(f"observation: front={self.front}, rear={self.rear}; each must be in 0..64")

    @property
    def sides(self) -> tuple[tuple[str, int], ...]:
        """Neighbours as (prefix, offset in the line), front ones first, nearest first."""
        fronts = tuple((f"front_{k}", -k) for k in range(1, self.front + 1))
        return fronts + tuple((f"rear_{k}", k) for k in range(1, self.rear + 1))

    @property
    def features(self) -> tuple[Feature, ...]:
        """Every number of an observation in order; names are unique (``own.speed``, ``front_1.gap``)."""
        groups = [("own", OWN_FEATURES), *((prefix, NEIGHBOUR_FEATURES) for prefix, _ in self.sides)]
        return tuple(
            Feature(f"{prefix}.{f.name}", f.unit, f.scale, f.low, f.high, f.meaning)
            for prefix, group in groups
            for f in group
        )

    @property
    def size(self) -> int:
        """Length F of an observation."""
        return len(OWN_FEATURES) + (self.front + self.rear) * len(NEIGHBOUR_FEATURES)


def observe(worlds: Worlds, vehicle: int, spec: ObservationSpec) -> Observations:
    """Observation of ``vehicle`` (0 = front) in every world, [n, F] float32 in its own memory."""
    if not 0 <= vehicle < worlds.N:
        raise InvalidInput(f"observe: vehicle index {vehicle}; must be in 0..{worlds.N - 1}")
    columns = _own_values(worlds, vehicle)
    known = informed(worlds, vehicle)
    absent = [np.zeros(worlds.n)] * len(NEIGHBOUR_FEATURES)
    for _, offset in spec.sides:
        other = vehicle + offset
        if 0 <= other < worlds.N:
            columns += [np.where(known, value, 0.0) for value in _neighbour_values(worlds, vehicle, other)]
        else:
            columns += absent
    features = spec.features
    observation = np.empty((worlds.n, len(features)), np.float32)
    for k, (feature, column) in enumerate(zip(features, columns, strict=True)):
        observation[:, k] = np.clip(column / feature.scale, feature.low, feature.high)
    return observation


def _own_values(worlds: Worlds, vehicle: int) -> list[Floats]:
    vehicles = worlds.vehicles
    return [
        worlds.speeds_mps[:, vehicle],
        worlds.command_mps2[:, vehicle],
        vehicles.braking_capacity_mps2[:, vehicle],
        vehicles.driving_capacity_mps2[:, vehicle],
        vehicles.mass_t[:, vehicle],
        _latency_left(worlds, vehicle),
        vehicles.restitution,
    ]


def _neighbour_values(worlds: Worlds, vehicle: int, other: int) -> list[Floats]:
    vehicles = worlds.vehicles
    front, rear = min(vehicle, other), max(vehicle, other)
    gap = worlds.gaps_m[:, front:rear].sum(axis=1)
    front_distance, rear_distance = (_stopping_distance(worlds, i) for i in (front, rear))
    own_room = gap + front_distance if vehicle == rear else rear_distance - gap
    return [
        np.ones(worlds.n),
        gap,
        worlds.speeds_mps[:, rear] - worlds.speeds_mps[:, front],
        worlds.command_mps2[:, other],
        vehicles.braking_capacity_mps2[:, other],
        vehicles.mass_t[:, other],
        _latency_left(worlds, other),
        worlds.pair_hit[:, vehicle - 1 if other < vehicle else vehicle].astype(np.float64),
        gap + front_distance - rear_distance,
        _fitting_deceleration(worlds, vehicle, own_room),
    ]


def _latency_left(worlds: Worlds, vehicle: int) -> Floats:
    left: Floats = np.maximum(worlds.vehicles.latency_s[:, vehicle] - worlds.time_s, 0.0)
    return left


def _stopping_distance(worlds: Worlds, vehicle: int) -> Floats:
    """Distance to rest under full braking once the latency has elapsed: ``v tau + v^2 / (2 a)``, 0 if not moving on."""
    speed = np.maximum(worlds.speeds_mps[:, vehicle], 0.0)
    capacity = worlds.vehicles.braking_capacity_mps2[:, vehicle]
    distance: Floats = speed * _latency_left(worlds, vehicle) + speed * speed / (2.0 * capacity)
    return distance


def _fitting_deceleration(worlds: Worlds, vehicle: int, room: Floats) -> Floats:
    """Constant deceleration that uses up exactly ``room`` after the own latency: ``v^2 / (2 (room - v tau))``.

    Where there is no room it reads as the upper clipping bound; at rest it is 0.
    """
    speed = np.maximum(worlds.speeds_mps[:, vehicle], 0.0)
    left = np.maximum(room - speed * _latency_left(worlds, vehicle), 1e-3)
    needed: Floats = speed * speed / (2.0 * left)
    return needed
