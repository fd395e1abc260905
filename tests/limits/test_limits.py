"""The limits of a list: found once for everything that tells of an evaluation, and what a task may ask."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import evaluate, measures, rollout, summarise, write_per_world
from ethbrake_marl.figures import harm_in_parts
from ethbrake_marl.limits import limits, lower_bound
from ethbrake_marl.limits.limits import Limits, Proof, Unproven, known_limits, prove
from ethbrake_marl.limits.lower_bound import team_bound
from ethbrake_marl.pages.report import avoidable_section, worst_section
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import Scenario, Task, load_scenario
from tests.cli.conftest import TINY_RECIPE
from tests.fixtures.evaluation import PAIR


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each part of the limits was computed, and how many evaluations there were."""
    found: Counter[str] = Counter()

    def watch(place: object, name: str, told: str) -> None:
        given = getattr(place, name)

        def counted(*arguments: object, **options: object) -> object:
            found[told] += 1
            return given(*arguments, **options)

        monkeypatch.setattr(place, name, counted)

    watch(limits, "avoidability", "avoidability")
    watch(lower_bound, "avoidability", "avoidability")
    watch(limits, "lower_bound", "bound")
    watch(limits, "best_known", "best known")
    watch(measures, "known_limits", "limits")
    watch(rollout, "evaluate_list", "evaluation")
    return found


def test_evaluate__finds_the_limits_once_for_table_csv_and_json(calls: Counter[str], tmp_path: Path) -> None:
    lines = ["--episodes", "20", "--per-world", str(tmp_path / "worlds.csv"), "--json"]
    assert run_command(["evaluate", "--agents", "full_brake,coast", *lines]) == 0
    assert calls == {"evaluation": 1, "limits": 1, "avoidability": 1, "bound": 1, "best known": 1}


@pytest.mark.slow
def test_run__finds_the_limits_once_per_evaluation(calls: Counter[str], tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(TINY_RECIPE))
    lines = ["--episodes", "20", "--output", str(tmp_path / "run"), "--json"]
    assert run_command(["run", "--recipe", str(tmp_path / "tiny.yaml"), *lines]) == 0
    told = json.loads((tmp_path / "run" / "results.json").read_text())
    assert told[0]["unavoidable_rate"] is not None
    assert calls["evaluation"] >= 4  # the three tests, and the policy while it learns, of which nothing is proven
    assert calls["limits"] == calls["avoidability"] == calls["best known"] == 3


def test_evaluation__whose_limits_nobody_asks_for_finds_none(
    calls: Counter[str], pair: Scenario, tmp_path: Path
) -> None:
    found = evaluate(pair.sample(2, 0), {"coast": make_agent("coast")}, scenario=pair)
    assert calls["limits"] == 0
    write_per_world(tmp_path / "out.csv", found)
    assert (len(summarise(found)), found.regrets) == (1, None)
    assert found.conditions["no_limits_because"]
    assert calls["limits"] == 1
    assert found.limits is found.limits


@pytest.fixture
def worlds() -> Worlds:
    return load_scenario("paper-random").sample(50, 7).worlds


def test_known_limits__are_the_proof_and_the_best_known(worlds: Worlds) -> None:
    task = Task(load_scenario("paper-random"), (1,))
    found, proof = known_limits(worlds, task), prove(worlds, task)
    assert isinstance(found, Limits) and not isinstance(proof, Unproven)
    assert proof.harm is not None and proof.impact is not None
    assert found.known.all()
    assert (found.first_impact_harm[proof.avoidable] == 0.0).all()
    assert (found.first_impact_harm >= proof.harm - 1e-9).all() and (found.total_harm >= proof.harm - 1e-9).all()
    assert not (proof.impact & proof.avoidable).any()


def test_known_limits__say_why_nothing_is_proven(worlds: Worlds) -> None:
    scenario = load_scenario("paper-random")
    assert known_limits(worlds, Task(scenario, ())) == Unproven(
        "driven are: none; avoidability is proven for one vehicle"
    )
    coasts = load_scenario("cooperation-3-pair").replace(roles={"vehicle_1": "coast", "vehicle_2": "learner"})
    assert known_limits(worlds, Task(coasts, (1, 2))) == Unproven(
        "vehicle_1 follows coast; harm is bounded where it follows full_brake"
    )


def test_prove__decides_contact_of_vehicles_2_and_3_as_of_vehicle_2_alone(worlds: Worlds) -> None:
    scenario = load_scenario("cooperation-3-pair")
    alone, both = prove(worlds, Task(scenario, (1,))), prove(worlds, Task(scenario, (2, 1)))
    assert isinstance(alone, Proof) and isinstance(both, Proof)
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
    assert isinstance(found, Limits) and found.proof.avoidable is None and found.proof.contact is None
    bound = team_bound(sample.worlds, vehicles, horizon_s=8.0, time_step_s=0.1)
    assert np.array_equal(found.proof.harm, bound.harm)
    assert not found.known.any()
    assert (found.proof.harm > 0).any() == (name != "cooperation-4-all")


def test_evaluation__of_a_team_tells_the_proven_harm_where_contact_is_not_decided(tmp_path: Path) -> None:
    scenario = load_scenario("cooperation-3-five")
    agents = {name: make_agent(name) for name in ("full_brake", "coast")}
    found = evaluate(scenario.sample(20, 7), agents, scenario=scenario)
    rows = summarise(found)
    told = rows[0]
    assert told["unavoidable_rate"] is None and told.between is None and told["avoidable_collision_rate"] is None
    assert (
        told["proven_harm"] is not None and 0 < told["proven_harm"].value < told["best_known_first_impact_harm"].value
    )
    assert told["impact_proven_rate"] is not None and told.known_best_share == 0.0
    text = rows.limit_line()
    assert "no joint command avoids an impact (proven)" in text and "avoids contact" not in text
    write_per_world(tmp_path / "out.csv", found)
    header, first = (tmp_path / "out.csv").read_text().splitlines()[:2]
    cells = dict(zip(header.split(","), first.split(","), strict=False))
    assert cells["avoidable"] == cells["unavoidable_reason"] == "" and float(cells["proven_harm"]) >= 0
    assert avoidable_section(found).title and worst_section(found, "coast", ()).title
    with pytest.raises(InvalidInput, match="where contact can be avoided is not decided"):
        harm_in_parts(found)


@pytest.mark.parametrize("vehicles", [(2,), (-1,), (0, 0)])
def test_task__refuses_vehicles_that_are_not_there_or_twice(vehicles: tuple[int, ...]) -> None:
    with pytest.raises(InvalidInput, match=r"task: vehicles .*indices from 0 to 1, each once"):
        Task(PAIR, vehicles)


def test_task__refuses_an_unknown_count_and_names_its_one_vehicle() -> None:
    with pytest.raises(InvalidInput, match="count 'last'"):
        Task(PAIR, (1,), "last")  # type: ignore[arg-type]
    assert Task(PAIR, (1,)).vehicle == 1
    with pytest.raises(InvalidInput, match="needs one driven vehicle; driven are: vehicle_1, vehicle_2"):
        assert Task(PAIR, (0, 1)).vehicle
