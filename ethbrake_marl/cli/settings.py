"""``--set KEY=VALUE``: which settings belong to the scenario, the recipe, or the command itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from ethbrake_marl.episode.counts import SHORT_NAMES
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario

if TYPE_CHECKING:
    from ethbrake_marl.training.recipe import TrainingRecipe

NO_SETTING = {"name", "title", "description", "source", "scenario"}  # which cannot be set


class CommandSettings(NamedTuple):
    """Settings (``--set``) of a command, sorted by what they change."""

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
    """Sort the settings ``KEY=VALUE`` of a command by what they change: the scenario, the recipe or the command itself.

    ``recipe_keys``, ``of_command``: valid keys of the recipe, and of the command. A key of both scenario and recipe is
    written ``scenario.KEY`` or ``recipe.KEY``. Raises ``UnknownName`` for an unknown key, and ``InvalidInput`` for an
    ambiguous key or a bad value.
    """
    valid_keys = {"scenario": {*Scenario.model_fields} - NO_SETTING, "recipe": {*recipe_keys} - NO_SETTING}
    valid_keys["command"] = {*of_command}
    valid_keys["command"] |= {"rules"} if recipe_keys or "harm_count" in of_command else set()
    by_owner: dict[str, list[Override]] = {owner: [] for owner in valid_keys}
    overrides = Override.parse(texts or ())
    for override in overrides:
        if override.key == "rules" and "rules" in valid_keys["command"]:
            owner = "recipe" if recipe_keys else "command"
            by_owner[owner].append(_expand_rules(override, overrides, owner))
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


def _expand_rules(rules: Override, overrides: Sequence[Override], owner: str) -> Override:
    """The setting that ``rules=NAME`` abbreviates: ``reward.harm_count`` of a recipe, else ``harm_count``.

    ``owner``: what the setting changes, such as ``recipe``. Raises ``InvalidInput`` for an unknown NAME, and if one of
    ``overrides`` changes the same key.
    """
    name, path = rules.value, ("reward", "harm_count") if owner == "recipe" else ("harm_count",)
    if not isinstance(name, str) or name not in SHORT_NAMES:
        raise InvalidInput(f"--set rules={flow_text(name, 60)}: must be {' or '.join(SHORT_NAMES)}")
    for override in overrides:
        inside = override.path[1:] if owner == override.top == "recipe" else override.path
        if inside and inside == path[: len(inside)]:
            raise InvalidInput(
                f"--set rules: sets {'.'.join(path)}, which --set {override.key} sets, too; leave one of them out"
            )
    return Override(rules.text, path, SHORT_NAMES[name])
