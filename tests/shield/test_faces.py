"""The step shield on every face: the libraries' own checkers, and the bound."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test
from stable_baselines3 import PPO

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.envs.parallel import parallel_env
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.shield import HybridShield, ShieldedEnv, shielded_aec
from ethbrake_marl.shield.sb3 import ShieldedVecEnv

KEYS = {
    "mode", "proposed_action", "applied_action", "intervened", "reason", "bound_harm", "margin", "trusted",
}  # fmt: skip


def test_parallel__keeps_the_bound_against_full_driving():
    env = HybridShield(parallel_env(), mode="step")
    for seed in range(5):
        env.reset(seed=seed)
        first = env.attached.shield.first_bound[0]
        while env.agents:
            *_, infos = env.step({"vehicle_2": np.array([1.0])})
            told = infos["vehicle_2"]["shield"]
            assert set(told) == KEYS and told["bound_harm"] <= first and told["trusted"]
        assert env.unwrapped.engine.ledger.world_harm("first")[0] == told["bound_harm"]


def test_parallel__a_policy_proposes_where_nobody_does():
    env = HybridShield(parallel_env(), make_agent("constant:5"), mode="step")
    env.reset(seed=1)
    *_, infos = env.step({})
    assert infos["vehicle_2"]["shield"]["proposed_action"] == pytest.approx(-5.0 / 9.0, abs=0.6)
    alone = HybridShield(parallel_env(), mode="step")
    alone.reset(seed=1)
    with pytest.raises(InvalidInput, match="no action was given"):
        alone.step({})


def test_pettingzoo__checkers_pass():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        parallel_api_test(HybridShield(parallel_env(), mode="step"), num_cycles=100)
        api_test(shielded_aec(parallel_env(), mode="step"), num_cycles=100)


def test_gymnasium__checker_passes_and_the_penalty_is_taken():
    plain = gymnasium.make("EthBrake-v0").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(ShieldedEnv(plain), skip_render_check=True)
    env = ShieldedEnv(gymnasium.make("EthBrake-v0").unwrapped, intervention_penalty=7.0)
    env.reset(seed=0)
    over, paid, harm = False, 0.0, 0.0
    while not over:
        _, reward, terminated, truncated, info = env.step(np.array([1.0], np.float32))
        paid += 7.0 * info["shield"]["intervened"]
        harm += reward
        over = terminated or truncated
    assert paid > 0.0 and set(info["shield"]) == KEYS
    assert info["world_first_impact_harm"] == info["shield"]["bound_harm"]


def test_sb3__rows_keep_their_bounds_over_automatic_resets():
    env = ShieldedVecEnv(make_sb3_vec_env("paper-random", 8, seed=3))
    env.reset()
    rng, ended = np.random.default_rng(0), 0
    for _ in range(120):
        _, _, done, infos = env.step(rng.uniform(-1.0, 1.0, (8, 1)).astype(np.float32))
        assert all(info["shield"]["trusted"] for info in infos)
        for k in np.flatnonzero(done):
            assert infos[k]["world_first_impact_harm"] == infos[k]["shield"]["bound_harm"]
            ended += 1
    assert ended >= 8


def test_sb3__learns_under_the_shield():
    env = ShieldedVecEnv(make_sb3_vec_env("paper-random", 4), intervention_penalty=1.0)
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=3, device="cpu")
    model.learn(256)
    assert np.isfinite(env.step(np.zeros((4, 1), np.float32))[1]).all()


def test_applied__something_between_the_shield_and_the_engine_is_found():
    env = HybridShield(parallel_env(), mode="step")
    env.reset(seed=0)
    env._engine.step = lambda actions, step=env._engine.step: step(np.zeros_like(actions) - 0.123)
    with pytest.raises(EthBrakeError, match="not the certified one"):
        env.step({"vehicle_2": np.array([-1.0])})


def test_learners__exactly_one_is_needed():
    with pytest.raises(InvalidInput, match=r"2 learners \(vehicle_2, vehicle_3\)"):
        ShieldedVecEnv(make_sb3_vec_env("paper-random", 2, learners=["vehicle_2", "vehicle_3"]))
    with pytest.raises(InvalidInput, match="not one of this package's environments"):
        ShieldedEnv(None)


def test_close__lets_go_of_the_environment():
    env = gymnasium.make("EthBrake-v0").unwrapped
    shielded = ShieldedEnv(env)
    shielded.close()
    assert env.engine.on_begin == []
