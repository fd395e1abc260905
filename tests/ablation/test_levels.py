"""Which levels belong together."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.ablation.levels import LADDER, STANDARD, common_worlds, read_levels
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.scenario import scenario_path


def test_read_levels__the_standard_set_is_a_ladder_and_its_worse_channels():
    levels = read_levels([*STANDARD, "cooperation-3-congested"])
    assert [level.name for level in levels if level.clear is None] == list(LADDER)
    assert {level.name: level.clear for level in levels if level.clear} == {
        "cooperation-2-blocked": "cooperation-2-paper",
        "cooperation-3-congested": "cooperation-3-pair",
    }
    assert [level.trained for level in levels] == [False] + [True] * (len(levels) - 1)


def test_read_levels__a_channel_belongs_to_the_level_that_came_before_it(tmp_path):
    late = tmp_path / "mine.yaml"
    text = scenario_path("cooperation-2-paper").read_text().replace("v2x: paper", "v2x: nominal")
    late.write_text(text.replace("name: cooperation-2-paper", "name: mine"))
    assert [level.clear for level in read_levels(["cooperation-2-paper", str(late)])] == [None, "cooperation-2-paper"]
    assert [level.clear for level in read_levels([str(late), "cooperation-2-paper"])] == [None, "mine"]


def test_common_worlds__gaps_and_speeds_are_the_same_at_every_level():
    samples = common_worlds(read_levels(STANDARD), 50, 7)
    for sample in samples:
        np.testing.assert_array_equal(sample.worlds.gaps_m, samples[0].worlds.gaps_m)
        np.testing.assert_array_equal(sample.worlds.speeds_mps, samples[0].worlds.speeds_mps)


def test_levels__bad_ones_are_refused():
    with pytest.raises(EthBrakeError, match="cooperation-2-paper"):
        read_levels(["cooperation-2-papr", "cooperation-3-pair"])
    with pytest.raises(InvalidInput, match="'cooperation-3-pair' is given twice"):
        read_levels(["cooperation-3-pair", "cooperation-3-pair"])
    with pytest.raises(InvalidInput, match="1 given; at least two"):
        read_levels(["cooperation-3-pair"])
    with pytest.raises(InvalidInput, match=r"'cooperation-3-five': its worlds are not those .* \(5 and 3 vehicles\)"):
        common_worlds(read_levels(["cooperation-3-pair", "cooperation-3-five"]), 3, 7)
