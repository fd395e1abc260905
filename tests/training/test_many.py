"""``train/benchmark/run.py`` and ``train/tune.py``: a killed run goes on to the result of an undisturbed one."""

from __future__ import annotations

import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.training.job import Job
from ethbrake_marl.training.training import Training
from tests.fixtures.commands import rows_of
from tests.training.tiny import TINY, kept

pytest.importorskip("optuna")
Run = Callable[..., int]
ROOT = Path(__file__).resolve().parents[2]
RUN = ("benchmark/run", "--tasks", "paper-random", "--seeds", "2", "--episodes", "5", "--methods")
TUNE = ("tune", "--scenario", "paper-random", "--trials", "3", "--search", "gamma=0.9..0.99:log")
TUNE += ("n_epochs=1..3", "network.policy=[8]/[16, 8]", "--recipe")


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> str:
    often = {"total_steps": 512, "evaluation": {"every_updates": 1, "worlds": 5, "seed": 7}}
    file = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    tiny = TINY.replace(name="tiny", checkpoint_every_updates=1, **often)
    file.write_text(yaml.safe_dump(tiny.model_dump(mode="json")))
    return str(file)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Run:
    def call(script: str, *words: object) -> int:
        monkeypatch.setattr(sys, "argv", [f"{Path(script).name}.py", *map(str, words)])
        try:
            runpy.run_path(str(ROOT / "train" / f"{script}.py"), run_name="__main__")
        except SystemExit as ended:
            return int(ended.code or 0)
        return 0

    return call


def results(folder: Path) -> dict[str, bytes]:
    files = [*folder.glob("*.csv"), *folder.rglob("weights.safetensors")]
    contents = {str(file.relative_to(folder)): file.read_bytes() for file in files}
    if "rows.csv" in contents:  # without the processor time
        rows = [{**row, "cpu_s": ""} for row in rows_of(folder / "rows.csv")]
        contents["rows.csv"] = csv_text(rows).encode()
    return contents


@pytest.mark.slow
@pytest.mark.parametrize(("words", "second"), [(RUN, "runs/*-seed1"), (TUNE, "trial-1")], ids=["run", "tune"])
def test_killed_run__goes_on_to_the_same_result(
    words: tuple[str, ...], second: str, recipe: str, run: Run, tmp_path: Path
) -> None:
    script, *options = words
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert run(script, *options, recipe, "--output", whole) == 0
    line = [sys.executable, f"train/{script}.py", *options, recipe, "--output", str(killed)]
    with subprocess.Popen(line, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        while not any(killed.glob(f"{second}/checkpoints/*")):
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert not [*killed.glob("*.csv")]
    assert run(script, *options, recipe, "--output", killed) == 0
    assert results(killed) == results(whole) and len(results(whole)) >= 3
    before = {file: file.stat().st_mtime_ns for file in whole.rglob("weights.safetensors")}
    assert run(script, *options, recipe, "--output", whole) == 0  # finished training runs are skipped
    assert before == {file: file.stat().st_mtime_ns for file in whole.rglob("weights.safetensors")}


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")
def test_run__on_ray_has_the_same_table(recipe: str, run: Run, tmp_path: Path) -> None:
    script, *options = RUN
    for folder, more in (("here", []), ("ray", ["--ray", "local", "--jobs", "2"])):
        assert run(script, *options, recipe, *more, "--output", tmp_path / folder) == 0
    assert results(tmp_path / "ray") == results(tmp_path / "here")


METHOD = """
from pathlib import Path

import ethbrake_marl as eb


def train(task, seed, decisions, folder):
    (folder / "brake.txt").write_text(str(6 - seed))


def make_agent(folder, settings):
    return eb.make_agent("constant:" + (Path(folder) / "brake.txt").read_text())
"""


def test_run__of_a_method_of_ones_own(run: Run, empty_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine.py").write_text(METHOD)
    words = ("benchmark/run", "--tasks", "benchmark-pair", "--methods", "mine.py:train", "--seeds", "2", "--decisions")
    assert run(*words, "50", "--episodes", "30", "--output", "new") == 0
    *rows, braking = rows_of(Path("new/rows.csv"))
    assert [braking[key] for key in ("method", "agent", "seed", "decisions")] == ["full_brake", "full_brake", "", ""]
    assert [(row["task"], row["method"], row["seed"], row["decisions"]) for row in rows] == [
        ("benchmark-pair", "mine.py:train", "0", "50"), ("benchmark-pair", "mine.py:train", "1", "50"),
    ]  # fmt: skip
    agents = {brake: f"constant:{brake}" for brake in ("6", "5")} | {"full_brake": "full_brake"}
    result = eb.evaluate("benchmark-pair", agents, episodes=30, measures="worst5")
    table = {row.agent: row for row in eb.summarise(result)}
    for row, brake in zip([*rows, braking], agents, strict=True):
        for key in ("honest_cost", "worst5_honest", "collision_rate"):
            assert float(row[key]) == table[brake][key].value
    capsys.readouterr()
    assert run(*words, "60", "--episodes", "30", "--output", "new") == 1
    assert "has a training with other settings" in capsys.readouterr().out
    assert run(*words, "50", "--episodes", "20", "--output", "new") == 1
    assert "episodes = 30, not 20; delete it to evaluate again" in capsys.readouterr().out
    Path("other").mkdir()
    Path("other/mine.py").write_text(METHOD.replace("6 - seed", "5 - seed"))
    other_words = ("other/mine.py:train" if word == "mine.py:train" else word for word in words)
    assert run(*other_words, "50", "--episodes", "30", "--output", "new") == 1
    assert "has a training with other settings or another file" in capsys.readouterr().out


def test_tune__of_a_method_of_ones_own(run: Run, empty_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine.py").write_text(
        METHOD.replace("decisions, folder):", "decisions, folder, brake=6):").replace("6 - seed", "brake")
    )
    words = ("tune", "--scenario", "benchmark-pair", "--recipe", "mine.py:train", "--trials", "2", "--output", "new")
    assert run(*words, "--search", "brake=4/5") == 0
    trials = {row["brake"]: float(row["harm"]) for row in rows_of(Path("new/trials.csv"))}
    for brake, harm in trials.items():
        agents = {"mine": f"constant:{brake}"}
        assert harm == eb.evaluate("benchmark-pair", agents, episodes=2000, seed=8)["mine"]["honest_cost"].mean()
    assert run(*words, "--search", "brakes=4/5") == 2
    assert "has no setting 'brakes'" in capsys.readouterr().err


def test_run__goes_on_after_a_failure(run: Run, empty_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine.py").write_text(METHOD.replace("(folder /", "1 / seed; (folder /"))
    Path("half.py").write_text(METHOD.replace("def make_agent", "def make"))
    words = ("benchmark/run", "--tasks", "benchmark-pair", "--seeds", "2", "--episodes", "9", "--decisions", "9")
    assert run(*words, "--methods", "mine.py:train", "--output", "new") == 1
    assert "ZeroDivisionError: division by zero" in capsys.readouterr().out
    assert [row["seed"] for row in rows_of(Path("new/rows.csv")) if row["reason"]] == ["0"]
    assert run(*words, "--methods", "mine.py:train", "half.py:train", "--output", "other") == 2
    assert "make_agent" in capsys.readouterr().err and not Path("other").exists()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_run__that_fails_is_a_row_with_its_reason(recipe: str, run: Run, tmp_path: Path) -> None:
    (script, *options), diverging = RUN, "reward.harm=1.0e+300"
    assert run(script, *options, recipe, "--set", diverging, "--output", tmp_path / "run") == 1
    assert (tmp_path / "run" / "rows.csv").read_text().count("training: ") == 2
    assert run(TUNE[0], *TUNE[1:], recipe, "--trials", "1", "--set", diverging, "--output", tmp_path / "tune") == 0
    assert "\n0,,0.9" in (tmp_path / "tune" / "trials.csv").read_text()


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ((*RUN, "ppp"), "'ppo'"),
        ((*RUN, "ppo", "ppo"), "only once"),
        ((*RUN, "ppo", "--set", "gama=1"), "gamma"),
        ((*TUNE, "ppo", "--jobs", "0"), "--jobs and --trials must be 1 or more"),
        ((*TUNE, "ppo", "--search", "gamma=0.9..1", "gamma=0.5/0.6"), "each key only once"),
        ((*TUNE, "ppo", "--search", "gamma=0.9"), "KEY=LOW..HIGH"),
        ((*TUNE, "ppo", "--search", "n_epochs=0..4"), "n_epochs"),
    ],
)
def test_bad_input__is_refused_in_one_line_and_nothing_is_made(
    words: tuple[str, ...], key: str, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script, *options = words
    assert run(script, *options, "--output", tmp_path / "new") == 2 and not (tmp_path / "new").exists()
    told = capsys.readouterr().err
    assert key in told and told.startswith(f"{Path(script).name}.py: error: ") and told.count("\n") == 1


def test_tune__a_log_of_other_settings_or_a_damaged_one_is_one_error(
    recipe: str, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script, *options = (*TUNE, recipe, "--trials", "1", "--output", tmp_path)
    assert run(script, *options) == 0
    before, log = results(tmp_path), tmp_path / "optuna.log"
    assert run(script, *options, "--set", "gae_lambda=0.5") == 2
    assert "with other settings" in capsys.readouterr().err
    for damaged in (b"\x81", log.read_bytes()[:-5] + b"\n{}\n", b"{}\n{}\n"):
        log.write_bytes(damaged)
        assert run(script, *options) == 2
        assert f"{log}: is damaged (" in capsys.readouterr().err
    log.unlink()
    assert run(script, *options) == 0 and results(tmp_path) == before


def test_job__skips_what_is_finished_and_reads_its_best_measurement(tmp_path: Path) -> None:
    job = Job(Training.of(TINY, "paper-random"), tmp_path / "new" / "run")
    assert job.attempt() == "" and job.attempt() == ""
    harm = [float(row["eval/honest_cost"]) for row in kept(job.folder)["rows"][::3]]
    assert len(harm) == 3 and job.result()["harm"] == job.result()["honest_cost"] == min(harm)
    assert load_policy(job.folder).manifest.steps == job.result()["steps"]
    other = Job(Training.of(TINY, "paper-random", seed=1), job.folder)
    assert "has a training with other settings" in other.attempt()
    assert "is not the folder of a run" in job._replace(folder=tmp_path).attempt()
