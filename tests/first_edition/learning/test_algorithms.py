"""Algorithms: one of the user's own, and how weights become ours."""

import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from gymnasium.spaces import Box
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.policies import SACPolicy

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.policies.actor import Actor
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.training.networks import ppo_arguments, tensors_of
from ethbrake_marl.first_edition.training.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.first_edition.training.sac import sac_arguments
from ethbrake_marl.first_edition.training.session import resume, train
from tests.first_edition.learning.tiny import TINY_PPO, ctrl_c_in, files_of, watch_steps


@pytest.fixture
def mine(tmp_path: Path) -> None:
    """An algorithm of a user's file is registered."""
    (tmp_path / "my_algorithm.py").write_text(A2C)
    runpy.run_path(str(tmp_path / "my_algorithm.py"))


A2C = '''
"""A2C, from Stable-Baselines3."""

from stable_baselines3 import A2C

from ethbrake_marl import TrainingRecipe, register_algorithm
from ethbrake_marl.first_edition.training.networks import ppo_arguments
from ethbrake_marl.first_edition.training.algorithm import Algorithm
from ethbrake_marl.first_edition.training.recipe import NetworkShape


class A2cRecipe(TrainingRecipe):
    n_steps: int  # decisions of each learner between two updates
    network: NetworkShape


class A2c(Algorithm):
    def build(self, training, environment):
        """A fresh model, seeded by the recipe."""
        recipe = training.recipe
        return A2C(
            "MlpPolicy",
            environment,
            learning_rate=recipe.learning_rate.at,
            n_steps=recipe.n_steps,
            gamma=recipe.gamma,
            policy_kwargs=ppo_arguments(recipe.network),
            seed=recipe.seed,
            device="cpu",
        )


register_algorithm("a2c", A2cRecipe, A2c)
'''
SCENARIO = eb.load_scenario("paper-random")


def recipe_file(folder: Path, **changes: Any) -> Path:
    """A recipe of the own algorithm."""
    recipe = TINY_PPO.model_dump(mode="json", include=set(TrainingRecipe.model_fields))
    own = {"name": "mine", "algorithm": "a2c", "total_steps": 512, "n_steps": 8}
    recipe |= own | {"network": {"policy": [8], "value": [8]}, "checkpoint_every_updates": 3}
    (folder / "mine.yaml").write_text(yaml.safe_dump(recipe | changes))
    return folder / "mine.yaml"


@pytest.mark.usefixtures("mine")
def test_own_algorithm__trains_resumes_bit_for_bit_and_is_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, run = recipe_file(tmp_path), tmp_path / "run"
    whole = train(recipe, SCENARIO, tmp_path / "whole")
    assert (whole.status, whole.steps, whole.updates) == ("finished", 512, 8)
    with monkeypatch.context() as patch:
        watch_steps(patch, ctrl_c_in(37))
        assert train(recipe, SCENARIO, run).status == "interrupted"
    config = (run / "config.json").read_text()
    (run / "config.json").write_text(config.replace('"n_steps": 8', '"n_steps": 4'))
    with pytest.raises(InvalidInput, match="was changed after the checkpoint"):
        resume(run)
    (run / "config.json").write_text(config)
    result = resume(run)
    assert (result.status, result.evaluations) == ("finished", whole.evaluations)
    assert files_of(run) == files_of(tmp_path / "whole") and load_policy(run).manifest.algorithm == "a2c"
    agents = {f"{kind}@{run}": eb.make_agent(f"{kind}@{run}", scenario=SCENARIO) for kind in ("policy", "team")}
    found = eb.evaluate(SCENARIO.sample(10, 7), agents, scenario=SCENARIO)
    harms = [found.outcome(name).first_impact_harm.mean() for name in agents]
    assert harms[0] == harms[1] == pytest.approx(min(e["first_impact_harm"] for e in result.evaluations))


@pytest.mark.usefixtures("mine")
def test_own_algorithm__under_vec_normalize_is_refused_as_no_bundle_holds_its_statistics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = type(load_recipe(recipe_file(tmp_path)).make_algorithm())
    build = kind.build
    monkeypatch.setattr(kind, "build", lambda self, training, rows: build(self, training, VecNormalize(rows)))
    with pytest.raises(InvalidInput, match="'a2c': its model uses VecNormalize, whose statistics"):
        train(recipe_file(tmp_path), SCENARIO, tmp_path / "run")


SEEN, ACTION = Box(-10.0, 10.0, (27,), np.float32), Box(-1.0, 1.0, (1,), np.float32)


def ppo_policy(activation: str) -> Any:
    shape = load_recipe("ppo-paper").network.model_copy(update={"activation": activation, "initial_log_std": -0.5})
    policy = ActorCriticPolicy(SEEN, ACTION, lambda _: 1e-3, **ppo_arguments(shape))
    with torch.no_grad():
        policy.action_net.weight *= 100.0  # fresh weights are tiny: fill [-1, 1] and go beyond it
    return policy


def sac_policy(activation: str) -> Any:
    policy = SACPolicy(SEEN, ACTION, lambda _: 1e-3, **sac_arguments(load_recipe("sac-paper")))
    with torch.no_grad():
        policy.actor.mu.weight *= 10.0
    return policy


@pytest.mark.parametrize(
    ("recipe", "make", "activation", "exact"),
    [
        ("ppo-paper", ppo_policy, "relu", 1e-6),
        ("ppo-paper", ppo_policy, "tanh", 1e-6),
        ("sac-paper", sac_policy, "relu", 5e-6),
    ],
)
def test_tensors_of__hold_every_weight_once_and_give_sb3s_deterministic_action(
    recipe: str, make: Callable[[str], Any], activation: str, exact: float
) -> None:
    torch.manual_seed(3)
    policy, spec = make(activation), load_recipe(recipe).network_spec(27).model_copy(update={"activation": activation})
    tensors = tensors_of(policy, spec)
    acting = policy.actor if recipe == "sac-paper" else policy
    assert sum(t.size for t in tensors.values()) == sum(p.numel() for p in acting.parameters())
    seen = np.random.default_rng(0).uniform(-2.0, 2.0, (2000, 27)).astype(np.float32)
    expected, _ = policy.predict(seen, deterministic=True)
    assert np.ptp(expected) > 0.5 and (np.abs(expected) < 0.5).any()
    np.testing.assert_allclose(Actor(spec, tensors)(seen), expected, rtol=0.0, atol=exact)
    kept = {name: tensor.copy() for name, tensor in tensors.items()}
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter += 1.0
    assert all(np.array_equal(tensors[name], kept[name]) for name in kept)  # a copy
