"""The key ``follower``: one more vehicle behind the line. Values by hand."""

from collections.abc import Callable

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.files.yaml import parse_yaml
from ethbrake_marl.first_edition.scenario.schema import Scenario
from tests.refused import refused

PAIR = {
    "name": "pair",
    "vehicles": 2,
    "gaps_m": 12,
    "speeds_mps": 20,
    "braking_capacity_mps2": [6, 9],
    "driving_capacity_mps2": 3,
    "mass_t": [1.6, 2.0],
    "latency_s": 0.2,
}


def test_follower__keeps_its_time_gap_at_the_speed_of_the_last_vehicle() -> None:
    line = Scenario(**PAIR, follower={"time_gap_s": 0.9, "latency_s": 0.5})
    worlds = line.sample(1, 7).worlds
    assert line.vehicles == 3 and line.roles["vehicle_3"] == "full_brake"
    assert worlds.gaps_m.tolist() == [[12.0, 18.0]] and worlds.speeds_mps.tolist() == [[20.0] * 3]
    told = worlds.vehicles
    assert told.braking_capacity_mps2.tolist() == [[6.0, 9.0, 7.59]] and told.latency_s.tolist() == [[0.2, 0.2, 0.5]]
    assert told.mass_t.tolist() == [[1.6, 2.0, 2.0]] and told.driving_capacity_mps2.tolist() == [[3.0] * 3]
    assert Scenario(**line.declared()) == line  # it does not grow again
    assert line.replace(follower={}).vehicles == 4


def test_follower__beside_a_mixture_stands_behind_each_of_its_lines() -> None:
    both = [{"scenario": {**PAIR, "name": name, "speeds_mps": speed}} for name, speed in (("slow", 10), ("fast", 20))]
    worlds = Scenario(name="both", mixture=both, follower={}).sample(30, 7).worlds
    rows = set(zip(worlds.gaps_m[:, 1].tolist(), worlds.speeds_mps[:, 2].tolist(), strict=True))
    assert rows == {(6.0, 10.0), (12.0, 20.0)}


MISTAKES: dict[str, Callable[[], object]] = {
    "bad.yaml, line 9: follower.time_gap_s = -1: must be greater than 0": lambda: written("follower: {time_gap_s: -1}"),
    "bad.yaml, line 9: follower.gap: unknown key": lambda: written("follower: {gap: 5}"),
    "bad.yaml, line 9: follower = 3": lambda: written("follower: 3"),
    "bad.yaml, line 3: gaps_m = -1": lambda: written("follower: {}", gaps_m=-1),
    "bad.yaml, line 9: follower: the follower has the speed of vehicle_2, which is random; this speed must be a": (
        lambda: written("follower: {}", speeds_mps="{uniform: [18, 22]}")
    ),
    "mixture[0] (stress-wide): follower: the follower has the speed of vehicle_3, which is random;": (
        lambda: eb.load_scenario("mixture-paper").replace(follower={})
    ),
    "follower: cannot be combined with vehicle_types; instead of the follower": (
        lambda: eb.load_scenario("realistic-mixed").replace(follower={})
    ),
}


def written(last: str, **changed: object) -> Scenario:
    """The scenario of a file of ``PAIR`` with other values and one more line."""
    lines = [f"{key}: {changed.get(key, value)}" for key, value in PAIR.items()]
    return Scenario.from_document(parse_yaml("\n".join([*lines, last]), "bad.yaml"))


@pytest.mark.parametrize("told", MISTAKES)
def test_follower__refusals_say_where_and_what_would_be_right(told: str) -> None:
    with refused(told):
        MISTAKES[told]()
