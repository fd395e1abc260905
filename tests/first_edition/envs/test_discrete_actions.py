"""``actions=9``: in every interface a learner acts by an index of nine shares; a DQN learns so, and drives."""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.game.discrete_actions import index_to_action
from tests.first_edition.contract.interfaces import BARE, CRASH, INTERFACES, PAPER, rows_of

PAIR = eb.load_scenario("cooperation-3-pair")


# What an index means.


@pytest.mark.parametrize(
    ("count", "values"),
    [
        (2, [-1.0, 1.0]),
        (3, [-1.0, 0.0, 1.0]),
        (5, [-1.0, -0.5, 0.0, 0.5, 1.0]),
        (9, [-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0]),
        (4, [-1.0, -1 / 3, 1 / 3, 1.0]),
    ],
)
def test_index__means_evenly_spaced_actions(count: int, values: list[float]) -> None:
    assert index_to_action(range(count), count).tolist() == values


@pytest.mark.parametrize("count", [7, 11, 49, 99, 1001])
def test_index__in_the_middle_coasts_exactly_and_sides_mirror(count: int) -> None:
    actions = index_to_action(np.arange(count), count)
    assert actions[count // 2] == 0.0 and (actions == -actions[::-1]).all() and (np.diff(actions) > 0).all()


def test_command__is_the_share_of_the_capacity() -> None:
    env = eb.EthBrakeEnv(CRASH, actions=9)  # Vehicle 2 brakes with 8 m/s2 at most, drives with 4 m/s2
    env.reset(seed=0)
    told = [env.step(index)[4] for index in (2, 4, np.int64(7))]
    assert [info["chosen_command_mps2"] for info in told] == [-4.0, 0.0, 3.0]
    assert [info["chosen_action"].tolist() for info in told] == [[-0.5], [0.0], [0.75]]


# Every interface.


@pytest.mark.parametrize("count", [2, 9, 10])
@pytest.mark.parametrize("name", INTERFACES)
def test_interface__with_indices_does_what_it_does_with_their_shares(name: str, count: int) -> None:
    by_index, by_share = INTERFACES[name](PAPER, rows_of(name), actions=count), INTERFACES[name](PAPER, rows_of(name))
    assert np.array_equal(by_index.reset(5), by_share.reset(5))
    ended = 0
    for indices in np.random.default_rng(3).integers(count, size=(100, by_index.n, 1)):
        turn, same = by_index.step(indices), by_share.step((2.0 * indices - (count - 1)) / (count - 1))
        assert turn.bits() == same.bits()
        ended += turn.ended.sum()
    assert ended


def test_spaces__are_discrete_for_learners_and_as_ever_for_scripts() -> None:
    for env in (eb.parallel_env(PAPER, actions=9), eb.env(PAPER, actions=9), eb.shield(eb.parallel_env(actions=9))):
        assert env.action_space("vehicle_2") == Discrete(9)
        assert env.action_space("vehicle_1") == env.action_space("vehicle_3") == Box(-1.0, 1.0, (1,))
    team = eb.parallel_env(PAIR, agents="learners", actions=np.int64(3))
    assert [team.action_space(agent) for agent in team.possible_agents] == [Discrete(3)] * 2
    assert eb.EthBrakeEnv(actions=9).action_space == eb.make_sb3_vec_env(PAIR, 2, actions=9).action_space == Discrete(9)
    many = gymnasium.make_vec("EthBrake-v1", num_envs=4, actions=9)
    assert many.single_action_space == Discrete(9) and many.action_space.shape == (4,)


# What is refused.

BAD: list[tuple[Any, str]] = [
    (9, "9: with actions=9, an action must be an index, a whole number from 0 to 8"),
    (0.5, r"0\.5: with actions=9"),
    (np.nan, "nan: with"),
    (True, "is a boolean; with"),
    ("full", "is not a number; with"),
    (None, "is not a number; with"),
]


@pytest.mark.parametrize(("bad", "message"), BAD, ids=[repr(bad) for bad, _ in BAD])
@pytest.mark.parametrize("name", BARE)
def test_index__that_is_none_is_refused(name: str, bad: Any, message: str) -> None:
    interface = BARE[name](PAPER, rows_of(name), actions=9)
    interface.reset(5)
    given: Any = [bad] if interface.n == 1 else [[0]] * (interface.n - 1) + [[bad]]
    with pytest.raises(InvalidInput, match=rf"action of (vehicle_2|the learners)(?: =|:) (?s:.*){message}"):
        interface.step([given] if interface.n == 1 else given)


MAKERS: dict[str, Callable[..., Any]] = {
    "parallel": eb.parallel_env,
    "in turn": eb.env,
    "single": eb.EthBrakeEnv,
    "vector": eb.EthBrakeVectorEnv,
    "sb3": partial(eb.make_sb3_vec_env, "paper-random", 2),
    "policy": partial(eb.policy_agent, lambda seen: seen),
}


@pytest.mark.parametrize("count", [1, 9.0, True])
@pytest.mark.parametrize("name", MAKERS)
def test_number_of_actions__is_at_least_2(name: str, count: Any) -> None:
    with pytest.raises(InvalidInput, match=r"^actions = .*: must be a whole number, at least 2"):
        MAKERS[name](actions=count)


# A policy that was learned so.


def small(env: Any, **settings: Any) -> DQN:
    return DQN("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, buffer_size=1_000, device="cpu", **settings)


def harm_of(agent: Any, episodes: int = 200) -> np.ndarray:
    return eb.evaluate(PAPER.sample(episodes, 7), {"theirs": agent}, scenario=PAPER).outcome("theirs").first_impact_harm


def test_dqn__drives_in_evaluate_as_in_its_environment() -> None:
    worlds, n = make_vec_env("EthBrake-v1", env_kwargs={"actions": 9}), 10
    model = small(worlds)
    worlds.seed(7)
    seen, returned = worlds.reset(), [0.0]
    while len(returned) <= n:
        seen, reward, done, _ = worlds.step(model.predict(seen, deterministic=True)[0])
        returned[-1] -= reward.item()
        returned += [0.0] * int(done.item())
    sample = PAPER.sample(n, 7, channel="training")
    driven = eb.evaluate(sample, {"dqn": eb.policy_agent(model)}, scenario=PAPER).outcome("dqn").first_impact_harm
    np.testing.assert_allclose(driven, returned[:n], atol=1e-5)


def test_dqn__of_a_file_says_what_its_indices_mean(tmp_path: Any) -> None:
    model = small(eb.make_sb3_vec_env(PAPER, 2, actions=9))
    model.save(tmp_path / "dqn.zip")
    loaded = DQN.load(tmp_path / "dqn.zip")
    with pytest.raises(
        InvalidInput,
        match=r"actions of the policy are in Discrete\(9\); must be a number in \[-1, 1\]; pass actions=9 if",
    ):
        eb.policy_agent(loaded)
    with pytest.raises(InvalidInput, match=r"in Discrete\(9\); must be an index from 0 to 4 \(actions=5\)"):
        eb.policy_agent(loaded, actions=5)
    assert (harm_of(eb.policy_agent(loaded, actions=9), 10) == harm_of(eb.policy_agent(model), 10)).all()


def test_copies__with_other_numbers_of_actions_are_refused() -> None:
    model = small(make_vec_env("EthBrake-v1", n_envs=2, env_kwargs={"actions": 9}))
    model.get_env().envs[1] = gymnasium.make("EthBrake-v1", actions=17)
    with pytest.raises(InvalidInput, match="have different numbers of discrete actions"):
        eb.policy_agent(model)


@pytest.mark.parametrize("shape", [(-1,), (-1, 1)])
def test_function__of_indices_drives(shape: tuple[int, ...]) -> None:
    agent = eb.policy_agent(lambda seen: np.full(len(seen), 2).reshape(shape), actions=9)
    half = eb.policy_agent(lambda seen: np.full((len(seen), 1), -0.5))
    assert (harm_of(agent, 20) == harm_of(half, 20)).all()
    shielded = eb.shield(agent, scenario=PAPER)
    assert harm_of(shielded, 20).mean() <= harm_of(half, 20).mean()


@pytest.mark.parametrize(
    ("gives", "message"),
    [
        (
            lambda n: np.full(n, 9),
            r"world 0, step 1 \(0.50 s\): .* the action index for this world is 9; must be a whole number",
        ),
        (lambda n: np.full(n, 2.0), "returned float64 of shape"),
        (lambda n: np.full(n + 1, 2), r"from 0 to 8 per world with actions=9, shape \(3,\) or \(3, 1\)"),
    ],
)
def test_function__of_indices_that_gives_something_else_is_refused(gives: Any, message: str) -> None:
    agent = eb.policy_agent(lambda seen: gives(len(seen)), actions=9)
    with pytest.raises(InvalidInput, match=message):
        harm_of(agent, 3)


def test_clip__takes_the_nearest_index() -> None:
    agents = [eb.policy_agent(lambda seen, k=k: np.full(len(seen), k), actions=9, clip=True) for k in (-4, 0)]
    assert (harm_of(agents[0], 5) == harm_of(agents[1], 5)).all()
