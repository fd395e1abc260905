"""Injuries by hand: curves, measures and the objective."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import HONEST, HarmCount
from ethbrake_marl.episode.objectives import amounts, objectives_of
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.evaluation.measure_registry import measures_called
from ethbrake_marl.extensions.injuries.curves import CURVES, expected_injuries, risks, speed_changes
from tests.episode.lines import later, state_of
from tests.episode.test_harm import met, of_objective
from tests.evaluation.lines import FULL_BRAKE, PAIR, evaluated
from tests.refused import refused


def test_injuries__by_hand() -> None:
    # Vehicle 1's speed changes by 2 / 3 1.5 sqrt(12) at its rear, Vehicle 2's by 1 / 3 1.5 sqrt(12) at its front and by
    # 1 / 3 1.5 3 at its rear, of which the front is worse, and Vehicle 3's by 2 / 3 1.5 3 at its front.
    logits = np.array([4.888 - 0.177 * 12**0.5, 4.457 - 0.177 * 3**0.5, 4.457 - 0.177 * 3])
    expected = (1000 / (1 + np.exp(logits))).sum()
    assert of_objective("injury:lr4s", met()) == pytest.approx([expected] * 3, abs=1e-8)


@pytest.mark.parametrize(
    ("curve", "side", "dv", "probability"),
    [
        ("lr4s", 0, 10.0, 1 / (1 + np.exp(4.457 - 1.77))),
        ("lr4s", 1, 10.0, 1 / (1 + np.exp(4.888 - 1.77))),
        ("gidas", 0, 10.0, 1 / (1 + np.exp(5.82 - 2.92))),
        ("gidas", 1, 10.0, 1 / (1 + np.exp(5.82 - 2.92))),
        ("reference", 0, 10.0, (10 / 51.287) ** 1.531),
        ("reference", 1, 10.0, (10 / 66.956) ** 1.531),
        ("reference", 0, 60.0, 1.0),
        ("reference", 1, 0.0, 0.0),
    ],
)
def test_probability__of_an_injury_by_hand(curve: str, side: int, dv: float, probability: float) -> None:
    changes = np.zeros((1, 2, 1))
    changes[0, side] = dv
    assert risks(changes, curve)[0, :, 0].tolist() == pytest.approx(
        [0.0] * side + [probability] + [0.0] * (1 - side), rel=1e-12
    )


def test_injured__by_the_larger_change_of_each_vehicle() -> None:
    changes = np.array([[[0.0, 2.0, 3.0, 0.0], [4.0, 3.0, 3.0, 0.0]]])  # front, rear
    front, rear = (
        (lambda dv: 1000 / (1 + np.exp(4.457 - 0.177 * dv))),
        (lambda dv: 1000 / (1 + np.exp(4.888 - 0.177 * dv))),
    )
    assert expected_injuries(changes, "lr4s")[0] == pytest.approx([rear(4.0), rear(3.0), rear(3.0), 0.0])
    assert expected_injuries(changes[:, ::-1], "lr4s")[0] == pytest.approx([front(4.0), front(3.0), rear(3.0), 0.0])


def test_changes_of_speed__between_two_states_by_hand() -> None:
    # 10 m/s into a vehicle of three times the mass at rest, e = 0.2: 1.2 x 10 are shared 3 : 9; the other world is calm
    before = state_of([[1.0], [500.0]], [[0.0, 10.0]] * 2, mass_t=[3.0, 1.0], restitution=0.2)
    changes = speed_changes(before, later(before, 0.0, 0.5))
    assert changes[0] == pytest.approx(np.array([[0.0, 9.0], [3.0, 0.0]])) and not changes[1].any()


def test_delta_v__is_the_largest_change_of_each_vehicle_by_one_impact() -> None:
    result = eb.evaluate("paper-random", "full_brake", measures="delta_v_mps,injury_gidas", episodes=60)["full_brake"]
    each = np.column_stack([result[f"delta_v_mps_{vehicle}"] for vehicle in (1, 2, 3)])
    assert (result["delta_v_mps"] == each.max(axis=1)).all() and ((each.max(axis=1) > 0.0) == result["collided"]).all()
    injuries = 1_000.0 / (1.0 + np.exp(5.82 - 0.292 * each))  # the same at front and rear
    assert result["injury_gidas"] == pytest.approx(np.where(each > 0.0, injuries, 0.0).sum(axis=1))


def test_injuries__of_the_honest_cost_are_those_of_impacts() -> None:
    """A kilometre apart and driving at full force, a vehicle pays for driving and motion, and nobody is hurt."""
    state = state_of([1000.0], [20.0, 20.0])
    last = later(state, [-6.0, 7.0], 2.0)
    injuries = objectives_of("injury:lr4s", 2)
    assert amounts(injuries, state, last, HONEST).tolist() == [[0.0, 0.0]] and last.harm("honest")[0] > 100.0


@pytest.mark.parametrize("count", ["first", "total", "honest"])
def test_rewards__add_up_to_minus_the_injuries_of_the_last_state(count: str) -> None:
    reward: Any = {"harm": 1.0, "objective": "injury:gidas", "harm_count": count}
    scenario, game = eb.open_game("paper-random", reward=reward)
    state, total = game.reset(scenario.sample(40, 4)), np.zeros((40, 3))
    actions = np.random.default_rng(2).uniform(-1.0, 0.0, (40, 1))
    while not state.ended.all():
        state, step = game.step(state, actions)
        total += step.reward
    assert total == pytest.approx(
        -amounts(objectives_of("injury:gidas", 3), None, state, HarmCount.of(count)), abs=1e-9
    )


def test_curve__is_named() -> None:
    with refused("unknown argument of the objective injury 'gidass'; did you mean 'gidas'?", UnknownName):
        objectives_of("injury:gidass", 2)
    with refused("unknown argument of the objective injury ''", UnknownName):
        objectives_of("injury", 2)


def test_measure__of_one_impact_by_hand() -> None:
    """Vehicle 1 is hit at its rear, Vehicle 2 at its front, at 3 m/s; the two share 1.1 times that by their masses."""
    changes = {1: 4.888 - 0.177 * 1.815, 2: 4.457 - 0.177 * 1.485}
    injuries = {body: 1000.0 / (1.0 + math.exp(exponent)) for body, exponent in changes.items()}
    row = evaluated(PAIR, 2, [FULL_BRAKE], ["injury_lr4s"])["full_brake"]
    assert [row[f"injury_lr4s_{body}"][1] for body in (1, 2)] == pytest.approx([*injuries.values()], rel=1e-5)
    assert row["injury_lr4s"][1] == pytest.approx(sum(injuries.values()), rel=1e-5)


def test_injury__is_the_curve_without_injuries_at_rest() -> None:
    assert [each.name for each in measures_called("injury")] == ["injury_reference"]
    touch = np.full((1, 2, 1), 1e-9)
    assert {curve: bool(risks(touch, curve).max() < 1e-9) for curve in CURVES} == {
        "lr4s": False, "reference": True, "gidas": False,
    }  # fmt: skip
