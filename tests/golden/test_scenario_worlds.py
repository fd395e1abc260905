"""The first 1,000 worlds of every shipped scenario stay what they are, whatever is added to scenarios.

``python -m tests.golden.test_scenario_worlds`` writes the file anew.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ethbrake_marl.evaluation.inputs import worlds_sha256
from ethbrake_marl.scenario import list_scenarios, load_scenario

FILE = Path(__file__).with_name("scenario_worlds.json")
WORLDS = 1_000


def measured(name: str) -> dict[str, object]:
    scenario = load_scenario(name)
    lists = {"list": scenario.sample(WORLDS, 7), "training": scenario.sample(WORLDS, 0, channel="training")}
    return {
        channel: {"rejected": sample.rejected, "sha256": worlds_sha256(sample.worlds, sample.index)}
        for channel, sample in lists.items()
    }


@pytest.mark.parametrize("name", [entry.name for entry in list_scenarios()])
def test_worlds__are_what_they_were(name: str) -> None:
    assert measured(name) == json.loads(FILE.read_text())[name]


if __name__ == "__main__":
    content = {entry.name: measured(entry.name) for entry in list_scenarios()}
    FILE.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")
