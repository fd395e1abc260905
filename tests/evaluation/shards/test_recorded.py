"""Statistics of evaluations that were recorded before the search and the loop of episodes were made faster."""

from __future__ import annotations

import hashlib
import json

import pytest

from ethbrake_marl.evaluation.results import Question
from ethbrake_marl.scenario import load_scenario

AGENTS = ("full_brake", "e_v2x_bm", "e_v2x_bm:pairwise")

# SHA-256 of the tally of 1,200 worlds of seed 11, its first 16 digits, by the code of 20 November 2026 (6d87c15);
# `stress-wide` and `realistic-mixed` on worlds that are the same on every processor.
RECORDED = {
    ("paper-random", "first"): "5ae559be31df8505",
    ("paper-random", "total"): "29b0ca9c08a04ae9",
    ("stress-wide", "first"): "22b5e762e6c951d0",
    ("stress-wide", "total"): "4664512f66236619",
    ("cooperation-2-five", "first"): "1922c828a6f1ea16",
    ("cooperation-2-five", "total"): "e9edef37a4098d2f",
    ("paper-random-obstacle", "first"): "e7a03a0982bc18ea",
    ("paper-random-obstacle", "total"): "10f6acd3dcfedde5",
    ("realistic-mixed", "first"): "1ae5e4977847725f",
    ("realistic-mixed", "total"): "616b5cb07da1c8d6",
}
# Of the first 250 of them, by code that gives the digests above.
FIRST_250 = {
    ("paper-random", "first"): "f306298691aca961",
    ("stress-wide", "total"): "6f54af14b777f89e",
    ("cooperation-2-five", "first"): "26c835879bdcb2a3",
    ("paper-random-obstacle", "total"): "8a39f7348bd5252a",
    ("realistic-mixed", "first"): "21ef20f79df3a8cf",
}


# Measures by the names that sums had then.
NAMES = {
    "collision_rate": "collisions", "vehicle_1_shoved_far_rate": "shoved_far", "unavoidable_rate": "unavoidable",
    "avoidable_collision_rate": "avoidable_collisions", "impact_proven_rate": "impact_proven",
    "vehicle_1_shoved_m": "shoved_m", "mean_regret_first": "regret_first", "mean_regret_total": "regret_total",
    "best_known_first_impact_harm": "best_known_first", "best_known_total_harm": "best_known_total",
    "best_known_minus_proven_first": "gap_first", "best_known_minus_proven_total": "gap_total",
}  # fmt: skip


def digest_of(tally):
    told = tally.to_json()
    for agent in told["agents"].values():
        assert all(of == tally.worlds for _, of in agent["counts"].values())
        agent["counts"] = {name: count for name, (count, _) in agent["counts"].items()}
        agent |= {part: {NAMES.get(name, name): each for name, each in agent[part].items()} for part in agent}
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "harm_count"), RECORDED)
def test_tally__is_the_one_that_was_recorded(scenario, harm_count):
    asked = Question(load_scenario(scenario), AGENTS, 1_200, 11, harm_count).ask()
    tally = asked.answer(0, 1_000) + asked.answer(1_000, 1_200)
    assert digest_of(tally) == RECORDED[scenario, harm_count]


@pytest.mark.parametrize(("scenario", "harm_count"), FIRST_250)
def test_tally__of_fewer_worlds_is_the_one_that_was_recorded(scenario, harm_count):
    asked = Question(load_scenario(scenario), AGENTS, 250, 11, harm_count).ask()
    assert digest_of(asked.answer(0, 250)) == FIRST_250[scenario, harm_count]
