"""What a driver in another simulator has received is what it would have received in an episode."""

import pytest

from tests.faces.test_driver import PAPER, drive_by_hand

PERIODIC = PAPER.replace(v2x={"preset": "nominal", "persistence": "periodic"}, early_impacts="keep")


@pytest.mark.parametrize("scenario", ["messages-noisy", PERIODIC], ids=["noisy", "periodic"])
def test_messages__are_received_alike(scenario: object) -> None:
    assert drive_by_hand(scenario, "ppo") == 0.0
