"""The episode shield: never worse than its baseline, in any world, and as predicted."""

from __future__ import annotations

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from ethbrake_marl.agents.planner import Refined
from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.envs.interfaces import parallel_env
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import HybridAgent, HybridShield
from tests.fixtures.asked import Asked

SCENARIO = load_scenario("paper-random")
WORLDS = SCENARIO.sample(300, 3).worlds


def harm(agent, harm_count="first"):
    return drive(WORLDS, agent, SCENARIO, 1).ledger.world_harm(harm_count)


class LateBrake:
    """Coasts until 0.9 s, then brakes fully: no constant deceleration, so sometimes better than any."""

    name = "late_brake"

    def act(self, worlds, vehicle):
        return np.where(worlds.time_s < 0.9, 0.0, -worlds.vehicles.braking_capacity_mps2[:, vehicle])


def memory_of(agent):
    return Asked(agent).begin(WORLDS, 1).memory


@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_coupled__is_never_worse_than_either_part(harm_count):
    hybrid = HybridAgent(LateBrake(), SCENARIO, harm_count=harm_count)
    realised, memory = harm(hybrid, harm_count), memory_of(hybrid)
    alone, baseline = harm(LateBrake(), harm_count), harm(make_agent("e_v2x_bm", harm_count=harm_count), harm_count)
    assert (realised <= baseline).all() and (realised <= alone).all()
    assert realised.tolist() == memory["predicted_harm"].tolist()
    assert memory["chosen_policy"].tolist() == (alone <= baseline).tolist()
    assert 0 < memory["chosen_policy"].sum() < WORLDS.n


def test_refined__policy_is_taken_at_its_word():
    hybrid = HybridAgent(Refined(make_agent("constant:5"), SCENARIO, tries=6), SCENARIO)
    realised = harm(hybrid)
    plain = harm(HybridAgent(make_agent("constant:5"), SCENARIO))
    assert realised.tolist() == memory_of(hybrid)["predicted_harm"].tolist()
    assert (realised <= plain).all() and (realised < plain).any()


def test_pairwise__bound_is_exceeded_in_the_same_physics():
    hybrid = HybridAgent(make_agent("constant:0.5"), SCENARIO, bound="pairwise")
    realised = harm(hybrid)
    assert (realised > memory_of(hybrid)["bound_harm"] + 1.0).mean() > 0.3


def test_begin__of_some_rows_leaves_the_others_alone():
    hybrid = Asked(HybridAgent(make_agent("full_brake"), SCENARIO)).begin(WORLDS, 1)
    before = hybrid.bound_harm.copy()
    hybrid.begin(WORLDS.take([7]), 1, np.array([2]))
    assert hybrid.bound_harm[2] == before[7]
    assert np.delete(hybrid.bound_harm, 2).tolist() == np.delete(before, 2).tolist()


def test_wrapper__applies_the_certified_strategy_whatever_is_proposed():
    for seed in range(6):
        shielded = HybridShield(parallel_env(), make_agent("full_brake"))
        _, _ = shielded.reset(seed=seed)
        while shielded.agents:
            _, _, _, _, infos = shielded.step({"vehicle_2": np.array([1.0])})
            shield = infos["vehicle_2"]["shield"]
            assert shield["proposed_action"] == 1.0 and shield["chosen_action"] <= 0.0
            assert infos["vehicle_2"]["chosen_action"] == pytest.approx(shield["chosen_action"], abs=1e-12)
        realised = shielded.unwrapped.engine.ledger.world_harm("first")[0]
        assert realised == pytest.approx(min(shield["policy_harm"], shield["bound_harm"]), abs=1e-9)


def test_wrapper__passes_the_api_test():
    with pytest.warns(UserWarning, match="option"):
        parallel_api_test(HybridShield(parallel_env(), make_agent("constant:3")), num_cycles=100)


def test_bad_input__is_refused():
    with pytest.raises(UnknownName, match="did you mean 'episode'"):
        HybridShield(parallel_env(), make_agent("full_brake"), mode="episod")
    with pytest.raises(InvalidInput, match="shields every learner"):
        HybridShield(parallel_env(), make_agent("full_brake"), agents=["vehicle_1"])
    shielded = HybridShield(parallel_env(), make_agent("full_brake"))
    shielded.reset(seed=0)
    with pytest.raises(InvalidInput, match="vehicle_2"):
        shielded.step({"vehicle_2": np.array([1.5])})


class Counting:
    """Full braking that counts how often it was asked."""

    name = "counting"

    def begin(self, alert, vehicle, scripts):
        return np.zeros(alert.n)

    def act(self, worlds, memory, vehicle):
        memory += 1.0
        return -worlds.vehicles.braking_capacity_mps2[:, vehicle], memory


def test_begin__the_prediction_does_not_disturb_the_policy():
    assert (HybridAgent(Counting(), SCENARIO).begin(WORLDS, 1, {})["policy"] == 0.0).all()


@pytest.mark.parametrize(("bound", "harm_count"), [("pairwise", "frist"), ("coupled", "both"), ("couple", "first")])
def test_hybrid__refuses_an_unknown_bound_or_count(bound, harm_count):
    with pytest.raises(InvalidInput, match="must be"):
        HybridAgent(make_agent("full_brake"), SCENARIO, bound=bound, harm_count=harm_count)


def test_wrapper__refuses_two_learners_and_leaves_the_environment_usable():
    env = parallel_env(learners=["vehicle_2", "vehicle_3"])
    with pytest.raises(InvalidInput, match=r"2 learners \(vehicle_2, vehicle_3\).*exactly one learner"):
        HybridShield(env, make_agent("full_brake"), agents=["vehicle_2"])
    env.reset(seed=0)


def test_wrapper__closed_lets_go_of_the_environment():
    env, policy = parallel_env(), Counting()
    shielded = HybridShield(env, policy)
    shielded.reset(seed=0)
    memory = shielded.attached.shield
    shielded.close()
    env.reset(seed=1)
    assert shielded.attached.shield is memory and memory["policy"].tolist() == [0.0]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"env": None}, "None is not one of this package's environments"),
        ({"policy": None}, "policy = None: must be an agent or a policy"),
        ({"agents": 5}, "agents = 5: must be a list of names"),
        ({"agents": "vehicle_2"}, "agents = 'vehicle_2': must be a list of names"),
        ({"mode": 5}, "unknown shield mode 5"),
    ],
)
def test_wrapper__says_what_is_not_what_it_must_be(wrong, message):
    given = {"env": parallel_env(), "policy": make_agent("full_brake")}
    with pytest.raises(InvalidInput, match=message):
        HybridShield(**{**given, **wrong})


def test_wrapper__says_that_nobody_learns():
    with pytest.raises(InvalidInput, match=r"no vehicle of scenario 'paper-random' learns"):
        HybridShield(parallel_env(learners=[]), make_agent("full_brake"), mode="step")
