"""Studies that go on after a kill: their folders, and trainings several at a time."""

from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.extensions.studies.folder import StudyFolder
from ethbrake_marl.extensions.studies.machine import this_machine
from ethbrake_marl.extensions.studies.trainings import TrainingJob, train_all
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.refused import refused
from tests.training.tiny import TINY, UPDATE, dying_after, killed

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


def jobs_of(folder: Path, count: int = 2) -> list[TrainingJob]:
    recipe, scenario = TINY.replace(total_steps=4 * UPDATE), load_scenario("paper-random")
    return [TrainingJob(Training.of(recipe, scenario, seed=k), folder / f"seed{k}") for k in range(count)]


def weights(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("weights.safetensors"))}


def test_trainings__go_on_after_a_kill_to_the_same_policies_whatever_the_number_of_jobs(tmp_path: Path) -> None:
    whole, lost = jobs_of(tmp_path / "whole"), jobs_of(tmp_path / "lost")
    told: list[str] = []
    assert train_all(whole, 1, lambda progress: told.append(progress.name))
    killed(lost[0].finish, dying_after(2))
    assert [job.steps_left() > 0 for job in lost] == [True, True]
    assert train_all(lost, 2) and not any(job.steps_left() for job in lost)
    assert len(weights(tmp_path / "whole")) >= 2 and weights(tmp_path / "lost") == weights(tmp_path / "whole")
    assert set(told) == {"seed0", "seed1"} and lost[0].result() == whole[0].result()
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "lost").rglob("*")}
    assert lost[0].attempt() == "" and train_all(lost)  # finished runs are skipped
    assert before == {file: file.stat().st_mtime_ns for file in (tmp_path / "lost").rglob("*")}


def test_result__is_the_best_row_of_what_the_recipe_counts(tmp_path: Path) -> None:
    (job,) = jobs_of(tmp_path, 1)
    assert job.finish()
    progress = job.folder / "progress.csv"
    head = "steps,eval/first_impact_harm,eval/total_harm,eval/collision_rate\n"
    progress.write_text(f"{head}0,9,19,0.9\n128,7,12,0.7\n256,,,\n384,8,11,0.6\n")
    assert job.result() == {
        "steps": 128, "harm": 7.0, "first_impact_harm": 7.0, "total_harm": 12.0, "collision_rate": 0.7
    }  # fmt: skip
    total = job.training.recipe.replace(reward={"harm": 1.0, "harm_count": "total"})
    assert job._replace(training=job.training._replace(recipe=total)).result()["steps"] == 384
    for damaged in (head, "\xff", head + "0,9,x,0.9\n"):
        progress.write_text(damaged)
        assert f"{progress}: is damaged (" in job.attempt()


def test_folder_of_another_training__is_refused(tmp_path: Path) -> None:
    one, other = jobs_of(tmp_path)
    other.folder.mkdir()
    with refused("the folder was not written by a training run; move it"):
        other.steps_left()
    assert one.finish()
    with refused("this training run has another recipe or another scenario; move it"):
        other._replace(folder=one.folder).steps_left()
    (one.folder / "run.json").write_text("{")
    with refused("delete the run's folder to train again"):
        one.steps_left()


def test_training_that_fails__is_a_reason(tmp_path: Path) -> None:
    (job,) = jobs_of(tmp_path, 1)
    with pytest.warns(RuntimeWarning):
        reason = job._replace(
            training=Training.of(job.training.recipe, job.training.scenario, reward={"harm": 1e300})
        ).attempt()
    assert reason.startswith("training: ")


def test_machine__is_one_line() -> None:
    machine = this_machine()
    assert "\n" not in str(machine) and machine.python in str(machine) and machine.cores >= machine.cores_usable >= 1
