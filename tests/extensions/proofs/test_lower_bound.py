"""The proven lower bounds, of one vehicle and of several: by hand, what the proof rests on, and no profile below."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from ethbrake_marl.engine.profiles import Profiles, profile_problem
from ethbrake_marl.extensions.proofs.avoidability import avoidability
from ethbrake_marl.extensions.proofs.branch_and_bound import CELLS, HEAP_WIDTH, lacking
from ethbrake_marl.extensions.proofs.flights import lead, widest_flight
from ethbrake_marl.extensions.proofs.followers import after_front, held_by_leader, obstacle_harm, slowed_by_rear
from ethbrake_marl.extensions.proofs.free_rear import behind_full_braking, gained, soft_behind
from ethbrake_marl.extensions.proofs.line import FRONT_FIRST, LARGE, LINE, REAR_FIRST, follower, leader
from ethbrake_marl.extensions.proofs.lower_bound import front_first, last_soft, lower_bound, rear_first
from ethbrake_marl.extensions.proofs.meetings import gentlest, gentlest_front, meet_front, meet_rear
from ethbrake_marl.extensions.proofs.obstacle import after, after_rear, behind_leader, least_beyond
from ethbrake_marl.extensions.proofs.plans import empty_plan
from ethbrake_marl.extensions.proofs.ramped_meetings import onset_states, rounding
from ethbrake_marl.extensions.proofs.team_bound import team_bound
from ethbrake_marl.extensions.search.problem import search_profiles
from ethbrake_marl.extensions.search.shipped import best_known
from ethbrake_marl.game.harm import empty_ledger
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.motion import solo_motion
from ethbrake_marl.physics.state import Vehicles, Worlds, make_worlds
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.task import Task
from tests.fixtures.lines import (
    REGIONS,
    line,
    moved_profiles,
    opening,
    random_profiles,
    wide_worlds,
    with_rates,
    worlds_of,
)
from tests.reference.play_profile import play_profile


def play(worlds, switch, command):
    _, ledger = play_profile(worlds, 1, np.array([switch]), np.array([command]))
    return ledger.world_harm("first")[0]


# world, controlled vehicle -> squared closing speed that no profile undercuts
PAIR_BY_HAND = {
    "standing leader: 400 - 2 * 5 * 10": (line([10], [0, 20], [5, 5], driving=4), 1, 300),
    "both brake: 16 - 2 * 2 * 3": (line([3], [20, 24], [4, 6], driving=4), 1, 4),
    "the leader brakes harder: 16 + 2 * 2 * 3": (line([3], [20, 24], [6, 4], driving=4), 1, 28),
    "the leader brakes harder and is faster: 2 * 2 * 1": (line([1], [20, 18], [6, 4], driving=4), 1, 4),
    "a touch": (line([4], [20, 24], [4, 6], driving=4), 1, 0),
    "far away": (line([90], [20, 24], [4, 6], driving=4), 1, 0),
    # 16 - 2 * (2 + 2) * gap
    **{f"drives away from {gap} m": (opening(gap), 0, harm) for gap, harm in ((1.5, 4), (2, 0), (3, 0))},
}


@pytest.mark.parametrize("name", PAIR_BY_HAND)
def test_pair__by_hand_less_what_rounding_can_do_which_is_next_to_nothing(name):
    worlds, vehicle, harm = PAIR_BY_HAND[name]
    bound, outward = lower_bound(worlds, vehicle), rounding(worlds, vehicle)[0]
    assert 0.0 < outward < 2e-8 and bound.harm[0] == pytest.approx(max(harm - outward, 0.0), rel=1e-12, abs=1e-12)
    assert bound.harm[0] == (bound.front_pair if vehicle else bound.rear_pair)[0]
    assert bound.impact_proven[0] == (harm > 0)


@pytest.mark.parametrize("vehicle", [0, 1])
@pytest.mark.parametrize("step", [0.1, 0.02])
def test_bound__is_never_above_what_its_own_optimum_realises_in_steps(vehicle, step):
    # Full braking behind a leader, or full drive ahead of a follower, attains the bound; rounding alone decides.
    rng, n = np.random.default_rng(61), 4000
    worlds = make_worlds(
        rng.uniform(0.01, 60, (n, 1)) * rng.choice([0.05, 0.3, 1.0], (n, 1)), rng.uniform(0, 45, (n, 2)),
        braking_capacity_mps2=rng.uniform(1, 12, (n, 2)), driving_capacity_mps2=rng.uniform(0, 8, (n, 2)),
        latency_s=0.0, mass_t=10 ** rng.uniform(-1.3, 2, (n, 2)), restitution=rng.uniform(0, 1, n),
        speed_limit_mps=60.0,
    )  # fmt: skip
    command = -worlds.vehicles.braking_capacity_mps2
    if vehicle == 0:
        command[:, 0] = worlds.vehicles.driving_capacity_mps2[:, 0]
    bound, outward = lower_bound(worlds, vehicle).harm, rounding(worlds, vehicle)
    ledger, now = empty_ledger(worlds), worlds
    for k in range(1, round(8.0 / step) + 1):
        now, impacts = advance(now, command, until_s=np.minimum(k * step, 8.0))
        ledger = ledger.add(impacts)
    harm = ledger.world_harm("first")
    attained = (harm > 0) & (harm - bound < 1e-6)
    assert attained.sum() > 500 and np.all(bound <= harm)
    # Most of what is subtracted is not needed, and all of it is little.
    assert np.max(np.abs(harm - outward - bound)[attained]) < 0.1 * outward.max() < 1e-8


def test_both_pairs__add_up():
    # Vehicle 2 cannot drive, and coasts into neither: 300 at the front as above; the rear one is 20 m/s faster.
    bound = lower_bound(line([10, 1], [0, 20, 40], [5, 5, 5]))
    assert (bound.front_pair[0], bound.rear_pair[0]) == pytest.approx((300, 400 - 2 * 5 * 1))
    assert bound.harm[0] >= bound.front_pair[0] + bound.rear_pair[0]


def test_early__impacts_before_the_latency_are_certain():
    worlds = line([1, 50], [10, 12, 12], [5, 5, 5], latency=[1, 1, 1])  # both coast: 2 m/s
    bound = lower_bound(worlds)
    assert avoidability(worlds).reason_name[0] == "early" and bound.early[0] == pytest.approx(4)
    assert bound.front_pair[0] == 0  # hit: a further impact of this pair does not count first
    assert lower_bound(worlds, harm_count="total").early[0] == pytest.approx(4)


SHIPPED_GAPS = {  # list -> share of the best known first-impact harm that the bound leaves, at most
    "paper-distance": 0.02,
    "paper-random": 0.01,
    "paper-random-early": 0.015,
    "paper-random-brake-only": 0.035,  # the bound lets all three meet at the same instant
    "paper-delay-low": 0.02,
    "paper-delay-middle": 0.012,
    "paper-delay-high": 0.02,
    "stress-wide": 0.06,
    "paper-random-obstacle": 0.19,
}


@pytest.mark.parametrize("n", [250, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", SHIPPED_GAPS)
def test_best_known_harm__of_every_shipped_list_is_never_below_the_bound_and_near_it(name, n):
    scenario = load_scenario(name)
    worlds = scenario.sample(n if n == 250 else 2000 if "delay" in name else 5000, seed=7).worlds
    known, avoidable = best_known(worlds, Task(scenario, scenario.learners)), avoidability(worlds).avoidable
    for time_step_s in (None, scenario.time_step_s):
        bound = lower_bound(worlds, horizon_s=scenario.horizon_s, time_step_s=time_step_s)
        assert np.all(bound.harm <= np.minimum(known["first"], known["total"]))
    assert bound.harm.mean() > (1 - SHIPPED_GAPS[name]) * known["first"].mean()
    # Contact is unavoidable but no impact proven: leaning comes in, and searches do find next to no harm.
    leaning = ~avoidable & ~bound.impact_proven
    assert name in ("stress-wide", "paper-random-obstacle") or known["total"][leaning].max(initial=0.0) < 1.0
    assert np.all(known["total"][avoidable] == 0)


def searched_harm(worlds, harm_count, rounds, seed):
    """Least harm of random profiles and of changes to the best of them."""
    rng = np.random.default_rng(seed)
    switch, command = random_profiles(worlds, 1, rng)
    best = np.full(worlds.n, np.inf)
    for k in range(rounds):
        fresh = k < rounds // 4
        tried = random_profiles(worlds, 1, rng) if fresh else moved_profiles(worlds, 1, switch, command, rng)
        harm = play_profile(worlds, 1, *tried)[1].world_harm(harm_count)
        better = harm < best
        best[better] = harm[better]
        switch[better], command[better] = tried[0][better], tried[1][better]
    return best


def searched_worlds(n, seed):
    paper = [load_scenario(name).sample(n, seed=9).worlds for name in ("paper-random", "paper-delay-high")]
    standing = wide_worlds(3 * n, 3, seed + 2, strong=True)
    speeds = np.minimum(standing.speeds_mps, [np.inf, 0.0, 4.0])
    standing = replace(standing, speeds_mps=speeds, gaps_m=0.2 * standing.gaps_m)
    return Worlds.concatenate([*paper, wide_worlds(3 * n, 3, seed, strong=True), wide_worlds(n, 3, seed + 1), standing])


@pytest.mark.parametrize("harm_count", ["first", "total"])
@pytest.mark.parametrize(("n", "rounds"), [(100, 90), pytest.param(1000, 2000, marks=pytest.mark.long)])
def test_searched_profiles__are_never_below_the_bound(n, rounds, harm_count):
    worlds = searched_worlds(n, 41)
    worlds = worlds.take(~avoidability(worlds).avoidable)
    bound = lower_bound(worlds, harm_count=harm_count, horizon_s=200.0)
    best = searched_harm(worlds, harm_count, rounds, 41)
    assert np.all(bound.harm <= best)
    # The comparison has teeth: in many worlds the search comes close to the bound.
    assert np.mean(bound.harm > 0.9 * best) > 0.2


@pytest.mark.parametrize(("n", "budget"), [(15, 300), pytest.param(400, 5000, marks=pytest.mark.long)])
@pytest.mark.parametrize("obstacle", [None, (0.0, 6.0)])
@pytest.mark.parametrize("region", REGIONS)
def test_bound__is_never_above_a_searched_profile_in_any_region(region, obstacle, n, budget):
    worlds = worlds_of(region, 3 * n, 3, 51, obstacle)
    latency = worlds.vehicles.latency_s
    worlds = worlds.take(np.flatnonzero(latency[:, 0] <= latency[:, 1])[:n])  # others are refused
    any_time, decided = (lower_bound(worlds, horizon_s=60.0, time_step_s=step).harm for step in (None, 0.1))
    assert np.all(any_time <= decided)
    for bound, harm_count, step in ((decided, "first", 0.1), (decided, "total", 0.1), (any_time, "first", 0.025)):
        problem = profile_problem(worlds, [1], harm_count=harm_count, horizon_s=60.0, time_step_s=step)
        assert np.all(
            bound <= search_profiles(problem, problem.constant(problem.even_grid(9)), budget=budget)[1][harm_count]
        )


def bounded_and_found(region, n, budget, seed):
    """Where brakes build up: the bound and the least harm found, [n] each, under either count."""
    worlds = with_rates(worlds_of(region, 3 * n, 3, seed), seed)
    worlds = worlds.take(np.flatnonzero(worlds.vehicles.latency_s[:, 0] <= worlds.vehicles.latency_s[:, 1])[:n])
    for harm_count in ("first", "total"):
        problem = profile_problem(worlds, [1], harm_count=harm_count, horizon_s=20.0)
        tried = np.concatenate([problem.even_grid(9), np.zeros((worlds.n, 1, 1))], axis=1)
        found = search_profiles(problem, problem.constant(tried), budget=budget)[1][harm_count]
        yield lower_bound(worlds, harm_count=harm_count, horizon_s=20.0), found


@pytest.mark.parametrize("region", list(REGIONS)[::5])
def test_bound__is_never_above_a_searched_profile_where_brakes_build_up(region):
    for bound, found in bounded_and_found(region, 15, 300, seed=52):
        assert np.all(bound.harm <= found) and bound.contact is None


def test_where_brakes_build_up__pairs_are_exact_and_worlds_at_once_keep_their_bits():
    # v^2 / 2 after full braking that builds up, by its way: 20 m/s, 5 m/s2 at 10 m/s3 behind a leader that stands
    worlds = line([20], [0, 20], [5, 5], driving=4)
    slow = replace(worlds, vehicles=replace(worlds.vehicles, brake_rate_mps3=np.full((1, 2), 10.0)))
    way = 20 * 0.5 - 10 * 0.5**3 / 6
    assert lower_bound(slow, 1).harm[0] == pytest.approx((20 - 10 * 0.5**2 / 2) ** 2 - 2 * 5 * (20 - way))
    plain = worlds_of("plain", 40, 3, seed=53)
    mixed = lower_bound(Worlds.concatenate([plain, with_rates(plain, 53)]))
    assert np.array_equal(mixed.harm[:40], lower_bound(plain).harm)
    assert np.any(mixed.combined[40:] > mixed.front_pair[40:] + mixed.rear_pair[40:])


# What a first meeting leaves, and what the command in force costs.

PLANS = empty_plan(), empty_plan()


def state(**given):
    """A state at the onset, all else 0; no obstacle."""
    at = np.zeros(LINE.WIDTH)
    at[LINE.OBSTACLE] = math.inf
    for name, value in given.items():
        at[getattr(LINE, name)] = value
    return at


def random_states(n, seed):
    """States at the onset in which vehicle 2 brakes at least as hard as the others, as the combined bound asks."""
    rng, drawn = np.random.default_rng(seed), {}
    for names, low, high in (
        (("GAP_L", "GAP_R"), 1, 20), (("V_L", "V_F", "V_R"), 0, 32), (("A_L", "A_R", "U_F"), 2, 8),
        (("LIMIT_F",), 32, 45), (("ONSET_R",), 0, 1.5), (("FRONT_SHARE", "REAR_SHARE"), 0.1, 0.9),
        (("RESTITUTION",), 0, 0.4),
    ):  # fmt: skip
        drawn |= {name: rng.uniform(low, high, n) for name in names}
    drawn["A_F"] = np.maximum(drawn["A_L"], drawn["A_R"]) * rng.choice([1.0, 1.3], n)
    return [state(**{name: column[k] for name, column in drawn.items()}) for k in range(n)]


def follows(kind, at, time, closing):
    """The least squared closing speed at the other pair after such a meeting."""
    return after(kind, at, time, time, closing, time, 0.0, *PLANS)


def test_gentlest_meeting__is_driven_and_falls_with_the_time():
    met = 0
    for at in random_states(300, seed=43):
        for kind, meet in ((FRONT_FIRST, meet_front), (REAR_FIRST, meet_rear)):
            coming = meet(at, np.inf if kind == FRONT_FIRST else 99.0, *PLANS)
            times = np.array([meet(at, parameter, *PLANS) for parameter in np.linspace(0, 3, 13)])
            times = np.sort(times[np.isfinite(times) & (times >= coming)])
            found = np.array([gentlest(kind, at, time) for time in times]).reshape(-1, 2)
            met += times.size > 1
            assert np.all(np.diff(found[:, 0]) < 1e-5)
            for time, (_, parameter) in zip(times, found, strict=True):
                if np.isfinite(parameter):
                    assert meet(at, parameter, *PLANS) == pytest.approx(time, abs=1e-5)
    assert met > 200


def test_what_follows__falls_with_the_closing_speed_and_rises_with_the_time():
    some = 0
    for at in random_states(300, seed=44):
        stand, apart = at[LINE.V_L] / at[LINE.A_L], at[LINE.GAP_L] + at[LINE.GAP_R]
        for kind in (FRONT_FIRST, REAR_FIRST):
            times = [t for t in (0.1, 0.4, 0.8, 1.6) if leader(at, t)[1] - follower(at, t)[1] > -apart]  # the outer two
            times = [t for t in times if kind == REAR_FIRST or t < stand]
            if not times:
                continue
            harm = np.array([[follows(kind, at, t, w) for w in (0, 0.5, 1, 2, 4)] for t in times])
            some += np.any(harm > 0)
            assert np.all(np.diff(harm, axis=1) < 1e-7)
            if kind == FRONT_FIRST:
                assert np.all(np.diff(harm, axis=0) > -1e-7)
    assert some > 100


# gaps, rear vehicle's latency, command, first-impact harm of both pairs; after which meeting, and of which pair
BOUNCES = {
    # 12 against 10 m/s: both at 11 -+ 0.4. With 4 m/s2 they are together again after 0.2 s, at 11.4 m/s, 2.2 m on.
    "in front, and driving on": (FRONT_FIRST, [0, 3.8], [10, 12, 30], 1.0, 4.0, [4, 18.6**2]),
    # 20 against 18 m/s: both at 19 -+ 0.4. Vehicle 3, at 4 m/s2, would be back after 0.4 s and 7.12 m; 1 cm before
    # that, vehicle 2 has 19.4^2 - 2 * 8 * 7.11.
    "behind, and braking": (REAR_FIRST, [7.11, 0], [0, 18, 20], 0.0, -8.0, [262.6, 4]),
}


@pytest.mark.parametrize("name", BOUNCES)
def test_after__is_nearly_attained_by_bouncing_off(name):
    kind, gaps, speeds, onset, command, harm = BOUNCES[name]
    worlds = line(gaps, speeds, [4, 8, 4], [0, 0, onset], driving=4, restitution=0.4, limit=40)
    _, ledger = play_profile(worlds, 1, np.array([[0.0]]), np.array([[command]]))
    assert ledger.first_impact_harm[0] == pytest.approx(harm)
    at = state(
        GAP_L=gaps[0], GAP_R=gaps[1], V_L=speeds[0], V_F=speeds[1], V_R=speeds[2], A_L=4, A_F=8, A_R=4, U_F=4,
        LIMIT_F=40, ONSET_R=onset, FRONT_SHARE=0.5, REAR_SHARE=0.5, RESTITUTION=0.4,
    )  # fmt: skip
    found, other = follows(kind, at, 0.0, 2.0), max(harm)
    assert other * (1 - 1e-4) <= found <= other * (1 + 1e-12)


ROOM = *PLANS, np.empty((CELLS, HEAP_WIDTH))
WALLED = dict(V_L=11, A_L=5, A_F=5, A_R=5, U_F=5, FRONT_SHARE=0.5, REAR_SHARE=0.5, WALL=9.5, UNTIL=99)
PUSHED = dict(V_L=10, A_L=5, FRONT_SHARE=0.5)
HELD = dict(V_L=10, A_L=8, V_F=20, A_F=4, U_F=2, LIMIT_F=40, V_R=30, A_R=4, FRONT_SHARE=0.9, GAP_R=100 - 121 / 14)
SLOWED = dict(V_L=0, A_L=5, V_F=18, A_F=8, V_R=20, A_R=4, REAR_SHARE=0.5)
SOFT = dict(V_L=30, A_L=1, V_F=18, A_F=5, U_F=4, V_R=21, A_R=7, GAP_L=50, GAP_R=1)
MEETINGS = {  # function, state, what else it is given -> value
    # 12 against 10 m/s, equal masses, no bounce: both at 11. Brakes of 5 take 2 * 5 * 11 of 121 on the way of 11 m.
    "obstacle, met by a leader pushed on": (obstacle_harm, {**PUSHED, "OBSTACLE": 11}, (0.0, 2.0), 11),
    "obstacle, too far": (obstacle_harm, {**PUSHED, "OBSTACLE": 13}, (0.0, 2.0), 0),
    # It takes (11 - sqrt(11)) / 5 = 1.54 s.
    "obstacle, too late": (obstacle_harm, {**PUSHED, "OBSTACLE": 11, "UNTIL": 1.5}, (0.0, 2.0), 0),
    # The leader stops at the obstacle itself: all three are one cluster.
    "obstacle, reached by itself": (obstacle_harm, {**PUSHED, "OBSTACLE": 10}, (0.0, 2.0), 0),
    # Three alike, 12 m/s and 5 m/s2: at a wall 9.5 m off after 1 s. So a leader from there, braking: 9.5 - 2.5 = 7 m/s.
    "obstacle, all three come": (least_beyond, WALLED, (0.0, 0.0, 0.0, 12.0, 0.0, *PLANS), 49),
    # The rear vehicle, at 20 m/s, is at the obstacle after 1 s; f, from 10 m behind it at 12 m/s, brakes (5) and then
    # drives (5) for t: 12 - 2.5 + 5 t^2 = 10. So it is at 12 - 5 + 10 t m/s.
    "obstacle, nobody passes": (
        behind_leader, {**WALLED, "WALL": 10, "GAP_R": 10, "V_R": 20, "ONSET_R": 9},
        (0.0, 0.0, 2.0, 2.0, 1e4, -99.0, 0.0, *PLANS), (20 - 7 - 10 * math.sqrt(0.1)) ** 2,
    ),
    # Both at 19 after 20 against 18 m/s; the rear one, braking harder, is no help: 19^2 - 2 * 4 * 7.
    "after rear, of one that brakes less": (
        after_rear, dict(GAP_L=7, V_L=0, A_L=5, V_F=18, A_F=4, V_R=20, A_R=8, REAR_SHARE=0.5),
        (0.0, 0.0, 2.0, 0.0, 0.0, *PLANS), 361 - 56,
    ),
    # 20 against 10 m/s, nine tenths of the mass in front, no bounce: both at 11, slowing by 0.9 * 8 - 0.1 * 2 = 7, and
    # rest after 11^2 / 14 m. The rear one, at 30 m/s with 4, comes there after 100 m in all: 900 - 800.
    "held by the leader": (held_by_leader, HELD, (0.0, 0.0, 10.0, *PLANS), 10.0),
    "not held by one that brakes harder": (held_by_leader, {**HELD, "A_F": 9}, (0.0, 0.0, 10.0, *PLANS), 0),
    # 20 against 18 m/s: both at 19, slowing by 6, and by 7 on average for f alone. 7 m before one that stands.
    "slowed by the rear": (
        slowed_by_rear, SLOWED, (0.0, 2.0, 7.0, *PLANS), 19 - 7 * (19 - math.sqrt(19**2 - 2 * 6 * 7)) / 6,
    ),
    "slowed, but the closing speed may rise": (slowed_by_rear, {**SLOWED, "A_L": 7.5}, (0.0, 2.0, 7.0, *PLANS), 0),
    # It was faster by 2 t a time t before, over 1 m: t is at most 1 s, and 1.5 s for 3 m/s.
    "last soft meeting": (last_soft, SOFT, (9.0, *PLANS), 1.0),
    "last soft meeting, from far": (last_soft, {**SOFT, "GAP_R": 90}, (9.0, *PLANS), 1.5),
    # Till its onset it can be left behind by up to 4, or be come towards by up to 5.
    "last soft meeting, late": (last_soft, {**SOFT, "GAP_R": 90, "ONSET_R": 0.2}, (9.0, *PLANS), 0.2 + 4 / 2),
}  # fmt: skip


@pytest.mark.parametrize("name", MEETINGS)
def test_meeting__by_hand(name):
    function, given, more, value = MEETINGS[name]
    assert function(state(**given), *more) == pytest.approx(value, rel=1e-4)


@pytest.mark.parametrize(
    ("given", "squared"),
    [
        # Parted with 1 m/s from one that brakes harder by 4: 0.125 m. Driving closes with 13: 2 * 13 * 0.125 = 13 / 4.
        ((0.8, 4.0, 13.0, 7.0, 0.1, 10.0, 0.0, 3.0), 13 / 4),
        ((0.8, 0.0, 13.0, 7.0, 0.1, 10.0, 0.0, 3.0), math.inf),  # it may stay behind for ever
        ((0.8, 4.0, 13.0, 7.0, 0.9, 10.0, 0.0, 3.0), math.inf),  # every touch throws it further
        # Thrown back with 0.5 m/s, it rolls for 3 s at most: 2 * 7 * 1.5 more.
        ((0.8, 4.0, 13.0, 7.0, 0.1, 10.0, 0.5, 3.0), 13 / 4 + 21),
    ],
)
def test_widest_flight__is_attained_by_braking_to_the_top_of_the_gap_and_driving(given, squared):
    assert widest_flight(*given) ** 2 == pytest.approx(squared)


def test_obstacle__takes_the_centre_of_mass_from_the_proof():
    at = state(GAP_R=4, V_L=10, A_L=5, V_F=12, A_F=7, U_F=7, LIMIT_F=40, V_R=20, A_R=6, FRONT_SHARE=0.5)
    free = after_front(at, 0.0, 0.0, 2.0, 0.0, 0.0, *PLANS)
    at[LINE.OBSTACLE] = 11
    assert after_front(at, 0.0, 0.0, 2.0, 0.0, 0.0, *PLANS) < free


def test_command_in_force__the_way_to_meet_gently_is_the_wrong_one_after_it():
    # In the step from 1 to 2 s; the gentlest meeting at 1.5 s drives for the first second, then brakes with 8.
    given = dict(V_L=0, A_L=1, A_F=8, U_F=0, LIMIT_F=40, V_R=9, A_R=1)
    assert gentlest_front(state(GAP_L=2, V_F=2, **given), 1.5) == pytest.approx((0.0, 1.0), abs=1e-9)
    at, half = state(GAP_L=10, V_F=8, **given), math.sqrt(0.5)
    closing, drive = gentlest_front(at, 1.5)
    assert (closing, drive) == pytest.approx((8 - 8 * half, 1.5 - half))
    # 0.5 s at c instead of -8 and braking earlier instead: the speed at the end is higher by (8 + c) / 2 times 0.5 s or
    # more. With 0.5 m/s more than the least, it brakes steeper by the share that is left before the command in force.
    steep = 0.5 / (1.0 - drive)
    lack = [lacking(kind, at, start, 1.5, closing, closing + more, 1.0) for kind, start, more in (
        (FRONT_FIRST, 1.5, 0.5), (FRONT_FIRST, 1.5, 0.0), (REAR_FIRST, 1.0, 0.0)
    )]  # fmt: skip
    assert lack == pytest.approx([8 - (1 + steep) / (1 + 0.5 * steep), 8, 0])


@pytest.mark.parametrize(("share", "press", "reach"), [(0.2, 13, 14), (0.45, 13, 14), (0.55, 13, 14), (0.78, 13, 9)])
def test_lead__is_what_a_flight_gains_less_the_command_it_costs(share, press, reach):
    # Every flight, tried: brake for s, then drive until the partner is met again. The last one brakes less than it.
    opens, s = 0.3, np.linspace(0.0, 0.5, 501)
    gap, relative = opens * s + 0.5 * (reach - press) * s * s, -(opens + (reach - press) * s)
    met = (-relative + np.sqrt(relative**2 + 2 * press * np.maximum(gap, 0.0))) / press
    best = np.max((share * (relative + press * met) - reach * s * (1.0 - share))[gap >= 0.0])
    found = lead(share, press, reach, opens, 0.0, 50.0, 0.0)
    assert found >= best - 1e-9 and found == pytest.approx(best, abs=2e-3)


# One stands 5 m ahead, the other comes from 100 m behind; 60 m ahead it may come in time.
BEFORE = dict(V_L=0, A_L=5, V_F=20, LIMIT_F=40, GAP_R=100, A_R=4)


def test_first_meeting__of_the_rear_is_impossible_where_the_leader_must_be_met_before():
    near, far = (state(**BEFORE, GAP_L=gap, A_F=6, U_F=4, V_R=40, FRONT_SHARE=0.9) for gap in (5, 60))
    assert rear_first(near, 0.0, LARGE, -1.0, *ROOM) == LARGE > rear_first(far, 0.0, LARGE, -1.0, *ROOM)
    # Nor of all at once: 400 - 2 * 4.5 * 5 in front; the rear one has 900 - 840 left, less what is pushed on.
    at = state(**BEFORE, GAP_L=5, A_F=4.5, U_F=0, V_R=30, FRONT_SHARE=0.98, REAR_SHARE=0.5)
    assert front_first(at, 0.0, LARGE, -1.0, *ROOM) > 400 - 2 * 4.5 * 5 + 30


# First meetings with a rear vehicle that does as it likes: every one that is played lies within what is bounded.
STEP_S, FAR_M = 0.2, 1e4


def played(worlds, rng):
    """First meetings under joint commands that are mostly extreme: world, time, closing speed, and the state there."""
    v, now = worlds.vehicles, worlds
    low, high = -v.braking_capacity_mps2, v.driving_capacity_mps2
    share = np.round(rng.uniform(0, 1, (worlds.n, 3)))
    for k in range(20):
        share = np.where(rng.random(share.shape) < 0.4, np.round(rng.uniform(0, 1, share.shape), k % 2), share)
        share[:, 0] = 0.0  # the leader brakes fully
        command = np.clip(low + (high - low) * share, low, high)
        after, impacts = advance(now, command, STEP_S, record=True)
        rows = impacts.rows
        for j in np.flatnonzero(rows.first & (rows.pair == 1)):
            world, time = rows.world[j], rows.time_s[j]
            there, _ = advance(now.take([world]), command[[world]], until_s=max(time - 1e-9, now.time_s[world]))
            yield world, time, rows.closing_speed_mps[j], there
        now = after


def test_played_meetings__lie_within_the_bounds_of_every_cell_that_holds_them():
    rng, checked, earlier, n = np.random.default_rng(3), 0, 0, 400
    latency = np.stack([np.zeros(n), np.zeros(n), rng.uniform(0, 1, n)], axis=1)
    worlds = make_worlds(  # lines of three whose leader is out of reach
        np.stack([np.full(n, FAR_M), rng.uniform(0.2, 8, n)], axis=1), rng.uniform(15, 25, (n, 3)),
        braking_capacity_mps2=rng.uniform(2, 9, (n, 3)), driving_capacity_mps2=rng.uniform(0, 8, (n, 3)),
        latency_s=latency, mass_t=1, restitution=0, speed_limit_mps=rng.uniform(25, 60, (n, 3)),
    )  # fmt: skip
    v = worlds.vehicles
    for world, time, closing, there in played(worlds, np.random.default_rng(4)):
        row = onset_states(worlds.take([world]), 1, None)[0]
        since, power = row[LINE.ONSET_R], row[LINE.A_R] + v.driving_capacity_mps2[world, 2]
        if time > since + row[LINE.V_R] / row[LINE.A_R]:
            continue  # the one that brakes fully stands by then
        speed, way, _ = solo_motion(row[LINE.V_R], -row[LINE.A_R], since, math.inf, time)
        _, way_l, _ = solo_motion(worlds.speeds_mps[world, 0], -v.braking_capacity_mps2[world, 0], 0.0, math.inf, time)
        further = max(FAR_M + way_l - there.gaps_m[0, 0] + row[LINE.GAP_R] - way, 0.0)
        faster = there.speeds_mps[0, 2] - speed
        assert all(faster >= gained(further - 1e-6, time, since, reach) - 1e-3 for reach in (power, math.inf))
        for before, later, near, far in ((0, 0, 1, 1), (0.5, 0.5, 0.5, 1.5), (1, 0.2, 0, 3), (0, 1, 0.9, 1)):
            early, late = (1 - before) * time, (1 + later) * time
            cell = early, late, max(near * further - 1e-6, 0.0), far * further + 1e-6
            assert behind_full_braking(row, early, late) <= cell[3] + 1e-6
            assert soft_behind(row, *cell, since, power) <= closing + 1e-3
        checked, earlier = checked + 1, earlier + (further > 0.1)
    assert checked > 100 and earlier > 50


# What is claimed where, and what is not.


def test_a_standing_vehicle__may_wait_before_it_drives():
    worlds = line(
        [1, 33],
        [15, 0, 15],
        [10, 13, 2],
        [0, 1.3, 1.3],
        driving=8,
        mass=[12, 13, 1],
        restitution=0.4,
        limit=[15, 13.5, 15],
    )
    assert avoidability(worlds).reason_name[0] == "rear"
    at_once, later = (play(worlds, [0.0, start, start + 1], [-13.0, 8.0, -13.0]) for start in (1.3, 1.577))
    assert lower_bound(worlds, horizon_s=100.0).harm[0] <= later < 21 < at_once


def test_combined__is_claimed_only_where_contact_is_unavoidable_and_not_early():
    worlds = wide_worlds(1500, 3, seed=46, strong=True)
    reason, bound = avoidability(worlds).reason, lower_bound(worlds, harm_count="total", horizon_s=200.0)
    assert np.all(bound.combined[reason < 2] == 0) and np.mean(bound.combined[reason >= 2] > 0) > 0.5
    assert np.all(bound.harm[reason == 0] == 0)


def test_leaning__is_contact_but_no_impact_and_none_is_proven():
    # Vehicle 3 touches vehicle 2 from the start and coasts on when vehicle 2 brakes: it is slowed by it.
    worlds = line([12, 0], [20, 20, 20], [6, 7, 6], [0, 0.1, 0.8], driving=7)
    assert avoidability(worlds).reason_name[0] == "rear"
    assert play(worlds, [0.0], [-7.0]) == lower_bound(worlds).harm[0] == 0


def test_horizon__what_comes_later_does_not_count():
    worlds = load_scenario("paper-random").sample(300, seed=10).worlds
    near, usual, far = (lower_bound(worlds, horizon_s=end).harm for end in (1.5, 8.0, 100.0))
    assert np.array_equal(usual, far)
    assert np.all(near <= usual) and near.mean() < 0.5 * usual.mean()


def test_decisions__leave_less_room_than_any_time():
    scenario = load_scenario("paper-random")
    worlds = scenario.sample(100, seed=7).worlds
    any_time, decided = lower_bound(worlds), lower_bound(worlds, time_step_s=scenario.time_step_s)
    often = lower_bound(worlds, time_step_s=1e-3)
    assert np.all(any_time.harm <= decided.harm) and decided.harm.mean() > 1.02 * any_time.harm.mean()
    assert often.harm.mean() < 1.01 * any_time.harm.mean()


def test_lower_bound__an_obstacle_that_was_struck_is_not_charged_again():
    """Of a state in mid-episode: the first impact on the obstacle is over, and what is pushed there again is free."""
    worlds = load_scenario("paper-random-obstacle").sample(300, 7).worlds
    again = replace(worlds, obstacle_hit=np.ones(worlds.n, np.bool_))
    fresh = lower_bound(worlds, time_step_s=0.1)
    struck, total = (lower_bound(again, time_step_s=0.1, harm_count=count) for count in ("first", "total"))
    assert (fresh.combined > fresh.front_pair + fresh.rear_pair).sum() > 20
    assert not struck.combined.any() and (struck.harm == struck.early + struck.front_pair + struck.rear_pair).all()
    assert (total.harm == fresh.harm).all()


@pytest.mark.parametrize("time_step_s", [None, 0.1])
@pytest.mark.parametrize("mass_t", [[1.0, 1.0, 1.0], [4.5, 5.5, 5.9], [50.0, 1.0, 1.0]])
@pytest.mark.parametrize("restitution", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("drive_mps2", [0.0, 1e-9, 3.0])
def test_lower_bound__who_stands_at_the_leader_is_struck_together_with_it(time_step_s, mass_t, restitution, drive_mps2):
    """One impact of all three: the front pair closes at 0 in it, and no second one follows."""
    worlds = line([0, 20], [0, 0, 20], 6.0, driving=drive_mps2, mass=mass_t, restitution=restitution, limit=40)
    harm = play(worlds, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert harm == pytest.approx(20.0**2 - 2 * 6 * 20)
    assert 0.0 < lower_bound(worlds, horizon_s=60.0, time_step_s=time_step_s).harm[0] <= harm


# ---------------------------------------------------------------- several controlled vehicles: joint profiles

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
    return search_profiles(problem, problem.constant(problem.even_grid(5)), budget=budget)[1][harm_count]


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
            assert all(np.all(bound.harm <= at_random(problem, rng)[harm_count == "total"]) for _ in range(draws))


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
