"""Time to collision, deceleration required and whose front, by hand and in evaluations."""

from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.field.measures import approach, drac_mps2, ttc_s
from ethbrake_marl.motion.layout import HIT
from tests.episode.lines import state_of

ANY_GAME: Any = None  # these measures ask nothing of the game


def test_pairs__by_hand() -> None:
    # 20 m close with 5 m/s in 4 s, which 25 / 40 m/s2 just avoids; equal speeds and an opening gap need nothing
    state = state_of([[20.0, 5.0, 8.0]], [[10.0, 15.0, 15.0, 10.0]])
    rates, required = approach(state)
    assert rates == pytest.approx(np.array([[1 / 4, 0.0, 0.0]])) and required == pytest.approx(
        np.array([[0.625, 0.0, 0.0]])
    )
    slow = state_of([[20.0]], [[10.0, 10.1]])
    assert ttc_s(ANY_GAME, slow).result(slow)[""] == pytest.approx(60.0)  # 200 s
    assert drac_mps2(ANY_GAME, slow).result(slow)[""] == pytest.approx(0.01 / 40)


def test_extremes__of_all_decisions_before_the_first_impact_of_a_pair() -> None:
    # The first world's rear pair needs 25 / 7 m/s2 for a moment, then it collides; the other world's front pair closes
    # in 1.6 s, and needs 25 / 16 m/s2.
    alert = state_of([[20.0, 5.0], [8.0, 8.0]], [[10.0, 15.0, 15.0]] * 2)
    then = state_of([[20.0, 3.5], [9.0, 8.0]], [[10.0, 10.0, 15.0], [10.0, 10.0, 10.0]])
    last = state_of([[20.0, 0.1], [9.0, 8.0]], [[10.0, 10.0, 20.0], [10.0, 10.0, 10.0]])
    last.line[0, HIT, 2] = 1.0
    values = []
    for measure in (ttc_s, drac_mps2):
        watch = measure(ANY_GAME, alert)
        watch.see(alert, None, then)
        watch.see(then, None, last)
        values.append({ending: column.tolist() for ending, column in watch.result(last).items()})
    least, largest = values
    assert least["1"] == pytest.approx([4.0, 1.6]) and least["2"] == pytest.approx([0.7, 60.0])
    assert least[""] == pytest.approx([0.7, 1.6]) and least["critical"] == [True, False]
    assert largest["1"] == pytest.approx([25 / 40, 25 / 16]) and largest["2"] == pytest.approx([25 / 7, 0.0])
    assert largest[""] == pytest.approx([25 / 7, 25 / 16]) and largest["critical"] == [True, False]


def test_evaluation__has_a_column_for_each_pair_and_the_rate_in_tables() -> None:
    result = eb.evaluate("paper-random", "full_brake,coast", measures="ttc_s,drac_mps2,whose_front", episodes=50)
    columns = result["full_brake"]
    assert (columns["ttc_s"] == np.minimum(columns["ttc_s_1"], columns["ttc_s_2"])).all()
    assert (columns["drac_mps2"] == np.maximum(columns["drac_mps2_1"], columns["drac_mps2_2"])).all()
    row = eb.summarise(result)[0]
    assert row["ttc_critical_rate"].value == (columns["ttc_s"] < 1.5).mean() > 0.0
    assert row["drac_critical_rate"].value == (columns["drac_mps2"] > 3.4).mean() > 0.0
    assert columns["ttc_s"].max() > 1.5 and columns["drac_mps2"].min() < 3.4


@pytest.mark.parametrize("scenario", ["paper-random-obstacle", "cooperation-2-five", "cooperation-3-pair"])
def test_whose_front__has_the_impacts_of_the_learners_with_both_neighbours(scenario: str) -> None:
    loaded, game = eb.open_game(scenario)
    columns = eb.evaluate(scenario, "full_brake", measures="whose_front", episodes=60)["full_brake"]
    team = eb.Team.of({f"vehicle_{body}": eb.make_agent("full_brake") for body in game.settings.learners}, "all")
    last = eb.play_to_end(game, loaded.sample(60, seed=7), team)
    pairs = last.pair_harm("total")  # column p: vehicles p + 1 and p + 2
    strikes = sum(pairs[:, body - 2] for body in game.settings.learners)
    struck = sum(pairs[:, body - 1] for body in game.settings.learners if body < last.vehicles)
    assert columns["whose_front_strikes"] == pytest.approx(strikes) and pairs.sum() > 0.0
    assert columns["whose_front_struck"] == pytest.approx(struck)


def test_whose_front__of_vehicle_1_is_against_the_obstacle() -> None:
    scenario = eb.load_scenario("paper-random-obstacle").with_learners(["vehicle_1"])
    columns = eb.evaluate(scenario, "coast", measures="whose_front", episodes=30)["coast"]
    rest = columns["total_harm"] - columns["whose_front_strikes"] - columns["whose_front_struck"]
    assert columns["whose_front_strikes"].min() > 100.0 and rest.min() > -1e-9  # the rest: Vehicles 2 and 3
