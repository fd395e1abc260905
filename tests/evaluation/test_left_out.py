"""One world that the physics cannot advance takes no other with it: it is named, and left out for all agents."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.evaluation import Evaluation, evaluate, summarise, write_per_world
from ethbrake_marl.evaluation.inputs import make_agents
from ethbrake_marl.pages.report import Report
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario
from tests.failing_worlds import planted_list, without

N, PLANTED, SEED = 12, [3, 7], 7
HARD = 8.5  # gap (m) of the world in which ``Failing`` fails


class Failing:
    """Brakes fully; in one world, known by a gap of its own, it meets a defect of the physics at its third decision."""

    name = "failing"

    def begin(self, alert: Worlds, vehicle: int, scripts: object) -> tuple[Bools, Ints]:
        return alert.gaps_m[:, 1] == HARD, np.zeros(alert.n, np.int64)

    def act(self, worlds: Worlds, memory: tuple[Bools, Ints], vehicle: int) -> tuple[Floats, tuple[Bools, Ints]]:
        hard, decisions = memory
        if (wrong := np.flatnonzero(hard & (decisions == 2))).size:
            raise PhysicsError({int(row): "planted" for row in wrong})
        return -worlds.vehicles.braking_capacity_mps2[:, vehicle], (hard, decisions + 1)


@pytest.fixture(scope="module")
def found(paper_random: Scenario) -> Evaluation:
    sample = planted_list(paper_random, N, SEED, PLANTED)
    sample.worlds.gaps_m[10, 1] = HARD
    names = ("full_brake", "e_v2x_bm", "planner:8", "best_harm:50")
    agents = {**make_agents(names, paper_random), "failing": Failing()}
    return evaluate(sample, agents, scenario=paper_random, seed=SEED, chunk=5)


def test_evaluate__names_the_worlds_and_leaves_them_out_for_all_agents(found: Evaluation) -> None:
    assert [(left.world, left.seed, left.agent) for left in found.left_out] == [
        (3, SEED, "full_brake"),
        (7, SEED, "full_brake"),
        (10, SEED, "failing"),
    ]
    assert "a contact was missed between 0 s and 0.5 s" in found.left_out[0].reason
    assert found.left_out[2].reason == "planted"
    assert found.index.tolist() == without(N, [3, 7, 10]).tolist()
    for outcome in found.outcomes.values():
        assert len(outcome.collided) == outcome.final.n == found.worlds.n == 9
        assert np.isfinite(outcome.total_harm).all()
    with pytest.raises(PhysicsError, match=r"world 3: full_brake: a contact was missed.*world 10: failing: planted"):
        found.complete()


def test_evaluate__the_other_worlds_are_as_if_those_were_not_in_the_list(
    found: Evaluation, paper_random: Scenario
) -> None:
    rows = without(N, [3, 7, 10])
    well = paper_random.sample(N, SEED).worlds.take(rows)
    alone = evaluate(well, {"e_v2x_bm": make_agent("e_v2x_bm")}, scenario=paper_random)
    one, other = found.outcome("e_v2x_bm"), alone.outcome("e_v2x_bm")
    assert np.array_equal(one.ledger.total_harm, other.ledger.total_harm)
    assert np.array_equal(one.predicted_harm, other.predicted_harm)
    assert alone.left_out == () and alone.complete() is alone


def test_evaluate__nothing_is_left_to_evaluate(paper_random: Scenario) -> None:
    sample = planted_list(paper_random, 2, SEED, [0, 1])
    with pytest.raises(PhysicsError, match="world 0: full_brake: a contact was missed"):
        evaluate(sample, {"full_brake": make_agent("full_brake")}, scenario=paper_random)


def test_table_json_and_report__say_how_many_and_which(found: Evaluation) -> None:
    rows = summarise(found)
    told = [row.to_json() for row in rows]
    assert all(row["episodes"] == 9 for row in told)
    assert all([left["world"] for left in row["left_out"]] == [3, 7, 10] for row in told)
    assert told[0]["left_out"][2] == {"world": 10, "seed": SEED, "agent": "failing", "reason": "planted"}
    for text in (rows.markdown(), Report("title", rows, found).html):
        assert "LEFT OUT for every agent: 3 of 12 worlds" in text
        assert "world 10 of seed 7 (failing: planted)" in text
    well = summarise(replace(found, left_out=()))
    assert well[0].to_json()["left_out"] == []
    assert "LEFT OUT" not in well.markdown()


def test_csv__has_a_row_for_each_that_says_so(found: Evaluation, tmp_path) -> None:
    write_per_world(tmp_path / "worlds.csv", found)
    rows = list(csv.DictReader((tmp_path / "worlds.csv").read_text("utf-8").splitlines()))
    assert len(rows) == 5 * N
    lost = [row for row in rows if row["ended"].startswith("left out")]
    assert [row["world"] for row in lost] == 5 * ["3", "7", "10"]
    assert {row["total_harm"] for row in lost} == {""} and lost[2]["ended"] == "left out: failing: planted"
    assert "" not in {row["total_harm"] for row in rows if row not in lost}
