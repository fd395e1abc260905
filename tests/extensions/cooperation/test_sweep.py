"""Levels and sweeps: what they are, and what is refused before any work."""

from pathlib import Path

import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli.settings import read_settings
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.cooperation.levels import common_worlds, read_levels, sweep_levels
from ethbrake_marl.extensions.cooperation.sweep import parse_sweep
from tests.fixtures.commands import Refuse

NOTHING = read_settings(())


@pytest.mark.parametrize(
    ("text", "settings"),
    [
        ("objective=social:0..90:45", ["objective=social:0", "objective=social:45", "objective=social:90"]),
        ("v2x.lost=0..0.3:0.1", ["v2x.lost=0", "v2x.lost=0.1", "v2x.lost=0.2", "v2x.lost=0.3"]),
        ("friction = 0.9, 0.2..0.4:0.1, 10", [f"friction={each}" for each in ("0.2", "0.3", "0.4", "0.9", "10")]),
        ("k=-0.5..0.5:0.5", ["k=-0.5", "k=0", "k=0.5"]),
        ("objective=social:45,0", ["objective=social:0", "objective=social:45"]),
    ],
)
def test_parse__ranges_and_lists_in_ascending_order(text: str, settings: list[str]) -> None:
    values = parse_sweep(text)
    assert [each.setting for each in values] == settings
    assert [each.number for each in values] == [float(each.replace(":", "=").split("=")[-1]) for each in settings]


REFUSED = {
    "--sweep objective=own,total": "must be KEY=LOW..HIGH:STEP",
    "--sweep objective=social:0..100:15": "equal steps",
    "--sweep friction=0.5..1:-0.1": "equal steps",
    "--sweep friction=0.5": "give 2 to 100 numbers",
    "--sweep friction=0..60:1,100..160:1": "give 2 to 100 numbers",
    "--sweep friction=0.5,0.50": "given twice",
    "--sweep gamma=0.9,0.99": "only a key of a scenario can be swept",
    "--sweep vehicles=2,3": "cannot be compared",
    "--sweep friction=0.5,0.6 --sweep v2x.lost=0,0.1": "--sweep is given twice",
    "--sweep friction=0.5,0.6 --set friction=1": "--set changes the same key",
    "--sweep friction=0.5,0.6 --levels cooperation-3-pair,cooperation-4-all": "a sweep needs exactly one level",
    "--sweep objective=social:0,90 --set reward.objective=own": "has its own objective",
    "--levels cooperation-3-pair,cooperation-3-pair": "given twice",
    "--levels cooperation-3-pair": "give at least two levels",
    "--levels cooperation-0-sensors,paper-distance": "level 'paper-distance': speeds_mps is",
    "--levels cooperation-3-pair,cooperation-3-five": "vehicles is 5, but 3",
    "--levels cooperation-0-sensors,cooperation-3-pair --set roles.vehicle_2=coast --set roles.vehicle_3=coast": (
        "no level has a learner"
    ),
    "--episodes 10 --search-episodes 11": "search-episodes = 11",
    "--shield robust": "shield 'robust'",
    "--recipes ppo,ppo": "two recipes have the same name",
}


@pytest.mark.parametrize("words", REFUSED)
def test_ablation__is_refused(words: str, refuse: Refuse) -> None:
    recipes = "" if "--recipes" in words else "--recipes ppo "
    refuse(f"study ablate --output new {recipes}{words}", REFUSED[words])


def test_output__is_a_folder_of_its_own(refuse: Refuse) -> None:
    Path("file").write_text("precious")
    refuse("study ablate --recipes ppo --output file/new", "is not a folder; give a new folder (--output)")


def test_levels__that_differ_only_in_messages_are_compared_with_the_first_one() -> None:
    levels = read_levels(["cooperation-2-paper", "cooperation-3-pair", "cooperation-3-congested"], NOTHING)
    assert [level.clear for level in levels] == [None, None, "cooperation-3-pair"]
    one, *others = common_worlds(levels, 20, 7)
    for other in others:
        assert other.worlds.gaps_m.tolist() == one.worlds.gaps_m.tolist()
    late = others[1].worlds.latency_s > one.worlds.latency_s
    assert late.any()  # a congested channel delays


def test_levels__whose_vehicles_differ_are_refused_unless_a_sweep_varies_them(tmp_path: Path) -> None:
    heavy = read_levels(["cooperation-2-paper", "cooperation-3-pair"], NOTHING)
    heavy[1] = heavy[1]._replace(scenario=heavy[1].scenario.replace(mass_t=[4.5, 5.5, 40.0]))
    with pytest.raises(InvalidInput, match=r"level 'cooperation-3-pair': mass_t is 4.5, 5.5, 40, but 4.5, 5.5, 5.9"):
        common_worlds(heavy, 5, 7)
    recipe = eb.load_recipe("ppo")
    swept = sweep_levels("cooperation-3-pair", "mass_t.2=5,40", NOTHING, [recipe])
    assert [level.name for level in swept] == ["cooperation-3-pair-mass_t.2-5", "cooperation-3-pair-mass_t.2-40"]
    assert [each.worlds.mass_t[0, 2] for each in common_worlds(swept, 5, 7)] == [5.0, 40.0]
    alike = sweep_levels("cooperation-3-pair", "objective=social:0,30", NOTHING, [recipe])
    assert [level.same_vehicles for level in (*swept, *alike)] == [False, False, True, True]
