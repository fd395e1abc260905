from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import curves as module, evaluate
from ethbrake_marl.evaluation.curves import deceleration_curve, regimes_of
from ethbrake_marl.figures import deceleration_figure, picture_bytes
from ethbrake_marl.limits.limits import Limits, Proof
from ethbrake_marl.physics import Worlds, make_worlds
from ethbrake_marl.scenario import Scenario, Task, load_scenario


def pair_world(gap_m: float, speeds_mps: tuple[float, float], latency_s: tuple[float, float]) -> Worlds:
    return make_worlds(
        [[gap_m]], [speeds_mps], braking_capacity_mps2=12.0, driving_capacity_mps2=0.0, latency_s=latency_s, mass_t=5.0,
        restitution=0.1,
    )  # fmt: skip


def seven_seven(scenario: Scenario) -> Worlds:
    columns = {"gap_1_m": [7.0], "gap_2_m": [7.0], "speed_1_mps": [20.0], "speed_2_mps": [18.0], "speed_3_mps": [20.0]}
    return scenario.worlds_from_table(columns)


def texts(figure: Figure) -> str:
    return " | ".join(text.get_text() for legend in figure.legends for text in legend.get_texts())


# By hand; the leader brakes from its onset, the follower from its own.
@pytest.mark.parametrize(
    ("gap", "speeds", "latency", "decelerations", "expected"),
    [
        (1.0, (20.0, 20.0), (0.0, 1.0), (6.0, 6.0), "A"),  # sqrt(2 / 6) = 0.577 s, before 1 s
        (10.0, (3.0, 10.0), (0.0, 2.0), (6.0, 6.0), "A'"),  # the leader stands at 0.5 s, 5.75 m ahead; hit at 1.075 s
        (10.0, (3.0, 10.0), (0.0, 0.5), (6.0, 2.0), "C"),  # the same leader; stopping takes 25 m of the 5.75 m
        (10.0, (3.0, 10.0), (0.0, 0.5), (6.0, 10.0), "none"),  # and here 5 m
        (1.0, (20.0, 20.0), (0.0, 0.5), (6.0, 6.0), "B"),  # 0.25 m left at 0.5 s, 3 m/s closing for good
        (1.0, (5.0, 10.0), (1.0, 0.0), (6.0, 2.0), "early"),  # 5 t - t^2 = 1 at 0.21 s, before 1 s
    ],
)
def test_regimes__by_hand(
    gap: float,
    speeds: tuple[float, float],
    latency: tuple[float, float],
    decelerations: tuple[float, float],
    expected: str,
) -> None:
    assert regimes_of(pair_world(gap, speeds, latency), 0, np.array([decelerations])).tolist() == [expected]


def test_curve__of_scenario_1_changes_its_regimes_at_the_known_decelerations() -> None:
    scenario = load_scenario("paper-scenario-1")
    curve = deceleration_curve(scenario.sample(1, 7).worlds, Task(scenario, (1,)))
    at = curve.deceleration_mps2
    front, rear = curve.regimes["front pair"], curve.regimes["rear pair"]
    assert [str(name) for name in dict.fromkeys(front.tolist())] == ["B", "C", "none"]
    assert [str(name) for name in dict.fromkeys(rear.tolist())] == ["none", "B"]
    assert at[front == "C"].max() <= 4.71845 + 0.004 and at[front == "none"].min() >= 4.71845 - 1e-5
    assert at[rear == "B"].min() == pytest.approx(5.01031, abs=0.004)
    assert (curve.predicted[(front == "none") & (rear == "none")] == 0.0).all()
    assert curve.predicted[-1] == pytest.approx(28.98, abs=1e-9)  # full braking, by hand


def test_curve__its_values_are_the_closed_form_and_the_simulation() -> None:
    scenario = load_scenario("paper-distance")
    world = seven_seven(scenario)
    curve = deceleration_curve(world, Task(scenario, (1,)), points=11)
    assert curve.predicted.min() == pytest.approx(4.03447, abs=1e-5)
    assert curve.deceleration_mps2[np.argmin(curve.predicted)] == pytest.approx(5.17021, abs=1e-5)
    for k in (3, 9):
        agent = {"x": make_agent(f"constant:{float(curve.deceleration_mps2[k])!r}")}
        driven = evaluate(world, agent, scenario=scenario).outcome("x")
        assert curve.first_impact_harm[k] == pytest.approx(driven.first_impact_harm[0], rel=1e-9)
        assert curve.total_harm[k] == pytest.approx(driven.total_harm[0], rel=1e-9)
    assert (np.diff(curve.deceleration_mps2) > 0.0).all()
    assert (curve.deceleration_mps2[0], curve.deceleration_mps2[-1]) == (0.0, 7.0)


def test_curve__the_others_follow_their_scripts(paper_random: Scenario) -> None:
    coasting = paper_random.replace(roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "coast"})
    world = paper_random.sample(1, 7).worlds
    curve = deceleration_curve(world, Task(coasting, (1,)), points=5)
    driven = evaluate(world, {"x": make_agent("full_brake")}, scenario=coasting).outcome("x")
    assert curve.total_harm[-1] == pytest.approx(driven.total_harm[0], rel=1e-9)
    assert curve.total_harm[-1] > 100.0  # Vehicle 3 arrives at about 20 m/s
    assert "Vehicle 1 full_brake, Vehicle 3 coast" in deceleration_figure(curve).get_supxlabel()


def test_curve__needs_one_world_and_two_points(paper_random: Scenario) -> None:
    with pytest.raises(InvalidInput, match="exactly one"):
        deceleration_curve(paper_random.sample(2, 7).worlds, Task(paper_random, (1,)))
    with pytest.raises(InvalidInput, match="points = 1"):
        deceleration_curve(paper_random.sample(1, 7).worlds, Task(paper_random, (1,)), points=1)


def test_figure__marks_what_e_v2x_bm_takes_and_the_best_known(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load_scenario("paper-distance")
    proof = Proof(np.array([False]), np.array(["rear"]), np.array([0.5]))
    known = Limits(proof, np.array([1.25]), np.array([2.5]))
    monkeypatch.setattr(module, "known_limits", lambda worlds, task: known)
    figure = deceleration_figure(deceleration_curve(seven_seven(scenario), Task(scenario, (1,))), title="a title")
    axes, strips = figure.axes
    assert "a* = 5.170 m/s², closed form: predicts 4.03" in texts(figure)
    assert "coupled, least first-impact harm: 10.55" in texts(figure)  # 10.546 in docs/cli.md
    assert "best known profile: 1.25 first-impact, 2.50 total; proven: no less than 0.50" in [
        text.get_text() for text in axes.texts
    ]
    assert {(1.25, 1.25), (2.5, 2.5)} <= {tuple(line.get_ydata()) for line in axes.lines}
    assert axes.get_title(loc="left") == "a title"
    assert [label.get_text() for label in strips.get_yticklabels()] == ["front pair", "rear pair"]
    assert len(picture_bytes(figure, "figure.png")) < 150_000


def test_figure__of_a_vehicle_without_limits_has_no_level_line(pair: Scenario) -> None:
    figure = deceleration_figure(deceleration_curve(pair.sample(1, 0).worlds, Task(pair, (1,))))
    axes, strips = figure.axes
    assert not [text for text in axes.texts if "best known" in text.get_text()]
    assert [label.get_text() for label in strips.get_yticklabels()] == ["front pair"]
