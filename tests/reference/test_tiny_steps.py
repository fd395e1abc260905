"""The reference itself, against cases that a person can work out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.reference.tiny_steps import Outcome, simulate

near = pytest.approx


def speeds(outcome: Outcome) -> list[float]:
    return [float(v) for v in outcome.speeds_mps[0]]


def test_simulate__coasting_pair_meets_by_equation_13() -> None:
    # Meets after 5 m / 5 m/s = 1 s. 10 + 3/5 * 1.2 * 5 = 13.6 and 15 - 2/5 * 1.2 * 5 = 12.6; one more second opens 1 m.
    outcome = simulate([5.0], [10.0, 15.0], [0.0, 0.0], mass_t=[2.0, 3.0], restitution=0.2, horizon_s=2.0)
    assert outcome.first_impact_harm[0] == near([25.0])
    assert outcome.total_harm[0] == near([25.0])
    assert outcome.count[0].tolist() == [1]
    assert speeds(outcome) == near([13.6, 12.6])
    assert outcome.gaps_m[0] == near([1.0])
    assert outcome.driven_impulse[0] == near(0.0, abs=1e-12)
    assert outcome.momentum_error[0] < 1e-12


def test_simulate__latency_lets_the_follower_coast_into_a_braking_leader() -> None:
    # w^2 = 0 + 2 * 6 * 3 = 36 at t = 1 s, long before the follower's latency of 5 s has elapsed.
    outcome = simulate([3.0], [20.0, 20.0], [-6.0, -6.0], latency_s=[0.0, 5.0], horizon_s=1.5)
    assert outcome.first_impact_harm[0] == near([36.0], abs=1e-5)
    # Plastic, equal masses: 17 m/s, then the leader brakes and pushes back on the coasting follower: -3 m/s2 for 0.5 s.
    assert speeds(outcome) == near([15.5, 15.5], abs=1e-6)
    assert outcome.driven_impulse[0] == near(-6.0 * 1.5, abs=1e-6)


def test_simulate__latency_inside_a_step_acts_at_its_exact_moment() -> None:
    outcome = simulate([50.0], [20.0, 20.0], [0.0, -6.0], latency_s=0.123456, horizon_s=1.123456, step_s=0.01)
    assert speeds(outcome) == near([20.0, 14.0])
    assert outcome.gaps_m[0] == near([53.0])


def test_simulate__standing_obstacle_is_hit_and_both_stop_together_after_one_impact() -> None:
    # 10^2 - 2 * 5 * 7.5 = 25. Plastic, equal masses: 2.5 m/s each; the rear brakes less, presses, and they stop as one.
    outcome = simulate([7.5], [0.0, 10.0], [-6.0, -5.0])
    assert outcome.first_impact_harm[0] == near([25.0])
    assert outcome.count[0].tolist() == [1]
    assert speeds(outcome) == [0.0, 0.0]
    assert outcome.gaps_m[0] == near([0.0], abs=1e-12)
    assert outcome.driven_impulse[0] == near(-10.0)


def test_simulate__light_striker_bounces_back_and_its_brakes_stop_it_from_below() -> None:
    # m_rear = 1 < e m_front = 2.4. Rear: 9 - 8/9 * 1.3 * 9 = -1.4; front: 1/9 * 1.3 * 9 = 1.3.
    # Stopping ways 1.4^2 / 14 = 0.14 backwards and 1.3^2 / 13 = 0.13 forwards.
    world = {"mass_t": [8.0, 1.0], "restitution": 0.3, "step_s": 1e-4}
    just_after = simulate([1e-9], [0.0, 9.0], [-6.5, -7.0], horizon_s=1.2e-9, **world)
    assert speeds(just_after) == near([1.3, -1.4], abs=1e-6)
    rest = simulate([1e-9], [0.0, 9.0], [-6.5, -7.0], **world)
    assert rest.first_impact_harm[0] == near([81.0])
    assert speeds(rest) == [0.0, 0.0]
    assert rest.gaps_m[0] == near([0.27], abs=1e-6)
    assert rest.momentum_error[0] < 1e-12


@pytest.mark.parametrize(
    ("before", "masses", "e", "after", "harms"),
    [
        ([5.0, 10.0, 15.0], [1.0, 2.0, 1.0], 0.5, [12.5, 10.0, 7.5], [25.0, 25.0]),  # P = 40/4 = 10
        ([0.0, 4.0, 10.0], [1.0, 1.0, 2.0], 0.25, [7.5, 6.5, 5.0], [16.0, 36.0]),  # P = 24/4 = 6
    ],
)
def test_simulate__three_vehicles_meeting_at_once_follow_the_order_free_law(
    before: list[float], masses: list[float], e: float, after: list[float], harms: list[float]
) -> None:
    outcome = simulate([0.0, 0.0], before, [0.0] * 3, mass_t=masses, restitution=e, horizon_s=2.0)
    assert speeds(outcome) == near(after)
    assert outcome.first_impact_harm[0] == near(harms)
    assert outcome.gaps_m[0] == near([2.0 * (after[0] - after[1]), 2.0 * (after[1] - after[2])])
    assert outcome.momentum_error[0] < 1e-12


def test_simulate__resting_neighbour_is_moved_by_a_blow_but_bears_no_harm() -> None:
    # P = (5 * 10) / 10 = 5 for all; v+ = 1.1 * 5 - 0.1 v.
    outcome = simulate([0.0, 10.0], [0.0, 0.0, 10.0], [0.0] * 3, mass_t=[2.0, 3.0, 5.0], restitution=0.1, horizon_s=2.0)
    assert speeds(outcome) == near([5.5, 5.5, 4.5])
    assert outcome.total_harm[0] == near([0.0, 100.0])
    assert outcome.count[0].tolist() == [0, 1]
    assert outcome.gaps_m[0] == near([0.0, 1.0], abs=1e-9)


@pytest.mark.parametrize(("gap", "harm"), [(0.0, 0.0), (1e-200, 25.0), (1e-12, 25.0)])
def test_simulate__impacts_at_different_instants_stay_apart_however_close(gap: float, harm: float) -> None:
    # Plastic, equal masses. Vehicle 2 hits 1 and slows from 10 to 5 m/s; vehicle 3 hits it at 5 if a gap was open.
    outcome = simulate([1.0, gap], [0.0, 10.0, 10.0], [0.0] * 3, horizon_s=1.0)
    assert outcome.total_harm[0] == near([100.0, harm])
    assert speeds(outcome) == near([20.0 / 3.0] * 3)


@pytest.mark.parametrize(("gap", "harm"), [(4.01, 0.0), (4.0, 0.0), (3.99, 0.04)])
def test_simulate__grazing_pair_touches_without_harm(gap: float, harm: float) -> None:
    # The leader drives at +2 away from a closing speed of 4: D = 16 - 4 gap.
    outcome = simulate([gap], [10.0, 14.0], [2.0, 0.0], horizon_s=4.0)
    assert outcome.total_harm[0] == near([harm], abs=1e-7)
    assert outcome.count[0].tolist() == [int(harm > 0.0)]


@pytest.mark.parametrize(("push", "speed"), [(5.0, 0.0), (5.9999, 0.0), (7.0, 2.0)])
def test_simulate__holding_brake_yields_only_to_a_stronger_push(push: float, speed: float) -> None:
    # The front holds up to 4 t * 3 m/s2 = 12 kN; the rear pushes with 2 t * push; 6 s at (14 - 12) / 6 = 1/3 m/s2.
    outcome = simulate([0.0], [0.0, 0.0], [-3.0, push], mass_t=[4.0, 2.0], horizon_s=6.0)
    assert speeds(outcome) == near([speed, speed], abs=1e-9)
    assert outcome.count[0].tolist() == [0]


def test_simulate__pressing_makes_no_impacts_and_release_follows_the_free_accelerations() -> None:
    # Vehicles 2 and 3 press (-4 and +5): common (3 * 5 - 2 * 4) / 5 = 1.4; vehicle 1 drives away at +2.
    outcome = simulate([0.0, 0.0], [10.0] * 3, [2.0, -4.0, 5.0], mass_t=[7.0, 2.0, 3.0], horizon_s=2.0)
    assert speeds(outcome) == near([14.0, 12.8, 12.8])
    assert outcome.gaps_m[0] == near([1.2, 0.0], abs=1e-6)
    assert outcome.count[0].tolist() == [0, 0]


def test_simulate__motor_stops_at_the_speed_limit_also_while_pushing() -> None:
    alone = simulate([1.0], [25.0, 20.0], [0.0, 5.0], speed_limit_mps=25.0, horizon_s=3.0)
    assert speeds(alone) == [25.0, 25.0]
    assert alone.gaps_m[0] == near([3.5])
    pushing = simulate([0.0], [24.0, 24.0], [-2.0, 4.0], speed_limit_mps=25.0, horizon_s=3.0)  # +1 m/s2 for 1 s
    assert speeds(pushing) == [25.0, 25.0]


def test_simulate__bounces_sum_to_the_geometric_series_and_end_in_resting_contact() -> None:
    # 2 * 4 * 2 = 16; every closing speed is 0.3 of the last: 4, 1.2, 0.36, 0.108, 0.0324 m/s, and that one is plastic.
    outcome = simulate([2.0], [10.0, 10.0], [0.0, 4.0], restitution=0.3, horizon_s=4.0)
    assert outcome.total_harm[0] == near([16.0 * sum(0.09**k for k in range(5))], abs=1e-6)
    assert outcome.first_impact_harm[0] == near([16.0])
    assert outcome.count[0].tolist() == [5]
    assert outcome.gaps_m[0] == near([0.0], abs=1e-12)
    assert speeds(outcome) == near([18.0, 18.0])


def test_simulate__halving_the_step_changes_nothing_that_matters() -> None:
    rng = np.random.default_rng(1)
    shape = (20, 4)
    gaps, v, command = rng.uniform(1, 8, (20, 3)), rng.uniform(10, 20, shape), rng.uniform(-7, 3, shape)
    world = {"latency_s": rng.uniform(0, 1, shape), "mass_t": rng.uniform(1, 8, shape), "restitution": 0.1}
    coarse, fine = (simulate(gaps, v, command, step_s=h, horizon_s=6.0, **world) for h in (2e-4, 1e-4))
    assert fine.count.sum() > 20
    assert np.array_equal(coarse.count > 0, fine.count > 0)
    assert coarse.total_harm == near(fine.total_harm, abs=1e-3)
    assert coarse.gaps_m == near(fine.gaps_m, abs=1e-3)
    assert coarse.momentum_error.max() < 1e-12
