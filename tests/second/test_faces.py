"""The interfaces of the second edition step like those of the first, in every scenario."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv, raw_env
from ethbrake_marl.faces.sb3 import make_sb3_vec_env
from ethbrake_marl.faces.vector import EthBrakeVectorEnv
from ethbrake_marl.first_edition.envs.gymnasium import EthBrakeEnv as FirstEnv
from ethbrake_marl.first_edition.envs.vector import EthBrakeVectorEnv as FirstVectorEnv
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.fixtures.scenarios import SHIPPED
from tests.second.same import ALONE, LEARNING, draws, same

MODES = list(gymnasium.vector.AutoresetMode)
PARALLEL: list[dict[str, Any]] = [
    {}, {"max_cycles": 7}, {"actions": 5}, {"reward_vector": "vehicles", "reward": "total-harm"},
    {"agents": "learners"},
]  # fmt: skip
VECTOR: list[dict[str, Any]] = [{}, {"max_episode_steps": 5, "reward": {"harm": 1.0, "objective": "own", "jerk": 1e-3}}]
SB3: list[dict[str, Any]] = [
    {"step_infos": True}, {"appended": "state", "horizon_is_end": False}, {"appended": "number", "actions": 4},
]  # fmt: skip


def in_turn(names: list[str], *choices: list[Any]) -> list[Any]:
    """Return cases: every name with one of the choices."""
    return [pytest.param(name, *(each[k % len(each)] for each in choices), id=name) for k, name in enumerate(names)]


def described(new: dict[str, Any], old: dict[str, Any]) -> None:
    """Compare descriptions, but for capacities on a road with friction; vehicle types may be missing."""
    for key, value in old.items():
        if key in new and not ("friction" in old and "_capacity_" in key):
            np.testing.assert_array_equal(new[key], value, err_msg=key)
    assert new.keys() >= {key for key in old if not key.endswith("_type")}


@pytest.mark.parametrize(("name", "settings"), in_turn(SHIPPED, PARALLEL))
def test_parallel_env__is_like_the_first(name: str, settings: dict[str, Any]) -> None:
    if not load_scenario(name).learners:
        settings = {}
    old, new, rng = eb.parallel_env(name, **settings), EthBrakeParallelEnv(name, **settings), np.random.default_rng(3)
    assert old.possible_agents == new.possible_agents
    same(name, new.reset(seed=3), old.reset(seed=3))
    described(new.describe_world(), old.describe_world())
    while old.agents:
        same(name, new.state(), old.state())
        count = settings.get("actions")
        actions = {agent: draws(rng, () if count else 1, count) for agent in new._learners}
        same(name, new.step(actions), old.step(actions))
        assert new.agents == old.agents
    same(name, new.reset(), old.reset())


@pytest.mark.parametrize("name", ["paper-random", "cooperation-4-five"])
def test_agents_in_turn__are_like_the_first(name: str) -> None:
    old, new = eb.raw_env(name, agents="learners"), raw_env(name, agents="learners")
    rng = np.random.default_rng(3)
    old.reset(seed=3)
    new.reset(seed=3)
    for agent in old.agent_iter():
        assert new.agent_selection == agent
        found, expected = new.last(), old.last()
        same(name, found, expected)
        action = None if any(expected[2:4]) else draws(rng, 1)
        old.step(action)
        new.step(action)
    assert new.agents == []


@pytest.mark.parametrize(("name", "mode", "settings"), in_turn(ALONE, MODES, VECTOR))
def test_vector_env__is_like_the_first(name: str, mode: Any, settings: dict[str, Any]) -> None:
    old = FirstVectorEnv(3, name, autoreset_mode=mode, **settings)
    new, rng = EthBrakeVectorEnv(3, name, autoreset_mode=mode, **settings), np.random.default_rng(1)
    same(name, new.reset(seed=2), old.reset(seed=2))
    for _ in range(12 if settings else 60):
        action = draws(rng, (3, 1))
        (*_, ended, cut, _), expected = found, _ = new.step(action), old.step(action)
        same(name, found, expected)
        if mode == gymnasium.vector.AutoresetMode.DISABLED and (ended | cut).any():
            options = {"reset_mask": ended | cut}
            same(name, new.reset(options=options), old.reset(options=options))
    described(new.describe_worlds(), old.describe_worlds())


@pytest.mark.parametrize(("name", "settings"), in_turn(LEARNING, SB3))
def test_sb3_vec_env__is_like_the_first(name: str, settings: dict[str, Any]) -> None:
    try:
        old = eb.make_sb3_vec_env(name, n_envs=2, seed=1, **settings)
    except InvalidInput as error:
        with pytest.raises(InvalidInput) as refusal:
            make_sb3_vec_env(name, n_envs=2, seed=1, **settings)
        assert str(refusal.value) == str(error)
        return
    new, rng = make_sb3_vec_env(name, n_envs=2, seed=1, **settings), np.random.default_rng(1)
    same(name, new.reset(), old.reset())
    count = settings.get("actions")
    for _ in range(50):
        action = draws(rng, old.num_envs if count else (old.num_envs, 1), count)
        same(name, new.step(action), old.step(action))


OPTIONS: list[Any] = [
    {"listed_world": {"seed": 7, "number": 3}}, {"listed_world": {"seed": -1, "number": 3}}, {"listed_world": 5},
    {"initial_state": {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}},
    {"initial_state": {"gaps_m": [5, 6], "speeds_mps": 20, "mass_t": [1, 2, 3], "latency_s": [0, 0.2, 0.4]}},
    {"initial_state": {"gaps_m": [0, 0], "speeds_mps": [0, 0, 0]}},
    {"initial_state": {"gaps_m": [-1, 7], "speeds_mps": 20}}, {"initial_state": {"gap_m": [7, 7]}},
    {"initial_state": {"speeds_mps": 20}}, 5, {},
    {"initial_state": {"gaps_m": 7}, "listed_world": {"seed": 1, "number": 1}},
]  # fmt: skip


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("name", ["paper-random", "paper-random-obstacle", "realistic-truck-buildup"])
def test_gymnasium_env__resets_as_asked_like_the_first(name: str, options: Any) -> None:
    old, new = FirstEnv(name), EthBrakeEnv(name)
    same(name, new.reset(seed=5), old.reset(seed=5))
    try:
        expected = old.reset(options=options)
    except InvalidInput as error:
        with pytest.raises(InvalidInput) as refusal:
            new.reset(options=options)
        assert str(refusal.value) == str(error)
    else:
        same(name, new.reset(options=options), expected)
    for _ in range(3):
        found, expected = new.step([-0.5]), old.step([-0.5])
        same(name, found, expected)
        if any(expected[2:4]):
            break
    described(new.describe_world(), old.describe_world())
    same(name, new.reset(), old.reset())
