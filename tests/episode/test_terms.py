"""Terms of a reward by hand, shaping as a difference of potentials, components of a vector, and what a reward says."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.counts import FIRST_IMPACTS, HONEST
from ethbrake_marl.episode.hold import hold
from ethbrake_marl.episode.infos import arrays
from ethbrake_marl.episode.objectives import amounts, objectives_of
from ethbrake_marl.episode.reward import REWARDS, Rewarding, RewardParams, WithoutEffect, reward_params
from ethbrake_marl.episode.shaping import potential
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import COST, Step
from ethbrake_marl.episode.terms import register_term
from ethbrake_marl.errors import FreeImpacts, InvalidInput
from ethbrake_marl.motion.layout import BRAKING, FIRST, GAP, SPEED, TOTAL
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario
from tests.contract.interfaces import CRASH, REST
from tests.episode.lines import later, state_of, step_between

near = pytest.approx
LEARNERS = np.array([2])


def moved(gaps: list[float], speeds: list[float], seconds: float, commands: Any = 0.0) -> tuple[State, State]:
    before = state_of(gaps, speeds, restitution=0.5)
    return before, later(before, commands, seconds)


def paid(reward: dict[str, Any], before: State, after: State, **settings: Any) -> Step:
    rewarding, step_settings = Rewarding.of(
        reward, "total", after.vehicles, LEARNERS, (0.5, 8.0), settings.pop("vector", None)
    )
    step = step_between(before, after, **settings)
    step.out[COST] = harm = after.harm(step_settings.harm_count) - before.harm(step_settings.harm_count)
    compiled = (step_settings.terminal * step.safe_end - step_settings.harm * harm)[:, np.newaxis]
    return rewarding.complete(before, step._replace(reward=np.repeat(compiled, after.vehicles, axis=1)), after)[1]


@cache
def struck() -> tuple[State, State]:
    """Vehicle 2 strikes Vehicle 1 at 10 m/s; Vehicle 3 falls back."""
    return moved([1.0, 5.0], [10.0, 20.0, 4.0], 0.5, [0.0, 0.0, -2.0])


@pytest.mark.parametrize(
    ("reward", "safe", "name", "value"),
    [
        ({"harm": 1.0}, False, "harm", [-100.0] * 3),
        ({"harm": 0.0, "jerk": 1.0}, False, "jerk", [0.0, 0.0, -16.0]),  # (-2 / 0.5)^2
        ({"harm": 0.0, "terminal": 3.0}, False, "terminal", [0.0] * 3),
        ({"harm": 0.0, "terminal": 3.0}, True, "terminal", [1.0] * 3),
        ({"harm": 0.0, "collision": 2.0, "k_energy": 0.5}, False, "collision", [-50.0] * 3),
    ],
)
def test_term__of_a_step_by_hand(reward: dict[str, float], safe: bool, name: str, value: list[float]) -> None:
    step = paid(reward, *struck(), safe=safe)
    assert [*step.terms] == [name]
    assert np.broadcast_to(step.terms[name].reshape(1, -1), (1, 3))[0].tolist() == value
    weight = max(each for key, each in reward.items() if key != "k_energy")
    assert step.reward[0].tolist() == [weight * each for each in value]


def sigmoid(x: float) -> float:
    return 1.0 / (1.0 + math.exp(-x))


# After struck() gap 1 is 0 + 5 m/s * 0.4 s = 2 m, opening; gap 2 is 5 + 2 + 0.4 * 12.5 - (2 - 0.25) = 10.25 m, opening.
OPENING = -sigmoid(0.5 * (3.0 - 2.0)), -sigmoid(0.5 * (3.0 - 10.25))


@pytest.mark.parametrize(
    ("states", "gaps", "settings", "value"),
    [
        (struck, [2.0, 10.25], {"distance_slope_per_m": 0.5}, [OPENING[0], sum(OPENING), OPENING[1]]),
        (  # pairs that close add the time to collision, to the safety buffer of 1 m: slow ones too
            partial(moved, [7.0], [0.0, 4.0], 0.5), [5.0], {"ttc_scale_s": 2.0},
            [-sigmoid(-((5.0 - 1.0) / 4.0) / 2.0) - sigmoid(3.0 - 5.0)] * 2,
        ),
        (partial(moved, [3.0], [0.0, 4.0], 0.625), [0.5], {}, [-0.5 - sigmoid(3.0 - 0.5)] * 2),  # within the buffer

    ],
)  # fmt: skip
def test_risk__by_hand(
    states: Callable[[], tuple[State, State]], gaps: list[float], settings: dict[str, float], value: list[float]
) -> None:
    before, after = states()
    assert after.gaps_m[0] == near(gaps)
    assert paid({"harm": 0.0, "risk": 1.0, **settings}, before, after).terms["risk"][0] == near(value)


@pytest.mark.parametrize(
    ("scenario", "action", "when", "truncated"),
    [(CRASH, 0.0, None, 7), (CRASH, -1.0, 7, 7), (REST, -1.0, 9, None)],
    ids=["crash", "safe at the horizon", "at rest"],
)
def test_terminal__is_paid_once_at_a_safe_end(
    scenario: Scenario, action: float, when: int | None, truncated: int | None
) -> None:
    _, game = open_game(scenario, reward={"harm": 0.0, "terminal": 3.0})
    state = game.reset(game.draw(1, 0, 0))
    for k in range(11):
        state, step = game.step(state, np.full((1, 1), action))
        assert bool(step.truncated[0]) == (k == truncated)
        assert step.reward[0].tolist() == [3.0 * (k == when)] * 2
        assert bool(step.safe_end[0]) == (k == when)


@pytest.mark.parametrize(("reward", "count"), [("first-impact-harm", "first"), ("total-harm", "total")])
def test_cost__of_all_steps_is_the_harm_that_the_reward_counts(reward: str, count: str) -> None:
    _, game = open_game("paper-random-obstacle", reward=reward)
    state, cost = game.reset(game.draw(20, 7, 0)), np.zeros(20)
    while not state.ended.all():
        state, step = game.step(state, np.full((20, 1), -0.2))
        cost += arrays(game, state, step, 7, np.array([2]))["cost"]
    infos = [arrays(game, state, step, 7, np.array([body])) for body in (1, 2, 3)]
    for name, harms in (("first_impact_harm", state.borne_harm("first")), ("total_harm", state.borne_harm("total"))):
        assert np.stack([info[name] for info in infos], axis=1) == near(harms)
    assert all(np.array_equal(info["world_honest_cost"], state.harm("honest")) for info in infos)
    assert (
        state.line[:, TOTAL, 0].any()
        and cost == near(state.harm(count))
        and (state.harm("total") > state.harm("first")).any()
    )


# ---------------------------------------------------------------- shaping


@pytest.mark.parametrize(
    ("discount", "count", "strongest"), [(1.0, "first", 0.0), (0.9, "first", 0.0), (1.0, "honest", 1.0)]
)
def test_shaping__sums_to_minus_the_first_potential_whatever_is_done(
    discount: float, count: str, strongest: float
) -> None:
    """Under the honest count also where vehicles still move at the horizon."""
    reward = {"harm": 0.0, "harm_count": count, "shaping": 1.0, "shaping_discount": discount}
    scenario, game = open_game("paper-random", reward=reward)
    state = game.reset(scenario.sample(50, 7))
    tried = state.car[:, BRAKING, [2]] * -np.linspace(0.0, 1.0, 9)
    least = hold(state, -state.car[:, BRAKING], [2], tried[:, :, np.newaxis], scenario.horizon_s, count)[0].min(axis=1)
    rng, total, factor = np.random.default_rng(5), np.zeros(50), 1.0
    while not state.ended.all():
        state, step = game.step(state, rng.uniform(-1.0, strongest, (50, 1)))
        total += factor * step.reward[:, 1]
        factor *= discount
        assert (step.reward[:, [0, 2]] == 0.0).all()
    assert (least > 0).sum() > 20 and total == near(least, abs=1e-9)
    assert state.at_rest.all() == (strongest == 0.0)


def test_potential__counts_only_what_is_still_to_come() -> None:
    _, game = open_game("paper-random", reward={"harm": 1.0, "harm_count": "total"})
    state = later(state_of([0.5, 60.0], [10.0, 20.0, 5.0]), -16.0, 8.0)
    assert state.harm("total") > 0.0 and (state.line[:, SPEED, 1:] == 0.0).all()
    assert potential(game.settings, state) == 0.0


# ---------------------------------------------------------------- a vector of components


def test_components__of_a_step_by_hand() -> None:
    before = state_of([1.0, 1.0], [10.0, 20.0, 20.0], mass_t=[1.0, 3.0, 1.0], obstacle_gap_m=3.0)
    after = later(before, 0.0, 2.0)
    assert (after.line[0, FIRST, :3] > 0.0).all()
    after.line[0, TOTAL, :3] += [1.0, 2.0, 3.0]  # later impacts
    p0, p1, p2 = (after.line[0, TOTAL, p] for p in range(3))
    vector = ["harm_1", "harm_2", "harm_3", "obstacle", "pair_1_2", "pair_2_3", "jerk"]
    step = paid({"harm": 1.0, "harm_count": "total", "jerk": 1.0}, before, after, vector=vector)
    borne = [0.75 * p1 + p0, 0.25 * p1 + 0.25 * p2, 0.75 * p2]
    for vehicle in range(3):
        expected = [*borne, p0, p1, p2, -step.terms["jerk"][0, vehicle]]
        assert step.vector is not None and (-step.vector[0, vehicle]).tolist() == near(expected)


def test_components__of_vehicles_add_up_to_the_reward() -> None:
    _, game = open_game("cooperation-4-all", reward="first-impact-harm", reward_vector="vehicles")
    state = game.reset(game.draw(30, 1, 0))
    while not state.ended.all():
        state, step = game.step(state, np.full((30, len(game.settings.learners)), -0.2))
        assert step.vector is not None and step.vector.shape == (30, 3, 3)
        assert step.vector.sum(axis=2) == near(step.reward, abs=1e-9)
    assert state.collided.any()
    _, game = open_game("paper-random", reward="first-impact-harm", reward_vector=["harm", "harm_2"])
    _, step = game.step(game.reset(game.draw(3, 1, 0)), np.zeros((3, 1)))
    assert step.vector is not None and step.vector.shape == (3, 3, 2) and [*step.terms] == ["harm"]


# ---------------------------------------------------------------- what a reward says


def rewards(reward: Any, scenario: Any = "paper-random", n: int = 40) -> tuple[np.ndarray, State]:
    loaded, game = open_game(scenario, reward=reward)
    state, total = game.reset(loaded.sample(n, 4)), np.zeros((n, 3))
    actions = np.random.default_rng(2).uniform(-1.0, 0.0, (n, 1))
    while not state.ended.all():
        state, step = game.step(state, actions)
        total += step.reward
    return total, state


def test_objective__is_the_scenarios_unless_the_reward_has_its_own() -> None:
    own = load_scenario("paper-random").replace(objective="own")
    plain = rewards("first-impact-harm")[0]
    assert (
        rewards("first-impact-harm", own)[0].tolist()
        == rewards({"harm": 1.0, "harm_count": "first", "objective": "own"})[0].tolist()
        != plain.tolist()
    )
    assert rewards({"harm_count": "first", "harm": 1.0, "objective": "total"}, own)[0].tobytes() == plain.tobytes()
    assert rewards(RewardParams(harm_count="first", objective=("total",) * 3))[0].tobytes() == plain.tobytes()


def test_objective__changes_no_weight_and_no_other_term() -> None:
    doubled, _ = rewards({"objective": "maximin", "harm": 2.0, "harm_count": "first", "terminal": 3.0}, n=150)
    single, state = rewards({"objective": "maximin", "harm": 1.0, "harm_count": "first"}, n=150)
    safe = ~state.collided
    assert safe.any() and single[:, 0] == near(-amounts(objectives_of("maximin", 3), None, state, FIRST_IMPACTS)[:, 0])
    assert doubled == near(2.0 * single + 3.0 * safe[:, np.newaxis])


def test_objective__without_a_weight_of_harm_has_no_effect_and_warns() -> None:
    own = load_scenario("cooperation-3-pair").replace(objective="own")
    with pytest.warns(WithoutEffect, match="the scenario's objective, own, has no effect"):
        _, game = open_game(own, reward="paper-reward")
    assert game.settings.harm == 0.0 and "harm" not in game.rewarding.counted
    open_game(own, reward={"harm": 1.0, "risk": 0.1})


def test_objective__that_leaves_an_impact_without_weight_warns_once() -> None:
    paper, obstacle = load_scenario("paper-random"), load_scenario("paper-random-obstacle")
    text = (
        "objective weighted:0,0,1: an impact between vehicle_1 and vehicle_2 has no weight, so vehicle_2 may cause it;"
        " write weighted:1,1,1000 to let the harm of the whole line decide between actions that are equal otherwise"
    )
    with pytest.warns(FreeImpacts) as seen:
        open_game(paper.replace(objective="weighted:0,0,1"))
        open_game(paper, reward={"harm": 2.0, "objective": "weighted:0,0,1"})
    assert [str(each.message) for each in seen] == [text]
    with pytest.warns(FreeImpacts, match="objective weighted:0,1,1: an impact between vehicle_1 and the obstacle has"):
        open_game(obstacle.replace(objective="weighted:0,1,1"))
    with pytest.warns(
        FreeImpacts, match="between vehicle_2 and vehicle_3 has no weight, .* write weighted:1000,1,1 to"
    ):
        open_game(paper.replace(objective=["own", "vehicle_1", "own"]))
    five = load_scenario("cooperation-2-five")
    with pytest.warns(FreeImpacts, match="write weighted:1,1,1000,4000,1e\\+06 to"):
        open_game(five.replace(objective="weighted:0,0,2,8,1e5"))
    open_game(five.replace(objective="weighted:1,1,1000,4000,1e+06"))


@pytest.mark.parametrize(
    ("name", "objective"),
    [
        ("paper-random", "weighted:0,1,1"),
        ("paper-random-obstacle", "weighted:1,0,1"),
        ("paper-random", "weighted:1,1,1000"),
        ("paper-random", ["vehicle_3", "total", "vehicle_1"]),  # only Vehicle 2 learns
    ],
    ids=str,
)
def test_objective__does_not_warn_where_every_impact_counts_or_an_objective_means_to_be_indifferent(
    name: str, objective: Any
) -> None:
    open_game(load_scenario(name).replace(objective=objective))  # a warning is an error in tests


def test_named_rewards__are_those_of_the_page() -> None:
    assert {
        "shaped": RewardParams(harm=0.05, harm_count="honest", shaping=0.05, shaping_discount=0.99),
        "first-impact-harm": RewardParams(harm=1.0, harm_count="first"),
        "total-harm": RewardParams(harm=1.0, harm_count="total"),
        "honest": RewardParams(harm=1.0, harm_count="honest"),
        "paper-reward": RewardParams(harm=0.0, harm_count="first", collision=1.0, risk=0.1, jerk=1e-5, terminal=10.0),
    } == REWARDS
    assert reward_params({"harm": 2, "jerk": 0.5}) == RewardParams(harm=2.0, jerk=0.5)
    assert reward_params("paper-reward") is REWARDS["paper-reward"]
    assert (
        RewardParams(harm=2.0)
        == RewardParams(harm=2.0, harm_count="honest")
        == RewardParams(harm=2.0, harm_count=HONEST)
    )
    with pytest.raises(InvalidInput, match=r"^reward 'paper' has ended; write paper-reward"):
        reward_params("paper")
    with pytest.raises(InvalidInput, match=r"^reward 'harm' has ended; write first-impact-harm"):
        reward_params("harm")


def one(before: State, step: Step, after: State) -> np.ndarray:
    """One for all."""
    return np.ones(after.n)


def gap(before: State, step: Step, after: State) -> np.ndarray:
    """Gap ahead."""
    return after.line[:, GAP, :-1] * [[0.0, 1.0, 1.0]]


def test_terms_of_ones_own__count_where_a_reward_says_so() -> None:
    for _ in range(2):  # registered twice it is one
        register_term("one", one)
    register_term("gap_ahead", gap, unit="m")
    for reward in ({"harm": 1.0}, {"harm": 1.0, "one": 0.0}, "first-impact-harm"):
        assert [*paid(reward, *struck()).terms] == ["harm"]  # type: ignore[arg-type]
    step = paid({"harm": 0.0, "one": 2.0, "gap_ahead": -1.0}, *struck())
    assert step.reward[0] == near([2.0, 2.0 - 2.0, 2.0 - 10.25])
    settled = RewardParams(harm=1.0, terms={"one": 3.0})
    assert RewardParams(**settled.model_dump()) == settled and settled.weights["one"] == 3.0
