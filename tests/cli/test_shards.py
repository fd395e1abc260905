"""``ethbrake evaluate --shards``: the table without shards, resumable, and comparable with its like only."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LIST = ("evaluate", "--agents", "full_brake", "--episodes", "2300", "--seed", "11")
SHARDED = (*LIST, "--shards", "3")


def test_evaluate_shards__prints_the_same_in_any_parts_and_the_figures_of_one_piece(ethbrake, tmp_path: Path) -> None:
    three, one = ethbrake(*SHARDED, "--json"), ethbrake(*LIST, "--shards", "1", "--json")
    assert three.status == one.status == 0
    assert three.out == one.out
    whole = json.loads(ethbrake(*LIST, "--json").out)
    for sharded, row in zip(json.loads(one.out), whole, strict=True):
        assert sharded["kind"] == "evaluate-shards"
        assert sharded["intervals"]["rates"] == "Clopper-Pearson"
        for name in ("first_impact_harm", "total_harm_interval", "collision_rate", "sampled_harm", "parameters"):
            assert sharded[name] == row[name], name
        assert sharded["vehicle_harm"]["total_harm_1"] > 0.0
    text = ethbrake(*LIST, "--episodes", "200", "--shards", "1", "--objective", "own").out
    assert "200 worlds, seed 11" in text and "Clopper-Pearson" in text and "Objectives, first-impact harm" in text
    parts, piece = tmp_path / "parts.json", tmp_path / "piece.json"
    parts.write_text(three.out)
    piece.write_text(json.dumps(whole))
    refused = ethbrake("compare", piece, parts)
    assert refused.status == 2 and "another kind of results" in refused.err


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--jobs", "2"), "--jobs: is for an evaluation in parts"),
        (("--ray", "local"), "--ray: is for an evaluation in parts"),
        (("--output", "kept"), "--output: is for an evaluation in parts"),
        (("--rows",), "--rows: is for an evaluation in parts"),
        (("--shards", "2", "--rows"), "--rows: needs a folder"),
        (("--shards", "2", "--per-world", "x.csv"), "--output FOLDER --rows"),
        (("--shards", "2", "--report", "x.html"), "--report: needs every world at once"),
        (("--shards", "2", "--by", "scenario"), "--by: needs every world at once"),
        (("--shards", "0"), "shards = 0: must be a whole number, at least 1"),
        (("--shards", "2", "--jobs", "0"), "jobs = 0: must be a whole number in 1..256"),
        (("--shards", "2", "--episodes", "0"), "episodes = 0: must be a whole number"),
    ],
)
def test_options_that_do_not_go_together__are_refused_in_one_line(ethbrake, more, said: str) -> None:
    answer = ethbrake(*LIST, *more)
    assert answer.status == 2
    assert said in answer.err and answer.err.count("\n") == 1


def finished(folder: Path) -> list[str]:
    """The shards that a folder keeps, in the order of their ends."""
    journal = folder / "journal.jsonl"
    lines = journal.read_text().splitlines(keepends=True) if journal.exists() else []
    return [json.loads(line)["job"] for line in lines if line.endswith("}\n")]


@pytest.mark.long
def test_ray__answers_the_same(ethbrake, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    found = ethbrake(*SHARDED, "--ray", "local", "--output", tmp_path / "kept", "--json")
    assert found.status == 0 and found.out == ethbrake(*SHARDED, "--json").out
    assert len(finished(tmp_path / "kept")) == 3


def test_compare__takes_two_sharded_results(ethbrake, tmp_path: Path) -> None:
    one, other = tmp_path / "one.json", tmp_path / "other.json"
    for file in (one, other):
        file.write_text(ethbrake(*LIST, "--episodes", "200", "--shards", "1", "--json").out)
    found = ethbrake("compare", one, other)
    assert found.status == 0 and "NOT paired" in found.err and "0.00" in found.out


@pytest.mark.slow
def test_killed__the_same_command_goes_on(ethbrake, tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    command = [
        *LIST,
        "--agents",
        "full_brake",
        "--episodes",
        "20000",
        "--shards",
        "20",
        "--output",
        str(folder),
        "--json",
    ]
    program = "import sys; from ethbrake_marl.cli.app import run_command; sys.exit(run_command(sys.argv[1:]))"
    running = subprocess.Popen(
        [sys.executable, "-c", program, *command, "--jobs", "2"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    while not finished(folder) and running.poll() is None:
        time.sleep(0.05)
    running.send_signal(signal.SIGKILL)
    running.communicate()
    assert running.returncode == -signal.SIGKILL
    before = finished(folder)
    assert 0 < len(before) < 20
    time.sleep(1.0)  # its workers end with it
    went_on = ethbrake(*command)
    assert went_on.status == 0
    assert finished(folder)[: len(before)] == before and len(finished(folder)) == 20
    assert (
        went_on.out == ethbrake(*LIST, "--agents", "full_brake", "--episodes", "20000", "--shards", "1", "--json").out
    )
    assert (folder / "results.json").read_text() == went_on.out
