"""Scenarios and recipes as strangers write them: every way to be no YAML, the wrong YAML, or YAML with wrong values."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.scenario import load_scenario
from tests.hostile.case import Case, damaged, write
from tests.hostile.recipe_parts import RECIPE_PARTS
from tests.hostile.yaml_changes import CERTAIN, SCENARIO_ONLY, UNCERTAIN, encoded
from tests.hostile.yaml_parts import RECIPE, SAC, SCENARIO, replaced


def scenarios(rng: random.Random) -> Iterator[Case]:
    """Scenario files: 25 of each category."""
    for certain, changes in ((True, CERTAIN), (False, UNCERTAIN)):
        for category, change in changes.items():
            for _ in range(25):
                yield _scenario(category, encoded(rng, category, change(rng, SCENARIO)), certain)
    for category, (certain, change) in SCENARIO_ONLY.items():
        for _ in range(25):
            yield _scenario(category, change(rng, SCENARIO), certain)
    for _ in range(75):
        yield _scenario("damaged", damaged(rng, SCENARIO.encode()), False)


def recipes(rng: random.Random) -> Iterator[Case]:
    """Recipe files: 28 of each category, of PPO and of SAC (which is not complete, so it is never in order)."""
    for certain, changes in ((True, CERTAIN), (False, UNCERTAIN)):
        for category, change in changes.items():
            for k in range(28):
                text = SAC if k % 4 == 3 else RECIPE
                yield _recipe(category, encoded(rng, category, change(rng, text)), certain)
    for category, (old, others) in RECIPE_PARTS.items():
        yield from (_recipe(category, replaced(RECIPE, old, other), True) for other in others)
    for _ in range(75):
        yield _recipe("damaged", damaged(rng, RECIPE.encode()), False)


def _scenario(category: str, content: bytes | str, certain: bool) -> Case:
    return Case(
        "scenario",
        category,
        ("scenario", "validate", "mine.yaml"),
        lambda folder: write(folder / "mine.yaml", content),
        certain=certain,
        reader=lambda: load_scenario("mine.yaml"),
        content=content,
    )


def _recipe(category: str, content: bytes | str, certain: bool) -> Case:
    def build(folder: Path) -> None:
        write(folder / "mine.yaml", content)
        write(folder / "taken", "precious")

    # The output is taken: a recipe in order is refused for that, before anything is trained.
    command = ("train", "--recipe", "mine.yaml", "--output", "taken")
    return Case(
        "recipe", category, command, build, certain=certain, reader=lambda: load_recipe("mine.yaml"), content=content
    )
