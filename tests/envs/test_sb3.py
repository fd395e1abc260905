"""What is special to Stable-Baselines3's interface; what all promise stands in ``tests/contract``."""

from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor

from ethbrake_marl.envs import EthBrakeEnv, EthBrakeVecEnv, make_sb3_vec_env, parallel_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario import full_state
from tests.contract.interfaces import CRASH, FIVE, PAPER, actions, initial_state, line

near = pytest.approx
PAIR = ["vehicle_2", "vehicle_3"]


def begun(*args: Any, **settings: Any) -> EthBrakeVecEnv:
    env = make_sb3_vec_env(*args, **settings)
    env.reset()
    return env


def test_episode__returns_and_lengths_start_again_with_each_one_and_with_a_reset() -> None:
    env, episodes = begun(CRASH, 1), []
    for k in range(33):
        if k == 25:
            env.reset()
        _, reward, _, infos = env.step(np.full((1, 1), 0.0 if k < 16 else -1.0, np.float32))
        episodes += [info["episode"] for info in infos if "episode" in info]
    assert reward.dtype == np.float32
    assert episodes == [{"r": near(harm), "l": 8, "t": 0.0} for harm in (-36.0, -36.0, 0.0, 0.0)]


def test_rows__are_learners_within_worlds() -> None:
    n, seed = 3, 5
    env = make_sb3_vec_env(FIVE, n, seed=seed, learners=PAIR, step_infos=True)
    plain = begun(FIVE, n, seed=seed, learners=PAIR)
    start = env.reset()
    worlds = FIVE.with_learners(PAIR).sample(n, seed, channel="training").worlds
    alone = [parallel_env(FIVE, learners=PAIR) for _ in range(n)]
    for k, single in enumerate(alone):
        given = single.reset(seed=seed, options={"initial_state": initial_state(worlds, k)})[0]
        assert np.array_equal(start[2 * k : 2 * k + 2], [given[agent] for agent in PAIR])
    running = set(range(n))
    for action in actions(3, 100, 2 * n):
        observation, reward, done, infos = env.step(action)
        assert not np.shares_memory(observation, start) and observation.flags.c_contiguous
        infos_of_plain = plain.step(action)[3]
        for k in sorted(running):
            rows = [2 * k, 2 * k + 1]
            given = alone[k].step(dict(zip(PAIR, action[rows], strict=True)))
            ended = given[2]["vehicle_1"] or given[3]["vehicle_1"]
            assert done[rows].tolist() == [ended] * 2
            assert [np.float32(given[1][agent]) for agent in PAIR] == reward[rows].tolist()
            seen = [infos[row]["terminal_observation"] for row in rows] if ended else observation[rows]
            assert np.array_equal(seen, [given[0][agent] for agent in PAIR])
            for row, agent in zip(rows, PAIR, strict=True):
                told = {**given[4][agent], "world": k, "world_seed": seed}  # alone they were given
                assert {name: infos[row][name] for name in told} == told
                assert infos_of_plain[row].keys() == (infos[row].keys() if ended else set())
            running -= {k} if ended else set()
    assert not running


def test_seed__is_used_by_the_next_reset_only_and_none_is_fresh_entropy() -> None:
    env = make_sb3_vec_env(PAPER, 2, seed=8)
    first, second = env.reset(), env.reset()
    assert np.array_equal(first[0], EthBrakeEnv(PAPER).reset(seed=8)[0]) and not np.array_equal(first, second)
    assert env.seed(8) == [8, 8]
    assert np.array_equal(env.reset(), first) and np.array_equal(env.reset(), second)
    assert env.seed(None) != env.seed(None)


def test_set_options__gives_each_world_its_own_start_once_and_fails_one_reset_only() -> None:
    env = make_sb3_vec_env(CRASH.replace(obstacle_gap_m=30), 2, learners=["vehicle_1", "vehicle_2"])
    far, near_, bad = ({"initial_state": {"gaps_m": gap, "speeds_mps": 10}} for gap in (40, 4, -1))
    env.set_options([far, far, near_, near_])
    env.reset()
    assert env.engine.worlds.speeds_mps.tolist() == [[10.0, 10.0]] * 2
    assert env.engine.worlds.gaps_m[:, 0].tolist() == [40.0, 4.0]
    env.set_options([bad] * 4)
    with pytest.raises(InvalidInput, match=r"gaps_m\[0\] = -1"):
        env.reset()
    assert env.engine.worlds.gaps_m[:, 0].tolist() == [40.0, 4.0]
    env.reset()
    assert env.engine.worlds.gaps_m[:, 0].tolist() == [3.0, 3.0]
    env.set_options([{"listed_world": {"seed": 7, "number": 40}}] * 4)
    with pytest.warns(UserWarning, match="unknown option listed_world, ignored; known: initial_state"):
        env.reset()


def test_reset_infos__belong_to_the_running_episodes_and_tell_the_news_of_each_learner() -> None:
    env = begun(CRASH.replace(latency_s=[0, {"uniform": [0.3, 0.6]}]), 2)
    starts = [set(), set()]
    for _ in range(30):
        done = env.step(np.zeros((2, 1), np.float32))[2]
        for row in range(2):
            starts[row].add(env.reset_infos[row]["time_s"])
            assert not done[row] or env.reset_infos[row]["time_s"] == env.engine.worlds.time_s[row]
    assert min(len(seen) for seen in starts) >= 4  # an episode takes 7 to 10 steps
    env = begun(line(4), 3, seed=5)
    known = env.engine.packed.known_from_s
    told = [info["known_from_s"].tolist() for info in env.reset_infos]
    assert told == [known[k, i].tolist() for k in range(3) for i in range(4)]


def test_attributes__belong_to_the_whole_batch() -> None:
    env = make_sb3_vec_env(CRASH, 3)
    assert isinstance(env, EthBrakeVecEnv) and env.get_attr("render_mode") == [None] * 3
    assert [engine is env.engine for engine in env.get_attr("engine", indices=[0, 2])] == [True, True]
    env.set_attr("label", 7)
    assert (env.get_attr("label"), env.env_method("seed", 4)) == ([7] * 3, [[4] * 3] * 3)
    assert (env.has_attr("engine"), env.has_attr("nothing")) == (True, False)
    assert env.env_is_wrapped(Monitor) == [False] * 3


def test_video__shows_every_world_of_the_batch() -> None:
    env = make_sb3_vec_env("paper-random", 3, render_mode="rgb_array")
    env.reset()
    env.step(np.zeros((3, 1)))
    assert env.metadata["render_fps"] == 10 and [image.shape for image in env.get_images()] == [(304, 800, 3)] * 3
    assert (env.render() != 0).any()


def test_step_async__keeps_its_own_copy_of_the_actions() -> None:
    env, untouched = begun(PAPER, 2), begun(PAPER, 2)
    action = np.full((1, 2), -0.5, np.float32)  # lying: the only row of a batch of columns
    env.step_async(action)
    action[:] = np.nan
    assert np.array_equal(env.step_wait()[0], untouched.step(np.full((2, 1), -0.5, np.float32))[0])


@pytest.mark.parametrize("horizon_is_end", [False, True])
def test_horizon_is_end__hides_the_truncation_and_nothing_else(horizon_is_end: bool) -> None:
    env = begun(PAPER, 3, seed=4, horizon_is_end=horizon_is_end)
    cut = []
    for _ in range(75):  # 0.5 s to 8 s
        _, _, done, infos = env.step(np.ones((3, 1), np.float32))  # drives on, so that the horizon cuts the episode off
        cut += [info["TimeLimit.truncated"] for info in infos if info]
    assert done.all() and cut == [not horizon_is_end] * 3
    assert all(info["terminal_observation"].shape == (27,) for info in infos)


@pytest.mark.parametrize("appended", ["number", "state"])
def test_appended__stands_behind_the_own_observation_in_every_row(appended: Any) -> None:
    three = ["vehicle_2", "vehicle_3", "vehicle_5"]
    plain = make_sb3_vec_env(FIVE, 3, seed=2, learners=three)
    more = make_sb3_vec_env(FIVE, 3, seed=2, learners=three, appended=appended)
    own = plain.observation_space.shape[0]
    rows, seen = plain.reset(), more.reset()
    ended = 0
    for _ in range(90):
        expected = np.tile([[0.0], [1.0], [2.0]], (3, 1))
        if appended == "state":
            expected = full_state(more.engine.worlds, more.engine.scenario).repeat(3, axis=0)
        np.testing.assert_array_equal(seen, np.hstack([rows, expected.astype(np.float32)]))
        assert more.observation_space.contains(seen[2])
        given = np.full((9, 1), -0.8, np.float32)
        (rows, _, _, plainly), (seen, _, dones, infos) = plain.step(given), more.step(given)
        for row in np.flatnonzero(dones):
            last = infos[row]["terminal_observation"]
            np.testing.assert_array_equal(last[:own], plainly[row]["terminal_observation"])
            assert last.shape == more.observation_space.shape
            assert appended == "state" or last[own] == row % 3
            ended += 1
    assert ended > 0
