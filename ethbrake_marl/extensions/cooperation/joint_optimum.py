"""Joint optimum of every level: the least known harm that its learners can achieve together, world by world.

It depends on the worlds, on the learners and on the scripts of the others; it does not depend on information or
objectives. Levels that differ only in these share one search problem, which is searched once. A result of one level
also counts for every other level whose learners can do the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.evaluation.identity import result_identity
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.extensions.cooperation.levels import (
    HARM,
    TOLERANCE,
    VEHICLE,
    WORLD,
    Level,
    Plan,
    common_worlds,
    quantity,
)
from ethbrake_marl.extensions.search.best_harm import search_list, task_problem
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.game.harm import HARM_COUNTS, HarmCount, Ledger
from ethbrake_marl.game.objectives import objective_harm
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.task import Task
from ethbrake_marl.shield.episodes import Shielded, drive_shielded
from ethbrake_marl.training.team import load_team
from ethbrake_marl.training.training import Training


@dataclass(frozen=True, slots=True)
class LevelOptimum:
    """What is known about the optimum of one level: its search, and its trained teams (of all recipes and seeds)."""

    level: Level
    worlds: Worlds
    searched: BestHarmTable
    teams: tuple[Team, ...]


def questions(plan: Plan, samples: Sequence[Sample]) -> list[tuple[Level, Sample, list[Level]]]:
    """Return each distinct search problem: the first level with it, the worlds to search, and all levels with it."""
    found: dict[bytes, tuple[Level, Sample, list[Level]]] = {}
    rows = np.arange(plan.search_episodes)
    for level, sample in zip(plan.levels, samples, strict=True):
        if level.scenario.learners:
            part = sample.take(rows)
            identity = task_problem(part.worlds, Task(level.scenario, level.scenario.learners)).identity.tobytes()
            found.setdefault(identity, (level, part, []))[2].append(level)
    return list(found.values())


def search_all(plan: Plan, samples: Sequence[Sample], jobs: int, tell: OnProgress) -> dict[str, BestHarmTable]:
    """Return the search results by level name, for every level with learners. Parts that exist already are reused."""
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
    """Return the least harm [n] of each count over all ``answers`` that the learners of ``own`` can achieve too.

    ``answers`` includes ``own``.
    """
    best = {harm_count: np.full(own.worlds.n, np.inf) for harm_count in HARM_COUNTS}
    for other in answers:
        rows = np.flatnonzero(_can_imitate(own, other))
        if rows.size:
            for harms in _harms(own, other, rows):
                for harm_count in HARM_COUNTS:
                    best[harm_count][rows] = np.minimum(best[harm_count][rows], harms[harm_count])
    return best


def _can_imitate(own: LevelOptimum, other: LevelOptimum) -> Bools:
    """Return the worlds [n] in which the learners of ``own`` can do whatever the learners of ``other`` do.

    This needs: the same learners or more, the same scripts for all others, the same line (which a sweep may change),
    equal latencies, and decisions of ``other`` that fall on decisions of ``own``. ``other`` may lack an obstacle,
    because its result is driven again with the obstacle.
    """
    mine, theirs = own.level.scenario, other.level.scenario
    same_scripts = all(theirs.scripts.get(i) == script for i, script in mine.scripts.items())
    if not (set(theirs.learners) <= set(mine.learners) and same_scripts):
        return np.zeros(own.worlds.n, np.bool_)
    obstacle_m = other.worlds.obstacle_gap_m
    later_s = own.worlds.first_decision_s(theirs.learners) - own.worlds.first_decision_s(mine.learners)
    steps = later_s / mine.time_step_s
    same = np.ones(own.worlds.n, np.bool_)
    for name in (*WORLD, *VEHICLE, "latency_s", "time_s", "command_mps2"):
        same &= (quantity(name, own.worlds) == quantity(name, other.worlds)).reshape(len(same), -1).all(axis=1)
    on_grid = np.abs(steps - np.rint(steps)) < 1e-9
    return np.asarray(same & on_grid & ((obstacle_m == own.worlds.obstacle_gap_m) | np.isinf(obstacle_m)), np.bool_)


def _harms(own: LevelOptimum, other: LevelOptimum, rows: Ints) -> Iterator[dict[HarmCount, Floats]]:
    """Yield the harm of both counts that the search and every team of ``other`` cause in worlds ``rows`` of ``own``."""
    scenario, task = other.level.scenario, Task(other.level.scenario, other.level.scenario.learners)
    worlds = replace(other.worlds, obstacle_gap_m=own.worlds.obstacle_gap_m).take(rows)
    for best in other.searched.best.values():
        kept = best._replace(harm=best.harm[rows], profiles=best.profiles.take(rows))
        yield dict(zip(HARM_COUNTS, task_problem(worlds, task).follow(kept.profiles), strict=True))
    for team in other.teams:
        driven = evaluate(worlds, {team.name: team}, scenario=scenario, aftermath=False).complete()
        ledger = driven.outcome(team.name).ledger
        yield {harm_count: ledger.world_harm(harm_count) for harm_count in HARM_COUNTS}


@dataclass(frozen=True, slots=True)
class Harms:
    """Harm by several trainings (or by one script) on the same worlds."""

    world: dict[HarmCount, Floats]  # [seeds, worlds] harm of all vehicles (m2/s2)
    vehicle: dict[HarmCount, Floats]  # [seeds, worlds, N] harm of each vehicle (m2/s2)
    collided: Bools  # [seeds, worlds]
    policies: tuple[Mapping[str, str], ...] = ()  # for each seed: vehicle -> SHA-256 of its policy's manifest
    ledgers: tuple[Ledger, ...] = ()  # one ledger for each seed


class Goal(NamedTuple):
    """What the trainings of a level minimise, as a mean over seeds, worlds and learners, also for full braking."""

    name: str
    reached: float
    full_brake: float

    @classmethod
    def of(cls, training: Training, reached: Harms, full_brake: Harms) -> Goal:
        """Return the goal of a training's reward: the harm of the line, or each learner's objective."""
        reward, scenario = training.recipe.reward, training.scenario
        objectives = reward.settled(scenario.objective, scenario.vehicles)[1]

        def mean(harms: Harms) -> float:
            if not objectives:
                return float(harms.world[reward.harm_count].mean())
            each = [objective_harm(ledger, reward.harm_count, objectives) for ledger in harms.ledgers]
            return float(np.stack(each)[:, :, list(scenario.learners)].mean())

        return cls("objective" if objectives else HARM[reward.harm_count], mean(reached), mean(full_brake))

    @property
    def missed(self) -> bool:
        """Whether full braking by everybody does better than the trained policies."""
        return self.reached > self.full_brake + TOLERANCE


@dataclass(frozen=True, slots=True)
class Measured:
    """Results of one level with one training algorithm: harm, best known harm, shielded results and goal."""

    level: Level
    algorithm: str | None  # None: the level has no learner
    reached: Harms  # harm by the trained policies (or by the scripts)
    full_brake: Harms  # harm if all vehicles brake fully, whatever their roles
    best: dict[HarmCount, Floats] | None  # [1, search_episodes] best known harm; None: the level has no learner
    identity: Mapping[str, Any] = field(default_factory=dict)  # identity of worlds, scenario and software
    shielded: dict[HarmCount, Shielded] | None = None  # [seeds, worlds] results behind the shield of each count
    goal: Goal | None = None  # None: the level has no learner


def measure(plan: Plan, jobs: int = 1, tell: OnProgress | None = None) -> list[Measured]:
    """Let all trained policies drive the common worlds, and search the joint optima. Existing parts are reused.

    Returns the results level by level in the plan's order, algorithm by algorithm. Where a policy does better than the
    search, its harm becomes the best known harm of that world. Raises the exceptions of loading teams and of
    ``common_worlds`` before any long work.
    """
    say = tell or (lambda progress: None)
    teams: dict[tuple[str, str], list[Team]] = {}
    trainings: dict[tuple[str, str], Training] = {}
    for level, algorithm, training in plan.trainings():
        trainings[level.name, algorithm] = training.training
        team = load_team(training.folder, level.scenario, training.folder.name)
        teams.setdefault((level.name, algorithm), []).append(team)
    samples = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    tables = search_all(plan, samples, jobs, say)
    answers = {}
    for level, sample in zip(plan.levels, samples, strict=True):
        if level.scenario.learners:
            own = [team for algorithm in plan.algorithms for team in teams[level.name, algorithm]]
            part = sample.worlds.take(np.arange(plan.search_episodes))
            answers[level.name] = LevelOptimum(level, part, tables[level.name], tuple(own))
    found: list[Measured] = []
    for level, sample in zip(plan.levels, samples, strict=True):
        alike = level.scenario.replace(roles=dict.fromkeys(level.scenario.vehicle_names, "full_brake"))
        braking = _drive(alike, sample, [Team({}, f"full braking in {level.name}")], say)
        about = result_identity("ablate", level.scenario, sample)
        if not level.scenario.learners:
            scripts = _drive(level.scenario, sample, [Team({}, f"scripts of {level.name}")], say)
            found.append(Measured(level, None, scripts, braking, None, about))
            continue
        known = best_known(answers[level.name], list(answers.values()))
        best = {harm_count: harm[np.newaxis] for harm_count, harm in known.items()}
        for algorithm in plan.algorithms:
            own = teams[level.name, algorithm]
            reached = _drive(level.scenario, sample, own, say)
            behind: dict[HarmCount, Shielded] = {}
            for harm_count in HARM_COUNTS if plan.shield else ():
                task, parts = Task(level.scenario, level.scenario.learners, harm_count), []
                for team in own:
                    parts.append(drive_shielded(team, sample.worlds, task))
                    name = f"driving {team.name} behind the shield, {harm_count}"
                    say(Progress(name, sample.worlds.n, sample.worlds.n))
                behind[harm_count] = Shielded.stack(parts)
            goal = Goal.of(trainings[level.name, algorithm], reached, braking)
            found.append(Measured(level, algorithm, reached, braking, best, about, behind or None, goal))
    return found


def _drive(scenario: Scenario, sample: Sample, drivers: Sequence[Driver], tell: OnProgress) -> Harms:
    """Return the harm by several drivers of one level on the same worlds."""
    outcomes = []
    for driver in drivers:
        result = evaluate(sample, {driver.name: driver}, scenario=scenario).complete()
        outcomes.append(result.outcome(driver.name))
        tell(Progress(f"driving {driver.name}", sample.worlds.n, sample.worlds.n))
    ledgers = [outcome.ledger for outcome in outcomes]
    return Harms(
        {harm_count: np.stack([each.world_harm(harm_count) for each in ledgers]) for harm_count in HARM_COUNTS},
        {harm_count: np.stack([each.vehicle_harm(harm_count) for each in ledgers]) for harm_count in HARM_COUNTS},
        np.stack([outcome.collided for outcome in outcomes]),
        tuple(dict(outcome.policies) for outcome in outcomes),
        tuple(ledgers),
    )
