"""The step shield, of one vehicle and of several: decisions by hand, and in the engine, where bounds hold."""

import copy
from dataclasses import replace

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.engine.profiles import profile_problem
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.first_edition.shields import episodes as episodes_module
from ethbrake_marl.first_edition.shields.certify import Backup, certify, plan_harm
from ethbrake_marl.first_edition.shields.comparison import ends_under
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.episodes import Shielded, drive_shielded
from ethbrake_marl.first_edition.shields.first_plan import joint_constants
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent
from ethbrake_marl.first_edition.shields.reasons import ShieldReason
from ethbrake_marl.first_edition.shields.rollouts import Proposer, certify_rollouts
from ethbrake_marl.first_edition.shields.running import begin_running
from ethbrake_marl.first_edition.shields.step import StepShield
from tests.first_edition.rest.fixture_asked import Acts
from tests.first_edition.shield.attacks import (
    ADVERSARIES,
    LEAKS,
    TEAM_ADVERSARIES,
    TEAMS,
    all_infos,
    attack,
    begun,
    line,
    search,
)
from tests.first_edition.shield.plays import reported

pytestmark = pytest.mark.filterwarnings(
    "ignore::RuntimeWarning",  # uncompiled, a division by 0 warns
    "ignore::ethbrake_marl.first_edition.shields.MovingAtHorizon",
)

STEPS = 81
PAPER = eb.load_scenario("paper-random")
WORLDS = PAPER.sample(60, 3).worlds

# Three worlds of two vehicles: small enough to run uncompiled.
TWO = eb.Scenario(
    name="two",
    vehicles=2,
    gaps_m={"uniform": [3, 5]},
    speeds_mps={"uniform": [14, 16]},
    braking_capacity_mps2=[8, 5],
    driving_capacity_mps2=3,
    mass_t=2,
    latency_s=[0, 0.35],
    restitution=0.2,
    horizon_s=5.0,
    roles={"vehicle_1": "full_brake", "vehicle_2": "learner"},
)
SMALL = TWO.sample(4, 1).worlds


def two(speed=10.0, latency=0.0):
    """Vehicle 1 stands 15 m ahead of Vehicle 2, which brakes with at most 5 m/s2: it stops after 10 m."""
    scenario = eb.Scenario(
        name="two", vehicles=2, gaps_m=15, speeds_mps=[0, speed], braking_capacity_mps2=5, driving_capacity_mps2=5,
        mass_t=1, latency_s=[0, latency], roles={"vehicle_1": "full_brake", "vehicle_2": "learner"},
    )  # fmt: skip
    return scenario, scenario.sample(1, 0).worlds


def start(worlds, plan, members=None, **settings):
    members = worlds if members is None else members
    running = begin_running(profile_problem(members, [1], **settings), members.n // worlds.n)
    return running, Backup(plan, plan_harm(running, plan))


def braking(action=-1.0, *vehicles):
    """A plan of one world; for several vehicles if it is told how many."""
    return np.full((1, STEPS, *vehicles), action)


def reason(decision):
    return ShieldReason(decision.reason[0]).text


def coasts(latency, steps, members=None):
    """Coasting is let through in so many steps; ``members`` gives the possible worlds of one."""
    worlds = two(latency=latency)[1]
    running, backup = start(worlds, braking(), None if members is None else members(worlds))
    assert backup.harm[0] == pytest.approx(0.0, abs=1e-9)
    decisions = []
    while not decisions or not decisions[-1].intervened[0]:
        decisions.append(certify(running, np.zeros(1), backup, backup.harm))
        running, backup = decisions[-1].after, decisions[-1].backup
    *let, last = decisions
    assert (len(let), reason(last), last.applied[0]) == (steps, "no certificate", -1.0)
    if steps == 5:  # one step more: 1 m too far, so an impact at sqrt(2 * 5 * 1) m/s
        assert last.margin[0] == pytest.approx(-10.0, abs=1e-9)


def test_by_hand__coasting_is_let_through_as_long_as_it_can_still_stop():
    coasts(0.0, 5)  # 15 m, 10 m to stop: 5 m at 10 m/s. (To touch at rest is no impact.)
    coasts(0.5, 0)  # the 5 m to spare go by before the first decision


def test_by_hand__a_pair_counts_once_for_the_first_impact_and_each_time_for_the_total():
    worlds = eb.make_worlds(
        [[1.0]], [[0.0, 10.0]], braking_capacity_mps2=[[8.0, 1.0]], driving_capacity_mps2=0.0, latency_s=0.0,
        mass_t=1.0, restitution=0.5,
    )  # fmt: skip
    plan, harm = np.where(np.arange(STEPS) < 5, -1.0, 0.0)[np.newaxis], {}
    for count in ("first", "total"):
        running, backup = start(worlds, plan, harm_count=count, others_mps2=np.array([[-8.0, 0.0]]))
        harm[count] = backup.harm[0]
        for k in range(3):
            decision = certify(running, plan[:, k], backup, backup.harm)
            running, backup = decision.after, decision.backup
        assert backup.harm[0] == harm[count]
    assert harm["first"] == pytest.approx(98.0, abs=1e-9)  # 10^2 - 2 * 1 * 1
    assert harm["total"] > harm["first"] + 0.5


@pytest.mark.parametrize(("value", "instead"), [(np.nan, -0.8), (-7.0, -1.0), (-np.inf, -1.0)])
def test_proposal__that_is_no_number_is_replaced_and_beyond_the_range_is_clipped_before_it_is_certified(value, instead):
    running, backup = start(two(15.0)[1], braking(-0.8))
    decision, same = (certify(running, np.array([each]), backup, backup.harm) for each in (value, instead))
    assert decision.applied.tolist() == [instead] and decision.bound.tolist() == same.bound.tolist()
    assert decision.after.states.tolist() == same.after.states.tolist()
    assert decision.intervened[0] == np.isnan(value) == (reason(decision) == "not a number")


@pytest.mark.parametrize(
    ("scenario", "n", "harm_count", "settings", "name"),
    [
        *((TWO, 4, "first", {}, name) for name in ("random_actions", "extremes")),  # small enough to run uncompiled
        *((line(3), 24, "first", {}, name) for name in ADVERSARIES),
        *((line(5), 24, "total", {}, name) for name in ADVERSARIES),
        *(
            (eb.load_scenario(TEAMS[level, N]), 4 if N == 3 else 2, harm_count, {"hostile": hostile, "cap": cap}, name)
            for level, N in ((3, 3), (4, 3), (3, 5))
            for harm_count, cap in (("first", "baseline"), ("total", None))
            for hostile in ("all", "one")
            for name in TEAM_ADVERSARIES
        ),
    ],
    ids=str,
)
def test_attack__realises_the_last_bound_to_the_bit_and_neither_bound_nor_caps_are_broken(
    scenario, n, harm_count, settings, name
):
    found = attack(scenario, scenario.sample(n, 5).worlds, ADVERSARIES[name], harm_count=harm_count, seed=1, **settings)
    assert found.realised.tolist() == found.last_bound.tolist() and (found.bound > 0.0).any()
    assert (found.realised <= found.bound).all() and (found.rises, found.over_cap) == (0, 0)
    assert found.accepted.any() or not settings or name == "full_drive"


def test_search__finds_no_way_past_the_shield_but_many_without_it():
    found = search(60, 5)
    assert (found.above, found.excess) == (0, 0.0) and found.loose > 0.5


@pytest.mark.parametrize("name", [name for name in LEAKS if "further off" not in name])  # that one takes longer lines
def test_search__finds_each_leak(name):
    found = search(100, 5, LEAKS[name], until_found=True)
    assert found.first is not None and found.excess > 1e-6


def test_allowance__keeps_what_it_grants_and_no_more():
    worlds = line(3).sample(60, 13).worlds
    strict, loose = (attack(line(3), worlds, ADVERSARIES["slow_drift"], allowance=a) for a in (0.0, 30.0))
    assert (loose.realised <= loose.bound + 30.0 + 1e-9).all() and (loose.realised > loose.bound).any()
    assert loose.realised.mean() > strict.realised.mean() + 1.0


@pytest.mark.parametrize(
    ("scenario", "settings"),
    [(PAPER, {}), (eb.load_scenario("cooperation-3-pair"), {"cap": "baseline"})],
    ids=["one", "team"],
)
def test_begin__of_some_rows_leaves_the_others_alone(scenario, settings):
    begins_apart(scenario, **settings)


def begins_apart(scenario, kind=StepShield, **settings):
    worlds = scenario.sample(6, 3).worlds
    shield, fresh = begun(scenario, worlds, kind, **settings), begun(scenario, worlds, kind, **settings)
    shield.decide(np.zeros_like(shield.memory.backup.plan[:, 0]))
    before = shield.take(np.arange(6))
    shield.begin(worlds.take([0]), np.array([4]))
    assert shield.memory.running.steps.tolist() == [1, 1, 1, 1, 0, 1]
    for row, as_in, there in ((0, before, 0), (5, before, 5), (4, fresh, 0)):
        now, then = shield.take(np.array([row])), as_in.take(np.array([there]))
        assert now.memory.running.states.tolist() == then.memory.running.states.tolist()
        assert np.array_equal(now.memory.running.caps, then.memory.running.caps)
        assert now.memory.baseline_shares.tolist() == then.memory.baseline_shares.tolist()
        assert now.bound.tolist() == then.bound.tolist()


SURPRISES = {"brakes harder": [-0.3, 0, 0, 0], "not a number": [0, 0, np.nan, 0], "no message": None}


@pytest.mark.parametrize("what", SURPRISES)
def test_surprise__is_flagged_and_falls_back_for_the_rest_of_that_episode_alone(what):
    shield, seen_columns = begun(TWO, SMALL), 4  # 2 speeds, gap, hit flag
    stale = shield.memory.running.states[:, :seen_columns].copy()
    shield.decide(np.full(4, -0.5), seen=stale)
    seen = shield.memory.running.states[:, :seen_columns].copy()
    assert not shield.memory.distrusted.any()
    seen[1] = stale[1] if what == "no message" else seen[1] + SURPRISES[what]
    for _ in range(3):
        decision = shield.decide(np.ones(4), seen=seen)
        assert shield.memory.distrusted.tolist() == [False, True, False, False]
        assert ShieldReason(decision.reason[1]).text == "assumption broken" and decision.intervened[1]
        assert decision.applied[1] <= 0.0 and np.isfinite([decision.applied, shield.bound]).all()
        seen = shield.memory.running.states[:, :seen_columns].copy()
    shield.begin(SMALL.take([3]), np.array([1]))
    assert not shield.memory.distrusted.any()


@Acts
def wavering(worlds, vehicle):
    """A bad driver that is not constant."""
    wave = np.sin(17.0 * worlds.time_s + worlds.gaps_m[:, 0])
    return np.where(wave > 0.0, 0.0, wave * worlds.vehicles.braking_capacity_mps2[:, vehicle])


@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_agent__is_never_worse_than_the_episode_mode_nor_than_its_prediction(harm_count):
    driven, alone = (
        drive(WORLDS, kind(wavering, PAPER, harm_count=harm_count), PAPER, 1) for kind in (ShieldedDriver, HybridAgent)
    )
    harm, hybrid = (episodes.ledger.world_harm(harm_count) for episodes in (driven, alone))
    shield = driven.guarded.shield
    assert (harm <= shield.predicted_harm).all() and (harm <= hybrid + 1e-9).all()
    assert harm.mean() < hybrid.mean() - 0.2
    assert harm.tolist() == shield.bound.tolist() and not shield.memory.distrusted.any()


def test_agent__a_policy_that_keeps_the_bound_is_left_alone():
    shield = drive(WORLDS, ShieldedDriver(eb.make_agent("e_v2x_bm"), PAPER), PAPER, 1).guarded.shield
    fine = shield.memory.alone_harm <= shield.memory.first_bound
    assert fine.mean() > 0.9 and shield.chosen_policy[fine].all()


@pytest.mark.parametrize("kind", [ShieldedDriver, HybridAgent])
def test_agent__a_worlds_outcome_depends_on_no_other_world_and_on_nothing_driven_before(kind):
    used = kind(wavering, PAPER)
    whole = drive(WORLDS, used, PAPER, 1).ledger.world_harm("first")
    for rows in ([0], [7], [50], list(range(20))):
        for agent in (used, kind(wavering, PAPER)):
            episodes = drive(WORLDS.take(rows), agent, PAPER, 1)
            assert episodes.ledger.world_harm("first").tolist() == whole[rows].tolist()
            told = episodes.memories[1] if episodes.guarded is None else episodes.guarded.results
            assert told["predicted_harm"].shape == told["chosen_policy"].shape == (len(rows),)


@Acts
def speechless(worlds, vehicle):
    """Full braking, and nothing that is a number in the second half of each second."""
    return np.where(worlds.time_s % 1.0 > 0.5, np.nan, -worlds.vehicles.braking_capacity_mps2[:, vehicle])


# The policy itself as a later certificate: accepted only if its rollout, followed step by step, keeps the budget.
ROLLED = PAPER.sample(120, 3).worlds


class Weights:
    """A policy of fixed random weights on everything that is observed: it reacts to all, and drives badly."""

    observation = eb.ObservationSpec()

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


@Acts
def two_faced(worlds, vehicle):
    """Coasts when it is asked what it does, and does otherwise where it is tried out in some of its worlds."""
    return np.zeros(worlds.n) if worlds.n == ROLLED.n else eb.LearnedAgent(Weights()).act(worlds, vehicle)


# 14 m are left, 10^2 / (2 * 3.5) = 14.29 m are needed: 2 * 3.5 * 0.2857 = 2 m2/s2
@pytest.mark.parametrize(
    ("proposed", "policy", "why", "plan", "margin"),
    [
        (0.0, None, "no certificate", [-0.7, -0.7], -np.inf),
        (0.0, "constant:3.5", "no certificate", [-0.7, -0.7], -2.0),
        (0.0, "full_brake", "policy rollout", [0.0, -1.0], 0.0),
        (7.0, "full_brake", "policy rollout", [1.0, -1.0], 0.0),  # 10.5 m/s: 11.025 m; from 13.5 m/s it were 18.2 m
    ],
)
def test_rollout__certifies_by_hand_what_plan_and_constants_do_not(proposed, policy, why, plan, margin):
    """10 m/s, 15 m to a vehicle at rest, and a plan (3.5 m/s2: 14.3 m) that coasting would make useless."""
    scenario, worlds = two()
    shield = begun(scenario, worlds)
    held = Backup(np.full_like(shield.memory.backup.plan, -0.7), np.zeros(1), np.zeros(0))
    shield.memory = shield.memory._replace(backup=held)
    proposer = None if policy is None else Proposer({1: eb.make_agent(policy)}, {1: None}, worlds)
    decision = shield.decide(np.full(1, proposed), proposer=proposer)
    assert (reason(decision), decision.applied[0], decision.bound[0]) == (why, plan[0], 0.0)
    assert shield.memory.backup.plan[0, :2].tolist() == plan and decision.margin[0] == pytest.approx(margin)


def driven(policy, **settings):
    """What the guard remembers at the end, each world's harm, and [decisions, n] the reasons and what was applied."""
    told, decide = [], StepShield.decide

    def noted(shield, *arguments, **given):
        decision = decide(shield, *arguments, **given)
        told.append((np.where(given["only"], decision.reason, -1), decision.applied))
        return decision

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StepShield, "decide", noted)
        episodes = drive(ROLLED, ShieldedDriver(policy, PAPER, **settings), PAPER, 1)
    return episodes.guarded, episodes.ledger.world_harm("first"), *map(np.array, zip(*told, strict=True))


@pytest.mark.parametrize("policy", [eb.LearnedAgent(Weights()), Remembering()], ids=["divisible", "remembering"])
def test_rollout__once_accepted_is_what_the_policy_then_does_and_the_bound_is_exact(policy):
    guarded, harm, reasons, _ = driven(policy)
    accepted = reasons == ShieldReason.POLICY_ROLLOUT
    assert accepted.sum() > 3
    later = np.cumsum(accepted, axis=0) - accepted > 0  # after the first accepted rollout of that world
    assert np.isin(reasons[later], [-1, ShieldReason.SAME_AS_PLAN, ShieldReason.ENDED]).all()
    assert harm.tolist() == guarded.shield.bound.tolist()
    assert (harm <= guarded.shield.predicted_harm).all() and not guarded.shield.memory.distrusted.any()


@pytest.mark.parametrize("distrusted", [False, True])
def test_rollout__leaves_the_past_in_the_plan_what_was_applied(distrusted):
    weaker = replace(ROLLED.vehicles, braking_capacity_mps2=0.9 * ROLLED.vehicles.braking_capacity_mps2)
    told = replace(ROLLED, vehicles=weaker) if distrusted else None
    guarded, _, reasons, applied = driven(eb.LearnedAgent(Weights()), logging=True, assumed=told)
    shield, running = guarded.shield, ~np.isin(reasons, [-1, ShieldReason.ENDED])
    assert (shield.memory.distrusted == distrusted).all()
    assert (shield.memory.backup.plan.T[: len(applied)] == applied)[running].all() and running[0].all()
    for entry in shield.log:
        assert entry.plan[: entry.step].tolist() == applied[: entry.step, entry.world].tolist()


def test_rollout__leaves_the_policys_memory_alone():
    guarded, _, reasons, _ = driven(Remembering())
    assert (reasons == ShieldReason.NO_CERTIFICATE).any()
    assert set(guarded.policies[1]["asked"]) == {float(len(reasons))}


def test_rollout__a_policy_that_does_otherwise_when_it_is_tried_out_gets_no_further_than_the_bound():
    guarded, harm, reasons, _ = driven(two_faced)
    assert (reasons == ShieldReason.POLICY_ROLLOUT).any()
    assert harm.tolist() == guarded.shield.bound.tolist() and (harm <= guarded.shield.predicted_harm).all()


# ---------------------------------------------------------------- several shielded vehicles, decided together

PAIR = eb.load_scenario("cooperation-3-pair")


def three(**changes):
    """Vehicle 1 stands; 10 m and 10 m behind it two vehicles come at 5 and 10 m/s that brake with at most 5 m/s2."""
    given = {
        "name": "three", "vehicles": 3, "gaps_m": [10, 10], "speeds_mps": [0, 5, 10], "braking_capacity_mps2": 5,
        "driving_capacity_mps2": 5, "mass_t": [1, 1, 3], "latency_s": 0,
        "roles": {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "learner"},
    }  # fmt: skip
    return eb.Scenario(**{**given, **changes}).sample(1, 0).worlds


def start_pair(worlds, plan):
    running = begin_running(profile_problem(worlds, (1, 2)))
    return running, Backup(plan, plan_harm(running, plan), np.zeros((0, 2)))


def told(decision):
    return [ShieldReason(each).text for each in decision.reason[0]]


def test_by_hand__proposals_that_are_harmless_alone_and_collide_together_go_to_the_front_one():
    # Vehicle 2 may brake sooner than planned, or Vehicle 3 later, but not both: 12 m/s need 14.4 m to stop.
    plan = braking(-1.0, 2)
    plan[0, :4, 0] = 0.0  # coasts 2 m first, then stops after 2.5 m, 0.4 m before Vehicle 1
    running, backup = start_pair(three(gaps_m=[4.9, 12.0], speeds_mps=[0, 5, 12]), plan)
    assert backup.harm.tolist() == [0.0]  # Vehicle 3 stops 12 + 4.5 - 14.4 = 2.1 m behind
    for each in ([[-1.0, -1.0]], [[0.0, 0.4]]):
        assert not certify(running, np.array(each), backup, backup.harm).intervened.any()
    several = np.array([[-1.0, 0.4]])  # 0.65 m sooner, and 1.69 m later
    assert plan_harm(certify(running, several, backup, np.full(1, 1e9)).after, plan)[0] > 0.0
    decision = certify(running, several, backup, backup.harm)
    assert told(decision) == ["plan remains", "no certificate"] and decision.applied[0].tolist() == [-1.0, -1.0]


def test_caps__reject_what_only_moves_harm_to_another_vehicle_also_in_a_later_rollout():
    worlds = three(gaps_m=[3.0, 10.0], speeds_mps=[0, 5, 16])
    running, backup = start_pair(worlds, braking(-1.0, 2))
    assert backup.harm[0] > 0.0  # Vehicle 3 runs into Vehicle 2, which stands before Vehicle 1
    proposed, budget = np.array([[0.0, -1.0]]), backup.harm + 50.0
    assert not certify(running, proposed, backup, budget).intervened.any()
    capped = running._replace(caps=ends_under(running, backup.plan)[1])
    decision = certify(capped, proposed, backup, budget)
    assert decision.intervened.tolist() == [[True, False]] and decision.applied[0, 0] == -1.0
    team = Proposer(dict.fromkeys((1, 2), eb.make_agent("full_brake")), {1: None, 2: None}, worlds)
    for each, refused in ((running, False), (capped, True)):
        found = certify_rollouts(each, proposed, np.arange(1), budget, backup.plan, team)
        assert found.intervened.tolist() == [[refused, refused]] and found.margin.min() > 0.0


def test_one_vehicle_in_a_list__is_the_single_shield_bit_for_bit():
    worlds, rng = PAPER.sample(20, 4).worlds, np.random.default_rng(4)
    single, listed = StepShield(PAPER, 1), StepShield(PAPER, [1])
    for shield in (single, listed):
        shield.begin(worlds, np.arange(20))
    held = single.memory.backup
    backup = Backup(held.plan[:, :, np.newaxis], held.harm, held.constants[:, np.newaxis])
    listed.memory = listed.memory._replace(backup=backup)
    while not single.memory.running.finished.all():
        proposed = rng.uniform(-1.2, 1.2, 20)
        one, other = single.decide(proposed), listed.decide(proposed[:, np.newaxis])
        for name in ("applied", "reason", "margin", "bound"):
            assert getattr(one, name).tolist() == getattr(other, name).reshape(20).tolist()


def test_team__whose_rollout_keeps_the_bound_is_left_alone():
    worlds = PAIR.sample(30, 2).worlds
    without = begun(PAIR, worlds)
    for name in ("full_brake", "constant:5"):
        shield, team = StepShield(PAIR, (1, 2)), {i: eb.make_agent(name) for i in (1, 2)}
        shield.begin(worlds, np.arange(30), team)
        drives = shield.memory.alone_harm <= shield.memory.first_bound
        command = [team[i].act(worlds, i) / worlds.vehicles.braking_capacity_mps2[:, i] for i in (1, 2)]
        assert not shield.decide(np.stack(command, axis=1)).intervened[drives].any() and drives.any()
        assert (shield.memory.first_bound <= without.memory.first_bound).all()


# Behind the interfaces.


def test_parallel__a_team_proposes_where_nobody_does_and_one_may_be_left_out():
    front_alone = {"vehicle_2": eb.make_agent("full_brake"), "vehicle_3": eb.make_agent("coast")}
    brake = eb.make_agent("full_brake")
    for policy, given, proposed in (
        (front_alone, {"vehicle_3": [0.5]}, [-1.0, 0.5]), (brake, {}, [-1.0, -1.0]),
        (eb.Team.of(brake, (1, 2)), {}, [-1.0, -1.0]),
    ):  # fmt: skip
        env = eb.HybridShield(eb.parallel_env("cooperation-3-pair"), policy, mode="step")
        env.reset(seed=1)
        *_, infos = env.step(given)
        assert [infos[agent]["shield_proposed_action"] for agent in env.shielded] == proposed


@pytest.mark.parametrize("settings", [{"shares": True}, {"cap": "baseline"}, {"shares": True, "harm_count": "total"}])
@pytest.mark.parametrize("scenario", ["cooperation-4-all", "paper-random"])
def test_shares__at_the_end_are_what_the_ledger_says(scenario, settings):
    env = eb.HybridShield(eb.parallel_env(scenario), mode="step", **settings)
    differed = 0
    for seed in range(4):
        infos = all_infos(env, {agent: [0.6] for agent in env.shielded}, seed=seed)
        ledger, count = env.unwrapped.engine.ledger, settings.get("harm_count", "first")
        borne = ledger.vehicle_harm(count)[0]
        for agent in env.shielded:
            first, *_, last = told = [reported(each[agent]) for each in infos]
            bounds = [each["bound_harm"] for each in told]  # common to all, and never rising
            assert bounds == [each[env.shielded[0]]["shield_bound_harm"] for each in infos]
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
    team = ShieldedDriver(eb.Team.of(eb.make_agent("coast"), (1, 2)), PAIR, harm_count="total", logging=True)
    for _ in range(2):  # a second batch begins anew
        episodes = drive(worlds, team.on((1, 2)), PAIR)
        ledger, shield = episodes.ledger, episodes.guarded.shield
        whole = drive_shielded(eb.make_agent("coast"), worlds, task)
        assert whole.harm.tolist() == ledger.world_harm("total").tolist() == shield.bound.tolist()
        assert whole.vehicle_harm.tolist() == ledger.vehicle_harm("total").tolist() == shield.shares().tolist()
        assert whole.bound.tolist() == shield.predicted_harm.tolist() and (whole.harm <= whole.bound).all()
        assert whole.baseline.tolist() == shield.memory.baseline_shares.tolist() and not shield.memory.distrusted.any()
    logged = np.zeros((12, 2), np.int64)
    np.add.at(logged, tuple(np.transpose([(entry.world, entry.vehicle - 1) for entry in shield.log])), 1)
    assert whole.replaced.tolist() == logged.tolist() and (logged.sum(axis=0) > 0).all()
    assert (whole.replaced <= whole.decisions[:, np.newaxis]).all()
    monkeypatch.setattr(episodes_module, "CHUNK", 5)
    parts = drive_shielded(eb.make_agent("coast"), worlds, task)
    assert all(np.array_equal(*columns) for columns in zip(whole, parts, strict=True))
    assert Shielded.stack([whole, parts]).replaced.shape == (2, 12, 2)


def test_plan__a_proposal_equal_to_it_costs_nothing_and_changes_nothing() -> None:
    running, backup = start(two(15.0)[1], braking(-0.7))
    decision = certify(running, np.array([-0.7]), backup, backup.harm)
    assert reason(decision) == "same as plan"
    assert not decision.intervened[0]
    assert decision.bound.tolist() == backup.harm.tolist()
    assert decision.margin.tolist() == [0.0]


def test_constant__gives_a_certificate_where_the_plan_gives_none() -> None:
    _, worlds = two(12.0)  # 14.4 m to stop
    plan = braking(-0.96 - 1e-9)  # 15 m to stop: nothing to spare
    running, backup = start(worlds, plan)
    assert backup.harm[0] == 0.0
    decision = certify(running, np.array([-0.9]), backup, backup.harm)
    assert reason(decision) == "constant"
    assert decision.backup.plan[0, 1:].tolist() == [-1.0] * (STEPS - 1)
    without = certify(running, np.array([-0.9]), backup._replace(constants=np.zeros(0)), backup.harm)
    assert without.intervened[0]
    assert without.applied[0] == plan[0, 0]


def test_two_proposals__the_harmless_one_is_accepted_the_other_replaced() -> None:
    # Braking fully they stop after 2.5 m and 10 m; Vehicle 3 then stands 2.5 m behind Vehicle 2.
    running, backup = start_pair(three(gaps_m=[2.6, 10]), braking(-1.0, 2))
    assert backup.harm.tolist() == [0.0]
    # Vehicle 2 has 0.1 m to spare, Vehicle 3 2.5 m: 0.1 s of coasting costs 0.5 m and 1 m.
    decision = certify(running, np.zeros((1, 2)), backup, backup.harm)
    assert decision.applied.tolist() == [[-1.0, 0.0]]
    assert decision.intervened.tolist() == [[True, False]]
    assert told(decision) == ["no certificate", "plan remains"]
    assert decision.bound.tolist() == [0.0]
    assert decision.margin[0, 0] < 0.0 == decision.margin[0, 1]
    assert decision.backup.plan[0, :2].tolist() == [[-1.0, 0.0], [-1.0, -1.0]]


def test_bound__has_at_once_what_one_of_two_makes_better() -> None:
    plan = braking(-1.0, 2)
    plan[0, 0, 1] = -0.5  # Vehicle 3 runs into Vehicle 2, and brakes too little at first
    running, backup = start_pair(three(gaps_m=[2.6, 10], speeds_mps=[0, 5, 11]), plan)
    decision = certify(running, np.array([[1.0, -1.0]]), backup, backup.harm)
    assert decision.intervened.tolist() == [[True, False]]
    assert decision.bound.tolist() == plan_harm(decision.after, decision.backup.plan).tolist()
    assert decision.bound[0] < backup.harm[0] - 1.0


def test_no_number__keeps_the_plan_and_what_is_beyond_is_clipped() -> None:
    running, backup = start_pair(three(), braking(-0.9, 2))
    decision = certify(running, np.array([[np.nan, -7.0]]), backup, backup.harm)
    assert told(decision) == ["not a number", "plan remains"]
    assert decision.applied.tolist() == [[-0.9, -1.0]]
    assert decision.intervened.tolist() == [[True, False]]


def test_surprise__after_the_last_step_replaces_nothing() -> None:
    shield = begun(TWO.replace(horizon_s=0.5), SMALL)  # decisions at 0.35 and 0.45 s
    while not shield.memory.running.finished.all():
        _ = shield.decide(np.ones(4))
    replaced, seen = shield.interventions.tolist(), shield.memory.running.states + 0.1
    decision = shield.decide(np.ones(4), seen=seen, only=np.ones(4, bool))
    assert shield.memory.distrusted.all()
    assert [ShieldReason(each).text for each in decision.reason] == ["ended", "ended", "ended", "ended"]
    assert shield.interventions.tolist() == replaced
    assert shield.memory.running.steps.tolist() == [2, 2, 2, 2]


def test_copy__goes_on_apart_its_log_included() -> None:
    shield = StepShield(PAPER, 1, logging=True)
    shield.begin(PAPER.sample(2, 0).worlds, np.arange(2))
    other = copy.copy(shield)
    other.decide(np.ones(2))
    shield.decide(np.full(2, 0.5))
    assert shield.memory.running.steps.tolist() == [1, 1]
    assert other.memory.running.steps.tolist() == [1, 1]
    assert [entry.proposed for entry in shield.log + other.log] == [0.5, 0.5, 1.0, 1.0]


def test_surprise__of_one_world_hands_the_whole_team_to_the_fallback() -> None:
    scenario = eb.load_scenario(TEAMS[4, 3])
    shield = begun(scenario, scenario.sample(3, 1).worlds)
    seen = shield.memory.running.states.copy()
    seen[1, 1] -= 0.5  # a vehicle is slower than it can be
    decision = shield.decide(np.ones((3, 3)), seen=seen)
    assert shield.memory.distrusted.tolist() == [False, True, False]
    assert [ShieldReason(each).text for each in decision.reason[1]] == [
        "assumption broken",
        "assumption broken",
        "assumption broken",
    ]
    assert decision.intervened[1].all()
    assert (decision.applied[1] <= 0.0).all()


def test_joint_constants__hold_all_alike_and_ladders_each_once() -> None:
    constants = joint_constants(3)
    assert len({tuple(row) for row in constants.tolist()}) == len(constants) == 31
    assert constants.min() == -1.0
    assert constants.max() == 0.0


def test_bound_at_the_alert__is_at_most_full_braking_and_any_single_constant() -> None:
    worlds = PAIR.sample(40, 8).worlds
    joint = begun(PAIR, worlds)
    braked = plan_harm(joint.memory.running, np.full((40, STEPS, 2), -1.0))
    assert (joint.memory.first_bound <= braked).all()
    assert joint.memory.first_bound.mean() < 0.8 * braked.mean()
    for vehicle in (1, 2):
        assert (
            joint.memory.first_bound <= begun(PAIR.with_learners([vehicle]), worlds).memory.first_bound + 1e-6
        ).all()


def test_settles__says_what_the_plan_comes_to_in_the_engine() -> None:
    worlds = PAPER.sample(60, 5).worlds
    scenario = PAPER.replace(horizon_s=4.2)
    shield = StepShield(scenario, 1)
    shield.begin(worlds, np.arange(60))
    episodes = drive(worlds, ShieldedDriver(eb.make_agent("e_v2x_bm"), scenario), scenario, 1)
    rests = (episodes.final.speeds_mps == 0.0).all(axis=1)
    assert rests.tolist() == shield.memory.settles.tolist()
    assert 0 < rests.sum() < 60
