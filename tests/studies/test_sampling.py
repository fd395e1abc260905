"""The study of the sampled map: what counts as a chain impact, the fitted order, the report, and the docs."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from ethbrake_marl.evaluation.identity import identity_line
from ethbrake_marl.physics import advance, make_worlds
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.sampling import (
    CONTROLS,
    chain_impacts,
    convergence,
    convergence_table,
    sampling_report,
)


def test_chain_impact__is_one_that_moves_a_third_vehicle():
    # Vehicles 1 and 2 touch at rest when Vehicle 3 comes; in the second world they stand 9 m apart.
    worlds = make_worlds(
        [[0.0, 4.0], [9.0, 4.0]],
        [0.0, 0.0, 4.0],
        braking_capacity_mps2=6.0,
        driving_capacity_mps2=6.0,
        latency_s=0.0,
        mass_t=1.0,
        restitution=0.0,
    )
    _, impacts = advance(worlds, [0.0, 0.0, 0.0], 1.5, record=True)
    assert chain_impacts(worlds, impacts.rows).tolist() == [True, False]


@pytest.mark.parametrize("agent", CONTROLS)
def test_table__in_the_docs_is_the_one_that_the_study_prints(agent):
    page = (Path(__file__).parents[2] / "docs" / "sampled.md").read_text("utf-8")
    docs = re.sub(r"(?<=\w)\n(?=\w)", " ", page).splitlines()  # a sentence on one line, as it is printed
    worlds = load_scenario("paper-random").sample(2000, 7).worlds
    printed = convergence_table(convergence(worlds, agent, steps_s=(0.2, 0.1, 0.05, 0.02))).splitlines()
    assert docs.count(printed[0]) == 1
    at = docs.index(printed[0])
    assert docs[at : at + 8] == printed[:-1]


def test_order__is_the_slope_of_the_error_up_to_a_tenth_of_a_second():
    worlds = load_scenario("paper-random").sample(200, 7).worlds
    study = convergence(worlds, "full_brake", steps_s=(0.2, 0.1, 0.05))
    low, high = study.column("first_median")[[2, 1]]
    assert study.order("first_median") == pytest.approx(math.log2(high / low))
    assert convergence(worlds, "full_brake", steps_s=(0.2, 0.1)).order("first_median") is None


def test_report__writes_the_figure_and_returns_both_tables(tmp_path):
    text = sampling_report(tmp_path / "study.png", n=20)
    assert (tmp_path / "study.png").read_bytes().startswith(b"\x89PNG")
    assert [text.count(f"`{agent}`: exact mean harm") for agent in CONTROLS] == [1, 1]
    assert text.count("\n| order | ") == 2
    scenario = load_scenario("paper-random")
    assert text.splitlines()[-1] == identity_line(scenario, scenario.sample(20, 7))
