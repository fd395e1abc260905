from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import pettingzoo
import pytest

import ethbrake_marl
from ethbrake_marl import ethbrake_v0
from ethbrake_marl.envs.interfaces import EthBrakeEnv, EthBrakeParallelEnv
from ethbrake_marl.envs.registration import GYMNASIUM_ID, PETTINGZOO_ID, register_environments

ROOT = Path(__file__).resolve().parents[2]


def run(program: str) -> str:
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_registration__twice_changes_nothing_and_says_nothing() -> None:
    before = (gymnasium.registry[GYMNASIUM_ID], pettingzoo.parallel_registry[PETTINGZOO_ID])
    register_environments()
    assert (gymnasium.registry[GYMNASIUM_ID], pettingzoo.parallel_registry[PETTINGZOO_ID]) == before


def test_registration__gymnasium_and_pettingzoo_make_it_by_id() -> None:
    assert isinstance(gymnasium.make("EthBrake-v0").unwrapped, EthBrakeEnv)
    assert isinstance(pettingzoo.make("parallel", "ethbrake/ethbrake-v0", learners=[2]), EthBrakeParallelEnv)
    in_turn = pettingzoo.make("aec", "ethbrake/ethbrake-v0")
    assert isinstance(in_turn, pettingzoo.AECEnv) and isinstance(in_turn.unwrapped, EthBrakeParallelEnv)


def test_import__stays_light_until_a_name_is_used_and_lets_gymnasium_make_it_by_id() -> None:
    program = (
        "import sys, ethbrake_marl as eb\n"
        "heavy = lambda: sorted({'torch', 'numba', 'stable_baselines3', 'matplotlib', 'pydantic'} & set(sys.modules))\n"
        "print(heavy()); p = eb.parallel_env(); p.reset(seed=0); print(heavy())\n"
        "import gymnasium; e = gymnasium.make('ethbrake_marl:EthBrake-v0'); print(e.unwrapped)\n"
        "e.reset(seed=0); e.step(e.action_space.sample())\n"
        "a = eb.EthBrakeEnv(render_mode='ansi'); a.reset(seed=0); a.render()\n"
        "print(e.unwrapped.engine._watched, p.engine._watched, *{'PIL', 'pygame', 'matplotlib'} & set(sys.modules))"
    )
    first, second, third, watched_and_drawn = run(program).splitlines()
    assert first == "[]"
    assert second == "['numba', 'pydantic']"
    assert third.startswith("<EthBrakeEnv")
    assert watched_and_drawn == "{} {}"


@pytest.mark.parametrize("name", ethbrake_marl.__all__)
def test_public_name__is_found_and_listed(name: str) -> None:
    assert getattr(ethbrake_marl, name) is not None
    assert name in dir(ethbrake_marl)


def test_public_name__a_wrong_one_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'ethbrake_marl' has no attribute 'paralel_env'"):
        ethbrake_marl.paralel_env  # noqa: B018


def test_ethbrake_v0__has_pettingzoos_three_names() -> None:
    assert ethbrake_v0.parallel_env is ethbrake_marl.parallel_env
    assert {"env", "parallel_env", "raw_env"} <= set(dir(ethbrake_v0))
