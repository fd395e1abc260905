"""The order-free law for many touching vehicles, against rational arithmetic by another formula (min-max)."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.physics import Floats, Worlds, advance, make_worlds
from tests.physics.exact_simulator import line_of, regression, simulate
from tests.physics.random_worlds import Draws, touching_lines
from tests.reference.tolerances import CLUSTER_EPS, EPS


def law_error_eps(before: Worlds, after: Worlds, k: int, rounds: int) -> float:
    """Largest difference of world k's speeds from the exact law, in eps of its largest speed and per round."""
    exact = simulate(line_of(before, [0.0] * before.N, k), Fraction(0))
    scale = max(np.abs(before.speeds_mps[k]).max(), np.abs(after.speeds_mps[k]).max())
    off = [abs(Fraction(float(v)) - u) for v, u in zip(after.speeds_mps[k], exact.speeds, strict=True)]
    return float(max(off)) / scale / EPS / rounds


@pytest.mark.parametrize(("N", "n"), [(2, 300), (3, 300), (4, 200), (8, 80), (20, 20), (50, 6)])
@pytest.mark.parametrize("ratio", [1.0, 1e3])
def test_cluster__of_any_size_follows_the_exact_law(N, n, ratio):
    before, command = touching_lines(71, n, N, heaviest_ratio=ratio)
    after, impacts = advance(before, command, 0.0, record=True)
    rounds = np.maximum(impacts.count.max(axis=1), 1)
    assert max(law_error_eps(before, after, k, int(rounds[k])) for k in range(n)) <= CLUSTER_EPS
    assert (impacts.count > 0).sum(axis=1).max() >= min(N - 1, 3)


def test_cluster__harm_is_that_of_the_exact_rounds():
    before, command = touching_lines(72, 150, 6)
    _, impacts = advance(before, command, 0.0, record=True)
    rows = impacts.rows
    for k in range(150):
        exact = [
            hit for hit in simulate(line_of(before, [0.0] * 6, k), Fraction(0)).hits if hit.closing > Fraction(1, 10**4)
        ]
        mine = (rows.world == k) & (rows.closing_speed_mps > 1e-4)
        assert rows.pair[mine].tolist() == [hit.pair for hit in exact]
        np.testing.assert_allclose(rows.closing_speed_mps[mine], [float(h.closing) for h in exact], rtol=0, atol=1e-12)
        np.testing.assert_allclose(rows.front_speed_change_mps[mine], [float(h[4]) for h in exact], rtol=0, atol=1e-12)
        np.testing.assert_allclose(rows.rear_speed_change_mps[mine], [float(h[5]) for h in exact], rtol=0, atol=1e-12)


def accelerations(command, mass, speed: float) -> Floats:
    """Accelerations of touching vehicles at one speed, from their speeds after 1/64 s."""
    n = len(command)
    worlds = make_worlds(
        np.zeros(n - 1), np.full(n, speed), braking_capacity_mps2=16, driving_capacity_mps2=16, latency_s=0,
        mass_t=mass, restitution=0.0, speed_limit_mps=8.0,
    )  # fmt: skip
    after, impacts = advance(worlds, command, 1.0 / 64.0)
    assert impacts.count.sum() == 0
    return (after.speeds_mps[0] - speed) * 64.0


def exact_accelerations(command, mass, speed: float) -> Floats:
    """The same from ranges of force, by the min-max formula."""
    low = [Fraction(0) if u > 0 and speed == 8.0 else Fraction(u) for u in command]
    high = [-Fraction(u) if u < 0 and speed == 0.0 else Fraction(u) for u in command]
    return np.array([float(a) for a in regression(tuple(map(Fraction, mass)), low, high)])


COMMANDS = st.lists(st.floats(-16.0, 16.0, width=16).map(lambda u: round(u, 3)), min_size=2, max_size=8)


@settings(max_examples=150)
@given(COMMANDS, st.data(), st.sampled_from([0.0, 4.0, 8.0]))
def test_resting__accelerations_are_the_generalised_regression_of_force_ranges(command, data, speed):
    mass = data.draw(st.lists(st.floats(0.25, 64.0, width=16), min_size=len(command), max_size=len(command)))
    found = accelerations(command, mass, speed)
    np.testing.assert_allclose(found, exact_accelerations(command, mass, speed), rtol=0, atol=1e-9)
    assert np.all(np.diff(found) <= 1e-9)  # nobody presses into the one before


@pytest.mark.parametrize("N", [10, 25, 50])
@pytest.mark.parametrize("speed", [0.0, 4.0, 8.0])
def test_resting__long_lines_too(N, speed):
    draws = Draws(73 + N)
    for _ in range(4):
        command, mass = draws.uniform(-16.0, 16.0, (N,)), draws.uniform(0.5, 8.0, (N,))
        expected = exact_accelerations(command.tolist(), mass.tolist(), speed)
        np.testing.assert_allclose(accelerations(command, mass, speed), expected, rtol=0, atol=1e-9)


def test_resting__members_of_a_block_keep_the_same_bits():
    draws = Draws(74)
    N, n = 12, 200
    worlds = make_worlds(
        np.zeros((n, N - 1)), np.full((n, N), 10.0), braking_capacity_mps2=16, driving_capacity_mps2=16, latency_s=0,
        mass_t=draws.uniform(0.5, 8.0, (n, N)), restitution=0.5,
    )  # fmt: skip
    command = draws.uniform(-16.0, 16.0, (n, N))
    for until in (0.1, 0.35, 1.0, 5.0):
        worlds, impacts = advance(worlds, command, until_s=until)
        assert impacts.count.sum() == 0
        touching = worlds.gaps_m == 0.0
        assert np.all((worlds.speeds_mps[:, 1:] == worlds.speeds_mps[:, :-1])[touching])
        assert touching.any() and not touching.all()


@settings(max_examples=60)
@given(st.lists(st.tuples(st.fractions(0, 30), st.fractions(1, 8)), min_size=1, max_size=7))
def test_oracle__the_min_max_formula_is_the_best_decreasing_fit(vehicles):
    v, mass = zip(*vehicles, strict=True)
    fit = regression(mass, v, v)
    assert all(a >= b for a, b in pairwise(fit))
    assert sum(m * (a - b) for m, a, b in zip(mass, fit, v, strict=True)) == 0
    blocks = [[k for k in range(len(fit)) if fit[k] == value] for value in dict.fromkeys(fit)]
    for block in blocks:  # each block is the mean of its members, and none of its heads pulls ahead of its tail
        for cut in range(1, len(block)):
            head, tail = block[:cut], block[cut:]
            mean = [sum(mass[k] * v[k] for k in part) / sum(mass[k] for k in part) for part in (head, tail)]
            assert mean[0] <= mean[1]
