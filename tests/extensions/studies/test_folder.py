"""Folders of studies, and the machine in words."""

import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl import __version__
from ethbrake_marl.extensions.studies.folder import work_in
from ethbrake_marl.extensions.studies.machine import this_machine
from tests.refused import refused

SETTINGS = {"seed_of_list": 1, "levels": [1, 2]}


def study(folder: Path, **changes: Any) -> AbstractContextManager[None]:
    settings = {**SETTINGS, **changes}
    return work_in(folder, "sums", settings, record="settings.json", advice="give another", writes=("sums.csv",))


def test_folder__goes_on_with_the_same_settings_and_refuses_others(tmp_path: Path) -> None:
    for _ in range(2):
        with study(tmp_path / "new"):
            tmp_path.joinpath("new/.ethbrake-x.partial").write_text("half")
    assert json.loads((tmp_path / "new/settings.json").read_text()) == SETTINGS
    told = "the folder contains sums with other settings (seed-of-list 1, now 2; levels); give another"
    with refused(told), study(tmp_path / "new", seed_of_list=2, levels=[1]):
        pytest.fail("the block ran")
    (tmp_path / "new/settings.json").write_text("half a fi")
    with refused("; give another"), study(tmp_path / "new"):
        pytest.fail("the block ran")


def test_folder__that_cannot_be_written_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "sums.csv").mkdir()
    with refused("sums.csv: is a folder; give the path of a file"), study(tmp_path):
        pytest.fail("the block ran")
    (tmp_path / "thesis.tex").touch()
    with refused("thesis.tex is not a folder; give a new folder"), study(tmp_path / "thesis.tex"):
        pytest.fail("the block ran")


def test_folder__is_used_by_one_and_what_a_killed_writer_left_goes(tmp_path: Path) -> None:
    tmp_path.joinpath(".ethbrake-x.partial").write_text("half")
    with study(tmp_path):
        assert {file.name for file in tmp_path.iterdir()} == {".lock", "settings.json"}
        with refused("another process works in this folder"), study(tmp_path):
            pytest.fail("the block ran")


def test_machine__is_one_line() -> None:
    assert "\n" not in this_machine() and f"ethbrake_marl {__version__}" in this_machine()
