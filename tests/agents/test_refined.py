"""A refined policy: never worse than the policy, and it does what it predicted."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents import planner as refined
from ethbrake_marl.agents.planner import HOLDS, SIZES, Refined, changes, deviate
from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.scenario import load_scenario
from tests.fixtures.asked import Asked

SCENARIO = load_scenario("paper-random")
WORLDS = SCENARIO.sample(120, 3).worlds


def harm(agent, harm_count="first", worlds=WORLDS):
    return drive(worlds, agent, SCENARIO, 1).ledger.world_harm(harm_count)


@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_refined__is_never_worse_and_as_predicted(harm_count):
    plain = harm(make_agent("constant:5"), harm_count)
    agent = Refined(make_agent("constant:5"), SCENARIO, tries=8, harm_count=harm_count)
    realised = harm(agent, harm_count)
    assert (realised <= plain).all() and (realised < plain - 1.0).any()
    assert realised.tolist() == Asked(agent).begin(WORLDS, 1).predicted_harm.tolist()


def test_refined__of_more_is_never_worse():
    few, many = (harm(Refined(make_agent("constant:5"), SCENARIO, tries=k, rounds=1)) for k in (3, 9))
    assert (many <= few).all() and (many < few).any()


def test_refined__of_more_rounds_is_never_worse():
    few, many = (harm(Refined(make_agent("constant:5"), SCENARIO, tries=5, rounds=r)) for r in (1, 3))
    assert (many <= few).all() and (many < few).any()


def test_refined__does_not_depend_on_how_the_trials_are_cut(monkeypatch):
    whole = harm(Refined(make_agent("constant:5"), SCENARIO, tries=5, rounds=2))
    monkeypatch.setattr(refined, "_BLOCK", 12)
    cut = harm(Refined(make_agent("constant:5"), SCENARIO, tries=5, rounds=2))
    assert cut.tolist() == whole.tolist()


def test_refined__where_nothing_is_better_drives_as_the_policy_does():
    apart = WORLDS.take(np.flatnonzero(harm(make_agent("full_brake")) == 0.0))
    agent = Asked(Refined(make_agent("full_brake"), SCENARIO, tries=4)).begin(apart, 1)
    assert agent.act(apart, 1).tolist() == (-apart.vehicles.braking_capacity_mps2[:, 1]).tolist()


def test_refined__of_one_world_is_that_of_the_batch():
    agent, alone = (Refined(make_agent("constant:5"), SCENARIO, tries=5) for _ in range(2))
    every = harm(agent)
    assert harm(alone, worlds=WORLDS.take([17])).tolist() == [every[17]]


def test_begin__of_some_rows_leaves_the_others_alone():
    agent = Asked(Refined(make_agent("constant:5"), SCENARIO, tries=3)).begin(WORLDS, 1)
    before = agent.predicted_harm.copy()
    agent.begin(WORLDS.take([7]), 1, np.array([2]))
    assert agent.predicted_harm[2] == before[7]
    assert np.delete(agent.predicted_harm, 2).tolist() == np.delete(before, 2).tolist()


def test_changes__keep_their_sizes_and_hold():
    table = changes(0, 18)
    assert table.shape == (18, 64)
    for k, change in enumerate(table):
        size, hold = SIZES[k % 3], HOLDS[k // 3 % 3]
        assert 0.5 * size < np.abs(change).max() <= size
        assert (change[:hold] == change[0]).all() and change[hold] != change[0]
    assert table[:4].tolist() == changes(0, 4).tolist()
    assert table.tolist() != changes(1, 18).tolist()


def test_deviated__stays_within_the_capacities():
    command = np.full(WORLDS.n, -6.9)
    low = deviate(command, np.full((WORLDS.n, 64), -0.5), WORLDS, 1)
    high = deviate(-command, np.full((WORLDS.n, 64), 0.5), WORLDS, 1)
    assert set(low.tolist()) == {-7.0} and set(high.tolist()) == {7.0}


@pytest.mark.parametrize("name", ["tries", "rounds"])
@pytest.mark.parametrize("number", [0, -1, True, 2.0, 10_001])
def test_refined__refuses_a_number_that_is_none(name, number):
    with pytest.raises(InvalidInput, match=rf"{name} = .*whole number in 1\.\.10000"):
        Refined(make_agent("coast"), SCENARIO, **{name: number})


def test_take__goes_on_in_some_worlds_only():
    policy = make_lineup(["ppo@shipped"], SCENARIO)["ppo@shipped"]
    agent = Asked(Refined(policy, SCENARIO, tries=3, rounds=1)).begin(WORLDS, 1)
    rows = np.array([5, 90])
    assert agent.take(rows).act(WORLDS.take(rows), 1).tolist() == agent.act(WORLDS, 1)[rows].tolist()
