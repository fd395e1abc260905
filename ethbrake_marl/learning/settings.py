"""Settings ``key=value``: which are the scenario's and which the recipe's, and what belongs together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.overrides import Override, changed_parts, parse_overrides
from ethbrake_marl.learning.recipe import WORDS, TrainingRecipe
from ethbrake_marl.scenario import Scenario

_NO_SETTING = {"name", *WORDS}  # they tell about a file, and change nothing
_TOGETHER = (("gamma", "reward.shaping_discount"),)  # keys of a recipe whose values must be equal


class Settings(NamedTuple):
    """What is asked for."""

    texts: tuple[str, ...]  # as they were given
    scenario: tuple[Override, ...]
    recipe: tuple[Override, ...]

    def change(self, recipe: TrainingRecipe, tell: Callable[[str], None] | None = None) -> TrainingRecipe:
        """The recipe with those of its settings that it has; ``tell`` hears what else may have to be changed."""
        own = [override for override in self.recipe if override.top in type(recipe).model_fields]
        if not own:
            return recipe
        changed = recipe.replace(**changed_parts(recipe.model_dump(mode="json"), own))
        if tell is not None:
            for note in unpaired_settings(changed, own):
                tell(f"note: {note}")
        return changed


def read_settings(texts: Sequence[str] | None, recipes: Sequence[TrainingRecipe] = ()) -> Settings:
    """Tell the settings apart: ``mass_t=40`` and ``scenario.mass_t=40`` are the scenario's, ``gamma=0.9`` a recipe's.

    Raises ``UnknownName`` with a suggestion for a key that neither has.
    """
    known = {
        "scenario": {*Scenario.model_fields} - _NO_SETTING,
        "recipe": {key for recipe in recipes for key in type(recipe).model_fields} - _NO_SETTING,
    }
    found: dict[str, list[Override]] = {"scenario": [], "recipe": []}
    for override in parse_overrides(texts or ()):
        if override.top == "recipe" and len(override.path) > 1 and not recipes:
            raise InvalidInput(f"--set {override.key}: this command takes no recipe, so nothing of one can be set")
        whose = [override.top] if override.top in known and len(override.path) > 1 else [*known]
        inside = override.inside() if whose == [override.top] else override
        owners = [each for each in whose if inside.top in known[each]]
        if not owners:
            raise unknown_name("setting", inside.top, {key for each in whose for key in known[each]})
        if len(owners) > 1:
            raise InvalidInput(f"--set {override.key}: write scenario.{override.key} or recipe.{override.key}")
        found[owners[0]].append(inside)
    return Settings(tuple(texts or ()), tuple(found["scenario"]), tuple(found["recipe"]))


def unpaired_settings(recipe: TrainingRecipe, overrides: Sequence[Override]) -> list[str]:
    """What must be said of settings that belong together where only one was changed, and they differ now."""
    keys = {override.key for override in overrides}
    values = {"gamma": recipe.gamma, "reward.shaping_discount": recipe.reward.shaping_discount}
    notes = []
    for pair in _TOGETHER:
        given = [key for key in pair if key in keys]
        if len(given) == 1 and values[pair[0]] != values[pair[1]]:
            (other,) = set(pair) - set(given)
            notes.append(
                f"{given[0]} = {values[given[0]]:g}, but {other} stays {values[other]:g}: shaping leaves the best"
                f" policy as it is only where both are equal (--set {other}={values[given[0]]:g})"
            )
    return notes
