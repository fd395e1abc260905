"""What an ablation trains, searches and measures, and what is left to do in its folder."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.ablation.levels import Level
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.recipe import WORDS, Scheme, TrainingRecipe
from ethbrake_marl.learning.run_directory import RunDirectory
from ethbrake_marl.scenario import Scenario

TRAININGS, OPTIMUM = "trainings", "optimum"  # folders inside the ablation's


@dataclass(frozen=True, slots=True)
class Training:
    """One training: a level, a recipe with its seed, and where it stands."""

    level: Level
    algorithm: str
    recipe: TrainingRecipe
    folder: Path

    def steps_left(self) -> int:
        """Decisions that are still to do; raises ``InvalidInput`` for a folder that holds another training."""
        run = RunDirectory(self.folder)
        if not run.status.exists():
            if self.folder.exists():
                raise InvalidInput(f"{self.folder}: is no training; move it away, or give another --output")
            return self.recipe.total_steps
        status, config = (_content(file) for file in (run.status, run.config))
        if not same_training(config, self.recipe, self.level.scenario):
            raise InvalidInput(
                f"{self.folder}: holds the training of another recipe or scenario; give another folder (--output)"
            )
        if status.get("status") == "finished":
            return 0
        steps = status.get("steps", 0)
        return max(self.recipe.total_steps - (steps if isinstance(steps, int) else 0), 1)


@dataclass(frozen=True, slots=True)
class Plan:
    """An ablation."""

    levels: tuple[Level, ...]
    recipes: tuple[TrainingRecipe, ...]
    scheme: Scheme  # of levels with several learners
    seeds: int
    steps_per_learner: int  # decisions of each learner
    episodes: int  # worlds on which everything is measured
    list_seed: int
    search_episodes: int  # of these, worlds in which the joint optimum is searched
    budget: int  # candidates per world and count of that search
    folder: Path

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Names of what is compared: recipes with the scheme."""
        return tuple(self._algorithm(recipe) for recipe in self.recipes)

    def trainings(self) -> Iterator[Training]:
        """Seed by seed, so that a first result over all levels is there early."""
        for seed in range(self.seeds):
            for recipe in self.recipes:
                for level in self.levels:
                    if level.trained:
                        yield self.training(level, recipe, seed)

    def training(self, level: Level, recipe: TrainingRecipe, seed: int) -> Training:
        """The training of one seed."""
        learners = len(level.scenario.learners)
        changes: dict[str, Any] = {"seed": seed, "total_steps": self.steps_per_learner * learners}
        changes["scheme"] = None if learners == 1 else self.scheme
        algorithm = self._algorithm(recipe)
        folder = self.folder / TRAININGS / f"{level.name}-{algorithm}-seed{seed}"
        return Training(level, algorithm, recipe.replace(**changes), folder)

    def _algorithm(self, recipe: TrainingRecipe) -> str:
        return f"{recipe.name}-{self.scheme}"


def check_plan(plan: Plan) -> None:
    """Raise ``InvalidInput`` for recipes of one name, numbers below 1, or nothing to train."""
    names = plan.algorithms
    if not names or len(set(names)) < len(names):
        raise InvalidInput(f"recipes {', '.join(names) or 'none'}: give at least one, each with a name of its own")
    numbers = ("seeds", "steps_per_learner", "episodes", "search_episodes", "budget")
    for name in numbers:
        if not getattr(plan, name) >= 1:
            raise InvalidInput(f"{name.replace('_', '-')} {getattr(plan, name)}: must be at least 1")
    if plan.search_episodes > plan.episodes:
        raise InvalidInput(
            f"search-episodes {plan.search_episodes}: must be at most the {plan.episodes} worlds of --episodes"
        )
    if not any(level.trained for level in plan.levels):
        raise InvalidInput("levels: nobody learns in any of them; give at least one with a learner")


def same_training(config: dict[str, Any], recipe: TrainingRecipe, scenario: Scenario) -> bool:
    """Whether a run's configuration is that of this recipe and scenario."""
    given = {name: value for name, value in dict(config.get("recipe") or {}).items() if name not in WORDS}
    wanted = recipe.model_dump(mode="json", exclude=set(WORDS)), scenario.model_dump(mode="json", exclude_unset=True)
    return (given, config.get("scenario")) == wanted


def _content(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInput(f"{file}: is damaged ({error}); delete its folder to train anew") from None
    if not isinstance(content, dict):
        raise InvalidInput(f"{file}: is damaged (no JSON object); delete its folder to train anew")
    return content
