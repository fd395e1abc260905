"""A sample of the gate "interference": nothing that fails, and nothing in between, gets above the bound."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from tests.shield.plays import INSIDE, PLAYS, WRAPPERS, disturbed, played, wrapped

BATCHED = ("vector", "vector, next step", "sb3", "team, sb3")


@pytest.mark.parametrize("name", PLAYS)
def test_disturbed__calls_that_fail_or_are_interrupted_change_nothing_and_no_episode_gets_above_its_bound(name):
    found = disturbed(name, 8 if name in BATCHED or "evaluation" in name else 5, seed=3)
    assert found.refused > 5 and found.interrupted > 3
    assert (found.above, found.broken) == (0, 0)


@pytest.mark.parametrize("name", PLAYS)
def test_played__through_every_interface_no_episode_gets_above_its_bound(name):
    found = played(name, 24, seed=5)
    assert found.episodes >= 24 and (found.above, found.broken) == (0, 0)


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize("name", INSIDE)
def test_wrapped__whatever_reaches_the_engine_is_shielded_and_no_episode_gets_above_its_bound(name, wrapper):
    found = wrapped(name, wrapper, 120, seed=5)
    assert found.episodes > 0 and (found.above, found.broken) == (0, 0)


def test_shield__under_which_the_environment_is_exchanged_tells_nothing() -> None:
    class Fresh(gymnasium.Wrapper):
        def reset(self, **options):
            if self.env.unwrapped.engine.ruling is not None:
                self.env = eb.EthBrakeEnv("paper-random")
            return self.env.reset(**options)

    shielded = eb.shield(Fresh(eb.EthBrakeEnv("paper-random")))
    shielded.reset(seed=7)
    shielded.step([1.0])
    with pytest.raises(InvalidInput, match="another environment is inside than the one that is shielded"):
        shielded.reset(seed=8)


def test_log__is_kept_over_resets() -> None:
    env = eb.shield(eb.EthBrakeEnv("paper-random"), logging=True)
    told = 0
    for seed in range(3):
        env.reset(seed=seed)
        done = False
        while not done:
            _, _, terminated, truncated, info = env.step([1.0])
            told, done = told + info["shield"]["intervened"], terminated or truncated
    assert len(env.attached.shield.log) == told > 30
    assert {entry.episode for entry in env.attached.shield.log} == {0, 1, 2}


def test_shield__that_is_refused_or_closed_lets_go_of_the_environment() -> None:
    env = eb.parallel_env("paper-random")
    with pytest.raises(InvalidInput, match="must be a list of names"):
        eb.HybridShield(env, mode="step", agents="vehicle_2")
    assert env.unwrapped.engine.guard is None
    batch = eb.shield(eb.make_sb3_vec_env("paper-random", 2, seed=1))
    batch.reset()
    batch.step_async(np.ones((2, 1)))
    batch.close()
    with pytest.raises(InvalidInput, match="this shield was closed"):
        batch.step_wait()
    with pytest.raises(InvalidInput, match="is a shield that was closed"):
        eb.shield(batch)


def test_shield__is_put_inside_a_wrapper_of_somebody_else_that_acts_in_turns() -> None:
    class Half(OrderEnforcingWrapper):
        def step(self, action):
            super().step(action / 2)

    with pytest.raises(InvalidInput, match="acts in turns: put the shield inside it"):
        eb.shield(Half(eb.env(scenario="paper-random")))
