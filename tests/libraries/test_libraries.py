"""The page of other libraries is what their files say, and those that are installed here run as copied."""

from __future__ import annotations

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.libraries.library import FOLDER, MOST_LINES, NAMES, Way, load
from tests.libraries.page import PAGE, make_page, read_matrix

WAYS = [pytest.param(way, id=f"{name}-{k}") for name in NAMES for k, way in enumerate(load(name).ways)]
HERE = [
    pytest.param(way, id=f"{name}-{k}")
    for name in ("stable_baselines3", "supersuit")
    if name in NAMES
    for k, way in enumerate(load(name).ways)
]


def test_page__is_what_the_files_and_the_last_matrix_say() -> None:
    assert PAGE.read_text("utf-8") == make_page(), "run `python -m tests.libraries --page`"


def test_names__are_all_files_that_declare_a_library() -> None:
    files = {file.stem for file in FOLDER.glob("*.py") if "\nLIBRARY = " in file.read_text("utf-8")}
    assert set(NAMES) == files


@pytest.mark.parametrize("way", WAYS)
def test_way__can_be_copied(way: Way) -> None:
    lines = [line for line in way.code.splitlines() if line.strip()]
    assert 1 <= len(lines) <= MOST_LINES
    assert max(len(line) for line in lines) <= 120
    if not way.command:
        compile(way.code, way.title, "exec")


@pytest.mark.parametrize("name", NAMES)
def test_matrix__has_every_way_as_it_stands_and_none_failed(name: str) -> None:
    rows = read_matrix()[name]
    assert not [row for row in rows if "FAILED" in row["verdict"]]
    if not rows[0]["verdict"].startswith("skipped"):
        assert [(row["way"], row["ran"]) for row in rows] == [(way.title, way.ran) for way in load(name).ways]


@pytest.mark.parametrize("way", HERE)
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
def test_way__runs_in_the_projects_own_environment(way: Way, tmp_path: Path, monkeypatch: Any) -> None:
    if find_spec("stable_baselines3") is None:
        pytest.skip("needs the extra train")
    monkeypatch.chdir(tmp_path)
    ppo = import_module("stable_baselines3").PPO.__init__
    monkeypatch.setattr(ppo, "__defaults__", tuple(64 if usual == 2048 else usual for usual in ppo.__defaults__))
    names: dict[str, Any] = {}
    exec(re.sub(r"n_steps=\d+", "n_steps=32", re.sub(r"\b\d+_000\b", "64", way.code)), names)
    assert names["agent"].act is not None
