"""Policies of bundles and of other libraries drive as they were trained, or are refused in one line."""

from __future__ import annotations

import copy
import pickle
import warnings
from collections import deque
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import stable_baselines3 as stable
import torch
from gymnasium import wrappers
from gymnasium.spaces import Box, Discrete
from stable_baselines3.common import vec_env
from stable_baselines3.common.monitor import Monitor

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.action_scale import ActionScale
from ethbrake_marl.agents.policy_agent import LearnedAgent, policy_agent
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.agents.team import Agent, Team, play_to_end
from ethbrake_marl.episode.features import GROUPS
from ethbrake_marl.episode.observe import View
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import AgentFailed, InvalidInput, Unfamiliar
from ethbrake_marl.evaluation.evaluate import evaluate
from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.faces.sb3 import make_sb3_vec_env
from ethbrake_marl.motion.layout import BRAKING, DRIVING
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.policies.training_range import TrainingRange
from ethbrake_marl.shields.algorithm_1 import EpisodeShield
from ethbrake_marl.shields.step import StepShield
from tests.refused import refused

PAPER, GAME = open_game("paper-random")
OBSTACLE = open_game("paper-random-obstacle")
PPO = load_shipped("ppo")
OTHERS = ["own", "rear_1", "front_1"]  # as many features as the usual ones
TINY = {"net_arch": [4]}


@cache
def sampled() -> State:
    return PAPER.sample(12, 7)


def harms(agent: Agent, game: Any = GAME, worlds: State | None = None) -> list[float]:
    return play_to_end(game, sampled() if worlds is None else worlds, Team("mine", {2: agent})).harm("first").tolist()


def actions(agent: Agent) -> list[float]:
    state = GAME.reset(sampled())
    command = agent.act(state, agent.begin(sampled(), 2), 2)[0]
    return (command / np.where(command < 0.0, state.car[:, BRAKING, 2], state.car[:, DRIVING, 2])).tolist()


def brake(observation: Any) -> Any:
    return np.full((len(observation), 1), -0.5, np.float32)


def predicted(model: Any, seen: Any) -> Any:
    return model.predict(seen, deterministic=True)[0]


def small_net() -> torch.nn.Module:
    torch.manual_seed(3)
    return torch.nn.Sequential(torch.nn.Linear(27, 5), torch.nn.Tanh(), torch.nn.Linear(5, 1), torch.nn.Tanh())


def rows(n: int = 2, **settings: Any) -> Any:
    return make_sb3_vec_env("paper-random", n, **settings)


# ---------------------------------------------------------------- our own policies


def test_learned_agent__acts_in_fractions_of_the_vehicles_capacity() -> None:
    state = GAME.reset(sampled())
    action = PPO(PPO.observation.observe(state, np.array([3]), 0.1)[:, 0])[:, 0].astype(float)
    command = LearnedAgent(PPO).act(state, None, 3)[0]
    braking, driving = state.car[:, BRAKING, 3], state.car[:, DRIVING, 3]
    assert command.tolist() == [a * (b if a < 0.0 else d) for a, b, d in zip(action, braking, driving, strict=True)]
    assert len(set(command)) > 5


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"versions": {"physics": "0" * 16}}, "old: was trained on other physics ('0000000000000000') than this"),
        ({"versions": {}}, None),
        (
            {"scenario": {**PPO.manifest.scenario, "time_step_s": 0.2}},
            "old: decided every 0.2 s in its training, but decides every 0.1 s in scenario 'paper-",
        ),
    ],
)
def test_learned_agent__warns_of_another_training(change: dict[str, Any], text: str | None) -> None:
    policy = type(PPO)(PPO.manifest.model_copy(update=change), PPO.tensors)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        play_to_end(GAME, sampled(), Team("old", {2: LearnedAgent(policy, "old")}))
    texts = [str(each.message) for each in caught if each.category is Unfamiliar]
    assert len(texts) == (text is not None) and all(each.startswith(text or "") for each in texts)


def test_learned_agent__is_for_policies_of_one_action() -> None:
    with refused("agent 'learned': policy = <function brake"):
        LearnedAgent(brake)  # type: ignore[arg-type]


def ranged(high: float) -> LearnedAgent:
    """Agent whose range holds no world, or every one if ``high`` is large."""
    size = len(PPO.observation.features)
    return LearnedAgent(PPO.with_range(TrainingRange(low=(-high,) * size, high=(high,) * size)))


def test_learned_agent__counts_decisions_outside_its_range_also_behind_a_shield() -> None:
    for agent, share in ((ranged(0.0), 1.0), (ranged(99.0), 0.0)):
        last = play_to_end(GAME, sampled(), Team("mine", {2: agent}))
        assert (last.memories[2].outside == share * last.steps).all() and last.steps.min() > 5
        shielded = play_to_end(GAME, sampled(), Team("mine", {2: agent}, StepShield({2: agent})))
        assert (shielded.memories["shield"].agents[2].outside == share * shielded.steps).all()
        for shield in (None, StepShield({2: agent}), EpisodeShield({2: agent})):
            result = evaluate(sampled(), {"mine": Team("mine", {2: agent}, shield)}, scenario=PAPER)
            assert (result["mine"]["outside"] == share).all()
    assert harms(ranged(0.0)) == harms(LearnedAgent(PPO.with_range(None)))


# ---------------------------------------------------------------- every kind of policy


@pytest.mark.parametrize("shape", [(-1, 1), (-1,)])
def test_function__drives_by_what_it_returns(shape: tuple[int, ...]) -> None:
    agent = policy_agent(lambda seen: (seen[:, 1] - 0.6).clip(-0.8, 0.4).reshape(shape))
    seen = View().observe(GAME.reset(sampled()), np.array([2]), 0.1)[:, 0, 1]
    assert actions(agent) == pytest.approx((seen - 0.6).clip(-0.8, 0.4).tolist())
    assert (
        agent.name == "<lambda>" and policy_agent(brake).name == "brake" and policy_agent(brake, name="b").name == "b"
    )


def test_torch_module__drives_without_gradients() -> None:
    net = small_net()
    assert net.training and harms(policy_agent(net)) == harms(policy_agent(lambda seen: net(torch.from_numpy(seen))))
    agent = policy_agent(net)
    assert not agent.ask(net, np.zeros((2, 27), np.float32)).requires_grad
    still = torch.nn.Sequential(torch.nn.Linear(27, 1), torch.nn.Dropout(0.5), torch.nn.Tanh()).eval()
    assert harms(policy_agent(still)) == harms(policy_agent(still))


def test_torch_module__of_another_type_drives() -> None:
    net = small_net()
    expected = harms(policy_agent(net))
    assert harms(policy_agent(net.to(torch.bfloat16))) == pytest.approx(expected, rel=0.2, abs=5.0)


def test_model__drives_as_in_its_own_librarys_rollout() -> None:
    model = stable.PPO("MlpPolicy", rows(4), n_steps=8, batch_size=16, seed=1).learn(64)
    env = EthBrakeEnv(reward="first-impact-harm")
    (seen, _), over, total = env.reset(seed=3), False, 0.0
    while not over:
        seen, reward, terminated, truncated, _ = env.step(predicted(model, seen))
        total, over = total + float(reward), terminated or truncated
    worlds = PAPER.sample(1, 3, purpose="training")
    assert harms(policy_agent(model), worlds=worlds)[0] == pytest.approx(-total, rel=1e-5, abs=1e-5)


def ramp(seen: Any, memory: Any) -> Any:
    """Brakes harder with every step; spoils what it was given."""
    steps, kept = memory
    braking = -np.minimum(steps, 10.0) / 10.0
    after = steps + 1.0, kept
    steps[:] = 99.0
    return braking, after


def no_steps(n: int) -> Any:
    return np.zeros((n, 1), np.float32), np.arange(n)


def test_memory__belongs_to_each_world_and_to_nobody_else() -> None:
    agent, state = policy_agent(ramp, initial_state=no_steps), GAME.reset(sampled())
    memory = agent.begin(sampled(), 2)
    for k in range(3):
        before = copy.deepcopy(memory)
        command, after = agent.act(state, memory, 2)
        assert command == pytest.approx(-k / 10.0 * state.car[:, BRAKING, 2])
        assert all(np.array_equal(a, b) for a, b in zip(before, memory, strict=True))
        memory = after
    bound = play_to_end(GAME, sampled(), Team("mine", {2: agent}, StepShield({2: agent})))
    assert (bound.harm("first") <= bound.memories["shield"].first).all() and sum(harms(agent)) > bound.harm().sum()


def test_indices__stand_for_evenly_spaced_actions() -> None:
    for index in range(5):
        agent = policy_agent(lambda seen, i=index: np.full(len(seen), i), actions=5)
        assert actions(agent) == pytest.approx([-1.0 + 0.5 * index] * 12)


def test_scale__is_that_of_the_environment_in_which_a_model_was_trained(tmp_path: Path) -> None:
    start = ActionScale(offset=-0.9, scale=0.3)
    env = make_sb3_vec_env(PAPER, 2, seed=1, actions=start)
    model = stable.PPO("MlpPolicy", env, n_steps=4, batch_size=8, policy_kwargs=TINY)
    model.save(tmp_path / "model.zip")
    loaded = stable.PPO.load(tmp_path / "model.zip")
    agent = policy_agent(loaded)
    assert agent.actions == start
    numbers = loaded.predict(agent.observe(agent.observation, GAME.reset(sampled()), 2), deterministic=True)[0][:, 0]
    assert actions(agent) == pytest.approx(np.clip(-0.9 + 0.3 * numbers, -1, 1)) and min(actions(agent)) < -0.8
    chosen = policy_agent(lambda seen: np.full(len(seen), 1), actions=start._replace(choices=3))
    assert actions(chosen) == pytest.approx([-0.9] * 12)
    with pytest.raises(AgentFailed, match=r"must be a number in \[-3, 3\]"):
        actions(policy_agent(lambda seen: np.full(len(seen), 3.1), actions=start))


def test_clip__means_the_nearest_action_and_one_float32_step_beyond_is_always_1() -> None:
    beyond = float(np.nextafter(np.float32(1), np.float32(2)))
    for size, clip in ((1.5, True), (beyond, False)):
        for sign in (-1.0, 1.0):
            assert actions(policy_agent(lambda seen, u=sign * size: np.full(len(seen), u), clip=clip)) == [sign] * 12
    assert actions(policy_agent(lambda seen: np.full(len(seen), 7), clip=True, actions=5)) == [1.0] * 12
    assert actions(policy_agent(lambda seen: np.full(len(seen), -7), clip=True, actions=5)) == [-1.0] * 12


def test_agent__can_be_pickled_where_its_policy_can() -> None:
    agents: list[Agent] = [policy_agent(given) for given in (brake, partial(brake), small_net())]
    for agent in [*agents, policy_agent(ramp, initial_state=no_steps), LearnedAgent(PPO)]:
        assert actions(pickle.loads(pickle.dumps(agent))) == actions(agent)


# ---------------------------------------------------------------- what it observes


def copies(make: Callable[[Any], Any]) -> Any:
    """Two copies of an environment, by SuperSuit, which Python 3.13 does not have."""
    supersuit = pytest.importorskip("supersuit")
    return supersuit.concat_vec_envs_v1(
        supersuit.pettingzoo_env_to_vec_env_v1(make(supersuit)), 2, base_class="stable_baselines3"
    )


AROUND: dict[str, Any] = {
    "rows": lambda features: rows(observation=features),
    "VecNormalize": lambda features: vec_env.VecNormalize(rows(observation=features)),
    "SuperSuit": lambda features: copies(
        lambda supersuit: EthBrakeParallelEnv(agents="learners", observation=features)
    ),
}


@pytest.mark.parametrize("around", AROUND)
def test_model__observes_what_it_was_trained_on_even_from_a_file(around: str, tmp_path: Path) -> None:
    features = OTHERS if around == "rows" else ["own", "front_1.gap", "place"]
    trained = stable.PPO("MlpPolicy", AROUND[around](features), policy_kwargs=dict(TINY))
    trained.save(tmp_path / "model")
    by_hand = harms(policy_agent(partial(predicted, trained), observation=features))
    for each in (trained, trained.policy, stable.PPO.load(tmp_path / "model")):
        agent = policy_agent(each, clip=True)
        assert agent.observation == View(features)
        assert around == "VecNormalize" or harms(agent) == by_hand
    with refused("agent 'PPO': observation lists other features than the policy was trained on"):
        policy_agent(trained, observation=["own"])


def test_policy_that_says_nothing__is_asked_for_its_features_where_they_are_not_the_usual_ones() -> None:
    own = open_game("paper-random", observation=OTHERS)
    for scenario, game in (OBSTACLE, own):
        with refused("nothing says which features the policy observes, and vehicle_2 of scenario 'paper-random"):
            harms(policy_agent(brake), game, scenario.sample(3, 7))
        harms(policy_agent(brake, observation=View()), game, scenario.sample(3, 7))
    agent = policy_agent(brake, scenario=OBSTACLE[0])
    assert agent.observation == OBSTACLE[1].views[2] and "obstacle.gap" in agent.observation.names
    assert harms(agent, OBSTACLE[1], OBSTACLE[0].sample(3, 7))
    for listed in (OTHERS, tuple(OTHERS), deque(OTHERS), View(OTHERS)):
        assert policy_agent(brake, observation=listed).observation == View(OTHERS)


@pytest.mark.skipif("contact" not in GROUPS, reason="the extension with these features is not installed")
def test_forecasts__need_the_scenario_for_its_time_step() -> None:
    listed = ["own", "contact.brake_front_time"]
    with refused("agent 'brake': observes forecasts, which need the time between two decisions; pass scenario="):
        policy_agent(brake, observation=listed)
    assert policy_agent(brake, observation=listed, scenario="paper-random").time_step_s == PAPER.time_step_s


# ---------------------------------------------------------------- wrappers and statistics


class Negated(gymnasium.ActionWrapper[Any, Any, Any]):
    def action(self, action: Any) -> Any:
        return -action


class OwnEnv(EthBrakeEnv):
    """Of nobody knows what."""


class TimeLimit(Negated):
    """Of another library than the one that changes nothing."""


CHANGING: dict[str, Any] = {
    "NormalizeObservation": lambda: wrappers.NormalizeObservation(EthBrakeEnv()),
    "TimeLimit": lambda: TimeLimit(EthBrakeEnv()),
    "VecFrameStack": lambda: vec_env.VecFrameStack(rows(), 1),
}


@pytest.mark.parametrize("name", CHANGING)
def test_wrapper_that_may_change_something__is_named(name: str) -> None:
    env = CHANGING[name]()
    trained = stable.PPO("MlpPolicy", env, n_steps=4, batch_size=4, policy_kwargs=dict(TINY))
    if name == "VecFrameStack":
        trained.learn(8)
    with refused(f"agent 'PPO': the model was trained under {name}, which may change observations or actions"):
        policy_agent(trained, clip=True)
    assert policy_agent(trained, ignore_wrappers=True).name == "PPO"
    env.close()


def test_wrappers_that_change_nothing__are_let_through() -> None:
    env: Any = wrappers.OrderEnforcing(wrappers.PassiveEnvChecker(EthBrakeEnv()))
    env = wrappers.TransformReward(wrappers.NormalizeReward(env), lambda reward: reward * 0.1)
    env = Monitor(wrappers.RecordEpisodeStatistics(wrappers.TimeLimit(env, 50)))
    trained = stable.PPO("MlpPolicy", env, policy_kwargs=dict(TINY))
    assert harms(policy_agent(trained)) == harms(policy_agent(partial(predicted, trained)))


UNDER: dict[str, Callable[[Any], Any]] = {
    "VecEnv": lambda reward: vec_env.VecMonitor(rows(reward=reward)),
    "Gymnasium": lambda reward: OwnEnv(reward=reward),
}


@pytest.mark.parametrize("name", UNDER)
def test_discount_above_that_of_the_shaping__is_refused(name: str) -> None:
    def driven(gamma: float, reward: Any) -> Any:
        env = UNDER[name](reward)
        model = stable.PPO("MlpPolicy", env, n_steps=4, batch_size=4, gamma=gamma, policy_kwargs=dict(TINY))
        return policy_agent(model, ignore_wrappers=True)

    early = {"harm": 1.0, "shaping": 0.1, "shaping_discount": 0.95}
    for gamma, reward in ((0.99, "shaped"), (0.95, early), (1.0, {**early, "shaping": 0.0})):
        assert driven(gamma, reward).name == "PPO"
    for gamma, reward, most in ((0.99, early, "0.95"), (0.995, "shaped", "0.99")):
        with refused(
            f"agent 'PPO': the model was trained with gamma = {gamma}: must be at most {most}, the reward's sh"
        ):
            driven(gamma, reward)


@pytest.mark.parametrize("algorithm", [stable.PPO, stable.SAC])
def test_model_from_a_file__needs_the_statistics_it_was_trained_under(algorithm: Any, tmp_path: Path) -> None:
    kind = {"n_steps": 32} if algorithm is stable.PPO else {"learning_starts": 8, "buffer_size": 100}
    for normalised in (False, True):
        env: Any = vec_env.VecNormalize(vec_env.VecMonitor(rows()), clip_obs=2.0) if normalised else rows()
        trained = algorithm("MlpPolicy", env, seed=1, policy_kwargs=dict(TINY), **kind).learn(64)
        trained.save(tmp_path / "model.zip")
        loaded = algorithm.load(tmp_path / "model.zip")
        if not normalised:
            assert harms(policy_agent(loaded)) == harms(policy_agent(trained))
    with refused("was trained under VecNormalize, whose statistics are missing; load them with model.set_env"):
        policy_agent(loaded, clip=True)
    assert policy_agent(loaded, ignore_wrappers=True).name == algorithm.__name__
    if algorithm is stable.PPO:  # the others forget what they saw last
        with refused("was trained under VecNormalize, whose statistics are missing"):
            policy_agent(algorithm.load(tmp_path / "model.zip", env=rows()))
    env.save(str(tmp_path / "statistics.pkl"))
    loaded.set_env(vec_env.VecNormalize.load(str(tmp_path / "statistics.pkl"), rows()))
    by_hand, mean = policy_agent(lambda seen: predicted(trained, env.normalize_obs(seen))), env.obs_rms.mean.copy()
    assert harms(policy_agent(loaded)) == harms(policy_agent(trained)) == harms(by_hand)
    assert harms(by_hand) != harms(policy_agent(trained.policy))
    assert np.array_equal(env.obs_rms.mean, mean)  # driving has counted nothing


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
        (Box(0.0, 1.0, (1,)), {}), (Box(-2.0, 2.0, (1,)), {"clip": True}), (Discrete(3), {"actions": 5}),
        (Discrete(3, start=1), {"actions": 3}),
    ],
    ids=str,
)  # fmt: skip
def test_action_space__must_be_what_the_agent_takes(space: Any, settings: dict[str, Any]) -> None:
    with refused("agent 'Spaced': the actions of the policy are in"):
        policy_agent(Spaced(space), **settings)
    assert policy_agent(Spaced(space), ignore_wrappers=True, **settings).name == "Spaced"


def test_discrete_actions_of_our_environments__are_known_from_the_space(tmp_path: Path) -> None:
    trained = stable.DQN("MlpPolicy", EthBrakeEnv(actions=5), policy_kwargs=dict(TINY), buffer_size=50)
    trained.save(tmp_path / "model")
    given = policy_agent(partial(predicted, trained), actions=5)
    assert harms(policy_agent(trained)) == harms(policy_agent(stable.DQN.load(tmp_path / "model"))) == harms(given)
    assert policy_agent(Spaced(Discrete(4)), actions=4).actions == 4


WRONG: dict[str, Any] = {
    "float64 of shape (12, 2); must return a number in [-1, 1]": lambda n: np.zeros((n, 2)),
    "float64 of shape (); must return": lambda n: 0.5,
}


@pytest.mark.parametrize("message", WRONG)
def test_answer_of_a_wrong_form__is_refused_with_the_vehicle(message: str) -> None:
    with refused(message, AgentFailed) as caught:
        harms(policy_agent(lambda seen: WRONG[message](len(seen)), name="mine"))
    assert str(caught.value).startswith("agent 'mine', vehicle_2: returned ")


BEYOND: dict[str, Any] = {
    "action 1.5; must be a number in [-1, 1]; clip=True clips": 1.5, "action nan; must be a": np.nan,
}  # fmt: skip


@pytest.mark.parametrize("message", BEYOND)
def test_answer_out_of_range__is_refused_with_world_and_time(message: str) -> None:
    with refused(f"agent 'mine', world 3, vehicle_2 at 0.50 s: {message}", AgentFailed):
        harms(policy_agent(lambda seen: np.where(np.arange(len(seen)) == 3, BEYOND[message], 0.0), name="mine"))


ANSWERS: dict[str, Any] = {  # what the message says after the vehicle: what the policy answers
    ": returned 'nothing', <U7 of shape ()": lambda seen: "nothing",
    ": returned array([[0., 0.],": lambda seen: np.zeros((len(seen), 2)),
    " at 0.50 s: action 7; must be a number": lambda seen: np.where(np.arange(len(seen)) == 1, 7.0, 0.0),
}


@pytest.mark.parametrize("body", [3])
@pytest.mark.parametrize("message", ANSWERS)
def test_answer__that_is_refused_names_the_vehicle_whatever_the_others_do(message: str, body: int) -> None:
    scenario, game = open_game(open_game("cooperation-3-pair")[0].replace(latency_s=0.5))
    good, bad = policy_agent(lambda seen: np.zeros(len(seen)), name="good"), policy_agent(ANSWERS[message], name="bad")
    where = f"world 6, vehicle_{body}" if "action " in message else f"vehicle_{body}"
    with refused(f"agent 'bad', {where}{message}", AgentFailed):
        play_to_end(game, scenario.sample(3, 7, first=5), Team("mine", {2: good, 3: good} | {body: bad}))


@pytest.mark.parametrize("body", [3])
def test_answer__of_a_policy_with_a_state_names_the_vehicle(body: int) -> None:
    scenario, game = open_game("cooperation-3-pair")
    bad = policy_agent(lambda seen, state: seen[:, 0], initial_state=lambda n: np.zeros((n, 1)), name="bad")
    with refused(f"agent 'bad', vehicle_{body}: returned array(", AgentFailed):
        play_to_end(game, scenario.sample(3, 7), Team("mine", {2: Held("coast"), 3: Held("coast")} | {body: bad}))


@pytest.mark.parametrize(("index", "message"), [(-1, "action -1"), (1.0, "float64 of shape (12,)")])
def test_index__must_be_one_of_the_actions(index: Any, message: str) -> None:
    with refused(f"{message}; must", AgentFailed) as caught:
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


REFUSED: dict[str, Any] = {
    "agent 'int': policy = 3: must be a function of observations": lambda: policy_agent(3),
    "agent 'Policy': policy = Policy('ppo', 27 observations": lambda: policy_agent(PPO),
    "agent 'str': policy = 'runs/none': must be a function of observations, an object with predict or a": lambda: (
        policy_agent("runs/none")
    ),
    "agent 'brake': actions = 1: must be a whole number, at least 2": lambda: policy_agent(brake, actions=1),
    "agent 'Sequential': initial_state = <function no_steps": lambda: policy_agent(small_net(), initial_state=no_steps),
    "agent 'Layer': the layer GRU is in training mode": lambda: policy_agent(Layer()),
    "unknown feature 'learner'": lambda: policy_agent(stable.PPO("MlpPolicy", rows(appended="number"))),
    "the learners of scenario 'two' observe different features; pass observation": lambda: policy_agent(
        brake,
        scenario=PAPER.replace(name="two", observation={"vehicle_2": ["own"]}).with_learners(
            ["vehicle_2", "vehicle_3"]
        ),
    ),
    "predict returned a state, so the model has a memory; write a function": lambda: harms(policy_agent(Recurrent())),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", REFUSED)
def test_policy_of_another_library__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()


@pytest.mark.parametrize("memory", [lambda n: np.zeros(n + 1), lambda n: (np.zeros(n), [object()] * n)])
def test_memory__has_one_row_for_each_world(memory: Any) -> None:
    right = "must be an array with one row for each of 12 worlds, or a tuple of such arrays"
    with refused(right, AgentFailed):
        harms(policy_agent(ramp, initial_state=memory))
    with refused(right, AgentFailed):
        harms(policy_agent(lambda seen, kept: (brake(seen), memory(len(seen))), initial_state=np.zeros))


def test_function_with_a_memory__returns_a_pair() -> None:
    with refused("with initial_state must return a pair of actions and state", AgentFailed):
        harms(policy_agent(lambda seen, kept: brake(seen), initial_state=np.zeros))


def raising(seen: Any) -> Any:
    raise KeyError("weights")


def chained(seen: Any) -> Any:
    try:
        raising(seen)
    except KeyError as error:
        raise InvalidInput("inner") from error


@pytest.mark.parametrize("function", [raising, chained])
def test_failure__names_the_agent_and_has_no_circle(function: Any) -> None:
    with pytest.raises(InvalidInput) as caught:
        harms(policy_agent(function, name="mine"))
    assert "agent 'mine'" in str(caught.value) or function is chained
    error, seen = caught.value, list[BaseException]()
    while error is not None:
        assert error not in seen
        seen.append(error)
        error = error.__cause__ or error.__context__  # type: ignore[assignment]
    assert len(seen) <= 2
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_function_without_a_scenario__is_warned_of_what_it_observes() -> None:
    with pytest.warns(Unfamiliar, match="so it gets the usual .*, own.speed to .*; pass scenario="):
        policy_agent(brake)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        policy_agent(brake, scenario="paper-random"), policy_agent(brake, observation=["own"])
