"""Studies that go on after a kill: one contract for their folders, and trainings several at a time."""

import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from filelock import FileLock

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.extensions.studies.folder import StudyFolder
from ethbrake_marl.extensions.studies.trainings import TrainingJob, train_all
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.training.recipe import load_recipe
from ethbrake_marl.first_edition.training.training import Training
from tests.extensions.studies.conftest import ABLATE

ROOT = Path(__file__).resolve().parents[3]
QUESTION = {"seed": 1, "levels": [1, 2], "versions": {"numpy": "2", "torch": "2"}}


def folder_of(path: Path, owner: str = "me", **changes: Any) -> StudyFolder:
    return StudyFolder(path, "sums", {**QUESTION, **changes}, more={"owner": owner}, beside=("mine",))


def begun(path: Path) -> Path:
    with folder_of(path).work():
        return path


def test_folder__of_something_else_is_refused_and_what_may_stand_there_may(tmp_path: Path) -> None:
    (tmp_path / "mine").touch()
    assert folder_of(tmp_path).check()
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(AlreadyExists, match="the folder exists, but does not contain sums; give another folder"):
        begun(tmp_path)
    with pytest.raises(InvalidInput, match=r"thesis.tex: .*thesis.tex is not a folder; give a new folder"):
        begun(tmp_path / "thesis.tex")


def test_folder__of_another_question_is_refused_with_what_differs(tmp_path: Path) -> None:
    begun(tmp_path / "new")
    other = folder_of(tmp_path / "new", "you", seed=2, levels=[1], versions={"numpy": "2", "torch": "3"})
    with pytest.raises(InvalidInput, match=r"other settings \(seed 1, now 2; levels; versions torch 2, now 3\); give"):
        other.check()
    assert not folder_of(tmp_path / "new", "you").check()  # the record of the first one stays
    assert '"owner": "me"' in (tmp_path / "new" / "question.json").read_text()
    with pytest.raises(
        AlreadyExists, match=r"the folder cannot be used for curves, because another command has written question.json"
    ):
        StudyFolder(tmp_path / "new", "curves").check()


@pytest.mark.parametrize("is_new", [True, False])
def test_folder__a_file_that_cannot_be_replaced_at_the_end_is_refused_at_once(tmp_path: Path, is_new: bool) -> None:
    folder = StudyFolder(tmp_path, "sums", None if is_new else QUESTION, writes=("sums.csv",))
    folder.check()
    (tmp_path / "sums.csv").write_text("of the last time")
    folder.check()
    (tmp_path / "sums.csv").unlink()
    (tmp_path / "sums.csv").mkdir()
    with pytest.raises(InvalidInput, match=r"sums.csv: is a folder; give the path of a file"):
        folder.check()


def test_folder__what_a_killed_writer_left_goes(tmp_path: Path) -> None:
    tmp_path.joinpath(".ethbrake-x.partial").write_text("half")
    with StudyFolder(tmp_path, "sums").work():
        assert [file.name for file in tmp_path.iterdir() if file.name != ".lock"] == []


# ---------------------------------------------------------------- trainings

TRAINING = """
import sys
from tests.extensions.studies.test_folder import tiny_trainings
from ethbrake_marl.extensions.studies.trainings import train_all

if __name__ == "__main__":
    train_all(tiny_trainings(sys.argv[1], sys.argv[2]), 2)
"""


def tiny_trainings(recipe: str, folder: str) -> list[TrainingJob]:
    """Short trainings, more than joblib hands to two workers ahead: some are left however fast the machine is."""
    plan, scenario = load_recipe(recipe).replace(total_steps=1_024), load_scenario("cooperation-3-pair")
    plan = plan.replace(scheme="shared")
    return [TrainingJob(Training.of(plan, scenario, seed=k), Path(folder) / f"seed{k}") for k in range(8)]


def weights(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("weights.safetensors"))}


@pytest.mark.slow
def test_trainings__killed_with_their_workers_go_on_to_the_same_policies(tiny_total: Path, tmp_path: Path) -> None:
    line = [sys.executable, "-c", TRAINING, str(tiny_total), str(tmp_path / "killed")]
    with subprocess.Popen(line, cwd=ROOT, stdout=subprocess.PIPE) as process:
        try:
            while not [*(tmp_path / "killed").glob("seed*/checkpoints/*")]:
                assert process.poll() is None
                time.sleep(0.01)
        finally:
            process.kill()
        process.communicate(timeout=60.0)  # until the last worker has ended, which it does by itself
    lost = tiny_trainings(str(tiny_total), str(tmp_path / "killed"))
    assert any(each.steps_left() for each in lost)
    assert train_all(lost, 1) and not any(each.steps_left() for each in lost)
    whole = tiny_trainings(str(tiny_total), str(tmp_path / "whole"))
    assert train_all(whole, 2)
    assert len(weights(tmp_path / "whole")) >= 8 and weights(tmp_path / "killed") == weights(tmp_path / "whole")


# ---------------------------------------------------------------- one contract for every folder


class Study(NamedTuple):
    """A command, the folder of its finished work, one with other settings, its refusal, and where they are kept."""

    line: tuple[object, ...]
    folder: Path
    other: tuple[object, ...]
    told: str
    record: str


REPRODUCE = ("reproduce", "learning-low", "--episodes", "20")


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a reproduction; not to be changed."""
    folder = tmp_path_factory.mktemp("done") / "reproduction"
    assert run_command([*REPRODUCE, "--output", str(folder)]) == 0
    return folder


STUDIES: dict[str, Callable[[Callable[[str], Any]], Study]] = {
    "reproduction": lambda get: Study(
        REPRODUCE, get("reproduced"), (*REPRODUCE, "--episodes", "50"), "(episodes 20, now 50)", "reproduction.json"
    ),
    "ablation": lambda get: Study(
        ("study", "ablate", "--recipes", get("tiny_total"), *ABLATE),
        get("finished_ablation"),
        ("study", "ablate", "--recipes", get("tiny_total"), *ABLATE, "--search-episodes", "3", "--seeds", "3"),
        "(seeds 2, now 3; search-episodes 4, now 3)",
        "settings.json",
    ),
}


@pytest.fixture(params=STUDIES)
def study(request: pytest.FixtureRequest) -> Study:
    """Each of them."""
    return STUDIES[request.param](request.getfixturevalue)


def files_in(folder: Path, but: str) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != but}


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Call it with a folder, a command line and its exit status: what it says; the folder stays as it is.

    Files named ``but`` may change.
    """

    def call(folder: Path, *line: object, status: int = 2, but: str = "") -> str:
        before = files_in(folder, but)
        capsys.readouterr()
        assert run_command([*map(str, line), "--output", str(folder)]) == status
        assert files_in(folder, but) == before
        return "\n".join(capsys.readouterr())

    return call


def test_other_settings__are_refused_with_what_differs(study: Study, told) -> None:
    assert study.told in told(study.folder, *study.other)


def test_second_process__is_refused(study: Study, told, tmp_path: Path) -> None:
    shutil.copytree(study.folder, tmp_path / "copy")
    with FileLock(tmp_path / "copy" / ".lock"):
        assert "another process works in this folder" in told(tmp_path / "copy", *study.line)


def test_damaged_record__is_named(study: Study, told, tmp_path: Path) -> None:
    shutil.copytree(study.folder, tmp_path / "copy")
    (tmp_path / "copy" / study.record).write_text("[]")
    assert f"{study.record}: is damaged" in told(tmp_path / "copy", *study.line)


LAST = "trainings/cooperation-3-congested-tiny-shared-seed1"


@pytest.mark.parametrize("study", ["ablation"], indirect=True)
@pytest.mark.parametrize(
    ("file", "damage", "message"),
    [
        (f"{LAST}/run.json", ("{", "["), "run.json: is damaged"),
        (f"{LAST}/config.json", ("{", "["), "config.json: is damaged"),
        (
            f"{LAST}/config.json",
            ('"total_steps": 256', '"total_steps": 512'),
            "this folder contains another training run, which differs in recipe total_steps; choose another folder",
        ),
        (f"{LAST}/run.json", None, "the folder was not written by a training run"),
        (f"{LAST}/team.json", ('"scheme"', '"shceme"'), "team.json"),
        (f"{LAST}/policy/manifest.json", ("{", "{}"), "manifest.json"),
    ],
)
def test_damaged_file__is_named_in_one_line_before_anything_is_done(
    study: Study, file: str, damage: tuple[str, str] | None, message: str, told, tmp_path: Path
) -> None:
    """A joint optimum and a training are left to be made, which come before it."""
    damaged = Path(shutil.copytree(study.folder, tmp_path / "copy")) / file
    for other in (tmp_path / "copy" / "optimum", damaged.parents[1] / "cooperation-3-pair-tiny-shared-seed0"):
        shutil.rmtree(other, ignore_errors=True)
    text = damaged.read_text()
    damaged.unlink()
    if damage is not None:
        assert damage[0] in text
        damaged.write_text(text.replace(*damage))
    said = told(tmp_path / "copy", *study.line, but=damaged.name)
    assert message in said and said.count("\n") == 2
