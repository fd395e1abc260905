"""Create a scenario (a YAML file, and a CSV file with gaps and speeds) from a folder of recorded traffic.

Only one file's states are in memory at a time, besides the rows: gaps and speeds of a chain of vehicles at one moment.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import os
from collections import Counter
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, count_of, naming_extras, plain_text
from ethbrake_marl.extensions.recorded.formats import DataFormat, Format, format_of
from ethbrake_marl.files.plain import open_plain
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.explain import check_file_name
from ethbrake_marl.worlds.rules import RECORDING, RULES
from ethbrake_marl.worlds.scenario import Scenario

with naming_extras():
    from ethbrake_marl.extensions.recorded.chains import cut_chains
    from ethbrake_marl.extensions.recorded.reading import LARGEST_BYTES, NotARecording
    from ethbrake_marl.extensions.recorded.states import read_recording

MOST_NUMBERS = 100_000  # of a scenario's table: every copy of the scenario contains it
QUANTILES = 40  # values of a fitted distribution
SLOWEST_MPS, LONGEST_S = 0.5, 60.0  # least speed and longest time gap of rows that are used for fits
LISTED = 10  # largest number of skipped files that a note names


class Rows(NamedTuple):
    """Gaps and speeds of chains of vehicles from all recordings in a folder, and information on the files."""

    numbers: Floats  # [k, 2 N - 1] gaps (m) and speeds (m/s) of each row
    of: list[tuple[str, str]]  # recording and vehicles of each row
    seen: int  # number of chains in the recordings; there can be fewer rows
    longest: int  # number of vehicles in the longest queue
    left_out: Counter[str]  # description of data that were left out -> their number
    refused: list[str]  # error message for each refused file
    skipped: list[str]  # names of files that are not recordings, or repeat another file

    def found(self, vehicles: int, every_s: float) -> list[str]:
        """Return phrases that say what the recordings contain, and which data were left out."""
        groups = {2: "pair", 3: "trio"}.get(vehicles, "queue")
        recordings = count_of(len({file for file, _ in self.of}), "recording")
        parts = [
            f"{count_of(self.seen, 'chain')} of {vehicles} vehicles, every {every_s:g} s; at one time, a vehicle is in"
            " at most one chain",
            f"rows of {count_of(len(set(self.of)), f'different {groups}')} of vehicles in {recordings}",
        ]
        parts += [f"left out: {number:,} {what}" for what, number in sorted(self.left_out.items()) if number]
        if self.skipped:
            more = f" and {len(self.skipped) - LISTED:,} more" if len(self.skipped) > LISTED else ""
            parts.append(f"skipped, because they are no recordings or copies: {', '.join(self.skipped[:LISTED])}{more}")
        return parts + [f"refused: {count_of(len(self.refused), 'file')}"] * bool(self.refused)


class FromData(NamedTuple):
    """A scenario that was created from a folder of recordings, and information on the files."""

    text: str  # content of the scenario file (YAML)
    csv: str  # content of the file of its rows (CSV): gaps (m), speeds (m/s), and the column ``recording``
    found: list[str]  # sentences that say what the recordings contain, and what was left out
    refused: list[str]  # error message for each refused file
    skipped: list[str]  # names of files that are not recordings, or repeat another file


def scenario_from_data(
    name: str,
    folder: Path,
    format: DataFormat,
    *,
    columns: str = "",
    based_on: str = "realistic-motorway",
    every_s: float = 1.0,
    draw: Literal["rows", "quantiles"] = "rows",
    strict: bool = False,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> FromData:
    """Create a scenario from the recordings in a folder and in all its subfolders.

    At regular times, each queue of vehicles in a recording is cut into chains of as many vehicles as the scenario
    ``based_on`` has, beginning at the front of the queue. Each chain is one row of gaps and speeds. If there are more
    rows than the table of a scenario may have, only every k-th row is used.

    Args:
        name: name of the scenario.
        folder: folder with the files, or one file.
        format: format of the files.
        columns: for the format ``table`` only: names of the columns, see ``format_of``.
        based_on: scenario that provides the number of vehicles and all quantities that are not recorded.
        every_s: time between two moments at which chains are formed, s.
        draw: how the scenario draws a world: ``rows`` draws a recorded chain; ``quantiles`` draws each quantity from
            40 quantiles of the chains.
        strict: True: any error in a file raises an exception; False: files with errors are left out.
        progress: called with the name of a file, the number of files read so far, and the number of all files.

    Raises ``InvalidInput``, which names file, line and column, if no file can be used. If several files have errors,
    notes on the exception (``__notes__``) describe the errors of all files but the first.

    """
    entry, base = format_of(format, columns), load_scenario(based_on)
    check_file_name("scenario", name)
    if not 0.0 < every_s < math.inf:
        raise InvalidInput(f"every = {every_s:g} s: the time between the moments that are read must be above 0")
    if base.members or base.table is not None:
        raise InvalidInput(
            f"based_on = {based_on!r}: the scenario must not be a mixture, and must not draw worlds from a table"
        )
    rows = read_rows(folder, entry, every_s, base.vehicles, progress)
    _check_rows(folder, rows, base.vehicles, strict)
    rules = RULES["gaps_m"], RULES["speeds_mps"]
    headings = [rule.column_of(i) for rule in rules for i in range(rule.count(base.vehicles))] + [RECORDING]
    table = [[*row, ": ".join(of)] for row, of in zip(rows.numbers.tolist(), rows.of, strict=True)]
    found = rows.found(base.vehicles, every_s)
    fastest_mps = float(rows.numbers[:, base.vehicles - 1 :].max())
    at_rest_s = np.max(base.bounds("latency_s")) + fastest_mps / np.min(base.bounds("braking_capacity_mps2"))
    replaced = ("gaps_m", "speeds_mps", "time_gaps_s", "line_speed_mps", "speed_deviations_mps")
    content = {key: value for key, value in base.declared().items() if key not in replaced} | {
        "name": name,
        "title": f"{entry.title}, {'row by row' if draw == 'rows' else 'quantiles of each quantity'}",
        "description": f"Speeds and gaps of {count_of(len({file for file, _ in rows.of}), 'recording')} of"
        f" {entry.title}. Brakes, masses and latencies were not recorded; they are as in {base.name}.",
        "source": f"{entry.title}, recorded in {entry.units}, folder {plain_text(folder.resolve().name)}."
        f" {'; '.join(found)}. {entry.licence}",
        "horizon_s": max(base.horizon_s, math.ceil(at_rest_s) + 1.0),
        **({"table": {"columns": headings, "rows": table}} if draw == "rows" else quantiles_of(rows.numbers)),
    }
    if np.min(base.bounds("speed_limit_mps")) < fastest_mps:
        content["speed_limit_mps"] = math.ceil(fastest_mps)
    load_scenario(content)
    if draw == "rows":
        content["table"] = {"file": f"{name}.csv", "columns": headings}
    text = "".join(f"{key}: {flow_text(content[key])}\n" for key in Scenario.model_fields if key in content)
    lines = io.StringIO()
    csv.writer(lines, lineterminator="\n").writerows([headings, *table])
    return FromData(text, lines.getvalue(), found, rows.refused, rows.skipped)


def _check_rows(folder: Path, rows: Rows, vehicles: int, strict: bool) -> None:
    """Raise ``InvalidInput`` if a file was refused and none may be, or if there is no row."""
    if rows.refused and (strict or not rows.seen):
        several = f"{folder}: {len(rows.refused):,} files refused: " * (len(rows.refused) > 1)
        error = InvalidInput(several + rows.refused[0])
        for each in rows.refused[1:]:
            error.add_note(each)
        raise error
    if not rows.seen:
        longest = (
            f"; the longest queue has {rows.longest} vehicles: with --based-on, give a scenario of at most"
            f" {rows.longest} vehicles, for instance realistic-pair with 2"
        )
        raise InvalidInput(
            f"{folder}: the moments that were read contain no lane in which {vehicles} vehicles follow each other"
            f"{longest * (rows.longest > 1)}"
        )


def read_rows(
    folder: Path, entry: Format, every_s: float, vehicles: int, progress: Callable[[str, int, int], None]
) -> Rows:
    """Read the chains of vehicles in all recordings of a folder and its subfolders, or in one file.

    If a file has an error, none of its chains are used, and the result contains the error message. A file with the
    content of another one is skipped. Raises ``InvalidInput`` if there is no recording of this format.
    """
    longest, left_out, refused, skipped = 0, Counter[str](), list[str](), list[str]()
    numbers, of, seen, others = [np.empty((0, 2 * vehicles - 1))], list[tuple[str, str]](), set[bytes](), list[str]()
    files = dict(_files(folder, entry, refused, skipped))
    if not files and not refused:
        patterns = " or ".join(entry.files)
        raise InvalidInput(f"{folder}: must be a folder with files of {entry.title}; their names match {patterns}")
    for k, (shown, file) in enumerate(files.items()):
        progress(f"read: {shown}", k, len(files))
        try:
            with open_plain(file, LARGEST_BYTES) as stream:
                content = hashlib.file_digest(stream, "sha256").digest()
            if content in seen:
                skipped.append(shown)
                continue
            seen.add(content)
            chains = cut_chains(read_recording(file, entry, every_s), vehicles)
        except NotARecording as error:
            others.append(str(error))
            skipped.append(shown)
        except InvalidInput as error:
            refused.append(str(error))
        else:
            numbers.append(chains.numbers)
            of += [(shown, each) for each in chains.vehicles]
            left_out.update(chains.left_out)
            longest = max(longest, chains.longest)
    if len(others) == len(files) and not refused:
        raise InvalidInput(f"{folder}: contains no recording of {entry.title}: {'; '.join(others)}")
    each_of = len(of) * (2 * vehicles - 1) // MOST_NUMBERS + 1
    # Rows of the same vehicles are next to each other in this order, so every k-th row keeps all vehicles.
    chosen = sorted(sorted(range(len(of)), key=of.__getitem__)[each_of - 1 :: each_of])
    thinned = f"chains: a table has at most {MOST_NUMBERS:,} numbers, so one in {each_of} is used"
    left_out[thinned] = len(of) - len(chosen)
    rows = np.array([round(number, 3) + 0.0 for number in np.concatenate(numbers)[chosen].ravel().tolist()])
    shape = len(chosen), 2 * vehicles - 1
    return Rows(rows.reshape(shape), [of[k] for k in chosen], len(of), longest, left_out, refused, skipped)


def _files(folder: Path, entry: Format, refused: list[str], skipped: list[str]) -> Iterator[tuple[str, Path]]:
    """Yield printable name and path of the files of a format in a folder and its subfolders.

    ``refused`` gets the errors for subfolders that cannot be read, ``skipped`` the names of text files without a header
    beside a CSV file of the same name. Files and folders whose names begin with a dot are ignored, and links to folders
    are not followed.
    """
    if folder.is_file():
        yield plain_text(folder.name), folder
    walk = os.walk(folder, onerror=lambda error: refused.append(f"{error.filename}: cannot be read ({error.strerror})"))
    everything = {Path(top, name) for top, _, names in walk for name in names}
    if not folder.is_dir():
        refused.clear()
    for file in sorted(everything):
        below = file.relative_to(folder)
        matches = any(fnmatch(file.name.lower(), pattern) for pattern in entry.files)
        if matches and not any(part.startswith(".") for part in below.parts):
            if entry.headless and file.suffix == ".txt" and file.with_suffix(".csv") in everything:
                skipped.append(plain_text(below.as_posix()))
            else:
                yield plain_text(below.as_posix()), file


def quantiles_of(rows: Floats) -> dict[str, Any]:
    """Return scenario keys with quantiles of time gaps, of the line's mean speed, and of deviations from this mean.

    ``rows`` [k, 2 N - 1] are gaps (m) and speeds (m/s) of k chains of N vehicles. The mean speed is clipped, so that
    mean plus deviation stays between 0 and the highest recorded speed. Raises ``InvalidInput`` if fewer than
    ``QUANTILES`` chains have speeds of at least ``SLOWEST_MPS``, and time gaps above 0 and at most ``LONGEST_S``.
    """
    gaps, speeds = np.split(rows, [rows.shape[1] // 2], axis=1)
    times = gaps / np.maximum(speeds[:, 1:], SLOWEST_MPS)
    used = (speeds >= SLOWEST_MPS).all(axis=1) & ((times > 0.0) & (times <= LONGEST_S)).all(axis=1)
    if used.sum() < QUANTILES:
        raise InvalidInput(
            f"draw = quantiles: needs at least {QUANTILES} rows with time gaps above 0 and up to {LONGEST_S:g} s, but"
            f" there are only {used.sum()}; give more recordings, or use draw = rows"
        )
    line = speeds[used].mean(axis=1)
    off = speeds[used] - line[:, np.newaxis]
    shares = (np.arange(QUANTILES) + 0.5) / QUANTILES

    def choice(values: Floats) -> dict[str, Any]:
        return {"choice": np.quantile(values, shares).tolist()}

    return {
        "time_gaps_s": [choice(each) for each in times[used].T],
        "line_speed_mps": choice(np.clip(line, -off.min(), speeds.max() - off.max())),
        "speed_deviations_mps": [choice(each) for each in off.T],
    }
