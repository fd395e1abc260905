"""What always holds, and what must not matter, with the tolerances of ``tests/reference/tolerances.py``."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.left_out import Impacts
from ethbrake_marl.first_edition.physics.state import Worlds
from tests.first_edition.physics.random_worlds import (
    HARMS,
    HORIZON_S,
    Batch,
    Draws,
    Watched,
    driving_lines,
    energy_rise_eps,
    last_digit_errors,
    line,
    momentum_eps,
    nearly_joined,
    once,
    place_ahead,
    restitution_eps,
    rounds,
    split_errors,
    state_bytes,
    thrown_lines,
    touching_lines,
)
from tests.reference.tolerances import ENERGY_EPS, GAP_M, MOMENTUM_EPS, RESTITUTION_EPS, SMALLEST, SPLIT, SPLIT_CASCADE

SPEED = st.just(0.0) | st.floats(SMALLEST, 40.0)
MASS = st.floats(1e-2, 1e4)

# ---------------------------------------------------------------- impacts


@settings(max_examples=400)
@given(SPEED, SPEED, MASS, MASS, st.floats(0.0, 1.0))
def test_impact__of_two_conserves_momentum_and_obeys_restitution(front, rear, m_front, m_rear, e):
    before = line([0.0], (front, rear), mass_t=(m_front, m_rear), restitution=e)
    after, impacts = advance(before, 0.0, 0.0)
    if rear <= front:
        assert after.speeds_mps.tolist() == [[front, rear]] and impacts.count[0, 0] == 0
        return
    assert momentum_eps(before, after)[0] <= MOMENTUM_EPS and energy_rise_eps(before, after)[0] <= ENERGY_EPS
    assert restitution_eps(before, after)[0] <= RESTITUTION_EPS and impacts.count[0, 0] == (rear - front > 1e-5)
    assert impacts.total_harm[0, 0] == ((rear - front) ** 2 if rear - front > 1e-5 else 0.0)


@pytest.mark.parametrize("ratio", [1.0, 1e3, 1e6])
@pytest.mark.parametrize("N", [2, 3, 5, 20])
def test_impact__of_a_whole_cluster_conserves_momentum_and_loses_energy(N, ratio):
    before, command = touching_lines(31, 20_000 // N, N, heaviest_ratio=ratio)
    after, impacts = advance(before, command, 0.0)
    assert impacts.count.sum() > 3_000 and np.max(momentum_eps(before, after) / rounds(impacts)) <= MOMENTUM_EPS
    assert np.max(energy_rise_eps(before, after) / rounds(impacts)) <= ENERGY_EPS
    if N == 2:
        assert np.max(restitution_eps(before, after)) <= RESTITUTION_EPS
    assert np.all(after.speeds_mps[:, 1:] <= after.speeds_mps[:, :-1], where=after.gaps_m == 0.0)


@pytest.mark.parametrize(
    ("speeds", "mass", "e"),
    [
        # Vehicle 1 already leaves; 2 (heavy, almost at rest) is struck by 3. Speeds taken relative to vehicle 1 lost
        # the digits of vehicle 2: 600 eps.
        ([29.7, 0.013, 11.1], [0.7, 6100.0, 0.9], 0.3),
        # Among millions of lines, where the plain weighted mean, without its refinement, is off by 4.5 and 5.6 eps.
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
def test_impact__keeps_the_last_digits_of_momentum(speeds, mass, e):
    before = line(np.zeros(len(speeds) - 1), speeds, mass_t=mass, restitution=e)
    after, _ = advance(before, 0.0, 0.0)
    assert momentum_eps(before, after)[0] <= MOMENTUM_EPS
    assert after.speeds_mps[0, 0] == speeds[0] or speeds[0] < 29.0  # whom nobody strikes keeps every bit


# ---------------------------------------------------------------- every instant ends


@pytest.mark.parametrize(("N", "n"), [(2, 2_000), (3, 4_000), (5, 4_000), (10, 2_000), (50, 200)])
@pytest.mark.parametrize("obstacle", [False, True])
def test_nearly_joined__lines_of_any_length_come_to_an_order(N, n, obstacle):
    worlds = nearly_joined(91, n, N, obstacle=obstacle)
    approaching = (np.diff(worlds.speeds_mps, axis=1) > 0.0).any(axis=1) | (obstacle & (worlds.speeds_mps[:, 0] > 0.0))
    assert approaching.mean() > 0.2
    after, impacts = advance(worlds, 0.0, 0.0)
    assert np.all(np.diff(after.speeds_mps, axis=1) <= 0.0)
    assert impacts.count.sum() == 0  # they are touches
    if obstacle:
        assert np.all(after.speeds_mps <= 0.0)
    else:
        assert np.max(momentum_eps(worlds, after)) <= MOMENTUM_EPS
    most = np.abs(worlds.speeds_mps).max(axis=1, keepdims=True)
    assert np.all(np.abs(after.speeds_mps - worlds.speeds_mps) <= (2.0 if obstacle else 4e-15) * most)


@pytest.mark.parametrize(("N", "n"), [(3, 2_000), (10, 1_000), (50, 40)])
def test_thrown_lines__against_an_obstacle_come_to_their_end(N, n):
    worlds, command = thrown_lines(93, n, N)
    after, impacts = advance(worlds, command, until_s=8.0)
    assert np.isfinite(after.speeds_mps).all() and (impacts.obstacle_count > 0).mean() > 0.3


# ---------------------------------------------------------------- motion


@pytest.mark.parametrize("N", [2, 3, 5])
@pytest.mark.parametrize("drive", [False, True])
def test_motion__gaps_follow_the_speeds_and_nothing_speeds_up_but_by_driving_to_its_limit_or_a_push(N, drive):
    motion = Watched(41, 150, N, drive=drive)
    assert motion.checked > 0.7 * 150 * 300 and motion.worst <= GAP_M
    assert min(state.gaps_m.min() for state in motion.states) >= 0.0
    if drive:
        speeds = np.stack([state.speeds_mps for state in motion.states])
        alone = np.stack([~state.pair_hit.any(axis=1) for state in motion.states])
        limit = motion.start.vehicles.speed_limit_mps
        assert (speeds <= limit)[alone].all() and (speeds == limit)[alone].sum() > 100
    else:
        assert (motion.energy_rises(), motion.unexplained_negative_speeds()) == (0, 0)
        assert sum(int((state.speeds_mps < 0.0).sum()) for state in motion.states) > 0


def test_resting__members_of_a_block_keep_the_same_bits():
    draws = Draws(74)
    n, N = 200, 12
    worlds = line(np.zeros((n, N - 1)), np.full((n, N), 10.0), mass_t=draws.uniform(0.5, 8.0, (n, N)), restitution=0.5)
    command = draws.uniform(-16.0, 16.0, (n, N))
    for until in (0.1, 0.35, 1.0, 5.0):
        worlds, impacts = advance(worlds, command, until_s=until)
        touching = worlds.gaps_m == 0.0
        assert np.all((worlds.speeds_mps[:, 1:] == worlds.speeds_mps[:, :-1])[touching])
        assert impacts.count.sum() == 0 and touching.any() and not touching.all()


# ---------------------------------------------------------------- how a segment is cut


@pytest.mark.parametrize("N", [2, 3, 5, 10])
@pytest.mark.parametrize("cuts", [2, 7, 80])
def test_split__changes_nothing_beyond_rounding(N, cuts):
    error, few, other = split_errors(N, 4_000 // N, cuts, 61)
    assert few.any() and not other.any()
    assert np.max(error[few], initial=0.0) <= SPLIT and np.max(error[~few], initial=0.0) <= SPLIT_CASCADE


def test_split__of_cascades_changes_no_more_than_ten_times_what_the_last_digit_of_a_gap_changes():
    cut, digit = split_errors(20, 400, 7, 61), last_digit_errors(20, 400, 61)
    assert (~cut.few).sum() > 100 and cut.error[~cut.few].max() <= 10.0 * digit.error[~digit.few].max()


# ---------------------------------------------------------------- the origin, the batch, units and neighbours


@pytest.mark.parametrize("shift", [-0.5, 64.0, 1024.0])
def test_origin__of_time_does_not_matter_to_the_last_bit(shift):
    # Times on a grid, so that the shifted ones are doubles too. (Positions are not stored: space has no origin.)
    batch = driving_lines(62, 1_000, 4)
    v = batch.worlds.vehicles
    latency = np.round(v.latency_s * 2**20) / 2**20
    grid = replace(batch.worlds, vehicles=replace(v, latency_s=latency))
    moved = replace(grid, vehicles=replace(v, latency_s=latency + shift), time_s=grid.time_s + shift)
    here, impacts = advance(grid, batch.command, until_s=HORIZON_S, record=True)
    there, same = advance(moved, batch.command, until_s=HORIZON_S + shift, record=True)
    assert state_bytes(here, impacts) == state_bytes(replace(there, time_s=there.time_s - shift), same)
    np.testing.assert_allclose(same.rows.time_s - shift, impacts.rows.time_s, rtol=0, atol=1e-12)
    assert impacts.count.sum() > 1_000


@pytest.mark.parametrize("N", [2, 3, 7])
def test_batch__a_world_among_others_with_and_without_obstacles_is_as_alone_and_inputs_stay(N):
    plain, ahead = driving_lines(63, 150, N), place_ahead(driving_lines(167, 50, N), 168)
    order = np.random.default_rng(1).permutation(200)
    worlds = Worlds.concatenate([plain.worlds, ahead.worlds]).take(order)
    command = np.concatenate([plain.command, ahead.command])[order]
    nothing = Impacts(*(np.zeros(0) for _ in HARMS))
    before = state_bytes(worlds, nothing)
    whole, impacts = advance(worlds, command, until_s=HORIZON_S, record=True, threads=2)
    parts = [once(Batch(worlds.take([k]), command[[k]])) for k in range(200)]
    harm = Impacts(*(np.concatenate([getattr(each, name) for _, each in parts]) for name in HARMS))
    assert state_bytes(Worlds.concatenate([world for world, _ in parts]), harm) == state_bytes(whole, impacts)
    listed = [(k, pair) for k, (_, each) in enumerate(parts) for pair in each.rows.pair]
    assert list(zip(impacts.rows.world, impacts.rows.pair, strict=True)) == listed and len(listed) > 100
    assert state_bytes(worlds, nothing) == before


def test_obstacle__out_of_reach_changes_no_bit():
    batch = driving_lines(163, 400, 3)
    without, impacts = once(batch)
    ahead, same = once(Batch(replace(batch.worlds, obstacle_gap_m=np.full(400, 1e4)), batch.command))
    assert np.isfinite(ahead.obstacle_gap_m).all() and not same.obstacle_count.any()
    assert state_bytes(replace(ahead, obstacle_gap_m=without.obstacle_gap_m), same) == state_bytes(without, impacts)
    assert np.array_equal(same.rows.pair, impacts.rows.pair) and len(same.rows.pair) > 200


def test_units__masses_in_other_units_give_the_same_bits():
    batch = driving_lines(66, 1_000, 4)
    v = batch.worlds.vehicles
    heavy = replace(batch.worlds, vehicles=replace(v, mass_t=v.mass_t * 1024.0))
    assert state_bytes(*once(Batch(heavy, batch.command))) == state_bytes(*once(batch))
