"""The joint shield: several shielded vehicles of one line, decided together."""

from __future__ import annotations

import numpy as np
import pytest
from pettingzoo.utils import BaseParallelWrapper

from ethbrake_marl.agents.registry import Team, drive, make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.envs.interfaces import parallel_env
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.search import profile_problem
from ethbrake_marl.shield import HybridShield, ShieldedDriver, StepShield, shielded_aec
from ethbrake_marl.shield.sb3 import ShieldedVecEnv
from ethbrake_marl.shield.step_shield import (
    REASONS,
    Backup,
    begin_running,
    certify,
    ends_under,
    joint_constants,
    plan_harm,
)
from tests.shield.attacks import TEAM_ADVERSARIES, TEAMS, attack

STEPS = 81
COAST = make_agent("coast")
PAIR = load_scenario("cooperation-3-pair")


def three(**changes):
    """Vehicle 1 stands; 10 m and 10 m behind it two vehicles come at 5 and 10 m/s that brake with at most 5 m/s2."""
    given = {
        "name": "three", "vehicles": 3, "gaps_m": [10, 10], "speeds_mps": [0, 5, 10], "braking_capacity_mps2": 5,
        "driving_capacity_mps2": 5, "mass_t": [1, 1, 3], "latency_s": 0,
        "roles": {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "learner"},
    }  # fmt: skip
    scenario = Scenario(**{**given, **changes})
    return scenario, scenario.sample(1, 0).worlds


def start(worlds, plan, vehicles=(1, 2), **settings):
    running = begin_running(profile_problem(worlds, vehicles, **settings))
    return running, Backup(plan, plan_harm(running, plan), np.zeros((0, len(vehicles))))


def told(decision):
    return [REASONS[each] for each in decision.reason[0]]


def test_by_hand__of_two_proposals_the_harmless_one_is_accepted_the_other_replaced():
    # Braking fully they stop after 2.5 m and 10 m; Vehicle 3 then stands 2.5 m behind Vehicle 2.
    _, worlds = three(gaps_m=[2.6, 10])
    running, backup = start(worlds, np.full((1, STEPS, 2), -1.0))
    assert backup.harm.tolist() == [0.0]
    # Vehicle 2 has 0.1 m to spare, Vehicle 3 2.5 m: 0.1 s of coasting costs 0.5 m and 1 m.
    decision = certify(running, np.zeros((1, 2)), backup, backup.harm)
    assert decision.applied.tolist() == [[-1.0, 0.0]] and decision.intervened.tolist() == [[True, False]]
    assert told(decision) == ["no certificate", "plan remains"] and decision.bound.tolist() == [0.0]
    assert decision.margin[0, 0] < 0.0 == decision.margin[0, 1]
    assert decision.backup.plan[0, :2].tolist() == [[-1.0, 0.0], [-1.0, -1.0]]


def test_by_hand__proposals_that_are_harmless_alone_and_collide_together_go_to_the_front_one():
    # Vehicle 2 may brake sooner than planned, or Vehicle 3 later, but not both: 12 m/s need 14.4 m to stop.
    _, worlds = three(gaps_m=[4.9, 12.0], speeds_mps=[0, 5, 12])
    plan = np.full((1, STEPS, 2), -1.0)
    plan[0, :4, 0] = 0.0  # coasts 2 m first, then stops after 2.5 m, 0.4 m before Vehicle 1
    running, backup = start(worlds, plan)
    assert backup.harm.tolist() == [0.0]  # Vehicle 3 stops 12 + 4.5 - 14.4 = 2.1 m behind
    front, rear = np.array([[-1.0, -1.0]]), np.array([[0.0, 0.4]])
    for each in (front, rear):
        assert not certify(running, each, backup, backup.harm).intervened.any()
    several = np.array([[-1.0, 0.4]])  # 0.65 m sooner, and 1.69 m later
    assert plan_harm(certify(running, several, backup, np.full(1, 1e9)).after, plan)[0] > 0.0
    decision = certify(running, several, backup, backup.harm)
    assert told(decision) == ["plan remains", "no certificate"] and decision.applied[0].tolist() == [-1.0, -1.0]


def test_by_hand__what_one_of_two_makes_better_is_in_the_bound_at_once():
    _, worlds = three(gaps_m=[2.6, 10], speeds_mps=[0, 5, 11])
    plan = np.full((1, STEPS, 2), -1.0)
    plan[0, 0, 1] = -0.5  # Vehicle 3 runs into Vehicle 2, and brakes too little at first
    running, backup = start(worlds, plan)
    decision = certify(running, np.array([[1.0, -1.0]]), backup, backup.harm)
    assert decision.intervened.tolist() == [[True, False]]  # Vehicle 2 has 0.1 m to spare
    assert decision.bound.tolist() == plan_harm(decision.after, decision.backup.plan).tolist()
    assert decision.bound[0] < backup.harm[0] - 1.0


def test_by_hand__who_says_no_number_keeps_the_plan_and_the_other_is_clipped():
    _, worlds = three()
    running, backup = start(worlds, np.full((1, STEPS, 2), -0.9))
    decision = certify(running, np.array([[np.nan, -7.0]]), backup, backup.harm)
    assert told(decision) == ["not a number", "plan remains"]
    assert decision.applied.tolist() == [[-0.9, -1.0]] and decision.intervened.tolist() == [[True, False]]


def test_certify__changes_nothing_it_is_given_and_refuses_other_shapes():
    _, worlds = three()
    running, backup = start(worlds, np.full((1, STEPS, 2), -0.8))
    before = running.states.copy(), backup.plan.copy(), backup.harm.copy()
    certify(running, np.array([[0.3, 0.9]]), backup, backup.harm)
    assert [a.tolist() for a in before] == [running.states.tolist(), backup.plan.tolist(), backup.harm.tolist()]
    with pytest.raises(InvalidInput, match=r"proposed \(1,\).*\(1, 2\)"):
        certify(running, np.zeros(1), backup, backup.harm)
    with pytest.raises(InvalidInput, match=r"plan \(1, 81\); \(1, at least 80, 2\) is needed"):
        plan_harm(running, np.zeros((1, STEPS)))


def test_shares__are_those_of_the_ledger_and_the_light_one_bears_more():
    _, worlds = three(speeds_mps=[0, 10, 20])
    running, backup = start(worlds, np.full((1, STEPS, 2), -1.0))
    borne = ends_under(running, backup.plan)[1][0]
    assert borne.sum() == pytest.approx(backup.harm[0]) and borne[1] > borne[2] > 0.0


def test_caps__reject_what_only_moves_harm_to_another():
    _, worlds = three(gaps_m=[3.0, 10.0], speeds_mps=[0, 5, 16])
    running, backup = start(worlds, np.full((1, STEPS, 2), -1.0))
    assert backup.harm[0] > 0.0  # Vehicle 3 runs into Vehicle 2, which stands before Vehicle 1
    proposed, budget = np.array([[0.0, -1.0]]), backup.harm + 50.0
    assert not certify(running, proposed, backup, budget).intervened.any()
    capped = running._replace(caps=ends_under(running, backup.plan)[1])
    decision = certify(capped, proposed, backup, budget)
    assert decision.intervened.tolist() == [[True, False]] and decision.applied[0, 0] == -1.0


@pytest.mark.parametrize(
    ("level", "N"), [(3, 3), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((4, 3), (3, 5)))]
)
@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_engine__realises_the_last_bound_to_the_bit_and_the_bound_never_rises(level, N, harm_count):
    scenario = load_scenario(TEAMS[level, N])
    cap = "baseline" if harm_count == "first" else None
    worlds = scenario.sample(8, 5).worlds
    for k, (name, adversary) in enumerate(TEAM_ADVERSARIES.items()):
        for hostile in ("all", "one") if level > 3 or N > 3 else ("one" if k % 2 else "all",):
            found = attack(scenario, worlds, adversary, hostile=hostile, harm_count=harm_count, cap=cap, seed=1)
            assert found.realised.tolist() == found.last_bound.tolist(), name
            assert (found.realised <= found.bound).all() and found.rises == 0 and found.over_cap == 0
            assert found.accepted.sum() > 0 or name == "full_drive"


def test_one_vehicle_in_a_list__is_the_single_shield_bit_for_bit():
    scenario = load_scenario("paper-random")
    worlds, rng = scenario.sample(20, 4).worlds, np.random.default_rng(4)
    single, listed = StepShield(scenario, 1), StepShield(scenario, [1])
    for shield in (single, listed):
        shield.begin(worlds, np.arange(20))
    listed.backup = listed.backup._replace(constants=single.backup.constants[:, np.newaxis])
    listed.backup = listed.backup._replace(plan=single.backup.plan[:, :, np.newaxis], harm=single.backup.harm)
    while not single.running.finished.all():
        proposed = rng.uniform(-1.2, 1.2, 20)
        one, other = single.decide(proposed), listed.decide(proposed[:, np.newaxis])
        for a, b in ((one.applied, other.applied), (one.reason, other.reason), (one.margin, other.margin)):
            assert a.tolist() == b[:, 0].tolist()
        assert one.bound.tolist() == other.bound.tolist()


def test_bound_at_the_alert__is_at_most_full_braking_and_any_single_constant():
    worlds = PAIR.sample(40, 8).worlds
    joint = StepShield(PAIR, (1, 2))
    joint.begin(worlds, np.arange(40))
    braking = plan_harm(joint.running, np.full((40, STEPS, 2), -1.0))
    assert (joint.first_bound <= braking).all() and joint.first_bound.mean() < 0.8 * braking.mean()
    for vehicle, other in ((1, 2), (2, 1)):
        single = StepShield(PAIR, vehicle, others={0: make_agent("full_brake"), other: make_agent("full_brake")})
        single.begin(worlds, np.arange(40))
        assert (joint.first_bound <= single.first_bound + 1e-6).all()


def test_team__whose_rollout_keeps_the_bound_is_left_alone_and_one_that_does_not_is_not():
    worlds, bounds = PAIR.sample(30, 2).worlds, {}
    for name in ("full_brake", "constant:5"):
        shield = StepShield(PAIR, (1, 2))
        team = {i: make_agent(name) for i in (1, 2)}
        shield.begin(worlds, np.arange(30), team)
        bounds[name] = shield.first_bound
        drives = shield.alone_harm <= shield.first_bound
        command = [team[i].act(worlds, i) / worlds.vehicles.braking_capacity_mps2[:, i] for i in (1, 2)]
        decision = shield.decide(np.stack(command, axis=1))
        assert not decision.intervened[drives].any() and drives.any()
    without = StepShield(PAIR, (1, 2))
    without.begin(worlds, np.arange(30))
    assert all((bound <= without.first_bound).all() for bound in bounds.values())


def test_begin__of_some_rows_keeps_the_others_with_their_caps():
    worlds = PAIR.sample(6, 3).worlds
    shield = StepShield(PAIR, (1, 2), cap="baseline")
    shield.begin(worlds, np.arange(6))
    shield.decide(np.zeros((6, 2)))
    caps, shares = shield.running.caps.copy(), shield.baseline_shares.copy()
    shield.begin(worlds.take([0]), np.array([4]))
    assert shield.running.steps.tolist() == [1, 1, 1, 1, 0, 1]
    assert (
        shield.running.caps[4].tolist() == caps[0].tolist() and shield.baseline_shares[4].tolist() == shares[0].tolist()
    )
    assert np.delete(shield.running.caps, 4, axis=0).tolist() == np.delete(caps, 4, axis=0).tolist()


def test_constants__hold_all_alike_and_ladders_each_once():
    constants = joint_constants(3)
    assert len({tuple(row) for row in constants.tolist()}) == len(constants) == 31
    assert constants.min() == -1.0 and constants.max() == 0.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: StepShield(PAIR, (2, 1)), "several are named front to rear, each once"),
        (lambda: StepShield(PAIR, (1, 1)), "front to rear, each once"),
        (lambda: StepShield(PAIR, ()), "must be an index from 0 to 2"),
        (lambda: StepShield(PAIR, (1, 3)), "must be an index from 0 to 2"),
        (lambda: StepShield(PAIR, (1, 2), cap="mine"), "cap 'mine'"),
    ],
)
def test_bad_input__is_refused_by_name(make, message):
    with pytest.raises(InvalidInput, match=message):
        make()


def test_policies__of_other_vehicles_are_refused():
    shield = StepShield(PAIR, (1, 2))
    with pytest.raises(InvalidInput, match=r"policies for vehicles \[1\], shielded are \[1, 2\]"):
        shield.begin(PAIR.sample(1, 0).worlds, np.arange(1), make_agent("coast"))


def test_surprise__of_one_world_hands_the_whole_team_to_the_fallback():
    scenario = load_scenario(TEAMS[4, 3])
    worlds = scenario.sample(3, 1).worlds
    shield = StepShield(scenario, scenario.learners)
    shield.begin(worlds, np.arange(3))
    seen = shield.running.states.copy()
    seen[1, 1] -= 0.5  # a vehicle is slower than it can be
    decision = shield.decide(np.ones((3, 3)), seen=seen)
    assert shield.distrusted.tolist() == [False, True, False]
    assert [REASONS[each] for each in decision.reason[1]] == ["assumption broken"] * 3
    assert decision.intervened[1].all() and (decision.applied[1] <= 0.0).all()


def test_engine__steps_the_team_as_it_was_certified():
    worlds = PAIR.sample(4, 6).worlds
    engine = Engine(PAIR, 4, learners=(1, 2), scripts={0: make_agent("full_brake")}, worlds=worlds)
    shield = StepShield(PAIR, (1, 2))
    shield.begin(worlds, np.arange(4))
    while not engine.ended.all():
        decision = shield.decide(np.ones((4, 2)), only=~engine.ended)
        engine.step(decision.applied)
        assert decision.after.states[:, :3].tolist() == engine.worlds.speeds_mps.tolist()
    assert shield.shares().tolist() == engine.ledger.vehicle_harm("first").tolist()


@pytest.fixture
def pair_env():
    return HybridShield(parallel_env("cooperation-3-pair"), mode="step")


def test_parallel__every_learner_is_told_its_own_decision_and_the_common_bound(pair_env):
    _, infos = pair_env.reset(seed=3)
    bound = infos["vehicle_2"]["shield"]["bound_harm"]
    assert pair_env.shielded == ("vehicle_2", "vehicle_3") and "shield" not in infos["vehicle_1"]
    while pair_env.agents:
        *_, infos = pair_env.step({"vehicle_2": [1.0], "vehicle_3": [-1.0]})
        told = [infos[agent]["shield"] for agent in pair_env.shielded]
        assert told[0]["bound_harm"] == told[1]["bound_harm"] <= bound
        assert [each["proposed_action"] for each in told] == [1.0, -1.0] and all(each["trusted"] for each in told)
        bound = told[0]["bound_harm"]
    assert pair_env.unwrapped.engine.ledger.world_harm("first")[0] == bound


def test_parallel__a_team_proposes_where_nobody_does_and_one_may_be_left_out():
    team = {"vehicle_2": make_agent("full_brake"), "vehicle_3": make_agent("coast")}
    env = HybridShield(parallel_env("cooperation-3-pair"), team, mode="step")
    env.reset(seed=1)
    *_, infos = env.step({"vehicle_3": [0.5]})
    assert [infos[agent]["shield"]["proposed_action"] for agent in env.shielded] == [-1.0, 0.5]
    for policy in (make_agent("full_brake"), Team.of(make_agent("full_brake"), (1, 2))):
        alike = HybridShield(parallel_env("cooperation-3-pair"), policy, mode="step")
        alike.reset(seed=1)
        *_, infos = alike.step({})
        assert [infos[agent]["shield"]["proposed_action"] for agent in alike.shielded] == [-1.0, -1.0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda env: HybridShield(env, mode="step", agents=["vehicle_2"]), "shields every learner.*give it a script"),
        (lambda env: HybridShield(env, mode="step", agents=["vehicle_1", "vehicle_2"]), "shields every learner"),
        (lambda env: HybridShield(env, mode="robust", uncertainty="gaps_m=0.5"), "exactly one learner in mode robust"),
        (lambda env: HybridShield(env, make_agent("coast")), "exactly one learner in mode episode"),
        (
            lambda env: HybridShield(env, {"vehicle_2": make_agent("coast")}, mode="step"),
            "one for each of vehicle_2, v",
        ),
        (lambda env: HybridShield(env, mode="step", cap="mine"), "cap = 'mine': must be baseline or None"),
        (lambda env: HybridShield(env, make_agent("coast"), cap="baseline"), "mode step alone takes one"),
    ],
)
def test_parallel__what_is_not_covered_is_refused_in_one_line(make, message):
    with pytest.raises(InvalidInput, match=message):
        make(parallel_env("cooperation-3-pair"))


def test_parallel__a_changed_action_of_any_of_them_is_shielded():
    class Driving(BaseParallelWrapper):
        def step(self, actions):
            return super().step({**actions, "vehicle_3": np.ones(1)})

    env = HybridShield(Driving(parallel_env("cooperation-3-pair")), mode="step")
    env.reset(seed=0)
    bound, replaced = env.attached.shield.first_bound[0], 0
    while env.agents:
        *_, infos = env.step({"vehicle_2": [-1.0], "vehicle_3": [-1.0]})
        assert infos["vehicle_3"]["shield"]["proposed_action"] == 1.0
        replaced += infos["vehicle_3"]["shield"]["intervened"]
    assert env.unwrapped.engine.ledger.world_harm("first")[0] <= bound and replaced > 0


def test_aec__decides_for_all_when_the_last_has_acted():
    env = shielded_aec(parallel_env("cooperation-4-all"), mode="step")
    env.reset(seed=5)
    for _ in env.agent_iter():
        *_, terminated, truncated, info = env.last()
        if "shield" in info:
            assert info["shield"]["trusted"]
        env.step(None if terminated or truncated else np.array([1.0], np.float32))
    engine = env.unwrapped.engine
    assert engine.ledger.world_harm("first")[0] == info["shield"]["bound_harm"]


def test_sb3__rows_of_one_world_are_decided_together_over_automatic_resets():
    env = ShieldedVecEnv(make_sb3_vec_env("cooperation-3-pair", 5, seed=3), cap="baseline", intervention_penalty=1.0)
    env.reset()
    rng, ended = np.random.default_rng(0), 0
    for _ in range(120):
        caps = env.attached.shield.baseline_shares
        _, _, done, infos = env.step(rng.uniform(-1.0, 1.0, (10, 1)).astype(np.float32))
        for k in np.flatnonzero(done)[::2]:
            pair = [infos[k], infos[k + 1]]
            assert pair[0]["shield"]["bound_harm"] == pair[1]["shield"]["bound_harm"]
            assert pair[0]["world_first_impact_harm"] == pair[0]["shield"]["bound_harm"]
            assert [each["first_impact_harm"] for each in pair] <= caps[k // 2, 1:].tolist()
            ended += 1
    assert ended >= 5


def test_evaluation__a_team_behind_the_shield_keeps_its_bound_and_is_never_worse_than_told():
    worlds = PAIR.sample(40, 7)
    agents = {name: make_agent(name, scenario=PAIR) for name in ("constant:3+step", "full_brake+step", "full_brake")}
    found = evaluate(worlds, agents, scenario=PAIR, seed=7).outcomes
    for name in ("constant:3+step", "full_brake+step"):
        harm = found[name].ledger.world_harm("first")
        assert (harm <= found[name].predicted_harm).all() and found[name].chosen_policy.shape == (40,)
    mean = {name: found[name].ledger.world_harm("first").mean() for name in agents}
    assert mean["full_brake+step"] < mean["full_brake"] - 1.0 and found["full_brake"].predicted_harm is None


def test_evaluation__members_ask_once_and_the_engine_is_followed_to_the_end():
    team = ShieldedDriver(Team.of(make_agent("coast"), (1, 2)), PAIR, logging=True).on((1, 2))
    worlds = PAIR.sample(20, 9).worlds
    episodes = drive(worlds, team, PAIR)
    harm, shield = episodes.ledger, episodes.guarded.shield
    assert harm.world_harm("first").tolist() == shield.bound.tolist() and not shield.distrusted.any()
    assert len(shield.log) == shield.interventions.sum() > 0
    assert {entry.vehicle for entry in shield.log} == {1, 2}
    again = drive(PAIR.sample(20, 9).worlds, team, PAIR).ledger  # a second batch begins anew
    assert again.world_harm("first").tolist() == harm.world_harm("first").tolist()


class Coasting:
    """Coasts."""

    name = "coasting"

    def act(self, worlds, vehicle):
        return np.zeros(worlds.n)


def test_evaluation__later_rollouts_of_the_team_let_more_of_it_through():
    class Late(Coasting):
        """Coasts for 0.3 s, then brakes fully."""

        def act(self, worlds, vehicle):
            return np.where(worlds.time_s < 0.8, 0.0, -worlds.vehicles.braking_capacity_mps2[:, vehicle])

    worlds, replaced = PAIR.sample(60, 11).worlds, {}
    for later in (True, False):
        team = ShieldedDriver(Team({1: Late(), 2: Late()}, "late"), PAIR, later_rollouts=later).on((1, 2))
        episodes = drive(worlds, team, PAIR)
        assert (episodes.ledger.world_harm("first") <= episodes.guarded.shield.predicted_harm).all()
        replaced[later] = episodes.guarded.shield.interventions.sum()
    assert replaced[True] < replaced[False]


@pytest.mark.parametrize("around", ["episode", "robust"])
def test_evaluation__other_shields_refuse_a_team(around):
    with pytest.raises(InvalidInput, match=r"can drive one learner|needs an uncertainty"):
        team = make_agent(f"full_brake+{around}", scenario=PAIR)
        evaluate(PAIR.sample(2, 1), {"one": team}, scenario=PAIR)


def test_evaluation__a_team_that_leaves_a_learner_alone_is_refused():
    with pytest.raises(InvalidInput, match=r"does not drive vehicle_3.*follows a script"):
        ShieldedDriver(Team({1: make_agent("coast")}, "half"), PAIR)
