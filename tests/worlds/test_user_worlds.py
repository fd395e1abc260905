"""Worlds that the user gives."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.state import KEY, NUMBER
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.describe import quantities_of
from ethbrake_marl.worlds.user_worlds import read_worlds, world_columns, worlds_from_state, worlds_from_table
from tests.refused import refused
from tests.worlds.test_scenario import bits, line

PAPER = load_scenario("paper-random")
HEADER = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps"
COLUMNS = {name: [7, 8] for name in HEADER.split(",")}


@pytest.mark.parametrize(
    ("scenario", "state", "expected"),
    [
        (PAPER, {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}, {"gaps_m": [7.0, 7.0], "latency_s": [0.0, 0.5, 0.8]}),
        (load_scenario("paper-scenario-1"), {}, {"gaps_m": [10.0, 8.0], "speeds_mps": [20.0, 18.0, 20.0]}),
        (line().replace(time_gaps_s=[0.5, 1]), {"speeds_mps": [30, 20, 10]}, {"gaps_m": [10.0, 10.0]}),
        (line(obstacle_margin_m=1.5), {"latency_s": 0, "braking_capacity_mps2": 4}, {"obstacle_gap_m": 51.5}),
        (line(friction=0.5), {}, {"braking_capacity_mps2": [0.5 * 9.81] * 3}),
        (line(friction=0.5), {"friction": 0.25}, {"braking_capacity_mps2": [0.25 * 9.81] * 3}),
    ],
)
def test_state__is_filled_in_with_what_is_fixed(scenario: Any, state: Any, expected: dict[str, Any]) -> None:
    worlds = worlds_from_state(scenario, state)
    assert {name: getattr(worlds, name)[0].tolist() for name in expected} == expected
    assert worlds.clock[:, 5].tolist() == [-1.0]


@pytest.mark.parametrize("name", ["realistic-mixed-buildup", "paper-random-obstacle"])
def test_table_of_what_was_drawn__is_the_same_worlds(name: str) -> None:
    scenario = load_scenario(name)
    drawn = scenario.draw(50, 3)
    given = worlds_from_table(scenario, quantities_of(drawn.worlds, drawn.road))
    for part in ("line", "car", "know", "wanted"):
        assert getattr(given, part).tobytes() == getattr(drawn.worlds, part).tobytes(), part
    clock = drawn.worlds.clock.copy()
    clock[:, NUMBER], clock[:, KEY] = -1.0, np.arange(50)  # they are of no list
    assert given.clock.tobytes() == clock.tobytes() and given.memories == drawn.worlds.memories == {}


def test_table__may_be_a_data_frame() -> None:
    pandas, pyarrow = pytest.importorskip("pandas"), pytest.importorskip("pyarrow")
    expected = bits(worlds_from_table(PAPER, COLUMNS))
    frame = pandas.DataFrame(COLUMNS, index=[5, 3])
    assert bits(worlds_from_table(PAPER, frame)) == expected
    assert bits(worlds_from_table(PAPER, {name: frame[name] for name in COLUMNS})) == expected
    assert bits(worlds_from_table(PAPER, pyarrow.table(COLUMNS))) == expected
    other = {**COLUMNS, "gap_1_m": frame["gap_1_m"], "gap_2_m": frame["gap_2_m"].sort_index()}
    with refused("initial states: columns have different pandas indexes; give them the same"):
        worlds_from_table(PAPER, other)


def test_column_of_the_users_own__is_a_label_of_the_results(empty_folder: Path) -> None:
    lines = ["note," + HEADER + ",case", '"wet, dark",7,8,20,18,20,1', ",9,8,20,18,20,02", "dry,7,8,20,18,21,3"]
    Path("mine.csv").write_text("\n".join(lines))
    worlds = read_worlds(PAPER, "mine.csv")
    bare = read_worlds(PAPER, "mine.csv")._replace(memories={})
    assert bits(worlds._replace(memories={})) == bits(bare) and worlds.gaps_m[1].tolist() == [9.0, 8.0]
    result = eb.evaluate(worlds.take([2, 0, 1]), "full_brake", scenario=PAPER)
    assert result.worlds["note"].tolist() == ["dry", "wet, dark", ""]
    assert result.worlds["case"].tolist() == result.arrays()["case"].tolist() == ["3", "1", "02"]
    groups = eb.summarise_by(result, "note")
    assert [*groups] == ["no note", "dry", "wet, dark"]
    plain = eb.evaluate(bare, "full_brake", scenario=PAPER)["full_brake"]["total_harm"]
    assert groups["dry"][0]["total_harm"].value == plain[2]
    assert result["full_brake"]["total_harm"].tolist() == plain[[2, 0, 1]].tolist()
    again = worlds_from_table(PAPER, {**{name: [7.0, 8.0] for name in COLUMNS}, "note": ["a", None], "case": [1, 2]})
    assert eb.evaluate(again, "coast", scenario=PAPER).worlds["note"].tolist() == ["a", ""]


def test_label__recording_gives_intervals_by_recording(empty_folder: Path) -> None:
    rows = [f"{gap},8,20,18,20,drive {gap % 3}" for gap in range(5, 11)]
    Path("mine.csv").write_text("\n".join([HEADER + ",recording", *rows]))
    result = eb.evaluate(read_worlds(PAPER, "mine.csv"), "full_brake", scenario=PAPER)
    assert result.clusters is not None and len({*result.clusters.tolist()}) == 3


def test_label__that_a_measure_is_called_is_refused(empty_folder: Path) -> None:
    for name in ("total_harm", "total_harm_1", "impacts"):
        worlds = worlds_from_table(PAPER, {**COLUMNS, name: ["a", "b"]})
        with refused("is the name of a column of the worlds; give another name"):
            eb.evaluate(worlds, "full_brake", scenario=PAPER)


NUMBERS = {
    "object": lambda pandas, frame: frame.astype(object),
    "Int64": lambda pandas, frame: frame.astype("Int64"),
    "pyarrow": lambda pandas, frame: frame.astype("float64[pyarrow]"),
    "structured": lambda pandas, frame: np.array([(7,) * 5, (8,) * 5], [(name, float) for name in COLUMNS]),
    "range": lambda pandas, frame: dict.fromkeys(COLUMNS, range(7, 9)),
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_table__may_have_numbers_of_any_type(kind: str) -> None:
    pandas = pytest.importorskip("pandas")
    table = NUMBERS[kind](pandas, pandas.DataFrame(COLUMNS))
    assert bits(worlds_from_table(PAPER, table)) == bits(worlds_from_table(PAPER, COLUMNS))


def test_table__may_be_of_polars() -> None:
    polars = pytest.importorskip("polars")
    for kind in (polars.DataFrame, polars.LazyFrame):
        assert bits(worlds_from_table(PAPER, kind(COLUMNS))) == bits(worlds_from_table(PAPER, COLUMNS))
    with refused("initial states, row 1, column gap_1_m = nan: must be finite"):
        worlds_from_table(PAPER, polars.LazyFrame({**COLUMNS, "gap_1_m": [7, None]}))
    with refused("initial states: type Series: must be a mapping from columns"):
        worlds_from_table(PAPER, polars.Series([7.0]))


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (lambda pandas: pandas.array([7, None], dtype="Int64"), ", row 1, column gap_1_m = nan: must be finite"),
        (lambda pandas: pandas.Series([7.0, "8"], dtype=object), ": gap_1_m = Series of object: must be a number or a"),
        (lambda pandas: pandas.to_datetime(["2020-01-01"] * 2), ": gap_1_m = DatetimeIndex of datetime64["),
        (lambda pandas: {0: 7, 1: 8}, ": gap_1_m = {0: 7, 1: 8}: must be a number or a list of numbers"),
    ],
)
def test_column__of_other_cells_is_refused_without_the_table(cells: Any, message: str) -> None:
    with refused(f"initial states{message}"):
        worlds_from_table(PAPER, {**COLUMNS, "gap_1_m": cells(pytest.importorskip("pandas"))})


@pytest.mark.parametrize("table", [3, "worlds.csv", np.ones((2, 5))], ids=lambda table: type(table).__name__)
def test_what_is_no_table__is_refused_by_its_type(table: Any) -> None:
    accepted = "must be a mapping from columns to lists of numbers, a pandas or polars frame, a pyarrow table, or"
    with refused(f"initial states: type {type(table).__name__}: {accepted}"):
        worlds_from_table(PAPER, table)
    if not isinstance(table, str):
        with refused("must be the path of a CSV file; worlds_from_table reads a table"):
            read_worlds(PAPER, table)


def test_file__may_hold_any_quantity_in_any_order(empty_folder: Path) -> None:
    columns = f"\ufefflatency_2_s,restitution,mass_3_t,speed_limit_1_mps,{HEADER}"
    Path("worlds.csv").write_text(f"{columns}\n0.2,0.3,6,30,10,8,20,1.8e1, 20\n\n", "utf-8")
    worlds = read_worlds(PAPER.replace(mass_t=[4.5, 5.5, {"uniform": [5, 6]}]), "worlds.csv")
    assert worlds.latency_s.tolist() == [[0.0, 0.2, 0.8]]
    assert worlds.mass_t.tolist() == [[4.5, 5.5, 6.0]]
    assert worlds.speeds_mps.tolist() == [[20.0, 18.0, 20.0]]
    assert [*world_columns(PAPER)][:6] == [*HEADER.split(","), "braking_capacity_1_mps2"]
