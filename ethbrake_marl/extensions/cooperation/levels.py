"""The levels and the plan of an ablation.

An ablation compares *levels*: scenarios with the same vehicles, gaps and speeds. They differ in who learns, who has
which information, whose harm counts, and whether an obstacle stands ahead. A sweep takes one level and sets one key of
its scenario, whichever it is, to several numbers; each number makes a level.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.spec import split_names
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.evaluation.identity import LIST_SEED
from ethbrake_marl.evaluation.trial import load_runnable
from ethbrake_marl.extensions.cooperation.sweep import Swept
from ethbrake_marl.extensions.studies.folder import StudyFolder
from ethbrake_marl.extensions.studies.trainings import TrainingJob
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.physics.messages import refuse_untold
from ethbrake_marl.physics.state import Floats, Worlds
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.recipe import WORDS, TrainingRecipe, load_recipe
from ethbrake_marl.training.settings import read_settings
from ethbrake_marl.training.training import Training

LADDER = (
    "cooperation-0-sensors",
    "cooperation-1-front",
    "cooperation-2-paper",
    "cooperation-3-pair",
    "cooperation-4-all",
)

STANDARD = (*LADDER, "cooperation-2-blocked")

SWEPT = "cooperation-3-pair"  # the level that is swept if none is named

Json = dict[str, Any]

_LINE = ("vehicles", "time_step_s", "horizon_s")

WORLD = ("gaps_m", "speeds_mps")

VEHICLE = (
    "braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "speed_limit_mps", "restitution", "brake_rate_mps3",
    "release_rate_mps3",
)  # fmt: skip

_MAY_DIFFER = "roles, objective, obstacle_gap_m, v2x and, where v2x differs, latency_s"

_BUT_CHANNEL = {"name", "title", "description", "source", "v2x"}


@dataclass(frozen=True, slots=True)
class Level:
    """One level of cooperation in an ablation: a scenario, compared with others on the same lines of vehicles."""

    scenario: Scenario
    clear: str | None = None  # name of the level that differs only in ``v2x``; None: this level is on the ladder
    swept: Swept | None = None  # the swept key at this level's value; None: no sweep

    @property
    def name(self) -> str:
        """The scenario's name; in a sweep with the value: ``cooperation-3-pair-social-15``."""
        return self.scenario.name if self.swept is None else f"{self.scenario.name}-{self.swept.label}"

    @property
    def same_lines(self) -> bool:
        """Whether world k is the same line as in the levels beside it; False in a sweep that changes the lines."""
        return self.swept is None or self.swept.same_lines

    @property
    def columns(self) -> Json:
        """Columns of tables that only a sweep has."""
        return {} if self.swept is None else self.swept.columns


def read_levels(names: Sequence[str], settings: Sequence[Override] = ()) -> list[Level]:
    """Load the levels of an ablation, in this order.

    A level that differs from an earlier one only in ``v2x`` is compared with that level (``Level.clear``). Each of the
    other levels is compared with the one before; they form the *ladder*.

    Args:
        names: names or paths of scenarios.
        settings: settings ``KEY=VALUE`` that override keys in each of them.

    Raises ``InvalidInput`` for fewer than two levels or a repeated level, and the exceptions of ``load_runnable``.

    """
    levels: list[Level] = []
    for name in names:
        scenario = load_runnable(name, settings)
        if any(level.name == scenario.name for level in levels):
            raise InvalidInput(f"levels: {scenario.name!r} is given twice")
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
        raise InvalidInput(f"levels: {len(levels)} given; at least two are needed to compare")
    return levels


def sweep_levels(name: str, sweep: str, settings: Sequence[Override], recipes: Sequence[TrainingRecipe]) -> list[Level]:
    """Return one level for each value of a sweep, in ascending order: the level ``name`` with ``settings``.

    Raises ``InvalidInput`` for a key that ``settings`` set too, that no scenario has, that a recipe replaces, or with
    which levels could not be compared; and the exceptions of ``Swept.parse`` and ``load_runnable``.
    """
    values = Swept.parse(sweep)
    scenario = read_settings([values[0].setting], recipes).scenario
    if not scenario:
        key = values[0].key
        raise InvalidInput(f"--sweep {key}: is a recipe's; a sweep varies a scenario (recipes: ethbrake study sweep)")
    key, path = scenario[0].key, scenario[0].path
    if path[0] in _LINE:
        raise InvalidInput(
            f"--sweep {key}: levels with different {path[0]} cannot be compared, vehicle by vehicle and time by time;"
            f" give each a folder of its own (--set {path[0]}=..., --output)"
        )
    if any(each.path[: len(path)] == path for each in settings):
        raise InvalidInput(f"--sweep {key}: --set {key} has no place beside it; leave one of them out")
    for recipe in recipes if path[0] == "objective" else ():
        if recipe.reward.objective is not None:
            raise InvalidInput(
                f"--sweep {key}: recipe {recipe.name!r} has an objective of its own (reward.objective), so that the"
                " scenario's changes nothing; give a recipe without"
            )
    each_value = [value._replace(key=key) for value in values]
    return [Level(load_runnable(name, [*settings, value.override]), swept=value) for value in each_value]


def common_worlds(levels: Sequence[Level], episodes: int, seed: int) -> list[Sample]:
    """Draw ``episodes`` worlds from ``seed`` for each level; world k is the same line of vehicles in all levels.

    Latencies may differ where ``v2x`` differs, and an obstacle ahead may be present or not. In a sweep of any other
    key, world k is drawn with the same random numbers, but the key changes it. Raises ``InvalidInput`` with the level
    and the quantity that differs, if another quantity differs.
    """
    samples = [level.scenario.sample(episodes, seed) for level in levels]
    if not levels[0].same_lines:
        return samples
    for k, level in enumerate(levels):
        if level.scenario.observation != levels[0].scenario.observation:
            raise InvalidInput(
                f"level {level.name!r}: its observation differs from that of {levels[0].name!r}, so that what it gains"
                f" would not be cooperation's; levels may differ in {_MAY_DIFFER}"
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
                f"level {other.name!r}: its {name} differs from that of {one.name!r} ({here}; there {there}); levels"
                f" are compared on the same lines and may differ in {_MAY_DIFFER}, so change or leave out one of them"
            )


def _values(name: str, level: Level, sample: Sample) -> Floats:
    """Return the quantity called ``name``, such as ``gaps_m``, in the worlds of ``sample``: one row per world.

    A number of the level's whole scenario, such as ``time_step_s``, gives a single row.
    """
    if name in _LINE:
        return np.array([getattr(level.scenario, name)], np.float64)
    return quantity(name, sample.worlds)


def quantity(name: str, worlds: Worlds) -> Floats:
    """Return a field of the worlds or of their vehicles, [n, ...]."""
    values: Floats = getattr(worlds if hasattr(worlds, name) else worlds.vehicles, name)
    return values


SETTINGS = "settings.json"  # file name in the ablation's folder

_QUICK = {"seeds": 2, "steps_per_learner": 200_000, "episodes": 500, "search_episodes": 40, "budget": 2_000}

_FULL = {"seeds": 5, "steps_per_learner": 400_000, "episodes": 4_000, "search_episodes": 600, "budget": 20_000}


@dataclass(frozen=True, slots=True)
class Plan:
    """Settings of an ablation, a comparison of trainings at several levels of cooperation."""

    levels: tuple[Level, ...]  # the compared levels, in order
    recipes: tuple[TrainingRecipe, ...]  # how to train; each recipe names its scheme for several learners
    seeds: int  # trainings per level and recipe
    steps_per_learner: int  # decisions of each learner in a training
    episodes: int  # number of common worlds
    list_seed: int  # seed of the common worlds
    search_episodes: int  # number of these worlds, from the first on, in which the joint optimum is searched
    budget: int  # candidate profiles that the search tries per world and count of harm
    folder: Path  # folder of all results
    noted: tuple[str, ...] = ()  # overrides of scenarios and recipes, for ``config.json``
    shield: str | None = None  # "step": everything also drives behind the step shield
    sweep: str | None = None  # as given: objective=social:0..90:15; None: the levels are scenarios of their own

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Names of the compared algorithms, ``RECIPE-SCHEME`` each."""
        return tuple(algorithm(recipe) for recipe in self.recipes)

    def trainings(self) -> Iterator[tuple[Level, str, TrainingJob]]:
        """Yield all trainings as (level, name of the algorithm, training), seed by seed.

        So a first result over all levels exists early. Levels without learners are omitted.
        """
        for seed in range(self.seeds):
            for recipe in self.recipes:
                for level in self.levels:
                    if level.scenario.learners:
                        yield level, algorithm(recipe), self.training(level, recipe, seed)

    def training(self, level: Level, recipe: TrainingRecipe, seed: int) -> TrainingJob:
        """Return the training of one recipe at one level with one seed, with its folder.

        Raises ``InvalidInput`` if recipe and level do not fit together.
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
        """Return all settings that affect the results as plain data: levels, recipes, numbers and the shield."""
        numbers = ("seeds", "steps_per_learner", "episodes", "list_seed", "search_episodes", "budget")
        return {
            "levels": [level.scenario.model_dump(mode="json", exclude=set(WORDS)) for level in self.levels],
            "recipes": [recipe.model_dump(mode="json", exclude=set(WORDS)) for recipe in self.recipes],
            **{name: getattr(self, name) for name in numbers},
            "shield": self.shield,
        }

    def study_folder(self) -> StudyFolder:
        """Return the object that guards the ablation's folder.

        It refuses a folder with the results of an ablation with other settings.
        """
        advice = f"give another folder (--output), or, to use its trainings, a copy of it without {SETTINGS}"
        written = (*FIGURES, *SWEEP_FIGURES, *(f"ablation.{ending}" for ending in ("html", "md", "csv", "json")))
        return StudyFolder(self.folder, "an ablation", self.settings(), record=SETTINGS, advice=advice, writes=written)

    def optimum_folder(self, level: Level) -> Path:
        """Return the path of the folder with the results of a level's search for the joint optimum."""
        return self.folder / "optimum" / level.name


def with_scheme(recipe: TrainingRecipe, scheme: str | None = None) -> TrainingRecipe:
    """Return the recipe with a scheme for several learners.

    This is ``scheme``, or if it is None the recipe's own, or else ``shared``.
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
    """Return the plan of an ablation, or of a sweep of one level, from the options of its command.

    Args:
        levels: names or paths of scenarios with commas between them; None: the shipped levels.
        recipes: names or paths of recipes with commas between them.
        settings: settings ``KEY=VALUE`` of scenarios and recipes; None: none.
        sweep: key of a scenario and its numbers, ``KEY=LOW..HIGH:STEP`` or ``KEY=A,B,...``; None: no sweep.
        quick: use few seeds, worlds and decisions by default.
        tell: called with notes about settings that do not fit together.
        given: other fields of ``Plan``; None means the default.

    Raises ``InvalidInput`` for recipes with the same name, numbers below 1, an unknown shield, levels without any
    learner, and levels that cannot be trained or compared.

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
        raise InvalidInput(f"levels: {len(names)} given; a sweep makes its levels out of one")
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
        raise InvalidInput(f"recipes {', '.join(called)}: give at least one, each with a name of its own")
    if plan.shield not in (None, "step"):
        raise InvalidInput(f"shield {plan.shield!r}: must be step; episode and robust shield one vehicle")
    if plan.search_episodes > plan.episodes:
        raise InvalidInput(
            f"search-episodes {plan.search_episodes}: must be at most the {plan.episodes} worlds of --episodes"
        )
    if not any(level.scenario.learners for level in plan.levels):
        raise InvalidInput("levels: nobody learns in any of them; give at least one with a learner")
    StudyFolder(plan.folder, "an ablation").check()
    samples = common_worlds(plan.levels, 5, plan.list_seed)
    for level, sample in zip(plan.levels, samples, strict=True) if plan.shield is not None else ():
        refuse_untold(sample.worlds, level.scenario.learners, f"level {level.name!r} behind the shield")
    list(plan.trainings())  # raises InvalidInput for an impossible training
    return plan


TOLERANCE = 1e-6  # m2/s2; a vehicle is worse off if its harm rises by more than this

HARM = {"first": "first-impact harm", "total": "total harm"}

FIGURES = {  # file of each figure of ``ablation_figures``: its title and its description
    "ablation.png": (
        "Harm against cooperation",
        "Both harms at each level, between full braking and the joint optimum.",
    ),
    "ablation-changes.png": ("What each step is worth", "Change of both harms from one level to the next."),
    "ablation-who-pays.png": ("Who pays", "Change of the harm of each vehicle, under both counts."),
}

SWEEP_FIGURES = {  # the same of the figures of a sweep
    "ablation.png": (
        "Harm against the number",
        "Both harms at each value, between full braking and the joint optimum.",
    ),
    "ablation-who-bears.png": ("Who bears it", "Harm of each vehicle at each value, under both counts."),
}
