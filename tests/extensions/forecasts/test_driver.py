"""Agents that forecast decide alike when they drive a vehicle of another simulator."""

import pytest

from tests.faces.test_driver import drive_by_hand


@pytest.mark.parametrize(
    "scenario", ["paper-random", "paper-random-obstacle", "realistic-mixed-buildup", "stress-wide"]
)
@pytest.mark.parametrize("agent", ["plan", "ppo"])
def test_forecasts__decide_alike(scenario: str, agent: str) -> None:
    assert drive_by_hand(scenario, agent) == 0.0
