"""The paper's fixed-step map: an impact by hand, a separately written reference, figures of version 0.5."""

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


def test_impact__second_of_a_pair_is_total_harm_only() -> None:
    state = at_a_sample([0.0, 50.0], [10.0, 12.0, 12.0])
    state.line[0, HIT, 1] = 1.0
    after = sample(state, 0.1)
    assert (after.harm("first")[0], after.harm("total")[0]) == (0.0, 4.0)


def test_impacts__of_one_sample_go_from_the_rear_to_the_front() -> None:
    """Vehicle 2 first gets 5.9 * 1.1 * 5 / 11.4 = 2.846 m/s from Vehicle 3, and then strikes Vehicle 1 with more."""
    after = sample(at_a_sample([0.0, 0.0], [10.0, 12.0, 17.0]), 0.1)
    pushed = 2.0 + 5.9 * 1.1 * 5.0 / 11.4
    assert after.pair_harm("total")[0].tolist() == pytest.approx([pushed * pushed, 25.0])


def reference(state: eb.State, k: int, until: float, h: float) -> tuple[float, float]:
    """Both counts of harm of one world, with floats alone."""
    e, tau = float(state.restitution[k]), state.latency_s[k].tolist()
    v, d, m = state.speeds_mps[k].tolist(), state.gaps_m[k].tolist(), state.mass_t[k].tolist()
    u, n, first, total = state.wanted[k, 1:].tolist(), 0, {}, 0.0
    start = tau[1]
    ways = [0.0] * 3
    for i in range(3):  # exact until the first sample
        braking = max(start - tau[i], 0.0)
        ways[i] = v[i] * start + 0.5 * u[i] * braking * braking
        v[i] += u[i] * braking
    d = [d[0] + ways[0] - ways[1], d[1] + ways[1] - ways[2]]
    while start + n * h < until - 1e-6 * h:
        for i in (1, 0):
            w = v[i + 1] - v[i]
            if d[i] <= 0.0 and w > 0.0:
                v[i] += m[i + 1] * (1.0 + e) * w / (m[i] + m[i + 1])
                v[i + 1] -= m[i] * (1.0 + e) * w / (m[i] + m[i + 1])
                first.setdefault(i, w * w)
                total += w * w
        before = list(v)
        for i in range(3):
            if tau[i] <= start + (n + 1e-6) * h:
                v[i] = max(v[i] + u[i] * h, 0.0) if v[i] >= 0.0 else min(v[i] - u[i] * h, 0.0)
        way = [0.5 * h * (old + new) for old, new in zip(before, v, strict=True)]
        d = [d[0] + way[0] - way[1], d[1] + way[1] - way[2]]
        n += 1
    return sum(first.values()), total


@pytest.mark.parametrize("step_s", [0.1, 0.25])
def test_map__is_that_of_a_reference(step_s: float) -> None:
    alert = worlds(40, -5.0)
    last = advance_sampled(alert, 8.0, step_s)
    each = np.array([reference(alert, k, 8.0, step_s) for k in range(40)])
    assert np.stack([last.harm("first"), last.harm("total")], axis=1) == pytest.approx(each, abs=1e-9)


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


def test_refusals() -> None:
    alert = worlds(2)
    for step_s in (0.0, float("nan"), float("inf")):
        with refused("advance_sampled: step_s = "):
            advance_sampled(alert, 8.0, step_s)
    for until_s in (0.1, float("nan"), float("inf")):
        with refused("advance_sampled: until_s = "):
            advance_sampled(alert, until_s)
    for row, value, what in ((GAP, 30.0, "an obstacle"), (SPEED, 60.0, "an impact before Vehicle 2 may act")):
        line = alert.line.copy()
        line[1, row, 0 if row == GAP else 2] = value
        with refused(f"advance_sampled: row 1 has {what}"):
            advance_sampled(alert._replace(line=line), 8.0)
    car = alert.car.copy()
    car[1, BRAKE_RATE, 3] = 30.0
    with refused("advance_sampled: row 1 has brakes that build up"):
        advance_sampled(alert._replace(car=car), 8.0)
