"""The limits of a list of worlds, found before anybody drives: avoidable, proven, and the best known harm.

Three vehicles, Vehicle 2 driven, the others braking fully: for these it is proven world by world whether some command
avoids all contact, and which harm no command undercuts (``limits.lower_bound``). The least
harm known is the first proof's witness (harm 0), or the result of a search (``best_harm``). Both proofs cover an
obstacle that Vehicle 1 does not reach by itself: only a push brings it there.

Several driven vehicles, and lines of more than three: which harm no joint command undercuts (``team_bound``).
Whether contact can be avoided is decided for Vehicles 2 and 3 of three, and not for other teams.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ethbrake_marl.agents import (
    Agent,
    AgentSettings,
    BestHarm,
    Driver,
    Source,
    fixed_commands,
    optimise_coupled,
    record_commands,
    script_agents,
)
from ethbrake_marl.errors import CorruptBundle, InvalidInput, PhysicsError, check_one_learner
from ethbrake_marl.files.arrays import ArrayArchive, ArrayRow
from ethbrake_marl.files.store import parse_strict_json, read_plain, write_file
from ethbrake_marl.files.yaml import first_mistake
from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.limits.lower_bound import avoidability, extreme_profiles, lower_bound, onset_states, team_bound
from ethbrake_marl.physics import (
    CLOCK,
    Bools,
    Floats,
    Ints,
    UInt64s,
    Worlds,
    advance,
    leaving_out_failed,
    stopping_distances,
)
from ethbrake_marl.registry import Part
from ethbrake_marl.scenario import Sample, Scenario, Task
from ethbrake_marl.search import MOST_PHASES, Found, ProfileProblem, Profiles, profile_problem, search_profiles

# Tables of best known harm: small files that are looked up by what a world is, never by its place in a list.

TABLE_FORMAT = 1
SIZE_LIMIT_BYTES = 64 << 20  # of a file
UNPACKED_LIMIT_BYTES = 256 << 20  # of its arrays
DECODED_LIMIT = 1 << 26  # numbers of the profiles of one count, every world with as many phases as the longest
TOLERANCE = 1e-6  # an agent must be this much (m2/s2) below the table to replace its value
_ABOUT = ("scenario", "list_seed", "episodes", "vehicles")  # of the header, in an error
LEFT_OUT = "left_out"  # key of a table's header: number in the list -> why the world is in no row
LOWERED = "lowered_by"  # key of a table's header: agent -> count -> in how many worlds it did less harm
_COUNTS: tuple[HarmCount, ...] = ("first", "total")


class BestKnown(NamedTuple):
    """The least harm known under one count."""

    harm: Floats  # [n] m2/s2
    profiles: Profiles  # [n] that do it; all ends 0 where only the harm is known


@dataclass(frozen=True, slots=True)
class BestHarmTable:
    """The least harm known in n worlds, for one or both counts, and how it was found (``header``)."""

    identity: UInt64s  # [n]
    best: Mapping[HarmCount, BestKnown]
    header: Mapping[str, Any]

    @classmethod
    def load(cls, path: Path) -> BestHarmTable:
        """Read a table. Raises ``InvalidInput`` if there is no file and ``CorruptBundle`` if it is not a table.

        Names, types, shapes and sizes are checked from the headers before anything is unpacked. What a table says of a
        world is believed; that its profiles fit a problem is for ``check_fits`` to say.
        """
        if not os.path.exists(path):
            raise InvalidInput(f"{path}: there is no such table of best known harm")
        data = read_plain(path, SIZE_LIMIT_BYTES, refusal=CorruptBundle)
        try:
            archive = ArrayArchive(data, UNPACKED_LIMIT_BYTES)
            counts = [harm_count for harm_count in _COUNTS if f"{harm_count}_harm" in archive.headers]
            arrays = archive.unpack([row for harm_count in counts or _COUNTS for row in _rows(harm_count)])
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
        """Write the table in one step."""
        write_file(path, table_bytes(self))

    @property
    def left_out(self) -> Mapping[str, str]:
        """Number in the list -> why the world is in no row."""
        return dict(self.header.get(LEFT_OUT, {}))

    def rows(self, identity: UInt64s) -> NDArray[np.int64]:
        """Row of each world, -1 where it is not in the table."""
        order = np.argsort(self.identity, kind="stable")
        place = np.minimum(np.searchsorted(self.identity[order], identity), len(order) - 1)
        rows = order[place]
        return np.where(self.identity[rows] == identity, rows, -1)

    def check_holds_any(self, identity: UInt64s) -> None:
        """Raise ``InvalidInput`` if none of these worlds is in the table: it is of another list."""
        if not (self.rows(identity) >= 0).any():
            made = ", ".join(f"{key} {self.header[key]}" for key in _ABOUT if key in self.header)
            raise InvalidInput(
                f"table of best known harm ({made}): holds none of these {len(identity)} worlds; give the scenario,"
                " seed and vehicles that it was made for"
            )

    def check_fits(self, problem: ProfileProblem) -> None:
        """Raise ``InvalidInput`` if a profile kept for one of these worlds cannot be driven there."""
        for harm_count in self.best:
            try:
                problem.check(self.profiles(problem.identity, harm_count, problem.last_step)[0])
            except InvalidInput as error:
                raise InvalidInput(f"table of best known harm, {harm_count}: {error}") from None

    def harm(self, identity: UInt64s, harm_count: HarmCount) -> Floats:
        """Best known harm of each world (m2/s2), NaN where it is not in the table."""
        rows = self.rows(identity)
        if harm_count not in self.best:
            return np.full(rows.shape, np.nan)
        return np.where(rows >= 0, self.best[harm_count].harm[rows], np.nan)

    def profiles(self, identity: UInt64s, harm_count: HarmCount, last_step: Ints) -> tuple[Profiles, Bools]:
        """Kept profiles [n], and where there is one [n]; coasting elsewhere. ``last_step`` [n] ends each of them."""
        rows = self.rows(identity)
        if harm_count not in self.best:
            controlled = next(iter(self.best.values())).profiles.commands_mps2.shape[2]
            coasting = Profiles(last_step[:, np.newaxis].copy(), np.zeros((len(rows), 1, controlled)))
            return coasting, np.zeros(len(rows), np.bool_)
        kept = self.best[harm_count].profiles.take(rows)
        known = (rows >= 0) & (kept.ends[:, -1] > 0)
        ends = np.where(known[:, np.newaxis], kept.ends, last_step[:, np.newaxis])
        return Profiles(ends, np.where(known[:, np.newaxis, np.newaxis], kept.commands_mps2, 0.0)), known

    def improved(
        self, identity: UInt64s, harm_count: HarmCount, harm: Floats, profiles: Profiles | None = None
    ) -> tuple[BestHarmTable, Bools]:
        """The table with every value replaced that ``harm`` [m] undercuts by more than ``TOLERANCE``; and where it did.

        ``profiles`` [m] are what did it; without them only the harm is known there. Worlds that are not in the table
        change nothing. Raises ``InvalidInput`` for a count that the table does not hold, or shapes that do not fit.
        """
        if harm_count not in self.best:
            raise InvalidInput(f"table of {', '.join(self.best)}: holds no {harm_count!r} harm")
        if harm.shape != identity.shape:
            raise InvalidInput(f"improve: {harm.shape} harms for {identity.shape} worlds")
        rows = self.rows(identity)
        old = self.best[harm_count]
        better = (rows >= 0) & (harm < old.harm[rows] - TOLERANCE)
        at = rows[better]
        new_harm = old.harm.copy()
        new_harm[at] = harm[better]
        if profiles is None:
            profiles = Profiles(
                np.zeros((len(harm), 1), np.int64), np.zeros((len(harm), 1, old.profiles.commands_mps2.shape[2]))
            )
        kept, new = Profiles.padded([old.profiles, profiles], 1)
        kept.ends[at] = new.ends[better]
        kept.commands_mps2[at] = new.commands_mps2[better]
        return replace(self, best={**self.best, harm_count: BestKnown(new_harm, kept)}), better


def table_bytes(table: BestHarmTable) -> bytes:
    """The table as a compressed .npz without pickles: only the phases in use, bytes of like weight together."""
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
    """What a table holds of one count: n worlds, m phases in all, C controlled vehicles."""
    return [
        ArrayRow("header", "|u1", ("bytes",)),
        ArrayRow("identity", "<u8", ("n",)),
        ArrayRow(f"{harm_count}_harm", "<f8", ("n",)),
        ArrayRow(f"{harm_count}_phases", "<u2", ("n",)),
        ArrayRow(f"{harm_count}_ends", "<u2", (f"m of {harm_count}",)),
        ArrayRow(f"{harm_count}_commands", "|u1", (8, f"m of {harm_count}", "C")),
    ]


class _Header(BaseModel):
    """What other code relies on in a header; it may say more."""

    model_config = ConfigDict(strict=True, extra="allow")

    format: Annotated[int, Field(ge=TABLE_FORMAT, le=TABLE_FORMAT)]  # neither true nor 1.0
    scenario: str = ""
    vehicles: list[str] = []
    budget: int = 0
    search_seed: int = 0
    episodes: int = 0
    list_seed: int = 0
    after: dict[str, Any] = {}
    lowered_by: dict[str, dict[str, int]] = {}


def _read_best(arrays: Mapping[str, NDArray[Any]], harm_count: HarmCount) -> BestKnown:
    """One count of a table whose arrays have the right shapes; raises ``ValueError`` for numbers that cannot be."""
    harm = arrays[f"{harm_count}_harm"].astype(np.float64)
    used = arrays[f"{harm_count}_phases"].astype(np.int64)
    planes = arrays[f"{harm_count}_commands"]
    flat = np.ascontiguousarray(planes.transpose(1, 2, 0)).view("<f8")[..., 0].astype(np.float64)
    if not len(harm):
        raise ValueError("it holds no world")
    if not (np.isfinite(harm).all() and (harm >= 0.0).all()):
        raise ValueError(f"{harm_count}_harm: a harm must be a finite number of at least 0 m2/s2")
    if not np.isfinite(flat).all():
        raise ValueError(f"{harm_count}_commands: a command must be a finite number")
    if used.sum() != len(flat):
        raise ValueError(f"{harm_count}_phases: {used.sum()} phases in all, but there are {len(flat)} commands")
    width, controlled = max(int(used.max()), 1), flat.shape[1]
    if not 1 <= controlled <= 64 or len(used) * width * (controlled + 1) > DECODED_LIMIT:
        raise ValueError(f"{len(used)} worlds of {width} phases of {controlled} vehicles are beyond what is kept")
    inside = np.arange(width) < used[:, np.newaxis]
    ends, commands = np.zeros(inside.shape, np.int64), np.zeros((*inside.shape, controlled))
    ends[inside] = arrays[f"{harm_count}_ends"]
    commands[inside] = flat
    last = np.maximum(used - 1, 0)
    rows = np.arange(len(used))
    ends = np.where(inside, ends, ends[rows, last][:, np.newaxis])
    commands = np.where(inside[..., np.newaxis], commands, commands[rows, last][:, np.newaxis])
    if not ((np.diff(ends, axis=1) >= 0).all() and ((ends[:, -1] > 0) == (used > 0)).all()):
        raise ValueError(f"{harm_count}_ends: the phases of a world must end in order, the last one after step 0")
    return BestKnown(harm, Profiles(ends, commands))


def _used(ends: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many phases each profile uses, [n]; 0 where there is none."""
    return np.where(ends[:, -1] > 0, np.argmax(ends == ends[:, -1:], axis=1) + 1, 0)


# The least harm known in each world: search over whole profiles of the controlled vehicles, in the engine's physics.
#
# What is found is realised harm: an upper bound of the true minimum, never below it. See docs/best-harm.md.

SEARCH_BUDGET = 100_000  # candidates per world and count
CHUNK = 200  # worlds between two reports of progress
CONSTANTS = 29  # even grid of constant commands from which every search also starts

Progress = Callable[[int, int], None]  # worlds done, of how many


def best_harm(
    scenario: Scenario,
    worlds: Worlds,
    *,
    counts: Sequence[HarmCount] = HARM_COUNTS,
    vehicles: Sequence[int] | None = None,
    budget: int = SEARCH_BUDGET,
    seed: int = 0,
    threads: int | None = None,
    known: BestHarmTable | None = None,
) -> BestHarmTable:
    """Search every world (at t = 0) for the profiles of least harm, once per count.

    ``vehicles`` are the controlled ones (default: the scenario's learners); all others follow their scripts. With both
    counts, each may take the other's result. The result is never worse than the best constant deceleration of a
    controlled vehicle (other controlled ones braking fully), than the same search with one of them alone, or than what
    is ``known`` (a table with these vehicles), from which the search then starts. It does not depend on ``threads``
    (default: every core) or on the batch. Raises ``InvalidInput`` for no vehicle, a script whose command is not fixed
    at the alert, no count, or a budget below 1.
    """
    if not counts or not set(counts) <= set(HARM_COUNTS) or len(set(counts)) != len(counts):
        raise InvalidInput(f"counts {tuple(counts)}: must be first, total, or both")
    task = Task(scenario, scenario.learners if vehicles is None else tuple(vehicles))
    others, problem = scripted_commands(worlds, task), task_problem(worlds, task)
    identity = problem.identity
    if known is not None:
        known.check_fits(problem)
    effort = {"budget": budget, "seed": seed, "threads": (os.cpu_count() or 1) if threads is None else threads}
    found: list[Found] = []
    for count in counts:
        given = [profiles for profiles, _ in found]
        if known is not None:
            given.append(_startable(known.profiles(identity, count, problem.last_step)[0]))
        found.append(_searched(worlds, replace(task, harm_count=count), others, given, task.vehicles, effort))
    rows = np.arange(worlds.n)
    best: dict[HarmCount, BestKnown] = {}
    for count in counts:
        harms = np.stack([harm[count] for _, harm in found])
        pick = np.argmin(harms, axis=0)
        ends = np.stack([profiles.ends for profiles, _ in found])[pick, rows]
        commands = np.stack([profiles.commands_mps2 for profiles, _ in found])[pick, rows]
        best[count] = BestKnown(harms[pick, rows], Profiles(ends, commands))
    names = [scenario.vehicle_names[i] for i in task.vehicles]
    header = {"scenario": scenario.name, "vehicles": names, "budget": budget, "search_seed": seed}
    table = BestHarmTable(identity, best, header)
    if known is None:
        return table
    for count in [count for count in counts if count in known.best]:
        kept, has_profile = known.profiles(identity, count, np.ones(worlds.n, np.int64))
        kept.ends[~has_profile] = 0
        table, _ = table.improved(identity, count, known.harm(identity, count), kept)
    return replace(table, header={**table.header, "after": dict(known.header)})


def search_list(
    scenario: Scenario,
    sample: Sample,
    *,
    counts: Sequence[HarmCount] = HARM_COUNTS,
    vehicles: Sequence[int] | None = None,
    budget: int = SEARCH_BUDGET,
    seed: int = 0,
    threads: int | None = None,
    known: BestHarmTable | None = None,
    chunks: Path | None = None,
    on_progress: Progress | None = None,
) -> BestHarmTable:
    """``best_harm`` of a long list, ``CHUNK`` worlds at a time, resumable.

    With ``chunks``, a folder, each finished chunk is kept there as a file, and a later call with the same question
    takes it from there. A file that answers another question is computed anew and replaced. A world that cannot be
    advanced (a defect of the physics) is left out: no table holds it, and the header names it under ``LEFT_OUT``.
    Raises ``InvalidInput``, as ``best_harm`` does, and if ``known`` holds no world of the list; ``PhysicsError`` if no
    world is left.
    """
    parts: list[BestHarmTable] = []
    left_out: dict[int, str] = {}
    n, task = sample.worlds.n, Task(scenario, scenario.learners if vehicles is None else tuple(vehicles))
    if known is not None:
        every, _, _ = leaving_out_failed(lambda at: task_problem(sample.worlds.take(at), task).identity, np.arange(n))
        if every is not None:
            known.check_holds_any(every)
    options = {"counts": counts, "budget": budget, "seed": seed, "threads": threads, "known": known}
    for first in range(0, n, CHUNK):
        rows = np.arange(first, min(first + CHUNK, n))
        file = None if chunks is None else chunk_file(chunks, first)
        work = partial(_kept_or_searched, task, sample.worlds, file, options)
        part, _, failed = leaving_out_failed(work, rows)
        parts += [] if part is None else [part]
        left_out |= {int(sample.index[row]): reason for row, reason in failed.items()}
        if on_progress is not None:
            on_progress(int(rows[-1]) + 1, n)
    if not parts:
        raise PhysicsError(left_out)
    both = [harm_count for harm_count in _COUNTS if all(harm_count in each.best for each in parts)]
    least: dict[HarmCount, BestKnown] = {}
    for harm_count in both:
        padded = Profiles.padded([each.best[harm_count].profiles for each in parts], 1)
        profiles = Profiles(*(np.concatenate(arrays) for arrays in zip(*padded, strict=True)))
        least[harm_count] = BestKnown(np.concatenate([each.best[harm_count].harm for each in parts]), profiles)
    table = BestHarmTable(np.concatenate([each.identity for each in parts]), least, parts[0].header)
    named = {LEFT_OUT: {str(world): reason for world, reason in left_out.items()}} if left_out else {}
    return replace(table, header={**table.header, **named})


def _kept_or_searched(
    task: Task, every: Worlds, file: Path | None, options: dict[str, Any], rows: Ints
) -> BestHarmTable:
    """A chunk of a list, its ``rows``: from its file where that answers the same question, else searched, and kept."""
    worlds = every.take(rows)
    known = options["known"]
    question = {"counts": list(options["counts"]), "budget": options["budget"], "search_seed": options["seed"]}
    question |= {} if known is None else {"after": dict(known.header)}
    if file is not None:
        with suppress(CorruptBundle):
            part = kept_chunk(file, task_problem(worlds, task).identity, question)
            if part is not None:
                return part
    part = best_harm(task.scenario, worlds, vehicles=task.vehicles, **options)
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        part.save(file)
    return part


def chunks_left(scenario: Scenario, sample: Sample, *, budget: int, chunks: Path) -> tuple[int, list[Path]]:
    """Worlds that ``search_list`` would search, with both counts, not finding them kept; and what it finds damaged."""
    left, damaged = 0, []
    identity = task_problem(sample.worlds, Task(scenario, scenario.learners)).identity
    question = {"counts": list(HARM_COUNTS), "budget": budget, "search_seed": 0}
    for first in range(0, len(identity), CHUNK):
        file, wanted = chunk_file(chunks, first), identity[first : first + CHUNK]
        try:
            kept = kept_chunk(file, wanted, question)
        except CorruptBundle:
            kept = None
            damaged.append(file)
        left += 0 if kept is not None else len(wanted)
    return left, damaged


def chunk_file(chunks: Path, first: int) -> Path:
    """Where the chunk that begins with world ``first`` is kept."""
    return chunks / f"{first:07d}.npz"


def kept_chunk(file: Path, identity: UInt64s, question: Mapping[str, object]) -> BestHarmTable | None:
    """A kept chunk, if it is there and answers this very question; raises ``CorruptBundle`` for a damaged one."""
    if not file.is_file():
        return None
    table = BestHarmTable.load(file)
    asked = {"counts": list(table.best), **{key: table.header[key] for key in question if key in table.header}}
    return table if asked == question and np.array_equal(table.identity, identity) else None


def scripted_commands(worlds: Worlds, task: Task) -> Floats:
    """The commands [n, N] of all vehicles but those of the task; full braking in the columns of these.

    Raises ``InvalidInput`` for a script whose command is not fixed at the alert.
    """
    others = {i: script for i, script in script_agents(task.scenario).items() if i not in task.vehicles}
    return fixed_commands(others, worlds, f"scenario {task.scenario.name!r}, search for the best profiles")


def task_problem(worlds: Worlds, task: Task) -> ProfileProblem:
    """The problem of choosing the profiles of the task's vehicles in worlds at t = 0.

    Its ``identity`` tells a world from any other; that does not depend on the count.
    """
    return _problem(worlds, task, scripted_commands(worlds, task), task.vehicles)


def _problem(worlds: Worlds, task: Task, others: Floats, deciders: Sequence[int]) -> ProfileProblem:
    scenario = task.scenario
    return profile_problem(
        worlds, task.vehicles, harm_count=task.harm_count, horizon_s=scenario.horizon_s,
        time_step_s=scenario.time_step_s, others_mps2=others, deciders=deciders,
    )  # fmt: skip


def _searched(
    worlds: Worlds, task: Task, others: Floats, given: Sequence[Profiles], deciders: Sequence[int],
    effort: dict[str, int],
) -> Found:  # fmt: skip
    """The best profiles that start from constants, from ``given``, and from each vehicle's own best profile."""
    problem = _problem(worlds, task, others, deciders)
    starts = [problem.constant(problem.even_grid(CONSTANTS)), *given]
    if len(task.vehicles) == 1:
        coupled = optimise_coupled(
            worlds, task.vehicle, harm_count=task.harm_count, horizon_s=task.scenario.horizon_s, others_mps2=others
        )
        starts.insert(0, problem.constant(-coupled.deceleration_mps2[:, np.newaxis, np.newaxis]))
        at, _ = advance(worlds, others, until_s=problem.clock[:, CLOCK.START])
        forward = np.all(at.speeds_mps >= 0.0, axis=1)
        neighbours = (forward & there for there in (task.vehicle > 0, task.vehicle < at.N - 1))
        starts.append(extreme_profiles(problem, onset_states(at, task.vehicle, None), *neighbours))
    else:
        for c, vehicle in enumerate(task.vehicles):
            alone, _ = _searched(worlds, replace(task, vehicles=(vehicle,)), others, (), deciders, effort)
            least = problem.bounds[:, np.newaxis, :, 0]
            commands = np.broadcast_to(least, (*alone.ends.shape, len(task.vehicles))).copy()
            commands[..., c] = alone.commands_mps2[..., 0]
            starts.append(Profiles(alone.ends, commands))
    return search_profiles(problem, _joined(starts, problem.n), **effort)


def _startable(profiles: Profiles) -> Profiles:
    """Those with as few phases as a search can start from; the others hold their first command."""
    ends, commands = Profiles.padded([profiles], MOST_PHASES)[0]
    last = ends[:, -1:]
    short = ends[:, MOST_PHASES - 1 : MOST_PHASES] == last
    return Profiles(
        np.where(short, ends[:, :MOST_PHASES], last),
        np.where(short[..., np.newaxis], commands[:, :MOST_PHASES], commands[:, :1]),
    )


def _joined(parts: list[Profiles], n: int) -> Profiles:
    """Several given profiles of each world, [n * Q_j] each, as one list [n * Q] world by world."""
    parts = Profiles.padded(parts, MOST_PHASES)
    ends = np.concatenate([part.ends.reshape(n, -1, MOST_PHASES) for part in parts], axis=1)
    shape = (n, -1, MOST_PHASES, parts[0].commands_mps2.shape[2])
    commands = np.concatenate([part.commands_mps2.reshape(shape) for part in parts], axis=1)
    return Profiles(ends.reshape(-1, MOST_PHASES), commands.reshape(-1, *shape[2:]))


# Episodes that agents drive, as profiles: what one does better than the best known becomes the best known.


def driven_profiles(agent: Driver, worlds: Worlds, task: Task, last_step: Ints) -> Profiles:
    """What ``agent`` commands the vehicle in every step of its episodes, as profiles; equal neighbours are joined."""
    commands = record_commands(agent, worlds, task.scenario, task.vehicle, int(last_step.max()))
    # one phase per change
    steps = commands.shape[1]
    ends = [np.append(np.flatnonzero(row[1:] != row[:-1]) + 1, steps) for row in commands]
    width = max(len(each) for each in ends)
    padded = np.array([np.append(each, np.full(width - len(each), steps)) for each in ends])
    chosen = np.take_along_axis(commands, padded - 1, axis=1)
    return Profiles(np.minimum(padded, last_step[:, np.newaxis]), chosen[:, :, np.newaxis])


def fold_episodes(
    table: BestHarmTable, scenario: Scenario, worlds: Worlds, name: str, agents: Mapping[HarmCount, Agent]
) -> BestHarmTable:
    """The table with the episodes of ``agents`` in it where they do less harm; its header says in how many worlds.

    ``agents``: for each count, ``name`` made to minimise it. Each drives the scenario's learner through ``worlds``
    (at t = 0; those that are known to end without harm are left out), and either count takes from either episode.
    Harms are those of the profiles, driven again. Where an agent cannot drive a world to its end, the table stays
    as it is. Raises ``InvalidInput`` if the scenario has not exactly one learner.
    """
    learners = [scenario.vehicle_names[i] for i in scenario.learners]
    check_one_learner(scenario.name, learners, "agents whose episodes are kept drive exactly one")
    task = Task(scenario, scenario.learners)
    identity = task_problem(worlds, task).identity
    known = np.max([table.harm(identity, harm_count) for harm_count in table.best], axis=0)
    hard = np.flatnonzero(known > 0.0)
    before = table.header.get(LOWERED, {})
    lowered = {harm_count: before.get(name, {}).get(harm_count, 0) for harm_count in table.best}
    if hard.size:
        worlds, identity = worlds.take(hard), identity[hard]
        problem = task_problem(worlds, task)
        for agent in agents.values():

            def work(at: Ints, agent: Agent = agent) -> Profiles:
                return driven_profiles(agent, worlds.take(at), task, problem.last_step[at])

            profiles, rows, _ = leaving_out_failed(work, np.arange(worlds.n))
            if profiles is None:
                continue
            first, total = problem.take(rows).follow(profiles)
            for harm_count in table.best:
                table, better = table.improved(
                    identity[rows], harm_count, first if harm_count == "first" else total, profiles
                )
                lowered[harm_count] += int(better.sum())
    return replace(table, header={**table.header, LOWERED: {**before, name: lowered}})


# The tables of best known harm that travel with the package, and the agent that drives their profiles.

TABLES = Path(__file__).resolve().parents[1] / "_tables" / "best_harm"


@cache
def shipped_tables() -> tuple[BestHarmTable, ...]:
    """Every shipped table, by name of its file."""
    return tuple(BestHarmTable.load(path) for path in sorted(TABLES.glob("*.npz")))


def best_known(worlds: Worlds, task: Task) -> dict[HarmCount, Floats]:
    """The least harm known in each world (at t = 0) under each count, [n] m2/s2; NaN where no shipped table holds it.

    Worlds are recognised by everything their harm depends on: state, parameters, the others' scripts, time step,
    horizon and the driven vehicles. Raises ``InvalidInput`` for a script whose command is not fixed at the alert, as no
    search knows it.
    """
    identity = task_problem(worlds, task).identity
    known = {harm_count: np.full(worlds.n, np.nan) for harm_count in HARM_COUNTS}
    for table in shipped_tables():
        known = {harm_count: np.fmin(harm, table.harm(identity, harm_count)) for harm_count, harm in known.items()}
    return known


def shipped_profiles(problem: ProfileProblem, harm_count: HarmCount) -> tuple[Profiles, Bools]:
    """Kept profiles of a problem with one controlled vehicle, [n], and where there is one, [n]."""
    last_step = problem.last_step
    profiles, known = Profiles(last_step[:, np.newaxis].copy(), np.zeros((problem.n, 1, 1))), np.zeros(problem.n, bool)
    for table in shipped_tables():
        kept, here = table.profiles(problem.identity, harm_count, last_step)
        profiles, kept = Profiles.padded([profiles, kept], 1)
        profiles.ends[here] = kept.ends[here]
        profiles.commands_mps2[here] = kept.commands_mps2[here]
        known |= here
    return profiles, known


def make_best_harm(argument: str | None, settings: AgentSettings) -> Agent:
    """``best_harm[:candidates]``: the shipped profile, or a search with so many candidates where there is none."""
    return BestHarm.make(argument, settings, shipped_profiles)


BEST_HARM = Part(  # what the entry point names (pyproject.toml)
    make_best_harm,
    form="best_harm[:CANDIDATES]",
    about="the best profile known; a search at the alert where none is known",
    knows=Source.MODEL,
)


_VEHICLES, _DRIVEN = 3, 1
_DECIDED = ({1}, {1, 2})  # of three vehicles: who is driven where avoidability is proven


@dataclass(frozen=True, slots=True)
class Unproven:
    """Nothing is proven for a task in these worlds."""

    because: str  # a clause


@dataclass(frozen=True, slots=True)
class Proof:
    """What is proven about each world, [n] each."""

    avoidable: Bools | None  # some admissible command avoids all contact; None where that is not decided
    reason: NDArray[np.str_] | None  # why not: "early", "front" or "rear"; "" where avoidable
    harm: Floats  # no command does less (m2/s2), under either count

    @property
    def impact(self) -> Bools:
        """Worlds in which every command leads to an impact, not only to contact."""
        return np.asarray(self.harm > 0.0, np.bool_)

    @property
    def contact(self) -> Bools | None:
        """Worlds in which every command leads to contact; None where that is not decided."""
        return None if self.avoidable is None else ~self.avoidable


@dataclass(frozen=True, slots=True)
class Limits:
    """What is known of each world before anybody drives: [n] each."""

    proof: Proof
    first_impact_harm: Floats  # least known (m2/s2): 0 where avoidable, else a table's; NaN in no table
    total_harm: Floats

    @property
    def known(self) -> Bools:
        """Worlds whose best is known for both counts, without looking at any agent."""
        return np.isfinite(self.first_impact_harm) & np.isfinite(self.total_harm)

    @property
    def warning(self) -> str:
        """That a table holds some of the worlds and not the others, a clause; empty where it is all or none of them."""
        known, avoidable = self.known, self.proof.avoidable
        listed = known if avoidable is None else known & ~avoidable
        missing = int((~known).sum())
        if not (missing and listed.any()):
            return ""
        return (
            f"the table of best known harm holds {listed.sum():,} of these {len(known):,} worlds, and not"
            f" the other {missing:,} ({100.0 * missing / len(known):.1f} %), whose best is not proven either. There the"
            " best agent of this evaluation stands in: regrets are lower bounds, and no share of the possible"
            " reduction is stated. A"
            " table is made for one list; a longer list, or one of another version, has other worlds"
            " (search_list makes one)"
        )


def known_limits(worlds: Worlds, task: Task) -> Limits | Unproven:
    """The limits of worlds at the alert; ``Unproven`` where the proofs do not cover the task."""
    proof = prove(worlds, task)
    if isinstance(proof, Unproven):
        return proof
    found = best_known(worlds, task)
    avoidable = np.zeros(worlds.n, np.bool_) if proof.avoidable is None else proof.avoidable
    first, total = (np.where(avoidable, 0.0, found[harm_count]) for harm_count in HARM_COUNTS)
    return Limits(proof, first, total)


def prove(worlds: Worlds, task: Task) -> Proof | Unproven:
    """The proofs alone, for worlds at the alert; ``Unproven`` where they do not cover the task."""
    because = unproven_because(worlds, task)
    if because is not None:
        return Unproven(because)
    horizon_s, time_step_s = task.scenario.horizon_s, task.scenario.time_step_s
    if _is_team(task):
        harm = team_bound(worlds, task.vehicles, horizon_s=horizon_s, time_step_s=time_step_s).harm
        if undecided_because(worlds, task) is not None:
            return Proof(None, None, harm)
        contact = avoidability(worlds, _DRIVEN)
        return Proof(contact.avoidable, contact.reason_name, harm)
    bound = lower_bound(worlds, task.vehicle, horizon_s=horizon_s, time_step_s=time_step_s)
    if bound.contact is None:
        return Proof(None, None, bound.harm)
    return Proof(bound.contact.avoidable, bound.contact.reason_name, bound.harm)


def unproven_because(worlds: Worlds, task: Task) -> str | None:
    """Why nothing is proven for the task in these worlds, as a clause; None when it is."""
    if worlds.vehicles.in_pieces.any() or (_is_team(task) and worlds.vehicles.build_up.any()):
        return _uneven_because(worlds)
    if not _is_team(task):
        return _uncovered_because(worlds, task)
    return _script_because(task, "harm is bounded")


def undecided_because(worlds: Worlds, task: Task) -> str | None:
    """Why it is not decided in these worlds whether contact can be avoided, as a clause; None when it is."""
    return _uneven_because(worlds) if worlds.vehicles.build_up.any() else _uncovered_because(worlds, task)


def _uncovered_because(worlds: Worlds, task: Task) -> str | None:
    """``undecided_because``, but for brakes that build up."""
    scenario, names = task.scenario, task.scenario.vehicle_names
    if not task.vehicles or (len(task.vehicles) > 1 and set(task.vehicles) not in _DECIDED):
        return f"driven are: {task.names}; avoidability is proven for one vehicle"
    if scenario.vehicles != _VEHICLES:
        return f"{scenario.vehicles} vehicles; avoidability is proven for {_VEHICLES}"
    if set(task.vehicles) not in _DECIDED:
        return f"{task.names} is driven; avoidability is proven for {names[_DRIVEN]}"
    because = _script_because(task, "avoidability is proven")
    if because is not None:
        return because
    latency_s = worlds.vehicles.latency_s
    first = (each[:, 0] for each in (worlds.vehicles.braking_capacity_mps2, worlds.vehicles.brake_rate_mps3))
    way_m = stopping_distances(worlds.speeds_mps[:, 0], latency_s[:, 0], *first)
    if not (way_m < worlds.obstacle_gap_m).all():
        return "vehicle_1 reaches the obstacle ahead by itself; nothing is proven then"
    if (latency_s[:, 0] > latency_s[:, _DRIVEN]).any():
        return f"{names[0]} may brake later than {names[_DRIVEN]}; nothing is proven then"
    return None


def _uneven_because(worlds: Worlds) -> str:
    why = "a vehicle brakes in pieces (profile)" if worlds.vehicles.in_pieces.any() else "brakes build up"
    return f"{why}; nothing is proven then"


def _is_team(task: Task) -> bool:
    """Whether the bound of teams is asked: several are driven, or one of more vehicles than ``lower_bound`` covers."""
    return len(task.vehicles) > 1 or (len(task.vehicles) == 1 and task.scenario.vehicles > _VEHICLES)


def _script_because(task: Task, proven: str) -> str | None:
    """That somebody who is not driven follows another script than full_brake, as a clause; else None."""
    scenario = task.scenario
    for i in range(scenario.vehicles):
        script = scenario.scripts.get(i, "full_brake")
        if i not in task.vehicles and script != "full_brake":
            return f"{scenario.vehicle_names[i]} follows {script}; {proven} where it follows full_brake"
    return None
