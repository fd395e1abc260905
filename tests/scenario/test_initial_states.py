from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario import load_scenario

PAPER = load_scenario("paper-random")
HEADER = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps"


def write(folder: Path, text: str) -> Path:
    path = folder / "worlds.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_csv__gives_the_state_and_the_scenario_the_rest(tmp_path: Path):
    worlds = PAPER.read_worlds(write(tmp_path, f"{HEADER}\n10,8,20,18,20\n5,9,22,1.8e1, 20\n"))
    assert worlds.gaps_m.tolist() == [[10.0, 8.0], [5.0, 9.0]]
    assert worlds.speeds_mps.tolist() == [[20.0, 18.0, 20.0], [22.0, 18.0, 20.0]]
    assert worlds.vehicles.latency_s.tolist() == [[0.0, 0.5, 0.8]] * 2
    assert worlds.vehicles.braking_capacity_mps2.tolist() == [[6.0, 7.0, 6.0]] * 2
    assert worlds.vehicles.restitution.tolist() == [0.1, 0.1]


def test_csv__optional_columns_in_any_order_with_a_byte_order_mark(tmp_path: Path):
    text = f"\ufefflatency_2_s,restitution,mass_3_t,speed_limit_1_mps,{HEADER}\n0.2,0.3,6,30,10,8,20,18,20\n"
    worlds = PAPER.read_worlds(write(tmp_path, text))
    assert worlds.vehicles.latency_s.tolist() == [[0.0, 0.2, 0.8]]
    assert worlds.vehicles.restitution.tolist() == [0.3]
    assert worlds.vehicles.mass_t.tolist() == [[4.5, 5.5, 6.0]]
    assert worlds.vehicles.speed_limit_mps.tolist() == [[30.0, 40.0, 40.0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER.replace("p_1_m", "p_1_km") + "\n1,2,3,4,5\n", "unknown column 'gap_1_km'; did you mean gap_1_m"),
        (HEADER + ",latency_2_ms\n1,2,3,4,5,6\n", "unknown column 'latency_2_ms'; did you mean latency_2_s (seconds)?"),
        (HEADER + ",speed_4_mps\n1,2,3,4,5,6\n", "line 1: unknown column 'speed_4_mps'; did you mean speed_"),
        (HEADER + ",gap_1_m\n1,2,3,4,5,6\n", "line 1: column 'gap_1_m' is given twice"),
        ("gap_1_m,speed_1_mps,speed_2_mps,speed_3_mps\n1,2,3,4\n", "column 'gap_2_m' is missing; 3 vehicles need it"),
        (HEADER.replace(",", ";") + "\n1;2;3;4;5\n", "columns are separated by commas"),
        (HEADER + "\n10,8,20,18\n", "line 2: 4 values, but the header has 5 columns"),
        (HEADER + "\n10,8,20,18,20\n\n10,8,20,18,20\n", "line 3: 0 values"),
        (HEADER + "\n10,8,20,18,20\n10,8,fast,18,20\n", "line 3, column speed_1_mps: 'fast' is not a number"),
        (HEADER + "\n10,8,nan,18,20\n", "line 2, column speed_1_mps: 'nan' is not a number"),
        (HEADER + "\n10,8,1_0,18,20\n", "'1_0' is not a number"),
        (HEADER + "\n10,,20,18,20\n", "line 2, column gap_2_m: '' is not a number"),
        (HEADER + "\n10,8,20,18,20\n10,-8,20,18,20\n", "line 3, column gap_2_m = -8: must be finite and in [0, 10000]"),
        (HEADER + "\n10,8,1e999,18,20\n", "line 2, column speed_1_mps = inf: must be finite and in [0, 200]"),
        (HEADER + "\n10,8,20,18,41\n", "line 2, column speed_3_mps = 41: must not be above speed_limit_mps of vehicle"),
        (HEADER + ",mass_1_t\n10,8,20,18,20,0\n", "line 2, column mass_1_t = 0: must be finite and in (0, 1000]"),
        (HEADER + ",latency_3_s\n10,8,20,18,20,8\n", "line 2, column latency_3_s = 8: must be below the scenario's ho"),
        (HEADER + ",restitution\n10,8,20,18,20,1.1\n", "line 2, column restitution = 1.1"),
        (HEADER + '\n"10,8,20,18,20\n', "cannot be read as CSV"),
        (HEADER + '\n"1\n0",8,20,18,20\n', "line 2, column gap_1_m: '1\\n0' is not a number"),
        (HEADER + '\n"10\n",8,20,18,20\n10,-8,20,18,20\n', "line 4, column gap_2_m = -8"),
        (HEADER + '\n"10\n",8,20,18,20\n10,8\n', "line 4: 2 values"),
        (
            HEADER + ",speed_limit_1_mps\n10,8,20,18,20,20\n10,8,35,18,20,30\n",
            "line 3, column speed_1_mps = 35: must not be above speed_limit_mps of vehicle_1, 30 m/s",
        ),
        (HEADER + "\n", "has a header but no rows"),
        ("", "line 1: must name the columns"),
    ],
)  # fmt: skip
def test_csv__defects_name_file_line_and_column(tmp_path: Path, text: str, message: str):
    path = write(tmp_path, text)
    with pytest.raises(InvalidInput) as caught:
        PAPER.read_worlds(path)
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)


@pytest.mark.parametrize("end", ["", "\n", "\n\n", "\r\n\r\n"])
def test_csv__blank_lines_at_the_end_are_nothing(tmp_path: Path, end: str):
    assert PAPER.read_worlds(write(tmp_path, f"{HEADER}\n10,8,20,18,20{end}")).n == 1


def test_csv__beyond_the_limit_is_not_read_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write(tmp_path, f"{HEADER}\n10,8,20,18,20\n")
    monkeypatch.setattr("ethbrake_marl.scenario.sampling.SIZE_LIMIT", path.stat().st_size)
    assert PAPER.read_worlds(path).n == 1
    larger = write(tmp_path, f"{HEADER}\n10,8,20,18,20\n\n")
    for file, reason in ((larger, "larger than 0 KiB, the limit for such a file"), (Path("/dev/zero"), "a device")):
        with pytest.raises(InvalidInput, match=reason):
            PAPER.read_worlds(file)


def test_csv__of_a_hundred_thousand_columns_is_refused_at_once(tmp_path: Path):
    spent = []
    for columns in (10_000, 100_000):
        path = write(tmp_path, ",".join(["gap_1_m"] * columns) + "\n1\n")
        began = time.process_time()
        with pytest.raises(InvalidInput, match="column 'gap_1_m' is given twice"):
            PAPER.read_worlds(path)
        spent.append(time.process_time() - began)
    assert spent[1] < 40.0 * spent[0]  # a hundred times when every column was counted anew


def test_csv__that_is_missing_or_not_text(tmp_path: Path):
    with pytest.raises(InvalidInput, match=r"none\.csv: no such file"):
        PAPER.read_worlds(tmp_path / "none.csv")
    path = tmp_path / "bytes.csv"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InvalidInput, match="cannot be read as CSV"):
        PAPER.read_worlds(path)


def test_csv__a_random_quantity_must_be_a_column(tmp_path: Path):
    path = write(tmp_path, f"{HEADER}\n10,8,20,18,20\n")
    random = PAPER.replace(mass_t=[4.5, {"uniform": [5, 6]}, 5.9])
    with pytest.raises(InvalidInput, match=r"column mass_2_t is missing, and random in scenario 'paper-random'"):
        random.read_worlds(path)
    worlds = random.read_worlds(write(tmp_path, f"{HEADER},mass_2_t\n10,8,20,18,20,5.2\n"))
    assert worlds.vehicles.mass_t.tolist() == [[4.5, 5.2, 5.9]]


def test_table__columns_of_a_line_of_two():
    two = PAPER.replace(
        vehicles=2, braking_capacity_mps2=6, driving_capacity_mps2=6, mass_t=5, latency_s=0,
        roles={"vehicle_2": "learner"},
    )  # fmt: skip
    assert list(two.table_columns)[:4] == ["gap_1_m", "speed_1_mps", "speed_2_mps", "braking_capacity_1_mps2"]
    assert len(two.table_columns) == 1 + 6 * 2 + 1


def test_table__equals_the_same_worlds_sampled():
    sampled = PAPER.sample(50, 3).worlds
    columns = {f"gap_{i + 1}_m": sampled.gaps_m[:, i] for i in range(2)}
    columns |= {f"speed_{i + 1}_mps": sampled.speeds_mps[:, i] for i in range(3)}
    worlds = PAPER.worlds_from_table(columns)
    assert np.array_equal(worlds.gaps_m, sampled.gaps_m)
    assert np.array_equal(worlds.speeds_mps, sampled.speeds_mps)
    assert np.array_equal(worlds.vehicles.mass_t, sampled.vehicles.mass_t)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gap_1_m": [1, 2]}, "one and the same length, not gap_1_m [2], gap_2_m [3]"),
        ({"gap_1_m": 1}, "one and the same length"),
        ({"gap_1_m": ["1", "2", "3"]}, "gap_1_m = ['1', '2', '3']: must be a number or a list of numbers"),
        ({"gap_1_m": [True, True, True]}, "must be a number or a list of numbers"),
        ({"gap_1_m": [[1], [2, 3]]}, "must be a number or a list of numbers"),
        ({"speed_2_mps": [1, np.nan, 3]}, "row 1, column speed_2_mps = nan: must be finite"),
        ({"gaps_1_m": [1, 2, 3]}, "unknown column 'gaps_1_m'; did you mean gap_1_m"),
    ],
)
def test_table__defects_name_column_and_row(changes, message):
    columns = {name: [7, 8, 9] for name in HEADER.split(",")} | changes
    with pytest.raises(InvalidInput) as caught:
        PAPER.worlds_from_table(columns)
    assert message in str(caught.value)


def test_initial_state__the_scenario_fills_in_fixed_fields():
    worlds = PAPER.worlds_from_state({"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]})
    assert worlds.n == 1
    assert worlds.gaps_m.tolist() == [[7.0, 7.0]]
    assert worlds.vehicles.braking_capacity_mps2.tolist() == [[6.0, 7.0, 6.0]]
    one_for_all = PAPER.worlds_from_state({"gaps_m": 7, "speeds_mps": np.full(3, 20), "restitution": 0.0})
    assert one_for_all.speeds_mps.tolist() == [[20.0, 20.0, 20.0]]
    assert one_for_all.vehicles.restitution.tolist() == [0.0]


def test_initial_state__of_a_fixed_scenario_may_be_empty():
    assert load_scenario("paper-scenario-1").worlds_from_state({}).gaps_m.tolist() == [[10.0, 8.0]]


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"gaps_m": [7, 7]}, "initial_state: speeds_mps[0] is missing, and random in scenario 'paper-random'"),
        ({"speeds_mps": 20}, "initial_state: gaps_m[0] is missing, and random"),
        ({"gap_m": [7, 7], "speeds_mps": 20}, "unknown key 'gap_m'; did you mean gaps_m (metres)?"),
        ({"restitution": [0.1, 0.2]}, "restitution has shape [2]; must be one number"),
        ({"gaps_m": [7, 7, 7], "speeds_mps": 20}, "gaps_m has shape [3]; 3 vehicles need 2 numbers, or one for all"),
        ({"gaps_m": [7, -7], "speeds_mps": 20}, "initial_state: gaps_m[1] = -7: must be finite and in [0, 10000] m"),
        ({"gaps_m": [7, np.nan], "speeds_mps": 20}, "initial_state: gaps_m[1] = nan: must be finite"),
        ({"gaps_m": "7", "speeds_mps": 20}, "gaps_m = '7': must be a number or a list of numbers"),
        ({"gaps_m": True, "speeds_mps": 20}, "gaps_m = True: must be a number"),
        (
            {"gaps_m": 7, "speeds_mps": [20, 41, 20]},
            "speeds_mps[1] = 41: must not be above speed_limit_mps of vehicle_2",
        ),
        ([7, 7], "must be a mapping"),
    ],
)
def test_initial_state__defects_name_key_and_entry(state, message):
    with pytest.raises(InvalidInput) as caught:
        PAPER.worlds_from_state(state)
    assert message in str(caught.value)
