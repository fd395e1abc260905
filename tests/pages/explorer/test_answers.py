"""What the explorer answers: the harm that an evaluation of the same world gives, and files that read back to it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agents.e_v2x_bm import optimise_coupled
from ethbrake_marl.defaults import DEFAULT
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.inputs import make_agents, make_lineup
from ethbrake_marl.evaluation.measures import Conditions
from ethbrake_marl.limits.limits import Proof, prove
from ethbrake_marl.pages.explorer import Explored, explorer_page, read_state, save_state
from ethbrake_marl.scenario import Scenario, Task, load_scenario
from tests.pages.explorer.conftest import AGENTS, Client


def test_answer__is_the_evaluation_of_that_world(client: Client, scenario: Scenario, state: dict[str, Any]) -> None:
    state["gaps_m"][0], state["mass_t"][2], state["restitution"] = 7.25, 11.0, 0.3
    reply = client.ask("answer", {"world": state, "profile": [-100.0]})
    assert reply.status == 200
    worlds = scenario.worlds_from_state(state)
    expected = evaluate(worlds, make_lineup(AGENTS, scenario), scenario=scenario)
    *others, hand = reply.json["outcomes"]
    for told, (name, outcome) in zip(others, expected.outcomes.items(), strict=True):
        assert told["agent"] == name
        harms = float(outcome.first_impact_harm[0]), float(outcome.total_harm[0])
        assert (told["impacts"], told["first"], told["total"]) == (int(outcome.impacts[0]), *harms)
    assert (hand["agent"], hand["first"]) == ("by hand", others[0]["first"])  # beyond its capacity: full braking
    proof = prove(worlds, Task(scenario, scenario.learners))
    assert isinstance(proof, Proof) and proof.harm is not None
    verdict = reply.json["verdict"]
    assert (verdict["avoidable"], verdict["proven_harm"]) == (bool(proof.avoidable[0]), float(proof.harm[0]))
    assert reply.json["constant"]["first"] == float(optimise_coupled(worlds, 1).harm[0])
    assert reply.json["grid"] == {"first_s": 0.5, "step_s": 0.1, "steps": 75, "low_mps2": -7.0, "high_mps2": 7.0}
    assert len(reply.json["world"]["episodes"]) == 4


def test_search__starts_where_h_star_is_and_is_driven_again(client: Client, state: dict[str, Any]) -> None:
    found = client.ask("best", {"world": state, "profile": [0.0], "seconds": 0.0}).json
    again = client.ask("answer", {"world": state, "profile": found["commands"]}).json
    hand = again["outcomes"][-1]
    assert (hand["first"], hand["total"]) == (found["first"], found["total"])
    assert again["verdict"]["proven_harm"] <= found["first"] <= again["constant"]["first"] + 1e-9
    assert found["candidates"] == 4_000
    worse = client.ask("best", {"world": state, "profile": [0.0] * 5, "seconds": 0.0}).json
    assert worse["first"] == found["first"]


def test_search__is_never_worse_than_h_star(
    explored: Explored, scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ethbrake_marl.pages.explorer.SLICE", 1)
    worlds = scenario.sample(20, DEFAULT.LIST_SEED).worlds
    for k in range(worlds.n):
        world = worlds.take([k])
        found = explored.search(world, np.array([0.0]), 0.0, lambda: True)
        assert found["first"] <= explored.best_constant(world)["first"] + 1e-9


def test_search__takes_the_profile_by_hand_where_that_is_better(explored: Explored, state: dict[str, Any]) -> None:
    world = read_state(state, explored.task.scenario)
    good = explored.search(world, np.array([0.0]), 1.0, lambda: False)
    folded = explored.search(world, np.array(good["commands"]), 0.0, lambda: True)
    assert folded["first"] <= good["first"]


def test_profile__of_an_agent_drives_as_the_agent(client: Client, state: dict[str, Any]) -> None:
    commands = client.ask("profile", {"world": state, "agent": "ppo@shipped"}).json["commands"]
    *_, policy, hand = client.ask("answer", {"world": state, "profile": commands}).json["outcomes"]
    assert (hand["first"], hand["total"], hand["impacts"]) == (policy["first"], policy["total"], policy["impacts"])


def test_world__is_that_of_the_list(client: Client, scenario: Scenario) -> None:
    told = client.ask("world", {"number": 12}).json["world"]
    world = scenario.sample(1, DEFAULT.LIST_SEED, first=12).worlds
    assert told == Conditions.of(world)
    read = read_state(json.loads(json.dumps(told)), scenario)
    assert np.array_equal(read.gaps_m, world.gaps_m) and np.array_equal(read.speeds_mps, world.speeds_mps)


@pytest.mark.parametrize("name", ["paper-random", "paper-random-obstacle", "realistic-motorway", "realistic-mixed"])
def test_saved_state__reads_back_to_the_same_harm(name: str, folder: Path) -> None:
    scenario = load_scenario(name)
    world = scenario.sample(1, DEFAULT.LIST_SEED, first=3).worlds
    state = Conditions.of(world)
    state["speeds_mps"][0] += 0.1 + 0.2
    changed = read_state(state, scenario)
    assert save_state(folder, "near-miss", "yaml", changed, scenario) == "near-miss.yaml"
    assert save_state(folder, "near-miss", "csv", changed, scenario) == "near-miss.csv"
    saved = load_scenario(folder / "near-miss.yaml")
    agents = make_lineup(["full_brake"], scenario)
    harms = []
    for worlds, where in (
        (changed, scenario),
        (saved.sample(1, 99).worlds, saved),
        (scenario.read_worlds(folder / "near-miss.csv"), scenario),
    ):
        outcome = evaluate(worlds, agents, scenario=where, aftermath=False).outcome("full_brake")
        harms.append((float(outcome.first_impact_harm[0]), float(outcome.total_harm[0])))
    assert harms[0] == harms[1] == harms[2]


def test_saved_state__may_have_an_impact_before_anybody_acts(folder: Path, scenario: Scenario) -> None:
    state = Conditions.of(scenario.sample(1, DEFAULT.LIST_SEED).worlds)
    state["gaps_m"][0] = 0.01
    world = read_state(state, scenario)
    save_state(folder, "early", "yaml", world, scenario)
    drawn = load_scenario(folder / "early.yaml").sample(1, 5)
    assert (drawn.rejected, drawn.worlds.gaps_m[0, 0]) == (0, 0.01)


def test_save__never_replaces_and_never_follows(client: Client, folder: Path, state: dict[str, Any]) -> None:
    question = {"world": state, "name": "kept", "kind": "yaml"}
    assert client.ask("save", question).json == {"file": "kept.yaml"}
    before = (folder / "kept.yaml").read_bytes()
    reply = client.ask("save", question)
    assert reply.status == 400 and "is there already" in reply.json["error"]
    outside = folder.parent / "outside"
    (folder / "link.csv").symlink_to(outside)
    assert client.ask("save", question | {"name": "link", "kind": "csv"}).status == 400
    assert (folder / "kept.yaml").read_bytes() == before
    assert not outside.exists()


def test_save__into_a_folder_that_went_is_told(client: Client, folder: Path, state: dict[str, Any]) -> None:
    folder.rmdir()
    reply = client.ask("save", {"world": state, "name": "kept", "kind": "yaml"})
    assert reply.status == 500 and reply.json["error"].startswith("cannot be written")


def test_save_state__refuses_what_is_there(folder: Path, scenario: Scenario, state: dict[str, Any]) -> None:
    world = read_state(state, scenario)
    (folder / "a.csv").mkdir()
    with pytest.raises(AlreadyExists, match=r"a\.csv: is there already"):
        save_state(folder, "a", "csv", world, scenario)


def test_explored__says_what_it_cannot_show(scenario: Scenario) -> None:
    with pytest.raises(InvalidInput, match="2 vehicles are driven; it takes exactly one"):
        Explored(Task(scenario, (1, 2)), make_agents(["full_brake"], scenario))
    nine = [f"constant:{k / 10}" for k in range(1, 10)]
    with pytest.raises(InvalidInput, match="9 agents; at least 1 and at most 8"):
        Explored(Task(scenario, scenario.learners), make_agents(nine, scenario))


def test_page__shows_hostile_names_as_text(scenario: Scenario, state: dict[str, Any]) -> None:
    hostile = "</script><img src=x onerror=alert(1)>\u202e"
    lineup = make_agents(["full_brake"], scenario)
    changed = scenario.replace(title=hostile)
    text = explorer_page(
        Explored(Task(changed, changed.learners), {hostile: lineup["full_brake"]}), state, world=0, seed=7
    ).html
    assert "<img" not in text and "\u202e" not in text
    content = json.loads(text.partition('id="explorer_data">')[2].partition("</script>")[0])
    assert content["named"] == [hostile] and all(name.isprintable() for name in content["agents"])
