"""Searches on the command line."""

from unittest.mock import Mock

import pytest

from ethbrake_marl.cli import scenario as module
from ethbrake_marl.extensions.search import recall
from ethbrake_marl.extensions.search.problem import search_profiles
from ethbrake_marl.kernel_store import cache_folder
from tests.fixtures.commands import Command, told_json

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.parametrize("script", ["best_harm", "best_harm:1000000"])
def test_validate__trying_a_search_has_a_budget(ethbrake: Command, scenario_file, monkeypatch, script: str) -> None:
    searched = Mock(side_effect=search_profiles)
    monkeypatch.setattr(recall, "search_profiles", searched)
    monkeypatch.setattr(module, "TRIED_WORLDS", 5)
    path = scenario_file("vehicle_3: full_brake", f"vehicle_3: {script}")
    path.write_text(path.read_text().replace("early_impacts: reject", "early_impacts: keep"))
    assert ethbrake("scenario", "validate", path).out.startswith("OK  mine: 3 vehicles, learners: vehicle_2;")
    budgets = [call.kwargs["budget"] for call in searched.call_args_list]
    assert budgets and max(budgets) <= 16


def test_benchmark__shares_are_those_of_each_scenario_alone(ethbrake: Command) -> None:
    words = ("--agents", "full_brake,coast", "--episodes", "10", "--set", "harm_count=total", "--json")
    told = told_json(ethbrake("evaluate", "--scenario", "benchmark", *words))
    assert len({row["scenario"] for row in told}) == 10 and len(told) == 20
    shares = {(row["scenario"], row["agent"]): row["share_of_possible_reduction"] for row in told}
    for name in ("paper-random", "cooperation-2-five"):
        for row in told_json(ethbrake("evaluate", "--scenario", name, *words)):
            alone = row["share_of_possible_reduction_total"]
            assert shares[name, row["agent"]]["value"] == alone and (alone == 0.0) == (row["agent"] == "full_brake")


@pytest.mark.long
def test_compile__leaves_nothing_of_a_search_to_compile(ethbrake: Command) -> None:
    assert ethbrake("doctor", "--compile").status == 0
    kernels = set(cache_folder().iterdir())
    assert ethbrake("evaluate", "--agents", "best_harm", "--episodes", "3").status == 0
    assert set(cache_folder().iterdir()) == kernels
