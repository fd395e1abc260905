"""The limits of a list: found once for everything that tells of an evaluation, and what a task may ask."""

import csv
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from ethbrake_marl.agents import make_agent
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import evaluate, measures, rollout, summarise, write_per_world
from ethbrake_marl.figures import harm_in_parts
from ethbrake_marl.limits import Unproven, known_limits, limits, lower_bound, prove
from ethbrake_marl.limits.lower_bound import team_bound
from ethbrake_marl.pages.report import avoidable_section, worst_section
from ethbrake_marl.scenario import Scenario, Task, load_scenario

PAPER = load_scenario("paper-random")
WORLDS = PAPER.sample(50, 7).worlds


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> dict[str, Mock]:
    """What computes each part of the limits, and evaluates, and counts how often it did."""
    found: dict[str, Mock] = {}
    for place, name in (
        (limits, "avoidability"), (lower_bound, "avoidability"), (limits, "lower_bound"), (limits, "best_known"),
        (measures, "known_limits"), (rollout, "evaluate_list"),
    ):  # fmt: skip
        monkeypatch.setattr(place, name, found.setdefault(name, Mock(wraps=getattr(place, name))))
    return found


def test_evaluate__finds_the_limits_once_for_table_csv_and_json(calls: dict[str, Mock], tmp_path: Path) -> None:
    lines = ["--episodes", "20", "--per-world", str(tmp_path / "worlds.csv"), "--json"]
    assert run_command(["evaluate", "--agents", "full_brake,coast", *lines]) == 0
    assert {name: part.call_count for name, part in calls.items()} == dict.fromkeys(calls, 1)


def test_evaluate__whose_limits_nobody_asks_for_finds_none(
    calls: dict[str, Mock], pair: Scenario, tmp_path: Path
) -> None:
    found = evaluate(pair.sample(2, 0), {"coast": make_agent("coast")}, scenario=pair)
    calls["known_limits"].assert_not_called()
    write_per_world(tmp_path / "out.csv", found)
    assert (len(summarise(found)), found.regrets) == (1, None)
    assert found.conditions["no_limits_because"]
    calls["known_limits"].assert_called_once()
    assert found.limits is found.limits


def test_known_limits__are_the_proof_and_the_best_known() -> None:
    task = Task(PAPER, (1,))
    found, proof = known_limits(WORLDS, task), prove(WORLDS, task)
    assert found.known.all()
    assert (found.first_impact_harm[proof.avoidable] == 0.0).all() and not (proof.impact & proof.avoidable).any()
    assert (np.minimum(found.first_impact_harm, found.total_harm) >= proof.harm - 1e-9).all()


def test_known_limits__say_why_nothing_is_proven() -> None:
    coasts = load_scenario("cooperation-3-pair").replace(roles={"vehicle_1": "coast", "vehicle_2": "learner"})
    for task, why in (
        (Task(PAPER, ()), "driven are: none; avoidability is proven for one vehicle"),
        (Task(coasts, (1, 2)), "vehicle_1 follows coast; harm is bounded where it follows full_brake"),
    ):
        assert known_limits(WORLDS, task) == Unproven(why)


def test_prove__decides_contact_of_vehicles_2_and_3_as_of_vehicle_2_alone() -> None:
    scenario = load_scenario("cooperation-3-pair")
    alone, both = prove(WORLDS, Task(scenario, (1,))), prove(WORLDS, Task(scenario, (2, 1)))
    assert np.array_equal(alone.avoidable, both.avoidable) and np.array_equal(alone.reason, both.reason)
    assert 0.99 * alone.harm.mean() < both.harm.mean() <= alone.harm.mean()


@pytest.mark.parametrize(
    ("name", "vehicles"),
    [("cooperation-4-all", (0, 1, 2)), ("cooperation-3-five", (1, 2, 3, 4)), ("cooperation-2-five", (1,))],
)
def test_prove__bounds_the_harm_of_other_teams_without_a_verdict_on_contact(name: str, vehicles: tuple[int]) -> None:
    scenario = load_scenario(name)
    sample = scenario.sample(30, 7)
    found = known_limits(sample.worlds, Task(scenario, vehicles))
    assert found.proof.avoidable is None and found.proof.contact is None
    assert np.array_equal(found.proof.harm, team_bound(sample.worlds, vehicles, horizon_s=8.0, time_step_s=0.1).harm)
    assert not found.known.any()
    assert (found.proof.harm > 0).any() == (name != "cooperation-4-all")


def test_evaluation__of_a_team_tells_the_proven_harm_where_contact_is_not_decided(tmp_path: Path) -> None:
    scenario = load_scenario("cooperation-3-five")
    agents = {name: make_agent(name) for name in ("full_brake", "coast")}
    found = evaluate(scenario.sample(20, 7), agents, scenario=scenario)
    rows = summarise(found)
    told, text = rows[0], rows.limit_line()
    assert (told["unavoidable_rate"], told.between, told["avoidable_collision_rate"]) == (None, None, None)
    assert 0 < told["proven_harm"].value < told["best_known_first_impact_harm"].value
    assert told["impact_proven_rate"] is not None and told.known_best_share == 0.0
    assert "no joint command avoids an impact (proven)" in text and "avoids contact" not in text
    write_per_world(tmp_path / "out.csv", found)
    with (tmp_path / "out.csv").open(newline="") as lines:
        cells = next(csv.DictReader(lines))
    assert cells["avoidable"] == cells["unavoidable_reason"] == "" and float(cells["proven_harm"]) >= 0
    assert avoidable_section(found).title and worst_section(found, "coast", ()).title
    with pytest.raises(InvalidInput, match="where contact can be avoided is not decided"):
        harm_in_parts(found)
