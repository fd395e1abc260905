"""Intervals rest on different worlds: rows of a table and equal worlds count once, however often they are drawn."""

from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.evaluation.statistics import rate
from ethbrake_marl.evaluation.summary import caption

COLUMNS = ["gap_1_m", "gap_2_m", "speed_1_mps", "speed_2_mps", "speed_3_mps"]
PAPER = eb.load_scenario("paper-random")
BASE = {key: value for key, value in PAPER.declared().items() if key not in ("name", "gaps_m", "speeds_mps")}
FIXED = {**BASE, "name": "fixed", "gaps_m": [8, 7], "speeds_mps": [20, 21, 22], "early_impacts": "keep"}


def rows(count: int, seed: int = 4) -> list[list[float]]:
    rng = np.random.default_rng(seed)
    return np.hstack([rng.uniform(5.0, 42.0, (count, 2)), rng.uniform(15.0, 32.0, (count, 3))]).round(2).tolist()


def table(cells: list[list[Any]], **more: Any) -> dict[str, Any]:
    return {**BASE, "name": "mine", "early_impacts": "keep", "table": {"columns": COLUMNS, "rows": cells}, **more}


def mixed(*members: dict[str, Any]) -> dict[str, Any]:
    named = [{"scenario": {**member, "name": f"member-{k}"}} for k, member in enumerate(members)]
    return {"name": "mixed", "mixture": named}


SIXTY = rows(60)
SPEED = {"choice": [19, 21]}
LUCK = {"preset": "nominal", "link_latency_s": 0.3, "sensing_s": [0.9, 0.9], "persistence": "periodic"}
# name -> scenario, and what there are how many of; {}: all worlds are independent
CASES: dict[str, tuple[dict[str, Any], dict[str, int]]] = {
    "table": (table(SIXTY), {"different_rows": 60}),
    "table, drawn latency": (table(SIXTY, latency_s=[0, 0.5, {"uniform": [0.6, 0.9]}]), {"different_rows": 60}),
    "table of equal rows": (table(rows(5) * 3), {"different_rows": 5}),
    "table of one row": (table(rows(1)), {"different_rows": 1}),
    "nothing drawn": (FIXED, {"different_worlds": 1}),
    "two speeds": ({**FIXED, "speeds_mps": [20, SPEED, SPEED]}, {"different_worlds": 4}),
    "tables, mixed": (mixed(table(rows(30)), table(rows(9, seed=5))), {"different_rows": 39}),
    "one table twice": (mixed(table(rows(7)), table(rows(7), mass_t=2)), {"different_rows": 14}),
    "table and nothing drawn": (mixed(table(rows(7)), FIXED), {"different_rows": 8}),
    "messages without luck": ({**FIXED, "v2x": {"preset": "paper", "hears": "front"}}, {"different_worlds": 1}),
    "periodic messages without losses": (
        {**FIXED, "v2x": {**LUCK, "loss_begins": 0.0, "loss_ends": 1.0}}, {"different_worlds": 1}
    ),
    "periodic messages": ({**FIXED, "v2x": LUCK}, {}),
    "drawn messages": ({**FIXED, "v2x": "congested"}, {}),
    "usual": (PAPER.declared(), {}),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_intervals__rest_on_different_worlds(name: str) -> None:
    scenario, count = eb.load_scenario(CASES[name][0]), CASES[name][1]
    result = eb.evaluate(scenario, "full_brake,coast", episodes=600, measures="worst5")
    table_of_result = eb.summarise(result)
    n = next(iter(count.values()), 600)
    assert result.independent == count and {**table_of_result.parameters, **count} == table_of_result.parameters
    assert (result.clusters is None) == (not count)
    for row in table_of_result:
        for key, estimate in row.estimates.items():
            assert estimate is None or n > 1 or estimate.interval is None, key
            assert estimate is None or estimate.freedom is None or estimate.freedom <= n - 1, key
    kinds = {"different_rows": "rows of the table", "different_worlds": "worlds"}
    words = [f"; 95 % intervals by {n} different {kinds[kind]}; d = " for kind in count] if n > 1 else ["; no 95 % int"]
    shown = caption(table_of_result.parameters).replace("\u00a0", " ")
    assert all(each in shown for each in words) and ("interval" in shown) == bool(count)
    parallel = eb.summarise(eb.evaluate(scenario, "full_brake,coast", episodes=600, measures="worst5", jobs=2))
    assert [row.to_json() for row in parallel] == [row.to_json() for row in table_of_result]


def test_table__has_the_intervals_of_its_rows() -> None:
    scenario = eb.load_scenario(table(SIXTY))
    once = eb.worlds_from_table(PAPER, dict(zip(COLUMNS, np.transpose(SIXTY), strict=True)))
    (direct,) = eb.summarise(eb.evaluate(once, "full_brake", scenario=PAPER))
    (drawn,) = eb.summarise(eb.evaluate(scenario, "full_brake", episodes=6000))
    for key in ("collision_rate", "honest_cost", "total_harm"):
        (low, high), (expected_low, expected_high) = drawn[key].interval, direct[key].interval
        assert high - low == pytest.approx(expected_high - expected_low, rel=0.1)
        assert low == pytest.approx(expected_low, abs=0.1 * (expected_high - expected_low))


def test_worlds_that_are_passed__count_once_if_they_are_equal() -> None:
    scenario = eb.load_scenario(table(SIXTY, latency_s=[0, 0.5, {"uniform": [0.6, 0.9]}]))
    for worlds in (scenario.sample(300, 7), scenario.draw(300, 7), scenario.sample(300, 7).take(np.arange(300)[::-1])):
        assert eb.evaluate(worlds, "coast", scenario=scenario).independent == {"different_rows": 60}
    twice = eb.worlds_from_table(
        PAPER, {name: [*column, *column] for name, column in zip(COLUMNS, np.transpose(SIXTY), strict=True)}
    )
    result = eb.evaluate(twice, "full_brake", scenario=PAPER)
    assert result.independent == {"different_worlds": 60} and result.worlds["same_as"].tolist() == [*range(60)] * 2
    assert result.take(np.arange(60)).independent == {} and result.take([3, 63]).independent == {"different_worlds": 1}
    hit = result["full_brake"]["collided"]
    expected = rate(hit[:60]).interval
    assert eb.summarise(result)[0]["collision_rate"].interval == pytest.approx(expected, abs=0.01)
    with pytest.raises(eb.EthBrakeError, match="column 'same_row_as': a column of your own needs another name"):
        eb.worlds_from_table(PAPER, {**dict(zip(COLUMNS, np.transpose(SIXTY), strict=True)), "same_row_as": ["a"] * 60})
