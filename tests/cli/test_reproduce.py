"""The command ``ethbrake reproduce``."""

from __future__ import annotations

import json

from ethbrake_marl.studies.reproduction import ITEMS


def test_reproduce__lists_every_item(ethbrake) -> None:
    answer = ethbrake("reproduce", "--list", "--json")
    assert [each["name"] for each in json.loads(answer.out)] == [item.name for item in ITEMS]


def test_reproduce__says_what_it_takes_makes_one_item_and_keeps_it(ethbrake, tmp_path) -> None:
    folder = tmp_path / "out"
    answer = ethbrake("reproduce", "accelerations", "--output", folder, "--json")
    assert answer.status == 0
    assert "to do: 1 item," in answer.err and f"page: {folder / 'index.html'}" in answer.err
    (result,) = json.loads(answer.out)
    assert result["name"] == "accelerations" and result["verdict"]["outcome"] in ("agrees", "differs")
    made = (folder / "accelerations" / "result.json").stat().st_mtime_ns
    assert ethbrake("reproduce", "accelerations", "--output", folder).status == 0
    assert (folder / "accelerations" / "result.json").stat().st_mtime_ns == made
    refused = ethbrake("reproduce", "accelerations", "--output", folder, "--episodes", 50)
    assert refused.status == 2 and "episodes 10000, here 50" in refused.err
