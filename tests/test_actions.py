from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.actions import checked_action
from ethbrake_marl.errors import InvalidInput


@pytest.mark.parametrize("value", [-1.0000001, 1.0000000000000002, 2.0, np.nan, np.inf])
def test_action__beyond_the_bounds_is_told_in_digits_that_show_it(value):
    with pytest.raises(InvalidInput) as caught:
        checked_action([0.5, value], (2,), "vehicle_2")
    assert str(caught.value) == f"action of vehicle_2: {value!r}; must be in [-1, 1]"


def test_action__at_the_bounds_is_taken():
    assert checked_action([-1, 1], (2,), "vehicle_2").tolist() == [-1.0, 1.0]
