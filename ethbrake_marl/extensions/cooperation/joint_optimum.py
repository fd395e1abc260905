"""Joint optimum of every level: the least known harm that its learners can achieve together, world by world.

It depends on the worlds, on the learners and on the scripts of the others. It does not depend on what anyone knows or
on the objectives, so levels that differ only in information or objectives share one search. A result of one level also
counts for every other level whose learners can do the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from ethbrake_marl.shields.episodes import Shielded, drive_shielded
from ethbrake_marl.training.team import load_team
from ethbrake_marl.training.training import Training


@dataclass(frozen=True, slots=True)
class LevelOptimum:
    """What is known about the joint optimum of one level: a search result, and trained teams that may be better."""

    level: Level  # the level
    worlds: Worlds  # worlds in which the optimum was searched
    searched: BestHarmTable  # best harm and profiles that the search found in these worlds
    teams: tuple[Team, ...]  # trained teams of the level, of all recipes and seeds


def questions(plan: Plan, samples: Sequence[Sample]) -> list[tuple[Level, Sample, list[Level]]]:
    """Return the searches for a joint optimum that are needed, one for all levels with the same optimum.

    Levels have the same optimum if worlds and learners are alike for the search. Each item is: the first such level,
    the worlds to search, and all such levels. Levels without learners need no search. ``samples`` holds the worlds of
    each level of ``plan``, in the same order.
    """
    by_content: dict[bytes, tuple[Level, Sample, list[Level]]] = {}
    rows = np.arange(plan.search_episodes)
    for level, sample in zip(plan.levels, samples, strict=True):
        if level.scenario.learners:
            part = sample.take(rows)
            identity = task_problem(part.worlds, Task(level.scenario, level.scenario.learners)).identity.tobytes()
            by_content.setdefault(identity, (level, part, []))[2].append(level)
    return list(by_content.values())


def search_all(plan: Plan, samples: Sequence[Sample], jobs: int, tell: OnProgress) -> dict[str, BestHarmTable]:
    """Search the joint optimum of every level with learners, and return the results by the level's name.

    Parts that were searched before are read from the plan's folder.

    Args:
        plan: settings of the ablation.
        samples: worlds of each level of the plan.
        jobs: number of threads.
        tell: called with the progress.

    """
    tables: dict[str, BestHarmTable] = {}
    for level, part, alike in questions(plan, samples):
        table = search_list(
            level.scenario,
            part,
            budget=plan.budget,
            threads=jobs,
            chunks=plan.optimum_folder(level),
            on_progress=partial(_tell, tell, f"joint optimum of {level.name}"),
        )
        tables |= {each.name: table for each in alike}
    return tables


def _tell(tell: OnProgress, name: str, done: int, total: int) -> None:
    tell(Progress(name, done, total))


def best_known(own: LevelOptimum, answers: Sequence[LevelOptimum]) -> dict[HarmCount, Floats]:
    """Return the least known harm [n] in each world of a level, under each count of harm (m2/s2).

    Args:
        own: the level, with the result of its search and its trained teams.
        answers: the same for all levels, including ``own``. A result of another level counts only in worlds in which
            the learners of ``own`` can brake in the same way.

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
    """Return in which worlds, [n] bool, the learners of ``own`` can do whatever the learners of ``other`` do.

    Conditions: ``own`` has the same learners or more, the other vehicles have the same scripts, the line is the same (a
    sweep may change it), latencies are equal, and at every decision time of ``other`` the learners of ``own`` decide
    too. ``other`` may lack an obstacle, because its result is driven again with the obstacle.
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
    """Yield the harm by the search result and by every team of ``other`` in the worlds ``rows`` of ``own``.

    Each item maps a count of harm to the harm [rows] (m2/s2).
    """
    scenario, task = other.level.scenario, Task(other.level.scenario, other.level.scenario.learners)
    worlds = replace(other.worlds, obstacle_gap_m=own.worlds.obstacle_gap_m).take(rows)
    for best in other.searched.best.values():
        best_here = best._replace(harm=best.harm[rows], profiles=best.profiles.take(rows))
        yield dict(zip(HARM_COUNTS, task_problem(worlds, task).follow(best_here.profiles), strict=True))
    for team in other.teams:
        evaluation = evaluate(worlds, {team.name: team}, scenario=scenario, aftermath=False).complete()
        ledger = evaluation.outcome(team.name).ledger
        yield {harm_count: ledger.world_harm(harm_count) for harm_count in HARM_COUNTS}


@dataclass(frozen=True, slots=True)
class Harms:
    """Harm of several trainings of one level (or of its scripts, as a single seed) on the same worlds."""

    world: dict[HarmCount, Floats]  # count of harm -> [seeds, worlds] harm of the whole line (m2/s2)
    vehicle: dict[HarmCount, Floats]  # count of harm -> [seeds, worlds, N] harm of each vehicle (m2/s2)
    collided: Bools  # [seeds, worlds] whether at least one impact happened
    policies: tuple[Mapping[str, str], ...] = ()  # for each seed: vehicle -> SHA-256 of its policy's manifest
    ledgers: tuple[Ledger, ...] = ()  # harm of all impacts, one ledger for each seed


class Goal(NamedTuple):
    """The quantity that the trainings of a level minimise: its mean for the trained policies and for full braking."""

    name: str  # name of the quantity: ``objective``, ``first-impact harm`` or ``total harm``
    reached: float  # mean over seeds, worlds and learners, driven by the trained policies
    full_brake: float  # the same mean if all vehicles brake fully

    @classmethod
    def of(cls, training: Training, reached: Harms, full_brake: Harms) -> Goal:
        """Return the quantity that ``training`` minimises, with its means.

        It is the harm of the whole line, or, if recipe or scenario give the learners objectives of their own, the mean
        of these. ``reached`` and ``full_brake`` are the harms by the trained policies and by full braking of all
        vehicles.
        """
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
        """Whether full braking by all vehicles does better than the trained policies."""
        return self.reached > self.full_brake + TOLERANCE


@dataclass(frozen=True, slots=True)
class Measured:
    """Results of one level of cooperation with one training algorithm on the same worlds as all other levels."""

    level: Level  # the level
    algorithm: str | None  # name of the algorithm (recipe and scheme); None: the level has no learner
    reached: Harms  # harm by the trained policies (or by the scripts)
    full_brake: Harms  # harm if all vehicles brake fully, whatever their roles
    # Count of harm -> [1, search_episodes] least known harm (m2/s2); None: the level has no learner.
    best: dict[HarmCount, Floats] | None
    identity: Mapping[str, Any] = field(default_factory=dict)  # hashes of worlds and scenario, and versions
    # Count of harm -> results [seeds, worlds] behind a shield that bounds that harm; None: no shield requested.
    shielded: dict[HarmCount, Shielded] | None = None
    goal: Goal | None = None  # what the training minimises; None: the level has no learner
    clusters: NDArray[np.str_] | None = None  # name of each world's cluster (``clusters_of``); None: no recordings


def measure(plan: Plan, jobs: int = 1, tell: OnProgress | None = None) -> list[Measured]:
    """Let the trained policies of all levels drive the same worlds, and search for the joint optimum of each level.

    Parts of a search that exist already are reused. Where a policy does better than the search, its harm becomes the
    best known harm of that world.

    Args:
        plan: settings of the ablation, whose trainings have finished.
        jobs: number of threads of the search.
        tell: called with the progress; None: silent.

    Returns the results level by level in the plan's order, algorithm by algorithm. Raises the exceptions of loading
    teams and of ``common_worlds`` before any long work.

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
    measured: list[Measured] = []
    for level, sample in zip(plan.levels, samples, strict=True):
        alike = level.scenario.replace(roles=dict.fromkeys(level.scenario.vehicle_names, "full_brake"))
        braking = _drive(alike, sample, [Team({}, f"full braking in {level.name}")], say)
        about = result_identity("ablate", level.scenario, sample)
        if not level.scenario.learners:
            scripts = _drive(level.scenario, sample, [Team({}, f"scripts of {level.name}")], say)
            measured.append(Measured(level, None, scripts, braking, None, about, clusters=sample.clusters))
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
            measured.append(
                Measured(level, algorithm, reached, braking, best, about, behind or None, goal, sample.clusters)
            )
    return measured


def _drive(scenario: Scenario, sample: Sample, drivers: Sequence[Driver], tell: OnProgress) -> Harms:
    """Let each of ``drivers`` (agents or teams) drive the worlds of ``sample``, and return their harm.

    Each of them counts as one seed.
    """
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
