"""Harm: shares by mass, ledger, injury, objectives; and reward terms by hand, shaping as a difference of potentials."""

import math
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.envs.making import make_engine
from ethbrake_marl.first_edition.game.actions import action_to_command, checked_action, command_to_action
from ethbrake_marl.first_edition.game.harm import Ledger, empty_ledger, split
from ethbrake_marl.first_edition.game.measures import BUILT_IN
from ethbrake_marl.first_edition.game.objectives import STANDARD, objective_harm, objectives_of, scored
from ethbrake_marl.first_edition.game.rewards import REWARDS, RewardParams, WithoutEffect, reward_params
from ethbrake_marl.first_edition.game.step_outcome import StepOutcome
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.forecast import forecast
from ethbrake_marl.first_edition.physics.left_out import Impacts
from ethbrake_marl.first_edition.physics.state import Floats, Worlds, make_worlds
from tests.first_edition.contract.interfaces import CRASH, REST
from tests.first_edition.physics.random_worlds import driving_lines, line
from tests.reference.tolerances import EPS

# ---------------------------------------------------------------- shares


@settings(max_examples=300)
@given(st.lists(st.floats(1e-2, 1e4), min_size=2, max_size=6), st.data())
def test_split__shares_add_up_to_the_last_bit_and_are_inverse_to_the_masses(mass, data) -> None:
    value = st.just(0.0) | st.floats(1e-10, 2_000.0)
    harm = data.draw(st.lists(value, min_size=len(mass) - 1, max_size=len(mass) - 1))
    for p, squared in enumerate(harm):  # pair by pair: a vehicle between two pairs bears a sum of rounded numbers
        front, rear = split(np.array([[squared]]), np.array([mass[p : p + 2]]))[0]
        assert Fraction(float(front)) + Fraction(float(rear)) == Fraction(squared)
        assert min(front, rear) >= 0.0
        rounding = 4.0 * EPS * squared * max(mass[p : p + 2])
        assert front * mass[p] == pytest.approx(rear * mass[p + 1], rel=0, abs=rounding)
    assert split(np.array([harm]), np.array([mass])).sum() == pytest.approx(sum(harm), rel=1e-14)


# ---------------------------------------------------------------- the ledger


def booked(key: int, n: int, N: int) -> tuple[Ledger, Floats, Floats, Floats]:
    """A ledger of three segments; first-impact harm, total harm and number of their recorded impacts, [n, pairs]."""
    worlds, command = driving_lines(key, n, N)
    ledger, (first, total, count) = empty_ledger(worlds), np.zeros((3, *worlds.gaps_m.shape))
    for until in (0.7, 2.0, 6.0):
        worlds, impacts = advance(worlds, command, until_s=until, record=True)
        rows, (segment_first, segment_total) = impacts.rows, np.zeros((2, *first.shape))
        assert rows is not None and np.all(np.diff(rows.time_s)[np.diff(rows.world) == 0] >= 0.0)
        harm = rows.closing_speed_mps * rows.closing_speed_mps
        np.add.at(segment_total, (rows.world, rows.pair), harm)
        np.add.at(segment_first, (rows.world[rows.first], rows.pair[rows.first]), harm[rows.first])
        np.add.at(count, (rows.world, rows.pair), 1.0)
        assert np.array_equal(worlds.pair_hit, count > 0)
        first, total, ledger = first + segment_first, total + segment_total, ledger.add(impacts)
    return ledger, first, total, count


@pytest.mark.parametrize("N", [2, 3, 6])
def test_ledger__is_the_sum_of_the_recorded_impacts_to_the_last_bit(N: int) -> None:
    ledger, first, total, count = booked(45, 400, N)
    assert ledger.pair_harm("first").tobytes() == first.tobytes()
    assert ledger.pair_harm("total").tobytes() == total.tobytes()
    assert ledger.count.tolist() == count.tolist() and ledger.count.dtype == np.int64
    assert ledger.collided.tolist() == (count.sum(axis=1) > 0).tolist()
    assert ledger.world_harm("total") == pytest.approx(ledger.vehicle_harm("total").sum(axis=1), rel=1e-14)


# ---------------------------------------------------------------- objectives

PAPER = eb.load_scenario("paper-random")
EACH = [*STANDARD, "social:30", "social:90", "weighted:1,4,2", "injury:lr4s"]


def played(reward: Any, scenario: eb.Scenario = PAPER, n: int = 60) -> tuple[Floats, eb.Engine]:
    """The sum of rewards of each vehicle, and the engine at the end."""
    scripts = {i: eb.make_agent(script) for i, script in scenario.scripts.items()}
    engine = eb.Engine(scenario, n, learners=scenario.learners, scripts=scripts, reward=reward, seed=4)
    action, total = np.random.default_rng(2).uniform(-1.0, 0.0, (n, len(scenario.learners))), 0.0
    while not engine.ended.all():
        total += engine.step(action).reward
    return total, engine


@pytest.mark.parametrize("harm_count", ["first", "total"])
@pytest.mark.parametrize("objective", [*EACH, ["total", "own", "social:45"]], ids=str)
def test_rewards__add_up_to_minus_the_objective_of_the_ledger(objective: Any, harm_count: str) -> None:
    scenario = PAPER if isinstance(objective, str) else PAPER.with_learners([1, 2])
    total, engine = played({"objective": objective, "harm_count": harm_count}, scenario)
    assert engine.ledger.collided.sum() > 20
    expected = -objective_harm(engine.ledger, harm_count, objectives_of(objective, 3))
    assert total == pytest.approx(expected, abs=1e-9)


# ---------------------------------------------------------------- reward terms


near = pytest.approx
PAPER = eb.load_scenario("paper-random")


def sigmoid(x: float) -> float:
    return 1.0 / (1.0 + math.exp(-x))


def terms_of(
    params: RewardParams, before: Worlds, after: Worlds, impacts: Impacts, safe: bool = False, **harms: Any
) -> dict[str, np.ndarray]:
    """Unweighted terms of one step of 0.5 s, each [n, N]; all but shaping."""
    facts = {"first_impact_harm": impacts.first_impact_harm.sum(axis=1), "total_harm": impacts.total_harm.sum(axis=1)}
    motion = after.gaps_m, after.speeds_mps, after.command_mps2, before.command_mps2
    v, end = after.vehicles, np.full(after.n, safe)
    constants = v.braking_capacity_mps2, v.driving_capacity_mps2, v.latency_s, v.mass_t
    harm_of_count = (facts | harms).values()
    step = StepOutcome(*harm_of_count, end, *motion, 0.5, after.time_s, *constants, np.array([1]))
    harm = step.first_impact_harm if params.harm_count == "first" else step.total_harm
    shared = params.shared(harm, step.safe_end.astype(np.float64))
    counted = [BUILT_IN[name] for name in params.counted if BUILT_IN[name].function]
    every = shared | {measure.name: measure.built_in(step, params) for measure in counted}
    return {
        name: np.repeat(term[:, np.newaxis], after.N, axis=1) if term.ndim == 1 else term
        for name, term in every.items()
    }


def moved(gaps_m: list[float], speeds_mps: list[float], seconds: float, command: Any = 0.0) -> Any:
    """A line before and after, and its impacts: e = 0.5, equal masses."""
    usual = {"braking_capacity_mps2": 10.0, "driving_capacity_mps2": 10.0, "latency_s": 0.0, "mass_t": 1.0}
    before = make_worlds([gaps_m], [speeds_mps], restitution=0.5, **usual)
    return before, *advance(before, command, seconds)


# Vehicle 2 strikes Vehicle 1 at 10 m/s; Vehicle 3 falls back.
STRUCK = moved([1.0, 5.0], [10.0, 20.0, 4.0], 0.5, [0.0, 0.0, -2.0])


@pytest.mark.parametrize(
    ("params", "safe", "name", "told"),
    [
        ({}, False, "harm", [-100.0] * 3),
        ({"harm": 0.0, "jerk": 1.0}, False, "jerk", [0.0, 0.0, -16.0]),
        ({"harm": 0.0, "terminal": 3.0}, False, "terminal", [0.0] * 3),
        ({"harm": 0.0, "terminal": 3.0}, True, "terminal", [1.0] * 3),
        ({"harm": 0.0, "collision": 1.0, "k_energy": 0.5}, False, "collision", [-50.0] * 3),
    ],
)
def test_term__of_a_step_by_hand(params: dict[str, float], safe: bool, name: str, told: list[float]) -> None:
    reward = RewardParams(**params)
    found = terms_of(reward, *STRUCK, safe)
    assert {each: term.tolist() for each, term in found.items()} == {name: [told]}
    weight = max(value for key, value in {"harm": 1.0, **params}.items() if key != "k_energy")
    assert reward.weighted_sum(found, (1, 3)).tolist() == [[weight * value for value in told]]


@pytest.mark.parametrize(("count", "harm"), [("first", [-100.0, 0.0]), ("total", [-130.0, -7.0])])
def test_collision__counts_every_impact_whatever_the_harm_counts(count: Any, harm: list[float]) -> None:
    two = STRUCK[0].take([0, 0]), STRUCK[1].take([0, 0]), STRUCK[2]
    harms = {"first_impact_harm": np.array([100.0, 0.0]), "total_harm": np.array([130.0, 7.0])}
    told = terms_of(RewardParams(harm=1.0, harm_count=count, collision=1.0, k_energy=0.5), *two, **harms)
    assert (told["collision"][:, 0].tolist(), told["harm"][:, 0].tolist()) == ([-65.0, -3.5], harm)


# After STRUCK gap 1 is 0 + 5 m/s * 0.4 s = 2 m, opening; gap 2 is 5 + 2 + 0.4 * 12.5 - (2 - 0.25) = 10.25 m, opening.
OPENING = -sigmoid(0.5 * (3.0 - 2.0)), -sigmoid(0.5 * (3.0 - 10.25))


@pytest.mark.parametrize(
    ("line", "gaps", "settings", "told"),
    [
        (STRUCK, [2.0, 10.25], {"distance_slope_per_m": 0.5}, [OPENING[0], sum(OPENING), OPENING[1]]),
        # Closing pairs add the time to collision, to the safety buffer of 1 m: slow ones too.
        (
            moved([7.0], [0.0, 4.0], 0.5),
            [5.0],
            {"ttc_scale_s": 2.0},
            [-sigmoid(-((5.0 - 1.0) / 4.0) / 2.0) - sigmoid(3.0 - 5.0)] * 2,
        ),
        (
            moved([7.0], [0.0, 0.5], 2.0),
            [6.0],
            {"ttc_scale_s": 10.0},
            [-sigmoid(-((6.0 - 1.0) / 0.5) / 10.0) - sigmoid(3.0 - 6.0)] * 2,
        ),
        (moved([3.0], [0.0, 4.0], 0.625), [0.5], {}, [-0.5 - sigmoid(3.0 - 0.5)] * 2),  # within the buffer: most urgent
    ],
)
def test_risk__by_hand(line: Any, gaps: list[float], settings: dict[str, float], told: list[float]) -> None:
    found = terms_of(RewardParams(harm=0.0, risk=1.0, **settings), *line)
    assert line[1].gaps_m[0] == near(gaps) and found["risk"][0] == near(told)


@pytest.mark.parametrize(
    ("scenario", "action", "paid", "truncated"),
    [(CRASH, 0.0, None, 7), (CRASH, -1.0, 7, 7), (REST, -1.0, 9, None)],
    ids=["crash", "safe at the horizon", "at rest"],
)
def test_terminal__is_paid_at_rest_and_at_the_horizon_after_no_collision_and_once(
    scenario: eb.Scenario, action: float, paid: int | None, truncated: int | None
) -> None:
    engine = make_engine(scenario, 1, reward=RewardParams(harm=0.0, terminal=3.0))
    results = [engine.step(np.full((1, 1), action)) for _ in range(11)]
    assert [bool(result.truncated[0]) for result in results] == [k == truncated for k in range(11)]
    assert [result.reward[0].tolist() for result in results] == [[3.0 * (k == paid)] * 2 for k in range(11)]
    assert [result.shared["terminal"][0] for result in results] == [float(k == paid) for k in range(11)]


@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_shaping__sums_to_minus_the_first_potential_whatever_is_done(discount: float) -> None:
    reward = RewardParams(harm=0.0, shaping=1.0, shaping_discount=discount)
    engine = make_engine(PAPER, 50, reward=reward)
    command = -engine.worlds.vehicles.braking_capacity_mps2
    candidates = command[:, 1:2] * np.linspace(0.0, 1.0, 9)
    least = forecast(engine.worlds, command, 1, candidates, PAPER.horizon_s)[0].min(axis=1)
    rng = np.random.default_rng(5)
    total, factor = np.zeros(50), 1.0
    while not engine.ended.all():
        result = engine.step(rng.uniform(-1.0, 0.0, (50, 1)))
        total += factor * result.reward[:, 1]
        factor *= discount
        assert (result.reward[:, [0, 2]] == 0.0).all()
    assert (least > 0).sum() > 20 and total == near(least, abs=1e-9)


def test_shaping__of_an_episode_after_autoreset_begins_with_the_potential_of_its_own_world() -> None:
    reward = RewardParams(harm=0.0, shaping=1.0)
    engine, rng = make_engine(PAPER, 6, reward=reward), np.random.default_rng(5)
    begun, gained, compared = reward.potential(engine.worlds, (1,), PAPER.horizon_s), np.zeros(6), 0
    while compared < 30:
        result = engine.step(rng.uniform(-1.0, 0.0, (6, 1)))
        gained += result.reward[:, 1]
        rows = np.flatnonzero(result.ended)
        assert gained[rows] == near(-begun[rows], abs=1e-9)
        engine.renew(rows)
        compared += (begun[rows] < 0.0).sum()
        begun[rows] = reward.potential(engine.worlds, (1,), PAPER.horizon_s)[rows]
        gained[rows] = 0.0


def potential_in_rounds(worlds: Worlds, rounds: int) -> np.ndarray:
    """Of learners 0 and 1, who choose one after the other, this often."""
    braking = worlds.vehicles.braking_capacity_mps2
    command, best = -braking.copy(), np.empty(worlds.n)
    for vehicle in (0, 1) * rounds:
        harms = []
        for share in range(9):
            tried = command.copy()
            tried[:, vehicle] = -braking[:, vehicle] * (share / 8.0)
            harms.append(forecast(worlds, tried, vehicle, tried[:, [vehicle]], 8.0)[0][:, 0])
        command[:, vehicle] = -braking[:, vehicle] * (np.array(harms).argmin(axis=0) / 8.0)
        best = np.array(harms).min(axis=0)
    return -best


def test_potential__of_two_learners_lets_each_choose_given_the_other_twice_round() -> None:
    worlds = eb.load_scenario("cooperation-3-pair").sample(300, seed=3).worlds
    braking, shares = worlds.vehicles.braking_capacity_mps2, np.linspace(0.0, 1.0, 9)
    found = RewardParams().potential(worlds, (0, 1), 8.0)
    assert found == near(potential_in_rounds(worlds, 2), abs=1e-12)
    assert (potential_in_rounds(worlds, 1) < found - 1.0).any()
    alone, pair = -RewardParams().potential(worlds, (1,), 8.0), -found
    every = np.empty((worlds.n, 9))  # least harm by Vehicle 2, for each choice of Vehicle 1
    for c, share in enumerate(shares):
        command = -braking.copy()
        command[:, 0] *= share
        every[:, c] = forecast(worlds, command, 1, -braking[:, 1:2] * shares, 8.0)[0].min(axis=1)
    assert (every.min(axis=1) <= pair).all() and (pair <= alone).all()
    assert (alone > 1.0).sum() > 100 and pair.mean() < 0.1 * alone.mean()  # Vehicle 1 simply does not brake


def test_reward__without_harm_says_that_the_scenarios_objective_changes_nothing() -> None:
    own = eb.load_scenario("cooperation-3-pair").replace(objective="own")
    with pytest.warns(WithoutEffect, match="the scenario's objective, own, has no effect"):
        paid = make_engine(own, 2, reward="paper", seed=1)
    assert paid.reward.objective is None
    make_engine(own, 2, reward={"harm": 1.0, "risk": 0.1}, seed=1)


def test_counts__differ_by_the_later_impacts() -> None:
    # The two counts differ by the later impacts: 8, 4 and 2 m/s against a heavy holding wall, in two segments.
    world = line([0.0], [0.0, 8.0], mass_t=[2.0**50, 1.0], restitution=0.5)
    ledger = empty_ledger(world)
    for until in (1.0, 3.25):
        world, impacts = eb.advance(world, [-16.0, 4.0], until_s=until)
        ledger = ledger.add(impacts)
    assert ledger.pair_harm("first").tolist() == [[64.0]]
    assert ledger.count.tolist() == [[3]]
    assert ledger.collided.tolist() == [True]
    assert ledger.vehicle_harm("first").sum().tolist() == 64.0
    assert np.round(ledger.world_harm("total"), 9).tolist() == [64 + 16 + 4]


def test_harm_of_the_obstacle__is_that_of_vehicle_1() -> None:
    # 6 m/s into it, 8 and 10 m/s behind, all touching, e = 0: one round, all at rest.
    world = line([0.0, 0.0], [6.0, 8.0, 10.0], obstacle_gap_m=0.0)
    ledger = empty_ledger(world).add(eb.advance(world, 0.0, 0.0)[1])
    assert ledger.obstacle_harm("first").tolist() == [36.0]
    assert ledger.obstacle_harm("total").tolist() == [36.0]
    assert ledger.pair_harm("total").tolist() == [[4.0, 4.0]]
    assert ledger.world_harm("total").tolist() == [44.0]
    assert ledger.vehicle_harm("first").tolist() == [[38.0, 4.0, 2.0]]
    assert ledger.vehicle_harm("total").tolist() == [[38.0, 4.0, 2.0]]
    alone = line([50.0], [20.0, 0.0], obstacle_gap_m=10.0)
    assert empty_ledger(alone).add(eb.advance(alone, 0.0, 1.0)[1]).collided.tolist() == [True]


BEYOND = np.nextafter(np.float32(1), np.float32(2))


@pytest.mark.parametrize(
    ("action", "taken"),
    [([-1, 1], [-1.0, 1.0]), ([-BEYOND, BEYOND], [-1.0, 1.0]), ([1.0000000000000002, 0.5], [1.0, 0.5])],
    ids=["bounds", "one step beyond", "rounding"],
)
def test_actions__are_taken_up_to_one_float32_step_beyond_their_bounds(action, taken) -> None:
    assert checked_action(action, (2,), "vehicle_2").tolist() == taken


@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
def test_action_of_one_vehicle__may_have_any_axes_of_length_1(shape) -> None:
    assert checked_action(np.full(shape, 0.25), (1,), "vehicle_2").tolist() == [0.25]
    assert checked_action(np.full(shape, 0.25), (1, 1), "vehicle_2").tolist() == [[0.25]]


@pytest.mark.parametrize(
    ("vehicle", "commands", "back", "cut"),
    [
        (0, [-8.0, -4.0, 0.0, 1.0, 2.0], [-1.0, -0.5, 0.0, 0.5, 1.0], [-1.0, -1.0, 0.0, 1.0, 1.0]),
        (1, [-6.0, -3.0, 0.0, 0.0, 0.0], [-1.0, -0.5, 0.0, 0.0, 0.0], [-1.0, -1.0, 0.0, 0.0, 0.0]),  # cannot drive
    ],
)
def test_actions__are_linear_on_each_side_of_coasting_and_back(vehicle, commands, back, cut) -> None:
    capacities = {"braking_capacity_mps2": [8.0, 6.0], "driving_capacity_mps2": [2.0, 0.0]}
    worlds = eb.make_worlds(5.0, np.full((5, 2), 20.0), **capacities, latency_s=0.0, mass_t=1.0, restitution=0.0)
    command = action_to_command(np.array([-1.0, -0.5, 0.0, 0.5, 1.0]), worlds.vehicles, vehicle)
    assert command.tolist() == commands
    assert command_to_action(command, worlds.vehicles, vehicle).tolist() == back
    assert command_to_action(np.array([-99.0, -8.5, 0.0, 2.5, 99.0]), worlds.vehicles, vehicle).tolist() == cut


@pytest.mark.parametrize(
    ("harm", "mass", "expected"),
    [
        ([16, 0], [1, 3, 1], [[12.0, 4.0, 0.0]]),
        ([16, 0], [3, 1, 1], [[4.0, 12.0, 0.0]]),
        ([0, 16], [1, 3, 1], [[0.0, 4.0, 12.0]]),
        ([16, 8], [1, 3, 1], [[12.0, 6.0, 6.0]]),
    ],
)
def test_split__the_lighter_one_of_a_pair_bears_more(harm, mass, expected) -> None:
    # The lighter one of a pair bears more, as in the paper: 16 of masses 1 and 3 are 12 and 4.
    assert split(np.array([harm], float), np.array([mass], float)).tolist() == expected


# Pair 1 met with 12 m2/s2 (masses 1, 2), pair 2 with 9 (masses 2, 1), then with 21 more; e = 0.5.
MET = Ledger(
    np.array([[12.0, 9.0]]),
    np.array([[12.0, 30.0]]),
    np.array([[1, 2]]),
    *Impacts.no_obstacle(1),
    np.array([[1.0, 2.0, 1.0]]),
    np.array([0.5]),
    np.array([[0.0, 1.0, 3.0]]),
)


@pytest.mark.parametrize(
    ("objective", "harm"),
    [
        ("total", [21.0, 21.0, 21.0]),
        ("own", [8.0, 7.0, 6.0]),
        ("social:0", [8.0, 7.0, 6.0]),
        ("social:90", [13.0, 14.0, 15.0]),
        ("social:45", [21 / 2**0.5] * 3),
        ("social:30", [x * 0.75**0.5 + (21 - x) / 2 for x in (8, 7, 6)]),
        ("maximin", [8.0, 8.0, 8.0]),
        ("preference", [18.75] * 3),  # 3 (7 + 3 x 6) / 4
        ("weighted:0,1,3", [18.75] * 3),
        ("mass-weighted", [21.0, 21.0, 21.0]),
        ("weighted:1,4,2", [3 * (8 + 4 * 7 + 2 * 6) / 7] * 3),
        ("weighted:1e6, 1e-6,1e6", [21.0, 21.0, 21.0]),
        (("total", "own", "maximin"), [21.0, 7.0, 8.0]),
    ],
    ids=str,
)
def test_objectives__by_hand(objective, harm) -> None:
    # Shares by mass: pair 1 gives 8 and 4, pair 2 gives 3 and 6 of its first: H = (8, 7, 6).
    found = objective_harm(MET, "first", objectives_of(objective, 3))
    assert found[0] == pytest.approx(harm, abs=1e-8)
    (told,) = scored(MET, "first", [objective]).values()
    assert told.tolist() == found.tolist()


def test_objectives__of_total_harm() -> None:
    # Pair 2 gives 10 and 20: H = (8, 14, 20).
    found = objective_harm(MET, "total", objectives_of(("total", "own", "maximin"), 3))
    assert found.tolist() == [[42.0, 14.0, 20.0]]


def test_injuries__by_hand() -> None:
    # The changes of speed are Vehicle 1's 2 / 3 1.5 sqrt(12) at the rear, Vehicle 2's 1 / 3 1.5 sqrt(12) in front and
    # 1 / 3 1.5 3 at the rear, of which the front one counts, and Vehicle 3's 2 / 3 1.5 3 in front.
    assert np.round(MET.speed_changes("first"), 8).tolist() == [[[0.0, 1.73205081, 3.0]], [[3.46410162, 1.5, 0.0]]]
    logits = np.array([4.888 - 0.177 * 12**0.5, 4.457 - 0.177 * 3**0.5, 4.457 - 0.177 * 3])
    injuries = objective_harm(MET, "first", objectives_of("injury:lr4s", 3))
    assert injuries[0] == pytest.approx([(1000 / (1 + np.exp(logits))).sum()] * 3, abs=1e-8)


def test_injuries__grow_with_a_harder_impact() -> None:
    # Though a rear hit counts for less than one in front.
    harder = [replace(MET, first_impact_harm=np.array([[400.0, w * w]])) for w in (19.9, 20.0, 20.1)]
    injuries = [objective_harm(each, "first", objectives_of("injury:lr4s", 3))[0, 0] for each in harder]
    assert injuries == sorted(set(injuries))


def test_reward__has_the_objective_of_the_scenario_unless_it_has_its_own() -> None:
    own = PAPER.replace(objective="own")
    assert played("harm", own)[0].tolist() == played({"objective": "own"})[0].tolist()
    assert played({"objective": "total"}, own)[0].tobytes() == played("harm")[0].tobytes()
    assert played(RewardParams(objective=("total",) * 3))[0].tobytes() == played("harm")[0].tobytes()


def test_reward__objective_changes_no_weight_and_no_other_term() -> None:
    doubled, _ = played({"objective": "maximin", "harm": 2.0, "terminal": 3.0})
    single, engine = played({"objective": "maximin"})
    safe = ~engine.ledger.collided
    assert safe.any()
    assert doubled == pytest.approx(2.0 * single + 3.0 * safe[:, np.newaxis])
    without, _ = played({"harm": 0.0, "terminal": 1.0})
    assert without.tolist() == np.repeat(safe[:, np.newaxis] * 1.0, 3, axis=1).tolist()


def one(step):
    """One for all."""
    return np.ones(len(step.time_s))


def test_rewards__are_those_of_the_page() -> None:
    assert REWARDS["harm"] == RewardParams(harm=1.0, harm_count="first")
    assert REWARDS["total-harm"] == RewardParams(harm_count="total")
    assert REWARDS["paper"] == RewardParams(harm=0.0, collision=1.0, risk=0.1, jerk=1e-5, terminal=10.0)
    assert list(REWARDS) == ["harm", "total-harm", "paper"]
    assert reward_params({"harm": 2, "jerk": 0.5}) == RewardParams(harm=2.0, jerk=0.5)


@pytest.mark.parametrize(
    ("reward", "terms"),
    [({"harm": 1.0}, {}), ({"mine": 0.0}, {}), ("harm", {}), ({"harm": 0.0, "terms": {"mine": 2}}, {"mine": 2.0})],
    ids=str,
)
def test_term_of_ones_own__counts_where_a_reward_says_so(reward, terms) -> None:
    for _ in range(2):  # registered twice it is one
        eb.register_measure("mine", one, by="step")
    assert reward_params(reward).terms == terms
    settled = RewardParams(harm=1.0, terms={"mine": 3.0})
    assert RewardParams(**settled.model_dump()) == settled
    assert settled.weight("mine") == 3.0
