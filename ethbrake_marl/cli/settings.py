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

NO_SETTING = {"name", "title", "description", "source", "scenario"}  # which cannot be set


class CommandSettings(NamedTuple):
    texts: tuple[str, ...]  # as written
    scenario: list[Override]
    recipe: list[Override]
    command: Mapping[str, Any]  # such as harm_count: total

    def change_scenario(self, name_or_path: str) -> Scenario:
        scenario = load_scenario(name_or_path)
        if not self.scenario:
            return scenario
        content = scenario.model_dump(mode="json", exclude_none=True) | scenario.declared()
        return scenario.replace(**Override.put(content, self.scenario))

    def change_recipe(self, recipe: TrainingRecipe) -> TrainingRecipe:
        return recipe.replace(**Override.put(recipe.model_dump(mode="json"), self.recipe)) if self.recipe else recipe


def read_settings(
    texts: Sequence[str] | None, recipe_keys: Sequence[str] = (), of_command: Sequence[str] = ()
) -> CommandSettings:
    """A key of both scenario and recipe is written ``scenario.KEY`` or ``recipe.KEY``. Raises ``UnknownName`` for an
    unknown key, and ``InvalidInput`` for an ambiguous key or a bad value.
    """
    valid_keys = {"scenario": {*Scenario.model_fields} - NO_SETTING, "recipe": {*recipe_keys} - NO_SETTING}
    valid_keys["command"] = {*of_command}
    by_owner: dict[str, list[Override]] = {owner: [] for owner in valid_keys}
    overrides = Override.parse(texts or ())
    for override in overrides:
        if override.key == "rules" and (recipe_keys or "harm_count" in of_command):
            name = "first" if override.value == "paper" else "honest"
            raise InvalidInput(f"--set {override.text}: rules has ended; write --set harm_count={name}")
        if override.key == "harm_count" and recipe_keys:
            by_owner["recipe"].append(_of_reward(override, overrides))
            continue
        named = override.top in ("scenario", "recipe") and len(override.path) > 1
        if named and override.top == "recipe" and not recipe_keys:
            raise InvalidInput(f"--set {override.key}: this command uses no recipe; remove this setting")
        candidates, inside = ([override.top], override.inside()) if named else ([*valid_keys], override)
        owners = [owner for owner in candidates if inside.top in valid_keys[owner]]
        if not owners:
            raise unknown_name("setting", inside.top, {key for owner in candidates for key in valid_keys[owner]})
        if len(owners) > 1:
            raise InvalidInput(
                f"--set {override.key}: both scenario and recipe have this key; write scenario.{override.key} or"
                f" recipe.{override.key}"
            )
        by_owner[owners[0]].append(inside)
    command = {setting.top: setting.value for setting in by_owner["command"]}
    return CommandSettings(tuple(texts or ()), by_owner["scenario"], by_owner["recipe"], command)


def _of_reward(count: Override, overrides: Sequence[Override]) -> Override:
    """Raises ``InvalidInput`` if one of ``overrides`` changes the same key."""
    for override in overrides:
        path = override.path[1:] if override.top == "recipe" else override.path
        if path in (("reward",), ("reward", "harm_count")):
            raise InvalidInput(
                f"--set harm_count: sets reward.harm_count, which --set {override.key} sets, too; leave one of them out"
            )
    return Override(count.text, ("reward", "harm_count"), count.value)
