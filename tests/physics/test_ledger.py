"""Harm is booked to the last bit: shares, segments, both counts."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.harm import empty_ledger, split
from ethbrake_marl.physics import advance, make_worlds
from tests.physics.random_worlds import driving_lines
from tests.reference.tolerances import EPS

MASS = st.floats(1e-2, 1e4)


@settings(max_examples=300)
@given(st.lists(MASS, min_size=2, max_size=6), st.data())
def test_harm__shares_add_up_to_the_last_bit(mass, data):
    value = st.just(0.0) | st.floats(1e-10, 2_000.0)
    harm = data.draw(st.lists(value, min_size=len(mass) - 1, max_size=len(mass) - 1))
    for p, squared in enumerate(harm):  # pair by pair: a vehicle between two pairs bears a sum of rounded numbers
        front, rear = split(np.array([[squared]]), np.array([mass[p : p + 2]]))[0]
        assert Fraction(float(front)) + Fraction(float(rear)) == Fraction(squared)
        assert min(front, rear) >= 0.0
        rounding = 4.0 * EPS * squared * max(mass[p : p + 2])
        assert front * mass[p] == pytest.approx(rear * mass[p + 1], rel=0, abs=rounding)
    whole = split(np.array([harm]), np.array([mass]))
    assert whole.sum() == pytest.approx(sum(harm), rel=1e-14)


@pytest.mark.parametrize("N", [2, 3, 6])
def test_ledger__is_the_sum_of_the_recorded_impacts_to_the_last_bit(N):
    worlds, command = driving_lines(45, 400, N)
    ledger = empty_ledger(worlds)
    first, total, count = (np.zeros(worlds.gaps_m.shape) for _ in range(3))
    for until in (0.7, 2.0, 6.0):
        worlds, impacts = advance(worlds, command, until_s=until, record=True)
        rows = impacts.rows
        harm = rows.closing_speed_mps * rows.closing_speed_mps
        segment_first, segment_total = np.zeros(first.shape), np.zeros(first.shape)
        np.add.at(segment_total, (rows.world, rows.pair), harm)
        np.add.at(segment_first, (rows.world[rows.first], rows.pair[rows.first]), harm[rows.first])
        np.add.at(count, (rows.world, rows.pair), 1)
        assert np.all(np.diff(rows.time_s)[np.diff(rows.world) == 0] >= 0.0)
        assert segment_total.tobytes() == impacts.total_harm.tobytes()
        assert segment_first.tobytes() == impacts.first_impact_harm.tobytes()
        first, total = first + segment_first, total + segment_total
        ledger = ledger.add(impacts)
    assert ledger.pair_harm("first").tobytes() == first.tobytes()
    assert ledger.pair_harm("total").tobytes() == total.tobytes()
    assert ledger.count.tolist() == count.tolist()
    assert np.array_equal(worlds.pair_hit, count > 0) and ledger.collided.tolist() == (count.sum(axis=1) > 0).tolist()
    assert ledger.world_harm("total") == pytest.approx(ledger.vehicle_harm("total").sum(axis=1), rel=1e-14)


def test_ledger__is_empty_at_the_alert():
    worlds, _ = driving_lines(46, 3, 4)
    ledger = empty_ledger(worlds)
    assert ledger.first_impact_harm.shape == ledger.total_harm.shape == ledger.count.shape == (3, 3)
    assert not ledger.collided.any() and ledger.world_harm("first").tolist() == [0.0] * 3
    assert ledger.count.dtype == np.int64 and ledger.vehicle_harm("total").tolist() == np.zeros((3, 4)).tolist()


def test_ledger__the_two_counts_differ_by_the_later_impacts():
    # 8, 4, 2 m/s against a heavy holding wall
    wall = make_worlds(
        [0.0], [0.0, 8.0], braking_capacity_mps2=16, driving_capacity_mps2=16, latency_s=0, mass_t=[2.0**50, 1.0],
        restitution=0.5,
    )  # fmt: skip
    _, impacts = advance(wall, [-16.0, 4.0], 3.25)
    ledger = empty_ledger(wall).add(impacts)
    assert ledger.pair_harm("first").tolist() == [[64.0]]
    assert ledger.world_harm("total") == pytest.approx([64.0 + 16.0 + 4.0])
    assert ledger.count.tolist() == [[3]]


def test_split__the_lighter_one_bears_more_whether_in_front_or_behind():
    harm = np.array([[16.0, 0.0]])
    assert split(harm, np.array([[1.0, 3.0, 1.0]])).tolist() == [[12.0, 4.0, 0.0]]
    assert split(harm, np.array([[3.0, 1.0, 1.0]])).tolist() == [[4.0, 12.0, 0.0]]
    assert split(harm[:, ::-1], np.array([[1.0, 3.0, 1.0]])).tolist() == [[0.0, 4.0, 12.0]]
    assert split(np.array([[16.0, 8.0]]), np.array([[1.0, 3.0, 1.0]])).tolist() == [[12.0, 4.0 + 2.0, 6.0]]
