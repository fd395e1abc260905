"""Harm against processor time: the harms are those of ``evaluate``, the time is that of the whole episode."""

from __future__ import annotations

import time

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.equal_time import equal_time

PAPER = load_scenario("paper-random")


class Slow:
    """Coasts, and takes 2 ms of processor time whenever an episode begins."""

    name, knows = "slow", "own sensors"

    def begin(self, worlds, vehicle, rows):
        until = time.process_time() + 2e-3 * worlds.n
        while time.process_time() < until:
            pass

    def act(self, worlds, vehicle):
        return np.zeros(worlds.n)


def test_equal_time__tells_the_harm_of_an_evaluation_and_the_time_it_took():
    sample = PAPER.sample(20, 8)
    agents = {"slow": Slow(), **make_lineup(["full_brake", "e_v2x_bm"], PAPER)}
    rows = {
        row.agent: row for row in equal_time(sample, agents, scenario=PAPER, against="full_brake", harm_count="total")
    }
    result = evaluate(sample, agents, scenario=PAPER)
    full = result.outcome("full_brake").total_harm
    for name, row in rows.items():
        outcome = result.outcome(name)
        assert row.first_impact_harm.value == pytest.approx(outcome.first_impact_harm.mean(), rel=1e-12)
        assert row.total_harm.value == pytest.approx(outcome.total_harm.mean(), rel=1e-12)
        assert row.difference.value == pytest.approx((outcome.total_harm - full).mean(), abs=1e-12)
        assert 0.0 < row.lowest_ms <= row.median_ms <= row.highest_ms
    assert rows["slow"].median_ms > max(2.0, rows["full_brake"].median_ms)
    assert list(rows) == sorted(rows, key=lambda name: rows[name].median_ms)
    assert rows["e_v2x_bm"].to_json()["knows"] == "true model"


def test_equal_time__refuses_what_it_cannot_compare():
    agents = make_lineup(["full_brake"], PAPER)
    with pytest.raises(UnknownName, match="agent to compare with 'full_break'"):
        equal_time(PAPER.sample(2, 8), agents, scenario=PAPER, against="full_break")
    with pytest.raises(InvalidInput, match="repeats = 0: must be a whole number, at least 1"):
        equal_time(PAPER.sample(2, 8), agents, scenario=PAPER, against="full_brake", repeats=0)
