"""Exact physics of a line of vehicles: compiled and pure. No YAML, no random numbers, no torch."""

from ethbrake_marl.physics.advance import (
    ImpactRows,
    Impacts,
    LeftOutRows,
    advance,
    leaving_out_failed,
    measured_without_failed,
)
from ethbrake_marl.physics.kernel import forecast
from ethbrake_marl.physics.sampled import advance_sampled
from ethbrake_marl.physics.worlds import (
    Bools,
    Floats,
    Ints,
    UInt64s,
    Vehicles,
    Worlds,
    assign,
    concatenate,
    make_worlds,
)

__all__ = [
    "Bools",
    "Floats",
    "ImpactRows",
    "Impacts",
    "Ints",
    "LeftOutRows",
    "UInt64s",
    "Vehicles",
    "Worlds",
    "advance",
    "advance_sampled",
    "assign",
    "concatenate",
    "forecast",
    "leaving_out_failed",
    "make_worlds",
    "measured_without_failed",
]
