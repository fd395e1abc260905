"""E-V2X-BM of the second edition against that of the first."""

import numpy as np
import pytest

import ethbrake_marl.first_edition.scenario as first
from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.agents.pairwise import pairwise
from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.first_edition.agents.e_v2x_bm.pairwise import optimise_pairwise
from ethbrake_marl.motion.layout import BRAKING
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.fixtures.scenarios import SHIPPED
from tests.second.same import builds_up


@pytest.mark.parametrize("name", [name for name in SHIPPED if not builds_up(name)])
def test_closed_form__chooses_what_the_first_edition_chooses(name: str) -> None:
    old, new = first.load_scenario(name).sample(300, 11).worlds, load_scenario(name).sample(300, 11)
    for vehicle in range(old.N):
        expected, found = optimise_pairwise(old, vehicle), pairwise(new, vehicle + 1)
        for one, other in zip(found, expected[:2], strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("paper-random", "first"),
        ("paper-random-obstacle", "total"),
        ("paper-random-brake-only", "first"),
        ("paper-random-buildup", "first"),
        ("stress-wide", "first"),
        ("cooperation-3-pair", "first"),
    ],
)
def test_coupled__does_as_little_harm_as_the_first_edition(name: str, count: str) -> None:
    n = 1000
    old, new = first.load_scenario(name).sample(n, 11).worlds, load_scenario(name).sample(n, 11)
    learners = list(load_scenario(name).learners)
    new.wanted[:, learners] = -new.car[:, BRAKING][:, learners]
    horizon_s = load_scenario(name).horizon_s
    expected = optimise_coupled(old, 1, harm_count=count, horizon_s=horizon_s).harm
    found = coupled(new, 2, count, horizon_s).harm
    assert abs(found.mean() / expected.mean() - 1.0) <= 5e-4 and np.mean(found > expected + 0.01) <= 5e-3
