"""The limits of a scenario's values: what lies on a limit is accepted, the next number beyond it is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jsonschema
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.worlds.quantities import QUANTITIES
from ethbrake_marl.worlds.scenario import Scenario
from ethbrake_marl.worlds.scenario_file import scenario_json_schema
from ethbrake_marl.worlds.user_worlds import worlds_from_state
from tests.refused import refused

EDITOR = jsonschema.Draft202012Validator(scenario_json_schema())
BASE: dict[str, Any] = {
    "name": "limits", "gaps_m": 5, "speeds_mps": 0, "braking_capacity_mps2": 5, "driving_capacity_mps2": 5, "mass_t": 1,
    "latency_s": 0, "roles": {"vehicle_2": "learner"},
}  # fmt: skip
LEAST = math.nextafter(0.0, 1.0)  # above 0
IN_TIME = math.nextafter(3600.0, 0.0)  # times until a vehicle may act are also below the horizon

# key -> smallest and largest value, and what else is then declared instead of BASE
RANGES: dict[str, tuple[float, float, dict[str, Any]]] = {
    "gaps_m": (0.0, 1e4, {}),
    "speeds_mps": (0.0, 200.0, {"speed_limit_mps": 200}),
    "braking_capacity_mps2": (LEAST, 100.0, {}),
    "driving_capacity_mps2": (0.0, 100.0, {}),
    "latency_s": (0.0, IN_TIME, {"horizon_s": 3600}),
    "mass_t": (LEAST, 1000.0, {}),
    "speed_limit_mps": (LEAST, 200.0, {}),
    "restitution": (0.0, 1.0, {}),
    "time_gaps_s": (LEAST, 60.0, {"gaps_m": None, "speeds_mps": 9}),
    "line_speed_mps": (0.0, 200.0, {"speeds_mps": None, "speed_limit_mps": 200}),
    "speed_deviations_mps": (-200.0, 200.0, {"speeds_mps": None, "speed_limit_mps": 200}),
    "obstacle_margin_m": (LEAST, 1e4, {}),
    "obstacle_gap_m": (LEAST, 1e4, {}),
    "alert_s": (0.0, IN_TIME, {"horizon_s": 3600}),
    "friction": (LEAST, 2.0, {}),
    "grip": (LEAST, 1.0, {"friction": 1.0}),
    "brake_rate_mps3": (LEAST, 1e6, {}),
    "release_rate_mps3": (LEAST, 1e6, {"brake_rate_mps3": 9}),
}
FORMS: dict[str, Callable[[float, float], Any]] = {  # of a value and of another one that is right
    "number": lambda value, right: value,
    "uniform": lambda value, right: {"uniform": sorted([value, right])},
    "choice": lambda value, right: {"choice": [right, value]},
    "list": lambda value, right: [right, value],
}


def below(key: str) -> float:
    """Largest number that is too small."""
    return math.nextafter(RANGES[key][0], -math.inf)


def above(key: str) -> float:
    """Smallest number that is too large."""
    return math.nextafter(3600.0 if RANGES[key][1] == IN_TIME else RANGES[key][1], math.inf)


def ends(key: str, value: float) -> dict[str, Any]:
    """What fits a value that is the end of a range of speeds."""
    return {"line_speed_mps": 200.0 if value < 0.0 else 0.0} if key == "speed_deviations_mps" else {}


def content(key: str, value: Any, more: dict[str, Any]) -> dict[str, Any]:
    whole = {**BASE, **more, key: value}
    return {name: each for name, each in whole.items() if each is not None}


def test_limits__are_those_of_all_quantities() -> None:
    assert RANGES.keys() == QUANTITIES.keys()


CASES = [  # each quantity as a number, and one in all other forms
    (key, form) for k, key in enumerate(RANGES) for form in [*FORMS][: 1 if k else None]
]


@pytest.mark.parametrize(("key", "form"), CASES)
def test_quantity__at_its_limit_is_accepted_and_beyond_it_is_refused(key: str, form: str) -> None:
    low, high, more = RANGES[key]
    rule, vehicles = QUANTITIES[key], 3 if QUANTITIES[key].per == "pair" else 2
    for value, beyond in ((low, below(key)), (high, above(key))):
        also = {**more, **ends(key, value), "vehicles": vehicles}
        right = value if key in ("speed_deviations_mps", "line_speed_mps", "speeds_mps") else min(max(1.0, low), high)
        given = content(key, FORMS[form](value, right), also)
        Scenario(**given)
        assert EDITOR.is_valid(given)
        given = content(key, FORMS[form](beyond, right), also)
        with refused(f"must be {rule.interval}"):
            Scenario(**given)
        assert not EDITOR.is_valid(given)
        with pytest.raises(InvalidInput, match="must be a finite number"):
            Scenario(**content(key, FORMS[form](math.inf, right), also))


OTHERS: dict[str, tuple[list[Any], list[Any]]] = {  # key -> accepted, refused
    "vehicles": ([2, 64], [1, 65]),
    "time_step_s": ([1e-3, 8.0], [math.nextafter(1e-3, 0.0), math.nextafter(8.0, 9.0)]),
    "horizon_s": ([0.1, 3600.0], [math.nextafter(0.1, 0.0), math.nextafter(3600.0, 4e3), 0.0]),
    "name": (["a", "a" * 64, "0-_"], ["", "a" * 65, "-a", "A"]),
}
CHANNEL: dict[str, tuple[list[Any], list[Any]]] = {
    "silent_links": ([0.0, 1.0], [-LEAST, math.nextafter(1.0, 2.0)]),
    "loss_ends": ([0.01, 1.0], [math.nextafter(0.01, 0.0), math.nextafter(1.0, 2.0)]),
    "message_period_s": ([1e-3, 60.0], [math.nextafter(1e-3, 0.0), math.nextafter(60.0, 61.0)]),
    "link_latency_s": ([0.0, 60.0], [-LEAST, math.nextafter(60.0, 61.0)]),
    "sensing_s": ([[0.0, 60.0], [1.0, 1.0]], [[-LEAST, 1.0], [0.0, math.nextafter(60.0, 61.0)], [1.0, 0.5]]),
}
BY_WEIGHT = ([LEAST, 1e9], [0.0, -1.0, math.nextafter(1e9, 2e9)])


def accepts(given: dict[str, Any]) -> bool:
    try:
        Scenario(**given)
    except InvalidInput:
        return False
    return True


def test_pair_of_keys__at_its_limit_is_accepted_and_beyond_it_is_refused() -> None:
    for key in ("latency_s", "alert_s"):
        late = {**BASE, "horizon_s": 9.0}
        Scenario(**{**late, key: math.nextafter(9.0, 0.0)})
        with refused("may not be able to act until 9 s; this time must be below horizon_s (9 s)"):
            Scenario(**{**late, key: 9.0})
    fast = {**BASE, "vehicles": 2, "speed_limit_mps": 30}
    Scenario(**{**fast, "speeds_mps": [30, 30]})
    with refused("speed_limit_mps"):
        Scenario(**{**fast, "speeds_mps": [30, math.nextafter(30.0, 31.0)]})


@pytest.mark.parametrize("key", OTHERS)
def test_key__at_its_limit_is_accepted_and_beyond_it_is_refused(key: str) -> None:
    for values, right in zip(OTHERS[key], (True, False), strict=True):
        assert [accepts({**BASE, key: value}) for value in values] == [right] * len(values), values


@pytest.mark.parametrize("key", CHANNEL)
def test_key_of_the_channel__at_its_limit_is_accepted_and_beyond_it_is_refused(key: str) -> None:
    base = {**BASE, "horizon_s": 100, "v2x": {"preset": "paper" if key == "link_latency_s" else "nominal"}}
    for values, right in zip(CHANNEL[key], (True, False), strict=True):
        given = [{**base, "v2x": {**base["v2x"], key: value}} for value in values]
        assert [accepts(each) for each in given] == [right] * len(values), values


def test_weight__at_its_limit_is_accepted_and_beyond_it_is_refused() -> None:
    member = {key: value for key, value in BASE.items() if key != "name"}
    for values, right in zip(BY_WEIGHT, (True, False), strict=True):
        for value in values:
            choice = {"gaps_m": {"choice": [1, 2], "weights": [1, value]}}
            mixture = {"name": "x", "mixture": [{"scenario": {**member, "name": "m"}, "weight": value}]}
            types = {"vehicle_types": {"car": {"weight": value}, "truck": {}}, "types": "any"}
            assert [accepts({**BASE, **choice}), accepts(mixture), accepts({**BASE, **types})] == [right] * 3, value


@pytest.mark.parametrize("key", ["gaps_m", "restitution"])
def test_given_world__at_a_limit_is_accepted_and_beyond_it_is_refused(key: str) -> None:
    low, high, more = RANGES[key]
    scenario = Scenario(**content(key, BASE.get(key, 0.5), more))
    for value, beyond in ((low, below(key)), (high, above(key))):
        worlds_from_state(scenario, {key: value})
        with refused(f"must be {QUANTITIES[key].interval}"):
            worlds_from_state(scenario, {key: beyond})
