"""What a stranger's program hands in first: other shapes of an action, another id, plain mappings, learners only."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import pytest
from pettingzoo.test import api_test, parallel_api_test

import ethbrake_marl as eb
from ethbrake_marl.envs.interfaces import env, parallel_env
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.scenario import load_scenario

BEYOND = np.nextafter(np.float32(1), np.float32(2))
SHAPES = [-0.5, np.float32(-0.5), [-0.5], np.array([[-0.5]], np.float32)]
PAIR = "cooperation-3-pair"


@pytest.mark.parametrize("action", SHAPES, ids=["number", "float32", "list", "1x1"])
def test_action__as_a_number_or_with_more_axes_is_the_same_action(action):
    usual = np.array([-0.5], np.float32)
    single, parallel = gymnasium.make("EthBrake-v0").unwrapped, parallel_env()
    rewards = []
    for given in (usual, action):
        single.reset(seed=1), parallel.reset(seed=1)
        observation, *_ = single.step(given)
        told, *_ = parallel.step({"vehicle_2": given})
        assert np.array_equal(told["vehicle_2"], observation)
        rewards.append(observation)
    assert np.array_equal(*rewards)


def test_action__flat_batches_are_batches():
    vector, rows = eb.EthBrakeVectorEnv(3), eb.make_sb3_vec_env("paper-random", 3)
    expected = []
    for actions in (np.full((3, 1), 0.5, np.float32), np.full(3, 0.5, np.float32)):
        vector.reset(seed=2), rows.seed(2), rows.reset()
        expected.append((vector.step(actions)[0], rows.step(actions)[0]))
    assert all(np.array_equal(*pair) for pair in zip(*expected, strict=True))
    for actions in (np.zeros((1, 3), np.float32), np.zeros(3, np.float32)):
        assert rows.step(actions)[0].shape[0] == 3
    with pytest.raises(InvalidInput):
        vector.step(np.zeros((3, 2), np.float32))


def test_action__one_float32_step_beyond_1_is_1_also_where_nobody_checks_first():
    each = [eb.EthBrakeVectorEnv(2) for _ in range(2)]
    for environment, value in zip(each, (np.float32(1), BEYOND), strict=True):
        environment.reset(seed=3)
        environment.last = environment.step(np.full((2, 1), value, np.float32))
    assert np.array_equal(each[0].last[0], each[1].last[0])
    assert np.array_equal(each[0].last[1], each[1].last[1])
    with pytest.raises(InvalidInput, match=r"action of vehicle_2: 1\.00000\d+; must be in"):
        each[0].step(np.full((2, 1), np.nextafter(BEYOND, np.float32(2)), np.float32))


def test_id__with_the_projects_name_is_the_same_environment():
    named, usual = gymnasium.make("ethbrake/EthBrake-v0"), gymnasium.make("EthBrake-v0")
    assert type(named.unwrapped) is type(usual.unwrapped)
    assert np.array_equal(named.reset(seed=1)[0], usual.reset(seed=1)[0])
    assert gymnasium.make_vec("ethbrake/EthBrake-v0", num_envs=2).reset(seed=1)[0].shape[0] == 2


def test_scenario__as_a_mapping_survives_the_json_of_a_spec():
    content = load_scenario("paper-random").declared()
    made = gymnasium.make("EthBrake-v0", scenario=json.loads(json.dumps(content)))
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(made.spec.to_json()))
    usual = gymnasium.make("EthBrake-v0", scenario="paper-random")
    assert np.array_equal(made.reset(seed=5)[0], usual.reset(seed=5)[0])
    assert np.array_equal(again.reset(seed=5)[0], usual.reset(seed=5)[0])
    with pytest.raises(InvalidInput, match="mass_t"):
        parallel_env({**content, "mass_t": -1.0})


@pytest.mark.parametrize("observation", [eb.ObservationSpec(2, 0), eb.choose_observation(["own", "front_1.gap"])])
def test_observation__an_object_survives_the_json_of_a_spec(observation):
    made = gymnasium.make("EthBrake-v0", observation=observation)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(made.spec.to_json()))
    assert again.unwrapped.engine.observation == observation
    assert np.array_equal(made.reset(seed=5)[0], again.reset(seed=5)[0])


def test_spec__with_objects_is_plain_and_makes_the_same_environment():
    scenario, reward = load_scenario("cooperation-3-pair"), eb.RewardParams(harm=0.5, terminal=2.0)
    made = gymnasium.make("EthBrake-v0", scenario=scenario, reward=reward, learners=["vehicle_3"])
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(made.spec.to_json()))
    assert again.unwrapped.engine.scenario == made.unwrapped.engine.scenario
    made.reset(seed=5), again.reset(seed=5)
    rewards = [env.step(np.array([1.0], np.float32))[1] for env in (made, again) for _ in range(60)]
    assert rewards[:60] == rewards[60:]
    assert eb.EthBrakeEnv().spec is None


def test_observation__a_mapping_with_anything_else_is_refused():
    with pytest.raises(UnknownName, match="fronts"):
        parallel_env(observation={"fronts": 2})
    with pytest.raises(InvalidInput, match="front = 'two'"):
        parallel_env(observation={"front": "two"})
    with pytest.raises(InvalidInput, match="chosen = 3; must be a list"):
        parallel_env(observation={"chosen": 3})


def test_learners_only__are_the_agents_and_nothing_else_changes():
    whole, learners = parallel_env(PAIR), parallel_env(PAIR, agents="learners")
    assert learners.possible_agents == ["vehicle_2", "vehicle_3"]
    assert set(learners.observation_spaces) == set(learners.action_spaces) == set(learners.possible_agents)
    (seen, told), (seen_all, told_all) = learners.reset(seed=4), whole.reset(seed=4)
    rng = np.random.default_rng(0)
    while learners.agents:
        assert set(seen) == set(told) == set(learners.possible_agents)
        for name in learners.possible_agents:
            assert np.array_equal(seen[name], seen_all[name])
        actions = {name: rng.uniform(-1, 1, 1).astype(np.float32) for name in learners.agents}
        seen, reward, ended, cut, told = learners.step(actions)
        seen_all, reward_all, ended_all, cut_all, told_all = whole.step(actions)
        for part, part_all in ((reward, reward_all), (ended, ended_all), (cut, cut_all)):
            assert part == {name: part_all[name] for name in learners.possible_agents}
        assert told["vehicle_3"]["total_harm"] == told_all["vehicle_3"]["total_harm"]
    assert not whole.agents
    assert np.array_equal(learners.state(), whole.state())


def test_learners_only__scripted_vehicles_are_no_agents():
    environment = parallel_env(agents="learners")
    environment.reset(seed=0)
    with pytest.raises(UnknownName, match="vehicle_1"):
        environment.step({"vehicle_1": [0.0], "vehicle_2": [0.0]})
    with pytest.raises(InvalidInput, match="must be 'all' or 'learners'"):
        parallel_env(agents="scripted")
    with pytest.raises(InvalidInput, match="nobody learns in 'paper-random'"):
        parallel_env(agents="learners", learners=[])


@pytest.mark.filterwarnings("ignore:reset. unknown option")
def test_learners_only__passes_pettingzoos_own_tests():
    parallel_api_test(parallel_env(PAIR, agents="learners"), num_cycles=100)
    api_test(env(scenario=PAIR, agents="learners"), num_cycles=100)


def test_learners_only__under_the_shield():
    environment = eb.HybridShield(parallel_env(agents="learners"), mode="step")
    _, infos = environment.reset(seed=7)
    while environment.agents:
        *_, infos = environment.step({"vehicle_2": np.array([1.0], np.float32)})
    assert infos["vehicle_2"]["world_first_impact_harm"] <= infos["vehicle_2"]["shield"]["bound_harm"] + 1e-9


def test_max_cycles__truncates():
    environment = parallel_env(max_cycles=3)
    for _ in range(2):
        environment.reset(seed=0)
        cuts = [environment.step({"vehicle_2": [0.0]})[3]["vehicle_2"] for _ in range(3)]
        assert cuts == [False, False, True]
        assert environment.agents == []
    with pytest.raises(InvalidInput, match="max_cycles = 0: must be a whole number, at least 1"):
        parallel_env(max_cycles=0)


def test_max_cycles__beyond_the_end_changes_nothing():
    plain, limited = parallel_env(), parallel_env(max_cycles=10_000)
    plain.reset(seed=0), limited.reset(seed=0)
    while plain.agents:
        told, same = plain.step({"vehicle_2": [-1.0]}), limited.step({"vehicle_2": [-1.0]})
        assert told[2:4] == same[2:4]
    assert not limited.agents
