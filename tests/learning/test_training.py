"""Recipes, their schema as an editor asks it, and what makes two trainings the same."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.files.yaml import parse_yaml, read_yaml
from ethbrake_marl.learning import RunDirectory, Training, TrainingRecipe, algorithm_names, load_recipe
from ethbrake_marl.learning.training import LearningRate
from ethbrake_marl.policies import NetworkSpec
from tests.learning.tiny import TINY_COUNTERFACTUAL, TINY_PPO, marked

SHIPPED = TrainingRecipe.shipped()
PAPERS = {
    "ppo-paper": {
        "gamma": 0.99, "n_steps": 2048, "n_epochs": 4, "batch_size": 512, "clip_range": 0.15, "gae_lambda": 0.95,
        "vf_coef": 0.5, "ent_coef": 0.005, "target_kl": 0.15, "max_grad_norm": 0.3,
    },
    "sac-paper": {
        "batch_size": 256, "buffer_size": 10**6, "learning_starts": 10**4, "tau": 0.02, "gamma": 0.99,
        "steps_per_update": 1, "gradient_steps": 1, "ent_coef": "auto", "target_update_interval": 1, "n_envs": 1,
        "update_ratio": 1.0,
    },
}  # fmt: skip
NETWORKS = {
    "ppo-paper": {"value_hidden": (256, 256, 128), "output": "clip"},
    "sac-paper": {"value_hidden": (), "output": "tanh"},
}


@pytest.mark.parametrize(("name", "value"), [("ppo-paper", (256, 256, 128)), ("sac-paper", (256, 256))])
def test_recipe__of_the_paper_has_its_network_and_table(name: str, value: tuple[int, ...]) -> None:
    recipe = load_recipe(name)
    assert {key: getattr(recipe, key) for key in PAPERS[name]} == PAPERS[name] and recipe.network.value == value
    shape = {"observation_size": 27, "action_size": 1, "policy_hidden": (256, 256), "activation": "relu"}
    assert recipe.network_spec(27) == NetworkSpec(**shape, **NETWORKS[name])


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_recipe__that_ships_comes_back_from_its_json_and_its_template_and_passes_the_schema(name: str) -> None:
    recipe, new = load_recipe(name), parse_yaml(load_recipe(name).new_text("mine"), "mine.yaml").content
    assert TrainingRecipe.of(recipe.model_dump(mode="json")) == recipe
    assert TrainingRecipe.of(new).name == "mine"
    schema = TrainingRecipe.json_schema()
    assert marked(schema, read_yaml(SHIPPED[name]).content) == marked(schema, new) == set()
    if (
        recipe.algorithm == "ppo"
    ):  # expects nothing beyond the horizon, but for the paper's, whose values are the paper's
        assert recipe.horizon_is_end == (name != "ppo-paper")


def test_learning_rate__cosine_by_hand() -> None:
    rate = LearningRate(start=5e-4, end=1e-4)
    assert [rate.at(x) for x in (1.0, 0.5, 0.0)] == pytest.approx([5e-4, 3e-4, 1e-4])
    assert rate.at(0.75) == pytest.approx(1e-4 + 4e-4 * (1.0 + 0.5**0.5) / 2.0)
    assert rate.at(-0.1) == pytest.approx(1e-4)  # the last rollout may overshoot the end; the rate must not rise again


def test_recipe__tells_only_the_keys_that_it_has_so_that_older_trainings_stay_the_same() -> None:
    told = TINY_COUNTERFACTUAL.model_dump(mode="json")
    assert not {"focus", "modes"} & told.keys() and "initial_action" not in told["network"]
    assert TINY_COUNTERFACTUAL.replace(focus=0.75).model_dump(mode="json")["focus"] == 0.75


@pytest.mark.parametrize("algorithm", algorithm_names())
def test_schema__says_what_every_key_of_an_algorithm_means(algorithm: str) -> None:
    recipe = type(load_recipe(algorithm))
    properties = TrainingRecipe.json_schema()["$defs"][recipe.__name__]["properties"]
    assert set(properties) == set(recipe.model_fields)
    assert [key for key, value in properties.items() if not value.get("description")] == []


SCENARIO = eb.load_scenario("paper-random")
TRAINING = Training.of(TINY_PPO, SCENARIO)
WORDS = {"title": "Another", "description": "More.", "source": "Elsewhere."}


@pytest.mark.parametrize("change", [WORDS, {"v2x": {"preset": "paper"}, "speed_limit_mps": 40}])
def test_training__words_and_defaults_that_are_spelt_out_change_nothing(change: dict[str, Any], tmp_path: Path) -> None:
    scenario = SCENARIO.model_dump(mode="json", exclude_unset=True) | change
    config = {"recipe": TINY_PPO.model_dump(mode="json"), "scenario": scenario}
    RunDirectory(tmp_path / "run").create(config).check_same(TRAINING)
    assert Training.of(TINY_PPO.replace(**WORDS), SCENARIO.replace(**WORDS)).identity == TRAINING.identity


def test_run__force_replaces_a_run_and_all_that_it_held(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "runs" / "first").create({"seeds": {"training": 3}})
    assert json.loads(run.config.read_text()) == {"seeds": {"training": 3}}
    assert json.loads(run.status.read_text())["status"] == "running"
    (run.path / "old").touch()
    again = RunDirectory(run.path).create({}, force=True).path
    assert sorted(path.name for path in again.iterdir()) == ["config.json", "run.json"]
    assert [path.name for path in run.path.parent.iterdir()] == ["first"]
