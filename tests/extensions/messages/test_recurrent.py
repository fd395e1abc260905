"""The recurrent network of train/recurrent.py, which looks at the age of messages."""

from pathlib import Path

import pytest

import ethbrake_marl as eb
from tests.docs.site import load


@pytest.mark.parametrize("memoryless", [False, True])
def test_recurrent__leaves_a_network_that_drives_and_keeps_to_its_budget(tmp_path: Path, memoryless: bool) -> None:
    script, task = load("../../train/recurrent"), eb.load_scenario("cooperation-3-congested")
    told = script.train(task, 0, 20_000, tmp_path, epochs=1, memoryless=memoryless)
    result = eb.evaluate(task, {"brakes": "full_brake", "gru": f"{script.__file__}:make_agent:{tmp_path}"}, episodes=5)
    assert 10_000 < told["simulated"] <= 20_000
    assert (result["gru"]["honest_cost"] != result["brakes"]["honest_cost"]).any()
