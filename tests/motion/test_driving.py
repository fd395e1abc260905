"""The speed that engines give, by hand: the integral of the force where it is positive."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.motion.layout import DROVE, FORCE, Floats
from tests.motion.lines import driven, lines

near = pytest.approx

# Vehicle 2 drives at 2 m/s2 from 0.5 s on and strikes Vehicle 1 at 1.5 s; Vehicle 3 is far behind.
CLOSE = lines([1.0, 90.0], [10.0, 10.0, 0.0], latency_s=[0.0, 0.5, 0.0])


def drove(line: Floats, car: Floats, commands: list[float], start: float, until: float) -> tuple[Floats, list[float]]:
    later = driven(line, car, commands, start, until)[0]
    return later, later[0, DROVE].tolist()


def test_driving__counts_after_the_latency_before_and_after_impacts() -> None:
    line, car = CLOSE
    line, row = drove(line, car, [0.0, 2.0, 1.0], 0.0, 1.0)
    assert row == near([0.0, 1.0, 1.0, 0.0])
    line, row = drove(line, car, [0.0, 2.0, 1.0], 1.0, 4.0)
    assert row == near([0.0, 7.0, 4.0, 0.0])
    assert drove(line, car, [3.0, 0.0, -1.0], 4.0, 5.0)[1] == near([3.0, 7.0, 4.0, 0.0])
    assert drove(*CLOSE, [0.0, -2.0, 0.0], 0.0, 0.9)[1] == [0.0] * 4
    assert drove(*lines([9.0], [10.0, 10.0], obstacle_gap_m=5.0), [0.0, 4.0], 0.0, 1.0)[1] == near([0.0, 4.0, 0.0])


@pytest.mark.parametrize(
    ("before", "command", "fall", "rise", "speed", "after"),
    [
        (0.0, 6.0, 3.0, np.inf, 6.0, 6.0),  # at once
        (0.0, 6.0, np.inf, 3.0, 1.5, 3.0),  # a triangle: 3 m/s2 after 1 s
        (0.0, 1.5, np.inf, 3.0, 0.375 + 0.75, 1.5),  # 0.5 s up, 0.5 s at 1.5 m/s2
        (6.0, 0.0, 3.0, np.inf, 4.5, 3.0),  # goes on after its command has ended
        (2.0, -4.0, 4.0, np.inf, 0.5, -2.0),  # positive for 0.5 s
        (-2.0, 4.0, np.inf, 4.0, 0.5, 2.0),
        (2.0, -4.0, np.inf, np.inf, 0.0, -4.0),
    ],
)  # fmt: skip
def test_driving__is_what_the_force_does(
    before: float, command: float, fall: float, rise: float, speed: float, after: float
) -> None:
    line, car = lines([90.0], [10.0, 10.0], force_mps2=[0.0, before], brake_rate_mps3=fall, release_rate_mps3=rise)
    later = driven(line, car, [0.0, command], 0.0, 1.0)[0]
    assert (later[0, DROVE, 1], later[0, FORCE, 2]) == near((speed, after))


def test_driving__goes_on_while_the_engine_does() -> None:
    """Action 1 for 1 s, then 0: the force falls with 3 m/s3, so the engine gives 6 + 6 m/s, not 6."""
    line, car = lines([90.0], [10.0, 10.0], brake_rate_mps3=3.0)
    for start, command in ((0.0, 6.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0)):
        line, row = drove(line, car, [0.0, command], start, start + 1.0)
    assert row == near([0.0, 12.0, 0.0]) and line[0, 0, 2] == near(22.0)


def test_driving__costs_what_a_vehicle_does_itself_to_the_bit() -> None:
    """Whether Vehicle 2 strikes Vehicle 1, and when, changes nothing for Vehicle 3, with the same commands."""
    rng = np.random.default_rng(7)
    n = 200
    rates = np.where(rng.random((n, 1)) < 0.5, np.inf, rng.uniform(5.0, 40.0, (n, 3)))
    rows = []
    for command in (-5.0, 5.0):
        line, car = lines(
            rng.uniform(0.0, 5.0, (n, 2)), rng.uniform(5.0, 20.0, (n, 3)), latency_s=[0.0, 0.3, 0.2], restitution=0.1,
            brake_rate_mps3=rates, release_rate_mps3=rates,
        )  # fmt: skip
        line = driven(line, car, [-6.0, command, 4.0], 0.0, 0.7)[0]
        rows.append(driven(line, car, [-6.0, -command, 2.0], 0.7, 2.0)[0][:, DROVE, 2])
    assert (rows[0] > 0.0).all() and np.array_equal(*rows)
