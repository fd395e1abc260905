"""``ethbrake study tune``: what it writes, that its best trial can be had again, and that no disturbance shows."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.learning.runs import train
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.studies.sweep import TuningPlan
from tests.studies.sweep.disturbing import PROGRAM
from tests.studies.tuning.conftest import TRIALS

TABLE = "trials.csv"
ROOT = Path(__file__).resolve().parents[3]


def read(file: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(file.read_text().splitlines()))


def tune(file: Path, folder: Path, *options: str) -> int:
    return run_command(["study", "tune", str(file), "--output", str(folder), "--trials", str(TRIALS), *options])


def test_table__has_every_trial_the_first_with_the_recipes_own_values(finished_tuning):
    rows = read(finished_tuning / TABLE)
    assert [row["trial"] for row in rows] == [str(number) for number in range(TRIALS)]
    first = rows[0]
    assert (first["learning_rate.start"], first["n_epochs"], first["network.policy"]) == ("0.001", "2", "[8]")
    for row in rows:
        assert 1e-4 <= float(row["learning_rate.start"]) <= 1e-1 and row["n_epochs"] in "1234" and not row["reason"]
        config = json.loads((finished_tuning / "trials" / f"{int(row['trial']):04d}" / "config.json").read_text())
        assert config["recipe"]["learning_rate"]["start"] == float(row["learning_rate.start"])
        assert config["recipe"]["evaluation"] == {"every_updates": 1, "worlds": 10, "seed": 11}
    assert not list((finished_tuning / "logs").iterdir())


def test_pruned_trials__stop_early_with_more_harm_than_the_median_had(finished_tuning):
    rows = read(finished_tuning / TABLE)
    pruned = [row for row in rows if row["state"] == "pruned"]
    assert pruned and all(int(row["steps"]) < 512 for row in pruned)
    finished = [row for row in rows if row["state"] == "finished"]
    assert len(finished) >= 2 and all(row["steps"] == "512" for row in finished)
    for row in pruned:
        run = json.loads((finished_tuning / "trials" / f"{int(row['trial']):04d}" / "run.json").read_text())
        assert run["reason"].startswith("pruned: ")
        assert float(row["first_impact_harm"]) > min(float(other["first_impact_harm"]) for other in finished)


def test_export__is_a_recipe_that_trains_the_best_trial_again_to_the_bit(finished_tuning, tmp_path):
    rows = [row for row in read(finished_tuning / TABLE) if row["state"] == "finished"]
    best = min(rows, key=lambda row: float(row["first_impact_harm"]))
    file = finished_tuning.parent / "best.yaml"
    again = train(load_recipe(file), "paper-random", tmp_path / "again", on_progress=None)
    assert again.policy.manifest.manifest_sha256 == best["policy_sha256"]
    assert min(each["first_impact_harm"] for each in again.evaluations) == float(best["first_impact_harm"])
    text = file.read_text()
    assert f"trial {best['trial']}, harm {float(best['first_impact_harm'])!r}" in text and "name: best\n" in text
    assert "ethbrake train --scenario paper-random --recipe best.yaml" in text


@pytest.mark.slow
def test_trials__that_ended_are_kept_and_more_go_on_as_if_they_had_been_asked_for_at_once(
    finished_tuning, write_tuning, tmp_path, capsys
):
    folder, file = tmp_path / "out", write_tuning()
    assert tune(file, folder, "--trials", "2") == 0
    assert [row["trial"] for row in read(folder / TABLE)] == ["0", "1"]
    written = (folder / "trials" / "0001" / "run.json").stat().st_mtime_ns
    assert tune(file, folder) == 0 and "2 trials ended already" in capsys.readouterr().err
    assert (folder / TABLE).read_bytes() == (finished_tuning / TABLE).read_bytes()
    assert (folder / "trials" / "0001" / "run.json").stat().st_mtime_ns == written
    assert tune(file, folder, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert sum(told["trials"].values()) == TRIALS and told["best"]["harm"] > 0.0 and not told["interrupted"]
    assert (folder / TABLE).read_bytes() == (finished_tuning / TABLE).read_bytes()


@pytest.mark.slow
def test_disturbed_tuning__has_the_same_table(finished_tuning, write_tuning, tmp_path):
    file, folder = write_tuning(), tmp_path / "out"
    export = tmp_path / "best.yaml"
    command = [
        *PROGRAM,
        "study",
        "tune",
        str(file),
        "--output",
        str(folder),
        "--trials",
        str(TRIALS),
        "--export",
        str(export),
    ]
    for trial, end in ((1, signal.SIGKILL), (3, signal.SIGINT)):
        driver = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        try:
            while not (folder / "trials" / f"{trial:04d}" / "run.json").is_file():
                assert driver.poll() is None
                time.sleep(0.01)
            driver.send_signal(end)
            assert driver.wait(timeout=300) in (-signal.SIGKILL, 130)
        finally:
            driver.kill()
            driver.wait()
    assert not export.exists()  # or the same command could not go on
    done = subprocess.run(command, cwd=ROOT, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (folder / TABLE).read_bytes() == (finished_tuning / TABLE).read_bytes()
    assert export.read_text() == (finished_tuning.parent / "best.yaml").read_text()


@pytest.mark.slow
def test_broken_trials__are_marked_failed_and_others_done_in_their_place(write_tuning, tmp_path):
    file, folder = write_tuning(), tmp_path / "out"
    plan = TuningPlan.read(file)
    folder.mkdir()
    plan.study(folder)._study.ask()  # a command that was killed just then
    with (folder / "study.journal").open("a") as journal:
        journal.write('{"op_code": 4, "worker')
    assert tune(file, folder, "--trials", "2") == 0
    rows = read(folder / TABLE)
    assert [row["state"] for row in rows] == ["failed", "finished", "finished"]
    assert rows[0]["reason"] == "was killed while it was asked for"
    assert [row["state"] for row in read(folder / TABLE)] == ["failed", "finished", "finished"]


@pytest.mark.slow
def test_trial__that_diverges_is_failed_with_its_reason_and_the_others_go_on(write_tuning, tmp_path, capsys):
    file = write_tuning(search={"reward.harm": {"choices": [0.05, 1e300]}}, sampler={"name": "random"})
    assert tune(file, tmp_path / "out", "--trials", "4") == 0
    rows = read(tmp_path / "out" / TABLE)
    failed = [row for row in rows if row["state"] == "failed"]
    assert {row["reward.harm"] for row in failed} == {"1e+300"} and failed[0]["reason"].startswith("training: ")
    assert rows[0]["state"] == "finished" and "1 finished" not in capsys.readouterr().err
    assert len(list((tmp_path / "out" / "trials").glob("*/policy"))) == 1 + len(failed)  # the same is not trained twice


@pytest.mark.slow
def test_no_trial__that_ends_well_is_exit_status_1(write_tuning, tmp_path, capsys):
    file = write_tuning(search={"reward.harm": {"low": 1e299, "high": 1e300}})
    export = tmp_path / "best.yaml"
    assert tune(file, tmp_path / "out", "--trials", "1", "--export", str(export)) == 1
    assert "the recipe's own values are not in the space" in capsys.readouterr().err and not export.exists()


def test_folder_of_another_tuning__is_refused(finished_tuning, write_tuning, capsys):
    table = (finished_tuning / TABLE).read_bytes()
    for changes in ({"seed": 1}, {"sampler": {"seed": 4}}):
        assert tune(write_tuning(**changes), finished_tuning) == 2
        assert "holds a tuning with other settings" in capsys.readouterr().err
    assert (finished_tuning / TABLE).read_bytes() == table


def test_folder_of_other_versions__is_refused_with_their_names(finished_tuning, write_tuning, tmp_path, capsys):
    folder = tmp_path / "out"
    shutil.copytree(finished_tuning, folder)
    record = json.loads((folder / "tuning.json").read_text())
    record["versions"]["torch"] = "1.0"
    (folder / "tuning.json").write_text(json.dumps(record))
    assert tune(write_tuning(), folder) == 2
    told = capsys.readouterr().err
    assert "(versions torch 1.0, here 2." in told and "numpy" not in told


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--trials", "0"], "trials = 0: must be a whole number in 1..100000"),
        (["--jobs", "0"], "jobs = 0: must be a whole number in 1..4096"),
        (["--retries", "-1"], "retries = -1: must be"),
        (["--export", "best.txt"], "must end in .yaml"),
        (["--export", "Best One.yaml"], "must be 1 to 64 lower case letters"),
        (["--export", "there.yaml"], "there.yaml: is there already"),
    ],
)
def test_bad_options__are_refused(write_tuning, tmp_path, monkeypatch, capsys, options, reason):
    monkeypatch.chdir(tmp_path)
    Path("there.yaml").write_text("mine")
    assert tune(write_tuning(), tmp_path / "new", *options) == 2
    told = capsys.readouterr().err
    assert reason in told and not (tmp_path / "new" / "trials.csv").exists()
    assert Path("there.yaml").read_text() == "mine"


def test_dry_run__prints_space_and_cost_and_makes_nothing(write_tuning, tmp_path, capsys):
    assert tune(write_tuning(), tmp_path / "new", "--dry-run", "--jobs", "2") == 0
    told = capsys.readouterr()
    assert told.out.splitlines()[1] == "n_epochs  from 1 to 4, whole  (the recipe has 2)"
    assert f"{TRIALS} trials of 512 decisions: about" in told.err and not (tmp_path / "new").exists()
    assert tune(write_tuning(), tmp_path / "new", "--dry-run", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["own_values"]["n_epochs"] == 2 and found["core_s_per_trial"] > 0.0


def test_tune__without_optuna_says_how_to_install_it(write_tuning, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert tune(write_tuning(), tmp_path / "new") == 2
    assert capsys.readouterr().err.endswith("-m pip install 'ethbrake-marl[tune]'\n")


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('{"op_code":0', '{"op_kode":0', "cannot be used"),
        ('{"op_code":0', "\x00", "cannot be used"),
        ('"results":"[', '"results":"{', "trial 0 is damaged"),
        ('"results":"[', '"results":7,"x":"[', "cannot be used"),
    ],
)
def test_damaged_journal__is_refused_in_one_line(finished_tuning, write_tuning, tmp_path, capsys, old, new, reason):
    folder = tmp_path / "out"
    shutil.copytree(finished_tuning, folder)
    journal = folder / "study.journal"
    assert old in journal.read_text()
    journal.write_text(journal.read_text().replace(old, new))
    assert tune(write_tuning(), folder) == 2
    told = capsys.readouterr().err
    assert reason in told and len(told.splitlines()) == 1


def test_second_command__in_a_folder_is_refused(finished_tuning, write_tuning, tmp_path, capsys):
    from filelock import FileLock

    folder = tmp_path / "out"
    shutil.copytree(finished_tuning, folder)
    with FileLock(folder / ".lock"):
        assert tune(write_tuning(), folder) == 2
    assert "another process works in it" in capsys.readouterr().err


def test_same_command__exports_again_over_its_own_recipe(finished_tuning, small, tmp_path, capsys):
    for each in ("out", "best.yaml"):
        target = shutil.copytree if (finished_tuning.parent / each).is_dir() else shutil.copy
        target(finished_tuning.parent / each, tmp_path / each)
    file, export = tmp_path / "tuning.yaml", tmp_path / "best.yaml"
    file.write_text(yaml.safe_dump(small))
    text = export.read_text()
    assert "Settings of" in text and "half a minute" not in text
    assert tune(file, tmp_path / "out", "--trials", str(TRIALS), "--export", str(export)) == 0
    assert export.read_text() == text
    export.write_text(text[1:])
    assert tune(file, tmp_path / "out", "--trials", str(TRIALS), "--export", str(export)) == 2
    assert "best.yaml: is there already" in capsys.readouterr().err
