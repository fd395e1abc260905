"""The lower bound of several controlled vehicles: by hand, against the bound of one, and against joint profiles."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.limits.lower_bound import avoidability, lower_bound, team_bound
from ethbrake_marl.physics import advance, make_worlds
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.search import Profiles, profile_problem
from tests.limits.team_worlds import REGIONS, worlds_of

HORIZON_S = 60.0
STEPS = ((0.1, 0.1), (None, 0.025), (0.02, 0.02))  # what the bound is told, and when the searched profiles change


def line(gaps, speeds, braking, **given):
    """One world, all vehicles free to act at once and without drive unless told otherwise."""
    driving, latency = given.get("driving", [0] * len(speeds)), given.get("latency", [0] * len(speeds))
    return make_worlds(
        [gaps], [speeds], braking_capacity_mps2=[braking], driving_capacity_mps2=[driving], latency_s=[latency],
        mass_t=given.get("mass", 1), restitution=given.get("restitution", 0.1),
        obstacle_gap_m=given.get("obstacle"), speed_limit_mps=given.get("limit", 60.0),
    )  # fmt: skip


def test_pair__whose_leader_drives_away_is_met_with_what_is_left():
    worlds = line([5], [10, 20], [5, 5], driving=[2, 0], latency=[0, 1])
    found = team_bound(worlds, (0, 1))
    assert found.harm[0] == pytest.approx(100 - 2 * 2 * 5)  # w^2 - 2 u d, before the follower may act
    assert team_bound(worlds, (1,)).harm[0] == pytest.approx(10**2 + 2 * 5 * 5)  # early: the leader brakes instead


def test_pair__behind_a_leader_that_brakes_harder_and_drew_ahead_is_bounded_by_the_gap():
    worlds = line([4], [20, 18], [8, 4])  # w = -2: driving would make the gap shrink sooner, at sqrt(2 (8 - 4) 4)
    assert team_bound(worlds, (1,)).harm[0] == pytest.approx(2 * 4 * 4)


def test_pair__of_a_leader_that_brakes_late_counts_what_the_follower_must_make_up():
    late = line([8], [10, 14], [6, 6], latency=[1, 0])  # the leader coasts for 1 s, the follower brakes at once
    assert team_bound(late, (1,)).harm[0] == 0
    late = line([2], [10, 14], [6, 3], latency=[1, 0])
    _, impacts = advance(late, -late.vehicles.braking_capacity_mps2, until_s=20.0)
    assert 0 < team_bound(late, (1,), horizon_s=20).harm[0] <= impacts.first_impact_harm.sum()


def test_pairs__of_a_line_add_up_and_the_obstacle_too():
    worlds = line([2, 50, 3], [30, 40, 10, 20], [5, 5, 5, 5], obstacle=10)
    found = team_bound(worlds, (0, 1, 2, 3))  # without drive the leaders coast
    assert found.pairs[0] == pytest.approx([100 - 2 * 5 * 2, 0, 100 - 2 * 5 * 3])
    assert found.obstacle[0] == pytest.approx(30**2 - 2 * 5 * 10)
    assert found.harm[0] == pytest.approx(found.pairs[0, 1:].sum() + max(found.obstacle[0] + 80, found.combined[0]))


def test_bound__of_a_line_that_learns_whole_is_above_0_where_vehicle_2_cannot_stop_before_the_obstacle():
    worlds = line([5], [20, 20], [5, 3], driving=[5, 5], obstacle=41)  # it needs 66.7 m, and has 46
    found = team_bound(worlds, (0, 1), horizon_s=HORIZON_S)
    assert found.obstacle[0] == found.pairs[0, 0] == 0 and 50 < found.combined[0] == found.harm[0]
    assert found.harm[0] <= searched(profile_problem(worlds, (0, 1), horizon_s=HORIZON_S), "first", 2000)[0] < 80
    assert team_bound(worlds, (0, 1), horizon_s=2.0).harm[0] == 0
    wider = replace(worlds, obstacle_gap_m=np.array([62.0]))
    assert team_bound(wider, (0, 1), horizon_s=HORIZON_S).harm[0] == 0


@pytest.mark.parametrize("vehicle", [0, 1])
def test_bound_of_one_vehicle_of_two__is_that_of_lower_bound(vehicle):
    worlds = load_scenario("paper-random").sample(300, seed=5).worlds
    v = worlds.vehicles
    pair = make_worlds(
        worlds.gaps_m[:, :1], worlds.speeds_mps[:, :2], braking_capacity_mps2=v.braking_capacity_mps2[:, :2],
        driving_capacity_mps2=v.driving_capacity_mps2[:, :2], latency_s=np.full((300, 2), [0.0, 0.5]),
        mass_t=v.mass_t[:, :2], restitution=0.1,
    )  # fmt: skip
    assert np.allclose(team_bound(pair, [vehicle]).harm, lower_bound(pair, vehicle).harm, rtol=1e-9, atol=1e-8)


def test_bound__of_the_paper_line_is_hardly_below_that_of_vehicle_2_alone():
    worlds = load_scenario("cooperation-3-pair").sample(300, seed=5).worlds
    alone = lower_bound(worlds, 1, time_step_s=0.1).harm
    both = team_bound(worlds, (1, 2), time_step_s=0.1)
    assert 0.995 * alone.mean() < both.harm.mean() < alone.mean()
    assert np.all(team_bound(worlds, (1, 2)).harm <= both.harm)
    assert both.impact_proven.mean() > 0.5


def test_bound__is_zero_where_the_pair_keeps_apart():
    worlds = load_scenario("cooperation-3-pair").sample(300, seed=5).worlds
    assert np.all(team_bound(worlds, (1, 2)).harm[avoidability(worlds, 1).avoidable] == 0)


def test_bound__never_rises_with_more_vehicles_that_are_free():
    worlds = worlds_of("plain", 60, 4, seed=3)
    sets = [(3,), (2, 3), (1, 2, 3), (0, 1, 2, 3)]
    pairs = [team_bound(worlds, chosen, horizon_s=HORIZON_S) for chosen in sets]
    for fewer, more in pairwise(pairs):
        assert np.all(more.early + more.pairs.sum(axis=1) <= fewer.early + fewer.pairs.sum(axis=1) + 1e-6)


def test_bound__grants_vehicle_3_what_it_may_gain_by_coming_earlier():
    worlds = worlds_of("weak brakes behind", 200, 3, seed=3)
    scripted, free = (team_bound(worlds, chosen, horizon_s=HORIZON_S).combined for chosen in ((1,), (1, 2)))
    assert np.all(free <= 1.01 * scripted + 0.01) and (free < scripted - 1e-3).mean() > 0.02


def test_bound__grants_vehicle_3_the_pushes_of_those_behind():
    worlds = worlds_of("weak brakes behind", 200, 4, seed=3)
    v = worlds.vehicles
    three = make_worlds(
        worlds.gaps_m[:, :2], worlds.speeds_mps[:, :3], braking_capacity_mps2=v.braking_capacity_mps2[:, :3],
        driving_capacity_mps2=v.driving_capacity_mps2[:, :3], latency_s=v.latency_s[:, :3], mass_t=v.mass_t[:, :3],
        restitution=v.restitution, speed_limit_mps=60.0,
    )  # fmt: skip
    found = [team_bound(some, (1,), horizon_s=HORIZON_S) for some in (three, worlds)]
    same = found[1].early == 0  # nobody is pushed before Vehicle 2 may act
    alone, pushed = (bound.combined[same] for bound in found)
    assert np.all(pushed <= 1.01 * alone + 0.01) and (pushed < alone - 1e-3).mean() > 0.02


def test_bound__knows_the_decisions_of_vehicle_2_only_where_it_is_the_first_to_act():
    worlds = worlds_of("rear reacts first", 200, 3, seed=3)
    bounds = [team_bound(worlds, (1, 2), horizon_s=HORIZON_S, time_step_s=step).combined for step in (None, 0.3)]
    assert np.array_equal(*bounds) and (bounds[0] > 0).any()
    worlds = worlds_of("plain", 200, 3, seed=3)
    bounds = [team_bound(worlds, (1, 2), horizon_s=HORIZON_S, time_step_s=step).combined for step in (None, 0.3)]
    assert np.all(bounds[0] <= bounds[1]) and (bounds[0] < bounds[1]).any()


def test_bound__counts_nothing_after_the_horizon_nor_a_pair_that_was_hit_before():
    worlds = load_scenario("cooperation-3-pair").sample(200, seed=7).worlds
    near, usual = (team_bound(worlds, (1, 2), horizon_s=end).harm for end in (1.2, 8.0))
    assert np.all(near <= usual) and near.mean() < 0.3 * usual.mean()
    hit = replace(worlds, pair_hit=np.ones_like(worlds.pair_hit))
    assert np.all(team_bound(hit, (1, 2)).harm == 0)
    assert np.all(team_bound(hit, (1, 2), harm_count="total").harm == team_bound(worlds, (1, 2)).harm)


def test_bound__does_not_depend_on_the_batch_or_the_order_of_the_vehicles():
    worlds = load_scenario("cooperation-3-congested").sample(40, seed=7).worlds
    whole = team_bound(worlds, (2, 1), time_step_s=0.1).harm
    assert np.array_equal(whole[[7]], team_bound(worlds.take([7]), (1, 2), time_step_s=0.1).harm)


@pytest.mark.parametrize(
    ("vehicles", "given", "told"),
    [
        ((), {}, r"vehicles \(\): at least one is needed, each once"),
        ((1, 1), {}, r"vehicles \(1, 1\)"),
        ((1, 3), {}, r"a vehicle = 3: must be a whole number in 0\.\.2"),
        (1, {}, "vehicles 1: must be a list of vehicles"),
        ((1.0, 2.0), {}, "a vehicle = 1.0: must be a whole number"),
        ((True,), {}, "a vehicle = True: must be a whole number"),
        ("12", {}, "a vehicle = '1': must be a whole number"),
        ((1, 2), {"horizon_s": "8"}, "horizon_s '8': must be a number of seconds"),
        ((1, 2), {"scripts": {"vehicle_1": "coast"}}, "a vehicle of scripts = 'vehicle_1'"),
        ((1, 2), {"harm_count": "worst"}, "count 'worst'"),
        ((1, 2), {"time_step_s": 0.0}, "time_step_s 0.0: must be a number of seconds from 0.001 on"),
        ((1, 2), {"horizon_s": 0.2}, "horizon_s 0.2: must be finite and at least 0.5"),
        ((1, 2), {"horizon_s": float("nan")}, "horizon_s nan"),
        ((1, 2), {"scripts": {0: "coast"}}, "vehicle_1 follows 'coast'; must be 'full_brake'"),
    ],
)
def test_team_bound__refuses_what_it_does_not_cover(vehicles, given, told):
    with pytest.raises(InvalidInput, match=told):
        team_bound(load_scenario("cooperation-3-pair").sample(2, seed=7).worlds, vehicles, **given)


def searched(problem, harm_count, budget):
    given = problem.constant(problem.even_grid(5))
    return problem.search(given, budget=budget)[1][harm_count]


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


@pytest.mark.parametrize("region", REGIONS)
def test_bound__is_never_above_a_joint_profile(region):
    check(worlds_of(region, 8, 3, seed=61), (1, 2), budget=100, draws=3, seed=62)


LINES = {
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


@pytest.mark.parametrize("kind", LINES)
def test_bound__is_never_above_a_joint_profile_of_any_line(kind):
    N, vehicles, obstacle = LINES[kind]
    for k, region in enumerate(
        ("plain", "any latency", "masses 0.05 to 100 t, restitution to 1", "weak brakes behind")
    ):
        steps = STEPS[k % len(STEPS) :][:1]
        check(worlds_of(region, 6, N, 70 + k, obstacle), vehicles, budget=100, draws=2, seed=k, steps=steps)


@pytest.mark.long
@pytest.mark.parametrize("region", REGIONS)
def test_bound__is_never_above_a_longer_joint_search(region):
    for k, (N, vehicles, obstacle) in enumerate(LINES.values()):
        check(worlds_of(region, 25, N, 80 + k, obstacle), vehicles, budget=800, draws=5, seed=k)
    check(worlds_of(region, 100, 3, seed=90), (1, 2), budget=2000, draws=20, seed=91)
