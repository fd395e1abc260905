"""What somebody who tries everything met: each is refused in one line, and nothing has changed."""

import pickle
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.faces.sb3 import make_sb3_vec_env
from ethbrake_marl.faces.vector import EthBrakeVectorEnv
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.game import game_of

PAPER = load_scenario("paper-random").replace(early_impacts="keep")


@pytest.mark.parametrize("role", ["nonsense", "coast@x", "no:3"])
def test_role_of_an_agent__must_be_known(role: str) -> None:
    scenario = PAPER.replace(roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": role})
    for face in (EthBrakeEnv, EthBrakeParallelEnv, lambda each: EthBrakeVectorEnv(2, each)):
        with pytest.raises(
            InvalidInput, match=rf"roles.vehicle_3 = {role}: (unknown agent|agent 'coast@x': coast uses no policy)"
        ):
            face(scenario)


@pytest.mark.parametrize("actions", [[[0.0]], None, np.zeros(3), np.zeros((2, 1)), np.zeros((3, 1), bool), "brake"])
def test_step_of_a_game__takes_one_action_for_each_learner_and_world(actions: Any) -> None:
    _, game = game_of("paper-random")
    state = game.start(3, 1, 0)
    before = pickle.dumps(state)
    with pytest.raises(InvalidInput, match=r"must be an array of numbers with the shape \(3, 1\)"):
        game.step(state, actions)
    assert pickle.dumps(state) == before


class Scripted:
    """A script that commands whatever it is given."""

    def __init__(self, given: Any) -> None:
        self.given = given

    def begin(self, alert: Any, body: int) -> None:
        return None

    def act(self, state: Any, memory: Any, body: int) -> tuple[Any, Any]:
        return (np.zeros(state.n) if state.time_s.max() == 0.0 else self.given), None


@pytest.mark.parametrize("given", [np.full(2, np.nan), np.full(2, -np.inf), None, "full", np.zeros(3)], ids=str)
def test_script__must_command_finite_numbers(given: Any) -> None:
    _, game = game_of(PAPER, scripts={3: Scripted(given)})
    state = game.start(2, 1, 0)
    before = pickle.dumps(state.line)
    with pytest.raises(InvalidInput, match=r"agent 'Scripted'.*vehicle_3.*(must be numbers|must be in)"):
        game.step(state, np.zeros((2, 1)), donate=True)
    assert pickle.dumps(state.line) == before


@pytest.mark.parametrize("v2x", ["paper", {"preset": "nominal", "message_period_s": 0.05}])
def test_snapshot__can_be_restored_again(v2x: Any) -> None:
    environment = make_sb3_vec_env(PAPER.replace(v2x=v2x), 4, seed=1)
    environment.reset()
    saved, seen = environment.snapshot(), []
    for _ in range(3):
        environment.restore(saved)
        seen.append([environment.step(np.full((4, 1), -0.3))[0].copy() for _ in range(60)])
    assert np.array_equal(seen[0], seen[1])
    assert np.array_equal(seen[0], seen[2])


@pytest.mark.parametrize(
    "settings",
    [{"reward": "paper"}, {"reward": {"harm": 1.0, "objective": "social:45"}}, {"reward_vector": "vehicles"}],
    ids=str,
)
def test_running_episode__can_be_pickled(settings: dict[str, Any]) -> None:
    environment = EthBrakeEnv(**settings)
    environment.reset(seed=1)
    environment.step([-0.2])
    other = pickle.loads(pickle.dumps(environment))
    for _ in range(20):
        one, two = environment.step([-0.7]), other.step([-0.7])
        assert np.array_equal(one[0], two[0])
        assert np.array_equal(one[1], two[1])


def test_seed__counts_from_the_next_reset() -> None:
    environment = make_sb3_vec_env("paper-random", 2, seed=1, step_infos=True)
    first = environment.reset().copy()
    environment.seed(9)
    *_, infos = environment.step(np.full((2, 1), -0.3))
    assert {info["world_seed"] for info in infos} == {1}
    assert not np.array_equal(environment.reset(), first)
    assert {info["world_seed"] for info in environment.step(np.full((2, 1), -0.3))[3]} == {9}


@pytest.mark.parametrize(
    "action", [[[0.1], [0.1, 0.2]], np.ma.masked_array([[0.1], [0.2]], [[True], [False]])], ids=str
)
def test_action_that_is_no_array_of_numbers__is_refused(action: Any) -> None:
    many = EthBrakeVectorEnv(2)
    many.reset(seed=1)
    with pytest.raises(InvalidInput, match="must be a number in"):
        many.step(action)
    if isinstance(action, np.ma.MaskedArray):
        rows = make_sb3_vec_env("paper-random", 2, seed=1)
        rows.reset()
        with pytest.raises(InvalidInput, match="must be a number in"):
            rows.step(action)


def test_small_ways_to_ask() -> None:
    for face in (EthBrakeEnv(), EthBrakeVectorEnv(2)):
        one, two = face.reset(seed=np.int64(9))[0], face.reset(seed=9)[0]
        assert np.array_equal(one, two)
    environment = make_sb3_vec_env("paper-random", 2, seed=1)
    environment.set_options({"nothing": 1})
    with pytest.warns(UserWarning, match="nothing"):
        environment.reset()
    with pytest.raises(InvalidInput, match=r"message_period_s = 1e-09: must be greater than or equal to 0.001"):
        PAPER.replace(v2x={"preset": "nominal", "message_period_s": 1e-9})
