"""What tables of worlds, given worlds and lists that are drawn may not be."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.worlds import sampling
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario
from ethbrake_marl.worlds.user_worlds import read_worlds, worlds_from_state, worlds_from_table
from tests.refused import refused

PAPER = load_scenario("paper-random")
OBSTACLE = PAPER.replace(obstacle_margin_m={"uniform": [1, 2]})
HEADER = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps"
STATE = {"gaps_m": 7, "speeds_mps": 20}
COLUMNS = {name: [7, 8, 9] for name in HEADER.split(",")}

# All at 20 m/s: Vehicle 1, braking with 6 m/s2, is 3 m closer to Vehicle 2 at 1 s, when this one may act.
CLOSE = PAPER.replace(gaps_m=3, speeds_mps=20, latency_s=[0, 1, 1])


def test_world__that_the_last_draw_accepts_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = PAPER.replace(gaps_m={"uniform": [0.5, 6.0]}, early_impacts="reject")
    drawn = scenario.draw(1, 7, first=1)
    assert drawn.rejected == 2
    monkeypatch.setattr(sampling, "MOST_ATTEMPTS", 3)
    assert scenario.sample(1, 7, first=1).line.tobytes() == drawn.worlds.line.tobytes()
    monkeypatch.setattr(sampling, "MOST_ATTEMPTS", 2)
    with refused("but in all 2 draws of world 1 an impact happens before vehicle_2 can act"):
        scenario.sample(1, 7, first=1)


def read(text: str, scenario: Scenario = PAPER) -> object:
    """The worlds of a file of this text."""
    Path("worlds.csv").write_text(text, encoding="utf-8")
    return read_worlds(scenario, "worlds.csv")


REFUSED: dict[str, Callable[[], object]] = {
    "worlds.csv, line 1: unknown column 'gap_1_km'; did you mean gap_1_m (metres)?": lambda: read(
        "gap_1_km,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n1,2,3,4,5\n"
    ),
    "worlds.csv, line 1: unknown column 'mass_2_kilograms'; did you mean mass_2_t (tonnes)?": lambda: read(
        HEADER + ",mass_2_kilograms\n1,2,3,4,5,5500\n"
    ),
    "worlds.csv, line 1: columns are separated by semicolons; separate them by commas": lambda: read(
        HEADER.replace(",", ";") + "\n7,5;8;20;18;20\n"
    ),
    "worlds.csv, line 1: unknown column 'friction'; ": lambda: read(HEADER + ",friction\n1,2,3,4,5,0.5\n"),
    "worlds.csv, line 1: column 'agent': a column of your own needs another name": lambda: read(
        HEADER + ",agent\n1,2,3,4,5,x\n"
    ),
    "worlds.csv, line 1: column 'gap_1_m' occurs twice": lambda: read(HEADER + ",gap_1_m\n1,2,3,4,5,6\n"),
    "worlds.csv, line 2: has 4 values, but the header has 5 columns": lambda: read(HEADER + "\n10,8,20,18\n"),
    "worlds.csv, line 3, column speed_1_mps: 'fast' is not a number": lambda: read(
        HEADER + "\n10,8,20,18,20\n10,8,fast,18,20\n"
    ),
    "worlds.csv, line 3, column gap_2_m = -8: must be finite and in [0, 10000] m (metres)": lambda: read(
        HEADER + "\n10,8,20,18,20\n10,-8,20,18,20\n"
    ),
    "vehicle_3 has a speed of 41 m/s; its speed must be from 0 to its speed_limit_mps, 40 m/s": lambda: read(
        HEADER + "\n10,8,20,18,41\n"
    ),
    "worlds.csv, line 2, column latency_3_s = 8: vehicle_3 may not be able to act until 8 s; this": lambda: read(
        HEADER + ",latency_3_s\n10,8,20,18,20,8\n"
    ),
    "worlds.csv: cannot be read as CSV: unexpected end of data": lambda: read(HEADER + '\n"10,8,20,18,20\n'),
    "worlds.csv: must have a header, for instance gap_1_m,gap_2_m,speed_1_mps,... and rows": lambda: read(""),
    "/dev/zero: is a device, a pipe or a socket; must be a plain file": lambda: read_worlds(PAPER, "/dev/zero"),
    "worlds.csv, line 2, column mass_2_t is missing; scenario 'paper-random' has no fixed value for it": lambda: read(
        HEADER + "\n10,8,20,18,20\n", PAPER.replace(mass_t=[4.5, {"uniform": [5, 6]}, 5.9])
    ),
    "initial states: all columns must be lists of the same length; they have the shapes gap_1_m [2],": lambda: (
        worlds_from_table(PAPER, COLUMNS | {"gap_1_m": [1, 2]})
    ),
    "initial states: gap_1_m = ['1', '2', '3']: must be a number or a list of numbers; no booleans, texts": lambda: (
        worlds_from_table(PAPER, COLUMNS | {"gap_1_m": ["1", "2", "3"]})
    ),
    "initial states: gap_1_m = [[1], [2, 3]]: must be a number or a list of numbers: setting an array": lambda: (
        worlds_from_table(PAPER, COLUMNS | {"gap_1_m": [[1], [2, 3]]})
    ),
    "initial states, row 0, column obstacle_gap_m is missing; scenario": lambda: worlds_from_table(OBSTACLE, COLUMNS),
    "initial_state: unknown key 'obstacle_gap_m'; known: gaps_m, speeds_mps": lambda: worlds_from_state(
        PAPER, {"gaps_m": 7, "speeds_mps": 20, "obstacle_gap_m": 30}
    ),
    "initial_state: speeds_mps[0] is missing; scenario 'paper-random' has no fixed value": lambda: worlds_from_state(
        PAPER, {"gaps_m": [7, 7]}
    ),
    "initial_state: unknown key 'gap_m'; did you mean gaps_m (metres)?": lambda: worlds_from_state(
        PAPER, {"gap_m": [7, 7], "speeds_mps": 20}
    ),
    "initial_state: gaps_m has shape [3]; must be a list of 2 numbers (for 3 vehicles), or": lambda: worlds_from_state(
        PAPER, {"gaps_m": [7, 7, 7], "speeds_mps": 20}
    ),
    "initial_state: with v2x: nominal, it is random what the vehicles learn about": lambda: worlds_from_state(
        PAPER.replace(v2x="nominal", early_impacts="keep"), {"gaps_m": 7, "speeds_mps": 20}
    ),
    "initial_state: braking_capacity_mps2[0] = 1: must be at least 2 m/s2 on the road, because": lambda: (
        worlds_from_state(
            PAPER.replace(roles={"vehicle_1": "constant:2"}), STATE | {"braking_capacity_mps2": [1, 2, 2]}
        )
    ),
    "initial_state: latency_s[1] = 0.5: vehicle_2 may not be able to act until 8.5 s": lambda: worlds_from_state(
        PAPER.replace(v2x={"preset": "sensors-only", "sensing_s": [1, 1]}), STATE | {"latency_s": [7.5, 0.5, 0.8]}
    ),
    "number of worlds = 0: must be a whole number in 1..10000000": lambda: PAPER.sample(n=0, seed=1),
    "seed of the list = None: must be a whole number, at least 0": lambda: PAPER.sample(n=1, seed=None),
    "seed of the list = -1: must be a whole number, at least 0": lambda: open_game(PAPER)[1].draw(2, -1, 0),
    "first world = '3': must be a whole number in 0..": lambda: open_game(PAPER)[1].draw(2, 7, "3"),  # type: ignore[arg-type]
    "seed of the list = array([3, 4]): must be": lambda: open_game(PAPER)[1].draw(2, np.array([3, 4]), 0),  # type: ignore[arg-type]
    "first world = 4503599627370497: must be a whole number": lambda: PAPER.sample(n=1, seed=1, first=2**52 + 1),
    "sample: purpose = 'test': must be one of list, training": lambda: PAPER.sample(n=1, seed=1, purpose="test"),
    "scenario 'paper-random': early_impacts: reject, but in all 1000 draws of": lambda: CLOSE.sample(1, 0),
    "1000 draws of world 0 an impact happens before vehicle_3 can act; use larger": lambda: (
        CLOSE.replace(gaps_m=2, latency_s=[0, 0.5, 1]).with_learners(["vehicle_3"]).sample(1, 0)
    ),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", REFUSED)
def test_worlds__are_refused_with_their_place_and_what_would_be_right(message: str) -> None:
    with refused(message):
        REFUSED[message]()


def test_table__that_is_no_text_or_too_large_is_refused(empty_folder: Path) -> None:
    Path("bytes.csv").write_bytes(b"\xff\xfe\x00")
    with refused("bytes.csv: cannot be read as CSV: 'utf-8' codec can't decode byte 0xff in position 0"):
        read_worlds(PAPER, "bytes.csv")
    with open("huge.csv", "wb") as stream:
        stream.truncate(2**26 + 1)  # sparse
    with refused("huge.csv: is larger than 64 MiB, the limit for this kind of file"):
        read_worlds(PAPER, "huge.csv")
