"""``ethbrake run``, ``train``, ``agent export``, and learning curves, on trainings of a few small updates."""

import inspect
import json
import re
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import onnx
import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.cli.command import Out
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.identity import scenario_sha256, worlds_sha256
from ethbrake_marl.evaluation.lineup import make_lineup
from ethbrake_marl.extensions.report import experiment
from ethbrake_marl.extensions.report.experiment import telling_world, write_figures
from ethbrake_marl.extensions.report.run_figures import learning_curve
from ethbrake_marl.extensions.reproduction.learning_curves import LearningCurves
from ethbrake_marl.progress import Progress
from tests.cli.conftest import TINY_RECIPE, Command, check_refused, rows_of, told_json

AGENTS = ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise", "trained policy", "hybrid"]
SCENARIO = eb.load_scenario("paper-random")


def status_of(folder: Path, *names: str) -> tuple[Any, ...]:
    """These entries of run.json."""
    content = json.loads((folder / "run.json").read_text())
    return tuple(content[name] for name in names)


def ctrl_c_when(monkeypatch: pytest.MonkeyPatch, *moments: Callable[[dict[str, Any]], bool]) -> None:
    """Press Ctrl-C when what is shown first fits the first moment, then when it first fits the second, ..."""
    waiting, progress = list(moments), Out.progress

    def press(*args: Any, **kwargs: Any) -> None:
        progress(*args, **kwargs)
        shown = inspect.signature(progress).bind(*args, **kwargs).arguments
        if waiting and waiting[0](shown):
            waiting.pop(0)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Out, "progress", press)


# A run: training, tests, report


def test_run__leaves_results_figures_report_and_policy(finished_run: Path) -> None:
    names = {path.name for path in finished_run.iterdir()}
    assert names >= {
        "config.json", "run.json", "progress.csv", "policy", "results.csv", "results.json", "per_world.csv",
        "report.html", "learning_curve.png", "harm_against_gap.png", "trajectories.png",
    }  # fmt: skip
    page = (finished_run / "report.html").read_text()
    assert page.count("<figure>") == 6 and "data:image" not in page  # three of them are in the pictures, too
    assert page.count('"pieces":') == 50 * len(AGENTS)
    assert status_of(finished_run, "status", "stage", "steps", "reason") == ("finished", "report", 256, None)


def test_run__results_agree_in_json_and_csv(finished_run: Path) -> None:
    """Whoever compares results reads the worlds of ``per_world.csv``, too."""
    rows, flat = json.loads((finished_run / "results.json").read_text()), rows_of(finished_run / "results.csv")
    assert [row["agent"] for row in rows] == [row["agent"] for row in flat] == AGENTS
    for row, line in zip(rows, flat, strict=True):
        told = [float(line[name]) for name in ("episodes", "total_harm", "total_harm_low", "total_harm_high")]
        assert told == [60, row["total_harm"], *row["total_harm_interval"]]
    assert (flat[0]["predicted_harm"], flat[0]["scenario"]) == ("", "paper-random")


def test_run__the_other_two_tests_stand_beside_the_main_one(finished_run: Path) -> None:
    rows = json.loads((finished_run / "other_tests.json").read_text())
    tests = ["paper-random-brake-only", "paper-random-obstacle"]
    expected = [(test, agent) for test in tests for agent in ("full_brake", "e_v2x_bm", "trained policy", "hybrid")]
    assert [(row["parameters"]["scenario"], row["agent"]) for row in rows] == expected
    flat = rows_of(finished_run / "other_tests.csv")
    assert [(line["scenario"], line["agent"]) for line in flat] == expected
    page = (finished_run / "report.html").read_text()
    assert "<h1>ethbrake run: paper-random</h1>" in page
    assert all(f">{test} test</h2>" in page for test in ("Brake-only", "Obstacle"))
    assert page.count(">Vehicle 1 shoved (m)</th>") == 3
    assert page.count(">Sampled harm</th>") == 2  # nobody samples where an obstacle stands ahead
    for test, row in zip(tests, rows[::4], strict=True):
        scenario = eb.load_scenario(test)
        result = eb.evaluate(scenario.sample(60, 7), make_lineup(["full_brake"], scenario), scenario=scenario, seed=7)
        assert row["total_harm"] == eb.summarise(result)[0].total_harm.value


def test_run__its_policy_evaluates_to_the_same_figures_afterwards(ethbrake: Command, finished_run: Path) -> None:
    agents = f"full_brake,ppo@{finished_run},ppo@{finished_run}+episode"
    now = told_json(ethbrake("evaluate", "--agents", agents, "--episodes", "60", "--json"))
    then = {row["agent"]: row for row in json.loads((finished_run / "results.json").read_text())}
    assert {row.pop("per_world")["file"] for row in then.values()} == {"per_world.csv"}
    names = {f"ppo@{finished_run}": "trained policy", f"ppo@{finished_run}+episode": "hybrid"}
    for row in now:
        assert row == {**then[names.get(row["agent"], row["agent"])], "agent": row["agent"]}


@pytest.mark.slow
def test_run__json_prints_the_rows_alone_and_force_replaces(ethbrake, tiny_recipe, finished_run, tmp_path) -> None:
    folder = tmp_path / "again"
    shutil.copytree(finished_run, folder)
    (folder / "per_world.csv").write_text("stale")
    answer = ethbrake("run", "--recipe", tiny_recipe, "--episodes", "60", "--output", folder, "--force", "--json")
    assert told_json(answer) == json.loads((finished_run / "results.json").read_text())
    assert (folder / "per_world.csv").read_bytes() == (finished_run / "per_world.csv").read_bytes()
    assert "training" in answer.err and str(folder / "report.html") in answer.err
    assert all(picture.read_bytes().startswith(b"\x89PNG") for picture in folder.glob("*.png"))


@pytest.mark.slow
def test_run__roles_choose_among_several_learners(ethbrake, tiny_recipe, scenario_file, tmp_path) -> None:
    scenario = scenario_file("\n  vehicle_3: full_brake\n", "\n  vehicle_3: learner\n")
    chosen = [
        "--scenario",
        scenario,
        "--set",
        "roles.vehicle_2=full_brake",
        "--episodes",
        "20",
        "--output",
        tmp_path / "new",
    ]
    rows = told_json(ethbrake("run", "--recipe", tiny_recipe, *chosen, "--json"))
    assert {row["parameters"]["controlled_vehicle"] for row in rows} == {"vehicle_3"}
    assert not (tmp_path / "new" / "other_tests.json").exists()  # not one of the three tests


def test_run__the_learning_curve_has_the_lines_of_its_references(monkeypatch, finished_run, tmp_path) -> None:
    specs = ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise"]
    agents = {**make_lineup(specs, SCENARIO), "trained policy": eb.LearnedAgent(eb.load_policy(finished_run))}
    result = eb.evaluate(SCENARIO.sample(5, 7), agents, scenario=SCENARIO, seed=7)
    drawn = []
    monkeypatch.setattr(experiment, "learning_curve", lambda *a, **k: drawn.append(learning_curve(*a, **k)) or drawn[0])
    monkeypatch.setattr(experiment, "write_picture", lambda *given, **settings: None)
    course = [{"steps": 0.0, "first_impact_harm": 30.0, "total_harm": 33.0, "collision_rate": 1.0}]
    write_figures(tmp_path, result, eb.summarise(result), course=course, course_caption="", agents=agents)
    labels = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert labels == ["policy", "full_brake", "e_v2x_bm"]


@pytest.mark.slow
def test_run__interrupted_evaluates_the_policy_so_far_and_goes_on_as_a_training(
    ethbrake, tiny_recipe, tmp_path, monkeypatch
) -> None:
    folder = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        ctrl_c_when(patch, lambda shown: shown["done"] == 128)
        answer = ethbrake("run", "--recipe", tiny_recipe, "--episodes", "40", "--output", folder, "--json")
    assert (answer.status, [row["agent"] for row in json.loads(answer.out)]) == (130, AGENTS)
    assert "interrupted after 128 steps: evaluating the policy so far" in answer.err
    last = answer.err.splitlines()[-1]
    assert last.startswith("interrupted after 128 training steps") and str(folder) in last
    assert status_of(folder, "status", "steps", "stage") == ("interrupted", 128, "report")
    assert "interrupted" in (folder / "report.html").read_text()
    assert ethbrake("train", "--resume", folder).status == 0
    assert status_of(folder, "status", "steps") == ("finished", 256)


def test_run__interrupted_twice_stops_at_once_and_keeps_the_policy(ethbrake, tiny_recipe, tmp_path, monkeypatch):
    ctrl_c_when(monkeypatch, lambda shown: shown["done"] == 128, lambda shown: shown["name"] == "evaluation")
    folder = tmp_path / "stopped"
    answer = ethbrake("run", "--recipe", tiny_recipe, "--episodes", "40", "--output", folder)
    assert (answer.status, answer.out) == (130, "") and answer.err.splitlines()[-1].startswith("interrupted; ")
    assert status_of(folder, "status", "stage") == ("interrupted", "evaluation")
    assert not (folder / "results.json").exists() and (folder / "policy" / "weights.safetensors").is_file()


def test_run__failed_says_so_in_its_status(ethbrake, tiny_recipe, tmp_path, monkeypatch) -> None:
    broken = Mock(side_effect=RuntimeError("no space left"))
    monkeypatch.setattr("ethbrake_marl.training.experiment.write_results", broken)
    with pytest.raises(RuntimeError, match="no space left"):
        ethbrake("run", "--recipe", tiny_recipe, "--episodes", "20", "--output", tmp_path / "failed")
    status, stage, reason = status_of(tmp_path / "failed", "status", "stage", "reason")
    assert (status, stage) == ("failed", "evaluation") and "no space left" in reason


@pytest.mark.slow
def test_run__with_sac_all_minimise_the_harm_it_is_for(ethbrake, tiny_sac, tmp_path) -> None:
    folder = tmp_path / "new"
    total = ("--set", "reward.harm_count=total", "--episodes", "20", "--output", folder)
    rows = told_json(ethbrake("run", "--recipe", tiny_sac, *total, "--json"))
    assert [row["agent"] for row in rows][-2:] == ["trained policy", "hybrid"]
    agents = f"full_brake,e_v2x_bm,sac@{folder}+episode"
    asked = (
        "--episodes",
        "20",
        "--set",
        "harm_count=total",
        "--output",
        tmp_path / "w",
        "--per-world",
        "csv",
        "--json",
    )
    for row, then in zip(
        told_json(ethbrake("evaluate", "--agents", agents, *asked)), (rows[0], rows[1], rows[4]), strict=True
    ):
        assert row == {**then, "agent": row["agent"], "per_world": row["per_world"]}
    assert json.loads((folder / "config.json").read_text())["update_ratio"] == 1 / 16
    assert ethbrake("evaluate", "--episodes", "20", "--agents", f"sac@{folder}", "--json").status == 0
    check_refused(ethbrake("evaluate", "--agents", f"ppo@{folder}"), "was trained by SAC")


def test_evaluate__interrupted_writes_nothing(ethbrake: Command, tmp_path: Path, monkeypatch) -> None:
    ctrl_c_when(monkeypatch, lambda shown: shown["name"] == "worlds")
    answer = ethbrake("evaluate", "--episodes", "5", "--agents", "coast", "--output", tmp_path / "new")
    assert (answer.status, answer.out) == (130, "")
    assert answer.err.splitlines()[-1] == "interrupted; nothing was written" and list(tmp_path.iterdir()) == []


# A training


@pytest.mark.parametrize("command", ["run", "train"])
def test_existing_run__is_refused_and_left_alone(ethbrake, tiny_recipe, finished_run, command: str) -> None:
    before = {path: path.read_bytes() for path in finished_run.rglob("*") if path.is_file()}
    check_refused(ethbrake(command, "--recipe", tiny_recipe, "--output", finished_run), str(finished_run), "force")
    assert {path: path.read_bytes() for path in finished_run.rglob("*") if path.is_file()} == before


def test_train__names_its_folder_and_ends_at_the_number_that_it_announces(ethbrake, tiny_recipe, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    answer = ethbrake("train", "--recipe", tiny_recipe, "--seed", "5", "--steps", "200", "--json")
    folder, figures = Path("runs/paper-random-tiny-seed5"), told_json(answer)
    assert (figures["directory"], figures["status"], figures["steps"]) == (str(folder), "finished", 256)
    assert figures["evaluation"]["steps"] == 256 and (folder / "policy" / "manifest.json").is_file()
    assert ": 0 of 256\n" in answer.err and "after 256 training steps" in answer.err and "of 200" not in answer.err


def test_train__by_a_scheme_leaves_a_team_that_evaluate_takes(ethbrake, tiny_recipe, tmp_path) -> None:
    scenario, folder = ("--scenario", "cooperation-3-pair"), tmp_path / "run"
    told = "policy/vehicle_2 drives vehicle_2; policy/vehicle_3 drives vehicle_3"
    answer = ethbrake("train", *scenario, "--recipe", tiny_recipe, "--set", "scheme=independent", "--output", folder)
    assert answer.status == 0 and f"scheme independent: {told}" in answer.err
    words = ("--episodes", "20", "--agents", f"ppo@{folder},team@{folder}", "--json")
    alone, team = told_json(ethbrake("evaluate", *scenario, *words))
    assert alone["first_impact_harm"] == team["first_impact_harm"]
    check_refused(ethbrake("evaluate", *scenario, "--agents", f"sac@{folder}"), "was trained by PPO", f"ppo@{folder}")
    check_refused(ethbrake("train", "--resume", folder), "evaluate --scenario cooperation-3-pair --agents team@")


def test_resume__goes_on_and_says_what_is_next(ethbrake, tiny_recipe, tmp_path, monkeypatch) -> None:
    folder = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        ctrl_c_when(patch, lambda shown: shown["done"] == 128)
        answer = ethbrake("train", "--recipe", tiny_recipe, "--output", folder)
    assert answer.status == 130 and status_of(folder, "policy") == ("policy",)
    last = answer.err.splitlines()[-1]
    assert "interrupted after 128 training steps" in last and f"go on with: ethbrake train --resume {folder}" in last
    told = told_json(ethbrake("train", "--resume", folder, "--json"))
    assert (told["status"], told["steps"]) == ("finished", 256)
    again = ethbrake("train", "--resume", folder)
    check_refused(again, "has finished", "ethbrake evaluate --scenario paper-random --agents ppo@")


# Learning curves


def test_curves__are_trained_drawn_and_gone_on_with(tiny_recipe, tiny_sac, tmp_path) -> None:
    folder = tmp_path / "curves"
    curves = LearningCurves(SCENARIO, LearningCurves.parse(f"{tiny_recipe}:2,{tiny_sac}:2"), folder)

    def press(progress: Progress) -> None:
        if (progress.name, progress.done) == ("tiny-seed1", 128):
            signal.raise_signal(signal.SIGINT)

    assert not curves.train(tell=press)
    manifest = folder / "tiny-seed0" / "policy" / "manifest.json"
    kept = manifest.stat().st_mtime_ns
    assert curves.train()
    summary = curves.write()
    assert manifest.stat().st_mtime_ns == kept
    assert (folder / "learning_curves.png").read_bytes().startswith(b"\x89PNG")
    rows = [row for row in rows_of(folder / "learning_curves.csv") if row["figure"] != "return"]
    harms = {(row["recipe"], row["seed"], int(row["steps"])): float(row["value"]) for row in rows}
    steps = {name: {each[2] for each in harms if each[0] == name} for name in ("tiny", "tiny-sac")}
    assert steps == {"tiny": {0, 128, 256}, "tiny-sac": {0, 160, 320}}
    told, last = summary["recipes"]["tiny"], [harms["tiny", seed, 256] for seed in "01"]
    low, high = told["last"]["interval"]
    assert (told["last"]["each"], told["last"]["interquartile_mean"]) == (last, pytest.approx(sum(last) / 2))
    assert min(last) <= low <= high <= max(last)
    fixed = SCENARIO.sample(10, 7)
    assert (summary["kind"], summary["scenario_sha256"]) == ("learning-curves", scenario_sha256(SCENARIO))
    assert told["worlds_sha256"] == worlds_sha256(fixed.worlds, fixed.index)
    policies = [eb.load_policy(folder / f"tiny-seed{seed}").manifest.manifest_sha256 for seed in (0, 1)]
    assert told["policy_sha256"] == policies
    curves._replace(against="cpu").write()
    spent = [float(row["cpu_s"]) for row in rows_of(folder / "learning_curves.csv")[:3]]
    assert 0.0 <= spent[0] < spent[1] < spent[2]


def test_curves__another_training_or_an_edited_scenario_is_told_before_any_is_begun(
    tiny_recipe, scenario_file, tmp_path
) -> None:
    folder, other = tmp_path / "curves", tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump({**TINY_RECIPE, "gamma": 0.9}))

    def curves(recipes: str, old: str, new: str) -> None:
        asked = LearningCurves(eb.load_scenario(scenario_file(old, new)), LearningCurves.parse(recipes), folder)
        assert asked.train()
        asked.write()

    curves(f"{tiny_recipe}:1", "horizon_s: 8", "horizon_s: 8")
    drawn = (folder / "learning_curves.json").stat().st_mtime_ns
    for recipes, horizon, what in (
        (f"{tiny_recipe}:1", "horizon_s: 9", "scenario horizon_s"),
        (f"ppo:1,{other}:1", "horizon_s: 8", "recipe gamma"),
    ):
        told = f"tiny-seed0: holds another training (here other: {what}); give another folder"
        with pytest.raises(InvalidInput, match=re.escape(told)):
            curves(recipes, "horizon_s: 8", horizon)
    assert (folder / "learning_curves.json").stat().st_mtime_ns == drawn and not (folder / "ppo-seed0").exists()
    # Words change no training: its result is kept.
    curves(f"{tiny_recipe}:1", 'title: "One line for lists and figures"', 'title: "Another line"')


def test_export__writes_onnx(ethbrake: Command, finished_run: Path, tmp_path: Path, monkeypatch) -> None:
    line = ("agent", "export", finished_run, "--onnx", tmp_path / "policy.onnx")
    assert ethbrake(*line).status == 0
    graph = onnx.load(str(tmp_path / "policy.onnx")).graph
    assert [output.name for output in graph.output] == ["action", "acceleration_mps2"]
    monkeypatch.setitem(sys.modules, "onnx", None)  # not installed: the output is looked at before that is
    check_refused(ethbrake(*line), "is there already")


# ---------------------------------------------------------------- parts of a report


@pytest.mark.parametrize(
    ("before", "after", "row"),
    [
        ([9.0, 0.0, 5.0, 7.0], [1.0, 0.0, 4.0, 2.0], 3),  # savings 8, -, 1, 5
        ([4.0, 3.0], [0.0, 0.0], 1),  # of two, the smaller saving
        ([0.0, 0.0], [0.0, 5.0], 0),  # full braking harms nobody
    ],
)
def test_telling_world__is_the_median_saving_among_harmful_worlds(before, after, row):
    harms = {"full_brake": before, "trained policy": after}
    by_count = {name: {"first": np.ones(4), "total": np.array(harm)} for name, harm in harms.items()}
    outcome = {name: SimpleNamespace(world_harm=found.__getitem__) for name, found in by_count.items()}
    evaluation = SimpleNamespace(outcome=outcome.__getitem__, outcomes=harms)
    assert telling_world(evaluation, "total") == row
