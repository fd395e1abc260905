"""The libraries' own checkers, with every warning an error. A badge: ``test_contract`` is the real suite."""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, render_test, seed_test
from pettingzoo.test.state_test import state_test
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.envs.gymnasium import EthBrakeEnv
from ethbrake_marl.first_edition.envs.pettingzoo import env, parallel_env
from ethbrake_marl.first_edition.envs.viewer import Viewer
from tests.first_edition.contract.interfaces import FIVE, LEVELS, PAPER, REST, SCENARIOS, line

pytestmark = pytest.mark.filterwarnings(
    "error",
    # PettingZoo's checkers pass {"options": 1} on purpose; asking for a warning here is our own rule.
    "ignore:reset. options has the unknown keys options:ethbrake_marl.first_edition.envs.making.UnknownResetOption",
    "ignore::ethbrake_marl.first_edition.envs.making.IgnoredAction",  # they act for all agents
    "ignore:.*is different from the unwrapped version",  # a shield is: that is its use
)
ANY_START = PAPER.replace(early_impacts="keep")
SETTINGS: dict[str, dict[str, Any]] = {
    **{
        scenario.name: {"scenario": scenario}
        for scenario in [*SCENARIOS.values(), *LEVELS.values(), line(2), line(6), line(10, "nominal", 8)]
    },
    "nobody learns": {"scenario": ANY_START, "learners": []},
    "two learn": {"scenario": ANY_START, "learners": ["vehicle_2", "vehicle_3"]},
    "learners alone": {"scenario": LEVELS["cooperation-3-pair"], "agents": "learners"},
    "discrete": {"scenario": LEVELS["cooperation-3-pair"], "actions": 9},
    **{mode: {"scenario": REST, "render_mode": mode} for mode in Viewer.METADATA["render_modes"][1:]},
}
STEP, EPISODE = {}, {"mode": "episode", "policy": eb.make_agent("full_brake")}
MAKERS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    **{name: (partial(parallel_env, **given), partial(env, **given)) for name, given in SETTINGS.items()},
    **{
        f"shielded, {mode}": (
            lambda given=given, acts=acts: eb.HybridShield(parallel_env(**acts), **given),
            lambda given=given, acts=acts: eb.shielded_aec(parallel_env(**acts), **given),
        )
        for mode, given, acts in (("step", STEP, {}), ("episode", EPISODE, {}), ("discrete", STEP, {"actions": 9}))
    },
}


@pytest.mark.parametrize("name", MAKERS)
def test_pettingzoo__checkers_pass(name: str) -> None:
    together, in_turn = MAKERS[name]
    parallel_api_test(together(), num_cycles=50)
    api_test(in_turn(), num_cycles=40)
    parallel_seed_test(together, num_cycles=20)
    if "shielded" not in name:
        state_test(in_turn(), together(), num_cycles=40)
    if name not in LEVELS:
        seed_test(in_turn, num_cycles=20)


def test_gymnasium_and_stable_baselines3__checkers_pass_behind_the_shield() -> None:
    for actions in (None, 9):
        check_env(eb.ShieldedEnv(EthBrakeEnv(actions=actions)), skip_render_check=True)
        sb3_check_env(eb.ShieldedEnv(EthBrakeEnv(actions=actions)))


def test_pettingzoo__render_test_passes() -> None:
    pytest.importorskip("pygame", reason="needs the extra: pip install 'ethbrake-marl[render]'")
    warnings.simplefilter("ignore", UserWarning)
    render_test(lambda render_mode: env(scenario=REST, render_mode=render_mode))


def test_stable_baselines3__learns_on_the_vec_env() -> None:
    vec_env = eb.make_sb3_vec_env(FIVE, 4, learners=["vehicle_2", "vehicle_3"])
    model = PPO("MlpPolicy", vec_env, n_steps=32, batch_size=32, n_epochs=1, seed=3, device="cpu").learn(768)
    assert model.ep_info_buffer[0]["l"] > 0
