"""Controllers that drive a vehicle of another simulator, and one behind the driver, decide as in an episode."""

import pytest

import ethbrake_marl as eb
from tests.faces.test_driver import PAPER, drive_by_hand


@pytest.mark.parametrize("agent", ["idm", "acc", "cacc", "rss", "r157_human", "r157_fsm", "aeb", "human"])
def test_controllers__decide_alike(agent: str) -> None:
    assert drive_by_hand("paper-random-buildup", agent) == 0.0


def test_driver__knows_the_commands_of_a_follower_that_reacts() -> None:
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "idm"}
    behind: eb.Scenario = PAPER.replace(roles=roles, early_impacts="keep")
    assert drive_by_hand(behind, "ppo") == 0.0
