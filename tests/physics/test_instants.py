"""Every instant ends: after a plastic impact nobody approaches any more, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.physics import advance, make_worlds
from tests.physics.random_worlds import momentum_eps, nearly_joined, thrown_lines
from tests.reference.tolerances import MOMENTUM_EPS


def test_plastic_cluster__three_vehicles_do_not_hand_the_last_bit_to_and_fro():
    # The regression joins all three at one speed, whose refined double is 1 ulp off for two of them; in doubles the
    # rear two then approach the front one again, and so on for ever.
    speeds = [float.fromhex(f"0x1.66d388ecfa50{digit}p+0") for digit in (5, 7, 6)]
    masses = [float.fromhex(mass) for mass in ("0x1.38aa48a631a58p+4", "0x1.842a10bbca148p+2", "0x1.e8de440211adfp+3")]
    worlds = make_worlds(
        [0.0, 0.0], speeds, braking_capacity_mps2=8.0, driving_capacity_mps2=8.0, latency_s=0.0, mass_t=masses,
        restitution=0.1,
    )  # fmt: skip
    after, impacts = advance(worlds, 0.0, 0.0)
    assert np.all(np.diff(after.speeds_mps) <= 0.0)
    assert impacts.count.sum() == 0
    assert after.speeds_mps[0] == pytest.approx(speeds, rel=4e-16)


@pytest.mark.parametrize(("N", "n"), [(2, 2_000), (3, 4_000), (5, 4_000), (10, 2_000), (50, 200)])
@pytest.mark.parametrize("obstacle", [False, True])
def test_nearly_joined__lines_of_any_length_come_to_an_order(N, n, obstacle):
    worlds = nearly_joined(91, n, N, obstacle=obstacle)
    approaching = (np.diff(worlds.speeds_mps, axis=1) > 0.0).any(axis=1) | (obstacle & (worlds.speeds_mps[:, 0] > 0.0))
    assert approaching.mean() > 0.2
    after, impacts = advance(worlds, 0.0, 0.0)
    assert np.all(np.diff(after.speeds_mps, axis=1) <= 0.0)
    assert not obstacle or np.all(after.speeds_mps <= 0.0)
    assert impacts.count.sum() == 0  # they are touches
    most = np.abs(worlds.speeds_mps).max(axis=1, keepdims=True)
    assert np.all(np.abs(after.speeds_mps - worlds.speeds_mps) <= (2.0 if obstacle else 4e-15) * most)


def test_nearly_joined__momentum_moves_by_no_more_than_its_rounding():
    for N in (2, 3, 10):
        worlds = nearly_joined(92, 4_000, N)
        after, _ = advance(worlds, 0.0, 0.0)
        assert np.max(momentum_eps(worlds, after)) <= MOMENTUM_EPS


@pytest.mark.parametrize(("N", "n"), [(3, 2_000), (10, 2_000), (50, 40)])
def test_thrown_lines__against_an_obstacle_come_to_their_end(N, n):
    worlds, command = thrown_lines(93, n, N)
    after, impacts = advance(worlds, command, until_s=8.0)
    assert np.isfinite(after.speeds_mps).all()
    assert (impacts.obstacle_count > 0).mean() > 0.3
