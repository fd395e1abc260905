"""First impacts and driving before them, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.evaluation.measures import driving_s, first_impact_s
from tests.episode.lines import later, state_of
from tests.episode.test_conduct import CLOSE, after_contact

near = pytest.approx


def test_driving__counts_until_the_first_impact() -> None:
    driven = after_contact()
    assert first_impact_s(CLOSE, driven).tolist() == near([1.5])
    assert driving_s(CLOSE, driven, first_impact_s(CLOSE, driven))[0].tolist() == near([0.0, 1.0, 1.5])
    after = later(driven, [0.0, 2.0, 1.0], 5.0)
    assert first_impact_s(driven, after).tolist() == [4.0]
    assert not driving_s(driven, after, driven.time_s).any()
    braked = later(CLOSE, [0.0, -2.0, 1.0], 1.0)
    assert first_impact_s(CLOSE, braked).tolist() == [1.0]
    assert driving_s(CLOSE, braked, np.ones(1))[0].tolist() == [0.0, 0.0, 1.0]


def test_first_impact__with_the_obstacle() -> None:
    ahead = state_of([9.0], [10.0, 10.0], obstacle_gap_m=5.0)
    after = later(ahead, [0.0, 4.0], 1.0)
    assert first_impact_s(ahead, after).tolist() == near([0.5])
