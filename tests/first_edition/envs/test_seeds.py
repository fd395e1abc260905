"""Copies of an environment play different worlds, and whoever names a seed or sets a generator decides which."""

import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput

MAKERS: dict[str, Callable[[], Any]] = {
    "parallel": eb.parallel_env,
    "in turn": eb.env,
    "in turn, raw": eb.raw_env,
    "single": eb.EthBrakeEnv,
    "made": lambda: gymnasium.make("EthBrake-v1"),
    "vector": lambda: eb.EthBrakeVectorEnv(3),
    "made vector": lambda: gymnasium.make_vec("EthBrake-v1", num_envs=3),
    "sb3": lambda: eb.make_sb3_vec_env("paper-random", 3),
    "shielded parallel": lambda: eb.shield(eb.parallel_env()),
    "shielded in turn": lambda: eb.shield(eb.env()),
    "shielded single": lambda: eb.shield(eb.EthBrakeEnv()),
    "shielded vector": lambda: eb.shield(eb.EthBrakeVectorEnv(3)),
    "shielded sb3": lambda: eb.shield(eb.make_sb3_vec_env("paper-random", 3)),
}
each_maker = pytest.mark.parametrize("name", MAKERS)
LOOKS: dict[str, Callable[[Any], Any]] = {
    "nobody looks": lambda env: None,
    "np_random": lambda env: env.np_random,
    "np_random_seed": lambda env: env.np_random_seed,
}
each_look = pytest.mark.parametrize("look", LOOKS.values(), ids=LOOKS)


def begin(env: Any, seed: int | None = None) -> tuple[int, bytes]:
    """Seed of the stream, and the worlds in which the episodes begin."""
    if seed is None:
        env.reset()
    elif hasattr(env, "step_async"):
        env.seed(seed)
        env.reset()
    else:
        env.reset(seed=seed)
    engine = env.unwrapped.engine
    return engine.seed, b"".join(part.tobytes() for part in engine.packed)


def first_seeds() -> list[int]:
    """The first seed of every interface after every look, for another process to compare."""
    seeds = []
    for make in MAKERS.values():
        for look in LOOKS.values():
            env = make()
            look(env)
            seeds.append(begin(env)[0])
    return seeds


def test_copies__have_different_seeds_in_every_interface_and_process() -> None:
    program = (
        "import json\nfrom tests.first_edition.envs.test_seeds import first_seeds\nprint(json.dumps(first_seeds()))"
    )
    command = [sys.executable, "-c", program]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    seeds = [*first_seeds(), *first_seeds(), *json.loads(ran.stdout)]
    assert len(set(seeds)) == len(seeds) == 3 * len(MAKERS) * len(LOOKS)
    assert all(0 <= seed < 2**63 for seed in seeds)


@each_maker
@each_look
def test_np_random_seed__plays_the_first_episode_again(name: str, look: Callable[[Any], Any]) -> None:
    env = MAKERS[name]()
    look(env)
    first, second = begin(env), begin(env)
    assert first[0] == env.np_random_seed and first[1] != second[1]
    assert begin(env, env.np_random_seed) == first and begin(env) == second
    assert begin(MAKERS[name](), env.np_random_seed) == first


@each_maker
def test_np_random__set_by_the_user_decides_every_reset_until_a_seed_is_named(name: str) -> None:
    def episodes(env: Any, generator: np.random.Generator) -> list[tuple[int, bytes]]:
        env.np_random = generator
        assert env.np_random is generator and env.np_random_seed == -1  # as Gymnasium's
        return [begin(env) for _ in range(3)]

    fresh, used = MAKERS[name](), MAKERS[name]()
    begin(used, 5)
    begin(used)
    played = episodes(fresh, np.random.default_rng(3))
    assert len(set(played)) == 3 and played == episodes(used, np.random.default_rng(3))
    assert not set(played) & set(episodes(used, np.random.default_rng(4)))
    state = used.np_random.bit_generator.state
    again = begin(used)
    used.np_random.bit_generator.state = state
    assert begin(used) == again
    assert begin(used, 5) == begin(MAKERS[name](), 5) and used.np_random_seed == 5
    assert begin(used)[0] == 5  # the stream goes on
    with pytest.raises(InvalidInput, match=r"np_random = 3: must be a numpy\.random\.Generator"):
        used.np_random = 3


@each_maker
def test_np_random__shared_by_copies_gives_each_its_own_worlds(name: str) -> None:
    shared, copies = np.random.default_rng(3), [MAKERS[name]() for _ in range(3)]
    for copy in copies:
        copy.np_random = shared
    assert len({begin(copy) for copy in copies}) == 3


@each_maker
def test_np_random__drawn_from_by_a_wrapper_changes_no_world(name: str) -> None:
    env, untouched = MAKERS[name](), MAKERS[name]()
    for each in (env, untouched):
        begin(each, 5)
    env.np_random.random(7)
    assert begin(env) == begin(untouched)


def test_seed__of_stable_baselines3_and_a_generator_count_in_the_order_in_which_they_are_set() -> None:
    env = eb.make_sb3_vec_env("paper-random", 3, seed=8)
    assert env.np_random_seed == 8
    env.np_random = np.random.default_rng(3)
    drawn = begin(env)
    assert drawn[0] != 8
    env.set_attr("np_random", np.random.default_rng(3))
    assert begin(env) == drawn
    assert begin(env, 8)[0] == env.get_attr("np_random_seed")[0] == 8
    other = eb.make_sb3_vec_env("paper-random", 3, seed=9)
    other.restore(env.snapshot())
    assert other.np_random_seed == 8 and begin(other) == begin(env)


def supersuit_copies() -> Any:
    supersuit = pytest.importorskip("supersuit")
    rows = supersuit.pettingzoo_env_to_vec_env_v1(eb.parallel_env(agents="learners"))
    return supersuit.concat_vec_envs_v1(rows, 3, base_class="gymnasium")


@pytest.mark.parametrize(
    "make",
    [
        lambda: gymnasium.make_vec("EthBrake-v1", 3, vectorization_mode="sync"),
        lambda: gymnasium.make_vec("EthBrake-v1", 3, vectorization_mode="async"),
        lambda: make_vec_env("EthBrake-v1", 3),
        supersuit_copies,
    ],
    ids=["sync", "async", "sb3", "supersuit"],
)
def test_copies__of_other_libraries_play_different_worlds(make: Callable[[], Any]) -> None:
    env = make()
    if hasattr(env, "get_attr"):
        assert len(set(env.get_attr("np_random_seed"))) == 3
    started = env.reset()
    seen = started[0] if isinstance(started, tuple) else started
    assert len({row.tobytes() for row in seen}) == 3
    env.close()
