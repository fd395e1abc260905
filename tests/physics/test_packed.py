"""Worlds by rows: nothing is lost, nothing is shared."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.physics import advance, make_worlds
from ethbrake_marl.physics.packed import Packed, ledger_columns, pack, unpack


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


@pytest.mark.parametrize(("n", "vehicles"), [(1, 2), (1, 3), (40, 3), (7, 6)])
def test_unpack__gives_back_every_bit_in_its_own_memory(n, vehicles):
    given = worlds(n, vehicles)
    packed = pack(given)
    back = unpack(packed)
    packed.state[:], packed.params[:] = -1.0, -1.0
    for part, again in ((given, back), (given.vehicles, back.vehicles)):
        for name in part.__slots__:
            value = getattr(part, name)
            if name != "vehicles":
                np.testing.assert_array_equal(getattr(again, name), value, strict=True)


def test_ledger_columns__are_in_their_own_memory():
    packed = pack(worlds(1, 3))
    first, total, count = ledger_columns(packed.state, 3)
    packed.state[:] = 5.0
    assert first.tolist() == total.tolist() == count.tolist() == [[0.0, 0.0]]
    assert isinstance(packed, Packed)
