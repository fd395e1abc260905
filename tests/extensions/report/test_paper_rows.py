"""The rows of the paper beside an evaluation, and what tables and pages mark."""

import pytest

from ethbrake_marl.extensions.report.paper_rows import PAPER_ROWS, is_papers_test
from ethbrake_marl.first_edition.scenario.catalogue import list_scenarios, load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task

SILENT = pytest.mark.filterwarnings("ignore::ethbrake_marl.extensions.search.limits.IncompleteTable")


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
