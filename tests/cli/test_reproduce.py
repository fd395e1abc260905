"""The command ``ethbrake reproduce``."""

from __future__ import annotations

import json

import pytest

from ethbrake_marl.studies.reproduction.folder import ITEMS


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


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["harm-delay"], "did you mean 'harm-delays'?"),
        (["<script>"], "unknown item '<script>'"),
        (["../gaps"], "unknown item"),
        (["gaps", "gaps"], "given twice"),
        (["--quick", "--full"], "give one of the two"),
        (["gaps", "--episodes", "1"], "episodes = 1: must be a whole number in 2..10000"),
        (["gaps", "--docs", "nowhere/page.md"], "there is no folder nowhere"),
        (["gaps", "--docs", "page.html"], "must end in .md"),
    ],
)
def test_reproduce__bad_input_is_refused_before_any_work(ethbrake, tmp_path, monkeypatch, arguments, told) -> None:
    monkeypatch.chdir(tmp_path)
    answer = ethbrake("reproduce", *arguments)
    assert answer.status == 2 and told in answer.err
    assert list(tmp_path.iterdir()) == []
