from __future__ import annotations

import csv
from types import SimpleNamespace

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.studies.experiment import results_csv, telling_world


@pytest.mark.parametrize(
    ("before", "after", "row"),
    [
        ([9.0, 0.0, 5.0, 7.0], [1.0, 0.0, 4.0, 2.0], 3),  # savings 8, -, 1, 5
        ([4.0, 3.0], [0.0, 0.0], 1),  # of two, the smaller saving
        ([0.0, 0.0], [0.0, 5.0], 0),  # full braking harms nobody
    ],
)
def test_telling_world__is_the_median_saving_among_harmful_worlds(before, after, row):
    harms = {"full_brake": before, "ppo": after}
    by_count = {name: {"first": np.ones(4), "total": np.array(harm)} for name, harm in harms.items()}
    outcome = {name: SimpleNamespace(world_harm=found.__getitem__) for name, found in by_count.items()}
    evaluation = SimpleNamespace(outcome=outcome.__getitem__, outcomes=harms)
    assert telling_world(evaluation, "total") == row


def test_results_csv__an_interval_becomes_two_columns_and_nothing_an_empty_cell():
    scenario = eb.load_scenario("paper-random")
    rows = eb.summarise(
        eb.evaluate(scenario.sample(3, 1), make_lineup(["coast", "e_v2x_bm"], scenario), scenario=scenario)
    )
    head, coast, bm = csv.reader(results_csv(rows).splitlines())
    column = {name: k for k, name in enumerate(head)}
    assert "parameters" not in column
    assert float(coast[column["first_impact_harm_low"]]) == rows[0].first_impact_harm.interval[0]
    assert float(coast[column["first_impact_harm_high"]]) == rows[0].first_impact_harm.interval[1]
    assert coast[column["predicted_harm"]] == ""
    assert float(bm[column["predicted_harm"]]) == rows[1]["predicted_harm"].value
    assert coast[column["harm_decrease_first"]] == ""  # full braking was not evaluated
