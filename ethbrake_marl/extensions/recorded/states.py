"""Convert the numbers of a recording to states of vehicles: position, direction, length and speed, in m and m/s.

The states of all vehicles at regular times are stored in a temporary database on disk. ``every_s`` is the time between
two moments at which chains of vehicles are formed, s. A *tick* is the interval between two recorded moments.
"""

from __future__ import annotations

import sqlite3
from collections import namedtuple
from collections.abc import Callable, Iterator
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.recorded.formats import Format
from ethbrake_marl.extensions.recorded.reading import Piece, read_pieces
from ethbrake_marl.physics.state import Floats
from ethbrake_marl.scenario.fields import QUANTITY

FASTEST_MPS, LONGEST_M = 75.0, 40.0  # largest speed (270 km/h) and length of a road vehicle

# Range of the lengths of cars and vans (m), and the least share of such vehicles. Lengths in feet violate it.
CAR_M, LEAST_CARS = (2.5, 8.0), 1 / 3

# Time (s) after each moment that becomes rows at which the vehicles are read again, to check gaps and positions against
# speeds. The time to the next row may be too long for this check.
CHECK_S = 1.0

OFF = 0.05  # largest accepted distance of a time from a tick, in ticks

# State of a vehicle at one moment, in m and m/s. ``front`` and ``side`` are x and y of its front, ``dx`` and ``dy`` its
# direction of travel (1 and 0 if positions are along the road). ``preceding`` is the id of the vehicle ahead, negative
# if there is none. ``length`` is 0 if the data contain gaps. ``tick`` is the time, in units of the time between two
# moments that become rows. A moment becomes rows if ``tick`` is whole. ``line`` is the number of the line in the file.
State = namedtuple("State", "tick id lane preceding front side dx dy length speed line")

STATE_TABLE = f"CREATE TABLE state({','.join(State._fields)})"


def check_every(every_s: float, entry: Format, what: str) -> int:
    """Return the number of ticks in the time ``every_s``.

    Raises ``InvalidInput`` if ``every_s`` is not a multiple of a tick. ``what`` is the name of the data in the message.
    """
    stride = every_s * entry.hertz
    off = 0.01 * stride if entry.title == "the table" else 1e-6  # video has 29.97 pictures in a second
    if not (1.0 - 1e-6 <= stride < 1e9 and abs(stride - round(stride)) <= off):
        raise InvalidInput(
            f"every = {every_s:g} s: the time between the moments that are read must be a multiple of"
            f" {1 / entry.hertz:g} s, the time step of {what}"
        )
    return round(stride)


def keep_states(
    store: sqlite3.Connection,
    file: Path,
    entry: Format,
    every_s: float,
    names: dict[str, float],
    progress: Callable[[int, int], None],
) -> None:
    """Read a recording, and write the states of its vehicles at regular times into a database.

    ``store`` is the database, with an empty table ``state``. ``names`` maps names of vehicles and lanes to numbers; new
    names are added to it. ``progress`` is called with the amount of data read so far and the size of the file (KiB).
    Raises ``InvalidInput``, which names file, line and column, for an impossible value, for instance a length of 0 m.
    """
    turned, first, stride, cars, states = np.empty((0, 2)), None, 1, 0, 0
    for piece in read_pieces(file, entry, list(entry.columns.values()), names, progress):
        times = piece.values[:, 0]
        if first is None:
            first, entry = times[0], entry if entry.hertz else _with_rate(entry, times, every_s)
            stride = check_every(every_s, entry, entry.title)
            turned = _directions(file, entry) if entry.title == "highD" else turned
        ticks = (times - first) * entry.ticks
        right = f"must be a multiple of {1 / entry.hertz:g} s after the first time"
        piece.refuse(~(abs(ticks - np.rint(ticks)) <= OFF), 0, right)
        near = max(1, min(stride, int(CHECK_S * entry.hertz)))
        taken = np.isin(np.rint(ticks) % stride, (0.0, near % stride))
        some = piece._replace(values=piece.values[taken], lines=piece.lines[taken])
        kept_states = _states(some, entry, np.rint(ticks[taken]) / stride, turned)
        store.executemany(f"INSERT INTO state VALUES ({', '.join('?' * len(State._fields))})", kept_states.tolist())
        lengths = kept_states[:, State._fields.index("length")]
        cars, states = cars + int(((lengths > CAR_M[0]) & (lengths < CAR_M[1])).sum()), states + len(kept_states)
    if not entry.gaps and cars < LEAST_CARS * states:
        raise InvalidInput(
            f"{file}: only {cars:,} of {states:,} vehicles are {CAR_M[0]:g} to {CAR_M[1]:g} m long, but at least a"
            f" third should be; lengths and speeds must be in {entry.units}"
        )


def moments(store: sqlite3.Connection) -> Iterator[tuple[float, list[Any]]]:
    """Yield (time, states) for each moment in the table ``state``, in order of time.

    The time is in units of ``every_s``. The states of a moment have the order of the file.
    """
    for tick, rows in groupby(store.execute("SELECT * FROM state ORDER BY tick, line"), itemgetter(0)):
        yield tick, [State(*row) for row in rows]


def _directions(file: Path, entry: Format) -> Floats:
    """Return the id and the driving direction of each vehicle in a highD recording, [vehicles, 2], sorted by id."""
    meta = read_pieces(Path(f"{str(file)[:-4]}Meta.csv"), entry, ("id", "drivingDirection"))
    turned = np.concatenate([piece.values for piece in meta])
    return turned[np.argsort(turned[:, 0])]


def _with_rate(entry: Format, times: Floats, every_s: float) -> Format:
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


def _states(piece: Piece, entry: Format, ticks: Floats, turned: Floats) -> Floats:
    """Return the states in the rows ``piece`` of a file, one per vehicle and time, [states, fields of State].

    ``ticks`` [rows] is the time since the first row of the file, in units of ``every_s``. ``turned`` [vehicles, 2] is
    the result of ``_directions``, for highD only.
    """
    if entry.gaps:
        return _of_gaps(piece, entry, ticks)
    columns, at = dict(zip(entry.columns, piece.values.T, strict=True)), list(entry.columns).index
    for role in ("id", "lane", "preceding") if not entry.texts else ():
        if role in columns:
            value, least = columns[role], entry.alone if role == "preceding" else 0.0
            odd, right = (value != np.rint(value)) | (value < least), f"must be a whole number, {least:g} or above"
            piece.refuse(odd, at(role), right)
    zero = np.zeros(len(ticks))
    who, lane, ahead = columns["id"], columns.get("lane", zero), columns.get("preceding", zero - 1.0)
    ahead = np.where(ahead == entry.alone, -1.0, ahead)
    front, side, length = (columns.get(role, zero) * entry.metres for role in ("front", "side", "length"))
    dx, dy, speed = zero + 1.0, zero, columns["speed"] * entry.mps
    right = f"m: the length must be above 0 and at most {LONGEST_M:g} m; {entry.title} is in {entry.units}"
    piece.refuse((length <= 0.0) | (length > LONGEST_M), at("length"), right, length)
    if entry.title == "highD":
        place = np.searchsorted(turned[:, 0], who).clip(max=len(turned) - 1)
        odd = (turned[place, 0] != who) | ~np.isin(turned[place, 1], (1.0, 2.0))
        piece.refuse(odd, at("id"), "must have the drivingDirection 1 or 2 in its tracksMeta.csv")
        right_hand = turned[place, 1] == 2.0  # x is the left edge of the vehicle and grows to the right
        front, speed = np.where(right_hand, front + length, -front), speed * np.where(right_hand, 1.0, -1.0)
    elif entry.title == "exiD":  # x and y are the centre of the vehicle
        dx, dy = np.cos(np.deg2rad(columns["heading"])), np.sin(np.deg2rad(columns["heading"]))
        front, side = front + length / 2.0 * dx, side + length / 2.0 * dy
    right = f"m/s: the speed must be at most {FASTEST_MPS:g} m/s; {entry.title} is in {entry.units}"
    piece.refuse(speed > FASTEST_MPS, at("speed"), right, speed)
    return np.column_stack([ticks, who, lane, ahead, front, side, dx, dy, length, speed, piece.lines])


def _of_gaps(piece: Piece, entry: Format, ticks: Floats) -> Floats:
    """Return the states in the rows ``piece`` of an OpenACC file, like ``_states``.

    Car k + 1 follows car k if the speeds of both cars and the gap between these cars (column ``IVS`` with the number k)
    are recorded. The first car of a queue has position 0. The position of every other car is minus the sum of the
    gaps between it and the first car of its queue.
    """
    at = {name.lower(): k for k, name in enumerate(piece.columns)}
    cars = sorted(int(name.removeprefix("speed")) for name in at if name.startswith("speed"))
    ivs = {k: f"ivs{k - 1}" for k in cars if f"ivs{k - 1}" in at and k - 1 in cars}
    if not ivs:
        raise InvalidInput(
            f"{piece.file}: none of the columns {', '.join(piece.columns[1:])} is the gap between two cars; the file"
            " must have the speeds of two cars and the gap between them, such as Speed1, Speed2 and IVS1"
        )
    right = f"m/s: the speed must be at most {FASTEST_MPS:g} m/s; {entry.title} is in {entry.units}"
    for k in cars:
        column = at[f"speed{k}"]
        piece.refuse(piece.values[:, column] > FASTEST_MPS, column, right)
    n, none = len(cars), np.zeros((len(ticks), len(cars)))
    speeds = np.column_stack([piece.values[:, at[f"speed{k}"]] for k in cars])
    gaps = np.column_stack([piece.values[:, at[ivs[k]]] if k in ivs else np.full(len(ticks), np.nan) for k in cars])
    farthest = QUANTITY.usual["gaps_m"].high
    for k, name in ivs.items():
        piece.refuse(abs(gaps[:, cars.index(k)]) > farthest, at[name], f"m: the gap must be at most {farthest:g} m")
    linked = np.isfinite(gaps) & np.isfinite(speeds)
    linked[:, 1:] &= np.isfinite(speeds[:, :-1])
    behind, numbers = np.cumsum(np.where(linked, gaps, 0.0), axis=1), np.tile(np.array(cars, float), (len(ticks), 1))
    ahead = np.where(linked, numbers - 1.0, -1.0)
    tick, line = (np.repeat(each[:, None], n, axis=1) for each in (ticks, piece.lines))
    fields = [tick, numbers, none, ahead, -behind, none, none + 1.0, none, none, speeds, line]
    return np.stack(fields, axis=-1)[np.isfinite(speeds)]
