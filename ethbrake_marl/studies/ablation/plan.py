"""Levels of cooperation that belong together: the same lines; what differs is who learns, knows and cares."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.inputs import load_runnable
from ethbrake_marl.files.durable import check_writable, write_file
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.learning.recipe import WORDS, Scheme, TrainingRecipe
from ethbrake_marl.learning.run_folder import RunDirectory, read_object
from ethbrake_marl.learning.training import check_same, resolve
from ethbrake_marl.physics import Floats
from ethbrake_marl.scenario import Sample, Scenario
from ethbrake_marl.studies.jobs.training import TrainingJob

LADDER = (
    "cooperation-0-sensors",
    "cooperation-1-front",
    "cooperation-2-paper",
    "cooperation-3-pair",
    "cooperation-4-all",
)
STANDARD = (*LADDER, "cooperation-2-blocked")

_LINE = ("vehicles", "time_step_s", "horizon_s")
_WORLD = ("gaps_m", "speeds_mps")
_VEHICLE = ("braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "speed_limit_mps", "restitution")
_MAY_DIFFER = "roles, objective, obstacle_gap_m, v2x and, where v2x differs, latency_s"
_ABOUT = {"name", "title", "description", "source"}


@dataclass(frozen=True, slots=True)
class Level:
    """One scenario of an ablation."""

    scenario: Scenario
    clear: str | None = None  # name of the level that is the same but for ``v2x``; None: a step of the ladder

    @property
    def name(self) -> str:
        """The scenario's name."""
        return self.scenario.name

    @property
    def trained(self) -> bool:
        """Whether anybody learns; else all follow their scripts."""
        return bool(self.scenario.learners)


def read_levels(names: Sequence[str], settings: Sequence[Override] = ()) -> list[Level]:
    """Load the levels, by name or path, in this order; ``settings`` hold in each.

    One that differs from an earlier one in ``v2x`` only is that level over another channel; the others are the ladder,
    each compared with the one before. Raises ``InvalidInput`` for fewer than two levels or one given twice, and what
    ``load_runnable`` raises.
    """
    levels: list[Level] = []
    for name in names:
        scenario = load_runnable(name, settings)
        if any(level.name == scenario.name for level in levels):
            raise InvalidInput(f"levels: {scenario.name!r} is given twice")
        same = [level.name for level in levels if level.clear is None and _but_channel(level.scenario, scenario)]
        levels.append(Level(scenario, same[0] if same else None))
    if len(levels) < 2:
        raise InvalidInput(f"levels: {len(levels)} given; at least two are needed to compare")
    return levels


def common_worlds(levels: Sequence[Level], episodes: int, seed: int) -> list[Sample]:
    """The list of each level: world k is the same line in all of them, and the same physics hold in it.

    Latencies may differ where ``v2x`` does, and an obstacle ahead may be there or not. Raises ``InvalidInput`` naming
    the level and what is another there.
    """
    samples = [level.scenario.sample(episodes, seed) for level in levels]
    for k, level in enumerate(levels):
        if level.scenario.observation != levels[0].scenario.observation:
            raise InvalidInput(
                f"level {level.name!r}: its observation differs from that of {levels[0].name!r}, so that what it gains"
                f" would not be cooperation's; levels may differ in {_MAY_DIFFER}"
            )
        _check_same(levels[0], samples[0], level, samples[k], (*_LINE, *_WORLD, *_VEHICLE))
        clear = next(j for j in range(k + 1) if levels[j].scenario.v2x == level.scenario.v2x)
        _check_same(levels[clear], samples[clear], level, samples[k], ("latency_s",))
    return samples


def _check_same(one: Level, first: Sample, other: Level, sample: Sample, names: Sequence[str]) -> None:
    for name in names:
        values, others = (_values(name, *pair) for pair in ((one, first), (other, sample)))
        rows = np.flatnonzero((values != others).reshape(len(values), -1).any(axis=1))
        if rows.size:
            here, there = (", ".join(f"{each:g}" for each in np.ravel(v[rows[0]])) for v in (others, values))
            raise InvalidInput(
                f"level {other.name!r}: its {name} differs from that of {one.name!r} ({here}; there {there}); levels"
                f" are compared on the same lines and may differ in {_MAY_DIFFER}, so change or leave out one of them"
            )


def _values(name: str, level: Level, sample: Sample) -> Floats:
    """One row per world of a quantity of the worlds; one row of a number of the scenario."""
    if name in _LINE:
        return np.array([getattr(level.scenario, name)], np.float64)
    values: Floats = getattr(sample.worlds if name in _WORLD else sample.worlds.vehicles, name)
    return values


def _but_channel(one: Scenario, other: Scenario) -> bool:
    """Whether two scenarios differ in their channel, and in nothing else that matters."""
    first, second = (scenario.model_dump(mode="json", exclude=_ABOUT | {"v2x"}) for scenario in (one, other))
    return first == second and one.v2x != other.v2x


TRAININGS, OPTIMUM, SETTINGS = "trainings", "optimum", "settings.json"  # inside the ablation's folder
SHIELDS = ("step",)  # that may be put around every level's learners
_NUMBERS = ("seeds", "steps_per_learner", "episodes", "list_seed", "search_episodes", "budget")
_TOLD = (*_NUMBERS, "shield")  # settings whose values are told where they differ


@dataclass(frozen=True, slots=True)
class Training:
    """One training: a level, a recipe with its seed, and where it stands."""

    level: Level
    algorithm: str
    recipe: TrainingRecipe
    folder: Path
    noted: tuple[str, ...] = ()  # by which scenario and recipe differ from their files, for ``config.json``

    def steps_left(self) -> int:
        """Decisions that are still to do; raises ``InvalidInput`` for a folder that holds another training."""
        run = RunDirectory(self.folder)
        if not run.status.exists():
            if self.folder.exists():
                raise InvalidInput(f"{self.folder}: is no training; move it away, or give another --output")
            return self.recipe.total_steps
        status = read_kept(run.status, "delete its folder to train anew")
        check_same(self.folder, resolve(self.recipe, self.level.scenario))
        if status.get("status") == "finished":
            return 0
        steps = status.get("steps", 0)
        return max(self.recipe.total_steps - (steps if isinstance(steps, int) else 0), 1)

    def job(self) -> TrainingJob:
        """What brings it to its end."""
        return TrainingJob(resolve(self.recipe, self.level.scenario), self.folder, self.noted)


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
    noted: tuple[str, ...] = ()  # see ``Training``
    shield: str | None = None  # one of ``SHIELDS``: everything drives a second time, behind it

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
            changes |= dict.fromkeys({"scheme", "turns"} & type(recipe).model_fields.keys())
        name = recipe.name if learners == 1 else _algorithm(recipe)
        folder = self.folder / TRAININGS / f"{level.name}-{name}-seed{seed}"
        return Training(level, _algorithm(recipe), recipe.replace(**changes), folder, self.noted)

    def settings(self) -> dict[str, Any]:
        """Everything that shapes the results, as plain data."""
        scenarios = [level.scenario.model_dump(mode="json", exclude=set(WORDS)) for level in self.levels]
        recipes = [recipe.model_dump(mode="json", exclude=set(WORDS)) for recipe in self.recipes]
        numbers = {name: getattr(self, name) for name in _NUMBERS}
        return {"levels": scenarios, "recipes": recipes, **numbers, "shield": self.shield}

    def optimum_folder(self, level: Level) -> Path:
        """Where the parts of its search stand."""
        return self.folder / OPTIMUM / level.name


def with_scheme(recipe: TrainingRecipe, scheme: Scheme | None) -> TrainingRecipe:
    """The recipe with this scheme for several learners; None: its own, else shared."""
    return recipe.replace(scheme=scheme or recipe.scheme or "shared")


def _algorithm(recipe: TrainingRecipe) -> str:
    return f"{recipe.name}-{recipe.scheme}"


def check_plan(plan: Plan) -> None:
    """Raise ``InvalidInput`` for recipes of one name, numbers below 1, an unknown shield, or nothing to train."""
    names = [recipe.name for recipe in plan.recipes]
    if not names or len(set(names)) < len(names):
        raise InvalidInput(f"recipes {', '.join(names) or 'none'}: give at least one, each with a name of its own")
    for name in _NUMBERS:
        if name != "list_seed" and not getattr(plan, name) >= 1:
            raise InvalidInput(f"{name.replace('_', '-')} {getattr(plan, name)}: must be at least 1")
    if plan.shield not in (None, *SHIELDS):
        raise InvalidInput(
            f"shield {plan.shield!r}: must be {', '.join(SHIELDS)}; episode and robust shield one vehicle"
        )
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
            f"{name.replace('_', '-')} {kept.get(name)!s:.40}, here {wanted[name]}" if name in _TOLD else f"{name}"
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
