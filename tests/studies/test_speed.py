"""What ``ethbrake doctor speed`` measures, and that no figure is far below what this code can do."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable

import numba
import numpy as np
import pytest

from ethbrake_marl.physics import advance, make_worlds
from ethbrake_marl.studies import speed as benchmark
from ethbrake_marl.studies.speed import (
    BENCHMARKS,
    Benchmark,
    Effort,
    Speed,
    brake_apart,
    braking,
    measure,
    rates,
    this_machine,
)

SHORT = Effort(1, 1e-6)

compiled_only = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="compilation is switched off")


def speeds_of(name: str, effort: Effort) -> list[Speed]:
    """The figures of this name, measured now."""
    return [each.measure(effort) for each in BENCHMARKS if each.name == name]


def test_rates__are_work_per_processor_second_without_the_first_round(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, durations = [0.0], iter([9.0, 0.25, 0.25, 1.0])  # the first round, two calls, one call

    def work() -> int:
        clock[0] += next(durations)
        return 10

    monkeypatch.setattr(time, "process_time", lambda: clock[0])
    assert rates(work, Effort(2, 0.5)).tolist() == [10.0, 40.0]


def test_measure__sets_world_steps_against_the_first_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    def figure(unit: str, *values: float) -> Benchmark:
        return Benchmark("x", "y", unit, 5, None, lambda effort: np.array(values))

    figures = (figure("world-steps/s", 7.0, 8.0, 9.0), figure("s", 4.0), figure("world-steps/s", 1.0, 2.0, 2.0))
    monkeypatch.setattr(benchmark, "BENCHMARKS", figures)
    found = measure()
    assert [speed.relative for speed in found] == [1.0, None, 0.25]
    assert [(speed.lowest, speed.value, speed.highest) for speed in found] == [(7, 8, 9), (4, 4, 4), (1, 2, 2)]


def test_braking__counts_world_steps_to_rest() -> None:
    worlds = benchmark.first_decisions(5)
    command = -worlds.vehicles.braking_capacity_mps2
    steps = 0
    while worlds.speeds_mps.any():
        worlds, steps = advance(worlds, command, 0.1)[0], steps + 1
    assert braking(5, 1.0)() == 5 * steps and steps > 20


def test_until_rest__ends_where_nothing_ever_rests() -> None:
    coasting = make_worlds(
        10.0,
        [20.0, 20.0],
        braking_capacity_mps2=6.0,
        driving_capacity_mps2=0.0,
        latency_s=0.0,
        mass_t=1.0,
        restitution=0.0,
    )
    assert benchmark.until_rest(coasting, np.zeros((1, 2)))() == benchmark.MOST_STEPS


def test_calibration__brakes_by_half_a_metre_per_second_and_starts_again() -> None:
    speeds, ways = np.full((2, 3), 20.0), np.zeros((2, 3))
    assert brake_apart(speeds, ways, 2) == 4
    assert (speeds == 19.0).all() and ways == pytest.approx(0.05 * (39.5 + 38.5))
    brake_apart(speeds, ways, 38)
    assert (speeds == 20.0).all()


def test_benchmarks__each_measures_something() -> None:
    slow = ("Stable-Baselines3 VecEnv", "import and first step")  # measured below
    for each in BENCHMARKS:
        assert each.workload and each.worlds >= 1
        if each.name not in slow:
            speed = each.measure(SHORT)
            assert 0.0 < speed.lowest == speed.value == speed.highest


@pytest.mark.slow
def test_start__takes_processor_time_of_another_process() -> None:
    (speed,) = speeds_of("import and first step", SHORT)
    assert (speed.unit, speed.floor, speed.worlds) == ("s", 2.0, 1)
    assert 0.0 < speed.value < math.inf


def test_machine__is_named_in_words() -> None:
    machine = this_machine()
    words = str(machine)
    assert machine.processor in words and f"{machine.cores_usable} of {machine.cores} cores" in words
    assert f"numba {numba.__version__}" in words and machine.processor


def watched() -> bool:
    """Whether a tracer, profiler or monitor runs beside the code (coverage, a debugger): it slows down Python alone."""
    monitoring = getattr(sys, "monitoring", None)  # from Python 3.12 on
    tools = [] if monitoring is None else [monitoring.get_tool(number) for number in range(6)]
    return sys.gettrace() is not None or sys.getprofile() is not None or any(tools)


@pytest.mark.parametrize("switch", [sys.settrace, sys.setprofile])
def test_watched__sees_a_tracer_and_a_profiler(switch: Callable[[object], None]) -> None:
    before = {sys.settrace: sys.gettrace, sys.setprofile: sys.getprofile}[switch]()
    try:
        switch(lambda *event: None)
        seen = watched()
    finally:
        switch(before)
    assert seen


@compiled_only
@pytest.mark.parametrize(
    ("name", "least"),
    [  # half or less of what each was, on a machine with eight busy programs for two cores: a third of that is too slow
        ("advance and ledger, 75%", 0.016),
        ("advance and ledger, 100%", 0.016),
        ("engine step", 0.008),
        ("Stable-Baselines3 VecEnv", 0.004),
        ("PettingZoo parallel", 9e-5),
    ],
)
def test_speed__is_not_far_below_the_calibration(name: str, least: float) -> None:
    if watched():
        pytest.skip("a tracer slows down Python and not the compiled calibration")
    effort = Effort(3, 0.03)
    (calibration,) = speeds_of("calibration", effort)
    speeds = speeds_of(name, effort)
    assert speeds
    for speed in speeds:
        assert speed.highest / calibration.value > least
