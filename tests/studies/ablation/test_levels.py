"""Which levels belong together."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.scenario import load_scenario, scenario_path
from ethbrake_marl.studies.ablation import LADDER, STANDARD, Level, common_worlds, read_levels


def test_read_levels__the_standard_set_is_a_ladder_and_its_worse_channels():
    levels = read_levels([*STANDARD, "cooperation-3-congested"])
    assert [level.name for level in levels if level.clear is None] == list(LADDER)
    assert {level.name: level.clear for level in levels if level.clear} == {
        "cooperation-2-blocked": "cooperation-2-paper",
        "cooperation-3-congested": "cooperation-3-pair",
    }
    assert [bool(level.scenario.learners) for level in levels] == [False] + [True] * (len(levels) - 1)


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
    with pytest.raises(InvalidInput, match=r"'cooperation-3-five': its vehicles differs from .* \(5; there 3\)"):
        common_worlds(read_levels(["cooperation-3-pair", "cooperation-3-five"]), 3, 7)


PAPER = load_scenario("cooperation-2-paper")


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"gaps_m": 7}, "gaps_m"),
        (
            {"mass_t": [4.5, 5.5, 6]},
            r"mass_t differs from that of 'cooperation-2-paper' \(4.5, 5.5, 6; there 4.5, 5.5, 5.9\)",
        ),
        ({"braking_capacity_mps2": 6}, "braking_capacity_mps2"),
        ({"driving_capacity_mps2": 6}, "driving_capacity_mps2"),
        ({"restitution": 0.2}, "restitution"),
        ({"speed_limit_mps": 30}, "speed_limit_mps"),
        ({"time_step_s": 0.05}, "time_step_s"),
        ({"horizon_s": 9}, r"horizon_s differs .* \(9; there 8\)"),
        ({"latency_s": [0, 0.5, 0.9]}, "latency_s"),
        ({"observation": ["own"]}, "observation differs from that of .cooperation-2-paper."),
    ],
)
def test_common_worlds__other_physics_are_refused(changes, what):
    other = PAPER.replace(name="mine", roles={"vehicle_3": "learner"}, **changes)
    with pytest.raises(InvalidInput, match=f"level 'mine': its {what}"):
        common_worlds([Level(PAPER), Level(other)], 5, 7)


def test_common_worlds__news_roles_objectives_and_an_obstacle_may_differ():
    roles = {"vehicle_1": "learner", "vehicle_3": "coast"}
    free = PAPER.replace(name="mine", roles=roles, objective="own", obstacle_gap_m=42, v2x="blocked")
    late = PAPER.replace(name="late", v2x="blocked")
    assert len(common_worlds([Level(PAPER), Level(free), Level(late)], 5, 7)) == 3
    with pytest.raises(InvalidInput, match="level 'late': its latency_s differs from that of 'mine'"):
        common_worlds([Level(PAPER), Level(free), Level(late.replace(latency_s=[0, 0.5, 0.9]))], 5, 7)
