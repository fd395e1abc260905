"""Worlds by hand: drawn, derived, of tables, of types and of mixtures."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.scenario.sampling import uniform_numbers
from ethbrake_marl.first_edition.scenario.tables import read_worlds, table_columns, worlds_from_state, worlds_from_table
from ethbrake_marl.first_edition.training.training import Training
from tests.first_edition.scenario.test_sampling import (
    ALL_RANDOM,
    DELAYS,
    PAPER,
    bits,
    build,
    closing_pair,
    quantity,
    typed,
)

LINE = {"time_gaps_s": {"uniform": [0.2, 2]}, "line_speed_mps": {"uniform": [10, 38]}}
DEVIATIONS = {"speed_deviations_mps": {"uniform": [-2, 2]}}


def ahead(**given):
    beside = {"braking_capacity_mps2": [5, 7, 6], "latency_s": [0.5, 0.5, 0.8]}
    return build(**{"gaps_m": 7, "speeds_mps": [20, 18, 20], **beside, **given})


FULL = {"gaps_m": 7, "speeds_mps": 6, "braking_capacity_mps2": 6, "driving_capacity_mps2": 6, "mass_t": 6}
FULL |= {"latency_s": 0, "restitution": 0, "speed_limit_mps": 40, "obstacle_gap_m": 30}


def test_world_k__is_the_same_far_down_the_list_and_of_any_whole_seed() -> None:
    far = ALL_RANDOM.sample(3, 0, first=10**15)
    assert far.index.tolist() == [1000000000000000, 1000000000000001, 1000000000000002]
    assert bits(ALL_RANDOM.sample(1, 0, first=10**15 + 2).worlds) == bits(far.worlds.take([2]))
    assert bits(ALL_RANDOM.sample(2, np.uint64(5)).worlds) == bits(ALL_RANDOM.sample(np.int64(2), 5).worlds)
    assert ALL_RANDOM.sample(1, 2**200).worlds.n == 1


def test_uniform_numbers__are_those_of_numpys_own_generator() -> None:
    key = np.random.SeedSequence([7], spawn_key=(0, 0)).generate_state(2, np.uint64)
    expected = np.random.Generator(np.random.Philox(key=key)).random(5 * 24).reshape(5, 24)
    assert uniform_numbers(7, "list", 0, 0, 5, 24).tolist() == expected.tolist()
    assert uniform_numbers(7, "list", 0, 3, 2, 24).tolist() == expected[3:].tolist()


@pytest.mark.parametrize(
    ("gap_m", "changes"),
    [
        (3.001, {}),
        (0.5, {"roles": {"vehicle_1": "coast", "vehicle_2": "learner"}}),  # nothing closes
        (1.001, {"roles": {"vehicle_1": "constant:2", "vehicle_2": "learner"}}),  # 1 m closer within 1 s
        (2, {"vehicles": 3, "latency_s": [0, 0.5, 1], "roles": {"vehicle_2": "learner", "vehicle_3": "learner"}}),
    ],
    ids=["full brake", "coast", "gentle", "first of two"],
)
def test_impact__after_the_first_learner_may_act_is_not_early(gap_m, changes) -> None:
    # The front one brakes at 6 m/s2, the rear one may act at 1 s; 2 m are gone after 0.816 s, after Vehicle 2 may act.
    assert closing_pair(gap_m, **changes).sample(1, 0).rejected == 0


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (
            {"time_gaps_s": [0.5, 2], "speeds_mps": [30, 20, 10]},
            ([[10.0, 20.0], [10.0, 20.0]], [[30.0, 20.0, 10.0], [30.0, 20.0, 10.0]]),
        ),
        (
            {"gaps_m": 7, "line_speed_mps": 20, "speed_deviations_mps": [1, -2, 0.5]},
            ([[7.0, 7.0], [7.0, 7.0]], [[21.0, 18.0, 20.5], [21.0, 18.0, 20.5]]),
        ),
        ({"gaps_m": 7, "line_speed_mps": 20}, ([[7.0, 7.0], [7.0, 7.0]], [[20.0, 20.0, 20.0], [20.0, 20.0, 20.0]])),
        (
            {"time_gaps_s": 0.5, "line_speed_mps": 20, "speed_deviations_mps": [0, -2, 2]},
            ([[9.0, 11.0], [9.0, 11.0]], [[20.0, 18.0, 22.0], [20.0, 18.0, 22.0]]),
        ),
    ],
)
def test_gaps_as_times_and_speeds_of_the_line__by_hand(given, expected) -> None:
    # Gaps as times, 0.5 s x 20 and 2 s x 10 m/s, and speeds as those of the line.
    worlds = build(**given).sample(2, 7).worlds
    assert (worlds.gaps_m.tolist(), worlds.speeds_mps.tolist()) == expected


def test_bounds__hold_for_every_draw_and_are_reached_by_fixed_numbers() -> None:
    scenario = build(**LINE, **DEVIATIONS)
    assert scenario.bounds("speeds_mps") == ((8.0, 40.0), (8.0, 40.0), (8.0, 40.0))
    assert scenario.bounds("gaps_m") == ((1.6, 80.0), (1.6, 80.0))
    assert build(time_gaps_s=0.5, speeds_mps=20).bounds("gaps_m") == ((10.0, 10.0), (10.0, 10.0))
    assert PAPER.bounds("gaps_m") == ((5.0, 10.0), (5.0, 10.0))
    worlds = scenario.sample(2000, 7).worlds
    assert 8.0 <= worlds.speeds_mps.min() < worlds.speeds_mps.max() <= 40.0
    assert 1.6 <= worlds.gaps_m.min() < worlds.gaps_m.max() <= 80.0


def test_new_way_to_declare__takes_the_place_of_the_old_one() -> None:
    scenario = build(**LINE, **DEVIATIONS)
    assert scenario.replace(gaps_m=7).bounds("gaps_m") == ((7.0, 7.0), (7.0, 7.0))
    assert scenario.replace(gaps_m=7).time_gaps_s is None
    assert scenario.replace(speeds_mps=20).declared().keys() & {"line_speed_mps", "speed_deviations_mps"} == set()
    assert scenario.replace(line_speed_mps=20).bounds("speeds_mps") == ((18.0, 22.0), (18.0, 22.0), (18.0, 22.0))
    assert scenario.replace(gaps_m=7, speeds_mps=20).replace(**LINE).bounds("speeds_mps") == (
        (10.0, 38.0),
        (10.0, 38.0),
        (10.0, 38.0),
    )
    assert eb.Scenario(**scenario.declared()) == scenario
    margin = build(gaps_m=7, speeds_mps=20, obstacle_margin_m=1.5)
    ahead_of = margin.replace(obstacle_gap_m=42)
    assert ahead_of.obstacle_margin_m is None
    assert ahead_of.replace(obstacle_margin_m=1).obstacle_gap_m is None


def test_margin__is_an_obstacle_for_everybody() -> None:
    # A margin is an obstacle for everybody: Vehicle 1 may brake with 5 m/s2 after 0.5 s, so from 20 m/s it stops
    # after 50 m. The margin is added to that way, and has the random number of the distance.
    scenario = ahead(obstacle_margin_m=1.5)
    assert scenario.sample(2, 7).worlds.obstacle_gap_m.tolist() == [51.5, 51.5]
    assert [each.has_obstacle for each in (scenario, ahead(obstacle_gap_m=42), ahead())] == [True, True, False]
    assert scenario.with_learners(["vehicle_1"]).learners == (0,)
    assert eb.observation_for(scenario).obstacle
    drawn = {"speeds_mps": {"uniform": [18, 22]}, "braking_capacity_mps2": {"uniform": [5, 7]}}
    worlds = ahead(obstacle_margin_m={"uniform": [1, 2]}, **drawn).sample(200, 7).worlds
    speed, capacity = worlds.speeds_mps[:, 0], worlds.vehicles.braking_capacity_mps2[:, 0]
    margin = worlds.obstacle_gap_m - speed * 0.5 - speed**2 / (2 * capacity)
    far = ahead(obstacle_gap_m={"uniform": [51, 52]}, **drawn).sample(200, 7).worlds.obstacle_gap_m
    assert np.abs(margin - (far - 50.0)).max() <= 1e-12
    assert np.ptp(margin) > 0.9


HEADER = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps"


@pytest.mark.parametrize(
    "scenario",
    [PAPER, build(**LINE, **DEVIATIONS, restitution=0.1, mass_t=[4.5, 5.5, 5.9])],
    ids=["gaps and speeds", "times and deviations"],
)
def test_table_in_csv__gives_the_state_and_the_scenario_the_rest(scenario, empty_folder: Path) -> None:
    Path("worlds.csv").write_text(f"{HEADER}\n10,8,20,18,20\n5,9,22,1.8e1, 20\n", "utf-8")
    worlds = read_worlds(scenario, "worlds.csv")
    assert worlds.gaps_m.tolist() == [[10.0, 8.0], [5.0, 9.0]]
    assert worlds.speeds_mps.tolist() == [[20.0, 18.0, 20.0], [22.0, 18.0, 20.0]]
    assert worlds.vehicles.latency_s.tolist() == [[0.0, 0.5, 0.8]] * 2
    assert worlds.vehicles.braking_capacity_mps2.tolist() == [[6.0, 7.0, 6.0]] * 2
    assert worlds.vehicles.restitution.tolist() == [0.1, 0.1]


def test_table_in_csv__may_hold_any_quantity_in_any_order_after_a_byte_order_mark(empty_folder: Path) -> None:
    columns = f"\ufefflatency_2_s,restitution,mass_3_t,speed_limit_1_mps,{HEADER}"
    Path("worlds.csv").write_text(f"{columns}\n0.2,0.3,6,30,10,8,20,18,20\n", "utf-8")
    vehicles = read_worlds(PAPER.replace(mass_t=[4.5, 5.5, {"uniform": [5, 6]}]), "worlds.csv").vehicles
    assert vehicles.latency_s.tolist() == [[0.0, 0.2, 0.8]]
    assert vehicles.restitution.tolist() == [0.3]
    assert vehicles.mass_t.tolist() == [[4.5, 5.5, 6.0]]
    assert vehicles.speed_limit_mps.tolist() == [[30.0, 40.0, 40.0]]


@pytest.mark.parametrize("end", ["", "\n", "\n\n", "\r\n\r\n"])
def test_table_in_csv__may_end_in_blank_lines(end: str, empty_folder: Path) -> None:
    Path("worlds.csv").write_text(f"{HEADER}\n10,8,20,18,20{end}", "utf-8")
    assert read_worlds(PAPER, "worlds.csv").n == 1


def test_table_of_columns__is_the_same_worlds_as_sampled_ones() -> None:
    sampled = PAPER.sample(50, 3).worlds
    columns = {f"gap_{i + 1}_m": sampled.gaps_m[:, i] for i in range(2)}
    columns |= {f"speed_{i + 1}_mps": sampled.speeds_mps[:, i] for i in range(3)}
    assert bits(worlds_from_table(PAPER, columns)) == bits(sampled)
    assert [*table_columns(closing_pair(7))][:4] == ["gap_1_m", "speed_1_mps", "speed_2_mps", "braking_capacity_1_mps2"]
    assert len(table_columns(closing_pair(7))) == 1 + 6 * 2 + 1
    table = {f"gap_{p}_m": [7, 7] for p in (1, 2)} | {f"speed_{i}_mps": [10, 20] for i in (1, 2, 3)}
    assert worlds_from_table(ahead(obstacle_margin_m=1.5), table).obstacle_gap_m.tolist() == [16.5, 51.5]
    # the first: 5 + 10 + 1.5
    assert worlds_from_table(
        ahead(obstacle_margin_m=1.5), {**table, "obstacle_gap_m": [30, 31]}
    ).obstacle_gap_m.tolist() == [30.0, 31.0]


@pytest.mark.parametrize(
    ("scenario", "state", "expected"),
    [
        (PAPER, {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}, {"gaps_m": [7.0, 7.0], "restitution": 0.1}),
        (PAPER, {"gaps_m": 7, "speeds_mps": np.full(3, 20), "restitution": 0.0}, {"restitution": 0.0}),
        (eb.load_scenario("paper-scenario-1"), {}, {"gaps_m": [10.0, 8.0], "speeds_mps": [20.0, 18.0, 20.0]}),
        (build(time_gaps_s=[0.5, 1], line_speed_mps=20), {"speeds_mps": [30, 20, 10]}, {"gaps_m": [10.0, 10.0]}),
        (build(time_gaps_s=[0.5, 1], line_speed_mps=20), {"speeds_mps": 20, "gaps_m": [7, 8]}, {"gaps_m": [7.0, 8.0]}),
        (build(time_gaps_s=[0.5, 1], speeds_mps=[0, 1, 2]), {}, {"gaps_m": [0.5, 2.0]}),
        (
            ahead(obstacle_margin_m=1.5),
            {"gaps_m": 7, "speeds_mps": 20, "latency_s": 0, "braking_capacity_mps2": 4},
            {"obstacle_gap_m": 51.5, "braking_capacity_mps2": [4.0, 4.0, 4.0]},
        ),
        (build(gaps_m=7, speeds_mps=20, obstacle_gap_m=42), {}, {"obstacle_gap_m": 42.0}),
        (ALL_RANDOM, FULL, {"obstacle_gap_m": 30.0, "braking_capacity_mps2": [6.0, 6.0, 6.0]}),
    ],
    ids=[
        "numbers",
        "one for all",
        "nothing",
        "times",
        "gaps for times",
        "standing",
        "margin",
        "obstacle",
        "everything",
    ],
)
def test_state_that_is_given__is_filled_in_with_what_is_fixed(scenario, state, expected) -> None:
    worlds = worlds_from_state(scenario, state)
    assert {name: quantity(worlds, name)[0].tolist() for name in expected} == expected


def test_types__are_the_first_number_of_a_stream_of_their_own() -> None:
    u = uniform_numbers(7, "list", 0, 0, 100, 12, of=(3,)).reshape(100, 3, 4)
    assert (typed().sample(100, 7).types == np.where(u[..., 0] < 0.75, "car", "truck")).all()
    assert typed(types="truck").sample(50, 1).types.tolist() == [["truck"] * 3] * 50
    given = {"gaps_m": {"uniform": [5, 50]}, "speeds_mps": {"uniform": [10, 20]}, "latency_s": 0.2, "mass_t": 2}
    plain = build(**given, driving_capacity_mps2={"uniform": [1, 3]}, braking_capacity_mps2={"uniform": [5, 9]})
    buses = plain.replace(vehicle_types={"car": {}, "bus": {"mass_t": 12}})
    one, other = (scenario.sample(500, 7).worlds for scenario in (plain, buses))
    assert bits(replace(one, vehicles=replace(one.vehicles, mass_t=other.vehicles.mass_t))) == bits(other)
    assert np.unique(other.vehicles.mass_t).tolist() == [2.0, 12.0]
    brakes = typed(vehicle_types={"car": {"braking_capacity_mps2": 7}}, mass_t=[1, 2, 3])
    assert brakes.sample(5, 7).worlds.vehicles.mass_t.tolist() == [[1.0, 2.0, 3.0]] * 5
    late = {"latency_s": [0, 0.5, 0.8], "early_impacts": "reject"}
    sample = typed(gaps_m={"uniform": [0.1, 4]}, speeds_mps=[15, 20, 20], **late).sample(300, 7)
    assert sample.rejected > 0
    assert sample.index.tolist() == list(range(300))
    assert ((sample.worlds.vehicles.mass_t >= 14.0) == (sample.types == "truck")).all()


def test_mixture__holds_what_stands_beside_it_for_every_member() -> None:
    heavy = DELAYS.replace(mass_t=[40, 1, 1])
    assert heavy.bounds("mass_t")[0] == (40.0, 40.0)
    assert np.unique(heavy.sample(20, 7).worlds.vehicles.mass_t[:, 0]).tolist() == [40.0]
    assert heavy.sample(20, 7).worlds.gaps_m.tolist() == DELAYS.sample(20, 7).worlds.gaps_m.tolist()
    assert DELAYS.bounds("latency_s") == ((0.0, 0.0), (0.1, 0.8), (0.3, 1.2))
    third = DELAYS.with_learners(["vehicle_3"])
    assert [each.learners for each in (third, *third.members)] == [(2,), (2,), (2,), (2,)]
    assert Training.of("ppo", DELAYS).identity != Training.of("ppo", heavy).identity
    assert "1 x paper-delay-low, 1 x paper-delay-middle, 1 x paper-delay-high" in DELAYS._repr_html_()


def test_mixture__may_name_a_file_beside_it_or_write_its_members_out(empty_folder: Path) -> None:
    Path("own.yaml").write_text(json.dumps(PAPER.replace(name="own", title="").declared()))
    Path("mine.yaml").write_text("name: mine\nmixture: [{scenario: own.yaml}, {scenario: paper-random-early}]\n")
    assert [each.name for each in eb.load_scenario(Path("mine.yaml")).members] == ["own", "paper-random-early"]
    line = "gaps_m: 7, speeds_mps: 20, braking_capacity_mps2: 9, driving_capacity_mps2: 5, latency_s: 0.5, mass_t: 1"
    members = f"mixture:\n  - scenario: {{name: a, {line}}}\n  - scenario: {{name: b, {line}}}\n"
    Path("mine.yaml").write_text(f"name: mine\nvehicles: 5\n{members}")
    assert [member.vehicles for member in eb.load_scenario(Path("mine.yaml")).members] == [5, 5]
    assert eb.Scenario(name="x", mixture=[{"scenario": PAPER}]).vehicles == 3


def test_mixture__with_a_channel_in_one_member_is_one_batch() -> None:
    pair = [{"scenario": "cooperation-3-pair"}, {"scenario": "cooperation-3-congested"}]
    mixture = eb.load_scenario({"name": "mixed", "mixture": pair})
    env = eb.parallel_env(scenario=mixture)
    assert mixture.by_link
    assert {env.reset(seed=seed)[1]["vehicle_2"]["known_from_s"].shape for seed in range(6)} == {(3,)}
