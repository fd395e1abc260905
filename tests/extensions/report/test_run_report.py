"""What the report adds to the folder of a run, and pages of commands."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import AGENTS
from ethbrake_marl.episode.counts import ALL_IMPACTS, HONEST
from ethbrake_marl.errors import EXTRA_OF
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.extensions.report.run import TESTS, learners_sheets, other_tests, short_sheet, typical_row_of
from ethbrake_marl.training.experiment import run_experiment
from tests.cli.test_run import status_of
from tests.extensions.report.conftest import compared_by
from tests.fixtures.commands import Command, told_json
from tests.fixtures.page import Page
from tests.test_imports import ended
from tests.training.tiny import TINY

COMPARED = ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise", "trained policy", "hybrid"]


# ---- the folder of a run


def test_run__leaves_results_page_and_policy(finished_run: Path) -> None:
    names = {path.name for path in finished_run.iterdir()}
    others = {f"results-{name}.json" for name in TESTS if name != "paper-random"}
    assert names >= {"config.json", "policy", "results.json", "worlds.csv", "report.html", *others}
    html = (finished_run / "report.html").read_text()
    assert html.count("<figure>") == html.count("data:image/svg") == 5
    assert html.count('"pieces":') == 50 * len(COMPARED)
    page = Page(html)
    assert "ethbrake run: paper-random" in page.text and ", on paper-random: 256 steps of 256 (finished)" in page.text
    titles = [attributes.get("id") for tag, attributes in page.tags if tag == "section"]
    open_titles = ["brake-only-test", "obstacle-test", "learning-curve", "worst-ten-worlds"]
    open_titles[3:3] = ["the-rule-plan"] if "plan" in AGENTS else []
    assert titles[: len(open_titles)] == open_titles
    assert {"agents-and-measures", "figures", "versions"} <= {*titles[len(open_titles) :]}
    assert len(re.findall(r"<details><summary>\s*<h2", html)) == len(titles) - len(open_titles)  # others are folded
    header, main = html.split("<main")
    assert 'class="player"' in header and 'class="player"' not in main  # an episode plays before any section
    for words in (
        "Honest cost",
        "e_v2x_bm:<wbr>pairwise",
        "the constant deceleration of its closed form",
        "the policy that this run trained",
    ):
        assert words in header
    assert status_of(finished_run, "status", "stage", "steps", "reason") == ("finished", "evaluation", 256, None)
    assert {*status_of(finished_run, "written")[0]} >= {"report.html", *others}


def test_run__the_other_two_tests_stand_beside_the_main_one(finished_run: Path) -> None:
    for test in ("paper-random-brake-only", "paper-random-obstacle"):
        saved = eb.read_result(finished_run / f"results-{test}.json")
        assert [*saved] == ["full_brake", "e_v2x_bm", "trained policy", "hybrid"]
        right = eb.evaluate(test, f"full_brake,policy@{finished_run}", episodes=60)
        for agent, spec in (("full_brake", "full_brake"), ("trained policy", f"policy@{finished_run}")):
            mean = right[spec]["total_harm"].mean()
            assert saved[agent]["total_harm"] == pytest.approx(mean, rel=1e-12)


def test_rule__stands_beside_what_was_trained(finished_run: Path) -> None:
    pytest.importorskip("ethbrake_marl.extensions.forecasts")
    policy = f"policy@{finished_run}"
    result = eb.evaluate("paper-random", f"plan,{policy}", episodes=60)
    costs = [result[agent]["honest_cost"] for agent in ("plan", policy)]
    text = Page((finished_run / "report.html").read_text()).text
    words = "Honest cost of the trained policy minus honest cost of the rule, mean of the first 60 worlds of the list:"
    assert f"{words} {(costs[1] - costs[0]).mean():.2f} [" in text
    assert f"{costs[0].mean():.2f}" in text.partition("The rule plan needs no training.")[2].partition("Worst ten")[0]


def test_several_learners__who_bears_what_and_what_each_adds(tmp_path: Path) -> None:
    recipe = TINY.replace(total_steps=256, scheme="shared", reward={"harm": 1.0})
    scenario = eb.load_scenario("cooperation-3-pair")
    compared = run_experiment(recipe, scenario, tmp_path / "run", episodes=12)[0].compared
    first, total, _, added = learners_sheets(compared)
    for sheet, harm in ((first, "first_impact_harm"), (total, "total_harm")):
        for agent, *cells in sheet.rows:
            means = [compared.result[agent][f"{harm}{ending}"].mean() for ending in ("_1", "_2", "_3", "")]
            assert [cell.value for cell in cells] == pytest.approx(means)
            assert sum(cell.value for cell in cells[:3]) == pytest.approx(cells[3].value)
    assert first.headings[1:] == ["Vehicle 1", "Vehicle 2", "Vehicle 3", "Whole line"]
    for name, less, *_ in added.rows:
        mine = [compared.result[each]["first_impact_harm"] for each in (f"all but {name}", "trained team")]
        assert less.value == pytest.approx((mine[0] - mine[1]).mean())
    assert [row[0] for row in added.rows] == ["vehicle_2", "vehicle_3"]
    *_, cost, more = learners_sheets(compared._replace(harm_count=HONEST))
    means = [compared.result["full_brake"][f"honest_cost{ending}"].mean() for ending in ("_1", "_2", "_3", "")]
    assert [cell.value for cell in cost.rows[0][1:]] == pytest.approx(means)
    assert more.headings[-1] == "Honest cost"


# ---- its parts


@pytest.mark.parametrize(
    ("before", "after", "row"),
    [
        ([9.0, 0.0, 5.0, 7.0], [1.0, 0.0, 4.0, 2.0], 3),  # savings 8, -, 1, 5
        ([0.0, 0.0], [0.0, 5.0], 0),  # full braking harms nobody
    ],
)
def test_typical_row__is_the_median_saving_among_harmful_worlds(before: Any, after: Any, row: int) -> None:
    result = {"full_brake": {"total_harm": np.array(before)}, "mine": {"total_harm": np.array(after)}}
    assert typical_row_of(Comparison(None, {}, result, None, ALL_IMPACTS), "mine") == row  # type: ignore[arg-type]


def test_three_tests__are_each_others_and_of_the_shipped_scenarios_only() -> None:
    for name in TESTS:
        assert {name, *(each.name for each in other_tests(eb.load_scenario(name)))} == {*TESTS}
    changed = eb.load_scenario("paper-random").replace(horizon_s=9.0)
    assert other_tests(changed) == other_tests(eb.load_scenario("realistic-pair")) == []
    assert len(other_tests(eb.load_scenario("paper-random").replace(title="Mine"))) == 2


@pytest.mark.parametrize("count", ["honest"])
def test_terminal__shows_both_harms_and_the_honest_cost_with_the_push_if_agents_minimise_it(count: str) -> None:
    mine = compared_by("paper-random", "full_brake,coast,constant:3", 30, count)
    sheet = short_sheet(mine)
    names = ["collision_rate", "first_impact_harm", "total_harm", "honest_cost"]
    names += ["pushed_mps"] if count == "honest" else []
    assert sheet.names[1:] == names
    for row, columns in zip(sheet.rows, mine.result.columns.values(), strict=True):
        means = [columns["collided" if name == "collision_rate" else name].mean() for name in names]
        assert [cell.value for cell in row[1:]] == pytest.approx(means)


# ---- pages and pictures of commands


def test_sample__draws_a_picture_even_of_worlds_that_are_all_alike(ethbrake: Command, tmp_path: Path) -> None:
    for picture in (tmp_path / "a.png", tmp_path / "b.png"):
        told = ethbrake("scenario", "sample", "paper-scenario-1", "--episodes", "40", "--output", picture)
        assert (told.status, told.out, told.err) == (0, "", f"picture: {picture}\n")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_evaluate__writes_the_page_of_its_own_numbers(ethbrake: Command, empty_folder: Path, undrawn: None) -> None:
    def rear(game: Any, alert: Any, last: Any) -> Any:
        """Speed at which the rear vehicle ends."""
        return last.speeds_mps[:, -1]

    eb.register_measure("rear_end_mps", rear, unit="m/s")
    words = ("evaluate", "--agents", "full_brake,coast", "--episodes", "40", "--set", "measures=rear_end_mps")
    rows = told_json(ethbrake(*words, "--output", "out", "--report", "--json"))
    text = Page(Path("out/report.html").read_text()).text
    assert "rear_end_mps (m/s)" in text and f"{rows[1]['rear_end_mps']:.2f}" in text
    assert "coast costs " in text and f"{rows[1]['honest_cost']:.2f}" in text and "vehicle_1 by full_brake" in text


def test_report__is_imported_where_no_package_of_an_extra_can_be() -> None:
    absent = "".join(f"sys.modules[{name!r}] = None\n" for name in sorted(EXTRA_OF))
    assert ended(f"import sys\n{absent}from ethbrake_marl.extensions import report") == (0, "", "")
