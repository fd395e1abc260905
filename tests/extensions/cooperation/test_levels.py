"""Levels and sweeps: what they are, and what is refused before any work."""

from itertools import pairwise
from pathlib import Path

import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli.settings import read_settings
from ethbrake_marl.extensions.cooperation.levels import (
    STANDARD,
    Level,
    common_worlds,
    parse_sweep,
    read_levels,
    sweep_levels,
)
from ethbrake_marl.worlds.mixture import DESCRIPTIVE_KEYS
from tests.fixtures.commands import Refuse
from tests.refused import refused

NOTHING = read_settings(())
LEVEL_2 = eb.load_scenario("cooperation-2-paper")


@pytest.mark.parametrize(
    ("text", "settings"),
    [
        ("objective=social:0..90:45", ["objective=social:0", "objective=social:45", "objective=social:90"]),
        ("friction = 0.9, 0.2..0.4:0.1, 10", [f"friction={each}" for each in ("0.2", "0.3", "0.4", "0.9", "10")]),
        ("k=-0.5..0.5:0.5", ["k=-0.5", "k=0", "k=0.5"]),
        ("objective=social:45,0", ["objective=social:0", "objective=social:45"]),
    ],
)
def test_parse__ranges_and_lists_in_ascending_order(text: str, settings: list[str]) -> None:
    values = parse_sweep(text)
    assert [each.setting for each in values] == settings
    assert [each.number for each in values] == [float(each.replace(":", "=").split("=")[-1]) for each in settings]


def test_standard_levels__change_one_thing_each_in_the_same_worlds() -> None:
    levels = read_levels(STANDARD, NOTHING)
    assert [level.before for level in levels] == [None, *STANDARD[:-1]]
    contents = [level.scenario.content(without=("name", *DESCRIPTIVE_KEYS)) for level in levels]
    changes = [{key for key in one if one[key] != other[key]} for one, other in pairwise(contents)]
    assert changes == [{"v2x"}, {"roles", "objective"}, {"objective"}, {"roles"}, {"roles"}]  # at 1 nobody learns
    drawn = common_worlds(levels, 20, 7)
    assert all(each.worlds.gaps_m.tolist() == drawn[0].worlds.gaps_m.tolist() for each in drawn)


REFUSED = {
    "--sweep objective=own,total": "must be KEY=LOW..HIGH:STEP",
    "--sweep objective=social:0..100:15": "equal steps",
    "--sweep friction=0.5..1:-0.1": "equal steps",
    "--sweep friction=0.5": "give 2 to 100 numbers",
    "--sweep friction=0..60:1,100..160:1": "give 2 to 100 numbers",
    "--sweep friction=0.5,0.50": "given twice",
    "--sweep gamma=0.9,0.99": "only a key of a scenario can be swept",
    "--sweep vehicles=2,3": "cannot be compared",
    "--sweep friction=0.5,0.6 --sweep v2x.silent_links=0,0.1": "--sweep is given twice",
    "--sweep friction=0.5,0.6 --set friction=1": "--set changes the same key",
    "--sweep friction=0.5,0.6 --levels cooperation-3-pair,cooperation-4-all": "a sweep needs exactly one level",
    "--sweep objective=social:0,90 --set reward.objective=own": "has its own objective",
    "--levels cooperation-3-pair,cooperation-3-pair": "given twice",
    "--levels cooperation-3-pair": "give at least two levels",
    "--levels level-0-sensors,paper-distance": "level 'paper-distance': speed_1_mps is",
    "--levels level-0-sensors,cooperation-3-pair --set roles.vehicle_2=coast --set roles.vehicle_3=coast": (
        "no level has a learner"
    ),
    "--episodes 10 --search-episodes 11": "search-episodes = 11",
    "--recipes ppo,ppo": "two recipes have the same name",
}


@pytest.mark.parametrize("words", REFUSED)
def test_ablation__is_refused(words: str, refuse: Refuse) -> None:
    recipes = "" if "--recipes" in words else "--recipes ppo "
    refuse(f"study ablate --output new {recipes}{words}", REFUSED[words])


def test_output__is_a_folder_of_its_own(refuse: Refuse) -> None:
    Path("file").write_text("precious")
    refuse("study ablate --recipes ppo --output file/new", "is not a folder; give a new folder (--output)")


def level(scenario: eb.Scenario) -> Level:
    return Level(scenario.name, scenario)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass_t": [4.5, 5.5, 6]}, "level 'mine': mass_3_t is 6.0, but 5.9 at level 'cooperation-2-paper'"),
        ({"brake_rate_mps3": 30}, "level 'mine': brake_rate_1_mps3 is 30.0, but not set at level"),
    ],
)
def test_levels__are_compared_on_the_same_lines(changes: dict[str, object], message: str) -> None:
    mine = LEVEL_2.replace(name="mine", roles={"vehicle_3": "learner"}, **changes)
    with refused(message):
        common_worlds([level(LEVEL_2), level(mine)], 5, 7)


def test_levels__may_differ_in_roles_objective_obstacle_and_channel_alone() -> None:
    roles = {"vehicle_1": "learner", "vehicle_3": "coast"}
    free = LEVEL_2.replace(name="mine", roles=roles, objective="own", obstacle_gap_m=42, v2x="blocked")
    late = LEVEL_2.replace(name="late", v2x="blocked")
    one, *others = common_worlds([level(LEVEL_2), level(free), level(late)], 5, 7)
    for other in others:
        assert other.worlds.gaps_m.tolist() == one.worlds.gaps_m.tolist()
        assert (other.worlds.latency_s > one.worlds.latency_s).any()
    with refused("level 'late': latency_3_s is"):
        common_worlds([level(LEVEL_2), level(free), level(late.replace(latency_s=[0, 0.5, 0.9]))], 5, 7)


def test_sweep__may_vary_the_vehicles() -> None:
    recipe = eb.load_recipe("ppo")
    swept = sweep_levels("cooperation-3-pair", "mass_t.2=5,40", NOTHING, [recipe])
    names = ["cooperation-3-pair-mass_t.2-5", "cooperation-3-pair-mass_t.2-40"]
    assert [(level.name, level.before) for level in swept] == [(names[0], None), (names[1], names[0])]
    assert [each.worlds.mass_t[0, 2] for each in common_worlds(swept, 5, 7)] == [5.0, 40.0]
    alike = sweep_levels("cooperation-3-pair", "objective=social:0,30", NOTHING, [recipe])
    assert [level.same_vehicles for level in (*swept, *alike)] == [False, False, True, True]
    assert alike[0].swept is not None and alike[0].swept.axis == "objective = social:…"
