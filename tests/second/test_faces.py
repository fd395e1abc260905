"""The interfaces of the second edition step like those of the first, over several episodes of every scenario."""

import gymnasium
import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.envs.gymnasium import EthBrakeEnv as FirstEnv
from ethbrake_marl.envs.vector import EthBrakeVectorEnv as FirstVectorEnv
from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.faces.sb3 import make_sb3_vec_env
from ethbrake_marl.faces.vector import EthBrakeVectorEnv
from ethbrake_marl.worlds.catalogue import load_scenario

NAMES = (
    "paper-random",
    "paper-random-obstacle",
    "paper-random-buildup",
    "cooperation-0-sensors",
    "cooperation-1-front",
    "cooperation-4-all",
    "engineering-wet-road",
    "mixture-delays",
)


def commands(rng, shape):
    """Half of the actions brake fully, the others are drawn."""
    return np.where(rng.random(shape) < 0.5, -1.0, rng.uniform(-1.0, 1.0, shape))


def same(name, found, expected):
    """Compare bits, or twelve digits where brakes build up."""
    if load_scenario(name).declares("brake_rate_mps3") or "buildup" in name or name.startswith("mixture"):
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    else:
        np.testing.assert_array_equal(found, expected)


def told_the_same(name, found, expected):
    """Compare infos, but for news of messages, which an extension tells. ``chosen_action`` is a number, no array."""
    assert found.keys() == expected.keys() - {"known_from_s", "age_s"}
    for key, value in found.items():
        if key == "chosen_action":
            np.testing.assert_allclose(value, expected[key][0], rtol=1e-6, atol=1e-7)
        else:
            same(name, value, expected[key])


@pytest.mark.parametrize("name", NAMES)
def test_parallel_env__observes_and_pays_like_the_first(name):
    old, new, rng = eb.parallel_env(name), EthBrakeParallelEnv(name), np.random.default_rng(3)
    assert old.possible_agents == new.possible_agents
    for episode in range(2):
        seed = 3 if episode == 0 else None
        (seen, _), (expected, _) = new.reset(seed=seed), old.reset(seed=seed)
        while True:
            for agent, values in expected.items():
                same(name, seen[agent], values)
            actions = {agent: commands(rng, 1) for agent in old.agents if old.action_space(agent).shape == (1,)}
            actions = {agent: action for agent, action in actions.items() if agent in new._learners}
            seen, paid, ended, cut, infos = new.step(actions)
            expected, old_paid, old_ended, old_cut, old_infos = old.step(actions)
            assert (ended, cut) == (old_ended, old_cut)
            for agent, reward in old_paid.items():
                same(name, paid[agent], reward)
                told_the_same(name, infos[agent], old_infos[agent])
            if not old.agents:
                assert new.agents == []
                break


@pytest.mark.parametrize("name", [name for name in NAMES if len(load_scenario(name).learners) == 1])
def test_gymnasium_env__observes_and_pays_like_the_first(name):
    old, new, rng = FirstEnv(name), EthBrakeEnv(name), np.random.default_rng(3)
    assert new.observation_space.shape == old.observation_space.shape
    (seen, info), (expected, old_info) = new.reset(seed=5), old.reset(seed=5)
    told_the_same(name, info, old_info)
    ended = False
    while not ended:
        same(name, seen, expected)
        action = commands(rng, 1)
        seen, paid, *ends, info = new.step(action)
        expected, old_paid, *old_ends, old_info = old.step(action)
        same(name, paid, old_paid)
        assert ends == old_ends
        told_the_same(name, info, old_info)
        ended = any(ends)
    assert new.describe_world().keys() == old.describe_world().keys()
    for key, value in old.describe_world().items():
        if "friction" in new.describe_world() and key.startswith("braking_capacity"):
            continue  # the first edition tells the capacity of a dry road
        assert new.describe_world()[key] == (pytest.approx(value, rel=1e-12) if isinstance(value, float) else value)


@pytest.mark.parametrize("mode", list(gymnasium.vector.AutoresetMode))
def test_vector_env__resets_like_the_first(mode):
    old = FirstVectorEnv(5, "paper-random", autoreset_mode=mode)
    new, rng = EthBrakeVectorEnv(5, "paper-random", autoreset_mode=mode), np.random.default_rng(1)
    (seen, _), (expected, _) = new.reset(seed=2), old.reset(seed=2)
    for _ in range(250):
        np.testing.assert_array_equal(seen, expected)
        action = commands(rng, (5, 1))
        seen, paid, ended, cut, infos = new.step(action)
        expected, old_paid, old_ended, old_cut, old_infos = old.step(action)
        np.testing.assert_array_equal(paid, old_paid)
        np.testing.assert_array_equal(ended, old_ended)
        np.testing.assert_array_equal(cut, old_cut)
        assert infos.keys() == old_infos.keys()
        if mode == gymnasium.vector.AutoresetMode.DISABLED and (ended | cut).any():
            options = {"reset_mask": ended | cut}
            (seen, _), (expected, _) = new.reset(options=options), old.reset(options=options)


@pytest.mark.parametrize("name", ["paper-random", "cooperation-3-pair", "paper-random-obstacle"])
def test_sb3_vec_env__steps_like_the_first(name):
    old, new, rng = (
        eb.make_sb3_vec_env(name, n_envs=4, seed=1),
        make_sb3_vec_env(name, n_envs=4, seed=1),
        np.random.default_rng(1),
    )
    seen, expected = new.reset(), old.reset()
    for _ in range(200):
        np.testing.assert_array_equal(seen, expected)
        action = commands(rng, (old.num_envs, 1))
        seen, paid, done, infos = new.step(action)
        expected, old_paid, old_done, old_infos = old.step(action)
        np.testing.assert_array_equal(paid, old_paid)
        np.testing.assert_array_equal(done, old_done)
        assert [info.keys() for info in infos] == [info.keys() for info in old_infos]
