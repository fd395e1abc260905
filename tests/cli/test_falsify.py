"""`ethbrake search falsify`: what it finds, writes, and drives again."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ethbrake_marl.evaluation.inputs import NamedWorlds
from tests.cli.conftest import Command

FOUND = ("search", "falsify", "--agent", "coast", "--against", "full_brake", "--budget", "300", "--keep", "4")


@pytest.fixture
def file(ethbrake: Command, tmp_path: Path) -> Path:
    """Four worlds in which coasting is worst."""
    path = tmp_path / "worst.yaml"
    assert ethbrake(*FOUND, "--output", path).status == 0
    return path


def test_falsify__writes_worlds_that_evaluate_takes_and_that_read_back(ethbrake: Command, file: Path) -> None:
    kept = NamedWorlds.read(file)
    assert [world.name for world in kept.worlds] == ["regret-1", "regret-2", "regret-3", "regret-4"]
    assert kept.text == file.read_text("utf-8")
    answer = ethbrake("evaluate", "--initial-states", file, "--agents", "coast,full_brake", "--json")
    rows = json.loads(answer.out)
    regret = rows[0]["first_impact_harm"] - rows[1]["first_impact_harm"]
    assert regret == pytest.approx(sum(world.score for world in kept.worlds) / 4)


def test_falsify_again__says_who_is_worse(ethbrake: Command, file: Path) -> None:
    same = ethbrake("search", "falsify", "--again", file)
    assert same.status == 0 and "coast is worse in 0 of 4 worlds" in same.err
    better = ethbrake("search", "falsify", "--again", file, "--agent", "e_v2x_bm", "--json")
    assert better.status == 0 and not any(row["worse"] for row in json.loads(better.out)["worlds"])
    worse = ethbrake("search", "falsify", "--again", file, "--agent", "constant:-6")
    assert worse.status == 1 and "constant:-6 is worse in 4 of 4 worlds" in worse.err


def test_falsify__tells_the_command_that_finds_the_same(ethbrake: Command, file: Path) -> None:
    again = ethbrake(*FOUND, "--json")
    told = json.loads(again.out)
    assert told["worlds"] == [world.model_dump(exclude_none=True) for world in NamedWorlds.read(file).worlds]
    assert told["found_by"].startswith("ethbrake search falsify --agent coast --measure regret --against full_brake")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("scenario: paper-random", "scenario: paper-distance"), "which 'paper-distance' is not, or is no longer"),
        (("harm_count: first", "harm_count: second"), "line 8: harm_count = second: must be first or total"),
        (("    score: ", "    skore: "), "worlds[0].skore: unknown key; did you mean score?"),
        (("name: regret-2", "name: regret-1"), "world 'regret-1' is given twice"),
        (("gap_2_m", "gap_3_m"), "gap_3_m"),
        (("version: 1", "version: 2"), "line 2: version"),
        (("version: 1", "version: true"), "line 2: version"),
    ],
)
def test_falsify_again__refuses_a_file_that_is_damaged(
    ethbrake: Command, file: Path, change: tuple[str, str], said: str
) -> None:
    file.write_text(file.read_text("utf-8").replace(*change), "utf-8")
    answer = ethbrake("search", "falsify", "--again", file)
    assert answer.status == 2 and said in answer.err


def test_falsify__keeps_a_file_that_is_there(ethbrake: Command, file: Path) -> None:
    before = file.read_bytes()
    assert ethbrake(*FOUND, "--output", file).status == 2 and file.read_bytes() == before


def test_falsify__says_when_nothing_is_found(ethbrake: Command, tmp_path: Path) -> None:
    same = ("search", "falsify", "--agent", "full_brake", "--against", "constant:7", "--budget", "64")
    answer = ethbrake(*same, "--output", tmp_path / "none.yaml")
    assert answer.status == 0 and "nothing was found" in answer.err and not (tmp_path / "none.yaml").exists()
    assert json.loads(ethbrake(*same, "--json").out)["worlds"] == []


@pytest.mark.parametrize("key", ["agent", "against"])
def test_falsify_again__runs_no_code_that_a_file_names(ethbrake: Command, file: Path, tmp_path: Path, key: str) -> None:
    (tmp_path / "evil.py").write_text("from pathlib import Path\nPath(__file__).with_suffix('.ran').touch()\n")
    text = file.read_text("utf-8").replace(
        f"{key}: {'coast' if key == 'agent' else 'full_brake'}\n", f'{key}: "{tmp_path}/evil.py:make"\n'
    )
    assert "evil.py" in text
    file.write_text(text, "utf-8")
    answer = ethbrake("search", "falsify", "--again", file)
    assert answer.status == 2 and "is code" in answer.err and not (tmp_path / "evil.ran").exists()


@pytest.mark.parametrize("option", [("--harm-count", "total"), ("--scenario", "stress-wide"), ("--keep", "3")])
def test_falsify_again__refuses_what_the_file_says(ethbrake: Command, file: Path, option: tuple[str, str]) -> None:
    answer = ethbrake("search", "falsify", "--again", file, *option)
    assert answer.status == 2 and option[0] in answer.err


def test_falsify__as_many_worlds_as_it_keeps_read_back(ethbrake: Command, tmp_path: Path) -> None:
    path = tmp_path / "many.yaml"
    call = [
        "search",
        "falsify",
        "--agent",
        "full_brake",
        "--measure",
        "harm",
        "--scenario",
        "stress-wide",
        "--keep",
        "200",
    ]
    assert ethbrake(*call, "--budget", "512", "--at-random", "--output", path).status == 0
    assert path.stat().st_size > 64 << 10 and len(NamedWorlds.read(path).worlds) == 200
