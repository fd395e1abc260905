"""The rows of the paper beside an evaluation, and what tables and pages mark."""

from typing import Any

import pytest

from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.summary import summarise
from ethbrake_marl.extensions.report.paper_rows import PAPER_ROWS, is_papers_test, with_paper_rows
from ethbrake_marl.extensions.report.report import Report
from ethbrake_marl.scenario.catalogue import list_scenarios, load_scenario
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.task import Task
from tests.evaluation.test_measures import CLEAR, EXPLOITS, check_marked, check_unmarked, knowing, printed, pushing

SILENT = pytest.mark.filterwarnings("ignore::ethbrake_marl.extensions.search.limits.IncompleteTable")


def test_table__has_every_figure_and_the_papers_rows_in_80_columns_and_in_markdown(evaluation: Evaluation) -> None:
    """What it looks like in 120 columns stands in tests/cli/printed."""
    rows = with_paper_rows(summarise(evaluation))
    narrow, markdown = printed(rows), rows.markdown()
    for row in rows:
        low, high = row.total_harm.interval
        assert f"{row.total_harm.value:.2f} [{low:.2f}, {high:.2f}]" in markdown and f"{low:.2f}, {high:.2f}" in narrow
        for name in ("first_impact_harm", "sampled_harm", "vehicle_1_shoved_m", "mean_regret_first"):
            assert f"{row[name].value:.2f}" in narrow and f"{row[name].value:.2f}" in markdown
        assert f" {100 * row.collision_rate.value:.1f} % " in narrow
        for name in ("harm_decrease_first", "harm_decrease_total", "vehicle_1_shoved_far_rate"):
            assert f"{100 * row[name].value:.1f} %" in markdown
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in lines} == {14} and len(lines) == 2 + 3 + len(PAPER_ROWS)
    ours = summarise(evaluation)
    assert "paper's" not in f"{ours}{ours.markdown()}" and len(ours.sheet().rows) == 3


def beside_paper(scenario: Scenario, *, vehicle: int = 1, seed: int | None = 7) -> bool:
    driven = scenario.with_learners([vehicle])
    return is_papers_test(Task(driven, driven.learners), seed)


@SILENT
def test_paper_rows__stand_beside_the_values_the_driver_and_the_list_of_the_shipped_random_tests_alone(
    paper_random: Scenario,
) -> None:
    shown = {entry.name for entry in list_scenarios() if beside_paper(load_scenario(entry.name))}
    assert shown == {"paper-random", "paper-random-early"}
    roles = {"vehicle_2": "learner", "vehicle_3": "constant:3"}
    others = [paper_random.replace(**change) for change in ({"gaps_m": {"uniform": [6, 7]}}, {"roles": roles})]
    assert beside_paper(paper_random.replace(title="Mine")) and not any(map(beside_paper, others))
    assert not beside_paper(paper_random, vehicle=2)
    assert not beside_paper(paper_random, seed=None)  # worlds that were given


def test_rows_of_the_paper__agree_with_themselves() -> None:
    for row in PAPER_ROWS:
        assert row.collision_rate == pytest.approx(row.collisions / row.episodes, abs=5e-5)
    random = {row.agent: row for row in PAPER_ROWS if row.table == "random test"}
    for row in random.values():
        assert row.harm_decrease == pytest.approx(1.0 - row.average_harm / random["Non-E"].average_harm, abs=1e-4)


@SILENT  # some of the few worlds of `cooperation-2-blocked` are those of a shipped table
@pytest.mark.usefixtures("undrawn")
def test_knowledge__a_hiding_channel_marks_who_sees_through_it_in_the_report() -> None:
    hiding = knowing("blocked")
    rows = summarise(hiding)
    for text in (printed(rows, 160), rows.markdown(), Report("Mine", rows, hiding).html):
        check_marked(text, hiding.hidden.mean())


@SILENT
@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("v2x", CLEAR)
def test_knowledge__where_nothing_is_hidden_nobody_is_marked_in_the_report(v2x: Any) -> None:
    result = knowing(v2x)
    rows = summarise(result)
    page = Report("Mine", rows, result).html.partition(">How to read the tables</h2>")[0]
    check_unmarked(printed(rows, 160) + rows.markdown() + page)


@pytest.mark.parametrize(("shoved_m", "moving", "names"), EXPLOITS)
def test_exploits__are_marked_in_the_report_too(shoved_m: float, moving: int, names: tuple[str]) -> None:
    found = pushing(shoved_m, moving)
    page = Report("t", summarise(found), found).html
    assert ("mine ‡" in page) == bool(names) and "full_brake ‡" not in page
