"""Tables of best known harm that are none: refused by their headers, before anything is unpacked."""

from __future__ import annotations

import random
import re
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.limits.limits import BestHarmTable, search_list
from ethbrake_marl.scenario import load_scenario
from tests.programmes.archives import CERTAIN, ONLY_A_PROBLEM_KNOWS, bomb, good, good_bytes, packed

READ = [category for category in CERTAIN if category not in ONLY_A_PROBLEM_KNOWS]


@pytest.mark.parametrize("category", READ)
def test_load_table__refuses_what_is_no_table(category: str, tmp_path: Path) -> None:
    for k in range(3):
        (tmp_path / "t.npz").write_bytes(CERTAIN[category](random.Random(k)))
        with pytest.raises(CorruptBundle, match=r"t\.npz: is not a table of best known harm: "):
            BestHarmTable.load(tmp_path / "t.npz")


def test_load_table__a_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "t.npz").write_bytes(bomb(2 << 30))
    monkeypatch.setattr("numpy.frombuffer", lambda *args, **kwargs: pytest.fail("unpacked"))
    with pytest.raises(CorruptBundle, match=r"would be 2,147,\d+,\d+ bytes when unpacked; 268,435,456 is the limit"):
        BestHarmTable.load(tmp_path / "t.npz")


def test_load_table__says_which_array_is_wrong_and_what_is_right(tmp_path: Path) -> None:
    (tmp_path / "t.npz").write_bytes(packed({**good(), "first_harm": np.zeros(4)}))
    with pytest.raises(CorruptBundle, match=re.escape("array 'first_harm' is <f8 [4], should be <f8 [3]")):
        BestHarmTable.load(tmp_path / "t.npz")


@pytest.mark.parametrize("category", ONLY_A_PROBLEM_KNOWS)
def test_search__refuses_a_start_that_does_not_fit(category: str, tmp_path: Path) -> None:
    scenario = load_scenario("paper-random")
    sample = scenario.sample(3, 7)
    (tmp_path / "t.npz").write_bytes(CERTAIN[category](random.Random(1)))
    with pytest.raises((InvalidInput, CorruptBundle)):
        search_list(scenario, sample, budget=1, threads=1, known=BestHarmTable.load(tmp_path / "t.npz"))


def test_good_table__is_read(tmp_path: Path) -> None:
    (tmp_path / "t.npz").write_bytes(good_bytes())
    assert len(BestHarmTable.load(tmp_path / "t.npz").identity) == 3
