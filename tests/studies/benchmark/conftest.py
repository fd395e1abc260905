"""A suite of three small lists, and entries on it."""

from __future__ import annotations

from pathlib import Path

import pytest

from ethbrake_marl.limits.limits import search_list
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.benchmark import Suite, load_suite
from tests.docs.site import load

freezing = load("../studies/freeze_suite")

TINY = {"paper-random": ("first", 901), "paper-random-obstacle": ("total", 902), "cooperation-3-pair": ("total", 903)}
WORLDS = 12


@pytest.fixture(scope="session")
def suites(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the suite ``tiny``; not to be changed."""
    lists = []
    for name, (harm_count, seed) in TINY.items():
        scenario = load_scenario(name)
        table = search_list(scenario, scenario.sample(WORLDS, seed), counts=(harm_count,), budget=300, threads=1)
        lists.append(freezing.NewList(name, "small", scenario, seed, WORLDS, harm_count, table))
    folder = tmp_path_factory.mktemp("suites")
    freezing.freeze_suite("tiny", lists, folder)
    return folder


@pytest.fixture
def tiny(suites: Path) -> Suite:
    """The suite ``tiny``."""
    return load_suite("tiny", suites)


@pytest.fixture(scope="session")
def entries(suites: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an entry of full_brake, coast (all lists) and full_brake+episode (two lists); not to be changed."""
    suite, folder = load_suite("tiny", suites), tmp_path_factory.mktemp("entries")
    for spec in ("full_brake", "coast", "full_brake+episode"):
        suite.make_entry(spec).write(folder / f"{spec}.json")
    return folder
