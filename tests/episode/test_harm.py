"""Harm: shares by mass, both counts, the obstacle, objectives, by hand and as properties."""

from __future__ import annotations

import pickle
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.episode.objectives import amounts, objectives_of, parse_objective
from ethbrake_marl.episode.state import State, split_harm
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion import layout as at
from tests.episode.lines import later, state_of

EPS = np.finfo(float).eps


def split(pairs: Any, mass: Any) -> np.ndarray:
    pairs, mass = (np.concatenate([np.zeros((len(rows), 1)), rows], axis=1) for rows in (pairs, mass))
    out = np.empty((len(mass), mass.shape[1] - 1))
    split_harm(np.concatenate([pairs, np.zeros((len(pairs), 1))], axis=1), mass, out)
    return out


@settings(max_examples=100)
@given(st.lists(st.floats(1e-2, 1e4), min_size=2, max_size=6), st.data())
def test_shares__add_up_to_the_last_bit_and_are_inverse_to_the_masses(mass: list[float], data: st.DataObject) -> None:
    value = st.just(0.0) | st.floats(1e-10, 2_000.0)
    harm = data.draw(st.lists(value, min_size=len(mass) - 1, max_size=len(mass) - 1))
    for p, squared in enumerate(harm):  # pair by pair: a vehicle between two pairs bears a sum of rounded numbers
        front, rear = split([[squared]], [mass[p : p + 2]])[0]
        assert Fraction(float(front)) + Fraction(float(rear)) == Fraction(squared)
        assert min(front, rear) >= 0.0
        assert front * mass[p] == pytest.approx(rear * mass[p + 1], rel=0, abs=4.0 * EPS * squared * max(mass))
    assert split([harm], [mass]).sum() == pytest.approx(sum(harm), rel=1e-14)


@pytest.mark.parametrize(
    ("harm", "mass", "expected"),
    [  # the lighter one of a pair bears more
        ([16, 0], [3, 1, 1], [4.0, 12.0, 0.0]),
        ([16, 8], [1, 3, 1], [12.0, 6.0, 6.0]),
    ],
)
def test_shares__by_hand(harm: list[float], mass: list[float], expected: list[float]) -> None:
    assert split([harm], [mass])[0].tolist() == expected


def test_counts__differ_by_the_later_impacts() -> None:
    # 8, 4 and 2 m/s against a heavy wall whose brakes hold it, with e = 0.5, in two intervals
    state = state_of([0.0], [0.0, 8.0], mass_t=[2.0**50, 1.0], restitution=0.5)
    for until in (1.0, 3.25):
        state = later(state, [-16.0, 4.0], until)
    assert state.pair_harm("first").tolist() == [[64.0]]
    assert np.round(state.pair_harm("total"), 9).tolist() == [[64.0 + 16.0 + 4.0]]
    assert state.line[0, at.IMPACTS, 1] == 3.0 and state.collided.tolist() == state.pair_hit[:, 0].tolist() == [True]
    assert state.harm("first").tolist() == [64.0] and state.borne_harm("first").sum() == 64.0


def test_harm_of_the_obstacle__is_that_of_vehicle_1() -> None:
    # 6 m/s into it, 8 and 10 m/s behind, all touching, e = 0: one round, then all are at rest
    state = later(state_of([0.0, 0.0], [6.0, 8.0, 10.0], obstacle_gap_m=0.0), 0.0, 0.5)
    assert state.line[0, at.FIRST, 0] == state.line[0, at.TOTAL, 0] == 36.0
    assert state.pair_harm("total").tolist() == [[4.0, 4.0]] and state.harm("total").tolist() == [44.0]
    assert state.borne_harm("first").tolist() == state.borne_harm("total").tolist() == [[38.0, 4.0, 2.0]]
    assert state.obstacle_gap_m.tolist() == [0.0] and not state.speeds_mps.any()
    alone = later(state_of([50.0], [20.0, 0.0], obstacle_gap_m=10.0), 0.0, 1.0)
    assert alone.collided.tolist() == [True] and not alone.pair_hit.any()
    assert np.isinf(state_of([50.0], [20.0, 0.0]).obstacle_gap_m).all()


# ---------------------------------------------------------------- objectives


def met(pairs: tuple[float, float] = (12.0, 9.0), total: tuple[float, float] = (12.0, 30.0)) -> State:
    """Pair 1 met with 12 m2/s2 (masses 1, 2), pair 2 with 9 (masses 2, 1), then with 21 more; e = 0.5."""
    state = state_of([0.0, 0.0], [0.0, 0.0, 0.0], mass_t=[1.0, 2.0, 1.0], restitution=0.5)
    state.line[0, at.FIRST, 1:3], state.line[0, at.TOTAL, 1:3], state.line[0, at.IMPACTS, 1:3] = pairs, total, (1, 2)
    return state


def of_objective(objective: Any, state: State, count: str = "first") -> list[float]:
    found: list[float] = amounts(objectives_of(objective, 3), None, state, HarmCount.of(count))[0].tolist()
    return found


@pytest.mark.parametrize(
    ("objective", "harm"),
    [  # pair 1 gives 8 and 4, pair 2 gives 3 and 6 of its first: the vehicles bear (8, 7, 6)
        ("total", [21.0, 21.0, 21.0]),
        ("own", [8.0, 7.0, 6.0]),
        ("social:45", [21 / 2**0.5] * 3),
        ("social:30", [x * 0.75**0.5 + (21 - x) / 2 for x in (8, 7, 6)]),
        ("maximin", [8.0, 8.0, 8.0]),
        ("weighted:1,4,2", [3 * (8 + 4 * 7 + 2 * 6) / 7] * 3),
        (("total", "own", "maximin"), [21.0, 7.0, 8.0]),
        ("vehicle_3", [6.0] * 3),
    ],
    ids=str,
)
def test_objective__by_hand(objective: Any, harm: list[float]) -> None:
    assert of_objective(objective, met()) == pytest.approx(harm, abs=1e-8)


@pytest.mark.parametrize("objective", ["maximin", "social:30"])
def test_objective__of_some_time_is_what_it_has_grown_by(objective: str) -> None:
    before, after = met((12.0, 0.0)), met((12.0, 9.0))
    grown = amounts(objectives_of(objective, 3), before, after, HarmCount.of("first"))[0]
    expected = np.subtract(of_objective(objective, after), of_objective(objective, before))
    assert grown == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("objective", ["total", "social:30", "weighted:1,4,2", "vehicle_2"])
def test_weights__of_a_weighted_sum_give_the_objective(objective: str) -> None:
    state, parsed = met(), parse_objective(objective)
    for vehicle, amount in enumerate(of_objective(objective, state)):
        assert (parsed.weights(state.car, vehicle) * state.borne_harm("first")).sum() == pytest.approx(amount)


def test_weights__of_another_objective_are_refused() -> None:
    with pytest.raises(
        InvalidInput, match="is not a weighted sum of the vehicles' harm; use one of total, own, social"
    ):
        parse_objective("maximin").weights(met().car, 0)


def test_objective__is_the_same_after_a_pickle() -> None:
    for text in ("own", "vehicle_3", "weighted:1,4,2"):
        parsed = parse_objective(text)
        assert pickle.loads(pickle.dumps(parsed)) == parsed


# ---------------------------------------------------------------- the harm of an episode

OBJECTIVES = ["social:30", "maximin", "weighted:1,4,1"]


@pytest.mark.parametrize(
    ("objective", "count"),
    [("own", "total"), *((each, "first") for each in [*OBJECTIVES, ["total", "own", "social:45"]])],
    ids=str,
)
def test_rewards__add_up_to_minus_the_objective_of_the_last_state(objective: Any, count: str) -> None:
    scenario, game = open_game("paper-random", reward={"harm": 1.0, "objective": objective, "harm_count": count})
    state, total = game.reset(scenario.sample(40, 4)), np.zeros((40, 3))
    actions = np.random.default_rng(2).uniform(-1.0, 0.0, (40, 1))
    while not state.ended.all():
        state, step = game.step(state, actions)
        total += step.reward
    assert state.collided.sum() > 15
    assert total == pytest.approx(-amounts(objectives_of(objective, 3), None, state, HarmCount.of(count)), abs=1e-9)
