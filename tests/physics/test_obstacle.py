"""An obstacle ahead of Vehicle 1 that nothing moves: numbers by hand, then the exact law and exact arithmetic."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import empty_ledger
from ethbrake_marl.physics import Worlds, advance, advance_sampled, forecast, make_worlds
from tests.physics.exact_simulator import line_of, simulate
from tests.physics.random_worlds import HARMS, HORIZON_S, Batch, Draws, driving_lines, state_bytes, touching_lines
from tests.reference.tolerances import CLUSTER_EPS, ENERGY_EPS, EPS, SPLIT


def line(obstacle_gap_m, gaps, speeds, restitution=0.5, mass_t=1.0) -> Worlds:
    return make_worlds(
        gaps, speeds, braking_capacity_mps2=6.0, driving_capacity_mps2=6.0, latency_s=0.0, mass_t=mass_t,
        restitution=restitution, obstacle_gap_m=obstacle_gap_m,
    )  # fmt: skip


def place_ahead(batch: Batch, key: int, low: float = 0.2, high: float = 40.0) -> Batch:
    """The same lines with an obstacle ahead, touching in a tenth of them."""
    draws = Draws(key)
    gap = draws.uniform(low, high, (batch.worlds.n,)) * draws.choice([1.0] * 9 + [0.0], (batch.worlds.n,))
    return Batch(replace(batch.worlds, obstacle_gap_m=gap), batch.command)


def test_obstacle__struck_at_a_known_speed_throws_back_and_hurts_vehicle_1_alone():
    # 10 m at 20 m/s: after 0.5 s; v+ = -0.5 * 20; at 1 s it is 5 m away again
    after, impacts = advance(line(10.0, [50.0], [20.0, 0.0], mass_t=[3.0, 1.0]), [0.0, 0.0], 1.0, record=True)
    assert after.speeds_mps.tolist() == [[-10.0, 0.0]] and after.obstacle_gap_m.tolist() == [5.0]
    assert after.gaps_m.tolist() == [[55.0]] and after.obstacle_hit.tolist() == [True]
    rows = impacts.rows
    assert (rows.pair.tolist(), rows.time_s.tolist(), rows.closing_speed_mps.tolist()) == ([-1], [0.5], [20.0])
    assert (rows.front_speed_change_mps.tolist(), rows.rear_speed_change_mps.tolist()) == ([0.0], [-30.0])
    ledger = empty_ledger(after).add(impacts)
    assert ledger.world_harm("first").tolist() == [400.0] and ledger.collided.tolist() == [True]
    with pytest.raises(InvalidInput, match="count 'both': must be"):
        ledger.obstacle_harm("both")
    assert ledger.vehicle_harm("total").tolist() == [[400.0, 0.0]] and ledger.pair_harm("total").tolist() == [[0.0]]


@pytest.mark.parametrize(("gap", "harm"), [(10.0, 280.0), (33.0, 4.0), (33.5, 0.0)])
def test_obstacle__braking_takes_two_a_g_off_the_squared_speed(gap, harm):
    # v^2 - 2 a g = 400 - 12 g; the vehicle stops in 33.33 m
    _, impacts = advance(line(gap, [99.0], [20.0, 0.0]), -6.0, 8.0)
    np.testing.assert_allclose(impacts.obstacle_first_harm, [harm], rtol=1e-13)
    assert impacts.obstacle_count.tolist() == [int(harm > 0.0)]


def test_obstacle__a_second_impact_counts_in_the_total_only():
    # thrown back at 5, its motor turns it round: it comes back at 5 (e = 0.5), then at 2.5, ...
    _, impacts = advance(line(0.0, [99.0], [10.0, 0.0]), [4.0, 0.0], 3.0, record=True)
    assert impacts.obstacle_first_harm.tolist() == [100.0] and impacts.obstacle_count.tolist() == [2]
    np.testing.assert_allclose(impacts.obstacle_total_harm, [125.0], rtol=1e-13)
    assert impacts.rows.first.tolist() == [True, False]


def test_obstacle__below_the_plastic_speed_nothing_bounces_and_a_touch_is_no_impact():
    slow, impacts = advance(line(0.0, [99.0], [0.04, 0.0]), 0.0, 1.0)
    assert slow.speeds_mps[0, 0] == 0.0
    np.testing.assert_allclose(impacts.obstacle_total_harm, [0.0016], rtol=1e-13)
    touching, impacts = advance(line(0.0, [99.0], [1e-5, 0.0]), 0.0, 1.0)
    assert impacts.obstacle_count.tolist() == [0] and touching.speeds_mps.tolist() == [[0.0, 0.0]]
    assert touching.obstacle_hit.tolist() == [False]


@pytest.mark.parametrize("command", [[6.0, 6.0, 6.0], [-6.0, 6.0, 6.0], [0.0, -6.0, 6.0], [0.0, 0.0, 6.0]])
def test_obstacle__a_line_pressed_against_it_stands_still(command):
    after, impacts = advance(line(0.0, [0.0, 0.0], [0.0, 0.0, 0.0]), command, 5.0)
    assert after.speeds_mps.tolist() == [[0.0] * 3] and after.gaps_m.tolist() == [[0.0] * 2]
    assert after.obstacle_gap_m.tolist() == [0.0] and impacts.obstacle_count.tolist() == [0]
    assert not after.obstacle_hit.any() and impacts.count.tolist() == [[0, 0]]


def test_obstacle__a_vehicle_that_leans_on_it_stays_when_struck_and_its_striker_is_thrown_back():
    # P of (0, 10) bounded by 0 is (0, 0): v+ = -e v-; Vehicle 1 does not move, so it does not strike the obstacle
    after, impacts = advance(line(0.0, [0.0], [0.0, 10.0], mass_t=[1.0, 100.0]), 0.0, 0.0)
    assert after.speeds_mps.tolist() == [[0.0, -5.0]]
    assert impacts.first_impact_harm.tolist() == [[100.0]] and impacts.obstacle_count.tolist() == [0]


def test_obstacle__a_plastic_chain_ends_at_rest_and_everybody_bears_its_own_share():
    # 6 m/s into the obstacle, 8 and 10 m/s behind, all touching, e = 0: one round, all at rest
    after, impacts = advance(line(0.0, [0.0, 0.0], [6.0, 8.0, 10.0], restitution=0.0), 0.0, 0.0)
    assert after.speeds_mps.tolist() == [[0.0] * 3]
    assert impacts.obstacle_total_harm.tolist() == [36.0] and impacts.total_harm.tolist() == [[4.0, 4.0]]
    ledger = empty_ledger(after).add(impacts)
    assert ledger.vehicle_harm("total").tolist() == [[38.0, 4.0, 2.0]] and ledger.world_harm("total").tolist() == [44.0]


@pytest.mark.parametrize(("N", "n"), [(2, 60), (3, 60), (5, 20), (20, 4)])
def test_obstacle__a_cluster_against_it_follows_the_exact_law(N, n):
    batch = touching_lines(171, n, N)
    before = replace(batch.worlds, obstacle_gap_m=np.zeros(n))
    after, impacts = advance(before, batch.command, 0.0)
    rounds = np.maximum(np.maximum(impacts.count.max(axis=1), impacts.obstacle_count), 1)
    for k in range(n):
        exact = simulate(line_of(before, [0.0] * N, k), Fraction(0))
        scale = np.abs(before.speeds_mps[k]).max()
        off = [abs(Fraction(float(v)) - u) for v, u in zip(after.speeds_mps[k], exact.speeds, strict=True)]
        assert float(max(off)) <= CLUSTER_EPS * EPS * scale * rounds[k]
    assert (impacts.obstacle_count > 0).sum() > n / 2 and (after.speeds_mps[:, 0] <= 0.0).all()


@pytest.mark.parametrize(("N", "n"), [(2, 60), (3, 50), (5, 12)])
@pytest.mark.parametrize("drive", [True, False])
def test_obstacle__runs_agree_with_exact_arithmetic_event_by_event(N, n, drive):
    worlds, command = place_ahead(driving_lines(151 + drive, n, N, drive=drive), 152)
    end, impacts = advance(worlds, command, HORIZON_S, record=True)
    rows, struck = impacts.rows, 0
    for k in range(n):
        exact = simulate(line_of(worlds, command[k].tolist(), k), Fraction(HORIZON_S), bits=160)
        mine = rows.world == k
        found = list(zip(rows.pair[mine].tolist(), rows.first[mine].tolist(), strict=True))
        assert found == [(hit.pair, hit.first) for hit in exact.hits]
        columns = (rows.time_s, rows.closing_speed_mps, rows.front_speed_change_mps, rows.rear_speed_change_mps)
        truth = np.array([[float(x) for x in (h.time, h.closing, *h[4:])] for h in exact.hits]).reshape(-1, 4)
        np.testing.assert_allclose(np.stack([c[mine] for c in columns], axis=1), truth, rtol=0, atol=1e-9)
        np.testing.assert_allclose(end.obstacle_gap_m[k], float(exact.obstacle), rtol=0, atol=1e-9)
        np.testing.assert_allclose(end.gaps_m[k], [float(g) for g in exact.gaps], rtol=0, atol=1e-9)
        np.testing.assert_allclose(end.speeds_mps[k], [float(v) for v in exact.speeds], rtol=0, atol=1e-9)
        struck += sum(hit.pair < 0 for hit in exact.hits)
    assert struck > n / 4


def test_obstacle__takes_momentum_forward_only_and_no_impact_adds_energy():
    batch = driving_lines(161, 300, 3)
    batch = Batch(replace(batch.worlds, obstacle_gap_m=Draws(162).uniform(1.0, 200.0, (300,))), batch.command)
    coasting = replace(batch.worlds, vehicles=replace(batch.worlds.vehicles, latency_s=np.full((300, 3), 1e9)))
    after, impacts = advance(coasting, 0.0, HORIZON_S)
    mass = after.vehicles.mass_t
    momentum = [(mass * w.speeds_mps).sum(axis=1) for w in (coasting, after)]
    energy = [(mass * w.speeds_mps**2).sum(axis=1) for w in (coasting, after)]
    number = impacts.count.sum(axis=1) + impacts.obstacle_count
    assert (energy[1] <= energy[0] * (1.0 + ENERGY_EPS * EPS * (number + 1))).all()
    spared = impacts.obstacle_count == 0
    np.testing.assert_allclose(momentum[1][spared], momentum[0][spared], rtol=1e-12)
    assert (momentum[1] < momentum[0])[impacts.obstacle_count > 0].all() and 50 < spared.sum() < 250


def test_obstacle__out_of_reach_changes_no_bit():
    batch = driving_lines(163, 400, 3)
    far = Batch(replace(batch.worlds, obstacle_gap_m=np.full(400, 1e4)), batch.command)
    without, impacts = advance(batch.worlds, batch.command, until_s=HORIZON_S, record=True)
    with_it, same = advance(far.worlds, far.command, until_s=HORIZON_S, record=True)
    assert np.isfinite(with_it.obstacle_gap_m).all() and not same.obstacle_count.any()
    assert state_bytes(replace(with_it, obstacle_gap_m=without.obstacle_gap_m), same) == state_bytes(without, impacts)
    assert np.array_equal(same.rows.pair, impacts.rows.pair) and len(same.rows.pair) > 200


def test_obstacle__splitting_a_segment_changes_nothing():
    worlds, command = place_ahead(driving_lines(164, 200, 3), 165)
    whole, impacts = advance(worlds, command, until_s=HORIZON_S)
    count, harm, first = np.zeros(200, np.int64), np.zeros(200), np.zeros(200)
    for until in (0.37, 0.9, 1.7, 2.2, 3.9, HORIZON_S):
        worlds, part = advance(worlds, command, until_s=until)
        count, harm = count + part.obstacle_count, harm + part.obstacle_total_harm
        first += part.obstacle_first_harm
    few = impacts.count.sum(axis=1) + impacts.obstacle_count <= 30
    assert np.array_equal(count[few], impacts.obstacle_count[few]) and few.sum() > 150
    np.testing.assert_allclose(harm[few], impacts.obstacle_total_harm[few], rtol=0, atol=SPLIT * 900.0)
    np.testing.assert_allclose(first[few], impacts.obstacle_first_harm[few], rtol=0, atol=SPLIT * 900.0)
    np.testing.assert_allclose(worlds.obstacle_gap_m[few], whole.obstacle_gap_m[few], rtol=0, atol=SPLIT * 100.0)


def test_obstacle__ahead_of_some_worlds_only_each_is_as_alone():
    plain, ahead = driving_lines(166, 40, 3), place_ahead(driving_lines(167, 40, 3), 168)
    order = np.random.default_rng(1).permutation(80)
    mixed = Worlds.concatenate([plain.worlds, ahead.worlds]).take(order)
    command = np.concatenate([plain.command, ahead.command])[order]
    assert np.array_equal(mixed.obstacle_ahead, order >= 40)
    whole, impacts = advance(mixed, command, until_s=HORIZON_S, record=True, threads=2)
    parts = [advance(mixed.take([k]), command[[k]], until_s=HORIZON_S, record=True) for k in range(80)]
    alone = Worlds.concatenate([world for world, _ in parts])
    harm = {name: np.concatenate([getattr(each, name) for _, each in parts]) for name in HARMS}
    assert state_bytes(alone, replace(impacts, **harm)) == state_bytes(whole, impacts)
    assert impacts.rows.pair.tolist() == [p for _, each in parts for p in each.rows.pair.tolist()]
    assert impacts.rows.world.tolist() == [k for k, (_, each) in enumerate(parts) for _ in each.rows.pair]


def test_forecast__counts_the_obstacle_as_advance_does():
    plain, ahead = driving_lines(166, 20, 3), place_ahead(driving_lines(167, 20, 3), 168, high=15.0)
    mixed, command = Worlds.concatenate([ahead.worlds, plain.worlds]), np.concatenate([ahead.command, plain.command])
    candidates = np.stack([np.full(40, -8.0), np.zeros(40), np.full(40, 4.0)], axis=1)
    first, total = forecast(mixed, command, 0, candidates, HORIZON_S)
    for c in range(3):
        tried = command.copy()
        tried[:, 0] = candidates[:, c]
        ledger = empty_ledger(mixed).add(advance(mixed, tried, until_s=HORIZON_S)[1])
        np.testing.assert_allclose(first[:, c], ledger.world_harm("first"), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(total[:, c], ledger.world_harm("total"), rtol=1e-12, atol=1e-12)
    assert (total[:20] > 0.0).any()


def test_bad_commands__are_named_by_the_numbers_of_the_vehicles():
    worlds = line([10.0, 10.0], [5.0], [[10.0, 10.0], [10.0, 10.0]])
    with pytest.raises(InvalidInput, match=r"command_mps2\[1, 1\] = -7"):
        advance(worlds, [[0.0, 0.0], [0.0, -7.0]], 1.0)
    with pytest.raises(InvalidInput, match=r"command_mps2\[0, 0\] = nan"):
        advance(worlds, [[np.nan, 0.0], [0.0, 0.0]], 1.0)
    with pytest.raises(InvalidInput, match=r"world 1 is at 0 s and cannot be advanced to -1 s"):
        advance(worlds, 0.0, until_s=[1.0, -1.0])


def test_sampled_map__refuses_an_obstacle():
    with pytest.raises(InvalidInput, match=r"world 0 has an obstacle ahead \(obstacle_gap_m = 10\)"):
        advance_sampled(line(10.0, [5.0], [10.0, 10.0]), -6.0, until_s=1.0)


@pytest.mark.parametrize("gap", [-1.0, np.inf, np.nan])
def test_make_worlds__refuses_an_obstacle_at_no_distance(gap):
    with pytest.raises(InvalidInput, match=r"obstacle_gap_m\[0\] = .*: must be finite and in \[0, inf\]"):
        line(gap, [5.0], [10.0, 10.0])


def test_with_obstacle__writes_it_out_in_front():
    worlds = replace(line(12.0, [5.0], [10.0, 9.0]), obstacle_hit=np.array([True])).with_obstacle()
    assert worlds.gaps_m.tolist() == [[12.0, 5.0]] and worlds.speeds_mps.tolist() == [[0.0, 10.0, 9.0]]
    assert worlds.pair_hit.tolist() == [[True, False]] and worlds.command_mps2.tolist() == [[0.0] * 3]
    v = worlds.vehicles
    assert v.mass_t.tolist() == [[np.inf, 1.0, 1.0]] and v.speed_limit_mps.tolist() == [[0.0, 40.0, 40.0]]
    assert v.braking_capacity_mps2.tolist() == v.driving_capacity_mps2.tolist() == [[0.0, 6.0, 6.0]]
    assert v.latency_s.tolist() == [[0.0] * 3] and v.known_from_s.shape == (1, 3, 3)
    assert worlds.obstacle_gap_m.tolist() == [np.inf] and worlds.obstacle_hit.tolist() == [False]
