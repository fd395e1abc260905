"""An ablation: train teams at every level with several seeds, and let all of them drive the same worlds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.drive import Team
from ethbrake_marl.agents.scripts import FULL_BRAKE
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.objectives import Declared, amounts, objectives_of
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.door import SEED
from ethbrake_marl.evaluation.evaluate import evaluate
from ethbrake_marl.evaluation.identity import about_scenario
from ethbrake_marl.evaluation.measures import Given, Measure
from ethbrake_marl.evaluation.statistics import Clusters
from ethbrake_marl.extensions.cooperation.levels import Level, common_worlds
from ethbrake_marl.extensions.studies.folder import work_in
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.names import open_game, teams_of
from ethbrake_marl.parallel import run_each
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.training.job import Job
from ethbrake_marl.training.recipe import TrainingRecipe
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.mixture import WORDS
from ethbrake_marl.worlds.sampling import Drawn

SETTINGS, JSON, CSV, FIGURE = "settings.json", "ablation.json", "ablation.csv", "ablation.png"
FULL = {"seeds": 5, "steps_per_learner": 400_000, "episodes": 4_000, "search_episodes": 600, "budget": 20_000}
QUICK = {"seeds": 2, "steps_per_learner": 200_000, "episodes": 500, "search_episodes": 40, "budget": 2_000}


@dataclass(frozen=True)
class Ablation:
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
        for seed in range(self.seeds):
            for recipe, algorithm in zip(self.recipes, self.algorithms, strict=True):
                for level in (level for level in self.levels if level.scenario.learners):
                    learners, name = len(level.scenario.learners), algorithm
                    changes: dict[str, Any] = {"seed": seed, "total_steps": self.steps_per_learner * learners}
                    if learners == 1:  # schemes are for several learners
                        changes["scheme"] = None
                        name = recipe.name
                    training = Training.of(recipe.replace(**changes), level.scenario)
                    folder = self.folder / "trainings" / f"{level.name}-{name}-seed{seed}"
                    noted = self.noted if level.swept is None else (*self.noted, level.swept.setting)
                    yield level, algorithm, Job(training, folder, noted)

    def study_folder(self) -> AbstractContextManager[None]:
        settings = {
            "levels": [level.scenario.content(without=WORDS) for level in self.levels],
            "recipes": [recipe.model_dump(mode="json", exclude=set(WORDS)) for recipe in self.recipes],
            **{name: getattr(self, name) for name in FULL},
        }
        advice = f"give another folder (--output); to reuse its trained policies, give a copy without {SETTINGS}"
        return work_in(self.folder, "an ablation", settings, record=SETTINGS, advice=advice, writes=(JSON, CSV, FIGURE))


Columns = dict[str, Floats]  # column of an evaluation -> [seeds, n]


class Measured(NamedTuple):
    """Results of one level with one algorithm, in the same worlds as all other levels."""

    level: Level
    algorithm: str | None  # None: the level has no learner
    reached: Columns  # with the trained teams, or with the scripts if there is no learner
    braking: Columns  # if the learners brake fully, [1, n]
    worlds: State  # at the alert
    best: Mapping[str, Floats] | None = None  # count -> [1, m] least known harm in the first m worlds (m2/s2)
    clusters: Clusters = None
    about: Mapping[str, Any] = MappingProxyType({})  # plain data: digests of worlds, scenario, policies; versions


def train_all(plan: Ablation, jobs: int, tell: OnProgress) -> bool:
    """Start or continue all trainings, ``jobs`` at a time. Return False if Ctrl-C stopped one.

    Raises ``InvalidInput`` if a training's folder contains anything else.
    """
    every = [job for _, _, job in plan.jobs()]
    for done, finished in enumerate(run_each(((job.finish,) for job in every), jobs), 1):
        if not finished:
            return False
        tell(Progress("trainings", done, len(every)))
    return True


def measure(plan: Ablation, tell: OnProgress) -> list[Measured]:
    trained: dict[Any, list[Job]] = {}
    for level, name, job in plan.jobs():
        trained.setdefault((level.name, name), []).append(job)
    worlds = common_worlds(plan.levels, plan.episodes, SEED)
    pairs: list[tuple[Level, Drawn, str | None]] = [
        (level, drawn, algorithm)
        for level, drawn in zip(plan.levels, worlds, strict=True)
        for algorithm in (plan.algorithms if level.scenario.learners else (None,))
    ]
    measured: list[Measured] = []
    for done, (level, drawn, algorithm) in enumerate(pairs):
        tell(Progress(f"driving {level.name}", done, len(pairs)))
        measured.append(driven(level, drawn, algorithm, trained.get((level.name, algorithm), ())))
    return measured


def driven(level: Level, drawn: Drawn, algorithm: str | None, jobs: Any) -> Measured:
    scenario, measures = level.scenario, []
    named = {f"{algorithm} seed {seed}": f"team@{job.folder}" for seed, job in enumerate(jobs)}
    teams = teams_of(named, scenario) if named else {"scripts": Team("scripts", {})}
    braking = Team("full_brake", dict.fromkeys(scenario.learners, FULL_BRAKE))
    if named:
        reward = jobs[0].training.recipe.reward
        goal = partial(minimised, reward.objective or scenario.objective, reward.harm_count)
        measures.append(Measure("goal", goal))
    every = {**teams, "full_brake": braking}
    result = evaluate(drawn, every, open_game(scenario)[1], measures, about=about_scenario(scenario))
    numbers = [name for name, values in result["full_brake"].items() if values.dtype.kind in "fib"]

    def stacked(names: Any) -> Columns:
        return {column: np.stack([result[name][column] for name in names]) for column in numbers}

    about = {**result.about, "policy_sha256": [dict(result.policies[name]) for name in teams]}
    return Measured(
        level, algorithm, stacked(teams), stacked(["full_brake"]), drawn.worlds, clusters=result.clusters, about=about
    )


def minimised(declared: Declared, count: str, game: Game, alert: State, last: State) -> Given:
    """Return what the training minimises, as a mean over the learners, [n]: the objective ``declared`` in ``count``.

    A measure, once the first two arguments are given; ``alert`` is unused.
    """
    each = amounts(objectives_of(declared, last.vehicles), None, last, count)
    return np.asarray(each[:, game.rules.learners - 1].mean(axis=1))
