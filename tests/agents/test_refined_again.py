"""The refinement at every decision: never worse than its first plan, its own worlds only, and it reacts."""

from __future__ import annotations

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.registry import Team, drive
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.scenario import load_scenario

SCENARIO = load_scenario("paper-random")
WORLDS = SCENARIO.sample(80, 3).worlds


def agent_of(spec, scenario=SCENARIO, harm_count="first"):
    return eb.make_agent(spec, scenario=scenario, harm_count=harm_count)


def harm(agent, harm_count="first", worlds=WORLDS, scenario=SCENARIO):
    return drive(worlds, agent, scenario, 1).ledger.world_harm(harm_count)


@pytest.mark.parametrize("harm_count", ["first", "total"])
@pytest.mark.parametrize("spec", ["constant:5+refined:20", "constant:5+refined:50us"])
def test_refined_again__is_never_worse_than_its_first_plan(spec, harm_count):
    plain = harm(agent_of("constant:5"), harm_count)
    agent = agent_of(spec, harm_count=harm_count)
    episodes = drive(WORLDS, agent, SCENARIO, 1)
    realised, predicted = episodes.ledger.world_harm(harm_count), episodes.memories[1]["predicted_harm"]
    assert (realised <= predicted).all() and (predicted <= plain).all()
    assert (realised < predicted).any() and (realised < plain - 0.1).any()


def test_refined_again__a_world_does_not_depend_on_its_batch():
    whole = harm(agent_of("full_brake+refined:10"))
    parts = [harm(agent_of("full_brake+refined:10"), worlds=WORLDS.take(np.arange(a, b))) for a, b in ((0, 7), (7, 80))]
    assert np.concatenate(parts).tolist() == whole.tolist()


def test_refined_again__reacts_where_another_vehicle_does_not_follow_its_script():
    """Vehicle 3 never brakes, which nobody was told: plans that are made again must do less harm than the first."""
    planned = SCENARIO.replace(early_impacts="keep")
    others = planned.with_learners(["vehicle_2", "vehicle_3"])
    worlds = planned.sample(60, 5).worlds
    found = {}
    for spec in ("full_brake+refined:profile", "full_brake+refined:60"):
        team = Team({1: agent_of(spec, planned), 2: agent_of("coast")}, "team")
        found[spec] = eb.evaluate(worlds, {"team": team}, scenario=others).outcome("team").first_impact_harm.mean()
    assert found["full_brake+refined:60"] < found["full_brake+refined:profile"] - 1.0


@pytest.mark.parametrize("around", ["+episode", "+step"])
def test_refined_again__behind_a_shield_keeps_its_bound(around):
    agents = {"mine": agent_of(f"full_brake+refined:10{around}")}
    found = eb.evaluate(WORLDS, agents, scenario=SCENARIO).outcome("mine")
    assert (found.first_impact_harm <= found.predicted_harm + 1e-9).all()


@pytest.mark.parametrize(
    ("spec", "error", "message"),
    [
        ("full_brake+refined:0", InvalidInput, "must be profile"),
        ("full_brake+refined:0us", InvalidInput, "must be profile"),
        ("full_brake+refined:2000000", InvalidInput, "at most 1,000,000"),
        ("full_brake+refined:99999999us", InvalidInput, "at most 60,000,000us"),
        ("full_brake+refined:10ms", UnknownName, "unknown shield or refinement"),
        ("full_brake+refined:10+refined", InvalidInput, "comes first and once"),
        ("full_brake+step+refined:10", InvalidInput, "comes first and once"),
    ],
)
def test_refined_again__refuses_what_is_no_budget(spec, error, message):
    with pytest.raises(error, match=message):
        agent_of(spec)
