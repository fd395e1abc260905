from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.defaults import HARM_COUNTS
from ethbrake_marl.evaluation import Evaluation, SummaryTable, evaluate, summarise
from ethbrake_marl.evaluation.measures import PAPER_ROWS
from ethbrake_marl.limits import limits
from ethbrake_marl.scenario import Scenario, list_scenarios, load_scenario

ALWAYS = {
    "kind", "agent", "knows", "sees_through_channel", "hidden_share", "episodes", "collisions",
    "horizon_ends", "collision_rate", "collision_rate_interval",
    "first_impact_harm", "first_impact_harm_interval", "total_harm", "total_harm_interval",
    "sampled_harm", "sampled_harm_interval", "vehicle_1_shoved_m", "vehicle_1_shoved_m_interval",
    "vehicle_1_shoved_far_rate", "vehicle_1_shoved_far_rate_interval",
    "first_impact_harm_difference", "first_impact_harm_difference_interval", "total_harm_difference",
    "total_harm_difference_interval", "harm_decrease_first", "harm_decrease_first_interval", "harm_decrease_total",
    "harm_decrease_total_interval", "unavoidable_rate", "unavoidable_rate_interval", "impact_proven_rate",
    "impact_unproven", "left_out", "worlds_sha256", "scenario_sha256", "policy_sha256", "versions",
    "impact_proven_rate_interval", "proven_harm", "proven_harm_interval", "best_known_minus_proven_first",
    "best_known_minus_proven_first_interval", "best_known_minus_proven_total", "best_known_minus_proven_total_interval",
    "avoidable_collision_rate",
    "avoidable_collision_rate_interval", "best_known_first_impact_harm", "best_known_first_impact_harm_interval",
    "best_known_total_harm", "best_known_total_harm_interval", "mean_regret", "mean_regret_interval",
    "mean_regret_first", "mean_regret_first_interval", "mean_regret_total", "mean_regret_total_interval",
    "realised_share", "realised_share_interval", "realised_share_first", "realised_share_first_interval",
    "realised_share_total", "realised_share_total_interval", "known_best_share", "best_known_warning",
    "below_best_known", "parameters",
}  # fmt: skip


def printed(evaluation: Evaluation, width: int = 80) -> str:
    console = Console(width=width, file=io.StringIO(), color_system=None)
    console.print(summarise(evaluation).terminal())
    text = console.file.getvalue()
    assert all(len(line) <= width for line in text.splitlines())
    return text


def test_summarise__json_keys(evaluation: Evaluation) -> None:
    full, constant, gap = (row.to_json() for row in summarise(evaluation))
    assert set(full) == set(constant) == ALWAYS
    assert set(gap) == ALWAYS | {"predicted_harm", "predicted_harm_interval", "policy_share"}
    assert [row["agent"] for row in (full, constant, gap)] == ["full_brake", "constant:4.5", "gap"]
    assert json.loads(json.dumps([full, constant, gap], allow_nan=False)) == [full, constant, gap]


def test_summarise__values_are_those_of_the_worlds(evaluation: Evaluation) -> None:
    full, constant, gap = (row.to_json() for row in summarise(evaluation))
    first = {name: outcome.first_impact_harm for name, outcome in evaluation.outcomes.items()}
    total = {name: outcome.total_harm for name, outcome in evaluation.outcomes.items()}
    collided = evaluation.outcome("constant:4.5").collided
    assert constant["episodes"] == 200
    assert constant["collisions"] == np.count_nonzero(collided)
    assert constant["collision_rate"] == np.count_nonzero(collided) / 200
    assert constant["first_impact_harm"] == pytest.approx(first["constant:4.5"].mean(), rel=1e-12)
    assert constant["total_harm"] == pytest.approx(total["constant:4.5"].mean(), rel=1e-12)
    assert constant["total_harm_difference"] == pytest.approx(
        total["constant:4.5"].mean() - total["full_brake"].mean(), rel=1e-9
    )
    assert gap["harm_decrease_total"] == pytest.approx(1 - total["gap"].mean() / total["full_brake"].mean(), rel=1e-9)
    assert constant["first_impact_harm_difference"] == pytest.approx(
        first["constant:4.5"].mean() - first["full_brake"].mean(), rel=1e-9
    )
    assert gap["harm_decrease_first"] == pytest.approx(1 - first["gap"].mean() / first["full_brake"].mean(), rel=1e-9)
    assert gap["predicted_harm"] == pytest.approx(evaluation.worlds.gaps_m[:, 0].mean(), rel=1e-12)
    assert gap["policy_share"] == np.mean(evaluation.worlds.gaps_m[:, 0] > 7.5)
    assert full["harm_decrease_first"] == full["harm_decrease_total"] == 0.0
    for name in ("collision_rate", "first_impact_harm", "total_harm", "harm_decrease_total"):
        low, high = constant[f"{name}_interval"]
        assert low < constant[name] < high


def test_summarise__without_full_braking_there_is_no_decrease(pair: Scenario) -> None:
    result = evaluate(pair.sample(1, 0), {"coast": make_agent("coast")}, scenario=pair)
    (row,) = (row.to_json() for row in summarise(result))
    assert row["harm_decrease_first"] is row["harm_decrease_total"] is row["total_harm_difference"] is None
    assert row["harm_decrease_first_interval"] is None
    assert row["first_impact_harm_interval"] is None  # a single world
    assert row["collision_rate_interval"] is not None


def test_parameters__say_under_which_conditions(evaluation: Evaluation) -> None:
    found = evaluation.conditions
    assert (found["scenario"], found["seed"], found["count"]) == ("paper-random", 7, 200)
    assert found["controlled_vehicle"] == "vehicle_2"
    assert found["scripts"] == {"vehicle_1": "full_brake", "vehicle_3": "full_brake"}
    assert found["restitution"] == 0.1
    assert found["latency_s"] == [0.0, 0.5, 0.8]
    assert found["mass_t"] == [4.5, 5.5, 5.9]
    assert found["gaps_m"][1] == [evaluation.worlds.gaps_m[:, 1].min(), evaluation.worlds.gaps_m[:, 1].max()]
    line = found.line.replace("\u00a0", " ")
    assert line.startswith("paper-random: 200 worlds, seed 7; d = ")
    assert line.endswith("τ = (0, 0.5, 0.8) s; m = (4.5, 5.5, 5.9) t; e = 0.1")


def test_rich_table__fits_80_columns_and_shows_both_counts(evaluation: Evaluation) -> None:
    text = printed(evaluation)
    row = summarise(evaluation)[0]
    for estimate in (row.first_impact_harm, row.total_harm):
        assert f"{estimate.value:.2f}" in text
        assert f"{estimate.interval[0]:.2f}, {estimate.interval[1]:.2f}" in text
    collided = evaluation.outcome("full_brake").collided.mean()
    assert f"full_brake {100 * collided:.1f} % " in " ".join(text.split())
    compared = summarise(evaluation)[2]
    for value in (compared["sampled_harm"], compared["vehicle_1_shoved_m"], compared["mean_regret_first"]):
        assert f"{value.value:.2f}" in text


def test_rich_table__in_120_columns_has_every_column(evaluation: Evaluation, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "best_known", lambda worlds, task: dict.fromkeys(HARM_COUNTS, np.zeros(worlds.n)))
    afresh = replace(evaluation)  # its limits are not found yet
    text = printed(afresh, width=120)
    row = summarise(afresh)[2]
    for share in (
        row["harm_decrease_first"],
        row["harm_decrease_total"],
        row["vehicle_1_shoved_far_rate"],
        row["realised_share_first"],
    ):
        assert f"{100 * share.value:.1f} %" in text
    for value in (row["predicted_harm"], row["mean_regret_first"]):
        assert f" {value.value:.2f}" in text
    assert f"In {100 * row['unavoidable_rate'].value:.1f} % [" in text


def test_rich_table__without_a_limit_keeps_the_decrease_of_total_harm(pair: Scenario) -> None:
    result = evaluate(pair.sample(2, 0), {"full_brake": make_agent("full_brake")}, scenario=pair)
    text = printed(result)
    assert text.count("Decrease") == 2
    assert "Regret" not in text


def test_rich_table__has_the_papers_rows_beside_ours_and_its_conditions(evaluation: Evaluation) -> None:
    text = " ".join(printed(evaluation, width=120).split())
    assert "Non-E 93.91 % 33.5878" in text
    assert "Hybrid PPO 59.74 % 5.6202 – – – – 83.26 %" in text
    assert "Standalone DRL 74.74 % 12.229" in text
    assert "m = (4.5, 5.5, 5.9) t; not stated: e" in text
    assert "62.3 %" in text


def test_rich_table__of_another_scenario_has_none_of_the_papers_rows(pair: Scenario) -> None:
    result = evaluate(pair.sample(2, 0), {"full_brake": make_agent("full_brake")}, scenario=pair)
    assert "paper" not in printed(result).lower()
    assert "paper" not in summarise(result).markdown().lower()


def test_rich_table__brackets_in_a_name_are_text(pair: Scenario) -> None:
    result = evaluate(pair.sample(2, 0), {"ppo@[red]x": make_agent("full_brake")}, scenario=pair)
    assert "ppo@[red]x" in printed(result)


def test_markdown_table__a_bar_in_a_name_makes_no_column(pair: Scenario) -> None:
    result = evaluate(pair.sample(2, 0), {"ppo@a|b": make_agent("full_brake")}, scenario=pair)
    assert "| ppo@a\\|b |" in summarise(result).markdown()


def test_markdown_table__every_row_has_every_column(evaluation: Evaluation) -> None:
    rows = [line for line in summarise(evaluation).markdown().splitlines() if line.startswith("|")]
    assert {line.count("|") for line in rows} == {14}
    assert len(rows) == 2 + 3 + len(PAPER_ROWS)
    estimate = summarise(evaluation)[0].first_impact_harm
    assert f"{estimate.value:.2f} [{estimate.interval[0]:.2f}, {estimate.interval[1]:.2f}]" in rows[2]


def test_tables__of_nothing_are_empty() -> None:
    assert "Agent" in SummaryTable().markdown()
    console = Console(width=80, file=io.StringIO())
    console.print(SummaryTable().terminal())
    assert "Agent" in console.file.getvalue()


def test_paper_rows__agree_with_themselves() -> None:
    for row in PAPER_ROWS:
        assert row.collision_rate == pytest.approx(row.collisions / row.episodes, abs=5e-5)
    random = {row.agent: row for row in PAPER_ROWS if row.table == "random test"}
    for row in random.values():
        assert row.harm_decrease == pytest.approx(1.0 - row.average_harm / random["Non-E"].average_harm, abs=1e-4)
    avoided = {row.agent: row.episodes - row.collisions for row in PAPER_ROWS if row.table == "hybrid test"}
    assert avoided["Hybrid"] == 2005  # what the note says
    assert avoided["E-V2X-BM"] + avoided["Standalone DRL"] == 2000


def _beside_paper(scenario: Scenario, *, vehicle: int = 1, seed: int | None = 7) -> bool:
    agents = {"full_brake": make_agent("full_brake")}
    driven = scenario.with_learners([vehicle])
    (row,) = summarise(evaluate(driven.sample(2, 7), agents, scenario=driven, seed=seed))
    assert ("paper, " in SummaryTable([row]).markdown()) is row.beside_paper
    return row.beside_paper


@pytest.mark.filterwarnings("ignore::ethbrake_marl.errors.IncompleteTable")  # of cooperation-2-blocked
def test_paper_rows__stand_only_beside_the_shipped_random_tests() -> None:
    shown = {entry.name for entry in list_scenarios() if _beside_paper(load_scenario(entry.name))}
    assert shown == {"paper-random", "paper-random-early"}


def test_paper_rows__need_the_values_the_driver_and_the_list_and_not_the_name(paper_random: Scenario) -> None:
    assert _beside_paper(paper_random.replace(title="Mine"))
    assert not _beside_paper(paper_random.replace(gaps_m={"uniform": [6, 7]}))
    assert not _beside_paper(paper_random.replace(roles={"vehicle_2": "learner", "vehicle_3": "constant:3"}))
    assert not _beside_paper(paper_random, vehicle=2)
    assert not _beside_paper(paper_random, seed=None)  # worlds that were given
