"""The least harm known: search every world of a list, under one or both counts of harm, for one or several vehicles."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.drive import Agent, Team, play
from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.objectives import Declared
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.extensions.search.extremes import extreme_profiles
from ethbrake_marl.extensions.search.pricing import COUNTS, MOST_PHASES, Problem, Profiles, UInt64s, problem_of
from ethbrake_marl.extensions.search.search import search_profiles
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.motion.layout import BRAKING, Floats

BUDGET = 100_000  # profiles that are simulated in each world, in each count
CHUNK = 200  # worlds that are searched together
CONSTANTS = 29  # constant commands with which every search begins
TOLERANCE = 1e-6  # a harm replaces one that is known if it is less by more than this (m2/s2)


def best_harm(
    game: Game,
    alert: State,
    *,
    counts: Sequence[str] = COUNTS,
    bodies: Sequence[int] | None = None,
    budget: int = BUDGET,
    seed: int = 0,
    threads: int | None = None,
    known: BestHarmTable | None = None,
    objective: Declared = "total",
) -> BestHarmTable:
    """Search worlds at the alert for the profile of least harm; return a table.

    The harm is at most that of every profile in ``known``, and of one vehicle's best constant deceleration. With
    several vehicles it is at most what the same search reaches with one of them, while the others brake fully. It
    depends on no other world.

    Args:
        game: rules of the episodes.
        alert: worlds at the alert.
        counts: ``first``, ``total`` or both; each is searched, and every profile counts for both.
        bodies: vehicles that are controlled (1: Vehicle 1); None: the learners.
        budget: number of profiles that are simulated in each world, in each count.
        seed: of the random search.
        threads: None: one for each core.
        known: a table of the same vehicles, whose profiles are tried first.
        objective: what is minimised, as under a scenario's key ``objective``; the table then holds its values.

    Raises ``InvalidInput`` for other counts, and the errors of ``problem_of`` and ``search_profiles``.

    """
    if not counts or not set(counts) <= set(COUNTS) or len(set(counts)) < len(counts):
        raise InvalidInput(f"counts = {tuple(counts)}: must be 'first', 'total' or both, each once")
    effort = {"budget": budget, "seed": seed, "threads": (os.cpu_count() or 1) if threads is None else threads}
    problem = problem_of(game, alert, bodies, objective=objective)
    found: list[tuple[Profiles, Mapping[str, Floats]]] = []
    for count in counts if known is not None else ():
        stored = known.stored(problem, count)[1] if known is not None else None
        assert stored is not None
        found.append((stored, problem.values(stored)))
    for count in counts:
        starts = [short(profiles) for profiles, _ in found]
        found.append(_searched(game, alert, problem.counting(count), starts, objective, effort))
    names = [f"vehicle_{body}" for body in problem.bodies]
    header: dict[str, Any] = {"scenario": game.name, "vehicles": names, "budget": budget, "search_seed": seed}
    header |= {} if objective == "total" else {"objective": objective}
    header |= {} if known is None else {"after": dict(known.header)}
    least, best = {}, {}
    every, rows = Profiles.padded([profiles for profiles, _ in found]), np.arange(alert.n)
    for count in counts:
        harms = np.stack([values[count] for _, values in found])
        pick = harms.argmin(axis=0)
        least[count] = harms[pick, rows]
        best[count] = Profiles(*(np.stack(arrays)[pick, rows] for arrays in zip(*every, strict=True)))
    return BestHarmTable(problem.identity, least, best, header)


def _searched(
    game: Game, alert: State, problem: Problem, given: Sequence[Profiles], objective: Declared, effort: dict[str, int]
) -> tuple[Profiles, dict[str, Floats]]:
    """Search with all that a search can start from: with several vehicles, the best profile of each of them alone."""
    starts, bodies = starting_profiles(problem, alert, given), problem.bodies.tolist()
    for c, body in enumerate(bodies if len(bodies) > 1 else ()):
        count = "total" if problem.total else "first"
        own = problem_of(game, alert, [body], count=count, objective=objective, deciders=bodies)
        alone, _ = _searched(game, alert, own, (), objective, effort)
        commands = np.repeat(problem.bounds[:, np.newaxis, :, 0], alone.ends.shape[1], axis=1)
        commands[:, :, c] = alone.commands_mps2[:, :, 0]
        starts.append(Profiles(alone.ends, commands))
    return search_profiles(problem, joined(starts, problem.n), **effort)


def starting_profiles(problem: Problem, alert: State, given: Sequence[Profiles] = ()) -> list[Profiles]:
    """Return the profiles with which a search begins: constant commands and ``given``.

    With one vehicle also the choice of E-V2X-BM, and profiles of full driving and full braking.
    """
    starts = [problem.constant(problem.even_grid(CONSTANTS)), *given]
    if len(problem.bodies) > 1:
        return starts
    return [e_v2x_bm_profiles(problem, alert), *starts, extreme_profiles(problem)]


def e_v2x_bm_profiles(problem: Problem, alert: State) -> Profiles:
    """Return the constant deceleration of E-V2X-BM for one controlled vehicle, [n]."""
    (body,), count = problem.bodies.tolist(), "total" if problem.total else "first"
    choice = coupled(alert._replace(wanted=problem.state.wanted), body, count, problem.horizon_s)
    return problem.constant(-choice.deceleration_mps2[:, np.newaxis, np.newaxis])


def short(profiles: Profiles) -> Profiles:
    """Return the profiles; one of more than ``MOST_PHASES`` phases becomes its first command for the whole episode."""
    ends, commands = Profiles.padded([profiles], MOST_PHASES)[0]
    fits = ends[:, MOST_PHASES - 1] == ends[:, -1]
    ends = np.where(fits[:, np.newaxis], ends[:, :MOST_PHASES], ends[:, -1:])
    return Profiles(ends, np.where(fits[:, np.newaxis, np.newaxis], commands[:, :MOST_PHASES], commands[:, :1]))


def joined(parts: Sequence[Profiles], n: int) -> Profiles:
    """Join parts of some profiles for each of n worlds, [n * Q]: first all profiles of world 0, and so on."""
    ends, commands = zip(*Profiles.padded(parts, MOST_PHASES), strict=True)
    B = commands[0].shape[2]
    every = np.concatenate([each.reshape(n, -1, MOST_PHASES) for each in ends], axis=1)
    what = np.concatenate([each.reshape(n, -1, MOST_PHASES, B) for each in commands], axis=1)
    return Profiles(every.reshape(-1, MOST_PHASES), what.reshape(-1, MOST_PHASES, B))


def search_list(
    game: Game,
    alert: State,
    *,
    chunks: Path | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> BestHarmTable:
    """Run ``best_harm`` on a long list of worlds, chunk by chunk; an interrupted run goes on where it stopped.

    Args:
        game: rules of the episodes.
        alert: worlds at the alert.
        chunks: folder of the finished chunks; those of the same worlds and options are read. None: no files.
        on_progress: called with the number of finished worlds, and of all.
        options: of ``best_harm``.

    """
    parts, known = [], options.get("known")
    if known is not None:
        known.check_holds_any(problem_of(game, alert, options.get("bodies")).identity)
    for first in range(0, alert.n, CHUNK):
        some = alert.take(slice(first, first + CHUNK))
        file = None if chunks is None else chunks / f"{first:07d}.npz"
        part = None if file is None else kept(file, game, some, options)
        if part is None:
            part = best_harm(game, some, **options)
            if file is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                part.save(file)
        parts.append(part)
        if on_progress is not None:
            on_progress(first + some.n, alert.n)
    return BestHarmTable(
        np.concatenate([part.identity for part in parts]),
        {count: np.concatenate([part.harm[count] for part in parts]) for count in parts[0].harm},
        {count: Profiles.join([part.profiles[count] for part in parts]) for count in parts[0].profiles},
        parts[0].header,
    )


def kept(file: Path, game: Game, alert: State, options: Mapping[str, Any]) -> BestHarmTable | None:
    """Return the table in ``file`` if it was made for these worlds with these options; None otherwise."""
    try:
        table = BestHarmTable.load(file)
    except (InvalidInput, CorruptBundle):
        return None
    known = options.get("known")
    asked = {
        "budget": options.get("budget", BUDGET), "search_seed": options.get("seed", 0),
        "objective": options.get("objective", "total"), "after": None if known is None else dict(known.header),
    }  # fmt: skip
    made = {"objective": "total", "after": None, **table.header}
    same = all(made[key] == value for key, value in asked.items()) and [*table.harm] == [*options.get("counts", COUNTS)]
    identity: UInt64s = problem_of(game, alert, options.get("bodies")).identity
    return table if same and np.array_equal(table.identity, identity) else None


def alone(game: Game, alert: State, body: int) -> tuple[Game, State]:
    """Return the game in which one vehicle learns and the other learners brake fully, and its worlds."""
    others = [each for each in game.rules.learners.tolist() if each != body]
    wanted = alert.wanted.copy()
    wanted[:, others] = -alert.car[:, BRAKING][:, others]
    chosen = np.array([body], np.int64)
    rules = game.rules._replace(learners=chosen)
    return game._replace(rules=rules, deciders=chosen, shield=None), alert._replace(wanted=wanted)


def commands_of(game: Game, alert: State, team: Team) -> Floats:
    """Return the commands of a team at every decision, [n, T, B] m/s2; after the end of an episode its last ones."""
    bodies, states = sorted(team.drivers), play(game, alert, team)
    next(states)
    return np.stack([state.wanted[:, bodies] for _, state in states], axis=1)


def driven_profiles(problem: Problem, game: Game, alert: State, team: Team) -> Profiles:
    """Return what a team drives, as profiles with one phase for each change of command."""
    commands, last = commands_of(game, alert, team), problem.last_step
    changes = (commands[:, 1:] != commands[:, :-1]).any(axis=2)
    number = np.concatenate([np.zeros((problem.n, 1), np.int64), changes.cumsum(axis=1)], axis=1)
    K = int(number.max()) + 1
    ends = np.repeat(last[:, np.newaxis], K, axis=1)
    world, step = np.nonzero(changes)
    ends[world, number[world, step]] = np.minimum(step + 1, last[world])
    first = (number[:, np.newaxis] < np.arange(K)[:, np.newaxis]).sum(axis=2).clip(max=commands.shape[1] - 1)
    return Profiles(ends, np.take_along_axis(commands, first[:, :, np.newaxis], 1))


def lowered(
    table: BestHarmTable, game: Game, alert: State, agents: Mapping[str, Team | Agent], name: str
) -> BestHarmTable:
    """Let agents drive the worlds; return the table with what they drive where it does less harm.

    ``agents``: count -> team or agent that minimises it. The header says in how many worlds they did, under ``name``.
    Raises ``InvalidInput`` for a table of another objective than the harm of the line.
    """
    if "objective" in table.header:
        raise InvalidInput(
            f"the table holds values of the objective {table.header['objective']!r}; give a table of harm"
        )
    problem = problem_of(game, alert)
    harm = {count: each.copy() for count, each in table.harm.items()}
    profiles, rows = dict(table.profiles), table.rows(problem.identity)
    counted = dict.fromkeys(harm, 0)
    for driver in agents.values():
        team = driver if isinstance(driver, Team) else Team(name, dict.fromkeys(game.rules.learners.tolist(), driver))
        driven = driven_profiles(problem, game, alert, team)
        for count, values in problem.values(driven).items():
            if count in harm:
                better = (rows >= 0) & (values < harm[count][rows] - TOLERANCE)
                harm[count][rows[better]] = values[better]
                old, new = Profiles.padded([profiles[count], driven])
                for mine, its in zip(old, new, strict=True):
                    mine[rows[better]] = its[better]
                profiles[count], counted[count] = old, counted[count] + int(better.sum())
    before = table.header.get("lowered_by", {})
    return BestHarmTable(table.identity, harm, profiles, {**table.header, "lowered_by": {**before, name: counted}})
