"""The JSON Schema of recipe files, for editors."""

from __future__ import annotations

from typing import Any

from pydantic.json_schema import models_json_schema

from ethbrake_marl.episode.reward import registered_terms
from ethbrake_marl.files.json_schema import FileSchema
from ethbrake_marl.training.recipe import ALGORITHMS, TrainingRecipe


def recipe_schema() -> dict[str, Any]:
    """The possible keys depend on ``algorithm``."""
    classes = {name: recipe for name, (recipe, _) in ALGORITHMS.usable().items()}
    places, schema = models_json_schema(
        [(recipe, "validation") for recipe in classes.values()], schema_generator=FileSchema
    )
    parts = schema["$defs"]
    for name, recipe in classes.items():
        keys = parts[str(places[recipe, "validation"]["$ref"]).rpartition("/")[2]]["properties"]
        keys["algorithm"] |= {"description": key_meanings(recipe)["algorithm"], "const": name}
    weight = {"type": "number", "description": "weight of a registered term"}
    parts["RewardParams"]["properties"] |= {name: weight for name in registered_terms()}
    ways = [
        {
            "if": {"properties": {"algorithm": {"const": name}}, "required": ["algorithm"]},
            "then": places[recipe, "validation"],
        }
        for name, recipe in classes.items()
    ]
    return FileSchema.publish(
        {
            "title": "Recipe",
            "description": "Settings of a training.",
            "type": "object",
            "required": ["algorithm"],
            "properties": {
                "algorithm": {"enum": [*classes], "description": "learning algorithm; decides which keys exist"}
            },
            "allOf": ways,
            "$defs": parts,
        }
    )


def key_meanings(recipe: type[TrainingRecipe]) -> dict[str, str]:
    """A key without a description takes the base class's."""
    meanings: dict[str, str] = {}
    for base in reversed(recipe.__mro__):
        for key, field in base.model_fields.items() if issubclass(base, TrainingRecipe) else ():
            meanings |= {key: field.description} if field.description else {}
    return meanings
