"""What tables of worlds, given worlds and lists that are drawn may not be."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.given import read_worlds, worlds_from_state, worlds_from_table
from ethbrake_marl.worlds.scenario import Scenario
from tests.refused import refused

PAPER = load_scenario("paper-random")
OBSTACLE = PAPER.replace(obstacle_margin_m={"uniform": [1, 2]})
HEADER = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps"
COLUMNS = {name: [7, 8, 9] for name in HEADER.split(",")}

# All at 20 m/s: Vehicle 1, braking with 6 m/s2, is 3 m closer to Vehicle 2 at 1 s, when this one may act.
CLOSE = PAPER.replace(gaps_m=3, speeds_mps=20, latency_s=[0, 1, 1])


def read(text: str, scenario: Scenario = PAPER) -> object:
    """The worlds of a file of this text."""
    Path("worlds.csv").write_text(text, encoding="utf-8")
    return read_worlds(scenario, "worlds.csv")


FILES: dict[str, Callable[[], object]] = {
    "worlds.csv, line 1: unknown column 'gap_1_km'; did you mean gap_1_m (metres)?": lambda: read(
        "gap_1_km,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n1,2,3,4,5\n"
    ),
    "worlds.csv, line 1: column 'gap_1_m' occurs twice": lambda: read(HEADER + ",gap_1_m\n1,2,3,4,5,6\n"),
    "worlds.csv, line 1: column 'gap_2_m' is missing; a table for 3 vehicles must": lambda: read(
        "gap_1_m,speed_1_mps,speed_2_mps,speed_3_mps\n1,2,3,4\n"
    ),
    "worlds.csv, line 2: has 4 values, but the header has 5 columns": lambda: read(HEADER + "\n10,8,20,18\n"),
    "worlds.csv, line 3: has 0 values, but the header has 5 columns": lambda: read(
        HEADER + "\n10,8,20,18,20\n\n10,8,20,18,20\n"
    ),
    "worlds.csv, line 3, column speed_1_mps: 'fast' is not a number": lambda: read(
        HEADER + "\n10,8,20,18,20\n10,8,fast,18,20\n"
    ),
    "worlds.csv, line 2, column speed_1_mps: 'nan' is not a number": lambda: read(HEADER + "\n10,8,nan,18,20\n"),
    "worlds.csv, line 2, column gap_2_m: '' is not a number": lambda: read(HEADER + "\n10,,20,18,20\n"),
    "worlds.csv, line 3, column gap_2_m = -8: must be finite and in [0, 10000] m (metres)": lambda: read(
        HEADER + "\n10,8,20,18,20\n10,-8,20,18,20\n"
    ),
    "must not be above speed_limit_mps of vehicle_3, 40 m/s": lambda: read(HEADER + "\n10,8,20,18,41\n"),
    "worlds.csv, line 2, column latency_3_s = 8: must be below horizon_s of the scenario (8 s)": lambda: read(
        HEADER + ",latency_3_s\n10,8,20,18,20,8\n"
    ),
    "worlds.csv: cannot be read as CSV: unexpected end of data": lambda: read(HEADER + '\n"10,8,20,18,20\n'),
    "worlds.csv, line 4, column gap_2_m = -8: must be finite and in [0, 10000] m (metres)": lambda: read(
        HEADER + '\n"10\n",8,20,18,20\n10,-8,20,18,20\n'
    ),
    "worlds.csv, line 4: has 2 values, but the header has 5": lambda: read(HEADER + '\n"10\n",8,20,18,20\n10,8\n'),
    "worlds.csv, line 3, column speed_1_mps = 35: must not be above speed_limit_mps of vehicle_1, 30 m/s": lambda: read(
        HEADER + ",speed_limit_1_mps\n10,8,20,18,20,20\n10,8,35,18,20,30\n"
    ),
    "worlds.csv: has a header but no rows; add one row per world": lambda: read(HEADER + "\n"),
    "worlds.csv, line 1: must name the columns": lambda: read(""),
    "none.csv: the file does not exist": lambda: read_worlds(PAPER, "none.csv"),
    "/dev/zero: is a device, a pipe or a socket; must be a plain file": lambda: read_worlds(PAPER, "/dev/zero"),
    "worlds.csv: column mass_2_t is missing; scenario 'paper-random' has no fixed value for it": lambda: read(
        HEADER + "\n10,8,20,18,20\n", PAPER.replace(mass_t=[4.5, {"uniform": [5, 6]}, 5.9])
    ),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", FILES)
def test_table__is_refused_with_its_line_and_column(message: str) -> None:
    with refused(message):
        FILES[message]()


GIVEN: dict[str, Callable[[], object]] = {
    "initial states: all columns must be lists of the same length; they have the shapes gap_1_m [2],": lambda: (
        worlds_from_table(PAPER, COLUMNS | {"gap_1_m": [1, 2]})
    ),
    "initial states: all columns must be lists of the same length; they have the shapes gap_1_m [],": lambda: (
        worlds_from_table(PAPER, COLUMNS | {"gap_1_m": 1})
    ),
    "initial states: gap_1_m = ['1', '2', '3']: must be a number or a list of numbers; no booleans, texts": lambda: (
        worlds_from_table(PAPER, COLUMNS | {"gap_1_m": ["1", "2", "3"]})
    ),
    "initial states: gap_1_m = [True, 2, 3]: must be a number or a list of numbers; no booleans, texts": lambda: (
        worlds_from_table(PAPER, COLUMNS | {"gap_1_m": [True, 2, 3]})
    ),
    "initial states: gap_1_m = [[1], [2, 3]]: must be a number or a list of numbers: setting an array": lambda: (
        worlds_from_table(PAPER, COLUMNS | {"gap_1_m": [[1], [2, 3]]})
    ),
    "initial states, row 1, column speed_2_mps = nan: must be finite and in [0, 200] m/s (metres": lambda: (
        worlds_from_table(PAPER, COLUMNS | {"speed_2_mps": [1, np.nan, 3]})
    ),
    "initial states: unknown column 'gaps_1_m'; did you mean gap_1_m (metres)?": lambda: worlds_from_table(
        PAPER, COLUMNS | {"gaps_1_m": [1, 2, 3]}
    ),
    "initial states: column 'recording' is possible only in the table of a scenario; put this table into a scenario "
    "(key table), or remove the column (confidence intervals then treat all": lambda: worlds_from_table(
        PAPER, COLUMNS | {"recording": ["a", "a", "b"]}
    ),
    "initial states: column obstacle_gap_m is missing; scenario": lambda: worlds_from_table(OBSTACLE, COLUMNS),
    "initial_state: unknown key 'obstacle_gap_m'; known: gaps_m, speeds_mps": lambda: worlds_from_state(
        PAPER, {"gaps_m": 7, "speeds_mps": 20, "obstacle_gap_m": 30}
    ),
    "initial_state: obstacle_gap_m = 0: must be finite and in (0, 10000] m": lambda: worlds_from_state(
        OBSTACLE, {"gaps_m": 7, "speeds_mps": 20, "obstacle_gap_m": 0}
    ),
    "initial_state: speeds_mps[0] is missing; scenario 'paper-random' has no fixed value": lambda: worlds_from_state(
        PAPER, {"gaps_m": [7, 7]}
    ),
    "initial_state: unknown key 'gap_m'; did you mean gaps_m (metres)?": lambda: worlds_from_state(
        PAPER, {"gap_m": [7, 7], "speeds_mps": 20}
    ),
    "initial_state: restitution has shape [2]; must be one number": lambda: worlds_from_state(
        PAPER, {"restitution": [0.1, 0.2]}
    ),
    "initial_state: gaps_m has shape [3]; must be a list of 2 numbers (for 3 vehicles), or": lambda: worlds_from_state(
        PAPER, {"gaps_m": [7, 7, 7], "speeds_mps": 20}
    ),
    "initial_state: gaps_m[1] = -7: must be finite and in [0, 10000] m (metres)": lambda: worlds_from_state(
        PAPER, {"gaps_m": [7, -7], "speeds_mps": 20}
    ),
    "initial_state: gaps_m = True: must be a number or a list of numbers; no booleans": lambda: worlds_from_state(
        PAPER, {"gaps_m": True, "speeds_mps": 20}
    ),
    "initial_state = [7, 7]: must be a mapping such as {'gaps_m': [7, 7]}": lambda: worlds_from_state(PAPER, [7, 7]),
    "initial_state: gaps_m[1] = 12000: must be finite and in [0, 10000] m (metres)": lambda: worlds_from_state(
        PAPER.replace(time_gaps_s=[1, 60]), {"speeds_mps": [20, 20, 200], "speed_limit_mps": 200}
    ),
    "initial_state: with v2x: nominal, it is random what the vehicles learn about": lambda: worlds_from_state(
        PAPER.replace(v2x="nominal", early_impacts="keep"), {"gaps_m": 7, "speeds_mps": 20}
    ),
}


@pytest.mark.parametrize("message", GIVEN)
def test_given_worlds__are_refused(message: str) -> None:
    with refused(message):
        GIVEN[message]()


LISTS: dict[str, Callable[[], object]] = {
    "number of worlds = 0: must be a whole number, at least 1": lambda: PAPER.sample(n=0, seed=1),
    "number of worlds = True: must be a whole number, at least 1": lambda: PAPER.sample(n=True, seed=1),
    "at most 10,000,000; draw more with several calls": lambda: PAPER.sample(n=10000001, seed=1),
    "seed of the list = None: must be a whole number, at least 0": lambda: PAPER.sample(n=1, seed=None),
    "first world = -1: must be a whole number, at least 0": lambda: PAPER.sample(n=1, seed=1, first=-1),
    "sample: first = 4611686018427387904: first + n must be at most 4611686018427387904": lambda: PAPER.sample(
        n=1, seed=1, first=4611686018427387904
    ),
    "sample: channel = 'test': must be one of list, training": lambda: PAPER.sample(n=1, seed=1, channel="test"),
    "scenario 'paper-random': early_impacts: reject, but in all 1000 draws of": lambda: CLOSE.sample(1, 0),
    "1000 draws of world 0 an impact happens before vehicle_3 can act; use larger": lambda: (
        CLOSE.replace(gaps_m=2, latency_s=[0, 0.5, 1]).with_learners(["vehicle_3"]).sample(1, 0)
    ),
}


@pytest.mark.parametrize("message", LISTS)
def test_list__cannot_be_drawn(message: str) -> None:
    with refused(message):
        LISTS[message]()


def test_table__that_is_no_text_or_too_large_is_refused(empty_folder: Path) -> None:
    Path("bytes.csv").write_bytes(b"\xff\xfe\x00")
    with refused("bytes.csv: cannot be read as CSV: 'utf-8' codec can't decode byte 0xff in position 0"):
        read_worlds(PAPER, "bytes.csv")
    with open("huge.csv", "wb") as stream:
        stream.truncate(2**26 + 1)  # sparse
    with refused("huge.csv: is larger than 64 MiB, the limit for this kind of file"):
        read_worlds(PAPER, "huge.csv")
