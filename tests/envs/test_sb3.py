from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor

from ethbrake_marl.envs.interfaces import EthBrakeEnv, parallel_env
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario import full_state
from tests.contract.interfaces import FIVE, PAPER, actions, initial_state
from tests.envs.lines import CRASH, REST

near = pytest.approx
PAIR = ["vehicle_2", "vehicle_3"]


def test_episode__of_a_crash_by_hand() -> None:
    env = make_sb3_vec_env(CRASH, 2)
    env.reset()
    for k in range(8):
        observation, reward, done, infos = env.step(np.array([[0.0], [-1.0]], np.float32))
        assert reward.dtype == np.float32
        assert done.tolist() == [k == 7] * 2
        assert [info.get("TimeLimit.truncated", False) for info in infos] == [k == 7] * 2
        assert all(("episode" in info) == (k == 7) for info in infos)
    coasting, braking = infos
    assert coasting["episode"] == {"r": near(-36.0), "l": 8, "t": 0.0}
    assert braking["episode"] == {"r": 0.0, "l": 8, "t": 0.0}
    assert (coasting["world_total_harm"], coasting["first_impact_harm"]) == (near(36.0), near(9.0))
    # Together at (14 + 3 * 20) / 4 = 18.5 m/s after the impact at 1 s, then 0.3 s under 6 / 4 m/s2.
    assert coasting["terminal_observation"][0] == near((18.5 - 0.45) / 20.0)
    assert observation[0, 0] == 1.0  # the next episode, at 20 m/s again


def test_episode__ended_by_rest_is_not_truncated() -> None:
    env = make_sb3_vec_env(REST, 1)
    env.reset()
    for _ in range(10):
        _, _, done, infos = env.step(np.full((1, 1), -1.0, np.float32))
    assert done.all() and infos[0]["TimeLimit.truncated"] is False
    assert infos[0]["episode"]["l"] == 10
    assert infos[0]["terminal_observation"][0] == 0.0


def test_episode__returns_and_lengths_start_again_with_each_one() -> None:
    env = make_sb3_vec_env(CRASH, 1)
    env.reset()
    episodes = []
    for k in range(24):
        infos = env.step(np.full((1, 1), 0.0 if k < 16 else -1.0, np.float32))[3]
        episodes += [info["episode"] for info in infos if "episode" in info]
    assert [episode["l"] for episode in episodes] == [8, 8, 8]
    assert [episode["r"] for episode in episodes] == [near(-36.0), near(-36.0), 0.0]
    env.step(np.zeros((1, 1), np.float32))
    env.reset()
    for _ in range(8):
        infos = env.step(np.zeros((1, 1), np.float32))[3]
    assert infos[0]["episode"]["l"] == 8


def test_rows__are_learners_within_worlds() -> None:
    n, seed = 3, 5
    env = make_sb3_vec_env(FIVE, n, seed=seed, learners=PAIR)
    assert env.num_envs == n * 2
    start = env.reset()
    worlds = FIVE.with_learners(PAIR).sample(n, seed, channel="training").worlds
    alone = [parallel_env(FIVE, learners=PAIR) for _ in range(n)]
    for k, single in enumerate(alone):
        given = single.reset(options={"initial_state": initial_state(worlds, k)})[0]
        assert np.array_equal(start[2 * k : 2 * k + 2], [given[agent] for agent in PAIR])
    running = set(range(n))
    for action in actions(3, 100, 2 * n):
        observation, reward, done, infos = env.step(action)
        for k in sorted(running):
            rows = [2 * k, 2 * k + 1]
            given = alone[k].step(dict(zip(PAIR, action[rows], strict=True)))
            ended = given[2]["vehicle_1"] or given[3]["vehicle_1"]
            assert done[rows].tolist() == [ended] * 2
            assert [np.float32(given[1][agent]) for agent in PAIR] == reward[rows].tolist()
            seen = [infos[row]["terminal_observation"] for row in rows] if ended else observation[rows]
            assert np.array_equal(seen, [given[0][agent] for agent in PAIR])
            if ended:
                assert [infos[row]["total_harm"] for row in rows] == [given[4][a]["total_harm"] for a in PAIR]
                running.remove(k)
    assert not running


def test_observation__is_one_block_of_its_own_memory() -> None:
    env = make_sb3_vec_env(FIVE, 3, learners=PAIR)
    first = env.reset()
    second = env.step(np.zeros((6, 1), np.float32))[0]
    assert not np.shares_memory(first, second) and first.flags.c_contiguous and second.flags.c_contiguous
    assert not np.shares_memory(first, second)


def test_terminal_observation__owns_its_memory() -> None:
    env = make_sb3_vec_env(CRASH, 2)
    env.reset()
    for _ in range(8):
        infos = env.step(np.zeros((2, 1), np.float32))[3]
    a, b = (info["terminal_observation"] for info in infos)
    assert a.flags.owndata and b.flags.owndata and not np.shares_memory(a, b)


def test_seed__is_used_by_the_next_reset_only() -> None:
    env = make_sb3_vec_env(PAPER, 2, seed=8)
    expected, _ = EthBrakeEnv(PAPER).reset(seed=8)
    first, second = env.reset(), env.reset()
    assert np.array_equal(first[0], expected)
    assert not np.array_equal(first, second)
    assert env.seed(8) == [8, 8]
    assert np.array_equal(env.reset(), first)
    assert np.array_equal(env.reset(), second)


def test_seed__none_is_fresh_entropy() -> None:
    assert not np.array_equal(
        make_sb3_vec_env(PAPER, 2, seed=None).reset(), make_sb3_vec_env(PAPER, 2, seed=None).reset()
    )
    env = make_sb3_vec_env(PAPER, 2)
    assert env.seed(None) != env.seed(None)


@pytest.mark.parametrize("seed", [-1, 0.5, "0"])
def test_seed__anything_but_a_whole_number_from_0_is_refused(seed: Any) -> None:
    with pytest.raises(InvalidInput, match="seed"):
        make_sb3_vec_env(PAPER, 1, seed=seed)
    with pytest.raises(InvalidInput, match="seed"):
        make_sb3_vec_env(PAPER, 1).seed(seed)


def test_set_options__gives_each_world_its_own_start_once() -> None:
    env = make_sb3_vec_env(CRASH.replace(obstacle_gap_m=30), 2, learners=["vehicle_1", "vehicle_2"])
    far, near_ = ({"initial_state": {"gaps_m": gap, "speeds_mps": 10}} for gap in (40, 4))
    env.set_options([far, far, near_, near_])
    env.reset()
    assert env.engine.worlds.speeds_mps.tolist() == [[10.0, 10.0]] * 2
    assert env.engine.worlds.gaps_m[:, 0].tolist() == [40.0, 4.0]
    env.reset()
    assert env.engine.worlds.gaps_m[:, 0].tolist() == [3.0, 3.0]


@pytest.mark.parametrize("order", [(0, 1, 1, 1), (0, None, 1, 1), (None, None, 1, 1), (0, 0)])
def test_set_options__rows_that_do_not_fit_together_are_refused(order: tuple[int | None, ...]) -> None:
    env = make_sb3_vec_env(CRASH.replace(obstacle_gap_m=30), 2, learners=["vehicle_1", "vehicle_2"])
    starts = [{"initial_state": {"gaps_m": np.array([gap])}} for gap in (40.0, 4.0)]
    env.set_options([{} if k is None else starts[k] for k in order])
    with pytest.raises(InvalidInput, match="set_options: "):
        env.reset()


def test_reset_infos__belong_to_the_running_episodes() -> None:
    env = make_sb3_vec_env(CRASH.replace(latency_s=[0, {"uniform": [0.3, 0.6]}]), 2)
    env.reset()
    starts = [set(), set()]
    for _ in range(30):
        done = env.step(np.zeros((2, 1), np.float32))[2]
        for row in range(2):
            starts[row].add(env.reset_infos[row]["time_s"])
            if done[row]:
                assert env.reset_infos[row]["time_s"] == env.engine.worlds.time_s[row]
    assert min(len(seen) for seen in starts) >= 4  # an episode takes 7 to 10 steps


def test_attributes__belong_to_the_whole_batch() -> None:
    env = make_sb3_vec_env(CRASH, 3)
    assert env.get_attr("render_mode") == [None] * 3
    assert [engine is env.engine for engine in env.get_attr("engine", indices=[0, 2])] == [True, True]
    assert env.has_attr("engine") and not env.has_attr("nothing")
    env.set_attr("label", 7)
    assert env.get_attr("label") == [7, 7, 7]
    assert env.env_method("seed", 4) == [[4, 4, 4]] * 3
    assert env.env_is_wrapped(Monitor) == [False] * 3
    with pytest.raises(InvalidInput, match="set_attr: indices 0; rows share one batch"):
        env.set_attr("label", 8, indices=0)
    with pytest.raises(InvalidInput, match="env_method"):
        env.env_method("seed", 4, indices=[1])


def test_wrappers__vec_monitor_agrees_with_the_episodes_own_figures() -> None:
    env = make_sb3_vec_env(PAPER, 2)
    monitored = VecMonitor(make_sb3_vec_env(PAPER, 2))
    env.reset(), monitored.reset()
    seen = 0
    for action in actions(3, 90, 2):
        ours, theirs = env.step(action)[3], monitored.step(action)[3]
        for mine, other in zip(ours, theirs, strict=True):
            assert ("episode" in mine) == ("episode" in other)
            if "episode" in mine:
                assert (mine["episode"]["l"], mine["episode"]["r"]) == (
                    other["episode"]["l"],
                    near(other["episode"]["r"]),
                )
                seen += 1
    assert seen >= 2


def test_learners__at_least_one_is_needed() -> None:
    with pytest.raises(InvalidInput, match="has no learner; pass learners="):
        make_sb3_vec_env(CRASH, 2, learners=[])


def test_step_async__keeps_its_own_copy_of_the_actions() -> None:
    env, untouched = make_sb3_vec_env(PAPER, 2), make_sb3_vec_env(PAPER, 2)
    env.reset(), untouched.reset()
    action = np.full((2, 1), -0.5, np.float32)
    env.step_async(action)
    action[:] = np.nan
    assert np.array_equal(env.step_wait()[0], untouched.step(np.full((2, 1), -0.5, np.float32))[0])
    with pytest.raises(InvalidInput, match="step"):
        env.step_wait()


def test_make_sb3_vec_env__is_a_vec_env_of_the_named_scenario() -> None:
    env = make_sb3_vec_env("paper-delay-high", 2, reward="paper")
    assert isinstance(env, EthBrakeVecEnv)
    assert (env.engine.scenario.name, env.engine.reward.terminal) == ("paper-delay-high", 10.0)
    env.close()


def test_set_options__that_cannot_be_used_fail_one_reset_only() -> None:
    env = make_sb3_vec_env(PAPER, 2, seed=4)
    expected = make_sb3_vec_env(PAPER, 2, seed=4).reset()
    env.set_options([{"initial_state": {"gaps_m": -1}}] * 2)
    with pytest.raises(InvalidInput):
        env.reset()
    assert (env.reset() == expected).all()


@pytest.mark.parametrize("horizon_is_end", [False, True])
def test_horizon_is_end__hides_the_truncation_and_nothing_else(horizon_is_end: bool) -> None:
    env = make_sb3_vec_env(PAPER, 3, seed=4, horizon_is_end=horizon_is_end)
    env.reset()
    cut = []
    for _ in range(75):  # 0.5 s to 8 s
        _, _, done, infos = env.step(np.ones((3, 1), np.float32))  # drives on, so that the horizon cuts the episode off
        cut += [info["TimeLimit.truncated"] for info in infos if info]
    assert done.all() and cut == [not horizon_is_end] * 3
    assert all(info["terminal_observation"].shape == (27,) for info in infos)


def test_appended__that_is_unknown_is_refused_at_construction() -> None:
    with pytest.raises(InvalidInput, match="appended = 'x': must be number or state, or None"):
        make_sb3_vec_env(FIVE, 3, appended="x")  # type: ignore[arg-type]


@pytest.mark.parametrize("appended", ["number", "state"])
def test_appended__stands_behind_the_own_observation_in_every_row(appended: Any) -> None:
    plain = make_sb3_vec_env(FIVE, 3, seed=2, learners=PAIR)
    more = make_sb3_vec_env(FIVE, 3, seed=2, learners=PAIR, appended=appended)
    own = plain.observation_space.shape[0]
    rows, seen = plain.reset(), more.reset()
    ended = 0
    for _ in range(90):
        expected = np.tile([[0.0], [1.0]], (3, 1))
        if appended == "state":
            expected = full_state(more.engine.worlds, more.engine.scenario).repeat(2, axis=0)
        np.testing.assert_array_equal(seen[:, :own], rows)
        np.testing.assert_array_equal(seen[:, own:], expected.astype(np.float32))
        assert more.observation_space.contains(seen[0])
        actions = np.full((6, 1), -0.8, np.float32)
        (rows, _, _, plainly), (seen, _, dones, infos) = plain.step(actions), more.step(actions)
        for row in np.flatnonzero(dones):
            last = infos[row]["terminal_observation"]
            np.testing.assert_array_equal(last[:own], plainly[row]["terminal_observation"])
            assert last.shape == more.observation_space.shape
            assert appended == "state" or last[own] == row % 2
            ended += 1
    assert ended > 0


def test_step_infos__tell_each_learner_in_every_step_what_the_parallel_environment_tells() -> None:
    learners = ["vehicle_2", "vehicle_3"]
    vec = make_sb3_vec_env("paper-random", 2, seed=3, learners=learners, step_infos=True)
    plain = make_sb3_vec_env("paper-random", 2, seed=3, learners=learners)
    env = parallel_env("paper-random", learners=learners)
    vec.reset(), plain.reset(), env.reset(seed=3)
    ended, cost = False, 0.0
    while not ended:
        actions = np.full((4, 1), -0.7, np.float32)
        *_, dones, infos = vec.step(actions)
        *_, infos_of_plain = plain.step(actions)
        *_, told = env.step(dict.fromkeys(learners, actions[0]))
        ended = bool(dones[0])
        for row, name in enumerate(learners):
            assert {key: infos[row][key] for key in told[name]} == told[name]
        cost += infos[0]["cost"]
        assert ended or infos_of_plain[:2] == [{}, {}]
    assert infos[0].keys() == infos_of_plain[0].keys() and cost == pytest.approx(infos[0]["world_first_impact_harm"])
