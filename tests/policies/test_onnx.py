from __future__ import annotations

import sys

import numpy as np
import onnxruntime
import pytest

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.errors import MissingExtra
from ethbrake_marl.observations import observe
from ethbrake_marl.physics import advance
from ethbrake_marl.policies import NetworkSpec, Policy
from ethbrake_marl.scenario import load_scenario

STATES = 10_000


def _policy_like(policy: Policy, output: str, activation: str) -> Policy:
    spec = NetworkSpec(
        observation_size=27,
        action_size=1,
        policy_hidden=(64, 48),
        value_hidden=(),
        activation=activation,
        output=output,
    )
    rng = np.random.default_rng(4)
    tensors = {row.name: (rng.normal(size=row.shape) / row.shape[-1] ** 0.5).astype("f4") for row in spec.tensors}
    tensors["policy.output.weight"] *= 3.0  # so that some actions reach the bounds
    fields = {name: getattr(policy.manifest, name) for name in type(policy.manifest).model_fields}
    del fields["weights_sha256"], fields["manifest_sha256"]
    return Policy.make(tensors, **{**fields, "network": spec, "algorithm": "sac" if output == "tanh" else "ppo"})


@pytest.mark.parametrize(("output", "activation"), [("clip", "relu"), ("tanh", "relu"), ("clip", "tanh")])
def test_onnx_model__asks_for_the_same_acceleration_in_10_000_states(
    output: str, activation: str, policy: Policy
) -> None:
    ours = _policy_like(policy, output, activation)
    session = onnxruntime.InferenceSession(ours.to_onnx(), providers=["CPUExecutionProvider"])

    worlds = load_scenario("paper-random").replace(driving_capacity_mps2={"uniform": [1, 3]}).sample(STATES, 5).worlds
    rng = np.random.default_rng(0)
    command = -rng.uniform(0.0, 1.0, worlds.speeds_mps.shape) * worlds.vehicles.braking_capacity_mps2
    worlds, _ = advance(worlds, command, until_s=rng.uniform(0.0, 6.0, STATES))
    seen = observe(worlds, 1, ours.observation)
    action, acceleration = session.run(["action", "acceleration_mps2"], {"observation": seen})

    expected = LearnedAgent(ours).act(worlds, 1)
    assert np.ptp(expected) > 4.0 and (expected > 0.5).any()
    np.testing.assert_allclose(action, ours(seen), rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(acceleration[:, 0], expected, rtol=0.0, atol=1e-4)


def test_onnx_model__says_what_to_install(policy: Policy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MissingExtra, match=r"-m pip install 'ethbrake-marl\[export\]'$"):
        policy.to_onnx()
