"""The levels of cooperation that an ablation compares: scenarios with the same vehicles, gaps and speeds.

Levels may differ in who learns, who has which information, whose harm counts, and whether an obstacle is ahead. A
*sweep* compares copies of one level that differ in the value of one key.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.cli.settings import CommandSettings
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.training.recipe import TrainingRecipe
from ethbrake_marl.worlds.describe import quantities_of
from ethbrake_marl.worlds.sampling import DrawnWorlds
from ethbrake_marl.worlds.scenario import Scenario

STANDARD = ("level-0-sensors", "level-1-messages", "level-2-own", "level-3-line", "level-4-pair", "level-5-all")
SWEEP_LEVEL = "cooperation-3-pair"  # default level of a sweep

SHARED_KEYS = ("vehicles", "time_step_s", "horizon_s", "observation")  # keys that are the same at all levels
MAY_DIFFER = "obstacle_gap_m"  # column of the worlds in which levels may differ
SAME_VEHICLES = ("objective", "obstacle_gap_m", "roles", "v2x")  # keys whose sweep leaves the vehicles as they are

MOST_VALUES = 100  # values of a sweep, such as ``objective=social:0..90:15`` (0, 15, ..., 90 degrees)
NUMBER_PATTERN = r"-?\d+(?:\.\d+)?"
ITEM = re.compile(rf"(?P<low>{NUMBER_PATTERN})(?:\.\.(?P<high>{NUMBER_PATTERN}):(?P<step>{NUMBER_PATTERN}))?", re.ASCII)
WORD = re.compile(r"\s*([A-Za-z][\w-]*:)?", re.ASCII)


class Swept(NamedTuple):
    """The key of a scenario that a sweep varies, with one of its values."""

    key: str  # such as v2x.silent_links
    word: str  # text before the number in the value, such as ``social:``; usually empty
    text: str  # the number

    @property
    def number(self) -> float:
        return float(self.text)

    @property
    def setting(self) -> str:
        return f"{self.key}={self.word}{self.text}"

    @property
    def axis(self) -> str:
        return f"{self.key} = {self.word}…" if self.word else self.key

    @property
    def label(self) -> str:
        """Suffix of the level's name, such as ``social-15`` or ``v2x.silent_links-0.1``."""
        return f"{self.word.rstrip(':') or self.key}-{self.text}"


class Level(NamedTuple):
    """One scenario of an ablation, and the name of the level with which it is compared."""

    name: str  # of the scenario; in a sweep followed by the swept value, such as ``cooperation-3-pair-social-15``
    scenario: Scenario
    before: str | None = None  # name of the level with which it is compared
    swept: Swept | None = None

    @property
    def same_vehicles(self) -> bool:
        """Whether world k has the same vehicles at all levels."""
        return self.swept is None or self.swept.key.partition(".")[0] in SAME_VEHICLES


def read_levels(names: Sequence[str], settings: CommandSettings) -> list[Level]:
    """Load the levels of an ablation; each is compared with the previous level.

    Raises ``InvalidInput`` for fewer than two levels, or if a level is repeated.
    """
    levels: list[Level] = []
    for name in names:
        scenario = settings.change_scenario(name)
        if any(level.name == scenario.name for level in levels):
            raise InvalidInput(f"levels: {scenario.name!r} is given twice; give each level once")
        levels.append(Level(scenario.name, scenario, levels[-1].name if levels else None))
    if len(levels) < 2:
        raise InvalidInput(f"levels: {count_of(len(levels), 'level')} given; give at least two levels to compare")
    return levels


def sweep_levels(name: str, sweep: str, settings: CommandSettings, recipes: Sequence[TrainingRecipe]) -> list[Level]:
    """One level for each value of a sweep, in ascending order; each is compared with the previous level."""
    values, levels = parse_sweep(sweep), list[Level]()
    key = values[0].key
    path = tuple(key.removeprefix("scenario.").split("."))
    if path[0] not in Scenario.model_fields:
        raise InvalidInput(
            f"--sweep {key}: only a key of a scenario can be swept; to vary a recipe, write a recipe for each value,"
            " and use train/benchmark/run.py"
        )
    if path[0] in SHARED_KEYS:
        raise InvalidInput(
            f"--sweep {key}: levels with different values of {path[0]} cannot be compared; for each value of {path[0]},"
            f" run the command once, with --set {path[0]}=... and an --output of its own"
        )
    if any(override.path[: len(path)] == path for override in settings.scenario):
        raise InvalidInput(f"--sweep {key}: --set changes the same key; leave out --sweep or --set")
    for recipe in recipes if path[0] == "objective" else ():
        if recipe.reward.objective is not None:
            raise InvalidInput(
                f"--sweep {key}: the sweep has no effect, because recipe {recipe.name!r} has its own objective"
                " (reward.objective); give a recipe without an objective"
            )
    for value in (swept._replace(key=".".join(path)) for swept in values):
        changed = settings._replace(scenario=[*settings.scenario, *Override.parse([value.setting])])
        scenario = changed.change_scenario(name)
        before = levels[-1].name if levels else None
        levels.append(Level(f"{scenario.name}-{value.label}", scenario, before, value))
    return levels


def parse_sweep(text: str) -> list[Swept]:
    """Read a sweep ``KEY=LOW..HIGH:STEP`` or ``KEY=A,B,...``; return its values in ascending order.

    A word may precede the numbers, as in ``objective=social:0..90:15``. Raises ``InvalidInput`` for any other text, a
    range that is no multiple of its step, a repeated number, and fewer than 2 or more than ``MOST_VALUES`` numbers.
    """
    key, equals, values = (part.strip() for part in text.partition("="))
    match = WORD.match(values)
    word, numbers = (match[1] or "" if match else ""), list[Decimal]()
    for item in values.split(","):
        parsed = ITEM.fullmatch(item.strip().removeprefix(word).strip())
        if not (key and equals and parsed):
            raise InvalidInput(
                f"--sweep {text!r:.200}: must be KEY=LOW..HIGH:STEP or KEY=A,B,... with numbers, for instance"
                " objective=social:0..90:15 or v2x.silent_links=0,0.1,0.3; for other values, give scenarios with"
                " --levels"
            )
        low, high, step = (Decimal(part or 0) for part in parsed.group("low", "high", "step"))
        steps = (high - low) / step if step > 0 else Decimal(0)
        if parsed["step"] is not None and (not 0 < steps < MOST_VALUES or steps % 1):
            raise InvalidInput(
                f"--sweep {key}: range {item.strip()}: a range LOW..HIGH:STEP must go up from LOW to HIGH in 1 to"
                f" {MOST_VALUES - 1} equal steps, for instance 0..90:15"
            )
        numbers += [low + k * step for k in range(int(steps) + 1)]
    if not 2 <= len(numbers) <= MOST_VALUES:
        raise InvalidInput(f"--sweep {key}: has {count_of(len(numbers), 'number')}; give 2 to {MOST_VALUES} numbers")
    if twice := [number for number in numbers if numbers.count(number) > 1]:
        raise InvalidInput(f"--sweep {key}: {twice[0]} is given twice; give each number once")
    return [Swept(key, word, f"{number.normalize():f}") for number in sorted(numbers)]


def common_worlds(levels: Sequence[Level], episodes: int, seed: int) -> list[DrawnWorlds]:
    """Worlds of each level; world k has the same line of vehicles at all levels (in a sweep the same random numbers).

    Raises ``InvalidInput`` for levels that differ in more than obstacles, weights of harm and, with another ``v2x``,
    latencies.
    """
    drawn_by_level = [level.scenario.draw(episodes, seed) for level in levels]
    if not levels[0].same_vehicles:
        return drawn_by_level
    all_quantities = [_quantities(*pair) for pair in zip(levels, drawn_by_level, strict=True)]
    for k, level in enumerate(levels):
        alike = next(j for j in range(k + 1) if levels[j].scenario.v2x == level.scenario.v2x)
        for key in dict.fromkeys([*all_quantities[0], *all_quantities[k]]):
            reference = alike if key.startswith("latency") else 0
            here, there = (all_quantities[j].get(key, np.array(["not set"])) for j in (k, reference))
            if not np.array_equal(here, there):
                differs = here != there
                world = int(np.argmax(differs)) if np.shape(differs) == here.shape else 0
                raise InvalidInput(
                    f"level {level.name!r}: {key} is {here[world]}, but {there[world]} at level"
                    f" {levels[reference].name!r}; levels may differ only in roles, objective, obstacle_gap_m, v2x and,"
                    " where v2x differs, latency_s; change or leave out one of the two levels"
                )
    return drawn_by_level


def _quantities(level: Level, drawn_worlds: DrawnWorlds) -> dict[str, Any]:
    keys = {key: np.array([str(getattr(level.scenario, key))]) for key in SHARED_KEYS}
    columns = quantities_of(drawn_worlds.worlds)
    return keys | {name: column for name, column in columns.items() if name != MAY_DIFFER}
