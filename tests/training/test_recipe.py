"""Recipes: what their files must be, and what an error says."""

from __future__ import annotations

import math
from collections import UserDict, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from ethbrake_marl.errors import AlreadyExists, UnknownName
from ethbrake_marl.files.yaml import read_yaml
from ethbrake_marl.training.ppo import Ppo
from ethbrake_marl.training.recipe import (
    ALGORITHMS,
    LearningRate,
    PpoRecipe,
    load_recipe,
    register_algorithm,
    shipped_recipes,
    usable_recipes,
)
from ethbrake_marl.training.recipe_file import key_meanings, recipe_schema
from tests.refused import refused

PPO = load_recipe("ppo")
GOOD = """name: mine
algorithm: ppo
total_steps: 4096
n_envs: 16
n_steps: 32
batch_size: 128
n_epochs: 2
learning_rate: {start: 1e-3, end: 1e-4}
gamma: 0.99
gae_lambda: 0.95
clip_range: 0.2
ent_coef: 0
vf_coef: 0.5
max_grad_norm: 0.5
network: {policy: [8], value: [8, 4]}
reward: {harm: 1}
evaluation: {every_updates: 2, worlds: 10, seed: 7}
checkpoint_every_updates: 3
"""


def with_line(old: str, new: str) -> Any:
    assert old in GOOD
    Path("mine.yaml").write_text(GOOD.replace(old, new, 1))
    return load_recipe("mine.yaml")


REFUSED: dict[str, Callable[[], object]] = {
    "mine.yaml, line 4: n_env: unknown key; did you mean n_envs?": lambda: with_line("n_envs: 16", "n_env: 16"),
    "mine.yaml, line 2: algorithm = trpo: must be one of ppo, sac": lambda: with_line(
        "algorithm: ppo", "algorithm: trpo"
    ),
    "mine.yaml, line 16: reward.harms: unknown key; did you mean harm?": lambda: with_line("harm: 1", "harms: 1"),
    "all weights of the reward except shaping are 0": lambda: with_line("m: 1", "m: 0, shaping: 0.1"),
    "mine.yaml: gamma: missing; this key is required; the shipped recipe ppo has all": lambda: with_line(
        "gamma: 0.99\n", ""
    ),
    "mine.yaml, line 9: gamma = 1.1: must be less than or equal to 1": lambda: with_line("0.99", "1.1"),
    "mine.yaml, line 9: gamma = 0.99: must be at most 0.9, the reward's shaping_discount: a larger": lambda: with_line(
        "harm: 1", "harm: 1, shaping: 0.1, shaping_discount: 0.9"
    ),
    "mine.yaml, line 6: batch_size = 100: must divide n_envs x n_steps = 512": lambda: with_line("128", "100"),
    "mine.yaml, line 19: observation = [frnt_1]: unknown feature": lambda: with_line(
        "updates: 3", "updates: 3\nobservation: [frnt_1]"
    ),
    "recipe 'sac': ent_coef = -1: must be 'auto' or a finite number": lambda: load_recipe("sac").replace(ent_coef=-1),
    "recipe 'ppo': device: unknown key; known: name": lambda: PPO.replace(device="cpu"),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", REFUSED)
def test_recipe__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()


def test_recipe__unknown_name_is_refused() -> None:
    with refused("unknown recipe 'ppo-papre'; did you mean 'ppo-paper'?", UnknownName):
        load_recipe("ppo-papre")


@pytest.mark.usefixtures("core_alone")
def test_recipe__of_an_absent_extension_is_refused_by_name() -> None:
    absent = shipped_recipes().keys() - usable_recipes()
    assert len(absent) >= 4 and "ppo" not in absent
    for name in absent:
        file = shipped_recipes()[name]
        with refused(f"; this algorithm belongs to the extension {file.parent.name}, which is not installed") as error:
            load_recipe(name)
        assert str(error.value).startswith(f"{file}, line ")


@pytest.mark.parametrize("name", usable_recipes())
def test_recipe__that_ships_goes_round_and_passes_the_schema(name: str) -> None:
    recipe = load_recipe(name)
    assert recipe.name == name
    assert load_recipe(recipe.model_dump(mode="json")) == recipe == recipe.replace()
    schema = recipe_schema()
    Draft202012Validator.check_schema(schema)
    validator = Draft202012Validator(schema)
    content = read_yaml(shipped_recipes()[name]).content
    assert not list(validator.iter_errors(content))
    marked = [error.absolute_path for error in validator.iter_errors({**content, "gamma": 2, "n_env": 1})]
    assert ["gamma"] in [list(path) for path in marked] and len(marked) == 2


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_recipe__every_key_has_a_meaning(algorithm: str) -> None:
    recipe = ALGORITHMS[algorithm][0]
    assert key_meanings(recipe).keys() == recipe.model_fields.keys()


def test_replace__takes_any_mapping_and_sequence() -> None:
    expected = PPO.replace(reward={"harm": 2.0}, observation=["own", "front_1"], network={"policy": [4], "value": [8]})
    network = UserDict(policy=deque([4]), value=np.array([8]))
    reward = UserDict(harm=np.float64(2.0))
    assert PPO.replace(reward=reward, observation=deque(["own", "front_1"]), network=network) == expected
    assert load_recipe(UserDict(expected.model_dump(mode="json"))) == expected
    assert expected.replace(reward=expected.reward, learning_rate=PPO.learning_rate) == expected


def test_learning_rate__falls_as_a_cosine() -> None:
    rate = LearningRate(start=1.0, end=0.2)
    assert [rate.at(remaining) for remaining in (1.0, 0.5, 0.0, -0.1)] == pytest.approx([1.0, 0.6, 0.2, 0.2])
    assert rate.at(0.75) == pytest.approx(0.2 + 0.4 * (1 + math.cos(math.pi / 4)))


@pytest.mark.parametrize(
    ("name", "recipe", "algorithm", "message"),
    [
        ("My algorithm", PpoRecipe, Ppo, "algorithm 'My algorithm': the name must have 1 to 64 characters"),
        ("new", dict, Ppo, "algorithm 'new': recipe = <class 'dict'>: must be a subclass of TrainingRecipe"),
        ("new", PpoRecipe, "nowhere", "algorithm 'new': algorithm = 'nowhere': must be a class with the method build"),
    ],
)
def test_register_algorithm__is_refused(name: str, recipe: Any, algorithm: Any, message: str) -> None:
    with refused(message):
        register_algorithm(name, recipe, algorithm)
    assert name not in ALGORITHMS


def test_register_algorithm__a_name_belongs_to_one() -> None:
    with refused("algorithm 'ppo' is registered already; give another name", AlreadyExists):
        register_algorithm("ppo", PpoRecipe, Ppo)
