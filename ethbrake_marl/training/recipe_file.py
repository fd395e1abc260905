"""Files of recipes that users write: a commented copy to begin with, and the JSON Schema for their editor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic.json_schema import models_json_schema

from ethbrake_marl.episode.reward import own_terms
from ethbrake_marl.files.json_schema import FileSchema, schema_lines
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.training.recipe import ALGORITHMS, TrainingRecipe
from ethbrake_marl.worlds.explain import check_file_name


def new_recipe_text(name: str, like: TrainingRecipe) -> str:
    """Return the text of a commented file ``<name>.yaml`` with the values of another recipe.

    Keys without a value are commented out. Raises ``InvalidInput`` for a bad name.
    """
    check_file_name("recipe", name)
    recipe = like.replace(
        name=name,
        title="Title in one line",
        description="What this recipe is for.",
        source=f"Values of {like.name}, to be changed.",
    )
    lines = [
        f"# Recipe {name}, a copy of {like.name}. Train with it: ethbrake train --recipe {name}.yaml\n",
        schema_lines("recipe", "train --schema"),
    ]
    values, meanings = recipe.model_dump(mode="json"), key_meanings(type(recipe))
    for key in type(recipe).model_fields:
        value = values.get(key)
        lines.append(f"\n# {meanings[key]}\n" if key in meanings else "\n")
        if value is None:
            lines.append(f"# {key}:\n")
        elif isinstance(value, Mapping):
            inside = (f"  {name}: {flow_text(entry)}\n" for name, entry in value.items() if entry is not None)
            lines += [f"{key}:\n", *inside]
        else:
            lines.append(f"{key}: {flow_text(value)}\n")
    return "".join(lines)


def recipe_schema() -> dict[str, Any]:
    """Return the JSON Schema of recipe files: which keys there are depends on the key ``algorithm``."""
    classes = {name: recipe for name, (recipe, _) in ALGORITHMS.usable().items()}
    places, whole = models_json_schema([(each, "validation") for each in classes.values()], schema_generator=FileSchema)
    parts = whole["$defs"]
    for name, recipe in classes.items():
        keys = parts[str(places[recipe, "validation"]["$ref"]).rpartition("/")[2]]["properties"]
        keys["algorithm"] |= {"description": key_meanings(recipe)["algorithm"], "const": name}
    weight = {"type": "number", "description": "weight of a registered term"}
    parts["RewardParams"]["properties"] |= {name: weight for name in own_terms()}
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
    """Return what the keys of a class of recipes mean; a key without a description has that of the base class."""
    meanings: dict[str, str] = {}
    for each in reversed(recipe.__mro__):
        for key, field in each.model_fields.items() if issubclass(each, TrainingRecipe) else ():
            meanings |= {key: field.description} if field.description else {}
    return meanings
