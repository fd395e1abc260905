"""The first 1,000 worlds of every shipped scenario stay what they are, whatever is added to scenarios.

``python -m tests.golden.test_scenario_worlds`` writes the file anew.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ethbrake_marl.evaluation.identity import worlds_sha256
from ethbrake_marl.scenario import Sample, list_scenarios, load_scenario
from ethbrake_marl.scenario.sample import quantity_columns

FILE = Path(__file__).with_name("scenario_worlds.json")
WORLDS = 1_000
INEXACT = ("normal", "loguniform")  # call the machine's logarithm or power: the last bit may differ between platforms


def told(sample: Sample, name: str) -> dict[str, object]:
    """The hash of the worlds; where the machine may matter, the sums of their quantities."""
    declared = json.dumps(load_scenario(name).declared())
    if any(f'"{kind}"' in declared for kind in INEXACT):
        return {"sums": {column: float(values.sum()) for column, values in quantity_columns(sample.worlds).items()}}
    return {"sha256": worlds_sha256(sample.worlds, sample.index)}


def measured(name: str) -> dict[str, object]:
    scenario = load_scenario(name)
    lists = {"list": scenario.sample(WORLDS, 7), "training": scenario.sample(WORLDS, 0, channel="training")}
    return {channel: {"rejected": sample.rejected, **told(sample, name)} for channel, sample in lists.items()}


@pytest.mark.parametrize("name", [entry.name for entry in list_scenarios()])
def test_worlds__are_what_they_were(name: str) -> None:
    kept, found = json.loads(FILE.read_text())[name], measured(name)
    for channel, wanted in kept.items():
        sums = wanted.pop("sums", None)
        if sums is not None:
            assert found[channel].pop("sums") == pytest.approx(sums, rel=1e-12)  # type: ignore[attr-defined]
        assert found[channel] == wanted


if __name__ == "__main__":
    content = {entry.name: measured(entry.name) for entry in list_scenarios()}
    FILE.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")
