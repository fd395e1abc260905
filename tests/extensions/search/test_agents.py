"""``best_harm`` does what it predicts, never worse than its start; and the measures ``limits``."""

from collections.abc import Callable

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import BUILT_IN_COUNTS, IMPACT_COUNTS, HarmCount
from ethbrake_marl.errors import Unfamiliar
from ethbrake_marl.extensions.search.best_harm import search_list
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.tables import best_stored
from ethbrake_marl.training.experiment import usable
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")
KEPT = PAPER.replace(early_impacts="keep")
pytestmark = pytest.mark.filterwarnings("ignore::ethbrake_marl.errors.Unfamiliar")


@pytest.mark.parametrize(
    ("name", "agent", "episodes", "count", "first", "total"),
    [  # means of README and findings are of these agents
        ("paper-random", "best_harm", 400, "first", 5.5869, 5.6753),
        ("paper-random-obstacle", "best_harm", 200, "total", 25.9747, 28.5609),
    ],
)
def test_best_harm__golden(name: str, agent: str, episodes: int, count: str, first: float, total: float) -> None:
    result = eb.evaluate(name, agent, episodes=episodes, harm_count=count)
    own = result[agent]
    assert [own[each.column].mean() for each in IMPACT_COUNTS] == pytest.approx([first, total], abs=5e-5)
    assert (
        own["predicted_harm"].tolist() == own[HarmCount.of(count).column].tolist()
        and result.knows[agent] == "true model"
    )


@pytest.mark.parametrize("count", ["first", "honest"])
def test_best_harm__of_no_table_is_never_worse_than_its_start_or_e_v2x_bm(count: str) -> None:
    start = "plan" if count == "honest" else "ppo"
    result = eb.evaluate("paper-random", f"{start},e_v2x_bm,best_harm:200", episodes=12, seed=5, harm_count=count)
    best, started, constant = (
        result[name][HarmCount.of(count).column] for name in ("best_harm:200", start, "e_v2x_bm")
    )
    assert (best <= started).all() and (best < started - 0.01).any()
    assert (best <= constant + 1e-9).all()
    assert result["best_harm:200"]["predicted_harm"].tolist() == best.tolist()


@pytest.mark.parametrize("count", ["honest"])
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
def test_best_harm__in_any_line_keeps_what_it_predicted(name: str, changes: dict[str, object], count: str) -> None:
    scenario = eb.load_scenario(name).replace(early_impacts="keep", **changes)
    (best,) = eb.evaluate(scenario, "best_harm:60", episodes=10, seed=4, harm_count=count).columns.values()
    assert best["predicted_harm"].tolist() == best[HarmCount.of(count).column].tolist()


def test_best_harm__minimises_the_objective_of_the_scenario_also_in_worlds_of_a_table() -> None:
    result = eb.evaluate(PAPER.replace(objective="own"), "best_harm:200,e_v2x_bm", episodes=10, harm_count="first")
    best = result["best_harm:200"]
    assert best["predicted_harm"] == pytest.approx(best["first_impact_harm_2"], rel=1e-12)
    of_the_line = eb.evaluate(PAPER, "best_harm", episodes=10, harm_count="first")["best_harm"]["first_impact_harm_2"]
    assert best["first_impact_harm_2"].tolist() != of_the_line.tolist()


def test_best_harm__spares_one_vehicle_first_and_then_the_line() -> None:
    first = PAPER.replace(objective="weighted:1,1,1000")
    result = eb.evaluate(first, "best_harm:200,full_brake,e_v2x_bm,ppo", episodes=10, harm_count="first")
    goal = {
        agent: 3.0 * (999.0 * each["first_impact_harm_3"] + each["first_impact_harm"]) / 1002.0
        for agent, each in result.columns.items()
    }
    best = result["best_harm:200"]
    assert best["predicted_harm"] == pytest.approx(goal["best_harm:200"], rel=1e-9)
    assert best["first_impact_harm"].mean() < result["full_brake"]["first_impact_harm"].mean()
    assert (goal["best_harm:200"] <= goal["ppo"] + 1e-9).all()
    assert (goal["best_harm:200"] <= goal["e_v2x_bm"] + 1e-9).all()


def test_best_harm__in_a_role_in_a_team_and_inside_a_shield() -> None:
    roles = {"vehicle_1": "full_brake", "vehicle_2": "best_harm:50", "vehicle_3": "learner"}
    scripted = eb.evaluate(KEPT.replace(roles=roles), "full_brake", episodes=6, seed=4)["full_brake"]
    alone = eb.evaluate(KEPT, "best_harm:50,best_harm:50+step", episodes=6, seed=4)
    assert scripted["honest_cost"] == pytest.approx(alone["best_harm:50"]["predicted_harm"], abs=8.0)
    pair = eb.evaluate("cooperation-3-pair", "best_harm:50,full_brake", episodes=6, seed=4)
    assert pair["best_harm:50"]["honest_cost"].sum() < pair["full_brake"]["honest_cost"].sum()
    assert alone["best_harm:50+step"]["replaced_actions"].shape == (6,)


@pytest.mark.parametrize(
    ("name", "budget", "episodes"),
    [("cooperation-4-all", 600, 2), ("cooperation-3-pair", 300, 3), ("benchmark-all", 1, 4)],
)
def test_best_harm__of_several_learners_is_the_joint_search(name: str, budget: int, episodes: int) -> None:
    scenario, game = eb.open_game(name)
    worlds = scenario.sample(episodes, seed=7)
    result = eb.evaluate(name, [f"best_harm:{budget}", "e_v2x_bm"], episodes=episodes)
    together, alone = (result[agent]["honest_cost"] for agent in result)
    problem = problem_of(game, worlds)
    stored = best_stored(problem, HarmCount.of("honest"))[0]
    searched = search_list(game, worlds, harm_counts=BUILT_IN_COUNTS, budget=budget).harm["honest"]
    expected = np.where(np.isfinite(stored), stored, searched)  # the value of every table
    assert together.tolist() == expected.tolist()
    assert together.mean() < alone.mean()


def test_best_harm__of_learners_with_different_objectives_searches_for_each_alone() -> None:
    pair = eb.load_scenario("cooperation-3-pair")
    (both,) = eb.evaluate(pair.replace(objective="own"), "best_harm:60", episodes=3).columns.values()
    (same,) = eb.evaluate(pair.replace(objective="maximin"), "best_harm:60", episodes=3).columns.values()
    assert both["honest_cost"].tolist() != same["honest_cost"].tolist()


def test_limits__are_regret_and_share_of_the_possible_reduction() -> None:
    result = eb.evaluate("paper-random", "full_brake,best_harm", episodes=60, measures="limits", harm_count="first")
    brake, best = result["full_brake"], result["best_harm"]
    assert brake["regret_first"].tolist() == (brake["first_impact_harm"] - brake["best_known_first"]).tolist()
    assert np.abs(best["regret_first"]).max() < 1e-9 and (best["regret_total"] >= -1e-9).all()
    rows = {row.agent: row for row in eb.summarise(result)}
    share = rows["best_harm"]["share_of_possible_reduction_first"]
    assert share is not None and share.value == pytest.approx(1.0, abs=1e-9)
    assert rows["full_brake"]["share_of_possible_reduction_first"].value == 0.0
    assert "Regret, first-impact" in "".join(eb.summarise(result).sheet().headings)


OUTDATED = "the shipped table of best known harm for paper-random is not used, because it was made for other physics"


def test_best_harm__searches_under_another_impact_law_and_says_so(other_law: str) -> None:
    with pytest.warns(Unfamiliar, match=f"^best_harm:60: searches every world: {OUTDATED}"):
        (few,) = eb.evaluate(PAPER, "best_harm:60", episodes=5, harm_count="first").columns.values()
    with pytest.warns(Unfamiliar):
        (more,) = eb.evaluate(PAPER, "best_harm:600", episodes=5, harm_count="first").columns.values()
    assert more["first_impact_harm"].sum() < few["first_impact_harm"].sum()  # of a table both would be the same


@pytest.mark.filterwarnings("error::ethbrake_marl.errors.Unfamiliar")
def test_best_harm__of_this_physics_does_not_warn() -> None:
    assert eb.evaluate(PAPER, "best_harm", episodes=2).n == 2


def test_limits__under_another_impact_law_are_refused_and_left_out_of_reports(other_law: str) -> None:
    with refused(f"measures limits: {OUTDATED}"):
        eb.evaluate(PAPER, "coast", episodes=3, measures="limits")
    with refused(NO_TABLE):
        eb.evaluate("realistic-platoon", "coast", episodes=3, measures="limits")
    told: list[str] = []

    def measured(name: str) -> object:
        return eb.evaluate(PAPER, "coast", episodes=3, measures=name)

    left = usable("measures", ("pushed_m", "limits"), measured, lambda progress: told.append(progress.note))
    (why,) = told
    assert left == ["pushed_m"] and why.startswith("limits is left out: measures limits: ") and OUTDATED in why


def drive(scenario: eb.Scenario | str, agent: str, **options: object) -> Callable[[], object]:
    return lambda: eb.evaluate(scenario, agent, episodes=3, **options)


JOINT = eb.load_scenario("cooperation-3-pair").replace(
    roles={"vehicle_1": "ppo", "vehicle_2": "learner", "vehicle_3": "learner"}, early_impacts="keep"
)
NO_TABLE = (
    "measures limits: scenario 'realistic-platoon' has no table of best known harm; evaluate the agent best_harm"
    " beside yours"
)
OTHER_WORLDS = (
    "measures limits: the table of best known harm for paper-random holds the first 10,000 worlds of seed 7, of the"
    " scenario without changes, where vehicle_2 learns; evaluate the agent best_harm"
)
REFUSED: dict[str, Callable[[], object]] = {
    "agent 'best_harm:1.5': after the colon, give the number of profiles": drive(PAPER, "best_harm:1.5"),
    "unknown shield 'search'; known: ": drive(PAPER, "full_brake+search"),
    "vehicle_1 is driven by 'ppo', whose commands are not known at the alert; a joint": drive(JOINT, "best_harm"),
    OTHER_WORLDS: drive(PAPER, "coast", seed=8, measures="limits"),
    NO_TABLE: drive("realistic-platoon", "coast", measures="limits"),
}


@pytest.mark.parametrize("message", REFUSED)
def test_searching__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()
