"""Tables of trajectories by named columns, from CSV and Parquet; exiD; order of rows."""

import importlib
import sys
from math import cos, radians, sin
from pathlib import Path

import pytest

from ethbrake_marl.errors import InvalidInput, MissingExtra
from ethbrake_marl.extensions.recorded.scenario import FromData, scenario_from_data
from tests.extensions.recorded.made import rows_of
from tests.fixtures.recordings import write_files

COLUMNS = "time=t,vehicle=who,lane=lane,front=x,length=l,speed=v,units=m"
HEAD = ["who", "t", "lane", "x", "l", "v"]
# At 0 and 1 s. Lane a: cars c, b, a at 20 m/s, 20 m apart and 5 m long, then two lorries; lane b: one car.
CARS = [
    (who, t, lane, x + v * t, length, v)
    for t in (0.0, 0.5, 1.0)
    for who, lane, x, length, v in [
        ("a", "E1_0", 60.0, 5.0, 20.0),
        ("lorry 1", "E1_0", 20.0, 12.0, 18.0),
        ("c", "E1_0", 100.0, 4.0, 20.0),
        ("b", "E1_0", 80.0, 5.0, 20.0),
        ("other", "E1_1", 70.0, 4.5, 25.0),
    ]
]
ROWS = ["16.0,15.0,20.0,20.0,20.0"] * 2


def table(folder: Path, cars: list[tuple[object, ...]] = CARS, separator: str = ",", name: str = "a.csv") -> Path:
    return write_files(folder, {name: [separator.join(map(str, row)) for row in [HEAD, *cars]]})


def made_of(folder: Path, columns: str = COLUMNS, **options: object) -> FromData:
    return scenario_from_data("mine", folder, "table", columns=columns, **options)  # type: ignore[arg-type]


def scaled(lengths: float = 1.0, speeds: float = 1.0, times: float = 1.0) -> list[tuple[object, ...]]:
    return [(w, t * times, lane, x * lengths, long * lengths, v * speeds) for w, t, lane, x, long, v in CARS]


def test_leaders__are_the_next_in_the_lane_at_that_time(tmp_path: Path) -> None:
    made = made_of(table(tmp_path))
    assert rows_of(made) == ROWS and made.csv.endswith("a.csv: c-b-a\n")
    assert "left out: 4 vehicles that were too few, or left over, at the end of a queue" in made.found
    assert rows_of(made_of(table(tmp_path), every_s=0.5)) == [ROWS[0]] * 3
    assert "licence is unknown" in made.text


@pytest.mark.parametrize(
    ("units", "time", "cars"),
    [
        ("ft", "t", scaled(1 / 0.3048, 1 / 0.3048)),
        ("km/h", "t", scaled(1.0, 3.6)),
        ("m", "t/1000", scaled(times=1000.0)),
        ("m", "t/25", scaled(times=25.0)),
    ],
)
def test_units__of_lengths_speeds_and_time(
    units: str, time: str, cars: list[tuple[object, ...]], tmp_path: Path
) -> None:
    columns = COLUMNS.replace("time=t", f"time={time}").replace("units=m", f"units={units}")
    assert rows_of(made_of(table(tmp_path, cars), columns)) == ROWS


@pytest.mark.parametrize("separator", [";", "\t"])
def test_separator__is_that_of_the_header(separator: str, tmp_path: Path) -> None:
    assert rows_of(made_of(table(tmp_path, separator=separator))) == ROWS


def test_times_of_30_hertz__may_be_rounded(tmp_path: Path) -> None:
    cars = [
        (*car[:1], round(k / 30, 3), *car[2:3], car[3] + car[5] * k / 30, *car[4:])
        for car in CARS[:5]
        for k in range(61)
    ]
    assert rows_of(made_of(table(tmp_path, cars))) == [ROWS[0]] * 3
    assert rows_of(made_of(table(tmp_path, cars), every_s=0.1)) == [ROWS[0]] * 21
    with pytest.raises(InvalidInput, match=r"every = 0.02 s: .* must be at least 0.033 s, the time between recorded"):
        made_of(table(tmp_path, cars), every_s=0.02)


def test_missing_package__is_named_with_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("ethbrake_marl.extensions.recorded.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtra, match=r"needs the package pyarrow.*pip install 'ethbrake-marl\[data\]'"):
        importlib.import_module("ethbrake_marl.extensions.recorded.scenario")


def one_more(*car: object) -> list[tuple[object, ...]]:
    return [*CARS, car]


WRONG = {
    "direction": (
        [(*car[:3], -car[3], *car[4:]) for car in CARS],
        "lane E1_0, positions .column x. change by -1.00 times the distance",
    ),
    "backwards": (
        [(*car[:3], -car[3], car[4], -car[5]) for car in CARS],
        "in lane E1_0, positions .column x. change by 1.00 times .*, and the speeds are negative; positions must",
    ),
    "feet": (
        [(*car[:3], car[3] / 0.3048, *car[4:]) for car in CARS],
        r"change by 3.28 times the distance that the speeds imply; .* both columns must be in m and m/s",
    ),
    "twice": (one_more(*CARS[2]), "line 17: vehicle c is recorded twice for this time"),
    "overlap": (one_more("d", 1.0, "E1_0", 119.0, 5.0, 20.0), "line 17: vehicle d overlaps vehicle c ahead by 3.00 m"),
    "no name": (one_more("", 1.0, "E1_0", 150.0, 5.0, 20.0), "line 17, column who: .*must be a name"),
    "no number": (
        one_more("d", 1.0, "E1_0", 150.0, "5 m", 20.0),
        "line 17, column l: must be a finite number, but is '5 m'",
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_table__is_refused_with_what_would_be_right(what: str, tmp_path: Path) -> None:
    cars, right = WRONG[what]
    with pytest.raises(InvalidInput, match=right):
        made_of(table(tmp_path, cars))


@pytest.mark.parametrize(
    ("columns", "right"),
    [
        (
            "",
            "must be time=...,vehicle=...,lane=...,front=...,length=...,speed=...,units=m|ft|km/h, with each key once",
        ),
        (COLUMNS.removesuffix(",units=m"), "units=m|ft|km/h, with each key once"),
        (COLUMNS.replace("x", ""), "with each key once"),
        (COLUMNS.replace("=m", "=mph"), "columns: units = 'mph': must be one of m, ft, km/h"),
        (COLUMNS.replace("=t,", "=t/0,"), "columns: time = .../0: the number after / must be"),
        (COLUMNS.replace("=who", "=id"), "a.csv: lacks columns that files of the table have: id"),
    ],
)
def test_wrong_columns__are_refused(columns: str, right: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput) as told:
        made_of(table(tmp_path), columns)
    assert right in str(told.value)
    with pytest.raises(InvalidInput, match="the columns of highD are fixed; leave out --columns"):
        scenario_from_data("mine", tmp_path, "highd", columns=COLUMNS)


EXID = (
    "recordingId,trackId,frame,trackLifetime,xCenter,yCenter,heading,width,length,xVelocity,yVelocity,xAcceleration,"
    "yAcceleration,lonVelocity,latVelocity,lonAcceleration,latAcceleration,traveledDistance,latLaneCenterOffset,"
    "laneletId,laneChange,lonLaneletPos,leadDHW,leadTHW,leadTTC,leadId,rearId"
)


def exid(folder: Path, degrees: float, ahead: int = 4) -> Path:
    """A car, a lorry 30 m behind its centre, a car 25 m behind that, all to one direction; in two lanelets."""
    rows = []
    for who, back, length, lead, lanelet in (
        (0, 0.0, 4.0, -1, "1574"),
        (ahead, 30.0, 12.0, 0, "1574;1573"),
        (7, 55.0, 5.0, ahead, "1573"),
    ):
        x, y = 100.0 - back * cos(radians(degrees)), -50.0 - back * sin(radians(degrees))
        rows.append(
            f"3,{who},0,0,{x:.4f},{y:.4f},{degrees},1.9,{length},0,0,0,0,{30 - who},0,0,0,9,0.1;0.2,{lanelet},0,1;2,"
            f"9,1,1,{lead},-1"
        )
    return write_files(folder, {"03_tracks.csv": [EXID, *rows], "03_tracksMeta.csv": ["recordingId,trackId"]})


@pytest.mark.parametrize("degrees", [0.0, 137.5])
def test_exid__has_gaps_along_the_direction_of_travel(degrees: float, tmp_path: Path) -> None:
    made = scenario_from_data("mine", exid(tmp_path, degrees), "exid")
    assert made.csv.splitlines()[1:] == ["22.0,16.5,30.0,26.0,23.0,03_tracks.csv: 0-4-7"]  # 30 - 2 - 6 and 25 - 6 - 2.5
    assert "must not be passed on" in made.text


def test_order_of_rows_and_vehicles__has_no_effect(tmp_path: Path) -> None:
    assert made_of(table(tmp_path, CARS[::-1])) == made_of(table(tmp_path))
    numbered = [(10 - k % 5, *row[1:]) for k, row in enumerate(CARS)]
    made = made_of(table(tmp_path, numbered), based_on="realistic-pair")
    assert made == made_of(table(tmp_path, sorted(numbered)), based_on="realistic-pair")
    assert made.csv.count("a.csv: 8-7\n") == 2


def test_frames_of_video__keep_their_rate_and_names_of_columns_are_literal(tmp_path: Path) -> None:
    # 29.97 pictures in a second: 600 of them are 20.02 s, and a second is 30 pictures.
    cars = [
        (who, frame, 1, x + 20.0 * frame / 29.97, 5.0, 20.0) for frame in range(601) for who, x in (("a", 20), ("b", 0))
    ]
    lines = [",".join(map(str, row)) for row in [["veh#", *HEAD[1:]], *cars]]
    folder = write_files(tmp_path, {"a.csv": lines})
    columns = "time=t/29.97,vehicle=veh#,lane=lane,front=x,length=l,speed=v,units=m"
    made = made_of(folder, columns, based_on="realistic-pair")
    assert rows_of(made) == ["15.0,20.0,20.0"] * 21


def platoon(**marked: float) -> list[tuple[object, ...]]:
    """Twenty cars of 5 m at 20 m/s, 25 m apart, for 40 s; ``marked``: the place of car c10 at some times."""
    cars: list[tuple[object, ...]] = []
    for k in range(20):
        for t in range(41):
            place = 600.0 - 25.0 * k + 20.0 * t
            cars.append((f"c{k}", float(t), "m", marked.get(f"t{t}", place) if k == 10 else place, 5.0, 20.0))
    return cars


MARKS = (0.0, -1.0, -999.0, -1073741824.0, 9999.0)


@pytest.mark.parametrize("mark", MARKS)
@pytest.mark.parametrize("times", [(12, 13), (0, 1), (39, 40), (7,)], ids=str)
def test_mark_of_a_missing_place__is_a_fault_of_its_vehicle(
    mark: float, times: tuple[int, ...], tmp_path: Path
) -> None:
    made = made_of(table(tmp_path, platoon(**{f"t{t}": mark for t in times})), based_on="realistic-pair")
    assert {row.split(",")[0] for row in rows_of(made)} == {"20.0"} and len(rows_of(made)) == 10 * (41 - len(times))
    assert any(f"left out: {len(times)} vehicles that overlap, jump, are recorded" in line for line in made.found)
    assert f"left out: {19 * len(times)} links in a lane where the place of a vehicle" in "".join(made.found)


@pytest.mark.parametrize("mark", MARKS)
def test_marks_of_missing_places__are_refused_where_they_are_many(mark: float, tmp_path: Path) -> None:
    """Each vehicle by itself: jumps of one lane cancel each other."""
    marks = {f"t{t}": mark for t in range(10, 20)}
    with pytest.raises(InvalidInput, match=r"vehicle c10 is at a place that contradicts .*; 10 of 820 positions"):
        made_of(table(tmp_path, platoon(**marks)), based_on="realistic-pair")
    few = [(who, t, lane, mark if who == "b" and t == 0.5 else x, *more) for who, t, lane, x, *more in CARS]
    with pytest.raises(InvalidInput, match="vehicle b is at a place that contradicts"):
        made_of(table(tmp_path, few), every_s=0.5)


def test_numbers_that_are_equal__are_one_lane_and_one_vehicle(tmp_path: Path) -> None:
    def named(who: object, lane: object) -> list[tuple[object, ...]]:
        lanes = {"E1_0": "1", "E1_1": "2"}
        return [(who if w == "b" else w, t, lane if w == "b" else lanes[str(p)], *rest) for w, t, p, *rest in CARS]

    for who, lane in (("b", "1"), ("b", "1.0"), ("b", "01"), ("b", "1."), ("b", "+1.00")):
        assert rows_of(made_of(table(tmp_path, named(who, lane)))) == ROWS
    mixed = [(7 if t < 0.5 else "7.0", t, *rest) if w == "b" else (w, t, *rest) for w, t, *rest in CARS]
    made = made_of(table(tmp_path, mixed), every_s=0.5)
    assert rows_of(made) == [ROWS[0]] * 3 and made.csv.count("a.csv: c-7-a\n") == 3
    for lane in ("2", "1.5", "1e", "lane 1", "9007199254740993"):
        other = [(w, t, "9007199254740992" if lane[0] == "9" and p == "E1_0" else p, *rest) for w, t, p, *rest in CARS]
        cars = [(w, t, lane if w == "b" else p, *rest) for w, t, p, *rest in other]
        assert made_of(table(tmp_path, cars), based_on="realistic-pair").csv.count("c-b") == 0


@pytest.mark.parametrize("column", ["who", "lane"])
@pytest.mark.parametrize("mark", ["", "nan", "NaN", "None", "null"])
def test_name__that_is_missing_is_refused(column: str, mark: str, tmp_path: Path) -> None:
    at = HEAD.index(column)
    cars = [tuple(mark if c == at and k == 3 else cell for c, cell in enumerate(car)) for k, car in enumerate(CARS)]
    with pytest.raises(InvalidInput, match=rf"line 5, column {column}: .*must be a name"):
        made_of(table(tmp_path, cars))
