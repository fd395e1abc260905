"""``ethbrake study tune``: its file and table, that its best trial can be had again, and that no disturbance shows."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.studies.sweep import TuningPlan
from tests.cli.conftest import rows_of as read
from tests.studies.conftest import TRIALS, study
from tests.studies.counting import PROGRAM, ROOT, end_when

DOCS = ROOT / "docs"


def test_every_trial__is_measured_as_often_whatever_an_update_holds(write_tuning):
    file = write_tuning(recipe="ppo", search={"n_envs": {"choices": [16, 128, 256]}}, measure={"times": 7, "seed": 3})
    plan = TuningPlan.read(file)
    for n_envs in (16, 128, 256):
        recipe = plan.training({"n_envs": n_envs}).recipe
        updates, every = plan.updates(recipe), recipe.evaluation.every_updates
        assert (recipe.evaluation.seed, recipe.seed, recipe.n_envs) == (3, 0, n_envs)
        steps = [7 * update // updates for update in {*range(0, updates, every), updates}]
        assert len(set(steps)) == len(steps) and 6 <= len(steps) <= 8 and max(steps) == 7


@pytest.mark.parametrize(
    ("search", "own"),
    [
        (
            {"network.policy": {"choices": [[9], [8]]}, "vf_coef": {"low": 0, "high": 1.0}},
            {"network.policy": [8], "vf_coef": 0.5},
        ),
        ({"gamma": {"low": 0, "high": 1}}, None),  # whole numbers alone, and the recipe has 0.995
        ({"max_grad_norm": {"low": 0.6, "high": 0.9}}, None),
    ],
)
def test_own_values__are_the_recipes_where_the_space_has_them(write_tuning, search, own):
    assert TuningPlan.read(write_tuning(search=search)).own_values() == own


def test_identity__is_that_of_all_that_changes_a_trial(write_tuning):
    others = [{"seed": 1}, {"set": {"mass_t": 9}}, {"measure": {"seed": 12}}, {"prune": None}, {"sampler": {"seed": 1}}]
    same, titled, *found = (
        str(TuningPlan.read(write_tuning(**changes)).question) for changes in ({}, {"title": "words"}, *others)
    )
    assert titled == same and len({same, *found}) == len(others) + 1


@pytest.mark.parametrize("name", ["tuning-quick", "tuning-ppo"])
def test_shipped_spaces__are_in_order_and_hold_their_recipe(name):
    plan, text = TuningPlan.read(DOCS / f"{name}.yaml"), (DOCS / f"{name}.yaml").read_text("utf-8")
    assert plan.own_values() is not None and plan.file.recipe in eb.TrainingRecipe.shipped()
    assert text in (DOCS / "tuning.md").read_text("utf-8") or name != "tuning-quick"


TABLE = "trials.csv"


def tune(file: Path, folder: Path, *options: str) -> int:
    return study("tune", file, "--output", folder, "--trials", TRIALS, *options)


def run_of(folder: Path, row: dict[str, str], file: str) -> dict[str, Any]:
    """A file of a trial's run."""
    found: dict[str, Any] = json.loads((folder / "trials" / f"{int(row['trial']):04d}" / file).read_text())
    return found


def test_table__has_every_trial_the_first_with_the_recipes_own_values(finished_tuning: Path) -> None:
    rows = read(finished_tuning / TABLE)
    assert [row["trial"] for row in rows] == [str(number) for number in range(TRIALS)]
    own = {"learning_rate.start": "0.001", "n_epochs": "2", "network.policy": "[8]"}
    assert rows[0].items() >= own.items()
    for row in rows:
        assert 1e-4 <= float(row["learning_rate.start"]) <= 1e-1 and row["n_epochs"] in "1234" and not row["reason"]
        recipe = run_of(finished_tuning, row, "config.json")["recipe"]
        assert recipe["learning_rate"]["start"] == float(row["learning_rate.start"])
        assert recipe["evaluation"] == {"every_updates": 1, "worlds": 10, "seed": 11}
    assert not list((finished_tuning / "logs").iterdir())


def test_pruned_trials__stop_early_with_more_harm_than_the_median_had(finished_tuning: Path) -> None:
    rows = read(finished_tuning / TABLE)
    pruned, finished = ([row for row in rows if row["state"] == state] for state in ("pruned", "finished"))
    assert pruned and len(finished) >= 2 and {row["steps"] for row in finished} == {"512"}
    least = min(float(row["first_impact_harm"]) for row in finished)
    for row in pruned:
        assert int(row["steps"]) < 512 and float(row["first_impact_harm"]) > least
        assert run_of(finished_tuning, row, "run.json")["reason"].startswith("pruned: ")


def test_export__is_a_recipe_that_trains_the_best_trial_again_to_the_bit(finished_tuning, tmp_path):
    rows = [row for row in read(finished_tuning / TABLE) if row["state"] == "finished"]
    best = min(rows, key=lambda row: float(row["first_impact_harm"]))
    file = finished_tuning.parent / "best.yaml"
    again = eb.train(eb.load_recipe(file), "paper-random", tmp_path / "again", on_progress=None)
    assert again.policy.manifest.manifest_sha256 == best["policy_sha256"]
    assert min(each["first_impact_harm"] for each in again.evaluations) == float(best["first_impact_harm"])
    text = file.read_text()
    assert f"trial {best['trial']}, harm {float(best['first_impact_harm'])!r}" in text and "name: best\n" in text
    assert "ethbrake train --scenario paper-random --recipe best.yaml" in text


@pytest.mark.slow
def test_trials__that_ended_are_kept_and_more_go_on_as_if_they_had_been_asked_for_at_once(
    finished_tuning, write_tuning, tmp_path, capsys
):
    folder, file, whole = tmp_path / "out", write_tuning(), (finished_tuning / TABLE).read_bytes()
    assert tune(file, folder, "--trials", "2") == 0
    assert [row["trial"] for row in read(folder / TABLE)] == ["0", "1"]
    kept = folder / "trials" / "0001" / "run.json"
    written = kept.stat().st_mtime_ns
    assert tune(file, folder) == 0 and "2 trials ended already" in capsys.readouterr().err
    assert (folder / TABLE).read_bytes() == whole and kept.stat().st_mtime_ns == written
    assert tune(file, folder, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert sum(told["trials"].values()) == TRIALS and told["best"]["harm"] > 0.0 and not told["interrupted"]
    assert (folder / TABLE).read_bytes() == whole


@pytest.mark.long
def test_disturbed_tuning__has_the_same_table(finished_tuning, write_tuning, tmp_path):
    folder, export = tmp_path / "out", tmp_path / "best.yaml"
    options = ["--output", folder, "--trials", str(TRIALS), "--export", export]
    command = [*PROGRAM, "study", "tune", write_tuning(), *options]
    for trial, by, status in ((1, signal.SIGKILL, -signal.SIGKILL), (3, signal.SIGINT, 130)):
        begun = folder / "trials" / f"{trial:04d}" / "run.json"
        assert end_when(command, lambda _, begun=begun: begun.is_file(), by)[0] == status
    assert not export.exists()  # or the same command could not go on
    done = subprocess.run(command, cwd=ROOT, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (folder / TABLE).read_bytes() == (finished_tuning / TABLE).read_bytes()
    assert export.read_text() == (finished_tuning.parent / "best.yaml").read_text()


@pytest.mark.slow
def test_broken_trials__are_marked_failed_and_others_done_in_their_place(write_tuning, tmp_path):
    file, folder = write_tuning(), tmp_path / "out"
    folder.mkdir()
    TuningPlan.read(file).study(folder)._study.ask()  # a command that was killed just then
    with (folder / "study.journal").open("a") as journal:
        journal.write('{"op_code": 4, "worker')
    assert tune(file, folder, "--trials", "2") == 0
    rows = read(folder / TABLE)
    assert [row["state"] for row in rows] == ["failed", "finished", "finished"]
    assert rows[0]["reason"] == "was killed while it was asked for"


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")  # an error in this process alone
@pytest.mark.filterwarnings("default::RuntimeWarning")  # of what diverges, in this process
@pytest.mark.slow
def test_trial__that_diverges_is_failed_with_its_reason_and_the_others_go_on(write_tuning, tmp_path, capsys) -> None:
    file = write_tuning(search={"reward.harm": {"choices": [0.05, 1e300]}}, sampler={"name": "random"})
    assert tune(file, tmp_path / "out", "--trials", "4") == 0
    rows = read(tmp_path / "out" / TABLE)
    failed = [row for row in rows if row["state"] == "failed"]
    assert {row["reward.harm"] for row in failed} == {"1e+300"} and failed[0]["reason"].startswith("training: ")
    assert rows[0]["state"] == "finished" and "1 finished" not in capsys.readouterr().err
    assert len(list((tmp_path / "out" / "trials").glob("*/policy"))) == 1 + len(failed)  # the same is not trained twice
    nothing, export = write_tuning(search={"reward.harm": {"low": 1e299, "high": 1e300}}), tmp_path / "best.yaml"
    assert tune(nothing, tmp_path / "none", "--trials", "1", "--export", str(export)) == 1
    assert "the recipe's own values are not in the space" in capsys.readouterr().err and not export.exists()


def test_same_command__exports_again_over_its_own_recipe_alone(finished_tuning, tmp_path, capsys) -> None:
    shutil.copytree(finished_tuning.parent, tmp_path / "all")
    file, export = tmp_path / "all" / "tuning.yaml", tmp_path / "all" / "best.yaml"
    text = export.read_text()
    assert "Settings of" in text and tune(file, tmp_path / "all" / "out", "--export", str(export)) == 0
    assert export.read_text() == text
    export.write_text(text[1:])
    assert tune(file, tmp_path / "all" / "out", "--export", str(export)) == 2
    assert "best.yaml: is there already" in capsys.readouterr().err
