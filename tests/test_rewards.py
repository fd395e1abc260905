"""Reward terms against hand-computed values; shaping as a true difference of potentials."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from ethbrake_marl import rewards as terms
from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.envs.interfaces import make_engine
from ethbrake_marl.errors import InvalidInput, UnknownName, WithoutEffect
from ethbrake_marl.physics import advance, forecast, make_worlds
from ethbrake_marl.rewards import REWARDS, RewardParams, StepOutcome, reward_params
from ethbrake_marl.scenario import load_scenario
from tests.contract.interfaces import CRASH, REST


def sigmoid(x: float) -> float:
    return 1.0 / (1.0 + math.exp(-x))


def outcome(before, after, impacts, safe_end) -> StepOutcome:
    harms = impacts.first_impact_harm.sum(axis=1), impacts.total_harm.sum(axis=1)
    motion = after.gaps_m, after.speeds_mps, after.command_mps2, before.command_mps2
    vehicles, learners = after.vehicles, np.array([1])
    given = vehicles.braking_capacity_mps2, vehicles.driving_capacity_mps2, vehicles.latency_s, vehicles.mass_t
    return StepOutcome(*harms, np.array([safe_end]), *motion, 0.5, after.time_s, *given, learners)


def reward_terms(params: RewardParams, step: StepOutcome):
    """Unweighted terms of one step, each [n, N]; all but shaping."""
    harm = step.first_impact_harm if params.harm_count == "first" else step.total_harm
    shared = params.shared(harm, step.safe_end.astype(np.float64))
    spread = {name: np.repeat(term[:, np.newaxis], step.speeds_mps.shape[1], axis=1) for name, term in shared.items()}
    return spread | step.built_in(params.moving, params)


def step(params: RewardParams, *, safe_end: bool = False):
    """Vehicle 2 strikes Vehicle 1 at 10 m/s (e = 0.5, equal masses); Vehicle 3 falls back."""
    before = make_worlds(
        [[1.0, 5.0]],
        [[10.0, 20.0, 4.0]],
        braking_capacity_mps2=10.0,
        driving_capacity_mps2=10.0,
        latency_s=0.0,
        mass_t=1.0,
        restitution=0.5,
    )
    after, impacts = advance(before, [0.0, 0.0, -2.0], 0.5)
    return after, reward_terms(params, outcome(before, after, impacts, safe_end))


def test_harm__is_shared_by_all_and_negative():
    _, terms = step(RewardParams())
    assert terms.keys() == {"harm"}
    assert terms["harm"].tolist() == [[-100.0, -100.0, -100.0]]


def test_collision__is_weighted_by_k_energy():
    _, terms = step(RewardParams(harm=0.0, collision=1.0, k_energy=0.5))
    assert terms["collision"][0, 0] == -50.0


def test_collision__counts_every_impact_whatever_the_harm_counts():
    facts = {
        "gaps_m": np.ones((2, 2)), "speeds_mps": np.zeros((2, 3)), "command_mps2": np.zeros((2, 3)),
        "previous_mps2": np.zeros((2, 3)), "time_step_s": 0.1, "safe_end": np.zeros(2, np.bool_),
        "first_impact_harm": np.array([100.0, 0.0]), "total_harm": np.array([130.0, 7.0]), "time_s": np.ones(2),
        "learners": np.array([1]),
    }  # fmt: skip
    given = ("braking_capacity_mps2", "driving_capacity_mps2", "latency_s", "mass_t")
    facts |= dict.fromkeys(given, np.ones((2, 3)))
    for count, harm in (("first", [-100.0, 0.0]), ("total", [-130.0, -7.0])):
        terms = reward_terms(
            RewardParams(harm=1.0, harm_count=count, collision=1.0, k_energy=0.5), StepOutcome(**facts)
        )
        assert terms["collision"][:, 0].tolist() == [-65.0, -3.5]
        assert terms["harm"][:, 0].tolist() == harm


def test_risk__ignores_the_time_to_collision_of_opening_pairs():
    # after: gap 1 = 0 + 5 m/s * 0.4 s = 2 m opening; gap 2: 5 + 2 + 0.4 * 12.5 - (2 - 0.25) = 10.25 m opening
    params = RewardParams(harm=0.0, risk=1.0, safety_buffer_m=1.0, target_gap_m=3.0, distance_slope_per_m=0.5)
    after, terms = step(params)
    assert after.gaps_m[0] == pytest.approx([2.0, 10.25])
    first, second = -sigmoid(0.5 * (3.0 - 2.0)), -sigmoid(0.5 * (3.0 - 10.25))
    assert terms["risk"][0] == pytest.approx([first, first + second, second])


def test_risk__of_a_closing_pair_adds_the_time_to_collision():
    params = RewardParams(harm=0.0, risk=1.0, ttc_scale_s=2.0)
    before = make_worlds([7.0], [0.0, 4.0], braking_capacity_mps2=1.0, driving_capacity_mps2=1.0, latency_s=0.0,
                         mass_t=1.0, restitution=0.0)  # fmt: skip
    after, impacts = advance(before, [0.0, 0.0], 0.5)
    terms = reward_terms(params, outcome(before, after, impacts, False))
    assert terms["risk"][0, 1] == pytest.approx(-sigmoid(-((5.0 - 1.0) / 4.0) / 2.0) - sigmoid(3.0 - 5.0))


def test_risk__of_a_pair_that_closes_slowly_has_a_time_to_collision_too():
    params = RewardParams(harm=0.0, risk=1.0, ttc_scale_s=10.0)
    before = make_worlds([7.0], [0.0, 0.5], braking_capacity_mps2=1.0, driving_capacity_mps2=1.0, latency_s=0.0,
                         mass_t=1.0, restitution=0.0)  # fmt: skip
    after, impacts = advance(before, [0.0, 0.0], 2.0)
    terms = reward_terms(params, outcome(before, after, impacts, False))
    assert terms["risk"][0, 1] == pytest.approx(-sigmoid(-((6.0 - 1.0) / 0.5) / 10.0) - sigmoid(3.0 - 6.0))


def test_risk__is_most_urgent_within_the_safety_buffer():
    params = RewardParams(harm=0.0, risk=1.0)
    before = make_worlds([3.0], [0.0, 4.0], braking_capacity_mps2=1.0, driving_capacity_mps2=1.0, latency_s=0.0,
                         mass_t=1.0, restitution=0.0)  # fmt: skip
    after, impacts = advance(before, [0.0, 0.0], 0.625)
    terms = reward_terms(params, outcome(before, after, impacts, False))
    assert after.gaps_m.tolist() == [[0.5]]
    assert terms["risk"][0, 1] == pytest.approx(-0.5 - sigmoid(3.0 - 0.5))


def test_settings__are_those_of_the_page():
    usual = {
        "harm": 1.0, "harm_count": "first", "objective": None, "collision": 0.0, "risk": 0.0, "jerk": 0.0,
        "terminal": 0.0, "shaping": 0.0, "shaping_discount": 1.0, "k_energy": 1.0, "ttc_scale_s": 1.0,
        "safety_buffer_m": 1.0, "target_gap_m": 3.0, "distance_slope_per_m": 1.0,
    }  # fmt: skip
    paper = {"harm": 0.0, "collision": 1.0, "risk": 0.1, "jerk": 1e-5, "terminal": 10.0}
    assert {name: reward.model_dump() for name, reward in REWARDS.items()} == {
        "harm": usual,
        "total-harm": usual | {"harm_count": "total"},
        "paper": usual | paper,
    }


def test_jerk__is_the_squared_rate_of_the_own_command():
    _, terms = step(RewardParams(harm=0.0, jerk=1.0))
    assert terms["jerk"].tolist() == [[0.0, 0.0, -16.0]]


def test_terminal__only_at_a_safe_end():
    params = RewardParams(harm=0.0, terminal=3.0)
    assert step(params)[1]["terminal"].tolist() == [[0.0] * 3]
    _, terms = step(params, safe_end=True)
    assert params.weighted_sum(terms, (1, 3)).tolist() == [[3.0] * 3]


def test_paper__has_its_four_terms():
    _, terms = step(reward_params("paper"))
    assert terms.keys() == {"collision", "risk", "jerk", "terminal"}


@pytest.mark.parametrize(("action", "safe"), [(0.0, False), (-1.0, True)])
def test_terminal__is_paid_at_the_horizon_too_and_once(action, safe):
    engine = make_engine(CRASH, 1, reward=RewardParams(harm=0.0, terminal=3.0))  # both are cut off in their 8th step
    results = [engine.step(np.full((1, 1), action)) for _ in range(9)]
    assert [bool(result.truncated[0]) for result in results] == [k == 7 for k in range(9)]
    assert [result.reward[0].tolist() for result in results] == [[3.0 * (safe and k == 7)] * 2 for k in range(9)]
    assert [result.shared["terminal"][0] for result in results] == [float(safe and k == 7) for k in range(9)]


def test_terminal__is_paid_at_rest_too():
    engine = make_engine(REST, 1, reward=RewardParams(harm=0.0, terminal=3.0))
    rewards = [engine.step(np.full((1, 1), -1.0)).reward[0].tolist() for _ in range(10)]
    assert rewards == [[0.0, 0.0]] * 9 + [[3.0, 3.0]]


@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_shaping__sums_to_minus_the_first_potential_whatever_is_done(discount):
    scenario = load_scenario("paper-random")
    reward = RewardParams(harm=0.0, shaping=1.0, shaping_discount=discount)
    scripts = {0: make_agent("full_brake"), 2: make_agent("full_brake")}
    engine = Engine(scenario, 50, learners=(1,), scripts=scripts, reward=reward)
    command = -engine.worlds.vehicles.braking_capacity_mps2
    candidates = command[:, 1:2] * np.linspace(0.0, 1.0, 9)
    least = forecast(engine.worlds, command, 1, candidates, scenario.horizon_s)[0].min(axis=1)
    rng = np.random.default_rng(5)
    total, factor = np.zeros(50), 1.0
    while not engine.ended.all():
        result = engine.step(rng.uniform(-1.0, 0.0, (50, 1)))
        total += factor * result.reward[:, 1]
        factor *= discount
        assert (result.reward[:, [0, 2]] == 0.0).all()
    assert (least > 0).sum() > 20
    assert total == pytest.approx(least, abs=1e-9)


def test_shaping__of_an_episode_after_autoreset_begins_with_the_potential_of_its_own_world():
    scenario = load_scenario("paper-random")
    reward = RewardParams(harm=0.0, shaping=1.0)
    scripts = {0: make_agent("full_brake"), 2: make_agent("full_brake")}
    engine = Engine(scenario, 6, learners=(1,), scripts=scripts, reward=reward)
    rng = np.random.default_rng(5)
    begun, gained, compared = reward.potential(engine.worlds, (1,), scenario.horizon_s), np.zeros(6), 0
    while compared < 30:
        result = engine.step(rng.uniform(-1.0, 0.0, (6, 1)))
        gained += result.reward[:, 1]
        rows = np.flatnonzero(result.ended)
        assert gained[rows] == pytest.approx(-begun[rows], abs=1e-9)
        engine.renew(rows)
        compared += (begun[rows] < 0.0).sum()
        begun[rows] = reward.potential(engine.worlds, (1,), scenario.horizon_s)[rows]
        gained[rows] = 0.0


def test_potential__of_two_learners_lets_each_choose_given_the_other():
    worlds = load_scenario("cooperation-3-pair").sample(30, seed=3).worlds
    braking = worlds.vehicles.braking_capacity_mps2
    shares = np.linspace(0.0, 1.0, 9)
    alone, pair = (-RewardParams().potential(worlds, learners, 8.0) for learners in ((1,), (0, 1)))
    every = np.empty((worlds.n, 9))  # least harm by Vehicle 2, for each choice of Vehicle 1
    for c, share in enumerate(shares):
        command = -braking.copy()
        command[:, 0] *= share
        every[:, c] = forecast(worlds, command, 1, -braking[:, 1:2] * shares, 8.0)[0].min(axis=1)
    assert (every.min(axis=1) <= pair).all() and (pair <= alone).all()
    assert (alone > 1.0).sum() > 10
    assert pair.mean() < 0.1 * alone.mean()  # Vehicle 1 simply does not brake


def potential_in_rounds(worlds, rounds: int) -> np.ndarray:
    """Of learners 0 and 1, who choose one after the other, this often."""
    braking = worlds.vehicles.braking_capacity_mps2
    command, best = -braking.copy(), np.empty(worlds.n)
    for _ in range(rounds):
        for vehicle in (0, 1):
            harms = []
            for share in range(9):
                tried = command.copy()
                tried[:, vehicle] = -braking[:, vehicle] * (share / 8.0)
                harms.append(forecast(worlds, tried, vehicle, tried[:, [vehicle]], 8.0)[0][:, 0])
            choice = np.array(harms).argmin(axis=0)
            command[:, vehicle] = -braking[:, vehicle] * (choice / 8.0)
            best = np.array(harms).min(axis=0)
    return -best


@pytest.mark.parametrize(("learners", "asked"), [((1,), [1]), ((1, 2), [1, 2, 1, 2])])
def test_potential__asks_one_learner_once_and_several_twice(learners, asked, monkeypatch):
    told = []

    def watched(worlds, command, vehicle, candidates, horizon_s):
        told.append(vehicle)
        return forecast(worlds, command, vehicle, candidates, horizon_s)

    monkeypatch.setattr(terms, "forecast", watched)
    RewardParams().potential(load_scenario("paper-random").sample(2, seed=3).worlds, learners, 8.0)
    assert told == asked


def test_potential__of_two_learners_goes_twice_round():
    worlds = load_scenario("cooperation-3-pair").sample(300, seed=3).worlds
    found = RewardParams().potential(worlds, (0, 1), 8.0)
    assert found == pytest.approx(potential_in_rounds(worlds, 2), abs=1e-12)
    assert (potential_in_rounds(worlds, 1) < found - 1.0).any()


def test_bad_input__is_refused():
    with pytest.raises(UnknownName, match="did you mean 'paper'"):
        reward_params("papr")
    for bad in ({"harm": -1.0}, {"harm": math.nan}, {"ham": 1.0}, {"harm_count": "all"}, {"shaping_discount": 1.5}):
        with pytest.raises(ValidationError):
            RewardParams(**bad)


def test_reward__may_be_given_as_settings():
    assert reward_params({"harm": 2, "jerk": 0.5}) == RewardParams(harm=2.0, jerk=0.5)


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (5, "reward = 5: must be a name"),
        (None, "reward = None: must be a name"),
        ({"hram": 1.0}, "unknown setting of a reward 'hram'; did you mean 'harm'"),
        ({"jerk": -1.0}, "reward: jerk = -1.0: must be greater than or equal to 0"),
        ({"jerk": "a"}, "reward: jerk = 'a': must be a number"),
        ({"shaping": 1.0}, "reward: harm: is left out, and would weigh 1 beside shaping; say harm: 1, or 0 for none"),
        ({"harm": 0.0, "objective": "own"}, "reward: objective: changes the term harm alone, whose weight is 0"),
    ],
)
def test_reward__that_cannot_be_one_is_refused_in_one_line(reward, message):
    with pytest.raises(InvalidInput, match=message) as caught:
        reward_params(reward)
    assert "\n" not in str(caught.value)


def test_reward__without_harm_says_that_the_scenarios_objective_changes_nothing():
    own = load_scenario("cooperation-3-pair").replace(objective="own")
    with pytest.warns(WithoutEffect, match="the scenario's objective, own, changes nothing"):
        paid = make_engine(own, 2, reward="paper", seed=1)
    assert paid.reward.objective is None
    make_engine(own, 2, reward={"harm": 1.0, "risk": 0.1}, seed=1)
