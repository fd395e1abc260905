"""Create a scenario (a YAML file, and a CSV file with gaps and speeds) from a folder of recorded traffic."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, count_of, naming_extras, plain_text
from ethbrake_marl.extensions.recorded.fits import DataDraw, fit_rows
from ethbrake_marl.extensions.recorded.formats import DataFormat, format_of
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.first_edition.scenario.catalogue import check_file_name, load_scenario
from ethbrake_marl.first_edition.scenario.fields import QUANTITY, RECORDING
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.vehicle_types import MOST_CHARACTERS

with naming_extras():
    from ethbrake_marl.extensions.recorded.folder import Rows, read_rows
    from ethbrake_marl.extensions.recorded.states import check_every

_OF_A_ROW = QUANTITY.usual["gaps_m"], QUANTITY.usual["speeds_mps"]

_REPLACED = ("gaps_m", "speeds_mps", "time_gaps_s", "line_speed_mps", "speed_deviations_mps")

_LISTED = 10  # largest number of skipped files that a note names


class FromData(NamedTuple):
    """A scenario that was created from a folder of recordings, and information on the files."""

    text: str  # content of the scenario file (YAML)
    csv: str  # content of the file of its rows (CSV): gaps (m), speeds (m/s), and the column ``recording``
    found: list[str]  # sentences that say what the recordings contain, and what was left out
    refused: list[str]  # error message for each refused file
    skipped: list[str]  # names of files that are not recordings, or are copies of other files


def scenario_from_data(
    name: str,
    folder: Path,
    format: DataFormat,
    *,
    columns: str = "",
    based_on: str = "realistic-motorway",
    every_s: float = 1.0,
    draw: DataDraw = "rows",
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
        draw: how the scenario draws a world: ``rows`` draws a recorded chain; ``normal``, ``lognormal`` and
            ``quantiles`` draw each quantity from a distribution of this kind, which is fitted to the chains.
        strict: True: any error in a file raises an exception; False: files with errors are left out.
        progress: called with the name of a file, the amount of data read from it so far (KiB), and its size (KiB).

    Raises ``InvalidInput``, which names file, line and column, if no file can be used. If several files have errors,
    notes on the exception (``__notes__``) describe the errors of all files but the first.

    """
    entry, base = format_of(format, columns), load_scenario(based_on)
    check_file_name("scenario", name)
    if entry.hertz:
        check_every(every_s, entry, entry.title)
    if not 0.0 < every_s < math.inf:
        raise InvalidInput(f"every = {every_s:g} s: the time between the moments that are read must be above 0")
    if base.members or base.table is not None:
        raise InvalidInput(
            f"based_on = {based_on!r}: the scenario must not be a mixture, and must not draw worlds from a table"
        )
    vehicles = base.vehicles
    rows = read_rows(folder, entry, every_s, vehicles, progress)
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
    recordings, summary = count_of(len({file for file, _ in rows.of}), "recording"), _found(rows, vehicles, every_s)
    fastest_mps = max(max(row[vehicles - 1 :]) for row in rows.numbers)
    at_rest_s = np.max(base.bounds("latency_s")) + fastest_mps / np.min(base.bounds("braking_capacity_mps2"))
    headings = [rule.column_of(i) for rule in _OF_A_ROW for i in range(rule.count(vehicles))] + [RECORDING]
    named = [[*row, _name(*of)] for row, of in zip(rows.numbers, rows.of, strict=True)]
    table = {"table": {"columns": headings, "rows": named}}
    content = {key: value for key, value in base.declared().items() if key not in _REPLACED} | {
        "name": name,
        "title": f"{entry.title}, {'row by row' if draw == 'rows' else f'{draw} of each quantity'}",
        "description": f"Speeds and gaps of {recordings} of {entry.title}. Brakes, masses and latencies were not"
        f" recorded; they are as in {base.name}.",
        "source": f"{entry.title}, recorded in {entry.units}, folder {plain_text(folder.resolve().name)}."
        f" {'; '.join(summary)}. {entry.licence}",
        "horizon_s": max(base.horizon_s, math.ceil(at_rest_s) + 1.0),
        **(table if draw == "rows" else fit_rows(np.array(rows.numbers), draw)),
    }
    if np.min(base.bounds("speed_limit_mps")) < fastest_mps:
        content["speed_limit_mps"] = math.ceil(fastest_mps)
    load_scenario(content)
    if draw == "rows":
        content["table"] = {"file": f"{name}.csv", "columns": headings}
    text = "".join(f"{key}: {flow_text(content[key])}\n" for key in Scenario.model_fields if key in content)
    lines = io.StringIO()
    csv.writer(lines, lineterminator="\n").writerows([headings, *named])
    return FromData(text, lines.getvalue(), summary, rows.refused, rows.skipped)


def _name(file: str, vehicles: str) -> str:
    """Return the name of a chain, such as ``drive_1.csv: 2-3-4``; the beginning of a long name is cut off."""
    return f"{file}: {vehicles}".strip()[-MOST_CHARACTERS:].strip()


def _found(rows: Rows, vehicles: int, every_s: float) -> list[str]:
    """Return phrases that say what the recordings contain, and which data were left out."""
    groups = {2: "pair", 3: "trio"}.get(vehicles, "queue")
    parts = [
        f"{count_of(rows.seen, 'chain')} of {vehicles} vehicles, every {every_s:g} s; at one time, a vehicle is in at"
        " most one chain",
        f"rows of {count_of(len(set(rows.of)), f'different {groups}')} of vehicles in"
        f" {count_of(len({file for file, _ in rows.of}), 'recording')}",
    ]
    parts += [f"left out: {number:,} {what}" for what, number in sorted(rows.left_out.items()) if number]
    if rows.skipped:
        more = f" and {len(rows.skipped) - _LISTED:,} more" if len(rows.skipped) > _LISTED else ""
        parts += [f"skipped, because they are no recordings or copies: {', '.join(rows.skipped[:_LISTED])}{more}"]
    if rows.refused:
        parts += [f"refused: {count_of(len(rows.refused), 'file')}"]
    return parts
