"""Create a scenario (a YAML file, and a CSV file with gaps and speeds) from a folder of recorded traffic."""

from __future__ import annotations

import hashlib
import math
import os
from collections import Counter
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, count_of, naming_extras, plain_text
from ethbrake_marl.extensions.recorded.formats import DataFormat, Format, format_of
from ethbrake_marl.files.plain import open_plain
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.quantities import QUANTITIES, RECORDING
from ethbrake_marl.worlds.scenario import Scenario
from ethbrake_marl.worlds.scenario_file import check_file_name

with naming_extras():
    from ethbrake_marl.extensions.recorded.chains import cut_chains
    from ethbrake_marl.extensions.recorded.interpolation import NEAR_S
    from ethbrake_marl.extensions.recorded.reading import LARGEST_BYTES, NotARecording
    from ethbrake_marl.extensions.recorded.states import read_recording

MOST_NUMBERS = 100_000  # of a scenario's table: every copy of the scenario contains it
MOST_LISTED = 10  # largest number of skipped files that a note names


class ChainRows(NamedTuple):
    numbers: Floats  # [k, 2 N - 1] gaps (m) and speeds (m/s) of each row
    of: list[tuple[str, str]]  # recording and vehicles of each row
    seen: int  # number of chains in the recordings; there can be fewer rows
    left_out: Counter[str]  # description of data that were left out -> their number
    interpolated: int  # number of states between two rows of a vehicle
    refused: list[str]  # error message for each refused file
    skipped: list[str]  # names of files that are not recordings, or repeat another file

    @property
    def recordings(self) -> str:
        return count_of(len({file for file, _ in self.of}), "recording")

    def found(self, vehicles: int, every_s: float) -> list[str]:
        groups = {2: "pair", 3: "trio"}.get(vehicles, "queue")
        parts = [
            f"{count_of(self.seen, 'chain')} of {vehicles} vehicles, every {every_s:g} s; at one time, a vehicle is in"
            " at most one chain",
            f"rows of {count_of(len(set(self.of)), f'different {groups}')} of vehicles in {self.recordings}",
        ]
        if self.interpolated:
            states = count_of(self.interpolated, "vehicle")
            parts.append(f"interpolated: {states} between two rows at most {NEAR_S:g} s apart")
        parts += [f"left out: {number:,} {what}" for what, number in sorted(self.left_out.items()) if number]
        if self.skipped:
            more = f" and {len(self.skipped) - MOST_LISTED:,} more" if len(self.skipped) > MOST_LISTED else ""
            parts.append(
                f"skipped, because they are no recordings or copies: {', '.join(self.skipped[:MOST_LISTED])}{more}"
            )
        return parts + [f"refused: {count_of(len(self.refused), 'file')}"] * bool(self.refused)


class FromData(NamedTuple):
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
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> FromData:
    """Create a scenario from the recordings in a folder and its subfolders; each world is a recorded chain of vehicles.

    Every ``every_s`` seconds, each queue is cut into chains of as many vehicles as the scenario ``based_on`` has, which
    supplies what is not recorded. If there are more rows than a table may have, every k-th is used.

    ``columns``: for the format ``table`` (``format_of``). ``progress``: called with ``files``, the number of files
    read, and of all. Raises ``InvalidInput`` for an invalid argument and, with file, line and column, if no file can be
    used.
    """
    entry, base = format_of(format, columns), load_scenario(based_on)
    check_file_name("scenario", name)
    if not 0.0 < every_s < math.inf:
        raise InvalidInput(f"every = {every_s:g} s: the time between the moments that are read must be above 0")
    if base.members or base.table is not None:
        raise InvalidInput(
            f"based_on = {based_on!r}: the scenario must not be a mixture, and must not draw worlds from a table"
        )
    rows = read_chains(folder, entry, every_s, base.vehicles, progress)
    rules = QUANTITIES["gaps_m"], QUANTITIES["speeds_mps"]
    headings = [rule.column_of(i) for rule in rules for i in range(rule.count(base.vehicles))] + [RECORDING]
    table = [[*row, ": ".join(of)] for row, of in zip(rows.numbers.tolist(), rows.of, strict=True)]
    findings = rows.found(base.vehicles, every_s)
    fastest_mps = float(rows.numbers[:, base.vehicles - 1 :].max())
    at_rest_s = np.max(base.bounds("latency_s")) + fastest_mps / np.min(base.bounds("braking_capacity_mps2"))
    replaced = ("gaps_m", "speeds_mps", "time_gaps_s", "line_speed_mps", "speed_deviations_mps")
    content = {key: value for key, value in base.declared().items() if key not in replaced} | {
        "name": name,
        "title": f"{entry.title}, row by row",
        "description": f"Speeds and gaps of {rows.recordings} of {entry.title}. Roads, brakes, masses and latencies"
        f" were not recorded; they are as in {base.name}.",
        "source": f"{entry.title}, recorded in {entry.units}, folder {plain_text(folder.resolve().name)}."
        f" {'; '.join(findings)}. {entry.licence}",
        "horizon_s": max(base.horizon_s, math.ceil(at_rest_s) + 1.0),
        "table": {"columns": headings, "rows": table},
    }
    if np.min(base.bounds("speed_limit_mps")) < fastest_mps:
        content["speed_limit_mps"] = math.ceil(fastest_mps)
    load_scenario(content)
    content["table"] = {"file": f"{name}.csv", "columns": headings}
    text = "".join(f"{key}: {flow_text(content[key])}\n" for key in Scenario.model_fields if key in content)
    lines = csv_text(dict(zip(headings, row, strict=True)) for row in table)
    return FromData(text, lines, findings, rows.refused, rows.skipped)


def read_chains(
    folder: Path, entry: Format, every_s: float, vehicles: int, progress: Callable[[str, int, int], None]
) -> ChainRows:
    """Chains of all recordings of a folder and its subfolders, or of one file.

    A file with an error is refused as a whole; a copy of another file is skipped. Raises ``InvalidInput`` if there is
    no recording of the format, or no chain.
    """
    longest, states_between, left_out, refused, skipped = 0, 0, Counter[str](), list[str](), list[str]()
    numbers, of, digests, format_errors = (
        [np.empty((0, 2 * vehicles - 1))],
        list[tuple[str, str]](),
        set[bytes](),
        list[str](),
    )
    files = files_of(folder, entry, refused)
    if not files and not refused:
        patterns = " or ".join(entry.files)
        raise InvalidInput(f"{folder}: must be a folder with files of {entry.title}; their names match {patterns}")
    for k, (printable_name, file) in enumerate(files.items()):
        if k > 0:
            progress("files", k, len(files))
        try:
            with open_plain(file, LARGEST_BYTES) as stream:
                content = hashlib.file_digest(stream, "sha256").digest()
            if content in digests:
                skipped.append(printable_name)
                continue
            digests.add(content)
            chains = cut_chains(read_recording(file, entry, every_s), vehicles)
        except NotARecording as error:
            format_errors.append(str(error))
            skipped.append(printable_name)
        except InvalidInput as error:
            refused.append(str(error))
        else:
            numbers.append(chains.numbers)
            of += [(printable_name, chain) for chain in chains.vehicles]
            left_out.update(chains.left_out)
            states_between += chains.interpolated
            longest = max(longest, chains.longest)
    if refused and not of:
        raise InvalidInput(f"{folder}: {count_of(len(refused), 'file')} refused: {'; '.join(refused)}")
    if len(format_errors) == len(files):
        raise InvalidInput(f"{folder}: contains no recording of {entry.title}: {'; '.join(format_errors)}")
    if not of:
        raise InvalidInput(
            f"{folder}: the moments that were read contain no lane in which {vehicles} vehicles follow each other; the"
            f" longest queue has {longest}: with --based-on, give a scenario of fewer vehicles, for instance"
            " realistic-pair with 2"
        )
    progress("files", len(files), len(files))
    each_of = len(of) * (2 * vehicles - 1) // MOST_NUMBERS + 1
    # Rows of the same vehicles are next to each other in this order, so every k-th row keeps all vehicles.
    chosen = sorted(sorted(range(len(of)), key=of.__getitem__)[each_of - 1 :: each_of])
    thinned = f"chains: a table has at most {MOST_NUMBERS:,} numbers, so one in {each_of} is used"
    left_out[thinned] = len(of) - len(chosen)
    rows = np.array([[round(number, 3) + 0.0 for number in row] for row in np.concatenate(numbers)[chosen].tolist()])
    return ChainRows(rows, [of[k] for k in chosen], len(of), left_out, states_between, refused, skipped)


def files_of(folder: Path, entry: Format, refused: list[str]) -> dict[str, Path]:
    """Files in a folder and its subfolders whose names fit a format: printable name -> path.

    ``folder`` may be one file, with any name. Hidden files and links to folders are ignored. A subfolder that cannot be
    read adds a message to ``refused``.
    """
    if not folder.is_dir():
        return {plain_text(folder.name): folder} if folder.is_file() else {}
    walk = os.walk(folder, onerror=lambda error: refused.append(f"{error.filename}: cannot be read ({error.strerror})"))
    files = {}
    for file in sorted(Path(top, name) for top, _, names in walk for name in names):
        below = file.relative_to(folder)
        matches = any(fnmatch(file.name.lower(), pattern) for pattern in entry.files)
        if matches and not any(part.startswith(".") for part in below.parts):
            files[plain_text(below.as_posix())] = file
    return files
