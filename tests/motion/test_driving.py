"""The speed that vehicles ask for by driving before the line's first impact, by hand."""

from __future__ import annotations

import pytest

from ethbrake_marl.motion.layout import DROVE, Floats
from tests.motion.lines import driven, lines

near = pytest.approx

# Vehicle 2 drives at 2 m/s2 from 0.5 s on and closes 1 m in 1 s: 2 m/s until the impact at 1.5 s
CLOSE = lines([1.0, 90.0], [10.0, 10.0, 0.0], latency_s=[0.0, 0.5, 0.0])


def drove(line: Floats, car: Floats, commands: list[float], start: float, until: float) -> tuple[Floats, list[float]]:
    later = driven(line, car, commands, start, until)[0]
    return later, later[0, DROVE].tolist()


def test_driving__counts_after_the_latency_and_until_the_first_impact_of_the_line() -> None:
    line, car = CLOSE
    line, row = drove(line, car, [0.0, 2.0, 1.0], 0.0, 1.0)
    assert row == near([0.0, 1.0, 1.0, 0.0])
    line, row = drove(line, car, [0.0, 2.0, 1.0], 1.0, 4.0)
    assert row == near([0.0, 2.0, 1.5, 0.0])
    assert drove(line, car, [3.0, 2.0, 1.0], 4.0, 5.0)[1] == row
    assert drove(*CLOSE, [0.0, -2.0, 0.0], 0.0, 0.9)[1] == [0.0] * 4


def test_driving__ends_with_an_impact_with_the_obstacle() -> None:
    assert drove(*lines([9.0], [10.0, 10.0], obstacle_gap_m=5.0), [0.0, 4.0], 0.0, 1.0)[1] == near([0.0, 2.0, 0.0])
