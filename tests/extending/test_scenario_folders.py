"""Folders of scenarios that somebody registers: known by name, listed with where they come from."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName
from ethbrake_marl.scenario import new_scenario_text
from ethbrake_marl.scenario.schema import FOLDERS


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "mine"
    path.mkdir()
    for name in ("hills", "coast-road"):
        (path / f"{name}.yaml").write_text(new_scenario_text(name))
    return path


def test_folder__makes_its_scenarios_known_by_name(folder: Path) -> None:
    before = eb.list_scenarios()
    eb.register_scenarios(folder)
    eb.register_scenarios(str(folder))
    assert eb.load_scenario("hills").name == "hills"
    added = [entry for entry in eb.list_scenarios() if entry not in before]
    assert [(entry.name, entry.origin) for entry in added] == [("coast-road", str(folder)), ("hills", str(folder))]
    assert {entry.origin for entry in before} == {"shipped"}
    with pytest.raises(UnknownName, match="did you mean 'hills'"):
        eb.load_scenario("hill")
    assert eb.parallel_env(scenario="hills").reset(seed=1)[0]


def test_plugin__with_a_folder_is_seen_on_the_command_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "parts.py"
    file.write_text(
        "from pathlib import Path\n\nimport ethbrake_marl as eb\n\n"
        "eb.register_scenarios(Path(__file__).parent / 'mine')\n"
    )
    words = ["evaluate", "--plugin", str(file), "--scenario", "hills", "--episodes", "5", "--agents", "coast", "--json"]
    assert run_command(words) == 0
    assert json.loads(capsys.readouterr().out)[0]["parameters"]["scenario"] == "hills"
    assert run_command(["scenario", "list", "--plugin", str(file)]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("hills ")]
    assert line.endswith(f"(from {folder})")
    assert run_command(["scenario", "list", "--plugin", str(file), "--json"]) == 0
    origins = {entry["name"]: entry["origin"] for entry in json.loads(capsys.readouterr().out)}
    assert (origins["hills"], origins["paper-random"]) == (str(folder), "shipped")


def test_register_scenarios__refuses_what_cannot_be_used(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for path, message in ((tmp_path / "nowhere", "there is no such folder"), (tmp_path / "empty", r"ends in \.yaml")):
        with pytest.raises(InvalidInput, match=message):
            eb.register_scenarios(path)
    twin = tmp_path / "twin"
    twin.mkdir()
    (twin / "paper-random.yaml").write_text(new_scenario_text("paper-random"))
    with pytest.raises(AlreadyExists, match=r"twin/paper-random\.yaml: a shipped scenario has the name 'paper-random'"):
        eb.register_scenarios(twin)
    assert FOLDERS == {}
    eb.register_scenarios(folder)
    (twin / "paper-random.yaml").rename(twin / "hills.yaml")
    with pytest.raises(AlreadyExists, match=r"twin/hills\.yaml: .*mine/hills\.yaml has the name 'hills' already"):
        eb.register_scenarios(twin)
    assert eb.load_scenario("hills").name == "hills"
    (folder / "hills.yaml").write_text("name: hills\n")
    with pytest.raises(InvalidInput, match=r"hills\.yaml"):
        eb.load_scenario("hills")
