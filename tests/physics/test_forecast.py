"""Forecasts are the same physics as the advance."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.physics import advance, forecast, make_worlds


def worlds(n=300):
    rng = np.random.default_rng(11)
    start = make_worlds(
        rng.uniform(2, 10, (n, 2)),
        rng.uniform(15, 22, (n, 3)),
        braking_capacity_mps2=[6.0, 7.0, 6.0],
        driving_capacity_mps2=[6.0, 7.0, 6.0],
        latency_s=[0.0, 0.5, 0.8],
        mass_t=[4.5, 5.5, 5.9],
        restitution=0.1,
    )
    return advance(start, [-6.0, 0.0, -6.0], until_s=rng.uniform(0.0, 3.0, n))[0]


def test_forecast__equals_the_advance_bit_for_bit():
    start = worlds()
    command = np.tile([-6.0, 99.0, -6.0], (start.n, 1))
    candidates = np.tile([-7.0, -4.0, 0.0, 3.0], (start.n, 1))
    first, total = forecast(start, command, 1, candidates, 8.0)
    assert (first > 0).sum() > 300 and (total > first).sum() > 50
    for c in range(candidates.shape[1]):
        command[:, 1] = candidates[:, c]
        _, impacts = advance(start, command, until_s=8.0)
        assert (impacts.first_impact_harm[:, 0] + impacts.first_impact_harm[:, 1]).tolist() == first[:, c].tolist()
        assert (impacts.total_harm[:, 0] + impacts.total_harm[:, 1]).tolist() == total[:, c].tolist()


@pytest.mark.parametrize("vehicle", [0, 1, 2])
@pytest.mark.parametrize("until", [2.0, 3.5])
def test_forecast__counts_up_to_its_end_for_any_vehicle_and_up_to_its_capacity(vehicle, until):
    start = worlds(60)
    start = start.take(start.time_s < until)
    capacity = start.vehicles.driving_capacity_mps2[0, vehicle]
    command = np.tile([-6.0, 2.0, -3.0], (start.n, 1))
    first, total = forecast(start, command, vehicle, np.full((start.n, 1), capacity), until)
    command[:, vehicle] = capacity
    _, impacts = advance(start, command, until_s=until)
    assert impacts.count.sum() > 5 and not (start.time_s + 1.0 < until).all()
    assert (impacts.first_impact_harm[:, 0] + impacts.first_impact_harm[:, 1]).tolist() == first[:, 0].tolist()
    assert (impacts.total_harm[:, 0] + impacts.total_harm[:, 1]).tolist() == total[:, 0].tolist()


@pytest.mark.parametrize(("until", "harm"), [(-1.0, 0.0), (0.0, 0.0), (1e-3, 64.0)])
def test_forecast__an_impact_that_is_due_counts_only_before_the_horizon(until, harm):
    start = make_worlds(
        [[0.0]], [0.0, 8.0], braking_capacity_mps2=9, driving_capacity_mps2=9, latency_s=0, mass_t=1, restitution=0
    )
    assert forecast(start, np.zeros((1, 2)), 0, np.zeros((1, 1)), until)[0].tolist() == [[harm]]


def test_forecast__a_world_at_the_horizon_has_no_harm_left():
    start, _ = advance(worlds(5), [-6.0, -7.0, -6.0], until_s=8.0)
    first, total = forecast(start, np.full((5, 3), -6.0), 1, np.full((5, 2), -1.0), 8.0)
    assert first.sum() == total.sum() == 0.0


@pytest.mark.parametrize(
    "call",
    [
        lambda w: forecast(w, np.zeros((5, 2)), 1, np.zeros((5, 1)), 8.0),
        lambda w: forecast(w, np.zeros((5, 3)), 3, np.zeros((5, 1)), 8.0),
        lambda w: forecast(w, np.zeros((5, 3)), -1, np.zeros((5, 1)), 8.0),
        lambda w: forecast(w, np.zeros((5, 3)), 1, np.full((5, 1), -7.5), 8.0),
        lambda w: forecast(w, np.zeros((5, 3)), 1, np.full((5, 1), np.nan), 8.0),
    ],
)
def test_bad_input__is_refused(call):
    with pytest.raises(InvalidInput, match="forecast"):
        call(worlds(5))


@pytest.mark.parametrize("k", [0, 1])
def test_overlap__that_no_advance_could_have_left_is_reported_with_its_world(k):
    # pair 0 meets, so the world goes event by event; pair 1 overlaps by 1 m and separates
    start = make_worlds(
        [[1.0, 1.0], [1.0, 1.0]], [0.0, 8.0, 4.0], braking_capacity_mps2=9, driving_capacity_mps2=9, latency_s=0,
        mass_t=1, restitution=0,
    )  # fmt: skip
    start.gaps_m[k, 1] = -1.0
    with pytest.raises(PhysicsError, match=f"^world {k}: a forecast could not reach 2 s"):
        forecast(start, np.zeros((2, 3)), 1, np.zeros((2, 1)), 2.0)
