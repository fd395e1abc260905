"""Formats of recorded traffic: files, columns, units, licence, and how much faulty data is accepted."""

from __future__ import annotations

import math
from collections import Counter
from typing import Literal, NamedTuple

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import parse_numeral

DataFormat = Literal["highd", "exid", "ngsim", "openacc", "table"]

FOOT_M = 0.3048

VEHICLE_PLACEHOLDER = "<number>"  # placeholder for the number of a vehicle in the name of a column


class Format(NamedTuple):
    title: str  # name of the data set
    files: tuple[str, ...]  # patterns of the names of its files, in lower case
    # Quantity -> name of its column. A name with ``VEHICLE_PLACEHOLDER`` means one column for each vehicle: Speed1,
    # Speed2, ... The quantity ``gap`` is the gap behind a vehicle.
    columns: dict[str, str]
    units: str  # units of lengths and speeds, for messages
    licence: str  # sentence on the licence, for the key ``source`` of the scenario
    metres: float = 1.0  # length in m of the files' unit of length
    mps: float = 1.0  # speed in m/s of the files' unit of speed
    per_second: float = 1.0  # number of the files' units of time in a second
    # Largest accepted share of vehicles with a fault (overlap, missing vehicle ahead). Faulty vehicles are left out.
    impossible: float = 0.0
    # If one of two vehicles is slower than this (m/s), a gap of 0 or less is noise and not a fault.
    standing_mps: float = -math.inf
    streets: tuple[str, ...] = ()  # values of the column Location, if there is one, whose rows are left out
    alone: float = 0.0  # value in the column of the vehicle ahead if no vehicle is ahead
    texts: tuple[str, ...] = ()  # quantities whose columns have names instead of numbers
    optional: tuple[str, ...] = ()  # quantities whose columns may be missing

    @property
    def gaps(self) -> bool:
        """Whether files contain gaps (empty where not measured) instead of positions and lengths."""
        return "gap" in self.columns

    @property
    def by_lane(self) -> bool:
        """Whether the vehicle ahead must be determined from lanes and positions, because no column contains its id."""
        return "ahead" not in self.columns and not self.gaps


_LEVELX = "is lent on request for non-commercial use and must not be passed on: these rows are for you alone."

FORMATS: dict[DataFormat, Format] = {
    "highd": Format(
        "highD", ("*_tracks.csv",),
        {"time": "frame", "vehicle": "id", "lane": "laneId", "ahead": "precedingId", "front": "x", "length": "width",
         "speed": "xVelocity"},
        "m and m/s", f"highD {_LEVELX}", per_second=25.0,
    ),
    "exid": Format(
        "exiD", ("*_tracks.csv",),
        {"time": "frame", "vehicle": "trackId", "ahead": "leadId", "front": "xCenter", "side": "yCenter",
         "heading": "heading", "length": "length", "speed": "lonVelocity"},
        "m and m/s", f"exiD {_LEVELX}", per_second=25.0, impossible=0.01, alone=-1.0,
    ),
    "ngsim": Format(
        "NGSIM", ("*.csv",),
        {"time": "Global_Time", "vehicle": "Vehicle_ID", "lane": "Lane_ID", "ahead": "Preceding", "front": "Local_Y",
         "length": "v_Length", "speed": "v_Vel", "location": "Location"},
        "feet and feet/s",
        "NGSIM is of the US Department of Transportation, CC BY-SA: name the source, and share what you make of it"
        " under the same licence. Streets with crossings (lankershim, peachtree) are left out.",
        metres=FOOT_M, mps=FOOT_M, per_second=1000.0, impossible=0.05, streets=("lankershim", "peachtree"),
        texts=("location",), optional=("location",),
    ),
    "openacc": Format(
        "OpenACC", ("*.csv",),
        {"time": "Time", "speed": f"Speed{VEHICLE_PLACEHOLDER}", "gap": f"IVS{VEHICLE_PLACEHOLDER}"}, "m and m/s",
        "OpenACC is of the European Commission's Joint Research Centre, CC BY 4.0: name the source, and say that these"
        " rows are made from it.",
        impossible=0.01, standing_mps=0.5,
    ),
}  # fmt: skip

# The file beside each recording of highD that says in which direction each vehicle drives.
HIGHD_META = FORMATS["highd"]._replace(columns={"vehicle": "id", "direction": "drivingDirection"})

# Value of ``units`` -> length in m of the unit of length, speed in m/s of the unit of speed, names of both units.
_UNITS = {"m": (1.0, 1.0, "m and m/s"), "ft": (FOOT_M, FOOT_M, "feet and feet/s"), "km/h": (1.0, 1 / 3.6, "m and km/h")}

_ROLES = ("time", "vehicle", "lane", "front", "length", "speed")  # keys of ``--columns`` that name a column


def format_of(name: DataFormat, columns: str = "") -> Format:
    """Format of recorded traffic called ``name``.

    ``columns`` describes the format ``table``: ``time=t,vehicle=id,lane=lane,front=x,length=l,speed=v,units=m``.
    ``time=t/1000``: the column ``t`` is in 1/1000 s. ``units``: ``m`` (m and m/s), ``ft`` (ft and ft/s) or ``km/h`` (m
    and km/h). Raises ``InvalidInput`` for missing, repeated or unknown keys and units, and for ``columns`` with another
    format.
    """
    if name != "table":
        if columns:
            raise InvalidInput(
                f"columns: the columns of {FORMATS[name].title} are fixed; leave out --columns, or use --format table"
            )
        return FORMATS[name]
    pairs = [[text.strip() for text in part.partition("=")[::2]] for part in columns.split(",")]
    settings = {key: value for key, value in pairs if value}
    known_keys, example = (*_ROLES, "units"), ",".join(f"{key}=..." for key in _ROLES)
    if Counter(key for key, _ in pairs) != Counter(known_keys) or len(settings) < len(known_keys):
        raise InvalidInput(f"columns = {columns!r}: must be {example},units={'|'.join(_UNITS)}, with each key once")
    if settings["units"] not in _UNITS:
        raise InvalidInput(f"columns: units = {settings['units']!r}: must be one of {', '.join(_UNITS)}")
    metres, mps, units = _UNITS[settings["units"]]
    column, _, divisor = settings["time"].rpartition("/")
    per_second = parse_numeral(divisor) if column else None
    if per_second is not None:
        settings["time"] = column
        if not 0.0 < per_second < math.inf:
            raise InvalidInput(
                f"columns: time = .../{divisor}: the number after / must be the number of time units in 1 s,"
                " for instance 1000 for ms"
            )
    return Format(
        "the table", ("*.csv", "*.txt"), {role: settings[role] for role in _ROLES}, units,
        "Its licence is unknown: look it up where the data come from.", metres, mps, per_second or 1.0, 0.01,
        texts=("vehicle", "lane"),
    )  # fmt: skip
