"""The libraries' own checkers, with every warning an error. A badge: ``test_contract`` is the real suite."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
from pettingzoo.test.state_test import state_test
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from ethbrake_marl import ethbrake_v0
from ethbrake_marl.envs.interfaces import UnknownResetOption
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from tests.contract.interfaces import FIVE, PAPER, SCENARIOS

Maker = Callable[..., Any]


@pytest.fixture(autouse=True)
def _no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # Gymnasium's checker renders in every mode, in a window, too


@pytest.fixture(autouse=True)
def _every_warning_is_an_error() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # PettingZoo's checkers pass {"options": 1} on purpose; asking for a warning here is our own rule.
        warnings.filterwarnings("ignore", "reset: unknown option options, ignored", UnknownResetOption)
        yield


ANY_START = PAPER.replace(early_impacts="keep")
SETTINGS: dict[str, dict[str, Any]] = {name: {"scenario": scenario} for name, scenario in SCENARIOS.items()} | {
    "nobody learns": {"scenario": ANY_START, "learners": []},
    "two learn": {"scenario": ANY_START, "learners": ["vehicle_2", "vehicle_3"]},
}


@pytest.fixture(params=SETTINGS.values(), ids=list(SETTINGS))
def settings(request: pytest.FixtureRequest) -> dict[str, Any]:
    given: dict[str, Any] = request.param
    return given


def test_pettingzoo__parallel_api(settings: dict[str, Any]) -> None:
    parallel_api_test(ethbrake_v0.parallel_env(**settings), num_cycles=150)


def test_pettingzoo__api(settings: dict[str, Any]) -> None:
    api_test(ethbrake_v0.env(**settings), num_cycles=150)


def test_pettingzoo__seeds(settings: dict[str, Any]) -> None:
    parallel_seed_test(lambda: ethbrake_v0.parallel_env(**settings), num_cycles=40)
    seed_test(lambda: ethbrake_v0.env(**settings), num_cycles=40)


def test_pettingzoo__state(settings: dict[str, Any]) -> None:
    state_test(ethbrake_v0.env(**settings), ethbrake_v0.parallel_env(**settings), num_cycles=40)


@pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS)
def test_gymnasium__check_env(scenario: Any) -> None:
    check_env(gymnasium.make("EthBrake-v0", scenario=scenario).unwrapped)


@pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS)
def test_stable_baselines3__check_env(scenario: Any) -> None:
    sb3_check_env(gymnasium.make("EthBrake-v0", scenario=scenario).unwrapped)


@pytest.mark.parametrize("learners", [["vehicle_4"], ["vehicle_2", "vehicle_3"]])
def test_stable_baselines3__learns_on_the_vec_env(learners: list[str]) -> None:
    vec_env = make_sb3_vec_env(FIVE, 4, learners=learners)
    model = PPO("MlpPolicy", vec_env, n_steps=32, batch_size=32, n_epochs=1, seed=3, device="cpu")
    model.learn(768)
    assert len(model.ep_info_buffer) > 0
    assert model.ep_info_buffer[0]["l"] > 0
