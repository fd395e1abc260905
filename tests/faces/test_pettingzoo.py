"""PettingZoo: agents, what each is given, vector rewards, and refusals of actions and settings."""

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pettingzoo.utils.conversions import parallel_to_aec

from ethbrake_marl.agents.action_scale import ActionScale
from ethbrake_marl.episode.full_state import full_state
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv, raw_env
from ethbrake_marl.faces.shield import shield
from tests.contract.interfaces import CRASH, PAPER
from tests.refused import refused

ELEVEN = {
    "name": "eleven",
    "vehicles": 11,
    "gaps_m": 7,
    "speeds_mps": 20,
    "braking_capacity_mps2": 6,
    "driving_capacity_mps2": 3,
    "mass_t": 1,
    "latency_s": 0.5,
    "restitution": 0,
}
SCRIPTED = PAPER.replace(roles={vehicle: "full_brake" for vehicle in PAPER.vehicle_names})


def began(**settings: Any) -> EthBrakeParallelEnv:
    env = EthBrakeParallelEnv(**settings)
    env.reset(seed=7)
    return env


def test_crash__by_hand() -> None:
    env = began(scenario=CRASH, reward="first-impact-harm")
    seen = [env.step({"vehicle_1": [1.0], "vehicle_2": [0.0]}) for _ in range(8)]  # from 0.5 s to the horizon at 1.3 s
    harm = [rewards["vehicle_1"] for _, rewards, *_ in seen]
    assert harm[:4] == [0.0] * 4 and sum(harm) == pytest.approx(-36.0)
    infos = seen[-1][4]
    borne = {agent: info["first_impact_harm"] for agent, info in infos.items()}
    assert borne == {"vehicle_1": pytest.approx(27.0), "vehicle_2": pytest.approx(9.0)}
    assert infos["vehicle_1"]["chosen_action"] == -1.0 and infos["vehicle_2"]["chosen_action"] == 0.0
    assert seen[-1][3] == {"vehicle_1": True, "vehicle_2": True} and env.agents == []
    assert np.array_equal(env.state(), full_state(env.episode, 1.3, False)[0]) and env.state() in env.state_space
    with refused("step: no episode is running; call reset first"):
        env.step({"vehicle_2": [0.0]})


@pytest.mark.parametrize("agents", ["all", "learners"])
def test_agents__are_given_what_their_own_vehicle_observes(agents: str) -> None:
    observation = {"vehicle_2": ["own", "rear_1"], "vehicle_3": ["own", "place"]}
    env = EthBrakeParallelEnv("cooperation-4-five", agents=agents, observation=observation)
    seen, _ = env.reset(seed=7)
    for _ in range(9):
        for agent in env.agents:
            body = int(agent[-1])
            own = env.game.views[body].observe(env.episode, np.array([body]), 0.1)[0, 0]
            assert np.array_equal(seen[agent], own) and seen[agent] in env.observation_space(agent)
        seen, *_ = env.step({f"vehicle_{body}": [-0.3] for body in env.game.settings.learners})
    names = list(env.scenario.vehicle_names)
    assert env.agents == (names if agents == "all" else [names[i - 1] for i in env.scenario.learners])


def test_vector_rewards__are_the_harm_that_each_vehicle_bears() -> None:
    vector, reward = {"reward_vector": "vehicles"}, "first-impact-harm"
    env, scalar = (began(scenario=CRASH, reward=reward, **more) for more in (vector, {}))
    paid = []
    for _ in range(8):
        rewards, numbers = env.step({"vehicle_2": [0.0]})[1], scalar.step({"vehicle_2": [0.0]})[1]
        assert {agent: reward.sum() for agent, reward in rewards.items()} == pytest.approx(numbers)
        paid += [rewards[agent].tolist() for agent in ("vehicle_1", "vehicle_2") if numbers[agent]]
    assert paid == [pytest.approx([-27.0, -9.0])] * 2
    assert rewards["vehicle_1"] in env.reward_space("vehicle_1") and env.reward_spaces.keys() == rewards.keys()
    with refused("reward_space: rewards are numbers here"):
        scalar.reward_space("vehicle_1")


@pytest.mark.parametrize(
    ("scenario", "observation"), [("paper-random", ["own", "own_build_up_time"]), ("cooperation-2-five", None)]
)
def test_environment__can_be_pickled_before_and_after_it_observes(scenario: str, observation: list[str] | None) -> None:
    env = began(scenario=scenario, observation=observation)
    env.step({"vehicle_2": [-0.5]})
    copied = pickle.loads(pickle.dumps(env))
    action = {"vehicle_2": [-0.25]}
    assert copied.step(action)[0]["vehicle_2"].tolist() == env.step(action)[0]["vehicle_2"].tolist()


def test_indices__are_evenly_spaced_actions() -> None:
    env = began(scenario="cooperation-3-pair", actions=5)
    for index in range(5):
        infos = env.step({"vehicle_2": index, "vehicle_3": [np.int64(4 - index)]})[4]
        assert infos["vehicle_2"]["chosen_action"] == pytest.approx(index / 2 - 1)
        assert infos["vehicle_3"]["chosen_action"] == pytest.approx(1 - index / 2)


def test_scale__moves_and_clips_the_numbers_and_indices_of_an_environment() -> None:
    start = ActionScale(offset=-0.9, scale=0.3)
    env = began(scenario="cooperation-3-pair", actions=start)
    assert env.action_space("vehicle_2").high == [3.0] and env.action_space("vehicle_2").low == [-3.0]
    for number, action in ((0.0, -0.9), (-1.0, -1.0), (2.0, -0.3), (3.0, 0.0)):
        assert env.step({"vehicle_2": number, "vehicle_3": 0.0})[4]["vehicle_2"]["chosen_action"] == pytest.approx(
            action
        )
    env = began(scenario="cooperation-3-pair", actions=start._replace(choices=3))
    for index, action in enumerate((-1.0, -0.9, 0.0)):
        assert env.step({"vehicle_2": index, "vehicle_3": 0})[4]["vehicle_2"]["chosen_action"] == pytest.approx(action)
    bads: list[dict[str, Any]] = [{"scale": 0.0}, {"offset": -1.1}, {"choices": 1}, {"offset": "-0.9"}, {"scale": None}]
    for bad in (start._replace(**each) for each in bads):
        with pytest.raises(InvalidInput, match="actions = "):
            EthBrakeParallelEnv(actions=bad)


REFUSED: dict[str, Callable[[], Any]] = {
    "step: vehicle_3 follows the script full_brake, so it takes no action here; leave its action out, or make the"
    " environment with learners=['vehicle_2', 'vehicle_3']": lambda: began(agents="learners").step(
        {"vehicle_2": [0.0], "vehicle_3": [0.0]}
    ),
    "step: the action of learner vehicle_2 is missing": lambda: began().step({"vehicle_1": [0.0]}),
    "unknown agent 'vehicle_9'": lambda: began().step({"vehicle_9": [0.0]}),
    "step: actions = [0.0]: must be a mapping from agent to action": lambda: began().step([0.0]),  # type: ignore[arg-type]
    "action of vehicle_2: True: must be a number": lambda: began().step({"vehicle_2": True}),
    "action of vehicle_2: 5: must be an index from 0 to 4": lambda: began(actions=5).step({"vehicle_2": 5}),
    "agents = 'some': must be 'all' or 'learners'": lambda: EthBrakeParallelEnv(agents="some"),
    "has no learner; pass learners=['vehicle_2']": lambda: EthBrakeParallelEnv(SCRIPTED, agents="learners"),
    "number of steps of an episode = 0: must be": lambda: EthBrakeParallelEnv(max_cycles=0),
    "state: no episode is running": lambda: EthBrakeParallelEnv().state(),
    "describe_worlds: no episode is running": lambda: EthBrakeParallelEnv().describe_world(),
    "render_mode = 'film': must be None or one of": lambda: EthBrakeParallelEnv(render_mode="film"),
    "reset: options = [1]: must be None or a mapping": lambda: began().reset(options=[1]),  # type: ignore[arg-type]
    "reset: options has both initial_state and listed_world": lambda: began().reset(
        options={"initial_state": {}, "listed_world": {}}
    ),
    "reset: listed_world = {'seed': 7}: must be seed and number": lambda: began().reset(
        options={"listed_world": {"seed": 7}}
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_refusals(message: str) -> None:
    with refused(message):
        REFUSED[message]()


def test_behind_a_shield__a_missing_action_is_no_proposal() -> None:
    env = shield(EthBrakeParallelEnv(), "full_brake")
    env.reset(seed=7)
    assert env.step({})[4]["vehicle_2"]["shield_proposed_action"] == -1.0


def test_a_line_without_learners__plays_by_itself() -> None:
    env = began(scenario=SCRIPTED)
    while env.agents:
        *_, infos = env.step({})
    assert infos["vehicle_1"]["time_s"] > 2.0


@pytest.mark.parametrize("settings", [{}, {"scenario": ELEVEN}, {"agents": "learners"}], ids=str)
def test_turns__are_those_of_pettingzoos_conversion(settings: dict[str, Any]) -> None:
    ours, converted = raw_env(**settings), parallel_to_aec(EthBrakeParallelEnv(**settings))
    assert str(ours) == str(converted)
    for env in (ours, converted):
        with pytest.raises(AttributeError, match="agent_selection cannot be accessed before reset"):
            env.last()
        env.reset(seed=7)
    taken = 0
    for agent in ours.agent_iter():
        assert agent == converted.agent_selection and ours.agents == converted.agents
        for name in ("rewards", "_cumulative_rewards", "terminations", "truncations", "infos"):
            assert repr(getattr(ours, name)) == repr(getattr(converted, name))
        observation, *values = ours.last()
        expected, *expected_values = converted.last()
        assert repr(values) == repr(expected_values) and np.array_equal(observation, expected)
        action = None if values[1] or values[2] else [taken % 3 - 1.0]
        ours.step(action)
        converted.step(action)
        taken += 1
    assert taken > 20 and converted.agents == []
