"""`ethbrake study ablate`: what it refuses."""

from pathlib import Path

import pytest

from tests.fixtures.commands import Refuse

REFUSED = [
    (
        "study ablate --output new --levels cooperation-3-par,cooperation-2-paper",
        "unknown scenario 'cooperation-3-par'; did you mean 'cooperation-3-pair'?",
    ),
    (
        "study ablate --output new --levels cooperation-3-pair,cooperation-3-pair",
        "levels: 'cooperation-3-pair' is given twice",
    ),
    ("study ablate --output new --levels cooperation-3-pair", "levels: 1 level given; give at least two levels"),
    (
        "study ablate --output new --levels cooperation-0-sensors,paper-distance",
        "level 'paper-distance': speeds_mps is 20, 18, 20, but",
    ),
    (
        "study ablate --output new --levels cooperation-3-pair,cooperation-3-five",
        "level 'cooperation-3-five': vehicles is 5, but 3 at level 'cooperation-3-pair'",
    ),
    (
        "study ablate --output new --episodes 10 --search-episodes 11",
        "search-episodes = 11: must be at most the number of worlds, episodes = 10",
    ),
    (
        "study ablate --output new --set scheme=shard",
        "recipe 'cooperation': scheme = shard: must be single, shared, independent or centralised",
    ),
    (
        "study ablate --output new --shield robust",
        "shield 'robust': the shield must be 'step', because other shields can control only one vehicle",
    ),
    ("study ablate --output new --recipes ppo,ppo", "recipes ppo, ppo: two recipes have the same name"),
]


@pytest.mark.parametrize(("line", "message"), REFUSED, ids=lambda value: value[:60])
def test_ablation__is_refused(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)


def test_output__is_a_folder_of_its_own(refuse: Refuse) -> None:
    Path("file").write_text("precious")
    refuse("study ablate --output file/new", "is not a folder; give a new folder (--output)")
