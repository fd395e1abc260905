"""The pairwise closed form: cases by hand, then properties, then against the event-exact physics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from ethbrake_marl.agents.e_v2x_bm import (
    CANDIDATES,
    closing_speed_squared,
    least_to_spare_front,
    most_to_spare_rear,
    optimise_pairwise,
    pairwise_harm,
)
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Worlds, advance, make_worlds

Array = NDArray[np.float64]


def wide_worlds(n: int, vehicles: int, seed: int, *, front_first: bool = False, exact_zeros: bool = False) -> Worlds:
    """Lines far beyond the paper's ranges; ``front_first``: each vehicle may brake no earlier than the one ahead."""
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(0, 60, (n, vehicles - 1)) * rng.choice([0.05, 0.3, 1.0], (n, 1))
    speeds = rng.uniform(0, 35, (n, vehicles))
    latency = rng.uniform(0, 2.5, (n, vehicles))
    if exact_zeros:
        for part in (gaps, speeds, latency):
            part[rng.random(part.shape) < 0.1] = 0.0
    return make_worlds(
        gaps,
        speeds,
        braking_capacity_mps2=rng.uniform(1, 10, (n, vehicles)),
        driving_capacity_mps2=3,
        latency_s=np.sort(latency, axis=1) if front_first else latency,
        mass_t=5,
        restitution=0.1,
    )


def harm_of_pairs(worlds: Worlds, vehicle: int, deceleration: Array) -> tuple[Array, Array]:
    """Harm of the front and of the rear pair of ``vehicle``, zero where there is none."""
    everyone = worlds.vehicles.braking_capacity_mps2.copy()
    everyone[:, vehicle] = deceleration
    padded = np.pad(pairwise_harm(worlds, everyone), ((0, 0), (1, 1)))
    return padded[:, vehicle], padded[:, vehicle + 1]


# gap, v_l, a_l, onset_l, v_f, a_f, onset_f -> squared closing speed
BY_HAND = {
    "A: leader brakes, follower coasts": ((8, 10, 4, 0, 10, 5, 5), 64.0),  # gap falls by 2 t^2: t = 2
    "A': leader at rest, follower coasts": ((10, 4, 4, 0, 6, 5, 5), 36.0),  # 2 m to rest, 12 m at 6 m/s: t = 2
    "B: both brake": ((9, 20, 4, 0, 22, 2, 0), 40.0),  # 2^2 + 2 * 2 * 9
    "C: leader at rest, follower brakes": ((10, 4, 4, 0, 10, 2, 0), 52.0),  # 100 - 2 * 2 * 12
    "both coast": ((4, 10, 5, 3, 12, 5, 4), 4.0),  # 4 m at 2 m/s: t = 2
    "follower brakes, leader still coasts": ((3, 10, 5, 9, 14, 2, 0), 4.0),  # 16 - 2 * 2 * 3
    "follower brakes first, both brake": ((4.5, 10, 6, 1, 13, 2, 0), 21.0),  # at 1 s: gap 2.5, w = 1; 1 + 2 * 4 * 2.5
    "touch": ((4, 10, 5, 9, 14, 2, 0), 0.0),  # 16 - 2 * 2 * 4
    "just spared at rest": ((12, 4, 4, 0, 10, 50 / 14, 0), 0.0),
    "opening": ((4, 12, 2, 0, 10, 5, 0), 0.0),
    "nobody brakes, opening": ((4, 12, 0, 0, 10, 0, 0), 0.0),
    "standing follower": ((4, 12, 2, 0, 0, 5, 0), 0.0),
    "standing leader, no brakes": ((5, 0, 2, 0, 3, 0, 0), 9.0),
    "touching and opening, then caught": ((0, 12, 4, 0, 10, 1, 9), 4.0),  # w = -2: closes again at +2
    "pressed together": ((0, 10, 4, 0, 10, 1, 9), 0.0),
}


@pytest.mark.parametrize("case", BY_HAND)
def test_closing_speed__by_hand(case):
    pair, expected = BY_HAND[case]
    assert closing_speed_squared(*map(float, pair)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        ((12, 4, 4, 0, 10, 0), 100 / 28),  # 14 m to stop from 10 m/s
        ((10, 20, 5, 0, 10, 0), 0.5 * 100 / 50),  # 50 m
        ((2, 30, 3, 0, 33, 0), 3 + 9 / 4),  # would stop first, but grazes while both move
        ((4, 10, 5, 9, 14, 0), 2.0),  # grazes the coasting leader, then stops in 4 + 90 + 10 = 104 m > 49 m
        ((4, 10, 5, 3, 12, 4), math.inf),  # they meet while both coast
        ((8, 10, 4, 0, 10, 5), math.inf),  # they meet before the follower may brake
        ((1, 10, 4, 0, 0, 5), 0.0),
    ],
)
def test_least_to_spare_front__by_hand(pair, expected):
    assert least_to_spare_front(*map(float, pair)) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        ((5, 10, 0, 10, 5, 0), 10.0),  # the follower needs 10 m, the leader may stop in 5
        ((11, 10, 0, 10, 5, 0), math.inf),  # the follower stops within the gap
        ((2, 30, 0, 33, 3, 0), 0.75),  # grazing: 9 = 2 (3 - a) 2
        ((1, 10, 0, 14, 2, 0), -math.inf),  # even a coasting leader is hit
        ((4, 10, 3, 12, 5, 4), -math.inf),  # they meet while both coast
        ((3, 10, 9, 14, 2, 0), -math.inf),  # hit before it may brake
        ((20, 10, 9, 14, 2, 0), math.inf),  # the follower is at rest before the leader brakes
        ((5, 0, 0, 3, 9, 0), math.inf),  # a standing leader out of reach,
        ((5, 0, 0, 10, 5, 0), -math.inf),  # and within
        ((0, 10, 0, 10, 5, 0.5), math.inf),  # pressed together: no impact
    ],
)
def test_most_to_spare_rear__by_hand(pair, expected):
    assert most_to_spare_rear(*map(float, pair)) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("exact_zeros", [False, True])
def test_closing_speed__equals_the_first_impact_of_the_event_exact_physics(exact_zeros):
    worlds = wide_worlds(8000, 2, seed=11, exact_zeros=exact_zeros)
    share = np.random.default_rng(12).uniform(0.05, 1, worlds.speeds_mps.shape)
    deceleration = worlds.vehicles.braking_capacity_mps2 * share
    _, impacts = advance(worlds, -deceleration, until_s=1000.0, record=True)
    assert impacts.rows is not None
    first = impacts.rows.first
    simulated = np.zeros(worlds.n)
    simulated[impacts.rows.world[first]] = impacts.rows.closing_speed_mps[first] ** 2
    closed = pairwise_harm(worlds, deceleration)[:, 0]
    assert 0.3 < np.mean(closed > 0) < 0.7
    assert np.abs(closed - simulated).max() < 1e-9


def test_pairwise_harm__counts_latency_from_the_worlds_own_time():
    at_alert = wide_worlds(500, 2, seed=13)
    apart = at_alert.gaps_m[:, 0] > 0.2 * 35
    later, _ = advance(at_alert.take(apart), np.zeros((int(apart.sum()), 2)), until_s=0.2)
    braking = -later.vehicles.braking_capacity_mps2
    _, impacts = advance(later, braking, until_s=1000.0)
    closed = pairwise_harm(later, -braking)[:, 0]
    assert np.abs(closed - impacts.first_impact_harm[:, 0]).max() < 1e-9


@pytest.mark.parametrize(("vehicles", "vehicle"), [(3, 1), (2, 0), (2, 1), (5, 2)])
def test_optimum__is_not_above_a_fine_grid_and_is_attained(vehicles, vehicle):
    worlds = wide_worlds(2000, vehicles, seed=14, exact_zeros=vehicles == 3)
    best = optimise_pairwise(worlds, vehicle)
    capacity = worlds.vehicles.braking_capacity_mps2[:, vehicle]
    grid = np.full(worlds.n, np.inf)
    for share in np.linspace(0, 1, 501):
        grid = np.minimum(grid, np.add(*harm_of_pairs(worlds, vehicle, share * capacity)))
    assert np.all(best.harm <= grid + 1e-9)
    assert 0.2 < np.mean(best.harm > 0) < 0.9
    assert np.all((best.deceleration_mps2 >= 0) & (best.deceleration_mps2 <= capacity))
    attained = np.add(*harm_of_pairs(worlds, vehicle, best.deceleration_mps2))
    assert np.array_equal(attained, best.harm)


def test_thresholds__part_harm_from_no_harm():
    worlds = wide_worlds(2000, 3, seed=15, exact_zeros=True)
    # Touching at equal speeds never counts as an impact, at any deceleration.
    worlds = worlds.take(np.all((worlds.gaps_m > 0) | (np.diff(worlds.speeds_mps, axis=1) != 0), axis=1))
    best = optimise_pairwise(worlds, 1)
    low, high = best.spares_front_mps2, best.spares_rear_mps2
    for share in np.linspace(0, 1, 201):
        a = share * worlds.vehicles.braking_capacity_mps2[:, 1]
        front, rear = harm_of_pairs(worlds, 1, a)
        assert not np.any((front > 0) & (a >= low)) and not np.any((front == 0) & (a < low - 1e-6))
        assert not np.any((rear > 0) & (a <= high)) and not np.any((rear == 0) & (a > high + 1e-6))


def test_pairs__front_harm_never_rises_and_rear_harm_never_falls_with_deceleration():
    worlds = wide_worlds(2000, 3, seed=16, front_first=True)
    front_before, rear_before = np.full(worlds.n, np.inf), np.zeros(worlds.n)
    for share in np.linspace(0, 1, 201):
        front, rear = harm_of_pairs(worlds, 1, share * worlds.vehicles.braking_capacity_mps2[:, 1])
        assert np.all(front <= front_before + 1e-10) and np.all(rear >= rear_before - 1e-10)
        front_before, rear_before = front, rear


def test_optimum__takes_the_middle_of_a_flat_minimum():
    # The front pair meets while both coast, whatever vehicle 2 does; the rear pair is spared up to 5 m/s2.
    worlds = make_worlds(
        [1.0, 5.0],
        [10.0, 12.0, 12.0],
        braking_capacity_mps2=[5, 8, 5],
        driving_capacity_mps2=0,
        latency_s=[1.0, 1.0, 1.0],
        mass_t=1,
        restitution=0,
    )
    best = optimise_pairwise(worlds, 1)
    # The rear one stops in 14.4 m, so vehicle 2 may stop in 9.4 m: 7.66 m/s2.
    assert best.spares_rear_mps2[0] == pytest.approx(72 / 9.4)
    assert best.spares_front_mps2[0] == math.inf
    assert best.harm[0] == 4.0
    assert best.deceleration_mps2[0] == pytest.approx(36 / 9.4)


def test_breakpoints__are_finite_and_inside_the_capacity():
    worlds = wide_worlds(500, 3, seed=17, exact_zeros=True)
    at = optimise_pairwise(worlds, 1).breakpoints_mps2
    assert at.shape == (500, CANDIDATES)
    assert np.all((at >= 0) & (at <= worlds.vehicles.braking_capacity_mps2[:, 1:2]))


@pytest.mark.parametrize("vehicle", [-1, 3])
def test_optimise__refuses_a_vehicle_that_is_not_in_the_line(vehicle):
    with pytest.raises(InvalidInput, match=r"index in 0\.\.2"):
        optimise_pairwise(wide_worlds(2, 3, seed=1), vehicle)


@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf])
def test_pairwise_harm__refuses_a_bad_deceleration(bad):
    with pytest.raises(InvalidInput, match=r"deceleration_mps2\[0, 1\]"):
        pairwise_harm(wide_worlds(2, 3, seed=1), [1.0, bad, 1.0])
