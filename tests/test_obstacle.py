"""An obstacle ahead of Vehicle 1, from the scenario to the results: every room counts it, and counts it alike."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.e_v2x_bm import optimise_coupled
from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.episodes import record_episode
from ethbrake_marl.evaluation.results import write_per_world
from ethbrake_marl.figures import trajectories
from ethbrake_marl.harm import empty_ledger
from ethbrake_marl.limits.limits import best_harm, task_problem
from ethbrake_marl.limits.lower_bound import avoidability, lower_bound
from ethbrake_marl.physics import Worlds, advance
from ethbrake_marl.policies import ObservationSchema
from ethbrake_marl.scenario import Scenario, Task, load_scenario
from ethbrake_marl.search import profile_problem
from ethbrake_marl.shield.guard import ShieldedDriver
from tests.reference.avoidability_lp import avoidable_by_lp

ALL = load_scenario("cooperation-4-all")
NEAR = ALL.replace(obstacle_gap_m={"uniform": [10, 45]})  # within the way of full braking in many worlds


def test_sample__an_obstacle_leaves_all_other_draws_alone_and_has_its_own_for_each_world():
    pair, near = load_scenario("cooperation-3-pair").sample(50, 7).worlds, NEAR.sample(50, 7).worlds
    for name in ("gaps_m", "speeds_mps"):
        assert getattr(near, name).tobytes() == getattr(pair, name).tobytes()
    assert np.isinf(pair.obstacle_gap_m).all() and not pair.obstacle_hit.any()
    assert (
        (near.obstacle_gap_m >= 10.0).all()
        and (near.obstacle_gap_m <= 45.0).all()
        and np.ptp(near.obstacle_gap_m) > 20.0
    )
    assert NEAR.sample(1, 7, first=31).worlds.obstacle_gap_m[0] == near.obstacle_gap_m[31]
    assert (NEAR.sample(50, 7, channel="training").worlds.obstacle_gap_m != near.obstacle_gap_m).all()


@pytest.mark.parametrize(
    ("value", "right"),
    [(0, "must be finite and in (0, 10000] m (metres)"), (-3.0, "(0, 10000]"), (2e4, "(0, 10000]"), (None, "left out")],
)
def test_scenario__refuses_an_obstacle_at_no_distance(value, right):
    with pytest.raises(InvalidInput, match=r"obstacle_gap_m = .*" + re.escape(right)):
        ALL.replace(obstacle_gap_m=value)


def test_scenario__vehicle_1_learns_only_with_something_to_lose():
    with pytest.raises(InvalidInput, match=r"roles\.vehicle_1 = learner: has nothing to lose without an obstacle"):
        load_scenario("cooperation-3-pair").with_learners([0, 1])
    assert ALL.with_learners(["vehicle_2"]).learners == (1,)


def test_initial_state__may_place_the_obstacle_where_the_scenario_has_one():
    state = {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}
    assert ALL.worlds_from_state(state).obstacle_gap_m.tolist() == [42.0]
    assert NEAR.worlds_from_state({**state, "obstacle_gap_m": 30}).obstacle_gap_m.tolist() == [30.0]
    with pytest.raises(InvalidInput, match="obstacle_gap_m is missing, and random in scenario"):
        NEAR.worlds_from_state(state)
    with pytest.raises(InvalidInput, match="obstacle_gap_m is not of this scenario: 'paper-random' has no"):
        load_scenario("paper-random").worlds_from_state({**state, "obstacle_gap_m": 30})
    with pytest.raises(InvalidInput, match=r"initial_state: obstacle_gap_m = 0: must be finite and in \(0, 10000\] m"):
        ALL.worlds_from_state({**state, "obstacle_gap_m": 0})
    columns = {"gap_1_m": [7, 8], "gap_2_m": [7, 8], "speed_1_mps": [20, 19], "speed_2_mps": 2 * [18]}
    table = NEAR.worlds_from_table({**columns, "speed_3_mps": [20, 20], "obstacle_gap_m": [30, 35]})
    assert table.obstacle_gap_m.tolist() == [30.0, 35.0]


def test_profiles__are_followed_with_the_obstacle_as_the_engine_drives_them():
    worlds = NEAR.sample(30, 7).worlds
    problem = profile_problem(worlds, [0, 1, 2], horizon_s=NEAR.horizon_s)
    commands = np.broadcast_to(np.array([-3.0, -2.5, -6.0]), (30, 1, 3))
    first, total = problem.follow(problem.constant(commands))
    scripts = {i: make_agent(spec) for i, spec in enumerate(("constant:3", "constant:2.5", "full_brake"))}
    engine = Engine(NEAR, 30, learners=(), scripts=scripts, deciders=(0, 1, 2), worlds=worlds)
    while not engine.ended.all():
        engine.step({})
    assert first.tobytes() == engine.ledger.world_harm("first").tobytes()
    assert total.tobytes() == engine.ledger.world_harm("total").tobytes()
    assert (engine.ledger.obstacle_count > 0).sum() > 10
    words = problem.identity
    moved = profile_problem(NEAR.replace(obstacle_gap_m=44).sample(30, 7).worlds, [0, 1, 2], horizon_s=NEAR.horizon_s)
    assert (words != moved.identity).all()


def test_profiles__refuse_worlds_of_which_only_some_have_an_obstacle():
    mixed = Worlds.concatenate([NEAR.sample(1, 1).worlds, load_scenario("cooperation-3-pair").sample(1, 1).worlds])
    with pytest.raises(InvalidInput, match="only some of the worlds have an obstacle ahead"):
        profile_problem(mixed, [1])


def test_coupled__vehicle_1_stops_short_of_the_obstacle_if_it_can():
    worlds = ALL.sample(6, 7).worlds
    found = optimise_coupled(worlds, 0, harm_count="total")
    for k in range(6):
        command = -worlds.vehicles.braking_capacity_mps2[[k]]
        harms = []
        for a in (*np.linspace(0.0, 6.0, 25), found.deceleration_mps2[k]):
            command[0, 0] = -a
            _, impacts = advance(worlds.take([k]), command, until_s=8.0)
            harms.append(empty_ledger(worlds.take([k])).add(impacts).world_harm("total")[0])
        assert harms[-1] == found.harm[k] <= min(harms)


def test_best_harm__of_the_whole_line_is_no_worse_than_of_its_followers():
    worlds = ALL.sample(3, 7).worlds
    level_3 = ALL.with_learners([1, 2])
    together = best_harm(ALL, worlds, counts=("total",), budget=3_000, threads=1)
    followers = best_harm(level_3, worlds, counts=("total",), budget=3_000, threads=1)
    whole, part = together.best["total"].harm, followers.best["total"].harm
    assert whole.mean() < part.mean()
    _, again = task_problem(worlds, Task(ALL, (0, 1, 2))).follow(together.best["total"].profiles)
    assert again.tobytes() == whole.tobytes()


def test_proofs__cover_an_obstacle_that_full_braking_never_meets_and_refuse_the_rest():
    worlds = ALL.with_learners([1]).sample(200, 7).worlds
    plain = load_scenario("cooperation-2-paper").sample(200, 7).worlds
    assert avoidability(worlds).reason.tolist() == avoidability(plain).reason.tolist()
    near = NEAR.sample(200, 7).worlds
    with pytest.raises(InvalidInput, match=r"obstacle_gap_m\[\d+\] = .*: must be beyond full braking of vehicle_1"):
        avoidability(near)
    with pytest.raises(InvalidInput, match=r"obstacle_gap_m\[\d+\] = .*: must be beyond full braking of vehicle_1"):
        lower_bound(near)
    assert np.all(lower_bound(worlds).front_pair == lower_bound(plain).front_pair)
    with pytest.raises(InvalidInput, match="avoidable_by_lp: obstacle_gap_m 42: the programme knows no obstacle"):
        avoidable_by_lp(worlds.take([0]), [1], 0.1)


@pytest.fixture(scope="module")
def near_one() -> Scenario:
    return NEAR.with_learners(["vehicle_1"])


def test_per_world__the_table_tells_the_obstacles_part(near_one, tmp_path: Path):
    worlds = near_one.sample(40, 7)
    result = eb.evaluate(worlds, {"coast": make_agent("coast")}, scenario=near_one)
    write_per_world(tmp_path / "worlds.csv", result)
    with (tmp_path / "worlds.csv").open() as file:
        rows = list(csv.DictReader(file))
    ledger = result.outcome("coast").ledger
    for row, first, total in zip(rows, ledger.obstacle_first_harm, ledger.obstacle_total_harm, strict=True):
        assert float(row["obstacle_first_impact_harm"]) == first and float(row["obstacle_total_harm"]) == total > 0.0
        assert 10.0 <= float(row["obstacle_gap_m"]) <= 45.0 and float(row["final_obstacle_gap_m"]) >= 0.0
        assert float(row["first_impact_harm_1"]) >= first
    assert [int(row["impacts"]) for row in rows] == ledger.impacts.tolist()


def test_record__positions_end_at_the_obstacle_and_the_figure_draws_it(near_one):
    record = record_episode(near_one.sample(1, 7).worlds, make_agent("coast"), scenario=near_one)
    gap = float(record.initial.obstacle_gap_m[0])
    assert record.positions_m[:, 0].max() == pytest.approx(gap, abs=1e-9) and (record.positions_m <= gap + 1e-9).all()
    struck = record.impacts.pair == -1
    assert struck.any() and record.impacts.closing_speed_mps[struck][0] ** 2 == record.ledger.obstacle_first_harm[0]
    figure = trajectories({"coast": record})
    assert "obstacle" in figure.axes[0].get_legend_handles_labels()[1]


@pytest.mark.parametrize("vehicle", [0, 1])
def test_shield__step_mode_bounds_the_harm_of_the_obstacle_too_to_the_last_bit(vehicle):
    scenario = NEAR.with_learners([vehicle])
    worlds = scenario.sample(40, 7).worlds
    agent = ShieldedDriver(make_agent("coast"), scenario, harm_count="total")
    episodes = drive(worlds, agent, scenario, vehicle)
    harm = episodes.ledger.world_harm("total")
    shield = episodes.guarded.shield
    assert not shield.distrusted.any()
    assert (harm <= shield.predicted_harm).all() and np.array_equal(harm, shield.bound)
    assert (shield.interventions > 0).sum() > 5 and (episodes.ledger.obstacle_count > 0).any()


def test_shield__wrapped_around_an_environment_sees_what_it_predicted():
    scenario = NEAR.with_learners(["vehicle_1"])
    env = eb.HybridShield(eb.parallel_env(scenario), None, mode="step")
    for seed in range(4):
        env.reset(seed=seed)
        while env.agents:
            infos = env.step({"vehicle_1": np.array([0.3], np.float32)})[4]
            assert infos["vehicle_1"]["shield"]["trusted"]
        assert infos["vehicle_1"]["world_first_impact_harm"] == infos["vehicle_1"]["shield"]["bound_harm"]


@pytest.mark.parametrize("name", ["paper-random", "cooperation-4-all"])
def test_manifest__a_policys_observation_is_known_again_by_its_features(name):
    spec = eb.observation_for(load_scenario(name))
    schema = ObservationSchema.of(spec)
    assert schema.spec == spec and ObservationSchema.of(schema.spec) == schema
    assert set(schema.model_dump()) == {"front", "rear", "features", "scaling_sha256"}  # as in every shipped policy


def test_lower_bound__knows_what_a_pushed_vehicle_does_at_the_obstacle():
    scenario = ALL.with_learners([1])
    worlds = scenario.sample(40, 7).worlds
    bound = lower_bound(worlds, horizon_s=scenario.horizon_s, time_step_s=scenario.time_step_s)
    for harm_count in ("first", "total"):
        found = best_harm(scenario, worlds, counts=(harm_count,), budget=500, threads=1).best[harm_count].harm
        assert np.all(bound.harm <= found)
    assert bound.harm.mean() > 1.0
