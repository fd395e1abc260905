"""Levels and settings of an ablation.

An ablation compares *levels*: scenarios with the same vehicles, gaps and speeds. Levels may differ in who learns, who
has which information, whose harm counts, and whether an obstacle is ahead. A *sweep* compares copies of one level that
differ in the value of one key.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number, count_of
from ethbrake_marl.extensions.cooperation.sweep import Swept
from ethbrake_marl.extensions.studies.folder import StudyFolder
from ethbrake_marl.extensions.studies.trainings import TrainingJob
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.first_edition.agents.spec import split_names
from ethbrake_marl.first_edition.evaluation.identity import LIST_SEED
from ethbrake_marl.first_edition.evaluation.trial import load_runnable
from ethbrake_marl.first_edition.physics.messages import refuse_untold
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.training.recipe import WORDS, TrainingRecipe, load_recipe
from ethbrake_marl.first_edition.training.settings import read_settings
from ethbrake_marl.first_edition.training.training import Training

LADDER = (
    "cooperation-0-sensors",
    "cooperation-1-front",
    "cooperation-2-paper",
    "cooperation-3-pair",
    "cooperation-4-all",
)

STANDARD = (*LADDER, "cooperation-2-blocked")

SWEPT = "cooperation-3-pair"  # default level of a sweep

Json = dict[str, Any]

_LINE = ("vehicles", "time_step_s", "horizon_s")

WORLD = ("gaps_m", "speeds_mps")

VEHICLE = (
    "braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "speed_limit_mps", "restitution", "brake_rate_mps3",
    "release_rate_mps3",
)  # fmt: skip

_MAY_DIFFER = "only in roles, objective, obstacle_gap_m, v2x and, where v2x differs, latency_s"

_BUT_CHANNEL = {"name", "title", "description", "source", "v2x"}


@dataclass(frozen=True, slots=True)
class Level:
    """One of the scenarios that an ablation compares."""

    scenario: Scenario
    clear: str | None = None  # name of an earlier level that differs only in ``v2x``; None: there is no such level
    swept: Swept | None = None  # the swept key with this level's value; None: no sweep

    @property
    def name(self) -> str:
        """Name of the scenario; in a sweep followed by the swept value, such as ``cooperation-3-pair-social-15``."""
        return self.scenario.name if self.swept is None else f"{self.scenario.name}-{self.swept.label}"

    @property
    def same_lines(self) -> bool:
        """Whether world k has the same vehicles at all levels; False if a sweep varies a key of the vehicles."""
        return self.swept is None or self.swept.same_lines

    @property
    def columns(self) -> Json:
        """Columns of result tables for the swept key and its value; empty if there is no sweep."""
        return {} if self.swept is None else self.swept.columns


def read_levels(names: Sequence[str], settings: Sequence[Override] = ()) -> list[Level]:
    """Load the levels of an ablation.

    A level that differs from an earlier level only in ``v2x`` is compared with that level (``Level.clear``). The other
    levels form the *ladder*, in which each level is compared with the previous one.

    ``names`` are names or paths of scenarios; ``settings`` replace values in every scenario. Raises ``InvalidInput`` if
    there are fewer than two levels or if a level is repeated. Raises the exceptions of ``load_runnable`` if a scenario
    cannot be loaded.
    """
    levels: list[Level] = []
    for name in names:
        scenario = load_runnable(name, settings)
        if any(level.name == scenario.name for level in levels):
            raise InvalidInput(f"levels: {scenario.name!r} is given twice; give each level once")
        fields = scenario.model_dump(mode="json", exclude=_BUT_CHANNEL)
        same = [
            level.name
            for level in levels
            if level.clear is None
            and level.scenario.v2x != scenario.v2x
            and level.scenario.model_dump(mode="json", exclude=_BUT_CHANNEL) == fields
        ]
        levels.append(Level(scenario, same[0] if same else None))
    if len(levels) < 2:
        raise InvalidInput(f"levels: {count_of(len(levels), 'level')} given; give at least two levels to compare")
    return levels


def sweep_levels(name: str, sweep: str, settings: Sequence[Override], recipes: Sequence[TrainingRecipe]) -> list[Level]:
    """Return one level for each value of a sweep, in ascending order of the values.

    ``name`` is the name or path of the scenario. ``sweep`` is a text ``KEY=LOW..HIGH:STEP`` or ``KEY=A,B,...``.
    ``settings`` are for other keys of the scenario. Raises ``InvalidInput`` if the key of the sweep is not a key of a
    scenario; if ``settings`` or a recipe also set this key; or if levels with different values of this key cannot be
    compared. Raises the exceptions of ``Swept.parse`` for an invalid ``sweep``, and of ``load_runnable`` if the
    scenario cannot be loaded.
    """
    values = Swept.parse(sweep)
    scenario = read_settings([values[0].setting], recipes).scenario
    if not scenario:
        key = values[0].key
        raise InvalidInput(
            f"--sweep {key}: this is a key of a recipe, but only a key of a scenario can be swept; to vary a recipe,"
            " write a recipe for each value, and use train/sweep.py"
        )
    key, path = scenario[0].key, scenario[0].path
    if path[0] in _LINE:
        raise InvalidInput(
            f"--sweep {key}: levels with different values of {path[0]} cannot be compared; for each value of"
            f" {path[0]}, run the command once, with --set {path[0]}=... and an --output of its own"
        )
    if any(each.path[: len(path)] == path for each in settings):
        raise InvalidInput(f"--sweep {key}: --set changes the same key; leave out --sweep or --set")
    for recipe in recipes if path[0] == "objective" else ():
        if recipe.reward.objective is not None:
            raise InvalidInput(
                f"--sweep {key}: the sweep has no effect, because recipe {recipe.name!r} has its own objective"
                " (reward.objective); give a recipe without an objective"
            )
    each_value = [value._replace(key=key) for value in values]
    return [Level(load_runnable(name, [*settings, value.override]), swept=value) for value in each_value]


def common_worlds(levels: Sequence[Level], episodes: int, seed: int) -> list[Sample]:
    """Draw worlds for each level; world k has the same line of vehicles at all levels.

    Levels with different ``v2x`` may have different latencies, and a level may have an obstacle that others do not
    have. If a sweep varies a key of the vehicles, world k is drawn with the same random numbers at all levels, but the
    vehicles of world k differ from level to level.

    Raises ``InvalidInput``, which names the level and the quantity, if a quantity differs that must be the same at all
    levels.
    """
    samples = [level.scenario.sample(episodes, seed) for level in levels]
    if not levels[0].same_lines:
        return samples
    for k, level in enumerate(levels):
        if level.scenario.observation != levels[0].scenario.observation:
            raise InvalidInput(
                f"level {level.name!r}: its observation differs from the observation of level {levels[0].name!r};"
                f" levels may differ {_MAY_DIFFER}"
            )
        _check_same(levels[0], samples[0], level, samples[k], (*_LINE, *WORLD, *VEHICLE))
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
                f"level {other.name!r}: {name} is {here}, but {there} at level {one.name!r}; levels may differ"
                f" {_MAY_DIFFER}; change or leave out one of the two levels"
            )


def _values(name: str, level: Level, sample: Sample) -> Floats:
    """Return an array with one row per world: the quantity ``name``, such as ``gaps_m``, in the worlds of ``sample``.

    If ``name`` is ``vehicles``, ``time_step_s`` or ``horizon_s``, the array has a single number: the scenario's value.
    """
    if name in _LINE:
        return np.array([getattr(level.scenario, name)], np.float64)
    return quantity(name, sample.worlds)


def quantity(name: str, worlds: Worlds) -> Floats:
    """Return the attribute ``name`` of ``worlds``, or else of ``worlds.vehicles``, as an array [n, ...]."""
    values: Floats = getattr(worlds if hasattr(worlds, name) else worlds.vehicles, name)
    return values


# file names in the ablation's folder
SETTINGS, JSON, CSV, FIGURE = "settings.json", "ablation.json", "ablation.csv", "ablation.png"

_QUICK = {"seeds": 2, "steps_per_learner": 200_000, "episodes": 500, "search_episodes": 40, "budget": 2_000}

_FULL = {"seeds": 5, "steps_per_learner": 400_000, "episodes": 4_000, "search_episodes": 600, "budget": 20_000}


@dataclass(frozen=True, slots=True)
class Plan:
    """Settings of an ablation."""

    levels: tuple[Level, ...]  # levels to compare, in order
    recipes: tuple[TrainingRecipe, ...]  # training recipes; each has its scheme for several learners
    seeds: int  # number of trainings (seeds) per level and recipe
    steps_per_learner: int  # number of decisions of each learner in a training
    episodes: int  # number of worlds for the comparison
    list_seed: int  # seed of these worlds
    search_episodes: int  # number of these worlds, counted from the first, in which the joint optimum is searched
    budget: int  # number of candidate profiles that the search tries per world and count of harm
    folder: Path  # folder of all results
    noted: tuple[str, ...] = ()  # overrides of scenarios and recipes, which are recorded in ``config.json``
    shield: str | None = None  # "step": all teams are also evaluated with the step shield
    sweep: str | None = None  # the sweep as text, such as objective=social:0..90:15; None: no sweep

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Names of the compared algorithms, each in the form ``RECIPE-SCHEME``."""
        return tuple(algorithm(recipe) for recipe in self.recipes)

    def trainings(self) -> Iterator[tuple[Level, str, TrainingJob]]:
        """Yield each training run as (level, name of the algorithm, training run), ordered by seed.

        Levels without learners have no training runs.
        """
        for seed in range(self.seeds):
            for recipe in self.recipes:
                for level in self.levels:
                    if level.scenario.learners:
                        yield level, algorithm(recipe), self.training(level, recipe, seed)

    def training(self, level: Level, recipe: TrainingRecipe, seed: int) -> TrainingJob:
        """Return the training run of one recipe at one level with one seed.

        Raises ``InvalidInput`` if the recipe cannot train at this level.
        """
        learners = len(level.scenario.learners)
        changes: dict[str, Any] = {"seed": seed, "total_steps": self.steps_per_learner * learners}
        if learners == 1:  # the scheme has no effect with one learner
            changes |= dict.fromkeys({"scheme", "turns"} & type(recipe).model_fields.keys())
        name = recipe.name if learners == 1 else algorithm(recipe)
        folder = self.folder / "trainings" / f"{level.name}-{name}-seed{seed}"
        noted = self.noted if level.swept is None else (*self.noted, level.swept.setting)
        return TrainingJob(Training.of(recipe.replace(**changes), level.scenario), folder, noted)

    def settings(self) -> dict[str, Any]:
        """Return all settings that affect the results."""
        numbers = ("seeds", "steps_per_learner", "episodes", "list_seed", "search_episodes", "budget")
        return {
            "levels": [level.scenario.model_dump(mode="json", exclude=set(WORDS)) for level in self.levels],
            "recipes": [recipe.model_dump(mode="json", exclude=set(WORDS)) for recipe in self.recipes],
            **{name: getattr(self, name) for name in numbers},
            "shield": self.shield,
        }

    def study_folder(self) -> StudyFolder:
        """Return the ablation's ``StudyFolder``, which refuses a folder that contains results of other settings."""
        advice = f"give another folder (--output); to reuse its trained policies, give a copy without {SETTINGS}"
        return StudyFolder(
            self.folder, "an ablation", self.settings(), record=SETTINGS, advice=advice, writes=(JSON, CSV, FIGURE)
        )

    def optimum_folder(self, level: Level) -> Path:
        """Return the folder of the search for a level's joint optimum."""
        return self.folder / "optimum" / level.name


def with_scheme(recipe: TrainingRecipe, scheme: str | None = None) -> TrainingRecipe:
    """Return the recipe with ``scheme``, which says how several learners are trained.

    If ``scheme`` is None, the recipe keeps its own scheme; a recipe without a scheme gets ``shared``.
    """
    return recipe.replace(scheme=scheme or recipe.scheme or "shared")


def algorithm(recipe: TrainingRecipe) -> str:
    return f"{recipe.name}-{recipe.scheme}"


def plan_ablation(
    levels: str | None,
    recipes: str,
    settings: Sequence[str] | None,
    *,
    sweep: str | None = None,
    quick: bool = False,
    tell: Callable[[str], None] | None = None,
    **given: Any,
) -> Plan:
    """Return the settings of an ablation, from the options of the command ``study ablate``.

    Args:
        levels: names or paths of scenarios, separated by commas; None: the shipped levels.
        recipes: names or paths of recipes, separated by commas.
        settings: settings ``KEY=VALUE`` of scenarios and recipes.
        sweep: ``KEY=LOW..HIGH:STEP`` or ``KEY=A,B,...``; None: no sweep.
        quick: True: numbers that ``given`` does not contain get small defaults.
        tell: called with a note if ``gamma`` and ``reward.shaping_discount`` of a recipe differ.
        given: further fields of ``Plan``, such as ``seeds``; a field that is None gets its default.

    Raises ``InvalidInput`` if two recipes have the same name, if a number such as ``seeds`` is below 1, if the shield
    is unknown, if no level has a learner, or if levels cannot be trained or compared.

    """
    usual_names: tuple[str, ...] = (LADDER if quick else STANDARD) if sweep is None else (SWEPT,)
    names = usual_names if levels is None else [each.strip() for each in split_names(levels, os.path.isfile)]
    loaded = [load_recipe(each.strip()) for each in split_names(recipes, os.path.isfile)]
    changed = read_settings(settings, loaded)
    usual = {"list_seed": LIST_SEED, **(_QUICK if quick else _FULL)}
    changed_recipes = tuple(with_scheme(changed.change(recipe, tell)) for recipe in loaded)
    if sweep is None:
        compared = read_levels(names, changed.scenario)
    elif len(names) == 1:
        compared = sweep_levels(names[0], sweep, changed.scenario, changed_recipes)
    else:
        raise InvalidInput(f"levels: {len(names)} levels given; a sweep needs exactly one level")
    plan = Plan(
        levels=tuple(compared),
        recipes=changed_recipes,
        noted=changed.texts,
        sweep=sweep,
        **{**usual, **{name: value for name, value in given.items() if value is not None}},
    )
    for name in ("seeds", "steps_per_learner", "episodes", "search_episodes", "budget"):
        check_whole_number(name, getattr(plan, name), 1)
    called = [recipe.name for recipe in loaded]
    if len(set(called)) < len(called):
        raise InvalidInput(f"recipes {', '.join(called)}: two recipes have the same name; all names must differ")
    if plan.shield not in (None, "step"):
        raise InvalidInput(
            f"shield {plan.shield!r}: the shield must be 'step', because other shields can control only one vehicle"
        )
    if plan.search_episodes > plan.episodes:
        raise InvalidInput(
            f"search-episodes = {plan.search_episodes}: must be at most the number of worlds, episodes ="
            f" {plan.episodes}"
        )
    if not any(level.scenario.learners for level in plan.levels):
        raise InvalidInput("levels: no level has a learner; give at least one level with a learner")
    StudyFolder(plan.folder, "an ablation").check()
    samples = common_worlds(plan.levels, 5, plan.list_seed)
    for level, sample in zip(plan.levels, samples, strict=True) if plan.shield is not None else ():
        refuse_untold(sample.worlds, level.scenario.learners, f"level {level.name!r} behind the shield")
    list(plan.trainings())  # raises InvalidInput for an impossible training
    return plan


TOLERANCE = 1e-6  # m2/s2; a vehicle counts as worse off if its harm rises by more than this

HARM = {"first": "first-impact harm", "total": "total harm"}
