"""Pictures, pages and films of commands."""

import sys
from pathlib import Path

import pytest

from ethbrake_marl.errors import _EXTRA_OF
from tests.files.test_files import check_target
from tests.fixtures.commands import Command, Refuse, check_refused
from tests.test_imports import ended

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.parametrize("name", ["realistic-mixed", "paper-scenario-1"])
def test_sample__draws_a_picture(ethbrake: Command, tmp_path: Path, name: str) -> None:
    for picture in (tmp_path / "a.png", tmp_path / "b.png"):
        told = ethbrake("scenario", "sample", name, "--episodes", "40", "--output", picture)
        assert (told.status, told.out, told.err) == (0, "", f"picture: {picture}\n")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_evaluate__by_force_leaves_no_file_of_earlier_results(ethbrake: Command, tmp_path: Path) -> None:
    folder, line = tmp_path / "new", ("evaluate", "--agents", "coast", "--episodes", "3", "--output")
    assert ethbrake(*line, folder, "--per-world", "csv", "--report").status == 0
    (folder / "mine.txt").write_text("mine")
    assert sorted(each.name for each in folder.iterdir()) == ["mine.txt", "report.html", "results.json", "worlds.csv"]
    check_refused(ethbrake(*line, folder), "results.json: already exists")
    assert ethbrake(*line, folder, "--force", "--per-world", "parquet").status == 0
    assert sorted(each.name for each in folder.iterdir()) == ["mine.txt", "results.json", "worlds.parquet"]


def test_target__that_cannot_be_replaced_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    check_target("watch --agents coast --output", tmp_path / "mine.png", monkeypatch, capsys)


def test_report__is_imported_where_no_package_of_an_extra_can_be() -> None:
    absent = "".join(f"sys.modules[{name!r}] = None\n" for name in sorted(_EXTRA_OF))
    assert ended(f"import sys\n{absent}from ethbrake_marl.extensions import report") == (0, "", "")


def test_film__of_an_extra_that_is_missing_says_the_line_that_installs_it(ethbrake: Command, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    missing = f"needs the package imageio_ffmpeg, which is not installed; install it with: {sys.executable} -m pip"
    check_refused(
        ethbrake("watch", "--agents", "coast", "--output", "film.mp4"), f"{missing} install 'ethbrake-marl[render]'\n"
    )
    assert list(Path().iterdir()) == []


def test_film__is_refused(refuse: Refuse) -> None:
    refuse("watch --agents nobody --output x.txt", "film with the file ending '.txt': the ending must be one of")


def test_film__that_is_there_is_not_replaced_unasked(refuse: Refuse) -> None:
    Path("film.gif").write_text("precious")
    told = "film.gif: already exists; give another name, or pass force=True (--force) to overwrite the file"
    refuse("watch --agents full_brake --output film.gif", told)
