"""Measures of speed, of docs/studies, and the machine in words. No speed is asserted."""

import math
import time
from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from tests.docs.site import load

benchmark = load("../studies/speed")


SHORT = benchmark.Effort(1, 1e-6)


def test_rates__are_work_per_processor_second_without_the_first_round(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, durations = [0.0], iter([9.0, 0.25, 0.25, 1.0])  # the first round, two calls, one call

    def work() -> int:
        clock[0] += next(durations)
        return 10

    monkeypatch.setattr(time, "process_time", lambda: clock[0])
    assert benchmark.rates(work, benchmark.Effort(2, 0.5)).tolist() == [10.0, 40.0]


@pytest.mark.parametrize(
    "each", [pytest.param(each, marks=pytest.mark.slow if each.unit == "s" else ()) for each in benchmark.BENCHMARKS]
)
def test_benchmarks__each_measures_something(each: Any) -> None:
    speed = each.measure(SHORT)
    assert each.workload and each.worlds >= 1 and 0.0 < speed.lowest == speed.value == speed.highest < math.inf


SPEED = load("../studies/speed")


def test_calibration__brakes_by_half_a_metre_per_second_and_starts_again() -> None:
    # The calibration of the speeds brakes by half a metre per second, and starts again: 0.05 * (39.5 + 38.5) m.
    speeds, ways = np.full((2, 3), 20.0), np.zeros((2, 3))
    assert SPEED.brake_apart(speeds, ways, 2) == 4
    assert speeds.tolist() == [[19.0, 19.0, 19.0], [19.0, 19.0, 19.0]]
    assert np.round(ways, 9).tolist() == [[3.9, 3.9, 3.9], [3.9, 3.9, 3.9]]
    assert SPEED.brake_apart(speeds, ways, 38) == 76
    assert speeds.tolist() == [[20.0, 20.0, 20.0], [20.0, 20.0, 20.0]]


def test_measurement__ends_where_nothing_ever_rests() -> None:
    physical = dict.fromkeys(("driving_capacity_mps2", "latency_s", "restitution"), 0.0)
    coasting = eb.make_worlds(10.0, [20.0, 20.0], braking_capacity_mps2=6.0, mass_t=1.0, **physical)
    assert SPEED.until_rest(coasting, np.zeros((1, 2)))() == SPEED.MOST_STEPS


def test_speed__counts_the_steps_of_all_worlds_until_all_are_at_rest() -> None:
    # A measure of speed counts the steps of all worlds until all are at rest: 38 and 63 of two worlds.
    assert SPEED.braking(2, 0.75)() == 76
    assert SPEED.braking(2, 0.1)() == 126
