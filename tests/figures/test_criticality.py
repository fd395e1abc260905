from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import curves as module, evaluate
from ethbrake_marl.evaluation.curves import avoidability_boundary, criticality_map
from ethbrake_marl.figures import criticality_figure, picture_bytes
from ethbrake_marl.limits.limits import Limits, known_limits
from ethbrake_marl.scenario import Scenario, Task, load_scenario

DISTANCE = load_scenario("paper-distance")
FULL = {"full_brake": make_agent("full_brake")}


def test_map__its_cells_are_the_worlds_of_both_gaps() -> None:
    found = criticality_map(DISTANCE, FULL, cells=3)
    assert found.gap_1_m.tolist() == found.gap_2_m.tolist() == [5.0, 7.5, 10.0]
    columns = {"gap_1_m": [10.0], "gap_2_m": [5.0], "speed_1_mps": [20.0], "speed_2_mps": [18.0], "speed_3_mps": [20.0]}
    world = DISTANCE.worlds_from_table(columns)
    alone = evaluate(world, FULL, scenario=DISTANCE).outcome("full_brake")
    assert found.harm("first")[0, 2] == alone.first_impact_harm[0]  # row: gap 2, column: gap 1
    assert found.harm("total")[0, 2] == alone.total_harm[0]
    assert found.harm("first")[0, 2] != found.harm("first")[2, 0]


def test_map__a_fixed_gap_is_drawn_around_it_and_a_range_can_be_given() -> None:
    found = criticality_map(load_scenario("paper-scenario-1"), FULL, cells=2)
    assert (found.gap_1_m.tolist(), found.gap_2_m.tolist()) == ([5.0, 15.0], [4.0, 12.0])
    found = criticality_map(DISTANCE, FULL, cells=2, gap_range_m=(6.0, 7.0))
    assert found.gap_1_m.tolist() == found.gap_2_m.tolist() == [6.0, 7.0]


def test_map__time_gaps_give_its_range_at_the_speed_of_the_rear_vehicle() -> None:
    scenario = DISTANCE.replace(
        time_gaps_s={"uniform": [0.25, 0.5]}, line_speed_mps=20, speed_deviations_mps=[0, -2, 0]
    )
    found = criticality_map(scenario, FULL, cells=2)
    assert (found.gap_1_m.tolist(), found.gap_2_m.tolist()) == ([4.5, 9.0], [5.0, 10.0])


def test_boundary__lies_between_avoidable_and_unavoidable_worlds() -> None:
    found = avoidability_boundary(DISTANCE, (5.0, 10.0), (5.0, 10.0))
    assert found is not None
    inside = np.isfinite(found[1]) & (found[1] > 5.001) & (found[1] < 9.999)
    assert inside.sum() > 100
    for shift, expected in ((1e-6, True), (-1e-6, False)):
        worlds = module._worlds_at(DISTANCE, found[0][inside], found[1][inside] + shift)
        limits = known_limits(worlds, Task(DISTANCE, (1,)))
        assert isinstance(limits, Limits)
        assert (limits.proof.avoidable == expected).all()


def test_boundary__leaves_the_range_and_jumps_where_it_does() -> None:
    def avoidable(gap_1: np.ndarray, gap_2: np.ndarray) -> np.ndarray:
        return (gap_1 >= 2.0) & (gap_2 >= 6.0 - gap_1)  # none for gap 1 < 2; then from gap 2 = 6 - gap 1 on

    gap_1, gap_2 = module._halve(avoidable, np.arange(7.0), (0.5, 5.0))
    assert gap_1.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert np.isnan(gap_2[0])
    assert gap_2[1:] == pytest.approx([5.0, 4.0, 3.0, 2.0, 1.0, 0.5], abs=1e-9)


def test_figure__draws_harm_and_boundary_and_names_both_sides() -> None:
    found = criticality_map(DISTANCE, FULL, cells=9)
    figure = criticality_figure(found)
    first, total = figure.axes[:2]
    assert first.get_shared_x_axes().joined(first, total) and first.get_shared_y_axes().joined(first, total)
    for axes, count in ((first, "first"), (total, "total")):
        drawn = np.ma.filled(axes.collections[0].get_array(), 0.0).reshape(9, 9)
        np.testing.assert_array_equal(np.nan_to_num(drawn), found.harm(count))
        assert {text.get_text() for text in axes.texts} == {"avoidable", "unavoidable"}
        line = axes.lines[0].get_xydata()
        np.testing.assert_array_equal(line[:, 1], found.boundary_gap_2_m)
    assert "full_brake" in first.get_title(loc="left")
    assert "proven" in figure.get_supxlabel()
    assert len(picture_bytes(figure, "figure.png")) < 150_000


def test_map__without_a_proof_has_no_boundary_and_says_so() -> None:
    scenario = DISTANCE.replace(roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "coast"})
    found = criticality_map(scenario, FULL, cells=2)
    assert found.avoidable is found.boundary_gap_1_m is found.boundary_gap_2_m is None
    figure = criticality_figure(found)
    assert not figure.axes[0].lines
    assert "Nothing is proven" in figure.get_supxlabel()


@pytest.mark.parametrize(
    ("agents", "options", "message"),
    [
        ({}, {}, "exactly one"),
        (FULL, {"cells": 1}, "cells = 1"),
        (FULL, {"gap_range_m": (5.0, 5.0)}, "0 <= low < high"),
        (FULL, {"gap_range_m": (-1.0, 5.0)}, "0 <= low < high"),
        (FULL, {"gap_range_m": (1.0, float("nan"))}, "0 <= low < high"),
    ],
)
def test_map__refuses_what_it_cannot_draw(agents: dict, options: dict, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        criticality_map(DISTANCE, agents, **options)


def test_map__refuses_one_gap_and_random_speeds(pair: Scenario, paper_random: Scenario) -> None:
    with pytest.raises(InvalidInput, match="one gap"):
        criticality_map(pair, FULL)
    late = DISTANCE.replace(latency_s={"uniform": [0.2, 0.5]})
    with pytest.raises(InvalidInput, match=r"latency_1_s is random, from 0.2 to 0.5.*needs everything but the first"):
        criticality_map(late, FULL, cells=2)
    with pytest.raises(InvalidInput, match=r"speed_1_mps is random, from 18 to 22.*paper-distance"):
        criticality_map(paper_random, FULL)
