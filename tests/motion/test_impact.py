"""Plastic impacts (e = 0) of a light vehicle between two heavy ones that close: none of the series is lost."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.motion.layout import COUNT, PASSED, SPEED, TOTAL
from tests.motion.lines import driven, lines

near = pytest.approx
MASS_T = [9.4, 1.25, 5.6]


@pytest.mark.parametrize(("gap_m", "behind_m", "harm"), [(1.0, 0.0, 466.13), (1e-3, 0.0, 499.37), (1.0, 1e-3, 466.10)])
def test_series__is_played_to_its_end(gap_m: float, behind_m: float, harm: float) -> None:
    """Vehicle 2 strikes the standing Vehicle 1, Vehicle 3 strikes it, it strikes again, and so on at one place.

    Each round takes (9.4 / 10.65) (5.6 / 6.85) of the closing speed. From 11.6 m/s and a gap of 1 mm the two pairs have
    11.6^2 / (1 - 0.7216^2) and (11.6 x 0.8826)^2 / (1 - 0.7216^2).
    """
    line, car = lines([gap_m, behind_m], [0.0, 11.6, 11.6], mass_t=MASS_T)
    after = driven(line, car, [0.0, -2.0, -5.0], 0.0, 8.0)[0]
    assert after[0, TOTAL].sum() == near(harm, abs=5e-3) and not after[0, PASSED].any()


@pytest.mark.parametrize("obstacle_gap_m", [1e300, 0.0])
def test_series__loses_the_energy_of_its_impacts(obstacle_gap_m: float) -> None:
    """``sum(mu h) / 2`` is the energy that an impact of touching vehicles loses, if one contact would open."""
    rng = np.random.default_rng(7)
    mass = rng.uniform(1.0, 10.0, (50, 3))
    speeds = np.column_stack([np.full((50, 2), 2.0 if obstacle_gap_m else 0.0), rng.uniform(4.0, 20.0, 50)])
    forces = [1.0, -1.0, 0.0] if obstacle_gap_m else 0.0
    line, car = lines([0.0, 0.0], speeds, mass_t=mass, obstacle_gap_m=obstacle_gap_m, force_mps2=forces)
    after = driven(line, car, forces, 0.0, 1e-9)[0]
    lost = 0.5 * (mass * (speeds**2 - after[:, SPEED, 1:] ** 2)).sum(axis=1)
    reduced = np.column_stack(
        [mass[:, 0], *(mass[:, p] * mass[:, p + 1] / (mass[:, p] + mass[:, p + 1]) for p in (0, 1))]
    )
    harm = 0.5 * (reduced * after[:, TOTAL, :-1]).sum(axis=1)
    assert (after[:, COUNT].sum(axis=1) > 0.0).all()
    if obstacle_gap_m:
        assert harm == near(lost, rel=1e-6)
    else:  # nothing would open: the contacts pass the impact on, as for every other e
        assert (
            after[:, TOTAL, 2] == near(speeds[:, 2] ** 2) and (after[:, PASSED, 1] > 0.0).all() and (harm < lost).all()
        )
