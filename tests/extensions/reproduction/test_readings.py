"""Readings of the paper: what they change, and the random test under each."""

from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import open_game, teams_of
from ethbrake_marl.agents.pairwise import harm_of_deceleration, pairwise
from ethbrake_marl.agents.team import play_to_end
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.reproduction import register
from ethbrake_marl.extensions.reproduction.made import ReproductionSettings
from ethbrake_marl.extensions.reproduction.random_test import (
    E_V2X_BM,
    HYBRID_PPO,
    NON_E,
    brake,
    plan,
    report_outcome,
    table_of,
)
from ethbrake_marl.extensions.reproduction.readings import NEAREST, RANDOM, STATED, Reading
from ethbrake_marl.extensions.reproduction.register import distance, rates_and_harms
from ethbrake_marl.motion.layout import BRAKING, LATENCY
from tests.refused import refused

WORLDS = 100
SETTINGS = ReproductionSettings(Path("unused"), episodes=20)

EARLY = Reading(acts_s=0.2)
DRIVEN_EARLY = register.EARLY_DRIVEN
ROWS = {
    "stated": STATED,
    "early": EARLY,
    "map": STATED._replace(step_s=0.25),
    "coasts": STATED._replace(after_impact="coasts"),
    "ends": STATED._replace(after_impact="ends"),
    "planned": DRIVEN_EARLY._replace(star="low end"),
    "total": STATED._replace(counted="total", hybrid="realised, by the coupled H*"),
    "nearest": NEAREST,
}
GOLDEN = {  # in the first 100 worlds: collision rate and mean harm of Non-E, E-V2X-BM, Hybrid SAC, Hybrid PPO
    "stated": [0.8, 21.011164, 0.6, 17.195163, 0.6, 7.068346, 0.6, 6.934062],
    "early": [0.96, 31.741475, 0.49, 16.739087, 0.49, 3.928278, 0.49, 3.463971],
    "map": [0.96, 34.530865, 0.91, 28.875307, 0.79, 20.510552, 0.77, 22.396755],
    "coasts": [0.8, 33.539506, 0.6, 17.195163, 0.6, 7.068346, 0.6, 6.934062],
    "ends": [0.8, 13.001568, 0.6, 17.195163, 0.6, 7.068346, 0.6, 6.934062],
    "planned": [0.96, 31.741475, 0.84, 8.559601, 0.49, 3.628675, 0.49, 3.477837],
    "total": [0.8, 22.464132, 0.6, 18.491603, 0.6, 6.468591, 0.6, 6.310893],
    "nearest": [0.96, 31.966079, 0.83, 8.559601, 0.54, 5.251315, 0.49, 4.982125],
}


@pytest.mark.parametrize("name", ROWS)
def test_numbers__are_as_recorded(name: str) -> None:
    assert rates_and_harms(table_of(ROWS[name], WORLDS)).ravel() == pytest.approx(GOLDEN[name], abs=1e-6)


@pytest.mark.parametrize(
    ("reading", "spec"),
    [
        (EARLY._replace(hybrid="realised, by the coupled H*"), "ppo+episode"),
        (STATED._replace(hybrid="policy alone", step_s=0.2), "ppo"),
        (STATED._replace(hybrid="realised, by the coupled H*", counted="total"), "ppo+episode"),
    ],
    ids=lambda each: each if isinstance(each, str) else each.name,
)
def test_hybrid__is_what_the_shield_does(reading: Reading, spec: str) -> None:
    scenario = reading.scenario(RANDOM)
    shield = eb.evaluate(scenario, spec, episodes=WORLDS, harm_count=reading.counted)[spec]
    collided, harm = report_outcome(HYBRID_PPO, reading, WORLDS, "ppo")
    column = "total_harm" if reading.counted == "total" else "first_impact_harm"
    assert np.array_equal(harm, shield[column]) and np.array_equal(collided, shield["collided"])


@pytest.mark.parametrize("reading", [STATED._replace(step_s=0.2), EARLY], ids=lambda reading: reading.name)
def test_baselines__are_what_the_agents_do(reading: Reading) -> None:
    result = eb.evaluate(reading.scenario(RANDOM), "full_brake,e_v2x_bm:pairwise", episodes=WORLDS, harm_count="first")
    for row, name in ((NON_E, "full_brake"), (E_V2X_BM, "e_v2x_bm:pairwise")):
        collided, harm = report_outcome(row, reading, WORLDS)
        assert np.array_equal(harm, result[name]["first_impact_harm"])
        assert np.array_equal(collided, result[name]["collided"])
    predicted = report_outcome(E_V2X_BM, reading._replace(baseline="predicted"), WORLDS)[1]
    assert np.array_equal(predicted, result["e_v2x_bm:pairwise"]["predicted_harm"])


def test_predicted__harm_of_the_hybrid_is_what_algorithm_1_expects() -> None:
    scenario, game = open_game(RANDOM)
    team = teams_of("ppo+episode:pairwise", scenario)["ppo+episode:pairwise"]
    memory = play_to_end(game, scenario.sample(WORLDS, 7), team).memories["shield"]
    expected = np.minimum(memory.policy_harm, memory.bound_harm)
    collided, harm = report_outcome(HYBRID_PPO, STATED._replace(hybrid="predicted"), WORLDS, "ppo")
    assert np.array_equal(harm, expected) and np.array_equal(collided, expected > 0.0)


def test_mixed__report_has_the_collisions_that_happen_and_the_harm_that_was_predicted() -> None:
    collided, harm = report_outcome(E_V2X_BM, DRIVEN_EARLY, WORLDS)
    assert np.array_equal(harm, plan(DRIVEN_EARLY, WORLDS).harm)
    assert np.array_equal(collided, report_outcome(E_V2X_BM, DRIVEN_EARLY._replace(baseline="realised"), WORLDS)[0])
    assert collided.sum() > (harm > 0.0).sum()


def test_ends_of_a_star__do_equally_little_harm_and_nothing_beyond_them_does() -> None:
    low, middle, high = (
        plan(STATED._replace(star=star), WORLDS).deceleration_mps2 for star in ("low end", "middle", "high end")
    )
    alert = eb.load_scenario(RANDOM).sample(WORLDS, 7)
    harm = pairwise(alert, 2).harm
    assert (low <= middle).all() and (middle <= high).all()
    assert np.array_equal(low == high, harm > 0.0)
    for k in np.flatnonzero(harm == 0.0):
        car = alert.car[k].copy()

        def at(deceleration: float, k: int = k, car: np.ndarray = car) -> float:
            return harm_of_deceleration(alert.line[k], car[BRAKING], car[LATENCY], 2, deceleration)

        assert max(at(low[k]), at(high[k])) < 1e-9
        assert at(low[k] - 1e-3) > 0.0 and (high[k] == 7.0 or at(high[k] + 1e-3) > 0.0)


def test_after_an_impact__vehicles_coast_or_the_episode_ends() -> None:
    on, coasts, ends = (brake(STATED, None, each, WORLDS) for each in ("brakes on", "coasts", "ends"))
    impacts = eb.evaluate(RANDOM, "full_brake", episodes=WORLDS)["full_brake"]["impacts"]
    assert np.array_equal(on["collided"], coasts["collided"]) and np.array_equal(on["collided"], ends["collided"])
    one = impacts <= 1
    assert ends["first"][one] == pytest.approx(on["first"][one], rel=1e-9) and one.sum() > on["collided"].sum() - 80
    assert (ends["first"] < on["first"] + 1e-9).all() and (coasts["first"] > ends["first"] - 1e-9).all()
    assert coasts["first"].mean() > on["first"].mean() > ends["first"].mean()


def test_names__say_what_differs() -> None:
    assert (STATED.name, EARLY.name) == ("as stated", "Vehicle 2 acts at 0.2 s")
    both = STATED._replace(step_s=0.25, others=(("horizon_s", 5.0), ("speed_limit_mps", 25.0)), star="low end")
    assert both.name == "the paper's map at 0.25 s; horizon_s = 5.0, speed_limit_mps = 25.0; a* at the low end"


def test_scenario__has_what_the_reading_says() -> None:
    scenario = Reading(RANDOM, 0.25, 1.1, 0.5, 0.3, (("horizon_s", 5.0), ("gaps_m", (7, 7)))).scenario(
        "paper-delay-low"
    )
    assert scenario.latency_s == (0.0, 0.25, 1.1) and (scenario.physics, scenario.time_step_s) == ("paper-map", 0.5)
    assert (scenario.restitution, scenario.horizon_s, scenario.gaps_m) == (0.3, 5.0, (7.0, 7.0))
    assert STATED.scenario("paper-delay-low").latency_s == (0.0, 0.1, 0.3)


def test_map__has_no_coupled_bound() -> None:
    with refused("does not cover map", InvalidInput):
        table_of(STATED._replace(step_s=0.2, hybrid="realised, by the coupled H*"), 2)


def test_difference__by_hand() -> None:
    printed = np.array([[0.5, 10.0], [0.4, 8.0], [0.2, 5.0], [0.1, 4.0]])
    ours = printed.copy()
    ours[0, 1], ours[3, 0] = 11.0, 0.05
    assert distance(ours, printed) == pytest.approx(((0.1**2 + 0.5**2) / 8) ** 0.5)
    assert distance(printed, printed) == 0.0


def test_register__shows_every_alternative() -> None:
    made = register.reproduce_gaps(SETTINGS)
    listed, measured = made.sheets
    alternatives = [reading for gap in register.GAPS for reading in gap.alternatives]
    assert len(listed.rows) == len(register.GAPS)
    assert len(measured.rows) == 1 + len(alternatives) + len(register.COMBINED.alternatives)
    assert len({row[1] for row in measured.rows}) == len(measured.rows)
    assert all(bool(gap.alternatives) != bool(gap.otherwise) for gap in register.GAPS)
    assert measured.rows[0][:2] == ("our defaults", "as stated")
    for reading in (STATED, DRIVEN_EARLY, NEAREST):
        (row,) = (row for row in measured.rows if row[1] == reading.name)
        numbers = rates_and_harms(table_of(reading, 20))
        assert row[2] == distance(numbers)
        assert [each.value for each in row[3:7]] == numbers[:, 1].tolist() and [*row[7:]] == numbers[:, 0].tolist()


@pytest.mark.parametrize(
    "reading",
    [
        *(STATED._replace(others=((key, value),)) for key, value in
          (("horizon_s", 5.0), ("horizon_s", 16.0), ("speed_limit_mps", 25.0), ("early_impacts", "keep"))),
        *(STATED._replace(star=star) for star in ("low end", "high end")),
    ],
    ids=lambda reading: reading.name,
)  # fmt: skip
def test_register__quantities_without_effect_have_none(reading: Reading) -> None:
    assert np.array_equal(rates_and_harms(table_of(reading, WORLDS)), rates_and_harms(table_of(STATED, WORLDS)))
