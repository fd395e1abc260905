"""Worlds by rows: nothing is lost, nothing is shared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.physics import advance, make_worlds
from ethbrake_marl.physics.advance import (
    NO_ROWS,
    Packed,
    command_at,
    gap_at,
    harm_at,
    has_news,
    ledger_columns,
    pack,
    params_at,
    previous_at,
    speed_at,
    state_width,
    unpack,
    with_news_columns,
)
from ethbrake_marl.physics.kernel import LISTED


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
    rows = pack(given)
    assert has_news(rows.params, vehicles) == told
    back = unpack(rows)
    rows.state[:], rows.params[:] = -1.0, -1.0
    for part, again in ((given, back), (given.vehicles, back.vehicles)):
        for name in part.__slots__:
            value = getattr(part, name)
            if name != "vehicles":
                np.testing.assert_array_equal(getattr(again, name), value, strict=True)


@pytest.mark.parametrize("told", [False, True])
def test_with_news_columns__says_the_same_as_without(told):
    given = worlds(7, 3)
    if told:
        given = replace(given, vehicles=replace(given.vehicles, own_latency_s=0.5 * given.vehicles.latency_s))
    state, params = pack(given)
    wide = with_news_columns(params, 3)
    assert (params.shape, wide.shape) == ((7, 28 if told else 16), (7, 28))
    again = unpack(Packed(state, wide)).vehicles
    for name in again.__slots__:
        np.testing.assert_array_equal(getattr(again, name), getattr(given.vehicles, name), strict=True)


def test_ledger_columns__are_in_their_own_memory():
    rows = pack(worlds(1, 3))
    first, total, count = ledger_columns(rows.state, 3)
    rows.state[:] = 5.0
    assert first.tolist() == total.tolist() == count.tolist() == [[0.0, 0.0]]
    assert isinstance(rows, Packed)


def test_columns__follow_each_other_without_a_hole():
    # 3 vehicles, 2 pairs: time | speeds 3 | commands 3 | before 3 | gaps 2 | hit 2 | first 2 | total 2 | count 2
    at = [speed_at(3), command_at(3), previous_at(3), gap_at(3), harm_at(3)]
    assert at == [1, 4, 7, 10, 14] and state_width(3) == 20
    assert [params_at(group, 3) for group in range(7)] == [1, 4, 7, 10, 13, 16, 19]
    assert pack(worlds(1, 3)).state.shape == (1, 20) and NO_ROWS.shape == (0, LISTED.WIDTH)


def test_ledger_columns__are_those_of_the_harm():
    state = np.arange(20.0)[None]
    first, total, count = ledger_columns(state, 3)
    assert (first.tolist(), total.tolist(), count.tolist()) == ([[14.0, 15.0]], [[16.0, 17.0]], [[18, 19]])
    assert count.dtype == np.int64
