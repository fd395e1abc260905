"""The ledger: shares by mass, both counts."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import empty_ledger, injury_probability, split
from ethbrake_marl.physics import advance, make_worlds


def test_split__by_mass_as_in_the_paper():
    shares = split(np.array([[100.0, 0.0]]), np.array([[1.0, 3.0, 2.0]]))
    assert shares.tolist() == [[75.0, 25.0, 0.0]]


def test_split__shares_add_up_to_the_last_bit():
    rng = np.random.default_rng(0)
    mass = rng.uniform(0.5, 40.0, (20_000, 2))
    harm = rng.uniform(0.0, 900.0, (20_000, 1))
    shares = split(harm, mass)
    assert (shares[:, 0] + shares[:, 1] == harm[:, 0]).all()


def test_ledger__first_counts_one_impact_per_pair_and_total_all():
    worlds = make_worlds(
        [0.0], [0.0, 8.0], braking_capacity_mps2=10, driving_capacity_mps2=10, latency_s=0, mass_t=[1e15, 1.0],
        restitution=0.5,
    )  # fmt: skip
    ledger = empty_ledger(worlds)
    for _ in range(3):
        worlds, impacts = advance(worlds, [-10.0, 4.0], 2.5)
        ledger = ledger.add(impacts)
    assert ledger.world_harm("first").tolist() == [64.0]
    assert ledger.world_harm("total")[0] == pytest.approx(64.0 + 16.0 + 4.0 + 1.0, rel=0.01)
    assert ledger.collided.tolist() == [True]
    assert ledger.vehicle_harm("first").sum() == 64.0


def test_injury_probability__matches_its_formula():
    assert injury_probability(np.array([0.0]), "front")[0] == pytest.approx(1 / (1 + np.exp(4.457)))
    assert injury_probability(np.array([-10.0]), "rear")[0] == pytest.approx(1 / (1 + np.exp(4.888 - 1.77)))


def test_ledger__refuses_an_unknown_count():
    ledger = empty_ledger(make_worlds([5.0], [20.0, 20.0], braking_capacity_mps2=6, driving_capacity_mps2=6,
                                      latency_s=0, mass_t=1, restitution=0))  # fmt: skip
    for harm in (ledger.pair_harm, ledger.vehicle_harm, ledger.world_harm):
        with pytest.raises(InvalidInput, match="count 'frist': must be 'first' or 'total'"):
            harm("frist")
