"""Read all recordings in a folder; return rows, each with the gaps and speeds of one chain of vehicles at one moment.

Only one file's states are in memory at a time, besides the rows.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Callable
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, plain_text
from ethbrake_marl.extensions.recorded.chains import cut_chains
from ethbrake_marl.extensions.recorded.formats import Format
from ethbrake_marl.extensions.recorded.reading import LARGEST_BYTES, NotARecording
from ethbrake_marl.extensions.recorded.states import read_recording
from ethbrake_marl.files.plain import open_plain
from ethbrake_marl.first_edition.scenario.vehicle_types import MOST_NUMBERS


class Rows(NamedTuple):
    """Gaps and speeds of chains of vehicles from all recordings in a folder, and information on the files."""

    numbers: list[list[float]]  # gaps (m) and speeds (m/s) of each row
    of: list[tuple[str, str]]  # recording and vehicles of each row
    seen: int  # number of chains in the recordings; there can be fewer rows
    longest: int  # number of vehicles in the longest queue
    left_out: Counter[str]  # description of data that were left out -> their number
    refused: list[str]  # error message for each refused file
    skipped: list[str]  # names of files that are not recordings, or are copies of other files


def read_rows(
    folder: Path, entry: Format, every_s: float, vehicles: int, progress: Callable[[str, int, int], None]
) -> Rows:
    """Read the chains of vehicles in all recordings of a folder and its subfolders.

    If a file has an error, none of its chains are used, and the result contains the error message. ``folder`` may be a
    single file. ``every_s`` is the time between two moments at which chains are formed, s. ``progress`` is called with
    the name of a file, the amount of data read from it so far (KiB), and its size (KiB).

    Raises ``InvalidInput`` if the folder contains no recordings of this format.
    """
    files, refused, twice = _search(folder, entry)
    if not files and (not refused or not folder.is_dir()):
        patterns = " or ".join(entry.files)
        raise InvalidInput(f"{folder}: must be a folder with files of {entry.title}; their names match {patterns}")
    longest, left_out, others = 0, Counter[str](), dict[str, str]()
    numbers, of = [np.empty((0, 2 * vehicles - 1))], list[tuple[str, str]]()
    for shown, file in files.items():
        try:
            chains = cut_chains(read_recording(file, entry, every_s, partial(progress, f"read: {shown}")), vehicles)
        except NotARecording as error:
            others[shown] = str(error)
        except InvalidInput as error:
            refused.append(str(error))
        else:
            numbers.append(chains.numbers)
            of += [(shown, each) for each in chains.vehicles]
            left_out.update(chains.left_out)
            longest = max(longest, chains.longest)
    if len(others) == len(files) and not refused:
        raise InvalidInput(f"{folder}: contains no recording of {entry.title}: {'; '.join(others.values())}")
    each_of = len(of) * (2 * vehicles - 1) // MOST_NUMBERS + 1
    # Rows of the same vehicles are next to each other in this order, so every k-th row keeps all vehicles.
    chosen = sorted(sorted(range(len(of)), key=of.__getitem__)[each_of - 1 :: each_of])
    left_out[f"chains: a table has at most {MOST_NUMBERS:,} numbers, so one in {each_of} is used"] = len(of) - len(
        chosen
    )
    rows = [[round(number, 3) + 0.0 for number in row] for row in np.concatenate(numbers)[chosen].tolist()]
    return Rows(rows, [of[k] for k in chosen], len(of), longest, left_out, refused, [*others, *twice])


def _search(folder: Path, entry: Format) -> tuple[dict[str, Path], list[str], list[str]]:
    """Find the files of a format in a folder and its subfolders by their names.

    Returns the files by printable path, the errors for subfolders that cannot be read, and the names of files that are
    left out because they repeat another file: copies and links, and a text file without a header beside a CSV file of
    the same name. Files and folders whose names begin with a dot are ignored, and links to folders are not followed.
    """
    if folder.is_file():
        return {plain_text(folder.name): folder}, [], []
    files, seen, refused, twice = dict[str, Path](), set[object](), list[str](), list[str]()
    walk = os.walk(folder, onerror=lambda error: refused.append(f"{error.filename}: cannot be read ({error.strerror})"))
    everything = {Path(top, name) for top, _, names in walk for name in names}
    for file in sorted(everything):
        below = file.relative_to(folder)
        matches = any(fnmatch(file.name.lower(), pattern) for pattern in entry.files)
        if not matches or any(part.startswith(".") for part in below.parts):
            continue
        shown = plain_text(below.as_posix())
        again = entry.headless and file.suffix == ".txt" and file.with_suffix(".csv") in everything
        content = _content(file)
        if again or shown in files or content in seen:
            twice.append(shown)
        else:
            seen.add(content)
            files[shown] = file
    return files, refused, twice


def _content(file: Path) -> object:
    """Return a hash of the content of ``file``, or, if it cannot be read, its path after following links."""
    try:
        with open_plain(file, LARGEST_BYTES) as stream:
            return hashlib.file_digest(stream, "sha256").digest()
    except (InvalidInput, OSError):
        return os.path.realpath(file)
