"""The formats of recorded traffic: files, columns, units, licence, and how many faults are accepted."""

from __future__ import annotations

import math
from collections import Counter
from typing import Literal, NamedTuple

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import parse_numeral

DataFormat = Literal["highd", "exid", "ngsim", "openacc", "table"]

FOOT_M = 0.3048

NUMBER = "<number>"  # in the name of a column: the number of a vehicle


class Format(NamedTuple):
    """One format of recorded traffic; lengths and speeds become m and m/s by ``metres`` and ``mps``."""

    title: str  # name of the data set, for users
    files: tuple[str, ...]  # patterns of the names of its files, in lower case
    # Names of the columns to read, by what they hold (fields of ``states.State``; ``gap``: the gap behind a vehicle,
    # recorded instead of positions and lengths). A name with ``NUMBER`` stands for one column per vehicle: Speed1, ...
    columns: dict[str, str]
    units: str  # units of lengths and speeds, for messages
    licence: str  # sentence about its licence, for the scenario's ``source``
    metres: float = 1.0  # number of metres in a unit of length of the files
    mps: float = 1.0  # number of m/s in a unit of speed of the files
    ticks: float = 1.0  # number of ticks (intervals between recorded moments) per unit of time of the files
    hertz: float = 10.0  # number of ticks in a second; 0 if each file shows it by its times, in ``ticks`` per second
    # Largest accepted share of vehicles with a fault (overlap, missing leader). Faulty vehicles are left out.
    impossible: float = 0.0
    # A gap at or below 0 is noise, and no fault, if one of both vehicles is slower than this (m/s).
    standing_mps: float = -math.inf
    elsewhere: tuple[str, ...] = ()  # lines of a file that contain one of these texts (names of streets) are left out
    alone: float = 0.0  # what the column of the vehicle ahead holds if there is none
    mixed: bool = False  # True if other tables may stand beside the recordings, under any name
    headless: tuple[str, ...] = ()  # names of the columns of a file with blanks between them and without a header
    texts: tuple[int, ...] = ()  # positions in ``columns`` of those whose cells are names, not numbers
    separators: str = ","  # possible separators of cells

    @property
    def gaps(self) -> bool:
        """Whether the files have gaps, not positions and lengths; an empty cell was then not measured."""
        return "gap" in self.columns

    @property
    def by_lane(self) -> bool:
        """Whether the vehicle ahead is the next one in the lane; otherwise the files name it."""
        return "preceding" not in self.columns and not self.gaps


_NGSIM_TEXT = (
    "Vehicle_ID", "Frame_ID", "Total_Frames", "Global_Time", "Local_X", "Local_Y", "Global_X", "Global_Y", "v_Length",
    "v_Width", "v_Class", "v_Vel", "v_Acc", "Lane_ID", "Preceding", "Following", "Space_Hdwy", "Time_Hdwy",
)  # fmt: skip

_LEVELX = "is lent on request for non-commercial use and must not be passed on: these rows are for you alone."

FORMATS: dict[DataFormat, Format] = {
    "highd": Format(
        "highD", ("*_tracks.csv",),
        {"tick": "frame", "id": "id", "lane": "laneId", "preceding": "precedingId", "front": "x", "length": "width",
         "speed": "xVelocity"},
        "m and m/s", f"highD {_LEVELX}", hertz=25.0,
    ),
    "exid": Format(
        "exiD", ("*_tracks.csv",),
        {"tick": "frame", "id": "trackId", "preceding": "leadId", "front": "xCenter", "side": "yCenter",
         "heading": "heading", "length": "length", "speed": "lonVelocity"},
        "m and m/s", f"exiD {_LEVELX}", hertz=25.0, impossible=0.01, alone=-1.0,
    ),
    "ngsim": Format(
        "NGSIM", ("*.csv", "*.txt"),
        {"tick": "Global_Time", "id": "Vehicle_ID", "lane": "Lane_ID", "preceding": "Preceding", "front": "Local_Y",
         "length": "v_Length", "speed": "v_Vel"},
        "feet and feet/s",
        "NGSIM is of the US Department of Transportation, CC BY-SA: name the source, and share what you make of it"
        " under the same licence. Streets with crossings (lankershim, peachtree) are left out.",
        metres=FOOT_M, mps=FOOT_M, ticks=0.01, impossible=0.05, elsewhere=("lankershim", "peachtree"), mixed=True,
        headless=_NGSIM_TEXT,
    ),
    "openacc": Format(
        "OpenACC", ("*.csv",), {"tick": "Time", "speed": f"Speed{NUMBER}", "gap": f"IVS{NUMBER}"}, "m and m/s",
        "OpenACC is of the European Commission's Joint Research Centre, CC BY 4.0: name the source, and say that these"
        " rows are made from it.",
        ticks=10.0, impossible=0.01, standing_mps=0.5, mixed=True,
    ),
}  # fmt: skip

REFUSED = {  # formats without lanes to follow, by columns that they have and columns that they have not
    "inD or rounD": ({"trackid", "xcenter", "lonvelocity"}, {"leadid"})
}

# Metres in a unit of length, m/s in a unit of speed, and both in words.
_UNITS = {"m": (1.0, 1.0, "m and m/s"), "ft": (FOOT_M, FOOT_M, "feet and feet/s"), "km/h": (1.0, 1 / 3.6, "m and km/h")}

# What each key of ``--columns`` names.
_ROLES = {"time": "tick", "vehicle": "id", "lane": "lane", "front": "front", "length": "length", "speed": "speed"}


def format_of(name: DataFormat, columns: str = "") -> Format:
    """Return the format of that name; for ``table``, with the columns that ``columns`` names.

    Args:
        name: name of the format.
        columns: of ``table``: ``time=t,vehicle=id,lane=lane,front=x,length=l,speed=v,units=m``. Each value is a column
            of the files. ``time=t/1000`` if a second has 1000 of its units; ``units`` are ``m`` (and m/s), ``ft`` (and
            ft/s) or ``km/h`` (and m).

    Raises ``InvalidInput`` for missing, repeated and unknown keys and units.

    """
    if name != "table":
        if columns:
            raise InvalidInput(f"columns: only --format table takes columns; those of {FORMATS[name].title} are known")
        return FORMATS[name]
    pairs = [[each.strip() for each in part.partition("=")[::2]] for part in columns.split(",")]
    settings = {key: value for key, value in pairs if value}
    known, example = (*_ROLES, "units"), ",".join(f"{key}=..." for key in _ROLES)
    if Counter(key for key, _ in pairs) != Counter(known) or len(settings) < len(known):
        raise InvalidInput(f"columns = {columns!r}: must be {example},units={'|'.join(_UNITS)}, each once")
    if settings["units"] not in _UNITS:
        raise InvalidInput(f"columns: units = {settings['units']!r}: must be one of {', '.join(_UNITS)}")
    metres, mps, units = _UNITS[settings["units"]]
    column, _, divisor = settings["time"].rpartition("/")
    second = parse_numeral(divisor) if column else None
    if second is not None:
        settings["time"] = column
        if not 0.0 < second < math.inf:
            raise InvalidInput(f"columns: time = .../{divisor}: must be the number of units of time in a second")
    return Format(
        "the table", ("*.csv", "*.txt", "*.parquet"), {role: settings[key] for key, role in _ROLES.items()},
        units,
        "Its licence is not known here: look where the data come from.", metres, mps, 1.0 / (second or 1.0), 0.0, 0.01,
        mixed=True, texts=(1, 2), separators=",;\t",
    )  # fmt: skip
