"""Policies of bundles and of other libraries drive as they were trained, or are refused in one line."""

from __future__ import annotations

import copy
import pickle
import warnings
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnx
import onnxruntime
import pytest
import stable_baselines3 as stable
import supersuit
import torch
from gymnasium import wrappers
from gymnasium.spaces import Box, Discrete
from stable_baselines3.common import vec_env
from stable_baselines3.common.monitor import Monitor

from ethbrake_marl.agents.drive import Agent, Team, drive
from ethbrake_marl.agents.foreign import ask_torch
from ethbrake_marl.agents.policy_agent import LearnedAgent, policy_agent
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.episode.features import GROUPS
from ethbrake_marl.episode.observe import View
from ethbrake_marl.errors import AgentFailed, InvalidInput, Unfamiliar
from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.faces.sb3 import make_sb3_vec_env
from ethbrake_marl.motion.layout import BRAKING, DRIVING
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.shields.algorithm_1 import EpisodeShield
from ethbrake_marl.shields.step import StepShield
from ethbrake_marl.worlds.game import game_of
from tests.refused import refused

PAPER, GAME = game_of("paper-random")
WORLDS = PAPER.sample(12, 7)
PPO = load_shipped("ppo")
OTHERS = ["own", "rear_1", "front_1"]  # as many features as the usual ones


def harms(agent: Agent, game: Any = GAME, worlds: Any = WORLDS) -> list[float]:
    """The harm in each world if the agent drives Vehicle 2."""
    return drive(game, worlds, Team("mine", {2: agent})).harm("first").tolist()


def commands(agent: Agent, body: int = 2) -> Any:
    """The first commands of a vehicle."""
    state = GAME.begin(WORLDS)
    return agent.act(state, agent.begin(WORLDS, body), body)[0]


def brake(observation: Any) -> Any:
    return np.full((len(observation), 1), -0.5, np.float32)


def answer(value: Any) -> Any:
    return policy_agent(lambda seen: value(len(seen)), name="mine")


# ---------------------------------------------------------------- our own policies


def test_learned_agent__acts_in_fractions_of_the_vehicles_capacity() -> None:
    state = GAME.begin(WORLDS)
    seen = PPO.observation.observe(state, np.array([3]), 0.1)[:, 0]
    action = PPO(seen)[:, 0].astype(float)
    found = LearnedAgent(PPO).act(state, None, 3)[0]
    braking, driving = state.car[:, BRAKING, 3], state.car[:, DRIVING, 3]
    assert found.tolist() == [a * (b if a < 0.0 else d) for a, b, d in zip(action, braking, driving, strict=True)]
    assert len(set(found)) > 5 and pickle.loads(pickle.dumps(LearnedAgent(PPO))).act(state, None, 3)[0][0] == found[0]


@pytest.mark.parametrize(("digest", "warned"), [("0" * 16, True), (None, False)])
def test_learned_agent__warns_in_one_line_of_other_physics(digest: str | None, warned: bool) -> None:
    versions = {k: v for k, v in {**PPO.manifest.versions, "physics": digest}.items() if v is not None}
    policy = type(PPO)(PPO.manifest.model_copy(update={"versions": versions}), PPO.tensors)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        drive(GAME, WORLDS, Team("old", {2: LearnedAgent(policy, "old")}))
    texts = [str(each.message) for each in caught if each.category is Unfamiliar]
    assert len(texts) == warned and all(
        "old: was trained on other physics ('0000000000000000') than" in t for t in texts
    )


def test_learned_agent__is_for_policies_of_one_action() -> None:
    with refused("agent 'learned': policy = <function brake"):
        LearnedAgent(brake)  # type: ignore[arg-type]


# ---------------------------------------------------------------- every kind of policy


def small_net() -> torch.nn.Module:
    torch.manual_seed(3)
    return torch.nn.Sequential(torch.nn.Linear(27, 5), torch.nn.Tanh(), torch.nn.Linear(5, 1), torch.nn.Tanh())


@pytest.fixture(scope="module")
def model() -> Any:
    return stable.PPO("MlpPolicy", make_sb3_vec_env("paper-random", 4), n_steps=8, batch_size=16, seed=1).learn(64)


@pytest.mark.parametrize("shape", [(-1, 1), (-1,)])
def test_function__drives_by_what_it_returns(shape: tuple[int, ...]) -> None:
    agent = policy_agent(lambda seen: -np.abs(seen[:, 1]).clip(0.2, 0.8).reshape(shape))
    expected = -np.abs(View().observe(GAME.begin(WORLDS), np.array([2]), 0.1)[:, 0, 1]).clip(0.2, 0.8)
    state = GAME.begin(WORLDS)
    assert commands(agent) == pytest.approx(expected.astype(float) * state.car[:, BRAKING, 2])
    assert (
        agent.name == "<lambda>" and policy_agent(brake).name == "brake" and policy_agent(brake, name="b").name == "b"
    )


def test_torch_module__drives_as_its_function() -> None:
    net = small_net()
    by_hand = policy_agent(lambda seen: net(torch.from_numpy(seen)).detach().numpy())
    with_gradients = policy_agent(lambda seen: net(torch.from_numpy(seen)))
    assert harms(policy_agent(net)) == harms(by_hand) == harms(with_gradients)
    assert not ask_torch(net, np.zeros((2, 27), np.float32)).requires_grad


@pytest.mark.parametrize("seed", [3, 4])
def test_model__drives_as_in_its_own_librarys_rollout(model: Any, seed: int) -> None:
    env = EthBrakeEnv()
    (seen, _), over, total = env.reset(seed=seed), False, 0.0
    while not over:
        seen, reward, terminated, truncated, _ = env.step(model.predict(seen, deterministic=True)[0])
        total, over = total + float(reward), terminated or truncated
    worlds = PAPER.sample(1, seed, channel="training")
    assert harms(policy_agent(model), worlds=worlds)[0] == pytest.approx(-total, rel=1e-5, abs=1e-5)


def test_onnx__bytes_of_a_file_and_a_session_drive_as_the_policy_does(tmp_path: Path) -> None:
    path = tmp_path / "shipped.onnx"
    path.write_bytes(PPO.to_onnx())
    session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    agents = [policy_agent(given) for given in (path, str(path), session)]
    path.write_bytes(b"written over, after the agent was made")
    for agent in agents:
        assert harms(agent) == pytest.approx(harms(LearnedAgent(PPO)), rel=1e-5, abs=1e-5)
    assert agents[0].name == "shipped"


def ramp(seen: Any, memory: Any) -> Any:
    """Brakes harder with every step; spoils what it was given."""
    steps, kept = memory
    actions = -np.minimum(steps, 10.0) / 10.0
    after = steps + 1.0, kept
    steps[:] = 99.0
    return actions, after


def no_steps(n: int) -> Any:
    return np.zeros((n, 1), np.float32), np.arange(n)


def test_memory__belongs_to_each_world_and_to_nobody_else() -> None:
    agent, state = policy_agent(ramp, initial_state=no_steps), GAME.begin(WORLDS)
    memory = agent.begin(WORLDS, 2)
    for k in range(3):
        before = copy.deepcopy(memory)
        found, after = agent.act(state, memory, 2)
        assert found == pytest.approx(-k / 10.0 * state.car[:, BRAKING, 2])
        assert all(np.array_equal(a, b) for a, b in zip(before, memory, strict=True))
        memory = after
    assert harms(agent) == harms(agent) != harms(policy_agent(brake))


@pytest.mark.parametrize("count", [2, 5, 9])
def test_indices__stand_for_evenly_spaced_actions(count: int) -> None:
    state = GAME.begin(WORLDS)
    for index in range(count):
        share = -1.0 + 2.0 * index / (count - 1)
        for shape in ((-1,), (-1, 1)):
            agent = policy_agent(lambda seen, i=index, s=shape: np.full(len(seen), i).reshape(s), actions=count)
            capacity = state.car[:, BRAKING if share < 0.0 else DRIVING, 2]
            assert commands(agent) == pytest.approx(share * capacity)


@pytest.mark.parametrize("beyond", [1.5, float(np.nextafter(np.float32(1), np.float32(2)))])
def test_clip__means_the_nearest_action_and_one_float32_step_beyond_is_always_1(beyond: float) -> None:
    agent = policy_agent(lambda seen: np.full((len(seen), 1), -beyond), clip=beyond == 1.5)
    assert commands(agent).tolist() == (-GAME.begin(WORLDS).car[:, BRAKING, 2]).tolist()
    agent = policy_agent(lambda seen: np.full(len(seen), 7), clip=True, actions=5)
    assert commands(agent).tolist() == GAME.begin(WORLDS).car[:, DRIVING, 2].tolist()


class Braking:
    """A function that can be pickled."""

    def __call__(self, seen: Any) -> Any:
        return brake(seen)


def test_agent__can_be_pickled_where_its_policy_can(model: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.onnx"
    path.write_bytes(PPO.to_onnx())
    for given in (brake, Braking(), partial(brake), small_net(), path, model.policy):
        agent = policy_agent(given)
        assert harms(pickle.loads(pickle.dumps(agent))) == harms(agent)
    agent = policy_agent(ramp, initial_state=no_steps, actions=None)
    assert harms(pickle.loads(pickle.dumps(agent))) == harms(agent)


# ---------------------------------------------------------------- what it observes


TRAINED_ON = [OTHERS, ["own", "rear_1", "rear_2"], ["own", "front_1.gap", "place"], ["own", "obstacle", "role"]]


@pytest.mark.parametrize("features", TRAINED_ON, ids=lambda each: "+".join(each))
@pytest.mark.parametrize("around", ["rows", "DummyVecEnv", "VecNormalize", "SuperSuit"])
def test_model__observes_what_it_was_trained_on_even_from_a_file(
    features: list[str], around: str, tmp_path: Path
) -> None:
    if around == "DummyVecEnv":
        env: Any = vec_env.DummyVecEnv([lambda: Monitor(EthBrakeEnv(observation=features))])
    elif around == "SuperSuit":
        rows = supersuit.pettingzoo_env_to_vec_env_v1(EthBrakeParallelEnv(agents="learners", observation=features))
        env = supersuit.concat_vec_envs_v1(rows, 2, base_class="stable_baselines3")
    else:
        env = make_sb3_vec_env("paper-random", 2, observation=features)
    env = vec_env.VecNormalize(env) if around == "VecNormalize" else env
    trained = stable.PPO("MlpPolicy", env, policy_kwargs={"net_arch": [4]})
    trained.save(tmp_path / "model")
    view = View(features)
    by_hand = harms(policy_agent(partial(predicted, trained), observation=features))
    for each in (trained, trained.policy, stable.PPO.load(tmp_path / "model")):
        agent = policy_agent(each, clip=True)
        assert agent.observation == view
        if around != "VecNormalize":
            assert harms(agent) == by_hand
    with refused("agent 'PPO': observation lists other features than the policy was trained on"):
        policy_agent(trained, observation=["own"])


def predicted(model: Any, seen: Any) -> Any:
    return model.predict(seen, deterministic=True)[0]


@pytest.mark.parametrize("features", [OTHERS, [*OTHERS, "place"]], ids=len)
def test_onnx__observes_what_its_metadata_name(features: list[str], tmp_path: Path) -> None:
    model = onnx.load_model_from_string(PPO.to_onnx())
    if len(features) == 3:
        onnx.helper.set_model_props(model, {"features": ",".join(View(features).names)})
        agent = policy_agent(model.SerializeToString(), name="file")
        assert agent.observation == View(features) and harms(agent) != harms(LearnedAgent(PPO))
        with refused("agent 'file': observation lists other features than the policy was trained on"):
            policy_agent(model.SerializeToString(), name="file", observation=["own", "front_1", "rear_1"])
    else:
        del model.metadata_props[:]
        agent = policy_agent(model.SerializeToString(), name="file", observation=features)
        with refused("agent 'file', vehicle_2: act fails", AgentFailed):
            harms(agent)


OBSTACLE = game_of("paper-random-obstacle")


@pytest.mark.parametrize("given", [brake, small_net()], ids=["function", "torch module"])
def test_policy_that_says_nothing__is_asked_for_its_features_where_they_are_not_the_usual_ones(given: Any) -> None:
    own = game_of("paper-random", observation=OTHERS)
    for scenario, game in (OBSTACLE, own):
        with refused("nothing says which features the policy observes, and vehicle_2 of scenario 'paper-random"):
            drive(game, scenario.sample(3, 7), Team("mine", {2: policy_agent(given)}))
        drive(game, scenario.sample(3, 7), Team("mine", {2: policy_agent(given, observation=View())}))
    agent = policy_agent(brake, scenario=OBSTACLE[0])
    assert agent.observation == OBSTACLE[1].views[2] and "obstacle.gap" in agent.observation.names
    drive(OBSTACLE[1], OBSTACLE[0].sample(3, 7), Team("mine", {2: agent}))
    assert policy_agent(brake, scenario=own[0]).observation == View(OTHERS)


def test_list_of_features__may_be_any_sequence() -> None:
    for listed in (OTHERS, tuple(OTHERS), deque(OTHERS), View(OTHERS)):
        assert policy_agent(brake, observation=listed).observation == View(OTHERS)


@pytest.mark.skipif("contact" not in GROUPS, reason="the extension with these features is not installed")
def test_forecasts__need_the_scenario_for_its_time_step() -> None:
    listed = ["own", "contact.brake_front_time"]
    with refused("agent 'brake': observes forecasts, which need the time between two decisions; pass scenario="):
        policy_agent(brake, observation=listed)
    assert policy_agent(brake, observation=listed, scenario="paper-random").time_step_s == PAPER.time_step_s


def test_rows_with_more_than_a_vehicle_observes__are_refused() -> None:
    for appended in ("number", "state"):
        rows = make_sb3_vec_env("cooperation-3-pair", 2, appended=appended)  # type: ignore[arg-type]  # a literal
        with refused("agent 'PPO': was trained on what no vehicle observes: unknown feature"):
            policy_agent(stable.PPO("MlpPolicy", rows))


# ---------------------------------------------------------------- wrappers and statistics


class Negated(gymnasium.ActionWrapper[Any, Any, Any]):
    def action(self, action: Any) -> Any:
        return -action


class Stepping(gymnasium.Wrapper[Any, Any, Any, Any]):
    def step(self, action: Any) -> Any:
        return self.env.step(0.5 * action)


class OwnEnv(EthBrakeEnv):
    def step(self, action: Any) -> Any:
        return super().step(-action)


class TimeLimit(Negated):
    """Of another library than the one that changes nothing."""


CHANGING: dict[str, Any] = {
    "RescaleAction": lambda: wrappers.RescaleAction(EthBrakeEnv(), np.float32(-1), np.float32(1)),
    "TransformObservation": lambda: wrappers.TransformObservation(EthBrakeEnv(), lambda seen: seen * 0.5, None),
    "NormalizeObservation": lambda: wrappers.NormalizeObservation(EthBrakeEnv()),
    "Negated": lambda: Negated(EthBrakeEnv()),
    "Stepping": lambda: Monitor(wrappers.TimeLimit(Stepping(EthBrakeEnv()), 50)),
    "TimeLimit": lambda: TimeLimit(EthBrakeEnv()),
    "OwnEnv": OwnEnv,
    "PendulumEnv": lambda: gymnasium.make("Pendulum-v1"),
    "VecFrameStack": lambda: vec_env.VecFrameStack(make_sb3_vec_env("paper-random", 2), 1),
    "Transposed": lambda: Transposed(make_sb3_vec_env("paper-random", 2)),
    "VecNormalize inside another one": lambda: vec_env.VecNormalize(
        vec_env.VecNormalize(make_sb3_vec_env("paper-random", 2))
    ),
    "SubprocVecEnv": lambda: vec_env.SubprocVecEnv([EthBrakeEnv] * 2, "fork"),
    "FrameStackModifier": lambda: supersuit.concat_vec_envs_v1(
        supersuit.pettingzoo_env_to_vec_env_v1(supersuit.frame_stack_v1(EthBrakeParallelEnv(agents="learners"), 1)),
        2,
        base_class="stable_baselines3",
    ),
}


class Transposed(vec_env.VecEnvWrapper):
    """Changes nothing, as far as anybody can tell from outside."""

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        return self.venv.step_wait()


@pytest.mark.parametrize("learn", [False, True])
@pytest.mark.parametrize("name", CHANGING)
def test_wrapper_that_may_change_something__is_named(name: str, learn: bool) -> None:
    env = CHANGING[name]()
    trained = stable.PPO("MlpPolicy", env, n_steps=4, batch_size=4, policy_kwargs={"net_arch": [4]})
    if learn:
        trained.learn(8)
    with refused(f"agent 'PPO': the model was trained under {name}, which may change observations or actions"):
        policy_agent(trained, clip=True)
    if name not in ("PendulumEnv", "VecNormalize inside another one"):
        assert policy_agent(trained, ignore_wrappers=True).name == "PPO"
    env.close()


HARMLESS: dict[str, Any] = {
    "OrderEnforcing": wrappers.OrderEnforcing,
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 50),
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda reward: reward * 0.1),
    "NormalizeReward": wrappers.NormalizeReward,
    "Monitor": Monitor,
    "several": lambda env: Monitor(wrappers.TimeLimit(wrappers.OrderEnforcing(env), 9)),
}


@pytest.mark.parametrize("name", HARMLESS)
def test_wrapper_that_changes_nothing__is_let_through(name: str) -> None:
    trained = stable.PPO("MlpPolicy", HARMLESS[name](EthBrakeEnv()), policy_kwargs={"net_arch": [4]})
    assert harms(policy_agent(trained)) == harms(policy_agent(partial(predicted, trained)))


def test_vec_normalize__is_applied_with_its_present_statistics() -> None:
    env = vec_env.VecNormalize(vec_env.VecMonitor(make_sb3_vec_env("paper-random", 4)), clip_obs=2.0)
    trained = stable.PPO("MlpPolicy", env, n_steps=64, batch_size=256, n_epochs=1, seed=1).learn(256)
    by_hand = policy_agent(lambda seen: predicted(trained, env.normalize_obs(seen)))
    agent, mean = policy_agent(trained), env.obs_rms.mean.copy()  # type: ignore[union-attr]  # no dictionary
    assert harms(agent) == harms(by_hand) != harms(policy_agent(trained.policy))
    assert np.array_equal(env.obs_rms.mean, mean)  # type: ignore[union-attr]  # driving has counted nothing


@pytest.mark.parametrize("algorithm", [stable.PPO, stable.A2C, stable.SAC, stable.TD3])
def test_model_from_a_file__needs_the_statistics_it_was_trained_under(algorithm: Any, tmp_path: Path) -> None:
    on_policy = algorithm in (stable.PPO, stable.A2C)
    rows = {"n_steps": 32} if on_policy else {"learning_starts": 8, "buffer_size": 100}
    for normalised in (False, True):
        env: Any = make_sb3_vec_env("paper-random", 2)
        env = vec_env.VecNormalize(env) if normalised else env
        trained = algorithm("MlpPolicy", env, seed=1, policy_kwargs={"net_arch": [4]}, **rows).learn(128)
        trained.save(tmp_path / "model.zip")
        loaded = algorithm.load(tmp_path / "model.zip")
        if not normalised:
            assert harms(policy_agent(loaded)) == harms(policy_agent(trained))
            continue
        with refused("was trained under VecNormalize, whose statistics are missing; load them with model.set_env"):
            policy_agent(loaded, clip=True)
        assert policy_agent(loaded, ignore_wrappers=True).name == algorithm.__name__
        if on_policy:  # the others forget what they saw last
            with refused("was trained under VecNormalize, whose statistics are missing"):
                policy_agent(algorithm.load(tmp_path / "model.zip", env=make_sb3_vec_env("paper-random", 2)))
        env.save(str(tmp_path / "statistics.pkl"))
        loaded.set_env(vec_env.VecNormalize.load(str(tmp_path / "statistics.pkl"), make_sb3_vec_env("paper-random", 2)))
        assert harms(policy_agent(loaded)) == harms(policy_agent(trained))


# ---------------------------------------------------------------- actions


class Spaced:
    """A model with an action space."""

    def __init__(self, space: Any) -> None:
        self.action_space = space

    def predict(self, seen: Any, deterministic: bool) -> Any:
        return np.zeros((len(seen), 1), np.int64)


@pytest.mark.parametrize(
    ("space", "settings"),
    [
        (Box(0.0, 1.0, (1,)), {}), (Box(-2.0, 2.0, (1,)), {"clip": True}), (Box(-1.0, 1.0, (2,)), {}),
        (Discrete(3), {}), (Discrete(3), {"actions": 5}), (Discrete(3, start=1), {"actions": 3}),
        (Box(-1.0, 1.0, (1,)), {"actions": 3}),
    ],
    ids=str,
)  # fmt: skip
def test_action_space__must_be_what_the_agent_takes(space: Any, settings: dict[str, Any]) -> None:
    with refused("agent 'Spaced': the actions of the policy are in"):
        policy_agent(Spaced(space), **settings)
    assert policy_agent(Spaced(space), ignore_wrappers=True, **settings).name == "Spaced"


def test_discrete_actions_of_our_environments__are_known_from_the_space(tmp_path: Path) -> None:
    trained = stable.DQN("MlpPolicy", EthBrakeEnv(actions=5), policy_kwargs={"net_arch": [4]}, buffer_size=50)
    trained.save(tmp_path / "model")
    loaded = stable.DQN.load(tmp_path / "model")
    given = policy_agent(partial(predicted, trained), actions=5)
    assert harms(policy_agent(trained)) == harms(policy_agent(loaded)) == harms(given)
    assert policy_agent(Spaced(Discrete(4)), actions=4).actions == 4


WRONG: dict[str, Any] = {
    "returned float64 of shape (12, 2); must return a number in [-1, 1]": lambda n: np.zeros((n, 2)),
    "returned float64 of shape (7,); must return": lambda n: np.zeros(7),
    "returned float64 of shape (); must return": lambda n: 0.5,
    "returned object of shape (0,); must return": lambda n: [[1.0], [1.0, 2.0]],
    "returned <U1 of shape (12,); must return": lambda n: ["a"] * n,
    "returned bool of shape (12,); must return": lambda n: [True] * n,
    "returned complex128 of shape (12,); must return": lambda n: np.zeros(n, complex),
    "returned object of shape (); must return": lambda n: None,
    "returned 2 values; must return": lambda n: (np.zeros((n, 1)), None),
}


@pytest.mark.parametrize("message", WRONG)
def test_answer_of_a_wrong_form__is_refused_with_the_vehicle(message: str) -> None:
    with refused(f"agent 'mine', vehicle_2: {message}", AgentFailed):
        harms(answer(WRONG[message]))


BEYOND: dict[str, Any] = {
    "action 1.5; must be a number in [-1, 1]; clip=True clips": lambda n: 1.5 * np.eye(n)[:, 3:4],
    "action nan; must be a number": lambda n: np.where(np.arange(n) == 3, np.nan, 0.0),
    "action inf; must be": lambda n: np.where(np.arange(n) == 3, np.inf, 0.0),
    "action -1e+300; must be": lambda n: np.where(np.arange(n) == 3, -1e300, 0.0),
    "action nan; must be a": lambda n: np.ma.masked_array(np.zeros(n), np.arange(n) == 3),
}


@pytest.mark.parametrize("message", BEYOND)
def test_answer_out_of_range__is_refused_with_world_and_time(message: str) -> None:
    with refused(f"agent 'mine', world 3, vehicle_2 at 0.50 s: {message}", AgentFailed):
        harms(answer(BEYOND[message]))


@pytest.mark.parametrize(("index", "message"), [(5, "action 5"), (-1, "action -1"), (1.0, "returned float64")])
def test_index__must_be_one_of_the_actions(index: Any, message: str) -> None:
    with refused(f"{message}", AgentFailed) as caught:
        harms(policy_agent(lambda seen: np.full(len(seen), index), actions=5, name="mine"))
    assert "an index from 0 to 4" in str(caught.value)


# ---------------------------------------------------------------- refusals


class Recurrent:
    def predict(self, seen: Any, deterministic: bool) -> Any:
        return np.zeros((len(seen), 1)), np.zeros((1, len(seen), 8))


class Layer(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.cell = torch.nn.GRU(27, 4, num_layers=2, dropout=0.5)


def wide_onnx(inputs: int, outputs: list[str]) -> Any:
    """A model that copies its inputs."""
    value, names = onnx.helper.make_tensor_value_info, [f"x{k}" for k in range(inputs)]
    nodes = [onnx.helper.make_node("Identity", [names[0]], [name]) for name in outputs]
    ends = [[value(each, onnx.TensorProto.FLOAT, ["n", 27]) for each in side] for side in (names, outputs)]
    graph = onnx.helper.make_graph(nodes, "copy", *ends)
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)])
    model.ir_version = 8
    return model.SerializeToString()


REFUSED: dict[str, Any] = {
    "agent 'int': policy = 3: must be a function of observations": lambda: policy_agent(3),
    "agent 'Policy': policy = Policy('ppo', 27 observations": lambda: policy_agent(PPO),
    "agent 'none': policy = 'runs/none': must be the path of an .onnx file; the policy": lambda: policy_agent(
        "runs/none"
    ),
    "none.onnx: the file does not exist": lambda: policy_agent(Path("none.onnx")),
    "agent 'bytes': the file is no ONNX model that can be run": lambda: policy_agent(b"\x08\x07 not a model"),
    "agent 'two': the ONNX model has the inputs ['x0', 'x1']": lambda: policy_agent(wide_onnx(2, ["y"]), name="two"),
    "and the outputs ['y', 'z']; must have one input": lambda: policy_agent(wide_onnx(1, ["y", "z"]), name="two"),
    "agent 'brake': actions = 1: must be a whole number, at least 2": lambda: policy_agent(brake, actions=1),
    "agent 'brake': actions = 2.5: must be": lambda: policy_agent(brake, actions=2.5),  # type: ignore[arg-type]
    "agent 'Sequential': initial_state = <function no_steps": lambda: policy_agent(small_net(), initial_state=no_steps),
    "agent 'ramp': initial_state = 3: must be a function": lambda: policy_agent(ramp, initial_state=3),  # type: ignore[arg-type]
    "agent 'Sequential': the layer Dropout is in training mode": lambda: policy_agent(
        torch.nn.Sequential(torch.nn.Linear(27, 1), torch.nn.Dropout(0.5))
    ),
    "agent 'Sequential': the layer BatchNorm1d is in": lambda: policy_agent(
        torch.nn.Sequential(torch.nn.BatchNorm1d(27), torch.nn.Linear(27, 1))
    ),
    "agent 'Layer': the layer GRU is in training mode": lambda: policy_agent(Layer()),
    "unknown feature 'own.sped'": lambda: policy_agent(brake, observation=["own.sped"]),
    "unknown scenario 'paper-randon'": lambda: policy_agent(brake, scenario="paper-randon"),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", REFUSED)
def test_policy_of_another_library__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()


def test_training_mode__is_left_by_eval_and_does_not_matter_without_such_layers() -> None:
    net = torch.nn.Sequential(torch.nn.Linear(27, 1), torch.nn.Dropout(0.5), torch.nn.Tanh()).eval()
    assert harms(policy_agent(net)) and small_net().training and harms(policy_agent(small_net()))


def test_model_with_a_memory__is_refused_when_it_shows_it() -> None:
    with refused("predict returned a state, so the model has a memory; write a function"):
        harms(policy_agent(Recurrent()))


@pytest.mark.parametrize(
    "memory", [lambda n: np.zeros(n + 1), lambda n: 0.0, lambda n: {"a": 1}, lambda n: (np.zeros(n), [object()] * n)]
)
def test_memory__has_one_row_for_each_world(memory: Any) -> None:
    right = "must be an array with one row for each of 12 worlds, or a tuple of such arrays"
    with refused(right, AgentFailed):
        harms(policy_agent(ramp, initial_state=memory))
    with refused(right, AgentFailed):
        harms(policy_agent(lambda seen, kept: (brake(seen), memory(len(seen))), initial_state=np.zeros))


@pytest.mark.parametrize("both", [lambda seen, kept: brake(seen), lambda seen, kept: (brake(seen), kept, kept)])
def test_function_with_a_memory__returns_a_pair(both: Any) -> None:
    with refused("with initial_state must return a pair of actions and state", AgentFailed):
        harms(policy_agent(both, initial_state=np.zeros))


@pytest.mark.parametrize("shield", [StepShield, EpisodeShield])
@pytest.mark.parametrize("kind", ["function with a memory", "model"])
def test_policy_behind_a_shield__keeps_the_bound(shield: Any, kind: str, model: Any) -> None:
    agent = policy_agent(ramp, initial_state=no_steps) if kind != "model" else policy_agent(model, clip=True)
    alone = drive(GAME, WORLDS, Team("alone", {2: agent}))
    last = drive(GAME, WORLDS, Team("mine", {2: agent}, shield({2: agent})))
    assert (last.harm("first") <= infos_of(shield, agent, last)["shield_bound_harm"] + 1e-9).all()
    assert last.harm("first").sum() < alone.harm("first").sum()


def infos_of(shield: Any, agent: Agent, last: Any) -> Any:
    """The infos of a shielded game."""
    return Team("mine", {2: agent}, shield({2: agent})).game(GAME).own_infos(last)


def raising(seen: Any) -> Any:
    raise KeyError("weights")


def chained(seen: Any) -> Any:
    try:
        raising(seen)
    except KeyError as error:
        raise InvalidInput("inner") from error


@pytest.mark.parametrize("function", [raising, chained, lambda seen: np.full(len(seen), np.nan), lambda seen: seen])
def test_failure__names_the_agent_and_has_no_circle(function: Any) -> None:
    with pytest.raises(InvalidInput) as caught:
        harms(policy_agent(function, name="mine"))
    if function is not chained:
        assert "agent 'mine'" in str(caught.value)
    seen: list[Any] = []
    todo: list[BaseException | None] = [caught.value]
    while todo:
        error = todo.pop()
        if error is not None:
            assert error not in seen
            seen.append(error)
            todo += [error.__cause__] if error.__cause__ is not None else [error.__context__]
    assert len(seen) <= 2
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


# ---------------------------------------------------------------- teams


def test_team_of_vehicles__drives() -> None:
    scenario, game = game_of("cooperation-3-pair")
    team = Team.of({"vehicle_2": policy_agent(brake), "vehicle_3": Held("full_brake")}, "mine")
    assert team.drivers.keys() == {2, 3} and drive(game, scenario.sample(3, 7), team).ended.all()


@pytest.mark.parametrize(
    ("drivers", "message"),
    [
        ({"vehicle_2": small_net()}, "team 't': vehicle_2 = Sequential("),
        ({"vehicle_2": "coast"}, "has no name and no knows and no begin and no act; must be an agent, which has name"),
        ({"vehicle_2": brake}, "policy_agent(model) or LearnedAgent(policy)"),
        ({2: Held("full_brake")}, "team 't': 2: must be the name of a vehicle, such as vehicle_2"),
        ({"vehicle_0": Held("full_brake")}, "team 't': 'vehicle_0': must be the name of a vehicle"),
    ],
)
def test_team__is_made_of_agents(drivers: Any, message: str) -> None:
    with refused(message):
        Team.of(drivers, "t")
