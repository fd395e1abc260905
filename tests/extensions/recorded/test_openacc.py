"""OpenACC by the numbers of its cars: holes, headings, gaps at or below 0, chains of any length."""

from pathlib import Path

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.recorded.scenario import scenario_from_data
from tests.extensions.recorded.made import openacc, rows_of, scenario_of

HEADING = ["Date,26,02,2019", "Vehicle_order,A,B,C,D,E", "Number_of_vehicles,5", "ACC,1", "Distance_setting,shortest"]


@pytest.mark.parametrize(
    ("columns", "values", "vehicles", "rows"),
    [
        ("Speed2,Speed3,Speed4,IVS2,IVS3", "20,20,20,15,16", 3, ["15.0,16.0,20.0,20.0,20.0,a.csv: 2-3-4"]),
        ("Speed1,Speed2,Speed4,Speed6,IVS1", "21,22,24,26,11", 2, ["11.0,21.0,22.0,a.csv: 1-2"]),
        (
            "Speed1,Speed2,Speed3,Speed5,Speed6,Speed7,IVS1,IVS2,IVS5,IVS6",
            "21,22,23,25,26,27,11,12,15,16",
            3,
            ["11.0,12.0,21.0,22.0,23.0,a.csv: 1-2-3", "15.0,16.0,25.0,26.0,27.0,a.csv: 5-6-7"],
        ),
        (
            "IVS3,Speed4,IVS1,Speed1,Speed3,Speed2,IVS2",
            "13,24,11,21,23,22,12",
            4,
            ["11.0,12.0,13.0,21.0,22.0,23.0,24.0,a.csv: 1-2-3-4"],
        ),
        (
            ",".join([*(f"Speed{k}" for k in range(7, 12)), *(f"IVS{k}" for k in range(7, 11))]),
            "27,28,29,30,31,17,18,19,20",
            5,
            ["17.0,18.0,19.0,20.0,27.0,28.0,29.0,30.0,31.0,a.csv: 7-8-9-10-11"],
        ),
        ("Speed1,Speed2,Speed3,IVS1,IVS2", "20,20,20,,16", 2, ["16.0,20.0,20.0,a.csv: 2-3"]),
        ("Speed1,Speed3,Speed4,IVS1,IVS2,IVS3", "21,23,24,11,12,13", 2, ["13.0,23.0,24.0,a.csv: 3-4"]),
    ],
)  # fmt: skip
def test_numbers__say_who_follows_whom(
    columns: str, values: str, vehicles: int, rows: list[str], tmp_path: Path
) -> None:
    base = scenario_of(vehicles, tmp_path)
    made = scenario_from_data("mine", openacc(tmp_path, columns, values), "openacc", based_on=base)
    assert made.csv.splitlines()[1:] == rows


@pytest.mark.parametrize(("vehicles", "found"), [(2, 1), (3, 0)])
def test_pair__is_no_chain_of_three_and_the_message_names_a_scenario_for_pairs(
    vehicles: int, found: int, tmp_path: Path
) -> None:
    folder = openacc(tmp_path, "Speed1,Speed2,Speed4,Speed6,IVS1", "21,22,24,26,11")
    if found:
        assert len(rows_of(scenario_from_data("mine", folder, "openacc", based_on="realistic-pair"))) == 1
    else:
        right = r"no lane in which 3 .*; the longest queue has 2: .*, for instance realistic-pair with 2"
        with pytest.raises(InvalidInput, match=right):
            scenario_from_data("mine", folder, "openacc")


def test_no_link__is_said_with_the_columns(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"no column is the gap between two cars; .*Speed1, Speed2 and IVS1"):
        scenario_from_data("mine", openacc(tmp_path, "Speed1,Speed3,IVS1", "20,20,15"), "openacc")
    with pytest.raises(InvalidInput, match="lacks columns that files of OpenACC have: IVS<number>"):
        scenario_from_data("mine", openacc(tmp_path, "Speed1,Speed2,Lat1", "20,20,15"), "openacc")


@pytest.mark.parametrize("lines", [0, 10, 11])
def test_heading__has_up_to_ten_lines(lines: int, tmp_path: Path) -> None:
    folder = openacc(tmp_path, "Speed2,Speed3,Speed4,IVS2,IVS3", "20,20,20,15,16", heading=(HEADING * 3)[:lines])
    if lines <= 10:
        assert rows_of(scenario_from_data("mine", folder, "openacc")) == ["15.0,16.0,20.0,20.0,20.0"]
    else:
        with pytest.raises(
            InvalidInput,
            match=r"contains no recording of OpenACC: .*a.csv: lacks columns .*: Time, Speed<number>, IVS<number>",
        ):
            scenario_from_data("mine", folder, "openacc")


def test_gap_of_0_or_less__of_a_standing_car_is_left_out_of_moving_ones_one_in_a_hundred_may_be(tmp_path: Path) -> None:
    columns, good = "Speed1,Speed2,Speed3,Speed4,IVS1,IVS2,IVS3", "20,20,20,20,15,16,17"
    rows = [good] * 4 + ["0.49,0.4,0.3,0.2,-0.2,5,6"] + ["3,0.2,20,20,0,16,17"]
    made = scenario_from_data("mine", openacc(tmp_path, columns, *rows), "openacc")
    assert rows_of(made)[-2:] == ["5.0,6.0,0.4,0.3,0.2", "16.0,17.0,0.2,20.0,20.0"]
    assert "left out: 2 links of standing cars whose gap was recorded as 0 or less" in made.found
    few, many = ["20,20,20,20,-1,16,17"] * 1, ["20,0.5,20,20,-1,16,17"] * 2
    made = scenario_from_data("mine", openacc(tmp_path, columns, *[good] * 24, *few), "openacc")  # 1 of 100 vehicles
    assert (
        "left out: 1 vehicles that overlap, jump, are recorded twice, or follow one that is not recorded" in made.found
    )
    with pytest.raises(
        InvalidInput,
        match=r"line 25: vehicle 2 overlaps vehicle 1 ahead by 1\.00 m; 2 of 100 positions of vehicles are faulty",
    ):
        scenario_from_data("mine", openacc(tmp_path, columns, *[good] * 23, *many), "openacc")


@pytest.mark.parametrize(
    ("gap", "right"), [("100000", "at most 10000"), ("-1e300", "at most"), ("inf", "finite number")]
)
def test_gap__beyond_what_a_scenario_may_have_refuses_its_file_only(gap: str, right: str, tmp_path: Path) -> None:
    openacc(tmp_path, "Speed1,Speed2,IVS1", "20,20,15")
    openacc(tmp_path, "Speed1,Speed2,IVS1", f"20,20,{gap}", name="b.csv")
    made = scenario_from_data("mine", tmp_path, "openacc", based_on="realistic-pair")
    assert rows_of(made) == ["15.0,20.0,20.0"]
    (text,) = made.refused
    assert "b.csv, line 2, column IVS1: " in text and right in text


def test_short_line__is_refused_and_no_unmeasured_gap(tmp_path: Path) -> None:
    folder = openacc(tmp_path, "Speed1,Speed2,Speed3,IVS1,IVS2", "20,20,20,15,16", "20,20,20,15")
    with pytest.raises(InvalidInput, match=r"a.csv: cannot be read .*Row #2: Expected 6 columns, got 5"):
        scenario_from_data("mine", folder, "openacc")
