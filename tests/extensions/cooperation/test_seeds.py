"""Means over seeds and worlds; figures recorded from version 0.5."""

import numpy as np
import pytest

from ethbrake_marl.extensions.cooperation import mean_over_seeds, share_over_seeds

RNG = np.random.default_rng(5)
VALUES, BASELINE = RNG.gamma(2.0, 3.0, (3, 40)), RNG.gamma(2.0, 4.0, (2, 40))
CLUSTERS = np.array([f"r{k // 8}" for k in range(40)])

GOLDEN = {
    "mean": (5.901371795105182, 4.892801965137039, 6.952234251036087),
    "difference": (-2.4897618232197862, -4.2072192694520565, -1.106233718741188),
    "rate": (0.4833333333333333, 0.3368640018879043, 0.6327233848186717),
    "clusters": (0.4833333333333333, 0.30753217702270197, 0.6633590132517875),
    "share": (0.7390213686172952, 0.640091372973452, 0.8085157879815194),
}


def ends(estimate):
    return estimate.value, *estimate.interval


def test_mean__is_as_recorded() -> None:
    assert ends(mean_over_seeds(VALUES)) == pytest.approx(GOLDEN["mean"], abs=1e-12)
    assert ends(mean_over_seeds(VALUES, BASELINE, CLUSTERS)) == pytest.approx(GOLDEN["difference"], abs=1e-12)
    assert ends(mean_over_seeds(VALUES > 5.0)) == pytest.approx(GOLDEN["rate"], abs=1e-12)
    assert ends(mean_over_seeds(VALUES > 5.0, clusters=CLUSTERS)) == pytest.approx(GOLDEN["clusters"], abs=1e-9)
    share = share_over_seeds(VALUES, VALUES[:1] + 9.0, 0.5 * VALUES[:1])
    assert share is not None and ends(share) == pytest.approx(GOLDEN["share"], abs=1e-12)


def test_no_interval__of_one_world_or_recording_or_of_zeros() -> None:
    assert mean_over_seeds(np.ones((3, 1))).interval is None
    assert mean_over_seeds(VALUES, clusters=np.full(40, "one")).interval is None
    assert mean_over_seeds(np.zeros((3, 40))).interval is None
    assert mean_over_seeds(np.ones((2, 40), bool)).interval[1] == 1.0


def test_share__where_nothing_can_be_reduced_is_none() -> None:
    assert share_over_seeds(VALUES, VALUES[:1], VALUES[:1]) is None
    rare = np.zeros((1, 40))
    rare[0, 0] = 1.0
    assert share_over_seeds(rare, rare, 0.0 * rare) is None  # many resamples lack the only world
