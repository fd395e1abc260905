"""The proven lower bound: by hand, what the proof rests on, and no commands below it."""

import math
from itertools import product

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import at_alert
from ethbrake_marl.extensions.proofs.avoidability import avoidability
from ethbrake_marl.extensions.proofs.branch_and_bound import CELL_COLUMNS, CELLS, command_deviation
from ethbrake_marl.extensions.proofs.flights import widest_flight
from ethbrake_marl.extensions.proofs.followers import after, after_rear, held_by_leader
from ethbrake_marl.extensions.proofs.line import FRONT_FIRST, LARGE, REAR_FIRST
from ethbrake_marl.extensions.proofs.lower_bound import front_first, lower_bound, rear_first, rounding
from ethbrake_marl.extensions.proofs.meetings import gentlest_front
from ethbrake_marl.motion.layout import FAR_M, HIT, SPEED
from tests.extensions.proofs.worlds import at, opening, play, searched_harm, wide_worlds, worlds
from tests.motion.lines import lines
from tests.refused import refused


def first_harm(state, switch, command):
    return play(state, 2, np.array([switch]), np.array([command])).harm("first")[0]


# world, controlled body -> squared closing speed that no commands undercut
PAIR_BY_HAND = {
    "standing leader: 400 - 2 * 5 * 10": (worlds(10, [0, 20], [5, 5], drive=4), 2, 300),
    "both brake: 16 - 2 * 2 * 3": (worlds(3, [20, 24], [4, 6], drive=4), 2, 4),
    "the leader brakes harder and is faster: 2 * 2 * 1": (worlds(1, [20, 18], [6, 4], drive=4), 2, 4),
    "a touch": (worlds(4, [20, 24], [4, 6], drive=4), 2, 0),
    **{f"drives away from {gap} m": (opening(gap), 1, harm) for gap, harm in ((1.5, 4), (2, 0), (3, 0))},
}


@pytest.mark.parametrize("name", PAIR_BY_HAND)
def test_pair__by_hand_less_what_rounding_can_do_which_is_next_to_nothing(name):
    state, body, harm = PAIR_BY_HAND[name]
    bound, outward = lower_bound(state, body), rounding(state, body)[0]
    assert 0.0 < outward < 2e-8 and bound.harm[0] == pytest.approx(max(harm - outward, 0.0), rel=1e-12, abs=1e-12)
    assert bound.harm[0] == (bound.front_pair if body == 2 else bound.rear_pair)[0]
    assert bound.impact_proven[0] == (harm > 0)


@pytest.mark.parametrize(("body", "step"), [(1, 0.1), (2, 0.02)])
def test_bound__is_never_above_what_its_own_optimum_reaches_in_steps(body, step):
    # Full braking behind a leader, or full drive ahead of a follower, attains the bound; rounding alone decides.
    rng, n = np.random.default_rng(61), 4000
    line, car = lines(
        rng.uniform(0.01, 60, (n, 1)) * rng.choice([0.05, 0.3, 1.0], (n, 1)), rng.uniform(0, 45, (n, 2)),
        braking_capacity_mps2=rng.uniform(1, 12, (n, 2)), driving_capacity_mps2=rng.uniform(0, 8, (n, 2)),
        mass_t=10 ** rng.uniform(-1.3, 2, (n, 2)), restitution=rng.uniform(0, 1, n), speed_limit_mps=60.0,
    )  # fmt: skip
    state = at_alert(line, car, np.zeros((n, 3, 3)), np.zeros((n, 3)), np.arange(n))
    capacity = state.driving_capacity_mps2 if body == 1 else -state.braking_capacity_mps2
    bound, outward = lower_bound(state, body).harm, rounding(state, body)
    steps = round(8.0 / step)
    times = np.tile(np.arange(steps) * step, (n, 1))
    harm = play(state, body, times, np.repeat(capacity[:, [body - 1]], steps, axis=1)).harm("first")
    attained = (harm > 0) & (harm - bound < 1e-6)
    assert attained.sum() > 500 and np.all(bound <= harm)
    # Most of what is subtracted is not needed, and all of it is little.
    assert np.max(np.abs(harm - outward - bound)[attained]) < 0.1 * outward.max() < 1e-8


def test_both_pairs__add_up():
    # Vehicle 2 cannot drive, and coasts into neither: 300 at the front as above; the rear one is 20 m/s faster.
    state = worlds([10, 1], [0, 20, 40], [5, 5, 5])
    bound = lower_bound(state)
    assert (bound.front_pair[0], bound.rear_pair[0]) == pytest.approx((300, 400 - 2 * 5 * 1))
    assert bound.harm[0] >= bound.front_pair[0] + bound.rear_pair[0]
    state.line[:, HIT] = 1.0  # further impacts count in total harm, and the honest cost is never below it
    first, total, honest = (lower_bound(state, harm_count=count).harm[0] for count in ("first", "total", "honest"))
    assert first == 0.0 and honest == total == pytest.approx(bound.harm[0])
    paper = eb.load_scenario("paper-random").sample(6, seed=7)
    total, honest = (lower_bound(paper, harm_count=count, time_step_s=0.1).harm for count in ("total", "honest"))
    assert np.array_equal(honest, total) and honest.any()


def test_early__impacts_before_the_latency_are_certain():
    state = worlds([1, 50], [10, 12, 12], [5, 5, 5], latency=[1, 1, 1])  # both coast: 2 m/s
    bound = lower_bound(state)
    assert avoidability(state).reason_name[0] == "early" and bound.early[0] == pytest.approx(4)
    assert bound.front_pair[0] == 0  # hit: a further impact of this pair does not count first
    assert lower_bound(state, harm_count="total").early[0] == pytest.approx(4)


# Recorded from version 0.5: the first worlds of seed 7, for commands at any time and at decisions.
RECORDED = {
    "paper-random": (
        8.0,
        [5.600547584600305, 17.509882798632752, 0.0, 0.0, 0.0, 13.645964117179009],
        [5.600547584600305, 19.631262732251102, 0.0, 0.0, 0.0, 14.166832943791839],
    ),
    "stress-wide": (
        16.0,
        [0.0, 30.9100990742892, 0.0, 0.0, 14.650003382986878, 0.0],
        [0.0, 30.9100990742892, 0.0, 0.0, 14.650003382986878, 0.0],
    ),
    "paper-delay-high": (
        8.0,
        [26.338367314366558, 43.07189488655127, 0.0, 4.228381773859021, 0.518867918113779, 41.17356147049801],
        [26.338367314366558, 46.928035538211816, 0.0, 4.731658673476925, 0.6322206469716386, 41.17356147049801],
    ),
}


@pytest.mark.parametrize("name", RECORDED)
def test_bounds__of_shipped_lists(name):
    horizon, any_time, decided = RECORDED[name]
    state = eb.load_scenario(name).sample(6, seed=7)
    assert lower_bound(state, harm_count="first", horizon_s=horizon).harm == pytest.approx(any_time, rel=1e-12)
    assert lower_bound(state, harm_count="first", horizon_s=horizon, time_step_s=0.1).harm == pytest.approx(
        decided, rel=1e-12
    )


@pytest.mark.parametrize("rounds", [60, pytest.param(10_000, marks=pytest.mark.slow)])
def test_bound__no_searched_commands_are_below_it_and_some_are_near(rounds):
    lists = [eb.load_scenario(name).sample(60, seed=9) for name in ("paper-random", "paper-delay-high")]
    state = eb.State.join([*lists, wide_worlds(300, 3, seed=41)])
    state = state.take(~avoidability(state).avoidable)
    least = searched_harm(state, rounds, seed=41)
    for count in ("first", "total"):
        bound = lower_bound(state, harm_count=count, horizon_s=200.0)
        assert np.all(bound.harm <= least[count])
        assert np.mean(bound.harm > 0.9 * least[count]) > 0.3  # the comparison has teeth


def test_decisions__leave_less_room_and_no_plan_is_below():
    scenario, game = eb.open_game("paper-random")
    state = scenario.sample(100, seed=7)
    any_time, decided, often = (
        lower_bound(state, harm_count="first", time_step_s=step).harm for step in (None, 0.1, 1e-3)
    )
    assert np.all(any_time <= decided) and decided.mean() > 1.02 * any_time.mean()
    assert often.mean() < 1.01 * any_time.mean()
    begun, least = game.reset(state), np.full(100, np.inf)
    for early, late, switch in product((-1, -0.5, 0, 0.5, 1), (-1, -0.5, 0, 1), range(0, 40, 4)):
        plan = np.where(np.arange(75) < switch, float(early), float(late))
        least = np.minimum(least, eb.price(game, begun, np.tile(plan[:, np.newaxis], (100, 1, 1)), "first"))
    near = (decided > 0) & (least < 1.02 * decided + 1e-6)
    assert np.all(decided <= least) and near.sum() > 10


# What a first contact leaves, and what the command in force costs.


def follows(kind, values, time, closing):
    return after(kind, values, time, time, closing, time, 0.0)


# kind, gaps, speeds, rear vehicle's latency, command, first-impact harm of both pairs
BOUNCES = {
    # 12 against 10 m/s: both at 11 -+ 0.4. With 4 m/s2 they are together again after 0.2 s, at 11.4 m/s, 2.2 m on.
    "in front, and driving on": (FRONT_FIRST, [0, 3.8], [10, 12, 30], 1.0, 4.0, [4, 18.6**2]),
    # 20 against 18 m/s: both at 19 -+ 0.4. Vehicle 3, at 4 m/s2, would be back after 0.4 s and 7.12 m; 1 cm before
    # that, Vehicle 2 has 19.4^2 - 2 * 8 * 7.11.
    "behind, and braking": (REAR_FIRST, [7.11, 0], [0, 18, 20], 0.0, -8.0, [262.6, 4]),
}


@pytest.mark.parametrize("name", BOUNCES)
def test_after__is_nearly_attained_by_bouncing_off(name):
    kind, gaps, speeds, onset, command, harm = BOUNCES[name]
    state = worlds(gaps, speeds, [4, 8, 4], [0, 0, onset], drive=4, restitution=0.4)
    assert play(state, 2, np.array([[0.0]]), np.array([[command]])).pair_harm("first")[0] == pytest.approx(harm)
    values = at(
        GAP_L=gaps[0], GAP_R=gaps[1], V_L=speeds[0], V_F=speeds[1], V_R=speeds[2], A_L=4, A_F=8, A_R=4, U_F=4,
        LIMIT_F=40, ONSET_R=onset, FRONT_SHARE=0.5, REAR_SHARE=0.5, BOUNCE=0.4,
    )  # fmt: skip
    assert max(harm) * (1 - 1e-4) <= follows(kind, values, 0.0, 2.0) <= max(harm) * (1 + 1e-12)


CELL_MEMORY = np.empty((CELLS, CELL_COLUMNS))
HELD = dict(V_L=10, A_L=8, V_F=20, A_F=4, U_F=2, LIMIT_F=40, V_R=30, A_R=4, FRONT_SHARE=0.9, GAP_R=100 - 121 / 14)
CONTACTS = {  # function, row, further arguments -> value
    # Both at 19 after 20 against 18 m/s; the rear one, braking harder, is no help: 19^2 - 2 * 4 * 7.
    "after rear, of one that brakes less": (
        after_rear, dict(GAP_L=7, V_L=0, A_L=5, V_F=18, A_F=4, V_R=20, A_R=8, REAR_SHARE=0.5),
        (0.0, 0.0, 2.0, 0.0, 0.0), 361 - 56,
    ),
    # 20 against 10 m/s, nine tenths of the mass in front, no bounce: both at 11, slowing by 0.9 * 8 - 0.1 * 2 = 7, and
    # rest after 11^2 / 14 m. The rear one, at 30 m/s with 4, comes there after 100 m in all: 900 - 800.
    "held by the leader": (held_by_leader, HELD, (0.0, 0.0, 10.0), 10.0),
    "not held by one that brakes harder": (held_by_leader, {**HELD, "A_F": 9}, (0.0, 0.0, 10.0), 0),
}  # fmt: skip


@pytest.mark.parametrize("name", CONTACTS)
def test_contact__by_hand(name):
    function, given, more, value = CONTACTS[name]
    assert function(at(**given), *more) == pytest.approx(value, rel=1e-4)


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


def test_command_in_force__the_way_to_a_gentle_contact_is_the_wrong_one_after_it():
    # In the step from 1 to 2 s; the gentlest contact at 1.5 s drives for the first second, then brakes with 8.
    given = dict(V_L=0, A_L=1, A_F=8, U_F=0, LIMIT_F=40, V_R=9, A_R=1)
    assert gentlest_front(at(GAP_L=2, V_F=2, **given), 1.5) == pytest.approx((0.0, 1.0), abs=1e-9)
    values, half = at(GAP_L=10, V_F=8, **given), math.sqrt(0.5)
    closing, drive = gentlest_front(values, 1.5)
    assert (closing, drive) == pytest.approx((8 - 8 * half, 1.5 - half))
    # 0.5 s at c instead of -8 and braking earlier instead: the speed at the end is higher by (8 + c) / 2 times 0.5 s or
    # more. With 0.5 m/s more than the least, it brakes steeper by the share that is left before the command in force.
    steep = 0.5 / (1.0 - drive)
    lack = [command_deviation(kind, values, start, 1.5, closing, closing + more, 1.0) for kind, start, more in (
        (FRONT_FIRST, 1.5, 0.5), (FRONT_FIRST, 1.5, 0.0), (REAR_FIRST, 1.0, 0.0)
    )]  # fmt: skip
    assert lack == pytest.approx([8 - (1 + steep) / (1 + 0.5 * steep), 8, 0])


# One stands 5 m ahead, the other comes from 100 m behind; 60 m ahead it may come in time.
BEFORE = dict(V_L=0, A_L=5, V_F=20, LIMIT_F=40, GAP_R=100, A_R=4)


def test_first_contact__of_the_rear_is_impossible_where_the_leader_must_be_met_before():
    near, far = (at(**BEFORE, GAP_L=gap, A_F=6, U_F=4, V_R=40, FRONT_SHARE=0.9) for gap in (5, 60))
    given = (0.0, LARGE, -1.0, CELL_MEMORY)
    assert rear_first(near, *given) == LARGE > rear_first(far, *given)
    # Nor of all at once: 400 - 2 * 4.5 * 5 in front; the rear one has 900 - 840 left, less what is pushed on.
    values = at(**BEFORE, GAP_L=5, A_F=4.5, U_F=0, V_R=30, FRONT_SHARE=0.98, REAR_SHARE=0.5)
    assert front_first(values, *given) > 400 - 2 * 4.5 * 5 + 30


# What is claimed where, and what is not.


def test_standing_vehicle__may_wait_before_it_drives():
    state = worlds(
        [1, 33], [15, 0, 15], [10, 13, 2], [0, 1.3, 1.3], drive=8, mass=[12, 13, 1], restitution=0.4,
        limit=[15, 13.5, 15],
    )  # fmt: skip
    assert avoidability(state).reason_name[0] == "rear"
    at_once, later = (first_harm(state, [0.0, start, start + 1], [-13.0, 8.0, -13.0]) for start in (1.3, 1.577))
    assert lower_bound(state, horizon_s=100.0).harm[0] <= later < 21 < at_once


def test_combined__is_claimed_only_where_contact_is_unavoidable_and_not_early():
    state = wide_worlds(600, 3, seed=46)
    reason, bound = avoidability(state).reason, lower_bound(state, harm_count="total", horizon_s=200.0)
    assert np.all(bound.combined[reason < 2] == 0) and np.mean(bound.combined[reason >= 2] > 0) > 0.3
    assert np.all(bound.harm[reason == 0] == 0)


def test_leaning__is_contact_but_no_impact_and_none_is_proven():
    # Vehicle 3 touches Vehicle 2 from the start and coasts on when Vehicle 2 brakes: it is slowed by it.
    state = worlds([12, 0], [20, 20, 20], [6, 7, 6], [0, 0.1, 0.8], drive=7)
    assert avoidability(state).reason_name[0] == "rear"
    assert first_harm(state, [0.0], [-7.0]) == lower_bound(state).harm[0] == 0


def test_horizon__what_comes_later_does_not_count():
    state = eb.load_scenario("paper-random").sample(200, seed=10)
    near, usual, far = (lower_bound(state, horizon_s=end).harm for end in (1.5, 8.0, 100.0))
    assert np.array_equal(usual, far)
    assert np.all(near <= usual) and near.mean() < 0.5 * usual.mean()


@pytest.mark.parametrize(
    ("time_step_s", "mass", "bounce", "drive"), [(None, 1.0, 0.0, 3.0), (0.1, [4.5, 5.5, 5.9], 1.0, 0.0)]
)
def test_who_stands_at_the_leader__is_struck_together_with_it(time_step_s, mass, bounce, drive):
    """One impact of all three: the front pair closes at 0 in it, and no second one follows."""
    state = worlds([0, 20], [0, 0, 20], 6.0, drive=drive, mass=mass, restitution=bounce)
    harm = first_harm(state, [0.0], [0.0])
    assert harm == pytest.approx(20.0**2 - 2 * 6 * 20)
    assert 0.0 < lower_bound(state, horizon_s=60.0, time_step_s=time_step_s).harm[0] <= harm


THREE = worlds([7, 7], [20, 18, 20], [6, 7, 6], [0, 0.5, 0.8])
REFUSED = {
    "lower_bound: harm_count = 'worst': must be 'first', 'total' or 'honest'": dict(harm_count="worst"),
    "lower_bound: horizon_s = 0.2: must be a finite number of at least 0.5": dict(horizon_s=0.2),
    "lower_bound: time_step_s = 0.0: must be a finite number of at least 0.001": dict(time_step_s=0.0),
}


@pytest.mark.parametrize("message", REFUSED)
def test_setting__is_refused(message):
    with refused(message):
        lower_bound(THREE, **REFUSED[message])


def test_one_bad_world__is_enough_to_refuse():
    later, obstacle = (
        worlds([7, 7], [20, 18, 20], [6, 7, 6], [0, latency, 0.8], obstacle=ahead)
        for latency, ahead in ((0.9, FAR_M), (0.5, 90))
    )
    with refused("lower_bound: world 1 has an obstacle ahead; the bound is proven without an obstacle"):
        lower_bound(State.join([THREE, obstacle, THREE]))
    for states in ([THREE, later], [later, THREE, THREE]):
        with refused("lower_bound: horizon_s = 0.7: must be a finite number of at least 0.9 (s)"):
            lower_bound(State.join(states), horizon_s=0.7)
        assert (lower_bound(State.join(states), horizon_s=0.9).harm >= 0.0).all()
    assert THREE.line[0, SPEED, 1] == 20  # worlds are not changed


def test_measures__are_asked_for_by_name():
    result = eb.evaluate("paper-random", "full_brake,coast", episodes=6, measures="contact_avoidable,proven_harm")
    assert result["coast"]["contact_avoidable"].tolist() == [False, False, True, True, True, False]
    assert result["coast"]["contact_avoidable_reason"].tolist() == ["front", "front", "", "", "", "rear"]
    assert result["full_brake"]["proven_harm"] == pytest.approx(RECORDED["paper-random"][2], rel=1e-12)
    assert (result["full_brake"]["proven_harm"] <= result["full_brake"]["first_impact_harm"]).all()
    soon = eb.load_scenario("paper-random").replace(horizon_s=1.5)
    near = eb.evaluate(soon, "full_brake", episodes=6, measures="proven_harm")["full_brake"]["proven_harm"]
    assert near.sum() < 0.8 * sum(RECORDED["paper-random"][2])
    coasts = eb.load_scenario("paper-random").replace(roles={"vehicle_2": "learner", "vehicle_3": "coast"})
    with refused("contact_avoidable, proven_harm: a vehicle that does not learn does not brake fully"):
        eb.evaluate(coasts, "full_brake", episodes=2, measures="contact_avoidable")
    both = eb.load_scenario("paper-random").with_learners(["vehicle_2", "vehicle_3"])
    with refused("contact_avoidable, proven_harm: vehicle_2, vehicle_3 learn; the proofs cover one controlled"):
        eb.evaluate(both, "full_brake", episodes=2, measures="proven_harm")
