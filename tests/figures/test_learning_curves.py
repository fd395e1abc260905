from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.figures import SeedCurve, seed_curves


def test_at_common_steps__keeps_the_steps_that_all_have() -> None:
    curve = SeedCurve.of([{0: 1.0, 10: 2.0, 15: 9.0, 20: 3.0}, {0: 5.0, 10: 6.0, 20: 7.0}])
    assert curve.steps.tolist() == [0.0, 10.0, 20.0]
    assert curve.values.tolist() == [[1.0, 2.0, 3.0], [5.0, 6.0, 7.0]]
    with pytest.raises(InvalidInput, match="never evaluated at the same step"):
        SeedCurve.of([{0: 1.0}, {1: 1.0}])


def test_seed_curves__draws_means_and_bands_of_one_standard_deviation() -> None:
    curve = SeedCurve(np.array([0.0, 10.0]), np.array([[4.0, 1.0], [8.0, 3.0]]))
    figure = seed_curves({"harm": {"ppo": curve}, "return": {"ppo": curve}}, logarithmic=["harm"], caption="x")
    left, right = figure.axes
    assert (left.get_yscale(), right.get_yscale()) == ("log", "linear")
    assert left.lines[0].get_ydata().tolist() == [6.0, 2.0]
    assert figure.legends[0].get_texts()[0].get_text() == "ppo, 2 seeds"
    band = left.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == pytest.approx(2.0 - 2.0**0.5)
    assert band[:, 1].max() == pytest.approx(6.0 + 8.0**0.5)


def test_seed_curves__one_seed_has_no_band_and_zero_no_logarithm() -> None:
    figure = seed_curves(
        {"harm": {"sac": SeedCurve(np.array([0.0, 1.0]), np.array([[5.0, 0.0]]))}}, logarithmic=["harm"]
    )
    assert figure.axes[0].get_yscale() == "linear"
    assert figure.legends[0].get_texts()[0].get_text() == "sac, 1 seed"
    with pytest.raises(InvalidInput, match="nothing to draw"):
        seed_curves({"harm": {}})
