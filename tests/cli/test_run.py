"""`ethbrake run` and `ethbrake train`, with a training of two small updates."""

from __future__ import annotations

import csv
import inspect
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.cli.command import Out
from ethbrake_marl.evaluation import evaluate, summarise
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.figures import learning_curve
from ethbrake_marl.policies import load_policy
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies import experiment as results_folder
from ethbrake_marl.studies.experiment import write_figures

ROOT = Path(__file__).resolve().parents[2]
AGENTS = ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise", "ppo", "hybrid"]


def program(source: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Runs Python source in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", source],
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        encoding=environment.get("PYTHONIOENCODING", "utf-8"),
        check=False,
    )


def run_json(folder: Path) -> dict:
    return json.loads((folder / "run.json").read_text())


def test_run__leaves_results_figures_report_and_policy(finished_run):
    names = {path.name for path in finished_run.iterdir()}
    assert names >= {"config.json", "run.json", "progress.csv", "policy", "results.csv", "results.json"}
    assert names >= {"per_world.csv", "report.html"}
    assert names >= {"learning_curve.png", "harm_against_gap.png", "trajectories.png"}
    page = (finished_run / "report.html").read_text()
    assert page.count("<figure>") == 6 and "data:image" not in page  # three of them are in the pictures, too
    assert page.count('"passport":"EB1:paper-random:') == 50 * len(AGENTS)
    ended = run_json(finished_run)
    assert (ended["status"], ended["stage"], ended["steps"], ended["reason"]) == ("finished", "report", 256, None)


def test_run__results_agree_in_json_csv_and_per_world(finished_run):
    rows = json.loads((finished_run / "results.json").read_text())
    flat = list(csv.DictReader((finished_run / "results.csv").read_text().splitlines()))
    worlds = list(csv.DictReader((finished_run / "per_world.csv").read_text().splitlines()))
    assert [row["agent"] for row in rows] == [row["agent"] for row in flat] == AGENTS
    for row, line in zip(rows, flat, strict=True):
        mine = [world for world in worlds if world["agent"] == row["agent"]]
        assert len(mine) == row["episodes"] == int(line["episodes"]) == 60
        assert float(line["total_harm"]) == row["total_harm"]
        assert sum(float(world["total_harm"]) for world in mine) / 60 == pytest.approx(row["total_harm"], rel=1e-12)
        assert [float(line["total_harm_low"]), float(line["total_harm_high"])] == row["total_harm_interval"]
    assert flat[0]["predicted_harm"] == ""
    assert flat[0]["scenario"] == "paper-random"


def test_run__the_other_two_tests_stand_beside_the_main_one(finished_run):
    rows = json.loads((finished_run / "other_tests.json").read_text())
    flat = list(csv.DictReader((finished_run / "other_tests.csv").read_text().splitlines()))
    tests = ["paper-random-brake-only", "paper-random-obstacle"]
    assert [row["parameters"]["scenario"] for row in rows] == [line["scenario"] for line in flat]
    assert [(row["parameters"]["scenario"], row["agent"]) for row in rows] == [
        (test, agent) for test in tests for agent in ("full_brake", "e_v2x_bm", "ppo", "hybrid")
    ]
    page = (finished_run / "report.html").read_text()
    assert "<h1>ethbrake run: paper-random (the main test of three)</h1>" in page
    assert all(f">{test}</h2>" in page for test in tests)
    assert page.count(">Vehicle 1 shoved (m)</th>") == 3
    assert page.count(">Sampled harm</th>") == 2  # nobody samples where an obstacle stands ahead
    for test in tests:
        scenario = load_scenario(test)
        (row,) = summarise(
            evaluate(scenario.sample(60, 7), make_lineup(["full_brake"], scenario), scenario=scenario, seed=7)
        )
        mine = next(r for r in rows if (r["parameters"]["scenario"], r["agent"]) == (test, "full_brake"))
        assert mine["total_harm"] == row.total_harm.value


def test_run__the_hybrid_is_in_no_world_worse_than_its_baseline(finished_run):
    harm = {
        (row["agent"], row["world"]): float(row["first_impact_harm"])
        for row in csv.DictReader((finished_run / "per_world.csv").read_text().splitlines())
    }
    assert all(harm["hybrid", str(k)] <= harm["e_v2x_bm", str(k)] for k in range(60))


def test_run__its_policy_evaluates_to_the_same_figures_afterwards(ethbrake, finished_run):
    answer = ethbrake(
        "evaluate",
        "--agents",
        f"full_brake,ppo@{finished_run},ppo@{finished_run}+episode",
        "--episodes",
        "60",
        "--json",
    )
    now = json.loads(answer.out)
    then = {row["agent"]: row for row in json.loads((finished_run / "results.json").read_text())}
    assert {row.pop("per_world")["file"] for row in then.values()} == {"per_world.csv"}
    names = {f"ppo@{finished_run}": "ppo", f"ppo@{finished_run}+episode": "hybrid"}
    for row in now:
        assert row == {**then[names.get(row["agent"], row["agent"])], "agent": row["agent"]}


@pytest.mark.slow
def test_run_json__prints_the_rows_alone_and_force_replaces(ethbrake, tiny_recipe, finished_run, tmp_path):
    folder = tmp_path / "again"
    shutil.copytree(finished_run, folder)
    (folder / "per_world.csv").write_text("stale")
    answer = ethbrake("run", "--recipe", tiny_recipe, "--episodes", "60", "--output", folder, "--force", "--json")
    assert answer.status == 0
    assert json.loads(answer.out) == json.loads((finished_run / "results.json").read_text())
    assert (folder / "per_world.csv").read_bytes() == (finished_run / "per_world.csv").read_bytes()
    assert "training" in answer.err
    assert str(folder / "report.html") in answer.err
    assert all(picture.read_bytes().startswith(b"\x89PNG") for picture in folder.glob("*.png"))
    page = (folder / "report.html").read_text()
    assert page.count("<figure>") == 6 and "data:image" not in page


def test_train__names_its_folder_after_scenario_recipe_and_seed(ethbrake, tiny_recipe, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    answer = ethbrake("train", "--recipe", tiny_recipe, "--seed", "5", "--steps", "128", "--json")
    assert answer.status == 0
    folder = Path("runs/paper-random-tiny-seed5")
    figures = json.loads(answer.out)
    assert (figures["directory"], figures["status"], figures["steps"]) == (str(folder), "finished", 128)
    assert figures["evaluation"]["steps"] == 128
    assert (folder / "policy" / "manifest.json").is_file()
    assert ethbrake("train", "--recipe", tiny_recipe, "--steps", "128", "--name", "mine").status == 0
    assert run_json(Path("runs/mine"))["status"] == "finished"


@pytest.mark.slow
def test_run__vehicle_chooses_among_several_learners(ethbrake, tiny_recipe, scenario_file, tmp_path):
    scenario = scenario_file("\n  vehicle_3: full_brake\n", "\n  vehicle_3: learner\n")
    chosen = ["--scenario", scenario, "--vehicle", "vehicle_3", "--episodes", "20", "--output", tmp_path / "new"]
    answer = ethbrake("run", "--recipe", tiny_recipe, *chosen, "--json")
    assert answer.status == 0
    assert {row["parameters"]["controlled_vehicle"] for row in json.loads(answer.out)} == {"vehicle_3"}
    assert not (tmp_path / "new" / "other_tests.json").exists()  # not one of the three tests


def test_run__the_learning_curve_has_the_lines_of_its_references(monkeypatch, finished_run, tmp_path):
    scenario = load_scenario("paper-random")
    specs = ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise"]
    agents = {**make_lineup(specs, scenario), "ppo": LearnedAgent(load_policy(finished_run), "ppo")}
    result = evaluate(scenario.sample(5, 7), agents, scenario=scenario, seed=7)
    drawn = []
    monkeypatch.setattr(
        results_folder, "learning_curve", lambda *a, **k: drawn.append(learning_curve(*a, **k)) or drawn[0]
    )
    monkeypatch.setattr(results_folder, "write_picture", lambda *given, **settings: None)
    course = [{"steps": 0.0, "first_impact_harm": 30.0, "total_harm": 33.0, "collision_rate": 1.0}]
    write_figures(tmp_path, result, summarise(result), course=course, course_caption="", agents=agents)
    labels = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert labels == ["policy", "full_brake", "e_v2x_bm"]


def test_train__progress_ends_at_the_number_that_it_announces(ethbrake, tiny_recipe, tmp_path):
    answer = ethbrake("train", "--recipe", tiny_recipe, "--steps", "200", "--output", tmp_path / "new")
    assert answer.status == 0
    assert "256 of 256\n" in answer.err
    assert "of 200" not in answer.err


def test_train__several_learners_share_a_policy(ethbrake, tiny_recipe, scenario_file, tmp_path):
    scenario = scenario_file("\n  vehicle_3: full_brake\n", "\n  vehicle_3: learner\n")
    folder = tmp_path / "two"
    answer = ethbrake("train", "--scenario", scenario, "--recipe", tiny_recipe, "--output", folder, "--json")
    assert answer.status == 0
    told = json.loads(answer.out)
    assert told["scheme"] == "shared" and told["evaluation"]["first_impact_harm"] > 0.0
    assert "scheme shared: policy drives vehicle_2, vehicle_3" in answer.err
    manifest = json.loads((folder / "policy" / "manifest.json").read_text())
    assert manifest["learners"] == ["vehicle_2", "vehicle_3"]


def ctrl_c_when(monkeypatch: pytest.MonkeyPatch, *moments: Callable[[dict[str, Any]], bool]) -> None:
    """Press Ctrl-C when what is shown first fits the first moment, then when it first fits the second, ..."""
    waiting = list(moments)

    progress = Out.progress

    def press(*args: Any, **kwargs: Any) -> None:
        progress(*args, **kwargs)
        shown = inspect.signature(progress).bind(*args, **kwargs).arguments
        if waiting and waiting[0](shown):
            waiting.pop(0)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Out, "progress", press)


@pytest.mark.slow
def test_run_interrupted__the_policy_so_far_is_evaluated(ethbrake, tiny_recipe, tmp_path, monkeypatch):
    ctrl_c_when(monkeypatch, lambda shown: shown["done"] == 256)
    folder = tmp_path / "stopped"
    answer = ethbrake(
        "run", "--recipe", tiny_recipe, "--steps", "100000000", "--episodes", "40", "--output", folder, "--json"
    )
    assert answer.status == 130
    assert [row["agent"] for row in json.loads(answer.out)] == AGENTS
    assert "interrupted after 256 steps: evaluating the policy so far" in answer.err
    assert answer.err.splitlines()[-1].startswith("interrupted after 256 training steps")
    assert str(folder) in answer.err.splitlines()[-1]
    assert (run_json(folder)["status"], run_json(folder)["steps"]) == ("interrupted", 256)
    assert "interrupted" in (folder / "report.html").read_text()


def test_run_interrupted_twice__stops_at_once_and_keeps_the_policy(ethbrake, tiny_recipe, tmp_path, monkeypatch):
    ctrl_c_when(monkeypatch, lambda shown: shown["done"] == 128, lambda shown: shown["name"] == "e_v2x_bm")
    folder = tmp_path / "stopped"
    answer = ethbrake("run", "--recipe", tiny_recipe, "--episodes", "40", "--output", folder)
    assert (answer.status, answer.out) == (130, "")
    assert answer.err.splitlines()[-1].startswith("interrupted; ")
    assert (run_json(folder)["status"], run_json(folder)["stage"]) == ("interrupted", "evaluation")
    assert not (folder / "results.json").exists()
    assert (folder / "policy" / "weights.safetensors").is_file()


def test_train_interrupted__the_policy_is_kept(ethbrake, tiny_recipe, tmp_path, monkeypatch):
    ctrl_c_when(monkeypatch, lambda shown: shown["done"] == 128)
    answer = ethbrake("train", "--recipe", tiny_recipe, "--output", tmp_path / "stopped")
    assert answer.status == 130
    assert "interrupted after 128 training steps" in answer.err
    assert run_json(tmp_path / "stopped")["policy"] == "policy"


def test_evaluate_interrupted__writes_nothing(ethbrake, tmp_path, monkeypatch):
    ctrl_c_when(monkeypatch, lambda shown: shown["name"] == "coast")
    answer = ethbrake("evaluate", "--episodes", "5", "--agents", "coast", "--per-world", tmp_path / "out.csv")
    assert (answer.status, answer.out) == (130, "")
    assert answer.err.splitlines()[-1] == "interrupted; nothing was written"
    assert list(tmp_path.iterdir()) == []


def test_run_failed__the_status_says_so(ethbrake, tiny_recipe, tmp_path, monkeypatch):
    def broken(*args: object, **kwargs: object) -> None:
        raise RuntimeError("no space left")

    monkeypatch.setattr("ethbrake_marl.studies.experiment.write_results", broken)
    folder = tmp_path / "failed"
    with pytest.raises(RuntimeError, match="no space left"):
        ethbrake("run", "--recipe", tiny_recipe, "--episodes", "20", "--output", folder)
    content = run_json(folder)
    assert (content["status"], content["stage"]) == ("failed", "evaluation")
    assert "no space left" in content["reason"]


def test_command_line__exit_status_and_streams_of_the_program():
    process = program("import sys; from ethbrake_marl.cli.app import main; sys.argv[1:] = ['evalute']; main()")
    assert (process.returncode, process.stdout, process.stderr.count("\n")) == (2, "", 1)


def test_kernels__a_temporary_cache_is_removed_at_the_end(tmp_path):
    process = program(
        "from ethbrake_marl.kernel_store import cache_folder; print(cache_folder(), cache_folder().is_dir())",
        NUMBA_CACHE_DIR="/dev/null/x",
        TMPDIR=str(tmp_path),
    )
    assert process.stdout.startswith(str(tmp_path / "ethbrake_marl-")) and process.stdout.endswith(" True\n")
    assert list(tmp_path.iterdir()) == []


def test_command_line__a_full_disk_behind_stdout_is_one_line():
    process = program(
        "import os, sys; from ethbrake_marl.cli.app import main; sys.argv[1:] = ['--version'];"
        "os.dup2(os.open('/dev/full', os.O_WRONLY), 1); main()"
    )
    assert (process.returncode, process.stderr) == (2, "ethbrake: error: output: No space left on device\n")


@pytest.mark.parametrize("encoding", [pytest.param("latin-1", marks=pytest.mark.slow), "ascii"])
def test_command_line__a_table_on_a_narrow_stdout_is_still_printed_and_needs_no_torch(encoding):
    process = program(
        "import sys; from ethbrake_marl.cli.app import main\n"
        "sys.argv[1:] = ['evaluate', '--episodes', '5', '--agents', 'coast']\n"
        "try:\n    main()\n"
        "except SystemExit as end:\n    assert not end.code\n"
        "print('loaded:', *{'torch', 'stable_baselines3', 'matplotlib'} & set(sys.modules))\n"
        "import ethbrake_marl.studies.reproduction\n"
        "print('with the items of the paper:', *{'torch'} & set(sys.modules))",
        PYTHONIOENCODING=encoding,
    )
    assert process.returncode == 0, process.stderr
    assert "coast" in process.stdout
    assert process.stdout.endswith("loaded:\nwith the items of the paper:\n"), process.stdout
