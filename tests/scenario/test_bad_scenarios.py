"""Every kind of bad scenario file: one error that says where, what is there, and what would be right."""

from __future__ import annotations

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario import Scenario, parse_yaml

LINES = {
    "name": "name: bad",
    "vehicles": "vehicles: 3",
    "time_step_s": "time_step_s: 0.1",
    "horizon_s": "horizon_s: 8",
    "gaps_m": "gaps_m: {uniform: [5, 10]}",
    "speeds_mps": "speeds_mps: [20, 18, 20]",
    "braking_capacity_mps2": "braking_capacity_mps2: [6, 7, 6]",
    "driving_capacity_mps2": "driving_capacity_mps2: [6, 7, 6]",
    "mass_t": "mass_t: [4.5, 5.5, 5.9]",
    "latency_s": "latency_s: [0, 0.5, 0.8]",
    "speed_limit_mps": "speed_limit_mps: 40",
    "restitution": "restitution: 0.1",
    "roles": "roles: {vehicle_1: full_brake, vehicle_2: learner, vehicle_3: full_brake}",
    "early_impacts": "early_impacts: reject",
}
LINE_NUMBER = {key: number for number, key in enumerate(LINES, start=1)}
QUANTITY_KINDS = (
    "{uniform: [low, high]}, {loguniform: [low, high]}, {normal: {mean, sd, low, high}} or {choice: [a, b, ...]}"
)


def build(**changed: str | None) -> Scenario:
    """The scenario file of LINES with some lines replaced (None: left out)."""
    lines = {**LINES, **changed}
    text = "\n".join("" if line is None else line for line in lines.values())
    return Scenario.from_document(parse_yaml(text, "folder/bad.yaml"))


# (key whose line is replaced, the line there instead, place and value in the message, what would be right)
BAD = [
    ("gaps_m", "road_friction: 0.7", "road_friction", "the model has no friction; braking_capacity_mps2 is"),
    ("gaps_m", "gaps_km: 0.007", "gaps_km", "unknown key; did you mean gaps_m (metres)?"),
    ("speeds_mps", "speeds_kmh: 72", "speeds_kmh", "did you mean speeds_mps (metres per second)?"),
    ("mass_t", "mass_kg: 4500", "mass_kg", "did you mean mass_t (tonnes)?"),
    ("latency_s", "latency_ms: 500", "latency_ms", "did you mean latency_s (seconds)?"),
    ("mass_t", "mass: 4.5", "mass", "did you mean mass_t (tonnes)?"),
    ("restitution", "restituton: 0.1", "restituton", "did you mean restitution?"),
    ("restitution", "zzz: 0.1", "zzz", "unknown key; known: name, title, "),
    ("gaps_m", None, "gaps_m", "missing; the bumper-to-bumper gap"),
    ("name", None, "name", "missing"),
    ("gaps_m", "gaps_m: -1", "gaps_m = -1", "overlapping vehicles"),
    (
        "gaps_m",
        "gaps_m: [7, {uniform: [-0.1, 7]}]",
        "gaps_m[1] (vehicle_2 to vehicle_3) = {uniform: [-0.1, 7]}",
        "overlapping vehicles",
    ),
    ("gaps_m", "gaps_m: [7, 7, 7]", "gaps_m", "has 3 entries; 3 vehicles need 2 (one per pair)"),
    ("gaps_m", "gaps_m: []", "gaps_m = []", "must not be empty"),
    ("gaps_m", 'gaps_m: "7"', 'gaps_m = "7"', "must be a number, not text; write it without quotes"),
    ("gaps_m", "gaps_m: true", "gaps_m = true", "must be a number or a distribution"),
    ("gaps_m", "gaps_m:", "gaps_m = null", "must be a number or a distribution"),
    ("gaps_m", "gaps_m: .nan", "gaps_m = .nan", "must be a finite number"),
    ("gaps_m", "gaps_m: [7, .inf]", "gaps_m[1] (vehicle_2 to vehicle_3) = .inf", "must be a finite number"),
    ("gaps_m", "gaps_m: 1e999", "gaps_m = .inf", "must be a finite number"),
    ("gaps_m", "gaps_m: [[7], 7]", "gaps_m[0] (vehicle_1 to vehicle_2) = [7]", QUANTITY_KINDS),
    ("gaps_m", "gaps_m: {unifrom: [5, 9]}", "gaps_m = {unifrom: [5, 9]}", "did you mean uniform?"),
    ("gaps_m", "gaps_m: {uniform: 5}", "gaps_m.uniform = 5", "must be a list"),
    ("gaps_m", "gaps_m: {uniform: [5]}", "gaps_m.uniform[1]", "two numbers [low, high]"),
    ("gaps_m", "gaps_m: {uniform: [5, 6, 7]}", "gaps_m.uniform = [5, 6, 7]", "must have 2 entries"),
    ("gaps_m", "gaps_m: {uniform: [9, 6]}", "gaps_m.uniform = [9, 6]", "low must not be above high"),
    ("gaps_m", "gaps_m: {uniform: [5, .nan]}", "gaps_m.uniform[1] = .nan", "must be a finite number"),
    ("gaps_m", "gaps_m: {uniform: [5, 9], choice: [7]}", "gaps_m.choice", "a quantity has one distribution"),
    ("gaps_m", "gaps_m: {normal: {mean: 7, sd: 1, low: 5}}", "gaps_m.normal.high", "missing; a number is needed"),
    ("gaps_m", "gaps_m: {normal: {mean: 7, std: 1, low: 5, high: 9}}", "gaps_m.normal.std", "did you mean sd?"),
    (
        "gaps_m",
        "gaps_m: {normal: {mean: 7, sd: 0, low: 5, high: 9}}",
        "gaps_m.normal = {mean: 7, sd: 0, low: 5, high: 9}",
        "sd must be above 0",
    ),
    (
        "gaps_m",
        "gaps_m: {normal: {mean: 7, sd: 1, low: 9, high: 9}}",
        "gaps_m.normal = {mean: 7, sd: 1, low: 9, high: 9}",
        "low must be below high",
    ),
    (
        "gaps_m",
        "gaps_m: {normal: {mean: 7, sd: 1, low: 20, high: 99}}",
        "gaps_m.normal = {mean: 7, sd: 1, low: 20, high: 99}",
        "at least 1e-06",
    ),
    ("gaps_m", "gaps_m: {choice: []}", "gaps_m.choice = []", "must not be empty"),
    ("gaps_m", "gaps_m: {choice: [7, 8], weights: [1]}", "gaps_m.weights = [1]", "as many entries as choice, 2"),
    ("gaps_m", "gaps_m: {choice: [7, 8], weights: [1, 0]}", "gaps_m.weights = [1, 0]", "every weight must be above 0"),
    ("gaps_m", "gaps_m: {choice: [7, 8], weigths: [1, 1]}", "gaps_m.weigths", "did you mean weights?"),
    ("mass_t", "mass_t: [4.5, -5.5, 5.9]", "mass_t[1] (vehicle_2) = -5.5", "in (0, 1000] t (tonnes)"),
    ("mass_t", "mass_t: 0", "mass_t = 0", "in (0, 1000] t (tonnes)"),
    ("mass_t", "mass_t: 4500", "mass_t = 4500", "in (0, 1000] t (tonnes)"),
    ("mass_t", "mass_t: [4.5, 5.5]", "mass_t", "has 2 entries; 3 vehicles need 3 (one per vehicle), or one for all"),
    ("braking_capacity_mps2", "braking_capacity_mps2: 0", "braking_capacity_mps2 = 0", "(0, 100] m/s2"),
    ("driving_capacity_mps2", "driving_capacity_mps2: -1", "driving_capacity_mps2 = -1", "[0, 100] m/s2"),
    ("speeds_mps", "speeds_mps: -1", "speeds_mps = -1", "[0, 200] m/s"),
    (
        "speeds_mps",
        "speeds_mps: {uniform: [18, 41]}",
        "speeds_mps = {uniform: [18, 41]}",
        "above speed_limit_mps of vehicle_1, 40 m/s",
    ),
    (
        "speeds_mps",
        "speeds_mps: [1, 2, {choice: [3, 41]}]",
        "speeds_mps[2] (vehicle_3) = {choice: [3, 41]}",
        "above speed_limit_mps",
    ),
    (
        "speed_limit_mps",
        "speed_limit_mps: {uniform: [19, 40]}",
        "speeds_mps[0] (vehicle_1) = 20",
        "{uniform: [19, 40]} m/s",
    ),
    ("latency_s", "latency_s: [0, 0.5, 8]", "latency_s[2] (vehicle_3) = 8", "must be below horizon_s (8 s)"),
    ("latency_s", "latency_s: -0.1", "latency_s = -0.1", "[0, 3600] s (seconds)"),
    ("restitution", "restitution: 1.01", "restitution = 1.01", "in [0, 1]"),
    ("restitution", "restitution: [0.1, 0.2]", "restitution = [0.1, 0.2]", QUANTITY_KINDS),
    ("time_step_s", "time_step_s: 9", "time_step_s = 9", "must not be above horizon_s (8 s)"),
    ("time_step_s", "time_step_s: 0", "time_step_s = 0", "greater than or equal to 0.0001"),
    ("time_step_s", "time_step_s: .nan", "time_step_s = .nan", "must be a finite number"),
    ("horizon_s", "horizon_s: -8", "horizon_s = -8", "greater than 0"),
    ("vehicles", "vehicles: 1", "vehicles = 1", "greater than or equal to 2"),
    ("vehicles", "vehicles: 65", "vehicles = 65", "less than or equal to 64"),
    ("vehicles", "vehicles: 3.0", "vehicles = 3.0", "must be a whole number, written without a decimal point"),
    ("vehicles", "vehicles: true", "vehicles = true", "whole number"),
    ("roles", "roles: {vehicle_2: learner, vehicle_4: coast}", "roles.vehicle_4 = coast", "vehicle_1 ... vehicle_3"),
    ("roles", "roles: {vehicel_2: learner}", "roles.vehicel_2 = learner", "did you mean vehicle_2?"),
    ("roles", "roles: {vehicle_2: Learner}", "roles.vehicle_2 = Learner", "must be name or name:argument"),
    ("roles", "roles: {vehicle_2: learner:1}", "roles.vehicle_2 = learner:1", "learner takes no argument"),
    ("roles", "roles: {vehicle_2: 2}", "roles.vehicle_2 = 2", "must be text"),
    ("roles", "roles: [learner]", "roles = [learner]", "must be a mapping"),
    ("roles", "roles:", "roles = null", "must be a mapping"),
    ("roles", "roles: {vehicle_1: constant, vehicle_2: learner}", "roles.vehicle_1 = constant", "finite deceleration"),
    (
        "roles",
        "roles: {vehicle_1: constant:7, vehicle_2: learner}",
        "roles.vehicle_1 = constant:7",
        "braking_capacity_mps2, 6",
    ),
    (
        "roles",
        "roles: {vehicle_1: constant:-7, vehicle_2: learner}",
        "roles.vehicle_1 = constant:-7",
        "driving_capacity_mps2, 6",
    ),
    (
        "roles",
        "roles: {vehicle_3: e_v2x_bm, vehicle_2: learner}",
        "roles.vehicle_3 = e_v2x_bm",
        "with early_impacts: reject a script must be full_brake, coast or constant:a",
    ),
    (
        "roles",
        "roles: {vehicle_3: ful_brake, vehicle_2: learner}",
        "roles.vehicle_3 = ful_brake",
        "did you mean full_brake?",
    ),
    ("roles", "roles: {vehicle_1: constant:1_0e-1, vehicle_2: learner}", "roles.vehicle_1 = constant:1_0e-1", "finite"),
    ("gaps_m", "gaps_m: 1_0", 'gaps_m = "1_0"', "must be a number or a distribution"),
    ("early_impacts", "early_impacts: refuse", "early_impacts = refuse", "must be keep or reject"),
    ("name", "name: Bad Name", 'name = "Bad Name"', "lower case letters"),
]


@pytest.mark.parametrize(("key", "line", "place", "right"), BAD, ids=[b[1] or f"no {b[0]}" for b in BAD])
def test_bad_input__one_error_says_where_what_and_what_would_be_right(key, line, place, right):
    with pytest.raises(InvalidInput) as caught:
        build(**{key: line})
    message = str(caught.value)
    assert message.startswith("folder/bad.yaml")
    assert f": {place}: " in message
    assert right in message
    assert "\n" not in message


@pytest.mark.parametrize(("key", "line"), [(b[0], b[1]) for b in BAD if b[2].startswith(b[0]) and b[1] is not None])
def test_bad_input__names_the_line(key, line):
    with pytest.raises(InvalidInput, match=rf"^folder/bad\.yaml, line {LINE_NUMBER[key]}: "):
        build(**{key: line})


def test_several_errors__the_first_is_shown_and_the_rest_are_counted():
    with pytest.raises(InvalidInput, match=r"line 7: braking_capacity_mps2 = 0: .* \(and 2 more\)$"):
        build(braking_capacity_mps2="braking_capacity_mps2: 0", mass_t="mass_t: 0", restitution="restitution: 2")


def test_several_errors__a_misspelt_key_comes_first_and_counts_once():
    with pytest.raises(InvalidInput, match=r"line 9: mass_kg: unknown key; did you mean mass_t \(tonnes\)\?$"):
        build(mass_t="mass_kg: 5500")
    with pytest.raises(InvalidInput, match=r"line 9: mass_kg: unknown key.* \(and 1 more\)$"):
        build(mass_t="mass_kg: 5500", restitution="restitution: 2")


@pytest.mark.parametrize("text", ["", "3", "[1, 2]", "just text"])
def test_document__that_is_no_mapping(text):
    with pytest.raises(InvalidInput, match=r"x\.yaml: must be a mapping"):
        Scenario.from_document(parse_yaml(text, "x.yaml"))
