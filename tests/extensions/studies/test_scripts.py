"""``train/sweep.py`` and ``train/tune.py``: a killed run goes on to the result of an undisturbed one."""

import runpy
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

from tests.training.tiny import TINY, UPDATE

Run = Callable[..., int]

ROOT = Path(__file__).resolve().parents[3]

SWEEP = ("sweep", "--scenarios", "paper-random", "--seeds", "2", "--recipes")
LONGER = ("sweep", "--scenarios", "paper-random", "--seeds", "3", "--recipes")
TUNE = ("tune", "--scenario", "paper-random", "--trials", "3", "--search", "gamma=0.9..1.0:log")
TUNE += ("n_epochs=1..3", "network.policy=[8]/[16, 8]", "--recipe")


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A recipe of eight updates, with a checkpoint after each."""
    path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    tiny = TINY.replace(name="tiny", total_steps=8 * UPDATE, checkpoint_every_updates=1)
    path.write_text(yaml.safe_dump(tiny.model_dump(mode="json")))
    return str(path)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a script in this process; its exit status."""

    def call(script: str, *words: object) -> int:
        monkeypatch.setattr(sys, "argv", [f"{script}.py", *map(str, words)])
        try:
            runpy.run_path(str(ROOT / "train" / f"{script}.py"), run_name="__main__")
        except SystemExit as ended:
            return int(ended.code or 0)
        return 0

    return call


def results(folder: Path) -> dict[str, bytes]:
    """The table and all weights: name -> content."""
    files = [*folder.glob("*.csv"), *folder.rglob("weights.safetensors")]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


@pytest.mark.slow
@pytest.mark.parametrize(("words", "second"), [(LONGER, "*-seed1-*"), (TUNE, "trial-1")], ids=["sweep", "tune"])
def test_killed_run__goes_on_to_the_same_result(
    words: tuple[str, ...], second: str, recipe: str, run: Run, tmp_path: Path
) -> None:
    """It is killed in the second of three trainings, so that a slow test does not come too late."""
    script, *options = words
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert run(script, *options, recipe, "--output", whole) == 0
    line = [sys.executable, f"train/{script}.py", *options, recipe, "--output", killed]
    with subprocess.Popen(line, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        while not any(killed.glob(f"{second}/checkpoints/*")):
            assert process.poll() is None
            time.sleep(0.01)
        process.kill()
    assert not [*killed.glob("*.csv")] and any(killed.glob("*/checkpoints/*"))
    assert run(script, *options, recipe, "--output", killed) == 0
    assert results(killed) == results(whole) and len(results(whole)) >= 3
    before = {file: file.stat().st_mtime_ns for file in whole.rglob("weights.safetensors")}
    assert run(script, *options, recipe, "--output", whole) == 0  # finished training runs are skipped
    assert before == {file: file.stat().st_mtime_ns for file in whole.rglob("weights.safetensors")}


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")
def test_sweep__on_ray_has_the_same_table(recipe: str, run: Run, tmp_path: Path) -> None:
    script, *options = SWEEP
    for folder, more in (("here", []), ("ray", ["--ray", "local", "--jobs", "2"])):
        assert run(script, *options, recipe, *more, "--output", tmp_path / folder) == 0
    assert results(tmp_path / "ray") == results(tmp_path / "here")


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_run__that_fails_is_a_row_with_its_reason(recipe: str, run: Run, tmp_path: Path) -> None:
    (script, *options), diverging = SWEEP, "reward.harm=1.0e+300"
    assert run(script, *options, recipe, "--set", diverging, "--output", tmp_path / "sweep") == 1
    assert (tmp_path / "sweep" / "results.csv").read_text().count(",training: ") == 2
    assert run(TUNE[0], *TUNE[1:], recipe, "--trials", "1", "--set", diverging, "--output", tmp_path / "tune") == 0
    assert "\n0,,0.9" in (tmp_path / "tune" / "trials.csv").read_text()


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ((*SWEEP, "ppp"), "'ppo'"),
        ((*SWEEP, "ppo", "ppo"), "only once"),
        ((*SWEEP, "ppo", "--set", "gama=1"), "gamma"),
        ((*SWEEP, "ppo", "--jobs", "0"), "--jobs 0: must be 1 or more"),
        ((*TUNE, "ppo", "--jobs", "0"), "--jobs and --trials must be 1 or more"),
        ((*TUNE, "ppo", "--search", "gamma=0.9..1", "gamma=0.5/0.6"), "each key only once"),
        ((*TUNE, "ppo", "--search", "gamma=0.9"), "KEY=LOW..HIGH"),
        ((*TUNE, "ppo", "--search", "gamma=3..1"), "low <= high"),
        ((*TUNE, "ppo", "--search", "n_epochs=0..4"), "n_epochs"),
        ((*TUNE, "ppo", "--search", "mass_t=1..4"), "mass_t"),
    ],
)
def test_bad_input__is_refused_in_one_line_and_nothing_is_made(
    words: tuple[str, ...], key: str, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script, *options = words
    assert run(script, *options, "--output", tmp_path / "new") == 2 and not (tmp_path / "new").exists()
    told = capsys.readouterr().err
    assert key in told and told.startswith(f"{script}.py: error: ") and told.count("\n") == 1


def test_tune__other_settings_in_its_folder_are_refused(recipe: str, run: Run, tmp_path: Path) -> None:
    script, *options = TUNE
    assert run(script, *options, recipe, "--trials", "1", "--output", tmp_path) == 0
    assert run(script, *options, recipe, "--set", "gae_lambda=0.5", "--output", tmp_path) == 2


def test_sweep__damaged_results_of_a_finished_run_are_a_row_with_its_reason(
    recipe: str, run: Run, tmp_path: Path
) -> None:
    script, *options = (*SWEEP, recipe, "--output", tmp_path)
    assert run(script, *options) == 0
    before = (tmp_path / "results.csv").read_text().splitlines()
    (progress,) = tmp_path.glob("*-seed0-*/progress.csv")
    head, *rows = progress.read_bytes().splitlines(keepends=True)
    for damaged in (head, b"\xff\xfe", head + rows[-1].replace(b".", b"x")):
        progress.write_bytes(damaged)
        assert run(script, *options) == 1
        now = (tmp_path / "results.csv").read_text().splitlines()
        assert f"{progress}: is damaged (" in now[1] and "delete the run's folder" in now[1]
        assert (now[0], now[2]) == (before[0], before[2])


def test_tune__damaged_file_of_trials_is_one_error_and_can_be_deleted(
    recipe: str, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script, *options = (*TUNE, recipe, "--trials", "1", "--output", tmp_path)
    assert run(script, *options) == 0
    before, log = results(tmp_path), tmp_path / "optuna.log"
    for damaged in (b"\x81", log.read_bytes()[:-5] + b"\n{}\n", b"{}\n{}\n"):
        log.write_bytes(damaged)
        assert run(script, *options) == 2
        assert f"{log}: is damaged (" in capsys.readouterr().err
    log.unlink()
    assert run(script, *options) == 0 and results(tmp_path) == before
