"""Scenarios of recorded traffic: rows by hand, formats, hostile files, order of rows, table of the page."""

import re
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.recorded.formats import DataFormat
from ethbrake_marl.extensions.recorded.scenario import scenario_from_data
from tests.extensions.recorded.made import rows_of, scenario_of
from tests.fixtures.recordings import HIGHD, write_files, write_highd, write_ngsim, write_openacc


def track(frame: int, who: int, x: float, width: float, v: float, ahead: int, lane: int = 6) -> str:
    return f"{frame},{who},{x},8,{width},2,{v},0,0,0,0,0,0,0,0,0,{ahead},0,0,0,0,0,0,0,{lane}"


def recording(folder: Path, rows: list[str], directions: str = "2222222") -> Path:
    """A folder of highD with these rows, and the direction of each vehicle in turn."""
    meta = ["id,drivingDirection", *(f"{k},{direction}" for k, direction in enumerate(directions, 1))]
    return write_files(folder, {"01_tracks.csv": [HIGHD, *rows], "01_tracksMeta.csv": meta})


def test_rows__are_bumper_to_bumper_in_both_directions_and_no_vehicle_is_in_two(tmp_path: Path) -> None:
    rows = [track(1, k, 100 - 20 * k, 4, 30 - k, k - 1) for k in range(1, 6)]  # to the right, a queue of five
    rows += [track(1, 6, 50, 5, -20, 0, 3), track(1, 7, 65, 4, -21, 6, 3)]  # to the left
    rows += [track(2, k, 0, 4, 0, 0) for k in range(1, 6)]  # at no moment that is looked at
    rows += [track(26, 8, 100, 4, 20, 0), track(26, 9, 80, 4, 20, 8, 5), track(26, 10, 60, 4, -0.1, 9, 5)]  # no queue
    rows += [track(51, k, 500 - 20 * k, 4, 0, k - 1 if k > 11 else 0) for k in (11, 12, 13)]  # these stand
    made = scenario_from_data("mine", recording(tmp_path, rows, "2222211222222"), "highd")
    assert made.csv.splitlines()[1:] == [
        "16.0,16.0,29.0,28.0,27.0,01_tracks.csv: 1-2-3",
        "16.0,16.0,0.0,0.0,0.0,01_tracks.csv: 11-12-13",
    ]
    assert made.found[1:] == [
        "rows of 2 different trios of vehicles in 1 recording",
        "left out: 2 links to another lane, or of a vehicle that rolls backwards",
        "left out: 7 vehicles that were too few, or left over, at the end of a queue",
    ]
    made = scenario_from_data("mine", tmp_path, "highd", based_on=scenario_of(2, tmp_path))
    assert rows_of(made) == ["16.0,29.0,28.0", "16.0,27.0,26.0", "10.0,20.0,21.0", "16.0,0.0,0.0"]
    assert "must not be passed on" in made.text


def test_two_vehicles_behind_the_same_one__the_nearer_one_follows_it(tmp_path: Path) -> None:
    rows = [track(1, 1, 100, 4, 20, 0), track(1, 2, 60, 4, 21, 1), track(1, 3, 80, 4, 22, 1)]
    made = scenario_from_data("mine", recording(tmp_path, rows), "highd", based_on=scenario_of(2, tmp_path))
    assert rows_of(made) == ["16.0,20.0,22.0"]


def test_formats__same_queues_in_metres_and_in_feet_are_the_same_rows(tmp_path: Path) -> None:
    one, two = (
        np.loadtxt(rows_of(scenario_from_data("mine", write(tmp_path / of, 20), of)), delimiter=",")
        for of, write in (("highd", write_highd), ("ngsim", write_ngsim))
    )
    assert one.shape == (40, 5) and np.abs(one - two).max() < 0.02  # feet have been rounded


def test_platoon__gaps_are_as_recorded_and_a_blank_ends_a_queue(tmp_path: Path) -> None:
    folder = write_openacc(tmp_path / "openacc", 40)
    made = scenario_from_data("mine", folder, "openacc")
    assert made.found == [
        "30 chains of 3 vehicles, every 1 s; at one time, a vehicle is in at most one chain",
        "rows of 1 different trio of vehicles in 1 recording",
        "left out: 100 vehicles that were too few, or left over, at the end of a queue",
    ]
    cells = (folder / "platoon.csv").read_text().splitlines()[6].split(",")
    assert rows_of(made)[0] == ",".join(f"{float(cells[k])}" for k in (16, 17, 1, 4, 7))
    assert "CC BY 4.0" in made.text and len(rows_of(scenario_from_data("mine", folder, "openacc", every_s=0.1))) == 300
    (folder / "later.csv").write_text("Date,later\n" + (folder / "platoon.csv").read_text())
    assert scenario_from_data("mine", folder, "openacc").found[0].startswith("60 chains")


def scaled(text: str, lengths: float, speeds: float) -> str:
    head, *rows = (line.split(",") for line in text.splitlines())
    units = {2: lengths, 4: lengths, 6: speeds}
    changed = ([f"{float(cell) * units.get(k, 1):g}" for k, cell in enumerate(row)] for row in rows)
    return "\n".join(",".join(row) for row in (head, *changed)) + "\n"


REFUSED = {
    "a column is missing": (lambda t: t.replace("precedingId", "-"), "lacks columns .* highD have: precedingId"),
    "a column twice": (lambda t: t.replace("ttc", "width"), "column width: each name must occur only"),
    "text": (lambda t: t.replace("4.50", "long", 1), "line 2, column width: must be a finite number, but is 'long'"),
    "no length": (lambda t: t.replace("4.50", "0.00", 1), r"line 2, column width: 0.0 m: the length must be above 0"),
    "half an id": (lambda t: t.replace("\n1,1,", "\n1,1.5,", 1), r"column id: 1.5 must be a whole number, 0 or above"),
    "half written": (lambda t: t[:-20], "cannot be read .*Row #3120: Expected 25 columns, got 17"),
    "no rows": (lambda t: t.splitlines()[0] + "\n", "Empty CSV file"),
    "no UTF-8": (lambda t: "\udcff" + t, "cannot be read .*utf-8"),
    "twice": (lambda t: t + t.splitlines()[1] + "\n", "line 3122: vehicle 1 is recorded twice"),
    "nobody ahead": (lambda t: re.sub(r",1,0,0,0,0,0,0,0,3\n", ",77,0,0,0,0,0,0,0,3\n", t), "vehicle 77, which is not"),
    "feet": (lambda t: scaled(t, 2.8, 1.5), "long, but at least a third should be; lengths and speeds must be"),
    "half as fast": (lambda t: scaled(t, 1.0, 0.4), r"positions \(column x\) change by 2\.50 times the distance"),
    "too fast": (lambda t: t.replace("-27.879", "-127.879"), "127.879 m/s: the speed must be at most 75 m/s; highD is"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_hostile_file__is_refused_with_one_line(what: str, tmp_path: Path) -> None:
    file = write_highd(tmp_path / "a folder\nwith it", 40) / "01_tracks.csv"
    file.write_bytes(REFUSED[what][0](file.read_text()).encode("utf-8", "surrogateescape"))
    with pytest.raises(InvalidInput, match=REFUSED[what][1]) as told:
        scenario_from_data("mine", file.parent, "highd")
    assert "01_tracks.csv" in str(told.value) and "\n" not in str(told.value)


def test_overlaps__are_refused_but_few_of_noisy_data_are_left_out(tmp_path: Path) -> None:
    rows = [track(1, 1, 100, 4, 20, 0), track(1, 2, 97, 4, 20, 1)]
    with pytest.raises(InvalidInput, match=r"line 3: vehicle 2 overlaps vehicle 1 ahead by 1.00 m"):
        scenario_from_data("mine", recording(tmp_path / "h", rows), "highd")
    file = write_ngsim(tmp_path / "n", 20) / "trajectories.csv"
    text = file.read_text()
    head = next(line for line in text.splitlines() if line.startswith("4,"))  # of the second queue, twice
    file.write_text(re.sub(r"(?m)^(2,0,11,\d+,20),[^,]+", r"\1,99", text) + head + "\n")
    made = scenario_from_data("mine", file.parent, "ngsim")
    assert len(rows_of(made)) == 38 and "left out: 3 vehicles that overlap" in made.found[3]
    file.write_text(re.sub(r"(?m)^((?:2|5|8|11|14|17),\d+,11,\d+,20),[^,]+", r"\1,99", text))
    with pytest.raises(
        InvalidInput,
        match=r"line \d+: vehicle 2 is at a place that contradicts .*; 12 of 120 positions of vehicles are",
    ):
        scenario_from_data("mine", file.parent, "ngsim")


FILES = {
    "highd": (write_highd, "01_tracks.csv"),
    "ngsim": (write_ngsim, "trajectories.csv"),
    "openacc": (write_openacc, "platoon.csv"),
}


@pytest.mark.parametrize("format", FILES)
def test_order_of_rows__has_no_effect(format: DataFormat, tmp_path: Path) -> None:
    write, name = FILES[format]
    file = write(tmp_path, 40) / name
    in_order = scenario_from_data("mine", tmp_path, format)
    lines = file.read_text().splitlines()
    head = 6 if format == "openacc" else 1
    for order in (0, 1):
        rows = np.random.default_rng(order).permutation(lines[head:]).tolist()
        file.write_text("\n".join([*lines[:head], *rows, ""]))
        assert scenario_from_data("mine", tmp_path, format) == in_order


def test_command__writes_both_files_or_none_and_evaluates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_openacc(tmp_path / "platoon; rm *")
    write_files(tmp_path, {"taken.csv": []})
    command = ["scenario", "from-data", "platoon; rm *", "--format", "openacc", "--output"]
    drive = ["evaluate", "--scenario", "mine.yaml", "--agents", "full_brake", "--episodes", "20"]
    assert [run_command(each) for each in ([*command, "mine.yaml"], drive)] == [0, 0]
    before = sorted((path.name, path.read_bytes()) for path in tmp_path.glob("*.*"))
    bad = (["mine.yaml"], ["taken.yaml"], ["Not A Name.yaml"], ["x.csv"], ["new.yaml", "--every", "nan"])
    assert {run_command([*command, *each]) for each in bad} == {2}
    monkeypatch.setattr("ethbrake_marl.cli.scenario.Out.write", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_command([*command, "new.yaml"])
    assert sorted((path.name, path.read_bytes()) for path in tmp_path.glob("*.*")) == before
