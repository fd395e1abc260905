"""``ethbrake study sweep``: what it writes, that nothing is done twice, and that no disturbance shows in its table."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import yaml

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.runs import train
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.policies import load_policy
from ethbrake_marl.studies import jobs
from tests.studies.jobs.inside import Inside
from tests.studies.sweep.disturbing import PROGRAM, holders, journal, parent

TABLE = "results.csv"
ROOT = Path(__file__).resolve().parents[3]


def read(file: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(file.read_text().splitlines()))


def sweep(file: Path, folder: Path, *options: str) -> int:
    return run_command(["study", "sweep", str(file), "--output", str(folder), "--jobs", "1", *options])


def test_table__has_a_row_for_every_job_in_the_order_of_the_file(finished_sweep, small):
    rows = read(finished_sweep / TABLE)
    assert [(row["seed"], row["set.gamma"]) for row in rows] == [
        ("3", "0.9"), ("3", "0.99"), ("5", "0.9"), ("5", "0.99")
    ]  # fmt: skip
    entries = journal(finished_sweep)
    assert Counter(one["job"].rpartition("-")[2] for one in entries) == Counter(row["hash"][:16] for row in rows)
    assert all(one["status"] == "finished" and one["wall_s"] > 0.0 for one in entries)
    for row in rows:
        (run,) = (finished_sweep / "runs").glob(f"paper-random-tiny-seed{row['seed']}-{row['hash'][:16]}")
        assert row["policy_sha256"] == load_policy(run).manifest.manifest_sha256
        assert (row["steps"], row["total_steps"], row["scheme"]) == ("256", "256", "single")
    assert not (finished_sweep / "failures.csv").exists() and not list((finished_sweep / "logs").iterdir())


def test_job__is_the_training_that_train_makes(finished_sweep, tiny, tmp_path):
    row = read(finished_sweep / TABLE)[0]
    recipe = load_recipe(str(tiny)).replace(gamma=0.9)
    alone = train(recipe, "paper-random", tmp_path / "alone", seed=3, on_progress=None)
    assert alone.training.identity == row["hash"]
    assert alone.policy.manifest.manifest_sha256 == row["policy_sha256"]
    least = min(alone.evaluations, key=lambda one: one["first_impact_harm"])
    assert float(row["first_impact_harm"]) == least["first_impact_harm"]
    assert float(row["last_total_harm"]) == alone.evaluations[-1]["total_harm"]


def test_finished_jobs__are_not_repeated_and_the_table_is_the_same(
    finished_sweep, small, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(jobs, "LocalWorkers", Inside)
    folder, file = tmp_path / "again", tmp_path / "sweep.yaml"
    shutil.copytree(finished_sweep, folder)
    file.write_text(yaml.safe_dump(small))
    whole = (folder / TABLE).read_bytes()
    (folder / TABLE).unlink()
    assert sweep(file, folder) == 0 and len(journal(folder)) == 4
    assert "4 jobs are finished already" in capsys.readouterr().err
    assert (folder / TABLE).read_bytes() == whole
    (folder / "journal.jsonl").write_text((folder / "journal.jsonl").read_text()[:-40])  # a writer was killed
    kept = {path: path.stat().st_mtime_ns for path in (folder / "runs").glob("*/policy/manifest.json")}
    gone = folder / "runs" / journal(finished_sweep)[0]["job"]
    shutil.rmtree(gone)  # taken away: to be done again
    assert sweep(file, folder) == 0
    assert "2 jobs are finished already; 1 damaged lines of the journal" in capsys.readouterr().err
    assert (folder / TABLE).read_bytes() == whole and (gone / "run.json").is_file()
    assert all(path.stat().st_mtime_ns == then for path, then in kept.items() if gone not in path.parents)


@pytest.mark.slow
@pytest.mark.parametrize("gone", ["policy", "policy/weights.safetensors"])
def test_job__whose_policy_was_taken_away_is_done_again(finished_sweep, small, tmp_path, gone):
    folder, file = tmp_path / "again", tmp_path / "sweep.yaml"
    shutil.copytree(finished_sweep, folder)
    file.write_text(yaml.safe_dump(small))
    run = folder / "runs" / journal(finished_sweep)[1]["job"]
    (shutil.rmtree if gone == "policy" else Path.unlink)(run / gone)
    assert sweep(file, folder) == 0 and len(journal(folder)) == 5
    assert (folder / TABLE).read_bytes() == (finished_sweep / TABLE).read_bytes()
    assert load_policy(run).manifest.manifest_sha256 in (folder / TABLE).read_text()


@pytest.mark.slow
def test_team__that_has_lost_a_policy_is_trained_again(write_sweep, tiny, tmp_path):
    job = {"scenario": "cooperation-3-pair", "recipe": str(tiny), "set": {"scheme": "independent", "total_steps": 1}}
    folder, file = tmp_path / "out", write_sweep(jobs=[job])
    assert sweep(file, folder) == 0
    whole = (folder / TABLE).read_bytes()
    (lost,) = folder.glob("runs/*/policy/vehicle_3")
    shutil.rmtree(lost)
    assert sweep(file, folder) == 0 and len(journal(folder)) == 2
    assert (folder / TABLE).read_bytes() == whole and (lost / "manifest.json").is_file()


def test_more_jobs__can_be_added_to_a_folder(finished_sweep, small, tmp_path):
    folder, file = tmp_path / "more", tmp_path / "sweep.yaml"
    shutil.copytree(finished_sweep, folder)
    less = {"grid": {**small["grid"], "seed": [5]}}
    file.write_text(yaml.safe_dump(less))
    assert sweep(file, folder) == 0 and len(journal(folder)) == 4
    assert read(folder / TABLE) == [row for row in read(finished_sweep / TABLE) if row["seed"] == "5"]


def test_dry_run__prints_jobs_and_cost_and_makes_nothing(finished_sweep, small, tmp_path, capsys):
    file = tmp_path / "sweep.yaml"
    file.write_text(yaml.safe_dump(small))
    assert sweep(file, tmp_path / "new", "--dry-run") == 0
    told = capsys.readouterr()
    lines = told.out.splitlines()
    assert len(lines) == 4 and lines[0].startswith("new       paper-random-tiny-seed3-")
    assert lines[0].endswith("gamma=0.9")
    assert "to do: 4 jobs, 1,024 decisions: about" in told.err and not (tmp_path / "new").exists()
    assert sweep(file, finished_sweep, "--dry-run", "--json") == 0
    assert {job["state"] for job in json.loads(capsys.readouterr().out)["jobs"]} == {"finished"}


@pytest.mark.slow
def test_failures__end_in_a_table_with_their_last_lines(write_sweep, tiny, tmp_path, capsys):
    good = {"scenario": "paper-random", "recipe": str(tiny)}
    bad = {**good, "set": {"reward.harm": 1e300}}
    folder, file = tmp_path / "out", write_sweep(jobs=[bad, good])
    assert sweep(file, folder) == 1
    assert "1 of 2 jobs finished" in capsys.readouterr().err
    (failed,) = read(folder / "failures.csv")
    assert failed["attempts"] == "1" and failed["reason"].startswith("training: ")  # it would diverge again
    assert "TrainingDiverged" in failed["last_lines"]
    assert failed["set"] == "reward.harm=1e+300"
    assert [row["recipe"] for row in read(folder / TABLE)] == [str(tiny)]


@pytest.mark.parametrize("options", [["--jobs", "0"], ["--retries", "-1"]])
def test_bad_options__are_refused(write_sweep, small, tmp_path, options):
    file = write_sweep(**small)
    assert run_command(["study", "sweep", str(file), "--output", str(tmp_path / "new"), *options]) == 2
    assert not (tmp_path / "new").exists()


GOOD = {"scenario": "paper-random", "recipe": "ppo"}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ({"jobs": [GOOD, {**GOOD, "recipe": "pppo"}]}, "unknown recipe 'pppo'"),
        ({"grid": {}}, "grid.scenario: missing"),
        ({"grid": None}, "asks for 0 jobs"),
        ({"grid": {**GOOD, "seed": []}, "jobs": [GOOD]}, "must not be empty"),
        ({"jobs": [GOOD, {**GOOD, "seed": 1}, {**GOOD, "set": {"gamma": 0.995}}]}, "is the same training as jobs[0]"),
        ({"jobs": [GOOD, {**GOOD, "seed": 1, "set": {"gama": 0.9}}]}, "unknown setting 'gama'"),
        ({"jobs": [GOOD, {**GOOD, "seed": 1, "set": {"reward.harmm": 0.9}}]}, "reward.harmm: unknown key"),
        ({"jobs": [GOOD, {**GOOD, "set": {"network.policy.9": 4}}]}, "'9' must be an entry from 0 to 1"),
        ({"jobs": [GOOD, {**GOOD, "set": {"gamma.x": 4}}]}, "there is nothing inside 0.995"),
    ],
)
def test_bad_files__begin_no_job_and_make_nothing(write_sweep, tmp_path, capsys, content, reason):
    file = write_sweep(**content)
    assert sweep(file, tmp_path / "new") == 2
    assert reason in capsys.readouterr().err and [*tmp_path.iterdir()] == [file]


@pytest.mark.long
def test_disturbed_sweep__of_trainings_has_the_same_table(finished_sweep, small, tmp_path):
    file = tmp_path / "sweep.yaml"
    file.write_text(yaml.safe_dump(small))
    folder = tmp_path / "out"
    disturb([*PROGRAM, "study", "sweep", str(file), "--output", str(folder), "--jobs", "2"], folder)
    assert (folder / TABLE).read_bytes() == (finished_sweep / TABLE).read_bytes()
    assert sorted(ends(folder).values()) == [1, 1, 1, 1]


@pytest.mark.slow
def test_disturbed_sweep__has_the_same_table(write_sweep, tmp_path):
    file = write_sweep(grid={"scenario": "paper-random", "recipe": "ppo", "seed": {"count": 6}})
    command = [sys.executable, "-m", "tests.studies.sweep.counting", str(file)]
    alone, folder = tmp_path / "alone", tmp_path / "out"
    subprocess.run([*command, str(alone), "--jobs", "1"], cwd=ROOT, stderr=subprocess.DEVNULL, check=True)
    disturb([*command, str(folder), "--jobs", "2"], folder)
    assert (folder / TABLE).read_bytes() == (alone / TABLE).read_bytes()
    assert sorted(ends(folder).values()) == [1] * 6


def disturb(command: list[str], folder: Path) -> None:
    """Begin a sweep, kill it while jobs run, begin it again, end it by Ctrl-C; the third one comes to its end."""
    for end in (signal.SIGKILL, signal.SIGINT):
        driver = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
        try:
            while driver.pid not in map(parent, holders(folder)):
                assert driver.poll() is None
                time.sleep(0.01)
            driver.send_signal(end)
            assert driver.wait(timeout=300) in (-signal.SIGKILL, 130)
        finally:
            driver.kill()
            driver.wait()
        while holders(folder):  # processes whose driver was killed end by themselves
            time.sleep(0.01)
    finished = subprocess.run(command, cwd=ROOT, stderr=subprocess.PIPE, text=True, check=False)
    assert finished.returncode == 0, finished.stderr


def ends(folder: Path) -> Counter[str]:
    """How often each job was finished."""
    return Counter(one["job"] for one in journal(folder) if one["status"] == "finished")


@pytest.mark.parametrize("command", ["sweep", "tune"])
def test_ray__that_is_missing_is_told_before_anything_is_planned(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def need(package: str) -> None:
        raise InvalidInput(f"needs the package {package}")

    monkeypatch.setattr("ethbrake_marl.cli.train.need", need)
    arguments = ["study", command, "no.yaml", "--output", "no", "--ray", "local", "--dry-run"]
    assert run_command(arguments) == 2
    assert "needs the package ray" in capsys.readouterr().err
