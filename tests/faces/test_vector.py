"""Gymnasium's vector environment: when episodes begin again, infos of rows, descriptions of its worlds."""

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.sb3 import make_sb3_vec_env
from ethbrake_marl.faces.vector import EthBrakeVectorEnv
from ethbrake_marl.worlds.catalogue import load_scenario
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
        assert all(columns[f"_{name}"].tolist() == [True, True] for name in info)


def test_description__has_columns_that_only_some_of_the_worlds_have() -> None:
    members = [{"scenario": "paper-random-obstacle"}, {"scenario": "realistic-mixed"}]
    env = EthBrakeVectorEnv(4, load_scenario({"name": "two", "mixture": members}))
    env.reset(seed=2)
    worlds = env.describe_worlds()
    assert worlds["world"].tolist() == [0, 1, 2, 3] and worlds["world_seed"].tolist() == [2] * 4
    mixed = worlds["scenario"] == "realistic-mixed"
    assert mixed.any() and not mixed.all() and ((worlds["vehicle_1_type"] != "") == mixed).all()
    assert (np.isnan(worlds["obstacle_gap_m"]) == mixed).all()
    assert worlds["scenario"].shape == (4,)


def test_description__of_worlds_of_a_list_and_of_those_that_follow() -> None:
    wet = load_scenario("realistic-motorway").replace(friction={"uniform": [0.2, 0.9]})
    env = EthBrakeVectorEnv(3, wet, autoreset_mode="SameStep")
    env.reset(seed=2, options={"listed_world": {"seed": 7, "number": 3}})
    drawn, over = env.scenario.draw(3, 7, first=3), np.zeros(3, bool)
    assert env.describe_worlds()["friction"].tolist() == drawn.friction.tolist()
    while not over.any():
        over = np.logical_or(*env.step(np.full((3, 1), -1.0))[2:4])
    worlds, first = env.describe_worlds(), env.scenario.draw(1, 2, purpose="training")
    assert worlds["world"].tolist() == np.where(over, np.cumsum(over) - 1, [3, 4, 5]).tolist() and not over.all()
    assert worlds["world_seed"].tolist() == np.where(over, 2, 7).tolist()
    assert worlds["friction"][over][0] == first.friction[0] and worlds["gap_1_m"][over][0] == first.worlds.gaps_m[0, 0]
    assert worlds["friction"][~over].tolist() == drawn.friction[~over].tolist()


NAMES = ("world_seed", "world", "world_listed")


def names(infos: dict[str, Any]) -> list[list[Any]]:
    return [infos[name].tolist() for name in NAMES]


def test_infos__name_the_worlds_that_options_specify() -> None:
    env = EthBrakeVectorEnv(3, max_episode_steps=2)
    listed = env.reset(seed=2, options={"listed_world": {"seed": 7, "number": 3}})[1]
    assert names(listed) == [[7, 7, 7], [3, 4, 5], [True, True, True]]
    assert names(env.step(np.zeros((3, 1)))[4]) == names(listed)
    env.step(np.zeros((3, 1)))
    assert names(env.step(np.zeros((3, 1)))[4]) == [[2, 2, 2], [0, 1, 2], [False] * 3]  # the next episodes
    given = env.reset(options={"initial_state": {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}})[1]
    assert names(given) == [[-1] * 3, [-1] * 3, [False] * 3]
    assert names(env.reset(seed=0, options={"listed_world": {"seed": 0, "number": 0}})[1])[1:] == [
        [0, 1, 2],
        [True] * 3,
    ]
    one = make_sb3_vec_env("paper-random", 2, seed=5, step_infos=True)
    one.set_options({"listed_world": {"seed": 9, "number": 4}})
    one.reset()
    assert [[info[name] for name in NAMES] for info in one.reset_infos] == [[9, 4, True], [9, 5, True]]
    for _ in range(80):
        dones, infos = one.step(np.array([[-1.0], [-0.6]]))[2:]
        if dones.any():
            break
    assert not dones.all() and [[info[name] for name in NAMES] for info in infos] == [[9, 4, True], [9, 5, True]]


@pytest.mark.parametrize(
    ("scenario", "seeds"), [("mixture-delays", [3, 11, 3]), ("cooperation-2-five", np.array([0, 2**62, 5]))]
)
def test_seeds__one_for_each_row_give_the_episodes_of_single_environments(scenario: str, seeds: Any) -> None:
    many, singles = EthBrakeVectorEnv(3, scenario, autoreset_mode="SameStep"), [EthBrakeEnv(scenario) for _ in range(3)]
    observations, infos = many.reset(seed=seeds)
    begun = [env.reset(seed=int(seed)) for env, seed in zip(singles, seeds, strict=True)]
    assert observations.tolist() == [seen.tolist() for seen, _ in begun]
    assert infos["world_seed"].tolist() == [*seeds] and infos["world"].tolist() == [0, 0, 0]
    for given in actions(3, 90, 3) * 0.1 - 0.9:
        observations, rewards, terminated, truncated, infos = many.step(given)
        for row, env in enumerate(singles):
            seen, reward, *ends, info = env.step(given[row])
            assert [terminated[row], truncated[row]] == ends and rewards[row] == reward
            if any(ends):
                seen, info = env.reset()
            assert observations[row].tolist() == seen.tolist()
            assert [infos[name][row] for name in NAMES] == [info[name] for name in NAMES]
    worlds = many.describe_worlds()
    assert [worlds["gap_1_m"][row] for row in range(3)] == [env.describe_world()["gap_1_m"] for env in singles]
    assert min(infos["world"]) > 0


@pytest.mark.parametrize(("seeds", "kind"), [([2**63 + 1, 3], "uint64"), ([2**64 + 1, 3], "object")])
def test_seeds__of_a_list_keep_all_digits(seeds: list[int], kind: str) -> None:
    env = EthBrakeVectorEnv(2)
    infos = env.reset(seed=seeds)[1]
    assert infos["world_seed"].tolist() == seeds and infos["world_seed"].dtype == kind
    assert env.describe_worlds()["world_seed"].tolist() == seeds
    options = {"initial_state": {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}}
    assert env.reset(seed=seeds, options=options)[1]["world_seed"].tolist() == [-1, -1]
    listed = env.reset(seed=seeds, options={"listed_world": {"seed": 2**63 + 5, "number": 0}})[1]
    assert listed["world_seed"].tolist() == [2**63 + 5] * 2


def test_seeds__none_in_a_list_is_drawn_and_bad_lists_are_refused() -> None:
    env = EthBrakeVectorEnv(2)
    infos = env.reset(seed=[None, 4])[1]
    assert infos["world_seed"][1] == 4 and infos["world"].tolist() == [0, 0]
    assert env.reset(seed=[None, 4])[1]["world_seed"][0] != infos["world_seed"][0]
    expected = env.reset()[1]["world_seed"].tolist()
    for seeds, right in (
        ([1], "a list of 2 seeds"),
        ([1, 2, 3], "2 seeds"),
        ([1, -2], "at least 0"),
        ([1, "2"], "whole"),
        ([np.array(1), 2], "whole"),
        (np.zeros((2, 1), int), "whole"),
        (np.array(3), "whole"),
        (b"ab", "whole"),
    ):
        with refused(right):
            env.reset(seed=seeds)
    assert env.reset()[1]["world_seed"].tolist() == expected
    with refused("reset: seed = [1]: must be None or a whole number"):
        EthBrakeEnv().reset(seed=[1])  # type: ignore[arg-type]


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
