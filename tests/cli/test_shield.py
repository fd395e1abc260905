"""`ethbrake shield` and its picture."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from ethbrake_marl.agents import registry
from ethbrake_marl.agents.registry import Entry, Team, make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.scenario.schema import shipped_folder
from tests.failing_worlds import plant


def test_shield__prints_its_rows_as_json_and_as_a_table(ethbrake):
    arguments = ("shield", "--agents", "full_brake", "--episodes", "30")
    answer = ethbrake(*arguments, "--json")
    assert answer.status == 0
    rows = json.loads(answer.out)
    assert [row["mode"] for row in rows] == ["none", "episode", "step", "step-alert"]
    assert rows[2]["harm"] <= rows[1]["harm"] <= rows[0]["harm"]
    assert rows[2]["above_bound"] == 0 and rows[0]["needed"] is None
    table = ethbrake(*arguments).out
    assert "full_brake" in table and "needed" in table and f"{rows[2]['harm']:.2f}" in table


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "command",
    [
        ("shield", "--agents", "full_brake"),
        ("watch", "picture", "shield-modes", "--agents", "coast", "--output", "x.png"),
        ("watch", "picture", "shield", "--agents", "coast,full_brake", "--output", "x.png"),
        pytest.param(("watch", "picture", "robustness", "--output", "x.png"), marks=pytest.mark.slow),
    ],
    ids=lambda command: " ".join(command[:2]),
)
def test_commands_of_the_shield__name_the_worlds_that_they_leave_out(ethbrake, monkeypatch, tmp_path, command):
    monkeypatch.chdir(tmp_path)
    sample = Scenario.sample

    def planted(self, n, seed, **options):
        drawn = sample(self, n, seed, **options)
        return replace(drawn, worlds=plant(drawn.worlds, [2] if n == 4 else []))

    monkeypatch.setattr(Scenario, "sample", planted)
    answer = ethbrake(*command, "--episodes", "4")
    assert answer.status == 0
    assert "LEFT OUT for every agent: 1 of 4 worlds" in answer.err
    assert "world 2 of seed 7 (a contact was missed" in answer.err


def test_picture__shows_the_modes(ethbrake, tmp_path):
    out = tmp_path / "modes.png"
    answer = ethbrake("watch", "picture", "shield-modes", "--agents", "full_brake", "--episodes", "20", "--output", out)
    assert (answer.status, answer.out) == (0, "")
    assert out.read_bytes().startswith(b"\x89PNG")


TEAM = ("--scenario", "cooperation-3-pair", "--agents", "full_brake,policy@shipped", "--episodes", "12")


def test_shield__of_several_learners_tells_bound_interventions_and_shares_and_can_be_compared(ethbrake, tmp_path):
    answer = ethbrake("shield", *TEAM, "--json")
    assert answer.status == 0
    rows = json.loads(answer.out)
    assert [row["mode"] for row in rows] == ["none", "step", "step-alert", "step-cap"] * 2
    step, capped = rows[1], rows[3]
    assert step["harm"] <= step["bound"] and step["against_none"] < 0.0 and step["against_episode"] is None
    assert [each["vehicle"] for each in step["vehicles"]] == ["vehicle_1", "vehicle_2", "vehicle_3"]
    assert step["vehicles"][0]["replaced"] is None and step["vehicles"][1]["replaced"] > 0.0
    assert {row["above_bound"] for row in rows if row["mode"] != "none"} == {0}
    assert {each["above_baseline"] for each in capped["vehicles"]} == {0.0}
    assert set(rows[5]["policy_sha256"]) == {"vehicle_2", "vehicle_3"} and rows[0]["policy_sha256"] == {}
    table = ethbrake("shield", *TEAM, "--harm-count", "total").out
    assert "minus no shield" in table and "What each vehicle bears" in table and "full_brake, step-cap" in table
    file = tmp_path / "shield.json"
    file.write_text(answer.out)
    compared = ethbrake("compare", file, file)
    assert compared.status == 0 and "step-cap" in compared.out


@pytest.mark.parametrize("command", [("watch", "picture", "shield"), ("watch", "picture", "shield-modes")])
def test_picture__draws_a_shielded_team(ethbrake, tmp_path, command):
    out = tmp_path / "team.png"
    words = ("--scenario", "cooperation-3-pair", "--agents", "full_brake", "--episodes", "6", "--output", out)
    answer = ethbrake(*command, *words)
    assert (answer.status, answer.out) == (0, "") and out.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("words", [("shield",), ("watch", "picture", "shield", "--output", "x.png")])
def test_shield__a_shielded_team_and_a_vehicle_that_is_no_learner_are_refused(ethbrake, words):
    told = ethbrake(*words, "--scenario", "cooperation-3-pair", "--agents", "coast+step", "--episodes", "3")
    assert told.status == 2 and "agent 'coast+step': has a shield already" in told.err
    told = ethbrake(*words, "--scenario", "cooperation-0-sensors", "--agents", "coast", "--episodes", "3")
    assert told.status == 2 and "no learner to drive" in told.err and len(told.err.strip().splitlines()) == 1


def test_evaluate__a_team_goes_behind_the_step_shield_and_no_other(monkeypatch):
    scenario, team = load_scenario("cooperation-3-pair"), Team.of(make_agent("coast"), [1, 2])
    monkeypatch.setitem(registry._ENTRIES, "team", Entry("team@RUN", "", (), lambda argument, settings: team))
    assert list(make_lineup(["team@run"], scenario)) == ["team@run"]
    with pytest.raises(
        InvalidInput, match=r"agent 'team@run\+robust': is a team, and \+robust is for one driven vehicle"
    ):
        make_lineup(["team@run+robust"], scenario)
    assert sorted(make_lineup(["team@run+step"], scenario)["team@run+step"].drivers) == [1, 2]


def test_horizon__what_still_moves_then_is_told_by_both_commands(ethbrake, tmp_path):
    short = tmp_path / "short.yaml"
    long = (shipped_folder() / "paper" / "paper-random.yaml").read_text("utf-8")
    short.write_text(long.replace("horizon_s: 8", "horizon_s: 3").replace("name: paper-random", "name: short"), "utf-8")
    note = "note: bounds of the shield end at the horizon (3 s) and say nothing of what comes after; worlds, of 20,"
    told = ethbrake("shield", "--agents", "full_brake", "--episodes", "20", "--scenario", str(short), "--json")
    assert note in told.err and all(row["horizon_ends"] > 10 for row in json.loads(told.out))
    policy = "ppo@ethbrake_marl/_policies/ppo+episode"
    evaluated = ethbrake("evaluate", "--agents", f"{policy},full_brake", "--episodes", "20", "--scenario", str(short))
    assert (
        note in evaluated.err and "rest then: full_brake" not in evaluated.err and ", full_brake" not in evaluated.err
    )
    assert "note: bounds" not in ethbrake("shield", "--agents", "full_brake", "--episodes", "5").err
