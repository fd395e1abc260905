from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.sac.policies import SACPolicy

from ethbrake_marl.learning.algorithms import ppo_arguments, sac_arguments, tensors_of
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.policies import Actor, NetworkSpec

SHAPE = load_recipe("ppo-paper").network


def _papers_network(observation_size: int) -> NetworkSpec:
    return load_recipe("ppo-paper").network_spec(observation_size)


def _policy(spec: NetworkSpec, seed: int) -> ActorCriticPolicy:
    torch.manual_seed(seed)
    seen = Box(-10.0, 10.0, (spec.observation_size,), np.float32)
    policy = ActorCriticPolicy(
        seen,
        Box(-1.0, 1.0, (1,), np.float32),
        lambda _: 1e-3,
        **ppo_arguments(SHAPE.model_copy(update={"activation": spec.activation, "initial_log_std": -0.5})),
    )
    with torch.no_grad():
        policy.action_net.weight *= 100.0  # fresh weights are tiny: fill [-1, 1] and go beyond it
    return policy


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_tensors_of__our_forward_pass_gives_sb3s_deterministic_action(activation: str) -> None:
    spec = _papers_network(27).model_copy(update={"activation": activation})
    policy = _policy(spec, 0)
    seen = np.random.default_rng(0).uniform(-2.0, 2.0, (2000, 27)).astype(np.float32)
    expected, _ = policy.predict(seen, deterministic=True)
    actual = Actor(spec, tensors_of(policy, spec))(seen)
    assert (np.abs(expected) == 1.0).any() and (np.abs(expected) < 0.5).any()
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-6)


def test_tensors_of__holds_every_weight_once() -> None:
    spec = _papers_network(27)
    policy = _policy(spec, 0)
    assert sum(t.size for t in tensors_of(policy, spec).values()) == sum(p.numel() for p in policy.parameters())
    assert tensors_of(policy, spec)["policy.log_std"].tolist() == [-0.5]


def test_tensors_of__is_a_copy() -> None:
    spec = _papers_network(5)
    policy = _policy(spec, 1)
    before = tensors_of(policy, spec)
    kept = before["policy.0.weight"].copy()
    with torch.no_grad():
        policy.mlp_extractor.policy_net[0].weight += 1.0
    assert np.array_equal(before["policy.0.weight"], kept)


def test_tensors_of__of_sac_gives_its_deterministic_action() -> None:
    recipe = load_recipe("sac-paper")
    shape, spec = recipe.network, recipe.network_spec(27)
    torch.manual_seed(3)
    seen = Box(-10.0, 10.0, (27,), np.float32)
    policy = SACPolicy(seen, Box(-1.0, 1.0, (1,), np.float32), lambda _: 1e-3, **sac_arguments(shape))
    with torch.no_grad():
        policy.actor.mu.weight *= 10.0
    observations = np.random.default_rng(0).uniform(-2.0, 2.0, (2000, 27)).astype(np.float32)
    expected, _ = policy.predict(observations, deterministic=True)
    tensors = tensors_of(policy, spec)
    assert sum(t.size for t in tensors.values()) == sum(p.numel() for p in policy.actor.parameters())
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(Actor(spec, tensors)(observations), expected, rtol=0.0, atol=5e-6)
