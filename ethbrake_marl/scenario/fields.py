"""The quantities of a scenario: name, unit, range and meaning of each, and which random number draws it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.files.model import UNITS
from ethbrake_marl.physics.state import Floats, Worlds

BLOCK = 8  # uniform numbers per vehicle and world; a multiple of 4, the output of one Philox counter

V2X_NEWS = (1,)  # stream of the links' delays and losses

OBSTACLE = (2,)  # stream of the obstacle's distance

TYPES = (3,)  # stream of the vehicles' types and loads

MIXTURE = (4,)  # stream that selects the member of a mixture for each world

LATER_LOSSES = (5,)  # stream of each world's key, the seed of its later message losses

SURROUNDINGS = (6,)  # stream of friction, the row of the table, and the time before the alert

BRAKES = (7,)  # stream of brake and release rates and of weights of harm, BLOCK numbers per vehicle

OF_WORLD = 4  # numbers per world in the streams OBSTACLE, MIXTURE, LATER_LOSSES and SURROUNDINGS

PER_TYPE = 4  # numbers per vehicle in the stream TYPES: type, load, two unused; one Philox counter

RECORDING = "recording"  # column of texts in a scenario's table: the recording and vehicles that a row comes from

ROW = (SURROUNDINGS, 1)  # place of the number that selects the row of a table

Place = tuple[tuple[int, ...], int]  # a stream of uniform numbers and a column in it


@dataclass(frozen=True, slots=True)
class QuantityRule:
    """Meaning, unit and allowed range of a quantity, and the place of its random number."""

    name: str  # key in a scenario, field of Worlds or Vehicles
    unit: str  # key of UNITS, or "" for a plain number
    per: Literal["vehicle", "pair", "world"]  # what has one value each
    high: float  # largest allowed value
    positive: bool  # whether 0 is refused
    slot: int  # column of its uniform number inside the block of BLOCK numbers that each vehicle has
    column: str  # column name in a table of initial states, such as ``gap_{}_m``; "": no column
    meaning: str  # what it is, in words
    example: str  # an example of its value in a scenario file
    low: float = 0.0  # smallest allowed value
    block: int = 0  # vehicle (from 0) in whose block the number of entry 0 is; entry i is in block ``block + i``
    stream: tuple[int, ...] = ()  # stream of uniform numbers that contains the blocks; (): the main stream

    @property
    def symbol(self) -> str:
        """Symbol of the unit, for example ``m/s2``; empty for a plain number."""
        return {"mps": "m/s", "mps2": "m/s2", "mps3": "m/s3"}.get(self.unit, self.unit)

    @property
    def label(self) -> str:
        """Name in words with the unit, as the label of an axis: ``braking capacity (m/s²)``."""
        return self.name.removesuffix(f"_{self.unit}").replace("_", " ") + (
            f" ({self.symbol.replace('s2', 's²').replace('s3', 's³')})" if self.unit else ""
        )

    @property
    def interval(self) -> str:
        """Allowed range with its unit, as error messages write it: ``finite and in (0, 1000] t (tonnes)``."""
        unit = f" {self.symbol} ({UNITS[self.unit]})" if self.unit else ""
        return f"finite and in {'(' if self.positive else '['}{self.low:g}, {self.high:g}]{unit}"

    def allows(self, low: float, high: float) -> bool:
        """Return whether every value from ``low`` to ``high`` is in range; False for NaN."""
        return (low > 0.0 if self.positive else low >= self.low) and high <= self.high

    def count(self, vehicles: int) -> int:
        """Return how many values a world with this number of ``vehicles`` has: one per vehicle, one per pair, or 1."""
        return {"vehicle": vehicles, "pair": vehicles - 1, "world": 1}[self.per]

    def place(self, index: int) -> Place:
        """Return the place of the uniform number that draws entry ``index`` (from 0): (stream, column in it)."""
        return self.stream, BLOCK * (self.block + index) + self.slot

    def column_of(self, index: int) -> str:
        """Return the column name of entry ``index`` (from 0) in a table of initial states, such as ``gap_1_m``."""
        return self.column.format(index + 1)

    def owner(self, index: int) -> str:
        """Return the vehicle or pair of entry ``index`` (from 0): ``vehicle_1``, or ``vehicle_1 to vehicle_2``.

        Empty for a value of the whole world.
        """
        front = f"vehicle_{index + 1}"
        return {"vehicle": front, "pair": f"{front} to vehicle_{index + 2}", "world": ""}[self.per]

    def of(self, worlds: Worlds) -> Floats:
        """Return the values of this quantity in ``worlds``, [n, entries]: one entry per vehicle, pair or world.

        Capacities are those on a dry road, as a scenario declares them, if every world has a friction. A distance to an
        obstacle is NaN in a world without one.
        """
        of_vehicles = hasattr(worlds.vehicles, self.name)
        values: Floats = getattr(worlds.vehicles if of_vehicles else worlds, self.name)
        if of_vehicles and np.isfinite(worlds.friction).all():
            values = worlds.dry(self.name)
        if self.stream == BRAKES:  # an infinite rate is written as the largest declarable one
            values = np.minimum(values, self.high)
        if self.stream == OBSTACLE:  # NaN if there is no obstacle
            values = np.where(np.isfinite(values), values, np.nan)
        return values.reshape(worlds.n, -1)


class Quantities(NamedTuple):
    """All quantities that a scenario can declare: key, such as ``gaps_m`` -> rule, in several groups."""

    usual: dict[str, QuantityRule]  # quantities that every world has
    otherwise: dict[str, QuantityRule]  # other ways to declare speeds, gaps and an obstacle
    optional: dict[str, QuantityRule]  # quantities that a world may lack; drawn from streams of their own
    # usual or optional key -> the key in ``otherwise`` that may replace it: {"gaps_m": "time_gaps_s", ...}; a scenario
    # never declares both
    alternatives: dict[str, str]
    of_a_type: tuple[str, ...]  # keys that a vehicle type may declare
    needed: tuple[str, ...]  # keys without a default, which every vehicle needs
    declared: dict[str, QuantityRule]  # every key that declares a quantity

    def of(self, worlds: Worlds) -> dict[str, QuantityRule]:
        """Return key -> rule of the quantities that ``worlds`` have; friction only if all worlds have it.

        The distance to an obstacle and the brake rates are included if some world has them, and the weights of harm if
        one of them is not 1.
        """
        there = {"obstacle_gap_m": worlds.obstacle_ahead.any(), "friction": np.isfinite(worlds.friction).all()}
        there["harm_weight"] = (worlds.vehicles.harm_weight != 1.0).any()
        there |= {key: np.isfinite(getattr(worlds.vehicles, key)).any() for key in self.optional if key not in there}
        return self.usual | {key: rule for key, rule in self.optional.items() if there[key]}

    def columns(self, worlds: Worlds) -> dict[str, Floats]:
        """Return every quantity of the worlds, [n] each, by column name of a table of initial states (``gap_1_m``)."""
        return {
            rule.column_of(i): values for rule in self.of(worlds).values() for i, values in enumerate(rule.of(worlds).T)
        }


def _by_name(*rules: QuantityRule) -> dict[str, QuantityRule]:
    return {rule.name: rule for rule in rules}


# The upper ends are far outside traffic: they catch a value in the wrong unit (kilograms, kilometres per hour).
# The slots never change: another order would give other worlds for the same seed.
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

# Other ways to declare speeds, gaps and an obstacle. Each uses the uniform numbers of the quantity that it replaces.
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
    QuantityRule(
        "harm_weight", "", "vehicle", 1e6, False, 2, "harm_weight_{}",
        "weight of the harm that each vehicle bears, for objective: preference; without it 1", "[1, 4, 1]",
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
)  # optional quantities that are independent of all others

MEANING = {key: rule.meaning for key, rule in QUANTITY.declared.items()}

Entry = tuple[str, int]  # quantity and index (from 0) of the vehicle or pair


def columns_of_table(rules: Mapping[str, QuantityRule], vehicles: int) -> dict[str, Entry]:
    """Return column name -> (quantity, index) of a table with these quantities: ``{"gap_1_m": ("gaps_m", 0), ...}``.

    Args:
        rules: the quantities, by key.
        vehicles: number of vehicles in the line.

    """
    named = {key: rule for key, rule in rules.items() if rule.column}
    return {rule.column_of(i): (key, i) for key, rule in named.items() for i in range(rule.count(vehicles))}


def is_tabled(data: Mapping[str, Any], key: str) -> bool:
    """Return whether a scenario's table gives the quantity ``key`` for every vehicle, pair or world.

    ``data``: fields of the scenario, as far as they are checked; ``table`` and ``vehicles`` are read.
    """
    table, rule = data.get("table"), QUANTITY.declared[key]
    if table is None or "vehicles" not in data or not rule.column:
        return False
    return all(rule.column_of(i) in table.columns for i in range(rule.count(data["vehicles"])))
