"""Changes of harm from one level to the next, by hand."""

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.cooperation.comparison import compare
from ethbrake_marl.extensions.cooperation.joint_optimum import Harms, Measured
from ethbrake_marl.extensions.cooperation.levels import Level


def measured(level: str, vehicles: list[list[float]], algorithm: str | None) -> Measured:
    """One training run in as many worlds as there are rows of harm of three vehicles."""
    each = np.array([vehicles])
    harms = Harms(
        {count: each.sum(axis=2) for count in ("first", "total")},
        {count: each for count in ("first", "total")},
        each.any(axis=2),
    )
    scenario = eb.load_scenario(level)
    return Measured(Level(scenario), algorithm, harms, harms, None)


def test_change__says_who_is_worse_off_and_by_how_much() -> None:
    before = measured("cooperation-0-sensors", [[2, 4, 0], [0, 6, 0], [1, 1, 0], [0, 0, 0]], None)
    after = measured("cooperation-1-front", [[1, 2, 3], [0, 2, 0], [1, 2, 0], [0, 0, 0]], "ppo")
    (step,) = compare([before, after], 4)["steps"]
    assert (step["from"], step["to"], step["algorithm"]) == ("cooperation-0-sensors", "cooperation-1-front", "ppo")
    for count in ("first", "total"):
        change = step[count]
        assert change["difference"]["value"] == pytest.approx((0 - 4 + 1 + 0) / 4)
        assert [each["value"] for each in change["vehicles"]] == pytest.approx([-0.25, -1.25, 0.75])
        assert change["worse_off"]["value"] == 0.5  # worlds 0 and 2
        assert change["worse_off_vehicles"] == [0.0, 0.25, 0.25]
