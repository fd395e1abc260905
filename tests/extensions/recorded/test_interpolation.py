"""Vehicles without a row at the moment that is read: interpolated, or the queue is broken there; both are counted."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.extensions.recorded.scenario import FromData, scenario_from_data
from tests.extensions.recorded.made import rows_of
from tests.extensions.recorded.test_tables import COLUMNS, HEAD
from tests.fixtures.recordings import FOOT_M, NGSIM, write_files

Skip = Callable[[str, float], bool]  # (vehicle, time) -> whether the row is missing
Lane = Callable[[str, float], str]

CHAIN = "20.5,20.0,20.0"


def made_of(
    folder: Path, off: dict[str, float], *, skip: Skip = lambda *_: False, lane: Lane = lambda *_: "1", seconds: int = 1
) -> FromData:
    """Cars 25 m apart and 4.5 m long at 20 m/s at 10 Hz, read every second. ``off``: error of each clock (s)."""
    rows = [
        (who, f"{k / 10 + off.get(who, 0.0):.3f}", lane(who, k / 10), 20.0 * (k / 10 + off.get(who, 0.0)) + x)
        for k in range(10 * seconds + 1)
        for who, x in (("d", 75.0), ("c", 50.0), ("b", 25.0), ("a", 0.0))
        if not skip(who, k / 10)
    ]
    lines = [",".join(map(str, row)) for row in [HEAD, *((*row, 4.5, 20.0) for row in rows)]]
    return scenario_from_data(
        "mine", write_files(folder, {"a.csv": lines}), "table", columns=COLUMNS, based_on="realistic-pair"
    )


# what is odd -> clocks and rows, chains, interpolated vehicles, broken links
CASES: dict[str, tuple[dict[str, float], dict[str, Any], list[str], int, int]] = {
    # The clock of c is 0.03 s late: no row before 0 s, so b has nobody ahead and a follows b; rows at 0.93 and 1.03 s.
    "late": ({"c": 0.03}, {}, [CHAIN] * 3, 1, 1),
    "two late": ({"c": 0.03, "b": 0.06}, {}, [CHAIN] * 2, 2, 1),
    "four clocks": ({"c": 0.03, "b": 0.06, "a": 0.01}, {}, [CHAIN] * 2, 3, 0),
    # At the first time, -0.03 s, and at 0.97 s only c has a row.
    "early": ({"c": -0.03}, {}, [CHAIN] * 2, 3, 1),
    "no first row": ({}, {"skip": lambda who, t: who == "c" and t == 0.0}, [CHAIN] * 3, 0, 1),
    "no first rows": ({}, {"skip": lambda who, t: who == "c" and t < 0.5}, [CHAIN] * 3, 0, 1),
    "no last row": ({}, {"skip": lambda who, t: who == "c" and t == 1.0}, [CHAIN] * 3, 0, 1),
    "no row at 0 s and at 1 s": ({}, {"skip": lambda who, t: who == "c" and t in (0.0, 1.0)}, [CHAIN] * 2, 0, 2),
    "arrives later": ({}, {"skip": lambda who, t: who == "c" and t < 0.6}, ["45.5,20.0,20.0", CHAIN, CHAIN], 0, 0),
    "a gap of 0.4 s": ({}, {"skip": lambda who, t: who == "c" and 0.8 < t < 1.2}, [CHAIN] * 4, 1, 0),
    "a gap of 0.6 s": ({}, {"skip": lambda who, t: who == "c" and 0.7 < t < 1.3}, [CHAIN] * 3, 0, 1),
    # c changes to lane 2, where e is ahead and f is behind: the links of b and of f are broken.
    "lane change": ({"c": 0.03}, {"lane": lambda who, t: "2" if who == "c" and t > 0.95 else "1"}, [CHAIN] * 2, 0, 2),
    "all rows": ({}, {}, [CHAIN] * 4, 0, 0),
}


@pytest.mark.parametrize("what", CASES)
def test_no_row_at_the_moment__nobody_is_chained_to_the_next_but_one(what: str, tmp_path: Path) -> None:
    off, options, rows, interpolated, broken = CASES[what]
    seconds = 2 if "gap" in what else 1
    made = made_of(tmp_path, off, seconds=seconds, **options)
    assert rows_of(made) == rows + [CHAIN] * 2 * (seconds - 1)
    account = "; ".join(made.found)
    assert (f"interpolated: {interpolated} vehicle" in account) == (interpolated > 0)
    assert (f"left out: {broken} links to a vehicle that has no row near this time" in account) == (broken > 0)
    assert account.partition("; ")[2] in made.text


def test_interpolation__is_linear_in_positions_and_speeds(tmp_path: Path) -> None:
    # b: 75 m at 15 m/s at 0.9 s and 78 m at 14 m/s at 1.1 s; a quarter on the way at 0.95 s, 0.05 s off the clock of c.
    rows = [("c", 0.0, 1, 100, 5, 10), ("c", 0.95, 1, 110, 5, 10), ("b", 0.9, 1, 75, 5, 15), ("b", 1.1, 1, 78, 5, 14)]
    rows += [("c", 0.95 + k / 10, 1, 110 + k, 5, 10) for k in (1, 2)]
    lines = [",".join(map(str, row)) for row in [HEAD, *rows]]
    folder = write_files(tmp_path, {"a.csv": lines})
    made = scenario_from_data("mine", folder, "table", columns=COLUMNS, based_on="realistic-pair", every_s=0.95)
    assert rows_of(made) == ["29.25,10.0,14.75"]  # 110 - 5 - 75.75


def test_formats_that_name_the_leader__its_clock_may_be_off(tmp_path: Path) -> None:
    # 12 m/s; the second of three cars, 15 m apart and 4.5 m long, is recorded 30 ms later than the others
    lines = [NGSIM]
    for tick in range(21):
        for who, ahead, y, late in ((1, 0, 30.0, 0), (2, 1, 15.0, 30), (3, 2, 0.0, 0)):
            front = (y + 12.0 * (tick / 10 + late / 1000)) / FOOT_M
            cells = f"{who},{tick},9,{1118846979700 + 100 * tick + late},20,{front:.4f},0,0,{4.5 / FOOT_M:.4f},6,2"
            lines.append(f"{cells},{12.0 / FOOT_M:.4f},0,2,,,,,,,{ahead},0,0,0,us-101")
    made = scenario_from_data("mine", write_files(tmp_path, {"a.csv": lines}), "ngsim")
    assert rows_of(made) == ["10.5,10.5,12.0,12.0,12.0"] * 2  # at 1 and 2 s: car 2 has no row before 0 s
