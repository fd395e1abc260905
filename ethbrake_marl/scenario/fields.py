"""Fields of a scenario: the quantities of a world and how they are drawn, roles, and types of vehicles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.files.model import UNITS
from ethbrake_marl.physics.state import Floats, Worlds

BLOCK = 8  # uniform numbers per vehicle and world; a multiple of 4, the numbers of one Philox counter

V2X_NEWS = (1,)  # the stream of the links' delays and losses

OBSTACLE = (2,)  # the stream of the obstacle's distance

TYPES = (3,)  # the stream of the vehicles' types and loads

MIXTURE = (4,)  # the stream of what each world of a mixture is drawn from

LATER_LOSSES = (5,)  # the stream of a world's key, from which its later messages are lost or not

SURROUNDINGS = (6,)  # the stream of friction, of the row of a table, and of the time before the alert

BRAKES = (7,)  # the stream of the rates of brakes that build up, BLOCK numbers per vehicle

OF_WORLD = 4  # numbers per world of the streams of obstacle, mixture, later losses and surroundings

PER_TYPE = 4  # numbers per vehicle of the stream of types: type, load, and two that are free; one Philox counter

ROW = (SURROUNDINGS, 1)  # the place of the number that chooses the row of a table

Place = tuple[tuple[int, ...], int]  # a stream of uniform numbers, and the column in it


@dataclass(frozen=True, slots=True)
class QuantityRule:
    """What a quantity means and which values it may take."""

    name: str  # key in a scenario, field of Worlds or Vehicles
    unit: str  # key of UNITS, or "" for a plain number
    per: Literal["vehicle", "pair", "world"]
    high: float  # largest allowed value
    positive: bool  # 0 is refused
    slot: int  # column inside a vehicle's block of uniform numbers
    column: str  # name in a table of initial states
    meaning: str
    example: str
    low: float = 0.0  # smallest allowed value
    block: int = 0  # vehicle (from 0) in whose block of uniform numbers entry 0 stands
    stream: tuple[int, ...] = ()  # of uniform numbers of its own, in which its slot is the column

    @property
    def symbol(self) -> str:
        """Of its unit."""
        return {"mps": "m/s", "mps2": "m/s2", "mps3": "m/s3"}.get(self.unit, self.unit)

    @property
    def label(self) -> str:
        """Its name in words, with its unit, as an axis has it: ``braking capacity (m/s²)``."""
        return self.name.removesuffix(f"_{self.unit}").replace("_", " ") + (
            f" ({self.symbol.replace('s2', 's²').replace('s3', 's³')})" if self.unit else ""
        )

    @property
    def interval(self) -> str:
        """The allowed range, with its unit, as messages write it."""
        unit = f" {self.symbol} ({UNITS[self.unit]})" if self.unit else ""
        return f"finite and in {'(' if self.positive else '['}{self.low:g}, {self.high:g}]{unit}"

    def allows(self, low: float, high: float) -> bool:
        """Whether every value from ``low`` to ``high`` is in range; false for NaN."""
        return (low > 0.0 if self.positive else low >= self.low) and high <= self.high

    def count(self, vehicles: int) -> int:
        """How many values a world of ``vehicles`` vehicles has."""
        return {"vehicle": vehicles, "pair": vehicles - 1, "world": 1}[self.per]

    def place(self, index: int) -> Place:
        """Which of a world's uniform numbers belongs to entry ``index`` (from 0)."""
        return self.stream, BLOCK * (self.block + index) + self.slot

    def column_of(self, index: int) -> str:
        """Name of the column that holds entry ``index`` (from 0) in a table of initial states."""
        return self.column.format(index + 1)

    def owner(self, index: int) -> str:
        """Whose value entry ``index`` (from 0) is, in words; empty for a value of the whole world."""
        front = f"vehicle_{index + 1}"
        return {"vehicle": front, "pair": f"{front} to vehicle_{index + 2}", "world": ""}[self.per]

    def of(self, worlds: Worlds) -> Floats:
        """The values that these worlds have, [n, entries]: one entry per vehicle, pair or world.

        Capacities are those on a dry road, as a scenario declares them, where the friction of all is told beside them.
        """
        of_vehicles = hasattr(worlds.vehicles, self.name)
        values: Floats = getattr(worlds.vehicles if of_vehicles else worlds, self.name)
        if of_vehicles and np.isfinite(worlds.friction).all():
            values = worlds.dry(self.name)
        if self.stream == BRAKES:  # as high as a rate can be declared: at once
            values = np.minimum(values, self.high)
        if self.stream == OBSTACLE:  # no number where there is none
            values = np.where(np.isfinite(values), values, np.nan)
        return values.reshape(worlds.n, -1)


class Quantities(NamedTuple):
    """All quantities by their keys."""

    usual: dict[str, QuantityRule]  # what every world has
    otherwise: dict[str, QuantityRule]  # other ways to declare speeds, gaps and an obstacle
    optional: dict[str, QuantityRule]  # what a world need not have; it has a stream of random numbers of its own
    # A scenario has exactly one of each two, or at most one where what they declare is optional.
    alternatives: dict[str, str]
    of_a_type: tuple[str, ...]  # what a type of vehicles may declare
    needed: tuple[str, ...]  # what has no default, and every vehicle needs
    declared: dict[str, QuantityRule]  # every key that declares one

    def of(self, worlds: Worlds) -> dict[str, QuantityRule]:
        """Those that these worlds have: friction only where all have such.

        The distance to an obstacle, and a rate of brakes, are told of all where some have one: the former is NaN
        where there is no obstacle.
        """
        there = {"obstacle_gap_m": worlds.obstacle_ahead.any(), "friction": np.isfinite(worlds.friction).all()}
        there |= {key: np.isfinite(getattr(worlds.vehicles, key)).any() for key in self.optional if key not in there}
        return self.usual | {key: rule for key, rule in self.optional.items() if there[key]}

    def columns(self, worlds: Worlds) -> dict[str, Floats]:
        """Every one of the worlds, each [n], named as in a table of initial states: ``gap_1_m``, ``mass_2_t``."""
        return {
            rule.column_of(i): values for rule in self.of(worlds).values() for i, values in enumerate(rule.of(worlds).T)
        }


def _by_name(*rules: QuantityRule) -> dict[str, QuantityRule]:
    return {rule.name: rule for rule in rules}


# The upper ends are far outside traffic: they catch a value in the wrong unit (kilograms, kilometres per hour).
# The slots are fixed for ever: another order would give other worlds for the same seed.
_USUAL = _by_name(
    QuantityRule(
        "gaps_m", "m", "pair", 1e4, False, 0, "gap_{}_m",
        "bumper-to-bumper gap of each pair at the alert, front to rear", "[7, 7]",
    ),
    QuantityRule(
        "speeds_mps", "mps", "vehicle", 200.0, False, 1, "speed_{}_mps",
        "speed of each vehicle at the alert", "[20, 18, 20]",
    ),
    QuantityRule(
        "braking_capacity_mps2", "mps2", "vehicle", 100.0, True, 2, "braking_capacity_{}_mps2",
        "largest deceleration of each vehicle", "[6, 7, 6]",
    ),
    QuantityRule(
        "driving_capacity_mps2", "mps2", "vehicle", 100.0, False, 3, "driving_capacity_{}_mps2",
        "largest forward acceleration of each vehicle", "[6, 7, 6]",
    ),
    QuantityRule(
        "latency_s", "s", "vehicle", 3600.0, False, 4, "latency_{}_s",
        "time from the alert until a vehicle's commands take effect; it coasts until then", "[0, 0.5, 0.8]",
    ),
    QuantityRule(
        "mass_t", "t", "vehicle", 1000.0, True, 5, "mass_{}_t",
        "mass of each vehicle", "[4.5, 5.5, 5.9]",
    ),
    QuantityRule(
        "speed_limit_mps", "mps", "vehicle", 200.0, True, 6, "speed_limit_{}_mps",
        "speed at which driving stops accelerating", "40",
    ),
    QuantityRule(
        "restitution", "", "world", 1.0, False, 7, "restitution",
        "coefficient of restitution of every impact: 0 plastic, 1 elastic", "0.1",
    ),
)  # fmt: skip

# Other ways to declare speeds, gaps and an obstacle. What replaces a quantity takes over its uniform numbers; the speed
# of the line has the one number of vehicle_2 that restitution, one per world, leaves free.
_OTHERWISE = _by_name(
    QuantityRule(
        "time_gaps_s", "s", "pair", 60.0, True, 0, "",
        "gap of each pair divided by the speed of its rear vehicle, front to rear", "[1, 1]",
    ),
    QuantityRule(
        "line_speed_mps", "mps", "world", 200.0, False, 7, "",
        "speed that all vehicles share at the alert", "20", block=1,
    ),
    QuantityRule(
        "speed_deviations_mps", "mps", "vehicle", 200.0, False, 1, "",
        "what each vehicle adds to line_speed_mps", "[0, -2, 0]", low=-200.0,
    ),
    QuantityRule(
        "obstacle_margin_m", "m", "world", 1e4, True, 0, "",
        "distance of that obstacle from where vehicle_1 stops by full braking as soon as it can", "1.7",
        stream=OBSTACLE,
    ),
    QuantityRule(
        "alert_s", "s", "world", 3600.0, False, 2, "",
        "time from the start, when gaps and speeds are as told, to the alert, from which latencies count",
        "{uniform: [1, 5]}", stream=SURROUNDINGS,
    ),
)  # fmt: skip

_OPTIONAL = _by_name(
    QuantityRule(
        "obstacle_gap_m", "m", "world", 1e4, True, 0, "obstacle_gap_m",
        "distance from the front of vehicle_1 to an unmovable obstacle ahead, at the alert", "42",
        stream=OBSTACLE,
    ),
    QuantityRule(
        "friction", "", "world", 2.0, True, 0, "friction",
        "friction of the road: no capacity is above friction x 9.81 m/s2", "{uniform: [0.2, 0.9]}",
        stream=SURROUNDINGS,
    ),
    QuantityRule(
        "brake_rate_mps3", "mps3", "vehicle", 1e6, True, 0, "brake_rate_{}_mps3",
        "how fast the deceleration of each vehicle builds up; without it at once", "12.65",
        stream=BRAKES,
    ),
    QuantityRule(
        "release_rate_mps3", "mps3", "vehicle", 1e6, True, 1, "release_rate_{}_mps3",
        "how fast it falls again, and driving builds up; without it at once", "25",
        stream=BRAKES,
    ),
)  # fmt: skip

QUANTITY = Quantities(
    _USUAL, _OTHERWISE, _OPTIONAL,
    alternatives={"gaps_m": "time_gaps_s", "speeds_mps": "line_speed_mps", "obstacle_gap_m": "obstacle_margin_m"},
    of_a_type=(
        "braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "latency_s", "speed_limit_mps", "brake_rate_mps3",
        "release_rate_mps3",
    ),
    needed=("braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "latency_s"),
    declared={**_USUAL, **_OTHERWISE, **_OPTIONAL},
)  # fmt: skip

ALSO = (
    "friction",
    "brake_rate_mps3",
    "release_rate_mps3",
)  # what is drawn where it is declared, and needs nothing else

MEANING = {key: rule.meaning for key, rule in QUANTITY.declared.items()}

Entry = tuple[str, int]  # quantity and index (from 0) of the vehicle or pair


def columns_of_table(rules: Mapping[str, QuantityRule], vehicles: int) -> dict[str, Entry]:
    """The columns of a table with these quantities, and the entry of each."""
    named = {key: rule for key, rule in rules.items() if rule.column}
    return {rule.column_of(i): (key, i) for key, rule in named.items() for i in range(rule.count(vehicles))}


def is_tabled(data: Mapping[str, Any], key: str) -> bool:
    """Whether the table of fields of a scenario has every entry of a quantity."""
    table, rule = data.get("table"), QUANTITY.declared[key]
    if table is None or "vehicles" not in data or not rule.column:
        return False
    return all(rule.column_of(i) in table.columns for i in range(rule.count(data["vehicles"])))
