from __future__ import annotations

import csv
import json
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.store import hold_lock, new_folder, write_file
from ethbrake_marl.learning.runs import ProgressTable
from ethbrake_marl.learning.training import RunDirectory


def test_write_file__replaces_in_one_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.json"
    write_file(path, b"old")

    def power_cut(*_: object) -> None:
        raise OSError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", power_cut)
        with pytest.raises(OSError, match="power cut"):
            write_file(path, b"new, but only half of i")
    assert path.read_bytes() == b"old"
    write_file(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_new_folder__is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    with new_folder(tmp_path / "a" / "good") as partial:
        (partial / "x").write_text("1")
        assert not (tmp_path / "a" / "good").exists()
    with pytest.raises(KeyboardInterrupt), new_folder(tmp_path / "a" / "bad") as partial:
        (partial / "x").write_text("1")
        raise KeyboardInterrupt
    assert [str(p.relative_to(tmp_path)) for p in sorted(tmp_path.rglob("*"))] == ["a", "a/good", "a/good/x"]


def test_new_folder__does_not_take_a_name_that_was_taken_meanwhile(tmp_path: Path) -> None:
    with pytest.raises(AlreadyExists, match="good: is there already"), new_folder(tmp_path / "good"):
        (tmp_path / "good").mkdir()
    assert list(tmp_path.iterdir()) == [tmp_path / "good"]


def test_hold_lock__is_for_one_and_free_afterwards(tmp_path: Path) -> None:
    def hold() -> AbstractContextManager[None]:
        return hold_lock(tmp_path / "some.lock", "somebody works here")

    for _ in range(2):
        with hold(), pytest.raises(InvalidInput, match=f"^{tmp_path}: somebody works here$"), hold():
            pass


def test_hold_lock__names_what_cannot_be_one(tmp_path: Path) -> None:
    lock = tmp_path / "some.lock"
    lock.mkdir()
    with pytest.raises(InvalidInput, match=r"some\.lock: cannot be used as a lock .*; delete it"), hold_lock(lock, ""):
        pass


def test_create_run__refuses_what_exists(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "runs" / "first").create({"seeds": {"training": 3}})
    assert json.loads(run.config.read_text()) == {"seeds": {"training": 3}}
    assert json.loads(run.status.read_text())["status"] == "running"
    with pytest.raises(
        AlreadyExists, match=r"first: is there already; give another name .*--force; make run ARGS=--force"
    ):
        RunDirectory(run.path).create({})
    assert run.status.is_file()


def test_create_run__force_replaces_a_run_and_nothing_else(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "first").create({})
    (run.path / "old").touch()
    assert sorted(p.name for p in RunDirectory(run.path).create({}, force=True).path.iterdir()) == [
        "config.json",
        "run.json",
    ]
    precious = tmp_path / "thesis"
    precious.mkdir()
    (precious / "chapter-1").touch()
    with pytest.raises(AlreadyExists, match="thesis: is there already, and is no run; give another name"):
        RunDirectory(precious).create({}, force=True)
    assert (precious / "chapter-1").is_file()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["first", "thesis"]


def test_progress_table__columns_are_sorted_and_later_ones_are_filled_in(tmp_path: Path) -> None:
    table = ProgressTable(tmp_path / "progress.csv")
    table.write({"train/b": np.float32(0.5), "train/a": 1}, {"train/b": (), "train/a": ()}, step=10)
    table.write({"train/a": 2}, {"train/a": ()}, step=20)
    table.write({"eval/z": 3.25, "train/a": 4, "hidden": 1}, {"eval/z": (), "train/a": (), "hidden": ("csv",)}, step=30)
    text = (tmp_path / "progress.csv").read_text()
    assert text == "steps,eval/z,train/a,train/b\n10,,1,0.5\n20,,2,\n30,3.25,4,\n"
    assert len(list(csv.DictReader(text.splitlines()))) == 3
