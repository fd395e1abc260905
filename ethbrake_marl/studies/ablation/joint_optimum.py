"""The joint optimum of every level: the least harm known that its learners can do together, world by world.

It depends on the worlds, on who learns, and on the scripts of the others; not on who knows what, nor on objectives. So
levels that differ in these only ask one question, which is searched once, and what is known of one level is known of
every other whose learners can do the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ethbrake_marl.agents.team import Team
from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.limits.best_harm import (
    CHUNK,
    chunk_file,
    kept_chunk,
    realised_harm,
    search_list,
    world_identity,
)
from ethbrake_marl.limits.best_harm_table import BestHarmTable
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.episode import first_decision_s
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.scenario import Sample, Task
from ethbrake_marl.studies.ablation.plan import Level, Plan


@dataclass(frozen=True, slots=True)
class LevelOptimum:
    """What is known of one level: its search, and what its teams (of all recipes and seeds) do in the same worlds."""

    level: Level
    worlds: Worlds
    searched: BestHarmTable
    teams: tuple[Team, ...]


def questions(plan: Plan, samples: Sequence[Sample]) -> list[tuple[Level, Sample, list[Level]]]:
    """Each question once: the first level that asks it, its worlds to be searched, and all levels that ask it."""
    found: dict[bytes, tuple[Level, Sample, list[Level]]] = {}
    rows = np.arange(plan.search_episodes)
    for level, sample in zip(plan.levels, samples, strict=True):
        if level.trained:
            part = sample.take(rows)
            identity = world_identity(part.worlds, Task(level.scenario, level.scenario.learners)).tobytes()
            found.setdefault(identity, (level, part, []))[2].append(level)
    return list(found.values())


def parts_left(plan: Plan, level: Level, part: Sample) -> tuple[int, list[Path]]:
    """Worlds of a question that ``search_list`` will search, not finding them kept; and what it finds damaged."""
    left, damaged = 0, []
    identity = world_identity(part.worlds, Task(level.scenario, level.scenario.learners))
    question = {"counts": list(HARM_COUNTS), "budget": plan.budget, "search_seed": 0}
    for first in range(0, part.worlds.n, CHUNK):
        file, wanted = chunk_file(plan.optimum_folder(level), first), identity[first : first + CHUNK]
        try:
            kept = kept_chunk(file, wanted, question)
        except CorruptBundle:
            kept = None
            damaged.append(file)
        left += 0 if kept is not None else len(wanted)
    return left, damaged


def search_all(plan: Plan, samples: Sequence[Sample], jobs: int, tell: OnProgress) -> dict[str, BestHarmTable]:
    """The search of every level with learners, by its name; parts that were found earlier are kept."""
    found: dict[str, BestHarmTable] = {}
    for level, part, alike in questions(plan, samples):
        table = search_list(
            level.scenario,
            part,
            budget=plan.budget,
            threads=jobs,
            chunks=plan.optimum_folder(level),
            on_progress=partial(_tell, tell, f"joint optimum of {level.name}"),
        )
        found |= {each.name: table for each in alike}
    return found


def _tell(tell: OnProgress, name: str, done: int, total: int) -> None:
    tell(Progress(name, done, total))


def best_known(own: LevelOptimum, answers: Sequence[LevelOptimum]) -> dict[HarmCount, Floats]:
    """The least harm [n] of each count in all ``answers`` (its own is among them) that these learners can give too."""
    best = {harm_count: np.full(own.worlds.n, np.inf) for harm_count in HARM_COUNTS}
    for other in answers:
        rows = np.flatnonzero(_can_imitate(own, other))
        if rows.size:
            for harms in _harms(own, other, rows):
                for harm_count in HARM_COUNTS:
                    best[harm_count][rows] = np.minimum(best[harm_count][rows], harms[harm_count])
    return best


def _can_imitate(own: LevelOptimum, other: LevelOptimum) -> Bools:
    """In which worlds the learners of ``own`` can do what those of ``other`` do, [n].

    They are the same vehicles or more, all others follow the same scripts, latencies are equal, and the decisions of
    ``other`` fall on theirs. What an obstacle ahead does to it is found by driving, so ``other`` may lack one.
    """
    mine, theirs = own.level.scenario, other.level.scenario
    same_scripts = all(theirs.scripts.get(i) == script for i, script in mine.scripts.items())
    if not (set(theirs.learners) <= set(mine.learners) and same_scripts):
        return np.zeros(own.worlds.n, np.bool_)
    latency_s, obstacle_m = own.worlds.vehicles.latency_s, other.worlds.obstacle_gap_m
    later_s = first_decision_s(own.worlds, theirs.learners) - first_decision_s(own.worlds, mine.learners)
    steps = later_s / mine.time_step_s
    same = (latency_s == other.worlds.vehicles.latency_s).all(axis=1)
    on_grid = np.abs(steps - np.rint(steps)) < 1e-9
    return np.asarray(same & on_grid & ((obstacle_m == own.worlds.obstacle_gap_m) | np.isinf(obstacle_m)), np.bool_)


def _harms(own: LevelOptimum, other: LevelOptimum, rows: Ints) -> Iterator[dict[HarmCount, Floats]]:
    """Harm of both counts that the search and every team of ``other`` do in some worlds of ``own``."""
    scenario, task = other.level.scenario, Task(other.level.scenario, other.level.scenario.learners)
    worlds = replace(other.worlds, obstacle_gap_m=own.worlds.obstacle_gap_m).take(rows)
    for best in other.searched.best.values():
        kept = best._replace(harm=best.harm[rows], profiles=best.profiles.take(rows))
        yield dict(zip(HARM_COUNTS, realised_harm(worlds, task, kept), strict=True))
    for team in other.teams:
        driven = evaluate(worlds, {team.name: team}, scenario=scenario, aftermath=False).complete()
        ledger = driven.outcome(team.name).ledger
        yield {harm_count: ledger.world_harm(harm_count) for harm_count in HARM_COUNTS}
