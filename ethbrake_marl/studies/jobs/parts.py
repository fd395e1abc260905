"""Scenario and recipe of a job that a file asks for, and which part of it a refusal is about."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.inputs import load_runnable
from ethbrake_marl.learning.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.learning.settings import read_settings
from ethbrake_marl.scenario import Scenario, load_scenario


def load_parts(scenario: str, recipe: str, settings: Sequence[str]) -> tuple[Scenario, TrainingRecipe]:
    """Scenario and recipe, each a name or a path, with the settings ``KEY=VALUE`` in them.

    Raises ``InvalidInput`` for what is not known, and for a value that is not allowed.
    """
    loaded = load_recipe(recipe)
    given = read_settings(settings, [loaded])
    return load_runnable(scenario, given.scenario), given.change(loaded)


def refused_part(scenario: str, recipe: str, settings: Sequence[str]) -> str:
    """The part that is refused by itself where ``load_parts`` refuses: ``recipe``, ``scenario`` or a setting's key.

    Empty where each by itself is in order.
    """
    tried: dict[str, Callable[[], object]] = {
        "recipe": partial(load_recipe, recipe),
        "scenario": partial(load_scenario, scenario),
        **{text.partition("=")[0]: partial(load_parts, scenario, recipe, (text,)) for text in settings},
    }
    for part, load in tried.items():
        try:
            load()
        except InvalidInput:
            return part
    return ""
