"""``ethbrake watch dataset``: what it says, and what it refuses in one line."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.cli.conftest import Command

pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_dataset__is_written_and_told(ethbrake: Command, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    answer = ethbrake("watch", "dataset", "--agents", "full_brake,coast", "--episodes", "3", "--output", "a.parquet")
    assert (answer.status, answer.out) == (0, "")
    lines = answer.err.splitlines()
    assert "full_brake: 3 episodes; harm differs from `ethbrake evaluate` by at most 0 m2/s2 in a world" in lines
    assert lines[-1].startswith("dataset: a.parquet, ") and lines[-1].endswith(" decisions")
    assert [path.name for path in tmp_path.iterdir()] == ["a.parquet"]
    again = ethbrake("watch", "dataset", "--episodes", "3", "--output", "a.parquet")
    assert again.status == 2 and again.err.endswith("is there already; give another name or use force (--force)\n")


def test_dataset__of_minari_says_how_it_is_loaded(ethbrake: Command, tmp_path: Path) -> None:
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    answer = ethbrake("watch", "dataset", "--agents", "full_brake", "--episodes", "2", "--output", "brakes-v0")
    assert answer.status == 0
    expected = f"load it: MINARI_DATASETS_PATH={tmp_path}, minari.load_dataset('brakes-v0')"
    assert answer.err.splitlines()[-1] == expected
    assert [path.name for path in tmp_path.iterdir()] == ["brakes-v0"]


@pytest.mark.parametrize("name", ["a.parquet", "brakes-v0"])
def test_dataset__without_the_extra_says_the_line_that_installs_it(
    ethbrake: Command, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("pyarrow", "minari"):
        monkeypatch.setitem(sys.modules, package, None)
    answer = ethbrake("watch", "dataset", "--episodes", "2", "--output", name)
    assert answer.status == 2 and answer.err.endswith(f"{sys.executable} -m pip install 'ethbrake-marl[data]'\n")
    assert len(answer.err.splitlines()) == 1 and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--output", "brakes"), "a dataset of Minari is a folder called NAME-vNUMBER, for instance brakes-v0"),
        (("--output", "no/a.parquet"), "there is no folder no; make it first"),
        (
            ("--output", "a.parquet", "--format", "minari"),
            "the format minari is written to a folder called NAME-vNUMBER",
        ),
        (
            ("--output", "a-v0", "--scenario", "cooperation-3-pair"),
            "a dataset of Minari is one learner's: --vehicle NAME",
        ),
        (("--output", "a.parquet", "--agents", "ful_brake"), "did you mean 'full_brake'?"),
        (("--output", "brakes", "--agents", "ful_brake"), "a dataset of Minari is a folder called NAME-vNUMBER"),
    ],
)
def test_dataset__what_cannot_be_is_refused_in_one_line(
    ethbrake: Command, options: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ethbrake_marl.evaluation.episodes.need", lambda package: None)
    answer = ethbrake("watch", "dataset", "--episodes", "2", *options)
    assert answer.status == 2 and message in answer.err and len(answer.err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
