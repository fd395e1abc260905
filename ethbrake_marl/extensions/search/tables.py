"""Tables of best known harm: the least known harm of each world and its profile, looked up by a hash of the world."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.errors import CorruptBundle, InvalidInput, describe_error
from ethbrake_marl.extensions.search.pricing import Problem, Profiles, UInt64s, best_of
from ethbrake_marl.files.package import package_folder
from ethbrake_marl.files.plain import parse_strict_json, read_plain
from ethbrake_marl.files.store import write_file
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.motion.layout import Floats

TABLE_FORMAT = 2
SIZE_LIMIT_BYTES, UNPACKED_LIMIT_BYTES = 64 << 20, 256 << 20
TABLE_FOLDER = package_folder() / "shipped" / "tables"
ABOUT = ("scenario", "list_seed", "episodes", "vehicles")  # entries of the header that messages show
ARRAYS = {"identity": ("<u8", 1)}  # name of an array -> its type and number of axes,
OF_COUNT = {"harm": ("<f8", 1), "ends": ("<u2", 2), "commands": ("<f8", 3)}  # and of those of one count of harm


@dataclass(frozen=True, slots=True)
class BestHarmTable:
    identity: UInt64s  # [n] hash of each world (``pricing.identities``)
    harm: Mapping[str, Floats]  # name of a count -> [n] m2/s2, or what else the search has minimised
    profiles: Mapping[str, Profiles]  # count -> profiles with this harm
    header: Mapping[
        str, Any
    ]  # how the table was made: scenario, vehicles, physics (its digest), budget, search_seed, weights of counts, ...

    @classmethod
    def load(cls, path: Path) -> BestHarmTable:
        """Raises ``InvalidInput`` and ``CorruptBundle``."""
        if not path.exists():
            raise InvalidInput(f"{path}: there is no such file; give the file of a table of best known harm")
        data = read_plain(path, SIZE_LIMIT_BYTES, refusal=CorruptBundle)
        try:
            arrays = _unpack_arrays(data)
            header = parse_strict_json(arrays.pop("header", np.zeros(0)).tobytes())
            if not isinstance(header, dict) or header.pop("format", None) is not TABLE_FORMAT:
                raise ValueError(f"header: must be an object with the entry format: {TABLE_FORMAT}")
            counts = [name.removesuffix("_harm") for name in arrays if name.endswith("_harm")]
            _check(arrays, counts)
        except ValueError as error:
            raise CorruptBundle(f"{path}: is not a table of best known harm: {error}") from None
        harm = {count: arrays[f"{count}_harm"] for count in counts}
        ends = {count: arrays[f"{count}_ends"].astype(np.int64) for count in counts}
        profiles = {count: Profiles(ends[count], arrays[f"{count}_commands"]) for count in counts}
        return cls(arrays["identity"], harm, profiles, header)

    def save(self, path: Path) -> None:
        write_file(path, self.content())

    def content(self) -> bytes:
        header = np.frombuffer(json.dumps({"format": TABLE_FORMAT, **self.header}).encode(), np.uint8)
        arrays: dict[str, NDArray[Any]] = {"header": header, "identity": self.identity}
        for count, (ends, commands) in self.profiles.items():
            arrays[f"{count}_harm"], arrays[f"{count}_ends"] = self.harm[count], ends.astype("<u2")
            arrays[f"{count}_commands"] = commands
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **arrays)
        return buffer.getvalue()

    def rows(self, identity: UInt64s) -> NDArray[np.int64]:
        """-1 for a world that is not in the table."""
        order = np.argsort(self.identity, kind="stable")
        rows = order[np.minimum(np.searchsorted(self.identity[order], identity), len(order) - 1)]
        return np.where(self.identity[rows] == identity, rows, -1)

    def stored(self, problem: Problem, count: HarmCount) -> tuple[Floats, Profiles]:
        """Least known harm of the problem's worlds, [n] m2/s2, and the profiles that reach it, [n].

        A world that is not in the table has infinite harm and a profile that coasts, and so have all worlds if the
        table was made for other weights of the count.
        """
        weights = self.header.get("weights", {}).get(count.name, [*count.weights])
        rows = self.rows(problem.identity)
        in_table = rows >= 0
        if count.name not in self.harm or weights != [*count.weights] or not in_table.any():
            return np.full(problem.n, np.inf), problem.coasting()
        ends, commands = self.profiles[count.name].take(rows)
        ends = np.where(in_table[:, np.newaxis], ends, problem.last_step[:, np.newaxis])
        profiles = Profiles(ends, np.where(in_table[:, np.newaxis, np.newaxis], commands, 0.0))
        return np.where(in_table, self.harm[count.name][rows], np.inf), profiles

    def check_holds_any(self, identity: UInt64s) -> None:
        if not (self.rows(identity) >= 0).any():
            contents = ", ".join(f"{key} {self.header[key]}" for key in ABOUT if key in self.header)
            raise InvalidInput(
                f"table of best known harm ({contents}): holds none of the {len(identity)} worlds; use the scenario,"
                " seed and vehicles for which it was made"
            )


@cache
def _load_shipped() -> tuple[BestHarmTable, ...]:
    return tuple(BestHarmTable.load(path) for path in sorted(TABLE_FOLDER.glob("*.npz")))


def shipped_tables() -> tuple[BestHarmTable, ...]:
    """Only those made with this installation's physics."""
    return tuple(table for table in _load_shipped() if table.header.get("physics") == physics_digest())


def outdated_tables() -> dict[str, str]:
    """Scenario -> sentence with the reason."""
    now = physics_digest()
    physics_of_tables = {table.header["scenario"]: table.header.get("physics") for table in _load_shipped()}
    return {
        scenario: f"the shipped table of best known harm for {scenario} is not used, because it was made for other"
        f" physics ({then!r}) than this installation's ({now!r})"
        for scenario, then in physics_of_tables.items()
        if then != now
    }


def best_stored(problem: Problem, count: HarmCount) -> tuple[Floats, Profiles]:
    """As ``BestHarmTable.stored``, from all shipped tables."""
    results = [table.stored(problem, count) for table in shipped_tables()]
    nothing = np.full(problem.n, np.inf), problem.coasting()
    return best_of([result for result in results if np.isfinite(result[0]).any()] or [nothing])


def _unpack_arrays(data: bytes) -> dict[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > UNPACKED_LIMIT_BYTES:
            raise ValueError(f"its arrays have {size:,} bytes; must have at most {UNPACKED_LIMIT_BYTES:,}")
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {name: np.asarray(arrays[name]) for name in arrays.files}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, TypeError, MemoryError) as error:
        raise ValueError(f"the archive is damaged ({describe_error(error)})") from None


def _check(arrays: Mapping[str, NDArray[Any]], counts: list[str]) -> None:
    expected_arrays = ARRAYS | {f"{count}_{name}": kind for count in counts for name, kind in OF_COUNT.items()}
    for name in sorted(expected_arrays.keys() ^ arrays.keys()):
        raise ValueError(f"array {name!r}: {'is missing' if name in expected_arrays else 'must not be in this file'}")
    for name, (kind, axes) in expected_arrays.items():
        if arrays[name].dtype != np.dtype(kind) or arrays[name].ndim != axes or not arrays[name].size:
            raise ValueError(f"array {name!r}: has type {arrays[name].dtype} and shape {arrays[name].shape}")
    for count in counts:
        harm, ends, commands = (arrays[f"{count}_{name}"] for name in OF_COUNT)
        if not len(harm) == len(ends) == len(arrays["identity"]) or commands.shape[:2] != ends.shape:
            raise ValueError(f"arrays of {count}: their shapes {harm.shape}, {ends.shape}, {commands.shape} do not fit")
        if not (np.isfinite(harm) & (harm >= 0.0)).all():
            raise ValueError(f"{count}_harm: must be finite and at least 0 m2/s2")
        if not np.isfinite(commands).all():
            raise ValueError(f"{count}_commands: must be finite")
        if (ends[:, 1:] < ends[:, :-1]).any() or not ends[:, -1].all():
            raise ValueError(f"{count}_ends: must not decrease within a world, and end above 0")
