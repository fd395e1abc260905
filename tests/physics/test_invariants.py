"""What always holds, with the tolerances published in ``tests/reference/tolerances.py``."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.physics import Worlds, advance, make_worlds
from tests.physics.random_worlds import (
    Watched,
    driving_lines,
    energy_rise_eps,
    momentum_eps,
    restitution_eps,
    rounds,
    touching_lines,
)
from tests.reference.tolerances import ENERGY_EPS, EPS, GAP_M, MOMENTUM_EPS, RESTITUTION_EPS, SMALLEST

SPEED = st.just(0.0) | st.floats(SMALLEST, 40.0)
MASS = st.floats(1e-2, 1e4)


def pair(speeds: tuple[float, float], mass: tuple[float, float], e: float) -> Worlds:
    """Two touching vehicles."""
    return make_worlds(
        [0.0], speeds, braking_capacity_mps2=9, driving_capacity_mps2=9, latency_s=0, mass_t=mass, restitution=e
    )


@settings(max_examples=400)
@given(SPEED, SPEED, MASS, MASS, st.floats(0.0, 1.0))
def test_impact__of_two_conserves_momentum_and_obeys_restitution(front, rear, m_front, m_rear, e):
    after, impacts = advance(pair((front, rear), (m_front, m_rear), e), [0.0, 0.0], 0.0)
    before, now = [Fraction(front), Fraction(rear)], [Fraction(float(v)) for v in after.speeds_mps[0]]
    mass = [Fraction(m_front), Fraction(m_rear)]
    if rear <= front:
        assert now == before and impacts.count[0, 0] == 0
        return
    scale = sum(m * max(abs(v), abs(u)) for m, v, u in zip(mass, before, now, strict=True))
    assert abs(sum(m * (u - v) for m, v, u in zip(mass, before, now, strict=True))) <= MOMENTUM_EPS * EPS * scale
    closing = before[1] - before[0]
    bounce = Fraction(e) if rear - front >= 0.05 else 0
    assert abs(now[0] - now[1] - bounce * closing) <= RESTITUTION_EPS * EPS * max(map(abs, [*before, *now]))
    energy = [sum(m * v * v for m, v in zip(mass, speeds, strict=True)) for speeds in (before, now)]
    assert energy[1] <= energy[0] * (1 + Fraction(ENERGY_EPS * EPS))
    assert impacts.count[0, 0] == (rear - front > 1e-5)
    assert impacts.total_harm[0, 0] == ((rear - front) ** 2 if rear - front > 1e-5 else 0.0)


@pytest.mark.parametrize("ratio", [1.0, 1e3, 1e6])
@pytest.mark.parametrize("N", [2, 3, 5, 20])
def test_impact__of_a_whole_cluster_conserves_momentum_and_loses_energy(N, ratio):
    before, command = touching_lines(31, 20_000 // N, N, heaviest_ratio=ratio)
    after, impacts = advance(before, command, 0.0)
    assert impacts.count.sum() > 3_000
    assert np.max(momentum_eps(before, after) / rounds(impacts)) <= MOMENTUM_EPS
    assert np.max(energy_rise_eps(before, after) / rounds(impacts)) <= ENERGY_EPS
    if N == 2:
        assert np.max(restitution_eps(before, after)) <= RESTITUTION_EPS
    assert np.all(after.speeds_mps[:, 1:] <= after.speeds_mps[:, :-1], where=after.gaps_m == 0.0)


def test_impact__a_heavy_vehicle_behind_a_fast_light_one_keeps_its_momentum():
    # One touching line: vehicle 1 already leaves; 2 (heavy, almost at rest) is struck by 3. Speeds taken relative to
    # vehicle 1 lost the digits of vehicle 2: 600 eps.
    before = make_worlds(
        [0.0, 0.0], [29.7, 0.013, 11.1], braking_capacity_mps2=9, driving_capacity_mps2=9, latency_s=0,
        mass_t=[0.7, 6100.0, 0.9], restitution=0.3,
    )  # fmt: skip
    after, impacts = advance(before, [0.0, 0.0, 0.0], 0.0)
    assert impacts.count.tolist() == [[0, 1]]
    assert momentum_eps(before, after)[0] <= MOMENTUM_EPS
    assert after.speeds_mps[0, 0] == 29.7  # nobody strikes it: not a bit changes


@pytest.mark.parametrize(
    ("speeds", "mass", "e"),
    [
        (
            [16.39952456911204, 15.75974805715059, 20.95326948476989],
            [2.8732803583387705, 6.81595348368118, 1.3604769656110456],
            0.9,
        ),
        (
            [0.8101434192213031, 8.398175828005087, 8.274889265517407,
             13.924489716132891, 11.810988245291215, 5.587596092116025],
            [7.889487053694922, 4591.572684725916, 5.034824118112325,
             5.7091832788539785, 3.783523066440141, 7.548945205044989],
            0.9,
        ),
    ],
)  # fmt: skip
def test_impact__the_common_speed_of_a_block_is_refined(speeds, mass, e):
    # among millions of lines those where the plain weighted mean, without its refinement, is off by 4.5 and 5.6 eps
    before = make_worlds(
        np.zeros(len(speeds) - 1), speeds, braking_capacity_mps2=9, driving_capacity_mps2=9, latency_s=0, mass_t=mass,
        restitution=e,
    )  # fmt: skip
    after, _ = advance(before, np.zeros(len(speeds)), 0.0)
    assert momentum_eps(before, after)[0] <= MOMENTUM_EPS


def test_impact__of_speeds_below_the_range_of_doubles_moves_by_less_than_their_spacing():
    # 5e-324 m/s has no half: relative tolerances end at SMALLEST, nothing else happens
    least = 5e-324
    after, impacts = advance(pair((0.0, least), (1.0, 1.0), 0.5), [0.0, 0.0], 0.0)
    assert impacts.count.tolist() == [[0]] and after.gaps_m.tolist() == [[0.0]]
    assert after.speeds_mps[0, 0] == after.speeds_mps[0, 1] and 0.0 <= after.speeds_mps[0, 0] <= least


def test_impact__a_pair_that_separates_is_left_alone_to_the_last_bit():
    rng = np.random.default_rng(0)
    rear = rng.uniform(0.0, 30.0, 2_000)
    front = rear + rng.uniform(0.0, 1.0, 2_000) * rng.choice([0.0, 1e-12, 1.0], 2_000)
    before = make_worlds(
        np.zeros((2_000, 1)), np.stack([front, rear], axis=1), braking_capacity_mps2=9, driving_capacity_mps2=9,
        latency_s=0, mass_t=rng.uniform(1, 9, (2_000, 2)), restitution=0.5,
    )  # fmt: skip
    after, impacts = advance(before, np.zeros((2_000, 2)), 0.0)
    assert after.speeds_mps.tobytes() == before.speeds_mps.tobytes() and impacts.count.sum() == 0


@pytest.mark.parametrize("N", [2, 3, 5])
@pytest.mark.parametrize("drive", [False, True])
def test_motion__gaps_follow_the_speeds_and_never_turn_negative(N, drive):
    motion = Watched(41, 400, N, drive=drive)
    assert motion.checked > 0.7 * 400 * 300
    assert motion.worst <= GAP_M
    assert min(state.gaps_m.min() for state in motion.states) >= 0.0


@pytest.mark.parametrize("N", [2, 3, 5])
def test_motion__under_brakes_nothing_speeds_up_and_only_a_bounce_back_is_negative(N):
    motion = Watched(42, 150, N, drive=False)
    assert motion.energy_rises() == 0
    assert motion.unexplained_negative_speeds() == 0
    assert sum(int((state.speeds_mps < 0.0).sum()) for state in motion.states) > 0


@pytest.mark.parametrize("N", [2, 4])
def test_motion__driving_ends_at_the_limit_unless_pushed(N):
    motion = Watched(43, 150, N, drive=True)
    limit, reached = motion.start.vehicles.speed_limit_mps, 0
    for state in motion.states:
        alone = ~state.pair_hit.any(axis=1)
        assert np.all((state.speeds_mps <= limit)[alone])
        reached += int((state.speeds_mps == limit)[alone].sum())
    assert reached > 100


def test_speeds__are_never_negative_without_restitution():
    start, command = driving_lines(44, 2_000, 4, drive=False)
    plastic = make_worlds(
        start.gaps_m, start.speeds_mps, braking_capacity_mps2=8, driving_capacity_mps2=8,
        latency_s=start.vehicles.latency_s, mass_t=start.vehicles.mass_t, restitution=0.0,
    )  # fmt: skip
    for until in np.linspace(0.1, 8.0, 80):
        plastic, _ = advance(plastic, command, until_s=until)
        assert plastic.speeds_mps.min() >= 0.0
    assert plastic.pair_hit.sum() > 2_000
