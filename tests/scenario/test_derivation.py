"""Gaps given as times and speeds given as one speed of the line: golden numbers by hand, and every reader of both."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario import Scenario, load_scenario, new_scenario_text, parse_yaml
from ethbrake_marl.scenario.sampling import uniform_numbers, values

REST = {
    "name": "given", "braking_capacity_mps2": [6, 7, 6], "driving_capacity_mps2": 6, "mass_t": 5,
    "latency_s": [0, 0.5, 0.8],
}  # fmt: skip
LINE = {"time_gaps_s": {"uniform": [0.2, 2]}, "line_speed_mps": {"uniform": [10, 38]}}
DEVIATIONS = {"speed_deviations_mps": {"uniform": [-2, 2]}}


def build(**given: object) -> Scenario:
    return Scenario(**{**REST, **given})


def test_time_gap__times_the_speed_of_the_rear_vehicle():
    worlds = build(time_gaps_s=[0.5, 2], speeds_mps=[30, 20, 10]).sample(2, 7).worlds
    assert worlds.gaps_m.tolist() == [[10.0, 20.0]] * 2  # 0.5 s x 20 m/s, 2 s x 10 m/s
    assert worlds.speeds_mps.tolist() == [[30.0, 20.0, 10.0]] * 2


def test_line_speed__plus_the_own_deviation():
    worlds = build(gaps_m=7, line_speed_mps=20, speed_deviations_mps=[1, -2, 0.5]).sample(1, 7).worlds
    assert worlds.speeds_mps.tolist() == [[21.0, 18.0, 20.5]]
    assert build(gaps_m=7, line_speed_mps=20).sample(1, 7).worlds.speeds_mps.tolist() == [[20.0, 20.0, 20.0]]


def test_both__the_time_gap_is_at_the_speed_with_its_deviation():
    scenario = build(time_gaps_s=0.5, line_speed_mps=20, speed_deviations_mps=[0, -2, 2])
    assert scenario.sample(1, 7).worlds.gaps_m.tolist() == [[9.0, 11.0]]


def test_columns__a_time_gap_has_the_number_of_its_gap_and_a_deviation_that_of_its_speed():
    scenario = build(**LINE, **DEVIATIONS)
    u = uniform_numbers(7, "list", 0, 0, 50, 24)
    line = values(scenario.quantities("line_speed_mps")[0], u[:, 15])
    for i, speed in enumerate(scenario.sample(50, 7).worlds.speeds_mps.T):
        assert (
            speed.tolist() == (line + values(scenario.quantities("speed_deviations_mps")[i], u[:, 8 * i + 1])).tolist()
        )
    worlds = scenario.sample(50, 7).worlds
    for pair, gap in enumerate(worlds.gaps_m.T):
        time_gap = values(scenario.quantities("time_gaps_s")[pair], u[:, 8 * pair])
        assert gap.tolist() == (time_gap * worlds.speeds_mps[:, pair + 1]).tolist()


def test_columns__the_other_way_to_declare_leaves_the_rest_alone():
    usual = build(gaps_m=7, speeds_mps=20, restitution={"uniform": [0, 0.3]}).replace(mass_t={"uniform": [1, 40]})
    before, after = usual.sample(20, 3).worlds, usual.replace(**LINE).sample(20, 3).worlds
    assert before.vehicles.mass_t.tobytes() == after.vehicles.mass_t.tobytes()
    assert before.vehicles.restitution.tobytes() == after.vehicles.restitution.tobytes()
    assert len(np.unique(after.speeds_mps)) == 20  # one speed per world
    assert len(np.unique(np.hstack([after.gaps_m, after.speeds_mps[:, :1], after.vehicles.mass_t]))) == 20 * 6


def test_bounds__hold_for_every_draw_and_are_reached_by_fixed_numbers():
    scenario = build(**LINE, **DEVIATIONS)
    assert scenario.bounds("speeds_mps") == ((8.0, 40.0),) * 3
    assert scenario.bounds("gaps_m") == ((1.6, 80.0),) * 2
    assert build(time_gaps_s=0.5, speeds_mps=20).bounds("gaps_m") == ((10.0, 10.0),) * 2
    assert load_scenario("paper-random").bounds("gaps_m") == ((5.0, 10.0),) * 2
    worlds = scenario.sample(2000, 7).worlds
    assert worlds.speeds_mps.min() >= 8.0
    assert worlds.speeds_mps.max() <= 40.0
    assert worlds.gaps_m.min() >= 1.6
    assert worlds.gaps_m.max() <= 80.0


def test_quantities__of_what_is_derived_is_an_error():
    with pytest.raises(InvalidInput, match=r"scenario 'given': gaps_m is not given; it is derived, see .*bounds"):
        build(**LINE).quantities("gaps_m")


BAD = [
    ({"speeds_mps": 20}, "gaps_m: missing; the bumper-to-bumper gap", "for instance gaps_m: [7, 7], or time_gaps_s"),
    ({"gaps_m": 7}, "speeds_mps: missing; the speed of each", "speeds_mps: [20, 18, 20], or line_speed_mps: 20"),
    ({"gaps_m": 7, "time_gaps_s": 1, "speeds_mps": 20}, "time_gaps_s = 1", "give either gaps_m or time_gaps_s, not bo"),
    ({"gaps_m": 7, "speeds_mps": 20, "line_speed_mps": 20}, "line_speed_mps = 20", "either speeds_mps or line_speed_m"),
    ({"gaps_m": 7, "speeds_mps": 20, "speed_deviations_mps": 0}, "speed_deviations_mps = 0", "needs line_speed_mps"),
    ({"gaps_m": 7, "speed_deviations_mps": [0, 1, 0]}, "speed_deviations_mps = [0, 1, 0]", "needs line_speed_mps"),
    ({"gaps_m": None, "time_gaps_s": 1, "speeds_mps": 20}, "gaps_m = null", "a key that is not used is left out"),
    ({"gaps_m": 7, "line_speed_mps": None}, "line_speed_mps = null", "must be a number or a distribution"),
    ({"time_gaps_s": 0, "speeds_mps": 20}, "time_gaps_s = 0", "must be finite and in (0, 60] s (seconds)"),
    ({"time_gaps_s": [1, 61], "speeds_mps": 20}, "time_gaps_s[1] (vehicle_2 to vehicle_3) = 61", "in (0, 60] s"),
    ({"time_gaps_s": -1, "speeds_mps": 20}, "time_gaps_s = -1", "a negative gap means overlapping vehicles"),
    ({"time_gaps_s": [1, 1, 1], "speeds_mps": 20}, "time_gaps_s", "has 3 entries; 3 vehicles need 2 (one per pair)"),
    (
        {"time_gaps_s": [1, 60], "speeds_mps": [20, 20, 190], "speed_limit_mps": 200},
        "time_gaps_s[1] (vehicle_2 to vehicle_3) = 60",
        "is up to 11400 m at the speed of vehicle_3; a gap must not be above 10000 m",
    ),
    ({"gaps_m": 7, "line_speed_mps": -1}, "line_speed_mps = -1", "in [0, 200] m/s"),
    ({"gaps_m": 7, "line_speed_mps": [20, 20, 20]}, "line_speed_mps = [20, 20, 20]", "must be a number, {uniform"),
    ({"gaps_m": 7, "line_speed_mps": 20, "speed_deviations_mps": -201}, "speed_deviations_mps = -201", "[-200, 200] m"),
    ({"gaps_m": 7, "line_speed_mps": 20, "speed_deviations_mps": [0, 1]}, "speed_deviations_mps", "has 2 entries"),
    (
        {"gaps_m": 7, "line_speed_mps": {"uniform": [1, 38]}, "speed_deviations_mps": [0, {"uniform": [-2, 2]}, 0]},
        "line_speed_mps = {uniform: [1, 38]}",
        "with speed_deviations_mps vehicle_2 drives -1 to 40 m/s; must be 0 to speed_limit_mps of vehicle_2, 40 m/s",
    ),
    (
        {"gaps_m": 7, "line_speed_mps": 39, "speed_deviations_mps": {"uniform": [-2, 2]}},
        "line_speed_mps = 39",
        "vehicle_1 drives 37 to 41 m/s; must be 0 to speed_limit_mps of vehicle_1, 40 m/s",
    ),
    ({"time_gap_s": 1, "speeds_mps": 20}, "time_gap_s", "did you mean time_gaps_s (seconds)?"),
    ({"time_gaps_ms": 1, "speeds_mps": 20}, "time_gaps_ms", "did you mean time_gaps_s (seconds)?"),
    ({"time_gaps_s": 1, "line_speed_kmh": 72}, "line_speed_kmh", "did you mean line_speed_mps (metres per second)?"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "place", "right"), BAD, ids=[b[1] for b in BAD])
def test_bad_input__one_error(given, place, right):
    with pytest.raises(InvalidInput) as caught:
        build(**given)
    assert str(caught.value).startswith(f"scenario 'given': {place}")
    assert right in str(caught.value)
    assert "more)" not in str(caught.value)


def test_bad_input__what_is_there_twice_has_its_line():
    text = "name: bad\ngaps_m: 7\nspeeds_mps: 20\nbraking_capacity_mps2: 6\ndriving_capacity_mps2: 6\nmass_t: 5\n"
    with pytest.raises(InvalidInput, match=r"^bad\.yaml, line 8: time_gaps_s = 1: give either gaps_m or time_gaps_s"):
        Scenario.from_document(parse_yaml(f"{text}latency_s: 0\ntime_gaps_s: 1\n", "bad.yaml"))
    with pytest.raises(InvalidInput, match=r"^bad\.yaml: gaps_m: missing; "):
        Scenario.from_document(parse_yaml(f"{text}latency_s: 0\n".replace("gaps_m: 7\n", ""), "bad.yaml"))


def test_replace__the_new_way_takes_the_place_of_the_old_one():
    scenario = build(**LINE, **DEVIATIONS)
    assert scenario.replace(gaps_m=7).bounds("gaps_m") == ((7.0, 7.0),) * 2
    assert scenario.replace(gaps_m=7).time_gaps_s is None
    assert scenario.replace(speeds_mps=20).declared().keys() & {"line_speed_mps", "speed_deviations_mps"} == set()
    assert scenario.replace(line_speed_mps=20).bounds("speeds_mps") == ((18.0, 22.0),) * 3
    assert scenario.replace(gaps_m=7, speeds_mps=20).replace(**LINE).bounds("speeds_mps") == ((10.0, 38.0),) * 3
    with pytest.raises(InvalidInput, match="give either gaps_m or time_gaps_s"):
        scenario.replace(gaps_m=7, time_gaps_s=1)
    assert Scenario(**scenario.declared()) == scenario


def test_initial_state__a_time_gap_is_at_the_given_speed():
    scenario = build(time_gaps_s=[0.5, 1], **{"line_speed_mps": 20}, **DEVIATIONS)
    assert scenario.worlds_from_state({"speeds_mps": [30, 20, 10]}).gaps_m.tolist() == [[10.0, 10.0]]
    assert scenario.worlds_from_state({"speeds_mps": 20, "gaps_m": [7, 8]}).gaps_m.tolist() == [[7.0, 8.0]]
    assert scenario.replace(speeds_mps=[0, 1, 2]).worlds_from_state({}).gaps_m.tolist() == [[0.5, 2.0]]
    with pytest.raises(
        InvalidInput, match=r"initial_state: speeds_mps\[0\] is missing, and random in scenario 'given'"
    ):
        scenario.worlds_from_state({"gaps_m": 7})
    with pytest.raises(InvalidInput, match=r"initial_state: gaps_m\[0\] is missing, and random in scenario 'given'"):
        build(**LINE).worlds_from_state({"speeds_mps": 20})
    with pytest.raises(InvalidInput, match=r"gaps_m\[1\] = 12000: must be finite and in \[0, 10000\] m"):
        state = {"speeds_mps": [20, 20, 200], "speed_limit_mps": 200}
        build(time_gaps_s=[1, 60], speeds_mps=20).worlds_from_state(state)


def test_csv__gaps_and_speeds_as_always(tmp_path):
    path = tmp_path / "worlds.csv"
    path.write_text("gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n10,8,20,18,20\n")
    worlds = build(**LINE, **DEVIATIONS).read_worlds(path)
    assert (worlds.gaps_m.tolist(), worlds.speeds_mps.tolist()) == ([[10.0, 8.0]], [[20.0, 18.0, 20.0]])


def test_early_impacts__give_larger_time_gaps():
    scenario = build(time_gaps_s=0.01, line_speed_mps=20, early_impacts="reject")
    with pytest.raises(InvalidInput, match=r"give larger time_gaps_s, a smaller latency_s"):
        scenario.sample(1, 0)


def test_new__the_keys_not_used_are_comments_that_would_be_valid():
    text = new_scenario_text("mine")
    swapped = text.replace("\ngaps_m:", "\n# gaps_m:").replace("\n# time_gaps_s:", "\ntime_gaps_s:")
    scenario = Scenario.from_document(parse_yaml(swapped))
    assert scenario.time_gaps_s == (1.0, 1.0)
    for key in ("line_speed_mps", "speed_deviations_mps"):
        swapped = swapped.replace(f"\n# {key}:", f"\n{key}:")
    line = Scenario.from_document(parse_yaml(swapped.replace("\nspeeds_mps:", "\n# speeds_mps:")))
    assert line.bounds("speeds_mps") == ((20.0, 20.0), (18.0, 18.0), (20.0, 20.0))


def test_stress_wide__has_the_stated_ranges():
    scenario = load_scenario("stress-wide")
    worlds = scenario.sample(5000, 7).worlds
    ranges = {
        "speeds_mps": (worlds.speeds_mps, 8, 40),
        "mass_t": (worlds.vehicles.mass_t, 1, 40),
        "braking_capacity_mps2": (worlds.vehicles.braking_capacity_mps2, 3, 10),
        "driving_capacity_mps2": (worlds.vehicles.driving_capacity_mps2, 3, 10),
        "latency_s": (worlds.vehicles.latency_s[:, 1:], 0, 1.5),
        "restitution": (worlds.vehicles.restitution, 0, 0.3),
        "time gaps": (worlds.gaps_m / worlds.speeds_mps[:, 1:], 0.2, 2),
    }
    for name, (drawn, low, high) in ranges.items():
        assert low - 1e-12 <= drawn.min() < low + 0.02 * (high - low), name
        assert high - 0.02 * (high - low) < drawn.max() <= high + 1e-12, name
    assert (worlds.vehicles.latency_s[:, 0] == 0.0).all()
    assert np.abs(np.diff(worlds.speeds_mps)).max() <= 4.0
    assert scenario.learners == (1,)
    slowest = worlds.vehicles.latency_s + worlds.speeds_mps / worlds.vehicles.braking_capacity_mps2
    assert slowest.max() < 1.5 + 40 / 3 < scenario.horizon_s
