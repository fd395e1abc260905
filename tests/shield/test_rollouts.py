"""The policy itself as a later certificate: accepted only if its rollout, followed step by step, keeps the budget."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.planner import Refined
from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.envs.interfaces import parallel_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.shield import HybridShield, ShieldedDriver, StepShield, parse_uncertainty
from ethbrake_marl.shield.step_shield import REASONS, Backup, Proposer
from tests.fixtures.asked import Asked

PAPER = load_scenario("paper-random")
WORLDS = PAPER.sample(120, 3).worlds
TWO = Scenario(
    name="two", vehicles=2, gaps_m=15, speeds_mps=[0, 10], braking_capacity_mps2=5, driving_capacity_mps2=5,
    mass_t=1, latency_s=0, roles={"vehicle_1": "full_brake", "vehicle_2": "learner"},
)  # fmt: skip


class Weights:
    """A policy of fixed random weights on everything that is observed: it reacts to all, and drives badly."""

    observation = ObservationSpec()

    def __call__(self, observation):
        weights = np.random.default_rng(1).normal(0.0, 1.0, (observation.shape[1], 1))
        return np.tanh(observation @ weights - 0.5).astype(np.float32)


class Remembering:
    """A policy whose action depends on how often it was asked in each row, which it counts in place."""

    name = "remembering"

    def begin(self, alert, vehicle, scripts):
        return {"asked": np.zeros(alert.n), "phase": np.arange(alert.n)}

    def act(self, worlds, memory, vehicle):
        memory["asked"] += 1.0
        wave = np.sin(2.0 * memory["asked"] + memory["phase"])
        return np.where(wave > 0.0, 0.0, wave * worlds.vehicles.braking_capacity_mps2[:, vehicle]), memory


class TwoFaced:
    """Coasts when it is asked what it does, and does otherwise where it is tried out in some of its worlds."""

    name = "two-faced"

    def act(self, worlds, vehicle):
        other = LearnedAgent(Weights())
        return np.zeros(worlds.n) if worlds.n == WORLDS.n else other.act(worlds, vehicle)


def tight():
    """10 m/s, 15 m to a vehicle at rest, and a plan (3.5 m/s2: 14.3 m) that coasting would make useless."""
    shield, worlds = StepShield(TWO, 1), TWO.sample(1, 0).worlds
    shield.begin(worlds, np.arange(1))
    shield.backup = Backup(np.full_like(shield.backup.plan, -0.7), np.zeros(1), np.zeros(0))
    return shield, worlds


def test_by_hand__the_policy_certifies_what_plan_and_constants_do_not():
    shield, worlds = tight()
    assert REASONS[shield.decide(np.zeros(1)).reason[0]] == "no certificate"
    shield, worlds = tight()
    decision = shield.decide(np.zeros(1), proposer=Proposer({1: make_agent("full_brake")}, {1: None}, worlds))
    assert REASONS[decision.reason[0]] == "policy rollout" and not decision.intervened[0]
    assert decision.applied.tolist() == [0.0] and decision.bound.tolist() == [0.0]
    assert (shield.backup.plan[0, 0], shield.backup.plan[0, 1]) == (0.0, -1.0)
    assert shield.running.steps.tolist() == [1] and shield.running.states[0, 2] == pytest.approx(14.0)


def test_by_hand__a_policy_that_would_collide_certifies_nothing():
    shield, worlds = tight()
    decision = shield.decide(np.zeros(1), proposer=Proposer({1: make_agent("constant:3.5")}, {1: None}, worlds))
    assert REASONS[decision.reason[0]] == "no certificate" and decision.applied.tolist() == [-0.7]
    # 14 m are left, 10^2 / (2 * 3.5) = 14.29 m are needed: 2 * 3.5 * 0.2857 = 2 m2/s2
    assert decision.margin[0] == pytest.approx(-2.0)


def driven(policy, **settings):
    """What the guard remembers at the end, each world's harm, and the reasons [decisions, n]."""
    reasons, decide = [], StepShield.decide

    def noted(shield, *arguments, **given):
        decision = decide(shield, *arguments, **given)
        reasons.append(np.where(given["only"], decision.reason, -1))
        return decision

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StepShield, "decide", noted)
        episodes = drive(WORLDS, ShieldedDriver(policy, PAPER, **settings), PAPER, 1)
    return episodes.guarded, episodes.ledger.world_harm("first"), np.array(reasons)


@pytest.mark.parametrize("policy", [LearnedAgent(Weights()), Remembering()], ids=["divisible", "remembering"])
def test_rollout__once_accepted_is_what_the_policy_then_does_and_the_bound_is_exact(policy):
    guarded, harm, reasons = driven(policy)
    accepted = reasons == REASONS.index("policy rollout")
    assert accepted.sum() > 3
    later = np.cumsum(accepted, axis=0) - accepted > 0  # after the first accepted rollout of that world
    allowed = [-1, REASONS.index("same as plan"), REASONS.index("ended")]
    assert np.isin(reasons[later], allowed).all()
    assert harm.tolist() == guarded.shield.bound.tolist()
    assert (harm <= guarded.shield.predicted_harm).all() and not guarded.shield.distrusted.any()


@pytest.mark.parametrize("distrusted", [False, True])
def test_rollout__leaves_the_past_in_the_plan_what_was_applied(distrusted, monkeypatch):
    weaker = parse_uncertainty("braking_capacity_mps2=20%").draw(WORLDS, np.random.default_rng(0))
    driver = ShieldedDriver(LearnedAgent(Weights()), PAPER, logging=True, told=weaker if distrusted else None)
    applied, decide = {}, StepShield.decide

    def noted(shield, *arguments, **given):
        steps, decision = shield.running.steps, decide(shield, *arguments, **given)
        running = np.flatnonzero(given["only"] & (decision.reason != REASONS.index("ended")))
        applied.update({(k, steps[k]): decision.applied[k] for k in running})
        return decision

    monkeypatch.setattr(StepShield, "decide", noted)
    shield = drive(WORLDS, driver, PAPER, 1).guarded.shield
    assert (shield.distrusted == distrusted).all()
    assert all(shield.backup.plan[k, step] == action for (k, step), action in applied.items())
    for entry in shield.log:
        assert entry.plan[: entry.step].tolist() == [applied[entry.world, step] for step in range(entry.step)]


def test_rollout__leaves_the_policys_memory_alone():
    policy = Remembering()
    guarded, _, reasons = driven(policy)
    assert (reasons == REASONS.index("no certificate")).any()
    assert set(guarded.policies[1]["asked"]) == {float(len(reasons))}


def test_rollout__a_policy_that_does_otherwise_when_it_is_tried_out_gets_no_further_than_the_bound():
    guarded, harm, reasons = driven(TwoFaced())
    assert (reasons == REASONS.index("policy rollout")).any()
    assert harm.tolist() == guarded.shield.bound.tolist() and (harm <= guarded.shield.predicted_harm).all()


def test_rollout__of_some_worlds_alone_is_that_of_the_whole_batch():
    class Whole:
        name = "whole"

        def __init__(self):
            self.policy = LearnedAgent(Weights())

        def act(self, worlds, vehicle):
            return self.policy.act(worlds, vehicle)

    assert driven(Whole())[1].tolist() == driven(LearnedAgent(Weights()))[1].tolist()


def test_rollout__is_refused_in_the_name_of_the_policy():
    pair = load_scenario("cooperation-3-pair")
    with pytest.raises(InvalidInput, match=r"agent 'coast\+step' drives vehicle_2"):
        drive(pair.sample(1, 0).worlds, ShieldedDriver(make_agent("coast"), pair), pair, 1)


def test_later_rollouts__may_be_switched_off():
    _, _, reasons = driven(LearnedAgent(Weights()), later_rollouts=False)
    assert not (reasons == REASONS.index("policy rollout")).any()


@pytest.mark.filterwarnings("ignore::ethbrake_marl.shield.MovingAtHorizon")
def test_wrapper__tries_its_policy_where_the_proposal_is_rejected_and_keeps_the_bound():
    env, reasons = HybridShield(parallel_env(), LearnedAgent(Weights()), mode="step"), set()
    for seed in range(40):
        if reasons >= {"policy rollout", "no certificate"}:
            break
        env.reset(seed=seed)
        first = env.attached.shield.first_bound[0]
        while env.agents:
            *_, infos = env.step({})
            reasons.add(infos["vehicle_2"]["shield"]["reason"])
        assert env.unwrapped.engine.ledger.world_harm("first")[0] == infos["vehicle_2"]["shield"]["bound_harm"] <= first
    assert {"policy rollout", "no certificate"} <= reasons


def test_refined__also_where_its_policy_cannot_be_divided():
    driver = ShieldedDriver(Refined(Remembering(), PAPER, tries=2), PAPER)
    episodes = drive(WORLDS.take(np.arange(20)), driver, PAPER, 1)
    assert episodes.ledger.world_harm("first").tolist() == episodes.guarded.shield.bound.tolist()


def test_take__of_a_refined_policy_drives_on_in_those_rows():
    worlds, rows = WORLDS.take(np.arange(6)), np.array([4, 1])
    agent = Refined(LearnedAgent(Weights()), PAPER, tries=4)
    agent = Asked(agent).begin(worlds, 1)
    assert agent.take(rows).act(worlds.take(rows), 1).tolist() == agent.act(worlds, 1)[rows].tolist()
