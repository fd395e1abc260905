from __future__ import annotations

import json
from pathlib import Path

import pytest

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.evaluation.inputs import LADDER
from ethbrake_marl.limits.limits import TABLES, BestHarmTable, task_problem
from ethbrake_marl.scenario import Task, load_scenario

SMALL = ["search", "best-harm", "--scenario", "paper-random", "--episodes", "4", "--budget", "60", "--threads", "1"]


def test_best_harm_command__prints_figures_and_writes_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "t.npz"
    assert run_command([*SMALL, "--json", "--output", str(file)]) == 0
    figures = json.loads(capsys.readouterr().out)
    table = BestHarmTable.load(file)
    assert figures["best_known_total_harm"] == pytest.approx(table.best["total"].harm.mean())
    assert figures["harmless_rate"] == (table.best["total"].harm == 0.0).mean()
    assert table.header["list_seed"] == 7
    command = (
        "ethbrake search best-harm --scenario paper-random --episodes 4 --seed 7 --budget 60 --search-seed 0 --output"
    )
    assert table.header["command"] == figures["command"] == f"{command} FILE.npz"
    assert 0.0 < figures["proven_harm"] <= figures["best_known_first_impact_harm"]
    assert figures["impact_proven_rate"] in (0.5, 0.75, 1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["t.npz"]


def test_best_harm_command__one_count_from_an_earlier_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, better = tmp_path / "t.npz", tmp_path / "u.npz"
    assert run_command([*SMALL, "--harm-count", "first", "--output", str(file)]) == 0
    assert "best_known_first_impact_harm" in capsys.readouterr().out
    assert run_command([*SMALL, "--harm-count", "first", "--start", str(file), "--output", str(better)]) == 0
    assert list(BestHarmTable.load(better).best) == ["first"]
    assert "--harm-count first" in BestHarmTable.load(better).header["command"]
    assert "--start t.npz" in BestHarmTable.load(better).header["command"]
    assert (BestHarmTable.load(better).best["first"].harm <= BestHarmTable.load(file).best["first"].harm + 1e-6).all()


def test_best_harm_command__takes_what_agents_do_better(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    alone, folded = tmp_path / "t.npz", tmp_path / "u.npz"
    small = ["search", "best-harm", "--episodes", "30", "--budget", "60", "--threads", "1"]
    assert run_command([*small, "--output", str(alone)]) == 0
    assert run_command([*small, "--agents", "planner:60,full_brake", "--output", str(folded)]) == 0
    before, after = BestHarmTable.load(alone), BestHarmTable.load(folded)
    assert list(after.header["lowered_by"]) == ["planner:60", "full_brake"]
    assert "--agents planner:60,full_brake" in after.header["command"]
    scenario = load_scenario("paper-random")
    for k, count in enumerate(("first", "total")):
        changed = after.best[count].harm != before.best[count].harm
        assert (after.best[count].harm <= before.best[count].harm).all()
        lowered = after.header["lowered_by"]["planner:60"][count]
        assert lowered >= changed.sum()  # in some worlds by the agents of both counts
        assert count == "first" or changed.sum() >= 3
        again = task_problem(scenario.sample(30, 7).worlds, Task(scenario, (1,))).follow(after.best[count].profiles)[k]
        assert again.tolist() == after.best[count].harm.tolist()


def test_best_harm_command__lets_the_whole_ladder_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "t.npz"
    small = ["search", "best-harm", "--episodes", "3", "--budget", "60", "--threads", "1", "--harm-count", "total"]
    assert run_command([*small, "--agents", "ladder", "--output", str(file)]) == 0
    assert list(BestHarmTable.load(file).header["lowered_by"]) == list(LADDER)


@pytest.mark.parametrize(
    ("more", "fragment"),
    [
        (["--budget", "0"], "budget = 0"),
        (["--vehicles", "vehicle_9"], "vehicle_9"),
        (["--output", "nowhere/t.npz"], "no folder"),
        (["--output", "t.txt"], "a table must end in .npz"),
        (["--start", "missing.npz"], "no such table"),
        (["--start", str(TABLES / "paper-delay-low.npz")], "scenario paper-delay-low, list_seed 7"),
        (["--start", str(TABLES / "paper-random.npz"), "--seed", "8"], "holds none of these 4 worlds"),
        (["--start", str(TABLES / "paper-random.npz"), "--vehicles", "vehicle_3"], "holds none of these 4 worlds"),
        (["--vehicles", ""], "unknown vehicle ''"),
        (["--vehicles", "vehicle_2,vehicle_2"], "listed twice"),
        (["--harm-count", "some"], "some"),
        (["--scenario", "cooperation-0-sensors"], "has no learner; say who is controlled"),
        (["--agents", "planner,planner"], "given twice"),
        (["--agents", "plannr"], "unknown agent 'plannr'"),
        (["--agents", "planner", "--vehicles", "vehicle_3"], "leave out --vehicles"),
        (["--episodes", "0"], "n = 0"),
    ],
)
def test_best_harm_command__refuses(
    more: list[str], fragment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_command([*SMALL, *more]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("ethbrake: error: ") and fragment in said.err
    assert list(tmp_path.iterdir()) == []
