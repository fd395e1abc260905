"""What a policy's networks compute: by hand, with the bits of no neighbour, and near torch."""

from typing import Any

import numpy as np
import pytest
import torch

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.actor import Actor
from ethbrake_marl.policies.layers import squash
from ethbrake_marl.policies.network import NetworkSpec
from tests.refused import refused

FIELDS: dict[str, Any] = {
    "algorithm": "ppo", "learners": ("vehicle_2",), "scenario": {"name": "paper-random", "time_step_s": 0.1},
    "reward": {"harm": 1.0}, "seeds": {"training": 3}, "steps": 1024,
}  # fmt: skip
BASE: dict[str, Any] = {
    "observation_size": 27, "action_size": 1, "policy_hidden": (13, 9), "value_hidden": (), "activation": "relu",
    "output": "clip",
}  # fmt: skip
KINDS: dict[str, dict[str, Any]] = {"clip": {"value_hidden": (5,)}, "tanh": {"output": "tanh", "activation": "tanh"}}


def network(kind: str, **more: Any) -> NetworkSpec:
    return NetworkSpec(**{**BASE, **KINDS.get(kind, {}), **more})


def tensors_for(spec: NetworkSpec, seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    shapes = spec.tensors.items()
    return {name: (rng.normal(size=s) / np.sqrt(s[-1])).astype(np.float32) for name, s in shapes}


def observations(n: int, size: int = 27, seed: int = 1) -> Any:
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (n, size)).astype(np.float32)


SPECS = {kind: network(kind) for kind in KINDS}


@pytest.mark.parametrize(
    ("output", "last", "expected", "tensors"),
    [("clip", [[1.0, -2.0]], [1.0, -0.5, -1.0, 0.0], 9), ("tanh", [[1.0, -2.0]], np.tanh([3.0, -0.5, -4.0, 0.0]), 10)],
)
def test_actor__relu_then_output_by_hand(output: str, last: Any, expected: Any, tensors: int) -> None:
    spec = NetworkSpec(
        observation_size=1, action_size=1, policy_hidden=(2,), value_hidden=(1,), activation="relu", output=output,
    )  # type: ignore[arg-type]  # fmt: skip
    weights = {name: np.zeros(shape, np.float32) for name, shape in spec.tensors.items()}
    weights["policy.0.weight"][:, 0] = [1.0, -1.0]  # hidden: max(x, 0), max(-x, 0)
    weights["policy.output.weight"][:] = last
    action = Actor(spec, weights)(np.array([[3.0], [-0.25], [-2.0], [0.0]], np.float32))
    np.testing.assert_allclose(action[:, 0], expected, rtol=1e-6)
    assert len(weights) == tensors


@pytest.mark.parametrize("kind", SPECS)
def test_actor__has_the_same_bits_in_any_batch(kind: str) -> None:
    actor, seen = Actor(SPECS[kind], tensors_for(SPECS[kind])), observations(500)
    together = actor(seen)
    assert np.unique(together).size > 5
    for first in (0, 1, 17, 255, 256, 300):
        for n in (0, 1, 2, 63, 64, 200):
            assert np.array_equal(actor(seen[first : first + n]), together[first : first + n]), (first, n)
    shuffled = np.random.default_rng(2).permutation(500)
    assert np.array_equal(actor(seen[shuffled]), together[shuffled])


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_actor__agrees_with_torch(activation: str) -> None:
    spec = network("clip", policy_hidden=(256, 256), activation=activation)
    tensors, seen = tensors_for(spec), observations(1000)
    x, function = torch.from_numpy(seen), torch.nn.functional.relu if activation == "relu" else torch.tanh
    for name in ("policy.0", "policy.1", "policy.output"):
        weight, bias = (torch.from_numpy(tensors[f"{name}.{part}"]) for part in ("weight", "bias"))
        y = torch.nn.functional.linear(x, weight, bias)
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


WRONG: dict[str, dict[str, Any]] = {"less than or equal to 4096": {"policy_hidden": (10**9,)}}


@pytest.mark.parametrize("message", WRONG)
def test_network__is_refused(message: str) -> None:
    with pytest.raises(ValueError) as caught:
        network("", **WRONG[message])
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        (np.zeros((3, 5), np.float32), "observation: has type float32 and shape (3, 5); needs type float32 and shape"),
        (np.zeros(27, np.float32), "observation: has type float32 and shape (27,)"),
        (np.where(np.arange(81).reshape(3, 27) == 29, np.nan, 0).astype(np.float32), "observation[1, 2] = nan: must"),
    ],
)
def test_observation__is_refused(seen: Any, message: str) -> None:
    with refused(message, InvalidInput):
        Actor(SPECS["clip"], tensors_for(SPECS["clip"]))(seen)
