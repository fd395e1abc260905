"""The ONNX model of a policy asks for what the policy asks for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.policy_agent import LearnedAgent, policy_agent
from ethbrake_marl.episode.observe import View
from ethbrake_marl.extensions.onnx import to_onnx
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.training_range import TrainingRange
from tests.agents.test_policy_agent import PPO, harms
from tests.fixtures.commands import Refuse
from tests.policies.test_networks import FIELDS, SPECS, network, tensors_for
from tests.refused import refused


@pytest.mark.parametrize("kind", SPECS)
def test_onnx__asks_for_the_same_acceleration(kind: str) -> None:
    spec = SPECS[kind]
    tensors = tensors_for(spec)
    tensors["policy.output.weight"] *= np.float32(3.0)  # so that some actions reach the bounds
    policy = Policy.make(tensors, network=spec, observation=View(), **FIELDS)
    scenario, game = open_game("paper-random")
    state = game.reset(scenario.replace(driving_capacity_mps2={"uniform": [1, 3]}).sample(10_000, 5))
    seen = View().observe(state, np.array([2]), 0.1)[:, 0]
    expected, _ = LearnedAgent(policy).act(state, None, 2)
    session = onnxruntime.InferenceSession(to_onnx(policy), providers=["CPUExecutionProvider"])
    action, acceleration = session.run(["action", "acceleration_mps2"], {"observation": seen})
    np.testing.assert_allclose(action, policy(seen), rtol=0.0, atol=1e-5)
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(acceleration[:, 0], expected, rtol=0.0, atol=1e-4)
    assert session.get_modelmeta().custom_metadata_map["features"].split(",") == list(View().names)


def test_onnx__needs_the_capacities() -> None:
    view = View(["own.speed", "own.driving_capacity"])
    spec = network("clip", observation_size=2)
    policy = Policy.make(tensors_for(spec), network=spec, observation=view, **FIELDS)
    with refused("to_onnx: the policy lacks own.braking_capacity; must observe"):
        to_onnx(policy)


def test_session__drives_as_the_policy_does() -> None:
    session = onnxruntime.InferenceSession(to_onnx(PPO), providers=["CPUExecutionProvider"])
    agent = policy_agent(
        lambda seen: session.run(["action"], {"observation": seen})[0], observation=PPO.observation.names
    )
    assert harms(agent) == pytest.approx(harms(LearnedAgent(PPO)), rel=1e-5, abs=1e-5)


def test_model__has_the_range_of_the_training() -> None:
    metadata = {entry.key: entry.value for entry in onnx.load_model_from_string(to_onnx(PPO)).metadata_props}
    assert TrainingRange.model_validate_json(metadata["training_range"]) == PPO.manifest.training_range


def test_export__replaces_a_file_only_by_force(refuse: Refuse) -> None:
    Path("mine.onnx").write_bytes(b"mine")
    refuse("agent export ppo --onnx mine.onnx", "mine.onnx: already exists")
