"""Counts: what the honest one adds to harm by hand, and what holds for all of them in random worlds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import make_agent, open_game
from ethbrake_marl.episode.counts import COUNTED_ROWS, COUNTS, EXACT_IMPACTS, HONEST, HarmCount, pair_amounts
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.hold import hold
from ethbrake_marl.episode.objectives import amounts, objectives_of
from ethbrake_marl.episode.play import follow_plans, price
from ethbrake_marl.episode.reward import RewardParams, reward_params
from ethbrake_marl.episode.state import State
from ethbrake_marl.evaluation.evaluate import evaluate
from ethbrake_marl.motion.layout import ANSWERED, BRAKING, DRIVING, DROVE, MOVING, PUSHED, SHARED
from ethbrake_marl.shields.step import StepShield
from tests.contract.interfaces import CRASH, REST
from tests.episode.lines import later, state_of
from tests.refused import refused

near = pytest.approx
N = 12
SCENARIOS = ["paper-random", "paper-random-obstacle", "paper-random-buildup", "cooperation-4-all"]

# ---------------------------------------------------------------- by hand


def test_honest__is_total_harm_and_the_price_of_push_driving_and_motion_at_the_horizon() -> None:
    # Coasting, Vehicle 2 hits with 6 m/s at 1 s: 18.5 m/s in common. Vehicle 1 of 1 t brakes with 6 m/s2 against the
    # 3 t behind it for 0.3 s: a push of 1.8 m/s, and 18.5 - 0.3 x 1.5 = 18.05 m/s of both at the horizon.
    # Of the impact Vehicle 1 bears 3/4; Vehicle 2 bears the price of its push, each that of its own motion.
    scenario = CRASH.replace(obstacle_gap_m=1000)
    _, game = open_game(scenario, learners=["vehicle_1", "vehicle_2"], reward="honest", reward_vector="vehicles")
    state, counted, borne = game.reset(game.draw(1, 0, 0)), 0.0, np.zeros(2)
    while not state.ended[0]:
        assert not state.line[:, MOVING].any()
        state, step = game.step(state, np.array([[-1.0, 0.0]]))
        counted += step.cost[0]
        assert step.vector is not None
        borne -= step.vector[0, 0]
        assert step.reward[0].tolist() == [-step.cost[0]] * 2
    assert state.line[0, PUSHED].tolist() == near([0.0, 1.8, 0.0])
    assert state.line[0, MOVING].tolist() == near([18.05**2, 18.05**2, 0.0])
    assert (state.harm("first"), state.harm("total")) == (near([36.0]), near([36.0]))
    assert counted == near(36.0 + 10 * 1.8 + 2 * 18.05**2)
    assert state.harm("honest").tolist() == near([counted])
    expected = [0.75 * 36.0 + 18.05**2, 0.25 * 36.0 + 10 * 1.8 + 18.05**2]
    assert state.borne_harm("honest")[0].tolist() == near(expected) and borne.tolist() == near(expected)
    assert amounts(objectives_of("own", 2), None, state, HONEST)[0].tolist() == near(expected)


@pytest.mark.parametrize(("scripts", "moving"), [
    ({1: "coast"}, [0.0, 12.0**2 - 10.0**2, 0.0]),  # Vehicle 3 is slower than the script ahead
    ({}, [10.0**2, 12.0**2, 9.0**2]),
    ({2: "coast"}, [10.0**2, 0.0, 0.0]),
    ({1: "full_brake"}, [0.0, 12.0**2 - 2.2**2, 9.0**2 - 2.2**2]),  # with 6 m/s2 for 1.3 s
    ({1: "coast", 2: "coast", 3: "coast"}, [0.0] * 3),
    ({3: "coast"}, [10.0**2, 12.0**2, 0.0]),
    ({2: "full_brake"}, [10.0**2, 0.0, 9.0**2 - 4.2**2]),
])  # fmt: skip
def test_motion_at_the_horizon__costs_what_no_script_commands(scripts: dict[int, str], moving: list[float]) -> None:
    roles = {f"vehicle_{i}": scripts.get(i, "learner") for i in (1, 2, 3)}
    scenario = eb.Scenario(
        name="apart", vehicles=3, gaps_m=50, speeds_mps=[10, 12, 9], braking_capacity_mps2=6, driving_capacity_mps2=6,
        mass_t=1, latency_s=0, horizon_s=1.3, roles=roles, obstacle_gap_m=1000,
    )  # fmt: skip
    _, game = open_game(scenario)
    state = game.reset(scenario.sample(1, seed=7))
    coasting = np.zeros((1, 1, 3 - len(scripts)))
    last, cost = follow_plans(game, state, coasting, HONEST)
    assert last.line[0, MOVING].tolist() == near([*moving, 0.0]) and cost.tolist() == near([sum(moving)])
    assert last.departures == {"obstacle"}


def ended(plan: Any, **settings: Any) -> State:
    """The last state of one world in which the learners' actions are ``plan`` [T, L]; the last ones repeat."""
    scenario = eb.Scenario(
        name="end", **{
            "vehicles": 3, "gaps_m": 10, "speeds_mps": 20, "braking_capacity_mps2": 6, "driving_capacity_mps2": 6,
            "mass_t": 5, "latency_s": 0, "restitution": 0.0, "early_impacts": "keep", **settings,
        }
    )  # fmt: skip
    _, game = open_game(scenario)
    return follow_plans(game, game.reset(scenario.sample(1, seed=7)), np.array([plan]), HONEST)[0]


def test_motion_at_the_horizon__is_free_only_as_a_script_commands_it() -> None:
    # Vehicle 1 stands; Vehicle 2, eight times as heavy, coasts at 9 m/s and strikes it after 1 s: 8 m/s in common.
    struck = {"vehicles": 2, "gaps_m": 9, "speeds_mps": [0, 9], "mass_t": [1, 8], "horizon_s": 1.0001}
    last = ended([[0.0]], roles={"vehicle_1": "full_brake", "vehicle_2": "learner"}, **struck)
    assert last.line[0, MOVING, :2].tolist() == near([64.0, 64.0], rel=1e-3)
    # A script that coasts at 4 m/s is thrown to 9: 4 of it is its own, also for the one behind, which has 7.
    struck |= {"gaps_m": 6, "speeds_mps": [4, 10], "mass_t": [1, 5], "horizon_s": 1.0001}
    last = ended([[0.0]], roles={"vehicle_1": "coast", "vehicle_2": "learner"}, **struck)
    assert last.line[0, MOVING, :2].tolist() == near([9.0**2 - 4.0**2] * 2, rel=1e-3)
    # Vehicle 2 pushes Vehicle 1, which brakes fully: its brakes alone would have stopped it after 10 / 6 s.
    pushed = {"vehicles": 2, "gaps_m": 0, "speeds_mps": 10, "driving_capacity_mps2": 8, "horizon_s": 2}
    last = ended([[1.0]], roles={"vehicle_1": "full_brake", "vehicle_2": "learner"}, **pushed)
    assert last.line[0, MOVING, :2].tolist() == near([12.0**2] * 2)
    # after 1 s, 4 of 11 m/s is commanded
    last = ended([[1.0]], roles={"vehicle_1": "full_brake", "vehicle_2": "learner"}, **pushed | {"horizon_s": 1})
    assert last.line[0, MOVING, :2].tolist() == near([11.0**2 - 4.0**2] * 2)


def test_motion_at_the_horizon__has_the_discount_of_the_nearest_vehicle_ahead() -> None:
    # Vehicle 1 coasts on at 20 m/s. Vehicle 2 brakes to rest, and Vehicle 3 comes at 20 m/s.
    roles = {"vehicle_1": "coast", "vehicle_2": "learner", "vehicle_3": "learner"}
    last = ended([[-1.0, 0.0]], roles=roles, gaps_m=[10, 90], horizon_s=4)
    assert last.line[0, MOVING].tolist() == near([0.0, 0.0, 400.0, 0.0])
    last = ended([[-1.0, 0.0]], roles=roles, gaps_m=[10, 90], horizon_s=2)  # Vehicle 2 still has 8 m/s
    assert last.line[0, MOVING].tolist() == near([0.0, 0.0, 400.0 - 64.0, 0.0])
    behind = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "coast"}
    last = ended([[-1.0]], roles=behind, gaps_m=[10, 90], horizon_s=4)  # commanded, whatever it meets
    assert not last.line[0, MOVING].any()


def test_honest__adds_nothing_to_a_line_that_brakes_to_rest_and_prices_driving_there() -> None:
    _, game = open_game(REST)
    alert = game.reset(game.draw(1, 0, 0))
    last, cost = follow_plans(game, alert, np.full((1, 1, 1), -1.0), HONEST)
    assert last.at_rest.tolist() == [True] and cost.tolist() == [0.0] and not last.line[:, MOVING].any()
    last, cost = follow_plans(game, alert, np.array([[[0.5], [0.5], [-1.0]]]), HONEST)  # 3 m/s2 for 0.2 s
    assert last.harm("total").tolist() == [0.0] and cost.tolist() == near([10 * 0.6])
    assert last.borne_harm("honest")[0].tolist() == [0.0, cost[0]]


def test_push__of_a_pressed_pair_costs_10_m2_s2_for_each_m_per_s() -> None:
    pressed = later(state_of([0.0], [0.0, 0.0], obstacle_gap_m=0.0), [3.0, 2.0], 0.5)  # 3 and 2 m/s2, for 0.5 s
    assert pressed.line[0, PUSHED].tolist() == near([1.5, 1.0, 0.0]) and not pressed.harm("total").any()
    driving = 0.5 * (3.0 + 2.0)  # an obstacle that is touched without an impact is no impact
    assert pressed.harm("honest") == near([10 * (1.5 + 1.0) + 10 * driving])


def test_amounts__of_pairs_and_worlds_have_the_weights_of_the_count() -> None:
    state = state_of([5.0, 5.0], [1.0, 1.0, 1.0])
    state.line[0, COUNTED_ROWS] = np.arange(1.0, 7.0)[:, np.newaxis] * [1.0, 10.0, 100.0, 0.0]
    for count, weight in (("first", 1.0), ("total", 2.0), ("honest", 2.0 + 3.0 + 40.0 + 50.0 + 6.0)):
        assert pair_amounts(state.line, COUNTS[count])[0, 0].tolist() == [weight, 10.0 * weight, 100.0 * weight, 0.0]
        assert state.harm(count).tolist() == [111.0 * weight]
        assert state.pair_harm(count).tolist() == [[10.0 * weight, 100.0 * weight]]
    own = HarmCount("own", np.array([0.5, 0.0, 0.0, 0.0, 2.0, 0.0]), "own_cost", "own cost", (EXACT_IMPACTS,))
    assert state.harm(own).tolist() == [111.0 * 10.5] and state.harm() == state.harm(HONEST) == state.harm("honest")


# ---------------------------------------------------------------- in random worlds


def opened(name: str, count: str, horizon_s: float = 8.0) -> tuple[Game, State]:
    scenario = eb.load_scenario(name).replace(horizon_s=horizon_s)
    _, game = open_game(scenario, reward={"harm": 1.0, "harm_count": count})
    return game, game.reset(game.draw(N, 5, 0))


def random_plans(game: Game, state: State, seed: int) -> np.ndarray:
    """Plans [n, T, L] that often drive, and brake at the end, so that every row of a count is met."""
    rng, steps = np.random.default_rng(seed), 30
    shape = state.n, steps, len(game.settings.learners)
    plans = np.where(rng.random(shape) < 0.3, 1.0, rng.uniform(-1.0, 1.0, shape))
    plans[:, -1] = np.where(rng.random((state.n, 1)) < 0.7, -1.0, 1.0)
    return plans


@pytest.mark.parametrize("name", SCENARIOS)
def test_counts__are_ordered_never_fall_and_are_the_sum_of_what_steps_count(name: str) -> None:
    stops = name in ("paper-random-obstacle", "cooperation-4-all")
    for count in COUNTS:
        game, state = opened(name, count, 8.0 if stops else 2.0)
        plans, counted = random_plans(game, state, 1), state.harm(count)
        while not state.ended.all():
            before = {each: state.harm(each) for each in COUNTS}
            now = np.minimum(state.steps, plans.shape[1] - 1)
            state, step = game.step(state, plans[np.arange(N), now])
            counted = counted + step.cost
            for each in COUNTS:
                assert (state.harm(each) >= before[each]).all()
            assert (state.harm("honest") >= state.harm("total")).all()
            assert (state.harm("total") >= state.harm("first")).all()
        assert counted == near(state.harm(count), rel=1e-12, abs=1e-9)
        met = (state.line[:, [PUSHED, DROVE, MOVING]] > 0.0).any(axis=(0, 2)).tolist()
        assert met == [True, True, not stops]


@pytest.mark.parametrize("name", [*SCENARIOS, "benchmark-truck", "benchmark-all", "realistic-truck-buildup"])
def test_borne_harm__sums_to_that_of_the_line(name: str) -> None:
    game, state = opened(name, "honest")
    for plans in (random_plans(game, state, 1), np.full((N, 1, len(game.settings.learners)), -1.0)):
        last, cost = follow_plans(game, state, plans, HONEST)
        assert last.borne_harm().sum(axis=1) == near(cost, rel=1e-12)
        own = amounts(objectives_of("own", last.vehicles), None, last, HONEST)
        assert own.sum(axis=1) == near(cost, rel=1e-12) and (own >= 0.0).all()
    assert not last.line[:, ANSWERED].any()  # all brake with all they have
    impacts = last.borne_harm(eb.HarmCount("impacts", [0, 1, 1, 0, 0, 0], "impact_harm", "impacts", (EXACT_IMPACTS,)))
    moving = np.where(last.moving[:, np.newaxis], np.nan, 0.0)
    shared = 10.0 * last.line[:, SHARED, :-1]
    assert np.nan_to_num(last.borne_harm() - impacts + moving - shared) == near(0.0, abs=1e-9)
    met = last.pair_hit | (last.line[:, PUSHED, 1:-1] > 0.0)
    front, rear = (np.pad(met, ((0, 0), place)) for place in ((1, 0), (0, 1)))
    assert not shared[~front & ~rear].any()  # who touches nobody


def test_own__gains_nothing_by_leaning_back_on_brakes_that_are_weaker() -> None:
    _, game = open_game("cooperation-3-pair")
    state = game.reset(eb.load_scenario("cooperation-3-pair").sample(2, seed=7)).take([1])
    ends = [follow_plans(game, state, np.array([[[-1.0, action]]]), HONEST) for action in np.linspace(-1.0, -0.5, 6)]
    own = np.array([last.borne_harm()[0, 2] for last, _ in ends])
    assert (own[1:] >= own[0] - 1e-9).all()


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", SCENARIOS)
def test_price__is_what_happens_to_the_bit_and_depends_on_no_other_world(name: str, count: str) -> None:
    game, state = opened(name, count)
    plans = random_plans(game, state, 2)
    expected, last = price(game, state, plans, count), state
    while not last.ended.all():
        last, _ = game.step(last, plans[np.arange(N), np.minimum(last.steps, plans.shape[1] - 1)])
    assert last.harm(count).tolist() == expected.tolist()
    for k in (7, 3):
        alone = price(game, state.take([k]), plans[[k]], count)
        assert alone.tolist() == expected[[k]].tolist()


@pytest.mark.parametrize("name", SCENARIOS)
def test_hold__of_constant_commands_is_the_episode(name: str) -> None:
    game, state = opened(name, "honest")
    learners, shares = game.settings.learners, np.array([-1.0, -0.4, 0.0, 0.7])
    braking, driving = (state.car[:, row][:, np.newaxis, learners] for row in (BRAKING, DRIVING))
    tried = shares[:, np.newaxis] * np.where(shares[:, np.newaxis] < 0.0, braking, driving)
    held = hold(state, state.wanted, learners, tried, game.settings.horizon_s, "honest")
    for c, share in enumerate(shares):
        last, cost = follow_plans(game, state, np.full((N, 1, len(learners)), share), HONEST)
        assert held[0, :, c] == near(cost, rel=1e-7, abs=1e-7)
        assert held[1, :, c] == near(last.harm("first"), rel=1e-7, abs=1e-7)


# ---------------------------------------------------------------- another count

UNKNOWN: dict[str, Any] = {
    "harm_count = 'best': must be": lambda: make_agent("e_v2x_bm", scenario="paper-random", harm_count="best"),
    "shield: harm_count = 'best': must be": lambda: StepShield(harm_count="best"),
    "reward: harm_count = 'best': must be": lambda: reward_params({"harm_count": "best"}),
    "evaluate: harm_count = 'best': must be": lambda: evaluate(
        "paper-random", {"mine": make_agent("coast")}, harm_count="best", episodes=1
    ),
}


@pytest.mark.parametrize("message", UNKNOWN)
def test_other_count__is_refused_and_the_three_are_listed(message: str) -> None:
    with refused(message) as error:
        UNKNOWN[message]()
    for count in COUNTS:
        assert count in str(error.value)
    assert (
        RewardParams(harm_count="honest").harm_count == HONEST and RewardParams().model_dump()["harm_count"] == "honest"
    )
