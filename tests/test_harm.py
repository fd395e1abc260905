"""Harm: shares by mass, a ledger of both counts, injury, and whose harm counts under each objective."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.harm import (
    STANDARD,
    Ledger,
    empty_ledger,
    injury_probability,
    objective_harm,
    objectives_of,
    parse_objective,
    scored,
    split,
)
from ethbrake_marl.physics import Floats, advance
from ethbrake_marl.physics.batch import Impacts
from ethbrake_marl.rewards import RewardParams, reward_params
from ethbrake_marl.scenario import Scenario, load_scenario
from tests.physics.random_worlds import driving_lines, line
from tests.reference.tolerances import EPS

# ---------------------------------------------------------------- shares


@settings(max_examples=300)
@given(st.lists(st.floats(1e-2, 1e4), min_size=2, max_size=6), st.data())
def test_split__shares_add_up_to_the_last_bit_and_are_inverse_to_the_masses(mass, data) -> None:
    value = st.just(0.0) | st.floats(1e-10, 2_000.0)
    harm = data.draw(st.lists(value, min_size=len(mass) - 1, max_size=len(mass) - 1))
    for p, squared in enumerate(harm):  # pair by pair: a vehicle between two pairs bears a sum of rounded numbers
        front, rear = split(np.array([[squared]]), np.array([mass[p : p + 2]]))[0]
        assert Fraction(float(front)) + Fraction(float(rear)) == Fraction(squared)
        assert min(front, rear) >= 0.0
        rounding = 4.0 * EPS * squared * max(mass[p : p + 2])
        assert front * mass[p] == pytest.approx(rear * mass[p + 1], rel=0, abs=rounding)
    assert split(np.array([harm]), np.array([mass])).sum() == pytest.approx(sum(harm), rel=1e-14)


@pytest.mark.parametrize(
    ("harm", "mass", "expected"),
    [
        ([16.0, 0.0], [1.0, 3.0, 1.0], [12.0, 4.0, 0.0]),
        ([16.0, 0.0], [3.0, 1.0, 1.0], [4.0, 12.0, 0.0]),
        ([0.0, 16.0], [1.0, 3.0, 1.0], [0.0, 4.0, 12.0]),
        ([16.0, 8.0], [1.0, 3.0, 1.0], [12.0, 4.0 + 2.0, 6.0]),
    ],
)
def test_split__the_lighter_one_bears_more_as_in_the_paper(harm, mass, expected) -> None:
    assert split(np.array([harm]), np.array([mass])).tolist() == [expected]


def test_injury_probability__matches_its_formula() -> None:
    assert injury_probability(np.array([0.0]), "front")[0] == pytest.approx(1 / (1 + np.exp(4.457)))
    assert injury_probability(np.array([-10.0]), "rear")[0] == pytest.approx(1 / (1 + np.exp(4.888 - 1.77)))


# ---------------------------------------------------------------- the ledger


def booked(key: int, n: int, N: int) -> tuple[Ledger, Floats, Floats, Floats]:
    """A ledger of three segments; first-impact harm, total harm and number of their recorded impacts, [n, pairs]."""
    worlds, command = driving_lines(key, n, N)
    ledger, (first, total, count) = empty_ledger(worlds), np.zeros((3, *worlds.gaps_m.shape))
    for until in (0.7, 2.0, 6.0):
        worlds, impacts = advance(worlds, command, until_s=until, record=True)
        rows, (segment_first, segment_total) = impacts.rows, np.zeros((2, *first.shape))
        assert rows is not None and np.all(np.diff(rows.time_s)[np.diff(rows.world) == 0] >= 0.0)
        harm = rows.closing_speed_mps * rows.closing_speed_mps
        np.add.at(segment_total, (rows.world, rows.pair), harm)
        np.add.at(segment_first, (rows.world[rows.first], rows.pair[rows.first]), harm[rows.first])
        np.add.at(count, (rows.world, rows.pair), 1.0)
        assert np.array_equal(worlds.pair_hit, count > 0)
        first, total, ledger = first + segment_first, total + segment_total, ledger.add(impacts)
    return ledger, first, total, count


@pytest.mark.parametrize("N", [2, 3, 6])
def test_ledger__is_the_sum_of_the_recorded_impacts_to_the_last_bit(N: int) -> None:
    ledger, first, total, count = booked(45, 400, N)
    assert ledger.pair_harm("first").tobytes() == first.tobytes()
    assert ledger.pair_harm("total").tobytes() == total.tobytes()
    assert ledger.count.tolist() == count.tolist() and ledger.count.dtype == np.int64
    assert ledger.collided.tolist() == (count.sum(axis=1) > 0).tolist()
    assert ledger.world_harm("total") == pytest.approx(ledger.vehicle_harm("total").sum(axis=1), rel=1e-14)


def test_ledger__the_two_counts_differ_by_the_later_impacts() -> None:
    # 8, 4, 2 m/s against a heavy holding wall, in two segments
    world = line([0.0], [0.0, 8.0], mass_t=[2.0**50, 1.0], restitution=0.5)
    ledger = empty_ledger(world)
    for until in (1.0, 3.25):
        world, impacts = advance(world, [-16.0, 4.0], until_s=until)
        ledger = ledger.add(impacts)
    assert (ledger.pair_harm("first").tolist(), ledger.count.tolist()) == ([[64.0]], [[3]])
    assert ledger.world_harm("total") == pytest.approx([64.0 + 16.0 + 4.0])
    assert ledger.collided.tolist() == [True] and ledger.vehicle_harm("first").sum() == 64.0


def test_ledger__the_harm_of_the_obstacle_is_that_of_vehicle_1_alone() -> None:
    # 6 m/s into the obstacle, 8 and 10 m/s behind, all touching, e = 0: one round, all at rest
    world = line([0.0, 0.0], [6.0, 8.0, 10.0], obstacle_gap_m=0.0)
    ledger = empty_ledger(world).add(advance(world, 0.0, 0.0)[1])
    assert ledger.obstacle_harm("first").tolist() == ledger.obstacle_harm("total").tolist() == [36.0]
    assert ledger.pair_harm("total").tolist() == [[4.0, 4.0]] and ledger.world_harm("total").tolist() == [44.0]
    assert ledger.vehicle_harm("first").tolist() == ledger.vehicle_harm("total").tolist() == [[38.0, 4.0, 2.0]]
    alone = line([50.0], [20.0, 0.0], obstacle_gap_m=10.0)
    assert empty_ledger(alone).add(advance(alone, 0.0, 1.0)[1]).collided.tolist() == [True]


# ---------------------------------------------------------------- objectives

PAPER = load_scenario("paper-random")
EACH = [*STANDARD, "social:30", "social:90", "weighted:1,4,2"]


def ledger() -> Ledger:
    """Pair 1 met with 12 m2/s2 (masses 1, 2), pair 2 with 9 (masses 2, 1); a second, harder impact of pair 2."""
    first, total = np.array([[12.0, 9.0]]), np.array([[12.0, 30.0]])
    return Ledger(first, total, np.array([[1, 2]]), *Impacts.no_obstacle(1), np.array([[1.0, 2.0, 1.0]]))


# Shares by mass: pair 1 gives 12 * 2/3 = 8 and 4, pair 2 gives 9 * 1/3 = 3 and 6; so H = (8, 7, 6), 21 in all.
# In the total count pair 2 gives 10 and 20: H = (8, 14, 20).
@pytest.mark.parametrize(
    ("objective", "harm_count", "expected"),
    [
        ("total", "first", [21.0, 21.0, 21.0]),
        ("own", "first", [8.0, 7.0, 6.0]),
        ("social:0", "first", [8.0, 7.0, 6.0]),
        ("social:90", "first", [13.0, 14.0, 15.0]),
        ("social:45", "first", [21.0 / math.sqrt(2.0)] * 3),
        ("social:30", "first", [h * math.cos(math.pi / 6) + (21 - h) * 0.5 for h in (8.0, 7.0, 6.0)]),
        ("maximin", "first", [8.0, 8.0, 8.0]),
        ("mass-weighted", "first", [3 * (8 + 2 * 7 + 6) / 4] * 3),
        ("weighted:1,4,2", "first", [3 * (8 + 4 * 7 + 2 * 6) / 7] * 3),
        ("weighted:1e6, 1e-6,1e6", "first", [3 * (8 + 6) / 2] * 3),
        (("total", "own", "maximin"), "first", [21.0, 7.0, 8.0]),
        (("total", "own", "maximin"), "total", [42.0, 14.0, 20.0]),
    ],
)
def test_objective_harm__by_hand(objective: Any, harm_count: str, expected: list[float]) -> None:
    found = objective_harm(ledger(), harm_count, objectives_of(objective, 3))
    assert found == pytest.approx(np.array([expected]), rel=1e-11)
    name = objective if isinstance(objective, str) else ", ".join(objective)
    told = scored(ledger(), harm_count, [objective])
    assert list(told) == [name] and told[name].tolist() == found.tolist()


def played(reward: Any, scenario: Scenario = PAPER, n: int = 60) -> tuple[Floats, Engine]:
    """The sum of rewards of each vehicle, and the engine at the end."""
    scripts = {i: make_agent(script) for i, script in scenario.scripts.items()}
    engine = Engine(scenario, n, learners=scenario.learners, scripts=scripts, reward=reward, seed=4)
    action, total = np.random.default_rng(2).uniform(-1.0, 0.0, (n, len(scenario.learners))), 0.0
    while not engine.ended.all():
        total += engine.step(action).reward
    return total, engine


@pytest.mark.parametrize("harm_count", ["first", "total"])
@pytest.mark.parametrize("objective", [*EACH, ["total", "own", "social:45"]], ids=str)
def test_rewards__add_up_to_minus_the_objective_of_the_ledger(objective: Any, harm_count: str) -> None:
    scenario = PAPER if isinstance(objective, str) else PAPER.with_learners([1, 2])
    total, engine = played({"objective": objective, "harm_count": harm_count}, scenario)
    assert engine.ledger.collided.sum() > 20
    expected = -objective_harm(engine.ledger, harm_count, objectives_of(objective, 3))
    assert total == pytest.approx(expected, abs=1e-9)


def test_reward__of_the_scenario_unless_the_reward_has_its_own() -> None:
    own = PAPER.replace(objective="own")
    assert played("harm", own)[0].tolist() == played({"objective": "own"})[0].tolist()
    assert played({"objective": "total"}, own)[0].tobytes() == played("harm")[0].tobytes()
    assert played(RewardParams(objective=("total",) * 3))[0].tobytes() == played("harm")[0].tobytes()


def test_reward__weight_and_other_terms_stay_what_they_are() -> None:
    doubled, _ = played({"objective": "maximin", "harm": 2.0, "terminal": 3.0})
    single, engine = played({"objective": "maximin"})
    safe = ~engine.ledger.collided
    assert safe.any()
    assert doubled == pytest.approx(2.0 * single + 3.0 * safe[:, np.newaxis])
    without, _ = played({"harm": 0.0, "terminal": 1.0})
    assert without.tolist() == np.repeat(safe[:, np.newaxis] * 1.0, 3, axis=1).tolist()


def test_objective__round_trips_with_its_scenario() -> None:
    for objective in (*EACH, ["own", "social:45", "total"]):
        scenario = PAPER.replace(objective=objective)
        assert Scenario(**scenario.declared()) == scenario
    assert parse_objective("social:45").angle_deg == 45.0
    assert reward_params("harm").objective is None
