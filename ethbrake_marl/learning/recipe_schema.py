"""The JSON Schema of recipe files: for each algorithm its own keys, with their meanings."""

from __future__ import annotations

from typing import Any

from pydantic.json_schema import models_json_schema

from ethbrake_marl.files.json_schema import FileSchema, publish
from ethbrake_marl.learning.recipe_text import MEANINGS
from ethbrake_marl.learning.registry import algorithm_names, recipe_class
from ethbrake_marl.rewards.registry import registered_terms

_WEIGHT = {"type": "number", "minimum": 0, "description": "weight of a registered term"}


def recipe_json_schema() -> dict[str, Any]:
    """JSON Schema of a recipe file, for editors that complete and check YAML.

    Which keys there are depends on ``algorithm``. Algorithms and reward terms that are registered now are known too.
    """
    classes = {name: recipe_class(name) for name in algorithm_names()}
    places, whole = models_json_schema([(each, "validation") for each in classes.values()], schema_generator=FileSchema)
    parts = whole["$defs"]
    for name, recipe in classes.items():
        part = parts[_part_of(places[recipe, "validation"])]
        part["properties"] = {key: _described(key, value) for key, value in part["properties"].items()}
        part["properties"]["algorithm"]["const"] = name
    parts["RewardParams"]["properties"] |= {name: _WEIGHT for name in registered_terms()}
    ways = [
        {
            "if": {"properties": {"algorithm": {"const": name}}, "required": ["algorithm"]},
            "then": places[recipe, "validation"],
        }
        for name, recipe in classes.items()
    ]
    return publish(
        {
            "title": "Recipe",
            "description": "A training set-up: everything that shapes a policy.",
            "type": "object",
            "required": ["algorithm"],
            "properties": {
                "algorithm": {"enum": [*classes], "description": "how it learns; decides which keys there are"}
            },
            "allOf": ways,
            "$defs": parts,
        }
    )


def _part_of(place: dict[str, Any]) -> str:
    return str(place["$ref"]).rpartition("/")[2]


def _described(key: str, value: dict[str, Any]) -> dict[str, Any]:
    return {"description": MEANINGS[key], **value} if key in MEANINGS else value
