"""The quantities that describe a world: meaning, unit, allowed range, and the place of each in the random numbers.

Speeds, gaps and an obstacle may be declared in another way (``OTHERWISE``). One table serves the schema, its messages,
the tables of initial states and the sampling.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ethbrake_marl.files.messages import UNITS

BLOCK = 8  # uniform numbers per vehicle and world; a multiple of 4, the numbers of one Philox counter

SYMBOLS = {"mps": "m/s", "mps2": "m/s2"}  # of the endings that are not their own symbol


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

    @property
    def interval(self) -> str:
        """The allowed range, with its unit, as messages write it."""
        unit = f" {SYMBOLS.get(self.unit, self.unit)} ({UNITS[self.unit]})" if self.unit else ""
        return f"finite and in {'(' if self.positive else '['}{self.low:g}, {self.high:g}]{unit}"

    def allows(self, low: float, high: float) -> bool:
        """Whether every value from ``low`` to ``high`` is in range; false for NaN."""
        return (low > 0.0 if self.positive else low >= self.low) and high <= self.high

    def count(self, vehicles: int) -> int:
        """How many values a world of ``vehicles`` vehicles has."""
        return {"vehicle": vehicles, "pair": vehicles - 1, "world": 1}[self.per]

    def place(self, index: int) -> int:
        """Which of a world's uniform numbers belongs to entry ``index`` (from 0)."""
        return BLOCK * (self.block + index) + self.slot

    def column_of(self, index: int) -> str:
        """Name of the column that holds entry ``index`` (from 0) in a table of initial states."""
        return self.column.format(index + 1)

    def owner(self, index: int) -> str:
        """Whose value entry ``index`` (from 0) is, in words; empty for a value of the whole world."""
        front = f"vehicle_{index + 1}"
        return {"vehicle": front, "pair": f"{front} to vehicle_{index + 2}", "world": ""}[self.per]


# The upper ends are far outside traffic: they catch a value in the wrong unit (kilograms, kilometres per hour).
# The slots are fixed for ever: another order would give other worlds for the same seed.
QUANTITIES = {
    rule.name: rule
    for rule in (
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
    )
}  # fmt: skip

# Other ways to declare speeds, gaps and an obstacle. What replaces a quantity takes over its uniform numbers; the speed
# of the line has the one number of vehicle_2 that restitution, one per world, leaves free.
OTHERWISE = {
    rule.name: rule
    for rule in (
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
        ),
    )
}  # fmt: skip
# What a world need not have. It has a stream of random numbers of its own.
OPTIONAL = {
    rule.name: rule
    for rule in (
        QuantityRule(
            "obstacle_gap_m", "m", "world", 1e4, True, 0, "obstacle_gap_m",
            "distance from the front of vehicle_1 to an unmovable obstacle ahead, at the alert", "42",
        ),
    )
}  # fmt: skip
DECLARED = {**QUANTITIES, **OTHERWISE, **OPTIONAL}  # every key that declares a quantity
# A scenario has exactly one of each two, or at most one where what they declare is optional.
ALTERNATIVES = {"gaps_m": "time_gaps_s", "speeds_mps": "line_speed_mps", "obstacle_gap_m": "obstacle_margin_m"}
