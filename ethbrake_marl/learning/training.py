"""A training, resolved once: what a recipe and a scenario come to, and the one answer to "is this the same training?".

Two trainings are the same where recipe (its seed included) and scenario say the same; titles, descriptions and sources
are words and count for nothing, nor does it matter whether a default is spelt out. Learning curves and ablations ask
before they keep a finished training or go on with one, ``resume`` asks whether a checkpoint belongs to what
``config.json`` says.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.messages import first_mistake
from ethbrake_marl.files.plugins import check_plugins, noted_plugins
from ethbrake_marl.learning.recipe import WORDS, Scheme, TrainingRecipe, load_recipe, recipe_of
from ethbrake_marl.learning.run_folder import RunDirectory, read_object
from ethbrake_marl.learning.schemes import drivers, scheme_of
from ethbrake_marl.observations import ObservationSpec, choose_observation, observation_for
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.scenario import Scenario, load_scenario

Content = dict[str, dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Training:
    """All that a training is before it begins; made by ``resolve``."""

    recipe: TrainingRecipe
    scenario: Scenario
    scheme: Scheme
    drivers: Mapping[str, str]  # learner, front to rear -> where in the run's folder its bundle will stand
    observation: ObservationSpec  # of every learner
    identity: str  # SHA-256 of all that makes it what it is, in hexadecimal digits

    def config(self) -> dict[str, Any]:
        """What ``config.json`` says of it."""
        recipe = self.recipe
        return {
            "recipe": recipe.model_dump(mode="json"),
            "scenario": self.scenario.model_dump(mode="json", exclude_unset=True),  # as in its file: defaults may clash
            "seeds": {"training": recipe.seed, "evaluation": recipe.evaluation.seed},
            "versions": installed_versions(),
            "plugins": noted_plugins(),
            **recipe.facts,
        }


def resolve(recipe: TrainingRecipe | str | Path, scenario: Scenario | str | Path, **changes: Any) -> Training:
    """The training of a recipe on a scenario, both given or by name or path; ``changes`` override the recipe.

    Raises ``InvalidInput`` where they do not fit each other: nobody learns, or the scheme is for others.
    """
    recipe = recipe if isinstance(recipe, TrainingRecipe) else load_recipe(recipe)
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    recipe = recipe.replace(**changes) if changes else recipe
    scheme = scheme_of(recipe, scenario)
    recipe.check_learners(len(scenario.learners))
    identity = training_identity(training_content(recipe, scenario))
    return Training(recipe, scenario, scheme, drivers(scheme, scenario), observation_of(recipe, scenario), identity)


def observation_of(recipe: TrainingRecipe, scenario: Scenario) -> ObservationSpec:
    """What learners observe: what the recipe says; where it says nothing, what the scenario says."""
    if recipe.observation is None:
        return observation_for(scenario)
    return choose_observation(recipe.observation, scenario.time_step_s)


def training_in(folder: Path, config: Mapping[str, Any]) -> Training:
    """The training of the configuration of the run in ``folder``.

    Raises ``InvalidInput`` naming what is wrong with it, and for a training of another library.
    """
    file = RunDirectory(folder).config
    if "library" in config:
        raise InvalidInput(
            f"{folder}: was trained by {config['library']}, which leaves nothing to go on from; train again"
        )
    try:
        recipe = recipe_of(json.dumps(config["recipe"]))
        scenario = Scenario.model_validate_json(json.dumps(config["scenario"]))
    except KeyError as error:
        raise InvalidInput(f"{file}: is not the configuration of a training: {error} is missing") from None
    except ValidationError as error:
        raise InvalidInput(f"{file}: scenario: {first_mistake(error)}") from None
    except InvalidInput as error:
        raise InvalidInput(f"{file}: {error}") from None
    return resolve(recipe, scenario)


def check_run_plugins(folder: Path, config: Mapping[str, Any], advice: str) -> None:
    """Raise ``InvalidInput``, ending in ``advice``, unless the plug-ins of this process are those of this run."""
    check_plugins(config.get("plugins", []), str(RunDirectory(folder).config), advice)


def check_same(folder: Path, training: Training) -> None:
    """Raise ``InvalidInput`` unless the run in ``folder`` is this training, naming the keys in which they differ.

    Its plug-ins must be those of this process.
    """
    config = read_object(RunDirectory(folder).config)
    check_run_plugins(folder, config, "or give another folder (--output)")
    found = training_in(folder, config)
    if found.identity == training.identity:
        return
    kept, wanted = (training_content(each.recipe, each.scenario) for each in (found, training))
    other = [
        f"{part} {key}"
        for part in wanted
        for key in dict.fromkeys([*wanted[part], *kept[part]])
        if key not in kept[part] or key not in wanted[part] or kept[part][key] != wanted[part][key]
    ]
    raise InvalidInput(
        f"{folder}: holds another training (here other: {', '.join(other)}); give another folder (--output)"
    )


def training_content(recipe: TrainingRecipe, scenario: Scenario) -> Content:
    """What makes a training what it is: plain data with every default in it, without words."""
    return {
        "recipe": recipe.model_dump(mode="json", exclude=set(WORDS)),
        "scenario": scenario.content(without=WORDS),
    }


def training_identity(content: Content) -> str:
    """SHA-256 of such content, in hexadecimal digits."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
