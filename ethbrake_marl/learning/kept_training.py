"""Which training a run's folder holds: the one answer to "is this the same training?", by content.

Two trainings are the same where recipe (its seed included) and scenario say the same; titles, descriptions and sources
are words and count for nothing, nor does it matter whether a default is spelt out. Learning curves and ablations ask
before they keep a finished training or go on with one, ``resume`` asks whether a checkpoint belongs to what
``config.json`` says.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.recipe import WORDS, TrainingRecipe, recipe_of
from ethbrake_marl.learning.run_folder import RunDirectory, read_object
from ethbrake_marl.policies.policy import first_line
from ethbrake_marl.scenario import Scenario

Content = dict[str, dict[str, Any]]


def asked_for(folder: Path, config: Mapping[str, Any]) -> tuple[TrainingRecipe, Scenario]:
    """Recipe and scenario of the configuration of the run in ``folder``.

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
        raise InvalidInput(f"{file}: scenario: {first_line(error)}") from None
    except InvalidInput as error:
        raise InvalidInput(f"{file}: {error}") from None
    return recipe, scenario


def fingerprint(recipe: TrainingRecipe, scenario: Scenario) -> str:
    """SHA-256 of all that makes a training what it is, in hexadecimal digits."""
    return hashlib.sha256(json.dumps(_content(recipe, scenario), sort_keys=True).encode()).hexdigest()


def check_same(folder: Path, recipe: TrainingRecipe, scenario: Scenario) -> None:
    """Raise ``InvalidInput`` unless the run in ``folder`` is the training of this recipe and scenario.

    The message names the keys in which they differ.
    """
    kept = _content(*asked_for(folder, read_object(RunDirectory(folder).config)))
    wanted = _content(recipe, scenario)
    other = [
        f"{part} {key}"
        for part in wanted
        for key in dict.fromkeys([*wanted[part], *kept[part]])
        if key not in kept[part] or key not in wanted[part] or kept[part][key] != wanted[part][key]
    ]
    if other:
        raise InvalidInput(
            f"{folder}: holds another training (here other: {', '.join(other)}); give another folder (--output)"
        )


def _content(recipe: TrainingRecipe, scenario: Scenario) -> Content:
    """Plain data with every default in it, without words."""
    return {
        "recipe": recipe.model_dump(mode="json", exclude=set(WORDS)),
        "scenario": scenario.model_dump(mode="json", exclude=set(WORDS)),
    }
