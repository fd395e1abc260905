"""Tables of best known harm: small files that identify a world by a hash of everything that affects its harm."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.files.arrays import ArrayArchive, ArrayRow
from ethbrake_marl.files.model import first_mistake
from ethbrake_marl.files.plain import parse_strict_json, read_plain
from ethbrake_marl.files.store import write_file
from ethbrake_marl.first_edition.engine.profiles import ProfileProblem, Profiles
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, UInt64s

TABLE_FORMAT = 1

SIZE_LIMIT_BYTES = 64 << 20  # largest size of a file

UNPACKED_LIMIT_BYTES = 256 << 20  # largest size of all arrays together

DECODED_LIMIT = 1 << 26  # largest number of numbers in the decoded profiles of one count

TOLERANCE = 1e-6  # m2/s2; a harm replaces the harm in the table if it is smaller by more than this

_ABOUT = ("scenario", "list_seed", "episodes", "vehicles")  # entries of the header that error messages show

LEFT_OUT = "left_out"  # key of a table's header: number in the list -> why the world is not in the table

OBJECTIVE = "objective"  # key of a table's header: whose harm its amounts are; missing: the harm of the line

LOWERED = "lowered_by"  # key of a table's header: agent -> count -> number of worlds in which it did less harm

COUNTS: tuple[HarmCount, ...] = ("first", "total")


class BestKnown(NamedTuple):
    """Best known harm of n worlds under one harm count."""

    harm: Floats  # [n] best known harm, m2/s2
    profiles: Profiles  # [n] command profiles with that harm; all ends are 0 where only the harm is known


@dataclass(frozen=True, slots=True)
class BestHarmTable:
    """Best known harm of n worlds, for one or both harm counts."""

    identity: UInt64s  # hash of each world, [n]
    best: Mapping[HarmCount, BestKnown]  # harm and profiles, by harm count
    header: Mapping[str, Any]  # entries that describe how the table was computed: scenario, vehicles, budget, ...

    @classmethod
    def load(cls, path: Path) -> BestHarmTable:
        """Read a table from the file ``path``.

        Raises ``InvalidInput`` if the file does not exist, and ``CorruptBundle`` if the file is not a table. The names,
        types, shapes and sizes of the arrays are checked before the file is unpacked. The stored harm is not checked by
        simulation.
        """
        if not os.path.exists(path):
            raise InvalidInput(f"{path}: there is no such file; give the file of a table of best known harm")
        data = read_plain(path, SIZE_LIMIT_BYTES, refusal=CorruptBundle)
        try:
            archive = ArrayArchive(data, UNPACKED_LIMIT_BYTES)
            counts = [harm_count for harm_count in COUNTS if f"{harm_count}_harm" in archive.headers]
            arrays = archive.unpack([row for harm_count in counts or COUNTS for row in _rows(harm_count)])
            header = parse_strict_json(arrays["header"].tobytes())
            _Header.model_validate(header)
            best = {harm_count: _read_best(arrays, harm_count) for harm_count in counts}
        except ValidationError as error:
            raise CorruptBundle(f"{path}: is not a table of best known harm: header: {first_mistake(error)}") from None
        except ValueError as error:
            raise CorruptBundle(f"{path}: is not a table of best known harm: {error}") from None
        del header["format"]
        return cls(arrays["identity"].astype(np.uint64), best, header)

    def save(self, path: Path) -> None:
        """Write the table to the file ``path``; if writing fails, the old file stays unchanged."""
        write_file(path, table_bytes(self))

    def rows(self, identity: UInt64s) -> NDArray[np.int64]:
        """Return the row in the table, [m], of each world with hash ``identity`` [m]; -1: not in the table."""
        order = np.argsort(self.identity, kind="stable")
        place = np.minimum(np.searchsorted(self.identity[order], identity), len(order) - 1)
        rows = order[place]
        return np.where(self.identity[rows] == identity, rows, -1)

    def check_holds_any(self, identity: UInt64s) -> None:
        """Raise ``InvalidInput`` if the table contains none of the worlds with the hashes ``identity``."""
        if not (self.rows(identity) >= 0).any():
            contents = ", ".join(f"{key} {self.header[key]}" for key in _ABOUT if key in self.header)
            raise InvalidInput(
                f"table of best known harm ({contents}): the table contains none of the {len(identity)} worlds; use"
                " the scenario, seed and vehicles for which the table was computed"
            )

    def check_fits(self, problem: ProfileProblem) -> None:
        """Raise ``InvalidInput`` if a stored profile is impossible in ``problem``, for instance exceeds a capacity."""
        for harm_count in self.best:
            try:
                problem.check(self.profiles(problem.identity, harm_count, problem.last_step)[0])
            except InvalidInput as error:
                raise InvalidInput(f"table of best known harm, {harm_count}: {error}") from None

    def harm(self, identity: UInt64s, harm_count: HarmCount) -> Floats:
        """Return the best known harm, [m] m2/s2, of each world with hash ``identity`` [m]; NaN: not in the table."""
        rows = self.rows(identity)
        if harm_count not in self.best:
            return np.full(rows.shape, np.nan)
        return np.where(rows >= 0, self.best[harm_count].harm[rows], np.nan)

    def profiles(self, identity: UInt64s, harm_count: HarmCount, last_step: Ints) -> tuple[Profiles, Bools]:
        """Return the stored profile of each world, [m], and a mask [m]: True for worlds that have a stored profile.

        A world without a stored profile gets the profile of coasting. ``identity`` [m] are the hashes of the worlds,
        and ``last_step`` [m] the number of time steps of each world's episode.
        """
        rows = self.rows(identity)
        if harm_count not in self.best:
            controlled = next(iter(self.best.values())).profiles.commands_mps2.shape[2]
            coasting = Profiles(last_step[:, np.newaxis].copy(), np.zeros((len(rows), 1, controlled)))
            return coasting, np.zeros(len(rows), np.bool_)
        stored = self.best[harm_count].profiles.take(rows)
        known = (rows >= 0) & (stored.ends[:, -1] > 0)
        ends = np.where(known[:, np.newaxis], stored.ends, last_step[:, np.newaxis])
        return Profiles(ends, np.where(known[:, np.newaxis, np.newaxis], stored.commands_mps2, 0.0)), known

    def improved(
        self, identity: UInt64s, harm_count: HarmCount, harm: Floats, profiles: Profiles
    ) -> tuple[BestHarmTable, Bools]:
        """Return a copy of the table with the smaller values from ``harm``, and a mask [m] of the changed worlds.

        A value in ``harm`` replaces the value in the table only if it is smaller by more than ``TOLERANCE``. Worlds
        that are not in the table are ignored. Raises ``InvalidInput`` if the table does not contain ``harm_count``.

        ``identity`` [m] are the hashes of the worlds, ``harm`` [m] is their harm in m2/s2, and ``profiles`` [m] are
        command profiles with this harm.
        """
        if harm_count not in self.best:
            raise InvalidInput(
                f"harm_count = {harm_count!r}: the table does not contain this harm count; it contains"
                f" {', '.join(map(repr, self.best))}"
            )
        rows = self.rows(identity)
        old = self.best[harm_count]
        better = (rows >= 0) & (harm < old.harm[rows] - TOLERANCE)
        at = rows[better]
        new_harm = old.harm.copy()
        new_harm[at] = harm[better]
        profiles_, new = Profiles.padded([old.profiles, profiles], 1)
        profiles_.ends[at] = new.ends[better]
        profiles_.commands_mps2[at] = new.commands_mps2[better]
        return replace(self, best={**self.best, harm_count: BestKnown(new_harm, profiles_)}), better


def table_bytes(table: BestHarmTable) -> bytes:
    """Return the content of a table file: a compressed .npz without pickles.

    The unused phases of a profile are left out. The file contains the first byte of every command, then the second byte
    of every command, and so on; in this order the commands compress better.
    """
    arrays: dict[str, NDArray[Any]] = {
        "header": np.frombuffer(json.dumps({"format": TABLE_FORMAT, **table.header}).encode(), np.uint8),
        "identity": table.identity.astype("<u8"),
    }
    for harm_count, best in table.best.items():
        ends, commands = best.profiles
        used = _used(ends)
        inside = np.arange(ends.shape[1]) < used[:, np.newaxis]
        arrays[f"{harm_count}_harm"] = best.harm.astype("<f8")
        arrays[f"{harm_count}_phases"] = used.astype("<u2")
        arrays[f"{harm_count}_ends"] = ends[inside].astype("<u2")
        flat = np.ascontiguousarray(commands[inside], "<f8")
        arrays[f"{harm_count}_commands"] = flat.view(np.uint8).reshape(*flat.shape, 8).transpose(2, 0, 1).copy()
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _rows(harm_count: HarmCount) -> list[ArrayRow]:
    """Return the name, type and shape of each array that a table file contains for one harm count.

    n is the number of worlds, m the number of phases of all worlds together, C the number of controlled vehicles.
    """
    return [
        ArrayRow("header", "|u1", ("bytes",)),
        ArrayRow("identity", "<u8", ("n",)),
        ArrayRow(f"{harm_count}_harm", "<f8", ("n",)),
        ArrayRow(f"{harm_count}_phases", "<u2", ("n",)),
        ArrayRow(f"{harm_count}_ends", "<u2", (f"m of {harm_count}",)),
        ArrayRow(f"{harm_count}_commands", "|u1", (8, f"m of {harm_count}", "C")),
    ]


class _Header(BaseModel):
    """Header of a table file: entries that are checked when the file is read. The header may have other entries."""

    model_config = ConfigDict(strict=True, extra="allow")

    format: Annotated[int, Field(ge=TABLE_FORMAT, le=TABLE_FORMAT)]  # version of the file format; refuses true and 1.0
    scenario: str = ""  # name of the scenario
    vehicles: list[str] = []  # names of the controlled vehicles
    budget: int = 0  # candidates per world and count of the search
    search_seed: int = 0  # seed of the search
    episodes: int = 0  # number of worlds of the list
    list_seed: int = 0  # seed of the list
    after: dict[str, Any] = {}  # header of the table with which the search started
    lowered_by: dict[str, dict[str, int]] = {}  # agent -> count -> number of worlds in which the agent did less harm


def _read_best(arrays: Mapping[str, NDArray[Any]], harm_count: HarmCount) -> BestKnown:
    """Return the harm and the profiles of one harm count; raise ``ValueError`` for an impossible number."""
    harm = arrays[f"{harm_count}_harm"].astype(np.float64)
    used = arrays[f"{harm_count}_phases"].astype(np.int64)
    planes = arrays[f"{harm_count}_commands"]
    flat = np.ascontiguousarray(planes.transpose(1, 2, 0)).view("<f8")[..., 0].astype(np.float64)
    if not len(harm):
        raise ValueError("the table contains no world")
    if not (np.isfinite(harm).all() and (harm >= 0.0).all()):
        raise ValueError(f"{harm_count}_harm: a harm must be a finite number of at least 0 m2/s2")
    if not np.isfinite(flat).all():
        raise ValueError(f"{harm_count}_commands: a command must be a finite number")
    if used.sum() != len(flat):
        raise ValueError(
            f"{harm_count}_phases: the profiles of all worlds have {used.sum()} phases (intervals of constant command),"
            f" but the file has {len(flat)} commands; it must have one for each phase"
        )
    width, controlled = max(int(used.max()), 1), flat.shape[1]
    if not 1 <= controlled <= 64 or len(used) * width * (controlled + 1) > DECODED_LIMIT:
        raise ValueError(
            f"the table has {controlled} vehicles and up to {width} phases for each of {len(used)} worlds; at most 64"
            f" vehicles, and {DECODED_LIMIT:,} numbers (worlds x phases x (vehicles + 1)), are allowed"
        )
    inside = np.arange(width) < used[:, np.newaxis]
    ends, commands = np.zeros(inside.shape, np.int64), np.zeros((*inside.shape, controlled))
    ends[inside] = arrays[f"{harm_count}_ends"]
    commands[inside] = flat
    last = np.maximum(used - 1, 0)
    rows = np.arange(len(used))
    ends = np.where(inside, ends, ends[rows, last][:, np.newaxis])
    commands = np.where(inside[..., np.newaxis], commands, commands[rows, last][:, np.newaxis])
    if not ((np.diff(ends, axis=1) >= 0).all() and ((ends[:, -1] > 0) == (used > 0)).all()):
        raise ValueError(
            f"{harm_count}_ends: the end times of a world's phases (intervals of constant command) must not decrease,"
            " and the last end time must be above 0"
        )
    return BestKnown(harm, Profiles(ends, commands))


def _used(ends: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number of phases that each profile uses, [n]; 0 for a world without a profile. ``ends`` is [n, K]."""
    return np.where(ends[:, -1] > 0, np.argmax(ends == ends[:, -1:], axis=1) + 1, 0)
