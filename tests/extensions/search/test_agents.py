"""``best_harm`` and ``+search``: as predicted, never worse than what they begin with; and the measures ``limits``."""

from collections.abc import Callable

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.search.agents import BestHarm, Searched
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.tables import best_known
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")
pytestmark = pytest.mark.filterwarnings("ignore::ethbrake_marl.errors.Unfamiliar")


def harms(result: eb.Result, agent: str) -> tuple[list[float], list[float]]:
    return result[agent]["first_impact_harm"].tolist(), result[agent]["total_harm"].tolist()


@pytest.mark.parametrize(
    ("name", "count", "first", "total"),
    [  # means of README and findings are of these agents: here 400 and 200 worlds, recorded from version 0.5
        ("paper-random", "first", 5.5924, 5.6690),
        ("paper-random-obstacle", "total", 26.9106, 33.0489),
    ],
)
def test_best_harm__recalls_and_keeps_what_it_predicted(name: str, count: str, first: float, total: float) -> None:
    result = eb.evaluate(name, "best_harm", episodes=400 if name == "paper-random" else 200, harm_count=count)
    own = result["best_harm"]
    assert own["first_impact_harm"].mean() == pytest.approx(first, abs=5e-5)
    assert own["total_harm"].mean() == pytest.approx(total, abs=5e-5)
    predicted = own["first_impact_harm" if count == "first" else "total_harm"]
    assert own["predicted_harm"].tolist() == predicted.tolist() and result.knows["best_harm"] == "true model"


def test_best_harm__of_no_table_is_never_worse_than_universal_or_e_v2x_bm() -> None:
    result = eb.evaluate("paper-random", "universal,e_v2x_bm,best_harm:200", episodes=12, seed=5)
    best, universal = result["best_harm:200"]["first_impact_harm"], result["universal"]["first_impact_harm"]
    assert (best <= universal).all() and (best < universal - 0.01).any()
    assert (best <= result["e_v2x_bm"]["first_impact_harm"] + 1e-9).all()
    assert result["best_harm:200"]["predicted_harm"].tolist() == best.tolist()


@pytest.mark.parametrize("inside", ["constant:5", "ppo"])
@pytest.mark.parametrize("count", ["first", "total"])
def test_searched__is_never_worse_and_as_predicted(inside: str, count: str) -> None:
    result = eb.evaluate("paper-random", f"{inside},{inside}+search", episodes=30, seed=3, harm_count=count)
    column = "first_impact_harm" if count == "first" else "total_harm"
    plain, own = result[inside][column], result[f"{inside}+search"]
    assert own["predicted_harm"].tolist() == own[column].tolist()
    assert (own[column] <= plain).all() and (own[column] < plain - 0.1).any()
    assert result.knows[f"{inside}+search"] == "true model"


def test_searched__golden() -> None:
    """The mean is that of version 0.5, to the last bit in every one of 400 worlds."""
    result = eb.evaluate("paper-random", "full_brake+search", episodes=400)
    assert result["full_brake+search"]["first_impact_harm"].mean() == pytest.approx(8.0650, abs=5e-5)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("paper-random", {"time_step_s": 0.05}),
        ("paper-random", {"roles": {"vehicle_1": "constant:3", "vehicle_2": "learner", "vehicle_3": "coast"}}),
        ("paper-random-obstacle", {}),
        ("paper-random-buildup", {}),
        ("cooperation-2-five", {}),
    ],
)
def test_planners__in_any_line_keep_what_they_predicted(name: str, changes: dict[str, object]) -> None:
    scenario = eb.load_scenario(name).replace(early_impacts="keep", **changes)
    agents = "full_brake,best_harm:60,full_brake+search"
    result = eb.evaluate(scenario, agents, episodes=10, seed=4, harm_count="total")
    for agent in ("best_harm:60", "full_brake+search"):
        assert result[agent]["predicted_harm"].tolist() == result[agent]["total_harm"].tolist()
    assert (result["full_brake+search"]["total_harm"] <= result["full_brake"]["total_harm"]).all()


def test_planners__minimise_the_objective_of_the_scenario() -> None:
    own = PAPER.replace(objective="own")
    result = eb.evaluate(own, "best_harm:200,full_brake+search,e_v2x_bm", episodes=10, seed=4)
    for agent in ("best_harm:200", "full_brake+search"):
        assert result[agent]["predicted_harm"] == pytest.approx(result[agent]["first_impact_harm_2"], rel=1e-12)
    assert result["best_harm:200"]["first_impact_harm_2"].sum() < result["e_v2x_bm"]["first_impact_harm_2"].sum()


def test_planners__in_a_role_and_in_a_team() -> None:
    roles = {"vehicle_1": "full_brake", "vehicle_2": "best_harm:50", "vehicle_3": "learner"}
    scenario = PAPER.replace(early_impacts="keep", roles=roles)
    result = eb.evaluate(scenario, "full_brake", episodes=6, seed=4)
    alone = eb.evaluate(PAPER.replace(early_impacts="keep"), "best_harm:50", episodes=6, seed=4)
    best = alone["best_harm:50"]["predicted_harm"]
    assert result["full_brake"]["first_impact_harm"] == pytest.approx(best, abs=1.0)
    pair = eb.evaluate("cooperation-3-pair", "best_harm:50,full_brake", episodes=6, seed=4)
    assert pair["best_harm:50"]["first_impact_harm"].sum() < pair["full_brake"]["first_impact_harm"].sum()


def test_searched__of_more_candidates_is_better_and_stands_inside_a_shield() -> None:
    brake = eb.make_agent("full_brake")
    agents = {n: Searched(brake, PAPER, candidates=int(n)) for n in ("20", "200")}
    result = eb.evaluate("paper-random", {**agents, "shielded": "full_brake+search+step"}, episodes=40, seed=3)
    assert result["200"]["first_impact_harm"].mean() < result["20"]["first_impact_harm"].mean()
    assert result["shielded"]["replaced_actions"].shape == (40,)


def test_limits__are_regret_and_share_of_the_possible_reduction() -> None:
    result = eb.evaluate("paper-random", "full_brake,best_harm", episodes=60, measures="limits")
    brake, best = result["full_brake"], result["best_harm"]
    assert brake["regret_first"].tolist() == (brake["first_impact_harm"] - brake["best_known_first"]).tolist()
    assert np.abs(best["regret_first"]).max() < 1e-9 and (best["regret_total"] >= -1e-9).all()
    rows = {row.agent: row for row in eb.summarise(result)}
    share = rows["best_harm"]["share_of_possible_reduction_first"]
    assert share is not None and share.value == pytest.approx(1.0, abs=1e-9)
    assert rows["full_brake"]["share_of_possible_reduction_first"].value == 0.0
    assert "Regret, first-impact" in eb.summarise(result).to_markdown()


def drive(scenario: eb.Scenario, agent: str) -> Callable[[], object]:
    return lambda: eb.evaluate(scenario, agent, episodes=2)


PLANS = PAPER.replace(
    early_impacts="keep", roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "ppo"}
)
REFUSED: dict[str, Callable[[], object]] = {
    "agent 'best_harm:1.5': after the colon, give the number of profiles": drive(PAPER, "best_harm:1.5"),
    "agent 'best_harm:0': after the colon": drive(PAPER, "best_harm:0"),
    "agent 'best_harm': needs a scenario": lambda: eb.make_agent("best_harm"),
    "search: candidates = 0: must be a whole number": lambda: Searched(eb.make_agent("coast"), PAPER, candidates=0),
    "'full_brake+step+search': a search around a shield; write +search first": drive(PAPER, "full_brake+step+search"),
    "vehicle_3 is driven by 'ppo', whose commands are not known at the alert": drive(PLANS, "full_brake+search"),
    "no shipped table holds 3 worlds of 3; the measures limits need": lambda: eb.evaluate(
        PAPER, "coast", episodes=3, seed=8, measures="limits"
    ),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_searching__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()


def test_best_harm__looks_no_world_up_for_another_objective() -> None:
    worlds, own = PAPER.sample(6, seed=7), BestHarm(PAPER.replace(objective="own"), budget=300)
    memory, line = own.begin(worlds, 2), BestHarm(PAPER, budget=300).begin(worlds, 2)
    assert memory.commands_mps2.shape == (6, own.decisions)
    assert (memory.predicted_harm < line.predicted_harm - 1.0).any()
    problem = problem_of(own.game, worlds, objective="own")
    shipped = problem.value(problem.follow(best_known(problem, "first")[1]))
    assert memory.predicted_harm.tolist() != shipped.tolist()
