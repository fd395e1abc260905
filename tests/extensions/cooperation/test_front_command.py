"""``study front`` as a user types it."""

import json
import signal
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from ethbrake_marl.extensions.cooperation import front
from tests.fixtures.commands import Command, Refuse, told_json

SMALL = "--episodes 20 --steps 1 --budget 100"


def test_front__writes_json_and_a_figure_and_prints_every_count(ethbrake: Command, empty_folder: Path) -> None:
    answer = ethbrake(*f"study front {SMALL} --agents e_v2x_bm --output out".split())
    assert answer.status == 0, answer.err
    found = json.loads(Path("out/front.json").read_text())
    assert [point["weights"] for point in found["points"][:3]] == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    assert (
        len(found["points"]) == len(found["agents"]["e_v2x_bm"]) == 7
    )  # corners, equal weights, corners that break ties
    assert found["agents"]["e_v2x_bm"][1]["ratio"] >= 1.0
    assert found["harm_count"] == "honest" and [*found["points"][0]["vehicles"]] == ["first", "total", "honest"]
    assert {each["reference"] for each in found["hypervolume"]} == {"full braking", "largest harm of each vehicle"}
    with Image.open("out/front.png") as picture:
        assert picture.width > 700
    for words in ("0,1,0", "full_brake", "maximin", "First", "Total", "Honest", "e_v2x_bm", "Hypervolume"):
        assert words in answer.out


def test_front__of_given_weights_two_learners_and_total_harm(ethbrake: Command, empty_folder: Path) -> None:
    line = "study front --scenario cooperation-4-all --weights 1,1,1 --weights 0,0,3 --episodes 2 --budget 20 --json"
    answer = ethbrake(*line.split(), "--set", "harm_count=total", "--output", "out")
    found = told_json(answer)
    assert (found["harm_count"], found["agents"]) == ("total", {}) and len(found["points"]) == 2


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("--weights 1,1", ("shape (1, 2)", "each of the 3 vehicles", "1,4,1")),
        ("--weights 1,x,1", ("weights 1,x,1: must be numbers",)),
        ("--steps 50", ("1,326 choices of weights", "at most 1,000")),
        ("--set roles.vehicle_2=full_brake", ("has no learner",)),
    ],
)
def test_front__refuses_before_any_work(refuse: Refuse, given: str, words: tuple[str, ...]) -> None:
    refuse(f"study front {given} --output out", *words)


@pytest.mark.filterwarnings("error")
def test_front__without_any_harm_has_a_figure_and_no_warning(ethbrake: Command, empty_folder: Path) -> None:
    line = "study front --weights 1,1,1 --episodes 3 --budget 50 --agents coast --set harm_count=first --output out"
    answer = ethbrake(*line.split(), "--set", "gaps_m=1000")
    assert answer.status == 0 and Path("out/front.png").is_file(), answer.err
    assert json.loads(Path("out/front.json").read_text())["harm_count"] == "first"


def test_front__does_not_replace_results(ethbrake: Command, empty_folder: Path) -> None:
    Path("out").mkdir()
    Path("out/front.json").write_text("mine")
    answer = ethbrake(*f"study front {SMALL} --output out".split())
    assert answer.status == 2 and "front.json" in answer.err and Path("out/front.json").read_text() == "mine"


def test_front__interrupted_keeps_the_worlds_that_are_finished(
    ethbrake: Command, empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, some = "study front --weights 1,1,1 --episodes 2 --budget 20 --output two", "--episodes 5 --output five"
    assert ethbrake(*whole.split()).status == 0
    monkeypatch.setattr(front, "FRONT_CHUNK", 2)
    search = front.search_profiles

    def interrupted(*arguments: Any, **settings: Any) -> Any:
        if front.FRONT_CHUNK == 2:
            signal.raise_signal(signal.SIGINT)
            monkeypatch.setattr(front, "FRONT_CHUNK", 3)
        return search(*arguments, **settings)

    monkeypatch.setattr(front, "search_profiles", interrupted)
    answer = ethbrake(*f"{whole} {some}".split())
    assert answer.status == 130 and "the results are those of the first 2 worlds" in answer.err
    assert "front: 10 searches with 100 candidates or more (--episodes 100 --steps 1: 14,000)" in answer.err
    two, five = (json.loads(Path(folder, "front.json").read_text()) for folder in ("two", "five"))
    assert two == five
