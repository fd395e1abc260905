"""One contract for every folder of jobs: other settings, files of somebody else, a second process, a damaged record."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from filelock import FileLock

from ethbrake_marl.cli.app import run_command
from tests.studies.conftest import ABLATE, TRIALS, write_yaml


class Study(NamedTuple):
    """A command, the folder of its finished work, what makes its settings others, and where they are kept."""

    line: tuple[object, ...]
    folder: Path
    other: tuple[object, ...]
    told: str
    record: str


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folders of a sharded evaluation and of a reproduction; not to be changed."""
    folder = tmp_path_factory.mktemp("done")
    assert run_command(["evaluate", *SHARDS, "--output", str(folder / "shards")]) == 0
    assert run_command([*REPRODUCE, "--output", str(folder / "reproduction")]) == 0
    return folder


REPRODUCE = ("reproduce", "learning-low", "--episodes", "20")
SHARDS = ("--agents", "coast", "--episodes", "20", "--shards", "2")


@pytest.fixture(params=["shards", "reproduction", "ablation", "tuning", "sweep"])
def study(request: pytest.FixtureRequest, tmp_path: Path) -> Study:
    """Each of them."""
    get, name = request.getfixturevalue, request.param
    if name == "shards":
        told = "holds shards with other settings (seed 7, here 8)"
        return Study(("evaluate", *SHARDS), get("done") / name, ("--seed", "8"), told, "question.json")
    if name == "reproduction":
        more, told = ("--episodes", "50"), "(episodes 20, here 50)"
        return Study(REPRODUCE, get("done") / name, more, told, "reproduction.json")
    if name == "ablation":
        line, more = ("study", "ablate", "--recipes", get("tiny_total"), *ABLATE), ("--budget", "60", "--seeds", "3")
        return Study(line, get("finished_ablation"), more, "(seeds 2, here 3; budget 50, here 60)", "settings.json")
    if name == "tuning":
        file = write_yaml(tmp_path / "same.yaml", get("small_tuning"))
        line, more = ("study", "tune", file, "--trials", TRIALS), ("--trials", TRIALS)
        other = ("study", "tune", get("write_tuning")(seed=1), *more)
        return Study(line, get("finished_tuning"), other, "holds a tuning with other settings", "tuning.json")
    file = get("write_sweep")(**get("small_sweep"))
    return Study(("study", "sweep", file, "--jobs", "1"), get("finished_sweep"), (), "", "")


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., None]:
    """Call it with a folder and a command line: it is refused with this text, and the folder stays as it is."""

    def refuse(folder: Path, told: str, *line: object) -> None:
        before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        capsys.readouterr()
        assert run_command([*map(str, line), "--output", str(folder)]) == 2
        assert told in capsys.readouterr().err
        assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before

    return refuse


def test_other_settings__are_refused_with_what_differs(study: Study, refused) -> None:
    if study.other:
        line = study.other if study.other[0] == "study" else (*study.line, *study.other)
        refused(study.folder, study.told, *line)


def test_folder_of_something_else__is_left_alone(study: Study, refused, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    refused(tmp_path / "mine" / "thesis.tex", "is a file; give a folder", *study.line)
    if study.line[0] != "study":  # a study's own files stand beside what is there
        refused(tmp_path / "mine", "holds no", *study.line)


def test_second_process__is_refused(study: Study, refused, tmp_path: Path) -> None:
    shutil.copytree(study.folder, tmp_path / "copy")
    if study.line[0] == "evaluate":  # which looks at what is finished first
        (tmp_path / "copy" / "journal.jsonl").unlink()
    with FileLock(tmp_path / "copy" / ".lock"):
        refused(tmp_path / "copy", "another process works in it", *study.line)


def test_damaged_record__is_named(study: Study, refused, tmp_path: Path) -> None:
    if study.record:
        shutil.copytree(study.folder, tmp_path / "copy")
        (tmp_path / "copy" / study.record).write_text("[]")
        refused(tmp_path / "copy", f"{study.record}: is damaged", *study.line)
