"""The lower bound of several controlled vehicles: by hand, against the bound of one, and against joint profiles."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from ethbrake_marl.limits.lower_bound import avoidability, lower_bound, team_bound
from ethbrake_marl.physics import Vehicles, advance
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.search import Profiles, profile_problem
from tests.limits.worlds import REGIONS, line, worlds_of

HORIZON_S = 60.0
STEPS = ((0.1, 0.1), (None, 0.025), (0.02, 0.02))  # what the bound is told, and when the searched profiles change
world = partial(line, mass=1, limit=60.0)
PAIR = load_scenario("cooperation-3-pair")


# world, controlled vehicles, harm of their bound
BY_HAND = {
    # w^2 - 2 u d, before the follower may act
    "the leader drives away": (world([5], [10, 20], 5, [0, 1], driving=[2, 0]), (0, 1), 100 - 2 * 2 * 5),
    "early: the leader brakes instead": (world([5], [10, 20], 5, [0, 1], driving=[2, 0]), (1,), 10**2 + 2 * 5 * 5),
    # w = -2: driving would make the gap shrink sooner, at sqrt(2 (8 - 4) 4)
    "the leader brakes harder and drew ahead": (world([4], [20, 18], [8, 4]), (1,), 2 * 4 * 4),
    "the leader coasts for 1 s, the follower brakes at once": (world([8], [10, 14], 6, [1, 0]), (1,), 0),
}


@pytest.mark.parametrize("name", BY_HAND)
def test_pair__by_hand(name):
    worlds, vehicles, harm = BY_HAND[name]
    assert team_bound(worlds, vehicles).harm[0] == pytest.approx(harm)


def test_pair__of_a_leader_that_brakes_late_counts_what_the_follower_must_make_up():
    late = world([2], [10, 14], [6, 3], [1, 0])
    _, impacts = advance(late, -late.vehicles.braking_capacity_mps2, until_s=20.0)
    assert 0 < team_bound(late, (1,), horizon_s=20).harm[0] <= impacts.first_impact_harm.sum()


def test_pairs__of_a_line_add_up_and_the_obstacle_too():
    worlds = world([2, 50, 3], [30, 40, 10, 20], [5, 5, 5, 5], obstacle=10)
    found = team_bound(worlds, (0, 1, 2, 3))  # without drive the leaders coast
    assert found.pairs[0] == pytest.approx([100 - 2 * 5 * 2, 0, 100 - 2 * 5 * 3])
    assert found.obstacle[0] == pytest.approx(30**2 - 2 * 5 * 10)
    assert found.harm[0] == pytest.approx(found.pairs[0, 1:].sum() + max(found.obstacle[0] + 80, found.combined[0]))


def test_bound__of_a_line_that_learns_whole_is_above_0_where_vehicle_2_cannot_stop_before_the_obstacle():
    worlds = world([5], [20, 20], [5, 3], driving=[5, 5], obstacle=41)  # it needs 66.7 m, and has 46
    found = team_bound(worlds, (0, 1), horizon_s=HORIZON_S)
    assert found.obstacle[0] == found.pairs[0, 0] == 0 and 50 < found.combined[0] == found.harm[0]
    assert found.harm[0] <= searched(profile_problem(worlds, (0, 1), horizon_s=HORIZON_S), "first", 2000)[0] < 80
    assert team_bound(worlds, (0, 1), horizon_s=2.0).harm[0] == 0
    assert team_bound(replace(worlds, obstacle_gap_m=np.array([62.0])), (0, 1), horizon_s=HORIZON_S).harm[0] == 0


@pytest.mark.parametrize("vehicle", [0, 1])
def test_bound_of_one_vehicle_of_two__is_that_of_lower_bound(vehicle):
    pair = worlds_of("plain", 300, 2, seed=5)
    assert np.allclose(team_bound(pair, [vehicle]).harm, lower_bound(pair, vehicle).harm, rtol=1e-9, atol=1e-8)


def test_bound__of_the_paper_line_is_hardly_below_that_of_vehicle_2_alone_and_0_where_that_one_keeps_apart():
    worlds = PAIR.sample(150, seed=5).worlds
    alone = lower_bound(worlds, 1, time_step_s=0.1).harm
    both, any_time = (team_bound(worlds, (1, 2), time_step_s=step) for step in (0.1, None))
    assert 0.995 * alone.mean() < both.harm.mean() < alone.mean()
    assert np.all(any_time.harm <= both.harm) and both.impact_proven.mean() > 0.5
    assert np.all(any_time.harm[avoidability(worlds, 1).avoidable] == 0)


def test_bound__never_rises_with_more_vehicles_that_are_free():
    worlds = worlds_of("plain", 60, 4, seed=3)
    bounds = [team_bound(worlds, chosen, horizon_s=HORIZON_S) for chosen in ((3,), (2, 3), (1, 2, 3), (0, 1, 2, 3))]
    assert np.all(np.diff([bound.early + bound.pairs.sum(axis=1) for bound in bounds], axis=0) <= 1e-6)


def test_bound__grants_vehicle_3_what_it_may_gain_by_coming_earlier():
    worlds = worlds_of("weak brakes behind", 200, 3, seed=3)
    scripted, free = (team_bound(worlds, chosen, horizon_s=HORIZON_S).combined for chosen in ((1,), (1, 2)))
    assert np.all(free <= 1.01 * scripted + 0.01) and (free < scripted - 1e-3).mean() > 0.02


def test_bound__grants_vehicle_3_the_pushes_of_those_behind():
    worlds = worlds_of("weak brakes behind", 200, 4, seed=3)
    v = worlds.vehicles
    parts = (v.braking_capacity_mps2, v.driving_capacity_mps2, v.latency_s, v.mass_t, v.speed_limit_mps)
    three = replace(
        worlds, gaps_m=worlds.gaps_m[:, :2], speeds_mps=worlds.speeds_mps[:, :3], pair_hit=worlds.pair_hit[:, :2],
        vehicles=Vehicles.at_once(*(part[:, :3] for part in parts), v.restitution),
    )  # fmt: skip
    found = [team_bound(some, (1,), horizon_s=HORIZON_S) for some in (three, worlds)]
    same = found[1].early == 0  # nobody is pushed before Vehicle 2 may act
    alone, pushed = (bound.combined[same] for bound in found)
    assert np.all(pushed <= 1.01 * alone + 0.01) and (pushed < alone - 1e-3).mean() > 0.02


@pytest.mark.parametrize(("region", "knows"), [("rear reacts first", False), ("plain", True)])
def test_bound__knows_the_decisions_of_vehicle_2_only_where_it_is_the_first_to_act(region, knows):
    worlds = worlds_of(region, 200, 3, seed=3)
    free, told = (team_bound(worlds, (1, 2), horizon_s=HORIZON_S, time_step_s=step).combined for step in (None, 0.3))
    assert np.all(free <= told) and (free > 0).any() and (free < told).any() == knows


def test_bound__counts_nothing_after_the_horizon_nor_a_pair_that_was_hit_before():
    worlds = PAIR.sample(200, seed=7).worlds
    near, usual = (team_bound(worlds, (1, 2), horizon_s=end).harm for end in (1.2, 8.0))
    assert np.all(near <= usual) and near.mean() < 0.3 * usual.mean()
    hit = replace(worlds, pair_hit=np.ones_like(worlds.pair_hit))
    assert np.all(team_bound(hit, (1, 2)).harm == 0)
    assert np.all(team_bound(hit, (1, 2), harm_count="total").harm == team_bound(worlds, (1, 2)).harm)


def test_bound__does_not_depend_on_the_batch_or_the_order_of_the_vehicles():
    worlds = load_scenario("cooperation-3-congested").sample(40, seed=7).worlds
    whole = team_bound(worlds, (2, 1), time_step_s=0.1).harm
    assert np.array_equal(whole[[7]], team_bound(worlds.take([7]), (1, 2), time_step_s=0.1).harm)


def searched(problem, harm_count, budget):
    return problem.search(problem.constant(problem.even_grid(5)), budget=budget)[1][harm_count]


def at_random(problem, rng, phases=8):
    """First-impact and total harm [n] of joint profiles whose commands are mostly extreme."""
    n, controlled = problem.n, len(problem.vehicles)
    ends = np.sort(np.minimum(rng.geometric(rng.choice([0.02, 0.1, 0.3]), (n, phases)), problem.last_step[:, None]))
    ends[:, -1] = problem.last_step
    share = rng.uniform(0, 1, (n, phases, controlled))
    share = np.where(rng.random(share.shape) < 0.7, np.round(share), share)
    low, high = problem.bounds[:, None, :, 0], problem.bounds[:, None, :, 1]
    return problem.follow(Profiles(ends, np.clip(low + (high - low) * share, low, high)))


def check(worlds, vehicles, budget, draws, seed, steps=STEPS):
    """No joint profile, searched or drawn, does less harm than the bound."""
    rng = np.random.default_rng(seed)
    for told, step in steps:
        for harm_count in ("first", "total"):
            bound = team_bound(worlds, vehicles, harm_count=harm_count, horizon_s=HORIZON_S, time_step_s=told)
            problem = profile_problem(worlds, vehicles, harm_count=harm_count, horizon_s=HORIZON_S, time_step_s=step)
            assert np.all(bound.harm <= searched(problem, harm_count, budget))
            for _ in range(draws):
                assert np.all(bound.harm <= at_random(problem, rng)[harm_count == "total"])


LINES = {  # vehicles, the controlled ones, where an obstacle stands
    "three, both that follow": (3, (1, 2), None),
    "two, the rear one": (2, (1,), None),
    "two, both": (2, (0, 1), None),
    "three, the middle one, pushed by nobody": (3, (1,), None),
    "two, both, with an obstacle": (2, (0, 1), (-3.0, 4.0)),
    "two, the front one, with an obstacle": (2, (0,), (-3.0, 4.0)),
    "three, with a far obstacle": (3, (1, 2), (0.0, 10.0)),
    "three, all, with an obstacle": (3, (0, 1, 2), (-3.0, 3.0)),
    "three, with an obstacle that is reached": (3, (1, 2), (-10.0, 2.0)),
    "five, all that follow": (5, (1, 2, 3, 4), None),
    "five, every other": (5, (0, 2, 4), None),
    "five, the second": (5, (1,), None),
}


@pytest.mark.parametrize("region", REGIONS)
def test_bound__is_never_above_a_joint_profile(region):
    check(worlds_of(region, 8, 3, seed=61), (1, 2), budget=100, draws=3, seed=62)


@pytest.mark.parametrize("kind", LINES)
@pytest.mark.parametrize("k", range(4))
def test_bound__is_never_above_a_joint_profile_of_any_line(kind, k):
    N, vehicles, obstacle = LINES[kind]
    region = ("plain", "any latency", "masses 0.05 to 100 t, restitution to 1", "weak brakes behind")[k]
    check(worlds_of(region, 6, N, 70 + k, obstacle), vehicles, budget=100, draws=2, seed=k, steps=STEPS[k % 3 :][:1])


@pytest.mark.long
@pytest.mark.parametrize("kind", LINES)
@pytest.mark.parametrize("region", REGIONS)
def test_bound__is_never_above_a_longer_joint_search(region, kind):
    N, vehicles, obstacle = LINES[kind]
    check(worlds_of(region, 50, N, 80, obstacle), vehicles, budget=1000, draws=10, seed=81)
