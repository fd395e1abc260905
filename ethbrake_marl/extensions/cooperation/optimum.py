"""Joint optimum of a level: in each world, the least known harm or cost that its learners can cause together.

It depends on worlds, learners and scripts, but not on what the learners know or minimise, so levels that differ only in
this share one search. A level also uses the best commands of every other level whose commands its learners can give.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import COLUMN
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import FIRST_DECISION, State
from ethbrake_marl.extensions.cooperation.ablation import Ablation, Measured
from ethbrake_marl.extensions.search.best_harm import search_list
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.motion.layout import FAR_M, GAP, OWN_LATENCY, WEIGHT, Bools, Floats
from ethbrake_marl.names import open_game
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.worlds.scenario import Scenario

ON_GRID = 1e-9  # part of a step by which decisions of two levels may differ


class Answer(NamedTuple):
    scenario: Scenario
    game: Game
    worlds: State  # at the alert, in which the joint optimum was searched, [m]
    searched: BestHarmTable
    driven: Mapping[str, Sequence[Floats]]  # count -> harm of each trained team, [m]


def with_optima(plan: Ablation, measured: Sequence[Measured], threads: int, tell: OnProgress) -> list[Measured]:
    """Add the joint optimum to the results of each level with a learner. Finished parts of the search are read back."""
    tables: dict[bytes, BestHarmTable] = {}
    answers: dict[str, Answer] = {}
    for one in measured:
        name, scenario = one.level.name, one.level.scenario
        if scenario.learners and name not in answers:
            game, worlds = open_game(scenario)[1], one.worlds.take(slice(plan.search_episodes))
            identity = problem_of(game, worlds).identity.tobytes()
            if identity not in tables:
                say = partial(_tell, tell, f"joint optimum of {name}")
                folder = plan.folder / "optimum" / name
                tables[identity] = search_list(
                    game, worlds, chunks=folder, on_progress=say, counts=[*COLUMN], budget=plan.budget, threads=threads
                )
            teams = [each.reached for each in measured if each.level.name == name]
            driven = {
                count: [row[: worlds.n] for own in teams for row in own[column]] for count, column in COLUMN.items()
            }
            answers[name] = Answer(scenario, game, worlds, tables[identity], driven)
    best = {
        name: {count: least_known(answer, answers.values(), count)[np.newaxis] for count in COLUMN}
        for name, answer in answers.items()
    }
    return [each._replace(best=best.get(each.level.name)) for each in measured]


def _tell(tell: OnProgress, name: str, done: int, total: int) -> None:
    tell(Progress(name, done, total))


def least_known(own: Answer, answers: Iterable[Answer], count: str) -> Floats:
    """Return the least known harm in each world of ``own``, [m] m2/s2. ``answers`` are the results of all levels."""
    best = np.full(own.worlds.n, np.inf)
    for other in answers:
        can = can_imitate(own, other)
        rows = np.flatnonzero(can)
        if rows.size:
            line = other.worlds.line.copy()
            line[:, :, 0] = own.worlds.line[:, :, 0]  # the obstacle
            problem = problem_of(other.game, other.worlds._replace(line=line).take(rows))
            for profiles in other.searched.profiles.values():
                harm = problem.follow(profiles.take(rows)).harm(count)
                best[rows] = np.minimum(best[rows], harm)
            same = rows[other.worlds.line[rows, GAP, 0] == own.worlds.line[rows, GAP, 0]]
            for driven in other.driven[count]:
                best[same] = np.minimum(best[same], driven[same])
    return best


def can_imitate(own: Answer, other: Answer) -> Bools:
    """Return in which worlds the learners of ``own`` can give the commands of the learners of ``other``, [m].

    They can if each learner of ``other`` learns in ``own``, the other vehicles of ``own`` have the same roles, lines
    and latencies are the same, and each decision time of ``other`` is also one of ``own``. Only ``own`` may have an
    obstacle, because the commands are simulated again in its worlds.
    """
    mine, theirs = own.scenario, other.scenario
    scripted = [name for name, role in mine.roles.items() if role != "learner"]
    if not set(theirs.learners) <= set(mine.learners) or any(mine.roles[n] != theirs.roles[n] for n in scripted):
        return np.zeros(own.worlds.n, np.bool_)
    rows = [row for row in range(own.worlds.car.shape[1]) if row not in (OWN_LATENCY, WEIGHT)]
    same = (own.worlds.line[:, :, 1:] == other.worlds.line[:, :, 1:]).all(axis=(1, 2))
    same &= (own.worlds.car[:, rows, 1:] == other.worlds.car[:, rows, 1:]).all(axis=(1, 2))
    first, later = (problem_of(each.game, each.worlds).state.clock[:, FIRST_DECISION] for each in (own, other))
    steps = (later - first) / mine.time_step_s
    ahead = other.worlds.line[:, GAP, 0]
    return np.asarray(
        same & (np.abs(steps - np.rint(steps)) < ON_GRID) & ((ahead == own.worlds.line[:, GAP, 0]) | (ahead >= FAR_M))
    )
