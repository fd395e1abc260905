"""`ethbrake shield` and its picture."""

from __future__ import annotations

import json


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


def test_shield__an_unknown_agent_is_refused(ethbrake):
    answer = ethbrake("shield", "--agents", "ful_brake", "--episodes", "3")
    assert answer.status == 2 and "did you mean 'full_brake'" in answer.err


def test_picture__shows_the_modes(ethbrake, tmp_path):
    out = tmp_path / "modes.png"
    answer = ethbrake("picture", "shield-modes", "--agents", "full_brake", "--episodes", "20", "--output", out)
    assert (answer.status, answer.out) == (0, "")
    assert out.read_bytes().startswith(b"\x89PNG")
