"""Folders of studies, and the machine in words."""

from pathlib import Path
from typing import Any

from filelock import FileLock

from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.extensions.studies.folder import StudyFolder
from ethbrake_marl.extensions.studies.machine import this_machine
from tests.refused import refused

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
    with refused("the folder exists, but does not contain sums; give another folder", AlreadyExists):
        begun(tmp_path)
    with refused("thesis.tex is not a folder; give a new folder"):
        begun(tmp_path / "thesis.tex")


def test_folder__of_another_question_is_refused_with_what_differs(tmp_path: Path) -> None:
    begun(tmp_path / "new")
    other = folder_of(tmp_path / "new", "you", seed=2, levels=[1], versions={"numpy": "2", "torch": "3"})
    with refused("other settings (seed 1, now 2; levels; versions torch 2, now 3); give"):
        other.check()
    assert not folder_of(tmp_path / "new", "you").check()  # the record of the first one stays
    assert '"owner": "me"' in (tmp_path / "new" / "question.json").read_text()
    with refused("because another command has written question.json", AlreadyExists):
        StudyFolder(tmp_path / "new", "curves").check()


def test_folder__a_file_that_cannot_be_replaced_at_the_end_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "sums.csv").mkdir()
    with refused("sums.csv: is a folder; give the path of a file"):
        StudyFolder(tmp_path, "sums", writes=("sums.csv",)).check()


def test_folder__what_a_killed_writer_left_goes_and_two_at_once_are_refused(tmp_path: Path) -> None:
    tmp_path.joinpath(".ethbrake-x.partial").write_text("half")
    with StudyFolder(tmp_path, "sums").work():
        assert [file.name for file in tmp_path.iterdir() if file.name != ".lock"] == []
    with FileLock(tmp_path / ".lock"), refused("another process works in this folder"):
        begun(tmp_path)


def test_machine__is_one_line() -> None:
    machine = this_machine()
    assert "\n" not in str(machine) and machine.python in str(machine) and machine.cores >= machine.cores_usable >= 1
