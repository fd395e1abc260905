"""The JSON Schema of recipes, asked as an editor asks it: what it lets pass, and what it marks."""

from __future__ import annotations

from typing import Any

import pytest
from jsonschema import Draft202012Validator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import parse_yaml, read_yaml
from ethbrake_marl.learning.training import TrainingRecipe, algorithm_names, load_recipe


def _marked(content: Any) -> set[str]:
    """The places where an editor marks a mistake; empty: the whole file."""
    found = Draft202012Validator(TrainingRecipe.json_schema()).iter_errors(content)
    return {".".join(map(str, error.absolute_path)) for error in found}


def test_schema__is_one() -> None:
    Draft202012Validator.check_schema(TrainingRecipe.json_schema())


@pytest.mark.parametrize("algorithm", algorithm_names())
def test_schema__says_what_every_key_of_an_algorithm_means(algorithm: str) -> None:
    recipe = type(load_recipe(algorithm))
    properties = TrainingRecipe.json_schema()["$defs"][recipe.__name__]["properties"]
    assert set(properties) == set(recipe.model_fields)
    assert [key for key, value in properties.items() if not value.get("description")] == []


@pytest.mark.parametrize("name", sorted(TrainingRecipe.shipped()))
def test_schema__lets_shipped_and_new_recipes_pass(name: str) -> None:
    assert _marked(read_yaml(TrainingRecipe.shipped()[name]).content) == set()
    assert _marked(parse_yaml(load_recipe(name).new_text("mine"), "mine.yaml").content) == set()


@pytest.mark.parametrize(
    ("change", "place"),
    [
        ({"algorithm": "nobody"}, "algorithm"),
        ({"gama": 0.9}, ""),
        ({"buffer_size": 1000}, ""),  # a key of another algorithm
        ({"gamma": 2}, "gamma"),
        ({"total_steps": 0.5}, "total_steps"),
        ({"seed": -1}, "seed"),
        ({"name": "Mine!"}, "name"),
        ({"scheme": "together"}, "scheme"),
        ({"reward": {"harm": -1}}, "reward.harm"),
        ({"reward": {"harmm": 1}}, "reward"),
        ({"network": {"policy": [], "value": [8]}}, "network.policy"),
        ({"observation": ["own", "own"]}, "observation"),
        ({"learning_rate": 0.001}, "learning_rate"),
    ],
)
def test_schema__marks_what_the_reader_refuses(change: dict[str, Any], place: str) -> None:
    good = read_yaml(TrainingRecipe.shipped()["ppo"]).content
    assert _marked({**good, **change}) == {place}
    with pytest.raises(InvalidInput):
        load_recipe("ppo").replace(**change)


def test_schema__asks_for_what_is_missing() -> None:
    good = read_yaml(TrainingRecipe.shipped()["ppo"]).content
    assert _marked({key: value for key, value in good.items() if key != "gamma"}) == {""}
    assert _marked({key: value for key, value in good.items() if key != "algorithm"}) == {""}
