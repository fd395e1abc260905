"""Tables of best known harm: for each world, found by a hash, the least harm that is known, and its profile."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import CorruptBundle, InvalidInput, describe_error
from ethbrake_marl.extensions.search.pricing import COUNTS, Problem, Profiles, UInt64s
from ethbrake_marl.files.plain import parse_strict_json, read_plain
from ethbrake_marl.files.store import write_file
from ethbrake_marl.motion.layout import Bools, Floats

FORMAT = 1
SIZE_LIMIT_BYTES, UNPACKED_LIMIT_BYTES = 64 << 20, 256 << 20
DECODED_LIMIT = 1 << 26  # largest count of numbers in the profiles of one count of harm
SHIPPED = Path(__file__).with_name("_tables")
ABOUT = ("scenario", "list_seed", "episodes", "vehicles")  # entries of the header that messages show


@dataclass(frozen=True, slots=True)
class BestHarmTable:
    """The least harm known in n worlds, in one or both counts."""

    identity: UInt64s  # [n] hash of each world (``pricing.identities``)
    harm: Mapping[str, Floats]  # count -> [n] m2/s2, or what else the search has minimised
    profiles: Mapping[str, Profiles]  # count -> profiles with this harm
    header: Mapping[str, Any]  # how it was made: scenario, vehicles, budget, search_seed, ...

    @classmethod
    def load(cls, path: Path) -> BestHarmTable:
        """Read a table. Raises ``InvalidInput`` if there is no such file, ``CorruptBundle`` if it is not a table.

        The size is checked before the file is unpacked, and no pickle is read.
        """
        if not path.exists():
            raise InvalidInput(f"{path}: there is no such file; give the file of a table of best known harm")
        data = read_plain(path, SIZE_LIMIT_BYTES, refusal=CorruptBundle)
        try:
            arrays = _unpacked(data)
            counts = [count for count in COUNTS if f"{count}_harm" in arrays] or [*COUNTS]
            _check_arrays(arrays, counts)
            header = parse_strict_json(arrays["header"].tobytes())
            if not isinstance(header, dict) or header.pop("format", None) is not FORMAT:
                raise ValueError(f"header: must be an object with the entry format: {FORMAT}")
            harm = {count: arrays[f"{count}_harm"].astype(np.float64) for count in counts}
            profiles = {count: _profiles(arrays, count) for count in counts}
        except ValueError as error:
            raise CorruptBundle(f"{path}: is not a table of best known harm: {error}") from None
        return cls(arrays["identity"].astype(np.uint64), harm, profiles, header)

    def save(self, path: Path) -> None:
        """Write the table: a compressed .npz without pickles. If writing fails, an old file stays as it was."""
        write_file(path, self.content())

    def content(self) -> bytes:
        """Return the content of the file. Empty phases are left out; bytes of one place stand together, to compress."""
        header = np.frombuffer(json.dumps({"format": FORMAT, **self.header}).encode(), np.uint8)
        arrays: dict[str, NDArray[Any]] = {"header": header, "identity": self.identity.astype("<u8")}
        for count, (ends, commands) in self.profiles.items():
            used = (ends == ends[:, -1:]).argmax(axis=1) + 1
            inside = np.arange(ends.shape[1]) < used[:, np.newaxis]
            flat = np.ascontiguousarray(commands[inside], "<f8")
            arrays[f"{count}_harm"] = self.harm[count].astype("<f8")
            arrays[f"{count}_phases"], arrays[f"{count}_ends"] = used.astype("<u2"), ends[inside].astype("<u2")
            arrays[f"{count}_commands"] = flat.view(np.uint8).reshape(*flat.shape, 8).transpose(2, 0, 1).copy()
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **arrays)
        return buffer.getvalue()

    def rows(self, identity: UInt64s) -> NDArray[np.int64]:
        """Return the row of each world, [m]; -1: it is not in the table."""
        order = np.argsort(self.identity, kind="stable")
        rows = order[np.minimum(np.searchsorted(self.identity[order], identity), len(order) - 1)]
        return np.where(self.identity[rows] == identity, rows, -1)

    def stored(self, problem: Problem, count: str) -> tuple[Floats, Profiles]:
        """Return the least harm known of the problem's worlds, [n] m2/s2, NaN: not in the table; and its profiles.

        A world that is not in the table has the profile of coasting.
        """
        rows, last = self.rows(problem.identity), problem.last_step
        if count not in self.harm:
            nothing = np.zeros((problem.n, 1, len(problem.bodies)))
            return np.full(problem.n, np.nan), Profiles(last[:, np.newaxis].copy(), nothing)
        known, (ends, commands) = rows >= 0, self.profiles[count].take(rows)
        ends = np.where(known[:, np.newaxis], ends, last[:, np.newaxis])
        profiles = Profiles(ends, np.where(known[:, np.newaxis, np.newaxis], commands, 0.0))
        return np.where(known, self.harm[count][rows], np.nan), profiles

    def check_holds_any(self, identity: UInt64s) -> None:
        """Raise ``InvalidInput`` if the table holds none of these worlds."""
        if not (self.rows(identity) >= 0).any():
            contents = ", ".join(f"{key} {self.header[key]}" for key in ABOUT if key in self.header)
            raise InvalidInput(
                f"table of best known harm ({contents}): holds none of the {len(identity)} worlds; use the scenario,"
                " seed and vehicles for which it was made"
            )


@cache
def shipped_tables() -> tuple[BestHarmTable, ...]:
    """Return the shipped tables, in the order of their files' names."""
    return tuple(BestHarmTable.load(path) for path in sorted(SHIPPED.glob("*.npz")))


def best_known(problem: Problem, count: str) -> tuple[Floats, Profiles]:
    """Return the least harm of each world in the shipped tables, [n] m2/s2, and its profiles; NaN: in no table."""
    least, profiles = (
        np.full(problem.n, np.nan),
        Profiles(problem.last_step[:, np.newaxis].copy(), np.zeros((problem.n, 1, len(problem.bodies)))),
    )
    for table in shipped_tables():
        if (table.rows(problem.identity) < 0).all():
            continue
        harm, stored = table.stored(problem, count)
        better: Bools = np.isfinite(harm) & ~(harm >= least)
        profiles, stored = Profiles.padded([profiles, stored])
        least[better] = harm[better]
        for mine, its in zip(profiles, stored, strict=True):
            mine[better] = its[better]
    return least, profiles


def _unpacked(data: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of a .npz file. Raises ``ValueError`` for a damaged or too large one."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > UNPACKED_LIMIT_BYTES:
            raise ValueError(f"its arrays have {size:,} bytes; must have at most {UNPACKED_LIMIT_BYTES:,}")
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {name: np.asarray(arrays[name]) for name in arrays.files}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, TypeError, MemoryError) as error:
        raise ValueError(f"the archive is damaged ({describe_error(error)})") from None


def _check_arrays(arrays: Mapping[str, NDArray[Any]], counts: Sequence[str]) -> None:
    """Check names, types and shapes: n worlds, m phases of one count in all, B controlled vehicles."""
    wanted: dict[str, tuple[str, int]] = {"header": ("|u1", 1), "identity": ("<u8", 1)}  # type, number of axes
    for count in counts:
        wanted |= {f"{count}_harm": ("<f8", 1), f"{count}_phases": ("<u2", 1), f"{count}_ends": ("<u2", 1)}
        wanted[f"{count}_commands"] = ("|u1", 3)
    for name in sorted(wanted.keys() ^ arrays.keys()):
        raise ValueError(f"array {name!r}: {'is missing' if name in wanted else 'must not be in this file'}")
    for name, (kind, axes) in wanted.items():
        if arrays[name].dtype != np.dtype(kind) or arrays[name].ndim != axes:
            raise ValueError(f"array {name!r}: has type {arrays[name].dtype} and {arrays[name].ndim} axes")
    n = len(arrays["identity"])
    for count in counts:
        m = len(arrays[f"{count}_ends"])
        shapes = [arrays[f"{count}_{name}"].shape for name in ("harm", "phases")]
        if shapes != [(n,), (n,)] or arrays[f"{count}_commands"].shape[:2] != (8, m):
            raise ValueError(f"arrays of {count}: do not have {n} worlds and {m} phases")


def _profiles(arrays: Mapping[str, NDArray[Any]], count: str) -> Profiles:
    """Return the profiles of one count. Raises ``ValueError`` for impossible numbers."""
    harm, used = arrays[f"{count}_harm"], arrays[f"{count}_phases"].astype(np.int64)
    flat = np.ascontiguousarray(arrays[f"{count}_commands"].transpose(1, 2, 0)).view("<f8")[..., 0].astype(np.float64)
    if not len(harm):
        raise ValueError("the table holds no world")
    if not (np.isfinite(harm).all() and (harm >= 0.0).all()):
        raise ValueError(f"{count}_harm: must be finite and at least 0 m2/s2")
    if not np.isfinite(flat).all():
        raise ValueError(f"{count}_commands: must be finite")
    if not (used > 0).all() or used.sum() != len(flat):
        raise ValueError(f"{count}_phases: {used.sum()} phases with {len(flat)} commands; must be one for each phase")
    width, controlled = int(used.max()), flat.shape[1]
    if not 1 <= controlled <= 64 or len(used) * width * (controlled + 1) > DECODED_LIMIT:
        raise ValueError(
            f"{controlled} vehicles, {width} phases, {len(used)} worlds: at most 64 vehicles and {DECODED_LIMIT:,}"
            " numbers"
        )
    inside, last = np.arange(width) < used[:, np.newaxis], np.minimum(np.arange(width), used[:, np.newaxis] - 1)
    ends, commands = np.zeros(inside.shape, np.int64), np.zeros((*inside.shape, controlled))
    ends[inside], commands[inside] = arrays[f"{count}_ends"], flat
    ends = np.take_along_axis(ends, last, 1)
    if not (np.diff(ends, axis=1) >= 0).all() or not (ends[:, -1] > 0).all():
        raise ValueError(f"{count}_ends: must not decrease within a world, and end above 0")
    return Profiles(ends, np.take_along_axis(commands, last[:, :, np.newaxis], 1))
