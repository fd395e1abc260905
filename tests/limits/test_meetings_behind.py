"""First meetings with a rear vehicle that does as it likes: every one that is played lies within what is bounded."""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.limits.lower_bound import LINE, behind_full_braking, gained, soft_behind
from ethbrake_marl.physics import advance, make_worlds

STEP_S, FAR_M = 0.2, 1e4


def pairs(n, seed):
    """Lines of three whose leader is out of reach."""
    rng = np.random.default_rng(seed)
    latency = np.stack([np.zeros(n), np.zeros(n), rng.uniform(0, 1, n)], axis=1)
    return make_worlds(
        np.stack([np.full(n, FAR_M), rng.uniform(0.2, 8, n)], axis=1), rng.uniform(15, 25, (n, 3)),
        braking_capacity_mps2=rng.uniform(2, 9, (n, 3)), driving_capacity_mps2=rng.uniform(0, 8, (n, 3)),
        latency_s=latency, mass_t=1, restitution=0, speed_limit_mps=rng.uniform(25, 60, (n, 3)),
    )  # fmt: skip


def rows_of(worlds):
    at, v = np.zeros((worlds.n, LINE.WIDTH)), worlds.vehicles
    at[:, LINE.V_F], at[:, LINE.V_R], at[:, LINE.GAP_R] = (
        worlds.speeds_mps[:, 1],
        worlds.speeds_mps[:, 2],
        worlds.gaps_m[:, 1],
    )
    at[:, LINE.A_F], at[:, LINE.A_R] = v.braking_capacity_mps2[:, 1], v.braking_capacity_mps2[:, 2]
    at[:, LINE.U_F], at[:, LINE.LIMIT_F] = v.driving_capacity_mps2[:, 1], v.speed_limit_mps[:, 1]
    at[:, LINE.ONSET_R] = v.latency_s[:, 2]
    return at


def played(worlds, rng):
    """First meetings under joint commands that are mostly extreme: world, time, closing speed, and the state there."""
    v, now = worlds.vehicles, worlds
    low, high = -v.braking_capacity_mps2, v.driving_capacity_mps2
    share = np.round(rng.uniform(0, 1, (worlds.n, 3)))
    for k in range(20):
        share = np.where(rng.random(share.shape) < 0.4, np.round(rng.uniform(0, 1, share.shape), k % 2), share)
        share[:, 0] = 0.0  # the leader brakes fully
        command = np.clip(low + (high - low) * share, low, high)
        after, impacts = advance(now, command, STEP_S, record=True)
        rows = impacts.rows
        for j in np.flatnonzero(rows.first & (rows.pair == 1)):
            world, time = rows.world[j], rows.time_s[j]
            there, _ = advance(now.take([world]), command[[world]], until_s=max(time - 1e-9, now.time_s[world]))
            yield world, time, rows.closing_speed_mps[j], there
        now = after


def full_braking(v, a, onset, time):
    """Way and speed of one that coasts until its onset, then brakes to rest."""
    braking = min(max(time - onset, 0.0), v / a)
    return v * (min(time, onset) + braking) - 0.5 * a * braking * braking, v - a * braking


def test_played_meetings__lie_within_the_bounds_of_every_cell_that_holds_them():
    worlds, checked, earlier = pairs(400, seed=3), 0, 0
    v = worlds.vehicles
    for world, time, closing, there in played(worlds, np.random.default_rng(4)):
        row = rows_of(worlds.take([world]))[0]
        since, power = row[LINE.ONSET_R], row[LINE.A_R] + v.driving_capacity_mps2[world, 2]
        if time > since + row[LINE.V_R] / row[LINE.A_R]:
            continue  # the one that brakes fully stands by then
        way, speed = full_braking(row[LINE.V_R], row[LINE.A_R], since, time)
        way_l, _ = full_braking(worlds.speeds_mps[world, 0], v.braking_capacity_mps2[world, 0], 0.0, time)
        further = max(FAR_M + way_l - there.gaps_m[0, 0] + row[LINE.GAP_R] - way, 0.0)
        faster = there.speeds_mps[0, 2] - speed
        for reach in (power, math.inf):
            assert faster >= gained(further - 1e-6, time, since, reach) - 1e-3
        for before, after, near, far in ((0, 0, 1, 1), (0.5, 0.5, 0.5, 1.5), (1, 0.2, 0, 3), (0, 1, 0.9, 1)):
            early, late = (1 - before) * time, (1 + after) * time
            cell = early, late, max(near * further - 1e-6, 0.0), far * further + 1e-6
            assert behind_full_braking(row, early, late) <= cell[3] + 1e-6
            assert soft_behind(row, *cell, since, power) <= closing + 1e-3
        checked, earlier = checked + 1, earlier + (further > 0.1)
    assert checked > 100 and earlier > 50
