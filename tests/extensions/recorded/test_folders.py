"""Folders as they are downloaded: subfolders are searched, other files skipped, bad and hostile ones refused."""

import json
import os
from pathlib import Path

import pytest

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.recorded.scenario import scenario_from_data
from tests.extensions.recorded.made import openacc, rows_of

COLUMNS, ROW = "Speed1,Speed2,Speed3,IVS1,IVS2", "20,20,20,15,16"


def good(folder: Path, name: str = "a.csv") -> Path:
    """A recording with one row, of that name; its heading differs from that of every other."""
    folder.mkdir(parents=True, exist_ok=True)
    return openacc(folder, COLUMNS, ROW, name=name, heading=[f"Date,{(folder.name + name).encode().hex()}"])


def bad(folder: Path, name: str) -> Path:
    file = good(folder, name) / name
    file.write_text(file.read_text().replace("0,20", "0,fast", 1))
    return folder


def test_folder__is_searched_below_and_what_is_no_recording_is_skipped(tmp_path: Path) -> None:
    good(tmp_path / "Casale", "part1.csv")
    good(tmp_path / "JRC" / "low speed", "part1.csv")
    good(tmp_path / ".hidden")
    (tmp_path / "Casale" / "Veh_specifications.csv").write_text("Vehicle,Length\nA,4.5\n")
    (tmp_path / "trip.csv").write_text("Time,Speed,Engine Speed,Gear\n0,20,3000,4\n")
    (tmp_path / "notes.txt").write_text("Speed1")
    (tmp_path / "empty.csv").touch()
    made = scenario_from_data("mine", tmp_path, "openacc")
    recordings = [line.rpartition(",")[2] for line in made.csv.splitlines()[1:]]
    assert recordings == ["Casale/part1.csv: 1-2-3", "JRC/low speed/part1.csv: 1-2-3"]
    assert made.found[1:] == [
        "rows of 2 different trios of vehicles in 2 recordings",
        "skipped, because they are no recordings or copies: Casale/Veh_specifications.csv, empty.csv, trip.csv",
    ]
    assert "; rows of 2 different trios of vehicles in 2 recordings; skipped" in made.text
    assert rows_of(scenario_from_data("mine", tmp_path / "Casale" / "part1.csv", "openacc")) == rows_of(made)[:1]


def test_progress__counts_the_files_that_were_read(empty_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good(empty_folder, "a.csv")
    line = ["scenario", "from-data", ".", "--format", "openacc", "--force", "--output", "mine.yaml"]
    assert run_command(line) == 0 and "files: 1 of 1\n" in capsys.readouterr().err
    good(empty_folder, "b.csv")
    (empty_folder / "mine.csv").unlink()
    seen: list[tuple[str, int, int]] = []
    scenario_from_data("mine", empty_folder, "openacc", progress=lambda *report: seen.append(report))
    assert seen == [("files", 1, 2), ("files", 2, 2)]


def test_refused_files__are_all_listed_and_add_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = bad(bad(good(Path("data")), "b.csv"), "c.csv")
    late = [ROW] * 9 + ["20,20,20,-15,16"] * 9  # refused behind its last row
    openacc(good(folder / "late"), COLUMNS, *late)
    made = scenario_from_data("mine", folder, "openacc")
    assert len(rows_of(made)) == 1 and made.found[-1] == "refused: 3 files"
    wrong = "data/late/a.csv, line 11: vehicle 2 overlaps vehicle 1 ahead by 15.00 m; 9 of 54 positions of vehicles"
    starts = [f"data/{name}.csv, line 3, column Speed1: must be a finite number, but is 'fast'" for name in "bc"] + [
        wrong
    ]
    assert [text.startswith(start) for text, start in zip(made.refused, starts, strict=True)] == [True] * 3
    command = ["scenario", "from-data", "data", "--format", "openacc", "--output", "mine.yaml"]
    assert run_command([*command, "--json"]) == 0
    out = capsys.readouterr()
    assert json.loads(out.out)["refused"] == made.refused and out.err.count("refused: data/") == 3
    Path("data/a.csv").unlink()
    with pytest.raises(InvalidInput, match=r"data: 3 files refused: data/b.csv, line 3") as told:
        scenario_from_data("mine", folder, "openacc")
    assert [start in str(told.value) for start in starts] == [True] * 3


def test_folder_without_recordings__says_what_each_file_lacks(tmp_path: Path) -> None:
    (tmp_path / "Veh.csv").write_text("Vehicle,Length\n")
    with pytest.raises(
        InvalidInput,
        match=r"contains no recording of OpenACC: .*Veh.csv: lacks columns .*: Time, Speed<number>, IVS<number>",
    ):
        scenario_from_data("mine", tmp_path, "openacc")
    with pytest.raises(InvalidInput, match=r"must be a folder with files of exiD; their names match \*_tracks.csv"):
        scenario_from_data("mine", tmp_path, "exid")
    with pytest.raises(InvalidInput, match="must be a folder with"):
        scenario_from_data("mine", tmp_path / "nowhere", "exid")


def test_hostile_folder__yields_the_good_files_and_one_line_for_each_other(tmp_path: Path) -> None:
    folder = good(tmp_path / 'data "x"\n; rm *', "ok.csv")
    good(folder, 'it\'s "a",\nnew\tone.csv')
    (folder / "other name.csv").symlink_to("ok.csv")
    (folder / "nowhere.csv").symlink_to("gone.csv")
    (folder / "round.csv").symlink_to("round.csv")
    (folder / "up").symlink_to("..")
    os.mkfifo(folder / "pipe.csv")
    (folder / "folder.csv").mkdir()
    (folder / "binary.csv").write_bytes(bytes(range(256)) * 100)
    (folder / "zeros.csv").write_bytes(bytes(1000))
    (folder / "huge.csv").write_text(f"Time,{COLUMNS}\n0,{'2' * 100_000}\n")
    (folder / "cut.csv").write_bytes(f"Time,{COLUMNS}\n0,{ROW}\n1,20,20".encode() + bytes(658))
    (folder / "sub").mkdir()
    made = scenario_from_data("mine", folder, "openacc")
    assert len(rows_of(made)) == 2 and r'"it\'s ""a"",\nnew\tone.csv: 1-2-3"'.replace(r"\'", "'") in made.csv
    assert made.skipped == ["other name.csv", "zeros.csv"]
    said = dict.fromkeys(made.refused)
    rights = (
        "binary.csv: cannot be read ('utf-8'",
        "cut.csv: cannot be read (CSV parse error: Row #2: Expected 6 columns, got 3",
        "huge.csv: cannot be read (CSV parse error: Row #1: Expected 6 columns, got 2",
        "nowhere.csv: the file does not exist",
        "pipe.csv: is a device, a pipe or a socket",
        "round.csv: cannot be read (Too many levels",
    )
    assert [right in text for right, text in zip(rights, said, strict=True)] == [True] * 6


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_file_and_folder__are_refused(tmp_path: Path) -> None:
    good(tmp_path)
    (good(tmp_path, "no.csv") / "no.csv").chmod(0)
    good(tmp_path / "closed").chmod(0)
    made = scenario_from_data("mine", tmp_path, "openacc")
    (tmp_path / "closed").chmod(0o700)
    assert [text.count("Permission denied") for text in made.refused] == [1, 1]


def test_copy_of_a_recording__counts_once(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "copy.csv").write_bytes((good(tmp_path / "a") / "a.csv").read_bytes())
    good(tmp_path / "c")
    made = scenario_from_data("mine", tmp_path, "openacc")
    assert made.skipped == ["b/copy.csv"] and "in 2 recordings" in made.found[1]


def test_thinning__keeps_rows_of_every_trio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Two pairs at each of 100 moments, in the same order: every second row would be the same pair.
    openacc(tmp_path, "Speed1,Speed2,Speed3,Speed4,IVS1,IVS3", *["20,20,20,20,15,16"] * 100)
    monkeypatch.setattr("ethbrake_marl.extensions.recorded.scenario.MOST_NUMBERS", 400)
    made = scenario_from_data("mine", tmp_path, "openacc", based_on="realistic-pair")
    rows = [line.rpartition(": ")[2] for line in made.csv.splitlines()[1:]]
    assert rows.count("1-2") == rows.count("3-4") == 50
