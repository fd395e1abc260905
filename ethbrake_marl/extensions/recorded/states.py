"""Convert the columns of a recording to states of vehicles: position, direction, length and speed, in m and m/s."""

from __future__ import annotations

import re
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from ethbrake_marl.errors import InvalidInput, plain_text
from ethbrake_marl.extensions.recorded.formats import HIGHD_META, Format
from ethbrake_marl.extensions.recorded.interpolation import Between, interpolated, rows_between
from ethbrake_marl.extensions.recorded.reading import Cells, read_cells
from ethbrake_marl.motion.layout import Bools, Floats, Ints
from ethbrake_marl.worlds.quantities import QUANTITIES

FASTEST_MPS, LONGEST_M = 75.0, 40.0  # largest speed (270 km/h) and length of a road vehicle

FARTHEST_M = QUANTITIES["gaps_m"].high  # longest gap that a scenario may have

# Range of the lengths of cars and vans (m), and the least share of such vehicles. Lengths in feet violate it.
CAR_M, LEAST_CARS = (2.5, 8.0), 1 / 3

# Allowed ratio: recorded change of positions / change that follows from the speeds. It is 3.28 if a file mixes feet and
# metres. It is checked if the squared distances driven in a lane sum up to LEAST_M2: one drive of 10 m.
SLOPE, LEAST_M2 = (0.5, 2.0), 100.0

NOISE_M, HARDEST_MPS2 = 3.0, 10.0  # error of a place, and largest acceleration between two moments
NUMERAL = r"[+-]?\d+\.?\d*"
NO_NAME = ("", "nan", "none", "null")  # cells without a name, in lower case


class Recording(NamedTuple):
    """States of the vehicles of one file at regular moments.

    ``states`` has one row for each vehicle and moment, sorted by ``moment`` (its number, from 0) and ``vehicle`` (its
    number). Further columns: ``lane``; ``ahead``, number of the vehicle ahead, negative if there is none; ``front`` and
    ``side``, x and y of the vehicle's front (m); ``dx`` and ``dy``, unit vector of its direction of travel (1 and 0 if
    positions are along the road); ``length`` (m), 0 if the data contain gaps; ``speed`` (m/s); ``row``, number of the
    row in the file; ``odd``, whether the vehicle's other places contradict this one.
    """

    cells: Cells
    entry: Format
    states: Any
    names: dict[float, str]  # number of a vehicle or lane -> its name, if files have names instead of numbers
    interpolated: int  # number of states between two rows of the vehicle
    unread: Any  # further vehicles on the road, without a row near the moment; same columns as ``states``

    def name(self, number: float) -> str:
        return self.names.get(number) or f"{number:.0f}"


def read_recording(file: Path, entry: Format, every_s: float) -> Recording:
    """States of the vehicles in a file every ``every_s`` seconds, from the file's first moment on.

    Raises ``InvalidInput``, with file, line and column, for an impossible value, and if positions contradict the
    speeds.
    """
    cells, names = read_cells(file, entry), dict[float, str]()
    raw = cells.frame
    if raw.empty:
        right = f" except those from {' and '.join(entry.streets)}, which have crossings" * bool(entry.streets)
        raise InvalidInput(f"{file}: contains no rows of data{right}")
    if "lane" in entry.texts:
        names = _number_names(raw, cells)
    vehicle = np.zeros(len(raw), np.int64) if entry.gaps else pd.factorize(raw["vehicle"])[0]
    moment, between = moments(raw["time"].to_numpy() / entry.per_second, vehicle, every_s)
    places = raw.index
    is_used = moment >= 0.0
    is_used[between.before] = is_used[between.after] = True
    raw = raw.assign(moment=moment)[is_used]
    if entry.gaps:
        states = _openacc(raw, cells, entry)
    else:
        states = _along_road(raw, cells, entry)
        if entry.title == "highD":
            _turn_highd(states, cells)
        elif entry.title == "exiD":
            _turn_exid(states, raw)
        _check(states, cells, entry)
    states["row"] = states.index
    between = between._replace(before=places[between.before], after=places[between.after])
    more, unread = interpolated(states, between)
    states = pd.concat([states[states["moment"] >= 0.0], more])
    states = states.sort_values(list(states), ignore_index=True)
    on_road = pd.concat([states, unread], ignore_index=True)
    on_road["odd"] = False
    if not entry.gaps:
        on_road["odd"] = odd_places(on_road, every_s)
    recording = Recording(cells, entry, on_road[: len(states)], names, len(more), on_road[len(states) :])
    if not entry.gaps:
        _check_positions(recording, every_s)
    return recording


def odd_places(states: Any, every_s: float) -> Bools:
    """Whether a vehicle's other places contradict the place of a state, such as a mark of a missing value, [states].

    From the longest part of a vehicle's way without a contradiction, the search goes on to both sides, past places that
    contradict the last one that did not. If half of the places are odd, all are.
    """
    odd = np.zeros(len(states), np.bool_)
    columns = states[["front", "side", "dx", "dy", "speed"]].to_numpy()
    times_s = states["moment"].to_numpy() * every_s

    def contradicts(early: Any, late: Any) -> Any:
        (x, y, dx, dy, v), (x_then, y_then, _, _, v_then) = columns[early].T, columns[late].T
        way, time_s = (x_then - x) * dx + (y_then - y) * dy, times_s[late] - times_s[early]
        error = np.abs(way - (v + v_then) / 2.0 * time_s)
        is_possible = (way >= -NOISE_M) & (way <= FASTEST_MPS * time_s + NOISE_M)
        return ~(is_possible & (error <= NOISE_M + HARDEST_MPS2 / 4.0 * time_s * time_s))

    for places in states.groupby("vehicle").indices.values():
        places = places[np.argsort(times_s[places], kind="stable")]
        jumps = np.flatnonzero(contradicts(places[:-1], places[1:])) + 1
        if not len(jumps):
            continue
        longest = max(np.split(places, jumps), key=len)
        first, last = longest[0], longest[-1]
        for place in places[places.tolist().index(last) + 1 :]:
            odd[place] = contradicts(last, place)
            last = last if odd[place] else place
        for place in places[: places.tolist().index(first)][::-1]:
            odd[place] = contradicts(place, first)
            first = first if odd[place] else place
        odd[places] |= 2 * odd[places].sum() >= len(places)
    return odd


def moments(times_s: Floats, vehicle: Ints, every_s: float) -> tuple[Floats, Between]:
    """Number of the moment for which each row is used, [rows] floats, -1: not used; and vehicles without such a row.

    Moment k, ``min(times_s) + k every_s``, uses the nearest recorded time, at most half a recording step (the smallest
    difference between recorded times of a vehicle) away. Raises ``InvalidInput`` if ``every_s`` is less than this step.
    """
    recorded, back = np.unique(np.round(times_s - times_s.min(), 6), return_inverse=True)
    order = np.lexsort((back, vehicle))
    steps = np.diff(recorded[back[order]])[np.diff(vehicle[order]) == 0]
    step = steps[steps > 0.0].min(initial=np.inf)
    if step == np.inf:  # no vehicle is recorded twice
        step = np.diff(recorded).min(initial=every_s)
    if every_s < 0.99 * step:
        raise InvalidInput(
            f"every = {every_s:g} s: the time between the moments that are read must be at least {step:g} s, the time"
            " between recorded moments"
        )
    number = np.rint(recorded / every_s)
    off = np.abs(recorded - number * every_s)
    order = np.lexsort((off, number))
    nearest = order[np.flatnonzero(np.diff(number[order], prepend=-1.0))]
    nearest = nearest[off[nearest] <= 0.51 * step]
    out = np.full(len(recorded), -1.0)
    out[nearest] = number[nearest]
    return np.asarray(out[back]), rows_between(recorded, back, vehicle, number[nearest], nearest, float(step))


def _number_names(raw: Any, cells: Cells) -> dict[float, str]:
    """Names of vehicles and lanes, number -> name; in ``raw``, the numbers replace them."""
    for column in ("vehicle", "lane"):
        cells.refuse(raw[column].str.lower().isin(NO_NAME), column, raw[column], "must be a name")
    text = pd.concat([raw["vehicle"], raw["lane"]]).drop_duplicates()
    names = pd.DataFrame({"number": pd.to_numeric(text, errors="coerce"), "text": text}).sort_values(["number", "text"])
    exact = {name: exact_name(name) for name in names["text"]}
    numbers = {key: float(k) for k, key in enumerate(dict.fromkeys(exact.values()))}
    for column in ("vehicle", "lane"):
        raw[column] = raw[column].map({name: numbers[key] for name, key in exact.items()})
    return {numbers[key]: plain_text(name) for name, key in reversed(exact.items())}


def exact_name(name: str) -> Decimal | str:
    """Numbers that are equal, such as 1 and 1.0, are one name."""
    return Decimal(name) if re.fullmatch(NUMERAL, name) else name


def _along_road(raw: Any, cells: Cells, entry: Format) -> Any:
    zero = pd.Series(0.0, raw.index)
    for role, least in (("vehicle", 0.0), ("lane", 0.0), ("ahead", entry.alone)):
        if role in raw:
            odd = (raw[role] != raw[role].round()) | (raw[role] < least)
            cells.refuse(odd, role, raw[role], f"must be a whole number, {least:g} or above")
    ahead = raw.get("ahead", zero - 1.0)
    return pd.DataFrame(
        {
            "moment": raw["moment"], "vehicle": raw["vehicle"], "lane": raw.get("lane", zero),
            "ahead": ahead.where(ahead != entry.alone, -1.0), "front": raw["front"] * entry.metres,
            "side": raw.get("side", zero) * entry.metres, "dx": zero + 1.0, "dy": zero,
            "length": raw["length"] * entry.metres, "speed": raw["speed"] * entry.mps,
        }
    )  # fmt: skip


def _turn_highd(states: Any, cells: Cells) -> None:
    """Turn highD's positions (left edges, whichever way a vehicle drives) into fronts that grow, in place."""
    meta = read_cells(Path(f"{str(cells.file)[:-4]}Meta.csv"), HIGHD_META).frame
    direction = states["vehicle"].map(meta.drop_duplicates("vehicle").set_index("vehicle")["direction"])
    right = "must have the drivingDirection 1 or 2 in its tracksMeta.csv"
    cells.refuse(~direction.isin([1.0, 2.0]), "vehicle", states["vehicle"], right)
    to_right = direction == 2.0
    states["front"] = (states["front"] + states["length"]).where(to_right, -states["front"])
    states["speed"] = states["speed"].where(to_right, -states["speed"])


def _turn_exid(states: Any, raw: Any) -> None:
    heading = np.deg2rad(raw["heading"])
    states["dx"], states["dy"] = np.cos(heading), np.sin(heading)
    states["front"] += states["length"] / 2.0 * states["dx"]
    states["side"] += states["length"] / 2.0 * states["dy"]


def _check(states: Any, cells: Cells, entry: Format) -> None:
    """Raise ``InvalidInput`` for an impossible length or speed, and if too few vehicles are as long as cars."""
    length, speed = states["length"], states["speed"]
    right = f"m: the length must be above 0 and at most {LONGEST_M:g} m; {entry.title} is in {entry.units}"
    cells.refuse((length <= 0.0) | (length > LONGEST_M), "length", length, right)
    right = f"m/s: the speed must be at most {FASTEST_MPS:g} m/s; {entry.title} is in {entry.units}"
    cells.refuse(speed > FASTEST_MPS, "speed", speed, right)
    cars = int(length.between(*CAR_M, inclusive="neither").sum())
    if cars < LEAST_CARS * len(states):
        raise InvalidInput(
            f"{cells.file}: only {cars:,} of {len(states):,} vehicles are {CAR_M[0]:g} to {CAR_M[1]:g} m long, but at"
            f" least a third should be; lengths and speeds must be in {entry.units}"
        )


def _check_positions(recording: Recording, every_s: float) -> None:
    """Raise ``InvalidInput`` if, in some lane, positions change much more or less than speeds imply, or backwards."""
    cells, entry, now = recording.cells, recording.entry, recording.states
    if now["odd"].mean() <= entry.impossible:
        now = now[~now["odd"]]
    then = now[["moment", "vehicle", "lane", "front", "side", "speed"]].assign(moment=now["moment"] + 1.0)
    pairs = now.merge(then, on=["moment", "vehicle", "lane"], suffixes=("", "_then"))
    along = (pairs["front"] - pairs["front_then"]) * pairs["dx"] + (pairs["side"] - pairs["side_then"]) * pairs["dy"]
    said = (pairs["speed"] + pairs["speed_then"]) / 2.0 * every_s
    lanes = pairs.assign(said2=said * said, product=along * said, said=said).groupby("lane")
    for lane, said2, product, way in lanes[["said2", "product", "said"]].sum().itertuples():
        if said2 >= LEAST_M2 and not (SLOPE[0] < product / said2 < SLOPE[1] and way > 0.0):
            raise InvalidInput(
                f"{cells.file}: in lane {recording.name(lane)}, positions (column {cells.names['front']}) change by"
                f" {product / said2:.2f} times the distance that the speeds"
                f" imply{'' if way > 0.0 else ', and the speeds are negative'}; positions must increase in the"
                f" direction of travel, speeds must be above 0, and both columns must be in {entry.units}"
            )


def _openacc(raw: Any, cells: Cells, entry: Format) -> Any:
    """States of cars whose speeds and gaps were recorded in numbered columns; a position is minus the sum of the gaps
    ahead.

    Car k + 1 follows car k if the speeds of both cars and the gap between them (column ``IVS`` with the number k) are
    recorded.
    """
    cars = sorted(int(name.removeprefix("speed")) for name in raw if name.startswith("speed"))
    gap_of = {k: f"gap{k - 1}" for k in cars if k - 1 in cars and f"gap{k - 1}" in raw}
    if not gap_of:
        raise InvalidInput(
            f"{cells.file}: no column is the gap between two cars; the file must have the speeds of two cars and the"
            " gap between them, such as Speed1, Speed2 and IVS1"
        )
    limits = {f"speed{k}": (f"m/s: the speed must be at most {FASTEST_MPS:g} m/s", FASTEST_MPS) for k in cars}
    limits |= {gap: (f"m: the gap must be at most {FARTHEST_M:g} m", FARTHEST_M) for gap in gap_of.values()}
    for name, (right, most) in limits.items():
        cells.refuse(abs(raw[name]) > most, name, raw[name], f"{right}; {entry.title} is in {entry.units}")
    speeds = raw[[f"speed{k}" for k in cars]].to_numpy()
    gaps = np.column_stack([raw[gap_of[k]] if k in gap_of else np.full(len(raw), np.nan) for k in cars])
    linked = np.isfinite(gaps) & np.isfinite(speeds)
    linked[:, 1:] &= np.isfinite(speeds[:, :-1])
    numbers = np.tile(np.array(cars, float), (len(raw), 1))
    return pd.DataFrame(
        {
            "moment": raw["moment"].repeat(len(cars)), "vehicle": numbers.ravel(), "lane": 0.0,
            "ahead": np.where(linked, numbers - 1.0, -1.0).ravel(),
            "front": -np.cumsum(np.where(linked, gaps, 0.0), axis=1).ravel(), "side": 0.0, "dx": 1.0, "dy": 0.0,
            "length": 0.0, "speed": speeds.ravel(),
        }
    ).dropna()  # fmt: skip
