"""What must not matter: how a segment is cut, when time begins, the batch, its order, the threads, the units."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.physics import Impacts, Worlds, advance, make_worlds
from tests.physics.random_worlds import (
    HARMS,
    HORIZON_S,
    Batch,
    driving_lines,
    last_digit_errors,
    once,
    split_errors,
    state_bytes,
)
from tests.reference.tolerances import SPLIT, SPLIT_CASCADE

# ---------------------------------------------------------------- cutting a segment


@pytest.mark.parametrize("N", [2, 3, 5, 10])
@pytest.mark.parametrize("cuts", [2, 7, 80])
def test_split__changes_nothing_beyond_rounding(N, cuts):
    error, few, other = split_errors(N, 4_000 // N, cuts, 61)
    assert few.any() and not other.any()
    assert np.max(error[few], initial=0.0) <= SPLIT
    assert np.max(error[~few], initial=0.0) <= SPLIT_CASCADE


def test_split__of_cascades_changes_no_more_than_ten_times_what_the_last_digit_of_a_gap_changes():
    cut, digit = split_errors(20, 400, 7, 61), last_digit_errors(20, 400, 61)
    assert (~cut.few).sum() > 100
    assert cut.error[~cut.few].max() <= 10.0 * digit.error[~digit.few].max()


def test_split__where_nothing_happens_is_closed_form_either_way():
    far = make_worlds(
        [200.0], [20.0, 20.0], braking_capacity_mps2=8, driving_capacity_mps2=8, latency_s=[0.25, 0.5], mass_t=1,
        restitution=0,
    )  # fmt: skip
    whole, _ = advance(far, [-4.0, -8.0], until_s=4.0)
    for until in (0.125, 0.25, 0.5, 1.0, 3.5, 4.0):
        far, _ = advance(far, [-4.0, -8.0], until_s=until)
    assert far.gaps_m.tolist() == whole.gaps_m.tolist() == [[200.0 + 5.0 + 20 * 3.75 - 2 * 3.75**2 - 10.0 - 25.0]]


# ---------------------------------------------------------------- the origin


@pytest.mark.parametrize("shift", [-0.5, 64.0, 1024.0])
def test_origin__of_time_does_not_matter_to_the_last_bit(shift):
    # Times on a grid, so that the shifted ones are doubles too. (Positions are not stored: space has no origin.)
    batch = driving_lines(62, 1_000, 4)
    v = batch.worlds.vehicles
    grid = replace(batch.worlds, vehicles=replace(v, latency_s=np.round(v.latency_s * 2**20) / 2**20))
    moved = replace(
        grid, vehicles=replace(grid.vehicles, latency_s=grid.vehicles.latency_s + shift), time_s=grid.time_s + shift
    )
    here, impacts = advance(grid, batch.command, until_s=HORIZON_S, record=True)
    there, same = advance(moved, batch.command, until_s=HORIZON_S + shift, record=True)
    there = replace(there, time_s=there.time_s - shift)
    assert state_bytes(here, impacts) == state_bytes(there, same)
    np.testing.assert_allclose(same.rows.time_s - shift, impacts.rows.time_s, rtol=0, atol=1e-12)
    assert impacts.count.sum() > 1_000


# ---------------------------------------------------------------- the batch


@pytest.mark.parametrize("N", [2, 3, 7])
def test_batch__of_one_of_many_and_in_any_order_are_the_same_bits(N):
    batch = driving_lines(63, 300, N)
    whole = once(batch)
    order = np.random.default_rng(9).permutation(300)
    shuffled = once(Batch(batch.worlds.take(order), batch.command[order]))
    back = np.argsort(order)
    for name in ("gaps_m", "speeds_mps"):
        assert getattr(shuffled[0], name)[back].tobytes() == getattr(whole[0], name).tobytes()
    assert shuffled[1].total_harm[back].tobytes() == whole[1].total_harm.tobytes()
    singles = [once(Batch(batch.worlds.take([k]), batch.command[[k]])) for k in range(300)]
    joined = Worlds.concatenate([world for world, _ in singles])
    harm = [np.concatenate([getattr(i, f) for _, i in singles]) for f in HARMS]
    assert state_bytes(joined, Impacts(*harm)) == state_bytes(*whole)
    assert whole[1].count.sum() > 100


def test_batch__inputs_are_left_alone():
    batch = driving_lines(64, 50, 3)
    before = batch.worlds.take(np.arange(50))
    once(batch)
    for name in ("gaps_m", "speeds_mps", "time_s", "pair_hit", "command_mps2"):
        assert getattr(batch.worlds, name).tobytes() == getattr(before, name).tobytes()


def test_batch__recording_more_impacts_than_first_reserved():
    # one world, 130 impacts: more than the 4 n + 64 rows made at first
    wall = make_worlds(
        [0.0], [0.0, 8.0], braking_capacity_mps2=16, driving_capacity_mps2=16, latency_s=0, mass_t=[2.0**50, 1.0],
        restitution=1.0,
    )  # fmt: skip
    world, impacts = advance(wall, [-16.0, 16.0], 129.5, record=True)
    assert impacts.rows.time_s == pytest.approx(np.arange(130), abs=1e-9)
    assert impacts.count.tolist() == [[130]]
    silent, unrecorded = advance(wall, [-16.0, 16.0], 129.5)
    assert unrecorded.rows is None and state_bytes(silent, unrecorded) == state_bytes(world, impacts)


def test_threads__two_give_the_bits_of_one():
    batch = driving_lines(65, 4_000, 3)
    whole = once(batch)
    chunks = [Batch(batch.worlds.take(rows), batch.command[rows]) for rows in np.array_split(np.arange(4_000), 16)]
    with ThreadPoolExecutor(2) as pool:
        parts = list(pool.map(once, chunks))
    harm = [np.concatenate([getattr(i, f) for _, i in parts]) for f in HARMS]
    assert state_bytes(Worlds.concatenate([world for world, _ in parts]), Impacts(*harm)) == state_bytes(*whole)


# ---------------------------------------------------------------- units and neighbours


def test_units__masses_in_other_units_give_the_same_bits():
    batch = driving_lines(66, 1_000, 4)
    v = batch.worlds.vehicles
    heavy = replace(batch.worlds, vehicles=replace(v, mass_t=v.mass_t * 1024.0))
    assert state_bytes(*once(Batch(heavy, batch.command))) == state_bytes(*once(batch))


def test_units__twice_the_length_is_twice_every_speed_and_four_times_the_harm():
    batch = driving_lines(67, 1_000, 3)
    v = batch.worlds.vehicles
    plastic = replace(v, restitution=np.zeros(1_000))  # no bounce: the plastic speed has no unit to matter in
    twice = replace(
        v, restitution=np.zeros(1_000), braking_capacity_mps2=2 * v.braking_capacity_mps2,
        driving_capacity_mps2=2 * v.driving_capacity_mps2, speed_limit_mps=2 * v.speed_limit_mps,
    )  # fmt: skip
    w = batch.worlds
    small, impacts = once(Batch(replace(w, vehicles=plastic), batch.command))
    large, fourfold = once(
        Batch(replace(w, vehicles=twice, gaps_m=2 * w.gaps_m, speeds_mps=2 * w.speeds_mps), 2 * batch.command)
    )
    same = (impacts.count == fourfold.count).all(axis=1)  # not where an impact is near the touch speed
    assert same.mean() > 0.99
    assert (2 * small.gaps_m)[same].tobytes() == large.gaps_m[same].tobytes()
    assert (2 * small.speeds_mps)[same].tobytes() == large.speeds_mps[same].tobytes()
    assert (4 * impacts.total_harm)[same].tobytes() == fourfold.total_harm[same].tobytes()


def test_neighbours__far_away_do_not_matter():
    batch = driving_lines(68, 1_000, 3)
    w, v = batch.worlds, batch.worlds.vehicles
    n = w.n
    far = make_worlds(
        np.column_stack([np.full(n, 1e4), w.gaps_m, np.full(n, 1e4)]),
        np.column_stack([np.full(n, 20.0), w.speeds_mps, np.full(n, 20.0)]),
        braking_capacity_mps2=8, driving_capacity_mps2=8,
        latency_s=np.column_stack([np.zeros(n), v.latency_s, np.zeros(n)]),
        mass_t=np.column_stack([np.ones(n), v.mass_t, np.ones(n)]),
        speed_limit_mps=np.column_stack([np.full(n, 40.0), v.speed_limit_mps, np.full(n, 40.0)]),
        restitution=v.restitution,
    )  # fmt: skip
    command = np.column_stack([np.zeros(n), batch.command, np.zeros(n)])
    alone, impacts = once(batch)
    among, more = once(Batch(far, command))
    assert more.count[:, 1:-1].tolist() == impacts.count.tolist() and not more.count[:, [0, -1]].any()
    np.testing.assert_allclose(among.gaps_m[:, 1:-1], alone.gaps_m, rtol=0, atol=1e-10)
    np.testing.assert_allclose(among.speeds_mps[:, 1:-1], alone.speeds_mps, rtol=0, atol=1e-10)
