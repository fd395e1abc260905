"""The quantities of a scenario: key, unit, range and meaning of each quantity, and the random number that draws it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.files.model import UNITS
from ethbrake_marl.first_edition.physics.state import Floats, Worlds

BLOCK = 8  # uniform numbers per vehicle and world; a multiple of 4, the output of one Philox counter

# A stream is an independent sequence of uniform random numbers, named by a tuple.
V2X_NEWS = (1,)  # stream of the delays and losses of the links

OBSTACLE = (2,)  # stream of the distance of the obstacle

TYPES = (3,)  # stream of the types and loads of the vehicles

MIXTURE = (4,)  # stream that selects the scenario of a mixture for each world

LATER_LOSSES = (5,)  # stream of the seed of each world's later message losses

SURROUNDINGS = (6,)  # stream of friction, row of the table, and time before the alert

BRAKES = (7,)  # stream of brake rates, release rates and weights of harm, BLOCK numbers per vehicle

OF_WORLD = 4  # numbers per world in the streams OBSTACLE, MIXTURE, LATER_LOSSES and SURROUNDINGS

PER_TYPE = 4  # numbers per vehicle in the stream TYPES: type, load, two unused; one Philox counter

RECORDING = "recording"  # column of texts in a scenario's table: the recording and vehicles that a row comes from

ROW = (SURROUNDINGS, 1)  # place of the number that selects the row of a table

Place = tuple[tuple[int, ...], int]  # a stream of uniform numbers and a column in it


@dataclass(frozen=True, slots=True)
class QuantityRule:
    """Meaning, unit and allowed range of a quantity, and which random number draws it."""

    name: str  # key of the quantity in a scenario, and name of the field of Worlds or Vehicles
    unit: str  # unit, a key of UNITS; "" for a plain number
    per: Literal["vehicle", "pair", "world"]  # whether each vehicle, each pair or the world has one value
    high: float  # largest allowed value
    positive: bool  # whether 0 is not allowed
    slot: int  # column of the uniform number inside the block of BLOCK numbers that each vehicle has
    column: str  # column name in a table of initial states, such as ``gap_{}_m``; "": no column
    meaning: str  # meaning of the quantity, in words
    example: str  # an example of the value in a scenario file
    low: float = 0.0  # smallest allowed value
    block: int = 0  # vehicle (from 0) in whose block the number of entry 0 is; entry i is in block ``block + i``
    stream: tuple[int, ...] = ()  # stream of uniform numbers that contains the blocks; (): the main stream

    @property
    def symbol(self) -> str:
        """Symbol of the unit, for example ``m/s2``; empty for a plain number."""
        return {"mps": "m/s", "mps2": "m/s2", "mps3": "m/s3"}.get(self.unit, self.unit)

    @property
    def label(self) -> str:
        """Name in words and unit, for the axis of a figure: ``braking capacity (m/s²)``."""
        return self.name.removesuffix(f"_{self.unit}").replace("_", " ") + (
            f" ({self.symbol.replace('s2', 's²').replace('s3', 's³')})" if self.unit else ""
        )

    @property
    def interval(self) -> str:
        """Allowed range with the unit, for error messages: ``finite and in (0, 1000] t (tonnes)``."""
        unit = f" {self.symbol} ({UNITS[self.unit]})" if self.unit else ""
        return f"finite and in {'(' if self.positive else '['}{self.low:g}, {self.high:g}]{unit}"

    def allows(self, low: float, high: float) -> bool:
        """Return whether all values from ``low`` to ``high`` are allowed for this quantity; False for NaN."""
        return (low > 0.0 if self.positive else low >= self.low) and high <= self.high

    def count(self, vehicles: int) -> int:
        """Return how many values the quantity has in a world with ``vehicles`` vehicles."""
        return {"vehicle": vehicles, "pair": vehicles - 1, "world": 1}[self.per]

    def place(self, index: int) -> Place:
        """Return which random number draws the value of vehicle or pair ``index`` (from 0): (stream, column)."""
        return self.stream, BLOCK * (self.block + index) + self.slot

    def column_of(self, index: int) -> str:
        """Return the column name for vehicle or pair ``index`` (from 0) in a table of initial states: ``gap_1_m``."""
        return self.column.format(index + 1)

    def owner(self, index: int) -> str:
        """Return the name of vehicle or pair ``index`` (from 0): ``vehicle_1``, or ``vehicle_1 to vehicle_2``.

        If the quantity has one value per world, the result is empty.
        """
        front = f"vehicle_{index + 1}"
        return {"vehicle": front, "pair": f"{front} to vehicle_{index + 2}", "world": ""}[self.per]

    def of(self, worlds: Worlds) -> Floats:
        """Return the values of this quantity in ``worlds``, [n, entries]: one entry per vehicle, pair or world.

        If every world has a friction, capacities are the declared ones, not limited by the friction. The distance to
        the obstacle is NaN in a world without an obstacle.
        """
        of_vehicles = hasattr(worlds.vehicles, self.name)
        values: Floats = getattr(worlds.vehicles if of_vehicles else worlds, self.name)
        if of_vehicles and np.isfinite(worlds.friction).all():
            values = worlds.dry(self.name)
        if self.stream == BRAKES:  # an infinite rate becomes the largest rate that can be declared
            values = np.minimum(values, self.high)
        if self.stream == OBSTACLE:  # NaN if there is no obstacle
            values = np.where(np.isfinite(values), values, np.nan)
        return values.reshape(worlds.n, -1)


class Quantities(NamedTuple):
    """All quantities that a scenario can declare, in groups. A group maps keys (``gaps_m``) to ``QuantityRule``."""

    usual: dict[str, QuantityRule]  # quantities that every world has
    otherwise: dict[str, QuantityRule]  # other ways to declare speeds, gaps and an obstacle, and the time of the alert
    optional: dict[str, QuantityRule]  # quantities that a world may lack; they have streams of their own
    # usual or optional key -> the key in ``otherwise`` that may replace it: {"gaps_m": "time_gaps_s", ...}; a scenario
    # never declares both keys
    alternatives: dict[str, str]
    of_a_type: tuple[str, ...]  # keys that a vehicle type may declare
    needed: tuple[str, ...]  # keys that have no default and that every vehicle needs
    declared: dict[str, QuantityRule]  # all keys that declare a quantity

    def of(self, worlds: Worlds) -> dict[str, QuantityRule]:
        """Return the quantities that ``worlds`` have: key -> ``QuantityRule``.

        The result contains friction only if all worlds have it, the distance to an obstacle only if at least one world
        has an obstacle, brake and release rates only if at least one rate is finite, and the weights of harm only if at
        least one weight is not 1.
        """
        there = {"obstacle_gap_m": worlds.obstacle_ahead.any(), "friction": np.isfinite(worlds.friction).all()}
        there["harm_weight"] = (worlds.vehicles.harm_weight != 1.0).any()
        there |= {key: np.isfinite(getattr(worlds.vehicles, key)).any() for key in self.optional if key not in there}
        return self.usual | {key: rule for key, rule in self.optional.items() if there[key]}

    def columns(self, worlds: Worlds) -> dict[str, Floats]:
        """Return the quantities of ``worlds`` as columns of a table of initial states: name (``gap_1_m``) -> [n]."""
        return {
            rule.column_of(i): values for rule in self.of(worlds).values() for i, values in enumerate(rule.of(worlds).T)
        }


def _by_name(*rules: QuantityRule) -> dict[str, QuantityRule]:
    return {rule.name: rule for rule in rules}


# The largest values are far above those of real traffic; they detect a wrong unit (kilograms, kilometres per hour).
# The slots must never change: with other slots the same seed gives other worlds.
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
        "time from the alert until a vehicle's commands take effect; until then it coasts", "[0, 0.5, 0.8]",
    ),
    QuantityRule(
        "mass_t", "t", "vehicle", 1000.0, True, 5, "mass_{}_t",
        "mass of each vehicle", "[4.5, 5.5, 5.9]",
    ),
    QuantityRule(
        "speed_limit_mps", "mps", "vehicle", 200.0, True, 6, "speed_limit_{}_mps",
        "speed at which each vehicle stops accelerating", "40",
    ),
    QuantityRule(
        "restitution", "", "world", 1.0, False, 7, "restitution",
        "coefficient of restitution of every impact: 0 plastic, 1 elastic", "0.1",
    ),
)  # fmt: skip

# Other ways to declare speeds, gaps and an obstacle. They use the uniform numbers of the quantities that they replace.
# The speed of the line uses slot 7 of vehicle_2, which is free because restitution needs one number per world only.
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
        "speed of each vehicle at the alert minus line_speed_mps", "[0, -2, 0]", low=-200.0,
    ),
    QuantityRule(
        "obstacle_margin_m", "m", "world", 1e4, True, 0, "",
        "distance from the point where vehicle_1 stops by full braking to an unmovable obstacle ahead", "1.7",
        stream=OBSTACLE,
    ),
    QuantityRule(
        "alert_s", "s", "world", 3600.0, False, 2, "",
        "time from the start of the episode to the alert; the declared gaps and speeds are those at the start, and"
        " latencies begin at the alert", "{uniform: [1, 5]}", stream=SURROUNDINGS,
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
        "friction of the road; it limits braking and driving capacities to friction x 9.81 m/s2",
        "{uniform: [0.2, 0.9]}", stream=SURROUNDINGS,
    ),
    QuantityRule(
        "brake_rate_mps3", "mps3", "vehicle", 1e6, True, 0, "brake_rate_{}_mps3",
        "rate at which the deceleration of each vehicle builds up; without this key brakes act at once", "12.65",
        stream=BRAKES,
    ),
    QuantityRule(
        "release_rate_mps3", "mps3", "vehicle", 1e6, True, 1, "release_rate_{}_mps3",
        "rate at which the deceleration of each vehicle falls, and its forward acceleration builds up; without this"
        " key both change at once", "25", stream=BRAKES,
    ),
    QuantityRule(
        "harm_weight", "", "vehicle", 1e6, False, 2, "harm_weight_{}",
        "weight of the harm that each vehicle bears, for objective: preference; 1 without this key", "[1, 4, 1]",
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
    "harm_weight",
)  # optional quantities that do not depend on other quantities

MEANING = {key: rule.meaning for key, rule in QUANTITY.declared.items()}

Entry = tuple[str, int]  # quantity and index (from 0) of the vehicle or pair


def columns_of_table(rules: Mapping[str, QuantityRule], vehicles: int) -> dict[str, Entry]:
    """Return the columns of a table of the quantities ``rules``: name -> (key of quantity, index of vehicle or pair).

    An example is ``{"gap_1_m": ("gaps_m", 0), ...}``. ``vehicles`` is the number of vehicles in the line.
    """
    named = {key: rule for key, rule in rules.items() if rule.column}
    return {rule.column_of(i): (key, i) for key, rule in named.items() for i in range(rule.count(vehicles))}


def is_tabled(data: Mapping[str, Any], key: str) -> bool:
    """Return whether a scenario's table has columns of the quantity ``key`` for every vehicle, pair or world.

    ``data`` has the scenario fields that have been checked already; only ``table`` and ``vehicles`` are used.
    """
    table, rule = data.get("table"), QUANTITY.declared[key]
    if table is None or "vehicles" not in data or not rule.column:
        return False
    return all(rule.column_of(i) in table.columns for i in range(rule.count(data["vehicles"])))
