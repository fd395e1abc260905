"""Algorithms: how Stable-Baselines3's weights become ours, and one of the user's own, as it is printed on its page."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable, Iterator
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

import ethbrake_marl as eb
from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning import training as registry
from ethbrake_marl.learning.algorithms import ppo_arguments, sac_arguments, tensors_of
from ethbrake_marl.learning.runs import resume, train
from ethbrake_marl.learning.training import TrainingRecipe, load_recipe
from ethbrake_marl.policies import Actor, load_policy
from tests.learning.tiny import TINY_PPO, ctrl_c_in, files_of, watch_steps


@pytest.fixture(autouse=True)
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The page's file, imported; what it registers is forgotten afterwards."""
    monkeypatch.setattr(registry, "_ALGORITHMS", dict(registry._ALGORITHMS))
    (source,) = (block for block in re.findall("```python\n(.*?)```", PAGE, re.DOTALL) if "register_algorithm" in block)
    (tmp_path / "my_algorithm.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("my_algorithm")
    yield
    sys.modules.pop("my_algorithm")


PAGE = (Path(__file__).resolve().parents[2] / "docs" / "learning.md").read_text("utf-8")


SCENARIO = eb.load_scenario("paper-random")


def recipe_file(folder: Path, **changes: Any) -> Path:
    """A recipe of the own algorithm."""
    recipe = TINY_PPO.model_dump(mode="json", include=set(TrainingRecipe.model_fields))
    recipe |= {
        "name": "mine",
        "algorithm": "a2c",
        "total_steps": 1024,
        "n_steps": 8,
        "network": {"policy": [8], "value": [8]},
    }
    (folder / "mine.yaml").write_text(yaml.safe_dump(recipe | changes))
    return folder / "mine.yaml"


def test_own_algorithm__trains_resumes_bit_for_bit_and_is_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, run = recipe_file(tmp_path), tmp_path / "run"
    whole = train(recipe, SCENARIO, tmp_path / "whole")
    assert (whole.status, whole.steps, whole.updates) == ("finished", 1024, 16)
    with monkeypatch.context() as patch:
        watch_steps(patch, ctrl_c_in(61))
        assert train(recipe, SCENARIO, run).status == "interrupted"
    config = (run / "config.json").read_text()
    (run / "config.json").write_text(config.replace('"n_steps": 8', '"n_steps": 4'))
    with pytest.raises(InvalidInput, match="was changed after the checkpoint"):
        resume(run)
    (run / "config.json").write_text(config)
    result = resume(run)
    assert (result.status, result.evaluations) == ("finished", whole.evaluations)
    assert files_of(run) == files_of(tmp_path / "whole")

    assert load_policy(run).manifest.algorithm == "a2c"
    agents = {f"{kind}@{run}": make_agent(f"{kind}@{run}", scenario=SCENARIO) for kind in ("policy", "team")}
    found = eb.evaluate(SCENARIO.sample(10, 7), agents, scenario=SCENARIO)
    harms = [found.outcome(name).first_impact_harm.mean() for name in agents]
    assert harms[0] == harms[1] == pytest.approx(min(e["first_impact_harm"] for e in result.evaluations))


def test_own_algorithm__under_vec_normalize_is_refused_as_no_bundle_holds_its_statistics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = sys.modules["my_algorithm"].A2c
    build = own.build
    monkeypatch.setattr(own, "build", lambda self, training, rows: build(self, training, VecNormalize(rows)))
    with pytest.raises(InvalidInput, match="'a2c': its model is trained under VecNormalize, whose statistics are no"):
        train(recipe_file(tmp_path), SCENARIO, tmp_path / "run")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_stepz": 3}, r"mine.yaml, line \d+: n_stepz.*did you mean n_steps"),
        ({"n_steps": 2.5}, r"mine.yaml, line \d+: n_steps = 2.5: must be a whole number"),
        ({"algorithm": "a3c"}, r"algorithm = a3c: must be ppo or sac or counterfactual or a2c"),
        ({"scheme": "independent"}, "scheme independent: recipe 'mine' is for A2C; it needs one for PPO"),
    ],
)
def test_own_algorithm__its_class_checks_the_recipe(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=message):
        train(recipe_file(tmp_path, **changes), "cooperation-3-pair", tmp_path / "run")
    assert load_recipe(recipe_file(tmp_path)).rounds == 8


SEEN, ACTION = Box(-10.0, 10.0, (27,), np.float32), Box(-1.0, 1.0, (1,), np.float32)


def ppo_policy(activation: str) -> Any:
    shape = load_recipe("ppo-paper").network.model_copy(update={"activation": activation, "initial_log_std": -0.5})
    policy = ActorCriticPolicy(SEEN, ACTION, lambda _: 1e-3, **ppo_arguments(shape))
    with torch.no_grad():
        policy.action_net.weight *= 100.0  # fresh weights are tiny: fill [-1, 1] and go beyond it
    return policy


def sac_policy(activation: str) -> Any:
    policy = SACPolicy(SEEN, ACTION, lambda _: 1e-3, **sac_arguments(load_recipe("sac-paper").network))
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
