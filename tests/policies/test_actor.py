from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import nn

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.policies import Actor, NetworkSpec, dense, squash

Tensors = Callable[[NetworkSpec], dict[str, np.ndarray]]


def _papers_network(observation_size: int) -> NetworkSpec:
    return load_recipe("ppo-paper").network_spec(observation_size)


def _observations(n: int, size: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(-2.0, 2.0, (n, size)).astype(np.float32)


def test_tensors__of_the_papers_network_has_the_tables_tensors() -> None:
    shapes = {row.name: row.shape for row in _papers_network(27).tensors}
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


@pytest.mark.parametrize(("output", "expected"), [("clip", [1.0, -0.5, -1.0]), ("tanh", np.tanh([3.0, -0.5, -4.0]))])
def test_actor__relu_then_output_by_hand(output: str, expected: list[float]) -> None:
    spec = NetworkSpec(
        observation_size=1, action_size=1, policy_hidden=(2,), value_hidden=(1,), activation="relu", output=output
    )
    tensors = {row.name: np.zeros(row.shape, np.float32) for row in spec.tensors}
    tensors["policy.0.weight"][:, 0] = [1.0, -1.0]  # hidden: max(x, 0), max(-x, 0)
    tensors["policy.output.weight"][0] = [1.0, -2.0]
    action = Actor(spec, tensors)(
        np.array([[3.0], [0.25], [2.0]], np.float32) * np.array([[1.0], [-1.0], [-1.0]], "f4")
    )
    np.testing.assert_allclose(action[:, 0], expected, rtol=1e-6)


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_actor__action_is_bitwise_independent_of_the_batch_around_it(activation: str, random_tensors: Tensors) -> None:
    spec = NetworkSpec(
        observation_size=27,
        action_size=1,
        policy_hidden=(256, 256),
        value_hidden=(8,),
        activation=activation,
        output="clip",
    )
    actor, seen = Actor(spec, random_tensors(spec)), _observations(500, 27)
    together = actor(seen)
    assert np.unique(together).size > 400  # else equality below would show nothing
    for first in (0, 1, 3, 17, 63, 64, 255, 256, 300):
        for n in (1, 2, 5, 63, 64, 65, 200):
            assert np.array_equal(actor(seen[first : first + n]), together[first : first + n]), (first, n)
    shuffled = np.random.default_rng(2).permutation(500)
    assert np.array_equal(actor(seen[shuffled]), together[shuffled])


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_actor__agrees_with_torch(activation: str, random_tensors: Tensors) -> None:
    spec = _papers_network(27).model_copy(update={"activation": activation})
    tensors, seen = random_tensors(spec), _observations(1000, 27)
    function = nn.functional.relu if activation == "relu" else torch.tanh
    x = torch.from_numpy(seen)
    for name in ("policy.0", "policy.1"):
        x = function(
            nn.functional.linear(x, torch.tensor(tensors[f"{name}.weight"]), torch.tensor(tensors[f"{name}.bias"]))
        )
    mean = nn.functional.linear(
        x, torch.tensor(tensors["policy.output.weight"]), torch.tensor(tensors["policy.output.bias"])
    )
    np.testing.assert_allclose(Actor(spec, tensors)(seen), mean.clip(-1.0, 1.0).numpy(), rtol=0.0, atol=1e-6)


def test_actor__empty_batch_gives_no_action(random_tensors: Tensors) -> None:
    spec = _papers_network(4)
    assert Actor(spec, random_tensors(spec))(np.empty((0, 4), np.float32)).shape == (0, 1)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (np.zeros((3, 5), np.float32), r"shape \(3, 5\); this policy takes float32 \[n, 4\]"),
        (np.zeros(4, np.float32), r"shape \(4,\)"),
        (np.zeros((3, 4)), "float64"),
        (np.array([[0, 0, 0, 0], [0, 0, np.nan, 0]], np.float32), r"observation\[1, 2\] = nan: must be finite"),
        (np.array([[0, np.inf, 0, 0]], np.float32), r"observation\[0, 1\] = inf"),
    ],
)
def test_actor__refuses_what_it_cannot_mean(observation: np.ndarray, message: str, random_tensors: Tensors) -> None:
    spec = _papers_network(4)
    with pytest.raises(InvalidInput, match=message):
        Actor(spec, random_tensors(spec))(observation)


def test_squash__is_the_rounded_hyperbolic_tangent() -> None:
    x = np.concatenate([np.linspace(-12.0, 12.0, 200_001), np.logspace(-30, 0, 2000), [0.0, -0.0, 1e30, -1e30]])
    single = x.astype(np.float32)[np.newaxis]
    actual = single.copy()
    squash(actual)
    exact = np.tanh(single.astype(np.float64))
    spacing = np.spacing(np.abs(exact).astype(np.float32)).astype(np.float64)
    assert (np.abs(actual - exact) <= 0.5001 * spacing).all()
    assert actual[0, -2:].tolist() == [1.0, -1.0]


@pytest.mark.parametrize("output", ["clip", "tanh"])
def test_actor__a_squashed_action_is_bitwise_independent_of_the_batch(output: str, random_tensors: Tensors) -> None:
    spec = NetworkSpec(
        observation_size=27, action_size=1, policy_hidden=(64,), value_hidden=(), activation="tanh", output=output
    )
    actor, seen = Actor(spec, random_tensors(spec)), _observations(200, 27)
    together = actor(seen)
    alone = np.concatenate([actor(seen[k : k + 1]) for k in range(200)])
    assert np.unique(together).size > 80
    assert np.array_equal(alone, together)
    assert np.array_equal(actor(seen[37:104]), together[37:104])
