"""Gymnasium's vector environment: when episodes begin again, infos of rows, descriptions of its worlds."""

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.vector import EthBrakeVectorEnv
from tests.contract.interfaces import SCENARIOS, actions
from tests.refused import refused

N, STEPS = 3, 160


def episodes(mode: Any) -> dict[int, list[Any]]:
    """Number of each world that came -> what its steps returned, and its last observation; braking fully."""
    env = EthBrakeVectorEnv(N, autoreset_mode=mode, reward={"harm": 1.0, "jerk": 1e-3})
    infos, over, seen = env.reset(seed=7)[1], np.zeros(N, bool), dict[int, list[Any]]()
    for given in actions(3, STEPS, N) * 0.1 - 0.9:
        numbers, before = infos["world"].copy(), over
        observation, reward, terminated, truncated, infos = env.step(given)
        over = terminated | truncated
        for row in range(N):
            step, last = {name: infos[name][row] for name in ("cost", "reward_jerk", "time_s")}, observation[row]
            if before[row] and mode == "NextStep":
                assert reward[row] == step["cost"] == step["reward_jerk"] == 0.0
                assert infos["world"][row] != numbers[row] and not over[row]
                continue
            if over[row] and mode == "SameStep":
                assert infos["_final_info"][row] and infos["cost"][row] == infos["reward_jerk"][row] == 0.0
                step, last = {name: infos["final_info"][name][row] for name in step}, infos["final_obs"][row]
            seen.setdefault(numbers[row], []).append((reward[row], step, last.tolist(), terminated[row]))
    return seen


def test_next_step_and_same_step__play_the_same_episodes() -> None:
    later, now = episodes("NextStep"), episodes("SameStep")
    whole = [number for number in now if number < 2 * N and number + N in later]
    assert len(whole) >= N and any(later[number][-1][3] for number in whole)
    assert {number: later[number][0] for number in range(N)} == {number: now[number][0] for number in range(N)}
    assert [len(later[number]) for number in range(N)] == [len(now[number]) for number in range(N)]
    assert [later[number] for number in range(N)] == [now[number] for number in range(N)]


def test_actions_of_ended_rows__are_ignored() -> None:
    envs = [EthBrakeVectorEnv(2, max_episode_steps=2) for _ in range(2)]
    for env in envs:
        env.reset(seed=7)
        env.step(np.zeros((2, 1)))
        assert env.step(np.zeros((2, 1)))[3].all()
    given = np.array([[np.nan], [7.0]])
    (one, _, _, cut, _), other = envs[0].step(given), envs[1].step(np.zeros((2, 1)))[0]
    assert np.array_equal(one, other) and np.isnan(given[0, 0]) and not cut.any()


@pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS)
def test_infos__are_those_of_the_single_environment(scenario: Any) -> None:
    many, single = EthBrakeVectorEnv(2, scenario), EthBrakeEnv(scenario)
    other = {"vehicle_1": ["own"], "vehicle_5": ["own"]} if scenario.vehicles == 5 else None
    own = EthBrakeEnv(scenario, observation=other)
    assert own.reset(seed=5)[0] in own.observation_space == single.observation_space
    pairs = [(many.reset(seed=5)[1], single.reset(seed=np.int64(5))[1])]
    pairs += [(many.step(np.full((2, 1), -0.5))[4], single.step(-0.5)[4]) for _ in range(12)]
    for columns, info in pairs:
        assert {name: columns[name][0] for name in info} == info
        assert columns.keys() == info.keys() | {f"_{name}" for name in info}


def test_description__has_columns_that_only_some_of_the_worlds_have() -> None:
    env = EthBrakeVectorEnv(4, "mixture-universal")
    env.reset(seed=2)
    worlds = env.describe_worlds()
    assert worlds["world"].tolist() == [0, 1, 2, 3] and worlds["world_seed"].tolist() == [2] * 4
    assert worlds["vehicle_1_type"].tolist() == ["", "", "", "equipped"]
    assert np.isnan(worlds["obstacle_gap_m"]).tolist() == [False, True, False, True]
    assert worlds["scenario"].shape == (4,)


def test_description__of_worlds_of_a_list_and_of_those_that_follow() -> None:
    env = EthBrakeVectorEnv(3, "engineering-wet-road", autoreset_mode="SameStep")
    env.reset(seed=2, options={"listed_world": {"seed": 7, "number": 3}})
    drawn, over = env.scenario.draw(3, 7, first=3), np.zeros(3, bool)
    assert env.describe_worlds()["friction"].tolist() == drawn.friction.tolist()
    while not over.any():
        over = np.logical_or(*env.step(np.full((3, 1), -1.0))[2:4])
    worlds, first = env.describe_worlds(), env.scenario.draw(1, 2, channel="training")
    assert worlds["world"].tolist() == np.where(over, np.cumsum(over) - 1, -1).tolist() and not over.all()
    assert worlds["friction"][over][0] == first.friction[0] and worlds["gap_1_m"][over][0] == first.worlds.gaps_m[0, 0]
    assert worlds["friction"][~over].tolist() == drawn.friction[~over].tolist()


def test_settings__are_checked() -> None:
    with refused("autoreset_mode = 'Disabled': must be 'NextStep' or 'SameStep'"):
        EthBrakeVectorEnv(autoreset_mode="Disabled")
    with refused("num_envs = 0: must be a whole number, at least 1"):
        EthBrakeVectorEnv(0)
    with refused("has 2 learners (vehicle_2, vehicle_3); this environment needs exactly one learner"):
        EthBrakeVectorEnv(2, "cooperation-3-pair")
    env = EthBrakeVectorEnv(3)
    env.reset()
    with refused("action of the learners: has shape (2,); must have shape (3, 1)"):
        env.step([0.0, 0.0])
