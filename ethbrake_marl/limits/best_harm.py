"""The least harm known in each world: search over whole profiles of the controlled vehicles, in the engine's physics.

What is found is realised harm: an upper bound of the true minimum, never below it. See docs/best-harm.md.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.agents.protocol import fixed_commands
from ethbrake_marl.agents.rollout import script_agents
from ethbrake_marl.defaults import SEARCH_BUDGET
from ethbrake_marl.errors import CorruptBundle, InvalidInput, PhysicsError
from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.limits.best_harm_table import BestHarmTable, BestKnown, join_tables, load_table, save_table
from ethbrake_marl.limits.extreme_profiles import extreme_profiles
from ethbrake_marl.limits.lower_bound import onset_states
from ethbrake_marl.physics import Floats, Ints, UInt64s, Worlds, advance, leaving_out_failed
from ethbrake_marl.physics.episode import START
from ethbrake_marl.scenario import Sample, Scenario, Task
from ethbrake_marl.search.kernel import MOST_PHASES
from ethbrake_marl.search.problem import ProfileProblem, profile_problem
from ethbrake_marl.search.profiles import (
    Profiles,
    SearchResult,
    constant_profiles,
    even_grid,
    follow_profiles,
    pad_profiles,
    search_profiles,
)

CHUNK = 200  # worlds between two reports of progress
LEFT_OUT = "left_out"  # key of a table's header: number in the list -> why the world is in no row
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
    chosen = scenario.learners if vehicles is None else tuple(vehicles)
    workers = _cores() if threads is None else threads
    search = _Search(scenario, worlds, scripted_commands(worlds, Task(scenario, chosen)), budget, seed, workers)
    found: list[SearchResult] = []
    identity = search.problem(chosen).identity
    if known is not None:
        known.check_fits(search.problem(chosen))
    for count in counts:
        given = [earlier.profiles for earlier in found]
        if known is not None:
            given.append(_startable(known.profiles(identity, count, search.problem(chosen).last_step)[0]))
        found.append(search.best(chosen, count, given))
    rows = np.arange(worlds.n)
    best: dict[HarmCount, BestKnown] = {}
    for count in counts:
        harms = np.stack([result.harm(count) for result in found])
        pick = np.argmin(harms, axis=0)
        ends = np.stack([result.profiles.ends for result in found])[pick, rows]
        commands = np.stack([result.profiles.commands_mps2 for result in found])[pick, rows]
        best[count] = BestKnown(harms[pick, rows], Profiles(ends, commands))
    names = [scenario.vehicle_names[i] for i in chosen]
    header = {"scenario": scenario.name, "vehicles": names, "budget": budget, "search_seed": seed}
    table = BestHarmTable(identity, best, header)
    return table if known is None else _merged(table, known)


def _merged(table: BestHarmTable, known: BestHarmTable) -> BestHarmTable:
    """The table, with what is ``known`` to do less harm; its header says what came before."""
    for harm_count in [harm_count for harm_count in table.best if harm_count in known.best]:
        nowhere = np.zeros(len(table.identity), np.int64)
        kept, has_profile = known.profiles(table.identity, harm_count, nowhere + 1)
        kept.ends[~has_profile] = 0
        table, _ = table.improved(table.identity, harm_count, known.harm(table.identity, harm_count), kept)
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
        every, _, _ = leaving_out_failed(lambda at: world_identity(sample.worlds.take(at), task), np.arange(n))
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
    table = join_tables(parts)
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
            part = kept_chunk(file, world_identity(worlds, task), question)
            if part is not None:
                return part
    part = best_harm(task.scenario, worlds, vehicles=task.vehicles, **options)
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        save_table(file, part)
    return part


def chunk_file(chunks: Path, first: int) -> Path:
    """Where the chunk that begins with world ``first`` is kept."""
    return chunks / f"{first:07d}.npz"


def kept_chunk(file: Path, identity: UInt64s, question: Mapping[str, object]) -> BestHarmTable | None:
    """A kept chunk, if it is there and answers this very question; raises ``CorruptBundle`` for a damaged one."""
    if not file.is_file():
        return None
    table = load_table(file)
    asked = {"counts": list(table.best), **{key: table.header[key] for key in question if key in table.header}}
    return table if asked == question and np.array_equal(table.identity, identity) else None


def world_identity(worlds: Worlds, task: Task) -> UInt64s:
    """What tells the problem in one world (at t = 0) from that in any other, [n]: ``search.profiles.identities``."""
    return _problem(worlds, task).identity


def realised_harm(worlds: Worlds, task: Task, best: BestKnown) -> tuple[Floats, Floats]:
    """First-impact and total harm [n] of the stored profiles, driven again in these worlds."""
    return follow_profiles(_problem(worlds, task), best.profiles)


def scripted_commands(worlds: Worlds, task: Task) -> Floats:
    """The commands [n, N] of all vehicles but those of the task; full braking in the columns of these.

    Raises ``InvalidInput`` for a script whose command is not fixed at the alert.
    """
    others = {i: script for i, script in script_agents(task.scenario).items() if i not in task.vehicles}
    return fixed_commands(others, worlds, f"scenario {task.scenario.name!r}, search for the best profiles")


def _problem(worlds: Worlds, task: Task) -> ProfileProblem:
    return _Search(task.scenario, worlds, scripted_commands(worlds, task), 1, 0, 1).problem(task.vehicles)


def _cores() -> int:
    return os.cpu_count() or 1


@dataclass(frozen=True, slots=True)
class _Search:
    """Searches in given worlds."""

    scenario: Scenario
    worlds: Worlds
    others: Floats  # [n, N]
    budget: int
    seed: int
    threads: int

    def problem(
        self, vehicles: Sequence[int], harm_count: HarmCount = "first", deciders: Sequence[int] | None = None
    ) -> ProfileProblem:
        return profile_problem(
            self.worlds,
            vehicles,
            harm_count=harm_count,
            horizon_s=self.scenario.horizon_s,
            time_step_s=self.scenario.time_step_s,
            others_mps2=self.others,
            deciders=deciders,
        )

    def best(
        self,
        vehicles: Sequence[int],
        harm_count: HarmCount,
        given: Sequence[Profiles] = (),
        deciders: Sequence[int] | None = None,
    ) -> SearchResult:
        """The best profiles that start from constants, from ``given``, and from each vehicle's own best profile."""
        problem = self.problem(vehicles, harm_count, deciders)
        starts = [constant_profiles(problem, even_grid(problem, CONSTANTS)), *given]
        if len(vehicles) == 1:
            coupled = optimise_coupled(
                self.worlds,
                vehicles[0],
                harm_count=harm_count,
                horizon_s=self.scenario.horizon_s,
                others_mps2=self.others,
            )
            starts.insert(0, constant_profiles(problem, -coupled.deceleration_mps2[:, np.newaxis, np.newaxis]))
            starts.append(self.extremes(problem, vehicles[0]))
        else:
            for c, vehicle in enumerate(vehicles):
                alone = self.best([vehicle], harm_count, (), vehicles if deciders is None else deciders).profiles
                least = problem.bounds[:, np.newaxis, :, 0]
                commands = np.broadcast_to(least, (*alone.ends.shape, len(vehicles))).copy()
                commands[..., c] = alone.commands_mps2[..., 0]
                starts.append(Profiles(alone.ends, commands))
        return search_profiles(
            problem, _joined(starts, problem.n), budget=self.budget, seed=self.seed, threads=self.threads
        )

    def extremes(self, problem: ProfileProblem, vehicle: int) -> Profiles:
        """Profiles of full drive and full braking of one vehicle, to start from."""
        at, _ = advance(self.worlds, self.others, until_s=problem.clock[:, START])
        forward = np.all(at.speeds_mps >= 0.0, axis=1)
        neighbours = (forward & there for there in (vehicle > 0, vehicle < at.N - 1))
        return extreme_profiles(problem, onset_states(at, vehicle, None), *neighbours)


def _startable(profiles: Profiles) -> Profiles:
    """Those with as few phases as a search can start from; the others hold their first command."""
    ends, commands = pad_profiles([profiles], MOST_PHASES)[0]
    last = ends[:, -1:]
    short = ends[:, MOST_PHASES - 1 : MOST_PHASES] == last
    return Profiles(
        np.where(short, ends[:, :MOST_PHASES], last),
        np.where(short[..., np.newaxis], commands[:, :MOST_PHASES], commands[:, :1]),
    )


def _joined(parts: list[Profiles], n: int) -> Profiles:
    """Several given profiles of each world, [n * Q_j] each, as one list [n * Q] world by world."""
    parts = pad_profiles(parts, MOST_PHASES)
    ends = np.concatenate([part.ends.reshape(n, -1, MOST_PHASES) for part in parts], axis=1)
    shape = (n, -1, MOST_PHASES, parts[0].commands_mps2.shape[2])
    commands = np.concatenate([part.commands_mps2.reshape(shape) for part in parts], axis=1)
    return Profiles(ends.reshape(-1, MOST_PHASES), commands.reshape(-1, *shape[2:]))
