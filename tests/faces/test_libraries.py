"""The checks that the libraries give for environments, and a training with each of their interfaces."""

import warnings
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FrameStackObservation, RecordEpisodeStatistics, TimeLimit
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordVectorStatistics
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv, raw_env
from ethbrake_marl.faces.sb3 import make_sb3_vec_env
from ethbrake_marl.faces.vector import EthBrakeVectorEnv

SETTINGS: list[dict[str, Any]] = [
    {}, {"scenario": "cooperation-4-five"}, {"scenario": "paper-random-obstacle", "agents": "learners"},
    {"actions": 5, "reward": "paper"}, {"scenario": "mixture-delays", "max_cycles": 7},
]  # fmt: skip


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_pettingzoo__finds_nothing_wrong(settings: dict[str, Any]) -> None:
    parallel_api_test(EthBrakeParallelEnv(**settings), num_cycles=60)
    parallel_seed_test(lambda: EthBrakeParallelEnv(**settings))
    api_test(raw_env(**settings), num_cycles=60)
    seed_test(lambda: raw_env(**settings))


@pytest.mark.parametrize("settings", [{}, {"scenario": "paper-random-buildup", "actions": 3}], ids=str)
def test_gymnasium__finds_nothing_wrong(settings: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*(not within|different from the unwrapped version|no render modes).*")
        check_env(EthBrakeEnv(**settings), skip_render_check=True)


def test_gymnasium__wrappers_count_and_cut() -> None:
    environment = RecordEpisodeStatistics(TimeLimit(FrameStackObservation(EthBrakeEnv(), 3), 5))
    observation, _ = environment.reset(seed=1)
    assert observation.shape == (3, *EthBrakeEnv().observation_space.shape)
    for _ in range(5):
        *_, truncated, info = environment.step(np.array([-1.0], np.float32))
    assert truncated
    assert info["episode"]["l"] == 5
    many = RecordVectorStatistics(EthBrakeVectorEnv(4))
    many.reset(seed=1)
    lengths = [
        info["episode"]["l"][info["_episode"]]
        for *_, info in (many.step(np.full((4, 1), -1.0, np.float32)) for _ in range(100))
        if "episode" in info
    ]
    assert np.concatenate(lengths).max() <= 76  # 7.6 s of decisions


def test_stable_baselines3__checks_and_trains() -> None:
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_checker import check_env as check_for_sb3

    check_for_sb3(EthBrakeEnv())
    for environment in (make_sb3_vec_env("cooperation-3-pair", 4, seed=1), make_sb3_vec_env("paper-random", 3, seed=1)):
        model = stable_baselines3.PPO("MlpPolicy", environment, n_steps=32, batch_size=32, n_epochs=1, seed=1)
        assert model.learn(256).num_timesteps >= 256


def test_supersuit__makes_a_vector_of_the_learners() -> None:
    supersuit = pytest.importorskip("supersuit")
    environment = supersuit.pettingzoo_env_to_vec_env_v1(EthBrakeParallelEnv("cooperation-4-all", agents="learners"))
    seen, _ = environment.reset(seed=1)
    assert len(seen) == 3
    _, rewards, *_ = environment.step(np.full((3, 1), -1.0, np.float32))
    assert len(rewards) == 3
