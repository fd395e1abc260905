"""Best known harm: search every world of a list for the commands with the least harm, for one or several vehicles."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.agents.team import Team, play
from ethbrake_marl.episode.counts import HONEST, AnyCount, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.objectives import Declared
from ethbrake_marl.episode.state import END, State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.search.extremes import extreme_profiles
from ethbrake_marl.extensions.search.pricing import Problem, Profiles, beside_braking, best_of, problem_of
from ethbrake_marl.extensions.search.search import compact, search_profiles
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.parallel import chosen_threads

SEARCH_BUDGET = 20_000  # profiles that are simulated in each world, in each count
SEARCH_CHUNK = 200  # worlds that are searched together
SEARCH_CONSTANTS = 29  # constant commands with which every search begins


def best_harm(
    game: Game,
    alert: State,
    *,
    harm_counts: Sequence[AnyCount] = (HONEST,),
    bodies: Sequence[int] | None = None,
    budget: int = SEARCH_BUDGET,
    seed: int = 0,
    threads: int | None = None,
    first_profiles: Sequence[Profiles] = (),
    objective: Declared = "total",
) -> BestHarmTable:
    """Search worlds at the alert for the profile (commands over time) of least harm; return a table.

    A world's harm is at most that of its profiles in ``first_profiles``, and of any controlled vehicle's best constant
    deceleration. With several vehicles it is at most what the same search reaches with one of them, while the others
    brake fully. The result of a world does not depend on other worlds.

    Args:
        game: game of the worlds' scenario.
        alert: worlds at the alert.
        harm_counts: counts of harm to search (``episode.counts``); each also tries the profiles of those before.
        bodies: vehicles that are controlled (1: Vehicle 1); None: the learners.
        budget: number of profiles that are simulated in each world, for each count.
        seed: seed of the random search.
        threads: number of threads; None: the environment variable ``ETHBRAKE_THREADS``, or 1.
        first_profiles: profiles that are tried first, [n] each, with any number of phases.
        objective: what is minimised, as in a scenario's key ``objective``; ``total``: the harm of the line.

    Raises ``InvalidInput`` for other counts, bodies or objectives, for a budget below 1 and for physics without exact
    impacts.

    """
    counts = [HarmCount.of(count, "harm_counts: count") for count in harm_counts]
    if not counts or len(set(counts)) < len(counts):
        raise InvalidInput(f"harm_counts = {tuple(harm_counts)}: must be one or more counts of harm, each once")
    effort = {"budget": budget, "seed": seed, "threads": chosen_threads(threads)}
    problem = problem_of(game, alert, bodies, objective=objective)
    every_profile = [*first_profiles]
    for count in counts:
        every_profile.append(_search(game, alert, problem.with_count(count), every_profile, objective, effort)[0])
    names = [f"vehicle_{body}" for body in problem.bodies]
    header: dict[str, Any] = {"scenario": game.name, "vehicles": names, "budget": budget, "search_seed": seed}
    header["physics"] = physics_digest()
    header |= {} if objective == "total" else {"objective": objective}
    header["weights"] = {count.name: [*count.weights] for count in counts}
    ends = [(problem.follow(profiles), profiles) for profiles in every_profile]
    best = {
        count.name: best_of([(problem.value(last, count), profiles) for last, profiles in ends]) for count in counts
    }
    harms, best_profiles = (
        {count: harm for count, (harm, _) in best.items()},
        {count: winners for count, (_, winners) in best.items()},
    )
    return BestHarmTable(problem.identity, harms, best_profiles, header)


def _search(
    game: Game,
    alert: State,
    problem: Problem,
    first_profiles: Sequence[Profiles],
    objective: Declared,
    effort: dict[str, int],
) -> tuple[Profiles, dict[str, Floats]]:
    starts, bodies = starting_profiles(problem, alert, first_profiles), problem.bodies.tolist()
    for body in bodies if len(bodies) > 1 else ():
        single_problem = problem_of(
            game, alert, [body], harm_count=problem.harm_count, objective=objective, deciders=bodies
        )
        starts.append(
            beside_braking(problem, single_problem, _search(game, alert, single_problem, (), objective, effort)[0])
        )
    return search_profiles(problem, starts, **effort)


def starting_profiles(problem: Problem, alert: State, first_profiles: Sequence[Profiles] = ()) -> list[Profiles]:
    """Profiles with which a search begins: constant commands and ``first_profiles``.

    For a single controlled vehicle also E-V2X-BM's choice, and profiles of full driving and full braking.
    """
    starts = [problem.constant(problem.even_grid(SEARCH_CONSTANTS)), *first_profiles]
    if len(problem.bodies) > 1:
        return starts
    return [e_v2x_bm_profiles(problem, alert), *starts, extreme_profiles(problem)]


def e_v2x_bm_profiles(problem: Problem, alert: State) -> Profiles:
    alert, end_s = alert._replace(wanted=problem.state.wanted), problem.state.clock[:, END]
    choice = coupled(alert, int(problem.bodies[0]), problem.harm_count, end_s)
    return problem.constant(-choice.deceleration_mps2[:, np.newaxis, np.newaxis])


def search_list(
    game: Game,
    alert: State,
    *,
    chunks: Path | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    known_table: BestHarmTable | None = None,
    teams: Iterable[Team] = (),
    bodies: Sequence[int] | None = None,
    threads: int | None = None,
    **options: Any,
) -> BestHarmTable:
    """Run ``best_harm`` on a long list of worlds, part by part; an interrupted run continues where it stopped.

    Args:
        game: game of the worlds' scenario.
        alert: worlds at the alert.
        chunks: folder for the files of finished parts, which a later run of the same search reads. None: no files.
        on_progress: called with the number of finished worlds, and of all.
        known_table: a table of the same vehicles, whose profiles are tried first.
        teams: teams whose commands are also tried first.
        bodies: as for ``best_harm``.
        threads: as for ``best_harm``.
        options: other arguments of ``best_harm``.

    Raises the errors of ``best_harm``, and ``InvalidInput`` if ``known_table`` contains none of the worlds.

    """
    parts = []
    if known_table is not None:
        known_table.check_holds_any(problem_of(game, alert, bodies).identity)
    for first in range(0, alert.n, SEARCH_CHUNK):
        some = alert.take(slice(first, first + SEARCH_CHUNK))
        problem = problem_of(game, some, bodies)
        first_profiles = (
            []
            if known_table is None
            else [known_table.stored(problem, HarmCount.of(count))[1] for count in known_table.harm]
        )
        first_profiles += [driven_profiles(problem, game, some, team) for team in teams]
        request = [repr(options).encode(), physics_digest().encode(), problem.identity.tobytes()]
        request += [array.tobytes() for part_profiles in first_profiles for array in part_profiles]
        file = None if chunks is None else chunks / f"{hashlib.sha256(b''.join(request)).hexdigest()[:16]}.npz"
        if file is not None and file.exists():
            part = BestHarmTable.load(file)
        else:
            part = best_harm(game, some, bodies=bodies, threads=threads, first_profiles=first_profiles, **options)
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


def driven_profiles(problem: Problem, game: Game, alert: State, team: Team) -> Profiles:
    """Commands of a team, as profiles with one phase for each change of command; at the end the last repeat."""
    bodies, states = sorted(team.drivers), play(game, alert, team)
    next(states)
    commands = np.stack([state.wanted[:, bodies] for _, state in states], axis=1)
    missing = int(problem.last_step.max()) - commands.shape[1]
    steps = Profiles.of_steps(np.pad(commands, ((0, 0), (0, missing), (0, 0)), mode="edge"), problem.last_step)
    return Profiles.join([compact(*profile) for profile in zip(*steps, strict=True)])
