"""The step shield in the engine: bounds hold, nothing fails silently, every intervention is written down."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.e_v2x_bm import optimise_coupled
from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.figures import operating_figure
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.scenario.schema import Task
from ethbrake_marl.shield import HybridAgent, ShieldedDriver, StepShield, parse_uncertainty
from ethbrake_marl.shield.evidence import operating_curves, review
from ethbrake_marl.shield.step_shield import REASONS
from tests.failing_worlds import plant, without
from tests.shield.attacks import ADVERSARIES, attack, line

pytestmark = pytest.mark.filterwarnings("ignore::ethbrake_marl.shield.MovingAtHorizon")

SCENARIO = load_scenario("paper-random")
TASK = Task(SCENARIO, (1,))
WORLDS = SCENARIO.sample(60, 3).worlds


class Wavering:
    """A bad driver that is not constant."""

    name = "wavering"

    def act(self, worlds, vehicle):
        wave = np.sin(17.0 * worlds.time_s + worlds.gaps_m[:, 0])
        return np.where(wave > 0.0, 0.0, wave * worlds.vehicles.braking_capacity_mps2[:, vehicle])


def shield_of(driver, worlds=WORLDS, scenario=SCENARIO):
    """The shield as it is when the episodes behind it have ended."""
    return drive(worlds, driver, scenario, 1).guarded.shield


@pytest.mark.parametrize("name", ADVERSARIES)
@pytest.mark.parametrize(("N", "harm_count"), [(3, "first"), (5, "total")])
def test_falsification__no_adversary_gets_above_the_bound(name, N, harm_count):
    scenario = line(N)
    found = attack(scenario, scenario.sample(24, 11).worlds, ADVERSARIES[name], harm_count=harm_count)
    assert (found.realised <= found.bound).all()
    assert found.realised.tolist() == found.last_bound.tolist()


def test_falsification__comes_within_one_percent_of_the_bound_by_accepted_actions():
    scenario = line(3)
    found = attack(scenario, scenario.sample(60, 12).worlds, ADVERSARIES["worst_case"])
    tried = (found.bound > 1.0) & (found.accepted > 0)
    assert (found.realised[tried] > 0.99 * found.bound[tried]).any()


def test_first_bound__is_what_the_coupled_optimum_realises():
    shield = StepShield(SCENARIO, 1)
    shield.begin(WORLDS, np.arange(WORLDS.n))
    optimum = optimise_coupled(WORLDS, 1, horizon_s=SCENARIO.horizon_s)
    assert shield.first_bound == pytest.approx(optimum.harm, abs=1e-6)


@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_agent__is_never_worse_than_the_episode_mode_nor_than_its_prediction(harm_count):
    driven, alone = (
        drive(WORLDS, kind(Wavering(), SCENARIO, harm_count=harm_count), SCENARIO, 1)
        for kind in (ShieldedDriver, HybridAgent)
    )
    harm, hybrid = (episodes.ledger.world_harm(harm_count) for episodes in (driven, alone))
    shield = driven.guarded.shield
    assert (harm <= shield.predicted_harm).all()
    assert (harm <= hybrid + 1e-9).all()
    assert harm.mean() < hybrid.mean() - 0.2
    assert harm.tolist() == shield.bound.tolist()
    assert not shield.distrusted.any()


def test_agent__a_policy_that_keeps_the_bound_is_left_alone():
    shield = shield_of(ShieldedDriver(make_agent("e_v2x_bm"), SCENARIO))
    fine = shield.alone_harm <= shield.first_bound
    assert fine.mean() > 0.9 and shield.chosen_policy[fine].all()


def test_agent__a_worlds_outcome_does_not_depend_on_its_batch():
    whole = drive(WORLDS, ShieldedDriver(Wavering(), SCENARIO), SCENARIO, 1).ledger.world_harm("first")
    for k in (0, 7, 50):
        alone = drive(WORLDS.take([k]), ShieldedDriver(Wavering(), SCENARIO), SCENARIO, 1).ledger.world_harm("first")
        assert alone.tolist() == [whole[k]]


def test_begin__of_some_rows_leaves_the_others_alone():
    shield = StepShield(SCENARIO, 1)
    shield.begin(WORLDS.take(np.arange(5)), np.arange(5))
    shield.decide(np.zeros(5))
    before = shield.bound.copy(), shield.running.steps.copy()
    shield.begin(WORLDS.take([9]), np.array([2]))
    assert shield.running.steps.tolist() == [1, 1, 0, 1, 1]
    assert np.delete(shield.bound, 2).tolist() == np.delete(before[0], 2).tolist()


def test_allowance__keeps_what_it_grants_and_no_more():
    scenario = line(3)
    worlds = scenario.sample(60, 13).worlds
    strict, loose = (attack(scenario, worlds, ADVERSARIES["slow_drift"], allowance=a) for a in (0.0, 30.0))
    assert (loose.realised <= loose.bound + 30.0 + 1e-9).all()
    assert loose.realised.mean() > strict.realised.mean() + 1.0
    with pytest.raises(InvalidInput, match="allowance"):
        StepShield(SCENARIO, 1, allowance=-1.0)


def seen_of(shield, rows=None):
    return shield.running.states[:, :7].copy()  # 3 speeds, 2 gaps, 2 hit flags


@pytest.mark.parametrize("what", ["brakes harder", "not a number", "no message"])
def test_surprise__is_flagged_and_falls_back_for_the_rest_of_that_episode_alone(what):
    shield = StepShield(SCENARIO, 1)
    shield.begin(WORLDS.take(np.arange(4)), np.arange(4))
    stale = seen_of(shield)
    shield.decide(np.full(4, -0.5), seen=stale)
    seen = seen_of(shield)
    assert not shield.distrusted.any()
    if what == "brakes harder":
        seen[1, 0] -= 0.3
    elif what == "not a number":
        seen[1, 4] = np.nan
    else:
        seen[1] = stale[1]
    for _ in range(3):
        decision = shield.decide(np.ones(4), seen=seen)
        assert shield.distrusted.tolist() == [False, True, False, False]
        assert REASONS[decision.reason[1]] == "assumption broken" and decision.intervened[1]
        assert decision.applied[1] <= 0.0 and np.isfinite(decision.applied).all() and np.isfinite(shield.bound).all()
        seen = seen_of(shield)
    shield.begin(WORLDS.take([5]), np.array([1]))
    assert not shield.distrusted.any()


def test_log__holds_every_intervention_and_forensics_says_what_it_was_good_for():
    shield = shield_of(ShieldedDriver(make_agent("coast"), SCENARIO, logging=True))
    log = shield.log
    assert len(log) == shield.interventions.sum() > 0
    assert all(entry.margin < 0.0 and entry.proposed == 0.0 != entry.applied for entry in log)
    found = review(shield, make_agent("coast"), WORLDS)
    assert found.without.shape == (len(log),)
    assert found.share("needed") > 0.8
    assert found.share("needed") + found.share("harmless") + found.share("costly") == pytest.approx(1.0)
    first = {entry.world: k for k, entry in reversed(list(enumerate(log)))}  # each world's first intervention
    alone = drive(WORLDS, make_agent("coast"), SCENARIO, 1).ledger.world_harm("first")
    assert all(found.without[k] == alone[world] for world, k in first.items())


@pytest.mark.parametrize("mode", ["distrusted", "robust"])
def test_review__tells_the_harm_of_the_engine_also_where_the_bound_is_not_it(mode):
    worlds = WORLDS.take(np.arange(40))
    other = parse_uncertainty("braking_capacity_mps2=20%").draw(worlds, np.random.default_rng(0))
    settings = {"told": other} if mode == "distrusted" else {"uncertainty": "gaps_m=0.5"}
    episodes = drive(worlds, ShieldedDriver(Wavering(), SCENARIO, logging=True, **settings), SCENARIO, 1)
    harm, shield = episodes.ledger.world_harm("first"), episodes.guarded.shield
    assert abs(shield.bound - harm).max() > 1.0
    found = review(shield, Wavering(), worlds)
    assert found.realised.tolist() == harm[found.world].tolist()
    assert found.trusted.tolist() == (~shield.distrusted[found.world]).tolist()
    assert found.trusted.all() == (mode == "robust")


def test_review__is_of_the_last_batch_and_of_its_worlds_alone():
    smaller, driver = WORLDS.take(np.arange(30, 50)), ShieldedDriver(Wavering(), SCENARIO, logging=True)
    shield_of(driver)
    again, fresh = shield_of(driver, smaller), shield_of(ShieldedDriver(Wavering(), SCENARIO, logging=True), smaller)
    for told, expected in zip(review(again, Wavering(), smaller), review(fresh, Wavering(), smaller), strict=True):
        assert told.tolist() == expected.tolist()
    with pytest.raises(InvalidInput, match="60 worlds, but 20 were driven last"):
        review(again, Wavering(), WORLDS)


@pytest.mark.parametrize("agent", [ShieldedDriver, HybridAgent])
@pytest.mark.parametrize("sizes", [(20, 10), (1, 20)])
def test_agent__drives_a_batch_of_another_size_as_a_fresh_one_does(agent, sizes):
    used = agent(make_agent("constant:3"), SCENARIO)
    for n in sizes:
        worlds, fresh = WORLDS.take(np.arange(n)), agent(make_agent("constant:3"), SCENARIO)
        driven = [drive(worlds, each, SCENARIO, 1) for each in (used, fresh)]
        harms = [episodes.ledger.world_harm("first").tolist() for episodes in driven]
        assert harms[0] == harms[1]
        told = [each.memories[1] if each.guarded is None else each.guarded.told for each in driven]
        for name in ("predicted_harm", "chosen_policy"):
            assert told[0][name].tolist() == told[1][name].tolist()


def test_begin__of_a_row_that_is_not_there_is_refused():
    shield = StepShield(SCENARIO, 1)
    shield.begin(WORLDS.take(np.arange(5)), np.arange(5))
    with pytest.raises(InvalidInput, match="begin in row 7 of a batch of 5"):
        shield.begin(WORLDS.take([0, 1]), np.array([3, 7]))


class Speechless:
    """Full braking, and nothing that is a number in the second half of each second."""

    name = "speechless"

    def act(self, worlds, vehicle):
        braking = -worlds.vehicles.braking_capacity_mps2[:, vehicle]
        return np.where(worlds.time_s % 1.0 > 0.5, np.nan, braking)


@pytest.mark.parametrize("capacity", [0.0, 5.0])
def test_agent__what_is_no_number_is_replaced_and_told(capacity):
    scenario = SCENARIO.replace(driving_capacity_mps2=capacity)
    worlds = scenario.sample(20, 3).worlds
    episodes = drive(worlds, ShieldedDriver(Speechless(), scenario, logging=True), scenario, 1)
    harm, shield = episodes.ledger.world_harm("first"), episodes.guarded.shield
    assert harm.tolist() == shield.bound.tolist() and (harm <= shield.predicted_harm).all()
    silent = [entry for entry in shield.log if REASONS[entry.reason] == "not a number"]
    assert len({entry.world for entry in silent}) == 20 and all(np.isnan(entry.proposed) for entry in silent)


def test_operating_curve__fewer_interventions_cost_harm():
    worlds = WORLDS.take(np.arange(60))
    done = []
    points = operating_curves(worlds, {"coast": make_agent("coast")}, TASK, [0.0, 20.0, 1e6], on_progress=done.append)[
        "coast"
    ]
    assert done == ["coast"]
    rates, harms = [p.intervention_rate for p in points], [p.harm for p in points]
    assert rates == sorted(rates, reverse=True) and rates[-1] == 0.0
    assert harms == sorted(harms) and harms[0] < harms[-1]
    figure = operating_figure([("coast", points)])
    (line_drawn,) = figure.axes[0].get_lines()
    assert line_drawn.get_xdata().tolist() == rates
    with pytest.raises(InvalidInput, match="at least one point"):
        operating_figure([])


def test_operating_curve__leaves_worlds_out_that_cannot_be_advanced_and_names_them():
    agents = {"coast": make_agent("coast"), "brake": make_agent("full_brake")}
    found = operating_curves(plant(WORLDS.take(np.arange(9)), [2, 6]), agents, TASK, [0.0, 20.0])
    rest = operating_curves(WORLDS.take(without(9, [2, 6])), agents, TASK, [0.0, 20.0])
    for name in agents:
        assert [[world for world, _ in point.left_out] for point in found[name]] == [[2, 6]] * 2
        assert [point[:-1] for point in found[name]] == [point[:-1] for point in rest[name]]
        assert rest[name][0].left_out == ()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: ShieldedDriver(make_agent("coast"), "paper-random"), "scenario = 'paper-random': must be a Scenario"),
        (lambda: HybridAgent(make_agent("coast"), "paper-random"), "scenario = 'paper-random': must be a Scenario"),
        (lambda: ShieldedDriver(make_agent("coast"), SCENARIO, told=3), "told = 3: must be worlds"),
        (lambda: ShieldedDriver(make_agent("coast"), SCENARIO, mode="episode"), "HybridAgent is that of mode episode"),
        (lambda: StepShield(SCENARIO, 9), "vehicle = 9: must be an index from 0 to 2"),
        (lambda: StepShield(SCENARIO, 1, allowance="1"), "allowance = '1': must be a number, at least 0"),
        (lambda: StepShield(SCENARIO, 1).decide(np.zeros(3)), "no episode has begun"),
    ],
)
def test_refused__what_does_not_fit(wrong, message):
    with pytest.raises(InvalidInput, match=message):
        wrong()


def test_refused__worlds_and_proposals_of_another_number():
    step = ShieldedDriver(make_agent("coast"), SCENARIO, told=WORLDS.take([0, 1]))
    with pytest.raises(InvalidInput, match="told of 2 worlds, but row 2 begins"):
        drive(WORLDS.take([0, 1, 2]), step, SCENARIO, 1)
    shield = StepShield(SCENARIO, 1)
    shield.begin(WORLDS.take([0, 1]), np.arange(2))
    with pytest.raises(InvalidInput, match=r"proposed \(3,\); \(2,\) is needed"):
        shield.decide(np.zeros(3))


def test_review__without_a_log_is_refused():
    coast = make_agent("coast")
    shield = shield_of(ShieldedDriver(coast, SCENARIO), WORLDS.take([0]))
    with pytest.raises(InvalidInput, match="logging=True"):
        review(shield, coast, WORLDS.take([0]))
