from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.agents.registry import agent_names
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.inputs import LADDER, check_agents, choose_worlds, make_lineup
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import HybridAgent
from ethbrake_marl.studies.experiment import run_folder

SCENARIO = load_scenario("paper-random")


def test_lineup__keeps_order_and_specs():
    lineup = make_lineup(["e_v2x_bm:pairwise", "constant:3.5", "coast"], SCENARIO)
    assert list(lineup) == ["e_v2x_bm:pairwise", "constant:3.5", "coast"]


def test_lineup__the_ladder_is_every_rung_that_there_is_in_order():
    lineup = list(make_lineup(["ladder", "constant:5"], SCENARIO))
    assert lineup == [*(spec for spec in LADDER if spec.partition(":")[0] in agent_names()), "constant:5"]
    assert lineup[:6] == ["coast", "copy_leader", "full_brake", "gentlest_front", "e_v2x_bm:pairwise", "e_v2x_bm"]


def test_lineup__an_agent_of_the_ladder_is_not_given_again():
    with pytest.raises(InvalidInput, match="'coast' is given twice"):
        make_lineup(["ladder", "coast"], SCENARIO)
    with pytest.raises(InvalidInput, match="did you mean 'ladder'"):
        make_lineup(["lader"], SCENARIO)


def test_lineup__agents_of_a_run_and_of_its_bundle_are_the_same(finished_run):
    run, bundle = make_lineup([f"ppo@{finished_run}", f"ppo@{finished_run / 'policy'}"], SCENARIO).values()
    worlds = SCENARIO.sample(20, 1).worlds
    assert np.array_equal(run.act(worlds, 1), bundle.act(worlds, 1))


@pytest.mark.parametrize(("shield", "bound"), [("episode", "coupled"), ("episode:pairwise", "pairwise")])
def test_lineup__the_hybrids_bound_and_count_are_as_asked(finished_run, shield, bound):
    (agent,) = make_lineup([f"ppo@{finished_run}+{shield}"], SCENARIO, harm_count="total").values()
    assert isinstance(agent, HybridAgent)
    assert (agent.bound, agent.harm_count) == (bound, "total")


def test_check_agents__a_constant_above_the_capacity_of_any_world_is_refused_before_the_work():
    scenario = SCENARIO.replace(braking_capacity_mps2={"uniform": [5, 7]})
    worlds = scenario.sample(500, 7).worlds
    check_agents(make_lineup(["e_v2x_bm", "constant:5", "gentlest_front"], scenario), worlds, scenario)
    capacity = worlds.vehicles.braking_capacity_mps2[:, 1]
    between = (capacity[0] + capacity.min()) / 2  # the first world could, another could not
    with pytest.raises(InvalidInput, match="above the braking capacity"):
        check_agents(make_lineup([f"constant:{between}"], scenario), worlds, scenario)


def test_check_agents__leaves_the_agents_as_they_are():
    lineup = make_lineup(["e_v2x_bm"], SCENARIO)
    before = dict(vars(lineup["e_v2x_bm"]))
    check_agents(lineup, SCENARIO.sample(3, 7).worlds, SCENARIO)
    assert vars(lineup["e_v2x_bm"]) == before


def test_worlds__are_the_list_of_the_seed():
    sample, seed = choose_worlds(SCENARIO, episodes=5, seed=9)
    assert seed == 9
    assert np.array_equal(sample.worlds.gaps_m, SCENARIO.sample(5, 9).worlds.gaps_m)
    sample, seed = choose_worlds(SCENARIO)
    assert (sample.worlds.n, seed) == (10_000, 7)


def test_run_folder__by_default_says_scenario_recipe_and_seed():
    recipe = load_recipe("ppo")
    assert run_folder(SCENARIO, recipe) == Path("runs/paper-random-ppo-seed0")
    assert run_folder(SCENARIO, recipe, seed=4) == Path("runs/paper-random-ppo-seed4")
    assert run_folder(SCENARIO, recipe, name="mine") == Path("runs/mine")
    assert run_folder(SCENARIO, recipe, output=Path("/elsewhere/x")) == Path("/elsewhere/x")


@pytest.mark.parametrize("name", ["", "..", "a/b", "-x", "a b", "a" * 129])
def test_run_folder__a_name_is_one_plain_folder(name):
    with pytest.raises(InvalidInput, match="run name"):
        run_folder(SCENARIO, load_recipe("ppo"), name=name)
