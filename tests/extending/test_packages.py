"""Packages that are installed: what they name is loaded when it is used, stands in every output, and breaks nothing."""

import json
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName
from ethbrake_marl.registry import versions_used

Install = Callable[..., None]

HILLS = '''
import numpy as np
import typer

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.training.recipes import PpoRecipe


class Gentle:
    name, knows, state_free = "gentle", "own sensors", True

    def __init__(self, share):
        self.share = share

    def act(self, worlds, vehicle):
        return -self.share * worlds.vehicles.braking_capacity_mps2[:, vehicle]


def make_gentle(argument, settings):
    return Gentle(float(argument or 0.5))


def softer(agent, argument, settings):
    return Gentle(agent.share / 2.0)


def worst(episodes):
    """Largest change of speed in the line."""
    return episodes.largest_speed_change_mps.max(axis=1)


def calm(step):
    """Minus the square of the own command in force."""
    return -(step.command_mps2**2)


def urgency(worlds, vehicle):
    """Own speed."""
    return worlds.speeds_mps[:, vehicle]


def front_first(harm, vehicle):
    """The harm of the front vehicle and of the own."""
    return harm.borne[:, 0] + harm.borne[:, vehicle]


class PatientRecipe(PpoRecipe):
    algorithm: str = "patient"


WORST = eb.Part(worst, unit="m/s")
CALM = eb.Part(calm, unit="m/s2", by="step")
URGENCY = eb.Part(urgency, unit="m/s", scale=10.0, low=0.0, high=4.0)
PATIENT = eb.Part(PatientRecipe, "ethbrake_marl.first_edition.training.ppo:Ppo")


def hello(name: str, loud: bool = False) -> None:
    """Say hello."""
    typer.echo(f"hello {name}{'!' * loud}")
'''


AGENTS = {"gentle": "hills:make_gentle"}


def test_entry_point__is_loaded_when_its_name_is_used(install: Install, capsys: pytest.CaptureFixture[str]) -> None:
    install(
        "hills", HILLS, agents=AGENTS, objectives={"front-first": "hills:front_first"}, commands={"hi": "hills:hello"}
    )
    assert run_command(["--help"]) == 0 and "Command of the installed package hills." in capsys.readouterr().out
    assert "gentle" in eb.agent_names()
    assert eb.make_agent("full_brake").name == "full_brake" and "hills" not in sys.modules and not versions_used()
    assert eb.make_agent("gentle:0.8").share == 0.8  # type: ignore[union-attr]
    assert versions_used() == {"hills": "1.2"}
    scenario = eb.load_scenario("paper-random").replace(objective="front-first", roles={"vehicle_2": "gentle"})
    assert eb.make_engine(scenario, 3).scenario.objective == "front-first"
    assert run_command(["hi", "you"]) == 0 and capsys.readouterr().out == "hello you\n"


def test_entry_point__is_loaded_once_by_several_threads(install: Install) -> None:
    install("hills", f"import time\ntime.sleep(0.3)\n{HILLS}", agents=AGENTS)
    with ThreadPoolExecutor(4) as pool:
        made = [pool.submit(eb.make_agent, "gentle:0.8") for _ in range(4)]
    assert [each.result().share for each in made] == [0.8] * 4  # type: ignore[union-attr]


def test_entry_point__that_fails_is_named_and_breaks_nothing_else(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    groups = ("agents", "measures", "features", "objectives", "algorithms", "commands", "shields")
    install("broken", "import nothing_of_this_name\n", **{group: {"hills": "broken:part"} for group in groups})
    told = "broken:part of the installed package broken: cannot be imported: ModuleNotFoundError: No module named"
    for use in (
        lambda: eb.make_agent("hills"),
        lambda: eb.make_agent("coast+hills"),
        lambda: eb.make_engine("paper-random", 1, reward={"harm": 1.0, "hills": 1.0}),
        lambda: eb.choose_observation(["hills"]),
        lambda: eb.load_scenario("paper-random").replace(objective="hills"),
        lambda: eb.load_recipe("ppo").replace(algorithm="hills"),
    ):
        with pytest.raises(InvalidInput, match=told):
            use()
    for words in (["hills"], ["evaluate", "--set", "measures=hills"]):
        assert run_command(words) == 2 and told in capsys.readouterr().err
    for words in (["--help"], ["evaluate", "--help"], ["scenario", "schema"], ["train", "--schema"], ["agent", "list"]):
        assert run_command(words) == 0
    assert capsys.readouterr().err.count("left out: ") == 2


def test_entry_point__without_a_part_of_its_name_is_named(install: Install) -> None:
    more = "\nSEVERAL = {'other': make_gentle}\n"
    install("hills", HILLS + more, agents={"hills": "hills:SEVERAL", "itself": "circle:make"})
    install("circle", "import ethbrake_marl as eb\nmake = eb.make_agent('itself')\n")
    with pytest.raises(InvalidInput, match="agent 'hills' is an entry point that defines parts with other names"):
        eb.make_agent("hills")
    assert eb.make_agent("other").name == "gentle"
    with pytest.raises(InvalidInput, match=r"agent 'itself', .*: agent 'itself' is looked up by its own module"):
        eb.make_agent("itself")


def test_name__that_two_packages_give_is_told_with_both(install: Install, capsys: pytest.CaptureFixture[str]) -> None:
    install("hills", HILLS, agents=AGENTS, commands={"evaluate": "hills:hello", "hey": "hills:hello"})
    agents = {"gentle": "valleys:make_gentle", "coast": "valleys:make_gentle"}
    install("valleys", HILLS, agents=agents, commands={"hey": "valleys:hello"})
    both = "several installed packages, hills and valleys; uninstall all but one"
    with pytest.raises(InvalidInput, match=f"agent 'gentle' is defined by {both}"):
        eb.make_agent("gentle")
    with pytest.raises(InvalidInput, match=r"agent 'coast' is defined by several .*, ethbrake-marl and valleys"):
        eb.make_agent("coast")
    assert eb.make_agent("full_brake").name == "full_brake"
    assert (
        run_command(["--help"]) == 0
        and "Command of the installed packages hills and valleys." in capsys.readouterr().out
    )
    assert run_command(["evaluate", "--episodes", "3"]) == 2
    assert (
        "command 'evaluate' is defined by several installed packages, ethbrake-marl and hills"
        in capsys.readouterr().err
    )
    with pytest.raises(UnknownName, match="unknown agent 'gentel'; did you mean 'gentle'"):
        eb.make_agent("gentel")


def test_register__is_the_way_of_both_and_refuses_another_of_that_name(install: Install) -> None:
    install("hills", HILLS, agents=AGENTS, measures={"worst": "hills:WORST"})
    import hills  # type: ignore[import-not-found]

    eb.register_agent("gentle", hills.make_gentle)
    eb.register_measure("worst", hills.worst, unit="m/s")
    with pytest.raises(AlreadyExists, match="agent 'gentle' is registered already"):
        eb.register_agent("gentle", hills.softer)
    with pytest.raises(AlreadyExists, match="measure 'worst' is registered already"):
        eb.register_measure("worst", hills.worst, unit="km/h")


def test_measures__of_a_file_are_told_where_it_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.py").write_text(f"{HILLS}\npart = WORST\n")
    words = ["evaluate", "--episodes", "5", "--agents", "full_brake", "--json"]
    measures = f"{tmp_path}/mine.py:worst,{tmp_path}/mine.py:part,injury"
    assert run_command([*words, "--set", f"measures={measures}"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["metric_worst"] == row["metric_part"] > 0.0 and row["metric_injury_lr4s"] > 0.0
    assert row["metrics"]["part"] == "part (m/s)" and row["versions"]["mine.py"].startswith("SHA-256 ")


def test_scenario_recipe_and_bundle__run_no_file_that_they_name(tmp_path: Path) -> None:
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    evil = f"{tmp_path}/evil.py:make"
    paper, ppo = eb.load_scenario("paper-random"), eb.load_recipe("ppo")
    for use in (
        lambda: paper.replace(roles={"vehicle_1": evil}),
        lambda: paper.replace(objective=evil),
        lambda: paper.replace(observation=[evil]),
        lambda: ppo.replace(algorithm=evil),
        lambda: ppo.replace(reward={"harm": 1.0, evil: 1.0}),
        lambda: ppo.replace(observation=[evil]),
    ):
        with pytest.raises(InvalidInput):
            use()
    assert [path.name for path in tmp_path.iterdir()] == ["evil.py"]
