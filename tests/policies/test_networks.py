"""What a policy's networks compute: by hand, with the bits of no neighbour, near torch, and as ONNX."""

from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch

from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.episode.observe import View
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.names import open_game
from ethbrake_marl.policies.actor import Actor
from ethbrake_marl.policies.layers import squash
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from tests.refused import refused

FIELDS: dict[str, Any] = {
    "algorithm": "ppo", "learners": ("vehicle_2",), "scenario": {"name": "paper-random", "time_step_s": 0.1},
    "reward": {"harm": 1.0}, "seeds": {"training": 3}, "steps": 1024,
}  # fmt: skip
BASE: dict[str, Any] = {
    "observation_size": 27, "action_size": 1, "policy_hidden": (13, 9), "value_hidden": (), "activation": "relu",
    "output": "clip",
}  # fmt: skip
KINDS: dict[str, dict[str, Any]] = {
    "clip": {"value_hidden": (5,)},
    "tanh": {"output": "tanh", "activation": "tanh"},
    "choice": {"output": "choice", "choices": 33},
    "experts": {"networks": 3, "gate_hidden": (6,)},
    "experts-tanh": {"networks": 2, "gate_hidden": (4, 4), "activation": "tanh", "output": "tanh"},
}


def network(kind: str, **more: Any) -> NetworkSpec:
    return NetworkSpec(**{**BASE, **KINDS.get(kind, {}), **more})


def among() -> NetworkSpec:
    """One that chooses among three experts, a squashed actor, and full braking, coasting, full driving."""
    return network("choice", choices=3, among=(network("experts"), network("tanh")))


def tensors_for(spec: NetworkSpec, seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    shapes = spec.tensors.items()
    tensors = {name: (rng.normal(size=s) / np.sqrt(s[-1])).astype(np.float32) for name, s in shapes}
    for name in ("gate.output", "policy.output") if spec.networks > 1 or spec.among else ():
        if f"{name}.weight" in tensors:  # each choice is the best somewhere
            tensors[f"{name}.weight"] -= tensors[f"{name}.weight"].mean(axis=0)
            tensors[f"{name}.bias"] *= np.float32(0.0)
    return tensors


def observations(n: int, size: int = 27, seed: int = 1) -> Any:
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (n, size)).astype(np.float32)


SPECS = {**{kind: network(kind) for kind in KINDS}, "among": among(), "wide": network("choice", choices=801)}


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


def test_mixture__acts_as_the_expert_of_the_highest_score_the_first_of_equal_ones() -> None:
    spec, seen = SPECS["experts"], observations(300)
    tensors = tensors_for(spec)
    hidden = np.maximum(seen @ tensors["gate.0.weight"].T + tensors["gate.0.bias"], 0.0)
    best = (hidden @ tensors["gate.output.weight"].T + tensors["gate.output.bias"]).argmax(axis=1)
    assert len(set(best)) == 3
    together = Actor(spec, tensors)(seen)
    for number in range(3):
        own = f"network_{number + 1}."
        alone = {name.replace(own, "policy."): each for name, each in tensors.items() if name.startswith(own)}
        assert np.array_equal(together[best == number], Actor(network(""), alone)(seen)[best == number])
    equal = {name: each * np.float32(not name.startswith("gate.output")) for name, each in tensors.items()}
    assert (Actor(spec, equal).expert(np.ascontiguousarray(seen.T)) == 0).all()


def test_among__acts_as_the_policy_or_the_action_of_the_highest_score() -> None:
    spec, seen = SPECS["among"], observations(2000)
    tensors = tensors_for(spec, 4)
    x = seen
    for layer in ("policy.0", "policy.1"):
        x = np.maximum(x @ tensors[f"{layer}.weight"].T + tensors[f"{layer}.bias"], 0.0)
    best = (x @ tensors["policy.output.weight"].T + tensors["policy.output.bias"]).argmax(axis=1)
    inside = [
        {name.removeprefix(f"among_{m}."): each for name, each in tensors.items() if name.startswith(f"among_{m}.")}
        for m in (1, 2)
    ]
    every = [Actor(each, own)(seen) for each, own in zip(spec.among, inside, strict=True)]
    every += [np.full((2000, 1), action, np.float32) for action in (-1.0, 0.0, 1.0)]
    assert set(best) == set(range(5))
    assert np.array_equal(Actor(spec, tensors)(seen), np.choose(best[:, np.newaxis], every))


def test_policy__says_which_format_its_network_needs() -> None:
    versions = {"clip": 2, "tanh": 2, "experts": 3, "choice": 4, "among": 5}
    for kind, version in versions.items():
        policy = Policy.make(tensors_for(SPECS[kind]), network=SPECS[kind], observation=View(), **FIELDS)
        assert policy.manifest.format_version == version


@pytest.mark.parametrize("kind", [kind for kind in SPECS if kind != "wide"])
def test_onnx__asks_for_the_same_acceleration(kind: str) -> None:
    spec = SPECS[kind]
    tensors = tensors_for(spec)
    if "policy.output.weight" in tensors and kind in ("clip", "tanh"):
        tensors["policy.output.weight"] *= np.float32(3.0)  # so that some actions reach the bounds
    policy = Policy.make(tensors, network=spec, observation=View(), **FIELDS)
    scenario, game = open_game("paper-random")
    state = game.reset(scenario.replace(driving_capacity_mps2={"uniform": [1, 3]}).sample(10_000, 5))
    seen = View().observe(state, np.array([2]), 0.1)[:, 0]
    expected, _ = LearnedAgent(policy).act(state, None, 2)
    session = onnxruntime.InferenceSession(policy.to_onnx(), providers=["CPUExecutionProvider"])
    action, acceleration = session.run(["action", "acceleration_mps2"], {"observation": seen})
    near = np.isclose(action, policy(seen), rtol=0.0, atol=1e-5)
    assert np.ptp(expected) > 0.5 and near.mean() > 0.999  # choices between two nearly equal scores may differ
    np.testing.assert_allclose(acceleration[near[:, 0], 0], expected[near[:, 0]], rtol=0.0, atol=1e-4)
    assert session.get_modelmeta().custom_metadata_map["features"].split(",") == list(View().names)


def test_onnx__needs_the_capacities() -> None:
    view = View(["own.speed", "own.driving_capacity"])
    spec = network("clip", observation_size=2)
    policy = Policy.make(tensors_for(spec), network=spec, observation=view, **FIELDS)
    with refused("to_onnx: the policy lacks own.braking_capacity; must observe"):
        policy.to_onnx()


WRONG: dict[str, dict[str, Any]] = {
    "gate_hidden = []: must have a layer if networks is above 1": {"networks": 2},
    "gate_hidden = [4]: must have a layer if": {"gate_hidden": (4,)},
    "value_hidden: must be empty if networks is above 1": {
        "networks": 2, "gate_hidden": (4,), "value_hidden": (5,),
    },
    "choices = None: must be a number if output is 'choice'": {"output": "choice"},
    "choices = 3: must be a number if": {"choices": 3},
    "output = 'choice': needs networks = 1": {"output": "choice", "choices": 3, "networks": 2, "gate_hidden": (4,)},
    "among[0]: needs output = 'choice', no key": {"among": (network("clip"),)},
    "among[0]: needs output = 'choice', no key among of its own": {
        "output": "choice", "choices": 3, "among": (among(),),
    },
    "no key among of its own, and observation_size = 27": {
        "output": "choice", "choices": 3, "among": (network("clip", observation_size=26),),
    },
    "less than or equal to 4096": {"policy_hidden": (10**9,)},
}  # fmt: skip


@pytest.mark.parametrize("message", WRONG)
def test_network__is_refused(message: str) -> None:
    with pytest.raises(ValueError) as caught:
        network("", **WRONG[message])
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        (np.zeros((3, 5), np.float32), "observation: has type float32 and shape (3, 5); needs type float32 and shape"),
        (np.zeros((3, 27)), "observation: has type float64"),
        (np.zeros(27, np.float32), "observation: has type float32 and shape (27,)"),
        (np.where(np.arange(81).reshape(3, 27) == 29, np.nan, 0).astype(np.float32), "observation[1, 2] = nan: must"),
    ],
)
def test_observation__is_refused(seen: Any, message: str) -> None:
    with refused(message, InvalidInput):
        Actor(SPECS["clip"], tensors_for(SPECS["clip"]))(seen)
