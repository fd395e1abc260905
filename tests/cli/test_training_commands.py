"""`ethbrake train resume`, `learning-curves` and `export`, with trainings of a few small updates."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import onnx
import pytest
import yaml

from ethbrake_marl.evaluation.inputs import scenario_sha256, worlds_sha256
from ethbrake_marl.policies import load_policy
from ethbrake_marl.scenario import load_scenario
from tests.cli.conftest import TINY_RECIPE
from tests.cli.test_bad_input import refused
from tests.cli.test_run import ctrl_c_when, run_json

TINY_SAC = {
    "name": "tiny-sac",
    "algorithm": "sac",
    "total_steps": 320,
    "n_envs": 16,
    "batch_size": 16,
    "buffer_size": 200,
    "learning_starts": 64,
    "learning_rate": {"start": 1e-3, "end": 1e-4},
    "gamma": 0.99,
    "tau": 0.02,
    "network": {"policy": [8], "value": [8]},
    "reward": {"harm": 1.0},
    "evaluation": {"every_updates": 10, "worlds": 10, "seed": 7},
    "checkpoint_every_updates": 100,
    "log_every_updates": 5,
}


@pytest.fixture(scope="session")
def tiny_sac(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recipe") / "tiny-sac.yaml"
    path.write_text(yaml.safe_dump(TINY_SAC))
    return path


def test_resume__goes_on_and_ends_as_if_nothing_had_happened(ethbrake, tiny_recipe, tmp_path, monkeypatch):
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    assert ethbrake("train", "--recipe", tiny_recipe, "--output", whole).status == 0
    with monkeypatch.context() as patch:
        ctrl_c_when(patch, lambda shown: shown["done"] == 128)
        answer = ethbrake("train", "--recipe", tiny_recipe, "--output", stopped)
    assert answer.status == 130
    assert f"go on with: ethbrake train resume {stopped}" in answer.err.splitlines()[-1]
    answer = ethbrake("train", "resume", stopped, "--json")
    assert answer.status == 0
    assert (json.loads(answer.out)["status"], json.loads(answer.out)["steps"]) == ("finished", 256)
    for name in ("policy", "policy-last"):
        expected = load_policy(whole / name).manifest.weights_sha256
        assert load_policy(stopped / name).manifest.weights_sha256 == expected
    refused(
        ethbrake("train", "resume", stopped), "has finished", "ethbrake evaluate --scenario paper-random --agents ppo@"
    )
    refused(ethbrake("train", "resume", tmp_path), "holds no training")


def test_train__by_a_scheme_leaves_a_team_that_evaluate_takes(ethbrake, tiny_recipe, tmp_path):
    scenario, folder = ("--scenario", "cooperation-3-pair"), tmp_path / "run"
    told = "policy/vehicle_2 drives vehicle_2; policy/vehicle_3 drives vehicle_3"
    answer = ethbrake("train", *scenario, "--recipe", tiny_recipe, "--scheme", "independent", "--output", folder)
    assert answer.status == 0 and f"scheme independent: {told}" in answer.err
    answer = ethbrake("evaluate", *scenario, "--episodes", "20", "--agents", f"ppo@{folder},team@{folder}", "--json")
    assert answer.status == 0
    alone, team = json.loads(answer.out)
    assert alone["first_impact_harm"] == team["first_impact_harm"]
    refused(ethbrake("train", *scenario, "--scheme", "single", "--output", tmp_path / "no"), "has 2 learners")
    refused(ethbrake("train", *scenario, "--scheme", "centralized", "--output", tmp_path / "no"), "centralised")
    refused(ethbrake("evaluate", "--agents", f"team@{tmp_path}"), "holds no team")
    refused(ethbrake("evaluate", *scenario, "--agents", f"sac@{folder}"), "was trained by PPO", f"ppo@{folder}")
    nobody = ethbrake("evaluate", "--scenario", "cooperation-0-sensors", "--agents", f"team@{folder}")
    refused(nobody, "has no learner to drive; give the scenario that the agents were trained for")
    refused(ethbrake("train", "resume", folder), "evaluate --scenario cooperation-3-pair --agents team@")


@pytest.mark.slow
def test_resume__an_interrupted_run_goes_on_as_a_training(ethbrake, tiny_recipe, tmp_path, monkeypatch):
    folder = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        ctrl_c_when(patch, lambda shown: shown["done"] == 128)
        assert ethbrake("run", "--recipe", tiny_recipe, "--episodes", "20", "--output", folder).status == 130
    assert run_json(folder)["stage"] == "report"
    assert ethbrake("train", "resume", folder).status == 0
    assert (run_json(folder)["status"], run_json(folder)["steps"]) == ("finished", 256)


@pytest.mark.slow
def test_run__with_sac_calls_its_policy_so(ethbrake, tiny_sac, tmp_path):
    answer = ethbrake("run", "--recipe", tiny_sac, "--episodes", "20", "--output", tmp_path / "new", "--json")
    assert answer.status == 0
    assert [row["agent"] for row in json.loads(answer.out)][-2:] == ["sac", "hybrid"]
    assert json.loads((tmp_path / "new" / "config.json").read_text())["update_ratio"] == 1 / 16
    answer = ethbrake("evaluate", "--episodes", "20", "--agents", f"sac@{tmp_path / 'new'}", "--json")
    assert answer.status == 0
    refused(ethbrake("evaluate", "--agents", f"ppo@{tmp_path / 'new'}"), "was trained by SAC")


def test_learning_curves__one_command_trains_draws_and_goes_on(ethbrake, tiny_recipe, tiny_sac, tmp_path, monkeypatch):
    folder = tmp_path / "curves"
    arguments = ("train", "curves", "--recipes", f"{tiny_recipe}:2,{tiny_sac}:2", "--output", folder, "--json")
    with monkeypatch.context() as patch:
        ctrl_c_when(patch, lambda shown: shown["name"] == "tiny-seed1" and shown["done"] == 128)
        answer = ethbrake(*arguments)
    assert answer.status == 130 and "the same command goes on" in answer.err
    kept = (folder / "tiny-seed0" / "policy" / "manifest.json").stat().st_mtime_ns
    answer = ethbrake(*arguments)
    assert answer.status == 0
    assert (folder / "tiny-seed0" / "policy" / "manifest.json").stat().st_mtime_ns == kept
    assert (folder / "learning_curves.png").read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader((folder / "learning_curves.csv").read_text().splitlines()))
    harms = {(r["recipe"], r["seed"], int(r["steps"])): float(r["value"]) for r in rows if r["figure"] != "return"}
    assert {key[2] for key in harms if key[0] == "tiny"} == {0, 128, 256}
    assert {key[2] for key in harms if key[0] == "tiny-sac"} == {0, 160, 320}
    summary = json.loads(answer.out)
    last = [harms["tiny", seed, 256] for seed in "01"]
    assert summary["recipes"]["tiny"]["last"]["each"] == last
    scenario, told = load_scenario("paper-random"), summary["recipes"]["tiny"]
    assert (summary["kind"], summary["scenario_sha256"]) == ("learning-curves", scenario_sha256(scenario))
    fixed = scenario.sample(10, 7)
    assert told["worlds_sha256"] == worlds_sha256(fixed.worlds, fixed.index)
    runs = [load_policy(folder / f"tiny-seed{seed}") for seed in (0, 1)]
    assert told["policy_sha256"] == [policy.manifest.manifest_sha256 for policy in runs]
    assert summary["recipes"]["tiny"]["last"]["interquartile_mean"] == pytest.approx(sum(last) / 2)
    low, high = summary["recipes"]["tiny"]["last"]["interval"]
    assert min(last) <= low <= high <= max(last)
    other = tiny_recipe.parent / "other.yaml"
    other.write_text(yaml.safe_dump({**TINY_RECIPE, "gamma": 0.9}))
    answer = ethbrake("train", "curves", "--recipes", f"{other}:1", "--output", folder)
    refused(answer, "holds another training (here other: recipe gamma); give another folder")


def test_learning_curves__of_an_edited_scenario_are_not_those_of_the_old_one(
    ethbrake, tiny_recipe, scenario_file, tmp_path
):
    command = ("train", "curves", "--recipes", f"{tiny_recipe}:1", "--output", tmp_path / "curves", "--scenario")
    assert ethbrake(*command, scenario_file("horizon_s: 8", "horizon_s: 8")).status == 0
    drawn = (tmp_path / "curves" / "learning_curves.json").stat().st_mtime_ns
    answer = ethbrake(*command, scenario_file("horizon_s: 8", "horizon_s: 9"))
    refused(answer, "tiny-seed0: holds another training (here other: scenario horizon_s); give another folder")
    assert (tmp_path / "curves" / "learning_curves.json").stat().st_mtime_ns == drawn
    words = scenario_file('title: "One line for lists and figures"', 'title: "Another line"')
    assert ethbrake(*command, words).status == 0  # words change no training: its result is kept


def test_learning_curves__another_training_is_told_before_any_is_begun(ethbrake, tiny_recipe, tiny_sac, tmp_path):
    folder = tmp_path / "curves"
    assert ethbrake("train", "--recipe", tiny_sac, "--seed", "0", "--output", folder / "tiny-sac-seed0").status == 0
    both = ("train", "curves", "--recipes", f"{tiny_recipe}:1,{tiny_sac}:1", "--steps", "160", "--output", folder)
    refused(ethbrake(*both), "tiny-sac-seed0: holds another training (here other: recipe total_steps)")
    assert {path.name for path in folder.iterdir()} - {".lock"} == {"tiny-sac-seed0"}


@pytest.mark.parametrize("recipes", ["ppo", "ppo:0", "ppo:2,ppo:3", "pppo:2", ""])
def test_learning_curves__refuses_a_plan_that_is_none(ethbrake, recipes, tmp_path):
    refused(ethbrake("train", "curves", "--recipes", recipes, "--output", tmp_path / "new"), "recipe")
    assert not (tmp_path / "new").exists()


def test_export__writes_onnx(ethbrake, finished_run, tmp_path, monkeypatch):
    assert ethbrake("agent", "export", finished_run, "--onnx", tmp_path / "policy.onnx").status == 0
    model = onnx.load(str(tmp_path / "policy.onnx"))
    assert [output.name for output in model.graph.output] == ["action", "acceleration_mps2"]
    monkeypatch.setitem(sys.modules, "onnx", None)  # not installed: the output is looked at before that is
    refused(ethbrake("agent", "export", finished_run, "--onnx", tmp_path / "policy.onnx"), "is there already")
    refused(
        ethbrake("agent", "export", finished_run, "--onnx", tmp_path / "none" / "policy.onnx"), "there is no folder"
    )
    refused(ethbrake("agent", "export", finished_run, "--onnx", tmp_path / "new.onnx"), "needs the package onnx")
