"""Settings ``KEY=VALUE`` of a command (``--set``): parse them, and sort them by scenario, recipe and agents."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.first_edition.agents.spec import split_names
from ethbrake_marl.first_edition.game.harm import HarmCount, check_harm_count
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.training.recipe import WORDS, TrainingRecipe

_NO_SETTING = {"name", *WORDS}  # descriptive keys, which cannot be set


class Settings(NamedTuple):
    """Settings ``KEY=VALUE`` of a command, sorted by whether they belong to scenario, recipe or agents."""

    texts: tuple[str, ...]  # the settings as the user wrote them
    scenario: tuple[Override, ...]  # keys of the scenario and their new values
    recipe: tuple[Override, ...]  # keys of the recipe and their new values
    harm_count: HarmCount = "first"  # impacts whose harm agents minimise: first impacts (``first``) or all (``total``)
    measures: tuple[str, ...] = ()  # names of additional measures that an evaluation reports

    def change(self, recipe: TrainingRecipe, tell: Callable[[str], None] | None = None) -> TrainingRecipe:
        """Return the recipe with the values that ``self.recipe`` sets; keys that the recipe does not have are ignored.

        ``tell`` is called with a note for the user if ``gamma`` and ``reward.shaping_discount`` differ because only one
        of them was set (they should be equal).
        """
        own = [override for override in self.recipe if override.top in type(recipe).model_fields]
        if not own:
            return recipe
        changed = recipe.replace(**Override.put(recipe.model_dump(mode="json"), own))
        together = {"gamma": changed.gamma, "reward.shaping_discount": changed.reward.shaping_discount}
        set_here = [key for key in together if key in {override.key for override in own}]
        if tell is not None and len(set_here) == 1 and len({*together.values()}) > 1:
            (key,), (other,) = set_here, together.keys() - set(set_here)
            tell(
                f"note: {key} = {together[key]:g} differs from {other} = {together[other]:g}. Reward shaping then"
                f" changes which policy is best; make both equal (--set {other}={together[key]:g})"
            )
        return changed


def read_settings(
    texts: Sequence[str] | None, recipes: Sequence[TrainingRecipe] = (), *, of_agents: Sequence[str] = ()
) -> Settings:
    """Parse the settings of a command, and sort them by whether they belong to scenario, recipe or agents.

    For instance, ``mass_t=40`` and ``scenario.mass_t=40`` belong to the scenario, ``gamma=0.9`` to a recipe.
    ``recipes`` are the recipes whose keys may be set. ``of_agents`` has the names of the settings of agents that the
    command allows, such as ``harm_count``. Raises ``UnknownName`` for an unknown key, and
    ``InvalidInput`` for an ambiguous key or an invalid value.
    """
    known = {
        "scenario": {*Scenario.model_fields} - _NO_SETTING,
        "recipe": {key for recipe in recipes for key in type(recipe).model_fields} - _NO_SETTING,
        "agents": {*of_agents},
    }
    by_owner: dict[str, list[Override]] = {owner: [] for owner in known}
    for override in Override.parse(texts or ()):
        if override.top == "recipe" and len(override.path) > 1 and not recipes:
            raise InvalidInput(f"--set {override.key}: this command uses no recipe; remove this setting")
        whose = [override.top] if override.top in known and len(override.path) > 1 else [*known]
        inside = override.inside() if whose == [override.top] else override
        owners = [each for each in whose if inside.top in known[each]]
        if not owners:
            raise unknown_name("setting", inside.top, {key for each in whose for key in known[each]})
        if len(owners) > 1:
            raise InvalidInput(
                f"--set {override.key}: both scenario and recipe have this key; write scenario.{override.key} or"
                f" recipe.{override.key}"
            )
        by_owner[owners[0]].append(inside)
    for_agents = {each.top: each.value for each in by_owner["agents"]}
    check_harm_count(count := for_agents.get("harm_count", "first"))
    measures = for_agents.get("measures", "")
    if not isinstance(measures, str) or ("measures" in for_agents and not measures):
        raise InvalidInput(
            "--set measures: must be one or more names of measures, with commas between them, for instance"
            " measures=injury"
        )
    return Settings(
        tuple(texts or ()),
        tuple(by_owner["scenario"]),
        tuple(by_owner["recipe"]),
        count,
        tuple(split_names(measures)) if measures else (),
    )
