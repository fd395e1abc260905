"""Worlds that are drawn, derived or given, by every key; refusals: ``worlds.txt``, ``keys.txt``; worlds: ``golden``."""

import json
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import stats

import ethbrake_marl as eb
from ethbrake_marl.agents import Team, drive, make_agent
from ethbrake_marl.evaluation import states_of, worlds_sha256
from ethbrake_marl.learning import Training
from ethbrake_marl.limits import prove
from ethbrake_marl.physics import Vehicles, Worlds
from ethbrake_marl.scenario import QUANTITY, Scenario, Task, load_scenario
from ethbrake_marl.scenario.sampling import BLOCK, Choice, LogUniform, Normal, Uniform, support, uniform_numbers, values
from ethbrake_marl.scenario.v2x import PRESETS
from ethbrake_marl.shield import ShieldedDriver, parse_uncertainty

near = pytest.approx
PAPER = eb.load_scenario("paper-random")
ALMOST_ONE = 1.0 - 2.0**-53

# ---------------------------------------------------------------- distributions


def normal(mean: float, sd: float, low: float, high: float) -> Normal:
    return Normal.model_validate({"normal": {"mean": mean, "sd": sd, "low": low, "high": high}})


@pytest.mark.parametrize(
    ("quantity", "u", "drawn", "bounds"),
    [
        (3.5, [0.0, 0.3, 0.9], [3.5, 3.5, 3.5], (3.5, 3.5)),
        (Uniform(uniform=(5.0, 10.0)), [0.0, 0.2, 0.5], [5.0, 6.0, 7.5], (5.0, 10.0)),
        (LogUniform(loguniform=(1.0, 16.0)), [0.0, 0.25, 0.5], near([1.0, 2.0, 4.0], rel=1e-15), (1.0, 16.0)),
        (normal(20.0, 1.0, 18.0, 22.0), [0.5], [20.0], (18.0, 22.0)),
        (Choice(choice=(6, 8, 7)), [0.0, 0.33, 0.34, 0.66, 0.67, ALMOST_ONE], [6, 6, 8, 8, 7, 7], (6.0, 8.0)),
        (
            Choice(choice=(1, 2, 3), weights=(1, 2, 1)),
            [0.0, 0.249, 0.25, 0.749, 0.75, ALMOST_ONE],
            [1, 1, 2, 2, 3, 3],
            (1.0, 3.0),
        ),
    ],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_distribution__by_hand(quantity: Any, u: list[float], drawn: Any, bounds: tuple[float, float]) -> None:
    assert values(quantity, np.array(u)).tolist() == drawn and support(quantity) == bounds


@given(st.floats(0, 1e4), st.floats(0, 1e4), st.lists(st.floats(1e-6, 1e6), min_size=1, max_size=9))
def test_distribution__is_never_outside_its_bounds(a: float, b: float, weights: list[float]) -> None:
    low, high = sorted((a, b))
    drawn = Uniform(uniform=(low, high)).value(np.array([0.0, 0.1, 0.7, ALMOST_ONE]))
    assert ((drawn >= low) & (drawn <= high)).all()
    logarithmic = LogUniform(loguniform=(low + 0.2, high + 0.2)).value(np.array([0.0, 0.4, ALMOST_ONE]))
    assert ((logarithmic >= low + 0.2) & (logarithmic <= high + 0.2)).all()
    last = Choice(choice=tuple(float(k) for k in range(len(weights))), weights=tuple(weights))
    assert last.value(np.array([ALMOST_ONE]))[0] == len(weights) - 1


@pytest.mark.parametrize("shape", [(20.0, 1.0, 18.0, 22.0), (0.97, 0.26, 0.3, 3.0), (5.0, 2.0, 9.0, 11.0)])
def test_normal__has_the_quantiles_of_the_truncated_normal(shape: tuple[float, float, float, float]) -> None:
    mean, sd, low, high = shape
    u = (np.arange(0, 200_000, 50) + 0.5) / 200_000
    other = stats.truncnorm((low - mean) / sd, (high - mean) / sd, mean, sd)
    assert np.allclose(normal(*shape).value(u), other.ppf(u), rtol=1e-9, atol=1e-9)
    tail = normal(0.0, 1.0, 4.0, 30.0).value(np.array([0.0, 0.5, 0.999999, ALMOST_ONE]))
    assert np.all((tail >= 4.0) & (tail <= 30.0)) and np.all(np.diff(tail) > 0.0)


# ---------------------------------------------------------------- worlds and their numbers

ALL_RANDOM = eb.Scenario(
    name="all-random",
    gaps_m={"uniform": [5, 10]},
    speeds_mps={"normal": {"mean": 20, "sd": 1, "low": 18, "high": 22}},
    braking_capacity_mps2={"uniform": [5, 9]},
    driving_capacity_mps2={"choice": [2, 3, 4], "weights": [0.2, 0.3, 0.5]},
    mass_t={"uniform": [1, 6]},
    latency_s={"uniform": [0, 1]},
    speed_limit_mps={"uniform": [30, 40]},
    restitution={"uniform": [0, 0.3]},
    obstacle_gap_m={"uniform": [10, 45]},
)
MIXED, DELAYS = eb.load_scenario("realistic-mixed"), eb.load_scenario("mixture-delays")


def closing_pair(gap_m: object, **changes: Any) -> eb.Scenario:
    """Two vehicles at 20 m/s; the front one brakes at 6 m/s2, the rear one may act at 1 s: 3 m closer by then."""
    usual = {"gaps_m": gap_m, "braking_capacity_mps2": 6, "latency_s": [0, 1], "early_impacts": "reject"}
    return build(**{"name": "closing-pair", "vehicles": 2, "speeds_mps": 20, **usual, **changes})


def build(**given: Any) -> eb.Scenario:
    rest = {"braking_capacity_mps2": [6, 7, 6], "driving_capacity_mps2": 6, "mass_t": 5, "latency_s": [0, 0.5, 0.8]}
    return eb.Scenario(**{"name": "given", **rest, **given})


def quantity(worlds: eb.Worlds, field: str) -> np.ndarray:
    return getattr(worlds, field) if hasattr(worlds, field) else getattr(worlds.vehicles, field)


def bits(worlds: eb.Worlds) -> dict[str, bytes]:
    return {field.name: quantity(worlds, field.name).tobytes() for field in [*fields(eb.Worlds)[1:], *fields(Vehicles)]}


def test_uniform_numbers__are_those_of_numpys_own_generator() -> None:
    key = np.random.SeedSequence([7], spawn_key=(0, 0)).generate_state(2, np.uint64)
    expected = np.random.Generator(np.random.Philox(key=key)).random(5 * 24).reshape(5, 24)
    assert uniform_numbers(7, "list", 0, 0, 5, 24).tolist() == expected.tolist()
    assert uniform_numbers(7, "list", 0, 3, 2, 24).tolist() == expected[3:].tolist()


NEWS = [PAPER.replace(name=preset, v2x=preset, early_impacts="keep") for preset in PRESETS]


@pytest.mark.parametrize(
    "scenario",
    [ALL_RANDOM, closing_pair({"uniform": [1, 5]}), MIXED, DELAYS, *NEWS],
    ids=lambda scenario: scenario.name,
)
def test_world_k__is_the_same_alone_and_in_any_list(scenario: eb.Scenario) -> None:
    whole = scenario.sample(40, 11)
    assert whole.index.tolist() == list(range(40))
    for first, n in (*((k, 1) for k in range(40)), (20, 15)):
        part, rows = scenario.sample(n, 11, first=first), np.arange(first, first + n)
        assert bits(part.worlds) == bits(whole.worlds.take(rows)) and part.index.tolist() == rows.tolist()
        assert all(part.kinds[name].tolist() == kinds[rows].tolist() for name, kinds in whole.kinds.items())
    other, training = scenario.sample(40, 12), scenario.sample(40, 11, channel="training")
    for name, kinds in whole.kinds.items():
        assert (other.kinds[name] != kinds).any() and (training.kinds[name] != kinds).any()


def test_world_k__far_down_the_list_and_of_any_whole_seed() -> None:
    far = ALL_RANDOM.sample(3, 0, first=10**15)
    assert far.index.tolist() == [10**15, 10**15 + 1, 10**15 + 2]
    assert bits(ALL_RANDOM.sample(1, 0, first=10**15 + 2).worlds) == bits(far.worlds.take([2]))
    assert bits(ALL_RANDOM.sample(2, np.uint64(5)).worlds) == bits(ALL_RANDOM.sample(np.int64(2), 5).worlds)
    assert ALL_RANDOM.sample(1, 2**200).worlds.n == 1


def test_columns__every_entry_of_a_world_has_its_own() -> None:
    rules = [*QUANTITY.usual.values(), QUANTITY.otherwise["line_speed_mps"]]
    streams, places = zip(*(rule.place(index) for rule in rules for index in range(rule.count(64))), strict=True)
    assert set(streams) == {()}
    assert len(set(places)) == len(places) and max(places) < BLOCK * 64 and BLOCK % 4 == 0
    for_all = {"braking_capacity_mps2": 6, "driving_capacity_mps2": 6, "mass_t": 5, "latency_s": 0.5}
    worlds = PAPER.replace(vehicles=5, roles={"vehicle_2": "learner"}, **for_all).sample(7, 1).worlds
    assert len(np.unique(worlds.speeds_mps)) == 35  # one entry for all: each vehicle draws its own value
    assert worlds.gaps_m.shape == (7, 4)


# ---------------------------------------------------------------- early impacts


def test_early_impacts__are_drawn_again_and_counted() -> None:
    scenario = closing_pair({"uniform": [1, 5]})
    sample = scenario.sample(4000, 5)
    assert sample.worlds.gaps_m.min() > 3.0  # half of all draws: about one refusal per world (its variance is 2)
    assert abs(sample.rejected - 4000) < 5.0 * np.sqrt(2.0 * 4000)
    parts = [scenario.sample(1, 5, first=k) for k in range(100)] + [scenario.sample(3900, 5, first=100)]
    assert sample.rejected == sum(part.rejected for part in parts)
    kept = scenario.replace(early_impacts="keep").sample(200, 5)
    late = kept.worlds.gaps_m[:, 0] > 3.0  # accepted draws are what they are where all are kept
    assert kept.rejected == 0 and 50 < late.sum() < 150
    assert bits(sample.worlds.take(np.flatnonzero(late))) == bits(kept.worlds.take(late))


@pytest.mark.parametrize(
    ("gap_m", "changes"),
    [
        (3.001, {}),  # an impact at 3 m, just when the learner may act, is early: see the list of refusals
        (0.5, {"roles": {"vehicle_1": "coast", "vehicle_2": "learner"}}),  # nothing closes
        (1.001, {"roles": {"vehicle_1": "constant:2", "vehicle_2": "learner"}}),  # 1 m closer within 1 s
        # Braking with 6 m/s2, 2 m are gone after 0.816 s: after vehicle_2 may act, before vehicle_3 may.
        (2, {"vehicles": 3, "latency_s": [0, 0.5, 1], "roles": {"vehicle_2": "learner", "vehicle_3": "learner"}}),
    ],
)
def test_early_impacts__scripts_are_followed_learners_coast_and_the_first_one_counts(
    gap_m: float, changes: dict[str, Any]
) -> None:
    assert closing_pair(gap_m, **changes).sample(1, 0).rejected == 0


# ---------------------------------------------------------------- gaps as times, speeds of the line, an obstacle ahead

LINE = {"time_gaps_s": {"uniform": [0.2, 2]}, "line_speed_mps": {"uniform": [10, 38]}}
DEVIATIONS = {"speed_deviations_mps": {"uniform": [-2, 2]}}


@pytest.mark.parametrize(
    ("given", "gaps", "speeds"),
    [
        ({"time_gaps_s": [0.5, 2], "speeds_mps": [30, 20, 10]}, [10, 20], [30, 20, 10]),  # 0.5 s x 20, 2 s x 10 m/s
        ({"gaps_m": 7, "line_speed_mps": 20, "speed_deviations_mps": [1, -2, 0.5]}, [7, 7], [21, 18, 20.5]),
        ({"gaps_m": 7, "line_speed_mps": 20}, [7, 7], [20, 20, 20]),
        ({"time_gaps_s": 0.5, "line_speed_mps": 20, "speed_deviations_mps": [0, -2, 2]}, [9, 11], [20, 18, 22]),
    ],
)
def test_derived__by_hand(given: dict[str, Any], gaps: list[float], speeds: list[float]) -> None:
    worlds = build(**given).sample(2, 7).worlds
    assert (worlds.gaps_m.tolist(), worlds.speeds_mps.tolist()) == ([gaps] * 2, [speeds] * 2)


def test_bounds__hold_for_every_draw_and_are_reached_by_fixed_numbers() -> None:
    scenario = build(**LINE, **DEVIATIONS)
    assert (scenario.bounds("speeds_mps"), scenario.bounds("gaps_m")) == (((8.0, 40.0),) * 3, ((1.6, 80.0),) * 2)
    assert build(time_gaps_s=0.5, speeds_mps=20).bounds("gaps_m") == ((10.0, 10.0),) * 2
    assert PAPER.bounds("gaps_m") == ((5.0, 10.0),) * 2
    worlds = scenario.sample(2000, 7).worlds
    assert 8.0 <= worlds.speeds_mps.min() < worlds.speeds_mps.max() <= 40.0
    assert 1.6 <= worlds.gaps_m.min() < worlds.gaps_m.max() <= 80.0


def test_replace__the_new_way_takes_the_place_of_the_old_one() -> None:
    scenario = build(**LINE, **DEVIATIONS)
    assert scenario.replace(gaps_m=7).bounds("gaps_m") == ((7.0, 7.0),) * 2
    assert scenario.replace(gaps_m=7).time_gaps_s is None
    assert scenario.replace(speeds_mps=20).declared().keys() & {"line_speed_mps", "speed_deviations_mps"} == set()
    assert scenario.replace(line_speed_mps=20).bounds("speeds_mps") == ((18.0, 22.0),) * 3
    assert scenario.replace(gaps_m=7, speeds_mps=20).replace(**LINE).bounds("speeds_mps") == ((10.0, 38.0),) * 3
    assert eb.Scenario(**scenario.declared()) == scenario
    margin = build(gaps_m=7, speeds_mps=20, obstacle_margin_m=1.5)
    assert margin.replace(obstacle_gap_m=42).obstacle_margin_m is None
    assert margin.replace(obstacle_gap_m=42).replace(obstacle_margin_m=1).obstacle_gap_m is None


def ahead(**given: Any) -> eb.Scenario:
    """An obstacle ahead of Vehicle 1, which may brake with 5 m/s2 after 0.5 s: from 20 m/s it stops after 50 m."""
    usual = {"gaps_m": 7, "speeds_mps": [20, 18, 20], "braking_capacity_mps2": [5, 7, 6], "latency_s": [0.5, 0.5, 0.8]}
    return build(**{**usual, **given})


def test_margin__is_added_to_the_way_to_standstill_and_has_the_random_number_of_the_distance() -> None:
    drawn = {"speeds_mps": {"uniform": [18, 22]}, "braking_capacity_mps2": {"uniform": [5, 7]}}
    worlds = ahead(obstacle_margin_m={"uniform": [1, 2]}, **drawn).sample(200, 7).worlds
    speed, capacity = worlds.speeds_mps[:, 0], worlds.vehicles.braking_capacity_mps2[:, 0]
    margin = worlds.obstacle_gap_m - speed * 0.5 - speed**2 / (2 * capacity)
    far = ahead(obstacle_gap_m={"uniform": [51, 52]}, **drawn).sample(200, 7).worlds.obstacle_gap_m
    assert margin == near(far - 50.0, abs=1e-12) and np.ptp(margin) > 0.9


def test_margin__is_an_obstacle_for_everybody() -> None:
    scenario = ahead(obstacle_margin_m=1.5)
    assert scenario.sample(2, 7).worlds.obstacle_gap_m.tolist() == [51.5] * 2
    assert [each.has_obstacle for each in (scenario, ahead(obstacle_gap_m=42), ahead())] == [True, True, False]
    assert scenario.with_learners(["vehicle_1"]).learners == (0,) and eb.observation_for(scenario).obstacle


# ---------------------------------------------------------------- worlds that are given

HEADER = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps"
FULL = {key: 6 for key in QUANTITY.usual} | {"gaps_m": 7, "latency_s": 0, "restitution": 0, "obstacle_gap_m": 30}


def read(folder: Path, text: str, scenario: eb.Scenario = PAPER) -> eb.Worlds:
    (folder / "worlds.csv").write_text(text, encoding="utf-8")
    return scenario.read_worlds(folder / "worlds.csv")


def test_csv__gives_the_state_and_the_scenario_the_rest(tmp_path: Path) -> None:
    for scenario in (PAPER, build(**LINE, **DEVIATIONS, restitution=0.1, mass_t=[4.5, 5.5, 5.9])):
        worlds = read(tmp_path, f"{HEADER}\n10,8,20,18,20\n5,9,22,1.8e1, 20\n", scenario)
        assert worlds.gaps_m.tolist() == [[10.0, 8.0], [5.0, 9.0]]
        assert worlds.speeds_mps.tolist() == [[20.0, 18.0, 20.0], [22.0, 18.0, 20.0]]
        assert worlds.vehicles.latency_s.tolist() == [[0.0, 0.5, 0.8]] * 2
        assert worlds.vehicles.braking_capacity_mps2.tolist() == [[6.0, 7.0, 6.0]] * 2
        assert worlds.vehicles.restitution.tolist() == [0.1, 0.1]


def test_csv__optional_columns_in_any_order_with_a_byte_order_mark(tmp_path: Path) -> None:
    text = f"\ufefflatency_2_s,restitution,mass_3_t,speed_limit_1_mps,{HEADER}\n0.2,0.3,6,30,10,8,20,18,20\n"
    vehicles = read(tmp_path, text, PAPER.replace(mass_t=[4.5, 5.5, {"uniform": [5, 6]}])).vehicles
    assert (vehicles.latency_s.tolist(), vehicles.restitution.tolist()) == ([[0.0, 0.2, 0.8]], [0.3])
    assert vehicles.mass_t.tolist() == [[4.5, 5.5, 6.0]] and vehicles.speed_limit_mps.tolist() == [[30.0, 40.0, 40.0]]


@pytest.mark.parametrize("end", ["", "\n", "\n\n", "\r\n\r\n"])
def test_csv__blank_lines_at_the_end_are_nothing(tmp_path: Path, end: str) -> None:
    assert read(tmp_path, f"{HEADER}\n10,8,20,18,20{end}").n == 1


def test_table__equals_the_same_worlds_sampled() -> None:
    sampled = PAPER.sample(50, 3).worlds
    columns = {f"gap_{i + 1}_m": sampled.gaps_m[:, i] for i in range(2)}
    columns |= {f"speed_{i + 1}_mps": sampled.speeds_mps[:, i] for i in range(3)}
    assert bits(PAPER.worlds_from_table(columns)) == bits(sampled)
    names = list(closing_pair(7).table_columns)
    assert names[:4] == ["gap_1_m", "speed_1_mps", "speed_2_mps", "braking_capacity_1_mps2"]
    assert len(names) == 1 + 6 * 2 + 1
    table = {f"gap_{p}_m": [7, 7] for p in (1, 2)} | {f"speed_{i}_mps": [10, 20] for i in (1, 2, 3)}
    assert ahead(obstacle_margin_m=1.5).worlds_from_table(table).obstacle_gap_m.tolist() == [5 + 10 + 1.5, 51.5]
    given = ahead(obstacle_margin_m=1.5).worlds_from_table({**table, "obstacle_gap_m": [30, 31]})
    assert given.obstacle_gap_m.tolist() == [30, 31]


@pytest.mark.parametrize(
    ("scenario", "state", "told"),
    [
        (PAPER, {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}, {"gaps_m": [7, 7], "restitution": 0.1}),
        (PAPER, {"gaps_m": 7, "speeds_mps": np.full(3, 20), "restitution": 0.0}, {"restitution": 0, "gaps_m": [7, 7]}),
        (eb.load_scenario("paper-scenario-1"), {}, {"gaps_m": [10, 8], "speeds_mps": [20, 18, 20]}),
        (build(time_gaps_s=[0.5, 1], line_speed_mps=20), {"speeds_mps": [30, 20, 10]}, {"gaps_m": [10, 10]}),
        (build(time_gaps_s=[0.5, 1], line_speed_mps=20), {"speeds_mps": 20, "gaps_m": [7, 8]}, {"gaps_m": [7, 8]}),
        (build(time_gaps_s=[0.5, 1], speeds_mps=[0, 1, 2]), {}, {"gaps_m": [0.5, 2]}),
        (
            ahead(obstacle_margin_m=1.5),
            {"gaps_m": 7, "speeds_mps": 20, "latency_s": 0, "braking_capacity_mps2": 4},
            {"obstacle_gap_m": 51.5, "braking_capacity_mps2": [4, 4, 4]},
        ),
        (build(gaps_m=7, speeds_mps=20, obstacle_gap_m=42), {}, {"obstacle_gap_m": 42}),
        (
            ALL_RANDOM,
            {**FULL, "speed_limit_mps": 40, "obstacle_gap_m": 30},
            {"obstacle_gap_m": 30, "braking_capacity_mps2": [6, 6, 6]},
        ),
    ],
)
def test_initial_state__the_scenario_fills_in_fixed_fields(
    scenario: eb.Scenario, state: dict[str, Any], told: dict[str, Any]
) -> None:
    worlds = scenario.worlds_from_state(state)
    usual = {} if "braking_capacity_mps2" in told else {"braking_capacity_mps2": [6, 7, 6]}
    assert worlds.n == 1 and {name: quantity(worlds, name)[0].tolist() for name in told | usual} == told | usual


# ---------------------------------------------------------------- types of vehicles

KINDS = {
    "car": {"weight": 3, "mass_t": {"uniform": [1, 2]}, "braking_capacity_mps2": {"normal": {
        "mean": 8, "sd": 1, "low": 6, "high": 10}}},
    "truck": {"mass_t": {"with_load": [14, 40]}, "braking_capacity_mps2": {"with_load": [7, 4]}},
}  # fmt: skip
N = 20_000


def typed(**given: Any) -> eb.Scenario:
    rest = {"gaps_m": 30, "speeds_mps": 20, "driving_capacity_mps2": 3, "latency_s": 0.2}
    return eb.Scenario(**{"name": "typed", **rest, "vehicle_types": KINDS, **given})


def test_types__of_each_place() -> None:
    scenario = typed(types=["truck", {"car": 1, "truck": 9}, "any"])
    counts = (scenario.sample(N, 1).types == "truck").sum(axis=0)
    assert counts[0] == N
    assert [stats.binomtest(counts[i], N, p).pvalue > 0.001 for i, p in ((1, 0.9), (2, 0.25))] == [True, True]
    assert scenario.bounds("mass_t") == ((14.0, 40.0), (1.0, 40.0), (1.0, 40.0))
    roles = {"vehicle_1": "constant:5", "vehicle_2": "learner"}  # within the capacity of every type of its place
    assert typed(roles=roles, types=["car", "any", "any"]).scripts[0] == "constant:5"


def test_type__is_the_first_number_of_its_own_stream() -> None:
    u = uniform_numbers(7, "list", 0, 0, 100, 12, of=(3,)).reshape(100, 3, 4)
    assert (typed().sample(100, 7).types == np.where(u[..., 0] < 0.75, "car", "truck")).all()
    assert typed(types="truck").sample(50, 1).types.tolist() == [["truck"] * 3] * 50


def test_quantities__follow_the_distribution_of_their_type() -> None:
    sample = typed().sample(N, 3)
    car, truck = (sample.types == name for name in ("car", "truck"))
    mass, braking = sample.worlds.vehicles.mass_t, sample.worlds.vehicles.braking_capacity_mps2
    assert stats.kstest(braking[car], stats.truncnorm(-2, 2, loc=8, scale=1).cdf).pvalue > 0.001
    assert abs(stats.pearsonr(mass[car], braking[car]).statistic) < 0.02  # a car's are drawn apart
    load = (mass[truck] - 14.0) / 26.0  # a truck's go together
    np.testing.assert_allclose(braking[truck], 7.0 - 3.0 * load, rtol=1e-12)
    assert stats.kstest(load, stats.uniform().cdf).pvalue > 0.001
    kinds = {"van": {"mass_t": {"with_load": [2, 4]}, "braking_capacity_mps2": 6, "load": {"choice": [0, 0.5]}}}
    assert set(np.unique(typed(vehicle_types=kinds).sample(1_000, 1).worlds.vehicles.mass_t)) == {2.0, 3.0}


def test_types__leave_all_other_draws_alone_and_what_they_leave_out_stands_beside_them() -> None:
    given = {"gaps_m": {"uniform": [5, 50]}, "speeds_mps": {"uniform": [10, 20]}, "latency_s": 0.2, "mass_t": 2}
    plain = build(**given, driving_capacity_mps2={"uniform": [1, 3]}, braking_capacity_mps2={"uniform": [5, 9]})
    buses = plain.replace(vehicle_types={"car": {}, "bus": {"mass_t": 12}})
    one, other = (scenario.sample(500, 7).worlds for scenario in (plain, buses))
    assert bits(replace(one, vehicles=replace(one.vehicles, mass_t=other.vehicles.mass_t))) == bits(other)
    assert set(np.unique(other.vehicles.mass_t)) == {2.0, 12.0}
    brakes = typed(vehicle_types={"car": {"braking_capacity_mps2": 7}}, mass_t=[1, 2, 3])
    assert brakes.sample(5, 7).worlds.vehicles.mass_t.tolist() == [[1.0, 2.0, 3.0]] * 5


def test_types__of_refused_worlds_are_drawn_again() -> None:
    late = {"latency_s": [0, 0.5, 0.8], "early_impacts": "reject"}
    sample = typed(gaps_m={"uniform": [0.1, 4]}, speeds_mps=[15, 20, 20], **late).sample(300, 7)
    assert sample.rejected > 0 and sample.index.tolist() == list(range(300))
    assert ((sample.worlds.vehicles.mass_t >= 14.0) == (sample.types == "truck")).all()


# ---------------------------------------------------------------- mixtures

MEMBERS = ("paper-delay-low", "paper-delay-middle", "paper-delay-high")


def mixed(*members: str, **beside: object) -> eb.Scenario:
    return eb.load_scenario({"name": "mixed", "mixture": [{"scenario": name} for name in members], **beside})


@pytest.mark.parametrize("channel", ["list", "training"])
@pytest.mark.parametrize(
    "mixture",
    [
        DELAYS,
        mixed("paper-random", "stress-wide", horizon_s=16),  # with early impacts
        mixed("realistic-mixed", "realistic-truck"),  # with types
        mixed("cooperation-3-pair", "cooperation-3-congested"),  # with a channel in one
    ],
    ids=range(4),
)
def test_mixture__world_k_is_that_of_its_member(mixture: eb.Scenario, channel: Any) -> None:
    sample = mixture.sample(300, 7, channel=channel)
    assert set(sample.scenarios) == {member.name for member in mixture.members}
    for member in mixture.members:
        own = eb.load_scenario(member.name).sample(300, 7, channel=channel)
        rows = np.flatnonzero(sample.scenarios == member.name)
        told = sample.worlds.take(rows), own.worlds.take(rows)
        assert worlds_sha256(told[0], rows) == worlds_sha256(told[1], rows)
        assert (told[0].vehicles.known_from_s == told[1].vehicles.known_from_s).all()
        if sample.types is not None:
            assert (sample.types[rows] == ("" if own.types is None else own.types[rows])).all()


def test_mixture__with_a_channel_and_without_is_one_batch() -> None:
    mixture = mixed("cooperation-3-pair", "cooperation-3-congested")
    env = eb.parallel_env(scenario=mixture)
    seen = {env.reset(seed=seed)[1]["vehicle_2"]["known_from_s"].shape for seed in range(6)}
    assert mixture.by_link and seen == {(3,)}


def test_mixture__what_stands_beside_holds_for_every_member() -> None:
    heavy = DELAYS.replace(mass_t=[40, 1, 1])
    assert heavy.bounds("mass_t")[0] == (40.0, 40.0)
    assert (heavy.sample(20, 7).worlds.vehicles.mass_t[:, 0] == 40.0).all()
    assert (heavy.sample(20, 7).worlds.gaps_m == DELAYS.sample(20, 7).worlds.gaps_m).all()
    assert DELAYS.bounds("latency_s") == ((0.0, 0.0), (0.1, 0.8), (0.3, 1.2))
    third = DELAYS.with_learners(["vehicle_3"])
    assert [each.learners for each in (third, *third.members)] == [(2,)] * 4
    assert Training.of("ppo", DELAYS).identity != Training.of("ppo", heavy).identity
    assert "1 x paper-delay-low, 1 x paper-delay-middle, 1 x paper-delay-high" in DELAYS._repr_html_()


def test_mixture__its_file_may_name_a_file_beside_it_and_its_members_may_be_written_out(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(json.dumps(PAPER.replace(name="own", title="").declared()))
    (tmp_path / "mine.yaml").write_text("name: mine\nmixture: [{scenario: own.yaml}, {scenario: paper-random-early}]\n")
    assert [each.name for each in eb.load_scenario(tmp_path / "mine.yaml").members] == ["own", "paper-random-early"]
    line = "gaps_m: 7, speeds_mps: 20, braking_capacity_mps2: 9, driving_capacity_mps2: 5, latency_s: 0.5, mass_t: 1"
    text = f"name: mine\nvehicles: 5\nmixture:\n  - scenario: {{name: a, {line}}}\n  - scenario: {{name: b, {line}}}\n"
    (tmp_path / "mine.yaml").write_text(text)
    assert [member.vehicles for member in eb.load_scenario(tmp_path / "mine.yaml").members] == [5, 5]
    assert eb.Scenario(name="x", mixture=[{"scenario": PAPER}]).vehicles == 3


def test_results__tell_scenario_and_types_agree_with_the_members_and_can_be_grouped() -> None:
    agents = {"full_brake": eb.make_agent("full_brake"), "e_v2x_bm": eb.make_agent("e_v2x_bm")}
    sample = DELAYS.sample(120, 7)
    found = eb.evaluate(sample, agents, scenario=DELAYS, seed=7)
    assert found.to_frame("columns")["scenario"].tolist() == sample.scenarios.tolist() * 2
    groups = eb.summarise_by(found, "scenario")
    for name in MEMBERS:
        member, rows = eb.load_scenario(name), np.flatnonzero(sample.scenarios == name)
        own = eb.evaluate(member.sample(120, 7).take(rows), agents, scenario=member, seed=7)
        assert (own.outcome("e_v2x_bm").total_harm == found.outcome("e_v2x_bm").total_harm[rows]).all()
        assert [row.total_harm for row in groups[name]] == [row.total_harm for row in eb.summarise(own)]
    sample = MIXED.sample(200, 7)
    found = eb.evaluate(sample, {"full_brake": eb.make_agent("full_brake")}, scenario=MIXED, seed=7)
    assert found.to_frame("columns")["vehicle_3_type"].tolist() == sample.types[:, 2].tolist()
    groups = eb.summarise_by(found, "vehicle_3_type")
    assert list(groups) == ["car", "truck", "van"]
    told = [(row.episodes, row.collisions) for (row,) in groups.values()]
    assert np.sum(told, axis=0).tolist() == [200, eb.summarise(found)[0].collisions]


def test_shields_and_searches__take_a_mixture() -> None:
    agents = {name: eb.make_agent(name, scenario=DELAYS) for name in ("full_brake+step", "constant:3+episode")}
    plain = eb.evaluate(DELAYS.sample(20, 7), {"b": eb.make_agent("full_brake")}, scenario=DELAYS).outcome("b")
    shielded = eb.evaluate(DELAYS.sample(20, 7), agents, scenario=DELAYS).outcome("full_brake+step")
    assert (shielded.first_impact_harm <= plain.first_impact_harm + 1e-9).all()


# ---------------------------------------------------------------- keys as engineers think of them, outcomes by hand

FIXED = PAPER.replace(gaps_m=40, speeds_mps=20, latency_s=0, early_impacts="keep", horizon_s=30)
TABLE = {"columns": ["gap_1_m", "speed_2_mps"], "rows": [[5.0, 18.0], [6.0, 19.0], [7.0, 20.0]]}


def final(scenario: Scenario, worlds: Worlds | None = None) -> Worlds:
    """The worlds once everybody has braked fully, or as its script says."""
    worlds = scenario.sample(1, 7).worlds if worlds is None else worlds
    return drive(worlds, Team.of(make_agent("full_brake"), list(scenario.learners)), scenario).final


# Friction: stopping ways are v^2 / (2 min(capacity, 9.81 mu)).


@pytest.mark.parametrize(
    ("friction", "capacity", "gaps"),
    [
        # 4 < 5.886 < 7: 50, 33.979, 33.979 m
        (0.6, [4.0, 7.0, 7.0], [40 + 50 - 400 / 11.772, 40.0]),
        # all 2.943: the same way of 67.96 m for all
        (0.3, [4.0, 7.0, 7.0], [40.0, 40.0]),
        # dry enough: 50, 28.571, 33.333 m
        (1.0, [4.0, 7.0, 6.0], [40 + 50 - 400 / 14, 40 + 400 / 14 - 400 / 12]),
    ],
)
def test_friction__gaps_at_rest_by_hand(friction: float, capacity: list[float], gaps: list[float]) -> None:
    found = final(FIXED.replace(friction=friction, braking_capacity_mps2=capacity))
    assert found.gaps_m[0] == pytest.approx(gaps, abs=1e-9)


def test_friction__is_one_number_for_the_whole_line_and_moves_nothing_else() -> None:
    wet = PAPER.replace(friction={"uniform": [0.2, 0.9]}, early_impacts="keep")
    worlds, dry = wet.sample(200, 7).worlds, PAPER.replace(early_impacts="keep").sample(200, 7).worlds
    friction = worlds.friction
    assert 0.2 <= friction.min() < 0.22 and 0.88 < friction.max() <= 0.9
    for name in ("braking_capacity_mps2", "driving_capacity_mps2"):
        own = getattr(dry.vehicles, name)
        assert (getattr(worlds.vehicles, name) == np.minimum(own, 9.81 * friction[:, np.newaxis])).all()
        assert (worlds.dry(name) == own).all()
    assert all((getattr(worlds, name) == getattr(dry, name)).all() for name in ("gaps_m", "speeds_mps"))
    assert wet.bounds("braking_capacity_mps2") == ((9.81 * 0.2, 6.0), (9.81 * 0.2, 7.0), (9.81 * 0.2, 6.0))
    assert wet.bounds("braking_capacity_mps2", dry=True) == ((6.0, 6.0), (7.0, 7.0), (6.0, 6.0))
    assert wet.ranges().names[-1] == "friction"


def test_friction__of_a_margin() -> None:
    short = FIXED.replace(friction=0.3, obstacle_margin_m=1.7)
    assert short.sample(1, 7).worlds.obstacle_gap_m[0] == pytest.approx(1.7 + 400 / (2 * 2.943), abs=1e-9)
    assert short.farthest_obstacle_m == pytest.approx(1.7 + 400 / (2 * 2.943), abs=1e-9)


def test_friction__a_table_of_initial_states_gives_the_same_worlds() -> None:
    wet = PAPER.replace(friction={"uniform": [0.2, 0.9]}, braking_capacity_mps2={"uniform": [3, 9]})
    worlds = wet.sample(50, 3).worlds
    states = states_of(worlds, wet)
    assert list(states[0])[-1] == "friction" and "braking_capacity_2_mps2" in states[0]
    again = wet.worlds_from_table({name: [state[name] for state in states] for name in states[0]})
    assert (again.road == worlds.road).all()
    assert (again.vehicles.braking_capacity_mps2 == worlds.vehicles.braking_capacity_mps2).all()
    state = {"friction": 0.5, "gaps_m": 7, "speeds_mps": 20, "braking_capacity_mps2": 6}
    assert wet.worlds_from_state(state).friction.tolist() == [0.5]


def test_friction__its_uncertainty_moves_all_capacities_together() -> None:
    worlds = FIXED.replace(friction=0.6, braking_capacity_mps2=[4, 7, 9]).sample(1, 7).worlds
    members = parse_uncertainty("friction=0.2,braking_capacity_mps2.vehicle_3=3").members(worlds)
    shares, dry = [0, 0.125, 0.25, 0.375, 0.625, 0.75, 0.875, 1], ([4, 7, 6], [4, 7, 12])
    expected = [[4, 5.886, 5.886]] + [np.minimum(d, 9.81 * (0.4 + 0.4 * share)) for d in dry for share in shares]
    assert members.vehicles.braking_capacity_mps2 == pytest.approx(np.array(expected), abs=1e-12)


def test_friction__of_some_members_of_a_mixture() -> None:
    wet = PAPER.replace(name="wet", friction=0.4).declared()
    mixed = Scenario(name="road", mixture=[{"scenario": PAPER}, {"scenario": wet}])
    worlds = mixed.sample(40, 7).worlds
    assert set(worlds.friction.tolist()) == {0.4, math.inf}
    braking = worlds.vehicles.braking_capacity_mps2
    assert set(braking[:, 1].tolist()) == {7.0, 9.81 * 0.4}
    told = QUANTITY.columns(worlds)  # no friction is told for all: then the capacities are what the road allows
    assert "friction" not in told and (told["braking_capacity_2_mps2"] == braking[:, 1]).all()
    assert [state["braking_capacity_2_mps2"] for state in states_of(worlds, mixed)] == braking[:, 1].tolist()


def test_friction__the_proof_reads_what_the_road_allows() -> None:
    near = FIXED.replace(gaps_m=30, braking_capacity_mps2=[9, 7, 6], latency_s=[0, 0.5, 0.8])
    proofs = {mu: prove(near.replace(friction=mu).sample(1, 7).worlds, Task(near, (1,))) for mu in (0.3, 1.0)}
    assert proofs[0.3].avoidable.tolist() == [True] == proofs[1.0].avoidable.tolist()
    apart = FIXED.replace(gaps_m=[4, 40], latency_s=[0, 0.5, 0.5])  # 20 x 0.5 = 10 m are lost where all brake alike
    assert final(apart.replace(friction=0.3)).pair_hit[0].tolist() == [True, False]


def test_friction__no_truth_of_its_box_is_distrusted_and_no_corner_is_above_the_bound() -> None:
    wet = load_scenario("engineering-wet-road").replace(time_gaps_s={"uniform": [0.2, 0.9]})
    told, rng = wet.sample(60, 7).worlds, np.random.default_rng(0)
    uncertainty = parse_uncertainty("friction=0.1")
    for corners, spec in ((True, "coast"), (True, "full_brake"), (False, "full_brake")):
        shield = ShieldedDriver(make_agent(spec), wet, told=told, uncertainty=uncertainty)
        found = drive(uncertainty.draw(told, rng, corners=corners), shield, wet, 1)
        assert not found.guarded.shield.distrusted.any()
        harm = found.ledger.world_harm("first")
        assert not corners or (harm <= found.guarded.shield.predicted_harm + 1e-9).all()


# A table: one row for each world, the rest drawn.


def without(scenario: Scenario, *keys: str) -> dict[str, Any]:
    """What a scenario declares, but these keys."""
    return {key: value for key, value in scenario.declared().items() if key not in keys}


def tabled(**changes: Any) -> Scenario:
    given = {"gaps_m": 9.0, "speeds_mps": {"uniform": [18, 22]}, "table": TABLE, **changes}
    return Scenario(**without(PAPER, *given), **given)


def test_table__rows_are_never_torn_and_the_rest_is_drawn_as_without_it() -> None:
    found = tabled().sample(600, 7).worlds
    rows = np.stack([found.gaps_m[:, 0], found.speeds_mps[:, 1]], axis=1)
    kinds, counts = np.unique(rows, axis=0, return_counts=True)
    assert kinds.tolist() == TABLE["rows"] and (np.abs(counts - 200) < 60).all()
    assert (found.gaps_m[:, 1] == 9.0).all()
    alone = tabled(table={**TABLE, "weights": [1, 1, 8]}).sample(600, 7).worlds
    assert (alone.speeds_mps[:, [0, 2]] == found.speeds_mps[:, [0, 2]]).all()  # early impacts: none here
    assert np.mean(alone.gaps_m[:, 0] == 7.0) == pytest.approx(0.8, abs=0.05)


def test_table__a_world_by_hand() -> None:
    one = Scenario(**{**FIXED.declared(), "table": {"columns": ["gap_1_m", "mass_3_t"], "rows": [[12, 30]]}})
    worlds = one.sample(3, 7).worlds
    assert worlds.gaps_m.tolist() == [[12.0, 40.0]] * 3 and worlds.vehicles.mass_t[:, 2].tolist() == [30.0] * 3
    assert final(one).gaps_m[0] == pytest.approx([12 + 400 / 12 - 400 / 14, 40 + 400 / 14 - 400 / 12], abs=1e-9)
    assert tabled().ranges().names[-1] == "row of the table" and tabled().bounds("gaps_m") == ((5.0, 7.0), (9.0, 9.0))
    assert tabled().middle_world().gaps_m[0].tolist() == [6.0, 9.0]


def test_table__of_a_file_is_read_once_and_goes_along(tmp_path: Path) -> None:
    whole = {"gap_1_m": 5.5, "gap_2_m": 6.5, "speed_1_mps": 20, "speed_2_mps": 19, "speed_3_mps": 18, "count": 3}
    lines = [",".join(whole), *(",".join(str(value + k) for value in whole.values()) for k in range(14))]
    (tmp_path / "rows.csv").write_text("\n".join(lines) + "\n\n")
    table = {"file": "rows.csv", "columns": [*whole][:5], "weights": "count"}
    declared = {**without(PAPER, "gaps_m", "speeds_mps"), "name": "mine", "early_impacts": "keep"}
    (tmp_path / "mine.yaml").write_text(json.dumps({**declared, "table": table}))
    mine = load_scenario(tmp_path / "mine.yaml")
    (tmp_path / "rows.csv").unlink()
    again = Scenario(**mine.declared()).replace(horizon_s=9)
    assert (len(again.table.rows), again.table.weights) == (14, (*range(3, 17),))
    assert (again.sample(50, 7).worlds.gaps_m == mine.sample(50, 7).worlds.gaps_m).all()


# Lognormal: the logarithm is normal.


def test_lognormal__is_the_truncated_one_of_the_textbook() -> None:
    shape = {"median": 1.1, "sigma": 0.4, "low": 0.3, "high": 3.0}
    law, u = stats.lognorm(s=0.4, scale=1.1), np.array([0.0, 0.5, 0.975])
    low, high = law.cdf(0.3), law.cdf(3.0)
    (entry, _) = PAPER.replace(time_gaps_s={"lognormal": shape}).quantities("time_gaps_s")
    assert entry.value(u) == pytest.approx(law.ppf(low + (high - low) * u), rel=1e-9)


# Equipage: who sends, who hears.

FIXED_LINKS = {"preset": "nominal", "link_latency_s": 0.3, "sensing_s": [1.0, 1.0]}


@pytest.mark.parametrize(
    ("vehicles", "latency", "known_of_2_by_3"),
    [
        ({}, [0.0, 0.3, 0.3], 0.3),
        ({"vehicle_1": {"sends": False}}, [0.0, 1.0, 2.0], 2.0),  # one sees it brake, the other one that
        ({"vehicle_3": {"sends": False, "hears": "none"}}, [0.0, 0.3, 1.3], 1.3),
        ({"vehicle_2": {"sends": False, "hears": "front"}}, [0.0, 0.3, 0.3], 1.0),
    ],
)
def test_equipage__reactions_by_hand(vehicles: dict[str, Any], latency: list[float], known_of_2_by_3: float) -> None:
    v2x = {**FIXED_LINKS, **({"vehicles": vehicles} if vehicles else {})}
    found = FIXED.replace(v2x=v2x).sample(1, 7).worlds.vehicles
    assert found.latency_s[0] == pytest.approx(latency, abs=1e-12)
    assert found.known_from_s[0, 2, 1] == pytest.approx(known_of_2_by_3, abs=1e-12)
    if "vehicle_2" in vehicles:
        assert found.known_from_s[0, 1, 2] == pytest.approx(1.0, abs=1e-12)  # of vehicle_3 it sees only


def test_equipage__of_types_is_drawn_with_them() -> None:
    kinds = {"equipped": {"weight": 7}, "without": {"weight": 3, "v2x": {"sends": False, "hears": "none"}}}
    sample = FIXED.replace(vehicle_types=kinds, v2x=FIXED_LINKS).sample(2000, 7)
    silent = sample.types == "without"
    latency = sample.worlds.vehicles.latency_s
    second = np.where(silent[:, 0] | silent[:, 1], 1.0, 0.3)
    third = np.where(silent[:, 0] | silent[:, 2], second + 1.0, 0.3)
    assert (latency[:, 1] == second).all() and np.abs(latency[:, 2] - third).max() < 1e-12


# Spread around what the load gives.


def lorries(spread: Any) -> Scenario:
    capacity = {"with_load": [7, 5], **({} if spread is None else {"spread": spread})}
    kinds = {"lorry": {"mass_t": {"with_load": [10, 40]}, "braking_capacity_mps2": capacity}}
    return Scenario(**without(FIXED, "mass_t", "braking_capacity_mps2"), vehicle_types=kinds)


def test_spread__is_added_to_what_the_load_gives() -> None:
    plain, wide = (lorries(spread).sample(3000, 7).worlds.vehicles for spread in (None, {"uniform": [-0.5, 0.5]}))
    by_load = 7 - 2 * (plain.mass_t - 10) / 30
    assert plain.braking_capacity_mps2 == pytest.approx(by_load, abs=1e-12)
    more = wide.braking_capacity_mps2 - by_load
    assert (wide.mass_t == plain.mass_t).all() and -0.5 <= more.min() < -0.49 and 0.49 < more.max() <= 0.5
    assert abs(np.corrcoef(wide.mass_t.ravel(), more.ravel())[0, 1]) < 0.02  # drawn apart from the load
    assert lorries({"uniform": [-0.5, 0.5]}).bounds("braking_capacity_mps2")[0] == (4.5, 7.5)
    names = lorries({"uniform": [-0.5, 0.5]}).ranges().names
    assert "braking_capacity_mps2 of vehicle_1" in names and "mass_t of vehicle_1" not in names


# The alert comes later.


def test_alert__everybody_goes_on_until_then() -> None:
    late = FIXED.replace(alert_s=2, speeds_mps=[20, 18, 20], latency_s=[0, 0.5, 0.8])
    assert late.sample(1, 7).worlds.vehicles.latency_s.tolist() == [[2.0, 2.5, 2.8]]
    now = late.replace(gaps_m=[40 + 2 * 2, 40 - 2 * 2])
    assert final(late).gaps_m == pytest.approx(final(Scenario(**without(now, "alert_s"))).gaps_m, abs=1e-9)
    drawn = FIXED.replace(alert_s={"uniform": [1, 5]})
    latency = drawn.sample(100, 7).worlds.vehicles.latency_s
    assert (latency == latency[:, :1]).all() and 1 <= latency.min() < 1.2 and 4.8 < latency.max() <= 5
    assert drawn.bounds("latency_s") == ((1.0, 5.0),) * 3 and drawn.ranges().names == ("alert_s",)
