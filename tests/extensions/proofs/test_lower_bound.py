"""The proven lower bound: by hand, what the proof rests on, and no profile below."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.extensions.proofs.avoidability import avoidability
from ethbrake_marl.extensions.proofs.branch_and_bound import CELLS, HEAP_WIDTH, lacking
from ethbrake_marl.extensions.proofs.flights import lead, widest_flight
from ethbrake_marl.extensions.proofs.followers import after, after_rear, held_by_leader, slowed_by_rear
from ethbrake_marl.extensions.proofs.line import FRONT_FIRST, LARGE, LINE, REAR_FIRST, follower, leader
from ethbrake_marl.extensions.proofs.lower_bound import front_first, last_soft, lower_bound, rear_first
from ethbrake_marl.extensions.proofs.meetings import gentlest, gentlest_front, meet_front, meet_rear
from ethbrake_marl.extensions.proofs.onset import rounding
from ethbrake_marl.extensions.proofs.plans import empty_plan
from ethbrake_marl.extensions.search.problem import search_profiles
from ethbrake_marl.extensions.search.shipped import best_known
from ethbrake_marl.first_edition.engine.profiles import profile_problem
from ethbrake_marl.first_edition.game.harm import empty_ledger
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.state import Worlds, make_worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.task import Task
from tests.fixtures.lines import REGIONS, line, moved_profiles, opening, random_profiles, wide_worlds, worlds_of
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
    assert name == "stress-wide" or known["total"][leaning].max(initial=0.0) < 1.0
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
@pytest.mark.parametrize("region", REGIONS)
def test_bound__is_never_above_a_searched_profile_in_any_region(region, n, budget):
    worlds = worlds_of(region, 3 * n, 3, 51)
    latency = worlds.vehicles.latency_s
    worlds = worlds.take(np.flatnonzero(latency[:, 0] <= latency[:, 1])[:n])  # others are refused
    any_time, decided = (lower_bound(worlds, horizon_s=60.0, time_step_s=step).harm for step in (None, 0.1))
    assert np.all(any_time <= decided)
    for bound, harm_count, step in ((decided, "first", 0.1), (decided, "total", 0.1), (any_time, "first", 0.025)):
        problem = profile_problem(worlds, [1], harm_count=harm_count, horizon_s=60.0, time_step_s=step)
        assert np.all(
            bound <= search_profiles(problem, problem.constant(problem.even_grid(9)), budget=budget)[1][harm_count]
        )


# What a first meeting leaves, and what the command in force costs.

PLANS = empty_plan(), empty_plan()


def state(**given):
    """A state at the onset, all else 0."""
    at = np.zeros(LINE.WIDTH)
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
HELD = dict(V_L=10, A_L=8, V_F=20, A_F=4, U_F=2, LIMIT_F=40, V_R=30, A_R=4, FRONT_SHARE=0.9, GAP_R=100 - 121 / 14)
SLOWED = dict(V_L=0, A_L=5, V_F=18, A_F=8, V_R=20, A_R=4, REAR_SHARE=0.5)
SOFT = dict(V_L=30, A_L=1, V_F=18, A_F=5, U_F=4, V_R=21, A_R=7, GAP_L=50, GAP_R=1)
MEETINGS = {  # function, state, what else it is given -> value
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
