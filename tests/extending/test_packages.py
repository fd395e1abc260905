"""Packages that are installed: what they name is loaded when it is used, stands in every output, and breaks nothing."""

import json
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl import parallel
from ethbrake_marl.agent_names import AGENTS, WRAPPERS
from ethbrake_marl.cli.app import Installed, _build_commands, run_command, whole_command
from ethbrake_marl.episode.counts import COUNTS
from ethbrake_marl.episode.features import FEATURES
from ethbrake_marl.episode.objectives import OBJECTIVES
from ethbrake_marl.episode.terms import TERMS
from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName
from ethbrake_marl.evaluation import evaluate as evaluating
from ethbrake_marl.evaluation.measure_registry import MEASURES
from ethbrake_marl.registry import versions_used
from ethbrake_marl.training.recipe import ALGORITHMS

Install = Callable[..., None]

HILLS = '''
import numpy as np
import typer

import ethbrake_marl as eb
from ethbrake_marl.training.recipe import PpoRecipe


class Gentle:
    name, knows = "gentle", "own sensors"

    def __init__(self, share):
        self.share = share

    def begin(self, alert, body):
        return -self.share * alert.braking_capacity_mps2[:, body - 1]

    def act(self, state, memory, body):
        return memory, memory


def make_gentle(argument, settings):
    return Gentle(float(argument or 0.5))


def softer(team, argument, settings):
    return team._replace(drivers={body: Gentle(agent.share / 2.0) for body, agent in team.drivers.items()})


def worst(game, alert, last):
    """Largest loss of speed in the line."""
    return (alert.speeds_mps - last.speeds_mps).max(axis=1)


def calm(before, step, after):
    """Minus the square of the command."""
    return -(after.commands_mps2**2)


def urgency(state, body):
    """Own speed."""
    return state.speeds_mps[:, body - 1]


def front_first(harm, vehicle):
    """The harm of the front vehicle and of the own."""
    return harm.borne[:, 0] + harm.borne[:, vehicle]


class PatientRecipe(PpoRecipe):
    algorithm: str = "patient"


GENTLE = eb.Part(make_gentle, about="brakes a little", knows="own sensors", form="gentle[:SHARE]")
WORST = eb.Part(worst, unit="m/s")
CALM = eb.Part(calm, unit="m2/s4")
URGENCY = eb.Part(urgency, unit="m/s", scale=10.0, low=0.0, high=4.0)
PATIENT = eb.Part(PatientRecipe, "ethbrake_marl.training.ppo:Ppo")


def hello(name: str, loud: bool = False) -> None:
    """Say hello."""
    typer.echo(f"hello {name}{'!' * loud}")
'''

GENTLE = {AGENTS.group: {"gentle": "hills:GENTLE"}}


def test_entry_point__is_loaded_when_its_name_is_used(install: Install, capsys: pytest.CaptureFixture[str]) -> None:
    install("hills", HILLS, **GENTLE, objectives={"front-first": "hills:front_first"}, commands={"hi": "hills:hello"})
    assert run_command(["--help"]) == 0 and "Command of the installed package hills." in capsys.readouterr().out
    assert "gentle" in AGENTS
    assert eb.make_agent("full_brake").name == "full_brake" and "hills" not in sys.modules and not versions_used()
    assert eb.make_agent("gentle:0.8").share == 0.8  # type: ignore[union-attr]
    assert versions_used() == {"hills": "1.2"}
    roles = {"vehicle_2": "learner", "vehicle_3": "gentle"}
    scenario = eb.load_scenario("paper-random").replace(objective="front-first", roles=roles, early_impacts="keep")
    assert eb.parallel_env(scenario=scenario).reset(seed=1)[0]
    assert run_command(["hi", "you"]) == 0 and capsys.readouterr().out == "hello you\n"


def test_command__in_a_group_that_nobody_defines_makes_the_group(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("hills", HILLS, commands={"lab.hi": "hills:hello"})
    assert run_command(["lab", "hi", "you"]) == 0 and capsys.readouterr().out == "hello you\n"
    assert run_command(["lab", "--help"]) == 0 and "Command of the installed package hills." in capsys.readouterr().out


def test_entry_points__of_every_kind_stand_beside_ours(install: Install, capsys: pytest.CaptureFixture[str]) -> None:
    parts = {
        WRAPPERS.group: {"softer": "hills:softer"}, MEASURES.group: {"worst": "hills:WORST"},
        TERMS.group: {"calm": "hills:CALM"}, FEATURES.group: {"urgency": "hills:URGENCY"},
        OBJECTIVES.group: {"front-first": "hills:front_first"}, ALGORITHMS.group: {"patient": "hills:PATIENT"},
    }  # fmt: skip
    install("hills", HILLS, **GENTLE, **parts)
    measures = ["worst", "calm", "front-first"]
    found = eb.evaluate("paper-random", "gentle:0.8,gentle:0.8+softer,gentle:0.4", episodes=5, measures=measures)
    soft, same = found["gentle:0.8+softer"], found["gentle:0.4"]
    assert {"worst", "calm_2", "front-first_total_3"} < {*soft}
    assert [soft[name].tolist() for name in soft] == [same[name].tolist() for name in soft]
    (row, *_) = eb.summarise(found).to_json()
    assert row["versions"]["hills"] == "1.2" and row["worst"] == pytest.approx(found["gentle:0.8"]["worst"].mean())
    env = eb.parallel_env(scenario="paper-random", observation=["urgency"], reward={"harm": 0.0, "calm": 0.5})
    assert env.reset(seed=1)[0]["vehicle_2"].shape == (1,)
    assert env.step({"vehicle_2": [-1.0]})[1]["vehicle_2"] == -0.5 * 49.0
    content = eb.load_recipe("ppo").model_dump(mode="json") | {"name": "mine", "algorithm": "patient"}
    assert type(eb.load_recipe(content)).__name__ == "PatientRecipe"
    for words, told in ((["agent", "list"], "gentle[:SHARE]"), (["agent", "list"], "+softer[:ARGUMENT]")):
        assert run_command(words) == 0 and told in capsys.readouterr().out
    assert run_command(["scenario", "list"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in ("worst", "calm", "urgency", "front-first", "patient"))


def test_entry_point__is_loaded_once_by_several_threads(install: Install) -> None:
    install("hills", f"import time\ntime.sleep(0.3)\n{HILLS}", **GENTLE)
    with ThreadPoolExecutor(4) as pool:
        made = [pool.submit(eb.make_agent, "gentle:0.8") for _ in range(4)]
    assert [each.result().share for each in made] == [0.8] * 4  # type: ignore[union-attr]


def test_entry_point__that_fails_is_named_and_breaks_nothing_else(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    tables = (AGENTS, WRAPPERS, MEASURES, TERMS, FEATURES, OBJECTIVES, ALGORITHMS, COUNTS)
    groups = {table.group: {f"hills{k}": "broken:part"} for k, table in enumerate(tables)}  # type: ignore[attr-defined]
    install("broken", "import nothing_of_this_name\n", **groups, commands={"hills": "broken:part"})
    told = "broken:part of the installed package broken: cannot be imported: ModuleNotFoundError: No module named"
    for use in (
        lambda: eb.make_agent("hills0"),
        lambda: eb.make_agent("coast+hills1", scenario="paper-random"),
        lambda: eb.evaluate("paper-random", "coast", episodes=2, measures="hills2"),
        lambda: eb.parallel_env(scenario="paper-random", reward={"harm": 1.0, "hills3": 1.0}),
        lambda: eb.View(["hills4"]),
        lambda: eb.load_scenario("paper-random").replace(objective="hills5"),
        lambda: eb.load_recipe("ppo").replace(algorithm="hills6"),
        lambda: eb.make_agent("coast", harm_count="hills7"),
    ):
        with pytest.raises(InvalidInput, match=told):
            use()
    for words in (["hills"], ["evaluate", "--set", "measures=hills2"], ["evaluate", "--agents", "coast,hills0"]):
        assert run_command(words) == 2 and told in capsys.readouterr().err
    for words in (["--help"], ["evaluate", "--help"], ["scenario", "list"]):
        assert run_command(words) == 0, words
    capsys.readouterr()
    assert run_command(["agent", "list"]) == 0 and capsys.readouterr().err.count("left out: ") == 2


def test_entry_point__without_a_part_of_its_name_is_named(install: Install) -> None:
    more = "\nSEVERAL = {'other': make_gentle}\n"
    install("hills", HILLS + more, **{AGENTS.group: {"hills": "hills:SEVERAL", "itself": "circle:make"}})
    install("circle", "import ethbrake_marl as eb\nmake = eb.make_agent('itself')\n")
    with pytest.raises(InvalidInput, match="agent 'hills' is an entry point that defines parts with other names"):
        eb.make_agent("hills")
    assert eb.make_agent("other").name == "gentle"
    with pytest.raises(InvalidInput, match=r"agent 'itself', .*: agent 'itself' is looked up by its own module"):
        eb.make_agent("itself")


def test_name__that_two_packages_give_is_told_with_both(install: Install, capsys: pytest.CaptureFixture[str]) -> None:
    install("hills", HILLS, **GENTLE, commands={"evaluate": "hills:hello", "hey": "hills:hello"})
    agents = {AGENTS.group: {"gentle": "valleys:make_gentle", "coast": "valleys:make_gentle"}}
    install("valleys", HILLS, **agents, commands={"hey": "valleys:hello"})
    both = "several installed packages, hills and valleys; uninstall all but one"
    with pytest.raises(InvalidInput, match=f"agent 'gentle' is defined by {both}"):
        eb.make_agent("gentle")
    with pytest.raises(InvalidInput, match=r"agent 'coast' is defined by several .*, ethbrake-marl and valleys"):
        eb.make_agent("coast")
    assert eb.make_agent("full_brake").name == "full_brake"
    told = "Command of the installed packages hills and valleys."
    assert run_command(["--help"]) == 0 and told in capsys.readouterr().out
    assert run_command(["evaluate", "--episodes", "3"]) == 2
    told = "command 'evaluate' is defined by several installed packages, ethbrake-marl and hills"
    assert told in capsys.readouterr().err
    with pytest.raises(UnknownName, match="unknown agent 'gentel'; did you mean 'gentle'"):
        eb.make_agent("gentel")


def test_register__is_the_way_of_both_and_refuses_another_of_that_name(install: Install) -> None:
    install("hills", HILLS, **{AGENTS.group: {"gentle": "hills:make_gentle"}, MEASURES.group: {"worst": "hills:WORST"}})
    import hills  # type: ignore[import-not-found]

    eb.register_agent("gentle", hills.make_gentle)
    eb.register_measure("worst", hills.worst, unit="m/s")
    with pytest.raises(AlreadyExists, match=r"agent 'gentle' is registered already.*entry point of the package hills"):
        eb.register_agent("gentle", hills.softer)
    with pytest.raises(AlreadyExists, match="measure 'worst' is registered already"):
        eb.register_measure("worst", hills.worst, unit="km/h")


OWN = '''
import numpy as np
import ethbrake_marl as eb

print("noise of a file")

class Half:
    name, knows = "half", "own sensors"

    def begin(self, alert, body):
        return None

    def act(self, state, memory, body):
        return -0.5 * state.braking_capacity_mps2[:, body - 1], memory

def bonus(before, step, after):
    """Minus the square of the command."""
    return -(after.commands_mps2**2)

def weight(state, body):
    """Mass of the vehicle."""
    return state.mass_t[:, body - 1]

eb.register_agent("half", lambda argument, settings: Half())
eb.register_term("bonus", bonus)
eb.register_feature("weight", weight, unit="t", scale=10.0, low=0.0, high=9.0)
'''


def test_load__makes_the_names_of_a_file_known_to_every_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An agent, also as the script of a role, a term and a feature; also in other processes."""
    pytest.importorskip("joblib")
    monkeypatch.setattr(parallel, "usable_cores", lambda: 2)
    monkeypatch.setattr(evaluating, "CHUNK", 3)
    (tmp_path / "own.py").write_text(OWN)
    load = ["--load", str(tmp_path / "own.py")]
    settings = ["roles.vehicle_3=half", "early_impacts=keep", "observation=[own, weight]", "measures=bonus"]
    words = ["evaluate", "--agents", "full_brake,half", "--episodes", "6", "--json"]
    words += [word for setting in settings for word in ("--set", setting)]
    assert run_command(words) == 2 and "unknown" in capsys.readouterr().err
    assert run_command([*words, *load]) == 0
    alone = capsys.readouterr()
    assert "noise of a file" in alone.err
    full, half = json.loads(alone.out)
    assert half["bonus_2"] < 0.0 and half["versions"]["own.py"].startswith("SHA-256 ") and full["bonus_3"] < 0.0
    assert run_command([*words, *load, "--jobs", "2"]) == 0
    assert json.loads(capsys.readouterr().out) == [full, half]
    assert run_command(["scenario", "list", *load]) == 0 and "bonus" in capsys.readouterr().out
    assert run_command([*load, "scenario", "list"]) == 0 and "bonus" in capsys.readouterr().out
    assert run_command(["agent", "list", "--load", str(tmp_path / "none.py")]) == 2
    assert "none.py': does not exist" in capsys.readouterr().err


def test_load__is_an_option_of_every_command() -> None:
    def commands_without(command: Any, name: str) -> list[str]:
        made = command.command() if isinstance(command, Installed) else command
        if hasattr(made, "commands"):
            return [each for word, other in made.commands.items() for each in commands_without(other, f"{name} {word}")]
        return [] if sum("--load" in option.opts for option in made.params) == 1 else [name]

    for _ in range(2):
        assert commands_without(whole_command(), "ethbrake") == []
        _build_commands.cache_clear()


def test_a_measure_of_a_file__may_be_what_the_file_registers_itself(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        f"{OWN}\ndef ends(game, alert, last):\n    '''When.'''\n    return last.time_s\n"
        "eb.register_measure('ends', ends, unit='s')\n"
    )
    measures = [f"{tmp_path}/own.py:bonus", f"{tmp_path}/own.py:ends"]
    columns = eb.evaluate("paper-random", "full_brake", episodes=3, measures=measures)["full_brake"]
    assert (columns["bonus_2"] < 0.0).all() and columns["ends"].tolist() == columns["end_s"].tolist()


def test_scenario_recipe_and_observation__run_no_file_that_they_name(tmp_path: Path) -> None:
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
