"""Policies of one line length on others."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.policies import Manifest, Policy, load_policy
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies import ablation
from ethbrake_marl.studies.ablation import LineQuestion, lengthen

PAIR = load_scenario("cooperation-3-pair")


def test_lengthened__vehicle_i_is_like_vehicle_i_minus_2():
    line = lengthen(PAIR, 6)
    vehicles = line.sample(2, 7).worlds.vehicles
    assert vehicles.mass_t[0].tolist() == [4.5, 5.5, 5.9, 5.5, 5.9, 5.5]
    assert vehicles.latency_s[0].tolist() == [0.0, 0.5, 0.8, 0.5, 0.8, 0.5]
    assert line.learners == (1, 2, 3, 4, 5)
    assert line.scripts == {0: "full_brake"}
    assert lengthen(PAIR, 2).sample(1, 7).worlds.N == 2


def test_lengthened__the_same_length_is_the_same_line():
    one, other = lengthen(PAIR, 3).sample(5, 7).worlds, PAIR.sample(5, 7).worlds
    np.testing.assert_array_equal(one.gaps_m, other.gaps_m)
    np.testing.assert_array_equal(one.vehicles.mass_t, other.vehicles.mass_t)


def test_lengthened__lists_of_pairs_and_objectives_go_on_too():
    listed = PAIR.replace(gaps_m=[6.0, 8.0], objective=["own", "total", "social:45"])
    line = lengthen(listed, 5)
    assert line.sample(1, 7).worlds.gaps_m[0].tolist() == [6.0, 8.0, 6.0, 8.0]
    assert line.objective == ("own", "total", "social:45", "total", "social:45")


def test_drive_longer__full_braking_gains_nothing_on_itself():
    question = LineQuestion(PAIR, (3, 4), 20, 7, "total", 3, 50)
    found = question.drive([make_agent("full_brake")])
    assert [one["vehicles"] for one in found] == [3, 4]
    for one in found:
        assert (one["decrease"], one["worse_off"], one["share"]) == (0.0, 0.0, 0.0)
    three = evaluate(PAIR.sample(20, 7), {"b": make_agent("full_brake")}, scenario=PAIR).outcome("b").total_harm
    assert found[0]["reached"] == pytest.approx(three.mean(), rel=1e-12)


def test_drive_longer__all_lines_are_made_before_one_is_driven(monkeypatch):
    driven = []
    monkeypatch.setattr(ablation, "evaluate", lambda *_, **__: driven.append(1))
    weighted = PAIR.replace(name="mine", objective="weighted:1,2,3")
    question = LineQuestion(weighted, (3, 4), 20, 7, "total", 0, 50)
    with pytest.raises(InvalidInput, match="mine-n4"):
        question.drive([make_agent("full_brake")])
    with pytest.raises(InvalidInput, match="vehicles 3, 3: each length once"):
        replace(question, vehicles=(3, 3)).drive([make_agent("full_brake")])
    assert not driven


@pytest.fixture(scope="module")
def run(tmp_path_factory, tiny) -> Path:
    """The run of a policy that Vehicles 2 and 3 share; not to be changed."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    words = ["train", "--scenario", "cooperation-3-pair", "--recipe", str(tiny), "--steps", "64"]
    assert run_command([*words, "--output", str(folder)]) == 0
    return folder


def test_generalise__prints_a_table_or_json_and_refuses_bad_input(run, tmp_path, capsys):
    words = ["study", "generalise", "--runs", str(run), "--scenario", "cooperation-3-pair", "--vehicles", "3,6"]
    words += ["--episodes", "10"]
    capsys.readouterr()
    assert run_command([*words, "--search-episodes", "2", "--budget", "20", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["vehicles"] for row in rows] == [3, 6] and {row["kind"] for row in rows} == {"generalise"}
    assert len({row["worlds_sha256"] for row in rows}) == 2 == len({row["scenario_sha256"] for row in rows})
    (policy,) = rows[0]["policy_sha256"]
    assert policy == load_policy(run).manifest.manifest_sha256
    assert rows[1]["best_known"] <= rows[1]["full_brake"] * 10 and rows[1]["share_interval"] is not None
    assert run_command(words) == 0
    out = capsys.readouterr().out
    assert "| 6 |" in out and "one seed says nothing about others" in out
    for bad, what in (("--vehicles", "3,x"), ("--vehicles", "1"), ("--episodes", "0"), ("--runs", str(tmp_path))):
        assert run_command([*words, bad, what]) == 2


def refused(capsys, runs: str, scenario: str = "cooperation-3-pair") -> str:
    capsys.readouterr()
    words = ["study", "generalise", "--runs", runs, "--scenario", scenario, "--vehicles", "3", "--episodes", "10"]
    assert run_command(words) == 2
    return capsys.readouterr().err


def test_generalise__runs_that_are_not_seeds_of_one_training_are_refused(run, tmp_path, capsys):
    assert "must be runs or bundles" in refused(capsys, "") and "must be runs or bundles" in refused(capsys, f"{run},")
    assert "are one policy; give each once" in refused(capsys, f"{run},{run}/../run")
    assert "are one policy; give each once" in refused(capsys, f"{run},{run / 'policy'}")
    other = changed(run, tmp_path / "scenario", scenario={"name": "mine"})
    assert f"runs {run} and {other}: differ in scenario; give seeds of one training" in refused(
        capsys, f"{run},{other}"
    )
    other = changed(run, tmp_path / "recipe", recipe={"gamma": 0.5})
    assert "differ in recipe" in refused(capsys, f"{run},{other}")
    seed = changed(run, tmp_path / "seed", recipe={"seed": 1})
    words = ["study", "generalise", "--runs", f"{run},{seed}", "--scenario", "cooperation-3-pair", "--vehicles", "2,4"]
    assert run_command([*words, "--episodes", "5"]) == 0
    assert "2 policies" in capsys.readouterr().out
    (seed / "config.json").write_text("[]")
    assert "config.json: is damaged" in refused(capsys, f"{run},{seed}")


def test_generalise__nobody_drives_vehicle_1_who_never_did(run, tmp_path, capsys):
    err = refused(capsys, str(run), "cooperation-4-all")
    assert "vehicle_1 learns there" in err and "--scenario cooperation-3-pair" in err


def test_generalise__a_policy_for_each_learner_is_refused(run, tmp_path, capsys):
    copy = tmp_path / "team"
    shutil.copytree(run, copy)
    team = {"vehicle_2": "policy/vehicle_2", "vehicle_3": "policy/vehicle_3"}
    content = json.loads((copy / "team.json").read_text()) | {"scheme": "independent", "drivers": team}
    (copy / "team.json").write_text(json.dumps(content))
    assert "have a policy each" in refused(capsys, str(copy))


def changed(run: Path, folder: Path, scenario: Mapping[str, object] = {}, recipe: Mapping[str, object] = {}) -> Path:
    """A run of another policy, with some other values in its scenario or recipe."""
    shutil.copytree(run, folder)
    policy = load_policy(run)
    fields = {name: getattr(policy.manifest, name) for name in Manifest.model_fields}
    del fields["weights_sha256"], fields["manifest_sha256"]
    tensors = {name: tensor + np.float32(0.01) for name, tensor in policy.tensors.items()}
    other = Policy.make(tensors, **{**fields, "scenario": {**policy.manifest.scenario, **scenario}})
    other.save(folder / "policy", replace=True)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"recipe": {**config["recipe"], **recipe}}))
    return folder
