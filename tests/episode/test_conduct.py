"""Terms of conduct by hand: push, driving, motion at the horizon."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.reward import RewardParams
from ethbrake_marl.episode.state import State
from tests.contract.interfaces import CRASH, REST
from tests.episode.lines import later, state_of
from tests.episode.test_terms import paid

near = pytest.approx

# Vehicle 2 drives at 2 m/s2 from 0.5 s on, 1 m behind Vehicle 1, at the same speed: contact at 0.5 + 1 = 1.5 s, with
# 2 m/s. From then on (e = 0) both are pushed. Vehicle 3 drives, too, and has fallen far behind.
CLOSE = state_of([1.0, 90.0], [10.0, 10.0, 0.0], latency_s=[0.0, 0.5, 0.0])


@cache
def after_contact() -> State:
    return later(CLOSE, [0.0, 2.0, 1.0], 4.0)


def test_drove__counts_what_the_engine_does() -> None:
    terms = paid({"harm": 0.0, "drove": 1.0}, CLOSE, after_contact()).terms
    assert terms["drove"][0].tolist() == near([0.0, -7.0, -4.0])


def test_push__is_the_push_of_the_step_of_all_pairs() -> None:
    terms = paid({"harm": 0.0, "push": 3.0}, CLOSE, after_contact()).terms
    assert terms["push"].tolist() == near([-2.0 * 2.5])  # 2 and 0 m/s2, for 2.5 s
    after = later(after_contact(), [-1.0, 2.0, 1.0], 5.0)
    step = paid({"harm": 0.0, "push": 3.0}, after_contact(), after)
    assert step.terms["push"].tolist() == near([-3.0]) and step.reward[0].tolist() == near([-9.0] * 3)
    against = state_of([0.0], [0.0, 0.0], obstacle_gap_m=0.0)  # 3 against the obstacle, 2 against Vehicle 1
    assert paid({"harm": 0.0, "push": 1.0}, against, later(against, [3.0, 2.0], 1.0)).terms["push"] == near(-5.0)


@pytest.mark.parametrize(
    ("scenario", "action", "ends"), [(CRASH.replace(horizon_s=0.9), 0.0, [-1.0]), (REST, -1.0, [])]
)
def test_still_moving__is_paid_once_at_the_horizon(scenario: Any, action: float, ends: list[float]) -> None:
    _, game = open_game(scenario, reward={"harm": 0.0, "still_moving": 2.0})
    state, values = game.reset(game.draw(1, 0, 0)), list[float]()
    for _ in range(11):
        state, step = game.step(state, np.full((1, 1), action))
        assert step.reward[0].tolist() == [2.0 * step.terms["still_moving"][0]] * 2
        values += [value for value in step.terms["still_moving"].tolist() if value]
    assert values == ends and state.at_rest[0] == (not ends)


def test_weights__are_in_files_where_they_are_not_0() -> None:
    assert not {"push", "drove", "still_moving"} & RewardParams(harm=1.0).model_dump().keys()
    params = RewardParams(harm=1.0, push=2.0)
    assert params.model_dump()["push"] == 2.0 and RewardParams(**params.model_dump()) == params
