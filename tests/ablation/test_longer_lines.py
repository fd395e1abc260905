"""Policies of one line length on others."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from ethbrake_marl.ablation.longer_lines import Question, drive_longer, lengthened
from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.cli import run_command
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.scenario import load_scenario

PAIR = load_scenario("cooperation-3-pair")


def test_lengthened__vehicle_i_is_like_vehicle_i_minus_2():
    line = lengthened(PAIR, 6)
    vehicles = line.sample(2, 7).worlds.vehicles
    assert vehicles.mass_t[0].tolist() == [4.5, 5.5, 5.9, 5.5, 5.9, 5.5]
    assert vehicles.latency_s[0].tolist() == [0.0, 0.5, 0.8, 0.5, 0.8, 0.5]
    assert line.learners == (1, 2, 3, 4, 5)
    assert line.scripts == {0: "full_brake"}
    assert lengthened(PAIR, 2).sample(1, 7).worlds.N == 2


def test_lengthened__the_same_length_is_the_same_line():
    one, other = lengthened(PAIR, 3).sample(5, 7).worlds, PAIR.sample(5, 7).worlds
    np.testing.assert_array_equal(one.gaps_m, other.gaps_m)
    np.testing.assert_array_equal(one.vehicles.mass_t, other.vehicles.mass_t)


def test_lengthened__lists_of_pairs_and_objectives_go_on_too():
    listed = PAIR.replace(gaps_m=[6.0, 8.0], objective=["own", "total", "social:45"])
    line = lengthened(listed, 5)
    assert line.sample(1, 7).worlds.gaps_m[0].tolist() == [6.0, 8.0, 6.0, 8.0]
    assert line.objective == ("own", "total", "social:45", "total", "social:45")


def test_drive_longer__full_braking_gains_nothing_on_itself():
    question = Question(PAIR, (3, 4), 20, 7, "total", 3, 50)
    found = drive_longer(question, [make_agent("full_brake")])
    assert [one.vehicles for one in found] == [3, 4]
    for one in found:
        assert (one.decrease.value, one.worse_off.value, one.share.value) == (0.0, 0.0, 0.0)
    three = evaluate(PAIR.sample(20, 7), {"b": make_agent("full_brake")}, scenario=PAIR).outcome("b").total_harm
    assert found[0].reached.value == pytest.approx(three.mean(), rel=1e-12)


def test_generalise__prints_a_table_or_json_and_refuses_bad_input(tmp_path, tiny, capsys):
    run = tmp_path / "run"
    assert run_command(["train", "--scenario", "cooperation-3-pair", "--recipe", str(tiny), "--output", str(run)]) == 0
    words = ["generalise", "--runs", str(run), "--vehicles", "3,6", "--episodes", "10"]
    capsys.readouterr()
    assert run_command([*words, "--search-episodes", "2", "--budget", "20", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["vehicles"] for row in rows] == [3, 6]
    assert rows[1]["best_known"] <= rows[1]["full_brake"] * 10 and rows[1]["share_interval"] is not None
    assert run_command(words) == 0
    assert "| 6 |" in capsys.readouterr().out
    for bad, what in (("--vehicles", "3,x"), ("--vehicles", "1"), ("--episodes", "0"), ("--runs", str(tmp_path))):
        assert run_command([*words, bad, what]) == 2
    copy = tmp_path / "team"
    shutil.copytree(run, copy)
    team = {"vehicle_2": "policy/vehicle_2", "vehicle_3": "policy/vehicle_3"}
    content = json.loads((copy / "team.json").read_text()) | {"scheme": "independent", "drivers": team}
    (copy / "team.json").write_text(json.dumps(content))
    capsys.readouterr()
    assert run_command([*words, "--runs", str(copy)]) == 2
    assert "have a policy each" in capsys.readouterr().err
