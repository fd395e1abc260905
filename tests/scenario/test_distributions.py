from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from pydantic import ValidationError
from scipy.stats import truncnorm

from ethbrake_marl.scenario.sampling import Choice, LogUniform, Normal, Uniform, support, values

GRID = (np.arange(200_000) + 0.5) / 200_000
ALMOST_ONE = np.array([1.0 - 2.0**-53])


def normal(mean: float, sd: float, low: float, high: float) -> Normal:
    return Normal.model_validate({"normal": {"mean": mean, "sd": sd, "low": low, "high": high}})


def test_number__is_itself_whatever_is_drawn():
    assert values(3.5, np.array([0.0, 0.3, 0.9])).tolist() == [3.5, 3.5, 3.5]
    assert support(3.5) == (3.5, 3.5)


def test_uniform__is_linear_in_u():
    drawn = Uniform.model_validate({"uniform": [5, 10]}).value(np.array([0.0, 0.2, 0.5]))
    assert drawn.tolist() == [5.0, 6.0, 7.5]


@given(st.floats(0, 1e4), st.floats(0, 1e4))
def test_uniform__is_never_outside_its_bounds(a, b):
    low, high = sorted((a, b))
    drawn = Uniform(uniform=(low, high)).value(np.array([0.0, 0.1, 0.7, ALMOST_ONE[0]]))
    assert np.all((drawn >= low) & (drawn <= high))


def test_choice__takes_equal_shares_of_the_unit_interval():
    choice = Choice.model_validate({"choice": [6, 8, 7]})
    assert choice.value(np.array([0.0, 0.33, 0.34, 0.66, 0.67, ALMOST_ONE[0]])).tolist() == [6, 6, 8, 8, 7, 7]
    assert choice.support == (6.0, 8.0)


def test_choice__weights_are_shares():
    choice = Choice.model_validate({"choice": [1, 2, 3], "weights": [1, 2, 1]})
    assert choice.value(np.array([0.0, 0.249, 0.25, 0.749, 0.75, ALMOST_ONE[0]])).tolist() == [1, 1, 2, 2, 3, 3]


@given(st.lists(st.floats(1e-6, 1e6), min_size=1, max_size=9))
def test_choice__the_largest_u_takes_the_last_entry(weights):
    choice = Choice(choice=tuple(float(k) for k in range(len(weights))), weights=tuple(weights))
    assert choice.value(ALMOST_ONE)[0] == len(weights) - 1


def test_loguniform__by_hand():
    drawn = LogUniform(loguniform=(1.0, 16.0)).value(np.array([0.0, 0.25, 0.5, 0.75]))
    assert np.allclose(drawn, [1.0, 2.0, 4.0, 8.0], rtol=1e-15)
    assert (LogUniform(loguniform=(0.2, 2.0)).value(ALMOST_ONE) <= 2.0).all()


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (-1.0, 1.0), (2.0, 1.0)])
def test_loguniform__needs_bounds_above_0_in_order(bounds):
    with pytest.raises(ValidationError, match="low must"):
        LogUniform(loguniform=bounds)


def test_normal__its_middle_is_the_mean_when_the_bounds_are_symmetric():
    assert normal(20.0, 1.0, 18.0, 22.0).value(np.array([0.5])).tolist() == [20.0]


@pytest.mark.parametrize("shape", [(20.0, 1.0, 18.0, 22.0), (0.97, 0.26, 0.3, 3.0), (5.0, 2.0, 9.0, 11.0)])
def test_normal__has_the_quantiles_of_the_truncated_normal(shape):
    mean, sd, low, high = shape
    other = truncnorm((low - mean) / sd, (high - mean) / sd, mean, sd)
    assert np.allclose(normal(*shape).value(GRID[::50]), other.ppf(GRID[::50]), rtol=1e-9, atol=1e-9)


def test_normal__stays_in_its_bounds_far_out_in_the_tail():
    drawn = normal(0.0, 1.0, 4.0, 30.0).value(np.array([0.0, 0.5, 0.999999, ALMOST_ONE[0]]))
    assert np.all((drawn >= 4.0) & (drawn <= 30.0))
    assert np.all(np.diff(drawn) > 0.0)


@pytest.mark.parametrize(
    "quantity",
    [
        Uniform(uniform=(5.0, 10.0)),
        LogUniform(loguniform=(0.2, 2.0)),
        Choice(choice=(1.0, 2.0, 5.0), weights=(0.2, 0.3, 0.5)),
        normal(20.0, 1.0, 18.0, 22.0),
    ],
)
def test_every_distribution__depends_on_each_u_alone(quantity):
    u = np.random.default_rng(1).random(64)
    whole = quantity.value(u)
    assert [quantity.value(u[k : k + 1])[0] for k in range(64)] == whole.tolist()
