"""Searches on the command line."""

import shutil
from unittest.mock import Mock

import pytest

from ethbrake_marl.cli import scenario as module
from ethbrake_marl.extensions.search import recall
from ethbrake_marl.extensions.search.problem import search_profiles
from ethbrake_marl.kernel_store import cache_folder
from ethbrake_marl.policies.shipped import shipped_policies
from tests.cli.test_refusals import write_scenario
from tests.fixtures.commands import Command, Refuse, check_refused, told_json

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.parametrize("script", ["best_harm", "best_harm:1000000"])
def test_validate__trying_a_search_has_a_budget(ethbrake: Command, scenario_file, monkeypatch, script: str) -> None:
    searched = Mock(side_effect=search_profiles)
    monkeypatch.setattr(recall, "search_profiles", searched)
    monkeypatch.setattr(module, "TRIED_WORLDS", 5)
    path = scenario_file("\n  vehicle_3: full_brake\n", f"\n  vehicle_3: {script}\n")
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


def test_evaluate__a_list_that_is_not_held_tells_what_needs_no_proof(ethbrake: Command, monkeypatch) -> None:
    line = ("evaluate", "--agents", "full_brake,coast", "--episodes", "600", "--json")
    held = told_json(ethbrake(*line))
    monkeypatch.setattr("ethbrake_marl.evaluation.identity.HELD", 500)
    flat = told_json(ethbrake(*line))
    for one, other in zip(flat, held, strict=True):
        assert one["parameters"]["no_limits_because"]
        for name in ("first_impact_harm", "total_harm_interval", "collision_rate_interval", "worlds_sha256"):
            assert one[name] == other[name], name
        assert one["mean_regret"] is None is not other["mean_regret"]


def test_evaluate__a_damaged_bundle_is_refused_by_file_with_a_search_around_it(ethbrake, tmp_path) -> None:
    shutil.copytree(shipped_policies()["ppo"] / "policy", tmp_path / "policy")
    weights = tmp_path / "policy" / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    spec = f"ppo@{tmp_path / 'policy'}+search"
    check_refused(ethbrake("evaluate", "--episodes", "5", "--agents", spec), str(weights))


@pytest.mark.long
def test_compile__leaves_nothing_of_a_search_to_compile(ethbrake: Command) -> None:
    assert ethbrake("doctor", "--compile").status == 0
    kernels = set(cache_folder().iterdir())
    assert ethbrake("evaluate", "--agents", "best_harm", "--episodes", "3").status == 0
    assert set(cache_folder().iterdir()) == kernels


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "vehicle_3: full_brake\n",
            "vehicle_3: best_harm:1000001\n",
            "the number of profiles to try in each world, from 1 to 1,000,000, for instance best_harm:20000",
        )
    ],
)
def test_validate__names_the_line_of_the_mistake(old: str, new: str, message: str, refuse: Refuse) -> None:
    write_scenario(old, new)
    refuse("scenario validate mine.yaml", message)


@pytest.mark.parametrize("command", ["run --output new", "train --output new", "evaluate"])
def test_role_that_cannot_drive__is_refused_before_anything_is_written(command: str, refuse: Refuse) -> None:
    write_scenario("vehicle_1: full_brake\n", "vehicle_1: best_harm:0\n")
    refuse(f"{command} --scenario mine.yaml", "mine.yaml, line 80: roles.vehicle_1 = best_harm:0: agent 'best_harm:0'")
