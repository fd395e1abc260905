"""The levels that an ablation compares, and its settings.

*Levels* are scenarios with the same vehicles, gaps and speeds. They may differ in who learns, who has which
information, whose harm counts, and whether an obstacle is ahead. A *sweep* compares copies of one level that differ in
the value of one key.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.cli.settings import Settings
from ethbrake_marl.errors import InvalidInput, check_whole_number, count_of
from ethbrake_marl.extensions.cooperation.sweep import Swept, parse_sweep
from ethbrake_marl.extensions.studies.folder import StudyFolder
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.training.recipe import TrainingRecipe
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.mixture import WORDS
from ethbrake_marl.worlds.rules import CAR_ROWS
from ethbrake_marl.worlds.sampling import Drawn
from ethbrake_marl.worlds.scenario import Scenario

LADDER = (
    *("cooperation-0-sensors", "cooperation-1-front", "cooperation-2-paper", "cooperation-3-pair"),
    "cooperation-4-all",
)
STANDARD = (*LADDER, "cooperation-2-blocked")
SWEPT = "cooperation-3-pair"  # default level of a sweep

SETTINGS, JSON, CSV, FIGURE = "settings.json", "ablation.json", "ablation.csv", "ablation.png"
FULL = {"seeds": 5, "steps_per_learner": 400_000, "episodes": 4_000, "search_episodes": 600, "budget": 20_000}
QUICK = {"seeds": 2, "steps_per_learner": 200_000, "episodes": 500, "search_episodes": 40, "budget": 2_000}

OF_LINE = ("vehicles", "time_step_s", "horizon_s", "observation")  # keys that all levels share
OF_VEHICLES = tuple(key for key in CAR_ROWS if key not in ("latency_s", "harm_weight"))
BUT_CHANNEL = ("name", *WORDS, "v2x")  # keys in which a level and the same one with another channel differ
SAME_VEHICLES = ("objective", "obstacle_gap_m", "roles", "v2x")  # keys whose sweep leaves the vehicles as they are


class Level(NamedTuple):
    """One of the scenarios that an ablation compares."""

    name: str  # of the scenario; in a sweep followed by the swept value, such as ``cooperation-3-pair-social-15``
    scenario: Scenario
    clear: str | None = None  # name of an earlier level that differs only in ``v2x``; None: there is none
    swept: Swept | None = None

    @property
    def same_vehicles(self) -> bool:
        """Whether world k has the same vehicles at all levels."""
        return self.swept is None or self.swept.key.partition(".")[0] in SAME_VEHICLES


def read_levels(names: Sequence[str], settings: Settings) -> list[Level]:
    """Load the levels of an ablation.

    A level that differs from an earlier one only in ``v2x`` is compared with it (``Level.clear``); the others form the
    *ladder*, in which each level is compared with the previous one. Raises ``InvalidInput`` for fewer than two levels
    and for a repeated one.
    """
    levels: list[Level] = []
    for name in names:
        scenario = settings.change_scenario(name)
        if any(level.name == scenario.name for level in levels):
            raise InvalidInput(f"levels: {scenario.name!r} is given twice; give each level once")
        content = scenario.content(without=BUT_CHANNEL)
        same = (each for each in levels if each.clear is None and each.scenario.v2x != scenario.v2x)
        clear = next((each.name for each in same if each.scenario.content(without=BUT_CHANNEL) == content), None)
        levels.append(Level(scenario.name, scenario, clear))
    if len(levels) < 2:
        raise InvalidInput(f"levels: {count_of(len(levels), 'level')} given; give at least two levels to compare")
    return levels


def sweep_levels(name: str, sweep: str, settings: Settings, recipes: Sequence[TrainingRecipe]) -> list[Level]:
    """Return one level for each value of a sweep, in ascending order.

    Raises ``InvalidInput`` if the key is not a scenario's, if a setting or a recipe sets it too, and if levels with
    different values of it cannot be compared.
    """
    values, levels = parse_sweep(sweep), []
    key = values[0].key
    path = tuple(key.removeprefix("scenario.").split("."))
    if path[0] not in Scenario.model_fields:
        raise InvalidInput(
            f"--sweep {key}: only a key of a scenario can be swept; to vary a recipe, write a recipe for each value,"
            " and use train/sweep.py"
        )
    if path[0] in OF_LINE:
        raise InvalidInput(
            f"--sweep {key}: levels with different values of {path[0]} cannot be compared; for each value of {path[0]},"
            f" run the command once, with --set {path[0]}=... and an --output of its own"
        )
    if any(each.path[: len(path)] == path for each in settings.scenario):
        raise InvalidInput(f"--sweep {key}: --set changes the same key; leave out --sweep or --set")
    for recipe in recipes if path[0] == "objective" else ():
        if recipe.reward.objective is not None:
            raise InvalidInput(
                f"--sweep {key}: the sweep has no effect, because recipe {recipe.name!r} has its own objective"
                " (reward.objective); give a recipe without an objective"
            )
    for value in (each._replace(key=".".join(path)) for each in values):
        changed = settings._replace(scenario=[*settings.scenario, *Override.parse([value.setting])])
        scenario = changed.change_scenario(name)
        levels.append(Level(f"{scenario.name}-{value.label}", scenario, swept=value))
    return levels


def common_worlds(levels: Sequence[Level], episodes: int, seed: int) -> list[Drawn]:
    """Draw the worlds of each level; world k has the same line of vehicles at all levels.

    Levels with different ``v2x`` may have different latencies, and a level may have an obstacle that others have not.
    Raises ``InvalidInput``, which names level and quantity, if anything else differs. If a sweep varies a key of the
    vehicles, world k only has the same random numbers.
    """
    drawn = [level.scenario.draw(episodes, seed) for level in levels]
    if not levels[0].same_vehicles:
        return drawn
    every = [_quantities(*pair) for pair in zip(levels, drawn, strict=True)]
    for k, level in enumerate(levels):
        clear = next(j for j in range(k + 1) if levels[j].scenario.v2x == level.scenario.v2x)
        for key, here in every[k].items():
            other = clear if key == "latency_s" else 0
            there = every[other][key]
            if not np.array_equal(here, there):
                raise InvalidInput(
                    f"level {level.name!r}: {key} is {_first(here, there)}, but {_first(there, here)} at level"
                    f" {levels[other].name!r}; levels may differ only in roles, objective, obstacle_gap_m, v2x and,"
                    " where v2x differs, latency_s; change or leave out one of the two levels"
                )
    return drawn


def _quantities(level: Level, drawn: Drawn) -> dict[str, Any]:
    """Return what levels must share: key -> [n, ...], or the value of a key of the scenario."""
    worlds, scenario = drawn.worlds, level.scenario
    own = {key: np.array(str(getattr(scenario, key))) for key in OF_LINE}
    of_worlds = {name: getattr(worlds, name) for name in ("gaps_m", "speeds_mps", "restitution", "latency_s")}
    return own | of_worlds | {key: worlds.car[:, CAR_ROWS[key], 1:] for key in OF_VEHICLES}


def _first(here: Floats, there: Floats) -> str:
    """Return the first row of ``here`` that differs, in words."""
    if here.ndim == 0 or here.shape != there.shape:
        return str(here) if here.ndim == 0 else f"of {here.shape[-1]} vehicles"
    k = int(np.argmax((here != there).reshape(len(here), -1).any(axis=1)))
    return ", ".join(f"{each:g}" for each in np.ravel(here[k]))


@dataclass(frozen=True)
class Plan:
    """Settings of an ablation."""

    folder: Path  # of all results
    levels: tuple[Level, ...]
    recipes: tuple[TrainingRecipe, ...]  # each has its scheme for several learners
    seeds: int  # trainings per level and recipe
    steps_per_learner: int  # decisions of each learner in a training
    episodes: int  # worlds in which levels are compared
    list_seed: int  # of these worlds
    search_episodes: int  # of these worlds, counted from the first, in which the joint optimum is searched
    budget: int  # profiles that the search tries per world and count of harm
    shield: str | None = None  # ``step``: all teams are also evaluated behind the step shield
    sweep: str | None = None  # as text, such as objective=social:0..90:15
    noted: tuple[str, ...] = ()  # settings of scenarios and recipes, for ``config.json``

    def __post_init__(self) -> None:
        for name in FULL:
            check_whole_number(name, getattr(self, name), 1)
        names = [recipe.name for recipe in self.recipes]
        if len(set(names)) < len(names):
            raise InvalidInput(f"recipes {', '.join(names)}: two recipes have the same name; all names must differ")
        if self.shield not in (None, "step"):
            raise InvalidInput(
                f"shield {self.shield!r}: must be 'step', because other shields can control only one vehicle"
            )
        if self.search_episodes > self.episodes:
            raise InvalidInput(
                f"search-episodes = {self.search_episodes}: must be at most the number of worlds, episodes ="
                f" {self.episodes}"
            )
        if not any(level.scenario.learners for level in self.levels):
            raise InvalidInput("levels: no level has a learner; give at least one level with a learner")
        common_worlds(self.levels, 5, self.list_seed)
        list(self.trainings())  # raises InvalidInput for an impossible training

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Names of the compared algorithms, each in the form ``RECIPE-SCHEME``."""
        return tuple(f"{recipe.name}-{recipe.scheme}" for recipe in self.recipes)

    def trainings(self) -> Iterator[tuple[Level, str, int, Training, Path]]:
        """Yield each training, seed by seed: level, algorithm, seed, training and its folder."""
        for seed in range(self.seeds):
            for recipe, algorithm in zip(self.recipes, self.algorithms, strict=True):
                for level in self.levels:
                    learners = len(level.scenario.learners)
                    if not learners:
                        continue
                    changes: dict[str, Any] = {"seed": seed, "total_steps": self.steps_per_learner * learners}
                    name = algorithm
                    if learners == 1:  # schemes are for several learners
                        changes["scheme"] = None
                        name = recipe.name
                    training = Training.of(recipe.replace(**changes), level.scenario)
                    yield (
                        level,
                        algorithm,
                        seed,
                        training,
                        self.folder / "trainings" / f"{level.name}-{name}-seed{seed}",
                    )

    def settings_of(self, level: Level) -> tuple[str, ...]:
        """Return the settings that a level's trainings record."""
        return self.noted if level.swept is None else (*self.noted, level.swept.setting)

    def settings(self) -> dict[str, Any]:
        """Return all settings that affect the results."""
        return {
            "levels": [level.scenario.content(without=WORDS) for level in self.levels],
            "recipes": [recipe.model_dump(mode="json", exclude=set(WORDS)) for recipe in self.recipes],
            **{name: getattr(self, name) for name in (*FULL, "list_seed", "shield")},
        }

    def study_folder(self) -> StudyFolder:
        """Return the folder, which refuses results of other settings."""
        advice = f"give another folder (--output); to reuse its trained policies, give a copy without {SETTINGS}"
        return StudyFolder(
            self.folder, "an ablation", self.settings(), record=SETTINGS, advice=advice, writes=(JSON, CSV, FIGURE)
        )
