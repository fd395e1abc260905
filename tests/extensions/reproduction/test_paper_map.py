"""The paper's fixed-step map: impacts by hand, figures of version 0.5."""

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.reproduction.paper_map import advance_sampled, sample
from ethbrake_marl.motion.layout import BRAKE_RATE, COUNT, GAP, HIT, LATENCY, SPEED
from tests.refused import refused

SCENARIO = eb.load_scenario("paper-random")


def worlds(n: int, vehicle_2: float = -7.0) -> eb.State:
    """Worlds of the random test at the alert, in which Vehicle 2 holds a command and the others brake fully."""
    alert = SCENARIO.sample(n, 7)
    wanted = alert.wanted.copy()
    wanted[:, 1:] = -alert.braking_capacity_mps2
    wanted[:, 2] = vehicle_2
    return alert._replace(wanted=wanted)


def at_a_sample(gaps, speeds) -> eb.State:
    """One world of the random test, in which nobody commands anything, at a sample with these gaps and speeds."""
    state = SCENARIO.sample(1, 7)
    line, wanted, clock = state.line.copy(), np.zeros(state.wanted.shape), state.clock.copy()
    line[0, GAP, 1:3], line[0, SPEED, 1:] = gaps, speeds
    clock[0, 0] = clock[0, 1] = 2.0
    return state._replace(line=line, wanted=wanted, clock=clock)


def test_impact__by_hand() -> None:
    """Masses 4.5 and 5.5 t, e = 0.1, closing at 10 m/s: changes of 0.55 * 1.1 * 10 and 0.45 * 1.1 * 10 m/s."""
    after = sample(at_a_sample([-0.5, 50.0], [10.0, 20.0, 15.0]), 0.1)
    assert after.speeds_mps[0].tolist() == pytest.approx([16.05, 15.05, 15.0])
    assert after.harm("first")[0] == after.harm("total")[0] == 100.0
    assert after.gaps_m[0].tolist() == pytest.approx([-0.5 + 0.1 * (16.05 - 15.05), 50.0 + 0.1 * (15.05 - 15.0)])
    again = sample(at_a_sample([-0.5, 50.0], [10.0, 9.0, 9.0]), 0.1)  # overlapping, but separating
    assert not again.line[0, COUNT].any() and again.harm("total")[0] == 0.0


def test_impact__second_of_a_pair_is_total_harm_only_and_vehicles_stop_at_0() -> None:
    state = at_a_sample([0.0, 50.0], [10.0, 12.0, 0.4])
    state.line[0, HIT, 1], state.wanted[0, 3] = 1.0, -6.0
    after = sample(state, 0.1)
    assert (after.harm("first")[0], after.harm("total")[0], after.speeds_mps[0, 2]) == (0.0, 4.0, 0.0)


def test_impacts__of_one_sample_go_from_the_rear_to_the_front() -> None:
    """Vehicle 2 first gets 5.9 * 1.1 * 5 / 11.4 = 2.846 m/s from Vehicle 3, and then strikes Vehicle 1 with more."""
    after = sample(at_a_sample([0.0, 0.0], [10.0, 12.0, 17.0]), 0.1)
    pushed = 2.0 + 5.9 * 1.1 * 5.0 / 11.4
    assert after.pair_harm("total")[0].tolist() == pytest.approx([pushed * pushed, 25.0])


@pytest.mark.parametrize(
    ("step_s", "vehicle_2", "harm"),
    [(0.1, -7.0, 23.479299909088144), (0.2, -7.0, 29.585014941952608), (0.25, -7.0, 36.812182133604814),
     (0.5, -7.0, 35.79459513033634), (0.1, -5.0, 27.97726529370422)],
)  # fmt: skip
def test_map__has_the_figures_of_version_0_5(step_s: float, vehicle_2: float, harm: float) -> None:
    assert advance_sampled(worlds(2_000, vehicle_2), 8.0, step_s).harm("first").mean() == harm


def test_map__of_a_world_does_not_depend_on_the_others() -> None:
    alert = worlds(3)
    alert.car[1, LATENCY, 2] = 0.31
    whole = advance_sampled(alert, 5.0)
    for k in range(3):
        assert np.array_equal(advance_sampled(alert.take([k]), 5.0).line[0], whole.line[k])


@pytest.mark.parametrize(
    ("until_s", "step_s", "told"),
    [(8.0, 0.0, "step_s = 0:"), (8.0, float("nan"), "step_s = nan"), (8.0, float("inf"), "step_s = inf"),
     (0.1, 0.1, "until_s = 0.1:"), (float("inf"), 0.1, "until_s = inf")],
)  # fmt: skip
def test_map__refuses_times(until_s: float, step_s: float, told: str) -> None:
    with refused(f"advance_sampled: {told}"):
        advance_sampled(worlds(2), until_s, step_s)


@pytest.mark.parametrize(
    ("part", "row", "body", "value", "told"),
    [
        ("line", GAP, 0, 30.0, "an obstacle"),
        ("line", SPEED, 2, 60.0, "an impact before Vehicle 2 may act"),
        ("car", BRAKE_RATE, 3, 30.0, "brakes that build up"),
    ],
)
def test_map__refuses_worlds_that_it_has_not(part: str, row: int, body: int, value: float, told: str) -> None:
    alert = worlds(2)
    changed = getattr(alert, part).copy()
    changed[1, row, body] = value
    with refused(f"advance_sampled: row 1 has {told}"):
        advance_sampled(alert._replace(**{part: changed}), 8.0)
