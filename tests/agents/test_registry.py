"""One registry, one grammar: who can be named, what can be put around whom, and an agent of the user's own."""

from __future__ import annotations

import importlib.util
import json

import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents import registry
from ethbrake_marl.agents.planner import Refined
from ethbrake_marl.agents.registry import AgentSpec, make_agent, parse_spec
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import HybridAgent, ShieldedDriver

SCENARIO = load_scenario("paper-random")


@pytest.mark.parametrize(
    ("spec", "parts"),
    [
        ("full_brake", AgentSpec("full_brake", None, None, ())),
        ("constant:-5+step", AgentSpec("constant", "-5", None, ("step",))),
        ("ppo@shipped+refined+step", AgentSpec("ppo", None, "shipped", ("refined", "step"))),
        ("ppo@runs/a+b:c@d+episode:pairwise", AgentSpec("ppo", None, "runs/a+b:c@d", ("episode:pairwise",))),
        ("ppo@runs/my+step/", AgentSpec("ppo", None, "runs/my+step/", ())),
        ("mine:x@path+robust", AgentSpec("mine", "x", "path", ("robust",))),
        ("mine:a+b", AgentSpec("mine", "a+b", None, ())),
    ],
)
def test_spec__is_taken_apart_and_written_again(spec, parts):
    assert parse_spec(spec) == parts and str(parts) == spec


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("ful_brake+step", "unknown agent 'ful_brake'; did you mean 'full_brake'"),
        ("full_brake+stpe", "unknown shield or refinement 'stpe'; did you mean 'step'"),
        ("ppo@shipped+epsiode", "did you mean 'episode'"),
        ("full_brake+", "unknown shield or refinement ''"),
        ("constant:3+setp", "did you mean 'step'"),
        ("planner+step+episode", "comes first and once, then one shield"),
        ("planner+step+refined", "comes first and once, then one shield"),
        ("planner+refined+refined", "comes first and once"),
        ("coast:1", "coast takes no argument"),
        ("coast@runs/x", "coast takes no policy"),
        ("ppo:x@shipped", "ppo takes no argument"),
        ("ppo@", "a path is needed after '@'"),
        ("ppo+step", "a policy is needed: ppo@PATH"),
        ("ppo@shipped+robust", r"agent 'ppo@shipped\+robust': mode robust needs an uncertainty"),
    ],
)
def test_spec__what_nobody_is_called_is_refused(spec, message):
    with pytest.raises(InvalidInput, match=message):
        make_agent(spec, scenario=SCENARIO)


@pytest.mark.parametrize("spec", ["full_brake+step", "ppo@shipped+refined", "planner+episode", "team@runs/x"])
def test_make_agent__says_where_a_scenario_is_needed(spec):
    with pytest.raises(InvalidInput, match="needs a scenario: make_agent"):
        make_agent(spec)
    with pytest.raises(InvalidInput, match="must be a Scenario"):
        make_agent(spec, scenario="paper-random")


@pytest.mark.parametrize(
    ("spec", "kind"),
    [
        ("full_brake+step", ShieldedDriver),
        ("constant:-5+step", ShieldedDriver),
        ("planner:8+episode", HybridAgent),
        ("best_harm:20+refined", Refined),
        ("e_v2x_bm+refined+episode", HybridAgent),
        ("gentlest_front+robust", ShieldedDriver),
        ("ppo@shipped+refined+step", ShieldedDriver),
    ],
)
def test_shields__go_around_any_agent_and_hold(spec, kind):
    worlds = SCENARIO.sample(3, 5)
    agents = {spec: eb.make_agent(spec, scenario=SCENARIO, harm_count="total", uncertainty="gaps_m=0.2")}
    assert isinstance(agents[spec], kind)
    outcome = evaluate(worlds, agents, scenario=SCENARIO).outcome(spec)
    assert (outcome.total_harm <= outcome.predicted_harm + 1e-9).all()


@pytest.mark.parametrize("spec", ["hybrid", "hybrid@shipped", "step:rehearsed@shipped", "robust@shipped"])
def test_agent__names_of_earlier_versions_are_unknown(spec):
    with pytest.raises(UnknownName, match=f"unknown agent {spec.partition('@')[0].partition(':')[0]!r}; "):
        make_agent(spec, scenario=SCENARIO)


OWN_FILE = """
import numpy as np
import ethbrake_marl as eb
from ethbrake_marl.agents.registry import Source


class HalfBrake:
    name, knows = "half_brake", Source.SENSORS

    def __init__(self, share):
        self.share = share

    def act(self, worlds, vehicle):
        return -self.share * worlds.vehicles.braking_capacity_mps2[:, vehicle]


def make_half_brake(argument, settings):
    return HalfBrake(float(argument or 0.5))


eb.register_agent("half_brake", make_half_brake, about="half of what the brakes can", knows=(Source.SENSORS,))
"""


def test_own_agent__is_evaluated_and_shielded_from_the_users_own_file(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))
    file = tmp_path / "mine.py"
    file.write_text(OWN_FILE)
    spec = importlib.util.spec_from_file_location("mine", file)
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    specs = ["half_brake", "half_brake:0.9", "half_brake+step", "half_brake:0.9+refined+episode"]
    assert run_command(["evaluate", "--agents", ",".join(specs), "--episodes", "4", "--json"]) == 0
    rows = {row["agent"]: row for row in json.loads(capsys.readouterr().out)}
    assert list(rows) == specs and rows["half_brake"]["knows"] == "own sensors"
    assert rows["half_brake+step"]["first_impact_harm"] <= rows["half_brake"]["first_impact_harm"]
    assert run_command(["agent", "list", "--json"]) == 0
    listed = {row["agent"]: row for row in json.loads(capsys.readouterr().out)}
    assert listed["half_brake[:ARGUMENT]"]["about"] == "half of what the brakes can"
    with pytest.raises(UnknownName, match="did you mean 'half_brake'"):
        make_agent("half_break")


def test_agents__are_listed_with_what_they_know(capsys):
    assert run_command(["agent", "list"]) == 0
    table = capsys.readouterr().out
    for name in (*registry.agent_names(), "+refined", "+episode", "+step", "+robust"):
        assert name in table
    assert "own sensors" in table and "also true model" in table


def test_own_horizon__is_the_scenarios():
    short = SCENARIO.replace(horizon_s=4)
    worlds = short.sample(20, 1).worlds
    ours, theirs = make_agent("e_v2x_bm", scenario=short), make_agent("e_v2x_bm", horizon_s=4.0)
    harms = [agent.begin(worlds, 1, {})["predicted_harm"].tolist() for agent in (ours, theirs)]
    assert harms[0] == harms[1]
