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

NO_SETTING = {"name", "title", "description", "source"}  # words, which cannot be set


class Settings(NamedTuple):
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
) -> Settings:
    """Sort the settings ``KEY=VALUE`` of a command by what they change: scenario, recipe or the command itself.

    ``recipe_keys`` and ``of_command`` are the keys of the recipe and of the command. A key that scenario and recipe
    share is written ``scenario.KEY`` or ``recipe.KEY``. Raises ``UnknownName`` for an unknown key, and ``InvalidInput``
    for an ambiguous key or a bad value.
    """
    known = {"scenario": {*Scenario.model_fields} - NO_SETTING, "recipe": {*recipe_keys} - NO_SETTING}
    known["command"] = {*of_command}
    known["command"] |= {"rules"} if recipe_keys or "harm_count" in of_command else set()
    found: dict[str, list[Override]] = {owner: [] for owner in known}
    given = Override.parse(texts or ())
    for override in given:
        if override.key == "rules" and "rules" in known["command"]:
            owner = "recipe" if recipe_keys else "command"
            found[owner].append(_counted(override, given, owner))
            continue
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


def _counted(rules: Override, given: Sequence[Override], owner: str) -> Override:
    """Setting for which ``rules=NAME`` is short: ``reward.harm_count`` of a recipe, else ``harm_count``.

    ``owner`` is ``recipe`` or another owner of settings. Raises ``InvalidInput`` for an unknown NAME, and if one of the
    settings ``given`` sets the same.
    """
    name, path = rules.value, ("reward", "harm_count") if owner == "recipe" else ("harm_count",)
    if not isinstance(name, str) or name not in SHORT_NAMES:
        raise InvalidInput(f"--set rules={flow_text(name, 60)}: must be {' or '.join(SHORT_NAMES)}")
    for other in given:
        inside = other.path[1:] if owner == other.top == "recipe" else other.path
        if inside and inside == path[: len(inside)]:
            raise InvalidInput(
                f"--set rules: sets {'.'.join(path)}, which --set {other.key} sets, too; leave one of them out"
            )
    return Override(rules.text, path, SHORT_NAMES[name])
