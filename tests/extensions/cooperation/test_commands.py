"""`ethbrake study ablate`: what it refuses."""

from pathlib import Path

import pytest

from tests.fixtures.commands import Refuse

REFUSED = {
    "--levels cooperation-3-pair,cooperation-3-pair": "given twice",
    "--levels cooperation-3-pair": "give at least two levels",
    "--levels cooperation-0-sensors,paper-distance": "level 'paper-distance': speeds_mps is",
    "--levels cooperation-3-pair,cooperation-3-five": "vehicles is 5, but 3",
    "--episodes 10 --search-episodes 11": "search-episodes = 11",
    "--shield robust": "shield 'robust'",
    "--recipes ppo,ppo": "two recipes have the same name",
}


@pytest.mark.parametrize("words", REFUSED)
def test_ablation__is_refused(words: str, refuse: Refuse) -> None:
    refuse(f"study ablate --output new {words}", REFUSED[words])


def test_output__is_a_folder_of_its_own(refuse: Refuse) -> None:
    Path("file").write_text("precious")
    refuse("study ablate --output file/new", "is not a folder; give a new folder (--output)")
