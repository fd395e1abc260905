"""Stable-Baselines3's interface: rows, ends, infos, snapshots, options."""

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.episode.full_state import full_state
from ethbrake_marl.faces.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.faces.shield import shield
from tests.contract.interfaces import CRASH, line
from tests.refused import refused


def played(env: EthBrakeVecEnv, steps: int, action: float = -0.3) -> list[Any]:
    return [env.step(np.full((env.num_envs, 1), action)) for _ in range(steps)]


@pytest.mark.parametrize("horizon_is_end", [True, False])
def test_last_infos__by_hand(horizon_is_end: bool) -> None:
    env = make_sb3_vec_env(CRASH, 2, seed=1, reward="first-impact-harm", horizon_is_end=horizon_is_end)
    env.reset()
    *turns, (observation, _, done, infos) = played(env, 8, 0.0)  # to the horizon at 1.3 s, with an impact at 1 s
    assert all(not each.any() and info == [{}, {}] for _, _, each, info in turns) and done.all()
    info = infos[1]
    assert info["episode"] == {"r": pytest.approx(-36.0), "l": 8, "t": 0.0} and info["time_s"] == 1.3
    assert info["TimeLimit.truncated"] == (not horizon_is_end) and info["world_total_harm"] == pytest.approx(36.0)
    assert not np.array_equal(info["terminal_observation"], observation[1])
    played(env, 3, 0.0)
    assert env.reset_infos[1]["world"] == 3 and env.reset_infos[1]["time_s"] == 0.5
    assert played(env, 5, 0.0)[-1][3][0]["episode"] == infos[0]["episode"]


@pytest.mark.parametrize("appended", [None, "number", "state"])
def test_rows__are_the_learners_of_each_world_from_front_to_rear(appended: Any) -> None:
    env = make_sb3_vec_env(line(3), 2, seed=5, appended=appended)
    seen = env.reset()
    for k in range(3):
        own = env.game.observe_alike(env.episode, env.game.settings.learners).reshape(6, -1)
        more = {"number": [[0], [1], [2]] * 2, "state": full_state(env.episode, 12.0, True).repeat(3, axis=0)}
        assert np.array_equal(seen, own if appended is None else np.hstack([own, np.array(more[appended])]))
        assert all(row in env.observation_space for row in seen)
        given = np.arange(6) / 6.0 - 0.5 + 0.1 * k
        seen, _, _, _ = env.step(given[:, np.newaxis])
        state, given = env.episode, given.reshape(2, 3)
        capacity = np.where(given < 0.0, state.braking_capacity_mps2, state.driving_capacity_mps2)
        assert np.allclose(state.commands_mps2, given * capacity)


def test_infos__of_every_step_on_request_and_of_a_shield_always() -> None:
    env = make_sb3_vec_env("paper-random", 2, seed=1, step_infos=True)
    env.reset()
    env.seed(9)  # counts from the next reset
    assert [info["world_seed"] for info in played(env, 1)[0][3]] == [1, 1]
    env.reset()
    infos = played(env, 2)[1][3]
    assert [(info["world_seed"], info["world"]) for info in infos] == [(9, 0), (9, 1)] and "cost" in infos[0]
    guarded = shield(make_sb3_vec_env("cooperation-3-pair", 2, seed=1))
    guarded.reset()
    first = guarded.reset_infos
    infos = played(guarded, 3, 1.0)[-1][3]
    assert infos[0].keys() == {name for name in first[0] if name.startswith("shield_")} and len(infos) == 4
    assert [info["shield_bound_harm"] for info in guarded.reset_infos] == [info["shield_bound_harm"] for info in first]


@pytest.mark.parametrize(
    ("scenario", "make", "reward"),
    [("paper-random", shield, {"harm": 1.0, "shaping": 0.1}), (line(3, v2x="nominal"), lambda env: env, "honest")],
    ids=["shield and shaping", "channel"],
)
def test_snapshot__can_be_restored_again_and_elsewhere(scenario: Any, make: Any, reward: Any) -> None:
    env, other = (make(make_sb3_vec_env(scenario, 4, seed=seed, reward=reward)) for seed in (1, 2))
    env.reset()
    other.reset()
    played(env, 20)
    saved = env.snapshot()
    seen = [[played(env, 90), env.reset_infos]]
    for each in (other, other):
        each.restore(saved)
        seen.append([played(each, 90), each.reset_infos])
    for turns, begun in seen[1:]:
        assert begun == seen[0][1]
        for (observation, reward_, done, infos), (o, r, d, i) in zip(turns, seen[0][0], strict=True):
            assert np.array_equal(observation, o) and np.array_equal(reward_, r) and np.array_equal(done, d)
            assert [info.get("episode") for info in infos] == [info.get("episode") for info in i]


def test_options__are_one_for_all_rows() -> None:
    env, state = make_sb3_vec_env("paper-random", 2), {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}
    env.set_options([{"initial_state": state}, {"initial_state": dict(state)}])
    start = env.reset()
    assert np.array_equal(start[0], start[1]) and not np.array_equal(env.reset()[0], start[0])
    for options in ([{"initial_state": state}, {}], [{}]):
        env.set_options(options)
        with refused("set_options: all worlds are simulated together; give the same options to every row"):
            env.reset()
    env.reset()


def test_attributes__belong_to_all_rows() -> None:
    env = make_sb3_vec_env("cooperation-3-pair", 2, seed=4)
    env.set_attr("step_infos", True)
    assert env.get_attr("step_infos", [0, 3]) == [True, True] and env.env_is_wrapped(object) == [False] * 4
    env.reset()
    assert [world["world_seed"] for world in env.env_method("describe_world")] == [4] * 4
    for ask in (lambda: env.set_attr("step_infos", False, [0]), lambda: env.env_method("close", indices=1)):
        with refused("must not be passed, because all worlds are simulated by one object"):
            ask()


def test_settings__are_checked() -> None:
    with refused("n_envs = 0: must be a whole number, at least 1"):
        make_sb3_vec_env("paper-random", 0)
    with refused("appended = 'all': must be 'number', 'state' or None"):
        make_sb3_vec_env("paper-random", 1, appended="all")  # type: ignore[arg-type]
    with refused("the learners of 'cooperation-3-pair' observe different features"):
        make_sb3_vec_env("cooperation-3-pair", 1, observation={"vehicle_2": ["own"]})
    with refused("has no learner; pass learners=['vehicle_2']"):
        make_sb3_vec_env(CRASH.replace(roles={"vehicle_1": "coast", "vehicle_2": "coast"}), 1)
    env = make_sb3_vec_env("paper-random", 4)
    env.reset()
    with refused("action of the learners: has shape (3,); must have shape (4, 1)"):
        env.step([0.0] * 3)
