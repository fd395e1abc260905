"""The front of a list: no constant, agent or point of other weights is better, and a batch changes nothing."""

from functools import cache

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.episode.counts import BUILT_IN_COUNTS, HarmCount
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.statistics import difference, mean
from ethbrake_marl.extensions.cooperation.front import (
    Front,
    corners,
    least_largest,
    observes_weights,
    search_front,
    weight_grid,
    weighted_harm,
)
from ethbrake_marl.extensions.cooperation.front_results import front_results, front_sheet, full_braking, hypervolumes
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.tables import best_stored
from ethbrake_marl.worlds.describe import clusters_of, columns_of
from tests.evaluation.lines import recorded

PAPER = eb.load_scenario("paper-random")
WEIGHTS = np.concatenate([weight_grid(3, 1), np.ones((1, 3)), corners(3)])
AGENTS = ["e_v2x_bm", "vine-paper", "vine-preference"]


@cache
def sampled() -> eb.State:
    return PAPER.sample(20, 7)


@pytest.fixture(scope="module")
def front() -> Front:
    return search_front(PAPER, sampled(), WEIGHTS, harm_count="first", budget=300, agents=AGENTS)


def preferring(row: np.ndarray) -> eb.Scenario:
    return PAPER.replace(harm_weight=row.tolist(), objective="preference")


def test_weighted__by_hand() -> None:
    """3 (1 * 2 + 4 * 5) / (1 + 4 + 0)."""
    assert weighted_harm(np.array([[2.0, 5.0, 100.0]]), np.array([1.0, 4.0, 0.0])).tolist() == [13.2]


def test_means__golden(front: Front) -> None:
    """The points begin with shipped tables and policies, which may be renewed."""
    assert front.borne["first"].mean(axis=1)[0].tolist() == pytest.approx([3.64, 2.98, 0.0], abs=0.02)
    assert front.borne["first"].mean(axis=1)[3].tolist() == pytest.approx(
        [3.4721550159616514, 2.9057313973142214, 0.060478832779794614], abs=1e-4
    )
    assert front.borne["first"].mean(axis=1)[2].tolist() == pytest.approx(
        [2.679382176856437, 4.643349143389841, 2.2849492360661285], abs=5e-3
    )
    assert front.agents["vine-paper"]["first"].mean() == pytest.approx(2.2635470461489393, abs=1e-12)


def test_point__is_never_beaten_under_its_weights_by_another_point_a_constant_or_an_agent(front: Front) -> None:
    problem = problem_of(eb.open_game(PAPER)[1], sampled())
    grid = problem.even_grid(101)
    constants = [problem.follow(problem.constant(grid[:, [q]])).borne_harm("first") for q in range(101)]
    others = [*front.borne["first"], *constants, *(each for borne in front.agents.values() for each in borne["first"])]
    for row, least in zip(front.weights, front.amounts, strict=True):
        for borne in others:
            assert (least <= weighted_harm(borne, row)).all()


def test_point__is_never_beaten_by_an_agent_that_was_not_given() -> None:
    obstacle, row = eb.load_scenario("paper-random-obstacle"), np.array([0.2, 0.8, 0.0])
    found = search_front(obstacle, obstacle.sample(20, 777), [row], budget=30, harm_count="total")
    scenario, game = eb.open_game(obstacle.replace(harm_weight=row.tolist(), objective="preference"))
    for name in ("plan", "vine-paper", "ppo"):
        agent = eb.make_agent(name, scenario=scenario)
        last = play_to_end(game, scenario.sample(20, 777), Team(name, {2: agent}))
        assert (found.amounts[0] <= weighted_harm(last.borne_harm("total"), row)).all()


@pytest.mark.parametrize("spec", AGENTS)
def test_agents__beside_the_front_bear_what_an_evaluation_says(spec: str, front: Front) -> None:
    scenario, game = eb.open_game(preferring(WEIGHTS[4]))
    agent = eb.make_agent(spec, scenario=scenario, harm_count="first")
    last = play_to_end(game, scenario.sample(20, 7), Team(spec, {2: agent}))
    for count in (each.name for each in BUILT_IN_COUNTS):
        assert front.agents[spec][count][4].tolist() == last.borne_harm(count).tolist()


def test_agents__that_do_not_observe_the_weights_drive_once() -> None:
    teams = {spec: Team(spec, {2: eb.make_agent(spec, scenario=PAPER)}) for spec in AGENTS}
    assert {spec: observes_weights(team) for spec, team in teams.items()} == {
        "e_v2x_bm": True, "vine-paper": False, "vine-preference": True,
    }  # fmt: skip


def test_equal_weights__are_as_good_as_the_tables(front: Front) -> None:
    known = best_stored(problem_of(eb.open_game(PAPER)[1], sampled()), HarmCount.of("first"))[0]
    assert (front.borne["first"][3].sum(axis=1) <= known + 1e-9).all()


def test_honest_cost__is_the_default_and_leaves_less_of_it_than_the_papers_rules(front: Front) -> None:
    mine = search_front(PAPER, sampled().take(np.arange(6)), WEIGHTS[[3]], budget=300, agents=["plan"])
    cost, papers, planned = (each["honest"][0].sum(axis=1) for each in (
        mine.borne, {"honest": front.borne["honest"][[3], :6]}, mine.agents["plan"]
    ))  # fmt: skip
    assert mine.harm_count == HarmCount.of("honest") and (cost <= planned).all() and cost.mean() < 0.9 * papers.mean()
    assert (mine.amounts[0] == pytest.approx(cost)) and (mine.borne["total"][0].sum(axis=1) <= cost + 1e-9).all()


def test_corner__decides_between_equals_by_the_others(front: Front) -> None:
    alone, first = front.borne["first"][0], front.borne["first"][-1]  # Vehicle 3's harm alone, and first
    assert alone[:, 2].mean() == pytest.approx(first[:, 2].mean(), abs=0.01) and first.sum() <= alone.sum() + 1e-9


def test_front__does_not_depend_on_the_other_worlds_or_threads(front: Front, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ethbrake_marl.extensions.cooperation.front.FRONT_CHUNK", 2)
    some, heard = np.array([3, 17, 11]), []
    again = search_front(
        PAPER, sampled().take(some), WEIGHTS, harm_count="first", budget=300, agents=AGENTS, threads=3,
        on_progress=lambda *each: heard.append(each),
    )  # fmt: skip
    for count in ("first", "total"):
        assert again.borne[count].tolist() == front.borne[count][:, some].tolist()
        assert again.agents["e_v2x_bm"][count].tolist() == front.agents["e_v2x_bm"][count][:, some].tolist()
    assert heard[-1] == (2 * 7 * 3, 2 * 7 * 3)


def test_maximin__is_at_least_as_good_for_whoever_bears_most_as_every_point(front: Front) -> None:
    found = least_largest(PAPER, sampled(), front, budget=300)["first"].max(axis=1)
    assert (found <= front.borne["first"].max(axis=2).min(axis=0)).all()
    assert found.mean() < 0.99 * front.borne["first"].max(axis=2).min(axis=0).mean()


@pytest.mark.parametrize("count", ["honest", pytest.param("first", marks=pytest.mark.slow)])
def test_two_learners__are_never_worse_than_one_nor_than_agents_that_drive_one_or_both(count: str) -> None:
    pair, rows, heard = eb.load_scenario("cooperation-3-pair"), WEIGHTS[[1, 3, 6]], []
    agents = ["e_v2x_bm", "plan"]
    found, *alone = (
        search_front(
            scenario, scenario.sample(8, 990801), rows, harm_count=count, budget=60, agents=agents,
            on_progress=lambda *each: heard.append(each),
        )
        for scenario in (pair, PAPER, pair.with_learners(["vehicle_3"]))
    )  # fmt: skip
    for row, least, *less in zip(rows, found.amounts, *(each.amounts for each in alone), strict=True):
        borne = [each[count] for front in (found, *alone) for each in front.agents.values()]
        driven = [weighted_harm(point, row) for points in borne for point in points]
        assert all((least <= other + 1e-9).all() for other in (*less, *driven))
    assert max(heard) == (3 * 2 * 3 * 8, 3 * 2 * 3 * 8)


def test_learners__that_decide_at_other_times_alone_are_searched_too() -> None:
    """Alone, Vehicle 3 decides from 0.82 s on; with Vehicle 2 at 0.8 s and 0.9 s, which is not the same."""
    pair = eb.load_scenario("cooperation-3-pair").replace(latency_s=[0.0, 0.5, 0.82])
    worlds, braking = pair.sample(4, 3), full_braking(pair, pair.draw(4, 3))["first"]
    found = search_front(pair, worlds, [[1, 1, 1]], budget=60, harm_count="first")
    assert (found.amounts[0] <= braking.sum(axis=1)).all()


def test_no_learner__has_no_front() -> None:
    nobody = PAPER.with_learners([])
    with pytest.raises(InvalidInput, match="has no learner"):
        search_front(nobody, nobody.sample(2, 3), [[1, 1, 1]], agents=["full_brake"])


def test_results__of_recorded_rows_have_intervals_by_recording() -> None:
    scenario = recorded(8)
    drawn = scenario.draw(80, 7)
    borne, by = full_braking(scenario, drawn), clusters_of(columns_of(drawn))
    some = {count: each[np.newaxis] for count, each in borne.items()}
    less = {count: 0.9 * each for count, each in some.items()}
    front = Front(np.ones((1, scenario.vehicles)), HarmCount.of("first"), less, {"agent": some})
    found = front_results(front, scenario, drawn, {"full_brake": borne}, 7)
    (point,), (driven,) = found["points"], found["agents"]["agent"]
    amounts = [weighted_harm(each["first"][0], front.weights[0]) for each in (less, some)]
    assert found["beside"]["full_brake"]["total"][1] == mean(borne["total"][:, 1], by).to_json()
    assert point["amount"] == mean(amounts[0], by).to_json() and driven["ratio"] == pytest.approx(1.0 / 0.9)
    assert driven["above"] == difference(amounts[1], amounts[0], by).to_json()
    assert found["recordings"] == 8 and "95 % intervals by 8 recordings." in front_sheet(found).note
    volumes = hypervolumes(front, borne["first"])[0]["of"]
    assert volumes["Pareto front"]["share"] == 1.0 and volumes["agent"] == {"volume": 0.0, "share": 0.0}
