"""The quantities of a world: key, unit, range, meaning, and the random number that draws each of them."""

from __future__ import annotations

from typing import Any, NamedTuple

from ethbrake_marl.files.model import UNITS, UNSHOWN, require
from ethbrake_marl.files.yaml import YamlPath
from ethbrake_marl.motion.layout import BRAKE_RATE, BRAKING, DRIVING, LATENCY, LIMIT, MASS, RELEASE_RATE, RESTITUTION
from ethbrake_marl.worlds.quantity import DISTRIBUTIONS, support

# A stream is an independent sequence of uniform random numbers, named by a tuple.
MAIN: tuple[int, ...] = ()
NEWS = (1,)  # delays and losses of the links
OBSTACLE_STREAM = (2,)
TYPES = (3,)  # types and loads of the vehicles
MIXTURE = (4,)  # scenario of a mixture
SURROUNDINGS = (6,)  # friction, row of the table, time before the alert
BRAKES = (7,)  # brake rates, release rates, grip
GENERATORS = (8,)  # key of the random generators of scripts

NUMBERS_PER_VEHICLE = 8  # numbers of one vehicle in the streams MAIN and BRAKES
PER_TYPE = 4  # numbers of one vehicle in TYPES: type, load, two unused
OF_WORLD = 4  # numbers of a world in the other streams

Place = tuple[tuple[int, ...], int]  # a stream and a column in it
QuantityEntry = tuple[str, int]  # key of a quantity, and index (from 0) of the vehicle or pair

ROW: Place = (SURROUNDINGS, 1)  # number that selects the row of a table
RECORDING = "recording"  # column of a table with texts: the recording and the vehicles that a row comes from


class Rule(NamedTuple):
    key: str
    unit: str  # a key of UNITS; "": a plain number
    per: str  # vehicle, pair or world: what has one value
    high: float  # largest allowed value
    positive: bool  # whether 0 is not allowed
    slot: int  # column of its number in the block of a vehicle. Another slot would give other worlds for a seed
    meaning: str
    example: str
    column: str = ""  # name of its columns in a table, such as gap_{}_m; "": none
    low: float = 0.0
    block: int = 0  # vehicle (from 0) in whose block the number of entry 0 stands; entry i in block + i
    stream: tuple[int, ...] = MAIN

    @property
    def interval(self) -> str:
        """Valid range, for messages, such as ``finite and in (0, 1000] t (tonnes)``."""
        symbol = {"mps": "m/s", "mps2": "m/s2", "mps3": "m/s3"}.get(self.unit, self.unit)
        unit = f" {symbol} ({UNITS[self.unit]})" if self.unit else ""
        return f"finite and in {'(' if self.positive else '['}{self.low:g}, {self.high:g}]{unit}"

    @property
    def schema(self) -> dict[str, Any]:
        """JSON Schema of the valid range, also inside lists and distributions (``range_KEY`` in a file's schema)."""
        inside = {"$ref": f"#/$defs/range_{self.key}"}
        limits = {"exclusiveMinimum" if self.positive else "minimum": self.low, "maximum": self.high, "items": inside}
        return {**limits, "properties": dict.fromkeys(("low", "high", "with_load", *DISTRIBUTIONS), inside)}

    def allows(self, low: float, high: float) -> bool:
        """False for NaN."""
        return (low > 0.0 if self.positive else low >= self.low) and high <= self.high

    def check(self, quantity: Any, at: YamlPath = ()) -> None:
        low, high = support(quantity)
        overlap = "; a negative gap means overlapping vehicles" if self.per == "pair" and low < 0.0 else ""
        require(self.allows(low, high), at, quantity, f"must be {self.interval}{overlap}")

    def count(self, vehicles: int) -> int:
        return {"vehicle": vehicles, "pair": vehicles - 1, "world": 1}[self.per]

    def place(self, index: int) -> Place:
        """Stream (``counters.uniform_numbers``) and column of the random number that draws a value."""
        return self.stream, NUMBERS_PER_VEHICLE * (self.block + index) + self.slot

    def column_of(self, index: int) -> str:
        """Such as ``gap_1_m``; ``index`` from 0."""
        return self.column.format(index + 1)

    def owner(self, index: int) -> str:
        """Such as ``vehicle_1 to vehicle_2``; "" for a world."""
        front = f"vehicle_{index + 1}"
        return {"vehicle": front, "pair": f"{front} to vehicle_{index + 2}", "world": ""}[self.per]


# The largest values are far above those of traffic: they catch a wrong unit (kilograms, kilometres per hour).
_USUAL = (
    Rule(
        "gaps_m", "m", "pair", 1e4, False, 0,
        "bumper-to-bumper gap of each pair at the alert, front to rear", "7", "gap_{}_m",
    ),
    Rule(
        "speeds_mps", "mps", "vehicle", 200.0, False, 1,
        "speed of each vehicle at the alert", "20", "speed_{}_mps",
    ),
    Rule(
        "braking_capacity_mps2", "mps2", "vehicle", 100.0, True, 2,
        "largest deceleration of each vehicle", "7", "braking_capacity_{}_mps2",
    ),
    Rule(
        "driving_capacity_mps2", "mps2", "vehicle", 100.0, False, 3,
        "largest forward acceleration of each vehicle", "6", "driving_capacity_{}_mps2",
    ),
    Rule(
        "latency_s", "s", "vehicle", 3600.0, False, 4,
        "time from the alert until a vehicle's commands take effect; until then it coasts", "0.5",
        "latency_{}_s",
    ),
    Rule("mass_t", "t", "vehicle", 1000.0, True, 5, "mass of each vehicle", "5", "mass_{}_t"),
    Rule(
        "speed_limit_mps", "mps", "vehicle", 200.0, True, 6,
        "speed at which each vehicle stops accelerating", "40", "speed_limit_{}_mps",
    ),
    Rule(
        "restitution", "", "world", 1.0, False, 7,
        "coefficient of restitution of every impact: 0 plastic, 1 elastic", "0.1", "restitution",
    ),
)  # fmt: skip

# Other ways to declare speeds, gaps and an obstacle, drawn by the numbers of what they replace. The speed of the line
# has slot 7 of vehicle_2: restitution needs only that of vehicle_1.
_SUBSTITUTES = (
    Rule(
        "time_gaps_s", "s", "pair", 60.0, True, 0,
        "gap of each pair divided by the speed of its rear vehicle, front to rear", "1",
    ),
    Rule(
        "line_speed_mps", "mps", "world", 200.0, False, 7, "speed that all vehicles share at the alert", "20", block=1
    ),
    Rule(
        "speed_deviations_mps", "mps", "vehicle", 200.0, False, 1,
        "speed of each vehicle at the alert minus line_speed_mps", "[0, -2, 0]", low=-200.0,
    ),
    Rule(
        "obstacle_margin_m", "m", "world", 1e4, True, 0,
        "distance from the point where vehicle_1 stops by full braking to an unmovable obstacle ahead", "1.7",
        stream=OBSTACLE_STREAM,
    ),
    Rule(
        "alert_s", "s", "world", 3600.0, False, 2,
        "time from the start of the episode to the alert; the declared gaps and speeds are those at the start, and"
        " latencies begin at the alert", "{uniform: [1, 5]}", stream=SURROUNDINGS,
    ),
)  # fmt: skip

_OPTIONAL = (
    Rule(
        "obstacle_gap_m", "m", "world", 1e4, True, 0,
        "distance from the front of vehicle_1 to an unmovable obstacle ahead, at the alert", "42", "obstacle_gap_m",
        stream=OBSTACLE_STREAM,
    ),
    Rule(
        "friction", "", "world", 2.0, True, 0,
        "friction of the road; it limits braking and driving capacities to friction x 9.81 m/s2",
        "{uniform: [0.2, 0.9]}", "friction", stream=SURROUNDINGS,
    ),
    Rule(
        "grip", "", "vehicle", 1.0, True, 3,
        "share of the road's friction that the tyres of each vehicle reach; all of it without this key",
        "{uniform: [0.8, 1]}", "grip_{}", stream=BRAKES,
    ),
    Rule(
        "brake_rate_mps3", "mps3", "vehicle", 1e6, True, 0,
        "rate at which the deceleration of each vehicle builds up; without this key brakes act at once", "12.65",
        "brake_rate_{}_mps3", stream=BRAKES,
    ),
    Rule(
        "release_rate_mps3", "mps3", "vehicle", 1e6, True, 1,
        "rate at which the deceleration of each vehicle falls, and its forward acceleration builds up; without this"
        " key both change at once", "25", "release_rate_{}_mps3", stream=BRAKES,
    ),
)  # fmt: skip

QUANTITIES = {rule.key: rule for rule in (*_USUAL, *_SUBSTITUTES, *_OPTIONAL)}
USUAL = tuple(rule.key for rule in _USUAL)  # quantities that every world has
OPTIONAL = tuple(rule.key for rule in _OPTIONAL)  # quantities that a world may lack
ALTERNATIVES = {"gaps_m": "time_gaps_s", "speeds_mps": "line_speed_mps", "obstacle_gap_m": "obstacle_margin_m"}
WITHOUT_DEFAULT = ("braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "latency_s")  # have no default
OF_A_TYPE = (*WITHOUT_DEFAULT, "speed_limit_mps", "brake_rate_mps3", "release_rate_mps3")  # keys of a vehicle type

CAR_QUANTITIES = {
    "mass_t": MASS,
    "speed_limit_mps": LIMIT,
    "latency_s": LATENCY,
    "braking_capacity_mps2": BRAKING,
    "driving_capacity_mps2": DRIVING,
    "brake_rate_mps3": BRAKE_RATE,
    "release_rate_mps3": RELEASE_RATE,
    "restitution": RESTITUTION,
}  # rows of `State.car`


def stream_width(stream: tuple[int, ...], vehicles: int) -> int:
    """Random numbers that a world takes from the stream."""
    return NUMBERS_PER_VEHICLE * vehicles if stream in (MAIN, BRAKES) else OF_WORLD


def check_length(value: Any, count: int, per: str, at: YamlPath = ()) -> None:
    right = f"must have {count}, one per {per}, or be a single entry for all"
    holds = not isinstance(value, tuple) or len(value) == count
    require(holds, at, UNSHOWN, f"has {len(value) if isinstance(value, tuple) else 1} entries; {right}")


def table_columns(keys: tuple[str, ...], vehicles: int) -> dict[str, QuantityEntry]:
    """Columns of a table with these quantities: name -> (key, index of the vehicle or pair from 0)."""
    return {QUANTITIES[key].column_of(i): (key, i) for key in keys for i in range(QUANTITIES[key].count(vehicles))}
