"""Worlds by rows: nothing is lost, nothing is shared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.physics import advance, make_worlds
from ethbrake_marl.physics.batch import Packed, columns


def worlds(n, vehicles):
    rng = np.random.default_rng(2)
    start = make_worlds(
        rng.uniform(0, 9, (n, vehicles - 1)),
        rng.uniform(10, 22, (n, vehicles)),
        braking_capacity_mps2=rng.uniform(5, 9, (n, vehicles)),
        driving_capacity_mps2=rng.uniform(1, 4, (n, vehicles)),
        latency_s=rng.uniform(0, 1, (n, vehicles)),
        mass_t=rng.uniform(1, 9, (n, vehicles)),
        restitution=rng.uniform(0, 0.3, n),
        speed_limit_mps=rng.uniform(30, 40, (n, vehicles)),
    )
    return advance(start, -4.0, until_s=rng.uniform(0.5, 3.0, n))[0]


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize(("n", "vehicles"), [(1, 2), (1, 3), (40, 3), (7, 6)])
def test_unpack__gives_back_every_bit_in_its_own_memory(n, vehicles, told):
    given = worlds(n, vehicles)
    if told:  # when each vehicle has the news of each other one
        news = np.arange(float(n * vehicles**2)).reshape(n, vehicles, vehicles)
        told_of = {"own_latency_s": 0.5 * given.vehicles.latency_s, "known_from_s": news}
        given = replace(given, vehicles=replace(given.vehicles, **told_of))
    rows = Packed.of(given)
    assert rows.has_news == told
    back = rows.worlds()
    rows.state[:], rows.params[:] = -1.0, -1.0
    for part, again in ((given, back), (given.vehicles, back.vehicles)):
        for name in part.__slots__:
            value = getattr(part, name)
            if name != "vehicles":
                np.testing.assert_array_equal(getattr(again, name), value, strict=True)


@pytest.mark.parametrize("told", [False, True])
def test_widened_rows__say_the_same_as_before(told):
    given = worlds(7, 3)
    if told:
        given = replace(given, vehicles=replace(given.vehicles, own_latency_s=0.5 * given.vehicles.latency_s))
    rows = Packed.of(given)
    wide = rows.widened(obstacle=True, news=True)
    assert (rows.params.shape, wide.params.shape) == ((7, 28 if told else 16), (7, 28))
    assert (rows.state.shape, wide.state.shape) == ((7, 20), (7, 25)) and not rows.has_obstacle and wide.has_obstacle
    again = wide.worlds()
    for part, other in ((given, again), (given.vehicles, again.vehicles)):
        for name in part.__slots__:
            if name != "vehicles":
                np.testing.assert_array_equal(getattr(other, name), getattr(part, name), strict=True)


def test_ledger__is_in_its_own_memory():
    rows = Packed.of(worlds(1, 3))
    first, total, count, *_ = rows.ledger()
    rows.state[:] = 5.0
    assert first.tolist() == total.tolist() == count.tolist() == [[0.0, 0.0]]
    assert isinstance(rows, Packed)


def test_columns__follow_each_other_without_a_hole():
    # 3 vehicles, 2 pairs: time | speeds 3 | commands 3 | before 3 | gaps 2 | hit 2 | first 2 | total 2 | count 2
    # and restitution | braking 3 | driving 3 | latency 3 | mass 3 | limit 3 | own latency 3 | news 9
    rows = Packed.of(worlds(1, 3))
    assert rows.column == (3, 0, 1, 4, 7, 10, 12, 14, 20, 0, 1, 4, 7, 10, 13, 16, 19, 28)
    assert columns(rows.state) == rows.column and rows.state.shape == (1, 20) and rows.params.shape == (1, 16)


def test_ledger__is_that_of_the_columns_of_harm():
    first, total, count, *of_obstacle = Packed(np.arange(25.0)[None], np.empty((1, 16))).ledger()
    assert (first.tolist(), total.tolist(), count.tolist()) == ([[14.0, 15.0]], [[16.0, 17.0]], [[18, 19]])
    assert [each.tolist() for each in of_obstacle] == [[22.0], [23.0], [24]]
    assert count.dtype == of_obstacle[2].dtype == np.int64
