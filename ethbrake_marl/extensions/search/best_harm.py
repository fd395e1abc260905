"""Compute the best known harm of each world by a search over command profiles.

Arguments that several functions share: ``worlds`` are n worlds at t = 0. ``task`` has the scenario, the controlled
vehicles, and the harm count to minimise. ``others`` [n, N] are the constant commands of the vehicles that follow
scripts, m/s2. ``budget`` is the number of profiles that are simulated in each world for each harm count. A *chunk* is a
part of a list of worlds: at most ``CHUNK`` worlds.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.errors import CorruptBundle, InvalidInput, PhysicsError, check_one_learner
from ethbrake_marl.extensions.proofs.onset import onset_states
from ethbrake_marl.extensions.search.extreme_profiles import extreme_profiles
from ethbrake_marl.extensions.search.problem import Found, minimising, search_profiles
from ethbrake_marl.extensions.search.tables import COUNTS, LEFT_OUT, LOWERED, OBJECTIVE, BestHarmTable, BestKnown
from ethbrake_marl.first_edition.agents.driving import record_commands, script_agents
from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.first_edition.agents.protocol import Agent, Driver, fixed_commands
from ethbrake_marl.first_edition.engine.profiles import MOST_PHASES, ProfileProblem, Profiles, profile_problem
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.first_edition.game.objectives import Declared
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.episode import CLOCK
from ethbrake_marl.first_edition.physics.left_out import leaving_out_failed
from ethbrake_marl.first_edition.physics.state import Floats, Ints, UInt64s, Worlds
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task

SEARCH_BUDGET = 100_000  # candidates per world and count

CHUNK = 200  # worlds between two reports of progress

CONSTANTS = 29  # number of evenly spaced constant commands with which every search starts

Progress = Callable[[int, int], None]  # called with the number of worlds done and their total


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
    objective: Declared = "total",
) -> BestHarmTable:
    """Search each world for the profile with the least harm under each count; return a table of these profiles.

    There is one search for each count. The harm in the table is at most the harm in ``known`` and, with one controlled
    vehicle, the harm of the best constant deceleration. With several controlled vehicles, the harm is also at most the
    harm that the search reaches with only one of them while the others brake fully. The result for a world does not
    depend on ``threads`` or on the other worlds. Raises ``InvalidInput`` if ``vehicles`` or ``counts`` is empty, if the
    command of a script is not fixed at the alert, or if ``budget`` is below 1.

    Args:
        scenario: scenario of the worlds.
        worlds: worlds at t = 0, [n].
        counts: harm counts to minimise: ``first``, ``total``, or both.
        vehicles: indices of the controlled vehicles; None: the learners of the scenario.
        budget: number of profiles to simulate in each world for each count.
        seed: seed of the random search.
        threads: None: one thread for each core.
        known: table for the same controlled vehicles; the search also starts from its profiles.
        objective: objective to minimise, as under a scenario's key ``objective``. If it is not ``total``, the table
            contains values of this objective instead of harm, and its header names the objective.

    """
    if not counts or not set(counts) <= set(HARM_COUNTS) or len(set(counts)) != len(counts):
        raise InvalidInput(
            f"counts = {tuple(counts)}: counts must contain 'first', 'total' or both, and none of them twice"
        )
    task = Task(scenario, scenario.learners if vehicles is None else tuple(vehicles))
    others, problem = scripted_commands(worlds, task), task_problem(worlds, task)
    identity, aimed = problem.identity, partial(minimising, worlds=worlds, declared=objective, vehicles=task.vehicles)
    if known is not None:
        known.check_fits(problem)
    effort = {"budget": budget, "seed": seed, "threads": (os.cpu_count() or 1) if threads is None else threads}
    results: list[Found] = []
    for count in counts:
        starts = [profiles for profiles, _ in results]
        if known is not None:
            starts.append(startable(known.profiles(identity, count, problem.last_step)[0]))
        results.append(_searched(worlds, replace(task, harm_count=count), others, starts, task.vehicles, effort, aimed))
    rows = np.arange(worlds.n)
    best: dict[HarmCount, BestKnown] = {}
    for count in counts:
        harms = np.stack([harm[count] for _, harm in results])
        pick = np.argmin(harms, axis=0)
        ends = np.stack([profiles.ends for profiles, _ in results])[pick, rows]
        commands = np.stack([profiles.commands_mps2 for profiles, _ in results])[pick, rows]
        best[count] = BestKnown(harms[pick, rows], Profiles(ends, commands))
    names = [scenario.vehicle_names[i] for i in task.vehicles]
    header = {"scenario": scenario.name, "vehicles": names, "budget": budget, "search_seed": seed}
    header |= {} if objective == "total" else {OBJECTIVE: objective}
    table = BestHarmTable(identity, best, header)
    if known is None:
        return table
    for count in [count for count in counts if count in known.best]:
        if known.header.get(OBJECTIVE, "total") != objective:
            stored, _ = known.profiles(identity, count, problem.last_step)
            table, _ = table.improved(identity, count, aimed(problem).values(stored)[count], stored)
            continue
        stored, has_profile = known.profiles(identity, count, np.ones(worlds.n, np.int64))
        stored.ends[~has_profile] = 0
        table, _ = table.improved(identity, count, known.harm(identity, count), stored)
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
    objective: Declared = "total",
) -> BestHarmTable:
    """Run ``best_harm`` on a long list of worlds, chunk by chunk; an interrupted run can be continued.

    The table leaves out worlds that cannot be simulated because of a defect of the physics. The header names these
    worlds under the key ``LEFT_OUT``. Raises ``InvalidInput`` in the same cases as ``best_harm``, and if ``known``
    contains no world of the list. Raises ``PhysicsError`` if no world of the list can be simulated.

    ``chunks`` is the folder for the tables of the finished chunks, one file each; None: no files. A later call with the
    same arguments reads these files; a call with other arguments overwrites them. ``on_progress`` is called with the
    number of finished worlds and the number of all worlds. The other arguments mean the same as in ``best_harm``.
    """
    parts: list[BestHarmTable] = []
    left_out: dict[int, str] = {}
    n, task = sample.worlds.n, Task(scenario, scenario.learners if vehicles is None else tuple(vehicles))
    if known is not None:
        every, _, _ = leaving_out_failed(lambda at: task_problem(sample.worlds.take(at), task).identity, np.arange(n))
        if every is not None:
            known.check_holds_any(every)
    options = {"counts": counts, "budget": budget, "seed": seed, "threads": threads, "known": known}
    options["objective"] = objective
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
    both = [harm_count for harm_count in COUNTS if all(harm_count in each.best for each in parts)]
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
    """Return the table of one chunk: from ``file`` if it has the same worlds and options, otherwise from a search.

    A new table is written to ``file`` (None: no file is read or written). ``every`` are all worlds of the list, and
    ``rows`` the indices of the chunk's worlds among them. ``options`` are keyword arguments of ``best_harm``.
    """
    worlds = every.take(rows)
    known = options["known"]
    question = {"counts": list(options["counts"]), "budget": options["budget"], "search_seed": options["seed"]}
    question |= {} if known is None else {"after": dict(known.header)}
    question[OBJECTIVE] = options["objective"]
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
    """Return how many worlds ``search_list`` still has to search, and the damaged files in the folder ``chunks``.

    The result is for a call of ``search_list`` with these arguments and no others.
    """
    left, damaged = 0, []
    identity = task_problem(sample.worlds, Task(scenario, scenario.learners)).identity
    question = {"counts": list(HARM_COUNTS), "budget": budget, "search_seed": 0}
    for first in range(0, len(identity), CHUNK):
        file, wanted = chunk_file(chunks, first), identity[first : first + CHUNK]
        try:
            stored = kept_chunk(file, wanted, question)
        except CorruptBundle:
            stored = None
            damaged.append(file)
        left += 0 if stored is not None else len(wanted)
    return left, damaged


def chunk_file(chunks: Path, first: int) -> Path:
    """Return the path of the file for the ``CHUNK`` worlds from index ``first`` on, in the folder ``chunks``."""
    return chunks / f"{first:07d}.npz"


def kept_chunk(file: Path, identity: UInt64s, question: Mapping[str, object]) -> BestHarmTable | None:
    """Return the table in ``file``; None if the file is missing or was made for other worlds or with other options.

    ``identity`` are the hashes of the chunk's worlds. ``question`` are the options of the search (counts, budget,
    seed). Raises ``CorruptBundle`` if the file is damaged.
    """
    if not file.is_file():
        return None
    table = BestHarmTable.load(file)
    asked = {"counts": list(table.best), OBJECTIVE: "total"}
    asked |= {key: table.header[key] for key in question if key in table.header}
    return table if asked == {OBJECTIVE: "total", **question} and np.array_equal(table.identity, identity) else None


def scripted_commands(worlds: Worlds, task: Task) -> Floats:
    """Return the constant command of each vehicle that follows a script, [n, N] m/s2.

    For the controlled vehicles the command is full braking. Raises ``InvalidInput`` if the command of a script is not
    fixed at the alert.
    """
    others = {i: script for i, script in script_agents(task.scenario).items() if i not in task.vehicles}
    return fixed_commands(others, worlds, f"scenario {task.scenario.name!r}, search for the best profiles")


def task_problem(worlds: Worlds, task: Task) -> ProfileProblem:
    """Return the problem of a search for the best profiles of the controlled vehicles.

    The field ``identity`` [n] of the problem is a hash of everything that affects the harm of a world. The hash does
    not depend on the harm count.
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
    effort: dict[str, int], aimed: Callable[[ProfileProblem], ProfileProblem],
) -> Found:  # fmt: skip
    """Search each world; return the profiles with the least harm, and their harm under each harm count.

    With several controlled vehicles, the search also starts from the best profile of each controlled vehicle while the
    others brake fully. ``given`` are additional starting profiles. The first decision comes when the first vehicle of
    ``deciders`` may act. ``effort`` are the arguments ``budget``, ``seed`` and ``threads`` of ``search_profiles``.
    ``aimed`` replaces the harm that a problem minimises by the objective of the controlled vehicles.
    """
    problem = aimed(_problem(worlds, task, others, deciders))
    starts = starting_profiles(problem, worlds, task, others, given)
    if len(task.vehicles) > 1:
        for c, vehicle in enumerate(task.vehicles):
            alone, _ = _searched(worlds, replace(task, vehicles=(vehicle,)), others, (), deciders, effort, aimed)
            least = problem.bounds[:, np.newaxis, :, 0]
            commands = np.broadcast_to(least, (*alone.ends.shape, len(task.vehicles))).copy()
            commands[..., c] = alone.commands_mps2[..., 0]
            starts.append(Profiles(alone.ends, commands))
    return search_profiles(problem, joined(starts, problem.n), **effort)


def starting_profiles(
    problem: ProfileProblem, worlds: Worlds, task: Task, others: Floats, given: Sequence[Profiles] = ()
) -> list[Profiles]:
    """Return the profiles from which a search starts: constant commands and ``given``.

    With one controlled vehicle, the result also contains the profiles of coupled E-V2X-BM and the extreme profiles
    (full drive and full braking).
    """
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
    return starts


def startable(profiles: Profiles) -> Profiles:
    """Replace each profile of more than ``MOST_PHASES`` phases by its first command for the whole episode."""
    ends, commands = Profiles.padded([profiles], MOST_PHASES)[0]
    last = ends[:, -1:]
    short = ends[:, MOST_PHASES - 1 : MOST_PHASES] == last
    return Profiles(
        np.where(short, ends[:, :MOST_PHASES], last),
        np.where(short[..., np.newaxis], commands[:, :MOST_PHASES], commands[:, :1]),
    )


def joined(parts: list[Profiles], n: int) -> Profiles:
    """Join arrays of profiles: array j has Q_j profiles of each of n worlds, and the result has Q = sum of Q_j.

    An array lists the profiles of world 0 first, then the profiles of world 1, and so on.
    """
    parts = Profiles.padded(parts, MOST_PHASES)
    ends = np.concatenate([part.ends.reshape(n, -1, MOST_PHASES) for part in parts], axis=1)
    shape = (n, -1, MOST_PHASES, parts[0].commands_mps2.shape[2])
    commands = np.concatenate([part.commands_mps2.reshape(shape) for part in parts], axis=1)
    return Profiles(ends.reshape(-1, MOST_PHASES), commands.reshape(-1, *shape[2:]))


def driven_profiles(agent: Driver, worlds: Worlds, task: Task, last_step: Ints) -> Profiles:
    """Let ``agent`` drive the n worlds, and return its commands as one profile for each world, [n].

    Neighbouring steps with equal commands become one phase. ``last_step`` [n] is the number of time steps of each
    episode.
    """
    commands = record_commands(agent, worlds, task.scenario, task.vehicle, int(last_step.max()))
    # one phase for each change of command
    steps = commands.shape[1]
    ends = [np.append(np.flatnonzero(row[1:] != row[:-1]) + 1, steps) for row in commands]
    width = max(len(each) for each in ends)
    padded = np.array([np.append(each, np.full(width - len(each), steps)) for each in ends])
    chosen = np.take_along_axis(commands, padded - 1, axis=1)
    return Profiles(np.minimum(padded, last_step[:, np.newaxis]), chosen[:, :, np.newaxis])


def fold_episodes(
    table: BestHarmTable, scenario: Scenario, worlds: Worlds, name: str, agents: Mapping[HarmCount, Agent]
) -> BestHarmTable:
    """Let agents drive the worlds; return a copy of ``table`` with the agents' harm where it is lower.

    The agents' commands are recorded and simulated again; the table stores the harm of the second simulation. The
    table's header says in how many worlds the harm was lowered, under the agent's name ``name``. Worlds with best known
    harm 0 are skipped. If the simulation with an agent fails in a world, the harm of this world stays as it was. Raises
    ``InvalidInput`` unless the scenario has exactly one learner, or if the table is for another objective than
    ``total``.

    ``agents`` has, for each harm count, an agent that minimises this count. Each episode is compared with the table
    under both counts.
    """
    if OBJECTIVE in table.header:
        raise InvalidInput(
            f"the table contains values of the objective {table.header[OBJECTIVE]!r}; give a table of the harm of the"
            " line (objective total)"
        )
    learners = [scenario.vehicle_names[i] for i in scenario.learners]
    check_one_learner(scenario.name, learners, "the commands of an agent can be stored for exactly one")
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
