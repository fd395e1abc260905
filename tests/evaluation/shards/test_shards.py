"""A list in shards: the same bits for any number of shards, workers and any size of the blocks, and today's figures."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.evaluation import evaluate, summarise
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.evaluation.measures import Tally, measures
from ethbrake_marl.evaluation.results import Question
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.studies.jobs import evaluate_shards

AGENTS = ("full_brake", "e_v2x_bm:pairwise")
N = 3_300

FAILING = """
import numpy as np
from ethbrake_marl.errors import PhysicsError

class Failing:
    name, knows = "failing", "own sensors"

    def begin(self, alert, vehicle, scripts):
        return alert.gaps_m[:, 0] < {below}

    def act(self, worlds, memory, vehicle):
        if memory.any():
            raise PhysicsError({{int(row): "planted" for row in np.flatnonzero(memory)}})
        return -worlds.vehicles.braking_capacity_mps2[:, vehicle], memory

def make():
    return Failing()
"""


@pytest.fixture(scope="module")
def asked(paper_random: Scenario):
    return Question(paper_random, AGENTS, N, 11, objectives=("own",)).ask()


@pytest.fixture(scope="module")
def tally(asked) -> Tally:
    return evaluate_shards(asked, shards=1)


@pytest.mark.parametrize(("shards", "block"), [(2, 2_000), (4, 1_000), (3, 5_000)])
def test_tally__is_the_same_bits_in_any_shards_and_blocks(asked, tally: Tally, shards: int, block: int) -> None:
    found = evaluate_shards(asked, shards=shards, block=block)
    assert found == tally
    assert json.dumps(asked.to_json(found, asked.summarise(found))) == json.dumps(
        asked.to_json(tally, asked.summarise(tally))
    )


@pytest.mark.slow
def test_tally__is_the_same_bits_from_two_processes(paper_random: Scenario) -> None:
    asked = Question(paper_random, ("full_brake", "e_v2x_bm"), 3_000, 5).ask()
    alone = evaluate_shards(asked, shards=1)
    assert evaluate_shards(asked, shards=3, jobs=2) == alone


def test_rows__are_those_of_evaluate_on_the_same_worlds(asked, tally: Tally, paper_random: Scenario) -> None:
    sample = paper_random.sample(N, 11)
    evaluation = evaluate(sample, make_lineup(AGENTS, paper_random), scenario=paper_random, seed=11, chunk=777)
    sharded, whole = asked.summarise(tally), summarise(evaluation)
    for one, other in zip(sharded, whole, strict=True):
        assert one.collision_rate.value == other.collision_rate.value
        assert one.collision_rate.interval == pytest.approx(other.collision_rate.interval, abs=4e-4)
        for measure in measures(()):
            if not (measure.limits or measure.name.endswith("_rate")):
                assert one[measure.name] == other[measure.name], measure.name  # to the last bit: both are exact sums
        names = ("collisions", "horizon_ends", "knows", "hidden_share", "episodes", "policy_share", "beside_paper",
                 "scenario_sha256")  # fmt: skip
        for name in names:
            assert getattr(one, name) == getattr(other, name), name
        assert one.parameters == other.parameters
        assert one["mean_regret_first"] is None  # no table holds the worlds of seed 11
    assert tally.rescore(["own"], 3) == evaluation.rescore(["own"])


def test_regret__where_a_table_holds_every_world(paper_random: Scenario) -> None:
    question = Question(paper_random, ("full_brake", "e_v2x_bm:pairwise"), 1_100, 7)
    asked = question.ask()
    found = asked.summarise(evaluate_shards(asked, shards=2))
    sample = paper_random.sample(1_100, 7)
    lineup = make_lineup(question.agents, paper_random)
    whole = summarise(evaluate(sample, lineup, scenario=paper_random, seed=7))
    for one, other in zip(found, whole, strict=True):
        for measure in measures(()):
            if measure.limits and not measure.name.endswith("_rate"):
                assert one[measure.name] == other[measure.name] != None, measure.name  # noqa: E711
        assert one["unavoidable_rate"].value == other["unavoidable_rate"].value
        assert one.below_best_known == other.below_best_known


def test_worlds_that_fail__are_left_out_for_all_agents(tmp_path: Path, paper_random: Scenario) -> None:
    file = tmp_path / "failing.py"
    file.write_text(FAILING.format(below=5.01))
    question = Question(paper_random, ("full_brake", f"{file}:make"), 1_100, 7)
    asked = question.ask()
    one, two = (evaluate_shards(asked, shards=k) for k in (1, 2))
    sample = paper_random.sample(1_100, 7)
    bad = np.flatnonzero(sample.worlds.gaps_m[:, 0] < 5.01)
    assert one == two and one.worlds == 1_100 - bad.size and bad.size > 0
    assert [(left.world, left.seed, left.reason) for left in one.left_out] == [(k, 7, "planted") for k in bad.tolist()]
    rows = asked.summarise(one)
    good = np.setdiff1d(np.arange(1_100), bad)
    whole = summarise(
        evaluate(sample.worlds.take(good), make_lineup(["full_brake"], paper_random), scenario=paper_random)
    )
    assert rows[0].first_impact_harm == whole[0].first_impact_harm
    assert len(rows[0].left_out) == bad.size


def test_a_list_of_which_every_world_fails__is_refused(tmp_path: Path, paper_random: Scenario) -> None:
    file = tmp_path / "failing_all.py"
    file.write_text(FAILING.format(below=1e9))
    asked = Question(paper_random, (f"{file}:make",), 1_500, 7).ask()
    with pytest.raises(PhysicsError, match="planted"):
        asked.summarise(evaluate_shards(asked, shards=2))


def test_tally__comes_back_from_json_as_it_was(tally: Tally) -> None:
    assert Tally.from_json(json.loads(json.dumps(tally.to_json()))) == tally
    whole = tally.to_json()
    agent = {"counts": {}, "moments": {"total_harm": [N, "0x1", "0x0"]}, "products": {}}
    short = {**agent, "moments": {"first_impact_harm": [3, "0x0", "0x0"], "total_harm": [N, "0x0", "0x0"]}}
    wrong = [{"worlds": -1}, {"agents": {"x": {}}}, {"agents": {"x": agent}}, {"agents": {"x": short}}]
    wrong += [{"left_out": [[0, 7, 3, None]]}, {"ranges": {"gaps_m": [1]}}, {"worlds": 10**30}]
    for bad in ({}, [], None, *({**whole, **change} for change in wrong)):
        with pytest.raises(InvalidInput, match="no tally"):
            Tally.from_json(bad)


def test_worlds_hash__tells_another_list(paper_random: Scenario, tally: Tally) -> None:
    for scenario, seed in ((paper_random, 12), (load_scenario("paper-random-early"), 11)):
        other = Question(scenario, ("full_brake",), N, seed).ask()
        assert evaluate_shards(other, shards=1).worlds_hash != tally.worlds_hash


def test_shard_bounds__are_whole_leaves(paper_random: Scenario) -> None:
    def shard_bounds(episodes: int, shards: int) -> list[tuple[int, int]]:
        return Question(paper_random, AGENTS, episodes, 7).bounds(shards)

    assert shard_bounds(10_300, 7)[-1] == (9_000, 10_300)
    assert shard_bounds(10_300, 1) == [(0, 10_300)]
    assert shard_bounds(500, 7) == [(0, 500)]
    for episodes, shards in ((10_300, 7), (10**8, 97), (999, 3)):
        bounds = shard_bounds(episodes, shards)
        assert bounds[0][0] == 0 and bounds[-1][1] == episodes
        assert all(one[1] == other[0] for one, other in pairwise(bounds))


@pytest.mark.parametrize("bounds", [(500, 1_000), (0, 999), (1_000, 1_000)])
def test_a_shard_that_is_no_range_of_leaves__is_refused(asked, bounds: tuple[int, int]) -> None:
    with pytest.raises(InvalidInput, match="whole leaves"):
        asked.answer(*bounds)


def test_a_shard__refuses_another_version_than_it_was_asked_about(asked) -> None:
    other = replace(asked, identity={**asked.identity, "versions": {"numba": "0"}})
    with pytest.raises(InvalidInput, match="versions changed"):
        other.answer(0, 1_000)


@pytest.mark.long
def test_a_hundred_thousand_worlds__are_the_same_bits_in_1_2_and_7_shards(paper_random: Scenario) -> None:
    asked = Question(paper_random, ("full_brake", "e_v2x_bm"), 100_000, 7).ask()
    one, two, seven = (evaluate_shards(asked, shards=k, jobs=min(k, 2)) for k in (1, 2, 7))
    assert one == two == seven
