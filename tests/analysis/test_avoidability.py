"""Avoidability: the proven shares, witnesses that hold in the engine's physics, and two independent checks."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.analysis.avoidability import avoidability
from ethbrake_marl.analysis.avoidability_lp import avoidable_by_lp
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import advance, make_worlds
from ethbrake_marl.scenario import load_scenario


def wide_worlds(n, seed):
    rng = np.random.default_rng(seed)
    speeds = rng.uniform(8.0, 25.0, (n, 3))
    return make_worlds(
        rng.uniform(2.0, 12.0, (n, 2)),
        speeds,
        braking_capacity_mps2=rng.uniform(4.0, 9.0, (n, 3)),
        driving_capacity_mps2=rng.uniform(0.0, 4.0, (n, 3)),
        latency_s=np.column_stack([np.zeros(n), rng.uniform(0.1, 0.8, (n, 2))]),
        mass_t=rng.uniform(1.0, 9.0, (n, 3)),
        restitution=0.1,
        speed_limit_mps=speeds + rng.uniform(0.0, 5.0, (n, 3)),
    )


def impacts_of(worlds, switch_s, command_mps2):
    """Impacts [n] of each world when Vehicle 2 plays a profile [n, K] and the others brake fully, to 40 s."""
    count = np.zeros(worlds.n, np.int64)
    at = -worlds.vehicles.braking_capacity_mps2
    now = np.zeros((worlds.n, 3))
    now[:, [0, 2]] = at[:, [0, 2]]
    ends = np.concatenate([switch_s, np.full((worlds.n, 1), np.inf)], axis=1)
    for k in range(ends.shape[1]):
        worlds, impacts = advance(worlds, now, until_s=np.clip(ends[:, k], worlds.time_s, 40.0))
        count += impacts.count.sum(axis=1)
        if k < switch_s.shape[1]:
            now[:, 1] = np.where(np.isfinite(switch_s[:, k]), command_mps2[:, k], now[:, 1])
    return count


@pytest.mark.parametrize(("name", "low", "high"), [("paper-random", 0.63, 0.67), ("paper-random-early", 0.545, 0.59)])
def test_avoidability__share_of_the_papers_random_test(name, low, high):
    verdict = avoidability(load_scenario(name).sample(3000, 7).worlds)
    assert low < 1.0 - verdict.avoidable.mean() < high


@pytest.mark.parametrize("worlds", [wide_worlds(4000, 1), load_scenario("paper-random").sample(4000, 7).worlds])
def test_witness__has_no_impact_in_the_engines_physics(worlds):
    verdict = avoidability(worlds)
    good = verdict.avoidable
    assert 300 < good.sum() < worlds.n - 300
    played = impacts_of(worlds.take(good), verdict.switch_s[good], verdict.command_mps2[good])
    assert played.sum() == 0


def test_unavoidable__no_random_profile_avoids_collision():
    worlds = load_scenario("paper-random").sample(500, 7).worlds
    bad = worlds.take(~avoidability(worlds).avoidable)
    rng = np.random.default_rng(0)
    for _ in range(300):
        start = bad.vehicles.latency_s[:, 1:2]
        switch = start + np.sort(rng.uniform(0.0, 3.0, (bad.n, 4)), axis=1)
        switch[:, 0] = start[:, 0]
        command = rng.uniform(-7.0, 7.0, (bad.n, 4))
        assert (impacts_of(bad, switch, command) > 0).all()


def test_avoidability__agrees_with_a_linear_programme():
    worlds = wide_worlds(60, 3)
    verdict = avoidability(worlds)
    certain = 0
    for k in range(worlds.n):
        lp = avoidable_by_lp(worlds.take([k]), (1,), 0.05)
        if lp.certain and verdict.reason[k] != 1:
            certain += 1
            assert lp.avoidable == verdict.avoidable[k], k
    assert certain > 40


def test_bad_input__is_refused():
    worlds = wide_worlds(3, 0)
    with pytest.raises(InvalidInput):
        avoidability(worlds, vehicle=3)
    with pytest.raises(InvalidInput, match="coast"):
        avoidability(worlds, scripts={0: "coast", 2: "full_brake"})
