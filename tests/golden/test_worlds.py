"""Worlds of the shipped scenarios, as digests: a seed gives the same worlds in every version and on every machine.

``worlds.json`` has the lists for evaluation, ``training_worlds.json`` the stream for training and its number of
rejected draws. ``python -m tests.golden.test_worlds`` records them anew, which breaks all lists that people have used.
"""

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.episode.state import State
from ethbrake_marl.evaluation.provenance import MOTION, plain_car
from ethbrake_marl.worlds.catalogue import list_scenarios, load_scenario
from tests.fixtures.scenarios import SHIPPED

LISTS, TRAINING = (Path(__file__).with_name(f"{name}.json") for name in ("worlds", "training_worlds"))
RECORDED, RECORDED_TRAINING = (json.loads(file.read_text("utf-8")) for file in (LISTS, TRAINING))


def digest(worlds: State) -> str:
    sha256 = hashlib.sha256()
    for array in (worlds.line[:, MOTION], plain_car(worlds), worlds.know, worlds.wanted):
        sha256.update(np.ascontiguousarray(array, "<f8").tobytes())
    return sha256.hexdigest()


def listed(name: str) -> str:
    return digest(load_scenario(name).sample(1500, 7))


def trained_on(name: str) -> list[str | int]:
    drawn = load_scenario(name).draw(1000, 0, first=0, purpose="training")
    return [digest(drawn.worlds)[:16], drawn.rejected]


def test_every_shipped_scenario__is_recorded() -> None:
    assert [*RECORDED] == [*RECORDED_TRAINING] == [entry.name for entry in list_scenarios()]


@pytest.mark.parametrize("name", SHIPPED)
def test_worlds__are_those_of_the_record(name: str) -> None:
    assert listed(name) == RECORDED[name]
    assert trained_on(name) == RECORDED_TRAINING[name]


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for file, record in ((LISTS, listed), (TRAINING, trained_on)):
        file.write_text(json.dumps({entry.name: record(entry.name) for entry in list_scenarios()}, indent=1) + "\n")
