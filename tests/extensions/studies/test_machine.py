"""Measures of speed, of docs/studies, and the machine in words. No speed is asserted."""

import math
import time
from typing import Any

import numba
import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.envs.making import make_engine
from ethbrake_marl.extensions.studies.machine import this_machine
from ethbrake_marl.physics.advance import advance
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


def test_measure__sets_world_steps_against_the_first_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    def figure(unit: str, *values: float) -> Any:
        return benchmark.Benchmark("x", "y", unit, 5, None, lambda effort: np.array(values))

    figures = (figure("world-steps/s", 7.0, 8.0, 9.0), figure("s", 4.0), figure("world-steps/s", 1.0, 2.0, 2.0))
    monkeypatch.setattr(benchmark, "BENCHMARKS", figures)
    found = benchmark.measure()
    assert [speed.relative for speed in found] == [1.0, None, 0.25]
    assert [(speed.lowest, speed.value, speed.highest) for speed in found] == [(7, 8, 9), (4, 4, 4), (1, 2, 2)]


def test_braking__counts_world_steps_to_rest() -> None:
    worlds = make_engine(benchmark.SCENARIO, 5, seed=benchmark.SEED).worlds
    command = -worlds.vehicles.braking_capacity_mps2
    steps = 0
    while worlds.speeds_mps.any():
        worlds, steps = advance(worlds, command, 0.1)[0], steps + 1
    assert benchmark.braking(5, 1.0)() == 5 * steps and steps > 20


@pytest.mark.parametrize(
    "each", [pytest.param(each, marks=pytest.mark.slow if each.unit == "s" else ()) for each in benchmark.BENCHMARKS]
)
def test_benchmarks__each_measures_something(each: Any) -> None:
    speed = each.measure(SHORT)
    assert each.workload and each.worlds >= 1 and 0.0 < speed.lowest == speed.value == speed.highest < math.inf


def test_machine__is_named_in_words() -> None:
    machine = this_machine()
    parts = (machine.processor, f"{machine.cores_usable} of {machine.cores} cores", f"numba {numba.__version__}")
    assert machine.processor and all(part in str(machine) for part in parts)


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
