"""The libraries find and accept the environments: their ids, their own checks, their wrappers."""

import copy
import pickle
import warnings
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box, Dict, Discrete, Tuple
from gymnasium.spaces.utils import flatdim, flatten, flatten_space, unflatten
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import (
    batch_differing_spaces,
    batch_space,
    concatenate,
    create_empty_array,
    create_shared_memory,
    iterate,
    read_from_shared_memory,
    write_to_shared_memory,
)
from gymnasium.wrappers import TimeAwareObservation
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
from stable_baselines3.common.env_checker import check_env as check_for_sb3

from ethbrake_marl.episode.observe import View
from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv, raw_env
from ethbrake_marl.faces.registration import register_environments
from ethbrake_marl.faces.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.faces.vector import EthBrakeVectorEnv
from ethbrake_marl.worlds.catalogue import load_scenario

supersuit: Any = import_module("supersuit") if find_spec("supersuit") else None
needs_supersuit = pytest.mark.skipif(supersuit is None, reason="SuperSuit needs Python below 3.13")
SETTINGS: list[dict[str, Any]] = [
    {"scenario": "paper-random-obstacle", "agents": "learners"}, {"actions": 5, "reward": "paper-reward"},
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
    single = gymnasium.make("EthBrake-v3", scenario="paper-random-obstacle", max_episode_steps=3)
    many = gymnasium.make_vec("EthBrake-v3", 2, max_episode_steps=3, autoreset_mode="SameStep")
    vectors = gymnasium.make("EthBrakeMO-v1")
    assert type(single.unwrapped) is type(vectors.unwrapped) is EthBrakeEnv and type(many) is EthBrakeVectorEnv
    for env, action in ((single, np.zeros(1, np.float32)), (many, np.zeros((2, 1)))):
        env.reset(seed=1)
        assert [np.all(env.step(action)[3]) for _ in range(3)] == [False, False, True]
    vectors.reset(seed=1)
    assert vectors.step([0.0])[1].shape == vectors.unwrapped.reward_space.shape == (3,)
    for interface in ("parallel", "aec") if hasattr(pettingzoo, "make") else ():
        assert type(pettingzoo.make(interface, "ethbrake/ethbrake-v3").unwrapped) is EthBrakeParallelEnv


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_pettingzoo_without_a_registry__runs(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("parallel_registry", "aec_registry", "register", "make"):
        monkeypatch.delattr(pettingzoo, name, raising=False)  # as in version 1.26
    register_environments()
    parallel_api_test(EthBrakeParallelEnv(), num_cycles=5)


CONTENT = load_scenario("paper-random").declared()
ARGUMENTS: dict[str, dict[str, Any]] = {
    "scenario": {"scenario": load_scenario("paper-random-obstacle")},
    "mixture": {"scenario": load_scenario("mixture-three-tests")},
    "content": {"scenario": {**CONTENT, "mass_t": np.array([1.0, 2.0, 3.0]), "gaps_m": {"choice": (7, np.float32(8))}}},
    "reward": {"reward": {"harm": np.float32(0.3), "jerk": np.float64(1e-5), "objective": ("own", "own", "own")}},
    "names": {"reward": np.str_("paper-reward"), "learners": np.array(["vehicle_3"])},
    "view": {"observation": {"vehicle_2": View(["own", "rear_1.gap"])}, "learners": ("vehicle_2",)},
    "set": {"learners": {"vehicle_2"}, "render_mode": np.str_("ansi")},
    "numbers": {"actions": np.int64(9), "reward_vector": ("harm_1", "harm_2")},
}


def played(env: Any, n: int | None = None) -> list[Any]:
    """Everything that an episode returns, with braking of about one half."""
    seen = [env.reset(seed=5)[0].tolist()]
    while len(seen) < 100:
        action = np.float32([-0.5]) if isinstance(env.unwrapped.action_space, Box) else 3
        parts = env.step(action if n is None else np.array([action] * n))[:4]
        seen.append([np.asarray(part).tolist() for part in parts])
        if n is None and (parts[2] or parts[3]):
            break
    return seen


@pytest.mark.filterwarnings("ignore:.*The reward returned by.*:UserWarning")  # vectors, as MO-Gymnasium has them
@pytest.mark.parametrize("given", ARGUMENTS.values(), ids=ARGUMENTS)
def test_spec__every_argument_goes_through_json_and_makes_the_same_episode(given: Any) -> None:
    single = gymnasium.make("EthBrake-v3", **given)
    many = gymnasium.make_vec("EthBrake-v3", 2, autoreset_mode=AutoresetMode.SAME_STEP, **given)
    same = gymnasium.make(EnvSpec.from_json(single.spec.to_json()))
    alike = gymnasium.make_vec(EnvSpec.from_json(many.spec.to_json()))
    first, rows = played(single), played(many, 2)
    assert played(same) == first and played(alike, 2) == rows
    assert same.spec.to_json() == single.spec.to_json()
    assert same.spec.max_episode_steps == alike.spec.max_episode_steps == many.spec.max_episode_steps >= len(first) - 1


LATER = {
    "name": "later", "based_on": "realistic-motorway", "horizon_s": 9.0,
    "speeds_mps": {"uniform": [3, 8]}, "gaps_m": {"uniform": [4, 12]}, "alert_s": {"uniform": [1, 5]},
}  # fmt: skip


@pytest.mark.parametrize(
    ("scenario", "learner", "steps", "least"),
    [("paper-random", "vehicle_2", 75, 75), ("mixture-delays", "vehicle_2", 79, 77), (LATER, "vehicle_2", 75, 60),
     ],
)  # fmt: skip
def test_spec__states_the_longest_episode_in_steps(scenario: Any, learner: str, steps: int, least: int) -> None:
    env = gymnasium.make("EthBrake-v3", scenario=scenario, learners=[learner])
    assert env.spec.max_episode_steps == env.unwrapped.spec.max_episode_steps == steps
    taken, driving = [], np.ones(1, np.float32)
    for seed in range(8):
        env.reset(seed=seed)
        taken.append(next(k for k in range(1, 400) if np.any(env.step(driving)[2:4])))
    assert least <= max(taken) <= steps
    timed = TimeAwareObservation(env)
    assert timed.reset(seed=1)[0] in timed.observation_space
    for limit in (3, steps):
        limited = gymnasium.make("EthBrake-v3", max_episode_steps=limit)
        vector = gymnasium.make_vec("EthBrake-v3", num_envs=2, max_episode_steps=limit)
        assert limited.spec.max_episode_steps == limit and vector.spec.max_episode_steps == min(limit, 75)
    assert EthBrakeEnv().spec is None and "TimeLimit" not in str(env)


def spaces() -> list[Any]:
    indices, vectors = EthBrakeEnv(actions=5), EthBrakeEnv(reward_vector="vehicles")
    agents, many = EthBrakeParallelEnv(reward_vector="vehicles"), EthBrakeVectorEnv(3, actions=3)
    rows = make_sb3_vec_env("paper-random", 2, appended="number")
    return [
        indices.observation_space, indices.action_space, vectors.action_space, vectors.reward_space,
        agents.state_space, agents.observation_space("vehicle_2"), agents.reward_space("vehicle_2"),
        many.observation_space, many.action_space, many.single_action_space, rows.observation_space,
    ]  # fmt: skip


def test_spaces__are_taken_by_every_function_of_gymnasium_on_spaces() -> None:
    for alone in spaces():
        for space in (alone, Dict({"a": alone, "b": Discrete(3)}), Tuple((alone, alone))):
            samples = [space.sample() for _ in range(3)]
            together = concatenate(space, samples, create_empty_array(space, 3))
            shared = create_shared_memory(space, 3)
            for row, sample in enumerate(samples):
                write_to_shared_memory(space, row, sample, shared)
            for batch in (batch_space(space, 3), batch_differing_spaces([space] * 3)):
                for read in (together, read_from_shared_memory(space, shared, 3)):
                    rows = [*iterate(batch, read)]
                    assert len(rows) == 3 and all(map(data_equivalence, rows, samples)), space
            flat = flatten(space, samples[0])
            assert flat in flatten_space(space) and flat.shape == (flatdim(space),)
            assert data_equivalence(unflatten(space, flat), samples[0])
            assert copy.deepcopy(space) == pickle.loads(pickle.dumps(space)) == space
        same = pickle.loads(pickle.dumps(alone))
        for name in ("features", "evenly_spaced", "scale"):
            assert getattr(same, name, None) == getattr(alone, name, None)


@pytest.mark.parametrize("vector", [SyncVectorEnv, pytest.param(AsyncVectorEnv, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mode", ["same", "different"])
@pytest.mark.parametrize("settings", [{}, {"actions": 5}], ids=str)
def test_vectors_of_gymnasium__take_single_environments(vector: Any, mode: str, settings: dict[str, Any]) -> None:
    env = vector([partial(EthBrakeEnv, **settings)] * 2, observation_mode=mode)
    observations = env.reset(seed=[3, 4])[0]
    assert observations.tolist() == EthBrakeVectorEnv(2).reset(seed=[3, 4])[0].tolist()
    env.step(env.action_space.sample())
    env.close()


SUPERSUIT: list[Callable[[Any], Any]] = [
    lambda env: supersuit.frame_skip_v0(env, 2), lambda env: supersuit.frame_stack_v1(env, 3),
    lambda env: supersuit.frame_stack_v2(env, 3), lambda env: supersuit.sticky_actions_v0(env, 0.3),
    lambda env: supersuit.delay_observations_v0(env, 2), lambda env: supersuit.max_observation_v0(env, 2),
    lambda env: supersuit.clip_reward_v0(env), lambda env: supersuit.dtype_v0(env, np.float64),
    lambda env: supersuit.flatten_v0(env), lambda env: supersuit.agent_indicator_v0(env),
    lambda env: supersuit.pad_observations_v0(env), lambda env: supersuit.pad_action_space_v0(env),
    lambda env: supersuit.nan_zeros_v0(env), lambda env: supersuit.clip_actions_v0(env),
    lambda env: supersuit.scale_actions_v0(env, 0.5), lambda env: supersuit.normalize_obs_v0(env),
    lambda env: supersuit.nan_random_v0(env),
]  # fmt: skip  # without black_death_v3, for which an episode ends only if it is terminated and truncated


@needs_supersuit
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_supersuit__wraps_both_forms() -> None:
    chosen = {"scenario": "cooperation-3-pair", "agents": "learners"}
    for wrap in SUPERSUIT:
        env = wrap(EthBrakeParallelEnv(**chosen))
        env.reset(seed=1)
        while env.agents:
            env.step({agent: env.action_space(agent).sample() for agent in env.agents})
        turns = wrap(raw_env(**chosen))
        turns.reset(seed=1)
        for agent in turns.agent_iter():
            over = np.any(turns.last()[2:4])
            turns.step(None if over else turns.action_space(agent).sample())


@needs_supersuit
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_supersuit__a_seed_repeats_the_numbers_of_skipped_frames() -> None:
    def times(seed: int) -> list[float]:
        env = supersuit.frame_skip_v0(EthBrakeParallelEnv(agents="learners"), (2, 5))
        env.reset(seed=seed)
        taken = []
        while env.agents:
            taken.append(env.step({"vehicle_2": np.zeros(1, np.float32)})[4]["vehicle_2"]["time_s"])
        return taken

    assert times(3) == times(3)
    env = EthBrakeParallelEnv()
    drawn = [env.np_random.random()]  # before a reset
    for seed in (3, None, 4, 3):
        env.reset(seed=seed)
        drawn.append(env.np_random.random())
    assert drawn[1] == drawn[4] and len({*drawn}) == 4


@pytest.mark.parametrize("kind", [EthBrakeEnv, EthBrakeParallelEnv, EthBrakeVectorEnv, EthBrakeVecEnv])
def test_close__before_the_constructor_and_twice_does_nothing(kind: Any) -> None:
    unopened = kind.__new__(kind)
    unopened.close()
    unopened.close()
