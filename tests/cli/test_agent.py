"""``agent show``: where a policy was trained."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fixtures.commands import Command, check_refused, told_json
from tests.policies.test_bundles import make_policy


def test_show__has_the_training_and_the_range_in_units(ethbrake: Command) -> None:
    content = told_json(ethbrake("agent", "show", "ppo", "--scenario", "cooperation-3-five", "--json"))
    assert content["about"] == (
        "ppo: vehicle_2 in paper-random, by ppo. In cooperation-3-five, 71 % of its decisions are outside."
    )
    ranges = {row.pop("feature"): row for row in content["range"]}
    assert ranges["own.braking_capacity"] == {"from": pytest.approx(7.0), "to": pytest.approx(7.0), "unit": "m/s2"}
    assert -0.5 < ranges["own.speed"]["from"] <= 0.1 and 20.0 < ranges["own.speed"]["to"] < 23.0
    table = ethbrake("agent", "show", "ppo").out
    assert table.startswith("ppo: vehicle_2 in paper-random, by ppo.")
    assert "own.braking_capacity" in table and "7.00" in table


def test_show__is_for_trained_policies_that_have_a_range(ethbrake: Command, tmp_path: Path) -> None:
    make_policy().save(tmp_path / "old")
    old = f"policy@{tmp_path / 'old'}"
    check_refused(ethbrake("agent", "show", old), f"agent '{old}': its file does not say what it observed in training")
    check_refused(ethbrake("agent", "show", "coast"), "agent 'coast': is no trained policy; name one, such as ppo")
