"""The ONNX model of a policy asks for what the policy asks for."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.policy_agent import LearnedAgent, policy_agent
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.episode.observe import View
from ethbrake_marl.errors import AgentFailed
from ethbrake_marl.extensions.onnx import to_onnx
from ethbrake_marl.policies.policy import Policy
from tests.agents.test_policy_agent import OTHERS, PPO, actions, harms
from tests.fixtures.commands import Refuse
from tests.policies.test_networks import FIELDS, SPECS, network, tensors_for
from tests.refused import refused


@pytest.mark.parametrize("kind", [kind for kind in SPECS if kind != "wide"])
def test_onnx__asks_for_the_same_acceleration(kind: str) -> None:
    spec = SPECS[kind]
    tensors = tensors_for(spec)
    if kind in ("clip", "tanh"):
        tensors["policy.output.weight"] *= np.float32(3.0)  # so that some actions reach the bounds
    policy = Policy.make(tensors, network=spec, observation=View(), **FIELDS)
    scenario, game = open_game("paper-random")
    state = game.reset(scenario.replace(driving_capacity_mps2={"uniform": [1, 3]}).sample(10_000, 5))
    seen = View().observe(state, np.array([2]), 0.1)[:, 0]
    expected, _ = LearnedAgent(policy).act(state, None, 2)
    session = onnxruntime.InferenceSession(to_onnx(policy), providers=["CPUExecutionProvider"])
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
        to_onnx(policy)


def test_onnx__bytes_of_a_file_and_a_session_drive_as_the_policy_does(tmp_path: Path) -> None:
    path = tmp_path / "shipped.onnx"
    path.write_bytes(to_onnx(PPO))
    session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    agents = [policy_agent(given) for given in (path, str(path), session)]
    path.write_bytes(b"written over, after the agent was made")
    for agent in agents:
        assert harms(agent) == pytest.approx(harms(LearnedAgent(PPO)), rel=1e-5, abs=1e-5)
    assert agents[0].name == "shipped"
    assert actions(pickle.loads(pickle.dumps(agents[0]))) == actions(agents[0])


def test_onnx__observes_what_its_metadata_name() -> None:
    model = onnx.load_model_from_string(to_onnx(PPO))
    onnx.helper.set_model_props(model, {"features": ",".join(View(OTHERS).names)})
    agent = policy_agent(model.SerializeToString(), name="file")
    assert agent.observation == View(OTHERS) and harms(agent) != harms(LearnedAgent(PPO))
    with refused("agent 'file': observation lists other features than the policy was trained on"):
        policy_agent(model.SerializeToString(), name="file", observation=["own", "front_1", "rear_1"])
    del model.metadata_props[:]
    agent = policy_agent(model.SerializeToString(), name="file", observation=[*OTHERS, "place"])
    with refused("agent 'file', vehicle_2: act fails", AgentFailed):
        harms(agent)


def test_onnx__knows_the_range_of_its_training() -> None:
    ranged = PPO.with_range(PPO.manifest.training_range.model_copy(update={"fallback": "plan.action"}))
    agent = policy_agent(to_onnx(ranged), name="file")
    assert agent.training_range == ranged.manifest.training_range
    scenario, game = open_game("cooperation-1-front")
    worlds = scenario.sample(12, 7)
    alone, file = (play_to_end(game, worlds, Team("mine", {2: mine})) for mine in (LearnedAgent(ranged), agent))
    np.testing.assert_allclose(file.harm("honest"), alone.harm("honest"), rtol=1e-4, atol=1e-4)
    assert file.memories[2].outside.tolist() == alone.memories[2].outside.tolist() and alone.memories[2].outside.all()


@pytest.mark.parametrize(
    ("text", "refusal"),
    [
        ("{", "agent 'file': training_range in the model's metadata: "),
        ('{"low": [0], "high": [1]}', "agent 'file': training_range in the model's metadata must have 27 features"),
    ],
)
def test_onnx__with_a_bad_range_is_refused(text: str, refusal: str) -> None:
    model = onnx.load_model_from_string(to_onnx(PPO))
    onnx.helper.set_model_props(model, {"features": ",".join(PPO.observation.names), "training_range": text})
    with refused(refusal):
        policy_agent(model.SerializeToString(), name="file")


def test_export__replaces_a_file_only_by_force(refuse: Refuse) -> None:
    Path("mine.onnx").write_bytes(b"mine")
    refuse("agent export ppo --onnx mine.onnx", "mine.onnx: already exists")
