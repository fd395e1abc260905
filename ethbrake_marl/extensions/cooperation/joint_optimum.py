"""Joint optimum of a level: in each world, the least known harm that the level's learners can achieve together.

The joint optimum depends on the worlds, on the learners and on the scripts of the other vehicles, but not on what the
learners know or on their objectives. Levels that differ only in information or objectives therefore share one search
for the joint optimum. The best commands of one level are also used for every other level whose learners can give the
same commands.

Arguments that several functions share: ``plan`` are the settings of the ablation, and ``samples`` the worlds of each
level in the order of ``plan.levels``. ``jobs`` is the number of threads of the search.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from ethbrake_marl.first_edition.agents.protocol import Driver, Team
from ethbrake_marl.first_edition.evaluation.identity import result_identity
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount, Ledger
from ethbrake_marl.first_edition.game.objectives import objective_harm
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.first_edition.shields.episodes import Shielded, drive_shielded
from ethbrake_marl.first_edition.training.team import load_team
from ethbrake_marl.first_edition.training.training import Training
from ethbrake_marl.progress import OnProgress, Progress


@dataclass(frozen=True, slots=True)
class LevelOptimum:
    """Result of the search for the joint optimum of one level, and the teams that were trained at this level."""

    level: Level  # the level
    worlds: Worlds  # worlds in which the joint optimum was searched
    searched: BestHarmTable  # best harm and profiles from the search in these worlds
    teams: tuple[Team, ...]  # trained teams of the level, for all recipes and seeds


def questions(plan: Plan, samples: Sequence[Sample]) -> list[tuple[Level, Sample, list[Level]]]:
    """Return the searches for joint optima that an ablation needs, each as (level, worlds to search, list of levels).

    Levels with the same search problem share one search: the list contains them all, and ``level`` is the first of
    them. Levels without learners need no search.
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
    """Search the joint optimum of every level with learners; return the results by name of the level.

    Results of earlier searches are read from the folder of the ablation.
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
    """Return the least known harm in each world of the level ``own``: count of harm -> [n] harm (m2/s2).

    ``answers`` are all levels, including ``own``. In a world, the commands of another level are used if the learners of
    ``own`` can give the same commands.
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
    """Return for each world, [n] bool, whether learners of ``own`` can give the commands of the learners of ``other``.

    The result is True if five conditions are met: each learner of ``other`` is also a learner in ``own``; each scripted
    vehicle of ``own`` has the same script in ``other``; the lines of vehicles are the same; the latencies are equal;
    and each decision time of ``other`` is also a decision time of ``own``. The result may be True if only ``own`` has
    an obstacle on the road, because ``_harms`` simulates the commands of ``other`` with this obstacle.
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
    """Yield the harm in the worlds ``rows`` of level ``own`` if its learners give commands from level ``other``.

    There is one mapping (count of harm -> [rows] harm in m2/s2) for each search result and for each team of ``other``.
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
    """Harm in the worlds of one level under the trained policies of each training run (seed).

    A level without learners counts as one training run.
    """

    world: dict[HarmCount, Floats]  # count of harm -> [seeds, worlds] harm of the whole line (m2/s2)
    vehicle: dict[HarmCount, Floats]  # count of harm -> [seeds, worlds, N] harm of each vehicle (m2/s2)
    collided: Bools  # [seeds, worlds] whether at least one impact happened
    policies: tuple[Mapping[str, str], ...] = ()  # for each seed: vehicle -> SHA-256 of the manifest of its policy
    ledgers: tuple[Ledger, ...] = ()  # one ledger for each seed, with the harm of all impacts


class Goal(NamedTuple):
    """Quantity that the training at a level minimises: its mean with the trained policies, and with full braking."""

    name: str  # name of the quantity: ``objective``, ``first-impact harm`` or ``total harm``
    reached: float  # mean over seeds, worlds and learners with the trained policies
    full_brake: float  # mean over worlds and learners if all vehicles brake fully

    @classmethod
    def of(cls, training: Training, reached: Harms, full_brake: Harms) -> Goal:
        """Return the quantity that ``training`` minimises, from the harms in the same worlds.

        This is the learners' objective if the recipe or the scenario has objectives, otherwise the harm of the line.
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
        """Whether the mean is larger with the trained policies than with full braking."""
        return self.reached > self.full_brake + TOLERANCE


@dataclass(frozen=True, slots=True)
class Measured:
    """Results of one level with one training algorithm, in the same worlds as all other levels."""

    level: Level  # the level
    algorithm: str | None  # name of the algorithm (recipe and scheme); None: the level has no learner
    reached: Harms  # harm with the trained policies, or with the scripts if the level has no learner
    full_brake: Harms  # harm if all vehicles brake fully instead
    # Count of harm -> [1, search_episodes] least known harm (m2/s2); None: the level has no learner.
    best: dict[HarmCount, Floats] | None
    identity: Mapping[str, Any] = field(default_factory=dict)  # hashes of worlds and scenario, and versions
    # Count of harm -> results [seeds, worlds] with a shield that bounds this harm; None: without shields.
    shielded: dict[HarmCount, Shielded] | None = None
    goal: Goal | None = None  # mean of the quantity that the training minimises; None: the level has no learner
    clusters: NDArray[np.str_] | None = None  # name of each world's cluster (``clusters_of``); None: no recordings


def measure(plan: Plan, jobs: int = 1, tell: OnProgress | None = None) -> list[Measured]:
    """Evaluate the trained policies of all levels in the same worlds, and search the joint optimum of each level.

    All training runs of the ablation must be finished. Results of earlier searches are reused. If a trained policy does
    less harm in a world than the best commands of the search, the joint optimum of this world is the policy's harm.

    Returns one result for each level and algorithm: levels in the order of ``plan.levels``, and for each level the
    algorithms in the order of ``plan.algorithms``. Raises the exceptions of ``load_team`` and ``common_worlds`` before
    the evaluation and the search begin.
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
    """Let each of the agents or teams ``drivers`` drive in the same worlds; return their harm.

    Each agent or team has one row in the arrays [seeds, worlds] of the result.
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
