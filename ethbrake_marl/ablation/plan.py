"""What an ablation trains, searches and measures, and what is left to do in its folder."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.ablation.levels import Level
from ethbrake_marl.durable_files import check_writable, write_file
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.kept_training import check_same
from ethbrake_marl.learning.recipe import WORDS, PpoRecipe, Scheme, TrainingRecipe
from ethbrake_marl.learning.run_directory import RunDirectory, read_object

TRAININGS, OPTIMUM, SETTINGS = "trainings", "optimum", "settings.json"  # inside the ablation's folder
_NUMBERS = ("seeds", "steps_per_learner", "episodes", "list_seed", "search_episodes", "budget")


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
        status = read_kept(run.status, "delete its folder to train anew")
        check_same(self.folder, self.recipe, self.level.scenario)
        if status.get("status") == "finished":
            return 0
        steps = status.get("steps", 0)
        return max(self.recipe.total_steps - (steps if isinstance(steps, int) else 0), 1)


@dataclass(frozen=True, slots=True)
class Plan:
    """An ablation."""

    levels: tuple[Level, ...]
    recipes: tuple[TrainingRecipe, ...]  # with the scheme of levels with several learners, see ``with_scheme``
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
        return tuple(_algorithm(recipe) for recipe in self.recipes)

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
        if learners == 1:  # the same training whatever the scheme of several learners
            changes |= dict.fromkeys(("scheme", "turns") if isinstance(recipe, PpoRecipe) else ("scheme",))
        name = recipe.name if learners == 1 else _algorithm(recipe)
        folder = self.folder / TRAININGS / f"{level.name}-{name}-seed{seed}"
        return Training(level, _algorithm(recipe), recipe.replace(**changes), folder)

    def settings(self) -> dict[str, Any]:
        """Everything that shapes the results, as plain data."""
        scenarios = [level.scenario.model_dump(mode="json", exclude=set(WORDS)) for level in self.levels]
        recipes = [recipe.model_dump(mode="json", exclude=set(WORDS)) for recipe in self.recipes]
        return {"levels": scenarios, "recipes": recipes, **{name: getattr(self, name) for name in _NUMBERS}}

    def optimum_folder(self, level: Level) -> Path:
        """Where the parts of its search stand."""
        return self.folder / OPTIMUM / level.name


def with_scheme(recipe: TrainingRecipe, scheme: Scheme | None) -> TrainingRecipe:
    """The recipe with this scheme for several learners; None: its own, else independent."""
    return recipe.replace(scheme=scheme or recipe.scheme or "independent")


def _algorithm(recipe: TrainingRecipe) -> str:
    return f"{recipe.name}-{recipe.scheme}"


def check_plan(plan: Plan) -> None:
    """Raise ``InvalidInput`` for recipes of one name, numbers below 1, or nothing to train."""
    names = [recipe.name for recipe in plan.recipes]
    if not names or len(set(names)) < len(names):
        raise InvalidInput(f"recipes {', '.join(names) or 'none'}: give at least one, each with a name of its own")
    for name in _NUMBERS:
        if name != "list_seed" and not getattr(plan, name) >= 1:
            raise InvalidInput(f"{name.replace('_', '-')} {getattr(plan, name)}: must be at least 1")
    if plan.search_episodes > plan.episodes:
        raise InvalidInput(
            f"search-episodes {plan.search_episodes}: must be at most the {plan.episodes} worlds of --episodes"
        )
    if not any(level.trained for level in plan.levels):
        raise InvalidInput("levels: nobody learns in any of them; give at least one with a learner")


def check_folder(folder: Path) -> None:
    """Raise ``InvalidInput`` for a folder that is none, or that cannot be made or written to; makes nothing."""
    there = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    if not there.is_dir():
        raise InvalidInput(f"{folder}: {there} is a file; give a folder of its own (--output)")
    try:
        check_writable(there)
    except OSError as error:
        raise InvalidInput(f"{folder}: cannot be written to ({error.strerror}); give another (--output)") from None


def check_settings(plan: Plan) -> None:
    """Raise ``InvalidInput`` where the folder holds an ablation with other settings, whose results would be lost."""
    file = plan.folder / SETTINGS
    if not file.exists():
        return
    kept, wanted = read_kept(file, "delete it to compare anew"), plan.settings()
    other = [name for name, value in wanted.items() if kept.get(name) != value]
    if other:
        told = "; ".join(
            f"{name.replace('_', '-')} {kept.get(name)!s:.40}, here {wanted[name]}" if name in _NUMBERS else f"{name}"
            for name in other
        )
        raise InvalidInput(
            f"{plan.folder}: holds an ablation with other settings ({told}); give another folder (--output), or, to use"
            f" its trainings, a copy of it without {SETTINGS}"
        )


def keep_settings(plan: Plan) -> None:
    """Make the folder, and write the settings into it."""
    plan.folder.mkdir(parents=True, exist_ok=True)
    write_file(plan.folder / SETTINGS, (json.dumps(plan.settings(), indent=2) + "\n").encode())


def read_kept(file: Path, advice: str) -> dict[str, Any]:
    """What a JSON file holds; raises ``InvalidInput`` (file, reason, ``advice``) if that is no object."""
    try:
        return read_object(file)
    except InvalidInput as error:
        raise InvalidInput(f"{error}; {advice}") from None
