"""An obstacle declared by its distance from where Vehicle 1 stops, and the three tests that share their draws."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl import observation_for
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario import Scenario, load_scenario, new_scenario_text, parse_yaml

REST = {
    "name": "given", "gaps_m": 7, "braking_capacity_mps2": [5, 7, 6], "driving_capacity_mps2": 6, "mass_t": 5,
    "latency_s": [0.5, 0.5, 0.8],
}  # fmt: skip
VARIANTS = ("paper-random-brake-only", "paper-random-obstacle")


def build(**given: object) -> Scenario:
    return Scenario(**{**REST, "speeds_mps": [20, 18, 20], **given})


def test_margin__is_added_to_the_way_to_standstill_latency_included():
    worlds = build(obstacle_margin_m=1.5).sample(2, 7).worlds
    assert worlds.obstacle_gap_m.tolist() == [20 * 0.5 + 20 * 20 / 10 + 1.5] * 2  # 51.5 m


def test_margin__follows_the_drawn_speed_and_capacity():
    scenario = build(
        obstacle_margin_m={"uniform": [1, 2]},
        speeds_mps={"uniform": [18, 22]},
        braking_capacity_mps2={"uniform": [5, 7]},
    )
    worlds = scenario.sample(200, 7).worlds
    speed, capacity = worlds.speeds_mps[:, 0], worlds.vehicles.braking_capacity_mps2[:, 0]
    margin = worlds.obstacle_gap_m - speed * 0.5 - speed**2 / (2 * capacity)
    assert margin.min() >= 1 - 1e-12
    assert margin.max() <= 2 + 1e-12
    assert np.ptp(margin) > 0.9


def test_margin__has_the_random_number_of_the_distance():
    near, far = build(obstacle_margin_m={"uniform": [1, 2]}), build(obstacle_gap_m={"uniform": [51, 52]})
    margin = near.sample(50, 3).worlds.obstacle_gap_m - 50.0
    assert margin == pytest.approx(far.sample(50, 3).worlds.obstacle_gap_m - 50.0, abs=1e-12)


def test_margin__a_given_world_gets_the_obstacle_of_its_own_speed():
    scenario = build(obstacle_margin_m=1.5)
    table = {f"gap_{p}_m": [7, 7] for p in (1, 2)} | {f"speed_{i}_mps": [10, 20] for i in (1, 2, 3)}
    assert scenario.worlds_from_table(table).obstacle_gap_m.tolist() == [5 + 10 + 1.5, 51.5]
    given = scenario.worlds_from_table({**table, "obstacle_gap_m": [30, 31]})
    assert given.obstacle_gap_m.tolist() == [30, 31]
    state = {"gaps_m": 7, "speeds_mps": 20, "latency_s": 0, "braking_capacity_mps2": 4}
    assert scenario.worlds_from_state(state).obstacle_gap_m.tolist() == [51.5]
    drawn = scenario.replace(obstacle_margin_m={"uniform": [1, 2]})
    with pytest.raises(InvalidInput, match=r"column obstacle_gap_m is missing, and random in scenario 'given'"):
        drawn.worlds_from_table(table)


def test_margin__is_an_obstacle_for_everybody():
    scenario = build(obstacle_margin_m=1.5)
    assert scenario.has_obstacle
    assert build(obstacle_gap_m=42).has_obstacle
    assert not build().has_obstacle
    assert scenario.with_learners(["vehicle_1"]).learners == (0,)
    assert observation_for(scenario).obstacle
    assert scenario.replace(obstacle_gap_m=42).obstacle_margin_m is None
    assert scenario.replace(obstacle_gap_m=42).replace(obstacle_margin_m=1).obstacle_gap_m is None


def test_key__of_an_earlier_version_is_unknown():
    with pytest.raises(InvalidInput, match="hazard_gap_m: unknown key; known: "):
        build(hazard_gap_m=42)
    with pytest.raises(InvalidInput, match="initial_state: unknown key 'hazard_gap_m'; "):
        build(obstacle_margin_m=1.5).worlds_from_state({"gaps_m": 7, "speeds_mps": 20, "hazard_gap_m": 60})


def yaml_of(content: dict[str, object]) -> str:
    return "".join(f"{key}: {value}\n" for key, value in content.items())


BAD = [
    (
        {"obstacle_margin_m": 1.7, "obstacle_gap_m": 42},
        "obstacle_margin_m = 1.7",
        "either obstacle_gap_m or obstacle_margin_m",
    ),
    ({"obstacle_margin_m": 0}, "obstacle_margin_m = 0", "must be finite and in (0, 10000] m (metres)"),
    ({"obstacle_margin_m": {"uniform": [-1, 1]}}, "obstacle_margin_m = {uniform: [-1, 1]}", "in (0, 10000] m"),
    ({"obstacle_margin_m": [1, 1, 1]}, "obstacle_margin_m = [1, 1, 1]", "must be a number, {uniform"),
    ({"obstacle_margin_m": None}, "obstacle_margin_m = null", "a key that is not used is left out"),
    ({"obstacle_margins_m": 1}, "obstacle_margins_m", "did you mean obstacle_margin_m (metres)?"),
    (
        {"obstacle_margin_m": 5, "braking_capacity_mps2": {"uniform": [0.01, 5]}},
        "obstacle_margin_m = 5",
        "puts the obstacle up to 20015 m ahead of vehicle_1; that distance must not be above 10000 m",
    ),
    (
        {"obstacle_margin_m": 5, "braking_capacity_mps2": 1e-320},
        "obstacle_margin_m = 5",
        "puts the obstacle up to inf m ahead",
    ),
    ({"roles": {"vehicle_1": "learner"}}, "roles.vehicle_1", "obstacle_gap_m"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "place", "right"), BAD, ids=[f"{b[1]} {k}" for k, b in enumerate(BAD)])
def test_bad_input__one_error(given, place, right):
    with pytest.raises(InvalidInput) as caught:
        build(**given)
    assert str(caught.value).startswith(f"scenario 'given': {place}")
    assert right in str(caught.value)
    assert "more)" not in str(caught.value)


def test_new_file__has_the_key_and_loads():
    text = new_scenario_text("mine", based_on="paper-random-obstacle")
    assert "\nobstacle_margin_m: 1.7\n" in text
    assert "\n# obstacle_gap_m: 42\n" in text
    assert Scenario.from_document(parse_yaml(text)).obstacle_margin_m == 1.7


@pytest.mark.parametrize("name", VARIANTS)
def test_variants__have_the_same_lines_as_paper_random(name):
    plain, variant = load_scenario("paper-random"), load_scenario(name)
    for channel in ("list", "training"):
        usual, other = (s.sample(500, 7, first=100, channel=channel) for s in (plain, variant))
        assert usual.worlds.gaps_m.tobytes() == other.worlds.gaps_m.tobytes()
        assert usual.worlds.speeds_mps.tobytes() == other.worlds.speeds_mps.tobytes()
        assert usual.rejected == other.rejected


@pytest.mark.parametrize("name", VARIANTS)
def test_variants__differ_from_paper_random_in_one_key(name):
    texts = {"name", "title", "description", "source"}
    plain, variant = (load_scenario(each).model_dump(exclude=texts) for each in ("paper-random", name))
    assert {key for key in plain if plain[key] != variant[key]} == {
        "driving_capacity_mps2" if name.endswith("brake-only") else "obstacle_margin_m"
    }


def test_obstacle__stands_1_7_m_beyond_where_vehicle_1_stops_in_every_world():
    worlds = load_scenario("paper-random-obstacle").sample(1000, 7).worlds
    assert worlds.obstacle_gap_m - worlds.speeds_mps[:, 0] ** 2 / 12 == pytest.approx(1.7, abs=1e-12)
    assert load_scenario("paper-random-brake-only").bounds("driving_capacity_mps2")[1] == (0.0, 0.0)
