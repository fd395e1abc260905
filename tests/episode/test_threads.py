"""A step has the same bits with any number of threads, and in the text that is compiled for three vehicles."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl import parallel
from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode import threads
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.step import OUT_ROWS, step_worlds
from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.motion.layout import Floats, scratch_for
from tests.episode.test_failed import planted

N = 203  # worlds: slices of 2, 3 and 5 threads differ in length


@pytest.fixture(autouse=True)
def _few_worlds_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "LEAST_WORLDS", 5)
    monkeypatch.setattr(parallel, "usable_cores", lambda: 8)


def game_with(count: int | None) -> Game:
    return open_game("paper-random", threads=count)[1]


def play(game: Game, donate: bool) -> list[list[Floats]]:
    """Arrays of state and step after each step of random actions, up to the end of all episodes."""
    numbers, state, steps = np.random.default_rng(3), game.reset(game.draw(N, 5, 0)), []
    while not state.ended.all():
        state, step = game.step(state, numbers.uniform(-1.0, 1.0, (N, 1)), donate=donate)
        steps.append([array.copy() for array in (*state[:5], step.reward, step.out)])
    return steps


def assert_same(arrays: Sequence[Floats], expected: Sequence[Floats]) -> None:
    for array, expected_array in zip(arrays, expected, strict=True):
        np.testing.assert_array_equal(array, expected_array)


@pytest.mark.parametrize("donate", [False, True])
def test_step__has_the_same_bits_with_any_number_of_threads(donate: bool) -> None:
    expected = play(game_with(1), donate=False)
    for count in (1, 2, 3, 5):
        for arrays, expected_arrays in zip(play(game_with(count), donate), expected, strict=True):
            assert_same(arrays, expected_arrays)


def test_step__of_three_vehicles_has_the_bits_of_the_text_for_any_number() -> None:
    game = game_with(1)
    state, settings, actions = game.reset(game.draw(N, 5, 0)), game.settings, np.full((N, 1), -0.7)

    def step(scratch: Floats) -> tuple[Floats, ...]:
        line, car, clock, _, wanted, _ = copy.deepcopy(state)
        out, reward = np.empty((OUT_ROWS, N)), np.empty((N, 3))
        for _ in range(40):
            assert step_worlds(
                line, clock, wanted, False, 0, N, line, car, clock, wanted, actions, scratch, out, reward,
                settings.learners, settings.time_step_s, settings.harm, settings.terminal, settings.harm_count.weights,
            ) == (-1, -1)  # fmt: skip
        return line, clock, wanted, out, reward

    assert_same(step(scratch_for(4)), step(scratch_for(5)))  # memory for five bodies: not the text for three vehicles


def test_step__moves_no_world_if_the_action_of_another_slice_is_bad() -> None:
    game = game_with(3)
    state = game.reset(game.draw(N, 5, 0))
    before, actions = copy.deepcopy(state), np.zeros((N, 1))
    actions[-1] = 2.0
    with pytest.raises(InvalidInput, match=r"^action of vehicle_2 = 2\.0: must be from -1"):
        game.step(state, actions, donate=True)
    assert_same(state[:5], before[:5])


@pytest.mark.parametrize("row", [100])
def test_step__names_the_world_of_any_slice_that_failed(row: int) -> None:
    game = game_with(3)
    state = planted(game.reset(game.draw(N, 5, 10)), row)
    with pytest.raises(PhysicsError, match=rf"^world {10 + row}: "):
        game.step(state, np.zeros((N, 1)))


@pytest.mark.parametrize(("count", "n"), [(1, N), (2, 4)])
def test_step__starts_no_thread_unless_asked_and_worth_it(count: int, n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "ThreadPoolExecutor", None)
    game = game_with(count)
    game.step(game.reset(game.draw(n, 5, 0)), np.zeros((n, 1)))


def test_threads__are_those_of_the_argument_or_of_the_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    assert game_with(None).settings.threads == 1
    monkeypatch.setenv("ETHBRAKE_THREADS", "3")
    assert game_with(None).settings.threads == 3
    assert game_with(2).settings.threads == 2
    assert eb.EthBrakeVectorEnv(2).game.settings.threads == 3
    assert eb.EthBrakeVectorEnv(2, threads=5).game.settings.threads == 5
    assert eb.make_sb3_vec_env("paper-random", 2).game.settings.threads == 3
    assert eb.make_sb3_vec_env("paper-random", 2, threads=5).game.settings.threads == 5


@pytest.mark.parametrize("text", ["", "0", "1.5"])
def test_threads__refuses_a_bad_variable(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ETHBRAKE_THREADS", text)
    with pytest.raises(InvalidInput, match=rf"^ETHBRAKE_THREADS = '{text}': must be a whole number from 1 to 1024$"):
        game_with(None)


@pytest.mark.parametrize("count", [0, True])
def test_threads__refuses_a_bad_number(count: Any) -> None:
    with pytest.raises(InvalidInput, match=r"^threads = .*: must be a whole number in 1..1024$"):
        game_with(count)


def test_threads__are_never_more_than_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "usable_cores", lambda: 3)
    monkeypatch.setenv("ETHBRAKE_THREADS", "1024")
    assert game_with(None).settings.threads == game_with(4).settings.threads == 3
    game, sizes = game_with(3), list[int]()
    monkeypatch.setattr(parallel, "usable_cores", lambda: 2)  # as in a process beside others

    class Pool(ThreadPoolExecutor):
        def __init__(self, size: int) -> None:
            sizes.append(size)
            super().__init__(size)

    monkeypatch.setattr(threads, "ThreadPoolExecutor", Pool)
    game.step(game.reset(game.draw(N, 5, 0)), np.zeros((N, 1)))
    assert sizes == [2]
