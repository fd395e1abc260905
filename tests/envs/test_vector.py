from __future__ import annotations

from itertools import combinations
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from ethbrake_marl.envs.interfaces import EthBrakeEnv, EthBrakeVectorEnv
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario import Scenario
from tests.contract.interfaces import FIVE, PAPER, actions, initial_state

near = pytest.approx

# Two vehicles 50 m apart at 5.7 m/s: who brakes fully rests in step 10, who coasts reaches the horizon in step 12.
SHORT = Scenario(
    name="short",
    vehicles=2,
    gaps_m={"uniform": [50, 60]},
    speeds_mps=5.7,
    braking_capacity_mps2=6,
    driving_capacity_mps2=6,
    mass_t=1,
    latency_s=[0, 0.5],
    horizon_s=1.7,
)
BRAKE_AND_COAST = np.array([[-1.0], [0.0]], np.float32)


def made(mode: str, n: int = 2, scenario: Scenario = SHORT) -> EthBrakeVectorEnv:
    env = EthBrakeVectorEnv(n, scenario, autoreset_mode=mode)
    env.reset(seed=0)
    return env


def test_autoreset__same_step_literally() -> None:
    env = made("SameStep")
    rows = []
    for k in range(1, 25):
        observation, reward, terminated, truncated, infos = env.step(BRAKE_AND_COAST)
        ended = terminated | truncated
        rows.append((k, terminated.tolist(), truncated.tolist(), np.round(infos["time_s"], 9).tolist()))
        assert ("final_obs" in infos) == ended.any()
        assert infos["_chosen_action"].all()
        assert (infos["chosen_action"][ended] == 0.0).all()
        if ended.any():
            assert np.array_equal(infos["_final_obs"], ended)
            assert [final is not None for final in infos["final_obs"]] == ended.tolist()
            assert [obs[1] == 0.0 for obs in observation] == (ended | [False, True]).tolist()  # no command yet
        assert (reward == 0.0).all()
    ends = [row for row in rows if True in row[1] + row[2]]
    assert ends == [
        (10, [True, False], [False, False], [0.5, 1.5]),
        (12, [False, False], [False, True], [0.7, 0.5]),
        (20, [True, False], [False, False], [0.5, 1.3]),
        (24, [False, False], [False, True], [0.9, 0.5]),
    ]


def test_autoreset__next_step_literally() -> None:
    env = made("NextStep")
    rows = []
    for k in range(1, 27):
        _, reward, terminated, truncated, infos = env.step(BRAKE_AND_COAST)
        rows.append((k, terminated.tolist(), truncated.tolist(), np.round(infos["time_s"], 9).tolist()))
        assert "final_obs" not in infos
        assert (reward == 0.0).all()
    # An ended row shows its last moment (1.5 s; the horizon 1.7 s), and its next step is the reset (0.5 s).
    assert [rows[k - 1] for k in (9, 10, 11, 12, 13, 14, 21, 22, 25, 26)] == [
        (9, [False, False], [False, False], [1.4, 1.4]),
        (10, [True, False], [False, False], [1.5, 1.5]),
        (11, [False, False], [False, False], [0.5, 1.6]),
        (12, [False, False], [False, True], [0.6, 1.7]),
        (13, [False, False], [False, False], [0.7, 0.5]),
        (14, [False, False], [False, False], [0.8, 0.6]),
        (21, [True, False], [False, False], [1.5, 1.3]),
        (22, [False, False], [False, False], [0.5, 1.4]),
        (25, [False, False], [False, True], [0.8, 1.7]),
        (26, [False, False], [False, False], [0.9, 0.5]),
    ]
    assert sum(True in row[1] + row[2] for row in rows) == 4


def test_autoreset__next_step_ignores_the_action_of_the_reset_and_rewards_nothing() -> None:
    # Closing 1 m at 6 m/s2 takes 0.58 s: an impact with harm 12 in the first of three steps (0.5 to 0.8 s).
    crash = SHORT.replace(gaps_m=1, speeds_mps=20, horizon_s=0.8)
    env, plain = made("NextStep", scenario=crash), made("NextStep", scenario=crash)
    for k in range(1, 13):
        action = np.zeros((2, 1), np.float32)
        observation, reward, _, truncated, infos = env.step(action + (0.7 if k in (4, 8) else 0.0))
        expected = plain.step(action)
        assert np.array_equal(observation, expected[0])
        assert np.array_equal(reward, expected[1])
        assert reward == near(np.full(2, -12.0 if k in (1, 5, 9) else 0.0))
        assert truncated.all() == (k in (3, 7, 11))
        assert np.array_equal(infos["reward_harm"] == 0.0, [k not in (1, 5, 9)] * 2)
        assert np.array_equal(infos["chosen_action"][:, 0] == 0.0, [True] * 2)


def test_autoreset__both_modes_play_the_same_first_episodes() -> None:
    same, later = made("SameStep", 3, PAPER), made("NextStep", 3, PAPER)
    running = np.ones(3, np.bool_)
    for action in actions(3, 90, 3):
        a, b = same.step(action), later.step(action)
        assert np.array_equal(a[1][running], b[1][running])
        ended = (a[2] | a[3]) & running
        assert np.array_equal((b[2] | b[3]) & running, ended)
        for row in np.flatnonzero(ended):
            assert np.array_equal(a[4]["final_obs"][row], b[0][row])
            assert a[4]["final_info"]["total_harm"][row] == b[4]["total_harm"][row]
        running &= ~ended
        assert np.array_equal(a[0][running], b[0][running])
    assert not running.any()


@pytest.mark.parametrize("mode", list(AutoresetMode)[:2])
def test_metadata__states_the_mode(mode: AutoresetMode) -> None:
    assert EthBrakeVectorEnv(1, SHORT, autoreset_mode=mode).metadata["autoreset_mode"] is mode
    assert EthBrakeVectorEnv(1, SHORT, autoreset_mode=mode.value).metadata["autoreset_mode"] is mode


@pytest.mark.parametrize("mode", ["same", AutoresetMode.DISABLED, None])
def test_autoreset_mode__another_one_is_refused(mode: Any) -> None:
    with pytest.raises(InvalidInput, match=r"autoreset_mode = .*: must be 'SameStep' or 'NextStep'"):
        EthBrakeVectorEnv(1, SHORT, autoreset_mode=mode)


@pytest.mark.parametrize("n", [0, -1, 2.5, True])
def test_num_envs__must_be_a_number_of_worlds(n: Any) -> None:
    with pytest.raises(InvalidInput, match="number of worlds"):
        EthBrakeVectorEnv(n, SHORT)


def test_infos__are_gymnasiums_columns_and_masks() -> None:
    env = made("SameStep", 3, FIVE)
    capacity = env.engine.worlds.vehicles.braking_capacity_mps2[:, 3]
    for action in actions(3, 5, 3):
        infos = env.step(action)[4]
    names = {name for name in infos if not name.startswith("_")}
    assert {f"_{name}" for name in names} == set(infos) - names
    for name in names:
        assert infos[name].shape == ((3, 1) if name == "chosen_action" else (3,))
        assert infos[f"_{name}"].tolist() == [True] * 3
    arrays = [value for value in infos.values() if isinstance(value, np.ndarray)]
    assert not any(np.shares_memory(a, b) for a, b in combinations(arrays, 2))
    assert np.array_equal(infos["chosen_action"], action)
    assert infos["chosen_command_mps2"] == near(action[:, 0] * np.where(action[:, 0] < 0, capacity, 3.0))


def test_infos__are_those_of_an_environment_alone() -> None:
    n = 3
    env = made("SameStep", n, FIVE)
    starts = env.reset(seed=6)[1]
    alone = [EthBrakeEnv(FIVE) for _ in range(n)]
    worlds = FIVE.sample(n, 6, channel="training").worlds
    for k in range(n):
        info = alone[k].reset(options={"initial_state": initial_state(worlds, k)})[1]
        del info["world"], info["world_seed"]  # it was given
        assert {name: starts[name][k] for name in info} == info
    running = set(range(n))
    for action in actions(3, 90, n):
        infos = env.step(action)[4]
        for k in sorted(running):
            *_, terminated, truncated, info = alone[k].step(action[k])
            columns = infos["final_info"] if terminated or truncated else infos
            named = {name: info.pop(name) for name in ("world", "world_seed")}  # alone they were given
            assert named["world"] == -1
            assert (columns["world_seed"][k], columns["world"][k]) == (6, k)
            assert {name: columns[name][k] for name in info} == info
            running -= {k} if terminated or truncated else set()
    assert not running


def test_make_vec__finds_it_and_takes_settings() -> None:
    env = gymnasium.make_vec("EthBrake-v0", num_envs=4, vectorization_mode="vector_entry_point", scenario=FIVE)
    assert isinstance(env.unwrapped, EthBrakeVectorEnv)
    assert env.observation_space.shape == (4, *env.single_observation_space.shape)
    assert env.action_space.shape == (4, 1)
    observation, _ = env.reset(seed=1)
    assert observation in env.observation_space
    assert type(gymnasium.make_vec("EthBrake-v0", num_envs=2).unwrapped) is EthBrakeVectorEnv


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_wrappers__gymnasiums_episode_statistics_count_right(mode: str) -> None:
    env = RecordEpisodeStatistics(made(mode, 2, PAPER))
    env.reset(seed=4)
    returns: list[float] = []
    harm: list[float] = []
    for action in actions(3, 160, 2):
        _, _, terminated, truncated, infos = env.step(action)
        for row in np.flatnonzero(terminated | truncated):
            final = infos["final_info"] if mode == "SameStep" else infos
            returns.append(infos["episode"]["r"][row])
            harm.append(final["world_first_impact_harm"][row])
    assert len(returns) >= 4
    assert [-r for r in returns] == near(harm)


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_make_vec__gymnasiums_own_vectorization_works_too(mode: str) -> None:
    env = gymnasium.make_vec("EthBrake-v0", num_envs=2, vectorization_mode=mode, scenario=PAPER)
    alone = gymnasium.make("EthBrake-v0", scenario=PAPER)
    observation, _ = env.reset(seed=7)  # Gymnasium gives world k the seed 7 + k
    for k in range(2):
        assert np.array_equal(observation[k], alone.reset(seed=7 + k)[0])
    for action in actions(3, 3, 2):
        observation = env.step(action)[0]
        assert np.array_equal(observation[1], alone.step(action[1])[0])
    env.close()


@pytest.mark.parametrize("ignored", [np.nan, 5.0])
def test_next_step__an_ignored_action_may_be_anything(ignored: float) -> None:
    env = made("NextStep", 3, SHORT)
    env.reset(seed=0)
    braking = np.array([[-1.0], [0.0], [0.0]], np.float32)
    ended = np.zeros(3, np.bool_)
    while not ended.any():
        _, _, terminated, truncated, _ = env.step(braking)
        ended = terminated | truncated
    assert ended.tolist() == [True, False, False]
    given = np.where(ended[:, np.newaxis], np.float32(ignored), np.float32(0.0))
    _, rewards, *_ = env.step(given)
    assert rewards[0] == 0.0
    assert np.isnan(given).any() == np.isnan(ignored)  # the caller's array stays as it is
    with pytest.raises(InvalidInput, match="action of vehicle_2"):
        env.step(given)
