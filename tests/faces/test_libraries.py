"""The libraries find and accept the environments: their ids, their own checks, their wrappers."""

import warnings
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
from stable_baselines3.common.env_checker import check_env as check_for_sb3

from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv, raw_env
from ethbrake_marl.faces.registration import register_environments
from ethbrake_marl.faces.vector import EthBrakeVectorEnv

SETTINGS: list[dict[str, Any]] = [
    {"scenario": "paper-random-obstacle", "agents": "learners"}, {"actions": 5, "reward": "paper"},
    {"scenario": "mixture-delays", "max_cycles": 7},
]  # fmt: skip


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_pettingzoo__finds_nothing_wrong(settings: dict[str, Any]) -> None:
    parallel_api_test(EthBrakeParallelEnv(**settings), num_cycles=60)
    parallel_seed_test(lambda: EthBrakeParallelEnv(**settings))
    api_test(raw_env(**settings), num_cycles=60)
    seed_test(lambda: raw_env(**settings))


@pytest.mark.parametrize("settings", [{}, {"scenario": "paper-random-buildup", "actions": 3}], ids=str)
def test_gymnasium_and_stable_baselines3__find_nothing_wrong(settings: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*(not within|different from the unwrapped version|no render modes).*")
        check_env(EthBrakeEnv(**settings), skip_render_check=True)
        check_for_sb3(EthBrakeEnv(**settings))


def test_ids__make_the_environments_of_each_library() -> None:
    register_environments()
    register_environments()  # has no effect
    single = gymnasium.make("EthBrake-v1", scenario="paper-random-obstacle", max_episode_steps=3)
    many = gymnasium.make_vec("EthBrake-v1", 2, max_episode_steps=3, autoreset_mode="SameStep")
    vectors = gymnasium.make("EthBrakeMO-v1")
    assert type(single.unwrapped) is type(vectors.unwrapped) is EthBrakeEnv and type(many) is EthBrakeVectorEnv
    for env, action in ((single, np.zeros(1, np.float32)), (many, np.zeros((2, 1)))):
        env.reset(seed=1)
        assert [np.all(env.step(action)[3]) for _ in range(3)] == [False, False, True]
    vectors.reset(seed=1)
    assert vectors.step([0.0])[1].shape == vectors.unwrapped.reward_space.shape == (3,)
    for interface in ("parallel", "aec") if hasattr(pettingzoo, "make") else ():
        assert type(pettingzoo.make(interface, "ethbrake/ethbrake-v1").unwrapped) is EthBrakeParallelEnv


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_pettingzoo_without_a_registry__runs(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("parallel_registry", "aec_registry", "register", "make"):
        monkeypatch.delattr(pettingzoo, name, raising=False)  # as in version 1.26
    register_environments()
    parallel_api_test(EthBrakeParallelEnv(), num_cycles=5)
