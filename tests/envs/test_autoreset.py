"""The native vector environment resets as Gymnasium's own does, step by step, in both modes."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation

from ethbrake_marl.envs.interfaces import EthBrakeEnv, EthBrakeVectorEnv
from tests.contract.interfaces import PAPER, actions, initial_state

MODES = ("NextStep", "SameStep")
NUMBERS = ("world", "world_seed")  # of a world that was given: none


class FromOneStream(gymnasium.Wrapper):
    """Takes each of its worlds from the list that all rows share, as the rows of the native environment do."""

    def __init__(self, worlds: Any, given: list[int]) -> None:
        super().__init__(EthBrakeEnv(PAPER))
        self.worlds, self.given = worlds, given

    def reset(self, **_: Any) -> Any:
        self.given[0] += 1
        return self.env.reset(options={"initial_state": initial_state(self.worlds, self.given[0] - 1)})


def both(mode: str, n: int, seed: int) -> tuple[Any, Any]:
    native = EthBrakeVectorEnv(n, PAPER, autoreset_mode=mode)
    if n == 1:
        return native, SyncVectorEnv([lambda: EthBrakeEnv(PAPER)], autoreset_mode=mode)
    worlds, given = PAPER.sample(60, seed, channel="training").worlds, [0]
    return native, SyncVectorEnv([lambda: FromOneStream(worlds, given)] * n, autoreset_mode=mode)


def assert_same_infos(ours: dict[str, Any], theirs: dict[str, Any], n: int, alone: bool) -> None:
    """Every info that Gymnasium's gives, where its mask says that it is one."""
    assert set(theirs) <= set(ours)
    for name, column in theirs.items():
        if name.startswith("_") or (name in NUMBERS and not alone):
            continue
        marked = theirs[f"_{name}"]
        assert np.array_equal(ours[f"_{name}"], marked), name
        if name == "final_info":
            assert_same_infos(ours[name], column, n, alone)
            continue
        for row in np.flatnonzero(marked):
            assert np.array_equal(ours[name][row], column[row]), (name, row)


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("mode", MODES)
def test_step__is_that_of_gymnasiums_own_vector_environment(mode: str, n: int) -> None:
    native, own = both(mode, n, seed=5)
    (ours, told), (theirs, told_own) = (env.reset(seed=5) for env in (native, own))
    assert np.array_equal(ours, theirs)
    assert_same_infos(told, told_own, n, alone=n == 1)
    ends = 0
    for action in actions(11, 300, n):
        (ours, *ending, told), (theirs, *ending_own, told_own) = native.step(action), own.step(action)
        assert np.array_equal(ours, theirs)
        assert all(np.array_equal(a, b) for a, b in zip(ending, ending_own, strict=True))
        assert_same_infos(told, told_own, n, alone=n == 1)
        ends += int((ending[1] | ending[2]).sum())
    assert ends >= 4 * n


def test_default__is_the_same_whatever_way_make_vec_takes() -> None:
    made = [gymnasium.make_vec("EthBrake-v0", num_envs=2, vectorization_mode=way) for way in (None, "sync")]
    assert [env.metadata["autoreset_mode"] for env in made] == [AutoresetMode.NEXT_STEP] * 2
    assert EthBrakeVectorEnv(2).autoreset_mode is AutoresetMode.NEXT_STEP


@pytest.mark.parametrize("mode", MODES)
def test_mode__can_be_chosen_both_ways(mode: str) -> None:
    native = gymnasium.make_vec("EthBrake-v0", num_envs=2, autoreset_mode=mode)
    sync = gymnasium.make_vec(
        "EthBrake-v0", num_envs=2, vectorization_mode="sync", vector_kwargs={"autoreset_mode": AutoresetMode(mode)}
    )
    assert native.metadata["autoreset_mode"] is sync.metadata["autoreset_mode"] is AutoresetMode(mode)


def test_default__suits_gymnasiums_own_vector_wrappers() -> None:
    env = NormalizeObservation(gymnasium.make_vec("EthBrake-v0", num_envs=3))
    env.reset(seed=1)
    for action in actions(2, 90, 3):
        observation = env.step(action)[0]
    assert np.isfinite(observation).all()
