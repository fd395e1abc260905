"""``--set KEY=VALUE``: which settings belong to the scenario, the recipe, or the command itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario

if TYPE_CHECKING:
    from ethbrake_marl.training.recipe import TrainingRecipe

NO_SETTING = {"name", "title", "description", "source"}  # words, which cannot be set


class Settings(NamedTuple):
    """Settings of a command, by their owner."""

    texts: tuple[str, ...]  # as written
    scenario: list[Override]
    recipe: list[Override]
    command: Mapping[str, Any]  # such as harm_count: total

    def change_scenario(self, name_or_path: str) -> Scenario:
        """Return the scenario with these settings."""
        scenario = load_scenario(name_or_path)
        if not self.scenario:
            return scenario
        content = scenario.model_dump(mode="json", exclude_none=True) | scenario.declared()
        return scenario.replace(**Override.put(content, self.scenario))

    def change_recipe(self, recipe: TrainingRecipe) -> TrainingRecipe:
        """Return the recipe with these settings."""
        return recipe.replace(**Override.put(recipe.model_dump(mode="json"), self.recipe)) if self.recipe else recipe


def read_settings(
    texts: Sequence[str] | None, recipe_keys: Sequence[str] = (), of_command: Sequence[str] = ()
) -> Settings:
    """Return the settings ``KEY=VALUE`` of a command, by their owner.

    A key that the scenario and the recipe share is written ``scenario.KEY`` or ``recipe.KEY``. Raises ``UnknownName``
    for an unknown key, and ``InvalidInput`` for an ambiguous one or a bad value.
    """
    known = {"scenario": {*Scenario.model_fields} - NO_SETTING, "recipe": {*recipe_keys} - NO_SETTING}
    known["command"] = {*of_command}
    found: dict[str, list[Override]] = {owner: [] for owner in known}
    for override in Override.parse(texts or ()):
        named = override.top in ("scenario", "recipe") and len(override.path) > 1
        if named and override.top == "recipe" and not recipe_keys:
            raise InvalidInput(f"--set {override.key}: this command uses no recipe; remove this setting")
        whose, inside = ([override.top], override.inside()) if named else ([*known], override)
        owners = [owner for owner in whose if inside.top in known[owner]]
        if not owners:
            raise unknown_name("setting", inside.top, {key for owner in whose for key in known[owner]})
        if len(owners) > 1:
            raise InvalidInput(
                f"--set {override.key}: both scenario and recipe have this key; write scenario.{override.key} or"
                f" recipe.{override.key}"
            )
        found[owners[0]].append(inside)
    command = {each.top: each.value for each in found["command"]}
    return Settings(tuple(texts or ()), found["scenario"], found["recipe"], command)
