"""What a policy's networks compute: by hand, as torch does, the same bits in any batch, behind a gate, and as ONNX."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from torch import nn

import ethbrake_marl as eb
from ethbrake_marl.observations import observe
from ethbrake_marl.policies import Actor, NetworkSpec, Policy, dense, squash


def _observations(n: int, size: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(-2.0, 2.0, (n, size)).astype(np.float32)


def test_tensors__of_the_papers_network_has_the_tables_tensors() -> None:
    shapes = {row.name: row.shape for row in eb.load_recipe("ppo-paper").network_spec(27).tensors}
    assert shapes == {
        "policy.0.weight": (256, 27),
        "policy.0.bias": (256,),
        "policy.1.weight": (256, 256),
        "policy.1.bias": (256,),
        "policy.output.weight": (1, 256),
        "policy.output.bias": (1,),
        "policy.log_std": (1,),
        "value.0.weight": (256, 27),
        "value.0.bias": (256,),
        "value.1.weight": (256, 256),
        "value.1.bias": (256,),
        "value.2.weight": (128, 256),
        "value.2.bias": (128,),
        "value.output.weight": (1, 128),
        "value.output.bias": (1,),
    }


def test_dense__numbers_by_hand() -> None:
    weight = np.array([[1, 2, 3, 4, 5], [0, 0, 0, 0, -1]], np.float32)
    bias = np.array([10, 20], np.float32)
    x = np.array([[1, 0], [1, 0], [1, 0], [1, 0], [1, 2]], np.float32)
    y = np.empty((2, 2), np.float32)
    dense(weight, bias, x, y)
    assert y.tolist() == [[25.0, 20.0], [19.0, 18.0]]


@pytest.mark.parametrize(
    ("output", "last", "expected", "tensors"),
    [
        ("clip", [[1.0, -2.0]], [1.0, -0.5, -1.0, 0.0], 9),
        ("tanh", [[1.0, -2.0]], np.tanh([3.0, -0.5, -4.0, 0.0]), 10),
        # of five actions from -1 to 1 that of the highest score, and the lowest of equal ones; without a critic
        ("choice", [[0.0, 0.0], [1.0, 0.0], [0.0, 3.0], [2.0, 0.0], [2.0, 0.0]], [0.5, 0.0, 0.0, -1.0], 4),
    ],
)
def test_actor__relu_then_output_by_hand(output: str, last: Any, expected: Any, tensors: int) -> None:
    spec = NetworkSpec(
        observation_size=1, action_size=1, policy_hidden=(2,), value_hidden=() if output == "choice" else (1,),
        activation="relu", output=output, choices=5 if output == "choice" else None,
    )  # fmt: skip
    weights = {row.name: np.zeros(row.shape, np.float32) for row in spec.tensors}
    weights["policy.0.weight"][:, 0] = [1.0, -1.0]  # hidden: max(x, 0), max(-x, 0)
    weights["policy.output.weight"][:] = last
    action = Actor(spec, weights)(np.array([[3.0], [-0.25], [-2.0], [0.0]], np.float32))
    np.testing.assert_allclose(action[:, 0], expected, rtol=1e-6)
    assert len(weights) == tensors


@pytest.mark.parametrize(
    ("hidden", "activation", "output"),
    [
        ((256, 256), "relu", "clip"),
        ((256, 256), "tanh", "clip"),
        ((64,), "tanh", "tanh"),
        ((64,), "relu", "choice"),
        (None, "relu", "clip"),  # several networks and a gate
    ],
)
def test_actor__action_is_bitwise_independent_of_the_batch_around_it(
    hidden: tuple[int, ...] | None, activation: str, output: str, random_tensors: RandomTensors, mixture: Policy
) -> None:
    actor: Any = mixture
    if hidden is not None:
        spec = NetworkSpec(
            observation_size=27, action_size=1, policy_hidden=hidden, value_hidden=(8,) if output == "clip" else (),
            activation=activation, output=output, choices=801 if output == "choice" else None,
        )  # fmt: skip
        actor = Actor(spec, random_tensors(spec))
    seen = _observations(500, 27)
    together = actor(seen)
    assert np.unique(together).size > (100 if output == "choice" else 200)  # else equality below would show nothing
    for first in (0, 1, 3, 17, 63, 64, 255, 256, 300):
        for n in (0, 1, 2, 5, 63, 64, 65, 200):
            assert np.array_equal(actor(seen[first : first + n]), together[first : first + n]), (first, n)
    shuffled = np.random.default_rng(2).permutation(500)
    assert np.array_equal(actor(seen[shuffled]), together[shuffled])


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_actor__agrees_with_torch(activation: str, random_tensors: RandomTensors) -> None:
    spec = eb.load_recipe("ppo-paper").network_spec(27).model_copy(update={"activation": activation})
    tensors, seen = random_tensors(spec), _observations(1000, 27)
    x, function = torch.from_numpy(seen), nn.functional.relu if activation == "relu" else torch.tanh
    for name in ("policy.0", "policy.1", "policy.output"):
        y = nn.functional.linear(x, torch.tensor(tensors[f"{name}.weight"]), torch.tensor(tensors[f"{name}.bias"]))
        x = function(y)
    np.testing.assert_allclose(Actor(spec, tensors)(seen), y.clip(-1.0, 1.0).numpy(), rtol=0.0, atol=1e-6)


def test_squash__is_the_rounded_hyperbolic_tangent() -> None:
    x = np.concatenate([np.linspace(-12.0, 12.0, 200_001), np.logspace(-30, 0, 2000), [0.0, -0.0, 1e30, -1e30]])
    single = x.astype(np.float32)[np.newaxis]
    actual = single.copy()
    squash(actual)
    exact = np.tanh(single.astype(np.float64))
    spacing = np.spacing(np.abs(exact).astype(np.float32)).astype(np.float64)
    assert (np.abs(actual - exact) <= 0.5001 * spacing).all()
    assert actual[0, -2:].tolist() == [1.0, -1.0]


RandomTensors = Callable[[NetworkSpec], dict[str, np.ndarray]]
SCENARIO = eb.load_scenario("paper-random")


def another(policy: Policy, tensors: Mapping[str, np.ndarray], **changes: Any) -> Policy:
    """A policy with these tensors and what else is changed of this one."""
    names = set(type(policy.manifest).model_fields) - {"weights_sha256", "manifest_sha256"}
    return Policy.make(tensors, **{**{name: getattr(policy.manifest, name) for name in names}, **changes})


def test_mixture__acts_as_the_network_that_the_gate_chooses_the_first_of_equal_scores(mixture: Policy) -> None:
    seen, network = _observations(300, 27), mixture.manifest.network
    hidden = np.maximum(seen @ mixture.tensors["gate.0.weight"].T + mixture.tensors["gate.0.bias"], 0.0)
    scores = hidden @ mixture.tensors["gate.output.weight"].T + mixture.tensors["gate.output.bias"]
    chosen = scores.argmax(axis=1)
    assert len(set(chosen)) > 1
    one = network.model_copy(update={"networks": 1, "gate_hidden": ()})
    for number in range(3):
        own = f"network_{number + 1}."
        tensors = {name.replace(own, "policy."): each for name, each in mixture.tensors.items() if name.startswith(own)}
        rows = chosen == number
        alone = Actor(one, {**tensors, "policy.log_std": np.zeros(1, np.float32)})
        assert np.array_equal(mixture(seen)[rows], alone(seen)[rows])
    equal = {name: each * np.float32(not name.startswith("gate.output")) for name, each in mixture.tensors.items()}
    assert (another(mixture, equal)._actor.choose(np.ascontiguousarray(seen.T)) == 0).all()


@pytest.mark.parametrize("around", ["+episode", "+step", "+refined", "+refined:profile"])
def test_mixture__drives_shielded_and_refined(around: str, mixture: Policy, tmp_path: Path) -> None:
    mixture.save(tmp_path / "mixture")
    assert eb.load_policy(tmp_path / "mixture").manifest == mixture.manifest
    spec = f"counterfactual@{tmp_path / 'mixture'}"
    agents = {name: eb.make_agent(name, scenario=SCENARIO) for name in (spec, spec + around)}
    found = eb.evaluate(SCENARIO.sample(4, seed=7).worlds, agents, scenario=SCENARIO)
    alone, harm = (found.outcome(name).first_impact_harm for name in agents)
    assert np.isfinite(harm).all() and ((harm <= alone).all() or "refined" not in around)


def onnx_of(policy: Policy) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(policy.to_onnx(), providers=["CPUExecutionProvider"])


@pytest.mark.parametrize(
    ("output", "activation"), [("clip", "relu"), ("tanh", "relu"), ("clip", "tanh"), ("choice", "relu")]
)
def test_onnx__asks_for_the_same_acceleration_in_10_000_states(
    output: str, activation: str, policy: Policy, random_tensors: RandomTensors
) -> None:
    spec = NetworkSpec(
        observation_size=27, action_size=1, policy_hidden=(64, 48), value_hidden=(), activation=activation,
        output=output, choices=33 if output == "choice" else None,
    )  # fmt: skip
    tensors = random_tensors(spec)
    tensors["policy.output.weight"] *= 3.0  # so that some actions reach the bounds
    ours = another(policy, tensors, network=spec, algorithm={"tanh": "sac", "choice": "options"}.get(output, "ppo"))
    worlds = SCENARIO.replace(driving_capacity_mps2={"uniform": [1, 3]}).sample(10_000, 5).worlds
    rng = np.random.default_rng(0)
    command = -rng.uniform(0.0, 1.0, worlds.speeds_mps.shape) * worlds.vehicles.braking_capacity_mps2
    worlds, _ = eb.advance(worlds, command, until_s=rng.uniform(0.0, 6.0, worlds.n))
    seen, expected = observe(worlds, 1, ours.observation), eb.LearnedAgent(ours).act(worlds, 1)
    action, acceleration = onnx_of(ours).run(["action", "acceleration_mps2"], {"observation": seen})
    assert np.ptp(expected) > 4.0 and (expected > 0.5).any()
    np.testing.assert_allclose(action, ours(seen), rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(acceleration[:, 0], expected, rtol=0.0, atol=1e-4)


def test_onnx__of_several_networks_and_without_the_package(mixture: Policy, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = _observations(2000, 27)
    (action,) = onnx_of(mixture).run(["action"], {"observation": seen})
    np.testing.assert_allclose(action, mixture(seen), rtol=0.0, atol=1e-5)
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(eb.MissingExtra, match=r"-m pip install 'ethbrake-marl\[export\]'$"):
        mixture.to_onnx()
