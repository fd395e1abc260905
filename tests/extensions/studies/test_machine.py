"""The study of speed. No speed is asserted."""

import math
import time
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from tests.docs.site import load

SPEED = load("../studies/speed")
SHORT = SPEED.Effort(1, 1e-6)


def test_rates__are_work_per_processor_second_without_the_first_round(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, durations = [0.0], iter([9.0, 0.25, 0.25, 1.0])  # the first round, two calls, one call

    def work() -> int:
        clock[0] += next(durations)
        return 10

    monkeypatch.setattr(time, "process_time", lambda: clock[0])
    assert SPEED.rates(work, SPEED.Effort(2, 0.5)).tolist() == [10.0, 40.0]


@pytest.mark.parametrize(
    "each", [pytest.param(each, marks=pytest.mark.slow if each.unit == "s" else ()) for each in SPEED.BENCHMARKS]
)
def test_benchmarks__each_measures_something(each: Any) -> None:
    speed = each.measure(SHORT)
    assert each.workload and each.worlds >= 1 and 0.0 < speed.lowest == speed.value == speed.highest < math.inf


def test_calibration__brakes_by_half_a_metre_per_second_and_starts_again() -> None:
    # The calibration brakes by half a metre per second, and starts again: 0.05 * (39.5 + 38.5) m.
    speeds, ways = np.full((2, 3), 20.0), np.zeros((2, 3))
    assert SPEED.brake_apart(speeds, ways, 2) == 4
    assert (speeds == 19.0).all() and (np.round(ways, 9) == 3.9).all()
    assert SPEED.brake_apart(speeds, ways, 38) == 76
    assert (speeds == 20.0).all()


def test_braking__counts_the_steps_of_running_worlds_until_all_are_at_rest() -> None:
    scenario, game = eb.open_game("paper-random")
    state = game.reset(scenario.sample(2, seed=7))
    while not state.ended.all():
        state, _ = game.step(state, np.full((2, 1), -0.75))
    assert SPEED.braking(2, 0.75)() == state.steps.sum() < 78  # the last world is at rest after 39 steps
