"""Names become things: the grammar, the table, refusals, and users' own agents."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl import agent_names
from ethbrake_marl.agent_names import (
    AgentSettings,
    group,
    listed_agents,
    make_agent,
    make_teams,
    open_game,
    register_agent,
    register_shield,
    teams_of,
)
from ethbrake_marl.agents.team import Team
from ethbrake_marl.episode.counts import ALL_IMPACTS
from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName
from ethbrake_marl.worlds.catalogue import load_scenario

PAPER = load_scenario("paper-random")
FILE = """
import numpy as np
from {neighbour} import SHARE

class Mine:
    name, knows = "mine", "own sensors"
    def __init__(self, share=SHARE):
        self.share = share
    def begin(self, alert, body):
        return None
    def act(self, state, memory, body):
        return -self.share * state.braking_capacity_mps2[:, body - 1], memory

def make():
    return Mine()

def make_with(argument, settings):
    return Mine(float(argument or settings.scenario.horizon_s / 10))

def fails():
    raise RuntimeError("no")

number = 3
"""


@pytest.fixture(autouse=True)
def _own_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    for table in (agent_names.AGENTS, agent_names.WRAPPERS):
        monkeypatch.setattr(table, "loaded", dict(table.loaded))


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    (tmp_path / f"neighbour_{tmp_path.name[-1]}.py").write_text("SHARE = 0.25")
    (tmp_path / "mine.py").write_text(FILE.format(neighbour=f"neighbour_{tmp_path.name[-1]}"))
    return "mine.py"


def around(team: Team, argument: str | None, settings: AgentSettings) -> Team:
    return team._replace(name=f"around {argument}")


@pytest.mark.parametrize("spec", ["full_brake", "constant:-1"])
def test_a_script__has_the_name_that_it_was_asked_for_by(spec: str):
    assert make_agent(spec).name == spec


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("constnt:3", "unknown agent 'constnt'; did you mean 'constant'"),
        ("constant", "constant needs a finite deceleration"),
        ("full_brake:3", "full_brake takes no argument"),
        ("full_brake@x", "full_brake uses no policy"),
        ("full_brake+stepp", "unknown shield 'stepp'"),
        ("x.py:make", "file 'x.py': does not exist"),
        ("", "must be a name"),
        ("a@", "a path must follow '@'"),
        ("runs/mine.zip", "agent 'runs/mine.zip': is a file; load it: "),
    ],
)
def test_a_bad_name__is_refused_in_one_line(spec: Any, message: str):
    with pytest.raises(InvalidInput, match=message):
        make_agent(spec, scenario=PAPER)


def test_an_agent_in_a_file__is_made_by_its_function_which_may_import_its_neighbour(file: str):
    assert make_agent(f"{file}:make").share == 0.25
    assert make_agent(f"{file}:make_with:0.5", scenario=PAPER).share == 0.5
    assert make_agent(f"{file}:make_with", scenario=PAPER).share == 0.8


def test_an_agent_in_a_file__may_have_a_wrapper(file: str):
    register_shield("around", around)
    for spec in (f"{file}:make+around", f"{file}:make_with:0.5+around:x"):
        team = make_agent(spec, scenario=PAPER)
        assert isinstance(team, Team) and team.name == spec


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("mine.py:number", "is not a function"),
        ("mine.py:fails", "RuntimeError: no"),
        ("mine.py:make:3", "has no parameters"),
    ],
)
def test_a_bad_agent_in_a_file__is_refused_in_one_line(file: str, spec: str, message: str):
    with pytest.raises(InvalidInput, match=message):
        make_agent(spec, scenario=PAPER)


def test_a_registered_agent__is_made_with_argument_policy_and_scenario():
    asked = []

    def make(argument: str | None, settings: AgentSettings) -> Any:
        asked.append((argument, settings.policy, settings.scenario, settings.harm_count, settings.spec))
        return make_agent("coast")

    register_agent("theirs", make, form="theirs[:ARGUMENT][@PATH]")
    make_agent("theirs:a:b@~/x", scenario=PAPER, harm_count="total")
    (argument, policy, scenario, count, spec) = asked[0]
    assert (argument, scenario, count, spec) == ("a:b", PAPER, ALL_IMPACTS, "theirs:a:b@~/x")
    assert policy == str(Path.home() / "x")


def test_a_name__belongs_to_one_agent():
    register_agent("theirs", make_agent)
    register_agent("theirs", make_agent)
    with pytest.raises(AlreadyExists, match="agent 'theirs' is registered already"):
        register_agent("theirs", print)
    for bad in ("Theirs", "a:b", "a@b", "a+b", "", 3, "a..b"):
        with pytest.raises(InvalidInput, match="must have the characters"):
            register_agent(bad, make_agent)  # type: ignore[arg-type]


def test_what_is_no_agent__is_refused_with_what_it_lacks():
    register_agent("theirs", lambda argument, settings: object())
    with pytest.raises(InvalidInput, match=r"agent 'theirs' = <object object.*: has no name and no begin and no act"):
        make_agent("theirs")


def test_wrappers__stand_around_the_team_from_the_inside():
    register_shield("around", around)
    team = make_agent("full_brake+around:1+around:2", scenario="cooperation-3-pair")
    assert team.name == "full_brake+around:1+around:2" and set(team.drivers) == {2, 3}
    with pytest.raises(InvalidInput, match="needs a scenario"):
        make_agent("full_brake+around")


def test_an_argument__may_be_a_line_of_its_own():
    register_shield("around", around)
    register_shield("around.other", lambda team, argument, settings: team._replace(drivers={}))
    assert make_agent("coast+around:other", scenario=PAPER).drivers == {}


@pytest.mark.parametrize(
    ("name", "kind"),
    [("a+b", "{}"), ("lr=1,seed=2,x", "policy@{}+around"), ("a+around", "coast,policy@{}/policy,full_brake")],
)
def test_a_path_with_a_comma_or_plus__is_refused(name: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    register_shield("around", around)
    file = kind == "{}"
    path = Path(f"{name}.py" if file else f"{name}/policy" if "/" in kind else name)
    path.parent.mkdir(exist_ok=True)
    path.touch()
    agents = f"coast,{path}:make+around" if file else kind.format(name)
    with pytest.raises(InvalidInput, match="must have no comma and no plus; rename it") as refusal:
        teams_of(agents, PAPER)
    assert str(refusal.value).startswith(f"{path}: ")
    if "coast" not in agents:
        with pytest.raises(InvalidInput, match="must have no comma"):
            make_agent(agents, scenario=PAPER)


def test_a_list__is_not_taken_for_the_path_of_a_file_with_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "coast,full_brake").touch()
    assert [*make_teams("coast,full_brake", PAPER)] == ["coast", "full_brake"]


def test_a_group__stands_for_its_agents_and_a_list_has_each_once():
    register_agent("both", ["coast", "full_brake"])
    register_agent("both.more", ["constant:2"])
    assert group("both") == ["coast", "full_brake", "constant:2"] and group("coast") == []
    assert list(make_teams("both", PAPER)) == ["coast", "full_brake", "constant:2"]
    with pytest.raises(InvalidInput, match="'coast' is listed twice"):
        make_teams("coast,both", PAPER)
    with pytest.raises(InvalidInput, match="is the name of a group"):
        make_agent("both")


def test_agents__are_given_as_names_or_as_mappings_of_names_agents_and_vehicles():
    scenario, coast = load_scenario("cooperation-3-pair"), make_agent("coast")
    assert list(teams_of("coast,full_brake", scenario)) == list(teams_of(["coast", "full_brake"], scenario))
    mixed = {
        "a": "coast", "b": coast, "c": Team("x", {2: coast, 3: coast}), "d": {"vehicle_3": coast, "vehicle_2": "coast"}
    }  # fmt: skip
    for name, team in teams_of(mixed, scenario).items():
        assert team.name == name and list(team.drivers) == [2, 3]
        assert all(agent == coast for agent in team.drivers.values())


@pytest.mark.parametrize(
    ("agents", "message"),
    [
        ({"a": 3}, "agent 'a' = 3: has no name"),
        ({"a": {"vehicle": "coast"}}, "team 'a': 'vehicle': must be the name of a vehicle"),
        ({"a": {"vehicle_2": Team("x", {})}}, "team 'a': vehicle_2 = Team.*has no begin"),
        (["coast", 3], "must be a name, for instance"),
    ],
)
def test_agents__that_are_none_are_refused(agents: Any, message: str):
    with pytest.raises(InvalidInput, match=message):
        teams_of(agents, PAPER)


def test_the_list__has_all_agents_and_no_group():
    register_agent("both", ["coast", "full_brake"])
    forms = {entry.form for entry in listed_agents()}
    assert {
        "coast",
        "full_brake",
        "constant:A",
        "+step",
        "+episode[:pairwise]",
    } <= forms and "both[:ARGUMENT]" not in forms


def test_an_unknown_role__tells_its_place():
    scenario = PAPER.replace(early_impacts="keep", roles={"vehicle_2": "learner", "vehicle_3": "coats"})
    with pytest.raises(UnknownName, match=r"scenario 'paper-random': roles.vehicle_3 = coats: unknown agent 'coats'"):
        open_game(scenario)
