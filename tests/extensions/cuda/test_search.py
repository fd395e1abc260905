"""The search of many threads: here on a processor, with the code that a GPU runs."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.cuda.profiles import best_alone, met, search
from ethbrake_marl.extensions.cuda.search_kernels import Plans
from ethbrake_marl.extensions.search.pricing import Problem, Profiles, problem_of
from tests.refused import refused

SMALL: dict[str, Any] = {"rounds": 2, "restarts": 2, "drawn": 5, "changes": 30, "device": "cpu"}


def problem(n: int = 8, scenario: str = "paper-random", **options: Any) -> Problem:
    loaded, game = eb.open_game(scenario)
    return problem_of(game, loaded.sample(n, seed=7), **options)


def test_profiles__do_the_harm_that_is_reported_and_less_than_constant_braking() -> None:
    asked = problem(40)
    best, values = search(asked, **SMALL)
    assert np.array_equal(values["first"], asked.value(asked.follow(best)))
    constant = asked.constant(asked.even_grid(29))
    of_constant = asked.take(np.repeat(np.arange(40), 29)).values(constant)["first"].reshape(40, 29).min(axis=1)
    assert (values["first"] <= of_constant + 1e-9).mean() > 0.9
    assert values["first"].mean() < 0.8 * of_constant.mean()


def test_result__depends_on_no_other_world_and_on_the_seed_alone() -> None:
    asked = problem(8)
    whole, values = search(asked, **SMALL)
    alone, of_one = search(asked.take([5]), **SMALL)
    assert np.array_equal(alone.ends, whole.ends[[5]]) and of_one["first"] == values["first"][5]
    again, _ = search(asked, **SMALL)
    other, _ = search(asked, **SMALL, seed=1)
    assert np.array_equal(again.commands_mps2, whole.commands_mps2)
    assert not np.array_equal(other.commands_mps2, whole.commands_mps2)


def test_given_profiles__are_where_threads_begin() -> None:
    asked = problem(6)
    good, values = search(asked, rounds=4, restarts=4, drawn=50, changes=200, device="cpu")
    none = {**SMALL, "drawn": 1, "changes": 1, "rounds": 1}
    _, after = search(asked, good, **none)
    assert (after["first"] <= values["first"] + 1e-9).all()
    bad = asked.constant(asked.even_grid(2))
    _, worse = search(asked, bad, **none)
    assert worse["first"].mean() >= after["first"].mean()


@pytest.mark.parametrize("scenario, bodies", [("cooperation-3-pair", None), ("cooperation-4-all", [1, 2, 3])])
def test_several_controlled_vehicles(scenario: str, bodies: list[int] | None) -> None:
    asked = problem(10, scenario, bodies=bodies)
    best, values = search(asked, **{**SMALL, "drawn": 60, "changes": 200})
    braking = asked.values(asked.constant(asked.bounds[:, np.newaxis, :, 0]))
    assert values["first"].mean() < 0.9 * braking["first"].mean()
    asked.check(best)


def test_several_vehicles__do_no_more_harm_than_one_of_them_while_the_others_brake() -> None:
    loaded, game = eb.open_game("cooperation-3-pair")
    worlds, effort = loaded.sample(10, seed=7), {**SMALL, "drawn": 60, "changes": 200}
    asked = problem_of(game, worlds)
    _, values = search(asked, **effort)
    alone = asked.values(best_alone(asked, partial(search, **effort)))["first"]
    assert (values["first"] <= alone + 1e-9).all()
    for body in (2, 3):
        _, own = search(problem_of(game, worlds, [body], deciders=[2, 3]), **effort)
        assert alone.mean() < own["first"].mean() + 0.1
    start = Profiles(np.full((10, 1), 75), np.zeros((10, 1, 2)))
    search(problem_of(game, worlds), start, **effort)  # which may be given beside it
    with refused("given: has 2 profiles for each world, with one for several vehicles, but 1 threads search it"):
        search(problem_of(game, worlds), start, **effort | {"restarts": 1})


def test_weights__give_a_front() -> None:
    asked = problem(10).take(np.tile(np.arange(10), 2))
    weights = np.repeat([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0]], 10, axis=0)
    best, _ = search(asked.minimising(weights), **SMALL)
    first, second = np.split(asked.follow(best).borne_harm("first"), 2)
    assert first[:, 0].mean() < second[:, 0].mean() and first[:, 2].mean() > second[:, 2].mean()


def test_seconds__end_it() -> None:
    _, values = search(problem(4), **{**SMALL, "rounds": 10**9}, seconds=0.0)
    assert np.isfinite(values["first"]).all()


def test_threads__meet_in_pairs_and_go_on_from_the_better_profile() -> None:
    values = torch.tensor([3.0, 1.0, 4.0, 2.0, 9.0, 0.0, 8.0, 7.0], dtype=torch.float64)  # 4 threads, 2 worlds
    numbers = torch.arange(8)
    plans = Plans(numbers[None].clone(), numbers[None, None].double(), numbers.clone(), values, numbers.clone())
    after = met(plans, 2, 4, 0)  # thread 0 meets 2, 1 meets 3
    assert after.phases.tolist() == [0, 5, 2, 7 - 4, 0, 5, 2, 3]
    assert after.ends[0].tolist() == after.commands[0, 0].tolist() == after.phases.tolist()
    assert after.values.tolist() == [3.0, 0.0, 4.0, 2.0, 3.0, 0.0, 4.0, 2.0]
    assert after.random.tolist() == [*range(8)]
    then = met(after, 2, 4, 1)  # thread 0 meets 1
    assert then.values.tolist() == [3.0, 0.0, 3.0, 0.0, 3.0, 0.0, 3.0, 0.0]
    assert met(plans, 8, 1, 0) is plans


def test_search__is_a_function_however_often_it_is_named() -> None:
    assert eb.cuda.search is search and eb.cuda.search is search


def test_no_world__is_refused() -> None:
    with refused("problem: has no world"):
        search(problem(2).take([]), **SMALL)


def test_too_little_memory__is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*given: Any, **more: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate")

    monkeypatch.setattr("ethbrake_marl.extensions.cuda.profiles.started", full)
    with refused("n = 2 worlds, restarts = 2 threads in each, on device 'cpu': need more memory than the device has"):
        search(problem(2), **SMALL)


@pytest.mark.parametrize(
    "changes, reason",
    [
        ({"rounds": 0}, "rounds = 0"),
        ({"restarts": 3}, "restarts = 3: must be a power of two, from 1 to 1024"),
        ({"restarts": 2048}, "restarts = 2048: must be"),
        ({"drawn": 0}, "drawn = 0"),
        ({"changes": 0}, "changes = 0"),
        ({"seed": -1}, "seed = -1"),
        ({"seconds": float("nan")}, "seconds = nan: must be None, or a number of 0 or more"),
        ({"seconds": float("inf")}, "seconds = inf: must be None"),
        ({"device": "gpu"}, "device = 'gpu'"),
        ({"given": 3}, "given: has 3 profiles; must have some for each of the 2 worlds"),
        ({"given": 8}, "given: has 4 profiles for each world, but 2 threads search it"),
    ],
)
def test_bad_input__is_refused(changes: dict[str, Any], reason: str) -> None:
    asked = problem(2)
    given = changes.get("given")
    if given is not None:
        changes = {"given": Profiles(np.full((given, 1), 75), np.zeros((given, 1, 1)))}
    with refused(reason, InvalidInput):
        search(asked, **SMALL | changes)
