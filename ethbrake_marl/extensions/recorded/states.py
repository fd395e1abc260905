"""Convert the columns of a recording to states of vehicles: position, direction, length and speed, in m and m/s.

The states of all formats are one table, sorted by time and vehicle, so that the order of a file's rows has no effect.
A *tick* is the interval between two recorded moments.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from ethbrake_marl.errors import InvalidInput, plain_text
from ethbrake_marl.extensions.recorded.formats import HIGHD_META, Format
from ethbrake_marl.extensions.recorded.reading import Source, open_source, read_columns
from ethbrake_marl.worlds.rules import RULES

FASTEST_MPS, LONGEST_M = 75.0, 40.0  # largest speed (270 km/h) and length of a road vehicle

FARTHEST_M = RULES["gaps_m"].high  # longest gap that a scenario may have

# Range of the lengths of cars and vans (m), and the least share of such vehicles. Lengths in feet violate it.
CAR_M, LEAST_CARS = (2.5, 8.0), 1 / 3

# Time (s) after each moment that becomes rows at which the vehicles are read again, to check gaps and positions against
# speeds. The time to the next row may be too long for this check.
CHECK_S = 1.0

LATEST = 2.0**53  # times, and numbers of ticks, below this are exact

OFF = 0.05  # largest accepted distance of a time from a tick, in ticks


class Recording(NamedTuple):
    """The states of the vehicles of one file at the moments that become rows, and at those that check them.

    ``states`` has one line per vehicle and moment, sorted by ``tick`` (number of ticks since the file's first moment)
    and ``vehicle``. ``ahead`` is the vehicle ahead, negative if there is none. ``front`` and ``side`` are x and y of
    its front (m), ``dx`` and ``dy`` its direction of travel (1 and 0 if positions are along the road). ``length`` (m)
    is 0 if the data contain gaps. ``speed`` is in m/s, ``row`` the row in the file.
    """

    source: Source
    entry: Format
    stride: int  # number of ticks between two moments that become rows: all multiples of it
    near: int  # number of ticks between two moments that are compared
    states: Any
    names: dict[float, str]  # number of a vehicle or lane -> its name, if files have names instead of numbers

    def name(self, number: float) -> str:
        """Return the name of a vehicle or lane."""
        return self.names.get(number) or f"{number:.0f}"


def check_every(every_s: float, entry: Format) -> int:
    """Return the number of ticks in the time ``every_s``.

    Raises ``InvalidInput`` if ``every_s`` is not a multiple of a tick.
    """
    stride = every_s * entry.hertz
    off = 0.01 * stride if entry.title == "the table" else 1e-6  # video has 29.97 pictures in a second
    if not (1.0 - 1e-6 <= stride < 1e9 and abs(stride - round(stride)) <= off):
        raise InvalidInput(
            f"every = {every_s:g} s: the time between the moments that are read must be a multiple of"
            f" {1 / entry.hertz:g} s, the time step of {entry.title}"
        )
    return round(stride)


def read_recording(file: Path, entry: Format, every_s: float) -> Recording:
    """Read the states of the vehicles in a file at regular times, ``every_s`` apart, from the file's first moment.

    Raises ``InvalidInput``, which names file, line and column, for an impossible value, for instance a length of 0 m.
    """
    source = open_source(file, entry)
    raw, names = read_columns(source, entry), dict[float, str]()
    if raw.empty:
        right = f" except those from {' and '.join(entry.streets)}, which have crossings" * bool(entry.streets)
        raise InvalidInput(f"{file}: contains no rows of data{right}")
    source.refuse(abs(raw["time"]) > LATEST, "time", raw["time"], "must be between -2^53 and 2^53")
    if not entry.hertz:
        entry = _with_rate(entry, raw["time"].unique(), every_s)
    stride = check_every(every_s, entry)
    near = max(1, min(stride, int(CHECK_S * entry.hertz)))
    ticks = (raw["time"] - raw["time"].min()) * entry.ticks
    right = f"must be a multiple of {1 / entry.hertz:g} s after the first time, and less than 2^53 of them"
    source.refuse((ticks > LATEST) | (abs(ticks - ticks.round()) > OFF), "time", raw["time"], right)
    raw["tick"] = ticks.round().astype("int64")
    raw = raw[np.isin(raw["tick"] % stride, (0, near % stride))]
    if entry.gaps:
        states = _openacc(raw, source, entry)
    else:
        if "lane" in entry.texts:
            names = _number_names(raw, source)
        states = _along_road(raw, source, entry)
        if entry.title == "highD":
            _turn_highd(states, source)
        elif entry.title == "exiD":
            _turn_exid(states, raw)
        _check(states, source, entry)
    states["row"] = states.index
    return Recording(source, entry, stride, near, states.sort_values(list(states), ignore_index=True), names)


def _with_rate(entry: Format, times: Any, every_s: float) -> Format:
    """Return the format ``entry`` with the sampling rate of a file, computed from its ``times`` [rows].

    A tick is the smallest difference between two times, and the rate is 1 / tick. If some times are not multiples of
    the tick (because they were rounded), and the rate is within 2 % of a whole number, this number is the rate. For
    example, times of 0.033 s and 0.067 s mean 30 Hz. If all times are equal, the tick is ``every_s``.
    """
    seconds = np.unique(np.round(times * entry.ticks, 6))
    steps = np.diff(seconds)
    hertz = 1.0 / (steps.min() if len(steps) else every_s)
    at = (seconds - seconds[0]) * hertz
    if (abs(at - np.rint(at)) > OFF).any() and abs(hertz - round(hertz)) <= 0.02 * hertz:
        hertz = float(round(hertz))
    return entry._replace(hertz=hertz, ticks=entry.ticks * hertz)


def _number_names(raw: Any, source: Source) -> dict[float, str]:
    """Replace the names of vehicles and lanes by numbers, in the order of the names; return the names by number."""
    for column in ("vehicle", "lane"):
        source.refuse(raw[column] == "", column, raw[column], "must be a name")
    text = pd.concat([raw["vehicle"], raw["lane"]]).drop_duplicates()
    names = pd.DataFrame({"number": pd.to_numeric(text, errors="coerce"), "text": text}).sort_values(["number", "text"])
    numbers = {name: float(k) for k, name in enumerate(names["text"])}
    for column in ("vehicle", "lane"):
        raw[column] = raw[column].map(numbers)
    return {number: plain_text(name) for name, number in numbers.items()}


def _along_road(raw: Any, source: Source, entry: Format) -> Any:
    """Return the states of a format with ids and positions along the road."""
    zero = pd.Series(0.0, raw.index)
    for role, least in (("vehicle", 0.0), ("lane", 0.0), ("ahead", entry.alone)):
        if role in raw:
            odd = (raw[role] != raw[role].round()) | (raw[role] < least)
            source.refuse(odd, role, raw[role], f"must be a whole number, {least:g} or above")
    ahead = raw.get("ahead", zero - 1.0)
    return pd.DataFrame(
        {
            "tick": raw["tick"], "vehicle": raw["vehicle"], "lane": raw.get("lane", zero),
            "ahead": ahead.where(ahead != entry.alone, -1.0), "front": raw["front"] * entry.metres,
            "side": raw.get("side", zero) * entry.metres, "dx": zero + 1.0, "dy": zero,
            "length": raw["length"] * entry.metres, "speed": raw["speed"] * entry.mps,
        }
    )  # fmt: skip


def _turn_highd(states: Any, source: Source) -> None:
    """Let positions increase in the direction of travel; x is the left edge of a vehicle and grows to the right."""
    meta = open_source(Path(f"{str(source.file)[:-4]}Meta.csv"), HIGHD_META)
    rows = read_columns(meta, HIGHD_META)
    direction = states["vehicle"].map(rows.drop_duplicates("vehicle").set_index("vehicle")["direction"])
    right = "must have the drivingDirection 1 or 2 in its tracksMeta.csv"
    source.refuse(~direction.isin([1.0, 2.0]), "vehicle", states["vehicle"], right)
    to_right = direction == 2.0
    states["front"] = (states["front"] + states["length"]).where(to_right, -states["front"])
    states["speed"] = states["speed"].where(to_right, -states["speed"])


def _turn_exid(states: Any, raw: Any) -> None:
    """Set the direction of travel, and move positions from the centre of a vehicle to its front."""
    heading = np.deg2rad(raw["heading"])
    states["dx"], states["dy"] = np.cos(heading), np.sin(heading)
    states["front"] += states["length"] / 2.0 * states["dx"]
    states["side"] += states["length"] / 2.0 * states["dy"]


def _check(states: Any, source: Source, entry: Format) -> None:
    length, speed = states["length"], states["speed"]
    right = f"m: the length must be above 0 and at most {LONGEST_M:g} m; {entry.title} is in {entry.units}"
    source.refuse((length <= 0.0) | (length > LONGEST_M), "length", length, right)
    right = f"m/s: the speed must be at most {FASTEST_MPS:g} m/s; {entry.title} is in {entry.units}"
    source.refuse(speed > FASTEST_MPS, "speed", speed, right)
    cars = int(length.between(*CAR_M, inclusive="neither").sum())
    if cars < LEAST_CARS * len(states):
        raise InvalidInput(
            f"{source.file}: only {cars:,} of {len(states):,} vehicles are {CAR_M[0]:g} to {CAR_M[1]:g} m long, but at"
            f" least a third should be; lengths and speeds must be in {entry.units}"
        )


def _openacc(raw: Any, source: Source, entry: Format) -> Any:
    """Return the states of cars of which speeds and gaps were recorded, in numbered columns.

    Car k + 1 follows car k if the speeds of both cars and the gap between these cars (column ``IVS`` with the number k)
    are recorded. The first car of a queue has position 0. The position of every other car is minus the sum of the
    gaps between it and the first car of its queue.
    """
    cars = sorted(int(name.removeprefix("speed")) for name in raw if name.startswith("speed"))
    gap_of = {k: f"gap{k - 1}" for k in cars if k - 1 in cars and f"gap{k - 1}" in raw}
    if not gap_of:
        raise InvalidInput(
            f"{source.file}: no column is the gap between two cars; the file must have the speeds of two cars and the"
            " gap between them, such as Speed1, Speed2 and IVS1"
        )
    limits = {f"speed{k}": (f"m/s: the speed must be at most {FASTEST_MPS:g} m/s", FASTEST_MPS) for k in cars}
    limits |= {gap: (f"m: the gap must be at most {FARTHEST_M:g} m", FARTHEST_M) for gap in gap_of.values()}
    for name, (right, most) in limits.items():
        source.refuse(abs(raw[name]) > most, name, raw[name], f"{right}; {entry.title} is in {entry.units}")
    speeds = raw[[f"speed{k}" for k in cars]].to_numpy()
    gaps = np.column_stack([raw[gap_of[k]] if k in gap_of else np.full(len(raw), np.nan) for k in cars])
    linked = np.isfinite(gaps) & np.isfinite(speeds)
    linked[:, 1:] &= np.isfinite(speeds[:, :-1])
    numbers = np.tile(np.array(cars, float), (len(raw), 1))
    return pd.DataFrame(
        {
            "tick": raw["tick"].repeat(len(cars)), "vehicle": numbers.ravel(), "lane": 0.0,
            "ahead": np.where(linked, numbers - 1.0, -1.0).ravel(),
            "front": -np.cumsum(np.where(linked, gaps, 0.0), axis=1).ravel(), "side": 0.0, "dx": 1.0, "dy": 0.0,
            "length": 0.0, "speed": speeds.ravel(),
        }
    ).dropna()  # fmt: skip
