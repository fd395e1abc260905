"""One best known per question, and no level with more learners that is worse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.agents.registry import Team, make_agent
from ethbrake_marl.errors import Progress
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.limits.limits import best_harm, chunks_left
from ethbrake_marl.scenario import Sample, load_scenario
from ethbrake_marl.studies.ablation import (
    Level,
    LevelOptimum,
    Plan,
    best_known,
    common_worlds,
    questions,
    read_levels,
    search_all,
    with_scheme,
)

WORLDS = 30
NAMES = ("cooperation-1-front", "cooperation-2-paper", "cooperation-3-pair", "cooperation-4-all")


def answer(level: Level, budget: int, agent: str = "full_brake") -> LevelOptimum:
    worlds = level.scenario.sample(WORLDS, 7).worlds
    table = best_harm(level.scenario, worlds, budget=budget, threads=1)
    return LevelOptimum(level, worlds, table, (Team.of(make_agent(agent), level.scenario.learners),))


@pytest.fixture(scope="module")
def answers() -> dict[str, LevelOptimum]:
    """Front does well by its policy alone, the paper by a long search, the pair and all three by neither."""
    front, paper, pair, everybody = read_levels(NAMES)
    found = [answer(front, 1, "e_v2x_bm"), answer(paper, 500), answer(pair, 1), answer(everybody, 1)]
    return {each.level.name: each for each in found}


def test_best_known__is_one_for_levels_that_ask_one_question(answers):
    front, paper = (best_known(answers[name], list(answers.values())) for name in NAMES[:2])
    scenario = answers[NAMES[0]].level.scenario
    policy = evaluate(answers[NAMES[0]].worlds, {"e": make_agent("e_v2x_bm")}, scenario=scenario).outcome("e")
    for count, harm in paper.items():
        np.testing.assert_array_equal(front[count], harm)
        assert (harm <= np.minimum(answers[NAMES[1]].searched.best[count].harm, policy.ledger.world_harm(count))).all()


def test_best_known__more_learners_are_never_worse_world_by_world(answers):
    """With the obstacle so far away that nobody reaches it."""
    far = load_scenario("cooperation-4-all").replace(obstacle_gap_m=200)
    every = [*list(answers.values())[:3], answer(Level(far), 1)]
    paper, pair, everybody = (best_known(each, every) for each in every[1:])
    for harm_count, harm in pair.items():
        assert (harm <= paper[harm_count] + 1e-9).all() and (everybody[harm_count] <= harm + 1e-9).all()
        assert harm.mean() < every[2].searched.best[harm_count].harm.mean() - 0.01
    with_obstacle = best_known(answers["cooperation-4-all"], list(answers.values()))
    for harm_count, best in answers["cooperation-4-all"].searched.best.items():
        assert with_obstacle[harm_count].mean() < best.harm.mean() - 0.1


def test_best_known__an_obstacle_that_is_reached_counts():
    """All brake fully: without an obstacle it is harmless; one 20 m ahead stands where Vehicle 1 runs into it."""
    pair = load_scenario("cooperation-3-pair").replace(gaps_m=60)
    near = pair.replace(name="near", roles=dict.fromkeys(pair.vehicle_names, "learner"), obstacle_gap_m=20)
    answers = [answer(Level(pair), 1), answer(Level(near), 1)]
    assert best_known(answers[0], answers)["total"].max() == 0.0
    assert best_known(answers[1], answers)["total"].min() > 0.0


def test_best_known__other_latencies_scripts_or_learners_count_for_nothing(answers):
    pair = answers["cooperation-3-pair"]
    alone = best_known(pair, [pair])
    late = replace(answers[NAMES[1]].worlds.vehicles, latency_s=pair.worlds.vehicles.latency_s + 0.1)
    coasting = load_scenario("cooperation-2-paper").replace(name="mine", roles={"vehicle_1": "coast"})
    others = [
        replace(answers[NAMES[1]], worlds=replace(answers[NAMES[1]].worlds, vehicles=late)),
        answer(Level(coasting.replace(roles={"vehicle_1": "coast", "vehicle_2": "learner"})), 1),
        answers["cooperation-4-all"],
    ]
    for count, harm in best_known(pair, [pair, *others]).items():
        np.testing.assert_array_equal(harm, alone[count])


def test_best_known__decisions_at_other_times_count_for_nothing():
    """Vehicle 3 may act 0.05 s before Vehicle 2, so the pair's decisions fall between those of Vehicle 2 alone."""
    pair = load_scenario("cooperation-3-pair").replace(latency_s=[0, 0.5, 0.45])
    one, both = answer(Level(pair.with_learners(["vehicle_2"])), 500), answer(Level(pair), 1)
    alone = best_known(both, [both])
    for count, harm in best_known(both, [one, both]).items():
        np.testing.assert_array_equal(harm, alone[count])
        assert one.searched.best[count].harm.mean() < harm.mean()


def left(plan: Plan, level: Level, part: Sample) -> tuple[int, list[Path]]:
    return chunks_left(level.scenario, part, budget=plan.budget, chunks=plan.optimum_folder(level))


def test_questions__each_is_searched_once_and_what_is_kept_is_not_searched_again(tmp_path, tiny):
    levels = tuple(read_levels(NAMES))
    recipe = with_scheme(load_recipe(str(tiny)), None)
    plan = Plan(levels, (recipe,), 1, 300, 10, 7, 5, 10, tmp_path)
    samples = common_worlds(levels, 10, 7)
    asked = questions(plan, samples)
    assert [[level.name for level in alike] for *_, alike in asked] == [list(NAMES[:2]), [NAMES[2]], [NAMES[3]]]
    assert [left(plan, level, part) for level, part, _ in asked] == [(5, [])] * 3
    told = []
    search_all(plan, samples, 1, told.append)
    assert told == [Progress(f"joint optimum of {name}", 5, 5) for name in (NAMES[0], *NAMES[2:])]
    assert [left(plan, level, part) for level, part, _ in asked] == [(0, [])] * 3
    assert left(replace(plan, budget=11), *asked[0][:2]) == (5, [])
    fewer = questions(replace(plan, search_episodes=4), samples)[0]
    assert left(plan, *fewer[:2]) == (4, [])
    damaged = tmp_path / "optimum" / NAMES[2] / "0000000.npz"
    damaged.write_bytes(b"no table")
    assert left(plan, *asked[1][:2]) == (5, [damaged])
