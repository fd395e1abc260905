"""Make scenarios from recorded traffic: chains of vehicles in highD, NGSIM or OpenACC become rows of initial states.

Each file is read once, in pieces. Its states at regular times go into a private file on disk, which returns them
ordered by time. So memory holds only one piece of a file, one moment, and the rows of the result.
"""

from __future__ import annotations

import io
import math
import re
import sqlite3
from collections import Counter, namedtuple
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from itertools import count, groupby, islice
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, count_of, plain_text
from ethbrake_marl.files.plain import open_plain
from ethbrake_marl.files.yaml import flow_text, parse_numeral
from ethbrake_marl.physics.elementary import exp, log
from ethbrake_marl.physics.state import Bools, Floats
from ethbrake_marl.scenario.catalogue import check_file_name, load_scenario
from ethbrake_marl.scenario.fields import QUANTITY
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.vehicle_types import MOST_NUMBERS

DataFormat = Literal["highd", "ngsim", "openacc"]

DataDraw = Literal["rows", "normal", "lognormal", "quantiles"]  # how the scenario draws its worlds

PIECE, HEAD = 50_000, 10  # lines read at once; number of first lines in which the header is searched

LONGEST_LINE, LARGEST_BYTES = 1 << 16, 1 << 40  # limits of a line (characters) and of a file

FASTEST_MPS, LONGEST_M = 75.0, 40.0  # limits of a road vehicle: 270 km/h, and more than any road train in the data

CAR_M, LEAST_CARS = (2.5, 8.0), 1 / 3  # range of lengths of cars and vans, and their least share, to detect feet

# Allowed ratio of the change of gaps to the change by the speeds (3.28 if units mix feet and metres), and the least
# correlation of the two for this check.
SLOPE, CORRELATED = (0.5, 2.0), 0.7

QUANTILES = 40

SLOWEST_MPS, LONGEST_S = 0.5, 60.0  # least speed and longest time gap of rows that are used for fits


class _Format(NamedTuple):
    """One of the formats of recorded traffic: its files, columns, units and licence."""

    title: str  # name of the data set, for users
    files: str  # pattern of the names of its files
    # Names of the columns to read, in the order of the fields of ``_State``. A name ending in 1 stands for one column
    # per vehicle: ``Speed1``, ``Speed2``, ...
    columns: tuple[str, ...]
    units: str  # units of lengths and speeds, for messages
    licence: str  # sentence about its licence, for the scenario's ``source``
    metres: float = 1.0  # number of metres in a unit of length of the files
    ticks: float = 1.0  # number of ticks (intervals between recorded moments) per unit of time of the files
    hertz: float = 10.0  # number of ticks in a second
    # Largest accepted share of vehicles with a fault (overlap, missing leader). Faulty vehicles are left out.
    impossible: float = 0.0
    elsewhere: tuple[str, ...] = ()  # lines of a file that contain one of these texts (names of streets) are left out
    blanks: bool = False  # True if empty cells mean that nothing was measured


FORMATS: dict[DataFormat, _Format] = {
    "highd": _Format(
        "highD", "*_tracks.csv", ("frame", "id", "laneId", "precedingId", "x", "width", "xVelocity"), "m and m/s",
        "highD is lent on request for non-commercial use and must not be passed on: these rows are for you alone.",
        hertz=25.0,
    ),
    "ngsim": _Format(
        "NGSIM", "*.csv", ("Global_Time", "Vehicle_ID", "Lane_ID", "Preceding", "Local_Y", "v_Length", "v_Vel"),
        "feet and feet/s", "NGSIM is of the US Department of Transportation: read its terms, and name the source."
        " Streets with crossings (lankershim, peachtree) are left out.",
        metres=0.3048, ticks=0.01, impossible=0.05, elsewhere=("lankershim", "peachtree"),
    ),
    "openacc": _Format(
        "OpenACC", "*.csv", ("Time", "Speed1", "IVS1"), "m and m/s",
        "OpenACC is open data of the European Commission's Joint Research Centre: read its terms, and name the source.",
        ticks=10.0, impossible=0.01, blanks=True,
    ),
}  # fmt: skip

_OF_A_ROW = QUANTITY.usual["gaps_m"], QUANTITY.usual["speeds_mps"]

_REPLACED = ("gaps_m", "speeds_mps", "time_gaps_s", "line_speed_mps", "speed_deviations_mps")

_OTHER_NAMES = {"preceeding": "preceding"}  # misspelt column in some files of NGSIM

# A vehicle at a moment. ``front`` is its position in m along the direction of travel; ``length`` is 0 if the data hold
# gaps.
_State = namedtuple("_State", "tick id lane preceding front length speed line")


def scenario_from_data(
    name: str,
    folder: Path,
    format: DataFormat,
    *,
    based_on: str = "realistic-motorway",
    every_s: float = 1.0,
    draw: DataDraw = "rows",
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> tuple[str, str, list[str]]:
    """Make a scenario from a folder of recordings. Return its YAML text, the CSV text of its rows, and notes.

    At regular times, queues of vehicles are cut from the front into chains of as many vehicles as ``based_on`` has; a
    vehicle belongs to at most one chain. Each chain is a row of speeds and gaps. If there are more rows than a table
    may hold, every k-th row is kept.

    Args:
        name: name of the scenario.
        folder: folder with the files.
        format: format of the files.
        based_on: scenario for everything that is not recorded, and for the number of vehicles.
        every_s: time between two moments that become rows (s).
        draw: how the scenario draws worlds: whole ``rows``, or each quantity from a fit to the rows.
        progress: called with the name of a file, the KiB read of it, and its size in KiB.

    Raises ``InvalidInput`` with file, line and column for a missing column, a cell that is not a number, or an
    impossible value.

    """
    entry, base = FORMATS[format], load_scenario(based_on)
    check_file_name("scenario", name)
    stride = every_s * entry.hertz
    if not (1.0 <= stride < 1e9 and abs(stride - round(stride)) < 1e-6):
        raise InvalidInput(
            f"every = {every_s:g} s: must be a multiple of {1 / entry.hertz:g} s, as {entry.title} has it"
        )
    if base.members or base.table is not None:
        raise InvalidInput(f"based_on = {based_on!r}: must be a scenario without mixture and table")
    vehicles, left_out = base.vehicles, Counter[str]()
    columns = [rule.column_of(i) for rule in _OF_A_ROW for i in range(rule.count(vehicles))]
    files = sorted(each for each in folder.glob(entry.files) if not each.name.startswith("."))
    if not files:
        raise InvalidInput(f"{folder}: must be a folder with {entry.files}, the files of {entry.title}")
    with closing(sqlite3.connect("")) as store:  # a temporary file on disk
        store.executescript(f"CREATE TABLE chain({','.join(columns)}); CREATE TABLE state({','.join(_State._fields)})")
        try:
            for file in files:
                _keep_states(store, file, format, round(stride), partial(progress, file.name))
                _cut_chains(store, file, entry, round(stride), vehicles, left_out)
                store.execute("DELETE FROM state")
            ((seen,),) = store.execute("SELECT COUNT(*) FROM chain")
            each_of = seen * len(columns) // MOST_NUMBERS + 1
            kept = store.execute("SELECT * FROM chain WHERE rowid % ? = 0", (each_of,)).fetchall()
        except sqlite3.Error as error:
            raise InvalidInput(f"{folder}: cannot be ordered by time ({error})") from None
    if not kept:
        raise InvalidInput(f"{folder}: no {vehicles} vehicles follow each other in a lane at any moment looked at")
    left_out[f"chains: a table holds {MOST_NUMBERS:,} numbers, so one in {each_of} is kept"] = seen - len(kept)
    told = [
        f"{count_of(seen, 'chain')} of {vehicles} vehicles, every {every_s:g} s, each vehicle in one of them at most"
    ]
    told += [f"left out: {number:,} {what}" for what, number in sorted(left_out.items()) if number]
    fastest_mps = max(max(row[vehicles - 1 :]) for row in kept)
    at_rest_s = np.max(base.bounds("latency_s")) + fastest_mps / np.min(base.bounds("braking_capacity_mps2"))
    content = {key: value for key, value in base.declared().items() if key not in _REPLACED} | {
        "name": name,
        "title": f"{entry.title}, {'row by row' if draw == 'rows' else f'{draw} of each quantity'}",
        "description": f"Speeds and gaps of {count_of(len(files), 'recording')} of {entry.title}. Brakes, masses and"
        f" latencies, which nobody recorded, are as in {base.name}.",
        "source": f"{entry.title}, recorded in {entry.units}, folder {plain_text(folder.resolve().name)}."
        f" {'; '.join(told)}. {entry.licence}",
        "horizon_s": max(base.horizon_s, math.ceil(at_rest_s) + 1.0),
        **({"table": {"columns": columns, "rows": kept}} if draw == "rows" else _fits(np.array(kept), draw)),
    }
    if np.min(base.bounds("speed_limit_mps")) < fastest_mps:
        content["speed_limit_mps"] = math.ceil(fastest_mps)
    load_scenario(content)
    if draw == "rows":
        content["table"] = {"file": f"{name}.csv", "columns": columns}
    text = "".join(f"{key}: {flow_text(content[key])}\n" for key in Scenario.model_fields if key in content)
    csv = "\n".join([",".join(columns), *(",".join(map(str, row)) for row in kept), ""])
    return text, csv, told


def _fits(rows: Floats, draw: DataDraw) -> dict[str, Any]:
    """Return keys of a scenario with independent fits to time gaps, mean speed of a row, and deviations from it.

    ``rows`` [k, 2 N - 1] holds the gaps (m) and speeds (m/s) of each chain; ``draw`` is the kind of fit.
    """
    gaps, speeds = np.split(rows, [rows.shape[1] // 2], axis=1)
    times = gaps / np.maximum(speeds[:, 1:], SLOWEST_MPS)
    used = (speeds >= SLOWEST_MPS).all(axis=1) & ((times > 0.0) & (times <= LONGEST_S)).all(axis=1)
    if used.sum() < QUANTILES:
        raise InvalidInput(f"draw = {draw}: {used.sum()} rows have time gaps to fit; at least {QUANTILES} are needed")
    line = speeds[used].mean(axis=1)
    off = speeds[used] - line[:, None]
    signed: DataDraw = "normal" if draw == "lognormal" else draw
    return {
        "time_gaps_s": [_fit(each, draw) for each in times[used].T],
        "line_speed_mps": _fit(
            np.clip(line, -off.min(), speeds.max() - off.max()), signed
        ),  # so that mean plus deviation stays in range
        "speed_deviations_mps": [_fit(each, signed) for each in off.T],
    }


def _fit(values: Floats, draw: DataDraw) -> Any:
    """Return a distribution for a scenario file, fitted to ``values`` [k] and limited to their range.

    ``draw`` is its kind: ``normal``, ``lognormal`` or ``quantiles``.
    """
    low, high = float(values.min()), float(values.max())
    if draw == "quantiles" or low == high:
        return {"choice": np.quantile(values, (np.arange(QUANTILES) + 0.5) / QUANTILES).tolist()}
    if draw == "lognormal":
        logs = np.array([log(value) for value in values])
        median, sigma = exp(logs.mean()), float(logs.std())
        return {"lognormal": {"median": median, "sigma": sigma, "low": low, "high": high}}
    return {"normal": {"mean": float(values.mean()), "sd": float(values.std()), "low": low, "high": high}}


def _keep_states(
    store: sqlite3.Connection, file: Path, format: DataFormat, stride: int, progress: Callable[[int, int], None]
) -> None:
    """Write the vehicles of a file at every ``stride``-th tick (recorded moment) into the table ``state`` of ``store``.

    ``progress`` is called with the KiB read and the size of the file in KiB.
    """
    entry, turned, first, cars, states = FORMATS[format], np.empty((0, 2)), None, 0, 0
    if format == "highd":
        meta = _numbers(Path(f"{str(file)[:-4]}Meta.csv"), entry, ("id", "drivingDirection"), lambda *_: None)
        turned = np.concatenate([each for each, _ in meta])
        turned = turned[np.argsort(turned[:, 0])]
    for values, lines in _numbers(file, entry, entry.columns, progress):
        first = values[0, 0] if first is None else first
        ticks = (values[:, 0] - first) * entry.ticks
        odd, right = (
            abs(ticks - np.rint(ticks)) > 0.01,
            f"must be a multiple of {1 / entry.hertz:g} s from the first on",
        )
        _refuse(odd, file, lines, entry.columns[0], values[:, 0], right)
        values[:, 0], taken = np.rint(ticks), np.rint(ticks) % stride == 0.0
        kept = _states(values[taken], lines[taken], file, format, turned)
        store.executemany(f"INSERT INTO state VALUES ({', '.join('?' * 8)})", kept.tolist())
        cars, states = cars + int(((kept[:, 5] > CAR_M[0]) & (kept[:, 5] < CAR_M[1])).sum()), states + len(kept)
    if not entry.blanks and cars < LEAST_CARS * states:
        raise InvalidInput(
            f"{file}: {cars:,} of {states:,} vehicles are {CAR_M[0]:g} to {CAR_M[1]:g} m long, fewer than a third; its"
            f" lengths and speeds must be in {entry.units}"
        )


def _states(values: Floats, lines: Floats, file: Path, format: DataFormat, turned: Floats) -> Floats:
    """Return the fields of ``_State`` for each vehicle and moment, [rows, 8], in m and m/s.

    Args:
        values: [rows, columns] numbers of the file, in the order of the format's columns.
        lines: [rows] line number of each row in the file.
        file: the file, for messages.
        format: its format.
        turned: [vehicles, 2] id and driving direction of each vehicle, sorted by id; only used for highD.

    Raises ``InvalidInput`` with file, line and column for an impossible value.

    """
    entry = FORMATS[format]
    states, fastest = np.column_stack([values, lines]), entry.columns[-1]
    if format == "openacc":
        n, fastest = values.shape[1] // 2, "Speed"
        speeds, gaps = values[:, 1 : n + 1], values[:, n + 1 :]
        linked = np.isfinite(gaps) & np.isfinite(speeds[:, :-1] + speeds[:, 1:])
        behind = np.pad(np.cumsum(np.where(linked, gaps, 0.0), axis=1), ((0, 0), (1, 0)))
        numbers, none = np.tile(np.arange(1.0, n + 1), (len(values), 1)), np.zeros(speeds.shape)
        ahead = np.pad(np.where(linked, numbers[:, :-1], 0.0), ((0, 0), (1, 0)))
        moment, line = (np.repeat(each[:, None], n, axis=1) for each in (values[:, 0], lines))
        states = np.stack([moment, numbers, none, ahead, -behind, none, speeds, line], axis=-1)[np.isfinite(speeds)]
    else:
        for k in (1, 2, 3):
            odd, right = (
                (states[:, k] != np.rint(states[:, k])) | (states[:, k] < 0.0),
                "must be a whole number, 0 or above",
            )
            _refuse(odd, file, lines, entry.columns[k], states[:, k], right)
        states[:, 4:7] *= entry.metres
        odd, right = (states[:, 5] <= 0.0) | (states[:, 5] > LONGEST_M), f"m of length: must be in (0, {LONGEST_M:g}]"
        _refuse(odd, file, lines, entry.columns[5], states[:, 5], f"{right}; {entry.title} has {entry.units}")
    if format == "highd":
        place = np.searchsorted(turned[:, 0], states[:, 1]).clip(max=len(turned) - 1)
        odd = (turned[place, 0] != states[:, 1]) | ~np.isin(turned[place, 1], (1.0, 2.0))
        _refuse(odd, file, lines, "id", states[:, 1], "must have the drivingDirection 1 or 2 in its tracksMeta.csv")
        right_hand = turned[place, 1] == 2.0  # x is the left edge of the vehicle and grows to the right
        states[:, 4] = np.where(right_hand, states[:, 4] + states[:, 5], -states[:, 4])
        states[:, 6] *= np.where(right_hand, 1.0, -1.0)
    right = f"m/s; must be at most {FASTEST_MPS:g}; {entry.title} has {entry.units}"
    _refuse(states[:, 6] > FASTEST_MPS, file, states[:, 7], fastest, states[:, 6], right)
    return states


def _cut_chains(
    store: sqlite3.Connection, file: Path, entry: _Format, stride: int, vehicles: int, left_out: Counter[str]
) -> None:
    """Cut the queues of vehicles of one file into rows, and write them into the table ``chain`` of ``store``.

    Vehicles are linked to those ahead at each moment. Gaps are checked against speeds.

    Args:
        store: database whose table ``state`` holds the vehicles of the file.
        file: the file, for messages.
        entry: its format.
        stride: ticks between two moments.
        vehicles: number of vehicles in a row.
        left_out: counts what was left out, by description; it is updated.

    """
    first_fault, faults, states, last = "", 0, 0, math.nan
    before: dict[float, tuple[float, float, Any]] = {}
    sums = np.zeros(3)  # sums of squares and product of the change of gaps and of the change by the speeds
    for tick, moment in groupby(store.execute("SELECT * FROM state ORDER BY tick, line"), itemgetter(0)):
        there = [_State(*state) for state in moment]
        by_id = {state.id: state for state in reversed(there)}
        behind: dict[float, tuple[float, float, Any]] = {}  # by vehicle id: gap behind it, opening speed, follower
        for state in there:
            ahead: Any = by_id.get(state.preceding) if state.preceding else None
            gap = ahead.front - ahead.length - state.front if ahead else math.nan
            fault = (
                f"is there at that time in line {by_id[state.id].line:.0f}, too" if by_id[state.id] is not state
                else f"follows vehicle {state.preceding:.0f}, which is not there" if state.preceding and not ahead
                else f"overlaps vehicle {ahead.id:.0f} ahead by {-gap:.2f} m" if gap <= 0.0 and ahead.lane == state.lane
                else ""
            )  # fmt: skip
            if fault:
                first_fault = first_fault or f"{file}, line {state.line:.0f}: vehicle {state.id:.0f} {fault}"
                faults += 1
            elif ahead and (ahead.lane != state.lane or min(ahead.speed, state.speed) < 0.0):
                left_out["links to another lane, or of a vehicle that rolls backwards"] += 1
            elif ahead and gap < behind.get(ahead.id, (math.inf,))[0]:
                behind[ahead.id] = gap, ahead.speed - state.speed, state
        for each in behind.keys() & before.keys() if tick - last == stride else ():
            (gap, rate, state), (gap_before, rate_before, follower) = behind[each], before[each]
            if state.id == follower.id:
                opened, said = gap - gap_before, (rate + rate_before) / 2.0 * stride / entry.hertz
                sums += opened * opened, said * said, opened * said
        rows, followers = list[list[float]](), {state.id for *_, state in behind.values()}
        for queue in [[(0.0, 0.0, state)] for state in reversed(by_id.values()) if state.id not in followers]:
            while queue[-1][2].id in behind:
                queue.append(behind[queue[-1][2].id])
            for k in range(0, len(queue) - vehicles + 1, vehicles):
                row = [gap for gap, *_ in queue[k + 1 : k + vehicles]] + [
                    each.speed for *_, each in queue[k : k + vehicles]
                ]
                rows.append([round(number, 3) + 0.0 for number in row])
            left_out["vehicles that were too few, or left over, at the end of a queue"] += len(queue) % vehicles
        store.executemany(f"INSERT INTO chain VALUES ({', '.join('?' * (2 * vehicles - 1))})", rows)
        states, before, last = states + len(there), behind, tick
    if faults > entry.impossible * states:
        raise InvalidInput(
            f"{first_fault}; {faults:,} of {states:,} are like that, at most {entry.impossible:.0%} may be"
        )
    left_out["vehicles that overlap, are there twice, or follow one that is not there"] += faults
    opened, said, product = sums.tolist()
    if product > CORRELATED * math.sqrt(opened * said) > 0.0 and not SLOPE[0] < product / said < SLOPE[1]:
        raise InvalidInput(
            f"{file}: gaps change {product / said:.2f} times as much as speeds say (feet beside m/s give 3.28, metres"
            f" beside km/h 0.28); {entry.title} has {entry.units}"
        )


def _numbers(
    file: Path, entry: _Format, columns: Sequence[str], progress: Callable[[int, int], None]
) -> Iterator[tuple[Floats, Floats]]:
    """Yield the numbers of a CSV file piece by piece: selected columns [rows, columns], line numbers [rows].

    All values are finite numbers. In formats with blanks an empty cell is NaN. ``progress`` is called with the KiB read
    and the size of the file in KiB.
    """
    with open_plain(file, LARGEST_BYTES) as stream:
        text = io.TextIOWrapper(stream, "utf-8-sig")
        source = zip(count(1), iter(partial(text.readline, LONGEST_LINE), ""), strict=False)
        names, used = _header(file, entry, columns, source)
        empty = True
        while piece := list(islice(source, PIECE)):
            progress(stream.tell() >> 10, file.stat().st_size >> 10)  # KiB
            kept = [(n, line) for n, line in piece if line.strip() and not any(at in line for at in entry.elsewhere)]
            if not kept:
                continue
            for number, line in kept:
                if line.count(",") + 1 != len(names):
                    raise InvalidInput(
                        f"{file}, line {number}: {line.count(',') + 1} values, but the header has {len(names)} columns;"
                        " is the file whole?"
                    )
            lines = [re.sub(r",(?=,|\s*$)", ",nan", line) if entry.blanks else line for _, line in kept]
            try:
                numbers = np.loadtxt(lines, delimiter=",", usecols=used, comments=None, ndmin=2)
            except ValueError:
                cells = (
                    (number, names[k], line.split(",")[k].strip())
                    for (number, _), line in zip(kept, lines, strict=True)
                    for k in used
                )
                odd = (each for each in cells if parse_numeral(each[2]) is None and each[2] != "nan")
                number, name, cell = next(odd, (kept[0][0], names[used[0]], "..."))
                raise InvalidInput(f"{file}, line {number}, column {name}: {cell!r:.60} is not a number") from None
            empty, at = False, np.array([number for number, _ in kept])
            for k, column in enumerate(used[:1] if entry.blanks else used):
                _refuse(~np.isfinite(numbers[:, k]), file, at, names[column], numbers[:, k], "must be a finite number")
            yield numbers, at
        if empty:
            raise InvalidInput(f"{file}: has no rows")


def _header(
    file: Path, entry: _Format, columns: Sequence[str], source: Iterator[tuple[int, str]]
) -> tuple[list[str], list[int]]:
    """Find the header among the first lines, and return the names of all columns and the indices of ``columns``.

    ``source`` yields (line number, line); lines up to the header are consumed.
    """
    least, have = list(columns), set[str]()
    for number, line in islice(source, HEAD):
        names = [cell.strip() for cell in line.split(",")]
        small = [_OTHER_NAMES.get(name.lower(), name.lower()) for name in names]
        missing = [each for each in columns if each.lower() not in small]
        least, have = min(least, missing, key=len), have.union(small)
        if not missing:
            several = [re.compile(re.sub("1$", r"\\d+", each.lower())) for each in columns]
            ordered = sorted((len(name), name, k) for k, name in enumerate(small))  # Speed2 before Speed10
            used = [k for each in several for _, name, k in ordered if each.fullmatch(name)]
            if len({small[k] for k in used}) < len(used) or (entry.blanks and len(used) % 2):
                right = "each column must be there once, and one IVS between two Speeds"
                raise InvalidInput(f"{file}, line {number}: {', '.join(names[k] for k in used)}: {right}")
            return names, used
    hints = [f"; this is {each.title}" for each in FORMATS.values() if have >= {c.lower() for c in each.columns}] or (
        ["; columns are separated by commas"] * (";" in str(have))
    )
    raise InvalidInput(f"{file}: has no column {', '.join(least)}, as files of {entry.title} have{''.join(hints)}")


def _refuse(bad: Bools, file: Path, lines: Floats, column: str, values: Floats, right: str) -> None:
    """Raise ``InvalidInput`` with file, line and column for the first row in which ``bad`` [rows] is true.

    ``lines`` and ``values`` [rows] are the rows' line numbers and values; ``right`` says what would be right.
    """
    if bad.any():
        line, value = lines[bad][0], values[bad][0]
        raise InvalidInput(f"{file}, line {line:.0f}, column {column}: {value:.12g} {right}")
