"""How far Vehicle 1 is shoved, and the paper's sum over samples: by hand, and against the two integrators."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.evaluation import Evaluation, SummaryTable, evaluate, record_episode, summarise, write_per_world
from ethbrake_marl.evaluation.measures import FAR_M
from ethbrake_marl.evaluation.rollout import ShovedFront
from ethbrake_marl.physics import advance_sampled
from ethbrake_marl.scenario import Scenario, Task, load_scenario

# Two vehicles at rest and in touch; the rear one pushes with 5.5 t x 6 m/s2 = 33 kN against brakes of 27 kN, plastic.
# Together they gain 6 kN / 10 t = 0.6 m/s2: after 2 s they stand 1.2 m further on.
PUSH = Scenario(
    name="push", vehicles=2, gaps_m=0.0, speeds_mps=0.0, braking_capacity_mps2=6.0, driving_capacity_mps2=6.0,
    mass_t=[4.5, 5.5], latency_s=0.0, restitution=0.0, horizon_s=2.0, roles={"vehicle_2": "learner"},
)  # fmt: skip


def alone(scenario: Scenario, spec: str, n: int = 1) -> Evaluation:
    return evaluate(scenario.sample(n, 7), {spec: make_agent(spec)}, scenario=scenario, seed=7)


def test_shoved__by_one_impact(pair: Scenario) -> None:
    (shoved,) = alone(pair, "full_brake").outcome("full_brake").shoved_m
    impact_s = 0.5 + 0.25 / 3.0  # see PAIR: speed 20 - 6 t before it, 18.315 m/s after it
    ends = 20.0 * impact_s - 3.0 * impact_s**2 + 18.315**2 / 12.0
    assert shoved == pytest.approx(ends - 20.0**2 / 12.0, abs=1e-12)


def test_shoved__by_pushing_from_rest() -> None:
    outcome = alone(PUSH, "constant:-6").outcome("constant:-6")
    assert outcome.shoved_m == pytest.approx([1.2], abs=1e-12)
    assert outcome.total_harm.tolist() == [0.0]


def test_shoved__is_zero_where_nobody_comes_near_whatever_the_script() -> None:
    for script in ("full_brake", "coast", "constant:2.5", "constant:-1"):
        far = PUSH.replace(gaps_m=500.0, speeds_mps=[20.0, 10.0], roles={"vehicle_1": script, "vehicle_2": "learner"})
        assert alone(far, "full_brake").outcome("full_brake").shoved_m == pytest.approx([0.0], abs=1e-11)


def test_shoved__ends_at_the_obstacle() -> None:
    wall = PUSH.replace(obstacle_gap_m=0.5, horizon_s=8.0)
    assert alone(wall, "constant:-6").outcome("constant:-6").shoved_m == pytest.approx([0.5], abs=1e-12)


def test_shoved__is_where_the_record_ends(evaluation: Evaluation, gap_agent: object) -> None:
    shoved = evaluation.outcome("gap").shoved_m
    assert shoved is not None
    for k in (int(np.argmax(shoved)), 0):
        record = record_episode(evaluation.worlds.take([k]), gap_agent, scenario=evaluation.scenario)
        own = evaluation.worlds.speeds_mps[k, 0] ** 2 / 12.0
        assert shoved[k] == pytest.approx(record.positions_m[-1, 0] - own, abs=1e-10)
    assert shoved.max() > 1.0


def test_shoved__has_no_meaning_where_vehicle_1_is_driven_or_reacts() -> None:
    driven = PUSH.replace(obstacle_gap_m=9.0).with_learners(["vehicle_1"])
    assert alone(driven, "full_brake").outcome("full_brake").shoved_m is None
    reacts = PUSH.replace(roles={"vehicle_1": "planner", "vehicle_2": "learner"})
    assert ShovedFront.of(reacts.sample(1, 7).worlds, Task(reacts, (1,))) is None


def test_sampled__one_impact_is_counted_once(pair: Scenario) -> None:
    """At 0.6 s the gap is -0.05 m and the closing speed 3 m/s; after the exchange they separate."""
    assert alone(pair, "full_brake").outcome("full_brake").sampled_harm == pytest.approx([9.0], abs=1e-12)


def test_sampled__pushing_is_counted_at_every_sample() -> None:
    """Each step the pusher gains at most 1.2 m/s on the pushed: w = 0, 0.6, 0.93, 1.1115, then 1.2 at 16 samples."""
    expected = 0.6**2 + 0.93**2 + 1.1115**2 + 16 * 1.2**2
    assert alone(PUSH, "constant:-6").outcome("constant:-6").sampled_harm == pytest.approx([expected], abs=1e-9)


@pytest.mark.parametrize("spec", ["full_brake", "constant:4.5"])
def test_sampled__of_a_constant_is_that_of_the_map(evaluation: Evaluation, spec: str) -> None:
    worlds, braking = evaluation.worlds, evaluation.worlds.vehicles.braking_capacity_mps2
    command = -braking.copy()
    command[:, 1] = -7.0 if spec == "full_brake" else -4.5
    _, impacts = advance_sampled(worlds, command, until_s=8.0, step_s=0.1)
    np.testing.assert_allclose(evaluation.outcome(spec).sampled_harm, impacts.total_harm.sum(axis=1), atol=1e-9)


def test_sampled__knows_no_obstacle_and_only_vehicle_2_driven() -> None:
    assert alone(PUSH.replace(obstacle_gap_m=9.0), "coast").outcome("coast").sampled_harm is None
    third = load_scenario("paper-random").with_learners(["vehicle_3"])
    assert alone(third, "coast").outcome("coast").sampled_harm is None


def test_both__do_not_depend_on_the_other_worlds(evaluation: Evaluation, gap_agent: object) -> None:
    again = evaluate(evaluation.worlds, {"gap": gap_agent}, scenario=evaluation.scenario, chunk=33).outcome("gap")
    whole = evaluation.outcome("gap")
    assert again.shoved_m.tobytes() == whole.shoved_m.tobytes()
    assert again.sampled_harm.tobytes() == whole.sampled_harm.tobytes()


def test_both__change_no_result_and_can_be_left_out(evaluation: Evaluation, gap_agent: object) -> None:
    without = evaluate(evaluation.worlds, {"gap": gap_agent}, scenario=evaluation.scenario, aftermath=False)
    outcome, whole = without.outcome("gap"), evaluation.outcome("gap")
    assert outcome.shoved_m is None and outcome.sampled_harm is None
    assert outcome.total_harm.tobytes() == whole.total_harm.tobytes()
    assert outcome.final.speeds_mps.tobytes() == whole.final.speeds_mps.tobytes()


def test_both__are_in_json_csv_and_the_table(evaluation: Evaluation, tmp_path: Path) -> None:
    outcome, row = evaluation.outcome("gap"), summarise(evaluation)[2]
    found = row.to_json()
    assert found["vehicle_1_shoved_m"] == pytest.approx(outcome.shoved_m.mean())
    assert found["vehicle_1_shoved_far_rate"] == (outcome.shoved_m > FAR_M).mean() > 0.0
    assert found["sampled_harm"] == pytest.approx(outcome.sampled_harm.mean())
    low, high = found["sampled_harm_interval"]
    assert low < found["sampled_harm"] < high
    line = next(line for line in SummaryTable([row]).markdown().splitlines() if line.startswith("| gap"))
    assert f" {found['sampled_harm']:.2f} [" in line and f" {found['vehicle_1_shoved_m']:.2f} [" in line
    assert f" {100 * found['vehicle_1_shoved_far_rate']:.1f} % [" in line
    write_per_world(tmp_path / "out.csv", evaluation)
    with (tmp_path / "out.csv").open(newline="") as stream:
        lines = [line for line in csv.DictReader(stream) if line["agent"] == "gap"]
    assert [float(line["vehicle_1_shoved_m"]) for line in lines] == outcome.shoved_m.tolist()
    assert [float(line["sampled_harm"]) for line in lines] == outcome.sampled_harm.tolist()


def test_none__is_null_in_json_empty_in_csv_and_a_dash_in_the_table(tmp_path: Path) -> None:
    result = alone(PUSH.replace(obstacle_gap_m=9.0).with_learners(["vehicle_1"]), "coast")
    (row,) = summarise(result)
    found = row.to_json()
    assert found["vehicle_1_shoved_m"] is found["vehicle_1_shoved_far_rate"] is found["sampled_harm"] is None
    write_per_world(tmp_path / "out.csv", result)
    with (tmp_path / "out.csv").open(newline="") as stream:
        (line,) = csv.DictReader(stream)
    assert line["vehicle_1_shoved_m"] == line["sampled_harm"] == ""
    assert "| – | – | – |" in SummaryTable([row]).markdown()
