"""Settings ``key=value``: which ones belong to the scenario, to the recipe or to the agents."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from ethbrake_marl.agents.spec import split_names
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.game.harm import HarmCount, check_harm_count
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.recipe import WORDS, TrainingRecipe

_NO_SETTING = {"name", *WORDS}  # descriptive fields, which cannot be set


class Settings(NamedTuple):
    """Settings ``KEY=VALUE`` of a command, sorted by whether they belong to scenario, recipe or agents."""

    texts: tuple[str, ...]  # the settings as the user wrote them
    scenario: tuple[Override, ...]  # keys of the scenario and their values
    recipe: tuple[Override, ...]  # keys of the recipe and their values
    harm_count: HarmCount = "first"  # harm that agents minimise: first impacts only, or all (``total``)
    measures: tuple[str, ...] = ()  # names of additional measures of an evaluation

    def change(self, recipe: TrainingRecipe, tell: Callable[[str], None] | None = None) -> TrainingRecipe:
        """Return the recipe with the values of ``self.recipe`` for those keys that its class has.

        ``tell`` is called with a note for the user if only one of ``gamma`` and ``reward.shaping_discount``, which
        should be equal, was set.
        """
        own = [override for override in self.recipe if override.top in type(recipe).model_fields]
        if not own:
            return recipe
        changed = recipe.replace(**Override.put(recipe.model_dump(mode="json"), own))
        together = {"gamma": changed.gamma, "reward.shaping_discount": changed.reward.shaping_discount}
        changed_keys = [key for key in together if key in {override.key for override in own}]
        if tell is not None and len(changed_keys) == 1 and len({*together.values()}) > 1:
            (key,), (other,) = changed_keys, together.keys() - set(changed_keys)
            tell(
                f"note: {key} = {together[key]:g}, but {other} stays {together[other]:g}: shaping leaves the best"
                f" policy as it is only where both are equal (--set {other}={together[key]:g})"
            )
        return changed


def read_settings(
    texts: Sequence[str] | None, recipes: Sequence[TrainingRecipe] = (), *, of_agents: Sequence[str] = ()
) -> Settings:
    """Parse the settings of a command, and sort them by whether they belong to scenario, recipe or agents.

    ``mass_t=40`` and ``scenario.mass_t=40`` belong to the scenario, ``gamma=0.9`` to a recipe.

    Args:
        texts: settings ``KEY=VALUE`` as the user wrote them; None: none.
        recipes: recipes of the command, whose keys may be set.
        of_agents: which of ``harm_count`` and ``measures`` the command allows.

    Raises ``UnknownName`` with a suggestion for an unknown key, ``InvalidInput`` for an unknown harm count.

    """
    known = {
        "scenario": {*Scenario.model_fields} - _NO_SETTING,
        "recipe": {key for recipe in recipes for key in type(recipe).model_fields} - _NO_SETTING,
        "agents": {*of_agents},
    }
    of_owner: dict[str, list[Override]] = {owner: [] for owner in known}
    for override in Override.parse(texts or ()):
        if override.top == "recipe" and len(override.path) > 1 and not recipes:
            raise InvalidInput(f"--set {override.key}: this command takes no recipe, so nothing of one can be set")
        whose = [override.top] if override.top in known and len(override.path) > 1 else [*known]
        inside = override.inside() if whose == [override.top] else override
        owners = [each for each in whose if inside.top in known[each]]
        if not owners:
            raise unknown_name("setting", inside.top, {key for each in whose for key in known[each]})
        if len(owners) > 1:
            raise InvalidInput(f"--set {override.key}: write scenario.{override.key} or recipe.{override.key}")
        of_owner[owners[0]].append(inside)
    asked = {each.top: each.value for each in of_owner["agents"]}
    check_harm_count(count := asked.get("harm_count", "first"))
    measures = asked.get("measures", "")
    if not isinstance(measures, str) or ("measures" in asked and not measures):
        raise InvalidInput("--set measures: must be names with commas between them, for instance measures=injury")
    return Settings(
        tuple(texts or ()),
        tuple(of_owner["scenario"]),
        tuple(of_owner["recipe"]),
        count,
        tuple(split_names(measures)) if measures else (),
    )
