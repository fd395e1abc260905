"""The joint shield: several shielded vehicles of one line, decided together."""

import numpy as np
import pytest

from ethbrake_marl.agents import Team, drive, make_agent
from ethbrake_marl.envs import parallel_env
from ethbrake_marl.scenario import Scenario, Task, load_scenario
from ethbrake_marl.search import profile_problem
from ethbrake_marl.shield import HybridShield, Shielded, ShieldedDriver, StepShield, guard as behind_module
from ethbrake_marl.shield.step_shield import (
    REASONS,
    Backup,
    Proposer,
    begin_running,
    certify,
    certify_rollouts,
    ends_under,
    joint_constants,
    plan_harm,
)
from tests.fixtures.asked import Acts
from tests.shield.attacks import TEAM_ADVERSARIES, TEAMS, all_infos, attack, begun

STEPS = 81
PAIR, PAPER = load_scenario("cooperation-3-pair"), load_scenario("paper-random")


def three(**changes):
    """Vehicle 1 stands; 10 m and 10 m behind it two vehicles come at 5 and 10 m/s that brake with at most 5 m/s2."""
    given = {
        "name": "three", "vehicles": 3, "gaps_m": [10, 10], "speeds_mps": [0, 5, 10], "braking_capacity_mps2": 5,
        "driving_capacity_mps2": 5, "mass_t": [1, 1, 3], "latency_s": 0,
        "roles": {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "learner"},
    }  # fmt: skip
    return Scenario(**{**given, **changes}).sample(1, 0).worlds


def braking(action=-1.0, vehicles=2):
    """A plan of one world."""
    return np.full((1, STEPS, vehicles), action)


def start(worlds, plan, vehicles=(1, 2)):
    running = begin_running(profile_problem(worlds, vehicles))
    return running, Backup(plan, plan_harm(running, plan), np.zeros((0, *plan.shape[2:])))


def told(decision):
    return [REASONS[each] for each in decision.reason[0]]


def test_by_hand__of_two_proposals_the_harmless_one_is_accepted_the_other_replaced():
    # Braking fully they stop after 2.5 m and 10 m; Vehicle 3 then stands 2.5 m behind Vehicle 2.
    running, backup = start(three(gaps_m=[2.6, 10]), braking())
    assert backup.harm.tolist() == [0.0]
    # Vehicle 2 has 0.1 m to spare, Vehicle 3 2.5 m: 0.1 s of coasting costs 0.5 m and 1 m.
    decision = certify(running, np.zeros((1, 2)), backup, backup.harm)
    assert decision.applied.tolist() == [[-1.0, 0.0]] and decision.intervened.tolist() == [[True, False]]
    assert told(decision) == ["no certificate", "plan remains"] and decision.bound.tolist() == [0.0]
    assert decision.margin[0, 0] < 0.0 == decision.margin[0, 1]
    assert decision.backup.plan[0, :2].tolist() == [[-1.0, 0.0], [-1.0, -1.0]]


def test_by_hand__proposals_that_are_harmless_alone_and_collide_together_go_to_the_front_one():
    # Vehicle 2 may brake sooner than planned, or Vehicle 3 later, but not both: 12 m/s need 14.4 m to stop.
    plan = braking()
    plan[0, :4, 0] = 0.0  # coasts 2 m first, then stops after 2.5 m, 0.4 m before Vehicle 1
    running, backup = start(three(gaps_m=[4.9, 12.0], speeds_mps=[0, 5, 12]), plan)
    assert backup.harm.tolist() == [0.0]  # Vehicle 3 stops 12 + 4.5 - 14.4 = 2.1 m behind
    for each in ([[-1.0, -1.0]], [[0.0, 0.4]]):
        assert not certify(running, np.array(each), backup, backup.harm).intervened.any()
    several = np.array([[-1.0, 0.4]])  # 0.65 m sooner, and 1.69 m later
    assert plan_harm(certify(running, several, backup, np.full(1, 1e9)).after, plan)[0] > 0.0
    decision = certify(running, several, backup, backup.harm)
    assert told(decision) == ["plan remains", "no certificate"] and decision.applied[0].tolist() == [-1.0, -1.0]


def test_by_hand__what_one_of_two_makes_better_is_in_the_bound_at_once():
    plan = braking()
    plan[0, 0, 1] = -0.5  # Vehicle 3 runs into Vehicle 2, and brakes too little at first
    running, backup = start(three(gaps_m=[2.6, 10], speeds_mps=[0, 5, 11]), plan)
    decision = certify(running, np.array([[1.0, -1.0]]), backup, backup.harm)
    assert decision.intervened.tolist() == [[True, False]]  # Vehicle 2 has 0.1 m to spare
    assert decision.bound.tolist() == plan_harm(decision.after, decision.backup.plan).tolist()
    assert decision.bound[0] < backup.harm[0] - 1.0


def test_by_hand__who_says_no_number_keeps_the_plan_and_the_other_is_clipped():
    running, backup = start(three(), braking(-0.9))
    decision = certify(running, np.array([[np.nan, -7.0]]), backup, backup.harm)
    assert told(decision) == ["not a number", "plan remains"]
    assert decision.applied.tolist() == [[-0.9, -1.0]] and decision.intervened.tolist() == [[True, False]]


def test_caps__reject_what_only_moves_harm_to_another_vehicle_also_in_a_later_rollout():
    worlds = three(gaps_m=[3.0, 10.0], speeds_mps=[0, 5, 16])
    running, backup = start(worlds, braking())
    assert backup.harm[0] > 0.0  # Vehicle 3 runs into Vehicle 2, which stands before Vehicle 1
    proposed, budget = np.array([[0.0, -1.0]]), backup.harm + 50.0
    assert not certify(running, proposed, backup, budget).intervened.any()
    capped = running._replace(caps=ends_under(running, backup.plan)[1])
    decision = certify(capped, proposed, backup, budget)
    assert decision.intervened.tolist() == [[True, False]] and decision.applied[0, 0] == -1.0
    team = Proposer(dict.fromkeys((1, 2), make_agent("full_brake")), {1: None, 2: None}, worlds)
    for each, refused in ((running, False), (capped, True)):
        found = certify_rollouts(each, proposed, np.arange(1), budget, backup.plan, team)
        assert found.intervened.tolist() == [[refused, refused]] and found.margin.min() > 0.0


@pytest.mark.parametrize(("level", "N"), [(3, 3), (4, 3), (3, 5)])
@pytest.mark.parametrize("harm_count", ["first", "total"])
@pytest.mark.parametrize("name", TEAM_ADVERSARIES)
def test_attack__realises_the_last_bound_to_the_bit_and_neither_bound_nor_caps_are_broken(name, level, N, harm_count):
    scenario, cap = load_scenario(TEAMS[level, N]), "baseline" if harm_count == "first" else None
    for hostile in ("all", "one"):
        found = attack(
            scenario, scenario.sample(4 if N == 3 else 2, 5).worlds, TEAM_ADVERSARIES[name], hostile=hostile, seed=1,
            harm_count=harm_count, cap=cap,
        )  # fmt: skip
        assert found.realised.tolist() == found.last_bound.tolist()
        assert (found.realised <= found.bound).all() and (found.rises, found.over_cap) == (0, 0)
        assert found.accepted.any() or name == "full_drive"


def test_one_vehicle_in_a_list__is_the_single_shield_bit_for_bit():
    worlds, rng = PAPER.sample(20, 4).worlds, np.random.default_rng(4)
    single, listed = StepShield(PAPER, 1), StepShield(PAPER, [1])
    for shield in (single, listed):
        shield.begin(worlds, np.arange(20))
    held = single.backup
    listed.backup = Backup(held.plan[:, :, np.newaxis], held.harm, held.constants[:, np.newaxis])
    while not single.running.finished.all():
        proposed = rng.uniform(-1.2, 1.2, 20)
        one, other = single.decide(proposed), listed.decide(proposed[:, np.newaxis])
        for name in ("applied", "reason", "margin", "bound"):
            assert getattr(one, name).tolist() == getattr(other, name).reshape(20).tolist()


def test_bound_at_the_alert__is_at_most_full_braking_and_any_single_constant():
    worlds = PAIR.sample(40, 8).worlds
    joint = begun(PAIR, worlds)
    braked = plan_harm(joint.running, np.full((40, STEPS, 2), -1.0))
    assert (joint.first_bound <= braked).all() and joint.first_bound.mean() < 0.8 * braked.mean()
    for vehicle in (1, 2):
        assert (joint.first_bound <= begun(PAIR.with_learners([vehicle]), worlds).first_bound + 1e-6).all()


def test_team__whose_rollout_keeps_the_bound_is_left_alone():
    worlds = PAIR.sample(30, 2).worlds
    without = begun(PAIR, worlds)
    for name in ("full_brake", "constant:5"):
        shield, team = StepShield(PAIR, (1, 2)), {i: make_agent(name) for i in (1, 2)}
        shield.begin(worlds, np.arange(30), team)
        drives = shield.alone_harm <= shield.first_bound
        command = [team[i].act(worlds, i) / worlds.vehicles.braking_capacity_mps2[:, i] for i in (1, 2)]
        assert not shield.decide(np.stack(command, axis=1)).intervened[drives].any() and drives.any()
        assert (shield.first_bound <= without.first_bound).all()


def test_constants__hold_all_alike_and_ladders_each_once():
    constants = joint_constants(3)
    assert len({tuple(row) for row in constants.tolist()}) == len(constants) == 31
    assert constants.min() == -1.0 and constants.max() == 0.0


def test_surprise__of_one_world_hands_the_whole_team_to_the_fallback():
    scenario = load_scenario(TEAMS[4, 3])
    shield = begun(scenario, scenario.sample(3, 1).worlds)
    seen = shield.running.states.copy()
    seen[1, 1] -= 0.5  # a vehicle is slower than it can be
    decision = shield.decide(np.ones((3, 3)), seen=seen)
    assert shield.distrusted.tolist() == [False, True, False]
    assert [REASONS[each] for each in decision.reason[1]] == ["assumption broken"] * 3
    assert decision.intervened[1].all() and (decision.applied[1] <= 0.0).all()


# Behind the interfaces.


def test_parallel__a_team_proposes_where_nobody_does_and_one_may_be_left_out():
    front_alone = {"vehicle_2": make_agent("full_brake"), "vehicle_3": make_agent("coast")}
    brake = make_agent("full_brake")
    for policy, given, proposed in (
        (front_alone, {"vehicle_3": [0.5]}, [-1.0, 0.5]), (brake, {}, [-1.0, -1.0]),
        (Team.of(brake, (1, 2)), {}, [-1.0, -1.0]),
    ):  # fmt: skip
        env = HybridShield(parallel_env("cooperation-3-pair"), policy, mode="step")
        env.reset(seed=1)
        *_, infos = env.step(given)
        assert [infos[agent]["shield"]["proposed_action"] for agent in env.shielded] == proposed


@pytest.mark.parametrize("settings", [{"shares": True}, {"cap": "baseline"}, {"shares": True, "harm_count": "total"}])
@pytest.mark.parametrize("scenario", ["cooperation-4-all", "paper-random"])
def test_shares__at_the_end_are_what_the_ledger_says(scenario, settings):
    env = HybridShield(parallel_env(scenario), mode="step", **settings)
    differed = 0
    for seed in range(4):
        infos = all_infos(env, {agent: [0.6] for agent in env.shielded}, seed=seed)
        ledger, count = env.unwrapped.engine.ledger, settings.get("harm_count", "first")
        borne = ledger.vehicle_harm(count)[0]
        for agent in env.shielded:
            first, *_, last = told = [each[agent]["shield"] for each in infos]
            bounds = [each["bound_harm"] for each in told]  # common to all, and never rising
            assert bounds == [each[env.shielded[0]]["shield"]["bound_harm"] for each in infos]
            assert bounds == sorted(bounds, reverse=True) and bounds[-1] == ledger.world_harm(count)[0]
            assert all(each["proposed_action"] == 0.6 and each["trusted"] for each in told[1:])
            assert set(first) == set(last) and last["own_harm"] == borne[int(agent[-1]) - 1]
            assert last["baseline_own_harm"] == first["own_harm"] == first["baseline_own_harm"]
            assert last["own_harm"] <= last["baseline_own_harm"] or "cap" not in settings
            differed += last["own_harm"] != last["baseline_own_harm"]
    assert differed > 0


# In evaluations.


def test_drive_chunks__is_what_the_shielded_team_does_whatever_the_chunk(monkeypatch):
    worlds, task = PAIR.sample(12, 7).worlds, Task(PAIR, (1, 2), "total")
    team = ShieldedDriver(Team.of(make_agent("coast"), (1, 2)), PAIR, harm_count="total", logging=True)
    for _ in range(2):  # a second batch begins anew
        episodes = drive(worlds, team.on((1, 2)), PAIR)
        ledger, shield = episodes.ledger, episodes.guarded.shield
        whole = Shielded.driven(make_agent("coast"), worlds, task)
        assert whole.harm.tolist() == ledger.world_harm("total").tolist() == shield.bound.tolist()
        assert whole.vehicle_harm.tolist() == ledger.vehicle_harm("total").tolist() == shield.shares().tolist()
        assert whole.bound.tolist() == shield.predicted_harm.tolist() and (whole.harm <= whole.bound).all()
        assert whole.baseline.tolist() == shield.baseline_shares.tolist() and not shield.distrusted.any()
    logged = np.zeros((12, 2), np.int64)
    np.add.at(logged, tuple(np.transpose([(entry.world, entry.vehicle - 1) for entry in shield.log])), 1)
    assert whole.replaced.tolist() == logged.tolist() and (logged.sum(axis=0) > 0).all()
    assert (whole.replaced <= whole.decisions[:, np.newaxis]).all()
    monkeypatch.setattr(behind_module, "CHUNK", 5)
    parts = Shielded.driven(make_agent("coast"), worlds, task)
    assert all(np.array_equal(*columns) for columns in zip(whole, parts, strict=True))
    assert Shielded.stack([whole, parts]).replaced.shape == (2, 12, 2)


def test_evaluation__later_rollouts_of_the_team_let_more_of_it_through():
    @Acts
    def late(worlds, vehicle):
        """Coasts for 0.3 s, then brakes fully."""
        return np.where(worlds.time_s < 0.8, 0.0, -worlds.vehicles.braking_capacity_mps2[:, vehicle])

    worlds, replaced = PAIR.sample(60, 11).worlds, {}
    for later in (True, False):
        episodes = drive(worlds, ShieldedDriver(Team.of(late, (1, 2)), PAIR, later_rollouts=later).on((1, 2)), PAIR)
        assert (episodes.ledger.world_harm("first") <= episodes.guarded.shield.predicted_harm).all()
        replaced[later] = episodes.guarded.shield.interventions.sum()
    assert replaced[True] < replaced[False]
