"""An ablation: train teams at every level of cooperation, drive the same worlds with all, search the joint optimum.

The *joint optimum* of a level is, in each world, the least known harm or cost that its learners can cause together. It
depends on worlds, learners and scripts, but not on what the learners know or minimise. Levels that differ only in what
learners know or minimise therefore share one search. A level also uses the best commands of every other level whose
commands its learners can give.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agent_names import open_game, teams_of
from ethbrake_marl.agents.scripts import FULL_BRAKE
from ethbrake_marl.agents.team import Team
from ethbrake_marl.episode.counts import BUILT_IN_COUNTS, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.objectives import Declared, amounts, objectives_of
from ethbrake_marl.episode.state import FIRST_DECISION, State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.evaluate import SEED, evaluate_teams
from ethbrake_marl.evaluation.measures import Measure, MeasureValue
from ethbrake_marl.evaluation.provenance import about_scenario
from ethbrake_marl.evaluation.statistics import Clusters
from ethbrake_marl.extensions.cooperation.levels import Level, common_worlds
from ethbrake_marl.extensions.search.best_harm import search_list
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.extensions.studies.folder import work_in
from ethbrake_marl.motion.layout import FAR_M, GAP, OWN_LATENCY, Bools, Floats
from ethbrake_marl.parallel import run_each
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.training.job import Job
from ethbrake_marl.training.recipe import TrainingRecipe
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.mixture import DESCRIPTIVE_KEYS
from ethbrake_marl.worlds.sampling import DrawnWorlds
from ethbrake_marl.worlds.scenario import Scenario

SETTINGS, JSON, CSV, FIGURE = "settings.json", "ablation.json", "ablation.csv", "ablation.png"
FULL = {"seeds": 5, "steps_per_learner": 400_000, "episodes": 4_000, "search_episodes": 600, "budget": 20_000}
QUICK_SETTINGS = {"seeds": 2, "steps_per_learner": 200_000, "episodes": 500, "search_episodes": 40, "budget": 2_000}
STEP_ROUNDING = 1e-9  # part of a step by which decisions of two levels may differ


@dataclass(frozen=True)
class Ablation:
    """Plan of an ablation: the levels to compare, how teams are trained, and in which worlds they are compared."""

    folder: Path  # of all results
    levels: tuple[Level, ...]
    recipes: tuple[TrainingRecipe, ...]  # each has its scheme for several learners
    seeds: int  # trainings per level and recipe
    steps_per_learner: int  # decisions of each learner in a training
    episodes: int  # worlds in which levels are compared, of the seed ``SEED``
    search_episodes: int  # of these worlds, counted from the first, in which the joint optimum is searched
    budget: int  # profiles that the search tries per world and count of harm
    noted: tuple[str, ...] = ()  # settings of scenarios and recipes, for ``config.json``

    def __post_init__(self) -> None:
        names = [recipe.name for recipe in self.recipes]
        if len(set(names)) < len(names):
            raise InvalidInput(f"recipes {', '.join(names)}: two recipes have the same name; all names must differ")
        if self.search_episodes > self.episodes:
            raise InvalidInput(
                f"search-episodes = {self.search_episodes}: must be at most the number of worlds, episodes ="
                f" {self.episodes}"
            )
        if not any(level.scenario.learners for level in self.levels):
            raise InvalidInput("levels: no level has a learner; give at least one level with a learner")
        common_worlds(self.levels, 5, SEED)
        list(self.jobs())  # raises InvalidInput for an impossible training

    @property
    def algorithms(self) -> tuple[str, ...]:
        return tuple(f"{recipe.name}-{recipe.scheme}" for recipe in self.recipes)

    def jobs(self) -> Iterator[tuple[Level, str, Job]]:
        """Every training: level, algorithm (recipe and scheme), and job. A level with one learner is trained without a
        scheme.
        """
        for seed in range(self.seeds):
            for recipe, algorithm in zip(self.recipes, self.algorithms, strict=True):
                for level in (level for level in self.levels if level.scenario.learners):
                    learners, folder_label = len(level.scenario.learners), algorithm
                    changes: dict[str, Any] = {"seed": seed, "total_steps": self.steps_per_learner * learners}
                    if learners == 1:  # schemes are for several learners
                        changes["scheme"] = None
                        folder_label = recipe.name
                    training = Training.of(recipe.replace(**changes), level.scenario)
                    folder = self.folder / "trainings" / f"{level.name}-{folder_label}-seed{seed}"
                    noted = self.noted if level.swept is None else (*self.noted, level.swept.setting)
                    yield level, algorithm, Job(training, folder, noted)

    def study_folder(self) -> AbstractContextManager[None]:
        settings = {
            "levels": [level.scenario.content(without=DESCRIPTIVE_KEYS) for level in self.levels],
            "recipes": [recipe.model_dump(mode="json", exclude=set(DESCRIPTIVE_KEYS)) for recipe in self.recipes],
            **{name: getattr(self, name) for name in FULL},
        }
        advice = f"give another folder (--output); to reuse its trained policies, give a copy without {SETTINGS}"
        return work_in(self.folder, "an ablation", settings, record=SETTINGS, advice=advice, writes=(JSON, CSV, FIGURE))


SeedColumns = dict[str, Floats]  # column of an evaluation -> [seeds, n]


class LevelResult(NamedTuple):
    """Results of one level with one algorithm, in the same worlds as all other levels."""

    level: Level
    algorithm: str | None  # None: the level has no learner
    reached: SeedColumns  # with the trained teams, or with the scripts if there is no learner
    braking: SeedColumns  # if the learners brake fully, [1, n]
    worlds: State  # at the alert
    best: Mapping[str, Floats] | None = None  # count -> [1, m] least known harm in the first m worlds (m2/s2)
    clusters: Clusters = None
    about: Mapping[str, Any] = MappingProxyType({})  # plain data: digests of worlds, scenario, policies; versions


def train_all(plan: Ablation, jobs: int, tell: OnProgress) -> bool:
    """Start or continue all trainings, ``jobs`` at a time. Return False if Ctrl-C stopped a training."""
    all_jobs = [job for _, _, job in plan.jobs()]
    for job_number, finished in enumerate(run_each(((job.finish,) for job in all_jobs), jobs), 1):
        if not finished:
            return False
        tell(Progress("trainings", job_number, len(all_jobs)))
    return True


def measure(plan: Ablation, tell: OnProgress) -> list[LevelResult]:
    trained: dict[Any, list[Job]] = {}
    for level, name, job in plan.jobs():
        trained.setdefault((level.name, name), []).append(job)
    worlds = common_worlds(plan.levels, plan.episodes, SEED)
    pairs: list[tuple[Level, DrawnWorlds, str | None]] = [
        (level, drawn_worlds, algorithm)
        for level, drawn_worlds in zip(plan.levels, worlds, strict=True)
        for algorithm in (plan.algorithms if level.scenario.learners else (None,))
    ]
    measured: list[LevelResult] = []
    for pair_number, (level, drawn_worlds, algorithm) in enumerate(pairs):
        tell(Progress(f"driving {level.name}", pair_number, len(pairs)))
        measured.append(measure_level(level, drawn_worlds, algorithm, trained.get((level.name, algorithm), ())))
    return measured


def measure_level(level: Level, drawn_worlds: DrawnWorlds, algorithm: str | None, jobs: Any) -> LevelResult:
    """Results of one level if the teams that ``jobs`` have trained drive its worlds, or, without jobs, its scripts
    alone.

    Full braking of all learners is measured for comparison. ``algorithm``: its name in the results.
    """
    scenario, measures = level.scenario, []
    named = {f"{algorithm} seed {seed}": f"team@{job.folder}" for seed, job in enumerate(jobs)}
    teams = teams_of(named, scenario) if named else {"scripts": Team("scripts", {})}
    braking = Team("full_brake", dict.fromkeys(scenario.learners, FULL_BRAKE))
    if named:
        reward = jobs[0].training.recipe.reward
        goal = partial(minimised_amount, reward.objective or scenario.objective, reward.harm_count)
        measures.append(Measure("goal", goal))
    all_teams = {**teams, "full_brake": braking}
    result = evaluate_teams(drawn_worlds, all_teams, open_game(scenario)[1], measures, about=about_scenario(scenario))
    numbers = [name for name, values in result["full_brake"].items() if values.dtype.kind in "fib"]

    def stack_columns(names: Any) -> SeedColumns:
        return {column: np.stack([result[name][column] for name in names]) for column in numbers}

    about = {**result.about, **result.independent, "policy_sha256": [dict(result.policies[name]) for name in teams]}
    return LevelResult(
        level,
        algorithm,
        stack_columns(teams),
        stack_columns(["full_brake"]),
        drawn_worlds.worlds,
        clusters=result.clusters,
        about=about,
    )


def minimised_amount(declared: Declared, count: HarmCount, game: Game, alert: State, last: State) -> MeasureValue:
    """What the training minimises: the objective ``declared`` in ``count``, mean over the learners, [n]; a measure if
    bound.
    """
    vehicle_amounts = amounts(objectives_of(declared, last.vehicles), None, last, count)
    return np.asarray(vehicle_amounts[:, game.settings.learners - 1].mean(axis=1))


class Answer(NamedTuple):
    """Best commands of one level and harm of its trained teams, with all that another level needs to use them."""

    scenario: Scenario
    game: Game
    worlds: State  # at the alert, in which the joint optimum was searched, [m]
    searched: BestHarmTable
    team_harm: Mapping[str, Sequence[Floats]]  # count -> harm of each trained team, [m]


def with_optima(plan: Ablation, measured: Sequence[LevelResult], threads: int, tell: OnProgress) -> list[LevelResult]:
    """Results with the joint optimum of each level that has a learner (``least_known``).

    Levels with the same worlds, learners and scripts share one search, whose finished parts are read from files.
    """
    tables: dict[bytes, BestHarmTable] = {}
    answers: dict[str, Answer] = {}
    for level_result in measured:
        name, scenario = level_result.level.name, level_result.level.scenario
        if scenario.learners and name not in answers:
            game, worlds = open_game(scenario)[1], level_result.worlds.take(slice(plan.search_episodes))
            identity = problem_of(game, worlds).identity.tobytes()
            if identity not in tables:
                say = partial(_tell_progress, tell, f"joint optimum of {name}")
                folder = plan.folder / "optimum" / name
                tables[identity] = search_list(
                    game,
                    worlds,
                    chunks=folder,
                    on_progress=say,
                    harm_counts=BUILT_IN_COUNTS,
                    budget=plan.budget,
                    threads=threads,
                )
            teams = [result.reached for result in measured if result.level.name == name]
            team_harm = {
                count.name: [row[: worlds.n] for columns in teams for row in columns[count.column]]
                for count in BUILT_IN_COUNTS
            }
            answers[name] = Answer(scenario, game, worlds, tables[identity], team_harm)
    best = {
        name: {count.name: least_known(answer, answers.values(), count)[np.newaxis] for count in BUILT_IN_COUNTS}
        for name, answer in answers.items()
    }
    return [result._replace(best=best.get(result.level.name)) for result in measured]


def _tell_progress(tell: OnProgress, name: str, finished: int, total: int) -> None:
    tell(Progress(name, finished, total))


def least_known(answer: Answer, answers: Iterable[Answer], count: HarmCount) -> Floats:
    """Least known harm in each world, [m] m2/s2, among the commands of all ``answers`` that ``can_imitate`` allows."""
    best = np.full(answer.worlds.n, np.inf)
    for original in answers:
        can = can_imitate(answer, original)
        rows = np.flatnonzero(can)
        if rows.size:
            line = original.worlds.line.copy()
            line[:, :, 0] = answer.worlds.line[:, :, 0]  # the obstacle
            problem = problem_of(original.game, original.worlds._replace(line=line).take(rows))
            for profiles in original.searched.profiles.values():
                harm = problem.follow(profiles.take(rows)).harm(count)
                best[rows] = np.minimum(best[rows], harm)
            same = rows[original.worlds.line[rows, GAP, 0] == answer.worlds.line[rows, GAP, 0]]
            for harm in original.team_harm[count.name]:
                best[same] = np.minimum(best[same], harm[same])
    return best


def can_imitate(imitator: Answer, original: Answer) -> Bools:
    """Whether the learners of ``imitator`` can give the commands of the learners of ``original``, in each world, [m].

    They can if each learner of ``original`` learns in ``imitator``, the scripted vehicles of ``imitator`` have the same
    roles in both, lines and latencies (with the wait for the alert) are the same, and each decision time of
    ``original`` is one of ``imitator``. Only ``imitator`` may have an obstacle: the commands are simulated again in its
    worlds.
    """
    imitator_scenario, original_scenario = imitator.scenario, original.scenario
    scripted = [name for name, role in imitator_scenario.roles.items() if role != "learner"]
    if not set(original_scenario.learners) <= set(imitator_scenario.learners) or any(
        imitator_scenario.roles[n] != original_scenario.roles[n] for n in scripted
    ):
        return np.zeros(imitator.worlds.n, np.bool_)
    rows = [row for row in range(imitator.worlds.car.shape[1]) if row != OWN_LATENCY]
    same = (imitator.worlds.line[:, :, 1:] == original.worlds.line[:, :, 1:]).all(axis=(1, 2))
    same &= (imitator.worlds.car[:, rows, 1:] == original.worlds.car[:, rows, 1:]).all(axis=(1, 2))
    first, later = (
        problem_of(answer.game, answer.worlds).state.clock[:, FIRST_DECISION] for answer in (imitator, original)
    )
    steps = (later - first) / imitator_scenario.time_step_s
    ahead = original.worlds.line[:, GAP, 0]
    return np.asarray(
        same
        & (np.abs(steps - np.rint(steps)) < STEP_ROUNDING)
        & ((ahead == imitator.worlds.line[:, GAP, 0]) | (ahead >= FAR_M))
    )
