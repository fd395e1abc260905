"""The folder of jobs: one question, one process at a time, and what is finished is kept, whatever was killed."""

from __future__ import annotations

import json
import operator
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.studies.jobs import Attempt, Job, JobFolder
from tests.studies.jobs.inside import Inside

QUESTION = {"seed": 1, "levels": [1, 2], "versions": {"numpy": "2", "torch": "2"}}


def folder_of(path: Path, **changes: Any) -> JobFolder:
    return JobFolder(path, "sums", {**QUESTION, **changes}, more={"owner": "me"}, beside=("mine",))


def do(folder: JobFolder, *numbers: int, workers: Any = 1) -> list[str]:
    """Run ``number + 1`` for each, and give the names of those that ended well."""
    found: list[str] = []

    def note(attempt: Attempt) -> None:
        if attempt.answer.value is not None:
            found.append(attempt.job.name)

    with folder.work():
        folder.run([Job(str(number), operator.add, (number, 1)) for number in numbers], workers, note)
    return found


@pytest.mark.parametrize("workers", [1, Inside(1)])
def test_finished_jobs__are_kept_with_what_they_gave(tmp_path: Path, workers) -> None:
    folder = folder_of(tmp_path / "new")
    assert folder.kept() == ({}, 0) and do(folder, 3, 4, workers=workers) == ["3", "4"]
    assert folder_of(tmp_path / "new").kept() == ({"3": 4, "4": 5}, 0)
    entry = json.loads((tmp_path / "new" / "journal.jsonl").read_text().splitlines()[0])
    assert (entry["job"], entry["status"], entry["attempt"]) == ("3", "finished", 1) and "process" in entry["where"]


def test_failed_jobs__are_noted_with_their_reason_and_not_kept(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    with folder.work():
        folder.run([Job("bad", operator.truediv, (1, 0))], Inside(1), lambda attempt: None, retries=1)
    entries = [json.loads(line) for line in (tmp_path / "journal.jsonl").read_text().splitlines()]
    assert [entry["status"] for entry in entries] == ["again", "failed"] and "division" in entries[1]["reason"]
    assert folder.kept() == ({}, 0)


@pytest.mark.parametrize(
    "damage",
    [lambda text: text[:-3], lambda text: text.replace('"found": 5', '"found": 6'), lambda text: text + "[]\n"],
)
def test_damaged_lines__are_counted_and_the_next_line_is_whole(tmp_path: Path, damage) -> None:
    folder, journal = folder_of(tmp_path), tmp_path / "journal.jsonl"
    do(folder, 3, 4)
    journal.write_text(damage(journal.read_text()))
    kept, damaged = folder.kept()
    assert damaged == 1 and kept["3"] == 4 and kept.get("4", 5) == 5
    do(folder, 7)
    assert folder.kept() == ({**kept, "7": 8}, 1)


def test_another_question__is_refused_with_what_differs_and_nothing_is_changed(tmp_path: Path) -> None:
    do(folder_of(tmp_path), 3)
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    other = folder_of(tmp_path, seed=2, levels=[1], versions={"numpy": "2", "torch": "3"})
    for refused in (other.check, lambda: do(other, 4)):
        with pytest.raises(
            InvalidInput, match=r"holds sums with other settings \(seed 1, here 2; levels; versions torch"
        ):
            refused()
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before
    (tmp_path / "question.json").write_text("[]")
    with pytest.raises(InvalidInput, match=r"question.json: is damaged.*; give another folder"):
        other.check()


def test_record__of_the_first_call_stays(tmp_path: Path) -> None:
    with folder_of(tmp_path).work():
        first = json.loads((tmp_path / "question.json").read_text())
    assert first["owner"] == "me"
    other = JobFolder(tmp_path, "sums", QUESTION, more={"owner": "you"})
    with other.work():
        assert not other.check() and json.loads((tmp_path / "question.json").read_text()) == first


def test_folder_of_something_else__is_left_alone_and_what_may_stand_there_may(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("expected")
    assert folder_of(tmp_path).check()
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(AlreadyExists, match="holds no sums"):
        do(folder_of(tmp_path), 3)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["mine", "thesis.tex"]
    for path in (tmp_path / "mine", tmp_path / "mine" / "new"):
        with pytest.raises(InvalidInput, match="is a file; give a folder"):
            folder_of(path).check()


def test_two_at_once__the_second_is_refused_and_a_killed_writers_rest_goes(tmp_path: Path) -> None:
    tmp_path.joinpath(".ethbrake-x.partial").write_text("half")
    folder = JobFolder(tmp_path, "sums")
    with folder.work(), pytest.raises(InvalidInput, match="another process works in it"):
        do(JobFolder(tmp_path, "sums"), 3)
    assert [file.name for file in tmp_path.iterdir() if file.name != ".lock"] == []


def test_folder_without_a_question__is_none_of_another_command(tmp_path: Path) -> None:
    do(folder_of(tmp_path), 3)
    with pytest.raises(AlreadyExists, match=r"no folder of a sweep: question\.json of another command is there; give"):
        JobFolder(tmp_path, "a sweep").check()
