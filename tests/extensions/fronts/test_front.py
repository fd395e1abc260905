"""The front of a list: no constant, agent or point of other weights is better; one answer for any batch."""

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.fronts.front import Front, amounts_of, least_largest, search_front
from ethbrake_marl.extensions.fronts.results import FRONT, front_results, front_sheet, full_braking, hypervolumes
from ethbrake_marl.extensions.fronts.weights import corners, weight_grid
from ethbrake_marl.extensions.search.best_harm import task_problem
from ethbrake_marl.extensions.search.shipped import best_known
from ethbrake_marl.first_edition.evaluation.statistics import mean, paired_difference
from ethbrake_marl.first_edition.scenario.task import Task
from tests.first_edition.evaluation.test_clusters import recorded

PAPER = eb.load_scenario("paper-random")
WORLDS = PAPER.sample(40, 7).worlds
WEIGHTS = np.concatenate([weight_grid(3, 2), np.ones((1, 3)), corners(3)])
AGENTS = ["full_brake", "e_v2x_bm", "universal", "ppo"]


@pytest.fixture(scope="module")
def front() -> Front:
    return search_front(PAPER, WORLDS, WEIGHTS, budget=300, agents=AGENTS)


def test_point__is_never_beaten_under_its_weights_by_another_point_a_constant_or_an_agent(front: Front) -> None:
    problem = task_problem(WORLDS, Task(PAPER, (1,)))
    constants = [problem.borne(problem.constant(problem.even_grid(101)[:, [q]]))["first"] for q in range(101)]
    others = [*front.borne["first"], *constants, *(each for borne in front.agents.values() for each in borne["first"])]
    for row, least in zip(front.weights, front.amounts, strict=True):
        for borne in others:
            assert (least <= amounts_of(borne, row)).all()


def test_point__is_never_beaten_by_a_shipped_policy_that_was_not_given() -> None:
    obstacle = eb.load_scenario("paper-random-obstacle")
    worlds, row = obstacle.sample(30, 777).worlds, [0.2, 0.8, 0.0]
    found = search_front(obstacle, worlds, [row], budget=30, harm_count="total")
    fixed = obstacle.replace(harm_weight=row, objective="preference")
    for name in ("universal", "rollout-obstacle"):
        agent = eb.make_agent(name, scenario=fixed)
        outcome = eb.evaluate(worlds, {"it": agent}, scenario=obstacle, aftermath=False).outcome("it")
        assert (found.amounts[0] <= amounts_of(outcome.vehicle_harm("total"), np.array(row))).all()


def test_agents__beside_the_front_bear_what_an_evaluation_says(front: Front) -> None:
    fixed = PAPER.replace(harm_weight=WEIGHTS[4].tolist(), objective="preference")
    for spec in AGENTS:
        agent = eb.make_agent(spec, scenario=fixed)
        outcome = eb.evaluate(WORLDS, {"it": agent}, scenario=PAPER, aftermath=False).outcome("it")
        for count in ("first", "total"):
            assert front.agents[spec][count][4].tolist() == outcome.vehicle_harm(count).tolist()


def test_profiles__cause_the_harm_that_is_told(front: Front) -> None:
    problem = task_problem(WORLDS, Task(PAPER, (1,)))
    for k, profiles in enumerate(front.profiles):
        for count, borne in problem.borne(profiles).items():
            assert borne.tolist() == front.borne[count][k].tolist()


def test_equal_weights__are_at_least_as_good_as_the_tables(front: Front) -> None:
    known = best_known(WORLDS, Task(PAPER, (1,)))["first"]
    assert (front.borne["first"][6].sum(axis=1) <= known + 1e-9).all()


def test_corner__decides_between_equals_by_the_others(front: Front) -> None:
    alone, first = front.borne["first"][0], front.borne["first"][-1]  # Vehicle 3's harm alone, and first
    assert alone[:, 2].mean() == pytest.approx(first[:, 2].mean(), abs=0.01)
    assert first.sum() <= alone.sum() + 1e-9


def test_front__does_not_depend_on_the_other_worlds_or_threads(front: Front) -> None:
    some = np.array([3, 17, 30])
    again = search_front(PAPER, WORLDS.take(some), WEIGHTS, budget=300, agents=AGENTS, threads=3)
    for count in ("first", "total"):
        assert again.borne[count].tolist() == front.borne[count][:, some].tolist()


def test_nondominated__keeps_the_sum_of_each_world(front: Front) -> None:
    kept = front.nondominated()
    assert kept.shape == front.amounts.shape and kept[6].all()


def test_maximin__is_at_least_as_good_for_whoever_bears_most_as_every_point(front: Front) -> None:
    found = least_largest(PAPER, WORLDS, front, budget=300)["first"].max(axis=1)
    assert (found <= front.borne["first"].max(axis=2).min(axis=0)).all()


def test_team__has_a_front_but_no_agents() -> None:
    pair = eb.load_scenario("cooperation-3-pair")
    worlds = pair.sample(2, 3).worlds
    found = search_front(pair, worlds, [[1, 1, 1], [1, 0, 0]], budget=200, harm_count="total")
    assert (found.borne["total"][1, :, 0] <= found.borne["total"][0, :, 0]).all()
    with pytest.raises(InvalidInput, match="agents can drive only one"):
        search_front(pair, worlds, [[1, 1, 1]], agents=["full_brake"])


def test_results__of_recorded_rows_have_intervals_by_recording() -> None:
    scenario = recorded(8)
    sample = scenario.sample(80, 7)
    borne = full_braking(scenario, sample)
    some = {count: each[np.newaxis] for count, each in borne.items()}
    less = {count: 0.9 * each for count, each in some.items()}
    front = Front(np.ones((1, 3)), "first", less, (), {"agent": some})
    found = front_results(front, scenario, sample, {"full_brake": borne}, 7)
    (point,), (driven,), by = found["points"], found["agents"]["agent"], sample.clusters
    amounts = [amounts_of(each["first"][0], front.weights[0]) for each in (less, some)]
    assert found["beside"]["full_brake"]["total"][1] == mean(borne["total"][:, 1], by).to_json()
    assert point["amount"] == mean(amounts[0], by).to_json()
    assert driven["above"] == paired_difference(amounts[1], amounts[0], by).to_json()
    assert found["recordings"] == 8 and "95 % intervals by 8 recordings." in front_sheet(found).note
    wide, narrow = (hypervolumes(front, borne["first"], names)[0]["of"][FRONT]["volume"] for names in (by, None))
    assert wide["value"] == narrow["value"] and np.ptp(wide["interval"]) > np.ptp(narrow["interval"])
