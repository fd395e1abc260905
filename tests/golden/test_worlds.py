"""Worlds of the shipped scenarios, as digests: a seed gives the same worlds in every version and on every machine.

``python -m tests.golden.test_worlds`` records them anew, which breaks every list of worlds that anybody has used.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.worlds.catalogue import list_scenarios, load_scenario
from tests.fixtures.scenarios import SHIPPED

FILE = Path(__file__).with_name("worlds.json")
RECORDED = json.loads(FILE.read_text("utf-8")) if FILE.exists() else {}


def digest(name: str) -> str:
    """SHA-256 of 1,500 worlds of seed 7: line, car, know, first commands, in this order."""
    worlds, sha256 = load_scenario(name).sample(1500, 7), hashlib.sha256()
    for array in (worlds.line, worlds.car, worlds.know, worlds.wanted):
        sha256.update(np.ascontiguousarray(array, "<f8").tobytes())
    return sha256.hexdigest()


def test_every_shipped_scenario__is_recorded() -> None:
    assert [*RECORDED] == [entry.name for entry in list_scenarios()]


@pytest.mark.parametrize("name", SHIPPED)
def test_worlds__are_those_of_the_record(name: str) -> None:
    assert digest(name) == RECORDED[name]


if __name__ == "__main__":
    digests = {entry.name: digest(entry.name) for entry in list_scenarios()}
    FILE.write_text(json.dumps(digests, indent=1) + "\n", "utf-8")
